"""Confidence in an unknown cell from a grid's known ones: straight walls that continue, free cells between free cells.

Nothing is extrapolated: cells beyond the known ones stay unknown. How often a cell with given surroundings is free is
counted in the grid itself, in holes that are cut into its known part and filled in again.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

Bool = NDArray[np.bool_]
Places = NDArray[np.intp]
Array = NDArray[np.float64]

RAYS = ((0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1))
"""Steps (rows, columns) to the eight neighbours; the opposite of ray k is ray k + 4."""

NOTHING, SEES_FREE, SEES_OCCUPIED = 0, 1, 2

SPAN_METRES = 3.0
"""Maximum distance to known cells, and maximum length by which a wall continues, in metres."""

HOLES, MIN_CASES = 64, 50
"""Number of holes that are cut into a grid, and minimum number of cases for a kind of surroundings."""

EVERY = 3
"""One in this many cells of a hole is evaluated: neighbours give the same result."""

NEAR_METRES = (0.15, 0.5)
"""Distances in metres that separate near and far known cells."""

WALL_RADIUS_METRES = 0.6
"""Length of a wall from which its direction is computed, in metres."""

MAX_WIDTH_RATIO = 0.2
"""Minimum ratio of the variances along and across the end of a straight wall."""

MAX_TURN = math.radians(8.0)
MAX_ENDS = 20_000


@dataclass(frozen=True, slots=True)
class Grid:
    """Known part of a grid. occupied, known: bool [height, width]. cell: metres."""

    occupied: Bool
    observed: Bool
    cell: float


# --- walls ---


def walls(grid: Grid, target: Bool) -> Bool:
    """Return the wanted cells over which a straight wall continues from one known end to another."""
    import cv2

    out = np.zeros(target.shape, np.uint8)
    edge = cv2.dilate(target.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    at = np.argwhere(grid.occupied & edge)
    if not 2 <= len(at) <= MAX_ENDS:
        return out.astype(bool)
    direction, straight = _directions(grid, at)
    at, direction = at[straight], direction[straight]
    if len(at) < 2:
        return out.astype(bool)
    points = shapely.points(at[:, ::-1].astype(float))
    pairs = shapely.STRtree(points).query(points, predicate="dwithin", distance=SPAN_METRES / grid.cell)
    first, second = pairs[:, pairs[0] < pairs[1]]
    across = at[second] - at[first]
    length = np.hypot(*across.T)
    line = across / np.maximum(length, 1e-9)[:, None]
    slack = np.sin(MAX_TURN + np.arctan(0.7 / np.maximum(length, 1.0)))
    aligned = np.ones(len(first), bool)
    for end in (first, second):
        turn = np.abs(direction[end, 0] * line[:, 1] - direction[end, 1] * line[:, 0])
        aligned &= turn <= slack
    seen_free = grid.observed & ~grid.occupied
    for a, b in zip(at[first[aligned]].tolist(), at[second[aligned]].tolist(), strict=True):
        steps = max(abs(a[0] - b[0]), abs(a[1] - b[1]))
        row, column = (np.round(np.linspace(p, q, steps + 1)).astype(int)[1:-1] for p, q in zip(a, b, strict=True))
        if len(row) and not seen_free[row, column].any():
            out[row, column] = 1
    return out.astype(bool) & target


def _directions(grid: Grid, at: Places) -> tuple[Array, Bool]:
    """Return the direction (rows, columns) of occupied cells around each position, and whether they form a line."""
    radius = max(2, round(WALL_RADIUS_METRES / grid.cell))
    padded = np.pad(grid.occupied, radius)
    offset = np.argwhere(np.ones((2 * radius + 1, 2 * radius + 1), bool)) - radius
    offset = offset[(offset**2).sum(axis=1) <= radius * radius]
    direction, straight = np.zeros((len(at), 2)), np.zeros(len(at), bool)
    portion = max(1, 2**22 // len(offset))
    for begin in range(0, len(at), portion):
        batch = at[begin : begin + portion] + radius
        weight = padded[batch[:, :1] + offset[:, 0], batch[:, 1:] + offset[:, 1]].astype(np.float64)
        total = np.maximum(weight.sum(axis=1), 1.0)
        mean = weight @ offset / total[:, None]
        squares = np.stack([offset[:, 0] ** 2, offset[:, 0] * offset[:, 1], offset[:, 1] ** 2], axis=1)
        rr, rc, cc = ((weight @ squares) / total[:, None]).T
        rr, rc, cc = rr - mean[:, 0] ** 2, rc - mean[:, 0] * mean[:, 1], cc - mean[:, 1] ** 2
        angle = 0.5 * np.arctan2(2 * rc, cc - rr)
        spread, middle = np.hypot((cc - rr) / 2, rc), (rr + cc) / 2
        direction[begin : begin + portion] = np.column_stack([np.sin(angle), np.cos(angle)])
        long_enough = middle + spread >= (0.25 * radius) ** 2
        straight[begin : begin + portion] = long_enough & (middle - spread <= MAX_WIDTH_RATIO * (middle + spread))
    return direction, straight


# --- free cells ---


def surroundings(grid: Grid, at: Places) -> NDArray[np.int64]:
    """Classify the surroundings of positions [n, 2]; 0 if they are not between free cells.

    The class counts the lines through a position with free cells on both sides, the rays that hit occupied ones, and
    the distance of the nearest known cell.
    """
    limit = max(1, round(SPAN_METRES / grid.cell))
    height, width = grid.observed.shape
    code = np.where(grid.observed, np.where(grid.occupied, SEES_OCCUPIED, SEES_FREE), NOTHING).astype(np.uint8)
    seen = np.zeros((8, len(at)), np.uint8)
    nearest = np.full(len(at), limit + 1.0)
    for ray, (up, right) in enumerate(RAYS):
        left = np.arange(len(at))
        for step in range(1, int(limit / math.hypot(up, right)) + 1):
            row, column = at[left, 0] + up * step, at[left, 1] + right * step
            inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
            left, row, column = left[inside], row[inside], column[inside]
            codes = code[row, column]
            hit = codes != NOTHING
            seen[ray, left[hit]] = codes[hit]
            nearest[left[hit]] = np.minimum(nearest[left[hit]], step * math.hypot(up, right))
            left = left[~hit]
            if not len(left):
                break
    both = ((seen[:4] == SEES_FREE) & (seen[4:] == SEES_FREE)).sum(axis=0)
    occupied = (seen == SEES_OCCUPIED).sum(axis=0)
    near = np.digitize(nearest * grid.cell, NEAR_METRES)
    return np.where(both > 0, 1 + (near * 5 + both) * 9 + occupied, 0)


KINDS = 1 + 3 * 5 * 9


def confidence(grid: Grid, side: float, draw: np.random.Generator) -> Array:
    """Return for each class of surroundings the share of free cells in holes cut into the grid: float64 [KINDS].

    It is the lower bound of the 95 % interval (Wilson), and 0 for rare classes. side: of the holes, metres.
    """
    free, count = np.zeros(KINDS), np.zeros(KINDS)
    for part, hole in _holes(grid, side, draw):
        wall = walls(Grid(part.occupied & ~hole, part.observed & ~hole, part.cell), hole)
        cut = Grid((part.occupied & ~hole) | wall, (part.observed & ~hole) | wall, part.cell)
        at = np.argwhere(hole & part.observed & ~wall)[::EVERY]
        kind = surroundings(cut, at)
        count += np.bincount(kind, minlength=KINDS)
        free += np.bincount(kind, weights=~part.occupied[at[:, 0], at[:, 1]], minlength=KINDS)
    n = np.maximum(count, 1.0)
    share, z = free / n, 1.96
    lower = (share + z * z / (2 * n) - z * np.sqrt(share * (1 - share) / n + z * z / (4 * n * n))) / (1 + z * z / n)
    lower[(count < MIN_CASES) | (np.arange(KINDS) == 0)] = 0.0
    return np.asarray(lower, np.float64)


def _holes(grid: Grid, side: float, draw: np.random.Generator) -> Iterator[tuple[Grid, Bool]]:
    """Yield positions of the grid, each with a square hole around a known cell."""
    indices = np.flatnonzero(grid.observed)
    half, margin = max(1, round(side / 2 / grid.cell)), round(SPAN_METRES / grid.cell)
    width = grid.observed.shape[1]
    for middle in draw.choice(indices, size=HOLES).tolist():
        row, column = divmod(middle, width)
        top, left = max(0, row - half - margin), max(0, column - half - margin)
        part = np.s_[top : row + half + margin, left : column + half + margin]
        hole = np.zeros(grid.observed[part].shape, bool)
        hole[max(0, row - half) - top : row + half - top, max(0, column - half) - left : column + half - left] = True
        yield Grid(grid.occupied[part], grid.observed[part], grid.cell), hole
