"""lanelet2: roads and footways as lanes between a left and a right bound, in an OSM file (Lanelet2, Autoware).

Points, linestrings (ways) and relations: lanelets (``type=lanelet``, members ``left``, ``right``, now and then
``centerline`` and ``regulatory_element``), areas (``type=multipolygon``) and regulatory elements. Source: Lanelet2's
documentation (LaneletAndAreaTagging, LinestringTagging) and its reader (OsmHandlerLoad); Autoware's further tags
``local_x``, ``local_y`` (metres in the frame that ``map_projector_info.yaml`` beside the map names) and ``ele``.

Reading. Each lanelet is a directed edge ``l<id>`` along its own centreline or the line half-way between its bounds,
two (``l<id>:back``) where it may be used both ways: where ``one_way`` says no, and, where nothing is said, where it is
for pedestrians only. Nodes are where lanelets meet as Lanelet2 means it: both bounds of one end where both bounds of
the next one begin; ``n<left>:<right>`` by the ids of the two points. (Where a lanelet for both ways ends, one may turn:
its two ends in Lanelet2's sense are one node.) ``width`` is the least distance of the bounds
(or what the lanelet says), ``speed_limit`` is in m/s. A lanelet's id and tags stand in the edge's
``properties.lanelet2``, a node's two ``points`` in the node's.

Everything else, and the lanelets once more so that they come back whole, is an object of the family ``lanelet2``:
points that are no mere bends ``n<id>``, ways ``w<id>``, relations ``r<id>``, ``kind`` being their type. Their
``properties.lanelet2`` holds ``tags``, further ``attributes``, ``refs`` and ``members``, the indexes of ``missing``
points, ``children`` that OSM does not know, and of a way's mere bends the ``vertices``, parallel to ``refs`` (one for
all where they are alike): ``tags``, ``attributes``, and the ``at`` of points that say their metres too.

Places are on earth, but metres where the projector is ``Local``: there ``local_x`` and ``local_y`` count, as in
Autoware.

Writing. A lanelet comes back while its edges are in the network as it draws them; where one direction is gone, the
other one is left. Any other edge becomes a new lanelet with bounds at half its width, an edge and its way back one
lanelet with ``one_way=no``; lanelets that meet share points of their bounds as far as the geometry lets them. So that
a network comes back as it was, such a lanelet has a centreline and the tags ``fleetmap:edge``, ``fleetmap:back``,
``fleetmap:source`` and ``fleetmap:target``, and each node is a point with the tag ``fleetmap:node``.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import Any

import numpy as np
import shapely

from app.errors import Invalid, MissingDatum, Problem, TooLarge, UnreadableFile
from app.formats import (
    Files,
    Format,
    LayerRequirements,
    ReadContext,
    WriteContext,
    _fields,
    register,
)
from app.formats._network import CROSS_PART_PROPERTIES, Edge, MergedNetwork, get_source_properties, merge_networks
from app.formats.lanelet2 import lane_geometry
from app.formats.lanelet2.lane_geometry import Arm, Array, Border
from app.formats.osm import xml_text
from app.formats.osm.elements import INT64, Data, Tags, Way
from app.formats.osm.parsing import parse
from app.formats.osm.xml_text import NO_ATTRIBUTES, as_texts, attribute_text, element_id, integers
from app.model.features import NO_GEOMETRY, Features, Properties, SharedKeyDicts, from_columns, unique_ids
from app.model.frame import MAX_DATUM_LATITUDE, MAX_METRES, Anchor, Datum
from app.model.geodesy import local_frame
from app.model.layers import NETWORK, Layers, Part, PartKey
from app.parameters import parameter
from app.syntax import yaml
from app.syntax.decimals import number

NAME = "lanelet2"
MAIN = "lanelet2.osm"
PROJECTOR = "map_projector_info.yaml"
_PROJECTORS = ("Local", "local", "MGRS", "LocalCartesian", "LocalCartesianUTM", "TransverseMercator")
PROJECTOR_SHAPE = _fields.record(
    "mgrs_grid",
    projector_type=_fields.OneOf(_PROJECTORS),
    vertical_datum=_fields.OneOf(("WGS84", "EGM2008")),
    map_origin=_fields.record(latitude=_fields.LATITUDE, longitude=_fields.LONGITUDE, altitude=_fields.COORDINATE),
    scale_factor=_fields.Number(0.0, 10.0, above=True),
)
"""What it holds. Source: autoware_map_projection_loader."""
GENERATOR = "Fleet Map Server"

EDGE, BACK, SOURCE, TARGET, NODE = (f"fleetmap:{w}" for w in ("edge", "back", "source", "target", "node"))
"""Our own tags: with them a network from elsewhere comes back with its ids."""

LOCAL = ("local_x", "local_y")
PLAIN_TAGS = frozenset({*LOCAL, "ele", "mgrs_code"})
"""Tags of points that only say where they are."""

ON_FOOT = frozenset({"walkway", "crosswalk", "stairs"})
"""Subtypes for pedestrians only, who may go both ways (Lanelet2: LaneletAndAreaTagging)."""

SUBTYPES: Mapping[str, str] = {
    **dict.fromkeys(("footway", "path", "pedestrian", "corridor"), "walkway"),
    "crossing": "crosswalk",
    "steps": "stairs",
    "cycleway": "bicycle_lane",
    "motorway": "highway",
    "motorway_link": "highway",
    "trunk": "highway",
    "living_street": "play_street",
    "busway": "bus_lane",
}
"""What OSM's ``highway`` is called here; any other one is a road."""

SAME_PLACE = {"wgs84": 1e-9, "local": 1e-4}
"""Degrees and metres: an edge whose bends are nearer to its lanelet's middle than this lies there still."""

UNITS = {"m/s": 1.0, "mps": 1.0, "mph": 0.44704, "m/h": 0.44704, "kmh": 1 / 3.6, "km/h": 1 / 3.6, "kph": 1 / 3.6}
"""Metres per second; without a unit kilometres an hour are meant (Lanelet2: Attribute)."""

CANONICAL_EDGE = frozenset({"kind", "name", "source", "target", "speed_limit", "width", NAME}) | CROSS_PART_PROPERTIES
CANONICAL_NODE = frozenset({"kind", "name", NAME}) | CROSS_PART_PROPERTIES


@dataclass(frozen=True, slots=True)
class WriteOptions:
    """What new lanelets are given where the network does not say it."""

    width: float = parameter(1.0, "width of lanes whose edge has none", minimum=0.01, maximum=100.0, unit="m")
    subtype: str = parameter("road", "subtype of lanes whose source names none: road, walkway, crosswalk …")
    location: str = parameter("urban", "location of new lanes: urban or nonurban")
    bounds: str = parameter("virtual", "type of the bounds of new lanes: virtual, line_thin, curbstone …")
    projector_info: bool = parameter(
        False, "also write map_projector_info.yaml (Local: local_x and local_y are metres in the environment's frame)"
    )


@dataclass(slots=True)
class Lane:
    """A lanelet as its relation says it; bounds as node ids."""

    id: int
    tags: Mapping[str, str]
    left: list[int]
    right: list[int]
    middle: list[int] | None = None


# --- the network that lanelets make: reader and writer must agree on it ------------------------------------------


