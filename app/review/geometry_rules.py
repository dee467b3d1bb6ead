"""Rules on the geometry of a network: near-misses, crossings without a node, lifts, the fence."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from app.model.fences import fences, level_fence
from app.model.frame import GROUND
from app.review.findings import MAX_IDS, Finding, Site, name_list, point
from app.review.fixes import Fixer
from app.review.graph_rules import is_corner
from app.review.levels import BLOCK, NEAR_METRES, LevelNetwork, height_tags
from app.review.network import Floats, Indices, Network

MAX_PAIRS = 2**21
"""Maximum number of neighbouring pairs that one rule compares: more are in no real network."""

STACK_METRES = 1.0
"""Maximum horizontal distance between the stops of a lift, in metres."""

FENCE_METRES = 0.5


def near_pairs(
    site: Site, tree: shapely.STRtree, geometries: NDArray[np.object_], distance: float | None
) -> Iterator[tuple[Indices, Indices]]:
    """Yield blocks of (index of a geometry, index in the tree) within a distance, or that cross (distance None)."""
    left = MAX_PAIRS
    for begin in range(0, len(geometries), BLOCK):
        block = geometries[begin : begin + BLOCK]
        if distance is None:
            ours, theirs = tree.query(block, predicate="crosses")
        else:
            ours, theirs = tree.query(block, predicate="dwithin", distance=distance)
        yield (ours + begin).astype(np.int64), theirs.astype(np.int64)
        left -= len(ours)
        if left < 0:
            site.truncated = True
            return


def near_misses(site: Site, fixer: Fixer) -> Iterator[Finding]:
    """Nodes close to an edge or to another node that they are not connected to."""
    for level in site.levels:
        around = site.level(level)
        if around.near > 0:
            yield from _nodes_near_edges(site, around, fixer)
            yield from _nodes_near_nodes(site, around, fixer)


def _nodes_near_edges(site: Site, around: LevelNetwork, fixer: Fixer) -> Iterator[Finding]:
    network = site.network
    points = np.asarray(shapely.points(network.xy[around.nodes]), object).reshape(len(around.nodes))
    for ours, theirs in near_pairs(site, around.tree, points, around.near):
        for node, n in zip(around.nodes[ours].tolist(), theirs.tolist(), strict=True):
            edge = around.edges[n]
            ends = (int(network.source[edge]), int(network.target[edge]))
            if node in ends or not around.neighbours[node].isdisjoint(ends):
                continue
            if not around.neighbours[node] and is_corner(network.nodes[node].properties):
                continue
            if min(float(np.hypot(*(network.xy[node] - network.xy[end]))) for end in ends) <= around.near:
                continue  # it is near a node: found as such
            yield _near_edge(network, node, edge, around.twins[edge], fixer)


def _near_edge(network: Network, node: int, edge: int, twins: list[int], fixer: Fixer) -> Finding:
    item, at = network.nodes[node], (float(network.xy[node, 0]), float(network.xy[node, 1]))
    changes = [change for twin in twins[:BLOCK] for change in fixer.split(twin, item.id, at)]
    gap = float(shapely.distance(network.lines[edge], shapely.Point(at)))
    ids = (item.id, *(network.edges[twin].id for twin in twins[: MAX_IDS - 1]))
    detail = f"{item.id[:80]} is {gap:.2f} m from the edge {ids[1][:80]}, but not connected to it"
    fix = fixer.build(f"Split the edge at {item.id[:80]}", tuple(changes))
    return Finding("topology", item.key.level, ids, detail, point(network.xy[node]), fix)


def _nodes_near_nodes(site: Site, around: LevelNetwork, fixer: Fixer) -> Iterator[Finding]:
    network = site.network
    points = np.asarray(shapely.points(network.xy[around.nodes]), object).reshape(len(around.nodes))
    tree = shapely.STRtree(points)
    for ours, theirs in near_pairs(site, tree, points, around.near):
        for a, b in zip(around.nodes[ours].tolist(), around.nodes[theirs].tolist(), strict=True):
            if a >= b or b in around.neighbours[a] or not around.neighbours[a].isdisjoint(around.neighbours[b]):
                continue
            if not around.neighbours[a] or not around.neighbours[b]:
                continue  # a node without edges is found as such
            one, other = network.nodes[a], network.nodes[b]
            line = shapely.LineString([network.xy[a], network.xy[b]])
            changes = [
                fixer.add_edge(one, one.id, other.id, line),
                fixer.add_edge(one, other.id, one.id, shapely.reverse(line)),
            ]
            detail = f"{one.id[:80]} and {other.id[:80]} are {line.length:.2f} m apart, but not connected"
            fix = fixer.build("Connect the two nodes", tuple(changes))
            yield Finding("topology", one.key.level, (one.id, other.id), detail, point(network.xy[a]), fix)


def crossing_edges(site: Site, fixer: Fixer) -> Iterator[Finding]:
    """Edges of a level that cross where they have no common node; bridges and tunnels may."""
    network = site.network
    for level in site.levels:
        around = site.level(level)
        for ours, theirs in near_pairs(site, around.tree, around.lines, None):
            for m, n in zip(ours.tolist(), theirs.tolist(), strict=True):
                if m >= n:
                    continue
                one, other = around.edges[m], around.edges[n]
                if height_tags(network.edges[one].properties) != height_tags(network.edges[other].properties):
                    continue
                finding = _crossing(network, one, other, around, fixer)
                if finding is not None:
                    yield finding


def _crossing(network: Network, one: int, other: int, around: LevelNetwork, fixer: Fixer) -> Finding | None:
    shared = {int(network.source[one]), int(network.target[one])} & {
        int(network.source[other]),
        int(network.target[other]),
    }
    places = shapely.get_coordinates(shapely.intersection(network.lines[one], network.lines[other]))
    inner = [at for at in places if all(np.hypot(*(at - network.xy[node])) > NEAR_METRES for node in shared)]
    if not inner:
        return None
    ids = (network.edges[one].id, network.edges[other].id)
    detail = f"the edges {ids[0][:80]} and {ids[1][:80]} cross without a node"
    fix = None
    if len(inner) == 1:
        at, item = (float(inner[0][0]), float(inner[0][1])), network.edges[one]
        node = fixer.new_id(f"{ids[0]}_x_{ids[1]}"[:100])
        twins = (*around.twins[one][:BLOCK], *around.twins[other][:BLOCK])
        changes = [fixer.add_node(item, at, node)] + [c for twin in twins for c in fixer.split(twin, node, at)]
        fix = fixer.build("Add a node where they cross", tuple(changes))
    return Finding("topology", network.edges[one].key.level, ids, detail, point(inner[0]), fix)


def lifts_that_do_not_stack(site: Site, fixer: Fixer) -> Iterator[Finding]:
    """Stops of one lift that are not above each other."""
    network = site.network
    stops: dict[str, list[int]] = defaultdict(list, {name: list(members) for name, members in network.lifts.items()})
    for k in np.flatnonzero(network.is_whole).tolist():
        a, b = int(network.source[k]), int(network.target[k])
        if network.node_levels[a] != network.node_levels[b] and network.edges[k].properties.get("action") == "lift":
            stops[f"\0{min(a, b)}-{max(a, b)}"] += [a, b]
    seen: set[int] = set()
    for name, members in sorted(stops.items()):
        first, *others = sorted(set(members), key=lambda k: (network.nodes[k].key.level != GROUND, k))
        for k in others:
            gap = float(np.hypot(*(network.xy[k] - network.xy[first])))
            if not gap > STACK_METRES or network.node_levels[k] == network.node_levels[first] or k in seen:
                continue
            seen.add(k)
            node, base = network.nodes[k], network.nodes[first]
            at = (float(network.xy[first, 0]), float(network.xy[first, 1]))
            lift = "one lift" if name.startswith("\0") else f"the lift {name[:80]!r}"
            detail = (
                f"{node.id[:80]} on {node.key.level[:80]} is {gap:.2f} m aside of {base.id[:80]} on "
                f"{base.key.level[:80]}, but both are stops of {lift}"
            )
            fix = fixer.build(f"Move {node.id[:80]} above {base.id[:80]}", (fixer.move(node, at),))
            yield Finding("topology", node.key.level, (node.id, base.id), detail, point(network.xy[k]), fix)


def outside_fence(site: Site, _: Fixer) -> Iterator[Finding]:
    """Nodes outside of the site's fence, one finding for each level."""
    network = site.network
    borders = fences(site.layers, lambda *_, **__: None)
    for level in site.levels:
        fence: Any = level_fence(borders, level, GROUND)
        nodes = np.flatnonzero((network.node_levels == level) & np.isfinite(network.xy).all(axis=1))
        if fence is None or not len(nodes):
            continue
        shapely.prepare(fence)
        outside = nodes[~shapely.contains_xy(fence, network.xy[nodes])]
        gaps = shapely.distance(fence, _points(network.xy[outside]))
        outside, gaps = outside[gaps > FENCE_METRES], gaps[gaps > FENCE_METRES]
        if not len(outside):
            continue
        order = np.argsort(-gaps, kind="stable")
        ids = tuple(network.nodes[k].id for k in outside[order][:MAX_IDS].tolist())
        count = "1 node lies" if len(outside) == 1 else f"{len(outside)} nodes lie"
        detail = f"{count} outside the fence, up to {float(gaps.max()):.1f} m: {name_list(ids)}"
        yield Finding("topology", level, ids, detail, point(network.xy[outside[order[0]]]))


def _points(xy: Floats) -> NDArray[np.object_]:
    return np.asarray(shapely.points(xy), object).reshape(len(xy))
