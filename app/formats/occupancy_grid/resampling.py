"""Resampling of grids to another cell size, or to an origin without yaw."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from app.errors import Invalid, Problem
from app.limits import Limits
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.syntax import images

_RANK = np.concatenate([[0], np.arange(2, OCCUPIED + 2), np.zeros(UNKNOWN - OCCUPIED - 1), [1]]).astype(np.uint8)
_OF_RANK = np.concatenate([[FREE, UNKNOWN], np.arange(1, OCCUPIED + 1), np.zeros(256 - OCCUPIED - 2)]).astype(np.uint8)
"""Order in which cells are merged: free < unknown < any value above free."""


def resample(grid: OccupancyGrid, resolution: float) -> OccupancyGrid:
    """Resample a grid to another cell size, with the same corner.

    A coarser cell has the highest value that it covers, with unknown just above free: no obstacle disappears, no
    unknown cell becomes free. A finer cell has the value of the cell at its centre. Raises Invalid if too many cells.
    """
    ratio = resolution / grid.resolution
    shape = [max(1, math.ceil(n / ratio - 1e-6)) for n in grid.cells.shape]
    _check_count(shape[0] * shape[1], "resolution")
    if ratio < 1.0:
        rows, columns = (
            np.minimum(((np.arange(n) + 0.5) * ratio).astype(np.intp), last - 1)
            for n, last in zip(shape, grid.cells.shape, strict=True)
        )
        return replace(grid, cells=grid.cells.take(rows, 0).take(columns, 1), resolution=resolution)
    ranks = images.apply_table(grid.cells, _RANK.tobytes())
    for axis in (0, 1):
        n, old = shape[axis], ranks.shape[axis]
        edges = np.arange(n + 1) * ratio
        starts = np.minimum(np.floor(edges[:-1] + 1e-6).astype(np.intp), old - 1)
        ends = np.clip(np.ceil(edges[1:] - 1e-6).astype(np.intp), starts + 1, old)
        # New cells may share an old row, so no single reduceat: take the maximum row by row.
        out = np.take(ranks, starts, axis)
        for step in range(1, int((ends - starts).max())):
            np.maximum(out, np.take(ranks, np.minimum(starts + step, ends - 1), axis), out=out)
        ranks = out
    return replace(grid, cells=images.apply_table(ranks, _OF_RANK.tobytes()), resolution=resolution)


def normalize(grid: OccupancyGrid) -> OccupancyGrid:
    """Resample a grid to yaw 0 and an origin at a multiple of the resolution; unknown outside.

    A cell has the value of the old cell at its centre, or of an occupied one whose centre it contains, whichever is
    higher: no obstacle disappears. Raises Invalid if too many cells.
    """
    size, (x, y, yaw) = grid.resolution, grid.origin
    steps = [v / size for v in (x, y)]
    if yaw == 0.0 and all(abs(s - round(s)) < 1e-6 for s in steps):
        return replace(grid, origin=(round(round(steps[0]) * size, 9), round(round(steps[1]) * size, 9), 0.0))
    cos, sin = math.cos(yaw), math.sin(yaw)
    corners = grid.corners() / size
    low = np.floor(corners.min(axis=0) + 1e-6).astype(np.int64)
    high = np.maximum(np.ceil(corners.max(axis=0) - 1e-6).astype(np.int64), low + 1)
    width, height = (int(v) for v in high - low)
    _check_count(width * height, "normalize")
    source = images.apply_table(grid.cells, _RANK.tobytes())
    ranks = np.empty((height, width), np.uint8)
    u = np.arange(width) + (float(low[0]) + 0.5 - steps[0])
    step = max(1, images.STRIP // 8 // width)
    for row in range(0, height, step):
        v = (np.arange(row, min(height, row + step)) + (float(low[1]) + 0.5 - steps[1]))[:, None]
        column = np.floor(u * cos + v * sin + 1e-9).astype(np.int32)
        line = np.floor(v * cos - u * sin + 1e-9).astype(np.int32)
        inside = (column >= 0) & (column < grid.width) & (line >= 0) & (line < grid.height)
        block = np.full(inside.shape, _RANK[UNKNOWN])
        block[inside] = source[line[inside], column[inside]]
        ranks[row : row + len(block)] = block
    for row in range(0, grid.height, step):
        high_line, high_column = np.nonzero(source[row : row + step] > _RANK[UNKNOWN])
        p, q = high_column + 0.5, high_line + (row + 0.5)
        at_x = np.floor(p * cos - q * sin + (steps[0] - float(low[0]))).astype(np.intp).clip(0, width - 1)
        at_y = np.floor(p * sin + q * cos + (steps[1] - float(low[1]))).astype(np.intp).clip(0, height - 1)
        np.maximum.at(ranks, (at_y, at_x), source[row + high_line, high_column])
    origin = (round(float(low[0]) * size, 9), round(float(low[1]) * size, 9), 0.0)
    return replace(grid, cells=images.apply_table(ranks, _OF_RANK.tobytes()), origin=origin)


def _check_count(count: int, location: str) -> None:
    maximum = Limits().pixels
    if count > maximum:
        reason = f"the map would have {count} cells; the limit is {maximum}: request a coarser resolution"
        raise Invalid(reason, [Problem(reason, where=location)])
