"""Changes of cells: map squares of one grid to cells of another and to metres, and find open cells."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import shapely
from numpy.typing import NDArray

from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, unknown_grey

Array = NDArray[np.float64]
Cells = NDArray[np.int64]


@dataclass(slots=True)
class CellChange:
    """Changes of a level's obstacles as squares of ``size`` metres: freed, covered now, and covered before.

    Each is int64 [n, 2], (column, row) from the local origin; with size 0 they are cells of the grid itself.
    """

    size: float
    freed: Cells = field(default_factory=lambda: np.empty((0, 2), np.int64))
    filled: Cells = field(default_factory=lambda: np.empty((0, 2), np.int64))
    before: Cells = field(default_factory=lambda: np.empty((0, 2), np.int64))


def replace_cells(stored: OccupancyGrid, cells: NDArray[np.uint8]) -> OccupancyGrid:
    """Return a stored grid with other cells; cells of grey 205 that stay unknown keep it."""
    grey = unknown_grey(stored)
    new_cells = cells if grey is None else np.where(grey & (cells == UNKNOWN), np.uint8(FREE), cells)
    return replace(stored, cells=new_cells)


_BIAS, _SPAN = 2**30, 2**31


def occupied_cells(grid: OccupancyGrid) -> Cells:
    """Return the occupied cells of a derived grid (yaw 0, origin a multiple of the resolution) as sorted numbers."""
    row, column = np.nonzero(grid.cells == OCCUPIED)
    x, y = (round(v / grid.resolution) for v in grid.origin[:2])
    return np.sort(_pack_squares(np.stack([column + x, row + y], axis=1)))


def _pack_squares(places: Cells) -> Cells:
    """Return each square (column, row) as one number."""
    return (places[:, 0].astype(np.int64) + _BIAS) * _SPAN + (places[:, 1].astype(np.int64) + _BIAS)


def unpack_squares(numbers: Cells) -> Cells:
    return np.stack([numbers // _SPAN - _BIAS, numbers % _SPAN - _BIAS], axis=1)


def grid_to_metres(grid: OccupancyGrid, at: Array) -> Array:
    """Convert positions in a grid, in columns and rows, to metres."""
    x, y, yaw = grid.origin
    c, s = math.cos(yaw), math.sin(yaw)
    u, v = at[:, 0] * grid.resolution, at[:, 1] * grid.resolution
    return np.stack([x + c * u - s * v, y + s * u + c * v], axis=1)


def metres_to_grid(grid: OccupancyGrid, at: Array) -> Array:
    """Convert metres to columns and rows of a grid."""
    x, y, yaw = grid.origin
    c, s = math.cos(yaw), math.sin(yaw)
    u, v = at[:, 0] - x, at[:, 1] - y
    return np.stack([c * u + s * v, -s * u + c * v], axis=1) / grid.resolution


def apply_change(grid: OccupancyGrid, change: CellChange) -> NDArray[np.uint8]:
    """Return the cells after freeing what obstacles left and occupying what they cover now."""
    cells = grid.cells.copy()
    for places, value in ((change.freed, FREE), (change.filled, OCCUPIED)):
        at = _covered_cells(grid, change, places)
        inside = ((at >= 0) & (at < [grid.width, grid.height])).all(axis=1)
        column, row = at[inside].T
        if value == FREE:
            occupied = cells[row, column] == OCCUPIED
            column, row = column[occupied], row[occupied]
        cells[row, column] = value
    return cells


def _covered_cells(grid: OccupancyGrid, change: CellChange, places: Cells) -> Cells:
    """Return the cells of a grid in which squares are; ``size`` 0: they are its own."""
    if change.size == 0.0 or not len(places):
        return places
    offset = np.array(grid.origin[:2]) / change.size
    if grid.origin[2] == 0.0 and grid.resolution == change.size and (np.abs(offset - np.round(offset)) < 1e-6).all():
        return places - np.round(offset).astype(np.int64)
    # of the cells that the squares touch, keep those whose centre is in one
    steps = max(2, math.ceil(2 * change.size / grid.resolution))
    inner = (np.arange(steps) + 0.5) / steps
    spread = np.stack(np.meshgrid(inner, inner), axis=-1).reshape(-1, 2)
    at = ((places[:, None, :] + spread[None]) * change.size).reshape(-1, 2)
    reached = np.unique(np.floor(metres_to_grid(grid, at) + 1e-9).astype(np.int64), axis=0)
    middles = np.floor(grid_to_metres(grid, np.asarray(reached + 0.5, np.float64)) / change.size + 1e-9).astype(
        np.int64
    )
    return reached[np.isin(_pack_squares(middles), _pack_squares(places))]


def square_boxes(places: Cells, size: float, main: OccupancyGrid | None) -> NDArray[np.object_]:
    """Return squares as boxes of consecutive ones, in metres. size 0: they are cells of the grid."""
    if not len(places):
        return np.empty(0, object)
    order = np.lexsort((places[:, 0], places[:, 1]))
    at = places[order]
    new = np.ones(len(at), bool)
    new[1:] = (at[1:, 1] != at[:-1, 1]) | (at[1:, 0] != at[:-1, 0] + 1)
    first = at[new]
    last = at[np.concatenate([np.flatnonzero(new)[1:] - 1, [len(at) - 1]])]
    boxes = shapely.box(first[:, 0], first[:, 1], last[:, 0] + 1, last[:, 1] + 1)
    if size > 0.0:
        return np.asarray(shapely.transform(boxes, lambda xy: xy * size), object)
    assert main is not None
    return np.asarray(shapely.transform(boxes, lambda xy: grid_to_metres(main, xy)), object)


def open_cells(cells: NDArray[np.uint8], across: float) -> Cells:
    """Return the numbers of cells that are free up to half the size of an object around them."""
    import cv2

    free = cells == FREE
    down, over = np.flatnonzero(free.any(axis=1)), np.flatnonzero(free.any(axis=0))
    if not len(down):
        return np.empty(0, np.int64)
    y, x = int(down[0]), int(over[0])
    inner = np.pad(free[y : int(down[-1]) + 1, x : int(over[-1]) + 1], 1).astype(np.uint8)
    away = cv2.distanceTransform(inner, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    row, column = np.nonzero(np.round(away, 3) > across * 0.75 + 1)
    return np.asarray((row + y) * cells.shape[1] + column + x, np.int64)


def grid_window(cells: NDArray[np.uint8], x: int, y: int, w: int, h: int) -> tuple[slice, slice] | None:
    """Return a window of the grid; None if it reaches beyond."""
    if x < 0 or y < 0 or x + w > cells.shape[1] or y + h > cells.shape[0]:
        return None
    return slice(y, y + h), slice(x, x + w)
