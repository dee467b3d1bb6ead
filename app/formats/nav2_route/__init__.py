"""nav2_route: the graphs of Nav2's route server, GeoJSON by its shape, metres in a robot's frame by its meaning.

A Point is a node {id, frame, metadata, operations}, a LineString or MultiLineString a directed edge {id, startid,
endid, cost, overridable, metadata, operations} whose shape the server does not look at. Ids are numbers: 32 bit in a
graph, 16 bit in the server's actions and services. The server tells integers from floats: what it asks for as a float
must be written as one (``85.0``), else it throws; so a metadata word that it reads so is always served as a float, and
all others keep the type they came with. Setting a new graph clears the old one before it is loaded: a bad file leaves
none.
Source: navigation2, nav2_route/src/plugins/graph_file_loaders/geojson_graph_file_loader.cpp and the edge scorers.

Canonical: an item's id is its number as a text; ``properties.nav2_route`` holds its ``id``, ``properties`` (the
feature's, less what is canonical), ``members`` (further ones of the feature), ``line`` where an edge is no
MultiLineString, and ``geometry`` where its shape is none of ours. The metadata words ``abs_speed_limit`` (metres per
second), ``name``, ``action`` and ``width`` are the canonical ``speed_limit``, ``name`` … The document's ``nav2_route``
holds the file's ``members``, the ``ignored`` features that are neither node nor edge, and the ``dangling`` edges
between unknown nodes (an edge with one known end is kept with that node).
"""

from __future__ import annotations

import hashlib
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import orjson
import shapely
from numpy.typing import NDArray

from app.errors import CannotConvert, Problem, TooLarge, UnreadableFile
from app.formats import (
    Claims,
    Files,
    Format,
    LayerRequirements,
    ReadContext,
    Traits,
    WriteContext,
    _fields,
    register,
)
from app.formats._fields import NOT_NEGATIVE, SPEED, Number, OneOf, record
from app.formats._network import (
    CROSS_PART_PROPERTIES,
    Array,
    Edge,
    MergedNetwork,
    Node,
    count,
    duplicates,
    edge_lines,
    get_source_properties,
    merge_networks,
    node_points,
    number,
    raise_unreadable,
    shorten_list,
    source_document,
)
from app.formats.nav2_route import rules as _nav2_route_rules
from app.model.features import Properties, from_columns, unique_ids
from app.model.layers import NETWORK, Layers, PartKey
from app.parameters import parameter
from app.syntax import json
from app.syntax.decimals import METRES

NAME = "nav2_route"
FRAME = "map"
LINES = ("LineString", "MultiLineString")
MAX_ID = 2**32 - 1
MAX_USED_ID = 2**16 - 1
"""Of ComputeRoute's start and goal, and of the edges that DynamicEdges closes."""

FLOATS = frozenset({"speed_limit", "abs_speed_limit", "penalty", "abs_time_taken"})
"""Metadata that Nav2's own plugins ask for as floats."""

TEXTS: Mapping[str, str] = {"name": "name", "action": "action"}
NUMBERS: Mapping[str, str] = {"abs_speed_limit": "speed_limit", "width": "width"}
CANONICAL_METADATA: Mapping[str, str] = {**TEXTS, **NUMBERS}
"""Metadata word -> the canonical word, for values that are texts and numbers."""

TRIGGERS = ("NODE", "ON_ENTER", "ON_EXIT")


@dataclass(frozen=True, slots=True)
class WriteOptions:
    """What the file says where no source does."""

    graph_name: str | None = parameter(None, "name of a graph that no source names; default: the map's")
    frame_id: str = parameter(FRAME, "frame of nodes whose source names none")


