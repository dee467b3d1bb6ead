"""Thinning of a mask, as native code.

Algorithm of Zhang and Suen (A fast parallel algorithm for thinning digital patterns, CACM 27, 1984), but each round
checks only cells whose neighbourhood has changed: the result is equal, cell by cell, at a fraction of the work. A block
of 2 × 2 cells, which their rules delete completely, keeps one cell, so that the skeleton has as many pieces and holes
as the mask (pieces: 8-connected).

Masks are [height, width] with a border of zeros.
"""

# numba has its own number types: 64-bit integers and floats, whatever mypy infers from NumPy's.
# mypy: disable-error-code="assignment,return-value,arg-type,no-any-return"

from __future__ import annotations

import numpy as np

from app.derive._kernels_space import I32, I64, U8
from app.native import native

DY = np.array([-1, -1, 0, 1, 1, 1, 0, -1], np.int64)
DX = np.array([0, 1, 1, 1, 0, -1, -1, -1], np.int64)
"""The eight neighbours, clockwise from the row above: bit k of a neighbourhood's code is neighbour k."""


def pieces(code: int) -> int:
    """Compute Yokoi's number: the number of 8-connected pieces of a neighbourhood without its centre."""
    q = [1 - (code >> k & 1) for k in range(8)]
    return sum(q[k] - q[k] * q[(k + 1) % 8] * q[(k + 2) % 8] for k in (0, 2, 4, 6))


def _tables() -> tuple[U8, U8]:
    """Build tables by neighbourhood code: bits 1 and 2 if the first or second pass deletes the cell; whether it is
    redundant."""
    passes, redundant = np.zeros(256, np.uint8), np.zeros(256, np.uint8)
    for code in range(256):
        p = [code >> k & 1 for k in range(8)]
        north, east, south, west = p[0], p[2], p[4], p[6]
        rises = sum(p[k] == 0 and p[(k + 1) % 8] == 1 for k in range(8))
        if 2 <= sum(p) <= 6 and rises == 1:
            if not (north and east and south) and not (east and south and west):
                passes[code] |= 1
            if not (north and east and west) and not (north and south and west):
                passes[code] |= 2
        redundant[code] = sum(p) >= 2 and pieces(code) == 1  # an end (one neighbour) stays
    return passes, redundant


_PASSES, _REDUNDANT = _tables()
_BLOCK = 4 | 8 | 16
"""Neighbourhood of the upper left cell of a 2 × 2 block: east, south-east and south."""


@native
def steps(width: int) -> I64:
    """Return the offsets from a cell to its eight neighbours, in a flat mask of this width."""
    out = np.empty(8, np.int64)
    for k in range(8):
        out[k] = DY[k] * width + DX[k]
    return out


@native
def slim(flat: U8, step: I64, cells: I32, count: int) -> int:
    """Delete redundant cells until none is left; return the number of remaining cells.

    flat: zeros and ones. step: offsets to the neighbours. cells: its first ``count`` elements are checked, and the
    remaining ones are moved to its beginning.
    """
    again = True
    while again:
        again = False
        n = 0
        for i in range(count):
            cell = cells[i]
            code = 0
            for k in range(8):
                code |= flat[cell + step[k]] << k
            if _REDUNDANT[code]:
                flat[cell] = 0
                again = True
            else:
                cells[n] = cell
                n += 1
        count = n
    return count


@native
def _lone_block(mask: U8, y: int, x: int) -> bool:
    """Return whether the 2 × 2 cells from (y, x) on have no neighbours (those of (y, x) itself are already checked)."""
    height, width = mask.shape
    for j in range(-1, 3):
        for i in range(-1, 3):
            inside = 0 <= j <= 1 and 0 <= i <= 1
            v, u = y + j, x + i
            if not inside and v < height and u < width and mask[v, u] & 1:
                return False
    return True


