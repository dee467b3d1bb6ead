"""Cellular automata on arrays, and connection of the free space that they leave.

Arrays are bool [rows, columns]; alive, or occupied, is True.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

Bool = NDArray[np.bool_]
I64 = NDArray[np.int64]

STRIP = 2**18
"""Number of cells that are processed at a time, so that they stay in the processor's cache."""

MAX_ROUNDS = 6


def run_automaton(
    alive: Bool, born: Collection[int], stays: Collection[int], iterations: int, *, outside: bool
) -> Bool:
    """Run a cellular automaton for a number of steps; ends early if nothing changes.

    born, stays: numbers of living neighbours (of eight) with which a dead cell is born, and a living one survives.
    outside: whether cells beyond the border are alive.
    """
    height, width = alive.shape
    table = np.zeros(32, np.uint8)  # by the neighbours and itself, times two, and itself
    for n in range(9):
        table[2 * n] = n in born
        table[2 * (n + 1) + 1] = n in stays
    now = np.pad(alive.astype(np.uint8), 1, constant_values=np.uint8(outside))
    after = now.copy()
    rows = max(1, STRIP // width)
    for _ in range(iterations):
        for y in range(0, height, rows):
            end = min(y + rows, height)
            part = now[y : end + 2]
            three = part[:-2] + part[1:-1]
            three += part[2:]
            nine = three[:, :-2] + three[:, 1:-1]
            nine += three[:, 2:]
            nine <<= 1
            nine |= part[1:-1, 1:-1]
            np.take(table, nine, out=after[y + 1 : end + 1, 1:-1], mode="clip")
        if np.array_equal(now, after):
            break
        now, after = after, now
    return now[1:-1, 1:-1].astype(bool)


def join_free_space(occupied: Bool, rim: Bool, radius: float, passage: float, smallest: float) -> tuple[Bool, int, int]:
    """Connect free space to one piece: return (occupied cells, number of filled cells, number of passages cut).

    rim: cells that stay occupied. radius: of a robot, in cells: places that it fits into are joined by passages (cells
    wide) if they have at least ``smallest`` cells for its centre. Everything not joined to the largest place is filled.
    """
    import cv2

    out = occupied.copy()
    passages = 0
    width = max(round(passage), 2 * int(np.ceil(radius)) + 1)
    for _ in range(MAX_ROUNDS):
        label, sizes = _places(out, radius)
        large = np.flatnonzero(sizes >= max(smallest, 1.0))
        if len(large) <= 1:
            break
        keep = np.zeros(len(sizes), bool)
        keep[large] = True
        cut = np.zeros(out.shape, np.uint8)
        for a, b in _shortest_path(np.where(keep[label], label, 0)):
            cv2.line(cut, (a[1], a[0]), (b[1], b[0]), 1, thickness=width, lineType=cv2.LINE_4)
            cv2.line(cut, (a[1], a[0]), (b[1], b[0]), 1, lineType=cv2.LINE_4)
            passages += 1
        before = out
        out = out & ~((cut > 0) & ~rim)
        if np.array_equal(before, out):
            break
    # the robot's largest place and all free cells around it stay; the rest is filled
    label, sizes = _places(out, radius)
    if not sizes.any():
        label, sizes = _places(out, 0.0)
    if not sizes.any():
        return np.ones_like(out), int(np.count_nonzero(~out)), passages
    main = label == int(np.argmax(sizes))
    _, free = cv2.connectedComponents((~out).astype(np.uint8), connectivity=4)
    remaining = np.asarray(free) == int(np.asarray(free)[main][0])
    filled = int(np.count_nonzero(~out & ~remaining))
    return ~remaining, filled, passages


def _places(occupied: Bool, radius: float) -> tuple[NDArray[np.int32], I64]:
    """Label the pieces of cells for a robot's centre, numbered from 1; also return each size (0 for the rest)."""
    import cv2

    free = (~occupied).astype(np.uint8)
    if radius > 0.0:
        away = cv2.distanceTransform(np.pad(free, 1), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
        # to the border of the next obstacle, which is half a cell nearer than its centre
        free = (np.asarray(away) - 0.5 > radius).astype(np.uint8)
    count, label = cv2.connectedComponents(free, connectivity=4)
    sizes = np.bincount(np.asarray(label).ravel(), minlength=count).astype(np.int64)
    sizes[0] = 0
    return np.asarray(label), sizes


def _shortest_path(label: NDArray[np.int32]) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Return lines (row, column to row, column) that join all labelled pieces, the shortest first (Kruskal).

    They connect the nearest cells of pieces whose surroundings touch.
    """
    from scipy import ndimage

    near = ndimage.distance_transform_edt(label == 0, return_distances=False, return_indices=True)
    owner = label[near[0], near[1]]
    blocks = []
    for axis in (0, 1):
        a, b = (np.s_[:-1], np.s_[1:]) if axis == 0 else (np.s_[:, :-1], np.s_[:, 1:])
        differ = owner[a] != owner[b]
        blocks.append(
            np.stack(
                [owner[a][differ], owner[b][differ], *(near[k][s][differ] for s in (a, b) for k in (0, 1))], axis=1
            ).astype(np.int64)
        )
    rows = np.concatenate(blocks)
    swap = rows[:, 0] > rows[:, 1]
    rows[swap] = rows[swap][:, [1, 0, 4, 5, 2, 3]]
    length = (rows[:, 2] - rows[:, 4]) ** 2 + (rows[:, 3] - rows[:, 5]) ** 2
    rows = rows[np.lexsort((*rows.T[::-1], length))]
    parent = np.arange(int(label.max()) + 1)

    def root(i: int) -> int:
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = int(parent[i])
        return i

    out = []
    _, first = np.unique(rows[:, 0] * len(parent) + rows[:, 1], return_index=True)
    for p, q, y0, x0, y1, x1 in rows[np.sort(first)].tolist():
        a_, b_ = root(p), root(q)
        if a_ != b_:
            parent[a_] = b_
            out.append(((y0, x0), (y1, x1)))
    return out
