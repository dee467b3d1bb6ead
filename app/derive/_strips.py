"""Aisles and rows: long free strips between parallel lines of obstacles.

A line is a long thin obstacle that stands alone (a rack, a hedge, a row of vines), or a chain of at least ``CHAIN``
small ones at equal distances (posts of a tunnel, pallets, trunks, legs of a shelf). Where posts stand in a lattice,
the longest chains are the lines, since people plant and store along the longer side.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]
Points = NDArray[np.float64]

CHAIN = 5
"""Minimum number of obstacles of a chain."""

PITCH = 4.5
"""Maximum distance of neighbours in a chain, in metres."""

PIECE = 3.0
"""Maximum size of an obstacle of a chain, in metres."""

LINE = 3.0
"""Minimum ratio of a line's length to its width."""

WIDEST_LINE = 3.0
"""Maximum width of a line in metres: two racks back to back."""

MIN_LENGTH = 4.0
"""Minimum length of strips in metres."""

MIN_GAP, MAX_GAP = 0.5, 4.5
"""Width of strips in metres."""

PARALLEL = math.radians(8.0)
OVERLAP = 0.6
"""Minimum share of the shorter line along which two lines face each other."""

CLEAR = 0.97
"""Minimum share of a strip's cells that are not occupied."""

MAX_PIECES = 20_000
"""Maximum number of small obstacles in which chains are sought."""


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """Line of obstacles, in cells. ends: float64 [2, 2] x, y. width: across it."""

    ends: Points
    width: float

    @property
    def length(self) -> float:
        """Return its length."""
        return float(np.hypot(*(self.ends[1] - self.ends[0])))


@dataclass(frozen=True, slots=True, eq=False)
class Strip:
    """Free strip. corners: float64 [4, 2] x, y in cells, the first two at one end. flanks: width of the lines beside
    it. facing: share of the shorter line that it covers."""

    corners: Points
    flanks: tuple[float, float]
    facing: float


def strips(occupied: Mask, free: Mask, cell: float) -> list[Strip]:
    """Return the strips of a grid. cell: metres."""
    lines = obstacle_lines(occupied, cell)
    out = []
    for one, other in itertools.combinations(lines, 2):
        strip = _strip(one, other, cell)
        if strip is not None and _is_clear(strip, occupied, free):
            out.append(strip)
    return out


