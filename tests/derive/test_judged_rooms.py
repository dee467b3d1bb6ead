"""Areas of real maps against people's labels: `python -m tests.derive.judge --kind rooms` prints all of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.derive.judge import cases, judged
from tests.derive.judge.__main__ import OWN

SMALL = (
    "joctomap_ecmr",
    "nav2_depot",
    "riseholme_vineyard",
    "rmf_hotel_L2",
    "rmf_office",
    "turtlebot3_house",
    "turtlebot3_office_raw",
)


@pytest.mark.parametrize("name", SMALL)
def test_areas_match_labels_within_bounds(shared: Path, name: str) -> None:
    case = next(case for case in cases(OWN / "rooms", shared / "data") if case.name == name)
    missed = {figure.name: (figure.value, figure.bound) for figure in judged(case).figures if not figure.is_kept}
    assert not missed
