"""Check of a map's network for edges that cross obstacles."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from app.errors import FleetMapError, Invalid, MissingDatum, Problem
from app.model import masks
from app.model.bends import is_identified
from app.model.features import Features, Properties
from app.model.grid import UNKNOWN, OccupancyGrid, is_occupied, unknown_grey_as_unknown
from app.model.layers import MAP, Layers, PartKey
from app.model.obstacles import object_footprint
from app.model.solids import Solids

Array = NDArray[np.float64]

BODIES = frozenset({"building", "wall", "fence", "barrier", "railing", "hedge", "rack", "shelf", "container"})
"""Kinds with a ground plan that robots cannot cross."""

CLEARANCE_METRES = 2.0
"""Minimum height of an underside that robots pass under, in metres."""

MIN_CROSSING_METRES = 0.1
"""Minimum length of an edge inside a ground plan, in metres."""

END_METRES = 1e-6
"""Maximum distance between an edge's end and a stretch inside a ground plan that begins or ends there, in metres."""

MAX_EDGES, MAX_BODIES = 500_000, 50_000
"""Maximum number of cells and bodies that are checked per level, so that maps stay fast."""

SAMPLES, MAX_SAMPLES = 2**20, 2**25
"""Maximum number of points along edges looked up at once, and in total: longer networks have a wider spacing."""

MAX_LISTED = 5


def crossings(networks: Layers, around: Layers, *, shape_of: str | None = None) -> list[Problem]:
    """Warn of edges that cross occupied cells of their level's grid, or buildings and walls in its unknown cells.

    Args:
        networks: the network as it is stored, before bent edges are split.
        around: the grids and objects that are in memory.
        shape_of: a format with shapes that its consumers ignore: robots drive straight along edges that it identifies.

    Networks on earth are not checked if there is no datum, or if the datum is too far away.
    """
    out: list[Problem] = []
    for key, part in networks.vector("topology").items():
        grids = {k: g for k, g in around.grids().items() if k.level == key.level}
        grid_key = obstacle_grid(grids)
        grid = None if grid_key is None else grids[grid_key]
        bodies = ground_plans(around, key.level, is_body)
        edges = [k for k, p in enumerate(part.properties) if p.get("kind") == "edge"][:MAX_EDGES]
        if not edges or (grid is None and not bodies):
            continue
        try:
            geometry = part.in_local(networks.frame)
        except (MissingDatum, Invalid):
            continue
        lines = _courses(part, geometry, edges, shape_of)
        blocked = np.zeros(len(edges), bool)
        if grid is not None and grid_key is not None:
            segments, owner = line_segments(lines)
            blocked[owner[_crossed_cells(segments, grid)[0]]] = True
            name = f"occupied cells of the occupancy grid {grid_key.name!r}"
            out += _problems([part.ids[edges[n]] for n in np.flatnonzero(blocked).tolist()], name, key)
        hit = np.zeros(len(edges), bool)
        hit[plan_crossings(lines, bodies, grid).line] = True
        hit &= ~blocked
        out += _problems([part.ids[edges[n]] for n in np.flatnonzero(hit).tolist()], "buildings or walls", key)
    return out


def _problems(ids: Sequence[str], obstacles: str, key: PartKey) -> list[Problem]:
    if not ids:
        return []
    count = "1 edge crosses" if len(ids) == 1 else f"{len(ids)} edges cross"
    named = ", ".join(ids[:MAX_LISTED]) + (" …" if len(ids) > MAX_LISTED else "")
    reason = f"{count} {obstacles}: {named}; a robot that follows the network meets an obstacle there"
    return [Problem(reason, where=f"topology {key.level}/{key.name}")]


def _courses(
    part: Features, geometry: NDArray[np.object_], edges: Sequence[int], shape_of: str | None
) -> NDArray[np.object_]:
    """Return the lines that robots drive along edges, in metres."""
    lines = geometry[list(edges)]
    if shape_of is None:
        return lines
    lines = lines.copy()
    point = shapely.get_type_id(geometry) == 0
    nodes = {i: g for i, g, is_point in zip(part.ids, geometry, point, strict=True) if is_point and not g.is_empty}
    for n in np.flatnonzero(shapely.get_num_coordinates(lines) > 2).tolist():
        p = part.properties[edges[n]]
        ends = [nodes.get(str(p.get(word))) for word in ("source", "target")]
        if is_identified(p, shape_of) and ends[0] is not None and ends[1] is not None:
            lines[n] = shapely.LineString([(end.x, end.y) for end in ends if end is not None])
    return lines


def line_segments(lines: NDArray[np.object_]) -> tuple[Array, NDArray[np.int64]]:
    """Split lines into straight pieces, float64 [n, 2, 2], with the index of each piece's line."""
    at, owner = shapely.get_coordinates(lines, return_index=True)
    same = owner[1:] == owner[:-1]
    return np.stack([at[:-1], at[1:]], axis=1)[same], owner[:-1][same].astype(np.int64)


def obstacle_grid(grids: Mapping[PartKey, OccupancyGrid]) -> PartKey | None:
    """Return a level's grid of obstacles: ``map``, else the only one that is no costmap filter mask."""
    keys = [k for k, g in grids.items() if k.name not in masks.MASKS and masks.NAME not in g.properties]
    return next((k for k in keys if k.name == MAP), keys[0] if len(keys) == 1 else None)


