"""Rules on obstacle stands in a robot's way: occupied cells, buildings, keepout areas, objects."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from app.derive.zones_to_occupancy import KEEPOUTS
from app.errors import Invalid, MissingDatum
from app.model import masks
from app.model.crossings import (
    BODIES,
    CLEARANCE_METRES,
    MIN_CROSSING_METRES,
    cells_at,
    ground_plans,
    is_body,
    line_segments,
    obstacle_grid,
    plan_crossings,
    sample_points,
)
from app.model.features import Properties
from app.model.grid import OccupancyGrid, is_occupied
from app.model.layers import Layers
from app.model.obstacles import object_role
from app.review.findings import MAX_IDS, Finding, Site, name_list, point
from app.review.fixes import Fixer
from app.review.network import Floats


def first_hits(lines: NDArray[np.object_], grid: OccupancyGrid, before: OccupancyGrid | None = None) -> Floats:
    """Return the first point of each line in an occupied cell, sampled at half a cell: float64 [n, 2], NaN for none.

    before: an earlier grid; cells that were occupied in it do not count.
    """
    out = np.full((len(lines), 2), np.nan)
    segments, owner = line_segments(lines)
    for number, points in sample_points(segments, grid.resolution / 2):
        hit = is_occupied(grid, cells_at(grid, points))
        if before is not None and hit.any():
            hit[hit] = ~is_occupied(before, cells_at(before, points[hit]))
        line, first = np.unique(owner[number[hit]], return_index=True)
        fresh = np.isnan(out[line, 0])
        out[line[fresh]] = points[hit][first[fresh]]
    return out


@dataclass(frozen=True, slots=True)
class KeepoutZone:
    """Area that robots must not enter, in metres."""

    id: str
    area: Any


def keepout_zones(layers: Layers, level: str) -> list[KeepoutZone]:
    """Return the keepout zones of a level."""
    out: list[KeepoutZone] = []
    for part in layers.vector("zones", level).values():
        kinds = np.array([str(p.get("kind")).lower() in KEEPOUTS for p in part.properties], bool)
        chosen = part.select(kinds & np.isin(shapely.get_type_id(part.geometry), (3, 6)))
        try:
            shapes = shapely.make_valid(chosen.in_local(layers.frame))
        except (MissingDatum, Invalid):
            continue
        out += [KeepoutZone(item, area) for item, area in zip(chosen.ids, shapes, strict=True)]
    return out


def keepout_masks(layers: Layers, level: str) -> dict[str, OccupancyGrid]:
    """Return the keepout masks of a level by name."""
    return {key.name: grid for key, grid in layers.grids(level).items() if masks.is_keepout(key.name, grid.properties)}


def _finding(level: str, ids: tuple[str, ...], obstacle: str, at: Floats, item: str | None = None) -> Finding:
    """Build a finding about the edges along one line, and the object in their way."""
    named = f"the edge {ids[0][:80]} crosses" if len(ids) == 1 else f"the edges {name_list(ids)} cross"
    if item is None:
        return Finding("topology", level, ids[:MAX_IDS], f"{named} {obstacle}", point(at))
    return Finding("objects", level, (*ids[: MAX_IDS - 1], item), f"{named} {obstacle}", point(at))


def level_obstacles(layers: Layers, level: str) -> tuple[str, OccupancyGrid] | None:
    """Return name and grid of the obstacles of a level: ``map``, else the only one that is no mask."""
    grids = layers.grids(level)
    key = obstacle_grid(grids)
    return None if key is None else (key.name, grids[key])


def edges_through_obstacles(site: Site, _: Fixer) -> Iterator[Finding]:
    """Edges through occupied cells, and through buildings and walls where no cell is known."""
    for level in site.levels:
        ways = site.level(level).ways
        around = level_obstacles(site.layers, level)
        hit = np.zeros(len(ways.ids), bool)
        if around is not None:
            at = first_hits(ways.lines, around[1])
            hit = np.isfinite(at[:, 0])
            for n in np.flatnonzero(hit).tolist():
                yield _finding(level, ways.ids[n], f"occupied cells of the grid {around[0][:80]!r}", at[n])
        for n, item, at_body in _object_hits(site, level, is_body):
            if not hit[n]:
                yield _finding(level, ways.ids[n], item[:80], at_body)


def objects_on_edges(site: Site, _: Fixer) -> Iterator[Finding]:
    """Furniture, trees, poles, water and other objects that are no buildings, on an edge."""
    for level in site.levels:
        for n, item, at in _object_hits(site, level, _is_loose):
            yield _finding(level, site.level(level).ways.ids[n], item[:80], at, item)


def _object_hits(site: Site, level: str, is_chosen: Callable[[Properties], bool]) -> Iterator[tuple[int, str, Floats]]:
    """Yield the ways on the ground that cross objects: index of the way, id of the object, and a point inside."""
    ways, around = site.level(level).ways, level_obstacles(site.layers, level)
    plans = ground_plans(site.layers, level, is_chosen)
    index = np.flatnonzero(ways.on_ground)
    hits = plan_crossings(ways.lines[index], plans, None if around is None else around[1])
    seen: set[tuple[int, int]] = set()
    for line, plan, at in zip(index[hits.line].tolist(), hits.plan.tolist(), hits.points, strict=True):
        if (line, plan) not in seen:
            seen.add((line, plan))
            yield line, plans[plan].id, at


def _is_loose(properties: Properties) -> bool:
    """Return whether an object is an obstacle on the ground that is no building or wall."""
    base = properties.get("base")
    if str(properties.get("kind")) in BODIES or (isinstance(base, (int, float)) and base >= CLEARANCE_METRES):
        return False
    return object_role(properties) in ("outline", "solids")


def edges_through_keepouts(site: Site, _: Fixer) -> Iterator[Finding]:
    """Edges through keepout zones, and through the cells of keepout masks."""
    for level in site.levels:
        ways = site.level(level).ways
        crossed = np.zeros(len(ways.ids), bool)
        zones = keepout_zones(site.layers, level)
        for n, zone, at in zone_crossings(ways.lines, zones):
            if not crossed[n]:
                crossed[n] = True
                yield _finding(level, ways.ids[n], f"the keepout zone {zones[zone].id[:80]}", at)
        for name, mask in keepout_masks(site.layers, level).items():
            hits = first_hits(ways.lines, mask)
            for n in np.flatnonzero(np.isfinite(hits[:, 0]) & ~crossed).tolist():
                crossed[n] = True
                yield _finding(level, ways.ids[n], f"the keepout mask {name[:80]!r}", hits[n])


def zone_crossings(lines: NDArray[np.object_], zones: list[KeepoutZone]) -> Iterator[tuple[int, int, Floats]]:
    """Yield the lines that lead through zones: index of the line, of the zone, and a point inside."""
    if not zones or not len(lines):
        return
    areas = np.array([zone.area for zone in zones], object)
    line, zone = shapely.STRtree(areas).query(lines, predicate="intersects")
    inside = shapely.intersection(lines[line], areas[zone])
    deep = shapely.length(inside) >= MIN_CROSSING_METRES
    middles = shapely.get_coordinates(shapely.point_on_surface(inside[deep]))
    yield from zip(line[deep].tolist(), zone[deep].tolist(), middles, strict=True)
