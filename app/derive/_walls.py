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

import numpy as np
import shapely
from numpy.typing import NDArray

from app.derive._shapes import Box, Disc

MAX_ROUNDS = 50
"""Maximum number of times that a wall is extended; each one joins all pieces in reach."""

MAX_TURN = 0.35
"""Maximum angle in radians between a wall and a piece longer than ``SHORT`` that is joined to it."""

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
    """A wall that grows: a point of it, its direction, its extent along it, and the pieces in it."""

    at: NDArray[np.float64]
    along: NDArray[np.float64]
    low: float
    high: float
    members: list[int]


def join_walls(walls: Sequence[Box], noise: float, gap: float, main: Sequence[float] = ()) -> list[Box]:
    """Join pieces of walls that lie on one line.

    Args:
        noise: maximum distance of a piece's ends from the line.
        gap: maximum gap between pieces.
        main: dominant directions, and those across them, in radians.

    Returns walls in the order of their first pieces.
    """
    if len(walls) < 2:
        return list(walls)
    ends = np.array([_ends(wall) for wall in walls])
    tree = shapely.STRtree(shapely.linestrings(ends))
    free = np.ones(len(walls), bool)
    joined: list[tuple[int, Box]] = []
    lengths = np.array([wall.length for wall in walls])
    for seed in np.lexsort((np.arange(len(walls)), -lengths)):
        if free[seed]:
            free[seed] = False
            line = _grow(int(seed), walls, ends, tree, free, noise, gap, main)
            joined.append((min(line.members), _wall_of(line, walls, ends)))
    return [wall for _, wall in sorted(joined, key=lambda item: item[0])]


def _ends(wall: Box) -> NDArray[np.float64]:
    half = np.array([math.cos(wall.yaw), math.sin(wall.yaw)]) * wall.length / 2
    middle = np.array([wall.x, wall.y])
    return np.stack([middle - half, middle + half])


def _grow(
    seed: int,
    walls: Sequence[Box],
    ends: NDArray[np.float64],
    tree: shapely.STRtree,
    free: NDArray[np.bool_],
    noise: float,
    gap: float,
    main: Sequence[float],
) -> _Line:
    """Join to a piece all free pieces on its line, and mark them as not free."""
    line = _fit([seed], walls, ends, noise, main)
    for _ in range(MAX_ROUNDS):
        a, b = (line.at + line.along * s for s in (line.low - gap, line.high + gap))
        around = shapely.linestrings(np.stack([a, b])).buffer(noise, cap_style="flat")
        candidates = np.sort(tree.query(around))
        new = [int(k) for k in candidates if free[k] and _is_on(ends[k], walls[k], line, noise, gap)]
        if not new:
            break
        free[new] = False
        line = _fit([*line.members, *new], walls, ends, noise, main)
    return line


def _is_on(ends: NDArray[np.float64], wall: Box, line: _Line, noise: float, gap: float) -> bool:
    """Return whether a piece is on a line within the noise and no further than the gap from its ends."""
    across = np.array([-line.along[1], line.along[0]])
    if np.abs((ends - line.at) @ across).max() > noise:
        return False
    turn = abs(math.remainder(wall.yaw - math.atan2(line.along[1], line.along[0]), math.pi))
    if wall.length > SHORT and turn > MAX_TURN:
        return False
    along = (ends - line.at) @ line.along
    return bool(along.min() <= line.high + gap and along.max() >= line.low - gap)


def _fit(
    members: list[int], walls: Sequence[Box], ends: NDArray[np.float64], noise: float, main: Sequence[float]
) -> _Line:
    """Fit a line to the ends of pieces, weighted by length; along a main direction if only noise is between them."""
    points = ends[members].reshape(-1, 2)
    weights = np.repeat([walls[k].length for k in members], 2)
    middle = np.average(points, axis=0, weights=weights)
    apart = (points - middle) * weights[:, None]
    spread = apart.T @ (points - middle)
    _, vectors = np.linalg.eigh(spread)
    along = vectors[:, 1]
    # the sign of an eigenvector is arbitrary
    along = along if (along[0], along[1]) > (0.0, 0.0) else -along
    length = float(np.ptp((points - middle) @ along))
    for direction in main:
        turn = math.remainder(direction - math.atan2(along[1], along[0]), math.pi / 2)
        if abs(turn) <= min(MAX_TURN, noise / max(length, 1.0)):
            c, s = math.cos(turn), math.sin(turn)
            along = np.array([c * along[0] - s * along[1], s * along[0] + c * along[1]])
            break
    reach = (points - middle) @ along
    return _Line(middle, along, float(reach.min()), float(reach.max()), members)


def _wall_of(line: _Line, walls: Sequence[Box], ends: NDArray[np.float64]) -> Box:
    """Return the wall around the pieces of a line; a single piece is unchanged."""
    if len(line.members) == 1:
        # its own direction covers its cells best
        return walls[line.members[0]]
    across = np.array([-line.along[1], line.along[0]])
    lengths = np.array([walls[k].length for k in line.members])
    # the usual width, and as much more as the pieces lie beside each other
    offsets = (ends[line.members].mean(axis=1) - line.at) @ across
    width = float(np.average([walls[k].width for k in line.members], weights=lengths))
    width += 2 * float(np.sqrt(np.average(offsets**2, weights=lengths)))
    middle = line.at + line.along * (line.low + line.high) / 2
    yaw = (math.atan2(line.along[1], line.along[0]) + math.pi / 2) % math.pi - math.pi / 2
    return Box(float(middle[0]), float(middle[1]), line.high - line.low, width, yaw)


def join_faces(walls: Sequence[Box], free: NDArray[np.bool_], widest: float) -> list[Box]:
    """Join the two faces of walls that were seen from both sides.

    free: bool [height, width], cells known to be free; between the faces of a wall most cells are not. widest: thickest
    wall.
    """
    if len(walls) < 2:
        return list(walls)
    tree = shapely.STRtree(shapely.linestrings(np.array([_ends(wall) for wall in walls])))
    left: dict[int, Box] = dict(enumerate(walls))
    for k in sorted(left, key=lambda k: (-walls[k].length, k)):
        if k not in left:
            continue
        around = shapely.linestrings(_ends(walls[k])).buffer(widest, cap_style="flat")
        for other in np.sort(tree.query(around)):
            if other != k and int(other) in left:
                joined = _joined_faces(left[k], left[int(other)], free, widest)
                if joined is not None:
                    left[k] = joined
                    del left[int(other)]
    return [left[k] for k in sorted(left)]


def _joined_faces(one: Box, other: Box, free: NDArray[np.bool_], widest: float) -> Box | None:
    """Return the wall of which two pieces are the faces, or None."""
    if other.length > one.length or abs(math.remainder(one.yaw - other.yaw, math.pi)) > MAX_FACE_TURN:
        return None
    along = np.array([math.cos(one.yaw), math.sin(one.yaw)])
    across = np.array([-along[1], along[0]])
    middle = np.array([one.x, one.y])
    ends = (_ends(other) - middle) @ along
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
