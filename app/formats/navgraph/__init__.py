"""navgraph: the navigation graphs of the Fawkes robot framework, as YAML 1.2 with tags.

Nodes have a name, a position [x, y] in metres and properties; connections join two nodes in both directions, with
``!dir`` in one. To Fawkes every scalar is a text and a property without a value (a bare word) is ``true``. How it adds
a connection that crosses others: it refuses (the default, ``!no-intersection``), adds it all the same
(``!allow-intersection``) or makes a node of the crossing (``!split-intersection``). A node that no connection reaches
must be ``!unconnected``.
Source: fawkes, src/libs/navgraph/yaml_navgraph.cpp and navgraph.cpp.

Canonical: a node's id is its name, an edge's ``<from>_<to>``; a connection of both directions is two edges, the second
with ``backward``. The property ``orientation`` (radians) is the node's orientation too. ``properties.navgraph`` holds a
node's ``properties`` (a mapping), ``words`` (which of them are bare), ``tag`` and ``more`` (further keys); a
connection's ``tag``, ``backward`` and, where the file has intersection tags, ``order``: with these Fawkes adds one
connection after the other, and the result depends on it. The document's ``navgraph`` holds ``top`` (the keys of the
file but nodes and connections), ``defaults`` and ``words`` of the default properties.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely

from app.errors import Problem, UnreadableFile
from app.formats import Claims, Files, Format, LayerRequirements, ReadContext, Traits, WriteContext, _fields, register
from app.formats._fields import ANGLE, COORDINATE, Number, Record, record
from app.formats._network import (
    CROSS_PART_PROPERTIES,
    Array,
    Edge,
    MergedNetwork,
    Node,
    check_name,
    count,
    duplicates,
    edge_lines,
    get_source_properties,
    identifier,
    is_flat,
    is_name,
    merge_networks,
    natural_sort_key,
    node_points,
    number,
    quaternion,
    raise_unreadable,
    report_3d_loss,
    shorten_list,
    source_document,
    yaw_or_source,
)
from app.formats.navgraph import rules as _navgraph_rules
from app.model.features import Properties, from_columns, unique_ids
from app.model.layers import NETWORK, Layers, PartKey
from app.parameters import parameter
from app.syntax import yaml
from app.syntax.decimals import METRES, numbers

NAME = "navgraph"
PREFIX = "tag:fawkesrobotics.org,navgraph/"
TAGS = (PREFIX, "!")
"""Our tags with Fawkes' %TAG line, and without it (then Fawkes does not know them)."""

DIRECTED, UNCONNECTED, CROSSING = "dir", "unconnected", "allow-intersection"
MODES = frozenset({CROSSING, "no-intersection", "split-intersection"})
KNOWN_TAGS = MODES | {DIRECTED, "bidir"}

_WORD = re.compile(r"[A-Za-z0-9_-]{1,64}\Z")

NAME_KEYS = frozenset({"graph-name", "root"})
TOP_KEYS = frozenset({"nodes", "connections", "default-properties"})
NODE_KEYS = frozenset({"name", "pos", "properties"})
CANONICAL_NODE = frozenset({"kind", "name", "orientation", NAME}) | CROSS_PART_PROPERTIES
CANONICAL_EDGE = frozenset({"kind", "source", "target", NAME}) | CROSS_PART_PROPERTIES

_TOLERANCE = Number(0.0, 1e4)
_PROPERTIES = [
    record(
        is_open=True,
        is_loose=True,
        orientation=ANGLE,
        travel_tolerance=_TOLERANCE,
        target_tolerance=_TOLERANCE,
        orientation_tolerance=_TOLERANCE,
        shortcut_tolerance=_TOLERANCE,
    )
]
SHAPE = Record(
    {
        **dict.fromkeys(("graph-name", "root", "connections")),
        "default-properties": _PROPERTIES,
        "nodes": [record("name", pos=(COORDINATE, COORDINATE), properties=_PROPERTIES)],
    }
)
"""What a navgraph holds. Source: Fawkes, libs/navgraph/yaml_navgraph.cpp."""

MANY_CROSSINGS = 50
"""Crossings a connection on average: a network with more is a scribble, and each is taken for crossing."""


# --- reading ---------------------------------------------------------------------------------------------------------