@dataclass(slots=True)
class PointTable:
    """Where points are. row: node id -> row of ``xyz``, [n, 3] as they are anchored, z NaN where none is said."""

    row: dict[int, int]
    xyz: Array
    anchor: Anchor
    names: dict[str, int] = field(default_factory=dict)
    labels: dict[str, str] = field(default_factory=dict)

    def metres(self) -> Array:
        """[n, 2]; on earth in a frame near the middle of the data, which is right to a few parts in 100 000."""
        if self.anchor == "local" or not len(self.xyz):
            return self.xyz[:, :2]
        lonlat = self.xyz[:, :2]
        low, high = lonlat.min(axis=0), lonlat.max(axis=0)
        # A tenth of a degree: an edit at the map's edge must not move the frame and so every digit of the others.
        lon, lat = np.round((low + high) / 2.0, 1).tolist()
        frame = local_frame(Datum(float(np.clip(lat, -MAX_DATUM_LATITUDE, MAX_DATUM_LATITUDE)), lon))
        xy = frame.to_local(lonlat)
        if not (np.abs(xy) <= MAX_METRES).all():
            reason = "the lanes spread over too much of the earth to be one network: give those of one site"
            raise Invalid(reason, [Problem(reason)])
        return xy


def network(lanes: Sequence[Lane], places: PointTable, document: Properties) -> Features:
    """Nodes and directed edges of lanelets, all of whose points have a place."""
    marks, compact = _JoinedEnds(), SharedKeyDicts()
    rows: list[tuple[Lane, tuple[int, int], tuple[int, int], bool]] = []
    ids: list[str] = []
    geometry: list[Any] = []
    properties: list[Properties] = []
    if lanes:
        xy = places.metres()
        left, right = (
            lane_geometry.runs([[places.row[r] for r in side] for side in sides]) for sides in _bounds(lanes)
        )
        left, right = lane_geometry.align_bounds(left, right, xy)
        lines, widths = _middles(lanes, left, right, places, xy)
        node_ids = {row: i for i, row in places.row.items()}
        begins = [
            (node_ids[a], node_ids[b])
            for a, b in zip(left.first_points.tolist(), right.first_points.tolist(), strict=True)
        ]
        ends = [
            (node_ids[a], node_ids[b])
            for a, b in zip(left.last_points.tolist(), right.last_points.tolist(), strict=True)
        ]
        for lane, a, b in zip(lanes, begins, ends, strict=True):
            both = is_two_way(lane.tags)
            rows.append((lane, a, b, both))
            for pair in (a, b):
                marks.add(pair, both)
    name_set = set(places.names)
    id_by_place: dict[tuple[int, int], str] = {}
    for pair in marks.all():
        top = marks.find(pair)
        if top not in id_by_place:
            id_by_place[top] = f"n{top[0]}:{top[1]}"
    # A node that our own tags name stands where it stood; every other one in the middle between its two points.
    used: dict[str, tuple[int, int] | None] = dict.fromkeys(places.names)
    edges: list[tuple[str, Any, Properties]] = []
    for k, (lane, a, b, both) in enumerate(rows):
        names = lane.tags.get(SOURCE, ""), lane.tags.get(TARGET, "")
        source, target = (
            name if name in name_set else id_by_place[marks.find(pair)]
            for name, pair in zip(names, (a, b), strict=True)
        )
        for name, pair in ((source, a), (target, b)):
            if name not in name_set:
                used.setdefault(name, marks.find(pair))
        edge_properties: dict[str, Any] = {"kind": "edge", "source": source, "target": target}
        if title := lane.tags.get("name") or lane.tags.get("road_name"):
            edge_properties["name"] = title
        if widths[k] is not None:
            edge_properties["width"] = widths[k]
        if (speed := parse_speed(lane.tags.get("speed_limit"))) is not None:
            edge_properties["speed_limit"] = speed
        edge_properties[NAME] = compact({"lanelet": lane.id, "tags": lane.tags})
        edge_properties = compact(edge_properties)
        edges.append((lane.tags.get(EDGE) or f"l{lane.id}", lines[k], edge_properties))
        if both:
            back = compact({**edge_properties, "source": target, "target": source})
            edges.append((lane.tags.get(BACK) or f"l{lane.id}:back", shapely.reverse(lines[k]), back))
    for name, pair_ in used.items():
        if pair_ is None:
            at = places.xyz[places.row[places.names[name]]]
            label = places.labels.get(name)
            properties.append({"kind": "node", "name": label or name, NAME: {"point": places.names[name]}})
        else:
            at = (places.xyz[places.row[pair_[0]]] + places.xyz[places.row[pair_[1]]]) / 2.0
            properties.append(compact({"kind": "node", NAME: compact({"points": list(pair_)})}))
        ids.append(name)
        geometry.append(shapely.Point(*at[:2].tolist()) if math.isnan(at[2]) else shapely.Point(*at.tolist()))
    ids = unique_ids([*ids, *(i for i, _, _ in edges)])
    out = np.empty(len(ids), object)
    out[:] = [*geometry, *(line for _, line, _ in edges)]
    return from_columns(ids, out, [*properties, *(p for _, _, p in edges)], places.anchor, document)


def _bounds(lanes: Sequence[Lane]) -> tuple[list[list[int]], list[list[int]]]:
    return [lane.left for lane in lanes], [lane.right for lane in lanes]


def _middles(
    lanes: Sequence[Lane], left: lane_geometry.LineSet, right: lane_geometry.LineSet, places: PointTable, xy: Array
) -> tuple[list[Any], list[float | None]]:
    """Of each lane its middle as a line, and its width in metres, None where the bounds touch."""
    high = ~np.isnan(places.xyz[:, 2])
    values = np.where(np.isnan(places.xyz), 0.0, places.xyz)
    points, owner = lane_geometry.middles(left, right, xy, values)
    points = np.round(points, 12 if places.anchor == "wgs84" else 9)
    deep = np.zeros(len(lanes), bool)
    for side in (left, right):
        np.logical_or.at(deep, side.owner, high[side.indices])
    flat = np.asarray(shapely.linestrings(points[:, :2], indices=owner), object).reshape(len(lanes))
    lines = flat
    if deep.any():
        lines = np.where(deep, np.asarray(shapely.linestrings(points, indices=owner), object), flat)
    out = lines.tolist()
    for k, lane in enumerate(lanes):
        if lane.middle is not None:
            rows = [places.row[r] for r in lane.middle]
            coordinates = values[rows] if high[rows].any() else places.xyz[rows, :2]
            out[k] = shapely.LineString(coordinates)
    sides = [
        np.asarray(shapely.linestrings(xy[s.indices], indices=s.owner), object).reshape(len(lanes))
        for s in (left, right)
    ]
    apart = shapely.distance(*sides).tolist()
    widths = []
    for lane, width in zip(lanes, apart, strict=True):
        # Where we made the bounds, the edge's width is in a tag; without one their distance is no information.
        between = round(width, 6) if width >= 0.01 and EDGE not in lane.tags else None
        tag_width = _positive(lane.tags.get("width"))
        widths.append(between if tag_width is None else tag_width)
    return out, widths


class _JoinedEnds:
    """Which ends of lanes are one node. An end is its (left, right) points, looking along the lane; on a lane that may
    be used both ways it is also (right, left)."""

    def __init__(self) -> None:
        self.parent: dict[tuple[int, int], tuple[int, int]] = {}

    def add(self, pair: tuple[int, int], both: bool) -> None:
        a = self.find(pair)
        if both:
            b = self.find((pair[1], pair[0]))
            # The smaller one stands for both, so that a node's id does not depend on the order of lanelets.
            self.parent[max(a, b)] = min(a, b)

    def find(self, pair: tuple[int, int]) -> tuple[int, int]:
        top = self.parent.setdefault(pair, pair)
        while self.parent[top] != top:
            top = self.parent[top]
        self.parent[pair] = top
        return top

    def all(self) -> list[tuple[int, int]]:
        return list(self.parent)


