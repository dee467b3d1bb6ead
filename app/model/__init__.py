"""Canonical layers as frozen, checked values, independent of the format they came in.

``frame`` datum and levels · ``geodesy`` WGS 84 to the local frame · ``features`` location, objects, topology, zones ·
``grid`` occupancy · ``voxels`` · ``imagery`` · ``layers`` all of it together.
"""
