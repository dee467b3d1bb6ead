"""The benchmark's synthetic maps convert, in a small size, and are reproducible from their seed."""

from __future__ import annotations

import pytest

from app.convert.files import offline
from app.model.features import Features
from app.model.grid import OccupancyGrid
from tests.bench import derived
from tests.bench.large import CASES, SMALL


@pytest.mark.parametrize("name", sorted(CASES))
def test_synthetic_map_converts(name: str) -> None:
    case = CASES[name]
    files = case.make(SMALL)
    assert files == case.make(SMALL)
    converted = offline(files, case.to, datum=case.datum, options=case.options)
    assert converted.files
    assert not [w for w in converted.report.as_dict()["warnings"] if "left out" in w["problem"]]


@pytest.mark.parametrize("name", sorted(derived.CASES))
def test_synthetic_site_derives(name: str) -> None:
    derived_layers = derived.run(derived.CASES[name], derived.SMALL)
    (part,) = derived_layers.parts.values()
    if isinstance(part, OccupancyGrid):
        assert part.cells.shape == pytest.approx((derived.HEIGHT * derived.SMALL, derived.WIDTH * derived.SMALL), abs=4)
        assert part.counts()["free"] > 0
    else:
        assert isinstance(part, Features)
        assert len(part) > 20
