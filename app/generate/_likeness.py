"""Ranges of a stored environment: rows, aisles and plants as its network, its objects or its grid show them.

Rows are parallel lines that lie beside each other: of objects that are longer than wide, of a network's edges, or of a
grid's obstacles, whichever shows them first in this order. Ways between rows are as far apart as rows.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from app.errors import CannotGenerate, Problem
from app.model.features import Features
from app.model.grid import OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.layers import Layers

Array = NDArray[np.float64]
Ranges = dict[str, tuple[float, float]]

MIN_LINES = 3
"""Minimum number of parallel lines that are rows."""

MIN_ROW_METRES = 2.0
MIN_ASPECT = 2.5
"""Minimum length of a row, and minimum ratio of its length and width."""

MAX_TURN = math.radians(8.0)
"""Maximum angle between rows."""

SAME_LINE_METRES = 0.35
"""Distance across the rows below which two lines are pieces of one row."""

MAX_SPACING_METRES = 12.0
"""Maximum distance between two rows of one field; more is a road between fields."""

COUNT_SHARE = 0.2
"""One environment has one number of rows: the range is this share of it to both sides."""

MAX_GRID_CELLS = 2**26

NOT_ROWS = frozenset({"wall", "building", "door", "lift", "tunnel", "region", "poi", "stairs", "window", "fence_line"})
PLANTS = frozenset({"tree", "plant", "vine", "bush", "crop"})


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Parallel lines.

    Attributes:
        ends: float64 [n, 2, 2], start and end (x, y) in metres.
        widths: float64 [n], metres, 0 if unknown.
        are_ways: whether they are between rows.
        changes: lengths of the edges from one row to the next, if a network says so.
    """

    ends: Array
    widths: Array
    are_ways: bool = False
    changes: Array | None = None


def measure(layers: Layers, names: Collection[str], label: str) -> Ranges:
    """Return (lowest, highest) of the quantities that an environment has: metres, degrees or numbers.

    names: wanted quantities. label: name of the environment, for the error.

    Raises CannotGenerate if it has none of them.
    """
    out: Ranges = {}
    for rows in (_objects(layers), _network(layers), _grid(layers)):
        for name, span in _of_rows(rows).items():
            out.setdefault(name, span)
    plants = _plants(layers)
    if plants is not None:
        out["plant_spacing"] = plants
    out = {name: span for name, span in out.items() if name in names}
    if not out:
        layer_names = ", ".join(sorted(layers.layers)) or "no layer"
        problem = (
            f"{label} has nothing to measure: it needs a network with at least {MIN_LINES} parallel ways, or at least "
            f"{MIN_LINES} parallel rows as objects or as obstacles of a grid; it has {layer_names}"
        )
        raise CannotGenerate(f"like: {problem}", [Problem(problem, where="like")])
    return out


def _of_rows(rows: Rows | None) -> Ranges:
    """Return what parallel lines show."""
    if rows is None or len(rows.ends) < MIN_LINES:
        return {}
    direction = _direction(rows.ends)
    ends, widths = _turned(rows.ends, direction), rows.widths
    slope = np.abs(np.arctan2(ends[:, 1, 1] - ends[:, 0, 1], ends[:, 1, 0] - ends[:, 0, 0]))
    straight = np.minimum(slope, math.pi - slope) <= MAX_TURN
    ends, widths = ends[straight], widths[straight]
    groups = _lines(ends)
    if len(groups) < MIN_LINES:
        return {}
    across = np.array([float(ends[group, :, 1].mean()) for group in groups])
    spacing = np.diff(across)
    near = spacing <= MAX_SPACING_METRES
    if np.count_nonzero(near) < MIN_LINES - 1:
        return {}
    lengths = np.array([float(np.ptp(ends[group, :, 0])) for group in groups])
    count = len(groups) + (1 if rows.are_ways else 0)
    if rows.changes is not None:  # there may be ways on the rows too, for robots that pass over them
        count = round(float(np.ptp(across)) / float(np.median(rows.changes))) + 2
        spacing, near = rows.changes, rows.changes > 0
    slack = max(1, round(COUNT_SHARE * count))
    out: Ranges = {
        "row_spacing": _span(spacing[near]),
        "row_length": _span(lengths),
        "rows": (max(2, count - slack), count + slack),
        "angle": (round(math.degrees(direction) % 180.0, 1),) * 2,
    }
    wide = np.array([float(np.median(widths[group])) for group in groups])
    if (wide > 0).all():
        depth = float(np.median(wide))
        clear = spacing[near] - depth
        if (clear > 0).any():
            out["aisle"] = _span(clear[clear > 0])
        out["rack_depth"] = (round(depth / 2, 3),) * 2
    return out


def _span(values: Array) -> tuple[float, float]:
    """Return the range of values without the outliers of one in ten."""
    low, high = np.percentile(values, [10, 90])
    return round(float(low), 3), round(float(high), 3)


def _direction(ends: Array) -> float:
    """Return the direction that most metres of lines have, in radians."""
    step = ends[:, 1] - ends[:, 0]
    length, turn = np.hypot(*step.T), np.arctan2(step[:, 1], step[:, 0]) % math.pi
    bins = np.arange(180) * math.pi / 180
    away = (np.abs(turn - one) for one in bins)  # one at a time: a network may have a million edges
    weight = [float(length[np.minimum(a, math.pi - a) <= MAX_TURN].sum()) for a in away]
    best = bins[int(np.argmax(weight))]
    away = np.abs(turn - best)
    near = np.minimum(away, math.pi - away) <= MAX_TURN
    twice = 2 * turn[near]
    mean = math.atan2(float((length[near] * np.sin(twice)).sum()), float((length[near] * np.cos(twice)).sum())) / 2
    return round(mean % math.pi, 6)


