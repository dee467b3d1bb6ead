"""Read Lanelet2: the network of lanelets, and all elements as objects."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from itertools import chain
from typing import Any

import numpy as np
import shapely

from app.errors import Invalid, Problem, TooLarge, UnreadableFile
from app.formats import Files, ReadContext, _fields
from app.formats.lanelet2.lane_geometry import Array
from app.formats.lanelet2.network import PointTable, network, read_lanes
from app.formats.lanelet2.tags import LOCAL, MAX_SPEED, NAME, NODE, PLAIN_TAGS, decimal, parse_speed
from app.formats.osm.elements import Data, Tags, Way
from app.formats.osm.parsing import parse
from app.formats.osm.tags import is_deleted
from app.model.features import NO_GEOMETRY, Features, Properties, SharedKeyDicts, from_columns
from app.model.frame import Anchor
from app.model.layers import NETWORK, Layers, Part, PartKey
from app.syntax import yaml

_PROJECTORS = ("Local", "local", "MGRS", "LocalCartesian", "LocalCartesianUTM", "TransverseMercator")
PROJECTOR_SHAPE = _fields.record(
    "mgrs_grid",
    projector_type=_fields.OneOf(_PROJECTORS),
    vertical_datum=_fields.OneOf(("WGS84", "EGM2008")),
    map_origin=_fields.record(latitude=_fields.LATITUDE, longitude=_fields.LONGITUDE, altitude=_fields.COORDINATE),
    scale_factor=_fields.Number(0.0, 10.0, above=True),
)
"""Shape of the file. Source: autoware_map_projection_loader."""


def read(files: Files, context: ReadContext) -> Layers:
    """Read the network of lanelets, and all elements as objects, in wgs84 (in metres with the projector ``Local``).

    Raises UnreadableFile, with a line if known, for files that are not OSM and for positions that are not on earth.
    """
    data = parse(files[context.main], context.limits)
    total = len(data.ids) + len(data.ways) + len(data.relations)
    if total > context.limits.features:
        raise TooLarge(f"the file has {total} elements; the limit is {context.limits.features}")
    for problem, line, location in data.problems:
        context.warn(problem, line=line, where=location)
    document: dict[str, Any] = {"attributes": data.root}
    if data.bounds:
        document["bounds"] = data.bounds
    if data.elements:
        document["elements"] = data.elements
    for relation in data.relations:
        limit = relation.tags.get("speed_limit")
        speed = None if limit is None else parse_speed(limit)
        if limit is not None and (speed is None or speed > MAX_SPEED):
            reason = f"invalid speed limit {limit[:40]!r}: must be from 0 to {MAX_SPEED:g} m/s"
            context.warn(reason, where=f"relation {relation.id}")
    projector = next((n for n in files if n != context.main), None)
    local = _is_metric_only(data)
    if projector is not None:
        document["projector"] = _projector_text(files[projector], projector)
        local = _projector_type(files[projector], projector, context) == "local" or local
    reader = _Reader(data, context, local)
    parts: dict[PartKey, Part] = {}
    if context.wants("topology"):
        part = reader.network()
        if len(part):
            parts[PartKey("topology", context.level, NETWORK)] = part
    if context.wants("objects") or not parts:
        parts[PartKey("objects", context.level, NAME)] = reader.objects({NAME: document})
    return Layers(parts)


def _is_metric_only(data: Data) -> bool:
    """Whether no point has degrees and some have metres: Autoware's maps without a projection."""
    metres = any(LOCAL[0] in tags for tags in data.tags.values())
    return metres and bool(np.isnan(data.lonlat[:, 0]).all())


def _projector_text(data: bytes, name: str) -> str:
    if len(data) > 2**16:
        raise TooLarge(f"{name} has {len(data)} bytes; the limit is 65536", [Problem("too large", name)])
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise UnreadableFile(f"{name} is not UTF-8 text", [Problem("not UTF-8 text", name)]) from error


