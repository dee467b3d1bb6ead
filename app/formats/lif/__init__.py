"""lif: VDMA's Layout Interchange Format 1.0, the tracks of automated guided vehicles as JSON.

A file has layouts, each with nodes, directed edges and stations; all of them share one origin, metres, x and y. What a
type of vehicle may do at a node or along an edge stands in a list with one entry for each type. Two drafts of 2.0 are
read too and served as they came: one calls vehicles mobile robots, the other one also puts layouts into ``origins``.
Source: VDMA LIF 1.0.0 (LIF.md, section 8).

Canonical: a layout's ``layoutLevelId`` is its level (without one, the level asked for), its nodes and edges are that
level's network, its stations objects of the kind ``station``. An item's id is the file's; ``nodeName``, ``edgeName``
and ``stationName`` are its name. A speed or an orientation that all types of vehicle share is the item's: an edge's
``maxSpeed`` is its ``speed_limit``, a node's ``theta`` its ``orientation``, and a trajectory of degree 1 is an edge's
bends. ``properties.lif`` holds the rest of the item under ``item``, its ``id``, the ``layout`` it stands in and ``at``
which place there, and a node's ``dangling`` edges. The document's ``lif`` holds the file's other members under ``top``
and what it says of its ``layouts`` and ``origins``.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

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
    Selection,
    Traits,
    WriteContext,
    _fields,
    register,
)
from app.formats._fields import ANGLE, COORDINATE, NOT_NEGATIVE, SPEED, Number, OneOf, record
from app.formats._network import (
    CROSS_PART_PROPERTIES,
    SAME_ANGLE,
    Array,
    Edge,
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
    shorten_list,
    yaw_or_source,
)
from app.formats.lif import rules as _lif_rules
from app.model.features import NO_GEOMETRY, Features, Properties, from_columns, unique_ids
from app.model.frame import GROUND
from app.model.layers import NETWORK, Layers, Part, PartKey
from app.parameters import parameter
from app.syntax import json
from app.syntax.decimals import METRES

NAME = "lif"
VERSION = "1.0.0"
EPOCH = "1970-01-01T00:00:00.00Z"
"""Where a source tells no time: the same network must give the same bytes."""

ORDER = json.rank_keys(
    "metaInformation projectIdentification lifId creator exportTimestamp lifVersion origins originId layoutId "
    "layoutName layoutVersion layoutLevelId layoutDescription layouts nodes edges stations nodeId nodeName "
    "nodeDescription mapId nodePosition edgeId edgeName edgeDescription startNodeId endNodeId stationId "
    "interactionNodeIds stationName stationDescription stationHeight stationPosition x y theta weight "
    "vehicleTypeNodeProperties vehicleTypeEdgeProperties vehicleTypeId actionType actionDescription "
    "requirementType blockingType actionParameters key value degree knotVector controlPoints"
)
"""How the keys follow each other, as in the specification."""

LISTS = frozenset({"nodes", "edges", "stations"})
_ACTION = record(
    "actionType actionDescription actionParameters",
    requirementType=OneOf(("REQUIRED", "CONDITIONAL", "OPTIONAL")),
    blockingType=OneOf(("NONE", "SOFT", "HARD")),
)
_TRAJECTORY = record(
    degree=Number(1.0, 1000.0),
    knotVector=[Number(0.0, 1e6)],
    controlPoints=[record(x=COORDINATE, y=COORDINATE, weight=Number(0.0, 1e9, above=True))],
)
_NODE = record(
    "nodeId nodeName nodeDescription mapId",
    nodePosition=record(x=COORDINATE, y=COORDINATE),
    vehicleTypeNodeProperties=[record("vehicleTypeId", theta=Number(-1e4, 1e4), actions=[_ACTION])],
)
_EDGE = record(
    "edgeId edgeName edgeDescription startNodeId endNodeId",
    vehicleTypeEdgeProperties=[
        record(
            "vehicleTypeId rotationAllowed rotationAtStartNodeAllowed rotationAtEndNodeAllowed loadRestriction "
            "reentryAllowed",
            vehicleOrientation=Number(-1e4, 1e4, usual=(-360.0, 360.0), hint="it is beyond a full turn"),
            orientationType=OneOf(("GLOBAL", "TANGENTIAL")),
            maxSpeed=SPEED,
            maxRotationSpeed=Number(0.0, 1000.0, unit="rad/s"),
            minHeight=COORDINATE,
            maxHeight=COORDINATE,
            trajectory=_TRAJECTORY,
            actions=[_ACTION],
        )
    ],
)
_STATION = record(
    "stationId stationName stationDescription interactionNodeIds",
    stationHeight=NOT_NEGATIVE,
    stationPosition=record(x=COORDINATE, y=COORDINATE, theta=ANGLE),
)
SHAPE = record(
    metaInformation=record("projectIdentification creator exportTimestamp lifVersion"),
    layouts=[
        record(
            "layoutId layoutName layoutVersion layoutLevelId layoutDescription",
            nodes=[_NODE],
            edges=[_EDGE],
            stations=[_STATION],
        )
    ],
)
"""What a file of version 1 holds. Source: VDMA LIF 1.0.0, section 8."""

CANONICAL_NODE = frozenset({"kind", "name", "orientation", NAME}) | CROSS_PART_PROPERTIES
CANONICAL_EDGE = frozenset({"kind", "name", "source", "target", "speed_limit", NAME}) | CROSS_PART_PROPERTIES
CANONICAL_STATION = frozenset({"kind", "name", NAME}) | CROSS_PART_PROPERTIES


@dataclass(frozen=True, slots=True)
class Dialect:
    """How a version of the format calls what types of vehicle have of their own, and the member that names a type."""

    node: str
    edge: str
    type: str

    def vehicle_type_member(self, name: str) -> dict[str, Any]:
        """The member that names a type of vehicle."""
        if self.type == "mobileRobotTypes":
            return {self.type: [{"manufacturer": name, "seriesName": name}]}
        return {self.type: name}


LIF_1 = Dialect("vehicleTypeNodeProperties", "vehicleTypeEdgeProperties", "vehicleTypeId")
LIF_2 = Dialect("mobileRobotTypeNodeProperties", "mobileRobotTypeEdgeProperties", "mobileRobotTypeId")
LIF_3 = Dialect(LIF_2.node, LIF_2.edge, "mobileRobotTypes")


@dataclass(frozen=True, slots=True)
class WriteOptions:
    """What the file says where no source does."""

    vehicle_type: str = parameter("any", "type of vehicle of nodes and edges whose source names none")
    creator: str = parameter("Fleet Map Server", "creator of a file that no source names one for")
    project: str | None = parameter(None, "project of a file that no source names one for; default: the map's name")
    orientation_type: Literal["TANGENTIAL", "GLOBAL"] = parameter(
        "TANGENTIAL", "what the orientation of vehicles on new edges is measured from"
    )
    vehicle_orientation: float = parameter(0.0, "of vehicles on new edges", minimum=-3.2, maximum=3.2, unit="rad")
    rotation_allowed: bool = parameter(False, "whether vehicles may turn on new edges")
    layout_version: str = parameter("1", "version of layouts that no source has")


# --- reading ---------------------------------------------------------------------------------------------------------


def read(files: Files, context: ReadContext) -> Layers:
    """Networks by level, and stations as objects, in local metres. Raises UnreadableFile naming the item."""
    if not (context.wants("topology") or context.wants("objects")):
        return Layers()
    top = json.load(files[context.main or next(iter(files))], context.limits)
    if not isinstance(top, dict) or not isinstance(top.get("layouts", top.get("origins")), list):
        reason = "a LIF file is one object with an array of layouts"
        raise UnreadableFile(reason, [Problem(reason, where="layouts")])
    reader = _Reader(top, context)
    layers = reader.layers()
    if reader.is_first:  # drafts of version 2 have other members in each revision
        _fields.check(top, SHAPE, context)
    return layers


@dataclass(slots=True)
class _Item:
    """A node, edge or station of the file."""

    said: dict[str, Any]
    where: str
    name: str
    layout: str
    at: int
    level: str
    id: str = ""


@dataclass(slots=True)
class _Level:
    """What becomes of one level: places of its nodes, its edges and stations with what they need of the nodes."""

    nodes: list[int] = field(default_factory=list)
    edges: list[tuple[_Item, int, int]] = field(default_factory=list)
    stations: list[_Item] = field(default_factory=list)


class _Reader:
    def __init__(self, top: dict[str, Any], context: ReadContext) -> None:
        self.top, self.context = top, context
        self.is_first = "origins" not in top
        self.doubts: Counter[str] = Counter()
        self.heads: list[dict[str, Any]] = []
        self.found: dict[str, list[_Item]] = {kind: [] for kind in ("node", "edge", "station")}
        self.document: dict[str, Any] = {
            "top": {w: v for w, v in top.items() if w not in ("layouts", "origins")},
            "layouts": self.heads,
        }
        self.version()
        for row, location in self.layouts():
            self.layout(row, location)
        total = sum(map(len, self.found.values()))
        if total > context.limits.features:
            raise TooLarge(f"the file has {total} items; the limit is {context.limits.features}")

    def version(self) -> None:
        """Report a version that is not known, or missing."""
        meta = self.top.get("metaInformation")
        version = meta.get("lifVersion") if isinstance(meta, dict) else None
        if not isinstance(version, str):
            self.context.warn("is missing; it is read as version 1.0", where="metaInformation.lifVersion")
        elif version.split(".")[0] not in ("0", "1"):
            self.is_first = False
            self.context.warn(
                f"version {version[:40]} is a draft, read as far as it is known; it is served as it came",
                where="metaInformation.lifVersion",
            )

    def layouts(self) -> Iterable[tuple[Any, str]]:
        """(layout, where it stands), also those inside of origins."""
        for k, row in enumerate(self._list(self.top, "layouts", "")):
            yield row, f"layouts[{k}]"
        origins = self._list(self.top, "origins", "")
        if "origins" in self.top:
            self.document["origins"] = heads = []
        if len(origins) > 1:
            self.context.warn("origins need not fit together: all are taken for the local one", where="origins")
        for k, origin in enumerate(origins):
            location = f"origins[{k}]"
            if not isinstance(origin, dict):
                raise_unreadable("must be an object", location)
            first = len(self.heads)
            for j, row in enumerate(self._list(origin, "layouts", location)):
                yield row, f"{location}.layouts[{j}]"
            layout_ids = [head["layoutId"] for head in self.heads[first:]]
            heads.append({"head": {w: v for w, v in origin.items() if w != "layouts"}, "layouts": layout_ids})

    def _list(self, of: Mapping[str, Any], key: str, location: str) -> list[Any]:
        value = of.get(key)
        if not isinstance(value, (list, type(None))):
            raise_unreadable("must be an array", f"{location}.{key}".lstrip("."))
        return value or []

    def layout(self, row: Any, location: str) -> None:
        """Take in a layout's items."""
        if not isinstance(row, dict):
            raise_unreadable("must be an object", location)
        layout_id = row.get("layoutId")
        if not isinstance(layout_id, str) or not is_name(layout_id):
            raise_unreadable("a layout needs an id, a text", f"{location}.layoutId")
        if any(head["layoutId"] == layout_id for head in self.heads):
            raise_unreadable(
                f"the layout {layout_id!r} stands twice: give layouts different ids", f"{location}.layoutId"
            )
        self.heads.append({w: v for w, v in row.items() if w not in LISTS})
        level = row.get("layoutLevelId")
        if level is None or level == "":
            level = self.context.level
        elif not isinstance(level, str):
            raise_unreadable("must be a text", f"{location}.layoutLevelId")
        level = check_name(level, f"{location}.layoutLevelId")
        for kind, items in self.found.items():
            for at, item in enumerate(self._list(row, f"{kind}s", location)):
                spot = f"{location}.{kind}s[{at}]"
                if not isinstance(item, dict):
                    raise_unreadable("must be an object", spot)
                name = item.get(f"{kind}Id")
                if isinstance(name, (int, float)) and not isinstance(name, bool):
                    self.context.warn(f"{name!r} is no text; it is served as one", where=f"{spot}.{kind}Id")
                    name = str(name)
                if not isinstance(name, str):
                    raise_unreadable("needs an id, a text", f"{spot}.{kind}Id")
                items.append(_Item(item, spot, check_name(name, f"{spot}.{kind}Id"), layout_id, at, level))

    def layers(self) -> Layers:
        nodes, edges, stations = self.found["node"], self.found["edge"], self.found["station"]
        taken: set[str] = set()
        for kind, items in (("nodes", nodes), ("edges", edges)):
            for item, i in zip(items, unique_ids((identifier(item.name) for item in items), taken), strict=True):
                item.id = i
                taken.add(i)
            if repeats := duplicates([item.name for item in items]):
                self.context.warn(
                    f"{len(repeats)} {kind} share an id: {shorten_list(repeats)}; references mean the first one"
                )
        for item, i in zip(stations, unique_ids(identifier(s.name) for s in stations), strict=True):
            item.id = i
        index_by_name = {item.name: k for k, item in reversed(list(enumerate(nodes)))}
        xyz: Array = np.array([self.position(n.said.get("nodePosition"), n.where, "node") for n in nodes], np.float64)
        xyz = xyz.reshape(-1, 3)
        levels: dict[str, _Level] = {}
        for k, node in enumerate(nodes):
            levels.setdefault(node.level, _Level()).nodes.append(k)
        properties = [self.node(node) for node in nodes]
        for edge in edges:
            self.join(edge, index_by_name, properties, levels)
        for station in stations:
            self.check_station(station, index_by_name)
            levels.setdefault(station.level, _Level()).stations.append(station)
        parts: dict[PartKey, Part] = {}
        for level, content in levels.items():
            if content.nodes or content.edges:
                parts[PartKey("topology", level, NETWORK)] = self.network(content, xyz, nodes, properties)
            if content.stations:
                parts[PartKey("objects", level, NAME)] = self.stations(content.stations)
        if not parts:
            empty = Features((), np.empty(0, object), (), np.empty(0, bool), {NAME: self.document})
            parts[PartKey("topology", self.context.level, NETWORK)] = empty
        for noun, n in sorted(self.doubts.items()):
            self.context.warn(f"{n} {noun}")
        return Layers(parts)  # LIF does not say how high its levels are

    def position(self, value: Any, location: str, kind: str) -> tuple[float, float, float]:
        """x, y in metres, and 0."""
        location = f"{location}.{kind}Position"
        if not isinstance(value, dict) or "x" not in value or "y" not in value:
            raise_unreadable("must be an object with x and y", location)
        return number(value["x"], f"{location}.x"), number(value["y"], f"{location}.y"), 0.0

    def source_members(self, item: _Item, kind: str, *keys: str) -> dict[str, Any]:
        """What only this format knows of an item; ``keys`` members are canonical."""
        position = item.said.get(f"{kind}Position")
        extra_members = {w: v for w, v in item.said.items() if w not in (f"{kind}Id", *keys)}
        if isinstance(position, dict):
            extra_members.pop(f"{kind}Position", None)
            if more := {w: v for w, v in position.items() if w not in ("x", "y")}:
                extra_members[f"{kind}Position"] = more
        out: dict[str, Any] = {"id": item.name, "layout": item.layout, "at": item.at}
        name = extra_members.get(f"{kind}Name")
        if isinstance(name, str) and is_name(name) and name != item.name:
            del extra_members[f"{kind}Name"]
        out["item"] = extra_members
        return out

    def name_members(self, item: _Item, kind: str) -> dict[str, Any]:
        name = item.said.get(f"{kind}Name")
        return {"name": name} if isinstance(name, str) and is_name(name) else {}

    def node(self, item: _Item) -> dict[str, Any]:
        source_properties = self.source_members(item, "node")
        out: dict[str, Any] = {"kind": "node", "name": item.name, **self.name_members(item, "node")}
        entries = _entries(source_properties["item"], "node")
        if not entries:
            self.doubts["nodes name no type of vehicle, so that none may use them"] += 1
        theta = _common_number(entries, "theta")
        if theta is not None and abs(theta) <= math.pi + SAME_ANGLE:
            out["orientation"] = quaternion(float(theta))
        far = sum(_is_number(e.get("theta")) and abs(e["theta"]) > math.pi + SAME_ANGLE for e in entries)
        if far:
            self.doubts["values of theta are beyond ±π: radians are meant; they are kept, but not believed"] += far
        out[NAME] = source_properties
        return out

    def join(
        self,
        edge: _Item,
        index_by_name: Mapping[str, int],
        properties: Sequence[dict[str, Any]],
        levels: dict[str, _Level],
    ) -> None:
        """Put an edge on its level; one to nowhere stays with the node it knows, else with its layout."""
        ends = [edge.said.get("startNodeId"), edge.said.get("endNodeId")]
        a, b = (index_by_name.get(str(e)) if isinstance(e, (str, int)) else None for e in ends)
        if a is not None and b is not None:
            if a == b:
                self.context.warn(f"the edge {edge.name} leads from a node to itself", where=edge.where)
            levels.setdefault(edge.level, _Level()).edges.append((edge, a, b))
            return
        missing = str(ends[0] if a is None else ends[1])[:60]
        self.context.warn(f"the edge {edge.name} leads to {missing!r}, which is no node; it is kept", where=edge.where)
        dangling_edge = {"layout": edge.layout, "at": edge.at, "item": edge.said}
        home = next((k for k in (a, b) if k is not None), None)
        of = self.document if home is None else properties[home][NAME]
        of.setdefault("dangling", []).append(dangling_edge)

    def check_station(self, station: _Item, index_by_name: Mapping[str, int]) -> None:
        node_ids = station.said.get("interactionNodeIds")
        if not isinstance(node_ids, list) or not all(isinstance(i, str) for i in node_ids):
            self.context.warn("needs an array of the nodes where it is reached", where=station.where)
            return
        unknown = [i for i in node_ids if i not in index_by_name]
        if unknown:
            self.context.warn(
                f"the station is reached at {shorten_list(unknown)}, which is no node", where=station.where
            )

    def network(
        self, content: _Level, xyz: Array, nodes: Sequence[_Item], properties: Sequence[dict[str, Any]]
    ) -> Features:
        """The topology of a level."""
        sources, targets = [a for _, a, _ in content.edges], [b for _, _, b in content.edges]
        lines = edge_lines(xyz, sources, targets)
        rows: list[Properties] = [properties[k] for k in content.nodes]
        for j, (edge, a, b) in enumerate(content.edges):
            source_properties = self.source_members(edge, "edge", "startNodeId", "endNodeId")
            entries = _entries(source_properties["item"], "edge")
            if not entries:
                self.doubts["edges name no type of vehicle, so that none may use them"] += 1
            out = {"kind": "edge", "source": nodes[a].id, "target": nodes[b].id, **self.name_members(edge, "edge")}
            speed = _common_number(entries, "maxSpeed")
            if speed is not None and speed >= 0:
                out["speed_limit"] = speed
                source_properties["item"] = _without(source_properties["item"], "edge", "maxSpeed")
            bends = _polyline(entries)
            if bends is not None:
                lines[j] = shapely.LineString(bends)
                source_properties["item"] = _without(source_properties["item"], "edge", "trajectory")
            rows.append({**out, NAME: source_properties})
        ids = [nodes[k].id for k in content.nodes] + [edge.id for edge, _, _ in content.edges]
        geometry = np.concatenate([node_points(xyz[content.nodes]), lines])
        return from_columns(ids, geometry, rows, "local", {NAME: self.document})

    def stations(self, items: Sequence[_Item]) -> Features:
        """Stations as objects: points, or without a geometry where the file does not say where they stand."""
        geometry: NDArray[np.object_] = np.empty(len(items), object)
        rows: list[Properties] = []
        for k, item in enumerate(items):
            position = item.said.get("stationPosition")
            geometry[k] = (
                NO_GEOMETRY if position is None else shapely.Point(self.position(position, item.where, "station")[:2])
            )
            source_properties = self.source_members(item, "station")
            if position is None and "stationPosition" in source_properties["item"]:
                del source_properties["item"]["stationPosition"]
            rows.append(
                {"kind": "station", "name": item.name, **self.name_members(item, "station"), NAME: source_properties}
            )
        return from_columns([item.id for item in items], geometry, rows, "local", {NAME: {}})


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _vehicle_properties_key(item: Mapping[str, Any], kind: str) -> str | None:
    """The member that holds what types of vehicle have of their own."""
    keys = (getattr(LIF_1, kind), getattr(LIF_2, kind))
    return next((w for w in keys if isinstance(item.get(w), list)), None)


