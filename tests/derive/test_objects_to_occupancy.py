"""Grids from objects: obstacles at a height, free ground, and errors if there is nothing."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from app import derive, parameters, upload_reader
from app.derive import DerivationNotes
from app.derive.location_to_occupancy import Parameters as BlankParameters
from app.derive.location_to_occupancy import location_to_occupancy
from app.derive.objects_to_occupancy import Parameters, objects_to_occupancy
from app.derive.objects_to_voxels import Parameters as VoxelParameters
from app.derive.objects_to_voxels import objects_to_voxels
from app.errors import CannotConvert, Invalid, MissingDatum, MissingLayer
from app.limits import Limits
from app.model import obstacles
from app.model.features import Features, features
from app.model.frame import Datum, Level
from app.model.geodesy import LocalFrame
from app.model.grid import OccupancyGrid
from app.model.layers import MAP, SITE, Layers, Part, PartKey, Resources
from app.model.obstacles import OF_OSM
from app.model.solids import TYPES
from app.upload_reader import EnvironmentContext, UploadHints
from tests.model.test_meshes import stl

BOX = {"type": "box", "size": [1, 2, 3], "pose": [0, 0, 1.5, 0, 0, 0]}
DATUM = Datum(52.0, 10.0)


def objects(*rows: tuple[Any, dict[str, Any]], anchor: Any = "local") -> Features:
    return features([(f"o{k}", geometry, properties) for k, (geometry, properties) in enumerate(rows)], anchor)


def layers(part: Features, *, level: str = "ground", **more: Any) -> Layers:
    parts: dict[PartKey, Part] = {PartKey("objects", level, "test"): part}
    if "fence" in more:
        fence = features([("fence", more.pop("fence"), {"kind": "fence"})], more.pop("anchor", "local"))
        parts[PartKey("location", "ground", SITE)] = fence
    if "files" in more:
        parts[PartKey("resources", "ground", "test")] = Resources(more.pop("files"))
    return Layers(parts, **more)


def grid(
    content: Layers,
    notes: DerivationNotes | None = None,
    level: str = "ground",
    *,
    outside_free: bool = True,
    **options: Any,
) -> OccupancyGrid:
    chosen = Parameters(outside_free=outside_free, **options)
    derived_layers = objects_to_occupancy(content, chosen, notes if notes is not None else DerivationNotes())
    part = derived_layers.parts[PartKey("occupancy", level, MAP)]
    assert isinstance(part, OccupancyGrid)
    assert part.origin[2] == 0
    for k in (0, 1):
        cell_count = part.origin[k] / part.resolution
        assert cell_count == pytest.approx(round(cell_count), abs=1e-6)
    return part


def at(g: OccupancyGrid, x: float, y: float) -> int:
    column, row = int((x - g.origin[0]) // g.resolution), int((y - g.origin[1]) // g.resolution)
    return int(g.cells[row, column]) if 0 <= row < g.height and 0 <= column < g.width else 255


def occupied(g: OccupancyGrid) -> float:
    """Square metres."""
    return float((g.cells == 100).sum() * g.resolution**2)


def test_solids_are_cut_at_the_laser_and_filled() -> None:
    turned = {"kind": "model", "shapes": [BOX], "pose": [5, 5, 0, 0, 0, math.pi / 2]}
    g = grid(layers(objects((shapely.Point(5, 5), turned))))
    assert occupied(g) == pytest.approx(2)
    assert (at(g, 5, 5), at(g, 5.9, 5.4), at(g, 5, 5.6), at(g, 3.2, 4)) == (100, 100, 0, 0)
    assert (g.width, g.height) == (80, 60), "a metre of padding around"
    assert set(np.unique(g.cells)) == {0, 100}


def test_height_and_band_select_obstacles() -> None:
    table = {
        "kind": "model",
        "shapes": [
            {"type": "box", "size": [2, 2, 0.1], "pose": [0, 0, 0.75, 0, 0, 0]},
            {"type": "cylinder", "radius": 0.1, "length": 0.7, "pose": [0, 0, 0.35, 0, 0, 0]},
        ],
    }
    content = layers(objects((shapely.Point(0, 0), table)))
    assert occupied(grid(content)) == pytest.approx(math.pi * 0.01, rel=0.7)
    assert occupied(grid(content, height=0.75)) == pytest.approx(4)
    assert occupied(grid(content, band=(0.1, 1.0))) == pytest.approx(4)
    assert occupied(grid(content, band=(0.1, 0.6))) == pytest.approx(math.pi * 0.01, rel=0.7)
    with pytest.raises(MissingLayer, match=r"at 2 m above the floor; the solids reach from 0 to 0\.8 m"):
        grid(content, height=2.0)
    with pytest.raises(MissingLayer, match="between 2 and 3 m"):
        grid(content, band=(2.0, 3.0))


def test_band_inside_solid_is_filled() -> None:
    g = grid(layers(objects((None, {"kind": "model", "shapes": [BOX]}))), band=(1.0, 1.1), padding=0.0)
    assert (g.cells == 100).all()
    assert occupied(g) == pytest.approx(2)


def test_hollow_wall_stays_hollow() -> None:
    """A ring-shaped room as one closed mesh: the room inside is free."""
    rings = [[[-3, -3], [3, -3], [3, 3], [-3, 3]], [[-2.5, -2.5], [2.5, -2.5], [2.5, 2.5], [-2.5, 2.5]]]
    g = grid(layers(objects((None, {"kind": "model", "shapes": [{"type": "polyline", "points": rings, "height": 2}]}))))
    assert occupied(g) == pytest.approx(36 - 25)
    assert at(g, 0, 0) == 0


def test_each_level_is_cut_above_its_own_floor() -> None:
    upstairs = {"kind": "model", "shapes": [BOX], "pose": [0, 0, 10, 0, 0, 0]}
    content = Layers(
        {
            PartKey("objects", "ground", "a"): objects((shapely.box(0, 0, 1, 1), {"kind": "building"})),
            PartKey("objects", "L2", "a"): objects((None, upstairs)),
        },
        levels=(Level(), Level("L2", 10.0)),
    )
    assert occupied(grid(content)) == pytest.approx(1)
    assert occupied(grid(content, level="L2")) == pytest.approx(2)


def test_building_walls_doors_floors_and_holes_are_drawn() -> None:
    floor = shapely.box(0, 0, 10, 6)
    rows: list[Any] = [
        (floor, {"kind": "floor"}),
        (shapely.LineString([(0, 0), (10, 0)]), {"kind": "wall"}),
        (shapely.LineString([(4, 0), (4, 6)]), {"kind": "wall", "width": 0.5}),
        (shapely.LineString([(0, 6), (3, 6)]), {"kind": "door", "name": "d"}),
        (shapely.box(8, 4, 9, 5), {"kind": "hole"}),
        (shapely.LineString([(5, 1), (5, 5)]), {"kind": "measurement"}),
        (shapely.Point(6, 3), {"kind": "fiducial"}),
    ]
    notes = DerivationNotes()
    g = grid(layers(objects(*rows)), notes)
    assert (at(g, 2, 3), at(g, 11 - 0.2, 3), at(g, -0.5, -0.5)) == (0, 255, 255)
    assert (at(g, 5, 0.02), at(g, 5, -0.02), at(g, 4.2, 3), at(g, 4.3, 3), at(g, 8.5, 4.5)) == (100, 100, 100, 0, 100)
    assert (at(g, 5, 3), at(g, 6, 3), at(g, 1.5, 5.98)) == (0, 0, 0)
    assert at(grid(layers(objects(*rows)), doors="closed"), 1.5, 5.98) == 100
    assert {d.subject: d.count for d in notes.dropped} == {
        "objects door": 1,
        "objects measurement": 1,
        "objects fiducial": 1,
    }


def test_fence_limits_the_grid() -> None:
    fence = shapely.Polygon([(0, 0), (10, 0), (0, 10)])
    rows = (shapely.box(1, 1, 2, 2), {"kind": "building"})
    g = grid(layers(objects(rows), fence=fence))
    assert list(g.origin) == [0, 0, 0]
    assert (g.width, g.height) == (200, 200)
    assert (at(g, 1.5, 1.5), at(g, 3, 3), at(g, 9, 9)) == (100, 0, 255)
    notes = DerivationNotes()
    grid(layers(objects((shapely.box(50, 50, 51, 51), {"kind": "building"})), fence=fence), notes)
    assert "outside the fence" in notes.warnings[0].problem
    floor = (shapely.box(0, 0, 3, 3), {"kind": "floor"})
    g = grid(layers(objects(rows, floor), fence=fence))
    assert (at(g, 2.5, 2.5), at(g, 4, 4)) == (0, 255), "within the fence only floors are free"


def test_wgs84_fence_without_datum_is_dropped_with_warning() -> None:
    notes = DerivationNotes()
    content = layers(
        objects((shapely.box(1, 1, 2, 2), {"kind": "wall"})), fence=shapely.box(9, 51, 10, 52), anchor="wgs84"
    )
    assert grid(content, notes).width == 60
    assert "the fence is ignored" in notes.warnings[0].problem


def test_wgs84_objects_without_datum_raise_missing_datum() -> None:
    house = shapely.box(10.001, 52.001, 10.0012, 52.0011)
    part = objects((house, {"kind": "building"}), anchor="wgs84")
    with pytest.raises(MissingDatum, match="no datum"):
        grid(layers(part))
    content = layers(part, datum=DATUM)
    g = grid(content)
    frame = content.frame
    assert frame is not None
    (local,) = frame.geometries_to_local(np.array([house], object))
    assert occupied(g) == pytest.approx(local.area, rel=0.05)
    assert at(g, local.centroid.x, local.centroid.y) == 100


@pytest.mark.parametrize(
    ("tags", "expected"),
    [
        ({"building": "yes"}, True),
        ({"building": "yes", "building:levels": "3"}, True),
        ({"building": "roof"}, False),
        ({"building": "yes", "min_height": "2.5 m", "height": "4"}, False),
        ({"building": "yes", "building:min_level": "1"}, False),
        ({"building": "yes", "height": "10 cm"}, False),
        ({"barrier": "fence"}, True),
        ({"barrier": "gate"}, False),
        ({"natural": "water"}, True),
        ({"natural": "wood"}, False),
        ({"waterway": "stream", "tunnel": "culvert"}, False),
        ({"waterway": "stream"}, True),
        ({"highway": "residential"}, False),
        ({"highway": "street_lamp"}, True),
        ({"power": "line"}, False),
        ({"power": "tower"}, True),
        ({"landuse": "forest"}, False),
        ({"amenity": "parking"}, False),
    ],
)
def test_openstreetmap_tags_decide_obstacles(tags: dict[str, str], expected: bool) -> None:
    properties = {"kind": next(iter(tags)), "osm": {"tags": tags}}
    content = layers(objects((shapely.box(0, 0, 2, 2), properties), (shapely.box(9, 9, 9.1, 9.1), {"kind": "post"})))
    assert (at(grid(content), 1, 1) == 100) is expected


def test_lines_and_points_are_drawn_with_width_and_radius() -> None:
    def square_metres(geometry: Any, **properties: Any) -> float:
        return occupied(grid(layers(objects((geometry, properties))), resolution=0.01))

    line = shapely.LineString([(0.003, 0.003), (10.003, 0.003)])
    assert square_metres(line, kind="barrier", osm={"tags": {"barrier": "hedge", "width": "2"}}) == pytest.approx(
        20, 0.02
    )
    assert square_metres(line, kind="waterway", osm={"tags": {"waterway": "river"}}) == pytest.approx(50, 0.02)
    assert square_metres(line, kind="fence") == pytest.approx(1, 0.15)
    tree = {"kind": "natural", "osm": {"tags": {"natural": "tree"}}}
    assert square_metres(shapely.Point(3, 3), **tree) == pytest.approx(math.pi * 0.04, 0.15)
    sized = square_metres(shapely.Point(3, 3), kind="crate", size=[1, 2, 1], pose=[3, 3, 0, 0, 0, 0.5])
    assert sized == pytest.approx(2, 0.05)
    assert square_metres(shapely.box(0, 0, 1, 1), kind="something", height=1.0) == pytest.approx(1, 0.05)


def test_multipolygons_are_assembled_from_their_ways() -> None:
    def way(i: int, *refs: tuple[float, float]) -> tuple[str, Any, dict[str, Any]]:
        return f"w{i}", shapely.LineString(refs), {"kind": "line", "osm": {"tags": {}}}

    tags = {"type": "multipolygon", "building": "yes"}
    members = [["way", 1, "outer"], ["way", 2, "outer"], ["way", 3, "inner"], ["way", 9, "outer"]]
    rows = [
        way(1, (0, 0), (4, 0), (4, 4)),
        way(2, (4, 4), (0, 4), (0, 0)),
        way(3, (1, 1), (3, 1), (3, 3), (1, 3), (1, 1)),
        ("r1", None, {"kind": "building", "osm": {"members": members, "tags": tags}}),
    ]
    content = Layers({PartKey("objects", "ground", "osm"): features(rows, "local")})
    notes = DerivationNotes()
    g = grid(content, notes)
    assert occupied(g) == pytest.approx(12)
    assert (at(g, 2, 2), at(g, 4.6, 2), at(g, 4.8, 2)) == (255, 255, 0), "the absent way may be anywhere near"
    assert "1 object has an unknown extent (r1): their ways or nodes are missing" in notes.warnings[0].problem


def test_ground_of_incomplete_area_is_unknown() -> None:
    """Half of a house of 8 × 6 m is there, and with it the disc that a corner of a right angle would lie on."""
    tags = {"type": "multipolygon", "building": "yes"}
    half = shapely.LineString([(0, 0), (8, 0), (8, 6)])
    member = [["way", 1, "outer"], ["way", 2, "outer"]]
    ring = {"refs": [1, 2, 3, 4, 1], "missing": [3], "tags": {"building": "yes"}}
    yard = {**ring, "tags": {"barrier": "fence"}}
    square = [(20, 0), (20, 8), (28, 8)]
    rows: list[Any] = [
        ("w1", half, {"kind": "line", "osm": {"refs": [1, 2, 3], "tags": {}}}),
        ("r1", None, {"kind": "building", "osm": {"members": member, "tags": tags}}),
        ("w3", shapely.LineString(square), {"kind": "building", "osm": ring}),
        ("w4", shapely.LineString([(x, y - 20) for x, y in square]), {"kind": "barrier", "osm": yard}),
        ("w5", shapely.box(-9, -9, -8, -8), {"kind": "building"}),
    ]
    content = Layers({PartKey("objects", "ground", "osm"): features(rows, "local")})
    notes = DerivationNotes()
    g = grid(content, notes, padding=10.0)
    assert (at(g, 6, 2), at(g, 0.2, 5.8), at(g, 8.4, 3)) == (255, 255, 255)
    assert (at(g, -1.5, 3), at(g, 10, 3), at(g, 4, -2.3)) == (0, 0, 0)
    assert (at(g, 24, 7), at(g, 27.8, 0.2), at(g, 24, -14)) == (255, 255, 0)
    assert "2 objects have an unknown extent (r1, w3)" in notes.warnings[0].problem


def test_resolution_inflation_and_padding_are_applied() -> None:
    content = layers(objects((shapely.box(0, 0, 1, 1), {"kind": "building"})))
    g = grid(content, resolution=0.25, padding=2.0)
    assert (g.resolution, g.width) == (0.25, 20)
    grown = grid(content, inflate=0.5, resolution=0.02)
    assert occupied(grown) == pytest.approx(1 + 4 * 0.5 + math.pi * 0.25, rel=0.02)


def test_town_gets_coarser_cells_up_to_a_limit() -> None:
    house = (shapely.box(0, 0, 10, 10), {"kind": "building"})
    town = layers(objects(house, (shapely.box(3000, 3000, 3010, 3010), {"kind": "wall"})))
    notes = DerivationNotes()
    g = grid(town, notes)
    assert g.resolution == 1.0
    assert notes.template[0].subject == "resolution"
    with pytest.raises(CannotConvert, match=r"the limit is 536870912 cells .* resolution of at least 0\.13"):
        grid(town, resolution=0.01)
    world = layers(objects(house, (shapely.box(9e6, 9e6, 9e6 + 1, 9e6 + 1), {"kind": "wall"})))
    with pytest.raises(CannotConvert, match="set a resolution"):
        grid(world)


@pytest.mark.parametrize(
    "rows",
    [
        [],
        [(shapely.box(0, 0, 5, 5), {"kind": "region"})],
        [(shapely.Point(0, 0), {"kind": "poi"}), (None, {})],
        [(shapely.LineString([(0, 0), (1, 1)]), {"kind": "path", "height": 3.0})],
        [(None, {"kind": "model", "shapes": [{"type": "plane", "size": [9, 9], "normal": [0, 0, 1]}]})],
        [(None, {"kind": "model", "shapes": [{**BOX, "visual": True}]})],
        [(None, {"kind": "light", "shapes": [BOX]})],
        [(None, {"kind": "building"})],
        [(None, {"kind": "model", "shapes": [{"type": "mesh", "file": "absent.dae"}]})],
        [(None, {"kind": "model", "shapes": "nonsense"})],
    ],
)
def test_site_without_obstacles_raises_missing_layer(rows: list[Any]) -> None:
    with pytest.raises(MissingLayer, match="object is an obstacle"):
        grid(layers(objects(*rows)))


def test_unenclosed_ground_is_unknown() -> None:
    """Without floor and fence only ground that walls separate from the border is free."""
    ring = [[[-3, -3], [3, -3], [3, 3], [-3, 3]], [[-2.5, -2.5], [2.5, -2.5], [2.5, 2.5], [-2.5, 2.5]]]
    room = (None, {"kind": "model", "shapes": [{"type": "polyline", "points": ring, "height": 2}]})
    notes = DerivationNotes()
    g = grid(layers(objects(room)), notes, outside_free=False)
    assert (at(g, 0, 0), at(g, -3.5, 0), at(g, 2.75, 0)) == (0, 255, 100)
    assert [(t.value, t.option) for t in notes.template] == [("unknown", "outside_free")]
    assert not notes.warnings
    alone = grid(layers(objects((None, {"kind": "model", "shapes": [BOX]}))), notes, outside_free=False)
    assert not alone.counts()["free"]
    assert "no cell of level ground is free: nothing encloses any ground; upload a fence" in notes.warnings[0].problem
    fenced = layers(objects((None, {"kind": "model", "shapes": [BOX]})), fence=shapely.box(-5, -5, 5, 5))
    assert at(grid(fenced, outside_free=False), 3, 3) == 0
    floor = (shapely.box(-5, -5, 5, 5), {"kind": "floor"})
    assert at(grid(layers(objects(floor, (None, {"kind": "model", "shapes": [BOX]}))), outside_free=False), 3, 3) == 0


@pytest.mark.parametrize(
    "lost",
    [
        {"type": "mesh", "file": "gone.dae"},
        {"type": "mesh", "file": "bad.stl"},
        {"type": "mesh", "uri": "package://gone.dae"},
        {"type": "model", "uri": "model://gone"},
        {"type": "mesh", "file": "cloud.xyz"},
    ],
    ids=lambda shape: str(shape.get("file") or shape.get("uri")),
)
def test_ground_around_unreadable_solid_is_unknown(lost: dict[str, Any]) -> None:
    """Never free, also within a fence; the object's other solids stay."""
    rows = [
        (
            None,
            {"kind": "model", "name": "shed", "shapes": [BOX, {**lost, "pose": [3, 0, 0, 0, 0, 0]}], "pose": [10, 0]},
        ),
        (None, {"kind": "model", "name": "barn", "shapes": [lost], "pose": [30, 0], "size": [16, 12, 3]}),
    ]
    fence = shapely.box(0, -20, 50, 20)
    files = {"bad.stl": b"", "cloud.xyz": b"0 0 0"}
    notes = DerivationNotes()
    g = grid(layers(objects(*rows), fence=fence, files=files), notes)
    assert (at(g, 10, 0), at(g, 13, 0), at(g, 13, 4.9), at(g, 13, 5.2)) == (100, 255, 255, 0)
    assert (at(g, 30, 9.8), at(g, 30, 10.2)) == (255, 0), "an object's own size counts"
    (warning,) = notes.warnings
    assert "2 objects have a solid that cannot be read (shed, barn): " in warning.problem
    assert str(lost.get("file") or lost.get("uri")) in warning.problem
    assert ("surroundings", 5.0) in [(t.subject, t.value) for t in notes.template]
    assert at(grid(layers(objects(*rows), fence=fence, files=files), surroundings=1.0), 13, 2) == 0