def is_two_way(tags: Mapping[str, str]) -> bool:
    """Whether a lanelet may be used both ways (Lanelet2: LaneletAndAreaTagging, "Direction")."""
    one_way = _truth(tags.get("one_way"))
    if one_way is not None:
        return not one_way
    allowed = {k.removeprefix("participant:") for k, v in tags.items() if k.startswith("participant:") and _truth(v)}
    on_foot = allowed == {"pedestrian"} if allowed else tags.get("subtype") in ON_FOOT
    special = {k.removeprefix("one_way:"): _truth(v) for k, v in tags.items() if k.startswith("one_way:")}
    if on_foot:
        return not special.get("pedestrian", False)
    # One participant's right to go back is not everybody's.
    return bool(allowed) and all(special.get(participant) is False for participant in allowed)


def _truth(value: str | None) -> bool | None:
    text = (value or "").strip().lower()
    return True if text in ("yes", "true", "1") else False if text in ("no", "false", "0") else None


_SPEED = re.compile(r"\s*(\d{1,9}(?:\.\d{1,20})?)\s*([A-Za-z/]*)\s*", re.ASCII)


MAX_SPEED = 150.0
"""Metres per second; no vehicle's limit is higher."""


def parse_speed(text: str | None) -> float | None:
    """Metres per second, or None for what is no speed."""
    match = _SPEED.fullmatch(text or "")
    if match is None:
        return None
    unit = UNITS.get(match[2].lower()) if match[2] else 1 / 3.6
    return None if unit is None else round(float(match[1]) * unit, 9)


def _decimal(text: Any) -> float:
    """A finite number within the bound of local coordinates, else NaN."""
    try:
        value = float(text)
    except (TypeError, ValueError):
        return math.nan
    return value if abs(value) <= MAX_METRES else math.nan


def _positive(text: Any) -> float | None:
    value = _decimal(text)
    return value if value > 0 else None


def _is_deleted(attributes: Mapping[str, Any]) -> bool:
    return attributes.get("action") == "delete" or attributes.get("visible") == "false"


def read_lanes(
    relations: Iterable[tuple[int, Sequence[Sequence[Any]], Mapping[str, str], Mapping[str, str]]],
    ways: Mapping[int, tuple[Sequence[int], Mapping[str, str]]],
    located: Mapping[int, Any],
) -> tuple[list[Lane], list[tuple[int, str]]]:
    """The lanelets that can be followed, and of the others why not. relations: (id, members, tags, attributes)."""
    out, broken = [], []
    for i, members, tags, attributes in relations:
        if tags.get("type") != "lanelet":
            continue
        if _is_deleted(attributes):
            broken.append((i, "it is marked as deleted"))
            continue
        sides: dict[str, list[list[int]]] = {"left": [], "right": [], "centerline": []}
        for kind, ref, role in members:
            if kind == "way" and role in sides and ref in ways and not _is_deleted(ways[ref][1]):
                sides[role].append([r for r in ways[ref][0] if r in located])
        if any(len(sides[s]) != 1 or len(sides[s][0]) < 2 for s in ("left", "right")):
            broken.append((i, "it needs one left and one right bound of two and more points each"))
            continue
        middle = sides["centerline"][0] if len(sides["centerline"]) == 1 and len(sides["centerline"][0]) > 1 else None
        out.append(Lane(i, tags, sides["left"][0], sides["right"][0], middle))
    return out, broken


# --- reading -----------------------------------------------------------------------------------------------------

_LANELET = re.compile(
    rb"""<tag\s+(?:k\s*=\s*["']type["']\s+v\s*=\s*["']lanelet["']|v\s*=\s*["']lanelet["']\s+k\s*=\s*["']type["'])\s*/?>"""
)
_ROOT = re.compile(rb"<osm[\s>]")


def detect(name: str, data: bytes) -> bool:  # noqa: ARG001
    """An ``<osm>`` file with a lanelet in it."""
    return b"lanelet" in data and _ROOT.search(data[:4096]) is not None and _LANELET.search(data) is not None


def companions(main: str, data: bytes, names: Sequence[str]) -> Iterable[str]:  # noqa: ARG001
    """Autoware's file about the projection, which stands beside the map."""
    folder = main.rpartition("/")[0]
    return [n for n in names if n == f"{folder}/{PROJECTOR}".lstrip("/")]


def read(files: Files, context: ReadContext) -> Layers:
    """The network of lanelets, and all elements as objects, on earth (in metres where the projector is ``Local``).

    Raises UnreadableFile, with a line where there is one, for what is no OSM file and for places that are not on earth.
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
            reason = f"the speed limit {limit[:40]!r} is no speed from 0 to {MAX_SPEED:g} m/s"
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
    """Whether no point stands on earth and some say their metres: Autoware's maps without a projection."""
    metres = any(LOCAL[0] in tags for tags in data.tags.values())
    return metres and bool(np.isnan(data.lonlat[:, 0]).all())


def _projector_text(data: bytes, name: str) -> str:
    if len(data) > 2**16:
        raise TooLarge(f"{name} has {len(data)} bytes; 65536 are the limit", [Problem("too large", name)])
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
        context.warn("it names no projector_type: places on earth are believed", file=name)
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
                context.warn("ids stand more than once in the file; the last one counts", where=noun)
        self.row = row
        xyz = np.full((len(data.ids), 3), np.nan)
        if not local:
            xyz[:, :2] = data.lonlat
        doubts: Counter[str] = Counter()
        for k, tags in data.tags.items():
            if local:
                xyz[k, :2] = _decimal(tags.get(LOCAL[0])), _decimal(tags.get(LOCAL[1]))
            if "ele" in tags:
                xyz[k, 2] = _decimal(tags["ele"])
                doubts["elevations are no numbers of metres and not believed"] += math.isnan(xyz[k, 2])
        absent = np.isnan(xyz[:, :2]).any(axis=1)
        xyz[absent] = np.nan
        doubts["points have no place; references to them are kept"] += int(absent.sum())
        for text, times in doubts.items():
            if times:
                context.warn(f"{times} {text}")
        self.xyz = xyz
        self.known: dict[int, dict[str, Any]] = {}
        self.compact = SharedKeyDicts()
        self.located = {i: k for i, k in row.items() if not absent[k]}

    def network(self) -> Features:
        relations = ((r.id, r.members, r.tags, r.attributes) for r in self.relations.values())
        ways = {i: (way.refs, way.attributes) for i, way in self.ways.items()}
        lanes, broken = read_lanes(relations, ways, self.located)
        for i, reason in broken:
            self.context.warn(f"the lanelet is no part of the network: {reason}", where=f"relation {i}")
        if not lanes:
            self.context.warn("the file has no lanelets that could be followed, so there is no network in it")
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
        """Points that are no mere bends, ways and relations."""
        data = self.data
        members = {i for r in self.relations.values() for kind, i, _ in r.members if kind == "node"}
        bent = set(chain.from_iterable(way.refs for way in self.ways.values()))
        lone = []
        for i, k in self.row.items():
            tags = data.tags.get(k, {})
            special = i not in bent or i in members or i not in self.located or not tags.keys() <= PLAIN_TAGS
            if special or k in data.node_children or _is_deleted(data.attributes(k)):
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
        if not way.refs and not _is_deleted(way.attributes):
            self.context.warn("the way has no nodes", where=f"way {way.id}")
        bends = [None if r in special or r not in self.row else self.bend(self.row[r]) for r in way.refs]
        mere = [b for b in bends if b is not None]
        if any(mere):
            source_members["vertices"] = mere[0] if all(b == mere[0] for b in mere) else bends
        if way.children:
            source_members["children"] = way.children
        return self.compact(source_members)

    def bend(self, k: int) -> dict[str, Any]:
        """What is known of a point beside its place; one value for all ways that bend there."""
        cached = self.known.get(k)
        if cached is None:
            cached = self.known[k] = self.read_point(k)
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
    """Only points with a place, so that nothing else can be meant."""
    rows = list(located.values())
    return PointTable({i: k for k, i in enumerate(located)}, xyz[rows].reshape(-1, 3), anchor, names, labels)


