"""Confidence in an unknown cell from a grid's known ones: walls that continue, free cells between free cells.

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
MAX_BEND = math.radians(15.0)
"""Maximum angle of a wall to the line that continues it straight, and of an arc's ends to its chord."""

MAX_ENDS = 20_000

DRAWN_AT_ONCE = 256
"""Number of lines and arcs that are drawn at once."""

ENDS_AT_ONCE = 64
"""Number of straight ends whose pairs are compared at once: all pairs of a grid would need the most memory."""


@dataclass(frozen=True, slots=True)
class Grid:
    """Known part of a grid. occupied, known: bool [height, width]. cell: metres."""

    occupied: Bool
    observed: Bool
    cell: float


# --- walls ---


def walls(grid: Grid, target: Bool) -> Bool:
    """Return the wanted cells over which a wall continues from one known end to another, straight on or in an arc."""
    import cv2

    out = np.zeros(target.shape, np.uint8)
    edge = cv2.dilate(target.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    at = np.argwhere(grid.occupied & edge)
    if not 2 <= len(at) <= MAX_ENDS:
        return out.astype(bool)
    direction, straight = _directions(grid, at)
    seen_free = grid.observed & ~grid.occupied
    for first, second in _pairs(at, straight, SPAN_METRES / grid.cell):
        continues, bend = _continues(grid, at, direction, straight, (first, second))
        # An arc needs a gap: beside a wall, ends near its corners look bent.
        for is_arc, blocked in ((False, seen_free), (True, grid.observed)):
            chosen = continues & ((bend != 0) == is_arc)
            _draw(out, blocked, at[first[chosen]], at[second[chosen]], bend[chosen])
    return out.astype(bool) & target


def _pairs(at: Places, straight: Bool, span: float) -> Iterator[tuple[Places, Places]]:
    """Yield portions of the pairs of a straight end and another one that are at most span cells apart, as indices."""
    points = shapely.points(at[:, ::-1].astype(float))
    tree = shapely.STRtree(points)
    ends = np.flatnonzero(straight)
    for begin in range(0, len(ends), ENDS_AT_ONCE):
        some = ends[begin : begin + ENDS_AT_ONCE]
        pairs = tree.query(points[some], predicate="dwithin", distance=span)
        first, second = some[pairs[0]], pairs[1]
        chosen = (first < second) | ~straight[second] & (first != second)
        yield first[chosen], second[chosen]


def _draw(out: NDArray[np.uint8], blocked: Bool, first: Places, second: Places, bend: Array) -> None:
    """Draw lines and arcs between ends [n, 2], in place, except those that leave the grid or meet a blocked cell."""
    steps = np.abs(second - first).max(axis=1)
    for begin in range(0, len(first), DRAWN_AT_ONCE):
        some = np.flatnonzero(steps[begin : begin + DRAWN_AT_ONCE] > 1) + begin  # neighbours have nothing between them
        count = steps[some] - 1
        line = np.repeat(np.arange(len(some)), count)
        start, (down, right), turn = first[some][line], (second - first)[some][line].T, bend[some][line]
        step = np.arange(len(line)) - np.repeat(np.cumsum(count) - count, count) + 1
        share = step * (1.0 / steps[some][line])
        aside = turn * share * (1.0 - share)
        row = np.round(start[:, 0] + share * down + aside * right).astype(int)
        column = np.round(start[:, 1] + share * right - aside * down).astype(int)
        inside = (row >= 0) & (row < out.shape[0]) & (column >= 0) & (column < out.shape[1])
        meets = ~inside
        meets[inside] = blocked[row[inside], column[inside]]
        drawn = np.bincount(line, meets, len(some))[line] == 0
        out[row[drawn], column[drawn]] = 1


def _continues(
    grid: Grid, at: Places, direction: Array, straight: Bool, pairs: tuple[Places, Places]
) -> tuple[Bool, Array]:
    """Return for pairs of a straight end and another one whether a wall joins them, and the arc's angle to its chord.

    Two straight ends are joined by a line, or by an arc if they turn alike. At an end that is not straight, another
    wall may join: it is enough that a wall of the first one's direction continues there.
    """
    first, second = pairs
    across = (at[second] - at[first]).astype(np.float64)
    length = np.hypot(*across.T)
    line = across / np.maximum(length, 1e-9)[:, None]
    slack = np.sin(MAX_TURN + np.arctan(0.7 / np.maximum(length, 1.0)))
    turn = []
    for end in pairs:
        sign = np.where((direction[end] * line).sum(axis=1) < 0, -1.0, 1.0)
        turn.append(sign * (direction[end, 0] * line[:, 1] - direction[end, 1] * line[:, 0]))
    bend, skew = (turn[0] - turn[1]) / 2, (turn[0] + turn[1]) / 2
    is_line = (np.abs(turn[0]) <= slack) & (np.abs(turn[1]) <= slack)
    is_arc = (np.abs(skew) <= slack / 2) & (np.abs(bend) > slack) & (np.abs(bend) <= math.sin(MAX_BEND))
    # An arc's ends are directed as in the middle of their walls, half a radius before the gap: it bends less within.
    arc = bend * length / (length + WALL_RADIUS_METRES / grid.cell)
    both = straight[second]
    joins = ~both & (np.abs(turn[0]) <= slack)
    joins[joins] = _is_wall_end(grid, at[second[joins]], line[joins])
    return np.where(both, is_line | is_arc, joins), np.where(both & is_arc, arc, 0.0)


def _is_wall_end(grid: Grid, at: Places, line: Array) -> Bool:
    """Return whether a wall in a direction (rows, columns) begins at each position, longer than it is wide."""
    reach = max(2, round(WALL_RADIUS_METRES / 2 / grid.cell))
    ahead = at[:, None] + np.arange(1, reach + 1)[None, :, None] * line[:, None]
    middle = at + line * reach / 2
    aside = np.stack([line[:, 1], -line[:, 0]], axis=1) * (reach / 2 + 1.0)
    out = _is_occupied(grid, ahead).all(axis=1)
    for place in (middle + aside, middle - aside):
        out &= ~_is_occupied(grid, place)
    return np.asarray(out)


def _is_occupied(grid: Grid, places: Array) -> Bool:
    """Return whether the cells at places [..., 2] are occupied; those beyond the grid are not."""
    row, column = np.moveaxis(np.round(places).astype(int), -1, 0)
    height, width = grid.occupied.shape
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    return np.asarray(inside & grid.occupied[row.clip(0, height - 1), column.clip(0, width - 1)])


def _directions(grid: Grid, at: Places) -> tuple[Array, Bool]:
    """Return the direction (rows, columns) of occupied cells around each position, and whether they form a line."""
    radius = max(2, round(WALL_RADIUS_METRES / grid.cell))
    padded = np.pad(grid.occupied, radius)
    offset = np.argwhere(np.ones((2 * radius + 1, 2 * radius + 1), bool)) - radius
    offset = offset[(offset**2).sum(axis=1) <= radius * radius]
    direction, straight = np.zeros((len(at), 2)), np.zeros(len(at), bool)
    portion = max(1, 2**18 // len(offset))
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