def test_unreadable_solids_without_known_ground_raise_missing_layer() -> None:
    lost = {"kind": "model", "shapes": [{"type": "mesh", "uri": "model://house/walls.dae"}]}
    floor = (shapely.box(-9, -9, 9, 9), {"kind": "floor"})
    for rows, more in (
        ([(None, lost)], {}),
        ([(None, lost), floor], {}),
        ([(None, lost)], {"fence": shapely.box(-9, -9, 9, 9)}),
        ([(None, lost), (None, {"kind": "model", "shapes": [BOX]})], {}),
    ):
        with pytest.raises(MissingLayer, match=r"model://house/walls\.dae is missing: upload it") as caught:
            grid(layers(objects(*rows), **dict(more)), outside_free=False)
        assert "model://house/walls.dae" in caught.value.problems[0].problem
    with pytest.raises(MissingLayer, match=r"known to have a body.*walls\.dae"):
        objects_to_voxels(layers(objects((None, lost))), VoxelParameters(), DerivationNotes())
    content = layers(objects((None, lost)), fence=shapely.box(-9, -9, 9, 9))
    with pytest.raises(MissingLayer, match=r"an empty grid.*walls\.dae"):
        location_to_occupancy(content, BlankParameters(), DerivationNotes())


def test_voxels_of_objects_give_no_grid() -> None:
    """A chain through voxels must not give what the slice refuses: only obstacles."""
    plan = derive.plan(frozenset({"objects"}), frozenset({"occupancy"}), frozenset({"objects_to_occupancy"}))
    assert plan is None or "objects_to_voxels" not in [step.name for step in plan.steps]