def _entries(item: Mapping[str, Any], kind: str) -> list[dict[str, Any]]:
    """What types of vehicle have of their own at an item; nothing where an entry is no object."""
    key = _vehicle_properties_key(item, kind)
    entries = item[key] if key else []
    return entries if all(isinstance(e, dict) for e in entries) else []


def _common_number(entries: Sequence[Mapping[str, Any]], key: str) -> Any:
    """The number that all entries have in common, else None."""
    values = [e.get(key) for e in entries]
    same = values and all(_is_number(v) and v == values[0] and type(v) is type(values[0]) for v in values)
    return values[0] if same else None


def _without(item: Mapping[str, Any], kind: str, key: str) -> dict[str, Any]:
    """The item, its entries without a word."""
    list_word = _vehicle_properties_key(item, kind)
    if list_word is None:
        return dict(item)
    return {**item, list_word: [{w: v for w, v in e.items() if w != key} for e in item[list_word]]}


def _trajectory(line: Sequence[Sequence[float]]) -> dict[str, Any]:
    """A line of n positions as the NURBS of degree 1 through them: knots from 0 to 1, evenly spread."""
    n = len(line)
    inner = [k / (n - 1) for k in range(1, n - 1)]
    points = [{"x": x, "y": y} for x, y in line]
    return {"degree": 1, "knotVector": [0.0, 0.0, *inner, 1.0, 1.0], "controlPoints": points}


