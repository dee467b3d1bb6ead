"""Holes of 2 m × 2 m cut into real grids: cells that complete_grid frees are free, and straight walls continue.

``python -m tests.generate.test_completion`` measures all grids, for the figures in docs/how-to/generate-sites.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from app import formats, generate
from app.derive import DerivationNotes
from app.errors import CannotGenerate
from app.formats import ReadContext
from app.generate import _evidence
from app.model.frame import GROUND
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.layers import Layers, PartKey

Bool = NDArray[np.bool_]

KEY = PartKey("occupancy", GROUND, "map")
HOLE = 2.0
HOLES = 12
FAST = ("gazebo_sdf/turtlebot3_house/maps/house.yaml", "nav2_masks/depot/depot.yaml")
GRIDS = (
    *FAST,
    "openrmf_building/robast_sim/ros_map/small_sim_map.yaml",
    "environment_template/riseholme_park_farm_vineyard/config/metric/map/map.yaml",
    "environment_template/riseholme_park_farm_strawberry_polytunnels/config/metric/map/map.yaml",
    "gazebo_sdf/aws_small_warehouse/maps/005/map.yaml",
    "gazebo_sdf/turtlebot3_world/maps/map.yaml",
    "occupancy_grid/nav2_map_circular/map_circular.yaml",
    "occupancy_grid/turtlebot3_map_office_raw/map_office_raw.yaml",
    "occupancy_grid/nav2_tb3_sandbox/tb3_sandbox.yaml",
)


def grid_of(path: Path) -> OccupancyGrid:
    files = {f.name: f.read_bytes() for f in path.parent.iterdir() if f.is_file()}
    (group,) = [g for g in formats.group(files, "occupancy_grid")[0] if g.main == path.name]
    (grid,) = formats.read(group, ReadContext()).grids().values()
    return grid


def holes(valid: Bool, side: int, centres: Sequence[int]) -> Bool:
    """Yield squares around known cells that do not touch, with mostly known cells."""
    out = np.zeros(valid.shape, bool)
    count = 0
    for middle in centres:
        row, column = divmod(int(middle), valid.shape[1])
        top, left = max(0, row - side // 2), max(0, column - side // 2)
        around = np.s_[max(0, top - side) : top + 2 * side, max(0, left - side) : left + 2 * side]
        if valid[top : top + side, left : left + side].mean() > 0.9 and not out[around].any():
            out[top : top + side, left : left + side] = True
            count += 1
        if count == HOLES:
            break
    return out


def along_walls(occupied: Bool, half: int, draw: np.random.Generator) -> list[int]:
    """Occupied cells in the middle of a wall that is straight and alone for 2.6 m."""
    reach = round(1.3 * half)
    out = []
    for row, column in draw.permutation(np.argwhere(occupied))[:2000].tolist():
        window = occupied[max(0, row - reach) : row + reach + 1, max(0, column - reach) : column + reach + 1]
        if window.shape != (2 * reach + 1, 2 * reach + 1):
            continue
        pieces = cv2.connectedComponents(window.astype(np.uint8), connectivity=8)[1]
        wall = np.argwhere(pieces == pieces[reach, reach])
        across, along = np.linalg.eigvalsh(np.cov(wall.T)) if len(wall) > 1.6 * reach else (9.0, 0.0)
        if across <= 2.0 and along >= (0.5 * reach) ** 2 and window.sum() <= 1.15 * len(wall):
            out.append(row * occupied.shape[1] + column)
    return out


@dataclass(frozen=True, slots=True)
class Measure:
    """Numbers of cells in holes. free, free_right: called free, and free in truth. wall, wall_right: called occupied,
    and at most one cell from an occupied one. straight, straight_back: cells of straight walls, and those that came
    back within one cell. cells: of all holes."""

    free: int = 0
    free_right: int = 0
    wall: int = 0
    wall_right: int = 0
    straight: int = 0
    straight_back: int = 0
    cells: int = 0

    def __add__(self, other: Measure) -> Measure:
        return Measure(*(getattr(self, name) + getattr(other, name) for name in Measure.__slots__))


def measured(grid: OccupancyGrid, seed: int = 3) -> Measure:
    """Holes anywhere, and holes in straight walls."""
    draw = np.random.default_rng(seed)
    valid = grid.cells != UNKNOWN
    occupied = valid & (grid.cells >= grid.occupied_thresh * OCCUPIED)
    side = round(HOLE / grid.resolution)
    anywhere = draw.choice(np.flatnonzero(valid), 2000).tolist()
    out = Measure()
    for centres in (anywhere, along_walls(occupied, side // 2, draw)):
        hole = holes(valid, side, centres)
        if not hole.any():
            continue
        cut = OccupancyGrid(np.where(hole, UNKNOWN, grid.cells).astype(np.uint8), grid.resolution)
        try:
            result = generate.run("complete_grid", 7, {}, Layers({KEY: cut}), DerivationNotes()).grids()[KEY].cells
        except CannotGenerate:
            result = cut.cells
        assert (result == grid.cells)[valid & ~hole].all(), "known cells stay"
        free, wall = hole & valid & (result == FREE), hole & valid & (result == OCCUPIED)
        near, back = (cv2.dilate(cells.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0 for cells in (occupied, wall))
        straight = hole & occupied if centres is not anywhere else np.zeros_like(hole)
        counts = (free, free & ~occupied, wall, wall & near, straight, straight & back, hole)
        out += Measure(*(int(np.count_nonzero(c)) for c in counts))
    return out


@pytest.mark.parametrize("name", FAST)
def test_holes_in_real_grids_get_walls_back_and_no_false_free_cells(shared: Path, name: str) -> None:
    measure = measured(grid_of(shared / "data" / name))
    assert measure.free_right >= 0.98 * measure.free
    assert measure.free >= 0.15 * measure.cells, "better unknown than wrong, but not nothing"
    assert measure.wall_right >= 0.95 * measure.wall
    assert measure.straight_back >= 0.5 * measure.straight


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


def test_higher_confidence_fills_fewer_cells() -> None:
    cells = room()
    cells[30:70, 20:60] = UNKNOWN
    filled = [int((complete(cells, confidence=c) != UNKNOWN).sum()) for c in (0.0, 0.5, 0.98)]
    assert filled[0] > filled[1] >= filled[2] > 0
    alone = np.full((60, 60), UNKNOWN, np.uint8)
    alone[10:40, 10:40] = FREE
    with pytest.raises(CannotGenerate, match="set a lower confidence"):
        complete(alone)


def main() -> None:
    """Print a line for each grid, and one for all."""
    total = Measure()
    for name in GRIDS:
        measure = measured(grid_of(Path(__file__).parents[3] / "shared" / "data" / name))
        total += measure
        print(name, measure, flush=True)
    print(
        f"free {total.free_right / total.free:.4f} of {total.free} ({total.free / total.cells:.2f} of the holes), "
        f"walls {total.wall_right / total.wall:.4f} of {total.wall}, straight walls back "
        f"{total.straight_back / total.straight:.2f} of {total.straight}"
    )


if __name__ == "__main__":
    main()
