"""Walls of scans: drawn rooms with a robot's noise, and the furniture that a scanner sees only a part of."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from app.derive import DerivationNotes
from app.derive._centrelines import wall_boxes
from app.derive._shapes import Box
from app.derive._walls import fit_arc, join_faces, join_walls
from app.derive.occupancy_to_objects import Parameters, occupancy_to_objects
from app.model.features import Features
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.layers import Layers, PartKey

CELL = 0.05


def objects(cells: NDArray[np.uint8], **options: Any) -> Features:
    grid = OccupancyGrid(cells, CELL, (0.0, 0.0, 0.0))
    derived = occupancy_to_objects(
        Layers({PartKey("occupancy"): grid}), Parameters(**options), DerivationNotes()
    ).parts.values()
    (part,) = derived
    assert isinstance(part, Features)
    return part


def scanned_room(seed: int, yaw: float = 0.0) -> NDArray[np.uint8]:
    """Four walls of 8 × 6 m as a robot records them: a cell of noise, and gaps of up to 15 cm."""
    rng = np.random.default_rng(seed)
    cells = np.full((190, 200), FREE, np.uint8)
    c, s = math.cos(yaw), math.sin(yaw)
    corners = np.array([(-80, -60), (80, -60), (80, 60), (-80, 60)]) @ np.array([[c, s], [-s, c]]) + (100, 95)
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        along = (b - a) / np.hypot(*(b - a))
        shift = 0.0
        for step in np.arange(0, np.hypot(*(b - a)), 0.5):
            if rng.random() < 0.05:
                shift = float(rng.integers(-1, 1))
            x, y = a + along * step + np.array([-along[1], along[0]]) * shift
            cells[int(y), int(x)] = OCCUPIED
        for _ in range(5):
            x, y = (a + along * rng.uniform(10, np.hypot(*(b - a)) - 10)).astype(int)
            if abs(along[0]) > abs(along[1]):
                cells[y - 3 : y + 4, x : x + int(rng.integers(1, 4))] = FREE
            else:
                cells[y : y + int(rng.integers(1, 4)), x - 3 : x + 4] = FREE
    return cells


@pytest.mark.parametrize("yaw", [0.0, 0.35])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_scanned_room_has_few_long_walls(seed: int, yaw: float) -> None:
    part = objects(scanned_room(seed, yaw))
    walls = sorted((f.geometry.length for f in part if f.properties["kind"] == "wall"), reverse=True)
    assert 4 <= len(walls) <= 7, "of a dozen pieces on each side"
    assert sum(walls) == pytest.approx(28.0, abs=3.0), "the rest is short, oblique or in a gap"
    assert walls[3] > 3.5


def test_gaps_of_doors_stay_open() -> None:
    cells = np.full((60, 200), FREE, np.uint8)
    cells[30:33, 10:90], cells[30:33, 106:190] = OCCUPIED, OCCUPIED  # a door of 80 cm
    cells[30:33, 50:54] = FREE  # a gap of 20 cm
    walls = [f.geometry for f in objects(cells) if f.properties["kind"] == "wall"]
    assert len(walls) == 2
    door = shapely.box(4.7, 1.0, 5.1, 2.0)
    assert not any(wall.intersects(door) for wall in walls)
    assert len([f for f in objects(cells, wall_gap=0.0) if f.properties["kind"] == "wall"]) == 3
    assert len([f for f in objects(cells, wall_gap=1.0) if f.properties["kind"] == "wall"]) == 1


def test_joined_walls_follow_their_line_and_keep_others_apart() -> None:
    pieces = [Box(10.0 * k, 1.0 * k, 8.0, 1.0, math.atan(0.1)) for k in range(5)]
    parallel = Box(20.0, 12.0, 30.0, 1.0, math.atan(0.1))
    joined, other = join_walls([*pieces, parallel], 2.0, 4.0)
    assert other == parallel
    assert (joined.x, joined.y) == pytest.approx((20.0, 2.0))
    assert joined.length == pytest.approx(math.hypot(40, 4) + 8, rel=1e-6)
    assert joined.yaw == pytest.approx(math.atan(0.1))
    assert join_walls(pieces, 2.0, 0.5) == pieces, "the gaps are wider"


def test_gap_and_noise_at_their_maximum_are_joined_whatever_is_rounded() -> None:
    for yaw in np.linspace(-1.5, 1.5, 61).tolist():
        c, s = math.cos(yaw), math.sin(yaw)
        places = [(100.0, 0.0), (114.0, 0.0), (100.0, 6.0)]  # a gap of 4 cells; 6 cells aside
        pieces = [Box(50.0 + c * u - s * v, 50.0 + s * u + c * v, 10.0, 1.0, yaw) for u, v in places]
        assert len(join_walls(pieces[:2], 2.0, 4.0)) == 1, yaw
        assert len(join_walls(pieces[::2], 6.0, 4.0)) == 1, yaw
        assert join_walls(pieces, 5.999, 3.999) == pieces, yaw


@pytest.mark.parametrize("yaw", [0.0, 0.5, 1.2, -0.8])
def test_wall_is_as_wide_and_long_as_its_cells(yaw: float) -> None:
    along = np.array([math.cos(yaw), math.sin(yaw)])
    rows, columns = np.mgrid[0:120, 0:120] + 0.5
    ahead = (columns - 60) * along[0] + (rows - 55) * along[1]
    aside = (rows - 55) * along[0] - (columns - 60) * along[1]
    thin = ((np.abs(ahead) <= 40) & (np.abs(aside) <= 3)).astype(np.uint8)
    aside_of_line = np.array([-along[1], along[0]])  # the centreline is a cell beside the middle
    ends = np.array([60.0, 55.0]) - 0.5 + aside_of_line + np.array([[-30.0], [35.0]]) * along
    (wall,) = wall_boxes(thin, ends[None], 12.0)
    assert (wall.x, wall.y) == pytest.approx((60.0, 55.0), abs=0.6)
    assert wall.length == pytest.approx(80.0, abs=1.5)
    assert wall.width == pytest.approx(6.0, abs=0.8)
    assert wall.yaw == pytest.approx(yaw)


def test_faces_of_a_wall_are_joined_unless_there_is_free_ground_between() -> None:
    faces = [Box(50.0, 20.0, 60.0, 1.0, 0.0), Box(55.0, 24.0, 40.0, 1.0, 0.0)]
    unknown = np.zeros((50, 100), bool)
    (wall,) = join_faces(faces, unknown, 6.0)
    assert wall.width == pytest.approx(5.0)
    assert 20.0 < wall.y < 24.0
    assert join_faces(faces, ~unknown, 6.0) == faces
    assert join_faces(faces, unknown, 4.0) == faces, "thicker than a wall"


def test_seen_part_of_a_rim_is_round() -> None:
    angles = np.linspace(0.0, math.pi, 30)
    disc = fit_arc(np.column_stack([50 + 6 * np.cos(angles), 40 + 6 * np.sin(angles)]), 15.0)
    assert disc is not None
    assert (disc.x, disc.y, disc.radius) == pytest.approx((50.0, 40.0, 6.5))
    assert fit_arc(np.column_stack([np.arange(20.0), np.zeros(20)]), 15.0) is None, "a straight wall"
    assert fit_arc(np.column_stack([50 + 6 * np.cos(angles / 3), 40 + 6 * np.sin(angles / 3)]), 15.0) is None


def test_half_seen_round_table_is_furniture() -> None:
    cells = scanned_room(1)
    rim = np.zeros(cells.shape, np.uint8)
    cv2.ellipse(rim, (60, 70), (9, 9), 0, 180, 360, 1, 1)
    y, x = np.mgrid[: cells.shape[0], : cells.shape[1]]
    cells[(np.hypot(x - 60, y - 70) < 9) & (y < 75)] = UNKNOWN
    cells[rim == 1] = OCCUPIED
    (table,) = [f for f in objects(cells) if f.properties["kind"] == "furniture"]
    assert table.properties["radius"] == pytest.approx(9.5 * CELL, abs=CELL)
    assert table.geometry.centroid.distance(shapely.Point(60.5 * CELL, 70.5 * CELL)) < 2 * CELL


def test_four_legs_carry_a_table_and_other_posts_none() -> None:
    cells = scanned_room(2)
    for x, y in ((60, 70), (88, 70), (60, 86), (88, 86), (130, 80), (140, 100)):
        cells[y : y + 2, x : x + 2] = OCCUPIED
    part = objects(cells)
    (table,) = [f for f in part if f.properties["kind"] == "furniture"]
    assert table.geometry.area == pytest.approx(29 * 17 * CELL**2, rel=0.1)
    assert len([f for f in part if f.properties["kind"] == "post"]) == 2
    racks = [f for f in objects(cells, context="warehouse") if f.properties["kind"] == "rack"]
    assert not racks, "only offices have tables"
    filled_cells = cells.copy()
    filled_cells[72:84, 62:86] = OCCUPIED
    filled = [f for f in objects(filled_cells) if f.properties["kind"] == "furniture"]
    areas = [f.geometry.area / CELL**2 for f in filled]
    assert areas == pytest.approx([24 * 12], rel=0.2), "a thing between posts is no table"


def test_broken_rim_around_unknown_ground_is_furniture() -> None:
    cells = scanned_room(3)
    cells[70:96, 60:90] = UNKNOWN
    cells[70:96, 60], cells[70:96, 89], cells[70, 60:90], cells[95, 60:90] = (OCCUPIED,) * 4
    cells[80:83, 60], cells[70, 70:72] = FREE, FREE
    (pallet,) = [f for f in objects(cells) if f.properties["kind"] == "furniture"]
    assert pallet.geometry.area == pytest.approx(30 * 26 * CELL**2, rel=0.1)


@pytest.mark.parametrize("door", [0, 18])
def test_broken_rim_in_a_closed_room_is_furniture(door: int) -> None:
    cells = np.full((140, 160), FREE, np.uint8)
    cells[10:13, 10:150], cells[127:130, 10:150] = OCCUPIED, OCCUPIED
    cells[10:130, 10:13], cells[10:130, 147:150] = OCCUPIED, OCCUPIED
    cells[10:13, 100 : 100 + door] = FREE
    for x in (30, 90):
        cells[50:76, x : x + 30] = UNKNOWN
        cells[50:76, x], cells[50:76, x + 29] = OCCUPIED, OCCUPIED
        cells[50, x : x + 30], cells[75, x : x + 30] = OCCUPIED, OCCUPIED
        cells[60:62, x], cells[50, x + 10 : x + 12], cells[75, x + 20 : x + 22] = FREE, FREE, FREE
    part = objects(cells)
    pallets = [f.geometry for f in part if f.properties["kind"] == "furniture"]
    assert [p.area for p in pallets] == pytest.approx([30 * 26 * CELL**2] * 2, rel=0.1)
    assert len([f for f in part if f.properties["kind"] == "wall"]) == (5 if door else 4), "only those of the room"


@pytest.mark.parametrize("yaw", [0.0, 0.35, 0.8, 1.9, -0.35])
@pytest.mark.parametrize(("left", "right", "boxes"), [(0.15, 1.0, 0), (0.3, 1.0, 0), (0.5, 0.5, 1), (1.0, 1.0, 1)])
def test_rim_counts_all_sides_of_a_turned_box(left: float, right: float, boxes: int, yaw: float) -> None:
    """A side of 2 m and parts of those beside it: furniture if enough was seen, else the corner of a room."""
    cells = np.full((140, 140), FREE, np.uint8)
    c, s = math.cos(yaw), math.sin(yaw)

    def drawn(*points: tuple[float, float]) -> NDArray[np.int32]:
        return np.round(np.array(points) @ np.array([[c, s], [-s, c]]) + (70, 70)).astype(np.int32)

    cv2.fillPoly(cells, [drawn((-20, -15), (20, -15), (20, 15), (-20, 15))], UNKNOWN)
    ends = (-20, 30 * left - 15), (20, 30 * right - 15)
    cv2.polylines(cells, [drawn(ends[0], (-20, -15), (20, -15), ends[1])], False, OCCUPIED)
    found = [f.geometry for f in objects(cells) if f.properties["kind"] == "furniture"]
    assert [f.area for f in found] == pytest.approx([41 * (30 * right + 1) * CELL**2] * boxes, rel=0.1)