@native
def _count_cells(mask: U8) -> tuple[int, int]:
    """Count the cells of a mask, and those at its edge."""
    count = edge = 0
    for y in range(1, mask.shape[0] - 1):
        for x in range(1, mask.shape[1] - 1):
            if mask[y, x]:
                count += 1
                if not (mask[y - 1, x] and mask[y + 1, x] and mask[y, x - 1] and mask[y, x + 1]):
                    edge += 1
    return count, edge


@native
def _list_edge(mask: U8, first: I32, second: I32) -> int:
    """Set bits 2 and 4 of the cells at the edge (pending in both passes), list them for each pass, return their number.

    Cells whose only missing neighbours are diagonal cannot be deleted yet: they have seven.
    """
    n = 0
    width = mask.shape[1]
    for y in range(1, mask.shape[0] - 1):
        for x in range(1, width - 1):
            if mask[y, x] and not (mask[y - 1, x] and mask[y + 1, x] and mask[y, x - 1] and mask[y, x + 1]):
                first[n] = second[n] = y * width + x
                n += 1
                mask[y, x] |= 6
    return n


@native
def _delete(mask: U8, step: I64, cells: I32, count: int, bit: int, removed: I32) -> int:
    """Delete the cells among the first ``count`` that this bit's pass deletes, list them, and return their number.

    All are checked before the first is deleted.
    """
    width = mask.shape[1]
    flat = mask.ravel()
    deleted = 0
    keep = 255 - 2 * bit
    for i in range(count):
        cell = cells[i]
        flat[cell] &= keep
        if flat[cell] & 1 == 0:
            continue
        code = 0
        for k in range(8):
            code |= (flat[cell + step[k]] & 1) << k
        if _PASSES[code] & bit and not (code == _BLOCK and _lone_block(mask, cell // width, cell % width)):
            removed[deleted] = cell
            deleted += 1
    for i in range(deleted):
        flat[removed[i]] &= 6
    return deleted


@native
def thin(mask: U8) -> int:
    """Thin a mask of zeros and ones in place, to lines one cell wide; return the number of remaining cells."""
    flat = mask.ravel()
    count, edge = _count_cells(mask)
    size = max(1024, edge * 2)
    first, second = np.empty(size, np.int32), np.empty(size, np.int32)
    removed = np.empty(size, np.int32)
    n1 = n2 = _list_edge(mask, first, second)
    step = steps(mask.shape[1])
    bit = 1
    while n1 > 0 or n2 > 0:
        deleted = _delete(mask, step, first, n1, bit, removed)
        n1 = 0
        count -= deleted
        need = max(n2, 0) + 8 * deleted
        if need > len(second):
            second = _grow(second, n2, need)
        if 8 * deleted > len(first):
            first = _grow(first, 0, 8 * deleted)
        for i in range(deleted):
            cell = removed[i]
            for k in range(8):
                other = cell + step[k]
                value = flat[other]
                if value & 1:
                    if value & (2 * bit) == 0:
                        first[n1] = other
                        n1 += 1
                    if value & (6 - 2 * bit) == 0:
                        second[n2] = other
                        n2 += 1
                    flat[other] = 7
        first, second = second, first
        n1, n2 = n2, n1
        if n1 > len(removed):
            removed = np.empty(len(first), np.int32)
        bit = 3 - bit
    corners = np.empty(count, np.int32)
    n = 0
    for cell in range(len(flat)):
        if flat[cell]:
            flat[cell] = 1
            corners[n] = cell
            n += 1
    return slim(flat, step, corners, count)


@native
def _grow(array: I32, used: int, need: int) -> I32:
    out = np.empty(max(need, 2 * len(array)), np.int32)
    out[:used] = array[:used]
    return out


def compile_all() -> None:
    """Compile all kernels: call each one once on a tiny grid."""
    mask = np.zeros((7, 9), np.uint8)
    mask[1:-1, 1:-1] = 1
    thin(mask)
