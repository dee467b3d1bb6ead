"""Impact of a change: edges deleted, blocked and turned, nodes moved, docks and parts cut off."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from app.model.crossings import cells_at
from app.model.grid import OccupancyGrid, is_occupied
from app.model.layers import Layers
from app.review.docks import Dock, find_docks
from app.review.findings import point
from app.review.graph_rules import middle
from app.review.network import Floats, Mask, Network, Reach, build_network, reach, weak_groups
from app.review.obstacle_rules import (
    KeepoutZone,
    first_hits,
    keepout_masks,
    keepout_zones,
    level_obstacles,
    zone_crossings,
)

MOVED_METRES = 1e-3
"""Distance by which a node has moved, in metres; less is rounding."""

MAX_SAMPLE = 20
"""Number of ids that stand for a part that is cut off."""

Xy = tuple[float, float]
ItemKey = tuple[str, str]
"""Level and id."""

Why = Literal["cannot be reached", "cannot be left", "has no connection"]


@dataclass(frozen=True, slots=True)
class Blocked:
    """Edge that is blocked now: by the cells of a grid or mask, by a zone, or because it is marked (neither)."""

    id: str
    level: str
    position: Xy | None
    grid: str | None = None
    zone: str | None = None


@dataclass(frozen=True, slots=True)
class Moved:
    """Node at another position. distance: metres from its former one."""

    id: str
    level: str
    distance: float


@dataclass(frozen=True, slots=True)
class LostDock:
    """Dock that is deleted, or that robots can no longer enter or leave."""

    id: str
    name: str
    level: str
    why: str


@dataclass(frozen=True, slots=True)
class CutOff:
    """Part of the network that was connected and no longer is. position: of its first node."""

    nodes: int
    sample: tuple[str, ...]
    level: str
    position: Xy | None
    why: Why


@dataclass(frozen=True, slots=True)
class _Obstruction:
    """What is newly in the way on a level: a grid or mask with its earlier state, or areas of zones."""

    level: str
    name: str
    grid: OccupancyGrid | None = None
    before: OccupancyGrid | None = None
    area: shapely.Geometry | None = None

    def covers(self, x: float, y: float) -> bool:
        """Return whether a position is free before and obstructed now."""
        if self.area is not None:
            return bool(shapely.contains_xy(self.area, x, y))
        if self.grid is None:
            return False
        at = np.array([[x, y]])
        was = self.before is not None and bool(is_occupied(self.before, cells_at(self.before, at))[0])
        return bool(is_occupied(self.grid, cells_at(self.grid, at))[0]) and not was


@dataclass
class Comparison:
    """Two states of a site, and what the change means for robots. Lists are in the order of parts and ids."""

    before: Layers
    after: Layers
    old: Network = field(init=False)
    new: Network = field(init=False)

    def __post_init__(self) -> None:
        self.old, self.new = build_network(self.before), build_network(self.after)

    @cached_property
    def old_edges(self) -> dict[ItemKey, int]:
        """Index of each former edge."""
        return {(edge.key.level, edge.id): k for k, edge in enumerate(self.old.edges)}

    @cached_property
    def new_edges(self) -> dict[ItemKey, int]:
        """Index of each edge."""
        return {(edge.key.level, edge.id): k for k, edge in enumerate(self.new.edges)}

    @cached_property
    def old_nodes(self) -> dict[ItemKey, int]:
        """Index of each former node."""
        return {(node.key.level, node.id): k for k, node in enumerate(self.old.nodes)}

    @cached_property
    def new_nodes(self) -> dict[ItemKey, int]:
        """Index of each node."""
        return {(node.key.level, node.id): k for k, node in enumerate(self.new.nodes)}

    @cached_property
    def deleted_edges(self) -> list[ItemKey]:
        """Edges that no longer exist."""
        return [key for key in self.old_edges if key not in self.new_edges]

    @cached_property
    def deleted_nodes(self) -> list[ItemKey]:
        """Nodes that no longer exist."""
        return [key for key in self.old_nodes if key not in self.new_nodes]

    @cached_property
    def moved(self) -> list[Moved]:
        """Nodes at another position."""
        out = []
        for key, k in self.new_nodes.items():
            if key in self.old_nodes:
                gap = float(np.hypot(*(self.new.xy[k] - self.old.xy[self.old_nodes[key]])))
                if gap > MOVED_METRES:
                    out.append(Moved(key[1], key[0], round(gap, 4)))
        return out

    @cached_property
    def turned(self) -> list[ItemKey]:
        """Edges whose direction changed: other ends, or the edge the opposite way was added or deleted."""
        was, now = _directions(self.old), _directions(self.new)
        out = []
        for key, k in self.new_edges.items():
            if key not in self.old_edges:
                continue
            ends = self.new.edges[k].properties.get("source"), self.new.edges[k].properties.get("target")
            earlier = self.old.edges[self.old_edges[key]].properties
            pair = frozenset(map(str, ends))
            if ends != (earlier.get("source"), earlier.get("target")) or was.get(pair) != now.get(pair):
                out.append(key)
        return out

    @cached_property
    def obstructions(self) -> list[_Obstruction]:
        """What is newly in the way."""
        out: list[_Obstruction] = []
        for level in self.new.levels:
            grids: dict[str, tuple[OccupancyGrid | None, OccupancyGrid]] = {}
            obstacles, former = level_obstacles(self.after, level), level_obstacles(self.before, level)
            if obstacles is not None:
                grids[obstacles[0]] = (None if former is None else former[1], obstacles[1])
            masks = keepout_masks(self.before, level)
            grids |= {name: (masks.get(name), mask) for name, mask in keepout_masks(self.after, level).items()}
            out += [
                _Obstruction(level, name, grid, before)
                for name, (before, grid) in grids.items()
                if before is None or not _is_same_grid(before, grid)
            ]
            earlier = {zone.id: zone.area for zone in keepout_zones(self.before, level)}
            fresh = [z for z in keepout_zones(self.after, level) if not _is_same_area(earlier.get(z.id), z.area)]
            covered = shapely.union_all(list(earlier.values())) if fresh else None
            for zone in fresh:
                area = shapely.difference(zone.area, covered)
                if not area.is_empty:
                    out.append(_Obstruction(level, zone.id, area=area))
        return out

    @cached_property
    def blocked(self) -> list[Blocked]:
        """Edges that were open and are blocked now, each with the first reason."""
        out: dict[int, Blocked] = {}
        rows = [
            (k, self.old_edges[key])
            for key, k in self.new_edges.items()
            if key in self.old_edges and self.old.is_open[self.old_edges[key]]
        ]
        for k, _ in rows:
            edge = self.new.edges[k]
            if edge.properties.get("blocked") is True:
                out[k] = Blocked(edge.id, edge.key.level, middle(self.new, k))
        for level in self.new.levels:
            flat = self.new.is_flat & (self.new.edge_levels == level)
            rows_here = [(k, j) for k, j in rows if k not in out and flat[k]]
            for k, blocked in self._obstructed(level, np.array(rows_here, np.int64).reshape(-1, 2)):
                out.setdefault(k, blocked)
        return [out[k] for k in sorted(out)]

    def _obstructed(self, level: str, rows: NDArray[np.int64]) -> Iterator[tuple[int, Blocked]]:
        """Yield edges that something new obstructs, then those that moved into something. rows: new and old index."""
        lines, former = self.new.lines[rows[:, 0]], self.old.lines[rows[:, 1]]
        for cause in self.obstructions:
            if cause.level != level:
                continue
            for n, at in _hits(lines, cause):
                yield self._blocked(int(rows[n, 0]), cause, at)
        moved = np.flatnonzero(~shapely.equals_exact(lines, former, MOVED_METRES))
        if not len(moved):
            return
        for cause, earlier in self._standing(level):
            passed = {n for n, _ in _hits(former[moved], earlier)} if earlier is not None else set()
            for n, at in _hits(lines[moved], cause):
                if n not in passed:
                    yield self._blocked(int(rows[moved[n], 0]), cause, at)

    def _standing(self, level: str) -> Iterator[tuple[_Obstruction, _Obstruction | None]]:
        """Yield all obstacles of a level, each with its earlier state."""
        obstacles, former = level_obstacles(self.after, level), level_obstacles(self.before, level)
        if obstacles is not None:
            earlier = None if former is None else _Obstruction(level, former[0], former[1])
            yield _Obstruction(level, *obstacles), earlier
        masks = keepout_masks(self.before, level)
        for name, mask in keepout_masks(self.after, level).items():
            yield _Obstruction(level, name, mask), _Obstruction(level, name, masks[name]) if name in masks else None
        zones = {zone.id: zone.area for zone in keepout_zones(self.before, level)}
        for zone in keepout_zones(self.after, level):
            was = _Obstruction(level, zone.id, area=zones[zone.id]) if zone.id in zones else None
            yield _Obstruction(level, zone.id, area=zone.area), was

    def _blocked(self, k: int, cause: _Obstruction, at: Floats) -> tuple[int, Blocked]:
        edge = self.new.edges[k]
        names = (cause.name, None) if cause.area is None else (None, cause.name)
        return k, Blocked(edge.id, edge.key.level, point(at), *names)

    @cached_property
    def usable(self) -> Mask:
        """Which edges robots can use now."""
        names = {(blocked.level, blocked.id) for blocked in self.blocked}
        out: Mask = self.new.is_open & ~np.array([(e.key.level, e.id) in names for e in self.new.edges], bool)
        return out

    @cached_property
    def reach(self) -> Reach:
        """Connection of the nodes now."""
        return reach(self.new, self.usable)

    @cached_property
    def lost(self) -> Mask:
        """Which nodes were connected to the largest part of their network, both ways, and no longer are."""
        was = reach(self.old, self.old.is_open)
        out = np.zeros(len(self.new.nodes), bool)
        for key, k in self.new_nodes.items():
            j = self.old_nodes.get(key)
            if j is not None and was.both[j] and not was.trivial[j]:
                out[k] = not self.reach.both[k] or self.reach.trivial[k]
        return out

    @cached_property
    def parts(self) -> list[CutOff]:
        """Parts that are cut off, the largest first."""
        out = []
        for group in weak_groups(self.new, self.usable, self.lost):
            ids = tuple(self.new.nodes[k].id for k in group[:MAX_SAMPLE].tolist())
            first = self.new.nodes[int(group[0])]
            position = point(self.new.xy[group[0]])
            out.append(CutOff(len(group), ids, first.key.level, position, self._why_lost(int(group[0]))))
        return out

    def _why_lost(self, k: int) -> Why:
        if self.reach.trivial[k] or not (self.reach.from_main[k] or self.reach.to_main[k]):
            return "has no connection"
        return "cannot be left" if self.reach.from_main[k] else "cannot be reached"

    @cached_property
    def docks(self) -> list[LostDock]:
        """Docks that are gone or cut off."""
        left = find_docks(self.after)
        out = []
        for (key, item), dock in find_docks(self.before).items():
            why = self._why_dock_lost(dock, is_left=(key, item) in left)
            if why is not None:
                out.append(LostDock(item, dock.name, key.level, why))
        return out

    def _why_dock_lost(self, dock: Dock, *, is_left: bool) -> str | None:
        level = dock.key.level
        if not is_left:
            exists = dock.key.layer == "topology" and (level, dock.id) in self.new_nodes
            return "is no longer marked as a dock" if exists else "is deleted"
        nodes = [self.new_nodes.get((level, node)) for node in dock.nodes]
        if nodes and all(k is None for k in nodes) and any((level, node) in self.old_nodes for node in dock.nodes):
            return "all its nodes are deleted"
        nodes_left = [k for k in nodes if k is not None]
        if nodes_left and all(self.lost[k] for k in nodes_left):
            return self._why_lost(nodes_left[0])
        return None


def _directions(network: Network) -> Mapping[frozenset[str], set[tuple[str, str]]]:
    """Return the directions in which edges connect each pair of nodes."""
    out: dict[frozenset[str], set[tuple[str, str]]] = defaultdict(set)
    for edge in network.edges:
        ends = (str(edge.properties.get("source")), str(edge.properties.get("target")))
        out[frozenset(ends)].add(ends)
    return out


def _hits(lines: NDArray[np.object_], cause: _Obstruction) -> Iterator[tuple[int, Floats]]:
    """Yield the lines that something obstructs, with the first point."""
    if cause.grid is not None:
        at = first_hits(lines, cause.grid, cause.before)
        for n in np.flatnonzero(np.isfinite(at[:, 0])).tolist():
            yield n, at[n]
    else:
        for n, _, at in zone_crossings(lines, [KeepoutZone(cause.name, cause.area)]):
            yield n, at


def _is_same_grid(one: OccupancyGrid, other: OccupancyGrid) -> bool:
    frame = (one.cells.shape, one.origin, one.resolution, one.occupied_thresh)
    same = frame == (other.cells.shape, other.origin, other.resolution, other.occupied_thresh)
    return same and np.array_equal(one.cells, other.cells)


def _is_same_area(one: shapely.Geometry | None, other: shapely.Geometry) -> bool:
    return one is not None and bool(shapely.equals_exact(one, other, MOVED_METRES))