def _turned(ends: Array, direction: float) -> Array:
    """Return the ends along and across a direction."""
    c, s = math.cos(direction), math.sin(direction)
    return np.asarray(ends @ np.array([[c, -s], [s, c]]), np.float64)


def _lines(ends: Array) -> list[NDArray[np.intp]]:
    """Return the pieces of each row, by their position across; rows shorter than the minimum are left out."""
    middle = ends[:, :, 1].mean(axis=1)
    order = np.argsort(middle, kind="stable")
    breaks = np.flatnonzero(np.diff(middle[order]) > SAME_LINE_METRES) + 1
    groups = np.split(order, breaks)
    long = [group for group in groups if np.ptp(ends[group, :, 0]) >= MIN_ROW_METRES]
    if not long:
        return []
    usual = float(np.median([np.ptp(ends[group, :, 0]) for group in long]))
    return [group for group in long if np.ptp(ends[group, :, 0]) >= usual / 3]


def _objects(layers: Layers) -> Rows | None:
    """Return the objects that are longer than wide."""
    ends, widths = [], []
    for part in layers.vector("objects").values():
        for shape, properties in zip(part.in_local(layers.frame), part.properties, strict=True):
            if properties.get("kind") in NOT_ROWS:
                continue
            axis = _axis(shape)
            if axis is not None:
                ends.append(axis[0])
                widths.append(axis[1])
    return Rows(np.array(ends), np.array(widths)) if ends else None


def _axis(shape: Any) -> tuple[Array, float] | None:
    """Return (ends, width) of a shape that is longer than wide."""
    if shape.is_empty:
        return None
    if shape.geom_type == "LineString":
        ends = shapely.get_coordinates(shape)[[0, -1]]
        long = float(np.hypot(*(ends[1] - ends[0])))
        return (ends, 0.0) if long >= max(MIN_ROW_METRES, 0.9 * shape.length) else None
    if shape.geom_type != "Polygon":
        return None
    corners = shapely.get_coordinates(shapely.minimum_rotated_rectangle(shape))
    if len(corners) < 5:
        return None
    first, second = (float(np.hypot(*(corners[k + 1] - corners[k]))) for k in (0, 1))
    a, b, c, d = corners[:4] if first >= second else np.roll(corners[:4], -1, axis=0)
    long, wide = max(first, second), min(first, second)
    if long < MIN_ROW_METRES or long < MIN_ASPECT * wide:
        return None
    return np.array([(a + d) / 2, (b + c) / 2]), wide


def _network(layers: Layers) -> Rows | None:
    """Return the edges of the networks; those that traverse rows if there are any."""
    ends: list[Array] = []
    actions: list[str] = []
    for part in layers.vector("topology").values():
        edges: Features = part.select_kinds("edge")
        for line, properties in zip(edges.in_local(layers.frame), edges.properties, strict=True):
            corners = shapely.get_coordinates(line)
            if len(corners) >= 2 and not np.allclose(corners[0], corners[-1]):
                ends.append(corners[[0, -1]])
                actions.append(str(properties.get("action")))
    if not ends:
        return None
    kinds, lines = np.array(actions), np.array(ends)
    along, change = lines[kinds == "row_traversal"], lines[kinds == "row_change"]
    chosen = along if len(along) >= MIN_LINES else lines
    changes = np.hypot(*(change[:, 1] - change[:, 0]).T) if len(change) >= MIN_LINES - 1 else None
    return Rows(chosen, np.zeros(len(chosen)), are_ways=True, changes=changes)


def _grid(layers: Layers) -> Rows | None:
    """Return the obstacles of the first grid that are longer than wide."""
    grid = next((g for key, g in layers.grids().items() if key.name == "map"), None)
    if grid is None or grid.cells.size > MAX_GRID_CELLS:
        return None
    import cv2

    full = (grid.cells != UNKNOWN) & (grid.cells >= grid.occupied_thresh * OCCUPIED)
    outlines, _ = cv2.findContours(full.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    ends, widths = [], []
    for outline in outlines:
        (x, y), (w, h), turn = cv2.minAreaRect(outline)
        long, wide = (max(w, h) + 1) * grid.resolution, (min(w, h) + 1) * grid.resolution
        if long < MIN_ROW_METRES or long < MIN_ASPECT * wide:
            continue
        yaw = math.radians(turn if w >= h else turn + 90.0)
        half = np.array([math.cos(yaw), math.sin(yaw)]) * max(w, h) / 2
        ends.append(_in_metres(grid, [np.array([x, y]) - half, np.array([x, y]) + half]))
        widths.append(wide)
    return Rows(np.array(ends), np.array(widths)) if ends else None


def _in_metres(grid: OccupancyGrid, cells: Sequence[Array]) -> Array:
    x, y, yaw = grid.origin
    c, s = math.cos(yaw), math.sin(yaw)
    at = (np.array(cells) + 0.5) * grid.resolution
    return np.column_stack([x + c * at[:, 0] - s * at[:, 1], y + s * at[:, 0] + c * at[:, 1]])


def _plants(layers: Layers) -> tuple[float, float] | None:
    """Return the range of distances from a plant to the next one."""
    from scipy import spatial

    points: list[Any] = []
    for part in layers.vector("objects").values():
        chosen = part.select(np.array([p.get("kind") in PLANTS for p in part.properties], bool))
        shapes = chosen.in_local(layers.frame)
        points += [shapely.get_coordinates(shapely.centroid(s))[0] for s in shapes if s.geom_type != "LineString"]
    if len(points) < 2 * MIN_LINES:
        return None
    away, _ = spatial.cKDTree(np.array(points)).query(np.array(points), k=2)
    return _span(away[:, 1])
