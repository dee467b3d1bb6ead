#!/bin/sh
# Nav2 after a new map: load_map of the map server and of the filter mask servers, set_route_graph of the route server,
# and DynamicEdges for edges that a graph marks as blocked. ../ros/fleetmap_ros/loading.py says which variables it takes.
exec "${FLEETMAP_PYTHON:-python3}" "$(dirname "$0")/../ros/fleetmap_ros/loading.py" nav2
