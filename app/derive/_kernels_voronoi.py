"""Generalised Voronoi diagram of free space, as native code.

Cells are deleted in order of their distance to obstacles, nearest first, unless that changes the pieces or holes
(Pudney, Distance-ordered homotopic thinning, CVIU 72, 1998). Anchors stay: cells between obstacles on roughly opposite
sides. The result are the ridges of the distance, and the paths of largest clearance between them.

Masks are [height, width] with a border of zeros, as in ``_kernels_thinning``.
"""

# numba has its own number types: 64-bit integers and floats, whatever mypy infers from NumPy's.
# mypy: disable-error-code="assignment,return-value,arg-type,no-any-return"

from __future__ import annotations

import numpy as np

from app.derive._kernels_space import F64, I32, I64, U8, U16, gaps
from app.derive._kernels_thinning import pieces, slim, steps
from app.native import native

_SIMPLE = np.array([pieces(code) == 1 for code in range(256)], np.uint8)
"""By neighbourhood code (``_kernels_thinning``): whether a cell can be deleted without changing pieces or holes."""

OPPOSITE = 1.6
"""Minimum ratio of the distance between two obstacles to their distance from a cell that makes them opposite.

It is 106 degrees as seen from the cell, so bisectors of right-angled corners are no anchors, and the centreline of a
corridor (180 degrees) is one.
"""


@native
def envelope(gap: U16, y: int, at: I64, until: F64, far: I64, column: I64) -> None:
    """Compute for each cell of a row the squared distance to the nearest obstacle, and that obstacle's column.

    Lower envelope of the row's parabolas (Felzenszwalb and Huttenlocher, Distance transforms of sampled functions,
    2012). Rows begin and end with an obstacle, so the distance is less than half the width. at, until: work arrays of
    the row's width, and one more.
    """
    width = gap.shape[1]
    n = 0
    at[0] = 0
    until[0], until[1] = -np.inf, np.inf
    for x in range(1, width):
        f = np.int64(gap[y, x]) * np.int64(gap[y, x]) + np.int64(x) * x
        while True:
            v = at[n]
            g = np.int64(gap[y, v]) * np.int64(gap[y, v]) + v * v
            s = (f - g) / (2.0 * (x - v))
            if s > until[n]:
                break
            n -= 1
        n += 1
        at[n] = x
        until[n], until[n + 1] = s, np.inf
    k = 0
    for x in range(width):
        while until[k + 1] < x:
            k += 1
        v = at[k]
        g = np.int64(gap[y, v])
        far[x] = g * g + (x - v) * (x - v)
        column[x] = v


@native
def farthest(mask: U8, gap: U16) -> int:
    """Return the largest squared distance of the mask's cells to their nearest obstacle."""
    height, width = gap.shape
    at, until = np.empty(width, np.int64), np.empty(width + 1, np.float64)
    far, column = np.empty(width, np.int64), np.empty(width, np.int64)
    maximum = np.int64(0)
    for y in range(height):
        envelope(gap, y, at, until, far, column)
        for x in range(width):
            if mask[y, x] and far[x] > maximum:
                maximum = far[x]
    return maximum


@native
def _row(gap: U16, y: int, x: int) -> int:
    """Return the row of the obstacle nearest to (y, x) in its column."""
    g = np.int64(gap[y, x])
    return y - g if y >= g and gap[y - g, x] == 0 else y + g


