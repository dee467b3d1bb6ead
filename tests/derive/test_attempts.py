"""A derivation's trial fails exactly when the derivation fails."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from app import derive
from app.derive import occupancy_to_imagery, occupancy_to_voxels
from app.errors import CannotDerive
from app.model import masks
from app.model.frame import Level
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.layers import Layers, PartKey

Grids = Mapping[tuple[str, str], OccupancyGrid]


def grid(value: int, size: int = 8, **more: Any) -> OccupancyGrid:
    return OccupancyGrid(np.full((size, size), value, np.uint8), **{"resolution": 0.05, **more})


MAP = ("ground", "map")
STOCKS: dict[str, tuple[Grids, float]] = {
    "free": ({MAP: grid(FREE)}, 0.0),
    "occupied": ({MAP: grid(OCCUPIED)}, 0.0),
    "all unknown": ({MAP: grid(UNKNOWN)}, 0.0),
    "one of two unknown": ({MAP: grid(UNKNOWN), ("upper", "map"): grid(FREE)}, 0.0),
    "masks alone": ({("ground", next(iter(masks.MASKS))): grid(OCCUPIED)}, 0.0),
    "which one": ({("ground", "a"): grid(FREE), ("ground", "b"): grid(FREE)}, 0.0),
    "far away": ({MAP: grid(OCCUPIED, origin=(9e5, 0.0, 0.0))}, 0.0),
    "high up": ({MAP: grid(OCCUPIED)}, 9e5),
    "large": ({MAP: grid(OCCUPIED, 64)}, 0.0),
    "chequered": ({MAP: OccupancyGrid(np.indices((64, 64)).sum(axis=0).astype(np.uint8) % 2 * OCCUPIED, 0.05)}, 0.0),
}


def outcome(how: Any, steps: tuple[derive.Step, ...], layers: Layers) -> Any:
    try:
        how(steps, layers)
    except CannotDerive as error:
        return error.step, error.detail, error.choose
    return None


@pytest.mark.parametrize("stock", STOCKS)
@pytest.mark.parametrize("name", [d.name for d in derive.all_derivations().values() if d.trial is not None])
def test_trial_fails_as_the_derivation_does(name: str, stock: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(occupancy_to_voxels, "MAX_LEAVES", 10_000)
    monkeypatch.setattr(occupancy_to_imagery, "MAX_PIXELS", 1000)
    grids, height = STOCKS[stock]
    layers = Layers({PartKey("occupancy", *k): g for k, g in grids.items()}, levels=(Level("ground", height),))
    for values in ({}, {"resolution": "0.02", "pixel": "0.05"}):
        steps = derive.with_parameters([derive.all_derivations()[name].step()], values)
        assert outcome(derive.try_steps, steps, layers) == outcome(derive.run, steps, layers)


def test_samples_have_both_outcomes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(occupancy_to_voxels, "MAX_LEAVES", 10_000)
    steps = (derive.all_derivations()["occupancy_to_voxels"].step(),)
    outcomes = {
        name: outcome(derive.try_steps, steps, Layers({PartKey("occupancy", *k): g for k, g in grids.items()}))
        for name, (grids, _) in STOCKS.items()
    }
    assert {name for name, failed in outcomes.items() if failed} == {
        "all unknown",
        "masks alone",
        "far away",
        "chequered",
    }


def test_trial_does_not_compute_the_result(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> Any:
        raise AssertionError("the whole result is computed")

    monkeypatch.setattr(occupancy_to_voxels, "_leaves", refuse)
    monkeypatch.setattr(occupancy_to_imagery, "_colour_cells", refuse)
    layers = Layers({PartKey("occupancy"): grid(OCCUPIED)})
    for name in ("occupancy_to_voxels", "occupancy_to_imagery"):
        derive.try_steps((derive.all_derivations()[name].step(),), layers)


def test_steps_before_the_last_are_executed() -> None:
    layers = Layers({PartKey("occupancy"): grid(UNKNOWN)})
    steps = tuple(derive.all_derivations()[name].step() for name in ("occupancy_to_objects", "occupancy_to_voxels"))
    with pytest.raises(CannotDerive) as caught:
        derive.try_steps(steps, layers)
    assert caught.value.step == "occupancy_to_objects"