def read(files: Files, context: ReadContext) -> Layers:
    """The graph as topology, local metres. Raises UnreadableFile naming the node or connection."""
    if not context.wants("topology"):
        return Layers()
    data = files[context.main or next(iter(files))]
    top = yaml.load(data, context.limits, tags=TAGS, typed=False)
    if not isinstance(top, dict) or not isinstance(top.get("nodes"), list):
        raise UnreadableFile("there is no list of nodes: not a navgraph", [Problem("no list", where="nodes")])
    nodes = [_ParsedNode(item, k, context) for k, item in enumerate(top["nodes"])]
    _fields.check(top, SHAPE, context)
    names = [node.name for node in nodes]
    ids = unique_ids(map(identifier, names))
    if repeats := duplicates(names):
        context.warn(
            f"{len(repeats)} names stand twice or more: {shorten_list(repeats)}; Fawkes refuses that; the first is "
            "meant"
        )
    index_by_name = {name: k for k, name in reversed(list(enumerate(names)))}
    rows, dangling = _connections(top.get("connections"), index_by_name, context)
    xyz: Array = np.array([(*node.at, 0.0) for node in nodes], np.float64).reshape(-1, 3)
    properties: list[Properties] = []
    for k, (node, i) in enumerate(zip(nodes, ids, strict=True)):
        node_properties = node.canonical(i)
        if k in dangling:
            node_properties[NAME]["dangling"] = dangling[k]
        properties.append(node_properties)
    edges = unique_ids((identifier(f"{ids[a]}_{ids[b]}") for a, b, _ in rows), set(ids))
    properties += [
        {"kind": "edge", "source": ids[a], "target": ids[b], NAME: extra_members} for a, b, extra_members in rows
    ]
    geometry = np.concatenate([node_points(xyz), edge_lines(xyz, [r[0] for r in rows], [r[1] for r in rows])])
    document = {NAME: _document(top, set(names), context)}
    if -1 in dangling:
        document[NAME]["dangling"] = dangling[-1]
    part = from_columns([*ids, *edges], geometry, properties, "local", document)
    return Layers({PartKey("topology", context.level, NETWORK): part})


class _ParsedNode:
    """One node of the file."""

    def __init__(self, item: Any, k: int, context: ReadContext) -> None:
        location = f"nodes[{k}]"
        self.tag, entry = _untag(item, location, context)
        if not isinstance(entry, dict):
            raise_unreadable("a node must be a mapping with a name and a pos", location)
        if "name" not in entry:
            raise_unreadable("a node must have a name", location)
        self.name = check_name(_name(entry["name"], f"{location}.name"), f"{location}.name")
        self.where = self.name
        if self.tag not in (None, UNCONNECTED):
            context.warn(f"Fawkes does not know the tag !{self.tag} of a node", where=self.where)
        at = entry.get("pos")
        if not isinstance(at, list) or len(at) != 2:
            raise_unreadable("pos must be [x, y]", f"{self.where}.pos")
        self.at = tuple(number(_plain(v, f"{self.where}.pos"), f"{self.where}.pos") for v in at)
        properties = entry.get("properties")
        self.properties, self.words = _properties(properties, f"{self.where}.properties", context)
        self.more = {key: _plain(value, f"{self.where}.{key}") for key, value in entry.items() if key not in NODE_KEYS}

    def canonical(self, i: str) -> dict[str, Any]:
        """Its properties in the canonical layer."""
        source_properties: dict[str, Any] = {}
        out: dict[str, Any] = {"kind": "node", "name": self.name, NAME: source_properties}
        properties = dict(self.properties)
        display = properties.get("name")
        if isinstance(display, str) and display not in ("", self.name) and "name" not in self.words:
            out["name"] = display
            source_properties["name"] = self.name  # also where the item is found again under another id
            del properties["name"]
        turned = properties.get("orientation")
        if isinstance(turned, (int, float)) and not isinstance(turned, bool):
            out["orientation"] = quaternion(float(turned))
        if self.name != i:
            source_properties["name"] = self.name
        members = {"tag": self.tag, "properties": properties, "words": self.words, "more": self.more}
        source_properties |= {key: value for key, value in members.items() if value}
        return out


