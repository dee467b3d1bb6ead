"""Lanes as pairs of bounds: direction of bounds, the middle line between them, and bounds beside a middle line.

Flat arrays: n lines are one array of indexes into a table of points, and the start of each line (``LineSet``).
Directions follow Lanelet2: looking along a lane, the left bound is on the left, and both run along it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

Array = NDArray[np.float64]
Places = NDArray[np.intp]

SAME_RATIO = 1e-6
"""Fraction of a lane's length: bends of both bounds closer than this along it are one bend of its middle."""

MIN_CROSSING_COSINE = 0.2
"""Minimum cosine of the angle between a lane and a border across it; below it the lane would begin with a sliver."""

MAX_MITRE_RATIO = 2.0
"""Maximum length of a mitred corner, as a multiple of half the width."""

Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class LineSet:
    """n lines of at least two points.

    indices: indexes of their points. first: [n + 1], start of each line in ``indices``.
    """

    indices: Places
    first: Places

    @property
    def owner(self) -> Places:
        """Return the line of each point, [len(at)]."""
        return np.repeat(np.arange(len(self.first) - 1), np.diff(self.first))

    @property
    def first_points(self) -> Places:
        """Return the first point of each line, [n]."""
        return self.indices[self.first[:-1]]

    @property
    def last_points(self) -> Places:
        """Return the last point of each line, [n]."""
        return self.indices[self.first[1:] - 1]

    def reverse(self, mask: NDArray[np.bool_]) -> LineSet:
        """Return the lines with these ones reversed."""
        owner = self.owner
        positions = np.arange(len(self.indices))
        back = self.first[owner] + self.first[owner + 1] - 1 - positions
        return LineSet(self.indices[np.where(mask[owner], back, positions)], self.first)


def runs(lines: Sequence[Sequence[int]]) -> LineSet:
    """Build lines from lists of indexes."""
    first = np.zeros(len(lines) + 1, np.intp)
    np.cumsum([len(line) for line in lines], out=first[1:])
    return LineSet(np.array([k for line in lines for k in line], np.intp), first)


def align_bounds(left: LineSet, right: LineSet, xy: Array) -> tuple[LineSet, LineSet]:
    """Orient both bounds along the lane. xy: [points, 2] in metres.

    Source: Lanelet2's ``geometry::align``, which its reader applies to every lanelet: a bound is reversed if the middle
    of the other one is not on its proper side.
    """
    turned = left.reverse(_side(left, _middle(right, xy), xy) >= 0)
    return turned, right.reverse(_side(right, _middle(turned, xy), xy) <= 0)


