"""Alignment of one map onto another: a rotation and a shift in the plane, with the quality of the fit.

Two methods. Grids: the outlines of occupied cells are matched at every angle, all shifts of an angle at once by a
correlation in the frequency domain (Lewis, Fast Normalized Cross-Correlation, 1995, without the norm); the best
positions are refined by iterative closest points (Besl and McKay 1992), each step the least-squares rigid motion
(Umeyama 1991, without scale). Points: given pairs, the largest set of pairs that agree, by the same least squares.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.errors import CannotConvert, Invalid, Problem
from app.model.frame import MAX_METRES
from app.model.grid import OccupancyGrid, is_occupied

Array = NDArray[np.float64]

SEARCH_CELLS = 128
"""Number of cells along the longer side of a map in the search over all angles."""

MAX_REFINED = 16
"""Number of positions that are refined."""

POINTS = 1500
"""Maximum number of cells of a map in a refinement; of more, an even selection."""

MAX_PAIRS = 1000
"""Maximum number of pairs of points."""

_CLOSE = 0.02
"""Difference of agreement below which two positions count as equal: then the nearer one is taken."""


@dataclass(frozen=True, slots=True)
class Fit:
    """A motion of one map onto another: p -> R(yaw) p + (x, y), metres and radians in the local frame.

    residual: the root mean square distance in metres of the cells or pairs that agree. agreement: the share of the
    moved map's occupied cells within the other one's outline (or of the pairs) that agree. overlap: the share of cells
    within that outline.
    """

    x: float
    y: float
    yaw: float
    residual: float
    agreement: float
    overlap: float = 1.0

    @property
    def score(self) -> float:
        """Return the share of all cells that agree."""
        return self.agreement * self.overlap

    def apply_to(self, points: Array) -> Array:
        """Move points [n, 2]."""
        return np.asarray(points @ rotation(self.yaw).T + np.array([self.x, self.y]), np.float64)

    def move_grid(self, grid: OccupancyGrid) -> OccupancyGrid:
        """Move a grid; its cells stay unchanged."""
        x, y, yaw = grid.origin
        new = self.apply_to(np.array([[x, y]]))[0]
        return replace(grid, origin=(round(float(new[0]), 9), round(float(new[1]), 9), angle_of(yaw + self.yaw)))

    def as_dict(self) -> dict[str, float]:
        """Return the motion and its quality as JSON: metres, radians, shares."""
        return {
            "x": round(self.x, 6),
            "y": round(self.y, 6),
            "yaw": round(self.yaw, 9),
            "residual": round(self.residual, 6),
            "agreement": round(self.agreement, 6),
            "overlap": round(self.overlap, 6),
        }


def align_grids(
    moving: OccupancyGrid, onto: OccupancyGrid, *, angle: float = math.pi, reach: float | None = None, near: float = 0.1
) -> list[Fit]:
    """Find the positions at which one grid's obstacles match another's, the best first; similar positions are merged.

    Args:
        angle: maximum rotation, radians.
        reach: maximum distance that the moving grid's middle may move, metres.
        near: distance at which two cells agree, metres; at least a cell of the coarser grid.

    Raises CannotConvert if a grid has no outline to align, or if no position matches.
    """
    near = max(near, moving.resolution, onto.resolution)
    moving_points, onto_points = outline(moving), outline(onto)
    for points, role in ((moving_points, "that is moved"), (onto_points, "that it is moved onto")):
        if len(points) < 3:
            raise CannotConvert(f"the grid {role} has {len(points)} occupied border cells, and at least 3 are required")
    middle = moving_points.mean(axis=0)
    search = _Search(moving_points - middle, onto_points, near)
    limit = math.inf if reach is None else reach
    fits: list[Fit] = []
    from scipy.spatial import cKDTree

    tree, judge = cKDTree(onto_points), cKDTree(_occupied_points(onto))
    every = subsample(_occupied_points(moving), 20_000)
    sample = subsample(moving_points)
    for yaw, shift in search.places(angle, limit, middle):
        at = Fit(*_shift_for(shift, yaw, middle), yaw, 0.0, 0.0)
        refined = refine(at, sample, tree, 3 * search.cell, near)
        distance = float(np.linalg.norm(refined.apply_to(middle[None])[0] - middle))
        if abs(refined.yaw) <= angle + 1e-3 and distance <= limit + near:
            fits.append(_with_quality(refined, every, judge, onto, near))
    fits = _distinct(sorted(fits, key=lambda f: (-f.score, abs(f.yaw))), middle, near)
    if not fits:
        raise CannotConvert("the maps do not match at any position within this angle and reach")
    # among equal fits the smallest motion: sites have symmetries
    rivals = [f for f in fits if f.score >= fits[0].score - _CLOSE]
    first = min(rivals, key=lambda f: float(np.linalg.norm(f.apply_to(moving_points) - moving_points, axis=1).mean()))
    polished = _polish(first, subsample(moving_points, 2 * POINTS), tree, middle, near)
    return [_with_quality(polished, every, judge, onto, near), *(f for f in fits if f is not first)]


def fit_pairs(pairs: Array, *, near: float = 0.5) -> tuple[Fit, list[int], float]:
    """Fit the motion that moves the first points of pairs onto the second ones.

    Args:
        pairs: float64 [n, 2, 2], n ≥ 2: [from, to] in metres.
        near: maximum distance, in metres, of points that agree after the motion.

    Returns the motion, which pairs disagree, and their scale: how many times as far apart the second points are (a
    motion has none). Raises Invalid for points that do not determine a rotation.
    """
    if pairs.ndim != 3 or pairs.shape[1:] != (2, 2) or not 2 <= len(pairs) <= MAX_PAIRS:
        reason = f"the number of pairs of points [[x, y], [x, y]] must be 2 to {MAX_PAIRS}"
        raise Invalid(reason, [Problem(reason, where="pairs")])
    if not np.isfinite(pairs).all() or (np.abs(pairs) > MAX_METRES).any():
        reason = f"coordinates must be finite metres within ±{MAX_METRES:g}"
        raise Invalid(reason, [Problem(reason, where="pairs")])
    a, b = pairs[:, 0], pairs[:, 1]
    if min(np.ptp(a, axis=0).max(), np.ptp(b, axis=0).max()) < 1e-6:
        reason = "all points have the same position: give points at different positions"
        raise Invalid(reason, [Problem(reason, where="pairs")])
    best = np.ones(len(pairs), bool)
    if len(pairs) > 2:
        best = _largest(a, b, near)
    yaw, shift = _rigid(a[best], b[best])
    away = np.linalg.norm(a @ rotation(yaw).T + shift - b, axis=1)
    spread = [float(np.linalg.norm(p[best] - p[best].mean(axis=0))) for p in (a, b)]
    fit = Fit(float(shift[0]), float(shift[1]), yaw, float(np.sqrt((away[best] ** 2).mean())), float(best.mean()))
    return fit, np.flatnonzero(~best).tolist(), spread[1] / spread[0] if spread[0] > 0 else 1.0


def _largest(a: Array, b: Array, near: float) -> NDArray[np.bool_]:
    """Find the largest set of pairs that agree with the motion of two of them; at least two."""
    count = len(a)
    seeds: Iterable[tuple[int, int]] = combinations(range(count), 2)
    if count > 64:  # RANSAC with a fixed seed, which makes the result reproducible
        chance = np.random.default_rng(0).integers(0, count, (4000, 2))
        seeds = sorted({(min(i, j), max(i, j)) for i, j in chance.tolist() if i != j})
    best, best_error = np.zeros(count, bool), math.inf
    for i, j in seeds:
        if np.linalg.norm(a[i] - a[j]) < 1e-6 or np.linalg.norm(b[i] - b[j]) < 1e-6:
            continue
        yaw, shift = _rigid(a[[i, j]], b[[i, j]])
        away = np.linalg.norm(a @ rotation(yaw).T + shift - b, axis=1)
        good = away <= near
        error = float(away[good].sum())
        if (-good.sum(), error) < (-best.sum(), best_error):
            best, best_error = good, error
    if best.sum() < 2:
        reason = f"no two pairs agree on one motion without a scale within {near:g} m"
        raise Invalid(reason, [Problem(reason, where="pairs")])
    return best


# --- the search over all angles --------------------------------------------------------------------------------------


class _Search:
    """Coarse search for positions of points [n, 2] around 0 on other points [m, 2], in cells of ``cell`` metres."""

    def __init__(self, points: Array, target_points: Array, near: float) -> None:
        import cv2

        self.radius = float(np.linalg.norm(points, axis=1).max())
        low, high = target_points.min(axis=0), target_points.max(axis=0)
        self.cell = max(near, float(max((high - low).max(), 2 * self.radius)) / SEARCH_CELLS)
        margin = self.radius + 2 * self.cell
        self.low = low - margin
        min_size = np.ceil((high - low + 2 * margin) / self.cell).astype(int) + 1
        self.width, self.height = (cv2.getOptimalDFTSize(int(v)) for v in min_size)
        mask = np.full((self.height, self.width), 255, np.uint8)
        column, row = ((target_points - self.low) / self.cell).astype(int).T
        mask[row, column] = 0
        away = cv2.distanceTransform(mask, cv2.DIST_L2, 5)
        # a cell next to the outline counts half, and one at a distance of two next to nothing
        field = np.exp(-0.7 * away.astype(np.float64) ** 2)
        self.field = np.fft.rfft2(field)
        self.points = points

    def places(self, angle: float, reach: float, middle: Array) -> list[tuple[float, Array]]:
        """Return (yaw, position of the middle) of the best positions, at a distance from each other."""
        step = min(math.radians(3.0), self.cell / max(self.radius, self.cell))
        count = math.ceil(min(angle, math.pi) / step)
        turns = np.linspace(-1, 1, 2 * count + 1) * min(angle, math.pi) if count else np.zeros(1)
        allowed = self._allowed_places(reach, middle)
        peaks: list[tuple[float, float, Array]] = []
        for yaw in turns.tolist():
            score = self._scores(yaw)
            if allowed is not None:
                score = np.where(allowed, score, 0.0)
            for _ in range(3):
                k = int(score.argmax())
                row, column = divmod(k, self.width)
                if score[row, column] <= 0:
                    break
                peaks.append((float(score[row, column]), yaw, self.low + (np.array([column, row]) + 0.5) * self.cell))
                score[max(0, row - 3) : row + 4, max(0, column - 3) : column + 4] = 0.0
        peaks.sort(key=lambda f: (-f[0], abs(f[1]), f[1]))
        out: list[tuple[float, Array]] = []
        for _, yaw, at in peaks:
            twins = (abs(angle_of(yaw - y)) < 2.5 * step and np.linalg.norm(at - a) < 4 * self.cell for y, a in out)
            if not any(twins):
                out.append((yaw, at))
                if len(out) == MAX_REFINED:
                    break
        return out

    def _scores(self, yaw: float) -> Array:
        """Return for each cell the number of matching cells with the middle at this cell."""
        turned = np.floor(self.points @ rotation(yaw).T / self.cell + 0.5).astype(int)
        image = np.zeros((self.height, self.width))
        image[turned[:, 1] % self.height, turned[:, 0] % self.width] = 1.0
        return np.asarray(np.fft.irfft2(self.field * np.fft.rfft2(image).conj(), s=image.shape))

    def _allowed_places(self, reach: float, middle: Array) -> NDArray[np.bool_] | None:
        if math.isinf(reach):
            return None
        x = self.low[0] + (np.arange(self.width) + 0.5) * self.cell - middle[0]
        y = self.low[1] + (np.arange(self.height) + 0.5) * self.cell - middle[1]
        return np.asarray(np.hypot(x[None, :], y[:, None]) <= reach + self.cell)


# --- refinement ------------------------------------------------------------------------------------------------------


def refine(start: Fit, points: Array, tree: Any, wide: float, near: float) -> Fit:
    """Refine by closest points, from a wide search to a narrow one."""
    yaw, shift = start.yaw, np.array([start.x, start.y])
    for reach in (wide, wide / 2, 2 * near, near):
        for _ in range(25):
            placed = points @ rotation(yaw).T + shift
            away, index = tree.query(placed, distance_upper_bound=max(reach, near))
            good = np.isfinite(away)
            if good.sum() < 3:
                break
            turn, move = _rigid(placed[good], tree.data[index[good]])
            yaw, shift = yaw + turn, rotation(turn) @ shift + move
            if abs(turn) < 1e-5 and float(np.abs(move).max()) < 1e-4:
                break
    return Fit(float(shift[0]), float(shift[1]), angle_of(yaw), 0.0, 0.0)


def _polish(fit: Fit, points: Array, tree: Any, middle: Array, near: float) -> Fit:
    """Minimise the distances both ways, cut off at ``near``, by Nelder and Mead's simplex from a few rotations.

    Closest points stop shortly before the minimum if round shapes can rotate or if cells coincide.
    """
    from scipy.optimize import minimize
    from scipy.spatial import cKDTree

    theirs = subsample(np.asarray(tree.data), 2 * POINTS)
    centred = points - middle
    moving_tree = cKDTree(centred)
    size = float(np.sqrt((centred**2).sum(axis=1).mean()))  # a rotation in metres, as the motion of an average point

    def cost(v: Array) -> float:
        turn, at = rotation(float(v[0]) / size), v[1:]
        away, _ = tree.query(centred @ turn.T + at, distance_upper_bound=near)
        back, _ = moving_tree.query((theirs - at) @ turn, distance_upper_bound=near)
        return float((np.minimum(away, near) ** 2).mean() + (np.minimum(back, near) ** 2).mean())

    def minimise(start: Array, step: float, tries: int) -> Any:
        simplex = start + step * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
        options = {"initial_simplex": simplex, "maxfev": tries, "xatol": near / 200, "fatol": 0.0}
        return minimize(cost, start, method="Nelder-Mead", options=options)

    start = np.array([fit.yaw * size, *fit.apply_to(middle[None])[0]])
    tried = [minimise(start + np.array([k * near / 2, 0.0, 0.0]), near / 2, 30) for k in (0, 1, -1, 2, -2, 3, -3)]
    best = minimise(min(tried, key=lambda result: float(result.fun)).x, near / 8, 100).x
    yaw = angle_of(float(best[0]) / size)
    return Fit(*_shift_for(best[1:], yaw, middle), yaw, 0.0, 0.0)


def _with_quality(fit: Fit, every: Array, judge: Any, onto: OccupancyGrid, near: float) -> Fit:
    """Return the fit with its quality. every: the moving grid's occupied cells."""
    placed = fit.apply_to(every)
    x, y, yaw = onto.origin
    inside = (placed - np.array([x, y])) @ rotation(yaw) / onto.resolution
    margin = near / onto.resolution
    covered = ((inside >= -margin) & (inside <= np.array([onto.width, onto.height]) + margin)).all(axis=1)
    away, _ = judge.query(placed[covered], distance_upper_bound=near * (1 + 1e-9))
    good = np.isfinite(away)
    if not good.any():
        return Fit(fit.x, fit.y, fit.yaw, math.inf, 0.0, float(covered.mean()))
    residual = float(np.sqrt((away[good] ** 2).mean()))
    return Fit(fit.x, fit.y, fit.yaw, residual, float(good.mean()), float(covered.mean()))