_SPEED, _LENGTH = replace(SPEED, or_other=True), replace(NOT_NEGATIVE, or_other=True)
_METADATA = record(
    is_open=True,
    is_loose=True,
    speed_limit=_SPEED,
    abs_speed_limit=_SPEED,
    penalty=_LENGTH,
    abs_time_taken=_LENGTH,
    width=_LENGTH,
)
_FEATURE = record(
    is_open=True,
    type=OneOf(("Feature",)),
    properties=record(
        "id startid endid overridable frame operations graph_id",
        metadata=_METADATA,
        cost=Number(0.0, 1e9, or_other=True),
    ),
)
SHAPE = record(is_open=True, type=OneOf(("FeatureCollection",)), features=[_FEATURE])
"""What a graph holds. Source: nav2_route, GeoJsonGraphFileLoader; members beside these are GeoJSON's or QGIS'."""

CRS = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::3857"}}
"""What Nav2's own graphs say, so that QGIS shows their metres; the route server does not look at it."""

CANONICAL_NODE = frozenset({"kind", "name", "action", "speed_limit", "width", NAME}) | CROSS_PART_PROPERTIES
CANONICAL_EDGE = CANONICAL_NODE | {"source", "target"}


# --- reading ---------------------------------------------------------------------------------------------------------


def read(files: Files, context: ReadContext) -> Layers:
    """The graph as topology, local metres. Raises UnreadableFile naming the feature; TooLarge beyond the limits."""
    if not context.wants("topology"):
        return Layers()
    top = json.load(files[context.main or next(iter(files))], context.limits)
    rows = top.get("features") if isinstance(top, dict) else None
    if not isinstance(top, dict) or not isinstance(rows, list):
        raise UnreadableFile(
            "a route graph is one object with an array of features", [Problem("no array", where="features")]
        )
    if len(rows) > context.limits.features:
        raise TooLarge(f"the file has {len(rows)} features; the limit is {context.limits.features}")
    layers = _Reader(top, rows, context).layers()
    _fields.check(top, SHAPE, context)
    return layers