def _properties(source_members: dict[str, Any], tags: Tags, otherwise: str) -> dict[str, Any]:
    kind = tags.get("type") or otherwise
    if otherwise == "relation" and kind == "multipolygon":
        kind = "area"
    name = tags.get("name")
    return {"kind": kind, "name": name, NAME: source_members} if name else {"kind": kind, NAME: source_members}


# --- writing -----------------------------------------------------------------------------------------------------


@dataclass(slots=True)
class _Point:
    """A point that is written. at: (lon, lat) as its source said them where the file says metres too, else None."""

    xyz: tuple[float, float, float]
    local: bool
    tags: Mapping[str, str] = field(default_factory=dict)
    attributes: Mapping[str, str] = field(default_factory=dict)
    at: tuple[float, float] | None = None
    stored: bool = True
    vertex: bool = False


@dataclass(slots=True)
class _Level:
    """How the elements of one level are called in the file: stored id -> id."""

    nodes: dict[int, int] = field(default_factory=dict)
    ways: dict[int, int] = field(default_factory=dict)
    relations: dict[int, int] = field(default_factory=dict)


@dataclass(slots=True)
class _NewLanelet:
    """A lanelet to be made: its middle [k, 3] in metres, the edge along it, and the edge back, if it is two-way."""

    middle: Array
    half: float
    edge: Edge
    back: Edge | None


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """``lanelet2.osm``, and ``map_projector_info.yaml`` where the source had one or it is asked for.

    Raises MissingDatum where a network is in metres and there is no datum.
    """
    out = _Writer(layers, context)
    for level in dict.fromkeys(key.level for key in sorted(layers.parts)):
        out.level(level)
    out.add_network()
    files = {MAIN: out.text()}
    if out.projector is not None:
        files[PROJECTOR] = out.projector.encode()
    elif context.options.projector_info:
        files[PROJECTOR] = b"projector_type: Local\nvertical_datum: WGS84\n"
    return files


