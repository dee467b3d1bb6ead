#!/bin/sh
# Load a new map into Nav2: load_map of the map server and the filter mask servers, set_route_graph of the route server,
# and DynamicEdges for edges that the graph marks as blocked. Variables: see ../ros/fleetmap_ros/loading.py.
exec "${FLEETMAP_PYTHON:-python3}" "$(dirname "$0")/../ros/fleetmap_ros/loading.py" nav2