def obstacle_lines(occupied: Mask, cell: float) -> list[Line]:
    """Return the lines of obstacles, the longest first."""
    contours, _ = cv2.findContours(occupied.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    out: list[Line] = []
    middles: list[Points] = []
    sizes: list[float] = []
    for contour in contours:
        box = cv2.minAreaRect(contour)
        length, width = max(box[1]) + 1.0, min(box[1]) + 1.0
        corners = cv2.boxPoints(box).astype(np.float64)
        if length <= PIECE / cell:
            middles.append(corners.mean(axis=0))
            sizes.append(length)
        elif length >= LINE * width and width <= WIDEST_LINE / cell:
            order = corners if np.hypot(*(corners[1] - corners[0])) <= width else np.roll(corners, 1, axis=0)
            out.append(Line(np.array([order[:2].mean(axis=0), order[2:].mean(axis=0)]), width))
    if CHAIN <= len(middles) <= MAX_PIECES:
        out += _chains(np.array(middles), np.array(sizes), cell)
    return sorted(out, key=lambda line: (-line.length, *line.ends.ravel().tolist()))


def _chains(middles: Points, sizes: NDArray[np.float64], cell: float) -> list[Line]:
    """Return the chains of small obstacles, the longest first; each obstacle is in one."""
    from scipy.spatial import cKDTree

    tree = cKDTree(middles)
    near = tree.query_pairs(PITCH / cell, output_type="ndarray")
    near = near[np.lexsort((near[:, 1], near[:, 0]))]
    alike = np.maximum(sizes[near[:, 0]], sizes[near[:, 1]]) <= 2.5 * np.minimum(*sizes[near].T) + 0.2 / cell
    found: list[list[int]] = []
    seen: set[tuple[int, int]] = set()
    for a, b in near[alike].tolist():
        if (a, b) in seen:
            continue
        chain = [*_walk(tree, middles, b, a, cell)[::-1], *_walk(tree, middles, a, b, cell)]
        seen.update((min(p), max(p)) for p in itertools.pairwise(chain))
        if len(chain) >= CHAIN:
            found.append(chain)
    out: list[Line] = []
    used: set[int] = set()
    for chain in sorted(found, key=lambda c: (-float(np.hypot(*(middles[c[-1]] - middles[c[0]]))), c)):
        length = float(np.hypot(*(middles[chain[-1]] - middles[chain[0]])))
        if length < MIN_LENGTH / cell or len(used.intersection(chain)) > len(chain) / 4:
            continue
        used.update(chain)
        out.append(Line(middles[[chain[0], chain[-1]]], float(np.median(sizes[chain]))))
    return out


def _walk(tree: object, middles: Points, first: int, second: int, cell: float) -> list[int]:
    """Continue from a pair of obstacles in equal steps; return those from the second on."""
    out = [second]
    step = middles[second] - middles[first]
    at = second
    while True:
        distance, k = tree.query(middles[at] + step)  # type: ignore[attr-defined]
        if distance > 0.12 * float(np.hypot(*step)) + 0.05 / cell or k in out or k == first:
            return out
        made = middles[k] - middles[at]
        step = 0.7 * step + 0.3 * made
        out.append(int(k))
        at = int(k)


def _gap(one: Line, other: Line) -> tuple[float, float] | None:
    """Return the distance of two parallel lines that face each other, and the length; None for others."""
    along = (one.ends[1] - one.ends[0]) / max(one.length, 1e-9)
    turn = (other.ends[1] - other.ends[0]) / max(other.length, 1e-9)
    if abs(along[0] * turn[1] - along[1] * turn[0]) > math.sin(PARALLEL):
        return None
    places = (other.ends - one.ends[0]) @ along
    length = min(one.length, float(places.max())) - max(0.0, float(places.min()))
    if length < OVERLAP * min(one.length, other.length):
        return None
    across = (other.ends - one.ends[0]) @ np.array([-along[1], along[0]])
    return (abs(float(across.mean())), length)


def _strip(one: Line, other: Line, cell: float) -> Strip | None:
    """Return the strip between two lines, None if its size is no aisle's."""
    gap = _gap(one, other)
    if gap is None:
        return None
    along = (one.ends[1] - one.ends[0]) / one.length
    across = np.array([-along[1], along[0]])
    mates = other.ends if (other.ends[1] - other.ends[0]) @ along > 0 else other.ends[::-1]
    places = (mates - one.ends[0]) @ along
    begin, end = max(0.0, float(places[0])), min(one.length, float(places[1]))
    side = 1.0 if float(((mates - one.ends[0]) @ across).mean()) > 0 else -1.0
    width = gap[0] - (one.width + other.width) / 2
    if not MIN_GAP <= width * cell <= MAX_GAP or (end - begin) * cell < MIN_LENGTH or end - begin < 2.0 * width:
        return None
    corners = []
    for place in (begin, end):
        share = (place - places[0]) / max(float(places[1] - places[0]), 1e-9)
        far = mates[0] + share * (mates[1] - mates[0]) - side * across * other.width / 2
        near = one.ends[0] + along * place + side * across * one.width / 2
        corners.append((near, far) if place == begin else (far, near))
    facing = (end - begin) / min(one.length, other.length)
    return Strip(np.array([*corners[0], *corners[1]]), (one.width, other.width), min(1.0, facing))


def _is_clear(strip: Strip, occupied: Mask, free: Mask) -> bool:
    """Return whether a strip's cells are free."""
    low = np.maximum(np.floor(strip.corners.min(axis=0)).astype(int), 0)
    high = np.ceil(strip.corners.max(axis=0)).astype(int) + 1
    mask = np.zeros((high - low)[::-1], np.uint8)
    cv2.fillPoly(mask, [np.rint(strip.corners - low).astype(np.int32)], 1)
    window = (slice(low[1], high[1]), slice(low[0], high[0]))
    inside = mask[: occupied[window].shape[0], : occupied[window].shape[1]] == 1
    count = np.count_nonzero(inside)
    blocked = np.count_nonzero(inside & occupied[window])
    return bool(count and blocked <= (1.0 - CLEAR) * count and np.count_nonzero(inside & free[window]) >= 0.8 * count)