def test_unreadable_objects_are_dropped_with_reason() -> None:
    mesh = {"type": "mesh", "file": "bad.stl"}
    rows: list[Any] = [
        (None, {"kind": "model", "shapes": [BOX]}),
        (None, {"kind": "model", "shapes": [BOX, mesh]}),
        (None, {"kind": "model", "shapes": [{"type": "mesh", "file": "flat.stl"}]}),
    ]
    notes = DerivationNotes()
    flat = stl(((5, 5, 0), (5, 5, 0), (5, 5, 0)), ((6, 6, 0), (6, 6, 1), (7, 6, 0)))
    g = grid(layers(objects(*rows), files={"bad.stl": b"", "flat.stl": flat}), notes, surroundings=0.5)
    assert at(g, 0, 0) == 100
    assert 100 in (at(g, 6.5, 6.02), at(g, 6.5, 5.98)), "an open triangle is still a surface"
    assert [(w.where, "bad.stl" in w.problem) for w in notes.warnings] == [("o1", True)]
    assert notes.dropped == []


def test_bodies_without_files_are_distinguished_from_marks() -> None:
    rows: list[Any] = [
        (None, {"kind": "model", "shapes": [BOX]}),
        (shapely.Point(0, 0), {"kind": "include", "name": "table"}),
        (shapely.Point(0, 0), {"kind": "model", "name": "Sun", "gazebo": {"sdf": "<include/>"}}),
        (shapely.Point(0, 0), {"kind": "light"}),
    ]
    notes = DerivationNotes()
    grid(layers(objects(*rows)), notes)
    assert {d.subject: d.why for d in notes.dropped} == {
        "objects light": "not an obstacle for robots",
        "objects model": "not an obstacle for robots",
        "objects include": "they have neither shapes nor a size: upload the files of their models too",
    }


