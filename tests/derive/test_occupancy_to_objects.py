"""Grids become objects: known discs, walls and boxes are found at their positions, and nothing else."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from lxml import etree
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from app import derive, formats, parameters, upload_reader
from app.convert import recipe
from app.derive import DerivationNotes
from app.derive import _figures as known_figures
from app.derive.objects_to_occupancy import Parameters as GridParameters
from app.derive.objects_to_occupancy import objects_to_occupancy
from app.derive.occupancy_to_objects import CONTEXTS, NAME, Parameters, occupancy_to_objects
from app.errors import Ambiguous, CannotConvert, Invalid, MissingLayer, NotFound
from app.limits import Limits
from app.model import solids
from app.model.features import Features
from app.model.frame import Level
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.layers import MAP, Layers, PartKey
from app.upload_reader import EnvironmentContext, UploadHints

CELL = 0.05
Array = NDArray[np.float64]


def grid(
    cells: Any, origin: tuple[float, float, float] = (0.0, 0.0, 0.0), resolution: float = CELL, **more: Any
) -> OccupancyGrid:
    return OccupancyGrid(np.array(cells, np.uint8), resolution, origin, **more)


def find_objects(g: OccupancyGrid, notes: DerivationNotes | None = None, **values: Any) -> Features:
    used_notes = notes if notes is not None else DerivationNotes()
    derived_layers = occupancy_to_objects(Layers({PartKey("occupancy"): g}), Parameters(**values), used_notes)
    assert set(derived_layers.parts) == {PartKey("objects", "ground", NAME)}
    part = derived_layers.parts[PartKey("objects", "ground", NAME)]
    assert isinstance(part, Features)
    assert part.local.all()
    return part


def kinds(f: Features) -> dict[str, int]:
    out: dict[str, int] = {}
    for p in f.properties:
        out[p["kind"]] = out.get(p["kind"], 0) + 1
    return out


def middles(rows: int, columns: int) -> tuple[Array, Array]:
    """x and y of all cells' middles in metres, without the origin."""
    y, x = np.mgrid[:rows, :columns]
    return (x + 0.5) * CELL, (y + 0.5) * CELL


def turned(x: Array, y: Array, at: tuple[float, float], yaw: float) -> tuple[Array, Array]:
    u, v = x - at[0], y - at[1]
    return u * math.cos(yaw) + v * math.sin(yaw), v * math.cos(yaw) - u * math.sin(yaw)


DISCS = [(1.0, 1.0, 0.2), (3.03, 1.48, 0.15), (5.5, 1.02, 0.4), (1.53, 4.0, 0.3)]
BOXES = [((3.5, 4.0), 1.2, 0.7, 0.0), ((6.4, 4.3), 1.5, 0.8, 0.5), ((2.0, 6.8), 2.0, 1.0, -0.9)]
WALLS = [((7.5, 7.225), 3.0, 0.15, 0.0), ((8.5, 2.5), 2.5, 0.2, math.pi / 2), ((5.0, 6.4), 1.5, 0.15, 0.6)]


def scene(*, hollow: bool = False) -> OccupancyGrid:
    """Discs, boxes and walls apart from each other in the open; hollow: only the rims, as a laser sees them."""
    x, y = middles(180, 200)
    cells = np.full(x.shape, FREE, np.uint8)
    for cx, cy, radius in DISCS:
        away = np.hypot(x - cx, y - cy)
        cells[away <= radius] = OCCUPIED
        if hollow:
            cells[away <= radius - 1.5 * CELL] = UNKNOWN
    for at, length, width, yaw in BOXES:
        u, v = turned(x, y, at, yaw)
        cells[(abs(u) <= length / 2) & (abs(v) <= width / 2)] = OCCUPIED
        if hollow:
            cells[(abs(u) <= length / 2 - 0.1) & (abs(v) <= width / 2 - 0.1)] = UNKNOWN
    for at, length, width, yaw in WALLS:
        u, v = turned(x, y, at, yaw)
        cells[(abs(u) <= length / 2) & (abs(v) <= width / 2)] = OCCUPIED
    return grid(cells)


def apart(a: float, b: float, period: float) -> float:
    return abs((a - b + period / 2) % period - period / 2)