class _Reader:
    def __init__(self, top: dict[str, Any], rows: list[Any], context: ReadContext) -> None:
        self.top, self.rows, self.context = top, rows, context
        self.nodes: list[int] = []
        self.edges: list[int] = []
        self.ignored: list[Any] = []
        self.dangling: list[dict[str, Any]] = []
        self.is_complete: Counter[str] = Counter()
        for k, row in enumerate(rows):
            location = f"features[{k}]"
            geometry = row.get("geometry") if isinstance(row, dict) else None
            if not isinstance(row, dict) or not isinstance(geometry, (dict, type(None))):
                raise_unreadable("must be a GeoJSON feature with a geometry", location)
            kind = geometry.get("type") if geometry else None
            if kind == "Point":
                self.nodes.append(k)
            elif kind in LINES:
                self.edges.append(k)
            else:
                context.warn("is neither a point nor a line: the route server ignores it; it is kept", where=location)
                self.ignored.append(row)
        if not self.nodes or not self.edges:
            noun = "point (node)" if not self.nodes else "line (edge)"
            reason = f"there is no {noun}: the route server takes graphs with one node and one edge at least"
            raise UnreadableFile(reason, [Problem(reason, where="features")])

    def layers(self) -> Layers:
        numbers = [self.read_id(k) for k in self.nodes]
        ids = unique_ids(map(str, numbers))
        if repeats := duplicates(list(map(str, numbers))):
            self.context.warn(
                f"{len(repeats)} nodes share an id: {shorten_list(repeats)}; edges go to the last one, as in Nav2"
            )
        index_by_number = {n: k for k, n in enumerate(numbers)}
        xyz: Array = np.array([self.position(k) for k in self.nodes], np.float64).reshape(-1, 3)
        properties: list[dict[str, Any]] = [
            {"kind": "node", "name": str(n), **self.canonical(k, n)} for k, n in zip(self.nodes, numbers, strict=True)
        ]
        indices, numbers, sources, targets = self.ends(index_by_number, properties)
        edges = unique_ids(map(str, numbers), set(ids))
        if repeats := duplicates(list(map(str, numbers))):
            self.context.warn(
                f"{len(repeats)} edges share an id: {shorten_list(repeats)}; later ones are served with a new one"
            )
        lines = edge_lines(xyz, sources, targets)
        for j, (k, n) in enumerate(zip(indices, numbers, strict=True)):
            p = {"kind": "edge", "source": ids[sources[j]], "target": ids[targets[j]], **self.canonical(k, n)}
            lines[j] = self.shape(k, lines[j], p[NAME])
            properties.append(p)
        if self.is_complete["integers"]:
            self.context.warn(
                f"{self.is_complete['integers']} metadata values ({', '.join(sorted(FLOATS))}) are integers, at which "
                "Nav2 throws; they are served as floats"
            )
        document: dict[str, Any] = {"members": {w: v for w, v in self.top.items() if w not in ("type", "features")}}
        credit = [self.top[w] for w in ("attribution", "license", "copyright") if isinstance(self.top.get(w), str)]
        document |= {"ignored": self.ignored} if self.ignored else {}
        document |= {"dangling": self.dangling} if self.dangling else {}
        geometry = np.concatenate([node_points(xyz), lines])
        collection_document = {NAME: document, "attribution": credit} if credit else {NAME: document}
        part = from_columns([*ids, *edges], geometry, properties, "local", collection_document)
        return Layers({PartKey("topology", self.context.level, NETWORK): part})

    def properties_of(self, k: int) -> dict[str, Any]:
        """The properties of a feature."""
        properties = self.rows[k].get("properties")
        if not isinstance(properties, dict):
            raise_unreadable("needs properties with an id", f"features[{k}]")
        return properties

    def read_id(self, k: int, key: str = "id") -> int:
        """A node's or edge's number."""
        value = self.properties_of(k).get(key)
        if isinstance(value, float) and value.is_integer():
            value = int(value)
        if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= MAX_ID:
            shown = "is missing" if value is None else f"is {str(value)[:40]!r}"
            raise_unreadable(
                f"{shown}; it must be a whole number from 0 to {MAX_ID}", f"features[{k}].properties.{key}"
            )
        return value

    def position(self, k: int) -> tuple[float, float, float]:
        """x, y, z in metres."""
        location = f"features[{k}].geometry.coordinates"
        at = self.rows[k]["geometry"].get("coordinates")
        if not isinstance(at, list) or len(at) < 2:
            raise_unreadable("a node needs two coordinates [x, y]", location)
        x, y, z = (number(v, location) for v in [*at[:3], 0.0][:3])
        frame = self.properties_of(k).get("frame", FRAME)
        if frame != FRAME:
            self.context.warn(f"its frame is {str(frame)[:60]!r}: its coordinates are taken as local", where=location)
        return x, y, z

    def ends(
        self, index_by_number: Mapping[int, int], properties: list[dict[str, Any]]
    ) -> tuple[list[int], list[int], list[int], list[int]]:
        """(features of edges between nodes, their numbers, the places of their ends); others are kept with a node."""
        indices, numbers, sources, targets = [], [], [], []
        for k in self.edges:
            n, start, end = self.read_id(k), self.read_id(k, "startid"), self.read_id(k, "endid")
            a, b = index_by_number.get(start), index_by_number.get(end)
            if a is None or b is None:
                missing = start if a is None else end
                self.context.warn(
                    f"the edge {n} begins or ends at {missing}, which is no node: Nav2 refuses such a graph; it is "
                    "kept, but not served",
                    where=f"features[{k}]",
                )
                edge_properties = {
                    w: v for w, v in self.properties_of(k).items() if w not in ("id", "startid", "endid")
                }
                edge = {"id": n, "from": start, "to": end, "properties": edge_properties}
                home = next((j for j in (a, b) if j is not None), None)
                if home is None:
                    self.dangling.append(edge)
                else:
                    properties[home][NAME].setdefault("dangling", []).append(edge)
                continue
            if a == b:
                self.context.warn(f"the edge {n} leads from a node to itself", where=f"features[{k}]")
            indices.append(k)
            numbers.append(n)
            sources.append(a)
            targets.append(b)
        return indices, numbers, sources, targets

    def canonical(self, k: int, n: int) -> dict[str, Any]:
        """The properties of an item that come from its feature."""
        row = self.rows[k]
        extra_members = {w: v for w, v in self.properties_of(k).items() if w not in ("id", "startid", "endid")}
        out: dict[str, Any] = {}
        metadata = extra_members.get("metadata")
        if isinstance(metadata, dict):
            self.is_complete["integers"] += _integers(metadata)
            out = {CANONICAL_METADATA[w]: v for w, v in metadata.items() if _fits(w, v) and (w, v) != ("name", str(n))}
            left = {w: v for w, v in metadata.items() if CANONICAL_METADATA.get(w) not in out}
            extra_members["metadata"] = left
            if not left and metadata:
                del extra_members["metadata"]
        self.is_complete["integers"] += _integers(extra_members.get("operations"))
        for reason in _loader_problems(extra_members):
            self.context.warn(reason, where=f"features[{k}].properties")
        source_properties: dict[str, Any] = {"id": n}
        if extra_members:
            source_properties["properties"] = extra_members
        members = {w: v for w, v in row.items() if w not in ("type", "properties", "geometry")}
        if members:
            source_properties["members"] = members
        return {**out, NAME: source_properties}

    def shape(self, k: int, straight: Any, source_properties: dict[str, Any]) -> Any:
        """An edge's line: as drawn where that is one line of its own, else from node to node."""
        geometry = self.rows[k]["geometry"]
        parts = geometry.get("coordinates")
        if geometry["type"] == "LineString":
            source_properties["line"] = True
            parts = [parts]
        drawn = _line(parts[0]) if isinstance(parts, list) and len(parts) == 1 else None
        if len(geometry) > 2 or drawn is None:
            if len(geometry) > 2 or parts not in (None, []):
                source_properties["geometry"] = {w: v for w, v in geometry.items() if w != "type"}
            return straight
        return straight if drawn == _line(shapely.get_coordinates(straight).tolist()) else shapely.LineString(drawn)


