"""Rules on the graph of a network: names, duplicates, dead ends, parts that are cut off."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from typing import Any

import numpy as np
import shapely

from app.formats.rmf.common import BUILDING
from app.model.features import Properties, unique_ids
from app.review.findings import MAX_IDS, Finding, Fix, Site, name_list, point
from app.review.fixes import Fixer
from app.review.lifts import graph_index
from app.review.network import Indices, Item, Network, Reach, reach, weak_groups

SAME_METRES = 0.01
"""Maximum distance between two lines that are the same, in metres."""

ZERO_METRES = 1e-3
"""Maximum length of an edge of length zero, in metres."""


def node_finding(network: Network, k: int, detail: str, fix: Fix | None = None) -> Finding:
    """Build a finding about one node."""
    node = network.nodes[k]
    return Finding("topology", node.key.level, (node.id,), detail, point(network.xy[k]), fix)


def middle(network: Network, k: int) -> tuple[float, float] | None:
    """Return the middle of an edge in metres."""
    line = network.lines[k]
    if line.is_empty or line.geom_type != "LineString":
        return None
    return point(shapely.get_coordinates(line.interpolate(0.5, normalized=True))[0])


def duplicate_names(site: Site, fixer: Fixer) -> Iterator[Finding]:
    """Several nodes of a level with one name: a robot that is sent to the name may go to any of them."""
    network = site.network
    by_name: dict[tuple[str, str, str], list[int]] = defaultdict(list)
    for k, node in enumerate(network.nodes):
        name = node.properties.get("name")
        if isinstance(name, str) and name:
            by_name[node.key.level, node.key.name, name].append(k)
    taken = {name for _, _, name in by_name}
    for (_, _, name), members in by_name.items():
        if len(members) < 2:
            continue
        ids = tuple(network.nodes[k].id for k in members)
        # long lists would take a fix of their own size: the first ones are renamed, the next check finds the rest
        fix = None
        if len(members) <= MAX_IDS:
            names = unique_ids([name] * (len(members) - 1), taken)
            changes = [fixer.rename(network.nodes[k], new) for k, new in zip(members[1:], names, strict=True)]
            fix = fixer.build(f"Rename {len(changes)} of them to {name_list(names)}", tuple(changes))
        detail = f"{len(members)} nodes are called {name[:80]!r}: {name_list(ids)}"
        yield Finding(
            "topology", network.nodes[members[0]].key.level, ids[:MAX_IDS], detail, point(network.xy[members[0]]), fix
        )


def duplicate_edges(site: Site, fixer: Fixer) -> Iterator[Finding]:
    """Several edges from one node to another along the same line, with the same action."""
    network = site.network
    by_ends: dict[tuple[int, int, str, int | None], list[int]] = defaultdict(list)
    whole = np.flatnonzero(network.is_whole)
    ends = network.source[whole] * len(network.nodes) + network.target[whole]
    _, group, counts = np.unique(ends, return_inverse=True, return_counts=True)
    for k in whole[counts[group] > 1].tolist():
        p = network.edges[k].properties
        by_ends[int(network.source[k]), int(network.target[k]), str(p.get("action")), graph_index(p)].append(k)
    for members in by_ends.values():
        first, *others = members
        same = [k for k in others if _is_same_line(network.lines[first], network.lines[k])]
        if not same:
            continue
        ids = tuple(network.edges[k].id for k in (first, *same))
        changes = tuple(fixer.delete(network.edges[k]) for k in same[:MAX_IDS])
        detail = f"{len(ids)} edges lead the same way: {name_list(ids)}"
        level = network.edges[first].key.level
        fix = fixer.build(f"Delete {name_list(ids[1:])}", changes) if len(same) <= MAX_IDS else None
        yield Finding("topology", level, ids[:MAX_IDS], detail, middle(network, first), fix)


def _is_same_line(one: Any, other: Any) -> bool:
    if one.is_empty or other.is_empty:
        return bool(one.is_empty and other.is_empty)
    return bool(shapely.hausdorff_distance(one, other) <= SAME_METRES)


def dead_ends(site: Site, fixer: Fixer) -> Iterator[Finding]:
    """Nodes that robots can enter but not leave."""
    network = site.network
    for k, entry in _dead_ends(network).items():
        edge = network.edges[entry]
        node, before = network.nodes[k], network.nodes[int(network.source[entry])]
        line = shapely.reverse(network.lines[entry])
        fix = None
        if not line.is_empty:
            back = fixer.add_edge(edge, node.id, before.id, line, edge.properties)
            fix = fixer.build(f"Add an edge back to {before.id[:80]}", (back,))
        yield node_finding(network, k, f"edges lead to {node.id[:80]}, but none leads away: a robot cannot leave", fix)


def _dead_ends(network: Network) -> dict[int, int]:
    """Return the nodes with edges to them and none from them, each with the first edge to it."""
    usable = np.flatnonzero(network.is_open & (network.source != network.target))
    leaving = np.bincount(network.source[usable], minlength=len(network.nodes))
    out: dict[int, int] = {}
    for edge in usable.tolist():
        target = int(network.target[edge])
        if not leaving[target]:
            out.setdefault(target, edge)
    return out


def isolated_nodes(site: Site, fixer: Fixer) -> Iterator[Finding]:
    """Nodes without any edge."""
    network = site.network
    for k in np.flatnonzero(_is_isolated(network)).tolist():
        node = network.nodes[k]
        if is_corner(node.properties):
            continue
        fix = fixer.build(f"Delete the node {node.id[:80]}", (fixer.delete(node),))
        yield node_finding(network, k, f"no edge begins or ends at {node.id[:80]}", fix)


def is_corner(properties: Properties) -> bool:
    """Return whether a node may be the corner of a wall: in Open-RMF's buildings these are nodes without a name."""
    return not properties.get("name") and BUILDING in properties