def _untag(item: Any, location: str, context: ReadContext) -> tuple[str | None, Any]:
    """(the tag's own name, the value)."""
    if not isinstance(item, yaml.Tagged):
        return None, item
    tag = item.tag.removeprefix(PREFIX) if item.tag.startswith(PREFIX) else item.tag[1:]
    if not _WORD.match(tag):
        raise_unreadable(f"{item.tag[:80]!r} cannot be a tag: letters, digits, - and _ can", location)
    if not item.tag.startswith(PREFIX):
        context.warn(f"the tag !{tag} needs the line '%TAG ! {PREFIX}' for Fawkes to know it", where=location)
    return tag, item.value


def _name(value: Any, location: str) -> str:
    """A scalar as the text that it is for Fawkes."""
    if not isinstance(value, str):
        raise_unreadable("must be a text", location)
    return str.__str__(value)


def _plain(value: Any, location: str) -> Any:
    """A value as JSON-like data; scalars without quotes get their meaning."""
    if isinstance(value, yaml.PlainScalar):
        try:
            return yaml.scalar(str.__str__(value))
        except ValueError as error:
            raise_unreadable(str(error), location)
    if isinstance(value, yaml.Tagged):
        raise_unreadable(f"the tag {value.tag[:80]} has no meaning here", location)
    if isinstance(value, dict):
        return {key: _plain(v, location) for key, v in value.items()}
    if isinstance(value, list):
        return [_plain(v, location) for v in value]
    return value


def _properties(listing: Any, location: str, context: ReadContext) -> tuple[dict[str, Any], list[str]]:
    """(a list of one-key mappings and bare words as a mapping, the bare words, sorted)."""
    if listing is None or listing == "":
        return {}, []
    if isinstance(listing, dict):
        context.warn("must be a list of one-key mappings for Fawkes; a list is served", where=location)
        listing = [listing]
    if not isinstance(listing, list):
        raise_unreadable("must be a list of words and one-key mappings", location)
    out: dict[str, Any] = {}
    flags: set[str] = set()
    for item in listing:
        if isinstance(item, str):
            flag = _name(item, location)
            pairs: Sequence[tuple[str, Any]] = [(flag, True)]
        elif isinstance(item, dict):
            pairs = [(key, _plain(value, f"{location}.{key}")) for key, value in item.items()]
        else:
            raise_unreadable("must be a list of words and one-key mappings", location)
        for key, value in pairs:
            if key in out:
                context.warn("stands twice; the last value counts", where=f"{location}.{key}")
            if isinstance(value, (dict, list)):
                context.warn("is no scalar, which Fawkes refuses; it is kept", where=f"{location}.{key}")
            out[key] = value
            flags.discard(key)
        if isinstance(item, str):
            flags.add(flag)
    return out, sorted(flags)


Row = tuple[int, int, dict[str, Any]]


def _connections(
    entries: Any, index_by_name: Mapping[str, int], context: ReadContext
) -> tuple[list[Row], dict[int, list[dict[str, Any]]]]:
    """((source, target, what only this format knows) of each edge; the connections to nowhere by their known node, by
    -1 where both are unknown)."""
    if entries is None or entries == "":
        return [], {}
    if not isinstance(entries, list):
        raise_unreadable("must be a list of pairs", "connections")
    items = []
    for k, item in enumerate(entries):
        location = f"connections[{k}]"
        tag, pair = _untag(item, location, context)
        if not isinstance(pair, list) or len(pair) != 2:
            raise_unreadable("a connection is a pair of names: [from, to]", location)
        items.append((tag, _name(pair[0], location), _name(pair[1], location), location))
        if tag is not None and tag not in KNOWN_TAGS:
            context.warn(f"Fawkes does not know the tag !{tag} of a connection", where=location)
    ordered = any(tag in MODES for tag, _, _, _ in items)
    rows: list[Row] = []
    dangling: dict[int, list[dict[str, Any]]] = defaultdict(list)
    seen: set[tuple[str, str]] = set()
    for k, (tag, a, b, location) in enumerate(items):
        extra_members: dict[str, Any] = {"tag": tag} if tag else {}
        if a not in index_by_name or b not in index_by_name:
            missing = a if a not in index_by_name else b
            home = index_by_name.get(a, index_by_name.get(b))
            reason = f"{a} - {b}: there is no node {missing!r}, which Fawkes refuses; it is kept, but not served"
            context.warn(reason, where=location)
            dangling[-1 if home is None else home].append({**extra_members, "ends": [a, b]})
            continue
        if (a, b) in seen:
            context.warn(f"{a} - {b} stands twice, which Fawkes refuses", where=location)
        seen |= {(a, b)} if tag == DIRECTED else {(a, b), (b, a)}
        if a == b:
            context.warn(f"{a} is connected with itself", where=location)
        if ordered:
            extra_members["order"] = k
        rows.append((index_by_name[a], index_by_name[b], extra_members))
        if tag != DIRECTED and a != b:
            rows.append((index_by_name[b], index_by_name[a], {**extra_members, "backward": True}))
    return rows, dangling