def _polyline(entries: Sequence[Mapping[str, Any]]) -> list[tuple[float, float]] | None:
    """The positions of a trajectory that all entries share, where it is one that ``_trajectory`` writes."""
    trajectory = entries[0].get("trajectory") if entries else None
    points = trajectory.get("controlPoints") if isinstance(trajectory, dict) else None
    if not isinstance(points, list) or len(points) < 3 or any(e.get("trajectory") != trajectory for e in entries):
        return None
    line = []
    for p in points:
        if not isinstance(p, dict) or not _is_number(p.get("x")) or not _is_number(p.get("y")):
            return None
        line.append((float(p["x"]), float(p["y"])))
    return line if _trajectory(line) == trajectory else None


# --- writing ---------------------------------------------------------------------------------------------------------


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """``layout.lif.json``: each level is a layout of its own, or the ones that its source has.

    Wgs84 items are brought to local metres (MissingDatum without a datum). CannotConvert where there is no node.
    """
    return {"layout.lif.json": _Writer(layers, context).data()}


@dataclass(slots=True)
class _Layout:
    """A layout being written: what it says of itself, and its items with where they stood."""

    head: dict[str, Any]
    items: dict[str, list[tuple[tuple[bool, int, tuple[int, str]], dict[str, Any]]]] = field(
        default_factory=lambda: {"nodes": [], "edges": [], "stations": []}
    )


