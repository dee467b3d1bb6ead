#!/bin/sh
# Nav2 after a new map: load_map of the map server and of the mask servers, set_route_graph of the route server.
#
# Only what changed is loaded. The files are named by the version's own folder, so that a switch in between does not mix
# two maps. Other names of nodes (a namespace, for instance): FLEETMAP_NAV2_MAP_SERVER=/robot1/map_server; empty: not at all.
# The services' definitions: nav2_msgs/srv/LoadMap (result 0 is success), nav2_msgs/srv/SetRouteGraph.
set -u
here=$(readlink -f "$FLEETMAP_CURRENT") || exit 1
seconds=${FLEETMAP_ROS_SECONDS:-60}
failed=0

quoted() { printf '%s' "$1" | sed "s/'/''/g"; }  # inside YAML's single quotes

changed() {  # whether one of these files (format/file) changed
  for file in "$@"; do
    printf '%s\n' "$FLEETMAP_CHANGED" | grep -qxF -- "$file" && return 0
  done
  return 1
}

call() {  # service, type, request, what the answer has where it worked
  answer=$(timeout "$seconds" ros2 service call "$1" "$2" "$3" 2>&1)
  status=$?
  if [ $status -ne 0 ] || ! printf '%s' "$answer" | grep -qE -- "$4"; then
    echo "$1 did not take it (status $status): $(printf '%s' "$answer" | grep -oE 'result=[0-9]+|success=[A-Za-z]+|[Ee]rror.*' | head -n 3 | cut -c1-300)"
    failed=1
  else
    echo "$1: done"
  fi
}

gone() {  # what, file: Nav2 has no service that unloads
  if changed "$2" && [ ! -e "$here/$2" ]; then
    echo "$1 is no longer part of the map; Nav2 goes on with the one of before until it is started anew"
    failed=1
  fi
}

load_map() {  # node, grid
  [ -n "$1" ] || return 0
  gone "the grid $2" "occupancy_grid/$2.yaml"
  [ -f "$here/occupancy_grid/$2.yaml" ] || return 0
  changed "occupancy_grid/$2.yaml" "occupancy_grid/$2.pgm" "occupancy_grid/$2.png" || return 0
  call "$1/load_map" nav2_msgs/srv/LoadMap "{map_url: '$(quoted "$here/occupancy_grid/$2.yaml")'}" 'result=0([^0-9]|$)'
}

load_map "${FLEETMAP_NAV2_MAP_SERVER-/map_server}" "${FLEETMAP_NAV2_MAP-map}"
load_map "${FLEETMAP_NAV2_KEEPOUT_SERVER-/keepout_filter_mask_server}" keepout
load_map "${FLEETMAP_NAV2_SPEED_SERVER-/speed_filter_mask_server}" speed

route=${FLEETMAP_NAV2_ROUTE_SERVER-/route_server}
[ -z "$route" ] || gone "the route graph" nav2_route/graph.geojson
if [ -n "$route" ] && [ -f "$here/nav2_route/graph.geojson" ] && changed nav2_route/graph.geojson; then
  call "$route/set_route_graph" nav2_msgs/srv/SetRouteGraph \
    "{graph_filepath: '$(quoted "$here/nav2_route/graph.geojson")'}" 'success=True'
fi
exit $failed
