"""Refinement of positions by lines of walls."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.model.alignment import Fit, angle_of, rotation, subsample

Array = NDArray[np.float64]

_NEIGHBOURS, _IS_LINE = 24, 0.6
"""Number of cells to which a line is fitted, and how much longer than wide they must be: 1 is a perfect line."""


@dataclass(frozen=True, slots=True)
class Lines:
    """Points of walls, and how much a distance to them counts in each direction.

    points: float64 [n, 2], on the middle line of the occupied cells around, where these are on a line. weight: float64
    [n, 2, 2], which lets a point slide along that line (Segal, Haehnel and Thrun, Generalized-ICP, 2009; on a wall the
    point-to-line distance of Censi 2008).
    """

    points: Array
    weight: Array

    @classmethod
    def of_cells(cls, cells: Array, size: float) -> Lines:
        """Fit lines to the middles of occupied cells of this size, whose walls are several cells thick."""
        from scipy.spatial import cKDTree

        if len(cells) < 3:
            return cls(cells, np.broadcast_to(np.eye(2), (len(cells), 2, 2)))
        tree = cKDTree(cells)
        away, index = tree.query(cells, k=min(_NEIGHBOURS, len(cells)), distance_upper_bound=5.5 * size)
        counts = np.isfinite(away)[:, :, None].astype(np.float64)
        around = np.where(counts > 0, cells[np.where(counts[:, :, 0] > 0, index, 0)], 0.0)
        middle = around.sum(axis=1) / counts.sum(axis=1)
        around = (around - middle[:, None]) * counts
        xx, yy = (around[:, :, 0] ** 2).sum(axis=1), (around[:, :, 1] ** 2).sum(axis=1)
        xy = (around[:, :, 0] * around[:, :, 1]).sum(axis=1)
        flat = 0.98 * np.hypot(xx - yy, 2 * xy) / (xx + yy + 1e-12)
        yaw = np.arctan2(2 * xy, xx - yy) / 2
        along = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
        on_line = middle + ((cells - middle) * along).sum(axis=1)[:, None] * along
        points = np.where((flat > _IS_LINE)[:, None], on_line, cells)
        return cls(points, np.eye(2) - flat[:, None, None] * along[:, :, None] * along[:, None, :])

    def moved(self, fit: Fit) -> Lines:
        """Return the lines after a motion."""
        turn = rotation(fit.yaw)
        return Lines(fit.apply_to(self.points), turn @ self.weight @ turn.T)

    def some(self, limit: int) -> Lines:
        """Return at most this number of points, evenly selected."""
        index = subsample(np.arange(len(self.points), dtype=np.float64), limit).astype(int)
        return Lines(self.points[index], self.weight[index])


class Target:
    """Lines with their tree."""

    def __init__(self, rows: Sequence[Lines]) -> None:
        from scipy.spatial import cKDTree

        self.points = np.concatenate([row.points for row in rows])
        self.weight = np.concatenate([row.weight for row in rows])
        self.tree = cKDTree(self.points)

    def pairs(self, points: Array, reach: float) -> tuple[Array, Array, Array]:
        """Return (points, nearest points, weights) of the points that have one within reach."""
        away, index = self.tree.query(points, distance_upper_bound=reach)
        near = np.isfinite(away)
        return points[near], self.points[index[near]], self.weight[index[near]]


def slide(fit: Fit, points: Array, target: Target, near: float) -> Fit:
    """Refine a position by the distances of walls to lines of walls, ever nearer ones."""
    for reach in (2 * near, 1.5 * near, near):
        for _ in range(12):
            p, q, weight = target.pairs(fit.apply_to(points), reach)
            if len(p) < 3:
                return fit
            middle = p.mean(axis=0)
            columns, weight = _columns(p - middle), _robust(weight, q - p, near)
            weighted = weight @ columns
            matrix = np.tensordot(columns, weighted, ([0, 1], [0, 1]))
            step = np.linalg.lstsq(matrix, np.tensordot(weighted, q - p, ([0, 1], [0, 1])), rcond=1e-9)[0]
            fit = _stepped(fit, middle, step)
            if float(np.abs(step).max()) < 1e-5:
                break
    return fit


def settled(fits: Mapping[int, Fit], lines: Mapping[int, Lines], fixed: set[int], near: float) -> dict[int, Fit]:
    """Move grids to the least squares of the distances between walls of each two of them (Gauss and Newton)."""
    fits, targets = dict(fits), {k: Target([lines[k]]) for k in fits}
    movable = sorted(set(fits) - fixed)
    at = {k: slice(3 * n, 3 * n + 3) for n, k in enumerate(movable)}
    for reach in (1.5 * near, near):
        for _ in range(20):
            matrix, vector = np.zeros((3 * len(movable),) * 2), np.zeros(3 * len(movable))
            middles = {k: fits[k].apply_to(lines[k].points.mean(axis=0)[None])[0] for k in movable}
            for i, k in permutations(fits, 2):
                on_other = chain(fits[i], inverse(fits[k])).apply_to(lines[i].points)
                p, q, weight = targets[k].pairs(on_other, reach)
                turn = rotation(fits[k].yaw)
                p, q, weight = fits[k].apply_to(p), fits[k].apply_to(q), turn @ weight @ turn.T
                weight = _robust(weight, q - p, near)
                moves = {i: -_columns(p - middles[i])} if i in at else {}
                moves |= {k: _columns(q - middles[k])} if k in at else {}
                for one, columns in moves.items():
                    vector[at[one]] -= np.tensordot(weight @ columns, q - p, ([0, 1], [0, 1]))
                    for two, others in moves.items():
                        matrix[at[one], at[two]] += np.tensordot(columns, weight @ others, ([0, 1], [0, 1]))
            step = np.linalg.lstsq(matrix, vector, rcond=1e-9)[0]
            fits |= {k: _stepped(fits[k], middles[k], step[at[k]]) for k in movable}
            if not movable or float(np.abs(step).max()) < 1e-5:
                break
    return fits


def _columns(arms: Array) -> Array:
    """Return how points move by (rotation around 0, shift), float64 [n, 2, 3], for small rotations."""
    turning = (arms[:, ::-1] * np.array([-1.0, 1.0]))[:, :, None]
    return np.concatenate([turning, np.broadcast_to(np.eye(2), (len(arms), 2, 2))], axis=2)


def _robust(weight: Array, away: Array, near: float) -> Array:
    """Return weights that count distances beyond a cell ever less (Cauchy's): others saw things that were moved."""
    return np.asarray(weight / (1.0 + (away**2).sum(axis=1) / (near / 2) ** 2)[:, None, None])


def _stepped(fit: Fit, middle: Array, step: NDArray[Any]) -> Fit:
    """Return a motion followed by (rotation around the middle, shift)."""
    x, y = (rotation(float(step[0])) @ (np.array([fit.x, fit.y]) - middle) + middle + step[1:]).tolist()
    return Fit(x, y, angle_of(fit.yaw + float(step[0])), 0.0, 0.0)


def inverse(fit: Fit) -> Fit:
    """Return the motion back."""
    x, y = (-rotation(-fit.yaw) @ np.array([fit.x, fit.y])).tolist()
    return Fit(x, y, angle_of(-fit.yaw), 0.0, 0.0)


def chain(first: Fit, then: Fit) -> Fit:
    """Return the motion that makes one motion and then another."""
    x, y = then.apply_to(np.array([[first.x, first.y]]))[0].tolist()
    return Fit(x, y, angle_of(first.yaw + then.yaw), 0.0, 0.0)