def _fits(key: str, value: Any) -> bool:
    """Whether a metadata word stands for a canonical one, with a value of its type."""
    if key in TEXTS:
        return isinstance(value, str) and value != ""
    return key in NUMBERS and isinstance(value, (int, float)) and not isinstance(value, bool)


def _line(coordinates: Any) -> list[tuple[float, ...]] | None:
    """Two positions or more, two-dimensional where all heights are 0; None where it is no line."""
    if not isinstance(coordinates, list) or len(coordinates) < 2:
        return None
    out: list[tuple[float, ...]] = []
    for at in coordinates:
        if not isinstance(at, list) or len(at) not in (2, 3):
            return None
        if not all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in at):
            return None
        out.append(tuple(map(float, at)))
    deep = all(len(at) == 3 for at in out) and any(at[2] for at in out)
    return out if deep else [at[:2] for at in out]


def _is_integer(key: str, value: Any) -> bool:
    return key in FLOATS and isinstance(value, int) and not isinstance(value, bool)


def _integers(value: Any) -> int:
    """How many values that Nav2 wants as floats are integers, at any depth."""
    if isinstance(value, list):
        return sum(map(_integers, value))
    if not isinstance(value, dict):
        return 0
    return sum(_is_integer(w, v) + _integers(v) for w, v in value.items())


def _floats(value: Any) -> Any:
    """The same with these values as floats."""
    if isinstance(value, list):
        return [_floats(v) for v in value]
    if not isinstance(value, dict):
        return value
    return {w: float(v) if _is_integer(w, v) else _floats(v) for w, v in value.items()}


def _loader_problems(properties: Mapping[str, Any]) -> Iterator[str]:
    """What the route server's loader would throw at in a feature's properties."""
    metadata, operations = properties.get("metadata"), properties.get("operations")
    if "metadata" in properties:
        yield from _metadata_problems(metadata, "metadata")
    if isinstance(operations, (dict, list)):
        for name, one in operations.items() if isinstance(operations, dict) else enumerate(operations):
            if not isinstance(one, dict) or not isinstance(one.get("type"), str) or one.get("trigger") not in TRIGGERS:
                yield f"the operation {str(name)[:60]!r} needs a type and a trigger, one of {', '.join(TRIGGERS)}"
            elif "metadata" in one:
                yield from _metadata_problems(one["metadata"], f"the metadata of the operation {str(name)[:60]!r}")
    elif "operations" in properties:
        yield "operations must be an object of operations"
    cost = properties.get("cost", 0.0)
    if isinstance(cost, bool) or not isinstance(cost, (int, float)):
        yield f"cost must be a number, got {str(cost)[:40]!r}"
    if not isinstance(properties.get("overridable", True), bool):
        yield f"overridable must be true or false, got {str(properties['overridable'])[:40]!r}"
    if not isinstance(properties.get("frame", ""), str):
        yield f"frame must be a text, got {str(properties['frame'])[:40]!r}"


