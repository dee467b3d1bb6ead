"""Free space for a round robot, as native code: distances to obstacles, erosion, and straight lines through cells.

Grids are [height, width] with a border of one obstacle cell all around. Distances are between cell centres, in cells,
as in Nav2's inflation; their squares are integers, so all of this is exact. A distance is stored as the ``gap`` of each
cell, the distance to the nearest obstacle in its column (two bytes per cell): the distance in the plane follows from a
few gaps of its row, so no array of floats is needed.
"""

# numba has its own number types: 64-bit integers and floats, whatever mypy infers from NumPy's.
# mypy: disable-error-code="assignment,return-value,arg-type,no-any-return"

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from app.native import native

U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
F64 = NDArray[np.float64]

MAX_GAP = 65535
"""Largest gap that can be stored."""


@native
def gaps(free: U8, out: U16) -> None:
    """Compute the distance of each cell to the nearest obstacle in its column."""
    height, width = free.shape
    for x in range(width):
        out[0, x] = 0
    for y in range(1, height):
        for x in range(width):
            above = np.int32(out[y - 1, x]) + 1
            out[y, x] = min(above, 65535) if free[y, x] else 0
    for y in range(height - 2, -1, -1):
        for x in range(width):
            below = np.int32(out[y + 1, x]) + 1
            out[y, x] = min(out[y, x], below)


@native
def erode(gap: U16, radius2: float, out: U8) -> int:
    """Set 1 if the squared distance to every obstacle is above ``radius2``, else 0; return the number of ones."""
    height, width = gap.shape
    reach = np.int64(np.floor(np.sqrt(radius2)))
    half = np.empty(reach + 1, np.int64)
    for g in range(reach + 1):
        half[g] = np.int64(np.floor(np.sqrt(radius2 - g * g)))
    count = 0
    for y in range(height):
        until = np.int64(-1)
        for x in range(width):
            g = gap[y, x]
            if g <= reach and x + half[g] > until:
                until = x + half[g]
            out[y, x] = 1 if x > until else 0
        until = np.int64(width)
        for x in range(width - 1, -1, -1):
            g = gap[y, x]
            if g <= reach and x - half[g] < until:
                until = x - half[g]
            if x >= until:
                out[y, x] = 0
            count += out[y, x]
    return count


@native
def distance2(gap: U16, y: int, x: int) -> int:
    """Return the squared distance of one cell to the nearest obstacle."""
    best = np.int64(gap[y, x]) * np.int64(gap[y, x])
    k = 1
    while k * k < best:
        left = np.int64(gap[y, x - k])
        right = np.int64(gap[y, x + k])
        nearer = min(left, right)
        best = min(best, k * k + nearer * nearer)
        k += 1
    return best


@native
def clear(mask: U8, y0: int, x0: int, y1: int, x1: int) -> bool:
    """Return whether all cells that the straight line between two cell centres touches are in the mask."""
    dx, dy = abs(x1 - x0), abs(y1 - y0)
    sx, sy = (1 if x1 > x0 else -1), (1 if y1 > y0 else -1)
    x, y, i, j = x0, y0, 0, 0
    while True:
        if mask[y, x] == 0:
            return False
        if i == dx and j == dy:
            return True
        side = (1 + 2 * i) * dy - (1 + 2 * j) * dx
        if side == 0 and (mask[y, x + sx] == 0 or mask[y + sy, x] == 0):
            return False
        if side <= 0:
            x += sx
            i += 1
        if side >= 0:
            y += sy
            j += 1


@native
def narrowest(gap: U16, y0: int, x0: int, y1: int, x1: int) -> int:
    """Return the smallest squared distance to an obstacle of the cells that a straight line touches.

    Between two cells the distance changes at most by how far they are apart, so most cells far from obstacles are
    skipped.
    """
    dx, dy = abs(x1 - x0), abs(y1 - y0)
    sx, sy = (1 if x1 > x0 else -1), (1 if y1 > y0 else -1)
    x, y, i, j = x0, y0, 0, 0
    best = distance2(gap, y, x)
    slack = 0.0  # distance that a cell must have from the current one to be nearer to an obstacle than the minimum
    while not (i == dx and j == dy):
        side = (1 + 2 * i) * dy - (1 + 2 * j) * dx
        if side == 0 and slack < 1.5:
            best = min(best, distance2(gap, y, x + sx), distance2(gap, y + sy, x))
        if side <= 0:
            x += sx
            i += 1
        if side >= 0:
            y += sy
            j += 1
        slack -= 1.5  # larger than a step to a diagonal neighbour
        if slack < 0.0:
            current = distance2(gap, y, x)
            best = min(best, current)
            slack = np.sqrt(current) - np.sqrt(best)
    return best


@native
def widths(gap: U16, cells: I64, pairs: I64, out: F64) -> None:
    """Compute the free width along the line of each pair (indices into ``cells``, [n, 2] row and column), in cells.

    A corridor of n free cells has width n if n is odd, else n - 1.
    """
    for k in range(len(pairs)):
        a, b = pairs[k, 0], pairs[k, 1]
        nearest = narrowest(gap, cells[a, 0], cells[a, 1], cells[b, 0], cells[b, 1])
        out[k] = max(0.0, 2.0 * np.sqrt(nearest) - 1.0)


@native
def clearances(gap: U16, cells: I64, out: F64) -> None:
    """Compute the distance of each cell ([n, 2] row and column) to the nearest obstacle."""
    for k in range(len(cells)):
        out[k] = np.sqrt(distance2(gap, cells[k, 0], cells[k, 1]))


@native
def clear_pairs(mask: U8, cells: I64, pairs: I64, out: U8) -> None:
    """Compute for each pair (indices into ``cells``) whether its straight line stays within the mask."""
    for k in range(len(pairs)):
        a, b = pairs[k, 0], pairs[k, 1]
        out[k] = clear(mask, cells[a, 0], cells[a, 1], cells[b, 0], cells[b, 1])


def compile_all() -> None:
    """Compile all kernels: call each one once on a tiny grid."""
    free = np.zeros((5, 5), np.uint8)
    free[1:-1, 1:-1] = 1
    gap, mask = np.zeros((5, 5), np.uint16), np.zeros((5, 5), np.uint8)
    gaps(free, gap)
    erode(gap, 0.0, mask)
    cells, pairs = np.array([[1, 1], [3, 3]], np.int64), np.array([[0, 1]], np.int64)
    widths(gap, cells, pairs, np.zeros(1))
    clearances(gap, cells, np.zeros(2))
    clear_pairs(mask, cells, pairs, np.zeros(1, np.uint8))
