#!/bin/sh
# Load a new map into topological_navigation: call switch_topological_map of its map manager if the network has changed,
# then check that the manager publishes this network. Variables: see ../ros/fleetmap_ros/loading.py.
exec "${FLEETMAP_PYTHON:-python3}" "$(dirname "$0")/../ros/fleetmap_ros/loading.py" topological
