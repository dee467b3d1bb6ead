"""Obstacles by kind: roles, bodies, heights and the walls of lifts."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import shapely

from app.model import obstacles, raster
from app.model.grid import FREE, OCCUPIED, UNKNOWN

POINT, LINE, AREA = shapely.Point(0, 0), shapely.LineString([(0, 0), (4, 0)]), shapely.box(0, 0, 4, 2)
DOOR = {"x": 0.0, "y": -1.0, "motion_axis_orientation": 0.0, "width": 1.0, "door_type": 2}


def lift(**doors: Any) -> dict[str, Any]:
    return {
        "kind": "lift",
        "size": [2.0, 2.0, 2.5],
        "pose": [10.0, 0.0, 0.0, 0.0, 0.0, math.pi / 2],
        "openrmf": {"says": {"doors": doors}},
    }


@pytest.mark.parametrize(
    ("properties", "role"),
    [
        ({"kind": "floor"}, "ground"),
        ({"kind": "lift", "shapes": [{"type": "box"}]}, "ground"),
        ({"kind": "region", "height": 2.0}, "mark"),
        ({"kind": "door", "shapes": [{"type": "box"}]}, "mark"),
        ({"kind": "model", "shapes": [{"type": "box"}]}, "solids"),
        ({"kind": "wall"}, "outline"),
        ({"kind": "hole"}, "outline"),
        ({"kind": "anything", "size": [1, 1, 1]}, "outline"),
        ({"kind": "building", "osm": {"tags": {"building": "roof"}}}, "mark"),
        ({"kind": "include"}, "bodiless"),
        ({}, "mark"),
    ],
)
def test_role_follows_kind_shapes_and_tags(properties: dict[str, Any], role: str) -> None:
    assert obstacles.object_role(properties) == role


def test_door_is_outline_when_doors_are_closed() -> None:
    assert obstacles.object_role({"kind": "door"}, doors_closed=True) == "outline"


def test_height_is_top_above_floor() -> None:
    assert obstacles.object_heights({"kind": "wall", "base": 1.0, "height": 4.0}, LINE) == (1.0, 4.0)
    assert obstacles.object_heights({"kind": "crate", "size": [1, 1, 2], "pose": [0, 0, 1.5]}, POINT) == (1.5, 3.5)
    shelf = {"kind": "crate", "size": [1, 1, 2], "pose": [0, 0, -2.5]}
    assert obstacles.object_heights(shelf, POINT, elevation=-4.0) == (1.5, 3.5)
    assert obstacles.object_heights(shelf, POINT, elevation=3.0) == (0.0, 2.0), "none is below its floor"
    assert obstacles.object_heights({"kind": "wall"}, LINE) == (0.0, math.inf)
    tags = {"building": "yes", "building:min_level": "1", "building:levels": "3"}
    assert obstacles.object_heights({"kind": "building", "osm": {"tags": tags}}, AREA) == (3.0, 9.0)


def test_wall_lines_close_corners_and_others_keep_their_ends() -> None:
    wall, fence = (obstacles.object_body({"kind": kind, "width": 0.2}, LINE) for kind in ("wall", "fence"))
    assert wall is not None
    assert fence is not None
    assert wall.area.bounds == pytest.approx((-0.1, -0.1, 4.1, 0.1))
    assert fence.area.bounds == pytest.approx((0.0, -0.1, 4.0, 0.1))


def test_lift_walls_are_open_at_doors() -> None:
    """For a cabin of 2 × 2 m turned by 90 degrees, the door on its lower side is on the right."""
    body = obstacles.object_body(lift(front=DOOR), POINT)
    assert body is not None
    assert (body.base, body.top) == (0.0, 2.5)
    assert body.area.area == pytest.approx(2.1**2 - 2.0**2 - 0.05)
    assert body.area.bounds == pytest.approx((8.95, -1.05, 11.05, 1.05))
    assert not body.area.intersects(shapely.box(11.0, -0.49, 11.1, 0.49))
    ground = obstacles.object_ground(lift(front=DOOR), POINT)
    assert ground is not None
    assert ground.bounds == pytest.approx((9, -1, 11, 1))


@pytest.mark.parametrize(
    "doors", [{}, {"front": None}, {"front": {**DOOR, "x": "left"}}, {"front": {**DOOR, "width": math.nan}}]
)
def test_lift_without_known_door_has_no_walls(doors: dict[str, Any]) -> None:
    """Walls without a way in would lock the cabin."""
    assert obstacles.object_body(lift(**doors), POINT) is None


def test_flood_fills_cells_connected_to_border() -> None:
    cells = np.zeros((9, 12), np.uint8)
    cells[2:7, 2:7], cells[3:6, 3:6] = OCCUPIED, FREE
    cells[2:7, 8], cells[4, 8] = OCCUPIED, FREE
    raster.flood(cells, FREE, UNKNOWN)
    assert (cells[3:6, 3:6] == FREE).all()
    assert np.count_nonzero(cells == FREE) == 9
    assert np.count_nonzero(cells == OCCUPIED) == 16 + 4
