#!/bin/sh
# topological_navigation after a new map: switch_topological_map of its map manager, where the network changed; then a
# check that the manager publishes this very network. ../ros/fleetmap_ros/loading.py says which variables it takes.
exec "${FLEETMAP_PYTHON:-python3}" "$(dirname "$0")/../ros/fleetmap_ros/loading.py" topological
