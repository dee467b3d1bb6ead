"""Aisles and rows: long free strips between parallel lines of obstacles.

A line is a long thin obstacle that stands alone (a rack, a hedge, a row of vines), or a chain of at least ``CHAIN``
small ones at equal distances (posts of a tunnel, pallets, trunks, legs of a shelf). Where posts stand in a lattice,
the longest chains are the lines, since people plant and store along the longer side.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray

from app.derive._rooms import outer_contours

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

JOIN = 0.2
"""Gaps in metres within one obstacle: scans draw outlines in dashes."""

ALIKE = 0.12
"""Maximum deviation of a step from that of another chain, as a share of it."""

NEAREST = 10
"""Number of nearest obstacles among which neighbours in a chain are sought."""

MAX_PIECES = 10_000
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
    """Free strip. corners: float64 [4, 2] x, y in cells, the first two at one end. flanks: the lines beside it.
    facing: share of the shorter line that it covers."""

    corners: Points
    flanks: tuple[Line, Line]
    facing: float


def strips(occupied: Mask, free: Mask, cell: float) -> list[Strip]:
    """Return the strips of a grid. cell: metres."""
    lines = obstacle_lines(occupied, cell)
    drawn = np.array([shapely.LineString(line.ends) for line in lines], object)
    tree = shapely.STRtree(drawn)
    out = []
    pairs = tree.query(drawn, predicate="dwithin", distance=(MAX_GAP + WIDEST_LINE) / cell).T
    for i, k in sorted(pairs[pairs[:, 0] < pairs[:, 1]].tolist()):
        strip = _strip(lines[i], lines[k], cell)
        if strip is not None and _is_clear(strip, occupied, free) and not _is_divided(strip, lines, drawn, tree):
            out.append(strip)
    return out


def flank_cells(aisles: list[Strip], occupied: Mask) -> Mask:
    """Return the cells of the lines beside strips: racks and plants, which divide no rooms."""
    mask = np.zeros(occupied.shape, np.uint8)
    for line in (line for strip in aisles for line in strip.flanks):
        along = (line.ends[1] - line.ends[0]) / max(line.length, 1e-9)
        aside = np.array([-along[1], along[0]]) * (line.width / 2 + 1.0)
        ahead = along * 1.0
        (a, b) = line.ends
        corners = np.array([a - ahead - aside, b + ahead - aside, b + ahead + aside, a - ahead + aside])
        cv2.fillPoly(mask, [np.rint(corners).astype(np.int32)], 1)
    return np.asarray(mask == 1)


def _is_divided(strip: Strip, lines: list[Line], drawn: NDArray[np.object_], tree: Any) -> bool:
    """Return whether another line runs along a strip. drawn, tree: the lines as geometries, and their index."""
    inner = shapely.Polygon(strip.corners)
    length = float(np.hypot(*(strip.corners[3] - strip.corners[0])))
    near = [k for k in tree.query(inner).tolist() if all(lines[k] is not flank for flank in strip.flanks)]
    return bool((shapely.length(shapely.intersection(drawn[near], inner)) > length / 4).any())


def obstacle_lines(occupied: Mask, cell: float) -> list[Line]:
    """Return the lines of obstacles, the longest first."""
    size = 2 * max(1, round(JOIN / 2 / cell)) + 1
    joined = np.asarray(
        cv2.morphologyEx(occupied.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((size, size), np.uint8)), np.uint8
    )
    out: list[Line] = []
    middles: list[Points] = []
    sizes: list[float] = []
    for contour in outer_contours(joined):
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
        out += _chains(*_outermost(np.array(middles), np.array(sizes)), cell)
    return sorted(out, key=lambda line: (-line.length, *line.ends.ravel().tolist()))


def _outermost(middles: Points, sizes: NDArray[np.float64]) -> tuple[Points, NDArray[np.float64]]:
    """Drop obstacles that lie within a larger one's circle: goods on a pallet, legs of a shelf."""
    from scipy.spatial import cKDTree

    tree = cKDTree(middles)
    stays = np.ones(len(middles), bool)
    for k in np.argsort(-sizes, kind="stable").tolist():
        if stays[k]:
            inside = [n for n in tree.query_ball_point(middles[k], sizes[k] / 2) if n != k and sizes[n] <= sizes[k]]
            stays[inside] = False
    return middles[stays], sizes[stays]


def _chains(middles: Points, sizes: NDArray[np.float64], cell: float) -> list[Line]:
    """Return the chains of small obstacles, the longest first; each obstacle is in one.

    Chains are sought between nearest neighbours; then, since other obstacles may stand between, also between farther
    ones, in the directions and with the steps of the chains that were found.
    """
    from scipy.spatial import cKDTree

    if len(middles) < CHAIN:
        return []
    tree = cKDTree(middles)
    close = _neighbours(tree, middles, sizes, cell)
    chains = _longest(_walks(tree, middles, sizes, close, cell), middles, set(), cell)
    steps = [np.median(np.diff(middles[chain], axis=0), axis=0) for chain in chains]
    used = {k for chain in chains for k in chain}
    if steps:
        pairs = tree.query_pairs(PITCH / cell, output_type="ndarray")
        pairs = pairs[~np.isin(pairs, list(used)).any(axis=1)]
        pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
        apart = middles[pairs[:, 1]] - middles[pairs[:, 0]]
        alike = np.zeros(len(pairs), bool)
        for step in steps:
            off = np.minimum(np.hypot(*(apart - step).T), np.hypot(*(apart + step).T))
            alike |= off <= ALIKE * float(np.hypot(*step))
        chains += _longest(_walks(tree, middles, sizes, pairs[alike], cell), middles, used, cell)
    return [_chain_line(middles[chain], sizes[chain]) for chain in chains]