def sample_points(segments: Array, step: float) -> Iterator[tuple[NDArray[np.int64], Array]]:
    """Yield points along straight pieces, about ``step`` metres apart, in blocks: indices of pieces, float64 [n, 2].

    Both ends of each piece are among them. Long networks have a wider spacing.
    """
    length = np.hypot(*(segments[:, 1] - segments[:, 0]).T)
    step = max(step, float(length.sum()) / MAX_SAMPLES)
    count = np.ceil(length / step).astype(np.int64) + 1
    bound = np.concatenate([[0], np.cumsum(count)])
    begin = 0
    while begin < len(segments):
        end = max(begin + 1, int(np.searchsorted(bound, bound[begin] + SAMPLES, side="right")) - 1)
        number = np.repeat(np.arange(begin, end), count[begin:end])
        share = (np.arange(len(number)) + bound[begin] - bound[number]) / (count[number] - 1).clip(1)
        yield number, segments[number, 0] + (segments[number, 1] - segments[number, 0]) * share[:, None]
        begin = end


def cells_at(grid: OccupancyGrid, points: Array) -> NDArray[np.uint8]:
    """Return the values of the cells at points in metres, float64 [n, 2]; UNKNOWN outside of the grid."""
    x, y, yaw = grid.origin
    cosine, sine = np.cos(yaw), np.sin(yaw)
    turned = (points - np.array([x, y])) @ np.array([[cosine, -sine], [sine, cosine]])
    column, row = np.floor(turned / grid.resolution).astype(np.int64).T
    inside = (row >= 0) & (row < grid.height) & (column >= 0) & (column < grid.width)
    out = np.full(len(points), UNKNOWN, np.uint8)
    out[inside] = grid.cells[row[inside], column[inside]]  # not of the whole grid, which may have 300 million cells
    return out


def _crossed_cells(segments: Array, grid: OccupancyGrid) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which pieces cross an occupied cell, and which an unknown one or the outside of the grid.

    They are sampled at half the cell size.
    """
    grid = unknown_grey_as_unknown(grid)
    hit, unseen = np.zeros(len(segments), bool), np.zeros(len(segments), bool)
    for number, points in sample_points(segments, grid.resolution / 2):
        cells = cells_at(grid, points)
        hit[number[is_occupied(grid, cells)]] = True
        unseen[number[cells == UNKNOWN]] = True
    return hit, unseen


@dataclass(frozen=True, slots=True)
class GroundPlan:
    """Ground that an object covers, in metres. id: of the object."""

    id: str
    area: Any


def ground_plans(around: Layers, level: str, is_chosen: Callable[[Properties], bool]) -> list[GroundPlan]:
    """Return the ground plans of a level's chosen objects."""
    out: list[GroundPlan] = []
    solids = Solids({})
    for part in around.vector("objects", level).values():
        rows = [k for k, p in enumerate(part.properties) if is_chosen(p)]
        chosen = part.select(rows[: MAX_BODIES - len(out)])
        try:
            shapes = chosen.in_local(around.frame)
        except (MissingDatum, Invalid):
            continue
        for item, p, geometry in zip(chosen.ids, chosen.properties, shapes, strict=True):
            try:
                area = object_footprint({**p, "shapes": None}, geometry, solids)
            except FleetMapError:  # invalid shapes or pose: its derivations report it
                continue
            if area is not None and not area.is_empty:
                out.append(GroundPlan(item, area))
    return out


@dataclass(frozen=True, slots=True)
class PlanCrossings:
    """Lines that cross ground plans: index of the line, index of the plan, and a point on the stretch inside."""

    line: NDArray[np.int64]
    plan: NDArray[np.int64]
    points: Array


def plan_crossings(
    lines: NDArray[np.object_], plans: Sequence[GroundPlan], grid: OccupancyGrid | None
) -> PlanCrossings:
    """Return where lines cross ground plans, except for the way from an end inside to the outside.

    grid: of the obstacles: a line whose cells are all known in it crosses no plan.
    """
    if not plans or not len(lines):
        return PlanCrossings(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 2)))
    grounds = np.array([plan.area for plan in plans], object)
    owner, ground = shapely.STRtree(grounds).query(lines, predicate="crosses")
    inside = shapely.line_merge(shapely.intersection(lines[owner], grounds[ground]))
    parts, pair = shapely.get_parts(inside, return_index=True)
    is_long = shapely.length(parts) >= MIN_CROSSING_METRES
    parts, owner, ground = parts[is_long], owner[pair[is_long]], ground[pair[is_long]]
    passing = np.ones(len(parts), bool)
    for index in (0, -1):
        ends = shapely.get_point(lines[owner], index)
        passing &= ~(shapely.distance(parts, ends) <= END_METRES)
    parts, owner, ground = parts[passing], owner[passing], ground[passing]
    if grid is not None:
        segments, number = line_segments(parts)
        unknown = np.zeros(len(parts), bool)
        unknown[number[_crossed_cells(segments, grid)[1]]] = True
        parts, owner, ground = parts[unknown], owner[unknown], ground[unknown]
    points = shapely.get_coordinates(shapely.line_interpolate_point(parts, 0.5, normalized=True))
    return PlanCrossings(owner.astype(np.int64), ground.astype(np.int64), points)


def is_body(properties: Properties) -> bool:
    """Return whether an object is a building or a wall that stands in the way of robots."""
    base = properties.get("base")
    raised = isinstance(base, (int, float)) and base >= CLEARANCE_METRES
    return str(properties.get("kind")) in BODIES and not raised
