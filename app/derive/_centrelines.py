"""Straight walls along the centrelines of a mask. Positions are (x, y) in cells, as in ``_figures``."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from app.derive._shapes import Box

Points = NDArray[np.float64]
Line = list[tuple[float, float]]

STEP = 0.25
"""Distance in cells between the positions at which a wall's width is sampled."""

MAX_SAMPLES = 64
"""Maximum number of positions along a wall at which its width is sampled."""

BATCH = 2**12
"""Number of positions that are looked up together."""


def straighten_lines(nodes: NDArray[np.integer], edges: NDArray[np.int64], tolerance: float) -> Points:
    """Join edges into straight lines within ``tolerance`` and return the end points of each line: float64 [n, 2, 2].

    At each node the straightest pair is joined first. Lines are in the order of their first edges.
    """
    at: Line = [(float(x), float(y)) for x, y in nodes.tolist()]
    lines: dict[int, list[int]] = dict(enumerate(edges.tolist()))
    meeting: dict[int, set[int]] = {}
    for k, (a, b) in lines.items():
        meeting.setdefault(a, set()).add(k)
        meeting.setdefault(b, set()).add(k)
    for node in sorted(meeting):
        while len(meeting[node]) > 1:
            best: tuple[float, int, int, list[int]] | None = None
            neighbours = sorted(meeting[node])
            for i, one in enumerate(neighbours):
                for other in neighbours[i + 1 :]:
                    joined = _join_lines(lines[one], lines[other], node)
                    away = _distance_from_line([at[k] for k in joined], tolerance)
                    if away is not None and (best is None or away < best[0]):
                        best = (away, one, other, joined)
            if best is None:
                break
            _, one, other, joined = best
            for k in (one, other):
                for end in (lines[k][0], lines[k][-1]):
                    meeting[end].discard(k)
            del lines[other]
            lines[one] = joined
            meeting[joined[0]].add(one)
            meeting[joined[-1]].add(one)
    return np.array([(at[line[0]], at[line[-1]]) for _, line in sorted(lines.items())]).reshape(-1, 2, 2)


def _join_lines(one: list[int], other: list[int], node: int) -> list[int]:
    """Join two lines at a common end."""
    first = one if one[-1] == node else one[::-1]
    second = other if other[0] == node else other[::-1]
    return [*first, *second[1:]]


def _distance_from_line(line: Line, tolerance: float) -> float | None:
    """Return the maximum distance of the corners from the chord; None if above tolerance, or if the line turns back."""
    (x0, y0), (x1, y1) = line[0], line[-1]
    dx, dy = x1 - x0, y1 - y0
    length = math.hypot(dx, dy)
    if length == 0.0:
        return None
    before = worst = 0.0
    for x, y in line[1:]:
        along = (x - x0) * dx + (y - y0) * dy
        worst = max(worst, abs((y - y0) * dx - (x - x0) * dy) / length)
        if along <= before or worst > tolerance:
            return None
        before = along
    return worst


def wall_boxes(thin: NDArray[np.uint8], ends: Points, widest: float) -> list[Box]:
    """Fit straight walls to centrelines: as wide as their cells, centred in them, up to where they end.

    thin: the walls' cells. ends: float64 [n, 2, 2], middles of the end cells of each line, from that of cell (0, 0).
    """
    if not len(ends):
        return []
    a, b = ends[:, 0] + 0.5, ends[:, 1] + 0.5
    length = np.hypot(*(b - a).T)
    along = (b - a) / length[:, None]
    across = np.column_stack([-along[:, 1], along[:, 0]])
    count = np.clip(np.rint(length).astype(np.int64), 3, MAX_SAMPLES)
    line = np.repeat(np.arange(len(ends)), count)
    share = (np.arange(len(line)) - np.repeat(np.cumsum(count) - count, count) + 0.5) / count[line]
    middle = a[line] + (b - a)[line] * share[:, None]
    left, right = (_reach(thin, middle, side, widest) for side in (across[line], -across[line]))
    width = np.maximum(_medians(left + right, line, count), 1.0)  # at junctions other walls count as width
    aside = across * _medians((left - right) / 2, line, count)[:, None]
    before, after = _reach(thin, a + aside, -along, widest), _reach(thin, b + aside, along, widest)
    centre = (a - along * before[:, None] + b + along * after[:, None]) / 2 + aside
    yaw = (np.arctan2(along[:, 1], along[:, 0]) + math.pi / 2) % math.pi - math.pi / 2
    table = np.column_stack([centre, length + before + after, width, yaw])
    return [Box(*row) for row in table.tolist()]


def _medians(values: Points, group: NDArray[np.int64], count: NDArray[np.int64]) -> Points:
    """Return the median of each group; groups are in order, with at least one value each."""
    ordered = values[np.lexsort((values, group))]
    first = np.cumsum(count) - count
    return np.asarray((ordered[first + (count - 1) // 2] + ordered[first + count // 2]) / 2)


def _reach(mask: NDArray[np.uint8], places: Points, directions: Points, max_distance: float) -> Points:
    """Measure how far the mask continues from each position in its direction, in cells; at most ``max_distance``."""
    steps = np.arange(0.0, max_distance + 1.0, STEP) + STEP / 2
    out = np.empty(len(places))
    portion = max(1, BATCH // len(steps))
    for begin in range(0, len(places), portion):
        part = slice(begin, begin + portion)
        x, y = (
            np.clip(np.floor(places[part, k, None] + directions[part, k, None] * steps).astype(np.int64), 0, size - 1)
            for k, size in ((0, mask.shape[1]), (1, mask.shape[0]))
        )
        beyond = mask[y, x] == 0
        out[part] = np.where(beyond.any(axis=1), beyond.argmax(axis=1), len(steps)) * STEP
    return out
