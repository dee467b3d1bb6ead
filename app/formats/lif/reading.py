"""Reading LIF: each layout as a network and its stations."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from app.errors import Problem, TooLarge, UnreadableFile
from app.formats import Files, ReadContext, _fields
from app.formats._network import (
    SAME_ANGLE,
    Array,
    check_name,
    duplicates,
    edge_lines,
    identifier,
    is_name,
    node_points,
    number,
    quaternion,
    raise_unreadable,
    shorten_list,
)
from app.formats.lif.vocabulary import LIF_1, LIF_2, LISTS, NAME, SHAPE
from app.model.features import NO_GEOMETRY, Features, Properties, from_columns, unique_ids
from app.model.layers import NETWORK, Layers, Part, PartKey
from app.syntax import json


def read(files: Files, context: ReadContext) -> Layers:
    """Read networks by level, and stations as objects, in local metres. Raises UnreadableFile with the item."""
    if not (context.wants("topology") or context.wants("objects")):
        return Layers()
    top = json.load(files[context.main or next(iter(files))], context.limits)
    if not isinstance(top, dict) or not isinstance(top.get("layouts", top.get("origins")), list):
        reason = "a LIF file must be an object with an array of layouts"
        raise UnreadableFile(reason, [Problem(reason, where="layouts")])
    reader = _Reader(top, context)
    layers = reader.layers()
    if reader.is_first:  # members of version 2 change with each draft
        _fields.check(top, SHAPE, context)
    return layers


@dataclass(slots=True)
class _Item:
    """Node, edge or station of the file."""

    members: dict[str, Any]
    location: str
    name: str
    layout: str
    at: int
    level: str
    id: str = ""


@dataclass(slots=True)
class _Level:
    """Content of one level: indices of its nodes, its edges and stations with references to nodes."""

    nodes: list[int] = field(default_factory=list)
    edges: list[tuple[_Item, int, int]] = field(default_factory=list)
    stations: list[_Item] = field(default_factory=list)


class _Reader:
    def __init__(self, top: dict[str, Any], context: ReadContext) -> None:
        self.top, self.context = top, context
        self.is_first = "origins" not in top
        self.doubts: Counter[str] = Counter()
        self.heads: list[dict[str, Any]] = []
        self.layout_ids: set[str] = set()
        self.items: dict[str, list[_Item]] = {kind: [] for kind in ("node", "edge", "station")}
        self.document: dict[str, Any] = {
            "top": {w: v for w, v in top.items() if w not in ("layouts", "origins")},
            "layouts": self.heads,
        }
        self.version()
        for row, location in self.layouts():
            self.layout(row, location)
        total = sum(map(len, self.items.values()))
        if total > context.limits.features:
            raise TooLarge(f"the file has {total} items; the limit is {context.limits.features}")

    def version(self) -> None:
        """Warn about an unsupported or missing version."""
        meta = self.top.get("metaInformation")
        version = meta.get("lifVersion") if isinstance(meta, dict) else None
        if not isinstance(version, str):
            self.context.warn("is missing; it is read as version 1.0", where="metaInformation.lifVersion")
        elif version.split(".")[0] not in ("0", "1"):
            self.is_first = False
            self.context.warn(
                f"version {version[:40]} is a draft; it is read as far as supported and written back unchanged",
                where="metaInformation.lifVersion",
            )

    def layouts(self) -> Iterable[tuple[Any, str]]:
        """Iterate over (layout, location), also of layouts inside origins."""
        for k, row in enumerate(self._list(self.top, "layouts", "")):
            yield row, f"layouts[{k}]"
        origins = self._list(self.top, "origins", "")
        if "origins" in self.top:
            self.document["origins"] = heads = []
        if len(origins) > 1:
            self.context.warn("origins may differ; all are read as the local origin", where="origins")
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
        """Read a layout's items."""
        if not isinstance(row, dict):
            raise_unreadable("must be an object", location)
        layout_id = row.get("layoutId")
        if not isinstance(layout_id, str) or not is_name(layout_id):
            raise_unreadable("a layout needs a string as its id", f"{location}.layoutId")
        if layout_id in self.layout_ids:
            raise_unreadable(f"duplicate layout {layout_id!r}: layout ids must be unique", f"{location}.layoutId")
        self.layout_ids.add(layout_id)
        self.heads.append({w: v for w, v in row.items() if w not in LISTS})
        level = row.get("layoutLevelId")
        if level is None or level == "":
            level = self.context.level
        elif not isinstance(level, str):
            raise_unreadable("must be a string", f"{location}.layoutLevelId")
        level = check_name(level, f"{location}.layoutLevelId")
        for kind, items in self.items.items():
            for at, item in enumerate(self._list(row, f"{kind}s", location)):
                spot = f"{location}.{kind}s[{at}]"
                if not isinstance(item, dict):
                    raise_unreadable("must be an object", spot)
                name = item.get(f"{kind}Id")
                if isinstance(name, (int, float)) and not isinstance(name, bool):
                    self.context.warn(f"{name!r} is not text; it is written as text", where=f"{spot}.{kind}Id")
                    name = str(name)
                if not isinstance(name, str):
                    raise_unreadable("needs a string as its id", f"{spot}.{kind}Id")
                items.append(_Item(item, spot, check_name(name, f"{spot}.{kind}Id"), layout_id, at, level))

    def layers(self) -> Layers:
        nodes, edges, stations = self.items["node"], self.items["edge"], self.items["station"]
        taken: set[str] = set()
        for kind, items in (("nodes", nodes), ("edges", edges)):
            for item, i in zip(items, unique_ids((identifier(item.name) for item in items), taken), strict=True):
                item.id = i
                taken.add(i)
            if repeats := duplicates([item.name for item in items]):
                self.context.warn(
                    f"{len(repeats)} duplicate ids of {kind}: {shorten_list(repeats)}; references use the first one"
                )
        for item, i in zip(stations, unique_ids(identifier(s.name) for s in stations), strict=True):
            item.id = i
        index_by_name = {item.name: k for k, item in reversed(list(enumerate(nodes)))}
        xyz: Array = np.array(
            [self.position(n.members.get("nodePosition"), n.location, "node") for n in nodes], np.float64
        )
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
        return Layers(parts)  # LIF has no elevations of levels

    def position(self, value: Any, location: str, kind: str) -> tuple[float, float, float]:
        """Parse a position: x and y in metres, and 0."""
        location = f"{location}.{kind}Position"
        if not isinstance(value, dict) or "x" not in value or "y" not in value:
            raise_unreadable("must be an object with x and y", location)
        return number(value["x"], f"{location}.x"), number(value["y"], f"{location}.y"), 0.0

    def source_members(self, item: _Item, kind: str, *keys: str) -> dict[str, Any]:
        """Return an item's source properties; the members ``keys`` are canonical."""
        position = item.members.get(f"{kind}Position")
        extra_members = {w: v for w, v in item.members.items() if w not in (f"{kind}Id", *keys)}
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
        name = item.members.get(f"{kind}Name")
        return {"name": name} if isinstance(name, str) and is_name(name) else {}

    def node(self, item: _Item) -> dict[str, Any]:
        source_properties = self.source_members(item, "node")
        out: dict[str, Any] = {"kind": "node", "name": item.name, **self.name_members(item, "node")}
        entries = vehicle_entries(source_properties["item"], "node")
        if not entries:
            self.doubts["nodes have no vehicle type; no vehicle may use them"] += 1
        theta = _common_number(entries, "theta")
        if theta is not None and abs(theta) <= math.pi + SAME_ANGLE:
            out["orientation"] = quaternion(float(theta))
        far = sum(is_number(e.get("theta")) and abs(e["theta"]) > math.pi + SAME_ANGLE for e in entries)
        if far:
            self.doubts["values of theta exceed ±π radians; they are stored but not used as orientations"] += far
        out[NAME] = source_properties
        return out

    def join(
        self,
        edge: _Item,
        index_by_name: Mapping[str, int],
        properties: Sequence[dict[str, Any]],
        levels: dict[str, _Level],
    ) -> None:
        """Add an edge to its level; a dangling edge is stored with its existing node, else with its layout."""
        ends = [edge.members.get("startNodeId"), edge.members.get("endNodeId")]
        a, b = (index_by_name.get(str(e)) if isinstance(e, (str, int)) else None for e in ends)
        if a is not None and b is not None:
            if a == b:
                self.context.warn(f"the edge {edge.name} leads from a node to itself", where=edge.location)
            levels.setdefault(edge.level, _Level()).edges.append((edge, a, b))
            return
        missing = str(ends[0] if a is None else ends[1])[:60]
        self.context.warn(
            f"the edge {edge.name} leads to the unknown node {missing!r}; it is stored and written back only",
            where=edge.location,
        )
        dangling_edge = {"layout": edge.layout, "at": edge.at, "item": edge.members}
        home = next((k for k in (a, b) if k is not None), None)
        of = self.document if home is None else properties[home][NAME]
        of.setdefault("dangling", []).append(dangling_edge)

    def check_station(self, station: _Item, index_by_name: Mapping[str, int]) -> None:
        node_ids = station.members.get("interactionNodeIds")
        if not isinstance(node_ids, list) or not all(isinstance(i, str) for i in node_ids):
            self.context.warn(
                "needs an array of its interaction nodes; it is stored without them", where=station.location
            )
            return
        unknown = [i for i in node_ids if i not in index_by_name]
        if unknown:
            self.context.warn(
                f"unknown interaction nodes of the station: {shorten_list(unknown)}; they are stored unchanged",
                where=station.location,
            )

    def network(
        self, content: _Level, xyz: Array, nodes: Sequence[_Item], properties: Sequence[dict[str, Any]]
    ) -> Features:
        """Build the topology of a level."""
        sources, targets = [a for _, a, _ in content.edges], [b for _, _, b in content.edges]
        lines = edge_lines(xyz, sources, targets)
        rows: list[Properties] = [properties[k] for k in content.nodes]
        for j, (edge, a, b) in enumerate(content.edges):
            source_properties = self.source_members(edge, "edge", "startNodeId", "endNodeId")
            entries = vehicle_entries(source_properties["item"], "edge")
            if not entries:
                self.doubts["edges have no vehicle type; no vehicle may use them"] += 1
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
        """Convert stations to objects: points, or without geometry if the file has no position."""
        geometry: NDArray[np.object_] = np.empty(len(items), object)
        rows: list[Properties] = []
        for k, item in enumerate(items):
            position = item.members.get("stationPosition")
            geometry[k] = (
                NO_GEOMETRY
                if position is None
                else shapely.Point(self.position(position, item.location, "station")[:2])
            )
            source_properties = self.source_members(item, "station")
            if position is None and "stationPosition" in source_properties["item"]:
                del source_properties["item"]["stationPosition"]
            rows.append(
                {"kind": "station", "name": item.name, **self.name_members(item, "station"), NAME: source_properties}
            )
        return from_columns([item.id for item in items], geometry, rows, "local", {NAME: {}})


