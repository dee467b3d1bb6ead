"""Keys of building files, and the object kind of each of their lists."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from app.formats._fields import ANGLE, ANY, COORDINATE, LENGTH, NOT_NEGATIVE, SPEED, Number, OneOf, Typed, record
from app.formats.rmf.building.coordinates import MIN_SCALE
from app.formats.rmf.common import BUILDING

NAME = BUILDING
FILE = "building.yaml"

LINES: Mapping[str, str] = {
    "walls": "wall",
    "doors": "door",
    "measurements": "measurement",
    "human_lanes": "human_lane",
}
RINGS: Mapping[str, str] = {"floors": "floor", "holes": "hole"}
LISTS = frozenset({*LINES, *RINGS, "lanes", "vertices", "models", "fiducials"})
"""Item lists of a level; its other keys stay in the document."""

IN_PIXELS = frozenset(
    {
        *("constraints", "drawing", "features", "layers", "lights", "physical_cameras"),
        *("flattened_x_offset", "flattened_y_offset", "x_meters", "y_meters"),
    }
)
"""Level keys with values in drawing pixels."""

LIFT_WORDS = frozenset({"x", "y", "yaw", "width", "depth"})
DOOR_TEMPLATE: Mapping[str, Any] = {
    "motion_axis": [1, "start"],
    "motion_degrees": [3, 90.0],
    "motion_direction": [2, 1],
    "type": [1, "hinged"],
}

_LANE = record(
    "mutex demo_mock_floor_name demo_mock_lift_name dock_name",
    bidirectional=Typed(OneOf((True, False))),
    graph_idx=Typed(Number(0, 1000)),
    orientation=Typed(OneOf(("", "forward", "backward"))),
    speed_limit=Typed(SPEED),
    width=Typed(NOT_NEGATIVE),
)
_WALL = record(
    "texture_name",
    alpha=Typed(Number(0.0, 1.0)),
    texture_height=Typed(NOT_NEGATIVE),
    texture_scale=Typed(NOT_NEGATIVE),
    texture_width=Typed(NOT_NEGATIVE),
)
_DOOR = record(
    "name motion_axis plugin",
    motion_degrees=Typed(Number(-360.0, 360.0, unit="degrees")),
    motion_direction=Typed(Number(-1, 1)),
    right_left_ratio=Typed(NOT_NEGATIVE),
    type=Typed(OneOf(("hinged", "double_hinged", "sliding", "double_sliding", "telescope", "double_telescope"))),
)
_VERTEX = record(
    "is_charger is_holding_point is_parking_spot is_passthrough_point is_cleaning_zone dock_name mutex lift_cabin "
    "spawn_robot_name spawn_robot_type pickup_dispenser dropoff_ingestor human_goal_set_name",
    merge_radius=Typed(Number(0.0, 1000.0, unit="metres")),
)
_RING = record(
    "vertices",
    parameters=record(
        "indoor ceiling_texture texture_name",
        texture_rotation=Typed(Number(-360.0, 360.0, unit="degrees")),
        texture_scale=Typed(NOT_NEGATIVE),
        ceiling_scale=Typed(NOT_NEGATIVE),
    ),
)
_LAYER = record(
    "features filename visible",
    color=[Number(0.0, 1.0)],
    transform=record(
        scale=Number(MIN_SCALE, 1 / MIN_SCALE, unit="metres per pixel"),
        translation_x=COORDINATE,
        translation_y=COORDINATE,
        yaw=ANGLE,
    ),
)
_LEVEL = record(
    "constraints drawing features fiducials lights physical_cameras",
    doors=[(ANY, ANY, _DOOR)],
    elevation=COORDINATE,
    flattened_x_offset=COORDINATE,
    flattened_y_offset=COORDINATE,
    floors=[_RING],
    holes=[_RING],
    human_lanes=[(ANY, ANY, _LANE)],
    lanes=[(ANY, ANY, _LANE)],
    layers=record(each=_LAYER),
    measurements=[(ANY, ANY, record(distance=Typed(COORDINATE)))],
    models=[
        record("model_name name static dispensable lift_cabin", x=COORDINATE, y=COORDINATE, z=COORDINATE, yaw=ANGLE)
    ],
    vertices=[(COORDINATE, COORDINATE, COORDINATE, ANY, _VERTEX)],
    walls=[(ANY, ANY, _WALL)],
    x_meters=COORDINATE,
    y_meters=COORDINATE,
)
_LIFT = record(
    "highest_floor initial_floor_name level_doors lowest_floor plugins reference_floor_name",
    depth=LENGTH,
    width=LENGTH,
    x=COORDINATE,
    y=COORDINATE,
    yaw=ANGLE,
    doors=record(
        each=record(door_type=Number(0, 100), motion_axis_orientation=ANGLE, width=LENGTH, x=COORDINATE, y=COORDINATE)
    ),
)
SHAPE = record(
    "coordinate_system crowd_sim graphs name reference_level_name",
    parameters=record(
        "generate_crs", suggested_offset_x=Typed(Number(-1e9, 1e9)), suggested_offset_y=Typed(Number(-1e9, 1e9))
    ),
    levels=record(each=_LEVEL),
    lifts=record(each=_LIFT),
)
"""Schema of a building. Source: rmf_traffic_editor's files and their reader, rmf_building_map_tools."""
