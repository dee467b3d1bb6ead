#!/bin/sh
# topological_navigation after a new map: switch_topological_map of its map manager, where the network changed.
#
# Another name of the node: FLEETMAP_TOPOLOGICAL_MANAGER. The service: topological_navigation_msgs/srv/WriteTopologicalMap.
set -u
here=$(readlink -f "$FLEETMAP_CURRENT") || exit 1
file="$here/tmap2/network.tmap2.yaml"
[ -f "$file" ] || file=$(find "$here/tmap2" -maxdepth 1 -name '*.yaml' 2>/dev/null | sort | head -n 1)
[ -n "$file" ] && [ -f "$file" ] || { echo "there is no tmap2 in $here: add it to --formats"; exit 1; }
printf '%s\n' "$FLEETMAP_CHANGED" | grep -q '^tmap2/' || exit 0

service="${FLEETMAP_TOPOLOGICAL_MANAGER:-/topological_map_manager2}/switch_topological_map"
quoted=$(printf '%s' "$file" | sed "s/'/''/g")
answer=$(timeout "${FLEETMAP_ROS_SECONDS:-60}" ros2 service call "$service" \
  topological_navigation_msgs/srv/WriteTopologicalMap "{filename: '$quoted', no_alias: false}" 2>&1)
status=$?
if [ $status -ne 0 ] || ! printf '%s' "$answer" | grep -q 'success=True'; then
  echo "$service did not take it (status $status): $(printf '%s' "$answer" | tail -n 3 | cut -c1-500)"
  exit 1
fi
echo "$service: done"
