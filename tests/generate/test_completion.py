"""Holes of 2 m × 2 m cut into real grids: cells that complete_grid frees are free, and straight walls continue."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from app import generate
from app.derive import DerivationNotes
from app.errors import CannotGenerate
from app.generate import _evidence
from app.model.frame import GROUND
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.layers import Layers, PartKey
from tests.derive.judge import cases
from tests.derive.judge.__main__ import OWN
from tests.derive.judge.completion import judge

KEY = PartKey("occupancy", GROUND, "map")


@pytest.mark.parametrize("name", ["house", "depot"])
def test_holes_in_real_grids_get_walls_back_and_no_false_free_cells(shared: Path, name: str) -> None:
    """The smallest two of the ten grids that the judge of derived maps measures."""
    (case,) = [case for case in cases(OWN / "completion", shared / "data") if case.name == name]
    result = judge(case)
    assert result.is_kept, [figure for figure in result.figures if not figure.is_kept]
    (freed,) = [figure.value for figure in result.figures if figure.name == "holes' cells freed"]
    assert freed >= 0.15, "better unknown than wrong, but not nothing"


def room() -> NDArray[np.uint8]:
    """A room of 6 m × 4 m with a wall in the middle, and unknown cells beyond its walls."""
    cells = np.full((100, 140), UNKNOWN, np.uint8)
    cells[10:90, 10:130] = FREE
    cells[10:90, [10, 11, 69, 70, 128, 129]] = OCCUPIED
    cells[[10, 11, 88, 89], 10:130] = OCCUPIED
    return cells


def complete(cells: NDArray[np.uint8], notes: DerivationNotes | None = None, **values: float) -> NDArray[np.uint8]:
    given = Layers({KEY: OccupancyGrid(cells, 0.05)})
    return generate.run("complete_grid", 7, values, given, notes or DerivationNotes()).grids()[KEY].cells


def test_wall_is_continued_and_cells_beyond_stay_unknown() -> None:
    cells = room()
    hole = np.s_[30:70, 50:90]
    cells[hole] = UNKNOWN
    notes = DerivationNotes()
    result = complete(cells, notes)
    assert (result[30:70, 69:71] == OCCUPIED).all()
    assert (result[hole] == OCCUPIED).sum() == 80
    assert (result[hole] == FREE).mean() > 0.5
    beyond = room() == UNKNOWN
    assert (result[beyond] == UNKNOWN).all()
    (left,) = [d for d in notes.dropped if d.subject == "unknown cells"]
    assert left.count > 0
    assert "confidence of 0.98" in left.why


def test_completed_grid_shows_more_than_the_objects() -> None:
    """Gazebo gets walls of a grid only if it is no slice of the objects that it has anyway."""
    cells = room()
    cells[30:70, 50:90] = UNKNOWN
    given = Layers({KEY: OccupancyGrid(cells, 0.05, properties={"slice": {"of": "objects"}, "kept": 1})})
    grid = generate.run("complete_grid", 7, {}, given, DerivationNotes()).grids()[KEY]
    assert grid.properties == {"kept": 1}


def walls_over(occupied: NDArray[np.bool_], hole: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return _evidence.walls(_evidence.Grid(occupied & ~hole, ~hole, 0.05), hole)


def test_wall_in_an_arc_is_continued_on_its_arc() -> None:
    row, column = np.mgrid[:200, :200]
    occupied = np.abs(np.hypot(row - 20, column - 20) - 150) <= 1.0  # a radius of 7.5 m
    hole = np.zeros_like(occupied)
    hole[106:146, 106:146] = True
    wall = walls_over(occupied, hole)
    near, back = (cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0 for mask in (occupied, wall))
    assert (near & wall).sum() == wall.sum() > 30
    assert (back & occupied & hole).sum() > 0.9 * (occupied & hole).sum()


@pytest.mark.parametrize("stub", [8, 0])
def test_wall_is_continued_to_its_corner_but_not_to_a_wall_across(stub: int) -> None:
    occupied = np.zeros((140, 140), bool)
    occupied[20:22, 30:110] = True  # another wall, which the upper end meets
    occupied[20 : 22 + stub, 69:71] = True
    occupied[62:130, 69:71] = True
    hole = np.zeros_like(occupied)
    hole[22 + stub : 62, 50:90] = True
    wall = walls_over(occupied, hole)
    assert wall.sum() == (2 * (40 - stub) if stub else 0), "a gap before a wall across may be a door"


def test_walls_compared_in_portions_are_the_same_and_need_less_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    occupied = np.zeros((100, 1600), bool)
    occupied[40, 20:1580] = True
    hole = np.zeros_like(occupied)
    hole[41:60, 20:1580] = True
    hole[30:60, 190:210] = True
    found, peaks = [], []
    for ends in (10_000, _evidence.ENDS_AT_ONCE):
        monkeypatch.setattr(_evidence, "ENDS_AT_ONCE", ends)
        tracemalloc.start()
        found.append(walls_over(occupied, hole))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert found[0].sum() == found[1].sum() == 20
    assert (found[0] == found[1]).all()
    assert peaks[1] < 0.6 * peaks[0]


def test_higher_confidence_fills_fewer_cells() -> None:
    cells = room()
    cells[30:70, 20:60] = UNKNOWN
    filled = [int((complete(cells, confidence=c) != UNKNOWN).sum()) for c in (0.0, 0.5, 0.98)]
    assert filled[0] > filled[1] >= filled[2] > 0
    alone = np.full((60, 60), UNKNOWN, np.uint8)
    alone[10:40, 10:40] = FREE
    with pytest.raises(CannotGenerate, match="set a lower confidence"):
        complete(alone)
