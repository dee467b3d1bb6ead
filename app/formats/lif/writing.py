"""Writing LIF: one layout per level."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import orjson
import shapely

from app.errors import CannotConvert
from app.formats import WriteContext
from app.formats._network import (
    Edge,
    Node,
    count,
    get_source_properties,
    is_flat,
    is_name,
    merge_networks,
    natural_sort_key,
    shorten_list,
    yaw_or_source,
)
from app.formats.lif.reading import is_number, trajectory_of, vehicle_entries, vehicle_properties_key
from app.formats.lif.vocabulary import (
    CANONICAL_EDGE,
    CANONICAL_NODE,
    CANONICAL_STATION,
    EPOCH,
    LIF_1,
    LIF_2,
    LIF_3,
    LISTS,
    NAME,
    ORDER,
    VERSION,
    Dialect,
)
from app.model.features import Properties, unique_ids
from app.model.frame import GROUND
from app.model.layers import Layers
from app.parameters import parameter
from app.syntax import json
from app.syntax.decimals import METRES


@dataclass(frozen=True, slots=True)
class WriteOptions:
    """Values that no source specifies."""

    vehicle_type: str = parameter("any", "vehicle type of nodes and edges without one")
    creator: str = parameter("Fleet Map Server", "creator of the file if no source specifies one")
    project: str | None = parameter(
        None, "project of the file if no source specifies one; default: the name of the map"
    )
    orientation_type: Literal["TANGENTIAL", "GLOBAL"] = parameter(
        "TANGENTIAL", "reference of vehicle_orientation on edges from other formats"
    )
    vehicle_orientation: float = parameter(
        0.0, "orientation of vehicles on edges from other formats", minimum=-3.2, maximum=3.2, unit="rad"
    )
    rotation_allowed: bool = parameter(False, "allow vehicles to rotate on edges from other formats")
    layout_version: str = parameter("1", "version of layouts without one")


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """Write ``layout.lif.json``: one layout per level, or the layouts of the source.

    WGS 84 items are converted to local metres (MissingDatum without a datum). Raises CannotConvert if there is no node.
    """
    return {"layout.lif.json": _Writer(layers, context).data()}


@dataclass(slots=True)
class _Layout:
    """Layout being written: its own members, and its items with their source index."""

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
            raise CannotConvert("a layout needs nodes, but the network has none: supply a network with nodes")
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
        """Return the dialect of the source's items."""
        property_sets = [n.properties for n in self.net.nodes] + [e.properties for e in self.net.edges]
        for p in property_sets:
            source_members = get_source_properties(get_source_properties(p, NAME), "item")
            for kind in ("node", "edge"):
                for entry in vehicle_entries(source_members, kind):
                    spoken = next((d for d in (LIF_1, LIF_2, LIF_3) if d.type in entry), None)
                    if spoken is not None:
                        return spoken
        return LIF_1

    def data(self) -> bytes:
        """Return the file."""
        names = self._names(self.net.nodes)
        for node, name in zip(self.net.nodes, names, strict=True):
            self._add_to_layout("nodes", node.properties, node.level, name, self._node(node, name))
        for edge, name in zip(self.net.edges, self._names(self.net.edges), strict=True):
            self._add_to_layout("edges", edge.properties, edge.part.level, name, self._edge(edge, name, names))
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
            self.context.fill("metaInformation.projectIdentification", project, "no source specifies it", "project")
        for key, value in (("creator", self.options.creator), ("exportTimestamp", EPOCH), ("lifVersion", VERSION)):
            if key not in meta:
                meta[key] = value
                option = key if key == "creator" else None
                self.context.fill(f"metaInformation.{key}", value, "no source specifies it", option)
        return {**top, "metaInformation": meta}

    def _origins(self) -> list[tuple[dict[str, Any], list[str]]]:
        """Return (members, ids of its layouts) of the source's origins; other layouts join the first one."""
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
        """Add an item to its layout: that of its source, the first of its level, or a new one."""
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
        """Return the ids in the file: those of the sources if they are unique."""
        names = []
        for item in items:
            source_id = get_source_properties(item.properties, NAME).get("id")
            names.append(source_id if isinstance(source_id, str) and is_name(source_id) else item.id)
        out = unique_ids(names)
        if repeats := [a for a, b in zip(names, out, strict=True) if a != b]:
            self.context.warn(f"{len(repeats)} duplicate ids: {shorten_list(repeats)}; a number makes them unique")
        return out

    def _base(self, p: Properties, kind: str, name: str) -> dict[str, Any]:
        """Return the members of an item's source, with its id and its name."""
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
        """Return copies of the entries by vehicle type; items of other formats get one for the type in the options.

        An item of a LIF file without entries gets none: no vehicle may use it.
        """
        key = vehicle_properties_key(out, kind)
        entries = [dict(e) for e in vehicle_entries(out, kind)]
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
        self.lost["areas of nodes"] += p.get("area") is not None
        self.lost["attributes of nodes"] += bool(p.keys() - CANONICAL_NODE - {"area"})
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
            if is_number(speed):
                entry["maxSpeed"] = speed
            if len(at) > 2 and edge.geometry.geom_type == "LineString":
                entry["trajectory"] = trajectory_of(at)
        self.lost["attributes of edges"] += bool(p.keys() - CANONICAL_EDGE)
        return out

    def _stations(self) -> None:
        for key, part in self.layers.vector("objects").items():
            if key.name != NAME:
                continue
            shapes = part.in_local(self.layers.frame)
            for i, p, shape in zip(part.ids, part.properties, shapes, strict=True):
                if p.get("kind") != "station":
                    self.lost["objects that are not stations"] += 1
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
        """Write dangling edges stored with nodes and with files, each once."""
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
        why = "no source specifies a vehicle type"
        for kind in ("nodes", "edges"):
            if self.filled[kind]:
                reason = f"{self.filled[kind]} {kind}: {why}"
                context.fill(f"{kind}: vehicle type", self.options.vehicle_type, reason, "vehicle_type")
        if self.filled["edges"]:
            option_names = {"orientationType": "orientation_type"}
            if self.dialect == LIF_1:
                option_names |= {"vehicleOrientation": "vehicle_orientation", "rotationAllowed": "rotation_allowed"}
            for key, option in option_names.items():
                reason = f"{self.filled['edges']} edges do not specify it"
                context.fill(f"edges: {key}", getattr(self.options, option), reason, option)
        if self.filled["layouts"]:
            context.fill("layouts", f"{self.filled['layouts']}, one per level", "no source has a layout of the level")
            context.fill(
                "layouts: layoutVersion", self.options.layout_version, "no source specifies it", "layout_version"
            )
        if self.filled["stations"]:
            context.fill("stations: interactionNodeIds", [], f"{self.filled['stations']} stations have no nodes")
        for noun, n in sorted(self.lost.items()):
            context.drop(noun, n, "LIF cannot store it")


def _objects(value: Any) -> list[dict[str, Any]]:
    """Return the objects of a list."""
    return [v for v in value if isinstance(v, dict)] if isinstance(value, list) else []


def _metres(value: float) -> float:
    return round(value, METRES) + 0.0