FENCE = shapely.box(-20, -20, 20, 20)
WALL = (shapely.LineString([(-10, 10), (10, 10)]), {"kind": "wall"})


@pytest.mark.parametrize("anchor", ["local", "wgs84"])
def test_object_of_unknown_extent_leaves_its_ground_unknown(anchor: Any) -> None:
    """Each with free ground beyond its radius, never within."""
    ground: list[Any] = [
        (shapely.Point(0, 0), {"kind": "model", "name": "chair"}),
        (shapely.Point(5, 0), {"kind": "include", "name": "table"}),
        (shapely.Point(-5, 0), {"kind": "crate", "size": [1, 1], "pose": ["x", 0]}),
        (shapely.Point(0, -5), {"kind": "crate", "size": [6, 4], "pose": ["x", 0]}),
        (shapely.Point(10, -5), {"kind": "model", "shapes": [BOX], "pose": ["x", 0]}),
        (shapely.Point(-5, -5), {"kind": "lift", "size": [1, 1], "pose": ["x", 0]}),
        (shapely.Point(-10, -5), {"kind": "table"}),
        (shapely.Point(-10, 0), {"kind": "table", "width": 0.2}),
    ]
    geometries = np.array([g for g, _ in (*ground, WALL)], object)
    frame = LocalFrame(DATUM)
    part = objects(
        *zip(
            geometries if anchor == "local" else frame.geometries_to_wgs84(geometries),
            [p for _, p in (*ground, WALL)],
            strict=True,
        ),
        anchor=anchor,
    )
    notes = DerivationNotes()
    content = layers(part, fence=FENCE, datum=DATUM)
    g = grid(content, notes, surroundings=2.0)
    for x in (0, 5, -5):
        assert (at(g, x, 0), at(g, x + 0.65, 0), at(g, x + 0.8, 0)) == (255, 255, 0)
    assert (at(g, 3.5, -5), at(g, 3.7, -5)) == (255, 0), "half the diagonal of its stated size"
    assert (at(g, 11.9, -5), at(g, 12.1, -5), at(g, -5, -5), at(g, -5, -5.8)) == (255, 0, 255, 0)
    assert (at(g, -10, -5), at(g, -9.4, -5), at(g, -9.4, 0)) == (100, 255, 0), "only the centre of a point is known"
    assert at(grid(content, unknown_radius=2.0), 1.9, 0) == 255
    assert at(grid(content, inflate=0.2), 0, 0) == 255
    (files, poses, points) = [w for w in notes.warnings if "an unknown extent" in w.problem]
    assert files.problem.startswith("2 objects have an unknown extent (chair, table): they have neither shapes nor")
    assert poses.problem.startswith("3 objects have an unknown extent (o2, o3, o5): pose")
    assert points.problem.startswith("1 object has an unknown extent (o6): they are points")
    assert ("unknown_radius", 0.7) in [(t.subject, t.value) for t in notes.template]