def _metadata_problems(value: Any, location: str) -> Iterator[str]:
    if not isinstance(value, dict):
        yield f"{location} must be an object"
        return
    for key, inner in value.items():
        if isinstance(inner, dict):
            yield from _metadata_problems(inner, f"{location}.{key[:60]}")
        elif any(v is None or isinstance(v, (dict, list)) for v in (inner if isinstance(inner, list) else [inner])):
            yield f"{location}.{key[:60]}: Nav2 reads numbers, texts, booleans and lists of these only"


# --- writing ---------------------------------------------------------------------------------------------------------


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """``graph.geojson``: all networks of the environment as one graph, nodes and then edges by their numbers.

    Numbers of a source come back; any other item gets one that follows from its id alone (unless that is taken), so
    that it stays the same when others come and go. Wgs84 items are brought to local metres (MissingDatum without a
    datum). CannotConvert where there is no node or no edge.
    """
    return {"graph.geojson": _Writer(layers, context).data()}


ORDER = json.rank_keys(
    "type name id startid endid frame trigger cost overridable metadata operations properties geometry coordinates"
)


def _dump(value: Any) -> bytes:
    return orjson.dumps(json.sort_keys(value, ORDER))


class _Writer:
    def __init__(self, layers: Layers, context: WriteContext) -> None:
        self.context = context
        self.document = source_document(layers, NAME)
        self.net: MergedNetwork = merge_networks(layers, context)
        if not self.net.nodes or not self.net.edges:
            noun = "no node" if not self.net.nodes else "no edge between its nodes"
            raise CannotConvert(f"the network has {noun}; the route server needs both: supply a network with edges")
        self.nodes, self.edges = self._numbers()
        self.options = context.options if isinstance(context.options, WriteOptions) else WriteOptions()
        self.framed = 0
        self.lost: Counter[str] = Counter()

    def _numbers(self) -> tuple[list[int], list[int]]:
        """The numbers of nodes and edges, apart from each other where there are enough."""
        net, context = self.net, self.context
        nodes, edges = _stored_numbers(net.nodes), _stored_numbers(net.edges)
        own_nodes, own_edges = set(nodes.values()), set(edges.values())
        apart = len(net.nodes) + len(net.edges) <= MAX_USED_ID // 2
        nodes = _assign_numbers(net.nodes, nodes, own_nodes | own_edges if apart else own_nodes)
        edges = _assign_numbers(net.edges, edges, {*own_edges, *nodes.values()} if apart else own_edges)
        duplicate_count = sum(_claim(n) not in (None, nodes[k]) for k, n in enumerate(net.nodes))
        duplicate_count += sum(_claim(e) not in (None, edges[k]) for k, e in enumerate(net.edges))
        if duplicate_count:
            context.warn(
                f"{duplicate_count} numbers stood for several items, which Nav2 would mix up: the others got new ones"
            )
        return [nodes[k] for k in range(len(nodes))], [edges[k] for k in range(len(edges))]

    def data(self) -> bytes:
        """The whole text, one line for each feature."""
        net, context = self.net, self.context
        at = np.array([(n.x, n.y, 0.0 if n.z is None else n.z) for n in net.nodes], np.float64)
        places = (np.round(at, METRES) + 0.0).tolist()
        rows = [
            self._feature(node, n, {"type": "Point", "coordinates": position if position[2] else position[:2]}, {})
            for n, node, position in sorted(zip(self.nodes, net.nodes, places, strict=True), key=lambda t: t[0])
        ]
        for n, edge in sorted(zip(self.edges, net.edges, strict=True), key=lambda t: t[0]):
            ends = {"startid": self.nodes[edge.source], "endid": self.nodes[edge.target]}
            rows.append(self._feature(edge, n, self._shape(edge), ends))
        self._report()
        head = {"type": "FeatureCollection", **self._head()}
        ignored = self.document.get("ignored")
        rows += [_dump(row) for row in ignored if isinstance(row, dict)] if isinstance(ignored, list) else []
        self.lost["dangling"] += count(self.document.get("dangling"))
        context.drop("edges to nowhere", self.lost["dangling"], "Nav2 refuses a graph with one, and loses the old one")
        return _dump(head)[:-1] + b',"features":[\n' + b",\n".join(rows) + b"\n]}\n"

    def _head(self) -> dict[str, Any]:
        members = self.document.get("members")
        head = {w: v for w, v in members.items() if w not in ("type", "features")} if isinstance(members, dict) else {}
        if not self.document:
            title = self.options.graph_name or self.context.title
            head = {"name": title, "crs": CRS}
            self.context.fill("name", title, "no source names the graph", "graph_name")
            self.context.fill("crs", CRS["properties"], "QGIS shows metres by it; the route server ignores it")
        if self.context.attribution and not head.keys() & {"attribution", "license", "copyright"}:
            head["attribution"] = "; ".join(self.context.attribution)
        return head

    def _feature(self, item: Node | Edge, n: int, geometry: dict[str, Any], ends: dict[str, int]) -> bytes:
        """One line of the file."""
        p = item.properties
        source_members = get_source_properties(p, NAME)
        extra_properties = source_members.get("properties")
        properties: dict[str, Any] = {"id": n, **ends}
        if NAME not in p and not ends:
            properties["frame"] = self.options.frame_id
            self.framed += 1
        if isinstance(extra_properties, dict):
            properties |= {w: v for w, v in extra_properties.items() if w not in properties}
        metadata = properties.get("metadata")
        more = self._metadata(p, str(n))
        if more and isinstance(metadata, (dict, type(None))):
            properties["metadata"] = {**(metadata or {}), **more}
        for key in ("metadata", "operations"):
            if key in properties:
                properties[key] = _floats(properties[key])
        for reason in _loader_problems(properties):
            self.context.warn(reason, where=str(n))
        self.lost["attributes"] += bool(p.keys() - (CANONICAL_EDGE if ends else CANONICAL_NODE))
        self.lost["dangling"] += count(source_members.get("dangling"))
        members = source_members.get("members")
        row = {"type": "Feature", "properties": properties, "geometry": geometry}
        if isinstance(members, dict):
            row |= {w: v for w, v in members.items() if w not in row}
        return _dump(row)

    def _metadata(self, p: Properties, number: str) -> dict[str, Any]:
        """The canonical words among the metadata."""
        out: dict[str, Any] = {}
        for key, canonical in CANONICAL_METADATA.items():
            value: Any = p.get(canonical)
            if _fits(key, value):
                out[key] = float(value) if key in NUMBERS else value
        if out.get("name") == number:
            del out["name"]
        if p.get("blocked") is True:
            out["blocked"] = True
        return out

    def _shape(self, edge: Edge) -> dict[str, Any]:
        source_members = get_source_properties(edge.properties, NAME)
        kind = "LineString" if source_members.get("line") is True else "MultiLineString"
        odd = source_members.get("geometry")
        if isinstance(odd, dict):
            return {"type": kind, **{w: v for w, v in odd.items() if w != "type"}}
        if edge.geometry is None or shapely.get_num_coordinates(edge.geometry) < 2:
            ends = [self.net.nodes[edge.source], self.net.nodes[edge.target]]
            at: NDArray[np.float64] = np.array([(n.x, n.y) for n in ends])
        else:
            at = shapely.get_coordinates(edge.geometry, include_z=bool(shapely.has_z(edge.geometry)))
        coordinates = (np.round(at, METRES) + 0.0).tolist()
        return {"type": kind, "coordinates": coordinates if kind == "LineString" else [coordinates]}

    def _report(self) -> None:
        net, context, counts = self.net, self.context, self.lost
        if len(set(net.levels)) > 1:
            context.drop("levels of nodes", len(net.nodes), "all networks are joined into one graph")
        foreign = sum(NAME not in n.properties for n in net.nodes) + sum(NAME not in e.properties for e in net.edges)
        if self.framed:
            context.fill("frame", self.options.frame_id, f"{self.framed} nodes name none", "frame_id")
        if foreign:
            context.fill("id", "a number made from each id", f"{foreign} nodes and edges have no number of their own")
        context.drop(
            "items with attributes that Nav2 has no word for", counts["attributes"], "other formats' own knowledge"
        )