class _Writer:
    def __init__(self, layers: Layers, context: WriteContext) -> None:
        self.layers, self.context = layers, context
        self.options: WriteOptions = context.options
        self.points: dict[int, _Point] = {}
        self.ways: dict[int, tuple[list[int], Mapping[str, str], Mapping[str, str]]] = {}
        self.relations: dict[int, tuple[list[tuple[str, int, str]], Mapping[str, str], Mapping[str, str]]] = {}
        self.levels: dict[str, _Level] = {}
        self.lost: Counter[str] = Counter()
        self.children: dict[tuple[str, int], Any] = {}
        self.explained: dict[PartKey, set[str]] = {}
        self.moved: dict[PartKey, set[str]] = {}
        own_parts = [part for key, part in layers.vector("objects").items() if key.name == NAME]
        self.documents = [
            source_members for part in own_parts if isinstance(source_members := part.document.get(NAME), Mapping)
        ]
        self.projector = next((s for d in self.documents if isinstance(s := d.get("projector"), str)), None)
        self.metric = any(part.local.any() for part in own_parts)
        rows = [get_source_properties(p, NAME) for part in own_parts for p in part.properties]
        self.taken = {k[1] for part in own_parts for i in part.ids if (k := element_id(i))}
        self.taken.update(chain.from_iterable(integers(source_members.get("refs")) or () for source_members in rows))
        self.counter = 0
        # In a map whose metres are another frame's, new points say only where on earth they are.
        self.say_metres = self.metric or not any(
            LOCAL[0] in as_texts(t) for source_members in rows for t in _iterate_tags(source_members)
        )

    def next_id(self) -> int:
        """A new id; points, ways and relations share one row of numbers."""
        self.counter += 1
        while self.counter in self.taken:
            self.counter += 1
        self.taken.add(self.counter)
        return self.counter

    # --- what was read ---

    def level(self, name: str) -> None:
        level = self.levels[name] = _Level()
        part = next((p for k, p in self.layers.vector("objects", name).items() if k.name == NAME), None)
        networks = self.layers.vector("topology", name)
        nodes = {
            i for n in networks.values() for i, p in zip(n.ids, n.properties, strict=True) if p.get("kind") == "node"
        }
        if part is None or not len(part):
            return
        mixed = part.local.any() and not part.local.all()
        geometry = part.in_wgs84(self.layers.frame) if mixed else part.geometry
        local = bool(part.local.all())
        rows = [
            (identity[0], identity[1], shape, get_source_properties(p, NAME))
            for i, shape, p in zip(part.ids, geometry, part.properties, strict=True)
            if (identity := element_id(i)) and NAME in p
        ]
        self.lost["objects that are no element of a map"] += len(part) - len(rows)
        for kind, i, shape, source_members in rows:
            if kind == "n":
                self.point(level, i, shape, source_members, local, nodes if networks else None)
        drawn_anew = [
            (i, shape, source_members)
            for kind, i, shape, source_members in rows
            if kind == "w" and not self.write_way(level, i, shape, source_members, local)
        ]
        for i, shape, source_members in drawn_anew:  # once the points of all others are there to be met
            refs = integers(source_members.get("refs")) or []
            points = self.redrawn(level, refs, _course(shape), local)
            self.ways[level.ways[i]] = (
                points,
                as_texts(source_members.get("tags")),
                as_texts(source_members.get("attributes")),
            )
        relations = [(i, source_members) for kind, i, _, source_members in rows if kind == "r"]
        for i, _ in relations:
            level.relations[i] = self.next_id() if i in self.relations else i
            self.relations[level.relations[i]] = ([], NO_ATTRIBUTES, NO_ATTRIBUTES)
        lane_tags = self.lanelets(level, part, local, relations, networks)
        for i, source_members in relations:
            self.relation(level, i, source_members, lane_tags.get(i, (NO_ATTRIBUTES, False)))

    def point(
        self, level: _Level, i: int, shape: Any, source_members: Mapping[str, Any], local: bool, nodes: set[str] | None
    ) -> None:
        xyz = _xyz(shape)
        new = self.next_id() if i in self.points else i
        tags = as_texts(source_members.get("tags"))
        if nodes is not None and NODE in tags and tags[NODE] not in nodes:
            tags = {k: v for k, v in tags.items() if k != NODE}
        self.points[new] = _Point(
            xyz, local, tags, as_texts(source_members.get("attributes")), _pair(source_members.get("at"))
        )
        level.nodes[i] = new
        self.unknown("node", new, source_members)

    def write_way(self, level: _Level, i: int, shape: Any, source_members: Mapping[str, Any], local: bool) -> bool:
        """Write a way; False where its geometry no longer has the points that it came with."""
        refs = integers(source_members.get("refs"))
        at = _course(shape)
        new = level.ways[i] = self.next_id() if i in self.ways else i
        self.unknown("way", new, source_members)
        tags, attributes = as_texts(source_members.get("tags")), as_texts(source_members.get("attributes"))
        missing = set(integers(source_members.get("missing")) or ())
        if refs is None or len(refs) - len(missing) != len(at):
            self.ways[new] = ([], tags, attributes)
            return False
        bends = source_members.get("vertices")
        rows = bends if isinstance(bends, list) and len(bends) == len(refs) else [bends] * len(refs)
        out, j = [], 0
        for k, ref in enumerate(refs):
            name = level.nodes.get(ref, ref)
            if k not in missing:
                point = self.points.get(name)
                bend: Mapping[str, Any] = row if isinstance(row := rows[k], Mapping) else {}
                if point is None or (ref not in level.nodes and not _is_same_place(point.xyz, at[j])):
                    # Two ways that no longer agree where their common point is keep their course each.
                    if point is not None:
                        name = self.next_id()
                    tags_, attributes_ = as_texts(bend.get("tags")), as_texts(bend.get("attributes"))
                    position = _pair(bend.get("at"))
                    self.points[name] = _Point(at[j], local, tags_, attributes_, position, vertex=True)
                    if point is None:
                        level.nodes[ref] = name
                elif point.vertex and not _is_same_place(point.xyz, at[j]):
                    name = self.next_id()
                    self.points[name] = _Point(at[j], local, vertex=True)
                j += 1
            out.append(name)
        self.ways[new] = (out, tags, attributes)
        return True

    def redrawn(self, level: _Level, refs: list[int], at: list[tuple[float, float, float]], local: bool) -> list[int]:
        """Points for a way whose geometry was edited: its own where one stands at a bend, else new ones."""
        names = (level.nodes.get(r, r) for r in refs)
        point_names = {self.points[n].xyz[:2]: n for n in names if n in self.points}
        out = []
        for position in at:
            if position[:2] not in point_names:
                point_names[position[:2]] = new = self.next_id()
                self.points[new] = _Point(position, local, vertex=True)
            out.append(point_names[position[:2]])
        return out

    def unknown(self, kind: str, number: int, source_members: Mapping[str, Any]) -> None:
        """Keep the elements inside an element that OSM does not know."""
        if source_members.get("children"):
            self.children[kind, number] = source_members["children"]

    def lanelets(
        self,
        level: _Level,
        part: Features,
        local: bool,
        relations: Sequence[tuple[int, Mapping[str, Any]]],
        networks: Mapping[PartKey, Features],
    ) -> dict[int, tuple[Mapping[str, str], bool] | None]:
        """What the network says of each lanelet: its tags and whether it goes the other way round now; None where its
        edges are gone. Without a network nothing is said of any."""
        if not networks:
            return {}
        ways: dict[int, tuple[list[int], Mapping[str, str]]] = {}
        row: dict[int, int] = {}
        xyz: list[tuple[float, float, float]] = []
        names: dict[str, int] = {}
        labels: dict[str, str] = {}
        sizes = shapely.get_num_coordinates(part.geometry).tolist()
        for i, size, p in zip(part.ids, sizes, part.properties, strict=True):
            identity, source_members = element_id(i), get_source_properties(p, NAME)
            refs: list[int] = []
            if identity and identity[0] == "n" and size:
                refs = [identity[1]]
                tags = as_texts(source_members.get("tags"))
                if tags.get(NODE):
                    names.setdefault(tags[NODE], identity[1])
                    labels.setdefault(tags[NODE], tags.get("name", ""))
            elif identity and identity[0] == "w":
                missing = set(integers(source_members.get("missing")) or ())
                refs = [r for k, r in enumerate(integers(source_members.get("refs")) or ()) if k not in missing]
                if len(refs) != size:  # redrawn: its points are not those that it came with
                    continue
                ways[identity[1]] = (refs, as_texts(source_members.get("attributes")))
            if any(r not in level.nodes for r in refs):
                continue  # a point that it refers to is not among them: somebody has changed it
            for r in refs:
                if r not in row:
                    row[r] = len(xyz)
                    xyz.append(self.points[level.nodes[r]].xyz)
        rows = (
            (
                i,
                _members(source_members),
                as_texts(source_members.get("tags")),
                as_texts(source_members.get("attributes")),
            )
            for i, source_members in relations
        )
        lanes, broken = read_lanes(rows, ways, row)
        table = PointTable(row, np.array(xyz, np.float64).reshape(-1, 3), "local" if local else "wgs84", names, labels)
        drawn = network(lanes, table, {})
        out = self.compare_lanelets(lanes, drawn, networks)
        # A lanelet with a redrawn bound is written as it is drawn now; its edges stay with it.
        redrawn = {i for i, _ in broken}
        for key, net in networks.items():
            own_edges = (
                k
                for k, p in zip(net.ids, net.properties, strict=True)
                if get_source_properties(p, NAME).get("lanelet") in redrawn
            )
            self.explained.setdefault(key, set()).update(own_edges)
        return out

    def compare_lanelets(
        self, lanes: Sequence[Lane], drawn: Features, networks: Mapping[PartKey, Features]
    ) -> dict[int, tuple[Mapping[str, str], bool] | None]:
        """Lanelets as the networks have them now. drawn: the network that the lanelets make by themselves."""
        index_by_id = drawn.index()
        net_properties: dict[str, Properties] = {}
        for key, net in networks.items():
            near = SAME_PLACE["local" if bool(drawn.local.all()) else "wgs84"]
            own_rows = [(k, index_by_id[i]) for k, i in enumerate(net.ids) if i in index_by_id]
            now, then = [k for k, _ in own_rows], [k for _, k in own_rows]
            same = shapely.equals_exact(net.geometry[now], drawn.geometry[then], tolerance=near) if now else []
            still = {net.ids[k] for k, ok in zip(now, same, strict=True) if ok and net.local[k] == drawn.local[0]}
            self.moved[key] = {net.ids[k] for k in now} - still
            explained_ids = self.explained.setdefault(key, set())
            for k, j in own_rows:
                p, q = net.properties[k], drawn.properties[j]
                ends = (p.get("source"), p.get("target"))
                if (
                    p.get("kind") == "edge"
                    and ends == (q.get("source"), q.get("target"))
                    and still >= {*ends, net.ids[k]}
                ):
                    net_properties[net.ids[k]] = p
                    explained_ids.add(net.ids[k])
        expected: dict[int, list[int]] = {}
        for k, p in enumerate(drawn.properties):
            if p["kind"] == "edge":
                expected.setdefault(p[NAME]["lanelet"], []).append(k)
        out: dict[int, tuple[Mapping[str, str], bool] | None] = {}
        for lane in lanes:
            edges = expected[lane.id]
            matches = [k for k in edges if drawn.ids[k] in net_properties]
            if not matches:
                out[lane.id] = None
                self.lost["lanelets whose edges are no longer in the network"] += 1
                continue
            tags = self.edited_tags(lane, drawn.properties[matches[0]], net_properties[drawn.ids[matches[0]]])
            if len(matches) < len(edges):
                tags = {**{k: v for k, v in tags.items() if not k.startswith("one_way:")}, "one_way": "yes"}
            out[lane.id] = (tags, matches[0] != edges[0])
        return out

    def edited_tags(self, lane: Lane, drawn: Properties, now: Properties) -> dict[str, str]:
        """The lanelet's tags with what the network says otherwise."""
        tags = dict(lane.tags)
        if now.get("speed_limit") != drawn.get("speed_limit"):
            tags.pop("speed_limit", None)
            if (speed := _metres_per_second(now)) is not None:
                tags["speed_limit"] = _kmh(speed)
        if now.get("name") != drawn.get("name"):
            tags.pop("name", None)
            tags.pop("road_name", None)
            if isinstance(now.get("name"), str):
                tags["name"] = now["name"]
        if now.get("width") != drawn.get("width"):
            self.lost["widths of edges that differ from the bounds of their lanelet"] += 1
        return tags

    def relation(
        self, level: _Level, i: int, source_members: Mapping[str, Any], about: tuple[Mapping[str, str], bool] | None
    ) -> None:
        if about is None:
            del self.relations[level.relations[i]]
            return
        tags, turned = about
        members = []
        for kind, ref, role in _members(source_members):
            names = {"node": level.nodes, "way": level.ways, "relation": level.relations}.get(kind, {})
            other = {"left": "right", "right": "left"}.get(role) if turned else None
            members.append((kind, names.get(ref, ref), other or role))
        stated = source_members.get("members")
        self.lost["relation members that are not [type, id, role]"] += (
            len(stated) - len(members) if isinstance(stated, list) else 0
        )
        self.unknown("relation", level.relations[i], source_members)
        tags = tags or as_texts(source_members.get("tags"))
        self.relations[level.relations[i]] = (members, tags, as_texts(source_members.get("attributes")))

    # --- what came from elsewhere ---

    def add_network(self) -> None:
        """Lanelets for all edges that none explains, and points for nodes."""
        parts: dict[PartKey, Part] = {}
        for key, part in self.layers.vector("topology").items():
            explained_ids = self.explained.get(key, set())
            keep = [k for k, i in enumerate(part.ids) if i not in explained_ids]
            if any(part.properties[k].get("kind") == "edge" for k in keep) or not explained_ids:
                parts[key] = part.select(keep)
        if not parts:
            return
        if self.layers.frame is None and not self.metric:
            raise MissingDatum(
                "lanelet2 says where on earth a network lies, and the environment has no datum: set one with PATCH "
                '/api/v1/environments/{env} {"datum": {"latitude": …, "longitude": …}} or upload a datum.yaml'
            )
        net = merge_networks(Layers(parts, self.layers.datum, self.layers.levels), self.context)
        new = self.make_lanelets(net)
        centres = self.node_points(net, {n for lane in new for n in (lane.edge.source, lane.edge.target)})
        self.bounds(net, new, centres)
        self.report_new_lanelets(net, new)

    def report_new_lanelets(self, net: MergedNetwork, new: Sequence[_NewLanelet]) -> None:
        """What new lanelets were given, and what they could not take."""
        if new:
            why = "the edges of the network say no more"
            if default := sum("width" not in lane.edge.properties for lane in new):
                self.context.fill("width of lanes", self.options.width, f"{default} edges say none", "width")
            self.context.fill("type of bounds", self.options.bounds, why, "bounds")
            self.context.fill("location of lanelets", self.options.location, why, "location")
            if any(self.subtype(lane.edge) == self.options.subtype for lane in new):
                self.context.fill("subtype of lanelets", self.options.subtype, why, "subtype")
        more = sum(bool(e.properties.keys() - CANONICAL_EDGE) for e in net.edges)
        self.context.drop("further properties of edges", more, "lanelets have no place for them")
        more = sum(bool(n.properties.keys() - CANONICAL_NODE) for n in net.nodes)
        self.context.drop("further properties of nodes", more, "points have no place for them")
        if len(set(net.levels)) > 1:
            self.context.drop("levels of nodes", len(net.nodes), "Lanelet2 knows no levels: all networks are joined")

    def make_lanelets(self, net: MergedNetwork) -> list[_NewLanelet]:
        """One for each edge, one for both where an edge has a like one on the way back."""
        waiting: dict[tuple[int, int], list[Edge]] = {}
        for edge in net.edges:
            waiting.setdefault((edge.source, edge.target), []).append(edge)
        done: set[int] = set()
        out = []
        without = loops = 0
        for edge in net.edges:
            if id(edge) in done:
                continue
            done.add(id(edge))
            if edge.source == edge.target:
                loops += 1
                continue
            middle = _middle_line(edge, net)
            if middle is None:
                without += 1
                continue
            back = None
            for other in waiting.get((edge.target, edge.source), ()):
                if id(other) not in done and _is_same_road(edge, other):
                    course = _middle_line(other, net)
                    if (
                        course is not None
                        and course.shape == middle.shape
                        and np.allclose(course[::-1], middle, atol=1e-6, equal_nan=True)
                    ):
                        back = other
                        done.add(id(other))
                        break
            width = _positive(edge.properties.get("width")) or self.options.width
            out.append(_NewLanelet(middle, width / 2.0, edge, back))
        self.context.drop("edges from a node to itself", loops, "a lanelet does not end at the border where it begins")
        self.context.drop("edges without length", without, "a lanelet needs bounds along its way")
        return out

    def node_points(self, net: MergedNetwork, used: set[int]) -> dict[int, int]:
        """A point for each node of the network; node number -> its id in the file. Nodes of lanelets that are written
        as they came need none unless a new lanelet begins there."""
        out = {}
        for k, node in enumerate(net.nodes):
            source_members = get_source_properties(node.properties, NAME)
            stored = source_members.get("point")
            level = self.levels.get(node.level, _Level())
            if type(stored) is int and stored in level.nodes and self.points[level.nodes[stored]].tags.get(NODE):
                new = level.nodes[stored]
                if not _is_same_place(
                    self.points[new].xyz, self.to_anchor(node.x, node.y, node.z, self.points[new].local)
                ):
                    new = -1
            elif k not in used and isinstance(source_members.get("points"), list):
                continue
            else:
                new = -1
            if new == -1:
                tags = {"type": "node", NODE: node.id}
                name = node.properties.get("name")
                if isinstance(name, str) and name != node.id:
                    tags["name"] = name
                new = self.add_point(node.x, node.y, node.z or 0.0 if node.z is not None else math.nan, tags)
            out[k] = new
        return out

    def to_anchor(self, x: float, y: float, z: float | None, local: bool) -> tuple[float, float, float]:
        """A place in metres in the coordinates that a point is anchored in."""
        high = math.nan if z is None else z
        if local or self.layers.frame is None:
            return x, y, high
        lon, lat = np.round(self.layers.frame.to_wgs84(np.array([[x, y]]))[0], 12).tolist()
        return lon, lat, high

    def add_point(self, x: float, y: float, z: float, tags: Mapping[str, str] = NO_ATTRIBUTES) -> int:
        new = self.next_id()
        point_tags = dict(tags)
        if self.say_metres:
            point_tags |= {LOCAL[0]: number(x), LOCAL[1]: number(y)}
        if not math.isnan(z):
            point_tags["ele"] = number(z)
        self.points[new] = _Point((x, y, z), True, point_tags, stored=False)
        return new

    def bounds(self, net: MergedNetwork, new: Sequence[_NewLanelet], centres: Mapping[int, int]) -> None:
        """Bounds, centrelines and relations of the new lanelets."""
        arms: dict[int, list[Arm]] = {}
        for k, lane in enumerate(new):
            for far, end in ((False, lane.edge.source), (True, lane.edge.target)):
                a, b = (lane.middle[-1], lane.middle[-2]) if far else (lane.middle[0], lane.middle[1])
                step = b[:2] - a[:2]
                away = step / np.hypot(*step)
                both = lane.back is not None
                arm = Arm(k, far, (float(away[0]), float(away[1])), far or both, not far or both, lane.half)
                arms.setdefault(end, []).append(arm)
        borders: dict[int, Border] = {}
        shared: dict[int, list[int]] = {}
        joins: dict[tuple[int, bool], tuple[int, bool]] = {}
        for node, node_arms in sorted(arms.items()):
            at = net.nodes[node]
            stored = self.read_border(net, node)
            border = stored[0] if stored else lane_geometry.border((at.x, at.y), node_arms)
            if border is None:
                continue
            borders[node] = border
            if stored:
                shared[node] = list(stored[1])
            joins |= {(arm.lane, arm.far): (node, border.along(arm)) for arm in node_arms if border.is_shared_by(arm)}
        narrow = 0
        for k, lane in enumerate(new):
            left, right, squeezed = self.sides(k, lane, joins, borders)
            narrow += squeezed
            sides = []
            for side, points in enumerate((left, right)):
                names = []
                for n, (x, y) in enumerate(points.tolist()):
                    join = joins.get((k, n > 0)) if n in (0, len(points) - 1) else None
                    z = float(lane.middle[n, 2])
                    if join is None:
                        names.append(self.add_point(x, y, z))
                        continue
                    node, straight = join
                    if node not in shared:
                        border = borders[node]
                        shared[node] = [self.add_point(*p, z) for p in (border.left, border.right)]
                    names.append(shared[node][side if straight else 1 - side])
                sides.append(names)
            self.emit(net, lane, sides, centres)
        if narrow:
            self.context.warn(f"{narrow} lanes are narrower than their edges say, so that their bounds do not cross")
        possible = sum(map(lane_geometry.count_ways, arms.values()))
        connection_count = 0
        for node, node_arms in arms.items():
            across = [
                lane_geometry.crossing_cosine(arm, borders[node]) if (arm.lane, arm.far) in joins else 0.0
                for arm in node_arms
            ]
            connection_count += lane_geometry.count_through(node_arms, across)
        if breaks := possible - connection_count:
            self.context.warn(
                f"{breaks} of {possible} ways from one lane into the next are no connection in Lanelet2's sense: their "
                "turns are too sharp for bounds to be shared"
            )

    def read_border(self, net: MergedNetwork, node: int) -> tuple[Border, tuple[int, int]] | None:
        """The two points of a node of stored lanelets, in metres, where it is still there."""
        at = net.nodes[node]
        pair = integers(get_source_properties(at.properties, NAME).get("points"))
        level = self.levels.get(at.level)
        if pair is None or len(pair) != 2 or level is None or any(at.id in moved for moved in self.moved.values()):
            return None
        names = [level.nodes.get(i, i) for i in pair]
        if pair[0] == pair[1] or any(n not in self.points for n in names):
            return None
        left, right = (self.point_in_metres(self.points[n]) for n in names)
        if left is None or right is None:
            return None
        x, y = left[0] - right[0], left[1] - right[1]
        length = math.hypot(x, y)
        return (Border((y / length, -x / length), left, right), (names[0], names[1])) if length > 1e-6 else None

    def point_in_metres(self, point: _Point) -> tuple[float, float] | None:
        if point.local:
            return point.xyz[:2]
        if self.layers.frame is None or math.isnan(point.xyz[0]):
            return None
        x, y = self.layers.frame.to_local(np.array([point.xyz[:2]]))[0].tolist()
        return x, y

    def sides(
        self, k: int, lane: _NewLanelet, joins: dict[tuple[int, bool], tuple[int, bool]], borders: Mapping[int, Border]
    ) -> tuple[Array, Array, bool]:
        """(left, right, whether they are closer than asked for). Ends that a border would spoil leave ``joins``."""
        half = lane.half
        if not shapely.LineString(lane.middle[:, :2]).is_simple:  # it crosses itself, however narrow it is
            for far in (False, True):
                joins.pop((k, far), None)
            return *lane_geometry.offset_bounds(lane.middle[:, :2], half), False
        for attempt in range(8):
            left, right = lane_geometry.offset_bounds(lane.middle[:, :2], half)
            for far_ends in ((False, True), (True,), (False,), ()):
                a, b = left.copy(), right.copy()
                for far in far_ends:
                    if (k, far) in joins:
                        node, straight = joins[k, far]
                        border = borders[node]
                        ends = (border.left, border.right) if straight else (border.right, border.left)
                        a[-1 if far else 0], b[-1 if far else 0] = ends
                if lane_geometry.is_sound(a, b):
                    for far in {False, True} - set(far_ends):
                        joins.pop((k, far), None)
                    return a, b, attempt > 0
            half /= 2.0
        for far in (False, True):
            joins.pop((k, far), None)
        return *lane_geometry.offset_bounds(lane.middle[:, :2], half), True

    def emit(
        self, net: MergedNetwork, lane: _NewLanelet, sides: Sequence[list[int]], centres: Mapping[int, int]
    ) -> None:
        edge = lane.edge
        middle = [centres[edge.source]]
        middle += [self.add_point(x, y, z) for x, y, z in lane.middle[1:-1].tolist()]
        middle.append(centres[edge.target])
        members = []
        for role, refs in (("left", sides[0]), ("right", sides[1]), ("centerline", middle)):
            new = self.next_id()
            kind = "virtual" if role == "centerline" else self.options.bounds
            self.ways[new] = (refs, {"type": kind}, NO_ATTRIBUTES)
            members.append(("way", new, role))
        source_tags = get_source_properties(edge.properties, NAME).get("tags")
        tags = {"type": "lanelet", "subtype": self.subtype(edge), "location": self.options.location}
        stated = as_texts(source_tags) if isinstance(source_tags, Mapping) else NO_ATTRIBUTES
        tags |= {k: v for k, v in stated.items() if k != "one_way" and not k.startswith(("one_way:", "fleetmap:"))}
        tags["one_way"] = "yes" if lane.back is None else "no"
        for key in ("name", "speed_limit", "width"):
            tags.pop(key, None)
        name = edge.properties.get("name")
        if isinstance(name, str) and name != edge.id:
            tags["name"] = name
        if (speed := _metres_per_second(edge.properties)) is not None:
            tags["speed_limit"] = _kmh(speed)
        if (width := _positive(edge.properties.get("width"))) is not None:
            tags["width"] = repr(width)
        tags |= {EDGE: edge.id, SOURCE: net.nodes[edge.source].id, TARGET: net.nodes[edge.target].id}
        if lane.back is not None:
            tags[BACK] = lane.back.id
        self.relations[self.next_id()] = (members, tags, NO_ATTRIBUTES)

    def subtype(self, edge: Edge) -> str:
        """What its source calls it, in Lanelet2's words."""
        source_subtype = as_texts(get_source_properties(edge.properties, NAME).get("tags")).get("subtype")
        highway = as_texts(get_source_properties(edge.properties, "osm").get("tags")).get("highway")
        if source_subtype:
            return source_subtype
        return SUBTYPES.get(highway, "road") if highway else self.options.subtype

    # --- XML ---

    def text(self) -> bytes:
        nodes = self.nodes_in_degrees()
        for item, times in sorted(self.lost.items()):
            self.context.drop(item, times, "a Lanelet2 map has no place for them")
        if self.layers.datum is not None:
            self.context.drop("datum", 1, "a Lanelet2 map stands on earth and has no local frame of its own")
        return xml_text.document(self.head(), nodes, self.ways, self.relations, self.children)

    def nodes_in_degrees(self) -> dict[int, xml_text.Node]:
        """All points in degrees with their tags."""
        todo = [i for i, p in self.points.items() if p.local and not (self.metric or math.isnan(p.xyz[0]))]
        degrees: dict[int, tuple[float, float]] = {}
        if todo and self.layers.frame is not None:
            places = self.layers.frame.to_wgs84(np.array([self.points[i].xyz[:2] for i in todo], np.float64))
            degrees = {i: (x, y) for i, (x, y) in zip(todo, places.tolist(), strict=True)}
        out = {}
        while self.points:  # each point makes room for its node: there may be millions
            i, point = self.points.popitem()
            if not point.local:
                lon, lat = point.xyz[:2]
            else:
                lon, lat = degrees.get(i) or point.at or (math.nan, math.nan)
            out[i] = xml_text.Node(lon, lat, self.tags(point), point.attributes)
        return out

    def tags(self, point: _Point) -> Mapping[str, str]:
        """The tags as they were said, but for places that are no longer true."""
        tags = point.tags
        if not point.stored:
            return tags
        x, y, z = point.xyz
        if point.local and not math.isnan(x) and (_decimal(tags.get(LOCAL[0])), _decimal(tags.get(LOCAL[1]))) != (x, y):
            tags = {**tags, LOCAL[0]: number(x), LOCAL[1]: number(y)}
        elif not point.local and LOCAL[0] in tags and (point.at is None or point.at != (x, y)):
            tags = {k: v for k, v in tags.items() if k not in LOCAL}
            self.lost["local_x and local_y of moved points"] += 1
        elevation = _decimal(tags["ele"]) if "ele" in tags else 0.0
        if not math.isnan(z) and z != elevation and not (math.isnan(elevation) and z == 0.0):
            tags = {**tags, "ele": number(z)}
        return tags

    def head(self) -> list[str]:
        root: dict[str, str] = {"version": "0.6", "generator": GENERATOR}
        for one in self.documents:
            root |= as_texts(one.get("attributes"))
        root["version"] = "0.6"
        if self.context.attribution and not root.keys() & {"attribution", "copyright", "license"}:
            root["attribution"] = "; ".join(self.context.attribution)
        lines = [f"<osm{attribute_text(root, frozenset())}>"]
        for one in self.documents:
            lines += xml_text.element_lines(one.get("elements"))
            boxes = one.get("bounds")
            lines += [f" <bounds{attribute_text(as_texts(b), frozenset())}/>" for b in boxes or [] if as_texts(b)]
        return lines