def test_objects_of_unknown_extent_leave_the_other_ground_free() -> None:
    """Even if they are the only objects, on a floor and on the empty grid of a fence."""
    chair = (shapely.Point(0, 0), {"kind": "model"})
    notes = DerivationNotes()
    g = grid(layers(objects((FENCE, {"kind": "floor"}), chair)), notes)
    assert (at(g, 0.6, 0), at(g, 0.8, 0)) == (255, 0)
    assert any("is free except the ground around objects of unknown extent" in w.problem for w in notes.warnings)
    content = layers(objects(chair), fence=FENCE)
    with pytest.raises(MissingLayer, match="upload the files of their models"):
        grid(content)
    notes = DerivationNotes()
    blank = location_to_occupancy(content, BlankParameters(), notes).grids()[PartKey("occupancy", "ground", MAP)]
    assert (at(blank, 0.6, 0), at(blank, 0.8, 0)) == (255, 0)
    assert "1 object has an unknown extent" in notes.warnings[0].problem
    notes = DerivationNotes()
    assert not grid(layers(objects((FENCE, {"kind": "floor"}), chair)), notes, unknown_radius=100.0).counts()["free"]
    assert "or set a smaller unknown_radius" in notes.warnings[-1].problem


def test_object_without_position_is_warned_of() -> None:
    notes = DerivationNotes()
    rows: list[Any] = [WALL, (None, {"kind": "building", "name": "barn"}), (None, {"kind": "model"})]
    grid(layers(objects(*rows)), notes)
    (warning,) = notes.warnings
    assert "2 objects have no known position (barn, o2)" in warning.problem


