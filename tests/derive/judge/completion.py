"""Kind ``completion``: square holes are cut into a grid, and ``complete_grid`` fills them in; the truth is the grid.

Keys of a label file:

    map: house.yaml               # of an occupancy grid
    image: house.pgm              # its image, with image_sha256
    seed: 3                       # of the holes: the same holes whatever is judged

There are holes of 2 m × 2 m anywhere in the known part, and holes over walls that are straight and alone for 2.6 m.
Of these walls' cells, those that come back within one cell are counted.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from app import formats, generate
from app.derive import DerivationNotes
from app.errors import CannotGenerate
from app.formats import ReadContext
from app.model.frame import GROUND
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.layers import Layers, PartKey
from tests.derive.judge import Case, Figure, Result

Bool = NDArray[np.bool_]
KEY = PartKey("occupancy", GROUND, "map")
HOLE_METRES, HOLES = 2.0, 12
TRIES = 2000
COLOURS = {"free": (150, 220, 150), "wrong": (230, 40, 40), "wall": (20, 60, 200), "lost": (250, 170, 40)}


def judge(case: Case) -> Result:
    """Fill in the holes; figures are NaN where there is nothing to count, and have no bound then."""
    grid = read_grid(case)
    valid, occupied = _known(grid)
    sums = dict.fromkeys(("free", "free_right", "wall", "wall_right", "straight", "back", "cells"), 0)
    pictures = []
    for hole, over_walls in holes(grid, case.labels["seed"]):
        result = _completed(grid, hole)
        if not (result == grid.cells)[valid & ~hole].all():
            raise AssertionError(f"{case.name}: known cells have changed")
        masks = _masks(result, hole, valid, occupied, over_walls=over_walls)
        for name, mask in masks.items():
            sums[name] += int(np.count_nonzero(mask))
        pictures.append(_picture(grid, hole, occupied, result))
    return Result(_figures(sums), Image.fromarray(np.vstack(pictures)) if pictures else None)


def read_grid(case: Case) -> OccupancyGrid:
    """Return the labelled grid."""
    yaml, image = case.file(), case.file("image")
    files = {yaml.name: yaml.read_bytes(), image.name: image.read_bytes()}
    (group,) = formats.group(files, "occupancy_grid")[0]
    (grid,) = formats.read(group, ReadContext()).grids().values()
    return grid


def _known(grid: OccupancyGrid) -> tuple[Bool, Bool]:
    """Return the known cells, and the occupied ones."""
    valid = grid.cells != UNKNOWN
    return valid, valid & (grid.cells >= grid.occupied_thresh * OCCUPIED)


def holes(grid: OccupancyGrid, seed: int) -> list[tuple[Bool, bool]]:
    """Return masks of holes, one of holes anywhere and one of holes over walls, and whether they are over walls."""
    draw = np.random.default_rng(seed)
    valid, occupied = _known(grid)
    side = round(HOLE_METRES / grid.resolution)
    anywhere = _holes(valid, side, draw.choice(np.flatnonzero(valid), TRIES).tolist())
    over_walls = _holes(valid, side, _along_walls(occupied, side // 2, draw))
    return [(hole, over) for hole, over in ((anywhere, False), (over_walls, True)) if hole.any()]


def cut(grid: OccupancyGrid, hole: Bool) -> OccupancyGrid:
    """Return the grid with unknown cells in a hole."""
    return OccupancyGrid(np.where(hole, UNKNOWN, grid.cells).astype(np.uint8), grid.resolution)


def _completed(grid: OccupancyGrid, hole: Bool) -> NDArray[np.uint8]:
    damaged = cut(grid, hole)
    try:
        return generate.run("complete_grid", 7, {}, Layers({KEY: damaged}), DerivationNotes()).grids()[KEY].cells
    except CannotGenerate:  # nothing is certain: all stays unknown
        return damaged.cells


def _masks(result: NDArray[np.uint8], hole: Bool, valid: Bool, occupied: Bool, *, over_walls: bool) -> dict[str, Bool]:
    free, wall = hole & valid & (result == FREE), hole & valid & (result == OCCUPIED)
    near, back = (cv2.dilate(cells.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0 for cells in (occupied, wall))
    straight = hole & occupied if over_walls else np.zeros_like(hole)
    return {
        "free": free,
        "free_right": free & ~occupied,
        "wall": wall,
        "wall_right": wall & near,
        "straight": straight,
        "back": straight & back,
        "cells": hole & valid,
    }


def _figures(sums: dict[str, int]) -> list[Figure]:
    def share(part: str, whole: str) -> float:
        return sums[part] / sums[whole] if sums[whole] else float("nan")

    rows: list[tuple[str, float, dict[str, Any]]] = [
        ("precision of free", share("free_right", "free"), {"at_least": 0.98} if sums["free"] else {}),
        ("holes' cells freed", share("free", "cells"), {}),
        ("precision of walls", share("wall_right", "wall"), {"at_least": 0.95} if sums["wall"] else {}),
        ("straight walls back", share("back", "straight"), {"at_least": 0.7} if sums["straight"] else {}),
        ("cells of straight walls", sums["straight"], {}),
    ]
    return [Figure(name, float(value), **bounds) for name, value, bounds in rows]


def _holes(valid: Bool, side: int, centres: list[int]) -> Bool:
    """Return squares around known cells that do not touch, with mostly known cells."""
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


def _along_walls(occupied: Bool, half: int, draw: np.random.Generator) -> list[int]:
    """Return occupied cells in the middle of a wall that is straight and alone for 2.6 m."""
    reach = round(1.3 * half)
    out = []
    for row, column in draw.permutation(np.argwhere(occupied))[:TRIES].tolist():
        window = occupied[max(0, row - reach) : row + reach + 1, max(0, column - reach) : column + reach + 1]
        if window.shape != (2 * reach + 1, 2 * reach + 1):
            continue
        pieces = cv2.connectedComponents(window.astype(np.uint8), connectivity=8)[1]
        wall = np.argwhere(pieces == pieces[reach, reach])
        across, along = np.linalg.eigvalsh(np.cov(wall.T)) if len(wall) > 1.6 * reach else (9.0, 0.0)
        if across <= 2.0 and along >= (0.5 * reach) ** 2 and window.sum() <= 1.15 * len(wall):
            out.append(row * occupied.shape[1] + column)
    return out


def _picture(grid: OccupancyGrid, hole: Bool, occupied: Bool, result: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Draw the grid with its holes: freed cells, continued walls, wrong ones, and lost wall cells."""
    out = np.full((*grid.cells.shape, 3), 200, np.uint8)
    out[grid.cells == FREE] = 255
    out[occupied] = 0
    out[hole] = (225, 225, 235)
    out[hole & (result == FREE)] = COLOURS["free"]
    out[hole & (result == OCCUPIED)] = COLOURS["wall"]
    out[hole & occupied & (result == UNKNOWN)] = COLOURS["lost"]
    out[hole & occupied & (result == FREE)] = COLOURS["wrong"]
    return np.ascontiguousarray(out[::-1])
