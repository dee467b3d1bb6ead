"""Write a navgraph, with an order and tags with which Fawkes loads the stored connections."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely

from app.formats import WriteContext
from app.formats._network import (
    Edge,
    MergedNetwork,
    Node,
    count,
    duplicates,
    get_source_properties,
    is_flat,
    is_name,
    merge_networks,
    natural_sort_key,
    report_3d_loss,
    shorten_list,
    source_document,
    yaw_or_source,
)
from app.formats.navgraph.vocabulary import (
    CANONICAL_EDGE,
    CANONICAL_NODE,
    CROSSING,
    DIRECTED,
    MODES,
    NAME,
    NODE_KEYS,
    PREFIX,
    TOP_KEYS,
    UNCONNECTED,
    WORD,
)
from app.model.layers import Layers
from app.parameters import parameter
from app.syntax import yaml
from app.syntax.decimals import METRES, numbers

MANY_CROSSINGS = 50
"""Crossings per connection on average, beyond which the remaining connections all count as crossing."""


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """Write ``navgraph.yaml``: all networks of the environment as one graph, nodes in natural order of names.

    Edges of both directions between two nodes are one connection. Wgs84 items are converted to local metres. Raises
    MissingDatum without a datum.
    """
    return {"navgraph.yaml": _Writer(layers, context).file().encode()}


@dataclass(frozen=True, slots=True)
class WriteOptions:
    """Values to write if no source has them."""

    graph_name: str | None = parameter(None, "name of a graph whose source has none; default: the map's")


@dataclass(frozen=True, slots=True)
class _Connection:
    """A connection to write: its tag, its end nodes (indexes), whether it comes from another format."""

    tag: str | None
    a: int
    b: int
    foreign: bool
    order: int | None


class _Writer:
    def __init__(self, layers: Layers, context: WriteContext) -> None:
        self.context = context
        self.document = source_document(layers, NAME)
        self.net: MergedNetwork = merge_networks(layers, context)
        self.names = [self._node_name(node) for node in self.net.nodes]
        self.lost: Counter[str] = Counter()

    def _node_name(self, node: Node) -> str:
        source_name = get_source_properties(node.properties, NAME).get("name")
        return source_name if isinstance(source_name, str) and is_name(source_name) else node.id

    def file(self) -> str:
        """Return the complete text."""
        if repeats := duplicates(self.names):
            self.context.warn(f"{len(repeats)} duplicate node names, which Fawkes rejects: {shorten_list(repeats)}")
        connections = self._with_tags(list(self._connections()))
        order = self._node_order(connections)
        out = [f"%YAML 1.2\n%TAG ! {PREFIX}\n---\n", self._head(), "nodes:" if order else "nodes: []"]
        xy = np.array([(self.net.nodes[k].x, self.net.nodes[k].y) for k in order], np.float64).reshape(-1, 2)
        texts = list(map(yaml.decimal, numbers(xy.ravel(), METRES)))
        linked = {k for c in connections for k in (c.a, c.b)}
        for k, x, y in zip(order, texts[::2], texts[1::2], strict=True):
            out.append(self._node(k, x, y, linked=k in linked))
        names = [yaml.text(name) for name in self.names]
        out.append("\nconnections:\n" if connections else "\nconnections: []\n")
        for c in connections:
            tag = f"!{c.tag} " if c.tag else ""
            out.append(f"  - {tag}[{names[c.a]}, {names[c.b]}]\n")
        self._report()
        return "".join(out)

    def _head(self) -> str:
        """Return the keys before the nodes."""
        source_value = self.document.get("top")
        top = {w: v for w, v in source_value.items() if w not in TOP_KEYS} if isinstance(source_value, dict) else {}
        if not isinstance(top.get("graph-name"), str) or not top["graph-name"]:
            source_value = getattr(self.context.options, "graph_name", None)
            top["graph-name"] = source_value or self.context.title
            self.context.fill("graph-name", top["graph-name"], "no source specifies it", "graph_name")
        first = {key: top.pop(key) for key in ("graph-name", "root") if key in top}
        out = [yaml.mapping({key: value}, 0) for key, value in first.items()]
        if top:
            out.append(yaml.mapping(top, 0))
        defaults = self.document.get("defaults")
        if isinstance(defaults, dict) and defaults:
            out.append("default-properties:\n" + _list_text(defaults, self.document.get("words"), 2))
        return "".join(out)

    def _node(self, k: int, x: str, y: str, *, linked: bool) -> str:
        """Return the text of a node, with a line break before it."""
        node, name = self.net.nodes[k], self.names[k]
        p = node.properties
        source_members = get_source_properties(p, NAME)
        tag = _tag(source_members)
        if NAME not in p and not linked:
            tag = UNCONNECTED
            self.lost["unconnected"] += 1
        elif tag == UNCONNECTED and linked:
            tag = None
            self.context.warn("was !unconnected and is now connected; exported without the tag", where=name)
        extra_properties = source_members.get("properties")
        properties = dict(extra_properties) if isinstance(extra_properties, dict) else {}
        turned = yaw_or_source(properties.get("orientation"), p.get("orientation"))
        if turned is not None:
            properties["orientation"] = turned
            self.lost["tilted"] += not is_flat(p["orientation"])
        display = p.get("name")
        if isinstance(display, str) and display not in ("", name):
            properties["name"] = display
        for key in p.keys() - CANONICAL_NODE:
            if isinstance(p[key], (str, int, float)):
                properties.setdefault(key, p[key])
            else:
                self.lost["node attributes"] += 1
        body = f"name: {yaml.text(name)}\n    pos: [{x}, {y}]\n"
        text = f"\n  - !{tag}\n    {body}" if tag else f"\n  - {body}"
        if properties:
            text += "    properties:\n" + _list_text(properties, source_members.get("words"), 6)
        more = source_members.get("more")
        if isinstance(more, dict) and (more := {w: v for w, v in more.items() if w not in NODE_KEYS}):
            text += yaml.mapping(more, 4)
        self.lost["dangling"] += count(source_members.get("dangling"))
        return text[:-1]

    def _connections(self) -> Iterator[_Connection]:
        """Convert edges to connections: both directions of a pair become one."""
        edges = sorted(self.net.edges, key=lambda e: (NAME not in e.properties, natural_sort_key(e.id)))
        waiting: dict[tuple[int, int, str | None], list[tuple[Edge, dict[str, Any]]]] = defaultdict(list)
        covered: set[tuple[int, int]] = set()
        for edge in edges:
            foreign = NAME not in edge.properties
            if foreign and (edge.source, edge.target) in covered:
                self.lost["parallel"] += 1
                continue
            covered.add((edge.source, edge.target))
            self.lost["edge attributes"] += bool(edge.properties.keys() - CANONICAL_EDGE)
            source_members = get_source_properties(edge.properties, NAME)
            tag = _tag(source_members)
            order = source_members.get("order") if isinstance(source_members.get("order"), int) else None
            back = waiting[(edge.target, edge.source, tag)]
            if tag == DIRECTED or edge.source == edge.target:
                yield _Connection(tag, edge.source, edge.target, foreign, order)
            elif back:
                other, its = back.pop(0)
                first, second = (other, edge) if self._leads(other, its, edge, source_members) else (edge, other)
                yield _Connection(tag, first.source, second.source, foreign, order)
            else:
                waiting[(edge.source, edge.target, tag)].append((edge, source_members))
        for (a, b, tag), left in waiting.items():
            for edge, source_members in left:
                self.lost["one-way modes"] += tag in MODES
                order = source_members.get("order") if isinstance(source_members.get("order"), int) else None
                yield _Connection(DIRECTED, a, b, NAME not in edge.properties, order)

    def _leads(self, a: Edge, its: Mapping[str, Any], b: Edge, other: Mapping[str, Any]) -> bool:
        """Whether edge a, not its reverse, gives a connection of both directions its direction in the file."""
        backward = (bool(its.get("backward")), bool(other.get("backward")))
        if backward[0] != backward[1]:
            return backward[1]
        return natural_sort_key(self.names[a.source]) < natural_sort_key(self.names[b.source])

    def _with_tags(self, connections: list[_Connection]) -> list[_Connection]:
        """Sort the connections in the order for Fawkes, and tag crossing ones of other formats."""
        crossing = self._crossing(connections)
        out = []
        for k, c in enumerate(connections):
            if c.foreign and crossing[k] and c.tag is None:
                out.append((2, 0, _Connection(CROSSING, c.a, c.b, c.foreign, None)))
            elif c.foreign or c.order is None:
                out.append((0 if c.foreign else 1, -1, c))
            else:
                out.append((1, c.order, c))
        stuck = sum(c.tag == DIRECTED and bool(crossing[k]) for k, c in enumerate(connections) if c.foreign)
        if stuck:
            self.context.warn(
                f"{stuck} one-way connections cross others; they cannot have a second tag, so Fawkes rejects "
                "those that cross each other"
            )
        names = self.names
        out.sort(
            key=lambda t: (t[0], t[1], natural_sort_key(names[t[2].a]), natural_sort_key(names[t[2].b]), t[2].tag or "")
        )
        return [c for _, _, c in out]

    def _crossing(self, connections: Sequence[_Connection]) -> Sequence[bool]:
        """Return for each connection whether it touches one without a common node; skipped for Fawkes' own graphs."""
        n = len(connections)
        crossing = np.zeros(n, bool)
        if not any(c.foreign for c in connections):
            return crossing.tolist()
        xy = np.array([(node.x, node.y) for node in self.net.nodes], np.float64)
        ends = np.array([(c.a, c.b) for c in connections], np.intp)
        lines = shapely.linestrings(xy[ends])
        tree = shapely.STRtree(lines)
        portion, pair_count = max(1, 20_000_000 // n), 0
        for begin in range(0, n, portion):
            if pair_count > MANY_CROSSINGS * n + 1_000_000:
                crossing[begin:] = True
                break
            a, b = tree.query(lines[begin : begin + portion], predicate="intersects")
            a = a + begin
            pair_count += len(a)
            apart = (ends[a][:, :, None] != ends[b][:, None, :]).all(axis=(1, 2))
            crossing[a[apart]] = True
        return crossing.tolist()

    def _node_order(self, connections: Sequence[_Connection]) -> list[int]:
        """Return node indexes in the file's order. Fawkes requires that all are reachable from the first one."""
        names, nodes = self.names, self.net.nodes
        order = sorted(range(len(names)), key=lambda k: natural_sort_key(names[k]))
        onward: dict[int, list[int]] = defaultdict(list)
        linked: set[int] = set()
        for c in connections:
            onward[c.a].append(c.b)
            if c.tag != DIRECTED:
                onward[c.b].append(c.a)
            linked |= {c.a, c.b}
        needed = [
            k for k in order if k in linked or _tag(get_source_properties(nodes[k].properties, NAME)) != UNCONNECTED
        ]
        needed = [k for k in needed if k in linked or NAME in nodes[k].properties]
        seen: set[int] = set()
        starts = [k for k in needed if _reach(k, onward, seen)]
        if len(starts) > 1:
            # If any node reaches all others, it is the last start of a search.
            everything: set[int] = set()
            _reach(starts[-1], onward, everything)
            if len(everything) == len(needed):
                order.remove(starts[-1])
                order.insert(0, starts[-1])
            else:
                self.context.warn(
                    f"no node reaches all others ({names[starts[0]]!r} does not reach {names[starts[1]]!r}); "
                    "Fawkes rejects such a graph unless multi-graphs are allowed"
                )
        return order

    def _report(self) -> None:
        context, counts = self.context, self.lost
        report_3d_loss(self.net, context, "Fawkes' nodes are two-dimensional")
        if counts["unconnected"]:
            why = "Fawkes requires the tag for nodes without connections"
            context.fill("nodes: !unconnected", f"{counts['unconnected']} nodes", why)
        edges = [e for e in self.net.edges if NAME not in e.properties]
        unnamed = sum(e.id != f"{self.net.nodes[e.source].id}_{self.net.nodes[e.target].id}" for e in edges)
        context.drop("ids of edges", unnamed, "a connection has no name, only its ends")
        context.drop(
            "edges with attributes (action, speed limit …)", counts["edge attributes"], "connections have no attributes"
        )
        context.drop("parallel edges", counts["parallel"], "Fawkes rejects a second connection between two nodes")
        context.drop(
            "attributes of nodes that are not scalars", counts["node attributes"], "properties in Fawkes are texts"
        )
        context.drop("tilts of nodes", counts["tilted"], "an orientation is one angle")
        context.drop(
            "intersection tags", counts["one-way modes"], "the connection is now one-way and cannot have a second tag"
        )
        counts["dangling"] += count(self.document.get("dangling"))
        context.drop(
            "connections without both end nodes", counts["dangling"], "Fawkes rejects a graph that contains one"
        )


def _tag(source_members: Mapping[str, Any]) -> str | None:
    """Return the tag of an item's source, if it can be written."""
    tag = source_members.get("tag")
    return tag if isinstance(tag, str) and WORD.match(tag) else None


def _reach(start: int, onward: Mapping[int, Sequence[int]], seen: set[int]) -> bool:
    """Add all nodes that can be reached from a node; return False if it had been added already."""
    if start in seen:
        return False
    seen.add(start)
    front = [start]
    while front:
        for k in onward.get(front.pop(), ()):
            if k not in seen:
                seen.add(k)
                front.append(k)
    return True


def _list_text(properties: Mapping[str, Any], flags: Any, column: int) -> str:
    """Write a mapping as a list of one-key mappings, sorted; bare words if their value is still true."""
    bare = frozenset(w for w in flags if isinstance(w, str)) if isinstance(flags, list) else frozenset()
    pad = " " * column
    out = []
    for key in sorted(properties):
        if key in bare and properties[key] is True:
            out.append(f"{pad}- {yaml.text(key)}\n")
        else:
            out.append(f"{pad}- {yaml.mapping({key: properties[key]}, column + 2)[column + 2 :]}")
    return "".join(out)