class _Writer:
    def __init__(self, layers: Layers, context: WriteContext) -> None:
        self.layers, self.context = layers, context
        self.options = context.options if isinstance(context.options, WriteOptions) else WriteOptions()
        self.net = merge_networks(layers, context)
        if not self.net.nodes:
            raise CannotConvert("the network has no node, and a layout needs one: supply a network with nodes")
        self.filled: Counter[str] = Counter()
        self.lost: Counter[str] = Counter()
        documents = [get_source_properties(part.document, NAME) for part in layers.vector("topology").values()]
        self.documents = [d for d in documents if d]
        self.layouts: dict[str, _Layout] = {}
        self.origins: list[dict[str, Any]] = []
        for document in self.documents:
            for head in _objects(document.get("layouts")):
                layout_id = head.get("layoutId")
                if isinstance(layout_id, str) and is_name(layout_id) and layout_id not in self.layouts:
                    self.layouts[layout_id] = _Layout({w: v for w, v in head.items() if w not in LISTS})
        self.dialect = self._dialect()

    def _dialect(self) -> Dialect:
        """The one that the source's items speak."""
        property_sets = [n.properties for n in self.net.nodes] + [e.properties for e in self.net.edges]
        for p in property_sets:
            source_members = get_source_properties(get_source_properties(p, NAME), "item")
            for kind in ("node", "edge"):
                for entry in _entries(source_members, kind):
                    spoken = next((d for d in (LIF_1, LIF_2, LIF_3) if d.type in entry), None)
                    if spoken is not None:
                        return spoken
        return LIF_1

    def data(self) -> bytes:
        """The whole text."""
        names = self._names(self.net.nodes)
        for node, name in zip(self.net.nodes, names, strict=True):
            self._add_to_layout("nodes", node.properties, node.level, name, self._node(node, name))
        for edge, name in zip(self.net.edges, self._names(self.net.edges), strict=True):
            self._add_to_layout("edges", edge.properties, edge.level, name, self._edge(edge, name, names))
        self._stations()
        self._dangling()
        out = self._top()
        inside = self._origins()
        placed = {i for _, layout_ids in inside for i in layout_ids}
        if inside:
            out["origins"] = [{**head, "layouts": [self._layout(i) for i in layout_ids]} for head, layout_ids in inside]
        free_layouts = [self._layout(i) for i in self.layouts if i not in placed]
        if free_layouts or not inside:
            out["layouts"] = free_layouts
        self._report()
        return orjson.dumps(json.sort_keys(out, ORDER), option=orjson.OPT_INDENT_2) + b"\n"

    def _top(self) -> dict[str, Any]:
        top: dict[str, Any] = {}
        for document in reversed(self.documents):
            top |= get_source_properties(document, "top")
        top = {w: v for w, v in top.items() if w not in ("layouts", "origins")}
        meta = dict(get_source_properties(top, "metaInformation"))
        if "lifId" not in meta and "projectIdentification" not in meta:
            meta["projectIdentification"] = self.options.project or self.context.title
            project = meta["projectIdentification"]
            self.context.fill("metaInformation.projectIdentification", project, "no source names it", "project")
        for key, value in (("creator", self.options.creator), ("exportTimestamp", EPOCH), ("lifVersion", VERSION)):
            if key not in meta:
                meta[key] = value
                option = key if key == "creator" else None
                self.context.fill(f"metaInformation.{key}", value, "no source names it", option)
        return {**top, "metaInformation": meta}

    def _origins(self) -> list[tuple[dict[str, Any], list[str]]]:
        """(head, ids of its layouts) of the origins that the source has; other layouts join the first one."""
        origins: list[tuple[dict[str, Any], list[str]]] = []
        placed: set[str] = set()
        for document in self.documents:
            for origin in _objects(document.get("origins")):
                head = {w: v for w, v in get_source_properties(origin, "head").items() if w != "layouts"}
                if any(head == other for other, _ in origins):
                    continue
                ids = origin.get("layouts")
                layout_ids = [i for i in ids if isinstance(i, str)] if isinstance(ids, list) else []
                layout_ids = [i for i in dict.fromkeys(layout_ids) if i in self.layouts and i not in placed]
                placed |= set(layout_ids)
                origins.append((head, layout_ids))
        if origins:
            origins[0][1].extend(i for i in self.layouts if i not in placed)
        return origins

    def _layout(self, i: str) -> dict[str, Any]:
        layout = self.layouts[i]
        out = dict(layout.head)
        for section, items in layout.items.items():
            if items or section != "stations":
                out[section] = [item for _, item in sorted(items, key=lambda t: t[0])]
        return out

    def _add_to_layout(self, section: str, p: Properties, level: str, name: str, item: dict[str, Any]) -> None:
        """Put an item into its layout: the one its source says, the first of its level, or a new one."""
        source_members = get_source_properties(p, NAME)
        layout_id, at = source_members.get("layout"), source_members.get("at")
        if not isinstance(layout_id, str) or layout_id not in self.layouts:
            of_level = (i for i, v in self.layouts.items() if v.head.get("layoutLevelId", GROUND) == level)
            layout_id = next(of_level, None)
        if layout_id is None:
            layout_id = unique_ids([level], set(self.layouts))[0]
            version = self.options.layout_version
            head = {
                "layoutId": layout_id,
                "layoutVersion": version,
                **({} if level == GROUND else {"layoutLevelId": level}),
            }
            self.layouts[layout_id] = _Layout(head)
            self.filled["layouts"] += 1
        has_index = isinstance(at, int) and not isinstance(at, bool)
        key = (not has_index, at if isinstance(at, int) else 0, natural_sort_key(name))
        self.layouts[layout_id].items[section].append((key, item))

    def _names(self, items: Sequence[Node | Edge]) -> list[str]:
        """The ids of the file: those of the sources, where they are distinct."""
        names = []
        for item in items:
            source_id = get_source_properties(item.properties, NAME).get("id")
            names.append(source_id if isinstance(source_id, str) and is_name(source_id) else item.id)
        out = unique_ids(names)
        if repeats := [a for a, b in zip(names, out, strict=True) if a != b]:
            self.context.warn(f"{len(repeats)} ids stood for several items and got a number: {shorten_list(repeats)}")
        return out

    def _base(self, p: Properties, kind: str, name: str) -> dict[str, Any]:
        """The members of an item's source, with its id and its name."""
        item = {
            w: v for w, v in get_source_properties(get_source_properties(p, NAME), "item").items() if w != f"{kind}Id"
        }
        out: dict[str, Any] = {f"{kind}Id": name, **item}
        title = p.get("name")
        if isinstance(title, str) and title not in ("", name):
            out[f"{kind}Name"] = title
        return out

    def _vehicles(
        self, p: Properties, out: dict[str, Any], kind: str, template: Mapping[str, Any]
    ) -> list[dict[str, Any]]:
        """The entries of types of vehicle, copies; one for the type of the options where another format tells none.

        An item of a LIF file without entries stays so: no vehicle may use it.
        """
        key = _vehicle_properties_key(out, kind)
        entries = [dict(e) for e in _entries(out, kind)]
        if key is None:
            if NAME in p:
                return []
            key = str(getattr(self.dialect, kind))
            entries = [{**self.dialect.vehicle_type_member(self.options.vehicle_type), **template}]
            self.filled[f"{kind}s"] += 1
        elif len(entries) != count(out[key]):
            return []
        out[key] = entries
        return entries

    def _node(self, node: Node, name: str) -> dict[str, Any]:
        p = node.properties
        out = self._base(p, "node", name)
        out["nodePosition"] = {**get_source_properties(out, "nodePosition"), "x": _metres(node.x), "y": _metres(node.y)}
        entries = self._vehicles(p, out, "node", {})
        if p.get("orientation") is not None:
            self.lost["tilts of nodes"] += not is_flat(p["orientation"])
            for entry in entries:
                theta = yaw_or_source(entry.get("theta"), p["orientation"])
                if theta is not None:
                    entry["theta"] = theta
        self.lost["altitudes of nodes"] += bool(node.z)
        self.lost["attributes of nodes"] += bool(p.keys() - CANONICAL_NODE)
        return out

    def _edge(self, edge: Edge, name: str, names: Sequence[str]) -> dict[str, Any]:
        p = edge.properties
        out = self._base(p, "edge", name)
        out |= {"startNodeId": names[edge.source], "endNodeId": names[edge.target]}
        defaults: dict[str, Any] = {"orientationType": self.options.orientation_type}
        if self.dialect == LIF_1:
            turn = {"vehicleOrientation": self.options.vehicle_orientation}
            defaults = {**turn, **defaults, "rotationAllowed": self.options.rotation_allowed}
        entries = self._vehicles(p, out, "edge", defaults)
        speed = p.get("speed_limit")
        at = (np.round(shapely.get_coordinates(edge.geometry), METRES) + 0.0).tolist()
        for entry in entries:
            if _is_number(speed):
                entry["maxSpeed"] = speed
            if len(at) > 2 and edge.geometry.geom_type == "LineString":
                entry["trajectory"] = _trajectory(at)
        self.lost["attributes of edges"] += bool(p.keys() - CANONICAL_EDGE)
        return out

    def _stations(self) -> None:
        for key, part in self.layers.vector("objects").items():
            if key.name != NAME:
                continue
            shapes = part.in_local(self.layers.frame)
            for i, p, shape in zip(part.ids, part.properties, shapes, strict=True):
                if p.get("kind") != "station":
                    self.lost["objects that are no stations"] += 1
                    continue
                source_id = get_source_properties(p, NAME).get("id")
                name = source_id if isinstance(source_id, str) and is_name(source_id) else i
                out = self._base(p, "station", name)
                if not shape.is_empty:
                    at = shapely.centroid(shape)
                    position = {"x": _metres(at.x), "y": _metres(at.y)}
                    out["stationPosition"] = {**get_source_properties(out, "stationPosition"), **position}
                if not isinstance(out.get("interactionNodeIds"), list):
                    out["interactionNodeIds"] = []
                    self.filled["stations"] += 1
                self.lost["attributes of stations"] += bool(p.keys() - CANONICAL_STATION)
                self._add_to_layout("stations", p, key.level, name, out)

    def _dangling(self) -> None:
        """Edges to nowhere, of the nodes that know them and of the files as a whole, each once."""
        lists = [get_source_properties(node.properties, NAME).get("dangling") for node in self.net.nodes]
        lists += [document.get("dangling") for document in self.documents]
        seen = set()
        for edge in (e for entries in lists for e in _objects(entries)):
            item, key = get_source_properties(edge, "item"), orjson.dumps(edge, option=orjson.OPT_SORT_KEYS).decode()
            if isinstance(item.get("edgeId"), str) and key not in seen:
                seen.add(key)
                self._add_to_layout("edges", {NAME: edge}, GROUND, item["edgeId"], item)

    def _report(self) -> None:
        context = self.context
        why = "no source names a type of vehicle"
        for kind in ("nodes", "edges"):
            if self.filled[kind]:
                reason = f"{self.filled[kind]} {kind}: {why}"
                context.fill(f"{kind}: type of vehicle", self.options.vehicle_type, reason, "vehicle_type")
        if self.filled["edges"]:
            option_names = {"orientationType": "orientation_type"}
            if self.dialect == LIF_1:
                option_names |= {"vehicleOrientation": "vehicle_orientation", "rotationAllowed": "rotation_allowed"}
            for key, option in option_names.items():
                reason = f"{self.filled['edges']} edges do not say it"
                context.fill(f"edges: {key}", getattr(self.options, option), reason, option)
        if self.filled["layouts"]:
            context.fill(
                "layouts", f"{self.filled['layouts']}, one for each level", "no source has a layout of the level"
            )
            context.fill("layouts: layoutVersion", self.options.layout_version, "no source has it", "layout_version")
        if self.filled["stations"]:
            context.fill("stations: interactionNodeIds", [], f"{self.filled['stations']} stations name no nodes")
        for noun, n in sorted(self.lost.items()):
            context.drop(noun, n, "LIF has no place for it")


