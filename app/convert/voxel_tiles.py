"""Voxel maps as rasters: columns of a slice of heights, for tiles of any reduction."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from app.errors import Invalid
from app.model.grid import FREE, OCCUPIED, UNKNOWN
from app.model.voxels import HALF, VoxelMap

GROUP = 2048
"""Number of leaves that are skipped together: neighbours in the octree, with one bounding box."""

Span = tuple[int, int]
"""Heights of a slice in smallest voxels from the local origin, [first, end)."""


class Columns:
    """Leaves of a voxel map, by position; thread-safe.

    Attributes:
        low, high: int32 [3, n], first and end (exclusive) smallest voxel of each leaf along x, y and z.
        left, top: voxels of the raster's first column, and of its upper edge.
        width, height: of the raster in smallest voxels.
        heights: the range of all leaves.
        resolution: metres of a smallest voxel.
    """

    def __init__(self, voxels: VoxelMap) -> None:
        sides = [voxels.axis(k) for k in range(3)]
        self.low = np.stack([low for low, _ in sides]).astype(np.int32)
        self.high = np.stack([high for _, high in sides]).astype(np.int32)
        self._occupied = voxels.occupied
        self.resolution = voxels.resolution
        first, end = self.low.min(axis=1), self.high.max(axis=1)
        self.left, self.top = int(first[0]), int(end[1])
        self.width, self.height = int(end[0] - first[0]), int(end[1] - first[1])
        self.heights: Span = (int(first[2]), int(end[2]))
        starts = np.arange(0, self.low.shape[1], GROUP)
        self._group_low = np.minimum.reduceat(self.low, starts, axis=1)
        self._group_high = np.maximum.reduceat(self.high, starts, axis=1)

    @property
    def size_bytes(self) -> int:
        """Return the memory that the leaves take."""
        return self.low.nbytes + self.high.nbytes + self._occupied.nbytes

    def tile(self, k: int, row: int, column: int, side: int, heights: Span) -> NDArray[np.uint8]:
        """Return a square of cells at a reduction, row 0 on top: occupied, else free, else unknown.

        row, column: its first cell, counted in cells of the reduction from the upper left corner of the raster.
        """
        x0, y1 = self.left + (column << k), self.top - (row << k)
        low, high = (x0, y1 - (side << k), heights[0]), (x0 + (side << k), y1, heights[1])
        chosen = self._find(low, high)
        left = np.maximum((self.low[0, chosen] - x0) >> k, 0)
        right = np.minimum(((self.high[0, chosen] - x0 - 1) >> k) + 1, side)
        above = np.maximum((y1 - self.high[1, chosen]) >> k, 0)
        below = np.minimum(((y1 - self.low[1, chosen] - 1) >> k) + 1, side)
        occupied = self._occupied[chosen]
        out = np.full((side, side), UNKNOWN, np.uint8)
        for value, mask in ((FREE, ~occupied), (OCCUPIED, occupied)):
            out[_covered(left[mask], right[mask], above[mask], below[mask], side)] = value
        return out

    def _find(self, low: tuple[int, int, int], high: tuple[int, int, int]) -> NDArray[np.intp]:
        """Find the leaves that intersect a box of voxels."""
        groups = np.flatnonzero(_meet(self._group_low, self._group_high, low, high))
        index = (groups[:, None] * GROUP + np.arange(GROUP)).ravel()
        index = index[index < self.low.shape[1]]
        if len(index) == self.low.shape[1]:
            return np.flatnonzero(_meet(self.low, self.high, low, high))
        chosen: NDArray[np.intp] = index[_meet(self.low[:, index], self.high[:, index], low, high)]
        return chosen


def _meet(
    starts: NDArray[np.int32], ends: NDArray[np.int32], low: tuple[int, int, int], high: tuple[int, int, int]
) -> NDArray[np.bool_]:
    out = np.ones(starts.shape[1], bool)
    for k in range(3):
        out &= (starts[k] < high[k]) & (ends[k] > low[k])
    return out


def _covered(
    left: NDArray[np.int32], right: NDArray[np.int32], above: NDArray[np.int32], below: NDArray[np.int32], side: int
) -> NDArray[np.bool_]:
    """Return the cells [side, side] that any rectangle [above, below) × [left, right) covers: by sums of corners."""
    single = (right - left == 1) & (below - above == 1)
    out = np.zeros((side, side), bool)
    out[above[single], left[single]] = True
    left, right, above, below = (edge[~single] for edge in (left, right, above, below))
    if len(left):
        stride = side + 1
        depth = np.zeros(stride * stride, np.int64)
        for rows, columns, sign in ((above, left, 1), (above, right, -1), (below, left, -1), (below, right, 1)):
            depth += sign * np.bincount(rows.astype(np.int64) * stride + columns, minlength=stride * stride)
        sums = depth.reshape(stride, stride).cumsum(axis=0).cumsum(axis=1)
        out |= sums[:side, :side] > 0
    return out


def slice_heights(columns: Columns, z_min: float | None, z_max: float | None) -> Span:
    """Convert heights in metres to smallest voxels that intersect them, at least one. Raises Invalid."""
    if z_min is not None and z_max is not None and z_min > z_max:
        raise Invalid(f"z_min {z_min:g} is above z_max {z_max:g}: swap them")
    first, end = columns.heights
    low = first if z_min is None else max(first, math.floor(_voxel(z_min, columns.resolution)))
    high = end if z_max is None else min(end, math.ceil(_voxel(z_max, columns.resolution)))
    if z_min is not None and z_min == z_max:
        high = min(end, low + 1)
    return (low, max(low, high))


def _voxel(metres: float, resolution: float) -> float:
    """Convert metres to smallest voxels; a whole number of them stays one in spite of rounding (0.3 / 0.1)."""
    value = min(max(metres / resolution, -HALF - 1.0), HALF + 1.0)
    return float(round(value)) if abs(value - round(value)) < 1e-6 else value
