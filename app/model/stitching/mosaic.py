"""One grid made of several whose positions are known.

The cells are the first grid's, continued, and as small as those of the finest grid. A cell takes from each grid the
value at its centre, or that of an occupied cell whose centre it contains: no wall is lost by a rotation. Unknown cells
take no part. If one grid saw a cell occupied and another one free, with no wall near it, they are in conflict.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from app.errors import Invalid, Problem
from app.model.alignment import Fit, rotation
from app.model.grid import FREE, OCCUPIED, SLICE, UNKNOWN, UNKNOWN_GREY, OccupancyGrid, unknown_grey_as_unknown

Cells = NDArray[np.uint8]
Seam = Literal["evidence", "newest"]
SEAMS: tuple[Seam, ...] = get_args(Seam)

MAX_CELLS = 2**26
"""Maximum number of cells of a merged grid."""

HIT, MISS = 0.85, 0.4
"""Log-odds of an occupied and of a free cell (Hornung et al., OctoMap, 2013): three free ones outweigh an occupied one.
"""

_STRIP = 2**19
"""Number of cells that are merged at once."""

_BESIDE_WALL = OCCUPIED + 1
"""Code of a free cell next to a wall of its grid: no evidence against a wall that another grid has there."""


@dataclass(frozen=True, slots=True)
class Mosaic:
    """A merged grid. conflicts: cells that one grid saw occupied and another free. freed: those that became free."""

    grid: OccupancyGrid
    conflicts: int
    freed: int


def merge_cells(
    grids: Sequence[OccupancyGrid], fits: Sequence[Fit], seam: Seam, *, near: float = 0.1, max_cells: int = MAX_CELLS
) -> Mosaic:
    """Merge grids, the first of which stays where it is.

    Args:
        fits: motion of each grid into the frame of the first.
        seam: `evidence`: sum of the log-odds of all grids, in doubt occupied. `newest`: the last grid that knows the
            cell decides.
        near: metres around a wall in which its grid's free cells are no evidence against other walls.

    Raises Invalid if there would be too many cells.
    """
    moved = [fit.move_grid(unknown_grey_as_unknown(grid)) for grid, fit in zip(grids, fits, strict=True)]
    first, size = moved[0], min(grid.resolution for grid in grids)
    low, (height, width) = _extent(moved, size, max_cells)
    x, y, yaw = first.origin
    corner = rotation(yaw) @ (low * size) + np.array([x, y])
    sources = [(_coded(grid, near), grid) for grid in moved]
    out = np.full((height, width), UNKNOWN, np.uint8)
    conflicts = freed = 0
    step = max(1, _STRIP // width)
    for row in range(0, height, step):
        shape = (min(step, height - row), width)
        values = [_strip(codes, grid, corner, yaw, size, row, shape) for codes, grid in sources]
        blocks = [block for block in values if block is not None]
        if not blocks:
            continue
        solid, free = (np.sum([block == code for block in blocks], axis=0) for code in (OCCUPIED, FREE))
        block = _by_evidence(blocks, solid, free) if seam == "evidence" else _by_age(blocks)
        disputed = (solid > 0) & (free > 0)
        conflicts += int(disputed.sum())
        freed += int((disputed & (block == FREE)).sum())
        out[row : row + shape[0]] = block
    middling = bool(((out > FREE) & (out < OCCUPIED)).any())
    properties = {key: value for key, value in first.properties.items() if key not in (SLICE, UNKNOWN_GREY)}
    origin = (round(float(corner[0]), 9), round(float(corner[1]), 9), yaw)
    mode = "scale" if middling and first.mode == "trinary" else first.mode
    merged = replace(first, cells=out, resolution=size, origin=origin, mode=mode, properties=properties)
    return Mosaic(merged, conflicts, freed)


def _by_evidence(values: Sequence[Cells], solid: NDArray[np.int_], free: NDArray[np.int_]) -> Cells:
    """Sum up the evidence. A middling value (a cost) is never lowered."""
    most = np.zeros(values[0].shape, np.uint8)
    observed = np.zeros(most.shape, bool)
    for block in values:
        observed |= block != UNKNOWN
        most = np.maximum(most, np.where(block < OCCUPIED, block, FREE))
    out = np.where(observed, most, np.uint8(UNKNOWN))
    return np.where((solid > 0) & (solid * HIT >= free * MISS), np.uint8(OCCUPIED), out).astype(np.uint8)


def _by_age(values: Sequence[Cells]) -> Cells:
    """Let the last grid that knows a cell decide."""
    out = np.full(values[0].shape, UNKNOWN, np.uint8)
    for block in values:
        out = np.where(block == UNKNOWN, out, np.where(block == _BESIDE_WALL, np.uint8(FREE), block)).astype(np.uint8)
    return out


def _coded(grid: OccupancyGrid, near: float) -> Cells:
    """Return the cells with a code of their own for free ones beside walls."""
    import cv2

    reach = min(5, max(1, round(near / grid.resolution)))
    solid = (grid.cells == OCCUPIED).astype(np.uint8)
    beside = cv2.dilate(solid, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8), borderValue=0)
    out = grid.cells.copy()
    out[(beside > 0) & (grid.cells == FREE)] = _BESIDE_WALL
    return out


def _extent(grids: Sequence[OccupancyGrid], size: float, max_cells: int) -> tuple[NDArray[np.float64], tuple[int, int]]:
    """Return (lower left cell as (column, row) in the first grid's cells of this size, (height, width)).

    Unknown borders of all grids but the first do not count.
    """
    x, y, yaw = grids[0].origin
    corners = [grids[0].corners()]
    for grid in grids[1:]:
        observed = grid.cells != UNKNOWN
        rows, columns = np.flatnonzero(observed.any(axis=1)), np.flatnonzero(observed.any(axis=0))
        if len(rows):
            low, high = np.array([columns[0], rows[0]]), np.array([columns[-1], rows[-1]]) + 1
            box = np.array([low, [high[0], low[1]], high, [low[0], high[1]]]) * grid.resolution
            corners.append(box @ rotation(grid.origin[2]).T + np.array(grid.origin[:2]))
    local = (np.concatenate(corners) - np.array([x, y])) @ rotation(yaw) / size
    low, high = np.floor(local.min(axis=0) + 1e-3), np.ceil(local.max(axis=0) - 1e-3)
    width, height = (float(n) for n in np.maximum(high - low, 1))
    if width * height > max_cells:
        reason = (
            f"the merged grid would have {width:.0f} × {height:.0f} cells of {size:g} m; the limit is {max_cells}: "
            "check the poses and pairs, or leave out the finest grid"
        )
        raise Invalid(reason, [Problem(reason, where="body.merge.grids")])
    return low, (int(height), int(width))


def _strip(
    codes: Cells,
    grid: OccupancyGrid,
    corner: NDArray[np.float64],
    yaw: float,
    size: float,
    row: int,
    shape: tuple[int, int],
) -> Cells | None:
    """Return a grid's values in some rows of the merged grid; None where it has no cell."""
    x, y, own_yaw = grid.origin
    turn = rotation(yaw - own_yaw) * (size / grid.resolution)
    shift = rotation(-own_yaw) @ (corner - np.array([x, y])) / grid.resolution
    v, u = np.mgrid[row : row + shape[0], 0 : shape[1]].astype(np.float64)

    def sample(du: float, dv: float) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.bool_]]:
        across = turn[0, 0] * (u + du) + turn[0, 1] * (v + dv) + shift[0]
        along = turn[1, 0] * (u + du) + turn[1, 1] * (v + dv) + shift[1]
        column, line = np.floor(across + 1e-6).astype(np.int32), np.floor(along + 1e-6).astype(np.int32)
        return column, line, (column >= 0) & (column < grid.width) & (line >= 0) & (line < grid.height)

    column, line, inside = sample(0.5, 0.5)
    out = np.full(shape, UNKNOWN, np.uint8)
    out[inside] = codes[line[inside], column[inside]]
    back = np.linalg.inv(turn)
    touched = inside.any()
    for du, dv in ((0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75)):
        column, line, inside = sample(du, dv)
        touched |= inside.any()
        at = np.nonzero(inside)
        solid = codes[line[at], column[at]] == OCCUPIED
        at = (at[0][solid], at[1][solid])
        # only the cell that contains the centre of the occupied one
        p, q = column[at] + 0.5 - shift[0], line[at] + 0.5 - shift[1]
        home = (np.floor(back[0, 0] * p + back[0, 1] * q + 1e-6) == at[1]) & (
            np.floor(back[1, 0] * p + back[1, 1] * q + 1e-6) == at[0] + row
        )
        out[at[0][home], at[1][home]] = OCCUPIED
    return out if touched else None