def _is_isolated(network: Network) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    ends = np.concatenate([network.source, network.target])
    counts = np.bincount(ends[ends >= 0], minlength=len(network.nodes))
    lonely: np.ndarray[tuple[int], np.dtype[np.bool_]] = counts == 0
    return lonely


def unreachable_parts(site: Site, fixer: Fixer) -> Iterator[Finding]:
    """Parts of a network to which, or from which, no way leads; single dead ends are not listed again."""
    network = site.network
    if not len(network.nodes):
        return
    around = reach(network, network.is_open)
    chosen = ~around.both & ~_is_isolated(network)
    chosen[list(_dead_ends(network))] = False
    for group in weak_groups(network, network.is_open, chosen):
        ids = tuple(network.nodes[k].id for k in group.tolist())
        arrives, leaves = bool(around.from_main[group].any()), bool(around.to_main[group].any())
        reason = (
            "can be entered but not left"
            if arrives and not leaves
            else "can be left but not reached"
            if leaves and not arrives
            else "can be passed, but not entered and left again"
            if arrives
            else "has no connection to the rest of its network"
        )
        count = f"a part of {len(ids)} nodes" if len(ids) > 1 else "a node"
        first = network.nodes[int(group[0])]
        fix = _way_back(network, fixer, group, around)
        yield Finding(
            "topology",
            first.key.level,
            ids[:MAX_IDS],
            f"{count} {reason}: {name_list(ids)}",
            point(network.xy[group[0]]),
            fix,
        )


def _way_back(network: Network, fixer: Fixer, group: Indices, around: Reach) -> Fix | None:
    """Return an edge back along the one that connects a part, if the part is strongly connected itself."""
    if len(set(around.group[group].tolist())) > 1:
        return None
    inside = np.zeros(len(network.nodes), bool)
    inside[group] = True
    k = np.flatnonzero(network.is_open & (shapely.get_type_id(network.lines) == 1))
    a, b = network.source[k], network.target[k]
    links = k[(inside[a] & around.main[b]) | (inside[b] & around.main[a])]
    if not len(links):
        return None
    link = int(links[0])
    edge = network.edges[link]
    ends: tuple[Item, Item] = (network.nodes[int(network.target[link])], network.nodes[int(network.source[link])])
    back = fixer.add_edge(edge, ends[0].id, ends[1].id, shapely.reverse(network.lines[link]), edge.properties)
    return fixer.build(f"Add an edge from {ends[0].id[:80]} to {ends[1].id[:80]}", (back,))


def zero_lengths(site: Site, fixer: Fixer) -> Iterator[Finding]:
    """Edges of no length on one level."""
    network = site.network
    if not len(network.edges):
        return
    short = network.is_flat & (shapely.length(network.lines) <= ZERO_METRES)
    for k in np.flatnonzero(short).tolist():
        edge, loop = network.edges[k], network.source[k] == network.target[k]
        fix = fixer.build(f"Delete the edge {edge.id[:80]}", (fixer.delete(edge),)) if loop else None
        ends = "leads from a node to itself" if loop else "connects two nodes at one position"
        yield Finding(
            "topology", edge.key.level, (edge.id,), f"the edge {edge.id[:80]} has no length: it {ends}",
            middle(network, k), fix,
        )  # fmt: skip
