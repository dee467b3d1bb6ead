"""Robots that a change touches: by their place, their node or their route."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Literal

import numpy as np
import shapely

from app.event_types import Pose, RobotPlace
from app.review.impact import Comparison

NEAR_METRES = 0.5
"""Distance of a robot's pose from something deleted or blocked that touches it, in metres."""

MAX_REASONS = 10

Touch = Literal["touched", "clear", "unknown"]


@dataclass(frozen=True, slots=True)
class RobotImpact:
    """Whether a change touches a robot, and why. edges: those of its route that are affected."""

    state: Touch
    why: tuple[str, ...] = ()
    edges: tuple[str, ...] = ()


class RobotTouch:
    """Looks up robots' places in a comparison."""

    def __init__(self, comparison: Comparison) -> None:
        self._c = comparison
        self._edges: dict[str, str] = {}
        for _, item in comparison.turned:
            self._edges[item] = "has another direction"
        for blocked in comparison.blocked:
            self._edges[blocked.id] = "is blocked"
        for _, item in comparison.deleted_edges:
            self._edges[item] = "is deleted"
        self._nodes: dict[str, str] = {}
        for moved in comparison.moved:
            if moved.distance >= NEAR_METRES:
                self._nodes[moved.id] = f"moves by {moved.distance:.2f} m"
        for part in np.flatnonzero(comparison.lost).tolist():
            self._nodes[comparison.new.nodes[part].id] = "is cut off"
        for _, item in comparison.deleted_nodes:
            self._nodes[item] = "is deleted"

    def judge(self, place: RobotPlace | None) -> RobotImpact:
        """Judge a robot by its last place; unknown if it reported none, or only ids that no version has."""
        if place is None or not self._is_known(place):
            return RobotImpact("unknown", ("it has not reported a place in this network",))
        why: list[str] = []
        if place.node is not None and place.node in self._nodes:
            why.append(f"its node {place.node[:80]} {self._nodes[place.node]}")
        edges: list[str] = []
        for item, reason in self._route(place.route or ()):
            if item in self._edges:
                edges.append(item)
                why.append(f"the edge {item[:80]} of its route {reason}")
            else:
                why.append(f"the node {item[:80]} of its route {reason}")
        if place.pose is not None:
            why += self._around(place.pose)
        unique = tuple(dict.fromkeys(why))
        return RobotImpact("touched" if why else "clear", unique[:MAX_REASONS], tuple(dict.fromkeys(edges)))

    def _is_known(self, place: RobotPlace) -> bool:
        ids = ((place.node,) if place.node is not None else ()) + (place.route or ())
        return place.pose is not None or any(item in self._known_ids for item in ids)

    @cached_property
    def _known_ids(self) -> set[str]:
        networks = (self._c.old, self._c.new)
        return {item.id for network in networks for item in (*network.nodes, *network.edges)}

    @cached_property
    def _edges_by_ends(self) -> dict[tuple[str, str], list[str]]:
        out: dict[tuple[str, str], list[str]] = defaultdict(list)
        for edge in self._c.old.edges:
            out[str(edge.properties.get("source")), str(edge.properties.get("target"))].append(edge.id)
        return out

    def _route(self, route: tuple[str, ...]) -> Iterator[tuple[str, str]]:
        """Yield the affected items of a route; between two nodes in a row the edges that connect them count."""
        for item in route:
            if item in self._edges or item in self._nodes:
                yield item, self._edges.get(item) or self._nodes[item]
        for pair in pairwise(route):
            ways = self._edges_by_ends.get(pair, [])
            if ways and all(item in self._edges for item in ways):
                yield ways[0], self._edges[ways[0]]

    def _around(self, pose: Pose) -> Iterator[str]:
        """Yield what is deleted or blocked at a pose; without a level on any level."""
        for cause in self._c.obstructions:
            if pose.level in (None, cause.level) and cause.covers(pose.x, pose.y):
                kind = "newly occupied cells of the grid" if cause.area is None else "the new keepout zone"
                yield f"it is in {kind} {cause.name[:80]}"
        tree, items = self._affected
        for n in tree.query(shapely.Point(pose.x, pose.y), predicate="dwithin", distance=NEAR_METRES).tolist():
            level, text = items[n]
            if pose.level in (None, level):
                yield f"it is near {text}"

    @cached_property
    def _affected(self) -> tuple[shapely.STRtree, list[tuple[str, str]]]:
        """Deleted and blocked edges and deleted nodes: a tree of their shapes, and level and text of each."""
        c = self._c
        shapes: list[shapely.Geometry] = []
        items: list[tuple[str, str]] = []
        for level, item in c.deleted_edges:
            shapes.append(c.old.lines[c.old_edges[level, item]])
            items.append((level, f"the edge {item[:80]}, which is deleted"))
        for level, item in c.deleted_nodes:
            if not np.isfinite(c.old.xy[c.old_nodes[level, item]]).all():
                continue
            shapes.append(shapely.Point(c.old.xy[c.old_nodes[level, item]]))
            items.append((level, f"the node {item[:80]}, which is deleted"))
        for blocked in c.blocked:
            if blocked.position is not None:
                shapes.append(shapely.Point(blocked.position))
                items.append((blocked.level, f"the place where the edge {blocked.id[:80]} is blocked"))
        return shapely.STRtree(shapes), items