def _document(top: Mapping[str, Any], names: set[str], context: ReadContext) -> dict[str, Any]:
    """What the file says as a whole."""
    extra_members = {
        key: str.__str__(value) if value and isinstance(value, str) and key in NAME_KEYS else _plain(value, key)
        for key, value in top.items()
        if key not in TOP_KEYS
    }
    if "graph-name" not in extra_members:
        context.warn("is missing; Fawkes asks for it", where="graph-name")
    if isinstance(extra_members.get("root"), str) and extra_members["root"] and extra_members["root"] not in names:
        context.warn(f"{extra_members['root']!r} is no node", where="root")
    out: dict[str, Any] = {"top": extra_members}
    defaults, flags = _properties(top.get("default-properties"), "default-properties", context)
    if defaults:
        out["defaults"] = defaults
    if flags:
        out["words"] = flags
    return out


# --- writing ---------------------------------------------------------------------------------------------------------


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """``navgraph.yaml``: all networks of the environment as one graph, nodes sorted by length and text of their names.

    Edges of both directions between two nodes are one connection. Wgs84 items are brought to local metres (MissingDatum
    without a datum).
    """
    return {"navgraph.yaml": _Writer(layers, context).file().encode()}


@dataclass(frozen=True, slots=True)
class WriteOptions:
    """What the file says where no source does."""

    graph_name: str | None = parameter(None, "name of a graph that no source names; default: the map's")


@dataclass(frozen=True, slots=True)
class _Connection:
    """A line of the file: its tag, its ends (places of nodes), whether another format's network has it."""

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
        """The whole text."""
        if repeats := duplicates(self.names):
            self.context.warn(
                f"{len(repeats)} names stand twice or more, which Fawkes refuses: {shorten_list(repeats)}"
            )
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
        """The keys before the nodes."""
        source_value = self.document.get("top")
        top = {w: v for w, v in source_value.items() if w not in TOP_KEYS} if isinstance(source_value, dict) else {}
        if not isinstance(top.get("graph-name"), str) or not top["graph-name"]:
            source_value = getattr(self.context.options, "graph_name", None)
            top["graph-name"] = source_value or self.context.title
            self.context.fill("graph-name", top["graph-name"], "no source names it", "graph_name")
        first = {key: top.pop(key) for key in ("graph-name", "root") if key in top}
        out = [yaml.mapping({key: value}, 0) for key, value in first.items()]
        if top:
            out.append(yaml.mapping(top, 0))
        defaults = self.document.get("defaults")
        if isinstance(defaults, dict) and defaults:
            out.append("default-properties:\n" + _list_text(defaults, self.document.get("words"), 2))
        return "".join(out)

    def _node(self, k: int, x: str, y: str, *, linked: bool) -> str:
        """The text of a node, with the line break before it."""
        node, name = self.net.nodes[k], self.names[k]
        p = node.properties
        source_members = get_source_properties(p, NAME)
        tag = _tag(source_members)
        if NAME not in p and not linked:
            tag = UNCONNECTED
            self.lost["unconnected"] += 1
        elif tag == UNCONNECTED and linked:
            tag = None
            self.context.warn("was !unconnected and is connected now: it is served without the tag", where=name)
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
        """Edges as connections: both directions of a pair as one."""
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
        """Whether edge a is the one that a connection of both directions is named by."""
        backward = (bool(its.get("backward")), bool(other.get("backward")))
        if backward[0] != backward[1]:
            return backward[1]
        return natural_sort_key(self.names[a.source]) < natural_sort_key(self.names[b.source])

    def _with_tags(self, connections: list[_Connection]) -> list[_Connection]:
        """The connections in the order that Fawkes shall add them, those of other formats tagged where they cross."""
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
                f"{stuck} one-way connections cross others; a connection has one tag only, so Fawkes refuses them "
                "where two of them cross each other"
            )
        names = self.names
        out.sort(
            key=lambda t: (t[0], t[1], natural_sort_key(names[t[2].a]), natural_sort_key(names[t[2].b]), t[2].tag or "")
        )
        return [c for _, _, c in out]

    def _crossing(self, connections: Sequence[_Connection]) -> Sequence[bool]:
        """Which connections touch another one that they share no node with; not looked at in Fawkes' own graphs."""
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
        """Places of the nodes in the file's order. Fawkes wants all of them to be reachable from the first one."""
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
            # Where any node reaches all, the last one that a search had to begin at does.
            everything: set[int] = set()
            _reach(starts[-1], onward, everything)
            if len(everything) == len(needed):
                order.remove(starts[-1])
                order.insert(0, starts[-1])
            else:
                self.context.warn(
                    f"no node reaches all others (from {names[starts[0]]!r} not {names[starts[1]]!r}): Fawkes refuses "
                    "that unless it allows several graphs in one"
                )
        return order

    def _report(self) -> None:
        context, counts = self.context, self.lost
        report_3d_loss(self.net, context, "Fawkes' nodes are two-dimensional")
        if counts["unconnected"]:
            why = "Fawkes asks for the tag where no connection leads"
            context.fill("nodes: !unconnected", f"{counts['unconnected']} nodes", why)
        edges = [e for e in self.net.edges if NAME not in e.properties]
        unnamed = sum(e.id != f"{self.net.nodes[e.source].id}_{self.net.nodes[e.target].id}" for e in edges)
        context.drop("ids of edges", unnamed, "a connection has no name; its ends say which one it is")
        context.drop(
            "edges with attributes (action, speed limit …)", counts["edge attributes"], "connections have none"
        )
        context.drop("parallel edges", counts["parallel"], "Fawkes refuses a second connection of the same nodes")
        context.drop(
            "attributes of nodes that are no scalars", counts["node attributes"], "Fawkes' properties are texts"
        )
        context.drop("tilts of nodes", counts["tilted"], "an orientation is one angle")
        context.drop("intersection tags", counts["one-way modes"], "the connection is one-way now and has one tag only")
        counts["dangling"] += count(self.document.get("dangling"))
        context.drop("connections to nowhere", counts["dangling"], "Fawkes refuses a graph with one")