def is_number(value: Any) -> bool:
    """Check for a JSON number, finite or not; booleans are none."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def vehicle_properties_key(item: Mapping[str, Any], kind: str) -> str | None:
    """Return the name of the member with the entries by vehicle type."""
    keys = (getattr(LIF_1, kind), getattr(LIF_2, kind))
    return next((w for w in keys if isinstance(item.get(w), list)), None)


def vehicle_entries(item: Mapping[str, Any], kind: str) -> list[dict[str, Any]]:
    """Return an item's entries by vehicle type, none if an entry is not an object."""
    key = vehicle_properties_key(item, kind)
    entries = item[key] if key else []
    return entries if all(isinstance(e, dict) for e in entries) else []


def _common_number(entries: Sequence[Mapping[str, Any]], key: str) -> Any:
    """Return the number that all entries share, else None."""
    values = [e.get(key) for e in entries]
    same = values and all(is_number(v) and v == values[0] and type(v) is type(values[0]) for v in values)
    return values[0] if same else None


def _without(item: Mapping[str, Any], kind: str, key: str) -> dict[str, Any]:
    """Return the item without ``key`` in its entries."""
    list_word = vehicle_properties_key(item, kind)
    if list_word is None:
        return dict(item)
    return {**item, list_word: [{w: v for w, v in e.items() if w != key} for e in item[list_word]]}


def trajectory_of(line: Sequence[Sequence[float]]) -> dict[str, Any]:
    """Convert a line of n positions to the NURBS of degree 1 through them, with uniform knots from 0 to 1."""
    n = len(line)
    inner = [k / (n - 1) for k in range(1, n - 1)]
    points = [{"x": x, "y": y} for x, y in line]
    return {"degree": 1, "knotVector": [0.0, 0.0, *inner, 1.0, 1.0], "controlPoints": points}


def _polyline(entries: Sequence[Mapping[str, Any]]) -> list[tuple[float, float]] | None:
    """Return the positions of a trajectory that all entries share, if ``trajectory_of`` can write it."""
    trajectory = entries[0].get("trajectory") if entries else None
    points = trajectory.get("controlPoints") if isinstance(trajectory, dict) else None
    if not isinstance(points, list) or len(points) < 3 or any(e.get("trajectory") != trajectory for e in entries):
        return None
    line = []
    for p in points:
        if not isinstance(p, dict) or not is_number(p.get("x")) or not is_number(p.get("y")):
            return None
        line.append((float(p["x"]), float(p["y"])))
    return line if trajectory_of(line) == trajectory else None