def test_box_without_geometry_is_drawn_at_its_pose() -> None:
    g = grid(layers(objects((None, {"kind": "crate", "size": [2, 1], "pose": [3, 4]}))))
    assert occupied(g) == pytest.approx(2)
    assert at(g, 3.9, 4.4) == 100


def test_broken_object_is_reported_and_others_are_drawn() -> None:
    rows: list[Any] = [
        (shapely.Point(0, 0), {"kind": "include"}),
        (None, {"kind": "model", "shapes": [{"type": "mesh", "file": "a.dae"}]}),
    ]
    with pytest.raises(MissingLayer, match=r"cannot be read: the file a\.dae is missing: upload it"):
        grid(layers(objects(*rows)))


def test_mesh_placed_many_times_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    from app.derive import _obstacles
    from app.model import solids

    monkeypatch.setattr(_obstacles, "MAX_TRIANGLES", 100)
    with pytest.raises(CannotConvert, match="more than 100 triangles"):
        grid(layers(objects(*[(None, {"kind": "model", "shapes": [BOX]})] * 9)))
    monkeypatch.setattr(solids, "MAX_TRIANGLES", 20)
    notes = DerivationNotes()
    one = (None, {"kind": "model", "shapes": [BOX]})
    grid(layers(objects(one, (None, {"kind": "model", "shapes": [BOX, BOX]}))), notes, surroundings=1.0)
    assert "more than 20 triangles" in notes.warnings[0].problem