def _objects(value: Any) -> list[dict[str, Any]]:
    """The objects of a list."""
    return [v for v in value if isinstance(v, dict)] if isinstance(value, list) else []


def _metres(value: float) -> float:
    return round(value, METRES) + 0.0


# --- the format ------------------------------------------------------------------------------------------------------


def lacks(layers: Layers) -> str | None:
    """A layout needs a node."""
    some_node = any(p.get("kind") == "node" for part in layers.vector("topology").values() for p in part.properties)
    return None if some_node else "the network has no node: supply one with nodes"


def detect(name: str, data: bytes) -> bool:  # noqa: ARG001 - one signature for all formats
    """A JSON object with LIF's two members on top."""
    if data[:64].lstrip(b"\xef\xbb\xbf \t\r\n")[:1] != b"{" or b'"metaInformation"' not in data:
        return False
    if b'"layouts"' not in data or b'"FeatureCollection"' in data:
        return False
    if len(data) > 2**20:
        return b'"nodePosition"' in data
    try:
        top = orjson.loads(data.removeprefix(b"\xef\xbb\xbf"))
    except orjson.JSONDecodeError:
        return b'"lifVersion"' in data
    return "metaInformation" in top and ("layouts" in top or "origins" in top)


def choose(keys: Sequence[PartKey], options: Any) -> Sequence[PartKey]:  # noqa: ARG001 - one signature for all formats
    """The networks, and the stations that came from a LIF file."""
    return [key for key in keys if key.layer == "topology" or (key.layer == "objects" and key.name == NAME)]


register(
    Format(
        name=NAME,
        title="Layout Interchange Format (VDMA LIF)",
        files={"layout.lif.json": "application/json"},
        layers=frozenset({"topology", "objects"}),
        detect=detect,
        read=read,
        check=_lif_rules.check,
        write=write,
        needs=LayerRequirements(one_of=(frozenset({"topology"}),), anchor="local", missing_content=lacks),
        write_options=WriteOptions,
        extensions=(".lif.json", ".lif", ".json"),
        selection=Selection(choose),
        claims=Claims(priority=37),
        traits=Traits(has_title=True),
    )
)
