"""The HTTP interface: one module for each noun.

``middleware`` stands in front (token, bodies, errors), ``maps.FleetMapApp`` before it (repeated requests from memory);
``problems`` knows the status of every error, ``schemas`` the shapes and examples.
"""
