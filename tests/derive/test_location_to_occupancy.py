"""Empty grid of a fence."""

from __future__ import annotations

from typing import Any

import pytest
import shapely

from app import derive
from app.derive import DerivationNotes
from app.derive.location_to_occupancy import Parameters, location_to_occupancy
from app.errors import CannotConvert, MissingLayer
from app.model.features import features
from app.model.frame import Datum
from app.model.grid import OccupancyGrid
from app.model.layers import MAP, SITE, Layers, PartKey

DATUM = Datum(52.0, 10.0)


def blank(fence: Any, anchor: Any = "local", notes: DerivationNotes | None = None, **options: Any) -> OccupancyGrid:
    part = features([("fence", fence, {"kind": "fence"})], anchor)
    derived_layers = location_to_occupancy(
        Layers({PartKey("location", "ground", SITE): part}, DATUM), Parameters(**options), notes or DerivationNotes()
    )
    grid = derived_layers.parts[PartKey("occupancy", "ground", MAP)]
    assert isinstance(grid, OccupancyGrid)
    return grid


def test_fence_grid_is_free_inside_and_unknown_outside() -> None:
    notes = DerivationNotes()
    g = blank(shapely.Polygon([(-1, -1), (3, -1), (-1, 3)]), notes=notes, resolution=0.1)
    assert (g.origin, g.width, g.height, g.resolution) == ((-1, -1, 0), 40, 40, 0.1)
    assert g.counts() == {"occupied": 0, "free": 780, "unknown": 820, "other": 0}
    assert "empty" in notes.warnings[0].problem


def test_wgs84_fence_gives_grid() -> None:
    g = blank(shapely.box(10.0, 52.0, 10.001, 52.001), "wgs84")
    assert g.resolution == 0.05
    assert g.width * 0.05 == pytest.approx(68.7, abs=0.3)
    assert g.height * 0.05 == pytest.approx(111.3, abs=0.3)
    assert g.counts()["unknown"] < 0.01 * g.cells.size


def test_large_fence_gets_coarser_cells_up_to_a_limit() -> None:
    notes = DerivationNotes()
    assert blank(shapely.box(0, 0, 2000, 2000), notes=notes).resolution == 0.5
    assert notes.template[0].value == 0.5
    with pytest.raises(CannotConvert, match="resolution of at least"):
        blank(shapely.box(0, 0, 2000, 2000), resolution=0.01)
    with pytest.raises(CannotConvert, match="smaller fence"):
        blank(shapely.box(-9e6, -9e6, 9e6, 9e6))


def test_grid_without_fence_raises_missing_layer() -> None:
    for layers in (Layers({}, DATUM), Layers({PartKey("location", "ground", SITE): features([], "local")}, DATUM)):
        with pytest.raises(MissingLayer, match="needs a fence"):
            location_to_occupancy(layers, Parameters(), DerivationNotes())
    with pytest.raises(MissingLayer, match="needs a fence"):
        blank(shapely.Point(0, 0))


def test_planner_uses_fence_grid_last() -> None:
    both: frozenset[Any] = frozenset({"location", "objects"})
    plan = derive.plan(both, frozenset({"occupancy"}))
    assert plan is not None
    assert [s.name for s in plan.steps] == ["objects_to_occupancy"]
    others = {n for n, d in derive.all_derivations().items() if d.gives == "occupancy"} - {"location_to_occupancy"}
    cheapest = {d.cost for n, d in derive.all_derivations().items() if n in others and not d.part_names}
    assert max(cheapest) < derive.all_derivations()["location_to_occupancy"].cost
    plan = derive.plan(both, frozenset({"occupancy"}), frozenset(others))
    assert plan is not None
    assert plan.steps[-1].name == "location_to_occupancy"