def _claim(item: Node | Edge) -> int | None:
    """The number that an item has from its source."""
    source_id = get_source_properties(item.properties, NAME).get("id")
    return (
        source_id
        if isinstance(source_id, int) and not isinstance(source_id, bool) and 0 <= source_id <= MAX_ID
        else None
    )


def _stored_numbers(items: Sequence[Node | Edge]) -> dict[int, int]:
    """Place -> number of the items that have one; of several with the same, the one whose id still says it."""
    claims: dict[int, list[int]] = defaultdict(list)
    for k, item in enumerate(items):
        n = _claim(item)
        if n is not None:
            claims[n].append(k)
    return {min(rivals, key=lambda k: (items[k].id != str(n), items[k].id)): n for n, rivals in claims.items()}


def _assign_numbers(items: Sequence[Node | Edge], claims: Mapping[int, int], taken: set[int]) -> dict[int, int]:
    """Place -> number of all items; ``taken`` grows. Ids that are numbers come before those that one is made from."""
    out = dict(claims)
    remaining = sorted((k for k in range(len(items)) if k not in out), key=lambda k: items[k].id)
    for k in remaining:
        if _is_number(items[k].id) and int(items[k].id) not in taken:
            out[k] = int(items[k].id)
            taken.add(out[k])
    size = 2**16 if len(items) <= MAX_USED_ID // 2 else 2**32
    for k in remaining:
        if k not in out:
            out[k] = next(n for n in _candidates(items[k].id, size) if n not in taken)
            taken.add(out[k])
    return out


