"""Reach of a robot: the free space of a grid, the clearance along lines, the reachable nodes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from app.model import raster
from app.model.grid import FREE, UNKNOWN, OccupancyGrid
from app.model.raster import RasterFrame

Array = NDArray[np.float64]

MAX_CLEARANCE_METRES = 20.0
"""Maximum free width in metres that is measured."""


def keep_largest_space(cells: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], int]:
    """Keep the largest piece of free cells (joined by their sides); set others to unknown and return their number."""
    import cv2

    free = cells == FREE
    count, label, stats, _ = cv2.connectedComponentsWithStats(free.astype(np.uint8), connectivity=4)
    if count <= 2:
        return cells, 0
    largest = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    shut = free & (label != largest)
    out = cells.copy()
    out[shut] = UNKNOWN
    return out, int(np.count_nonzero(shut))


def passable(grid: OccupancyGrid, lines: Sequence[Any], radius: float) -> NDArray[np.bool_]:
    """Return which lines and points (metres) a robot of a radius can follow: bool [n].

    Every cell on them is in the grid, and farther than the radius from any cell that is not free, between centres: it
    is outside of inflated obstacles. The grid's yaw is 0.
    """
    import cv2

    blocked = np.pad(grid.cells != FREE, 1, constant_values=True)
    away = cv2.distanceTransform((~blocked).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    frame = RasterFrame((grid.origin[0], grid.origin[1]), grid.resolution, grid.width, grid.height)
    at, owner = shapely.get_coordinates(np.array(lines, object), return_index=True)
    cells = frame.to_cells(at)
    good = np.ones(len(lines), bool)
    outside = ((cells < 0) | (cells > [grid.width, grid.height])).any(axis=1)
    good[owner[outside]] = False
    # consecutive vertices, and each vertex with itself, so that points count too
    same = owner[1:] == owner[:-1]
    edges = np.concatenate([np.stack([at[:-1], at[1:]], axis=1)[same], np.stack([at, at], axis=1)])
    number = np.concatenate([owner[:-1][same], owner])
    for spans in raster.lines(edges, frame):
        index, row, column = raster.expand_spans(spans)
        near = away[row, column] <= radius / grid.resolution + 1e-4
        good[number[index[near]]] = False
    return good


def clearance(grid: OccupancyGrid, lines: Sequence[Any]) -> Array:
    """Return the free width along lines in metres, at most MAX_CLEARANCE_METRES: float64 [n].

    It is twice the distance to the nearest cell that is not free, rounded down to centimetres.
    """
    out = np.full(len(lines), MAX_CLEARANCE_METRES)
    if not len(lines):
        return out
    blocked = np.pad(grid.cells != FREE, 1, constant_values=True)
    rim = blocked.copy()
    rim[1:-1, 1:-1] &= ~(blocked[:-2, 1:-1] & blocked[2:, 1:-1] & blocked[1:-1, :-2] & blocked[1:-1, 2:])
    step = np.diff(np.pad(rim, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    (row, first), (_, end) = np.nonzero(step == 1), np.nonzero(step == -1)
    x, y, r = grid.origin[0], grid.origin[1], grid.resolution
    boxes = shapely.box(x + (first - 1) * r, y + (row - 1) * r, x + (end - 1) * r, y + row * r)
    pairs, distance = shapely.STRtree(boxes).query_nearest(
        np.array(lines, object), max_distance=MAX_CLEARANCE_METRES / 2, return_distance=True, all_matches=False
    )
    out[pairs[0]] = np.floor(np.round(2 * distance, 6) * 100) / 100
    return np.asarray(np.minimum(out, MAX_CLEARANCE_METRES), np.float64)


def unreachable_nodes(names: Sequence[str], edges: Iterable[tuple[str, str]]) -> list[str]:
    """Return the nodes that no path reaches from the first one."""
    following: dict[str, list[str]] = {name: [] for name in names}
    for a, b in edges:
        following[a].append(b)
    seen, waiting = set(names[:1]), list(names[:1])
    while waiting:
        for name in following[waiting.pop()]:
            if name not in seen:
                seen.add(name)
                waiting.append(name)
    return [name for name in names if name not in seen]
