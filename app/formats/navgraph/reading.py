"""Read a navgraph: its nodes and connections as a network."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from app.errors import Problem, UnreadableFile
from app.formats import Files, ReadContext, _fields
from app.formats._network import (
    Array,
    check_name,
    duplicates,
    edge_lines,
    identifier,
    node_points,
    number,
    quaternion,
    raise_unreadable,
    shorten_list,
)
from app.formats.navgraph.vocabulary import (
    DIRECTED,
    KNOWN_TAGS,
    MODES,
    NAME,
    NAME_KEYS,
    NODE_KEYS,
    PREFIX,
    SHAPE,
    TAGS,
    TOP_KEYS,
    UNCONNECTED,
    WORD,
)
from app.model.features import Properties, from_columns, unique_ids
from app.model.layers import NETWORK, Layers, PartKey
from app.syntax import yaml


def read(files: Files, context: ReadContext) -> Layers:
    """Read the graph as topology, local metres. Raises UnreadableFile naming the node or connection."""
    if not context.wants("topology"):
        return Layers()
    data = files[context.main or next(iter(files))]
    top = yaml.load(data, context.limits, tags=TAGS, typed=False)
    if not isinstance(top, dict) or not isinstance(top.get("nodes"), list):
        raise UnreadableFile("not a navgraph: a list of nodes is missing", [Problem("missing list", where="nodes")])
    nodes = [_ParsedNode(item, k, context) for k, item in enumerate(top["nodes"])]
    _fields.check(top, SHAPE, context)
    names = [node.name for node in nodes]
    ids = unique_ids(map(identifier, names))
    if repeats := duplicates(names):
        context.warn(
            f"{len(repeats)} duplicate node names: {shorten_list(repeats)}; Fawkes rejects them, and connections "
            "use the first"
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
        self.location = self.name
        if self.tag not in (None, UNCONNECTED):
            context.warn(f"Fawkes does not support the tag !{self.tag} of a node", where=self.location)
        at = entry.get("pos")
        if not isinstance(at, list) or len(at) != 2:
            raise_unreadable("pos must be [x, y]", f"{self.location}.pos")
        self.at = tuple(number(_plain(v, f"{self.location}.pos"), f"{self.location}.pos") for v in at)
        properties = entry.get("properties")
        self.properties, self.words = _properties(properties, f"{self.location}.properties", context)
        self.more = {
            key: _plain(value, f"{self.location}.{key}") for key, value in entry.items() if key not in NODE_KEYS
        }

    def canonical(self, i: str) -> dict[str, Any]:
        """Return its canonical properties."""
        source_properties: dict[str, Any] = {}
        out: dict[str, Any] = {"kind": "node", "name": self.name, NAME: source_properties}
        properties = dict(self.properties)
        display = properties.get("name")
        if isinstance(display, str) and display not in ("", self.name) and "name" not in self.words:
            out["name"] = display
            source_properties["name"] = self.name  # also if the item later has another id
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
    """Return the tag's own name and the value."""
    if not isinstance(item, yaml.Tagged):
        return None, item
    tag = item.tag.removeprefix(PREFIX) if item.tag.startswith(PREFIX) else item.tag[1:]
    if not WORD.match(tag):
        raise_unreadable(f"invalid tag {item.tag[:80]!r}: use letters, digits, - and _", location)
    if not item.tag.startswith(PREFIX):
        context.warn(f"the tag !{tag} has no effect in Fawkes without the line '%TAG ! {PREFIX}'", where=location)
    return tag, item.value


def _name(value: Any, location: str) -> str:
    """Return a scalar as the text that Fawkes reads."""
    if not isinstance(value, str):
        raise_unreadable("must be a string", location)
    return str.__str__(value)


def _plain(value: Any, location: str) -> Any:
    """Convert a value to JSON-like data; unquoted scalars are parsed."""
    if isinstance(value, yaml.PlainScalar):
        try:
            return yaml.scalar(str.__str__(value))
        except ValueError as error:
            raise_unreadable(str(error), location)
    if isinstance(value, yaml.Tagged):
        raise_unreadable(f"unsupported tag {value.tag[:80]}", location)
    if isinstance(value, dict):
        return {key: _plain(v, location) for key, v in value.items()}
    if isinstance(value, list):
        return [_plain(v, location) for v in value]
    return value


