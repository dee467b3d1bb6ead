"""A grid of which walls and free space can be looked up anywhere, and how walls of one lie on another."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from app.model.alignment import Fit, outline, rotation, subsample
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, halve_cells, is_occupied, unknown_grey_as_unknown
from app.model.stitching.lines import Lines

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

WORKING_CELLS = 2**22
"""Number of cells above which a grid is matched at half its resolution, or a quarter …"""

SAMPLES = 4000
"""Maximum number of wall cells of a grid that are compared."""

_DIRECTIONS = np.array([[math.cos(k * math.pi / 4), math.sin(k * math.pi / 4)] for k in range(8)])


@dataclass(slots=True)
class Look:
    """Walls of one grid on another: metres to the next wall there, is free there, is free space before it there too.

    The last tells walls from their back sides, which fit each other where grids lie side by side.
    """

    away: NDArray[np.float32]
    free: Mask
    same_side: Mask

    @classmethod
    def nowhere(cls, count: int) -> Look:
        """Return walls on nothing."""
        return cls(np.full(count, np.inf, np.float32), np.zeros(count, bool), np.zeros(count, bool))

    def join(self, other: Look) -> None:
        """Add a look at one more grid."""
        self.away = np.minimum(self.away, other.away)
        self.free |= other.free
        self.same_side |= other.same_side


@dataclass(slots=True)
class Tally:
    """Metres of walls that agree within ``near``, and in free space. squares: of the distances, times metres."""

    near: float
    agree: float = 0.0
    conflict: float = 0.0
    squares: float = 0.0

    def add(self, look: Look, metres: float) -> None:
        """Add the walls of one side; walls count half on each."""
        close = look.away <= self.near
        agree = close & look.same_side
        self.agree += float(agree.sum()) * metres / 2
        self.conflict += float((look.free & ~close).sum()) * metres / 2
        self.squares += float((look.away[agree].astype(np.float64) ** 2).sum()) * metres / 2


class Chart:
    """A grid of which walls and free space can be looked up anywhere, in its own coordinates (metres)."""

    def __init__(self, grid: OccupancyGrid) -> None:
        import cv2

        grid = unknown_grey_as_unknown(grid)
        cells, size = grid.cells, grid.resolution
        while cells.size > WORKING_CELLS:
            cells, size = halve_cells(cells), 2 * size
        self.grid = replace(grid, cells=cells, resolution=size)
        self.resolution = size
        self.free = cells == FREE
        self.observed = cells != UNKNOWN
        solid = is_occupied(grid, cells).astype(np.uint8)
        self.away = cv2.distanceTransform(1 - solid, cv2.DIST_L2, 5) * np.float32(size)
        if not solid.any():
            self.away[:] = np.inf
        # the cells that a scan lost inside of a wall are no outline
        closed = cv2.morphologyEx(solid, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8), borderValue=0).astype(bool)
        self.outline = outline(replace(self.grid, cells=np.where(closed, np.uint8(OCCUPIED), cells)))
        self.walls = subsample(self.outline, SAMPLES)
        self.metres_of_sample = size * len(self.outline) / max(1, len(self.walls))
        self.lines = Lines.of_cells(self.outline, size)
        row, column = np.nonzero(self.observed)
        keep = np.linspace(0, max(0, len(row) - 1), min(len(row), 20_000)).astype(int)
        self.seen = self._points(row[keep], column[keep])
        self.seen_area = float(len(row)) * size**2
        self.middle = self.outline.mean(axis=0) if len(self.outline) else grid.corners().mean(axis=0)
        reference = self.seen if len(self.seen) else grid.corners()
        self.radius = float(np.linalg.norm(reference - self.middle, axis=1).max())

    def look_ahead(self, near: float) -> None:
        """Find where each sampled wall has free space before it: the side from which it was seen."""
        ahead = self.walls[:, None] + 2.5 * near * _DIRECTIONS
        self.ahead = ahead.reshape(-1, 2)
        self.is_front = self.look_up(self.ahead)[1].reshape(-1, len(_DIRECTIONS))

    def look_from(self, other: Chart, motion: Fit) -> Look:
        """Look up this grid's sampled walls on another one. motion: into the other's coordinates."""
        away, free, _ = other.look_up(motion.apply_to(self.walls))
        ahead = other.look_up(motion.apply_to(self.ahead))[1].reshape(self.is_front.shape)
        return Look(away, free, np.asarray((ahead & self.is_front).any(axis=1)))

    def _points(self, row: NDArray[np.intp], column: NDArray[np.intp]) -> Array:
        x, y, yaw = self.grid.origin
        cells = (np.column_stack([column, row]) + 0.5) * self.resolution
        return np.asarray(cells @ rotation(yaw).T + np.array([x, y]))

    def look_up(self, points: Array) -> tuple[NDArray[np.float32], Mask, Mask]:
        """Return (metres to the next wall, is free, is observed) of points [n, 2]; beyond it infinite, neither."""
        x, y, yaw = self.grid.origin
        local = (points - np.array([x, y])) @ rotation(yaw) / self.resolution
        column, row = np.floor(local).astype(np.int64).T
        height, width = self.observed.shape
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        row, column = row[inside], column[inside]
        away = np.full(len(points), np.inf, np.float32)
        free, observed = np.zeros(len(points), bool), np.zeros(len(points), bool)
        away[inside], free[inside], observed[inside] = (
            self.away[row, column],
            self.free[row, column],
            self.observed[row, column],
        )
        return away, free, observed