def _distinct(fits: list[Fit], middle: Array, near: float) -> list[Fit]:
    out: list[Fit] = []
    for fit in fits:
        moved_middle = fit.apply_to(middle[None])[0]
        if fit.score > 0 and not any(
            abs(angle_of(fit.yaw - o.yaw)) < 0.05
            and np.linalg.norm(moved_middle - o.apply_to(middle[None])[0]) < 4 * near
            for o in out
        ):
            out.append(fit)
    return out


def _rigid(a: Array, b: Array) -> tuple[float, Array]:
    """Solve for (yaw, shift) with the least squares of R a + shift - b."""
    low, high = a.mean(axis=0), b.mean(axis=0)
    p, q = a - low, b - high
    yaw = math.atan2(float((p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum()), float((p * q).sum()))
    return yaw, high - rotation(yaw) @ low


def rotation(yaw: float) -> Array:
    """Return the matrix [2, 2] that rotates column vectors by an angle in radians."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s], [s, c]])


def angle_of(yaw: float) -> float:
    """Normalise an angle to ±π, rounded to 1e-12."""
    return round(math.remainder(yaw, 2 * math.pi), 12)


def _shift_for(at: Array, yaw: float, middle: Array) -> tuple[float, float]:
    """Return the shift of a motion that rotates by yaw and moves the middle to ``at``."""
    x, y = (at - rotation(yaw) @ middle).tolist()
    return x, y


def subsample(points: Array, limit: int = POINTS) -> Array:
    """Return at most this number of points, evenly selected."""
    return points if len(points) <= limit else points[np.linspace(0, len(points) - 1, limit).astype(int)]


def _occupied_points(grid: OccupancyGrid) -> Array:
    """Return the middles of occupied cells in metres, float64 [n, 2]."""
    return _placed_cells(grid, is_occupied(grid, grid.cells))


def outline(grid: OccupancyGrid) -> Array:
    """Return the middles of occupied cells next to others, in metres: the visible outline of walls of any thickness."""
    import cv2

    solid = is_occupied(grid, grid.cells).astype(np.uint8)
    inner = cv2.erode(solid, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return _placed_cells(grid, (solid - inner).astype(bool))


def _placed_cells(grid: OccupancyGrid, chosen: NDArray[np.bool_]) -> Array:
    row, column = np.nonzero(chosen)
    x, y, yaw = grid.origin
    cells = (np.column_stack([column, row]) + 0.5) * grid.resolution
    return np.asarray(cells @ rotation(yaw).T + np.array([x, y]))
