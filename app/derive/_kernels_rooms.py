"""Basins of a distance map, as native code: cells are flooded from the widest places down."""

# numba has its own number types: 64-bit integers and floats, whatever mypy infers from NumPy's.
# mypy: disable-error-code="assignment,return-value,arg-type,no-any-return"

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from app.derive._kernels_space import F64, I32, I64
from app.native import native

F32 = NDArray[np.float32]


@native
def root(parent: I32, basin: int) -> int:
    """Return the representative of a basin, and shorten the path to it."""
    while parent[basin] != basin:
        parent[basin] = parent[parent[basin]]
        basin = parent[basin]
    return basin


@native
def flood(distance: F32, order: I64, door: float, ratios: F64, least: float, label: I32, peak: F64) -> int:
    """Label basins of a distance map by flooding cells in order of falling distance; return the number of labels.

    Two basins that meet become one unless the saddle between them is a neck: less than a ratio of the smaller basin's
    largest distance, which is at least ``least``. ratios: the one of saddles up to ``door`` from obstacles, and of
    wider ones. label: int32 [h, w], zeros; receives labels from 1, those of joined basins equal. peak: work array, one
    more than there may be basins. The border of the map must not be in ``order``.
    """
    height, width = distance.shape
    parent = np.zeros(len(peak), np.int32)
    count = 0
    near = np.empty(8, np.int32)
    for cell in order:
        y, x = cell // width, cell % width
        depth = distance[y, x]
        met = 0
        best = 0
        highest = np.float32(-1.0)
        for dy in range(-1, 2):
            for dx in range(-1, 2):
                other = label[y + dy, x + dx]
                if other == 0:
                    continue
                basin = root(parent, other)
                if distance[y + dy, x + dx] > highest:
                    highest, best = distance[y + dy, x + dx], basin
                is_listed = False
                for k in range(met):
                    is_listed = is_listed or near[k] == basin
                if not is_listed:
                    near[met] = basin
                    met += 1
        if met == 0:
            count += 1
            parent[count] = count
            peak[count] = depth
            label[y, x] = count
            continue
        label[y, x] = best
        for k in range(met):
            for j in range(k):
                a, b = root(parent, near[j]), root(parent, near[k])
                if a == b:
                    continue
                smaller = min(peak[a], peak[b])
                if depth < (ratios[0] if depth <= door else ratios[1]) * smaller and smaller >= least:
                    continue
                keep, drop = (a, b) if peak[a] >= peak[b] else (b, a)
                parent[drop] = keep
    number = np.zeros(count + 1, np.int32)
    used = 0
    for y in range(height):
        for x in range(width):
            if label[y, x]:
                basin = root(parent, label[y, x])
                if number[basin] == 0:
                    used += 1
                    number[basin] = used
                label[y, x] = number[basin]
    return used


def compile_all() -> None:
    """Compile all kernels: call each one once on a tiny grid."""
    distance = np.zeros((3, 3), np.float32)
    distance[1, 1] = 1.0
    flood(distance, np.array([4]), 1.0, np.ones(2), 1.0, np.zeros((3, 3), np.int32), np.zeros(3))
