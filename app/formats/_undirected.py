"""Graphs whose edges have no direction (``prm``, ``ffr_network``) <-> directed edges, and back.

A line of the file is two directed edges: the first carries what the file says of it, the second ``backward``; both
carry ``line``, the line's place in the file, so that they find each other again. A line that says ``oneway: true`` (our
own word: these formats have none) is one edge.
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
"""Canonical words of edges that a line may say, too."""

NODE_CANONICAL = frozenset({"kind", "name", "drawn_from"})
EDGE_CANONICAL = frozenset({"kind", "source", "target", "drawn_from", *WORDS})


@dataclass(frozen=True, slots=True)
class Line:
    """A line of a file: places of the nodes at its ends, and what else it says."""

    a: int
    b: int
    members: dict[str, Any]


def canonical(keys: Iterable[str], members: dict[str, Any]) -> dict[str, Any]:
    """The canonical words among what an item says, where their values are of the right type."""
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
    """Lines -> (ids, geometries, properties) of directed edges. ids, xyz: of the nodes. name: the format's."""
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
    """Directed edges as lines, in the order of their nodes' places; what lines cannot say is declared."""
    ordered = sorted(
        net.edges,
        key=lambda e: (get_source_properties(e.properties, name).get("backward") is True, natural_sort_key(e.id)),
    )
    pairs: list[tuple[Edge, Edge | None]] = []
    waiting = ordered
    for exact in (True, False):  # first the two edges of one line of a file, then whatever leads back
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
    context.drop("attributes of edges", dropped_count, "the format has no place for them")
    context.drop("attributes of the way back", differing, "a line says the same of both directions")
    if oneway:
        reason = f"{oneway} edges lead one way only, which the format cannot say: they are marked {ONEWAY}: true"
        context.warn(f"{reason}, but other readers will drive them both ways")
    return sorted(out, key=lambda line: (line.a, line.b))


def warn_isolated(count: int, linked: Iterable[int], names: Sequence[str], context: ReadContext) -> None:
    """Name nodes that no line reaches."""
    reached = set(linked)
    lonely = [names[k] for k in range(count) if k not in reached]
    if lonely:
        context.warn(f"{len(lonely)} nodes have no lines: {shorten_list(lonely)}")
