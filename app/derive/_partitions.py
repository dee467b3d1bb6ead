"""Wide openings in partitions: where two rooms meet, although the opening is wider than a room is deep.

The distance to walls does not dip there, so that no basin ends (``_rooms``). As ROSE² (Luperto et al., IROS 2022)
divides rooms along the lines of walls, a partition is a wall that stands in the ground, with ground on both of its
faces; where it goes on behind a gap on the same line, the gap is a border between rooms.
"""

from __future__ import annotations

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray

Mask = NDArray[np.bool_]
Points = NDArray[np.float64]

MAX_GAP = 6.0
"""Widest opening that is a border between rooms, in metres; wider, both are one room with a piece of wall in it."""

STUB = 0.5
"""Minimum length in metres of the wall on each side of an opening."""

WALL = 0.6
"""Maximum thickness of a partition in metres; thicker is a block, or ground that was not seen."""

SOLID = 0.7
"""Minimum share of the wall beside an opening that has ground on both of its faces."""

STRAIGHT = 0.15
"""Maximum distance in metres of a face's cells from a straight line."""

OFFSET = 0.25
"""Maximum distance in metres of the shorter of two faces of one wall from the line of the longer."""


def borders(wall: Mask, ground: Mask, narrowest: float, share: float, cell: float) -> Mask:
    """Return the cells of lines across wide openings of partitions.

    narrowest: minimum width of openings in metres. share: minimum length of the walls beside an opening, as a share of
    its width. cell: metres.
    """
    out = np.zeros(wall.shape, np.uint8)
    middles: list[Points] = []
    for one, other, along, reach in zip(*_pairs(_faces(wall, cell), narrowest, share, cell), strict=True):
        if (
            _is_clear(one, other, wall, ground)
            and _is_partition(one, -reach[0] * along, ground, cell)
            and _is_partition(other, reach[1] * along, ground, cell)
            and all(np.hypot(*(middle - (one + other) / 2)) > 2 * WALL / cell for middle in middles)
        ):
            middles.append((one + other) / 2)  # the other faces of the wall have the same opening
            ends = [np.rint(end).astype(int).tolist() for end in (one - along, other + along)]
            cv2.line(out, ends[0], ends[1], 1, 3)
    return np.asarray((out == 1) & ground)


def _pairs(faces: Points, narrowest: float, share: float, cell: float) -> tuple[Points, Points, Points, Points]:
    """Return the gaps between faces that lie on one line.

    Their beginnings and ends (x, y in cells [n, 2]), directions [n, 2], and how much of both faces counts [n, 2].
    """
    tree = shapely.STRtree(shapely.points(faces[:, 0]))
    # faces have their ground on the same side: where one ends, the next on its line begins
    pairs = tree.query(shapely.points(faces[:, 1]), predicate="dwithin", distance=MAX_GAP / cell)
    first, second = pairs[:, np.lexsort((pairs[1], pairs[0]))]
    length = np.hypot(*(faces[:, 1] - faces[:, 0]).T)
    longer = np.where(length[first] >= length[second], first, second)
    along = (faces[longer, 1] - faces[longer, 0]) / length[longer, None]
    gap = ((faces[second, 0] - faces[first, 1]) * along).sum(axis=1)
    reach = np.minimum(np.stack([length[first], length[second]], axis=1), gap[:, None])
    ahead = [((faces[k, 1] - faces[k, 0]) * along).sum(axis=1) for k in (first, second)]
    apart = np.concatenate([faces[first], faces[second]], axis=1) - faces[longer, :1]
    aside = np.abs(apart[..., 0] * along[:, None, 1] - apart[..., 1] * along[:, None, 0]).max(axis=1, initial=0.0)
    fits = (gap > narrowest / cell) & (reach.sum(axis=1) >= share * gap) & (aside <= OFFSET / cell)
    fits &= (ahead[0] > 0) & (ahead[1] > 0)
    return faces[first, 1][fits], faces[second, 0][fits], along[fits], reach[fits]


def _faces(wall: Mask, cell: float) -> Points:
    """Return the straight faces of walls, as their ends x, y in cells [n, 2, 2], with the ground on the same side."""
    contours, _ = cv2.findContours(wall.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    out = []
    for contour in contours:
        corners = cv2.approxPolyDP(contour, STRAIGHT / cell, closed=True)[:, 0].astype(np.float64)
        ends = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
        out.append(ends[np.hypot(*(ends[:, 1] - ends[:, 0]).T) >= STUB / cell])
    return np.concatenate([np.zeros((0, 2, 2)), *out])


def _at(mask: Mask, points: Points) -> Mask:
    """Return the values of a mask at points x, y."""
    x, y = np.moveaxis(np.rint(points).astype(int), -1, 0)
    return np.asarray(mask[np.clip(y, 0, mask.shape[0] - 1), np.clip(x, 0, mask.shape[1] - 1)])


def _is_clear(a: NDArray[np.float64], b: NDArray[np.float64], wall: Mask, ground: Mask) -> bool:
    """Return whether the line between two faces crosses ground and no wall."""
    count = int(np.hypot(*(b - a)))
    between = a + (b - a) * np.linspace(0.0, 1.0, count)[2:-2, None]
    return bool(not _at(wall, between).any() and _at(ground, between).all())


def _is_partition(end: NDArray[np.float64], reach: NDArray[np.float64], ground: Mask, cell: float) -> bool:
    """Return whether there is ground on both sides of a wall. reach: from the end of its face along it."""
    places = end + np.linspace(0.1, 0.9, 9)[:, None] * reach
    across = np.array([-reach[1], reach[0]]) / np.hypot(*reach)
    depths = np.arange(1, WALL / cell + 3)[:, None] * across
    sides = [_at(ground, places[:, None] + sign * depths).any(axis=1) for sign in (-1, 1)]
    return bool((sides[0] & sides[1]).mean() >= SOLID)
