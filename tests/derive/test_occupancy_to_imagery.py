"""Occupancy -> imagery: positions and colours on the plan, and its warnings."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pytest
import shapely

from app import derive
from app.convert.recipe import recipe
from app.convert.worker import from_layers
from app.derive import DerivationNotes
from app.derive import occupancy_to_imagery as plan
from app.errors import Ambiguous, CannotConvert, MissingLayer
from app.formats import get_format
from app.model.features import features
from app.model.frame import GROUND, Level
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.imagery import GeoImage, pixel_positions
from app.model.layers import Layer, Layers, PartKey
from app.store.values import PartEntry, Provenance, Version

GRID = PartKey("occupancy")
PLAN = PartKey("imagery", GROUND, "plan")


def room(width: int = 40, height: int = 20) -> Any:
    cells = np.full((height, width), FREE, np.uint8)
    cells[0], cells[-1], cells[:, 0], cells[:, -1] = (OCCUPIED,) * 4
    cells[1:4, 1:4] = UNKNOWN
    return cells


def drawn(layers: Layers, notes: DerivationNotes | None = None, **values: Any) -> GeoImage:
    derived_layers = plan.occupancy_to_imagery(layers, plan.Parameters(**values), notes or DerivationNotes())
    (picture,) = derived_layers.parts.values()
    assert isinstance(picture, GeoImage)
    return picture


@pytest.mark.parametrize("yaw", [0.0, 0.7])
def test_each_cell_becomes_a_pixel_at_its_position(yaw: float) -> None:
    cells = room()
    picture = drawn(Layers({GRID: OccupancyGrid(cells, 0.1, (3.0, -2.0, yaw))}))
    assert picture.pixels.shape == (20, 40, 4)
    assert (picture.pixels[::-1][cells == FREE] == (*plan.PAPER, 255)).all()
    assert (picture.pixels[::-1][cells == OCCUPIED] == (*plan.INK, 255)).all()
    assert (picture.pixels[::-1][cells == UNKNOWN][:, 3] == 0).all(), "unknown cells are transparent"
    # The middle of the cell in column 5, row 2 by the grid's own rule, and of its pixel by the picture's.
    u, v, c, s = 0.55, 0.25, math.cos(yaw), math.sin(yaw)
    (xy,) = pixel_positions(picture.transform, np.array([5.5]), np.array([20 - 2.5]))
    assert xy == pytest.approx([3.0 + c * u - s * v, -2.0 + s * u + c * v], abs=1e-9)


@pytest.mark.parametrize(
    ("pixel", "size"), [(0.3, None), (0.1, None), (0.001, 0.1), (0.12, 0.1), (0.27, 0.3), (None, None)]
)
def test_another_size_of_pixels_than_asked_for_is_reported(pixel: float | None, size: float | None) -> None:
    notes = DerivationNotes()
    picture = drawn(Layers({GRID: OccupancyGrid(room(), 0.1)}), notes, pixel=pixel)
    assert picture.transform[0] == pytest.approx(size or pixel or 0.1)
    assert [(t.subject, t.value, t.option) for t in notes.template] == (
        [] if size is None else [("pixel", pytest.approx(size), "pixel")]
    )


def test_costs_are_shades_between_paper_and_ink() -> None:
    cells = np.array([[0, 25, 50, 75, 100]], np.uint8)
    grey = drawn(Layers({GRID: OccupancyGrid(cells, 1.0)})).pixels[0, :, 0].astype(int)
    assert (np.diff(grey) < 0).all()
    assert grey[2] == round((plan.PAPER[0] + plan.INK[0]) / 2)


def test_pixel_of_many_cells_shows_occupied_first() -> None:
    cells = room()
    cells[10, 21] = OCCUPIED
    picture = drawn(Layers({GRID: OccupancyGrid(cells, 0.1)}), pixel=0.3)
    assert picture.pixels.shape == (7, 14, 4)
    up = picture.pixels[::-1]
    assert tuple(up[3, 7][:3]) == plan.INK
    assert tuple(up[3, 5][:3]) == plan.PAPER
    with pytest.raises(CannotConvert, match="more than 67108864 pixels"):
        plan._step(OccupancyGrid(np.broadcast_to(np.uint8(0), (100_000, 100_000)), 0.1), 0.1, "it")
    large = OccupancyGrid(np.broadcast_to(np.uint8(0), (20_000, 14_000)), 0.1)
    step = plan._step(large, None, "it")
    assert 20_000 * 14_000 / step**2 <= plan.MAX_PIXELS < 20_000 * 14_000 / (step - 1) ** 2


def test_objects_and_edges_are_drawn_over_the_cells() -> None:
    items = [
        ("house", shapely.box(1.0, 0.5, 2.0, 1.0), {"kind": "building"}),
        ("hedge", shapely.LineString([(2.5, 0.5), (2.5, 1.5)]), {"kind": "hedge", "width": 0.4}),
        ("bench", shapely.box(3.0, 0.5, 3.4, 1.0), {"kind": "poi"}),
    ]
    edge = shapely.LineString([(0.5, 1.25), (3.5, 1.25)])
    edges = [("e", edge, {"kind": "edge", "source": "a", "target": "b"})]
    layers = Layers(
        {
            GRID: OccupancyGrid(np.zeros((20, 40), np.uint8), 0.1),
            PartKey("objects", GROUND, "site"): features(items, "local"),
            PartKey("topology", GROUND, "network"): features(edges, "local"),
        }
    )
    up = drawn(layers, draw_network=True).pixels[::-1]
    house = (up[..., :3] == plan.COLOURS["building"]).all(axis=-1)
    assert np.argwhere(house).min(axis=0).tolist() == [5, 10]
    assert int(house.sum()) == 50
    hedge = (up[..., :3] == plan.COLOURS["hedge"]).all(axis=-1)
    assert hedge[7, 23:27].all()
    assert (up[12, 6:34, :3] == plan.EDGE).all(axis=-1).all()
    assert (up[7, 31, :3] == plan.PAPER).all(), "a point of interest is no thing to draw"
    plain = drawn(layers, draw_objects=False).pixels
    assert (plain[..., :3] == plan.PAPER).all()


def test_wgs84_objects_without_datum_are_dropped_with_warning() -> None:
    house = [("house", shapely.box(5.0, 52.0, 5.1, 52.1), {"kind": "building"})]
    notes = DerivationNotes()
    layers = Layers({GRID: OccupancyGrid(room(), 0.1), PartKey("objects"): features(house, "wgs84")})
    drawn(layers, notes)
    assert notes.dropped[0].count == 1
    assert notes.warnings[-1].problem == "the image is a plan drawn from the map, not a photograph"


def test_several_grids_raise_ambiguous() -> None:
    two = Layers({PartKey("occupancy", GROUND, n): OccupancyGrid(room(), 0.1) for n in ("a", "b")})
    with pytest.raises(Ambiguous, match="name one with grid="):
        drawn(two)
    assert drawn(two, grid="a").pixels.shape == (20, 40, 4)


def test_drawn_plan_is_no_source_of_other_layers() -> None:
    have: frozenset[Layer] = frozenset({"occupancy"})
    assert derive.plan(have, frozenset({"imagery"})) is not None
    derivation_plan = derive.plan(have, frozenset({"objects"}), without=frozenset({"occupancy_to_objects"}))
    assert derivation_plan is None or all(step.name != "occupancy_to_imagery" for step in derivation_plan.steps)


def test_stored_plan_is_no_source_of_other_layers() -> None:
    """Neither a plan drawn from a grid nor an empty grid is a source of other layers; an edited one is."""
    now = datetime.fromtimestamp(0, UTC)

    def version(information: Any, edited: bool = False) -> Version:
        steps = ({"step": "occupancy_to_imagery"},)
        source = Provenance(information, steps=steps, inputs=({},))
        source = source.with_edit_step() if edited else source
        part = PartEntry(PartKey("imagery", name="plan"), "00", 1, {}, source)
        return Version("e", 1, "", None, "", "", now, {}, (), (), None, (Level(),), (part,))

    for fmt in ("geojson", "tmap2", "octomap"):
        with pytest.raises(MissingLayer, match="supply"):
            recipe(version("derived"), fmt, {})
        assert recipe(version("derived", edited=True), fmt, {}).steps
        assert recipe(version("raw"), "satellite", {}).steps == ()
    assert recipe(version("derived"), "satellite", {}).steps == ()


def test_derivation_without_result_is_missing_with_advice() -> None:
    empty = OccupancyGrid(np.full((4, 4), 255, np.uint8), 0.5)
    layers = Layers({PartKey("occupancy"): empty})
    for fmt in ("octomap", "geojson", "tmap2"):
        with pytest.raises(CannotConvert, match="supply"):
            from_layers(get_format(fmt), layers, {}, derived=True)