@pytest.mark.parametrize("hollow", [False, True])
@pytest.mark.parametrize("context", CONTEXTS)
def test_shapes_are_found_at_their_positions(context: str, *, hollow: bool) -> None:
    f = find_objects(scene(hollow=hollow), context=context)
    setting = CONTEXTS[context]
    tables = [disc for disc in DISCS if 2 * disc[2] >= setting.round_furniture]
    assert len(tables) == (2 if context == "office" else 0)
    assert kinds(f) == {
        setting.post: len(DISCS) - len(tables),
        "wall": len(WALLS),
        setting.furniture: len(BOXES) + len(tables),
    }
    for item in f:
        p = item.properties
        assert p["height"] == setting.heights[p["kind"]]
        assert p["size"][2] == p["height"]
    posts = [p for p in f.properties if "radius" in p]
    for cx, cy, radius in DISCS:
        near = min(posts, key=lambda p: math.dist(p["pose"][:2], (cx, cy)))
        assert math.dist(near["pose"][:2], (cx, cy)) < CELL
        assert abs(near["radius"] - radius) < CELL
    for kind, shapes in ((setting.furniture, BOXES), ("wall", WALLS)):
        candidates = [p for p in f.properties if p["kind"] == kind and "radius" not in p]
        for at, length, width, yaw in shapes:
            near = min(candidates, key=lambda p: math.dist(p["pose"][:2], at))
            assert math.dist(near["pose"][:2], at) < CELL
            assert abs(near["size"][0] - length) < 2 * CELL
            assert abs(near["size"][1] - width) < 2 * CELL
            assert apart(near["pose"][5], yaw, math.pi) < 0.05


@pytest.mark.parametrize("origin", [(-6.0, 3.5, 0.0), (100.0, -20.0, 0.7), (0.05, 0.05, -2.5)])
def test_grid_origin_and_yaw_move_all_objects(origin: tuple[float, float, float]) -> None:
    plain, g = find_objects(scene()), scene()
    moved = find_objects(grid(g.cells, origin))
    assert plain.ids == moved.ids
    x, y, yaw = origin
    c, s = math.cos(yaw), math.sin(yaw)
    expected = shapely.transform(
        plain.geometry, lambda a: np.stack([x + c * a[:, 0] - s * a[:, 1], y + s * a[:, 0] + c * a[:, 1]], axis=1)
    )
    assert shapely.equals_exact(expected, moved.geometry, 1e-6).all()
    for a, b in zip(plain.properties, moved.properties, strict=True):
        assert apart(a["pose"][5] + yaw * (a.get("radius") is None), b["pose"][5], math.tau) < 1e-6
        assert a["size"] == b["size"]


def test_solids_match_outlines() -> None:
    """A cylinder or box at its pose covers the footprint, and has its height."""
    f = find_objects(scene(), height=2.0)
    reader = solids.Solids({})
    for item in f:
        corners = reader.triangles(item.properties).reshape(-1, 3)
        assert corners[:, 2].min() == pytest.approx(0.0)
        assert corners[:, 2].max() == pytest.approx(2.0)
        width = item.properties.get("width")
        body = item.geometry if width is None else shapely.buffer(item.geometry, width / 2, cap_style="square")
        solid = shapely.MultiPoint(corners[:, :2]).convex_hull
        assert shapely.area(shapely.symmetric_difference(body, solid)) < 0.03 * body.area


def room() -> NDArray[np.uint8]:
    """A room of 6 × 4 m with walls of 0.15 m and a wall across, and a thick block in a corner: all one piece."""
    cells = np.full((84, 124), FREE, np.uint8)
    cells[2:82, 2:122] = OCCUPIED
    cells[5:79, 5:119] = FREE
    cells[5:79, 60:63] = OCCUPIED
    return cells


def test_room_becomes_walls() -> None:
    f = find_objects(grid(room()))
    assert kinds(f) == {"wall": 5}
    walls = [((3.1, 0.175), 6.0), ((3.1, 4.025), 6.0), ((0.175, 2.1), 4.0), ((6.025, 2.1), 4.0), ((3.075, 2.1), 4.0)]
    for at, length in walls:
        near = min(f.properties, key=lambda p: math.dist(p["pose"][:2], at))
        assert math.dist(near["pose"][:2], at) < CELL
        assert abs(near["size"][0] - length) < 6 * CELL
        assert abs(near["width"] - 0.15) < CELL
        assert min(apart(near["pose"][5], k * math.pi / 2, math.tau) for k in range(4)) < 0.03