def _iterate_tags(source_members: Mapping[str, Any]) -> Iterable[Any]:
    """The tags of a stored point or of a way's bends."""
    bends = source_members.get("vertices")
    rows = bends if isinstance(bends, list) else [bends]
    return [source_members.get("tags"), *(row.get("tags") for row in rows if isinstance(row, Mapping))]


def _xyz(shape: Any) -> tuple[float, float, float]:
    at = _course(shape)
    return at[0] if at else (math.nan, math.nan, math.nan)


def _course(shape: Any) -> list[tuple[float, float, float]]:
    """The points of a line or ring, z NaN where it has none; nothing for any other geometry."""
    if shape.geom_type not in ("LineString", "LinearRing", "Point") or shape.is_empty:
        return []
    return [(x, y, z) for x, y, z in shapely.get_coordinates(shape, include_z=True).tolist()]


def _is_same_place(a: tuple[float, float, float], b: tuple[float, float, float]) -> bool:
    """The same place; a line without elevations says nothing of them."""
    high = math.isnan(a[2]) or math.isnan(b[2]) or a[2] == b[2]
    return a[0] == b[0] and a[1] == b[1] and high


def _pair(value: Any) -> tuple[float, float] | None:
    if not isinstance(value, list | tuple) or len(value) != 2:
        return None
    valid = all(isinstance(v, int | float) and not isinstance(v, bool) for v in value)
    return (float(value[0]), float(value[1])) if valid else None


