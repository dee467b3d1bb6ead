"""Convert between graphs with undirected edges (``prm``, ``ffr_network``) and directed edges.

A line of the file becomes two directed edges: the first has the line's properties, the second has ``backward``; both
have ``line``, the line's index in the file, so that the writer can join them again. A line with ``oneway: true`` (our
extension: these formats have no such key) is one edge.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from app.formats import ReadContext, WriteContext
from app.formats._network import (
    Array,
    Edge,
    MergedNetwork,
    edge_lines,
    get_source_properties,
    natural_sort_key,
    shorten_list,
)
from app.model.features import Properties, unique_ids

ONEWAY = "oneway"
WORDS = ("action", "name", "speed_limit", "width")
"""Canonical edge properties that a line may have, too."""

NODE_CANONICAL = frozenset({"kind", "name", "drawn_from"})
EDGE_CANONICAL = frozenset({"kind", "source", "target", "drawn_from", *WORDS})


@dataclass(frozen=True, slots=True)
class Line:
    """A line of a file: indexes of its end nodes, and its other keys."""

    a: int
    b: int
    members: dict[str, Any]


def canonical(keys: Iterable[str], members: dict[str, Any]) -> dict[str, Any]:
    """Return the canonical properties among an item's members that have a value of the right type."""
    out: dict[str, Any] = {}
    for key in keys:
        value = members.get(key)
        if key in ("speed_limit", "width"):
            if isinstance(value, (int, float)) and not isinstance(value, bool):
                out[key] = value
        elif isinstance(value, str) and value:
            out[key] = value
    return out


def edges(
    lines: Sequence[Line], ids: Sequence[str], xyz: Array, name: str
) -> tuple[list[str], list[Any], list[Properties]]:
    """Convert lines to (ids, geometries, properties) of directed edges. ids, xyz: of the nodes. name: the format's."""
    rows: list[tuple[int, int]] = []
    properties: list[Properties] = []
    for k, line in enumerate(lines):
        canonical_members = canonical(WORDS, line.members)
        extra_members = {key: value for key, value in line.members.items() if key not in canonical_members}
        oneway = extra_members.get(ONEWAY) is True
        if oneway:
            del extra_members[ONEWAY]
        ends = {"source": ids[line.a], "target": ids[line.b]}
        properties.append(
            {
                "kind": "edge",
                **ends,
                **canonical_members,
                name: {**({"more": extra_members} if extra_members else {}), "line": k},
            }
        )
        rows.append((line.a, line.b))
        if not oneway and line.a != line.b:
            back = {"source": ids[line.b], "target": ids[line.a]}
            properties.append({"kind": "edge", **back, **canonical_members, name: {"line": k, "backward": True}})
            rows.append((line.b, line.a))
    edge_ids = unique_ids((f"{p['source']}-{p['target']}" for p in properties), set(ids))
    return edge_ids, list(edge_lines(xyz, [a for a, _ in rows], [b for _, b in rows])), properties


def lines(net: MergedNetwork, context: WriteContext, name: str) -> list[Line]:
    """Convert directed edges to lines, ordered by node index; declare what lines cannot express."""
    ordered = sorted(
        net.edges,
        key=lambda e: (get_source_properties(e.properties, name).get("backward") is True, natural_sort_key(e.id)),
    )
    pairs: list[tuple[Edge, Edge | None]] = []
    waiting = ordered
    for exact in (True, False):  # first the two edges of one line of a file, then any edge in the opposite direction
        open_: dict[tuple[Any, ...], list[Edge]] = defaultdict(list)
        closed: list[tuple[Edge, Edge]] = []
        for edge in waiting:
            key = get_source_properties(edge.properties, name).get("line") if exact else None
            key = key if isinstance(key, int) else None
            partners = open_[edge.target, edge.source, key]
            if edge.source != edge.target and partners and (key is not None or not exact):
                closed.append((partners.pop(0), edge))
            else:
                open_[edge.source, edge.target, key].append(edge)
        pairs += closed
        done = {id(e) for pair in closed for e in pair}
        waiting = [e for e in waiting if id(e) not in done]
    pairs += [(edge, None) for edge in waiting]
    dropped_count = differing = oneway = 0
    out = []
    for edge, back in pairs:
        dropped_count += bool(edge.properties.keys() - EDGE_CANONICAL - {name})
        canonical_members = canonical(WORDS, dict(edge.properties))
        if back is not None:
            differing += canonical_members != canonical(WORDS, dict(back.properties))
        more = get_source_properties(edge.properties, name).get("more")
        members = {**(more if isinstance(more, dict) else {}), **canonical_members}
        if back is None and edge.source != edge.target:
            members[ONEWAY] = True
            oneway += 1
        out.append(Line(edge.source, edge.target, members))
    context.drop("attributes of edges", dropped_count, "the format cannot store them")
    context.drop(
        "attributes of the opposite direction", differing, "a line has one set of attributes for both directions"
    )
    if oneway:
        reason = f"{oneway} edges are one-way, which the format cannot express: they are marked {ONEWAY}: true"
        context.warn(f"{reason}; other readers use them in both directions")
    return sorted(out, key=lambda line: (line.a, line.b))


def warn_isolated(count: int, linked: Iterable[int], names: Sequence[str], context: ReadContext) -> None:
    """Warn about nodes without lines."""
    reached = set(linked)
    lonely = [names[k] for k in range(count) if k not in reached]
    if lonely:
        context.warn(f"{len(lonely)} isolated nodes without lines: {shorten_list(lonely)}")
