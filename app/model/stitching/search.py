"""Coarse search for positions of one grid on another, at all angles and shifts."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.model.alignment import Fit, angle_of, rotation
from app.model.stitching.charts import Chart

Array = NDArray[np.float64]

SEARCH_CELLS, WIDEST_SEARCH = 100, 512
"""Number of cells along the smaller grid in the search over all angles, and the maximum along the larger one."""

CANDIDATES = 24
"""Number of positions of each pair that are refined."""

_SEARCH_CONFLICT = 1.0
"""Weight of a wall cell in free space in the coarse search, whose cells are too large to weigh conflicts fully."""


class Search:
    """Coarse search for positions of one grid on another, at all angles and shifts within bounds around a start."""

    def __init__(self, moving: Chart, onto: Chart, near: float, start: Fit, angle: float, reach: float) -> None:
        self.moving, self.start, self.angle, self.reach = moving, start, angle, reach
        extent = 2 * onto.radius + 2 * moving.radius
        self.cell = max(near, 2 * moving.radius / SEARCH_CELLS, extent / WIDEST_SEARCH)
        from scipy import fft

        self.side = int(fft.next_fast_len(math.ceil(extent / self.cell) + 4, real=True))
        self.low = onto.middle - self.side * self.cell / 2
        self.half = math.ceil(moving.radius / self.cell) + 1
        walls = self._image(onto.outline - self.low)
        import cv2

        away = cv2.distanceTransform((walls == 0).astype(np.uint8), cv2.DIST_L2, 5)
        free = self._free(onto, self._centres(self.side) + self.low).reshape(self.side, self.side)
        near_walls = np.exp(np.float32(-0.7) * away**2)
        self.gain = fft.rfft2(near_walls - np.float32(_SEARCH_CONFLICT) * free)
        self.loss = fft.rfft2(np.float32(_SEARCH_CONFLICT) * walls)
        self.grid_of_moving = self._centres(2 * self.half) - self.half * self.cell

    def _centres(self, side: int) -> Array:
        row, column = np.indices((side, side)).reshape(2, -1)
        return np.asarray((np.column_stack([column, row]) + 0.5) * self.cell)

    def _image(self, points: Array) -> NDArray[np.float32]:
        image = np.zeros((self.side, self.side), np.float32)
        column, row = (points / self.cell).astype(int).clip(0, self.side - 1).T
        image[row, column] = 1.0
        return image

    def _free(self, chart: Chart, points: Array) -> NDArray[np.float32]:
        """Return 1 at points in free space that is clear of walls at this cell size."""
        away, free, _ = chart.look_up(points)
        return (free & (away > 1.5 * self.cell)).astype(np.float32)

    def positions(self) -> list[Fit]:
        """Return the best positions, the best first, at a distance from each other."""
        step = min(math.radians(2.0), self.cell / max(self.moving.radius, self.cell))
        limit = min(self.angle, math.pi)
        count = math.ceil(limit / step)
        turns = np.linspace(-1, 1, 2 * count + 1) * limit if count else np.zeros(1)
        allowed = self._allowed()
        peaks: list[tuple[float, float, int, int]] = []
        for turn in turns.tolist():
            yaw = angle_of(self.start.yaw + turn)
            score = np.where(allowed, self._scores(yaw), -np.inf)
            for _ in range(4):
                row, column = divmod(int(score.argmax()), self.side)
                if score[row, column] <= 0:
                    break
                peaks.append((float(score[row, column]), yaw, row, column))
                score[max(0, row - 2) : row + 3, max(0, column - 2) : column + 3] = -np.inf
        peaks.sort(key=lambda peak: (-peak[0], abs(peak[1]), peak[1], peak[2], peak[3]))
        kept: list[tuple[float, int, int]] = []
        for _, yaw, row, column in peaks:
            twins = (abs(angle_of(yaw - y)) < 2.5 * step and max(abs(row - r), abs(column - c)) < 4 for y, r, c in kept)
            if not any(twins):
                kept.append((yaw, row, column))
                if len(kept) == CANDIDATES:
                    break
        return [self._fit(*position) for position in kept]

    def _fit(self, yaw: float, row: int, column: int) -> Fit:
        at = self.low + np.array([column, row]) * self.cell
        x, y = (at - rotation(yaw) @ self.moving.middle).tolist()
        return Fit(x, y, yaw, 0.0, 0.0)

    def _scores(self, yaw: float) -> NDArray[np.float32]:
        """Return for each cell the evidence with the moving grid's middle at its corner (row, column)."""
        from scipy import fft

        turn = rotation(yaw)
        walls = np.zeros((self.side, self.side), np.float32)
        column, row = np.floor((self.moving.outline - self.moving.middle) @ turn.T / self.cell).astype(int).T
        walls[row % self.side, column % self.side] = 1.0
        free = np.zeros((self.side, self.side), np.float32)
        block = self._free(self.moving, self.grid_of_moving @ turn + self.moving.middle)
        index = np.arange(-self.half, self.half) % self.side
        free[np.ix_(index, index)] = block.reshape(2 * self.half, 2 * self.half)
        spectrum = self.gain * fft.rfft2(walls).conj() - self.loss * fft.rfft2(free).conj()
        return np.asarray(fft.irfft2(spectrum, s=walls.shape), np.float32)

    def _allowed(self) -> Any:
        if math.isinf(self.reach):
            return True
        aim = self.start.apply_to(self.moving.middle[None])[0]
        x = self.low[0] + np.arange(self.side) * self.cell - aim[0]
        y = self.low[1] + np.arange(self.side) * self.cell - aim[1]
        return np.asarray(np.hypot(x[None, :], y[:, None]) <= self.reach + self.cell)