def _chain_line(middles: Points, sizes: NDArray[np.float64]) -> Line:
    """Return the line that fits a chain best, from the outer side of its first obstacle to that of its last."""
    centre = middles.mean(axis=0)
    along = np.linalg.svd(middles - centre)[2][0]
    along = along if along @ (middles[-1] - middles[0]) > 0 else -along
    begin = (middles[0] - centre) @ along - sizes[0] / 2
    end = (middles[-1] - centre) @ along + sizes[-1] / 2
    return Line(np.array([centre + begin * along, centre + end * along]), float(np.median(sizes)))


def _walks(
    tree: Any, middles: Points, sizes: NDArray[np.float64], pairs: NDArray[np.int64], cell: float
) -> list[list[int]]:
    """Return the chains that begin with pairs of obstacles of like size."""
    alike = _are_alike(sizes[pairs[:, 0]], sizes[pairs[:, 1]], cell)
    out: list[list[int]] = []
    seen: set[tuple[int, int]] = set()
    for a, b in pairs[alike].tolist():
        if (a, b) not in seen:
            chain = [*_walk(tree, middles, sizes, b, a, cell)[::-1], *_walk(tree, middles, sizes, a, b, cell)]
            seen.update((min(p), max(p)) for p in itertools.pairwise(chain))
            out.append(chain)
    return out


def _longest(chains: list[list[int]], middles: Points, used: set[int], cell: float) -> list[list[int]]:
    """Return the longest chains that hardly share obstacles."""
    used = set(used)
    out = []
    lengths = [float(np.hypot(*(middles[chain[-1]] - middles[chain[0]]))) for chain in chains]
    for length, chain in sorted(zip(lengths, chains, strict=True), key=lambda item: (-item[0], item[1])):
        if len(chain) >= CHAIN and length >= MIN_LENGTH / cell and len(used.intersection(chain)) <= len(chain) / 4:
            used.update(chain)
            out.append(chain)
    return out


def _are_alike(one: Any, other: Any, cell: float) -> NDArray[np.bool_]:
    """Return where two sizes may be those of the same kind of obstacle."""
    return np.asarray(np.maximum(one, other) <= 2.0 * np.minimum(one, other) + 0.1 / cell)


def _neighbours(tree: Any, middles: Points, sizes: NDArray[np.float64], cell: float) -> NDArray[np.int64]:
    """Return the pairs within reach of which no third obstacle of their size is nearer to both: int64 [n, 2].

    The relative neighbourhood graph (Toussaint, 1980): in a lattice its sides, and not its diagonals.
    """
    count = min(NEAREST + 1, len(middles))
    distance, index = tree.query(middles, k=count)
    near = np.stack([np.repeat(np.arange(len(middles)), count - 1), index[:, 1:].ravel()], axis=1)
    length = distance[:, 1:].ravel()
    near, length = near[length <= PITCH / cell], length[length <= PITCH / cell]
    pairs, first = np.unique(np.sort(near, axis=1), axis=0, return_index=True)
    length = length[first]
    good = np.ones(len(pairs), bool)
    for side in (0, 1):
        witness = index[pairs[:, side], 1:]
        to_own, to_other = (
            distance[pairs[:, side], 1:],
            np.hypot(*np.moveaxis(middles[witness] - middles[pairs[:, 1 - side]][:, None], 2, 0)),
        )
        alike = _are_alike(sizes[witness], sizes[pairs[:, side]][:, None], cell)
        good &= ~((to_own < 0.98 * length[:, None]) & (to_other < 0.98 * length[:, None]) & alike).any(axis=1)
    return np.asarray(pairs[good])


def _walk(tree: Any, middles: Points, sizes: NDArray[np.float64], first: int, second: int, cell: float) -> list[int]:
    """Continue from a pair of obstacles in equal steps; return those from the second on."""
    out = [second]
    step = middles[second] - middles[first]
    at = second
    while True:
        tolerance = ALIKE * float(np.hypot(*step)) + 0.05 / cell + sizes[at] / 4
        for times in (1, 2):  # one of them may not have been seen
            distance, k = tree.query(middles[at] + times * step)
            alike = bool(_are_alike(sizes[at], sizes[k], cell))
            if alike and distance <= times * tolerance and k not in out and k != first:
                break
        else:
            return out
        step = 0.7 * step + 0.3 * (middles[k] - middles[at]) / times
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
    if not shapely.Polygon([*corners[0], *corners[1]]).is_valid:
        return None  # the lines cross
    facing = (end - begin) / min(one.length, other.length)
    return Strip(np.array([*corners[0], *corners[1]]), (one, other), min(1.0, facing))


def _is_clear(strip: Strip, occupied: Mask, free: Mask) -> bool:
    """Return whether a strip's cells are free."""
    low = np.maximum(np.floor(strip.corners.min(axis=0)).astype(int) - 2, 0)  # a border, so that erosion begins there
    high = np.ceil(strip.corners.max(axis=0)).astype(int) + 3
    mask = np.zeros((high - low)[::-1], np.uint8)
    cv2.fillPoly(mask, [np.rint(strip.corners - low).astype(np.int32)], 1)
    mask = cv2.erode(mask, np.ones((5, 5), np.uint8))  # the lines beside it are as wide as their cells, or a step more
    window = (slice(low[1], high[1]), slice(low[0], high[0]))
    inside = mask[: occupied[window].shape[0], : occupied[window].shape[1]] == 1
    count = np.count_nonzero(inside)
    blocked = np.count_nonzero(inside & occupied[window])
    return bool(count and blocked <= (1.0 - CLEAR) * count and np.count_nonzero(inside & free[window]) >= 0.8 * count)