@native
def anchors(mask: U8, gap: U16, scale: float, rank: U16) -> int:
    """Set bit 1 of the mask's cells that lie between obstacles on opposite sides; return their number.

    rank: output, the distance of each cell to its nearest obstacle times ``scale``. Only two rows of distances are
    kept.
    """
    height, width = mask.shape
    at, until = np.empty(width, np.int64), np.empty(width + 1, np.float64)
    far, column = np.empty((2, width), np.int64), np.empty((2, width), np.int64)
    factor = np.float32(scale)
    rank[0] = 0
    rank[height - 1] = 0
    envelope(gap, 1, at, until, far[1], column[1])
    count = 0
    for y in range(1, height - 1):
        current, below = y % 2, (y + 1) % 2
        envelope(gap, y + 1, at, until, far[below], column[below])
        for x in range(width):
            rank[y, x] = np.uint16(np.sqrt(np.float32(far[current, x])) * factor)
        for x in range(1, width - 1):
            if mask[y, x] == 0:
                continue
            ax = column[current, x]
            ay = np.int64(_row(gap, y, ax))
            # centre of an odd number of cells: equal distance to both sides
            g = np.int64(np.sqrt(far[current, x]))
            if g * g == far[current, x] and (
                (y >= g and y + g < height and gap[y - g, x] == 0 and gap[y + g, x] == 0)
                or (x >= g and x + g < width and gap[y, x - g] == 0 and gap[y, x + g] == 0)
            ):
                count += 1 if mask[y, x] & 2 == 0 else 0
                mask[y, x] |= 2
            for d in range(2):
                v, u = y + d, x + 1 - d
                if mask[v, u] == 0:
                    continue
                other = below if d else current
                bx = column[other, u]
                by = np.int64(_row(gap, v, bx))
                apart = np.sqrt((ax - bx) * (ax - bx) + (ay - by) * (ay - by))
                # neighbours may see obstacles up to one cell farther apart, because their positions differ
                if apart - 1.0 >= OPPOSITE * (np.sqrt(far[current, x]) + np.sqrt(far[other, u])) / 2.0:
                    if far[other, u] > far[current, x]:
                        count += 1 if mask[v, u] & 2 == 0 else 0
                        mask[v, u] |= 2
                    else:
                        count += 1 if mask[y, x] & 2 == 0 else 0
                        mask[y, x] |= 2
    return count


@native
def count_ranks(mask: U8, rank: U16, out: I64) -> None:
    """Count the mask's cells of each rank ([65536])."""
    height, width = mask.shape
    for y in range(height):
        for x in range(width):
            if mask[y, x]:
                out[rank[y, x]] += 1


@native
def sort_band(mask: U8, rank: U16, low: int, high: int, place: I64, out: I32) -> None:
    """List the mask's cells with ranks from ``low`` up to but excluding ``high``, by rank, row and column, as flat
    indices.

    place: start of each rank's cells in ``out``, [high - low]; it is advanced.
    """
    height, width = mask.shape
    for y in range(height):
        for x in range(width):
            r = np.int64(rank[y, x])
            if mask[y, x] and low <= r and r < high:
                out[place[r - low]] = y * width + x
                place[r - low] += 1


@native
def thin(mask: U8, order: I32, rank: U16) -> None:
    """Delete cells of a mask in this order (flat indices, nearest to obstacles first), except anchors (bit 1)."""
    flat, key = mask.ravel(), rank.ravel()
    step = steps(mask.shape[1])
    stack = np.empty(1024, np.int64)
    for i in range(len(order)):
        size = 1
        stack[0] = order[i]
        now = key[order[i]]
        while size > 0:
            size -= 1
            cell = stack[size]
            if flat[cell] != 1:  # already deleted, or an anchor
                continue
            code = 0
            for k in range(8):
                code |= (flat[cell + step[k]] & 1) << k
            if _SIMPLE[code] == 0:
                continue
            flat[cell] = 0
            if size + 8 > len(stack):
                larger = np.empty(2 * len(stack), np.int64)
                larger[:size] = stack[:size]
                stack = larger
            for k in range(8):
                other = cell + step[k]
                # cells of a higher rank are checked later
                if flat[other] == 1 and key[other] <= now:
                    stack[size] = other
                    size += 1


@native
def finish(mask: U8, order: I32) -> int:
    """Thin the remaining cells to one cell wide, of zeros and ones; return their number.

    Anchors may be two cells wide: those that are no ends are deleted. order: remaining cells, as for ``thin``;
    overwritten.
    """
    flat = mask.ravel()
    for i in range(len(order)):
        flat[order[i]] = 1
    return slim(flat, steps(mask.shape[1]), order, len(order))


def compile_all() -> None:
    """Compile all kernels: call each one once on a tiny grid."""
    free = np.zeros((7, 9), np.uint8)
    free[1:-1, 1:-1] = 1
    gap = np.zeros(free.shape, np.uint16)
    gaps(free, gap)
    rank = np.empty(free.shape, np.uint16)
    farthest(free, gap)
    anchors(free, gap, 1.0, rank)
    counts = np.zeros(65536, np.int64)
    count_ranks(free, rank, counts)
    order = np.empty(int(counts.sum()), np.int32)
    sort_band(free, rank, 0, 65536, np.cumsum(counts) - counts, order)
    thin(free, order, rank)
    finish(free, np.flatnonzero(free).astype(np.int32))