def _is_number(text: str) -> bool:
    return text.isascii() and text.isdigit() and len(text) <= 5 and str(int(text)) == text and int(text) <= MAX_USED_ID


def _candidates(text: str, size: int) -> Iterable[int]:
    """Numbers below ``size`` that follow from a text, one after the other."""
    first = int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "big")
    step = first >> 32 | 1  # odd, so that all numbers come
    return ((first + k * step) % size for k in range(size))


# --- the format ------------------------------------------------------------------------------------------------------


def lacks(layers: Layers) -> str | None:
    """Nodes and edges must both be there."""
    kinds = {p.get("kind") for part in layers.vector("topology").values() for p in part.properties}
    return None if {"node", "edge"} <= kinds else "the network has no edge between its nodes: supply one with edges"


def detect(name: str, data: bytes) -> bool:  # noqa: ARG001 - one signature for all formats
    """A JSON object of features with the route server's own words."""
    if data[:64].lstrip(b"\xef\xbb\xbf \t\r\n")[:1] != b"{":
        return False
    return b'"startid"' in data and b'"endid"' in data and b'"features"' in data


register(
    Format(
        name=NAME,
        title="Route graph (Nav2 route server)",
        files={"graph.geojson": "application/geo+json"},
        layers=frozenset({"topology"}),
        detect=detect,
        read=read,
        write=write,
        needs=LayerRequirements(one_of=(frozenset({"topology"}),), anchor="local", missing_content=lacks),
        write_options=WriteOptions,
        check=_nav2_route_rules.check,
        extensions=(".geojson", ".json"),
        version=2,
        claims=Claims(priority=36),
        traits=Traits(keeps_bends="foreign", has_title=True),
    )
)
