"""Rooms, doors, aisles and rows of drawn grids: what is found, how it is called, and that names last."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import shapely
import shapely.affinity
from numpy.typing import NDArray

from app import derive
from app.derive import DerivationNotes, _reading_order, _strips
from app.derive.occupancy_to_topology import Parameters as NetworkParameters
from app.derive.occupancy_to_topology import occupancy_to_topology
from app.derive.occupancy_to_zones import Parameters, occupancy_to_zones
from app.errors import CannotConvert
from app.model.features import Features, features
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.layers import NETWORK, ZONES, Layers, PartKey

CELL = 0.1
AREAS = PartKey("zones", "ground", "areas")
MAP = PartKey("occupancy")


def draw(width: float, height: float, walls: Sequence[tuple[float, float, float, float]], value: int = FREE) -> Any:
    """Return cells of a ground with walls: boxes x0, y0, x1, y1 in metres."""
    cells = np.full((round(height / CELL), round(width / CELL)), value, np.uint8)
    for x0, y0, x1, y1 in walls:
        cells[round(y0 / CELL) : round(y1 / CELL), round(x0 / CELL) : round(x1 / CELL)] = OCCUPIED
    return cells


def flat() -> NDArray[np.uint8]:
    """Two rooms of 5 × 4 m in the north, a corridor of 10 × 1.6 m south of them, doors of 0.9 m at x 2 and 7."""
    frame = [(0, 0, 10.4, 0.2), (0, 6.2, 10.4, 6.4), (0, 0, 0.2, 6.4), (10.2, 0, 10.4, 6.4)]
    inner = [(5.1, 2.0, 5.3, 6.4), (0, 1.8, 2.0, 2.0), (2.9, 1.8, 7.0, 2.0), (7.9, 1.8, 10.4, 2.0)]
    return np.asarray(draw(10.4, 6.4, [*frame, *inner]))


def zones(cells: Any, stored: Features | None = None, **more: Any) -> Features:
    grid = cells if isinstance(cells, OccupancyGrid) else OccupancyGrid(cells, CELL, **more)
    layers = Layers({MAP: grid} | ({AREAS: stored} if stored is not None else {}))
    part = occupancy_to_zones(layers, Parameters(), DerivationNotes()).parts[AREAS]
    assert isinstance(part, Features)
    return part


def by_name(part: Features) -> dict[str, Any]:
    return {str(p["name"]): (p, shape) for p, shape in zip(part.properties, part.geometry, strict=True)}


def test_flat_has_rooms_a_corridor_and_doors() -> None:
    found = by_name(zones(flat()))
    assert sorted(found) == ["corridor-1", "door-1", "door-2", "room-1", "room-2"]
    west, east = found["room-1"][1], found["room-2"][1]
    assert west.contains(shapely.Point(2.5, 4))
    assert east.contains(shapely.Point(7.7, 4))
    assert found["corridor-1"][1].contains(shapely.Point(5, 1))
    assert west.area == pytest.approx(4.9 * 4.2, rel=0.1)
    for name, x in (("door-1", 2.45), ("door-2", 7.45)):
        door, shape = found[name]
        assert shape.centroid.distance(shapely.Point(x, 1.9)) < 0.3
        assert door["width"] == pytest.approx(0.9, abs=0.15)
        assert 0.5 <= door["confidence"] <= 1.0


def halls(stub: float, opening: float) -> NDArray[np.uint8]:
    """Two halls of 10 × 3 m, one south of the other, with an opening in the wall between them."""
    frame = [(0, 0, 10.4, 0.2), (0, 6.4, 10.4, 6.6), (0, 0, 0.2, 6.6), (10.2, 0, 10.4, 6.6)]
    return np.asarray(draw(10.4, 6.6, [*frame, (0, 3.2, 0.2 + stub, 3.4), (0.2 + stub + opening, 3.2, 10.4, 3.4)]))


@pytest.mark.parametrize("yaw", [0, 1])
def test_opening_wider_than_a_room_is_deep_parts_rooms(yaw: int) -> None:
    found = by_name(zones(np.rot90(halls(1.5, 4.0), yaw).copy()))
    assert sorted(found) == ["room-1", "room-2"], "an opening of 4 m is no door"
    assert [shape.area for _, shape in found.values()] == pytest.approx([30.0, 30.0], rel=0.05)


def test_piece_of_wall_in_a_room_does_not_part_it() -> None:
    assert sorted(by_name(zones(halls(0.0, 6.0)))) == ["room-1"], "there is wall on one side only"
    assert sorted(by_name(zones(halls(1.0, 7.0)))) == ["room-1"], "the opening is most of the wall"


def test_niche_belongs_to_its_room() -> None:
    cells = draw(10.0, 8.0, [(0, 0, 10, 0.2), (0, 7.8, 10, 8), (0, 0, 0.2, 8), (9.8, 0, 10, 8)])
    cells[20:22, 70:86] = cells[40:42, 70:86] = OCCUPIED  # a booth of 1.8 × 2.8 m with a counter before it,
    cells[20:42, 70:72] = OCCUPIED  # and ways of 1.2 m past it
    assert sorted(by_name(zones(cells))) == ["room-1"]


def test_goods_around_one_pallet_are_no_chain() -> None:
    cells = draw(8.0, 8.0, [(0, 0, 8, 0.2), (0, 7.8, 8, 8), (0, 0, 0.2, 8), (7.8, 0, 8, 8), (2.8, 3.9, 5.2, 4.1)])
    cells[[35, 35, 45, 45, 48], [36, 44, 36, 44, 40]] = OCCUPIED
    assert sorted(by_name(zones(cells))) == ["room-1"]


def test_areas_follow_origin_and_yaw_of_the_grid() -> None:
    yaw = 0.4
    plain, turned = by_name(zones(flat())), by_name(zones(flat(), origin=(3.0, -2.0, yaw)))
    c, s = math.cos(yaw), math.sin(yaw)
    x, y = plain["door-1"][1].centroid.coords[0]
    expected = shapely.Point(3.0 + c * x - s * y, -2.0 + s * x + c * y)
    assert min(shape.centroid.distance(expected) for p, shape in turned.values() if p["kind"] == "door") < 1e-6


def test_furniture_is_part_of_its_room() -> None:
    cells = flat()
    table = [(1.0, 3.0), (2.2, 3.0), (1.0, 4.2), (2.2, 4.2)]
    for x, y in table:
        cells[round(y / CELL), round(x / CELL)] = OCCUPIED
    cells[45:53, 70:90] = UNKNOWN  # behind a cupboard
    cells[45, 70:90] = OCCUPIED
    assert sorted(by_name(zones(cells))) == ["corridor-1", "door-1", "door-2", "room-1", "room-2"]


def test_open_ground_has_no_rooms_but_rows() -> None:
    hedges = [(3.0, 3.0 + 2.5 * k, 15.0, 3.2 + 2.5 * k) for k in range(4)]
    found = by_name(zones(draw(18.0, 14.0, hedges)))
    assert sorted(found) == ["row-1", "row-2", "row-3"]
    for row, shape in found.values():
        assert row["width"] == pytest.approx(2.3, abs=0.2)
        assert shapely.LineString([(3.5, shape.centroid.y), (14.5, shape.centroid.y)]).within(shape)
    assert found["row-1"][1].centroid.y > found["row-3"][1].centroid.y, "numbers go from north to south"


def test_rows_side_by_side_are_numbered_across_their_direction() -> None:
    hedges = [(3.0 + 2.5 * k, 3.0 + k % 3, 3.2 + 2.5 * k, 14.0 + k % 2) for k in range(12)]  # their ends differ
    found = by_name(zones(draw(36.0, 19.0, hedges)))
    assert len(found) == 11
    east = [found[f"row-{k}"][1].centroid.x for k in range(1, 12)]
    assert east == sorted(east)


def turned(x: float, y: float, angle: float, length: float = 20.0) -> Any:
    strip = shapely.affinity.rotate(shapely.box(-length / 2, -1, length / 2, 1), angle, origin=(0, 0))
    return shapely.affinity.translate(strip, x, y)


def test_groups_of_strips_are_numbered_one_after_the_other() -> None:
    slope = [turned(4.0 * k, 3.0 * k + (-2.0) ** (k % 3), -53.0) for k in range(6)]
    far = [turned(100.0, 40.0 - 4.0 * k, 0.0) for k in range(3)]
    lane = [turned(-100.0, -40.0, 2.0), turned(-75.0, -40.3, 1.0), turned(-88.0, -45.0, 0.0)]
    shapes = [*slope[::-1], *far, *lane]
    assert _reading_order.strips(shapes) == [6, 7, 8, 5, 4, 3, 2, 1, 0, 9, 10, 11]
    assert _reading_order.strips([]) == []


def test_places_of_different_depth_are_read_in_lines() -> None:
    upper = [shapely.box(10 * k, 20 - k % 2, 10 * k + 9, 26 + k % 3) for k in range(4)]
    lower = [shapely.box(10 * k, 8 + k % 2, 10 * k + 9, 14) for k in range(4)]
    shapes = [*lower[::-1], *upper[::-1]]
    assert _reading_order.places(shapes) == [7, 6, 5, 4, 3, 2, 1, 0]


def test_racks_in_a_hall_give_aisles() -> None:
    hall = [(0, 0, 16, 0.2), (0, 11.8, 16, 12), (0, 0, 0.2, 12), (15.8, 0, 16, 12)]
    racks = [(3.0, 3.0 + 3.0 * k, 13.0, 4.2 + 3.0 * k) for k in range(3)]
    found = by_name(zones(draw(16.0, 12.0, [*hall, *racks])))
    assert sorted(found) == ["aisle-1", "aisle-2", "room-1"]
    assert found["aisle-2"][1].centroid.distance(shapely.Point(8.0, 5.1)) < 0.3


def test_posts_in_a_lattice_are_chained_along_the_longer_side() -> None:
    posts = np.zeros((300, 160), bool)
    for y in range(20, 280, 30):
        for x in range(30, 130, 14):
            posts[y, x + y // 30] = True
    lines = _strips.obstacle_lines(posts, CELL)
    assert len(lines) == 8
    for line in lines:
        along = np.abs(line.ends[1] - line.ends[0])
        assert along[1] > 10 * along[0]


@pytest.mark.parametrize("value", [FREE, UNKNOWN, OCCUPIED])
def test_grid_without_areas_is_refused(value: int) -> None:
    with pytest.raises(CannotConvert, match="no rooms, doors, aisles or rows"):
        zones(draw(5.0, 5.0, [], value))


def test_renamed_area_keeps_its_name_when_derived_again() -> None:
    before = zones(flat())
    properties = [
        {**p, "name": "Kitchen", "note": "wet floor"} if p["name"] == "room-2" else p for p in before.properties
    ]
    stored = replace(before, properties=tuple(properties))
    cells = flat()
    cells[20:62, 20:22] = OCCUPIED  # a wall divides the western room
    cells[36:46, 20:22] = FREE
    after = by_name(zones(cells, stored))
    kitchen = after["Kitchen"][0]
    assert (kitchen["kind"], kitchen["note"]) == ("room", "wet floor")
    assert {"corridor-1", "door-1", "door-2", "room-1", "room-3", "door-3"} <= set(after)
    ids = zones(cells, stored).ids
    assert "room-2" in ids, "its id stays too"


def test_result_is_the_same_for_each_run() -> None:
    one, other = zones(flat()), zones(flat())
    assert one.ids == other.ids
    assert shapely.to_wkb(one.geometry).tolist() == shapely.to_wkb(other.geometry).tolist()


def named_network(zone_part: Features, cells: Any) -> tuple[Features, DerivationNotes]:
    notes = DerivationNotes()
    layers = Layers({MAP: OccupancyGrid(cells, CELL), PartKey("zones", "ground", ZONES): zone_part})
    part = occupancy_to_topology(layers, NetworkParameters(), notes).parts[PartKey("topology", "ground", NETWORK)]
    assert isinstance(part, Features)
    return part, notes


def nodes(network: Features) -> dict[str, tuple[dict[str, Any], Any]]:
    rows = zip(network.ids, network.properties, network.geometry, strict=True)
    return {i: (dict(p), shape) for i, p, shape in rows if p["kind"] == "node"}


def test_nodes_take_the_names_of_areas() -> None:
    part = zones(flat())
    network, _ = named_network(part, flat())
    found = nodes(network)
    for name, (zone, shape) in by_name(part).items():
        node, at = found[name]
        assert node["name"] == name
        assert at.within(shape.buffer(0.3))
        if zone["kind"] != "door":
            assert node["area"] == name
    edges = [p for p in network.properties if p["kind"] == "edge"]
    assert {p["source"] for p in edges} | {p["target"] for p in edges} <= set(found)
    assert {(p["source"], p["target"]) for p in edges} == {(p["target"], p["source"]) for p in edges}
    plain, _ = named_network(features([], "local"), flat())
    assert len(found) <= len(nodes(plain)) + len(part)
    assert "area" not in next(iter(nodes(plain).values()))[0]


@pytest.mark.parametrize("name", ["Loading\nbay ", "\x07", "x" * 400, "x" * 600], ids=["lines", "bell", "400", "600"])
def test_any_name_of_an_area_gives_a_node(name: str) -> None:
    """An id has one line of at most 512 characters, also that of an edge between two such areas; a name is free."""
    part = zones(flat())
    names = [name + i for i in part.ids]
    renamed = [{**p, "name": new} for p, new in zip(part.properties, names, strict=True)]
    network, _ = named_network(replace(part, properties=tuple(renamed)), flat())
    titled = {p["name"]: i for i, (p, _) in nodes(network).items() if p["name"] in names}
    assert set(titled) == set(names)
    for title, i in titled.items():
        assert i.startswith(title.replace("\n", " ").replace("\x07", " ")[:400])


def test_aisle_has_nodes_at_both_ends() -> None:
    hedges = [(3.0, 3.0, 15.0, 3.2), (3.0, 5.5, 15.0, 5.7)]
    cells = draw(18.0, 9.0, hedges)
    drawn = features([("z", shapely.box(3.0, 3.2, 15.0, 5.5), {"kind": "aisle", "name": "strawberries"})], "local")
    found = nodes(named_network(drawn, cells)[0])
    entry, leave = found["strawberries/in"][1], found["strawberries/out"][1]
    assert entry.distance(shapely.Point(3.0, 4.35)) < 1.0
    assert leave.distance(shapely.Point(15.0, 4.35)) < 1.0
    assert found["strawberries"][1].distance(shapely.Point(9.0, 4.35)) < 1.0


def test_area_beyond_the_network_is_reported() -> None:
    far = features([("z", shapely.box(90, 90, 95, 95), {"kind": "room", "name": "elsewhere"})], "local")
    network, notes = named_network(far, flat())
    assert "elsewhere" not in network.ids
    assert [one.subject for one in notes.dropped] == ["names of areas"]


def test_zones_are_never_derived_for_a_map() -> None:
    assert derive.plan(frozenset({"occupancy"}), frozenset({"zones"})) is None


def test_drawn_outline_that_crosses_itself_is_compared() -> None:
    bow = shapely.Polygon([(0, 2), (5, 6.2), (5, 2), (0, 6.2)])
    stored = features([("drawn", bow, {"kind": "room", "name": "Lab"})], "local")
    assert {"room-1", "room-2"} & set(by_name(zones(flat(), stored)))