def test_objects_beyond_local_frame_raise_cannot_convert() -> None:
    far = objects((shapely.box(100, -50, 100.1, -49.9), {"kind": "building"}), anchor="wgs84")
    with pytest.raises(CannotConvert, match="too far from the datum"):
        grid(layers(far, datum=DATUM))


def test_visuals_count_only_when_requested() -> None:
    content = layers(objects((None, {"kind": "model", "shapes": [{**BOX, "visual": True}]})))
    assert occupied(grid(content, visuals=True)) == pytest.approx(2)


NUMBERS = st.one_of(
    st.floats(-1e12, 1e12), st.integers(-(10**30), 10**30), st.booleans(), st.text(max_size=3), st.none()
)
LISTS = st.one_of(NUMBERS, st.lists(NUMBERS, max_size=7), st.lists(st.lists(NUMBERS, max_size=3), max_size=3))
SHAPE = st.fixed_dictionaries(
    {"type": st.sampled_from([*sorted(TYPES), "cone"])},
    optional=dict.fromkeys(("size", "radius", "radii", "length", "pose", "normal", "points", "height", "scale"), LISTS)
    | {"file": st.sampled_from(["a.stl", "", None]), "submesh": NUMBERS, "visual": NUMBERS},
)
TAGS = st.dictionaries(
    st.sampled_from([*OF_OSM, "height", "width", "min_height", "building:levels", "tunnel", "layer"]),
    st.one_of(
        st.text(max_size=4), st.sampled_from(["yes", "tree", "1e400", "9" * 39, "5 m", "fence", "water"]), NUMBERS
    ),
    max_size=4,
)
OWN = st.fixed_dictionaries({}, optional={"tags": st.one_of(TAGS, NUMBERS), "members": LISTS})
SAID = st.fixed_dictionaries(
    {
        "kind": st.sampled_from(
            ["model", "wall", "building", "natural", "floor", "lift", "hole", "door", "crate", 7, None]
        )
    },
    optional={
        **dict.fromkeys(("size", "pose", "height", "base", "width"), LISTS),
        "shapes": st.one_of(st.lists(SHAPE, max_size=2), NUMBERS),
        "osm": st.one_of(OWN, NUMBERS),
    },
)
PLACES = st.sampled_from(
    [
        None,
        shapely.Point(1, 2),
        shapely.Point(1, 2, 3),
        shapely.LineString([(0, 0), (0, 0)]),
        shapely.LineString([(0, 0, 1), (5, 5, 1)]),
        shapely.Polygon([(0, 0), (2, 2), (2, 0), (0, 2)]),
        shapely.MultiPoint([(0, 0), (9, 9)]),
        shapely.GeometryCollection([shapely.Point(0, 0), shapely.box(1, 1, 2, 2)]),
    ]
)


@given(st.lists(st.tuples(PLACES, SAID), min_size=1, max_size=3))
def test_random_objects_give_grid_or_error(rows: list[Any]) -> None:
    """Problems of one object are reported, and the others are drawn."""
    content = layers(objects(*rows, (shapely.box(0, 0, 1, 1), {"kind": "building"})), files={"a.stl": stl()})
    try:
        derived_grid = grid(content, resolution=0.5, doors="closed")
    except CannotConvert as error:
        expected = ("resolution of at least", "no free ground of level ground is known, because solids")
        assert any(text in error.detail for text in expected), "distant objects make it large"
    else:
        assert at(derived_grid, 0.5, 0.5) == 100
    try:
        objects_to_voxels(content, VoxelParameters(resolution=0.5), DerivationNotes())
    except CannotConvert as error:
        assert "coarser resolution" in error.detail or "resolution of at least" in error.detail


def test_grid_parameters_are_validated() -> None:
    chosen = parameters.parse(Parameters, {"band": "0.1,1.5", "doors": "closed"})
    assert chosen.band == (0.1, 1.5)
    for wrong in ({"height": "a"}, {"band": "1"}, {"resolution": "0"}, {"doors": "ajar"}, {"inflate": "-1"}):
        with pytest.raises(Invalid):
            parameters.parse(Parameters, wrong)
    content = layers(objects((None, {"kind": "model", "shapes": [BOX]})))
    with pytest.raises(Invalid, match="exclude each other"):
        grid(content, height=1.0, band=(0.0, 1.0))
    with pytest.raises(Invalid, match="band must be low,high with low <= high"):
        grid(content, band=(1.0, 0.0))


def test_plan_includes_optional_layers() -> None:
    plan = derive.plan(frozenset({"objects"}), frozenset({"occupancy"}))
    assert plan is not None
    assert [s.name for s in plan.steps] == ["objects_to_occupancy"]
    assert plan.steps[0].reads == {"objects", "resources", "location"}


# --- real maps -------------------------------------------------------------------------------------------------------


def read(*paths: Path) -> Layers:
    files = {p.name: p.read_bytes() for p in paths}
    upload_bundle = upload_reader.read(
        upload_reader.unpack(files, Limits()),
        UploadHints(),
        EnvironmentContext(None, None, None, True, False),
        Limits(),
    )
    return upload_bundle.layers(None)


def xy_of(listed: list[dict[str, Any]], scale: float) -> Any:
    return [(one["x"] * scale, -one["y"] * scale) for one in listed]


