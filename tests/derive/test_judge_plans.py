"""The bounds of the labelled plans and scans, as far as their maps are there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from tests.derive.judge import DATA, Case, cases
from tests.derive.judge.plan import judge as judge_plan
from tests.derive.judge.scan import judge as judge_scan

LABELS = Path(__file__).parent / "labels"
PASSABLE = {
    # pallets that are half seen keep walls as sides
    "nav2_depot": {"walls / labelled walls", "median length / labelled"},
}
"""Figures that are known to miss their bounds."""


@pytest.fixture(scope="module")
def labelled() -> dict[str, Case]:
    if not DATA.is_dir():
        pytest.skip("the real maps are missing")
    return {case.name: case for folder in ("plans", "scans") for case in cases(LABELS / folder)}


@pytest.mark.parametrize("name", ["hotel_L1", "hotel_L2", "office", "triple_H"])
def test_plans_keep_their_bounds(labelled: dict[str, Case], name: str) -> None:
    figures = judge_plan(labelled[name]).figures
    assert len(figures) == 5
    assert not {figure.name for figure in figures if not figure.is_kept} - PASSABLE.get(name, set())


@pytest.mark.parametrize("name", ["aws_warehouse", "nav2_depot", "turtlebot3_house", "turtlebot3_office"])
def test_scans_keep_their_bounds(labelled: dict[str, Case], name: str) -> None:
    figures = judge_scan(labelled[name]).figures
    assert len(figures) >= 5
    assert not {figure.name for figure in figures if not figure.is_kept} - PASSABLE.get(name, set())


@pytest.mark.parametrize("name", ["airport", "clinic"])
def test_plans_from_elsewhere_say_where_to_get_them(labelled: dict[str, Case], name: str) -> None:
    (figure,) = judge_plan(replace(labelled[name], roots=())).figures
    assert "not measured" in figure.name
    assert "https://" in figure.name
    assert not figure.bound