def _tag(source_members: Mapping[str, Any]) -> str | None:
    """The tag that an item's source gave it, where it can be written."""
    tag = source_members.get("tag")
    return tag if isinstance(tag, str) and _WORD.match(tag) else None


def _reach(start: int, onward: Mapping[int, Sequence[int]], seen: set[int]) -> bool:
    """Add all that can be reached from a node; False where it had been seen already."""
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
    """A mapping as a list of one-key mappings, sorted, and bare words where the value still is true."""
    bare = frozenset(w for w in flags if isinstance(w, str)) if isinstance(flags, list) else frozenset()
    pad = " " * column
    out = []
    for key in sorted(properties):
        if key in bare and properties[key] is True:
            out.append(f"{pad}- {yaml.text(key)}\n")
        else:
            out.append(f"{pad}- {yaml.mapping({key: properties[key]}, column + 2)[column + 2 :]}")
    return "".join(out)


# --- the format ------------------------------------------------------------------------------------------------------

_OWN = re.compile(rb"(?m)^graph-name[ \t]*:")
_TAG = re.compile(rb"(?m)^%TAG\s+\S+\s+tag:fawkesrobotics\.org,navgraph/")


def detect(name: str, data: bytes) -> bool:
    """YAML with Fawkes' tags announced on top, or with the name of a graph."""
    if not name.lower().endswith((".yaml", ".yml")) or b"nodes" not in data:
        return False
    return bool(_TAG.search(data[:4096]) or _OWN.search(data))


register(
    Format(
        name=NAME,
        title="Navigation graph (Fawkes)",
        files={"navgraph.yaml": "application/yaml"},
        layers=frozenset({"topology"}),
        detect=detect,
        read=read,
        check=_navgraph_rules.check,
        write=write,
        needs=LayerRequirements(one_of=(frozenset({"topology"}),), anchor="local"),
        write_options=WriteOptions,
        extensions=(".yaml", ".yml"),
        version=2,
        claims=Claims(priority=35),
        traits=Traits(keeps_bends="nodes", has_title=True),
    )
)