@pytest.mark.parametrize(
    ("name", "level", "walls", "floor"),
    [
        # metres of walls, square metres of floors: by hand from the file's pixels and its measurements
        ("office/office.building.yaml", "L1", 33, 4),
        ("hotel/hotel.building.yaml", "L1", 56, 3),
        ("hotel/hotel.building.yaml", "L3", None, None),
        ("robast_sim/tiplu.building.yaml", "Tiplu", 21, 1),
    ],
)
def test_real_building_gives_walls_and_floors(
    shared: Path, name: str, level: str, walls: int | None, floor: int | None
) -> None:
    """Against shapely on the file's own numbers, read with a plain YAML loader."""
    import yaml

    path = shared / "data/openrmf_building" / name
    levels = yaml.safe_load(path.read_text())["levels"]
    content = read(path)
    g = grid(content, level=level)
    if walls is None:
        assert g.counts()["free"] > 100_000
        return
    one = levels[level]
    assert (len(one["walls"]), len(one["floors"])) == (walls, floor)
    xy = np.array([[v[0], -v[1]] for v in one["vertices"]])
    scale = np.mean([m[2]["distance"][1] / np.hypot(*(xy[m[0]] - xy[m[1]])) for m in one["measurements"]])
    xy *= scale
    lines = shapely.union_all([shapely.LineString(xy[w[:2]]) for w in one["walls"]])
    floors = shapely.union_all([shapely.Polygon(xy[f["vertices"]]) for f in one["floors"]])
    x, y = np.meshgrid(
        g.origin[0] + (np.arange(g.width) + 0.5) * g.resolution,
        g.origin[1] + (np.arange(g.height) + 0.5) * g.resolution,
    )
    middles = shapely.points(x, y)
    away = shapely.distance(middles, lines)
    assert (g.cells[away < 0.049] == 100).all()
    lifts = [q for part in content.vector("objects").values() for q in part.properties if q.get("kind") == "lift"]
    cabins = shapely.union_all([shapely.Point(q["pose"][:2]).buffer(2.2) for q in lifts])
    apart = ~shapely.contains(cabins, middles)
    assert (g.cells[apart & (away > 0.05 * math.sqrt(2) + 0.036 + 0.001)] != 100).all()
    inside = shapely.contains(floors, middles)
    models = shapely.MultiPoint(xy_of(one.get("models", []), scale))
    near = np.zeros(inside.shape) + np.inf if models.is_empty else shapely.distance(middles, models)
    assert (g.cells[inside & (g.cells != 100) & (near > 0.74)] == 0).all()
    assert (g.cells[(near < 0.69) & (g.cells != 100)] == 255).all()
    assert (g.cells[~inside & (g.cells != 100)] == 255).all()
    assert g.counts()["free"] > 0.5 * (inside & (g.cells != 100)).sum(), "rooms stay mostly free"


def test_robast_sim_walls_match_its_ros_map(shared: Path) -> None:
    """The building was drawn by hand over the picture of the ROS map, so pixels are cells."""
    import yaml
    from scipy import ndimage

    folder = shared / "data/openrmf_building/robast_sim"
    derived = grid(read(folder / "tiplu.building.yaml"), level="Tiplu")
    real = read(*(p for p in (folder / "ros_map").iterdir() if p.suffix in (".yaml", ".pgm")))
    (measured,) = real.grids().values()
    level = yaml.safe_load((folder / "tiplu.building.yaml").read_text())["levels"]["Tiplu"]
    (a, b, more) = level["measurements"][0][:3]
    ends = np.array([level["vertices"][k][:2] for k in (a, b)])
    scale = more["distance"][1] / np.hypot(*(ends[0] - ends[1]))
    assert scale == pytest.approx(measured.resolution, rel=0.03)
    rows, columns = np.nonzero(derived.cells == 100)
    x = (derived.origin[0] + (columns + 0.5) * derived.resolution) / scale
    y = measured.height + (derived.origin[1] + (rows + 0.5) * derived.resolution) / scale
    away = ndimage.distance_transform_edt(measured.cells != 100) * measured.resolution
    distances = away[np.clip(y.astype(int), 0, measured.height - 1), np.clip(x.astype(int), 0, measured.width - 1)]
    assert (distances <= 0.2).mean() > 0.8
    assert (distances <= 0.5).mean() > 0.95


@pytest.mark.parametrize("door", ["left", ["x", "y"], 7, None])
def test_lifts_without_door_positions_have_no_walls(door: Any) -> None:
    lift = {"kind": "lift", "size": [2.0, 2.0], "openrmf": {"says": {"doors": {"d": door}}}}
    assert obstacles.object_body(lift, shapely.Point(4, 4)) is None
    good = {"x": 1.0, "y": 0.0, "motion_axis_orientation": 1.57, "width": 1.0}
    lift["openrmf"] = {"says": {"doors": {"d": good}}}
    assert obstacles.object_body(lift, shapely.Point(4, 4)) is not None
    assert obstacles.object_body(lift, shapely.Point()) is None, "it has no position"
