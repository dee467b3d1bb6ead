"""Order in which areas are numbered: as people read a plan, and side by side as they walk past rows.

Places are read in lines from north to south, and in each line from west to east. Parallel strips side by side are one
group, numbered across their direction; groups are read as places are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

LINE = 1.0
"""Minimum height of a line of places in metres; lines of larger ones are half as high as these."""

PARALLEL = math.radians(10.0)
"""Maximum angle between neighbours of one group."""

BESIDE = 10.0
"""Maximum distance in metres of neighbours in a group: one strip between them may not have been found."""

FACING = 0.25
"""Minimum share of the shorter strip along which neighbours lie side by side."""


@dataclass(frozen=True, slots=True)
class _Axis:
    """Middle line of a strip: float64 [2, 2] x, y of its ends, in metres, and its width."""

    ends: NDArray[np.float64]
    width: float

    @property
    def along(self) -> NDArray[np.float64]:
        """Direction from the first end to the second, of length 1."""
        step = self.ends[1] - self.ends[0]
        return np.asarray(step / max(float(np.hypot(*step)), 1e-9))


def places(shapes: Sequence[Any]) -> list[int]:
    """Return the indices of polygons (x east, y north, metres) in reading order.

    A line begins with the northernmost place that is left, and has those whose middle is less than half a typical
    height (at least ``LINE``) south of it, so that neighbours of different depth stay in one line.
    """
    if not shapes:
        return []
    middles = shapely.get_coordinates(shapely.centroid(list(shapes))).round(6)
    bounds = shapely.bounds(list(shapes))
    height = max(LINE, 0.5 * float(np.median(bounds[:, 3] - bounds[:, 1])))
    out: list[int] = []
    line: list[int] = []
    for k in np.lexsort((middles[:, 0], -middles[:, 1])).tolist():
        if line and middles[line[0], 1] - middles[k, 1] >= height:
            out += sorted(line, key=lambda i: (middles[i, 0], -middles[i, 1]))
            line = []
        line.append(k)
    return out + sorted(line, key=lambda i: (middles[i, 0], -middles[i, 1]))


def strips(shapes: Sequence[Any]) -> list[int]:
    """Return the indices of long polygons in order: group by group, each across the direction of its strips.

    Within a group the order is from north to south, or from west to east if the strips run north; strips end to end
    follow each other from west to east, or from north to south.
    """
    if not shapes:
        return []
    axes = [_axis(shape) for shape in shapes]
    groups = _groups(shapes, axes)
    read = places([shapely.union_all([shapes[k] for k in group]) for group in groups])
    return [k for i in read for k in _across(groups[i], axes)]


def _axis(shape: Any) -> _Axis:
    corners = shapely.get_coordinates(shapely.minimum_rotated_rectangle(shape))[:4]
    sides = np.hypot(*(np.roll(corners, -1, axis=0) - corners).T)
    if sides[0] > sides[1]:
        corners = np.roll(corners, -1, axis=0)
    return _Axis(np.array([corners[:2].mean(axis=0), corners[2:].mean(axis=0)]), float(sides.min()))


def _groups(shapes: Sequence[Any], axes: Sequence[_Axis]) -> list[list[int]]:
    """Return the strips that are linked by neighbours side by side, in the order of their first one."""
    group = list(range(len(shapes)))
    pairs = shapely.STRtree(list(shapes)).query(list(shapes), predicate="dwithin", distance=BESIDE).T
    for i, k in sorted(pairs[pairs[:, 0] < pairs[:, 1]].tolist()):
        if group[i] != group[k] and _is_beside(axes[i], axes[k]):
            low, high = sorted((group[i], group[k]))
            group = [low if g == high else g for g in group]
    return [[k for k, g in enumerate(group) if g == first] for first in sorted(set(group))]


def _is_beside(one: _Axis, other: _Axis) -> bool:
    """Return whether two strips are parallel, and face each other."""
    a, b = one.along, other.along
    if abs(a[0] * b[1] - a[1] * b[0]) > math.sin(PARALLEL):
        return False
    spans = [np.sort(axis.ends @ a) for axis in (one, other)]
    facing = min(spans[0][1], spans[1][1]) - max(spans[0][0], spans[1][0])
    return bool(facing >= FACING * min(spans[0][1] - spans[0][0], spans[1][1] - spans[1][0]))


def _across(group: list[int], axes: Sequence[_Axis]) -> list[int]:
    """Return the strips of a group in the order of their lanes."""
    along = sum((axes[k].ends[1] - axes[k].ends[0]) * _sign(axes[k], axes[group[0]]) for k in group)
    along = np.asarray(along) / max(float(np.hypot(*np.asarray(along))), 1e-9)
    if abs(along[0]) >= abs(along[1]):  # the strips run east: south is next
        along = along if along[0] > 0 else -along
        across = np.array([along[1], -along[0]])
    else:
        along = along if along[1] < 0 else -along
        across = np.array([-along[1], along[0]])
    middles = {k: axes[k].ends.mean(axis=0) for k in group}
    out: list[int] = []
    lane: list[int] = []
    for k in sorted(group, key=lambda k: (round(float(middles[k] @ across), 6), k)):
        if lane and (middles[k] - middles[lane[0]]) @ across > axes[lane[0]].width / 2:
            out += sorted(lane, key=lambda i: (round(float(middles[i] @ along), 6), i))
            lane = []
        lane.append(k)
    return out + sorted(lane, key=lambda i: (round(float(middles[i] @ along), 6), i))


def _sign(axis: _Axis, first: _Axis) -> float:
    """Return 1 if a strip's ends are in the order of the first one's, else -1."""
    return 1.0 if float(axis.along @ first.along) >= 0 else -1.0