def _properties(listing: Any, location: str, context: ReadContext) -> tuple[dict[str, Any], list[str]]:
    """Convert a list of one-key mappings and bare words to a mapping; also return the bare words, sorted."""
    if listing is None or listing == "":
        return {}, []
    if isinstance(listing, dict):
        context.warn("must be a list of one-key mappings for Fawkes; it is exported as a list", where=location)
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
                context.warn("duplicate key; the last value is used", where=f"{location}.{key}")
            if isinstance(value, (dict, list)):
                context.warn("not a scalar, which Fawkes rejects; it is stored", where=f"{location}.{key}")
            out[key] = value
            flags.discard(key)
        if isinstance(item, str):
            flags.add(flag)
    return out, sorted(flags)


Row = tuple[int, int, dict[str, Any]]


def _connections(
    entries: Any, index_by_name: Mapping[str, int], context: ReadContext
) -> tuple[list[Row], dict[int, list[dict[str, Any]]]]:
    """Return the edges as (source, target, source properties), and the dangling connections.

    Dangling connections are grouped by their existing node, by -1 if there is none.
    """
    if entries is None or entries == "":
        return [], {}
    if not isinstance(entries, list):
        raise_unreadable("must be a list of pairs", "connections")
    items = []
    for k, item in enumerate(entries):
        location = f"connections[{k}]"
        tag, pair = _untag(item, location, context)
        if not isinstance(pair, list) or len(pair) != 2:
            raise_unreadable("a connection must be a pair of names: [from, to]", location)
        items.append((tag, _name(pair[0], location), _name(pair[1], location), location))
        if tag is not None and tag not in KNOWN_TAGS:
            context.warn(f"Fawkes does not support the tag !{tag} of a connection", where=location)
    ordered = any(tag in MODES for tag, _, _, _ in items)
    rows: list[Row] = []
    dangling: dict[int, list[dict[str, Any]]] = defaultdict(list)
    seen: set[tuple[str, str]] = set()
    for k, (tag, a, b, location) in enumerate(items):
        extra_members: dict[str, Any] = {"tag": tag} if tag else {}
        if a not in index_by_name or b not in index_by_name:
            missing = a if a not in index_by_name else b
            home = index_by_name.get(a, index_by_name.get(b))
            reason = (
                f"{a} - {b}: unknown node {missing!r}, which Fawkes rejects; the connection is stored, but not exported"
            )
            context.warn(reason, where=location)
            dangling[-1 if home is None else home].append({**extra_members, "ends": [a, b]})
            continue
        if (a, b) in seen:
            context.warn(f"duplicate connection {a} - {b}, which Fawkes rejects", where=location)
        seen |= {(a, b)} if tag == DIRECTED else {(a, b), (b, a)}
        if a == b:
            context.warn(f"{a} is connected to itself", where=location)
        if ordered:
            extra_members["order"] = k
        rows.append((index_by_name[a], index_by_name[b], extra_members))
        if tag != DIRECTED and a != b:
            rows.append((index_by_name[b], index_by_name[a], {**extra_members, "backward": True}))
    return rows, dangling


def _document(top: Mapping[str, Any], names: set[str], context: ReadContext) -> dict[str, Any]:
    """Return the collection document."""
    extra_members = {
        key: str.__str__(value) if value and isinstance(value, str) and key in NAME_KEYS else _plain(value, key)
        for key, value in top.items()
        if key not in TOP_KEYS
    }
    if "graph-name" not in extra_members:
        context.warn("missing, but required by Fawkes", where="graph-name")
    if isinstance(extra_members.get("root"), str) and extra_members["root"] and extra_members["root"] not in names:
        context.warn(f"{extra_members['root']!r} is not a node", where="root")
    out: dict[str, Any] = {"top": extra_members}
    defaults, flags = _properties(top.get("default-properties"), "default-properties", context)
    if defaults:
        out["defaults"] = defaults
    if flags:
        out["words"] = flags
    return out