def _projector_type(data: bytes, name: str, context: ReadContext) -> str:
    try:
        document = yaml.load(data, context.limits)
    except UnreadableFile as error:
        problems = [Problem(p.problem, name, p.line, p.where) for p in error.problems]
        raise UnreadableFile(f"{name}: {error.detail}", problems) from error
    if isinstance(document, dict):
        _fields.check(document, PROJECTOR_SHAPE, context, name)
    kind = document.get("projector_type") if isinstance(document, dict) else None
    if not isinstance(kind, str):
        context.warn("missing projector_type; positions on earth are used", file=name)
        return ""
    return kind.lower()


class _Reader:
    def __init__(self, data: Data, context: ReadContext, local: bool) -> None:
        self.data, self.context = data, context
        self.anchor: Anchor = "local" if local else "wgs84"
        row = {i: k for k, i in enumerate(data.ids)}
        self.ways = {way.id: way for way in data.ways}
        self.relations = {r.id: r for r in data.relations}
        for noun, distinct, all_ids in (
            ("node", row, data.ids),
            ("way", self.ways, data.ways),
            ("relation", self.relations, data.relations),
        ):
            if len(distinct) != len(all_ids):
                context.warn("duplicate ids in the file; the last element is used", where=noun)
        self.row = row
        xyz = np.full((len(data.ids), 3), np.nan)
        if not local:
            xyz[:, :2] = data.lonlat
        doubts: Counter[str] = Counter()
        for k, tags in data.tags.items():
            if local:
                xyz[k, :2] = decimal(tags.get(LOCAL[0])), decimal(tags.get(LOCAL[1]))
            if "ele" in tags:
                xyz[k, 2] = decimal(tags["ele"])
                doubts["elevations are not numbers of metres and are ignored"] += math.isnan(xyz[k, 2])
        absent = np.isnan(xyz[:, :2]).any(axis=1)
        xyz[absent] = np.nan
        doubts["points have no position; references to them are stored"] += int(absent.sum())
        for text, times in doubts.items():
            if times:
                context.warn(f"{times} {text}")
        self.xyz = xyz
        self.points_by_row: dict[int, dict[str, Any]] = {}
        self.compact = SharedKeyDicts()
        self.located = {i: k for i, k in row.items() if not absent[k]}

    def network(self) -> Features:
        relations = ((r.id, r.members, r.tags, r.attributes) for r in self.relations.values())
        ways = {i: (way.refs, way.attributes) for i, way in self.ways.items()}
        lanes, broken = read_lanes(relations, ways, self.located)
        for i, reason in broken:
            self.context.warn(f"the lanelet is not part of the network: {reason}", where=f"relation {i}")
        if not lanes:
            self.context.warn("the file has no usable lanelets; no network is created")
        names: dict[str, int] = {}
        labels: dict[str, str] = {}
        for k, tags in self.data.tags.items():
            name = tags.get(NODE)
            if name and self.data.ids[k] in self.located:
                names.setdefault(name, self.data.ids[k])
                labels.setdefault(name, tags.get("name", ""))
        try:
            return network(lanes, _table(self.located, self.xyz, self.anchor, names, labels), {})
        except Invalid as error:
            raise UnreadableFile(error.detail, list(error.problems)) from error

    def objects(self, document: Properties) -> Features:
        """Convert points that are not only bends, ways and relations."""
        data = self.data
        members = {i for r in self.relations.values() for kind, i, _ in r.members if kind == "node"}
        bent = set(chain.from_iterable(way.refs for way in self.ways.values()))
        lone = []
        for i, k in self.row.items():
            tags = data.tags.get(k, {})
            special = i not in bent or i in members or i not in self.located or not tags.keys() <= PLAIN_TAGS
            if special or k in data.node_children or is_deleted(data.attributes(k)):
                lone.append(k)
        ids = [f"n{data.ids[k]}" for k in lone]
        geometry: list[Any] = [self.point(k) for k in lone]
        properties: list[Properties] = []
        for k in lone:
            tags = data.tags.get(k, {})
            source_members = self.read_point(k)
            if children := data.node_children.get(k):
                source_members["children"] = children
            properties.append(self.compact(_properties(source_members, tags, "point")))
        special_ids = {data.ids[k] for k in lone}
        deep = ~np.isnan(self.xyz[:, 2])
        for way in self.ways.values():
            source_members = self.way_properties(way, special_ids)
            ids.append(f"w{way.id}")
            geometry.append(self.line(way, deep))
            properties.append(self.compact(_properties(source_members, way.tags, "line")))
        for r in self.relations.values():
            source_members = {"members": [list(m) for m in r.members], "tags": r.tags}
            if r.attributes:
                source_members["attributes"] = r.attributes
            if r.children:
                source_members["children"] = r.children
            ids.append(f"r{r.id}")
            geometry.append(NO_GEOMETRY)
            properties.append(self.compact(_properties(self.compact(source_members), r.tags, "relation")))
        out = np.empty(len(geometry), object)
        out[:] = geometry
        return from_columns(ids, out, properties, self.anchor, document)

    def point(self, k: int) -> Any:
        x, y, z = self.xyz[k].tolist()
        if math.isnan(x):
            return NO_GEOMETRY
        return shapely.Point(x, y) if math.isnan(z) else shapely.Point(x, y, z)

    def line(self, way: Way, deep: Any) -> Any:
        rows = [self.located[r] for r in way.refs if r in self.located]
        if not rows:
            return NO_GEOMETRY
        at = self.xyz[rows]
        at = np.where(np.isnan(at), 0.0, at) if deep[rows].any() else at[:, :2]
        return shapely.LineString(at) if len(rows) > 1 else shapely.Point(*at[0])

    def way_properties(self, way: Way, special: set[int]) -> dict[str, Any]:
        source_members: dict[str, Any] = {"refs": way.refs, "tags": way.tags}
        if way.attributes:
            source_members["attributes"] = way.attributes
        if missing := [k for k, r in enumerate(way.refs) if r not in self.located]:
            source_members["missing"] = missing
        if not way.refs and not is_deleted(way.attributes):
            self.context.warn("the way has no nodes", where=f"way {way.id}")
        bends = [None if r in special or r not in self.row else self.bend(self.row[r]) for r in way.refs]
        mere = [b for b in bends if b is not None]
        if any(mere):
            source_members["vertices"] = mere[0] if all(b == mere[0] for b in mere) else bends
        if way.children:
            source_members["children"] = way.children
        return self.compact(source_members)

    def bend(self, k: int) -> dict[str, Any]:
        """Return a point's data except its position; one value for all ways that bend there."""
        cached = self.points_by_row.get(k)
        if cached is None:
            cached = self.points_by_row[k] = self.read_point(k)
        return cached

    def read_point(self, k: int) -> dict[str, Any]:
        tags = self.data.tags.get(k)
        attributes = self.data.attributes(k)
        at = None
        if (tags and LOCAL[0] in tags) or self.anchor == "local":
            at = self.data.lonlat[k].tolist()
        source_members = {"tags": tags, "attributes": attributes, "at": None if at is None or math.isnan(at[0]) else at}
        return self.compact({key: value for key, value in source_members.items() if value})


def _table(
    located: Mapping[int, int], xyz: Array, anchor: Anchor, names: dict[str, int], labels: dict[str, str]
) -> PointTable:
    """Only points with a position, so that ids are unambiguous."""
    rows = list(located.values())
    return PointTable({i: k for k, i in enumerate(located)}, xyz[rows].reshape(-1, 3), anchor, names, labels)


def _properties(source_members: dict[str, Any], tags: Tags, otherwise: str) -> dict[str, Any]:
    kind = tags.get("type") or otherwise
    if otherwise == "relation" and kind == "multipolygon":
        kind = "area"
    name = tags.get("name")
    return {"kind": kind, "name": name, NAME: source_members} if name else {"kind": kind, NAME: source_members}
