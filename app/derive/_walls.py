"""Join the straight pieces that a robot's scan leaves of each wall, and recognise round and legged furniture.

A wall in a recorded grid is broken where the robot's pose, a door frame or a cable moved a beam: its centreline falls
into pieces of a few decimetres, each with its own direction. Pieces are joined along the line of the longest one, as
far as their ends stay within the robot's noise of it. As in ROSE (Kucner et al. 2020), the dominant directions of the
map straighten what the noise may have turned; a longer piece keeps its own direction, so that walls at any angle are
joined. All lengths are in cells.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from app.derive._shapes import Box, Disc

MAX_ROUNDS = 50
"""Maximum number of times that a wall is extended; each one joins all pieces in reach."""

MAX_TURN = 0.35
"""Maximum angle in radians between a wall and a piece longer than ``SHORT`` that is joined to it."""

ROUNDING = 1e-6
"""Length in cells by which maximum distances are exceeded, so that machines that round differently join the same."""

SHORT = 4.0
"""Length in cells up to which a piece has no direction of its own."""

MAX_FACE_TURN, OVERLAP, FREE_BETWEEN = 0.1, 0.6, 0.5
"""Faces of a wall: angle between them, share of the shorter beside the longer, share of free cells between them."""

ARC, ARC_NOISE = 2.6, 0.75
"""Minimum angle in radians of the seen rim of a round object, and root mean square distance of its cells."""

MAX_LEGS = 400
"""Maximum number of small pieces among which legs of tables are searched; more are trees, or noise."""

LEG_NOISE = 1.5
"""Maximum distance in cells of a leg from its corner of a rectangle."""


@dataclass(slots=True)
class _Line:
    """A wall that grows: a point of it, its direction (a unit vector), its extent along it, and the pieces in it.

    Several lines may share one object: the arrays then have a row for each.
    """

    at: NDArray[np.float64]
    along: NDArray[np.float64]
    low: Any
    high: Any
    members: list[int]


class _Pieces:
    """Pieces of walls as arrays, and what may be joined to them.

    noise: maximum distance of a piece's ends from the line. gap: maximum gap between pieces.
    """

    def __init__(self, walls: Sequence[Box], noise: float, gap: float, main: Sequence[float]) -> None:
        self.ends = _all_ends(walls)
        self.yaws = np.array([wall.yaw for wall in walls])
        self.lengths = np.array([wall.length for wall in walls])
        self.widths = np.array([wall.width for wall in walls])
        self.noise, self.gap, self.main = noise + ROUNDING, gap + ROUNDING, main
        self._tree = shapely.STRtree(shapely.linestrings(self.ends))

    def mates(self) -> list[NDArray[np.int64]]:
        """Return for each piece the pieces on its line, itself included, in order."""
        turned = [_straightened(*p, self.noise, self.main) for p in zip(self.yaws, self.lengths, strict=True)]
        along = np.column_stack([np.cos(turned), np.sin(turned)])
        lines = _Line(self.ends.mean(axis=1), along, -self.lengths / 2, self.lengths / 2, [])
        first, second = self._tree.query(_strips(lines, self.gap, self.noise), predicate="intersects")
        chosen = _Line(lines.at[first], along[first], lines.low[first], lines.high[first], [])
        on = self._are_on(second, chosen)
        first, second = first[on], second[on]
        order = np.lexsort((second, first))
        return np.split(second[order], np.cumsum(np.bincount(first, minlength=len(self.ends)))[:-1])

    def on(self, line: _Line) -> NDArray[np.int64]:
        """Return the pieces on a line, in order."""
        candidates = np.sort(self._tree.query(_strips(line, self.gap, self.noise), predicate="intersects"))
        return np.asarray(candidates[self._are_on(candidates, line)])

    def _are_on(self, pieces: NDArray[np.int64], line: _Line) -> NDArray[np.bool_]:
        """Return which pieces are on a line, or each on its own line: within the noise, and the gap from its ends."""
        c, s = line.along[..., None, 0], line.along[..., None, 1]
        apart = self.ends[pieces] - line.at[..., None, :]
        aside = np.abs(apart[..., 1] * c - apart[..., 0] * s).max(axis=1)
        ahead = apart[..., 0] * c + apart[..., 1] * s
        turn = self.yaws[pieces] - np.arctan2(line.along[..., 1], line.along[..., 0])
        turn = np.abs(np.remainder(turn + math.pi / 2, math.pi) - math.pi / 2)
        is_along = (self.lengths[pieces] <= SHORT) | (turn <= MAX_TURN)
        is_near = (ahead.min(axis=1) <= line.high + self.gap) & (ahead.max(axis=1) >= line.low - self.gap)
        return np.asarray((aside <= self.noise) & is_along & is_near)

    def fit(self, members: list[int]) -> _Line:
        """Fit a line to the ends of pieces, weighted by length."""
        points = self.ends[members].reshape(-1, 2)
        weights = np.repeat(self.lengths[members], 2)
        middle = weights @ points / weights.sum()
        apart = points - middle
        (xx, xy), (_, yy) = ((apart * weights[:, None]).T @ apart).tolist()
        angle = math.atan2(2 * xy, xx - yy) / 2
        length = float(np.ptp(apart @ np.array([math.cos(angle), math.sin(angle)])))
        angle = _straightened(angle, length, self.noise, self.main)
        along = np.array([math.cos(angle), math.sin(angle)])
        reach = apart @ along
        return _Line(middle, along, float(reach.min()), float(reach.max()), members)

    def wall(self, line: _Line) -> Box:
        """Return the wall around the pieces of a line."""
        across = np.array([-line.along[1], line.along[0]])
        lengths = self.lengths[line.members]
        # the usual width, and as much more as the pieces lie beside each other
        offsets = (self.ends[line.members].mean(axis=1) - line.at) @ across
        width = float(self.widths[line.members] @ lengths / lengths.sum())
        width += 2 * math.sqrt(float(offsets**2 @ lengths / lengths.sum()))
        x, y = (line.at + line.along * (line.low + line.high) / 2).tolist()
        yaw = (math.atan2(line.along[1], line.along[0]) + math.pi / 2) % math.pi - math.pi / 2
        return Box(x, y, line.high - line.low, width, yaw)


def join_walls(walls: Sequence[Box], noise: float, gap: float, main: Sequence[float] = ()) -> list[Box]:
    """Join pieces of walls that lie on one line.

    Args:
        noise: maximum distance of a piece's ends from the line.
        gap: maximum gap between pieces.
        main: dominant directions, and those across them, in radians.

    Returns walls in the order of their first pieces; a piece that is joined to none is unchanged.
    """
    if len(walls) < 2:
        return list(walls)
    pieces = _Pieces(walls, noise, gap, main)
    mates = pieces.mates()
    free = np.ones(len(walls), bool)
    joined: list[tuple[int, Box]] = []
    for seed in np.lexsort((np.arange(len(walls)), -pieces.lengths)).tolist():
        if free[seed]:
            free[seed] = False
            # most are alone: no line is fitted to these
            new = mates[seed][free[mates[seed]]] if len(mates[seed]) > 1 else mates[seed][:0]
            line = _grow(seed, new, pieces, free) if len(new) else None
            joined.append((min(line.members), pieces.wall(line)) if line else (seed, walls[seed]))
    return [wall for _, wall in sorted(joined, key=lambda item: item[0])]


def _grow(seed: int, new: NDArray[np.int64], pieces: _Pieces, free: NDArray[np.bool_]) -> _Line:
    """Join to a piece the new ones, and all free pieces on the line that they make; mark them as not free."""
    members = [seed]
    for _ in range(MAX_ROUNDS):
        free[new] = False
        members = [*members, *new.tolist()]
        line = pieces.fit(members)
        new = pieces.on(line)
        new = new[free[new]]
        if not len(new):
            break
    return line


def _all_ends(walls: Sequence[Box]) -> NDArray[np.float64]:
    """Return the ends of the centrelines of walls: float64 [n, 2, 2]."""
    middle = np.array([(wall.x, wall.y) for wall in walls])
    half = np.array([(math.cos(wall.yaw) * wall.length / 2, math.sin(wall.yaw) * wall.length / 2) for wall in walls])
    return np.stack([middle - half, middle + half], axis=1)


def _strips(line: _Line, gap: float, noise: float) -> Any:
    """Return the rectangles around lines that pieces on them touch, a little wider than these."""
    across = np.stack([-line.along[..., 1], line.along[..., 0]], axis=-1) * (noise + ROUNDING)
    reach = gap + ROUNDING
    low, high = (line.at + line.along * np.expand_dims(end, -1) for end in (line.low - reach, line.high + reach))
    return shapely.polygons(np.stack([low - across, high - across, high + across, low + across], axis=-2))


def _straightened(angle: float, length: float, noise: float, main: Sequence[float]) -> float:
    """Return the direction of a line; a main direction if only noise is between them."""
    for direction in main:
        turn = math.remainder(direction - angle, math.pi / 2)
        if abs(turn) <= min(MAX_TURN, noise / max(length, 1.0)):
            return angle + turn
    return angle


def join_faces(walls: Sequence[Box], free: NDArray[np.bool_], widest: float) -> list[Box]:
    """Join the two faces of walls that were seen from both sides.

    free: bool [height, width], cells known to be free; between the faces of a wall most cells are not. widest: thickest
    wall.
    """
    if len(walls) < 2:
        return list(walls)
    ends = _all_ends(walls)
    tree = shapely.STRtree(shapely.linestrings(ends))
    apart = ends[:, 1] - ends[:, 0]
    aside = np.abs(apart[:, ::-1]) * (widest / np.maximum(np.hypot(*apart.T), 1e-9))[:, None]
    around = shapely.box(*(ends.min(axis=1) - aside).T, *(ends.max(axis=1) + aside).T)
    left: dict[int, Box] = dict(enumerate(walls))
    for k in sorted(left, key=lambda k: (-walls[k].length, k)):
        if k not in left:
            continue
        for other in np.sort(tree.query(around[k])).tolist():
            if other != k and other in left:
                joined = _joined_faces(left[k], left[other], free, widest)
                if joined is not None:
                    left[k] = joined
                    del left[other]
    return [left[k] for k in sorted(left)]


def _joined_faces(one: Box, other: Box, free: NDArray[np.bool_], widest: float) -> Box | None:
    """Return the wall of which two pieces are the faces, or None."""
    if other.length > one.length or abs(math.remainder(one.yaw - other.yaw, math.pi)) > MAX_FACE_TURN:
        return None
    along = np.array([math.cos(one.yaw), math.sin(one.yaw)])
    across = np.array([-along[1], along[0]])
    middle = np.array([one.x, one.y])
    ends = (_all_ends([other])[0] - middle) @ along
    low, high = float(ends.min()), float(ends.max())
    aside = float((np.array([other.x, other.y]) - middle) @ across)
    width = abs(aside) + (one.width + other.width) / 2
    overlap = min(high, one.length / 2) - max(low, -one.length / 2)
    if width > widest or overlap < OVERLAP * other.length:
        return None
    steps = np.linspace(low, high, max(3, round(high - low)))
    at = middle + along * steps[:, None] + across * aside / 2
    x, y = np.floor(at).astype(np.int64).T
    if free[y.clip(0, free.shape[0] - 1), x.clip(0, free.shape[1] - 1)].mean() > FREE_BETWEEN:
        return None
    low, high = min(low, -one.length / 2), max(high, one.length / 2)
    # a face is part of the wall's length: the rest keeps its own line
    shift = across * aside / 2 * min(1.0, other.length / one.length) + along * (low + high) / 2
    return Box(one.x + float(shift[0]), one.y + float(shift[1]), high - low, width, one.yaw)


def fit_arc(points: NDArray[np.float64], max_radius: float) -> Disc | None:
    """Return the circle of which points are the seen rim, or None. points: float64 [n, 2], on the rim.

    Least squares of Kåsa 1976.
    """
    if len(points) < 8:
        return None
    matrix = np.column_stack([2 * points, np.ones(len(points))])
    (x, y, c), _, rank, _ = np.linalg.lstsq(matrix, (points**2).sum(axis=1), rcond=None)
    if rank < 3 or c + x * x + y * y <= 0:
        return None
    radius = math.sqrt(c + x * x + y * y)
    away = np.hypot(points[:, 0] - x, points[:, 1] - y)
    if radius > max_radius or float(np.sqrt(((away - radius) ** 2).mean())) > ARC_NOISE:
        return None
    angles = np.sort(np.arctan2(points[:, 1] - y, points[:, 0] - x))
    seen = math.tau - float(np.diff(angles, append=angles[0] + math.tau).max())
    return Disc(float(x), float(y), radius + 0.5) if seen >= ARC else None


def find_tables(
    legs: NDArray[np.float64], free: NDArray[np.bool_], sides: tuple[float, float], directions: Sequence[float]
) -> Iterator[Box]:
    """Yield the outlines of tables that stand on four of the legs.

    Args:
        legs: float64 [n, 2], middles of small separate pieces.
        free: bool [height, width], cells known to be free; between the legs all are.
        sides: shortest and longest side of a table.
        directions: yaws of the walls; tables stand along them.

    The most exact rectangles come first; each leg belongs to one table.
    """
    if not 4 <= len(legs) <= MAX_LEGS:
        return
    options = []
    for yaw in directions:
        c, s = math.cos(yaw), math.sin(yaw)
        turned = legs @ np.array([[c, -s], [s, c]])
        options += _rectangles(turned, sides, yaw)
    used: set[int] = set()
    for _, corners, yaw in sorted(options, key=lambda option: (option[0], option[1])):
        if used.isdisjoint(corners) and _is_clear(legs[list(corners)], free):
            used.update(corners)
            yield _outline(legs[list(corners)], yaw)


def _rectangles(
    at: NDArray[np.float64], sides: tuple[float, float], yaw: float
) -> list[tuple[float, tuple[int, ...], float]]:
    """Return (error, indices, yaw) of upright rectangles of points."""
    low, high = sides
    out: list[tuple[float, tuple[int, ...], float]] = []
    for i, corner in enumerate(at):
        apart = at - corner
        right = np.flatnonzero((np.abs(apart[:, 1]) <= LEG_NOISE) & (apart[:, 0] >= low) & (apart[:, 0] <= high))
        up = np.flatnonzero((np.abs(apart[:, 0]) <= LEG_NOISE) & (apart[:, 1] >= low) & (apart[:, 1] <= high))
        for j in right:
            for k in up:
                error = np.hypot(*(at - (at[j] + at[k] - corner)).T)
                last = int(error.argmin())
                if error[last] <= LEG_NOISE:
                    out.append((round(float(error[last]), 6), (i, int(j), int(k), last), yaw))
    return out


def _is_clear(corners: NDArray[np.float64], free: NDArray[np.bool_]) -> bool:
    """Return whether the ground between four legs is free, but for a margin around the legs."""
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = 3
    x0, y0 = (int(v) + margin for v in low)
    x1, y1 = (int(v) - margin for v in high)
    return x1 > x0 and y1 > y0 and bool(free[y0:y1, x0:x1].all())


def _outline(corners: NDArray[np.float64], yaw: float) -> Box:
    """Return the table top over four legs: half a cell beyond their middles."""
    c, s = math.cos(yaw), math.sin(yaw)
    turned = corners @ np.array([[c, -s], [s, c]])
    low, high = turned.min(axis=0) - 0.5, turned.max(axis=0) + 0.5
    middle = np.array([[c, s], [-s, c]]).T @ ((low + high) / 2)
    length, width = (float(v) for v in high - low)
    if width > length:
        length, width, yaw = width, length, yaw + math.pi / 2
    yaw = (yaw + math.pi / 2) % math.pi - math.pi / 2
    return Box(float(middle[0]), float(middle[1]), length, width, yaw)