def test_thick_part_of_wall_is_no_wall() -> None:
    cells = room()
    cells[20:50, 5:30] = OCCUPIED  # 1.25 × 1.5 m at the wall on the left
    assert kinds(find_objects(grid(cells)))["furniture"] == 1
    cells[50:70, 5:12] = OCCUPIED  # and no rectangle any more
    f = find_objects(grid(cells))
    assert kinds(f)["obstacle"] == 1
    (area,) = f.select_kinds("obstacle").geometry
    assert area.area == pytest.approx(1.25 * 1.5 + 0.35 * 1.0 + 0.15 * 2.5, rel=0.15)
    assert f.select_kinds("obstacle").properties[0]["height"] == 2.5
    large = np.full((300, 300), OCCUPIED, np.uint8)
    large[100:200, 100:200] = FREE
    (around,) = find_objects(grid(large)).geometry
    assert around.area == pytest.approx(15.0**2 - 5.0**2, rel=0.01)
    assert len(around.interiors) == 1


def test_rim_around_free_cells_is_room() -> None:
    g = scene(hollow=True)
    cells = g.cells.copy()
    cells[cells == UNKNOWN] = FREE
    f = find_objects(grid(cells), wall_length=0.3)
    assert "furniture" not in kinds(f)
    sides = [side for _, length, width, _ in BOXES for side in (length, width)]
    assert kinds(f)["wall"] >= len(WALLS) + 2 * sum(side >= 0.7 for side in sides)


def test_specks_are_dropped_with_note() -> None:
    cells = scene().cells.copy()
    cells[100, 5], cells[120, 5], cells[140, 5] = OCCUPIED, OCCUPIED, OCCUPIED
    notes = DerivationNotes()
    f = find_objects(grid(cells), notes)
    assert f.ids == find_objects(scene()).ids
    assert [(d.subject, d.count) for d in notes.dropped] == [("specks", 3)]
    assert len(find_objects(grid(cells), minimum_size=0.0)) == len(f) + 3
    notes = DerivationNotes()
    few = find_objects(grid(cells), notes, minimum_size=1.0)
    # Of the discs none is a metre across, of the others all are.
    assert kinds(few) == {"furniture": len(BOXES), "wall": len(WALLS)}
    assert notes.dropped[0].count == 3 + len(DISCS)


def test_filled_in_heights_are_noted() -> None:
    notes = DerivationNotes()
    find_objects(scene(), notes, context="orchard")
    assert {(t.subject, t.value) for t in notes.template} == {
        ("height of tree", 3.0),
        ("height of crate", 1.0),
        ("height of wall", 2.0),
    }
    assert len(notes.warnings) == 1
    assert "orchard" in notes.warnings[0].problem
    notes = DerivationNotes()
    f = find_objects(scene(), notes, height=1.75)
    assert [(t.subject, t.value) for t in notes.template] == [("height", 1.75)]
    assert {p["height"] for p in f.properties} == {1.75}


def test_trunk_of_any_shape_is_tree_in_forest() -> None:
    cells = np.full((60, 60), FREE, np.uint8)
    cells[20:24, 20:32], cells[24:30, 20:24] = OCCUPIED, OCCUPIED  # an angle, half a metre long
    assert kinds(find_objects(grid(cells), context="forest")) == {"tree": 1}
    assert "post" not in kinds(find_objects(grid(cells)))


def test_tolerance_and_wall_width_are_applied() -> None:
    x, y = middles(120, 200)
    cells = np.full(x.shape, FREE, np.uint8)
    cells[abs(y - 3.0 - 0.6 * np.sin(x)) < 0.12] = OCCUPIED
    coarse, fine = find_objects(grid(cells), tolerance=0.4), find_objects(grid(cells), tolerance=0.05)
    assert 1 < kinds(coarse)["wall"] < kinds(fine)["wall"]
    middle = np.column_stack([np.linspace(0.5, 9.5, 50), 3.0 + 0.6 * np.sin(np.linspace(0.5, 9.5, 50))])
    lines = shapely.union_all(fine.geometry)
    assert max(lines.distance(shapely.Point(p)) for p in middle.tolist()) < 0.05 + 2 * CELL
    assert kinds(find_objects(grid(cells), wall_width=0.15)).get("obstacle") == 1


def test_thresholds_and_unknown_cells_are_respected() -> None:
    cells = scene().cells.copy()
    cells[cells == OCCUPIED] = 70
    assert find_objects(grid(cells)).ids == find_objects(scene()).ids
    with pytest.raises(CannotConvert, match="no occupied cell"):
        find_objects(grid(cells, occupied_thresh=0.8))
    cells[cells == FREE] = UNKNOWN
    assert find_objects(grid(cells)).ids == find_objects(scene()).ids


