"""The judges of aerial pictures and rows on labelled maps that are part of the data for development."""

from __future__ import annotations

import pytest

from tests.derive.judge import cases, judged
from tests.derive.judge.__main__ import OWN


@pytest.mark.parametrize("name", ["polytunnels-satellite", "polytunnels-posts", "vineyard-grid"])
def test_labelled_map_keeps_its_bounds(name: str) -> None:
    (case,) = [case for case in cases(OWN) if case.name == name]
    result = judged(case)
    missed = [f"{f.name} {f.value:.3g} {f.bound}" for f in result.figures if not f.is_kept]
    assert not missed
    assert result.picture is not None