def _middle(lines: LineSet, xy: Array) -> Array:
    """Return the middle point of each line, [n, 2]; the mean of two points."""
    size = np.diff(lines.first)
    inner = xy[lines.indices[lines.first[:-1] + size // 2]]
    return np.where((size > 2)[:, None], inner, (xy[lines.first_points] + xy[lines.last_points]) / 2.0)


def _side(lines: LineSet, points: Array, xy: Array) -> Array:
    """Return [n]: positive if a line's point is on its left, negative on its right."""
    coordinates = xy[lines.indices]
    inner = np.ones(len(lines.indices), bool)
    inner[lines.first[1:] - 1] = False
    start = np.flatnonzero(inner)  # a segment begins at every point except a line's last
    owner = lines.owner[start]
    a, along = coordinates[start], coordinates[start + 1] - coordinates[start]
    p = points[owner] - a
    length = (along**2).sum(axis=1)
    t = np.clip((p * along).sum(axis=1) / np.where(length > 0, length, 1.0), 0.0, 1.0)
    away = p - along * t[:, None]
    distance = (away**2).sum(axis=1)
    distance[length == 0] = np.inf
    order = np.lexsort((distance, owner))
    nearest = order[np.searchsorted(owner[order], np.arange(len(lines.first) - 1))]
    unit = along / np.sqrt(np.where(length > 0, length, 1.0))[:, None]
    normal = np.column_stack([-unit[:, 1], unit[:, 0]])
    # At a corner both segments count: the sum of their normals points to the left of both.
    nearest_normal = normal[nearest].copy()
    before, after = nearest - 1, nearest + 1
    at_start = (t[nearest] == 0.0) & (before >= 0) & (owner[np.maximum(before, 0)] == owner[nearest])
    last = len(owner) - 1
    at_end = (t[nearest] == 1.0) & (after <= last) & (owner[np.minimum(after, last)] == owner[nearest])
    nearest_normal[at_start] += normal[before[at_start]]
    nearest_normal[at_end] += normal[after[at_end]]
    offset = np.where((at_start | at_end)[:, None], away[nearest], p[nearest])
    side: Array = (offset * nearest_normal).sum(axis=1)
    return side


def middles(left: LineSet, right: LineSet, xy: Array, places: Array) -> tuple[Array, Places]:
    """Return the line half-way between the bounds of n lanes: all its points [m, columns] and their lane [m].

    It bends wherever a bound bends, at the same fraction of the bounds' lengths in ``xy`` (metres); ``places`` are in
    any coordinates, and so is the result.
    """
    ratio = [_ratios(side, xy) for side in (left, right)]
    owner = np.concatenate([left.owner, right.owner])
    t = np.concatenate(ratio)
    order = np.lexsort((t, owner))
    owner, t = owner[order], t[order]
    fresh = np.ones(len(t), bool)
    fresh[1:] = (owner[1:] != owner[:-1]) | (t[1:] - t[:-1] > SAME_RATIO)
    last = np.append(np.flatnonzero(owner[1:] != owner[:-1]), len(t) - 1)
    near = fresh & (t > 1.0 - SAME_RATIO)
    fresh[near] = False
    fresh[last] = True  # exactly at the end, regardless of the point before it
    owner, t = owner[fresh], t[fresh]
    query = t + 2.0 * owner
    sides = []
    for lines, ratios in zip((left, right), ratio, strict=True):
        knots = ratios + 2.0 * lines.owner
        values = places[lines.indices]
        sides.append(np.column_stack([np.interp(query, knots, column) for column in values.T]))
    return (sides[0] + sides[1]) / 2.0, owner


def _ratios(lines: LineSet, xy: Array) -> Array:
    """Return each point's fraction of its line's length, 0 to 1."""
    owner = lines.owner
    step = np.hypot(*(xy[lines.indices[1:]] - xy[lines.indices[:-1]]).T)
    step[owner[1:] != owner[:-1]] = 0.0
    run = np.concatenate([[0.0], np.cumsum(step)])
    run -= run[lines.first[:-1]][owner]
    total = run[lines.first[1:] - 1]
    number = np.arange(len(owner)) - lines.first[:-1][owner]
    even = number / (np.diff(lines.first)[owner] - 1)
    ratio = np.where(total[owner] > 0, run / np.where(total > 0, total, 1.0)[owner], even)
    ratio[lines.first[1:] - 1] = 1.0
    return ratio


# --- bounds beside a middle --------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Arm:
    """End of a lane at a node. lane: its index. far: it is the lane's last point. away: unit vector out of the node.

    inward, outward: whether traffic may reach the node, or leave it, on this lane. half: half its width, metres.
    """

    lane: int
    far: bool
    away: Point
    inward: bool
    outward: bool
    half: float


@dataclass(frozen=True, slots=True)
class Border:
    """Two points across the lanes that meet at a node: looking along ``axis``, ``left`` is on the left."""

    axis: Point
    left: Point
    right: Point

    def is_shared_by(self, arm: Arm) -> bool:
        """Whether this lane can begin or end at the border."""
        return abs(crossing_cosine(arm, self)) > MIN_CROSSING_COSINE

    def along(self, arm: Arm) -> bool:
        """Whether the lane runs along the axis, so that its left bound is at ``left``; else at ``right``."""
        return (_dot(arm.away, self.axis) > 0) != arm.far


def crossing_cosine(arm: Arm, at: Border) -> float:
    """Return the cosine between a lane's direction out of the node and the border's axis."""
    return _dot(arm.away, at.axis)


def border(at: Point, arms: Sequence[Arm]) -> Border | None:
    """Find the border at a node that connects most pairs of lanes, or None if it connects none.

    Two lanes are connected in Lanelet2 if both bounds end and begin at the same two points in the same order: from one
    side of the border to the other.
    """
    if len(arms) < 2:
        return None
    best: tuple[int, float, Point] | None = None
    for axis in _axes(arms):
        shares = [_dot(arm.away, axis) for arm in arms]
        count = count_through(arms, [a if abs(a) > MIN_CROSSING_COSINE else 0.0 for a in shares])
        rank = (count, min(abs(a) for a in shares))
        if count and (best is None or rank > best[:2]):
            best = (*rank, axis)
    if best is None:
        return None
    axis = best[2]
    half = min(arm.half for arm in arms if abs(_dot(arm.away, axis)) > MIN_CROSSING_COSINE)
    if len(arms) == 2:
        half = min(half / max(abs(_dot(arms[0].away, axis)), 1e-9), half * MAX_MITRE_RATIO)
    x, y = -axis[1] * half, axis[0] * half
    return Border(axis, (at[0] + x, at[1] + y), (at[0] - x, at[1] - y))


def count_through(arms: Sequence[Arm], shares: Sequence[float]) -> int:
    """Count the lane pairs that are connected over the border.

    shares: ``crossing_cosine`` of each arm, 0 if it does not reach the border.
    """
    return sum(
        a.inward and b.outward and p * q < 0
        for a, p in zip(arms, shares, strict=True)
        for b, q in zip(arms, shares, strict=True)
        if a is not b
    )


def count_ways(arms: Sequence[Arm]) -> int:
    """Count the pairs of different lanes, in and out."""
    return sum(a.inward and b.outward for a in arms for b in arms if a is not b)


def _axes(arms: Sequence[Arm]) -> list[Point]:
    if len(arms) == 2:
        x, y = arms[1].away[0] - arms[0].away[0], arms[1].away[1] - arms[0].away[1]
        length = math.hypot(x, y)
        return [(x / length, y / length)] if length > 1e-6 else []
    # The arms on one side change only where the axis is perpendicular to an arm: one axis for each gap between.
    square = sorted((math.atan2(arm.away[1], arm.away[0]) + math.pi / 2) % math.pi for arm in arms)
    axes = []
    for k, low in enumerate(square):
        high = square[k + 1] if k + 1 < len(square) else square[0] + math.pi
        if high - low > 1e-6:
            middle = (low + high) / 2
            axes.append((math.cos(middle), math.sin(middle)))
    return axes


def _dot(a: Point, b: Point) -> float:
    return a[0] * b[0] + a[1] * b[1]


def offset_bounds(middle: Array, half: float) -> tuple[Array, Array]:
    """Return the (left, right) bounds of a lane, [k, 2] each, at this distance from its middle [k, 2], mitred.

    The middle must have at least two points, no two equal in a row.
    """
    along = np.diff(middle, axis=0)
    along /= np.hypot(along[:, 0], along[:, 1])[:, None]
    normal = np.column_stack([-along[:, 1], along[:, 0]])
    before, after = np.vstack([normal[:1], normal]), np.vstack([normal, normal[-1:]])
    share = 1.0 + (before * after).sum(axis=1)
    mitre = (before + after) / np.maximum(share, 1e-9)[:, None]
    length = np.hypot(mitre[:, 0], mitre[:, 1])
    hairpin = length < 1e-6  # a reversal: continue straight
    mitre[hairpin] = before[hairpin]
    length[hairpin] = 1.0
    mitre *= np.minimum(1.0, MAX_MITRE_RATIO / np.maximum(length, 1e-9))[:, None]
    return middle + mitre * half, middle - mitre * half


def is_sound(left: Array, right: Array) -> bool:
    """Whether two bounds enclose a lane: neither crosses itself or the other one."""
    ring = shapely.linearrings(np.vstack([left, right[::-1], left[:1]]))
    return bool(shapely.is_simple(ring))