def bad(cells: Any, **values: Any) -> str:
    with pytest.raises(CannotConvert) as caught:
        find_objects(grid(cells), **values)
    return caught.value.detail


def test_grids_without_objects_raise_cannot_convert() -> None:
    assert "no occupied cell (3000 free)" in bad(np.full((50, 60), FREE))
    assert "no occupied cell (3000 unknown)" in bad(np.full((50, 60), UNKNOWN))
    assert "completely occupied" in bad(np.full((50, 60), OCCUPIED))
    assert "no occupied cell (1 free)" in bad([[FREE]])
    assert "no occupied cell (1 unknown)" in bad([[UNKNOWN]])
    assert "completely occupied" in bad([[OCCUPIED]])
    one = np.full((9, 9), FREE)
    one[4, 4] = OCCUPIED
    assert "1 specks less than 0.1 m" in bad(one)
    assert "minimum_size" in bad(one)
    assert "'map' of level 'ground'" in bad(one)
    assert kinds(find_objects(grid(one), minimum_size=0.05)) == {"post": 1}


def test_noise_raises_cannot_convert(monkeypatch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(0)
    cells = np.where(random.random((200, 200)) < 0.3, OCCUPIED, FREE)
    labels = find_objects(grid(cells), minimum_size=0.0)
    assert len(labels) > 100
    monkeypatch.setattr(known_figures, "MAX_PIECES", 100)
    assert "too noisy" in bad(cells)
    monkeypatch.undo()
    monkeypatch.setattr(known_figures, "MAX_FIGURES", 50)
    assert "more than 50 edges" in bad(cells)


def test_pieces_are_never_fewer_than_opencv_counts() -> None:
    import cv2

    random = np.random.default_rng(1)
    for rows, share in ((7, 0.5), (40, 0.2), (1030, 0.6), (2100, 0.05)):
        mask = (random.random((rows, 30)) < share).astype(np.uint8)
        contours, _ = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
        assert len(contours) <= known_figures.pieces(mask) <= 6 * len(contours)


def test_grid_is_selected_per_level() -> None:
    g = scene()
    parts = {PartKey("occupancy", "ground", n): g for n in ("keepout", MAP)}
    parts[PartKey("occupancy", "L2", "only")] = g
    layers = Layers(dict(parts), levels=(Level(), Level("L2", 4.0)))
    derived_parts = occupancy_to_objects(layers, Parameters(), DerivationNotes()).parts
    assert {k.level for k in derived_parts} == {"ground", "L2"}
    upper = derived_parts[PartKey("objects", "L2", NAME)]
    assert isinstance(upper, Features)
    assert {p["pose"][2] for p in upper.properties} == {4.0}
    assert {k.level for k in occupancy_to_objects(layers, Parameters(grid="only"), DerivationNotes()).parts} == {"L2"}
    with pytest.raises(NotFound, match="keepout, map, only"):
        occupancy_to_objects(layers, Parameters(grid="nogo"), DerivationNotes())
    parts[PartKey("occupancy", "L2", "second")] = g
    with pytest.raises(Ambiguous, match="only, second"):
        occupancy_to_objects(Layers(dict(parts), levels=layers.levels), Parameters(), DerivationNotes())
    with pytest.raises(MissingLayer, match="masks contain no obstacles"):
        occupancy_to_objects(Layers({PartKey("occupancy", "ground", "keepout"): g}), Parameters(), DerivationNotes())


def test_object_derivation_validates_parameters_and_is_planned_last() -> None:
    for wrong in ({"context": "moon"}, {"minimum_size": "-1"}, {"height": "0"}, {"wall_width": "x"}):
        with pytest.raises(Invalid):
            parameters.parse(Parameters, wrong)
    for stored, first in (
        ({"occupancy"}, "occupancy_to_objects"),
        ({"occupancy", "imagery"}, "imagery_to_objects"),
        ({"voxels", "imagery"}, "imagery_to_objects"),
    ):
        plan = derive.plan(frozenset(stored), frozenset({"objects"}))  # type: ignore[arg-type]
        assert plan is not None
        assert plan.steps[0].name == first
    plan = derive.plan(frozenset({"occupancy"}), frozenset({"topology"}))
    assert plan is not None
    assert [s.name for s in plan.steps] == ["occupancy_to_topology"]


def load(folder: Path) -> Layers:
    files = {p.name: p.read_bytes() for p in sorted(folder.iterdir()) if p.is_file()}
    upload_bundle = upload_reader.read(
        upload_reader.unpack(files, Limits()),
        UploadHints(),
        EnvironmentContext(None, None, None, True, False),
        Limits(),
    )
    return upload_bundle.layers(None)


def test_turtlebot3_world_gives_nine_pillars(shared: Path) -> None:
    """Map recorded by a robot: its round pieces are the world's cylinders, as in the model file."""
    root = shared / "data/gazebo_sdf/turtlebot3_world"
    model = etree.parse(str(root / "models/turtlebot3_world/model.sdf"))
    pillars = []
    for collision in model.iterfind(".//collision"):
        if collision.find(".//cylinder") is not None:
            pillars.append([float(v) for v in str(collision.findtext("pose")).split()[:2]])
    assert len(pillars) == 9
    f = find_objects(next(iter(load(root / "maps").grids().values())))
    posts = f.select_kinds("post")
    assert len(posts) == 9
    at = np.array([p["pose"][:2] for p in posts.properties])
    away, indices = cKDTree(at).query(pillars)
    assert away.max() < 0.1
    assert sorted(indices.tolist()) == list(range(9))
    assert all(abs(p["radius"] - 0.15) < 0.05 for p in posts.properties)


@pytest.mark.parametrize(
    "folder",
    [
        "gazebo_sdf/turtlebot3_world/maps",
        "occupancy_grid/turtlebot3_map_office_raw",
        "occupancy_grid/nav2_map_circular",
    ],
)
def test_objects_of_real_maps_cover_occupied_cells(shared: Path, folder: str) -> None:
    layers = load(shared / "data" / folder)
    (g,) = layers.grids().values()
    derived_layers = occupancy_to_objects(layers, Parameters(), DerivationNotes())
    back = objects_to_occupancy(derived_layers, GridParameters(resolution=g.resolution), DerivationNotes())
    (again,) = back.grids().values()

    def occupied(one: OccupancyGrid) -> Array:
        assert one.origin[2] == 0.0
        rows, columns = np.nonzero(one.cells == OCCUPIED)
        return np.asarray((np.column_stack([columns, rows]) + 0.5) * one.resolution + one.origin[:2])

    a, b = occupied(g), occupied(again)
    # only specks are not covered
    assert (cKDTree(b).query(a)[0] <= 1.5 * g.resolution).mean() > 0.95
    column, row = np.floor((b - np.array(g.origin[:2])) / g.resolution).astype(int).T
    is_free = g.cells[row.clip(0, g.height - 1), column.clip(0, g.width - 1)] == FREE
    # what is seen only from outside is solid inside
    assert ((cKDTree(a).query(b)[0] <= 1.5 * g.resolution) | ~is_free).mean() > 0.95


def test_object_derivation_is_repeatable(shared: Path) -> None:
    layers = load(shared / "data/occupancy_grid/turtlebot3_map_office_raw")
    a, b = (occupancy_to_objects(layers, Parameters(), DerivationNotes()).vector("objects") for _ in range(2))
    for one, other in zip(a.values(), b.values(), strict=True):
        assert one.ids == other.ids
        assert one.properties == other.properties
        assert shapely.to_wkb(one.geometry).tolist() == shapely.to_wkb(other.geometry).tolist()


def test_gazebo_world_of_objects_has_their_cylinders_and_boxes() -> None:
    derived_layers = occupancy_to_objects(Layers({PartKey("occupancy"): scene()}), Parameters(), DerivationNotes())
    gazebo = formats.get_format("gazebo")
    files = gazebo.write(derived_layers, formats.WriteContext(title="scene", options=gazebo.write_options()))
    world = etree.fromstring(files["world.sdf"])
    assert len(world.findall(".//collision/geometry/cylinder")) == len(DISCS)
    assert len(world.findall(".//collision/geometry/box")) == len(BOXES) + len(WALLS)


def test_grid_alone_gives_gazebo_world_of_its_cells() -> None:
    gazebo = formats.get_format("gazebo")
    key = PartKey("occupancy")
    chain = recipe.plan_chain(gazebo, recipe.AvailableLayers(frozenset({key}), datum=False), gazebo.write_options())
    assert chain == recipe.DerivationChain((), (key,))
    # objects derived from it replace it, unless it is named
    both = [PartKey("objects", "ground", NAME), key]
    assert gazebo.selection.choose(both, gazebo.write_options()) == both[:1]
    assert gazebo.selection.choose(both, gazebo.write_options(grid=MAP)) == both