def _members(source_members: Mapping[str, Any]) -> list[tuple[str, int, str]]:
    rows = source_members.get("members")
    return [
        (str(row[0]), row[1], str(row[2]))
        for row in (rows if isinstance(rows, list) else [])
        if isinstance(row, list | tuple) and len(row) == 3 and type(row[1]) is int and abs(row[1]) < INT64
    ]


def _metres_per_second(properties: Properties) -> float | None:
    value = properties.get("speed_limit")
    valid = isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value < 1e9
    return float(value) if valid and value is not None else None


def _kmh(speed: float) -> str:
    """As Autoware reads it: kilometres an hour without a unit."""
    return xml_text.plain(repr(round(speed * 3.6, 9) + 0.0)).removesuffix(".0")


def _is_same_road(a: Edge, b: Edge) -> bool:
    """Whether two edges, there and back, can be one lanelet."""
    keys = ("speed_limit", "width", "name")
    return all(a.properties.get(w) == b.properties.get(w) for w in keys) and a.level == b.level


def _middle_line(edge: Edge, net: MergedNetwork) -> Array | None:
    """[k, 3] from node to node, metres, no point twice in a row; z NaN in two dimensions; None without a length."""
    a, b = net.nodes[edge.source], net.nodes[edge.target]
    inner = np.empty((0, 3))
    if edge.geometry.geom_type == "LineString" and not edge.geometry.is_empty:
        inner = shapely.get_coordinates(edge.geometry, include_z=True)[1:-1]
    ends = np.array([[n.x, n.y, math.nan if n.z is None else n.z] for n in (a, b)])
    line = np.vstack([ends[:1], inner, ends[1:]])
    if not np.isnan(line[:, 2]).all():
        line[:, 2] = np.where(np.isnan(line[:, 2]), 0.0, line[:, 2])
    keep = np.ones(len(line), bool)
    keep[1:] = np.hypot(*np.diff(line[:, :2], axis=0).T) > 1e-6
    if not keep[-1]:  # the last point is the node: what stands on it goes
        before = np.flatnonzero(keep)[-1]
        keep[before], keep[-1] = before == 0, before != 0
    line = line[keep]
    return line if len(line) > 1 else None


def choose(keys: Sequence[PartKey], options: Any) -> Sequence[PartKey]:  # noqa: ARG001 - one signature for all formats
    """The networks, and what came from such a map."""
    return [key for key in keys if key.layer == "topology" or (key.layer == "objects" and key.name == NAME)]


register(
    Format(
        name=NAME,
        title="Lanelet2 (also Autoware's)",
        files=(MAIN,),
        media_types=("application/vnd.openstreetmap.data+xml",),
        layers=frozenset({"topology", "objects"}),
        detect=detect,
        read=read,
        write=write,
        needs=LayerRequirements(
            one_of=(frozenset({"topology"}),), anchor="wgs84", also=frozenset({"objects"}), own=True
        ),
        companions=companions,
        write_options=WriteOptions,
        family=NAME,
        priority=36,
        version=2,
        extensions=(".osm",),
        select_parts=choose,
    )
)
