"""Keys of navigation graph files."""

from __future__ import annotations

from app.formats._fields import ANGLE, ANY, COORDINATE, SPEED, WIDTH, Number, OneOf, record
from app.formats.rmf.common import NAV_GRAPH

NAME = NAV_GRAPH

_VERTEX = record(
    "name is_charger is_holding_point is_parking_spot is_passthrough_point is_cleaning_zone dock_name mutex lift "
    "lift_cabin spawn_robot_name spawn_robot_type pickup_dispenser dropoff_ingestor human_goal_set_name",
    merge_radius=Number(0.0, 1000.0, unit="metres"),
)
_LANE = record(
    "dock_name mutex door_name is_bidirectional demo_mock_floor_name demo_mock_lift_name",
    orientation_constraint=OneOf(("forward", "backward")),
    speed_limit=SPEED,
)
SHAPE = record(
    "building_name",
    levels=record(each=record(vertices=[(COORDINATE, COORDINATE, _VERTEX)], lanes=[(ANY, ANY, _LANE)])),
    doors=record(each=record("map", endpoints=[[COORDINATE]])),
    lifts=record(each=record(position=(COORDINATE, COORDINATE, ANGLE), dims=[WIDTH])),
)
"""Schema of a graph. Source: rmf_building_map_tools (building_map/generate_nav), rmf_fleet_adapter's parse_graph."""
