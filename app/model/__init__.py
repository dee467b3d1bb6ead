"""The canonical layers as frozen, checked values: what the server knows, in one form, whatever format it came in.

``frame`` datum and levels · ``geodesy`` WGS 84 to the local frame · ``features`` location, objects, topology, zones ·
``grid`` occupancy · ``voxels`` · ``imagery`` · ``layers`` all of it together.
"""
