"""OpenStreetMap: XML (``.osm``, also ``.gz`` and ``.bz2``) and PBF in, XML out.

Reading. Each node that a ``highway=*`` way uses is a topology node ``n<id>``, each segment of such a way a directed
edge ``w<way>:<from>-<to>`` (a segment that the way repeats gets ``#2`` …), two where it may be used both ways; a way of
one node twice that is tagged ``self_loop=yes`` is an edge from that node to itself. Tags and
the further attributes (version, user, timestamp …) stay with nodes and edges in ``properties.osm``. Everything else is
an object of the family ``osm``: tagged or lone nodes ``n<id>``, all ways ``w<id>`` (the highways too, so that they come
back whole and in order) and relations ``r<id>``, a multipolygon with its area. Nodes that only bend a line are no
objects: their ids and attributes stand with their way, in ``refs`` and ``vertices``, and their places in its geometry.
``properties.osm`` of an object:

========== ============================================================================================================
tags       key -> value
attributes XML attributes but for id, lat and lon
refs       (ways) node ids in order
missing    (ways) indexes into refs of nodes without a place; the geometry has a vertex for each of the others
vertices   (ways) attributes of the nodes that are no features: one mapping for all, or a list parallel to refs
members    (relations) [type, id, role] in order
children   elements that OSM does not know: [name, attributes], then the text and a list of such where there are any
========== ============================================================================================================

An object's kind is its main tag's key (``building``, ``barrier``, ``highway`` …), ``tree`` and ``water`` for what is
one, else ``point``, ``line`` or ``relation``; tags also say its ``height``, ``base`` and ``width`` (the rules are in
``app.model.osm_tags``). An edge has its way's ``speed_limit`` (of its direction), ``width`` (else the lanes'),
``surface`` and ``access``, and ``stairs``. Ways join where they share a node: a bridge and what is below it do not.
Elements marked as deleted (``action="delete"``, ``visible="false"``) are kept, but no robot drives on them.

Writing. The canonical content decides: a feature's place wins over what else is known of a node, and its name, height,
speed limit … over the tags where they say something else; a highway way comes
back whole while all its edges are in the network, and is split where edges are gone, have become one-way or carry other
tags (the first piece keeps the id, the others get negative ones, and relations follow). Edges that no way explains
become new ways with negative ids. Objects of other formats, and zones, are written as ways and nodes with the tags
``name`` and ``kind``. Sorted as the OSM tools ask: nodes, ways, relations, each by id.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from itertools import chain, pairwise
from typing import Any, Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from app.errors import Problem, UnreadableFile
from app.formats import Claims, Files, Format, LayerRequirements, ReadContext, Traits, WriteContext, register
from app.formats.osm import rules as _osm_rules
from app.formats.osm import xml_text
from app.formats.osm.parsing import INT64, Data, Tags, Way, is_pbf, parse, unpack
from app.formats.osm.xml_text import NO_ATTRIBUTES, Node, as_texts, attribute_text, element_id, integers, plain
from app.limits import Limits
from app.model import osm_tags
from app.model.features import NO_GEOMETRY, Features, Properties, from_columns, points, segments, shared_key_dict
from app.model.frame import GROUND
from app.model.layers import NETWORK, Layers, Part, PartKey
from app.model.osm_areas import multipolygon_areas
from app.syntax import xml
from app.syntax.decimals import DEGREES, numbers

FAMILY = "osm"
GENERATOR = "Fleet Map Server"

MAIN_TAGS = (
    "highway",
    "building",
    "building:part",
    "barrier",
    "railway",
    "waterway",
    "aeroway",
    "aerialway",
    "power",
    "man_made",
    "amenity",
    "shop",
    "office",
    "craft",
    "emergency",
    "leisure",
    "tourism",
    "historic",
    "public_transport",
    "natural",
    "landuse",
    "military",
    "place",
    "boundary",
    "route",
)
"""The keys that say what an element is, most telling first (OSM wiki: Map features)."""

AREAS = frozenset(
    {
        "building",
        "building:part",
        "amenity",
        "shop",
        "office",
        "craft",
        "leisure",
        "tourism",
        "historic",
        "natural",
        "landuse",
        "military",
        "place",
        "boundary",
    }
)
"""A closed way with one of these is an area (OSM wiki: Area), unless it says ``area=no``."""

LINES = frozenset({"coastline", "cliff", "tree_row", "ridge", "arete", "valley", "track", "slipway", "citywalls"})
"""Values of such keys that are lines all the same."""

Direction = Literal["both", "forward", "backward"]

_FORWARD = frozenset({"yes", "true", "1", "reversible", "alternating"})
_BACKWARD = frozenset({"-1", "reverse"})
_NO = frozenset({"no", "false", "0"})


def direction(tags: Mapping[str, Any]) -> Direction:
    """Which way along its nodes a way may be used.

    ``oneway`` decides. Without it roundabouts and motorways are one-way, their links too: to drive against a link's
    traffic is worse than not to drive there. A reversible way is taken as it was drawn, never in both directions.
    """
    oneway = str(tags.get("oneway", "")).strip().lower()
    if oneway in _FORWARD:
        return "forward"
    if oneway in _BACKWARD:
        return "backward"
    if oneway in _NO:
        return "both"
    implied = tags.get("junction") in ("roundabout", "circular") or tags.get("highway") in ("motorway", "motorway_link")
    return "forward" if implied else "both"


def is_deleted(attributes: Mapping[str, Any]) -> bool:
    """Whether an element is only there to say that it is gone."""
    return attributes.get("action") == "delete" or attributes.get("visible") == "false"


KINDS: Mapping[str, Mapping[Any, str]] = {
    "natural": {"tree": "tree", "water": "water"},
    "waterway": dict.fromkeys(
        ("river", "stream", "canal", "ditch", "drain", "tidal_channel", "riverbank", "dock"), "water"
    ),
    "landuse": {"basin": "water", "reservoir": "water"},
}
"""By a main tag's key and value, the kind where the key itself tells too little."""


def object_kind(tags: Mapping[str, Any], otherwise: str) -> str:
    """The key of the main tag, or what its value says more plainly."""
    main_key = next((key for key in MAIN_TAGS if key in tags and tags[key] != "no"), None)
    if main_key is None:
        return str(tags["type"]) if otherwise == "relation" and tags.get("type") else otherwise
    if main_key in KINDS:
        return KINDS[main_key].get(tags[main_key], main_key)
    return "building" if main_key == "building:part" else main_key


_MEASURES = frozenset({"height", "building:levels", "min_height", "building:min_level", "width", "est_width"})
_MEASURES |= {"diameter", "circumference"}
_SPOKEN = {"name": "name", "height": "height", "base": "min_height", "width": "width"}
"""Canonical words of objects, and the tag that says each."""

_EDGE_TAGS = frozenset({"maxspeed", "maxspeed:forward", "maxspeed:backward", "width", "est_width", "lanes"})
_EDGE_TAGS |= {"surface", "access"}


def object_properties(tags: Mapping[str, Any]) -> dict[str, Any]:
    """The canonical words that an object's tags say, but for its kind. A highway's measures are its edges'."""
    out: dict[str, Any] = {}
    if name := tags.get("name"):
        out["name"] = name
    if "highway" in tags or _MEASURES.isdisjoint(tags):
        return out
    values = {"height": osm_tags.height(tags), "base": osm_tags.base(tags), "width": osm_tags.width(tags)}
    return out | {key: value for key, value in values.items() if value is not None}


def edge_properties(tags: Mapping[str, Any], heading: Literal["forward", "backward"]) -> dict[str, Any]:
    """The canonical words that a highway's tags say of its edges in one direction."""
    out: dict[str, Any] = {}
    if not _EDGE_TAGS.isdisjoint(tags):
        if limit := osm_tags.speed_limit(tags, heading):
            out["speed_limit"] = limit
        if width := osm_tags.way_width(tags):
            out["width"] = width
        out |= {key: tags[key] for key in ("surface", "access") if tags.get(key)}
    if tags.get("highway") == "steps":
        out["stairs"] = True
    return out


def _differs(now: Any, source_value: Any) -> bool:
    """Whether a canonical value says something else than the tags; one that is absent says nothing."""
    if isinstance(now, str):
        return now not in ("", source_value)
    if isinstance(now, bool) or not isinstance(now, int | float) or now <= 0:
        return False
    return not isinstance(source_value, int | float) or abs(now - source_value) > 1e-6 * now


def _number(value: Any) -> str:
    return plain(repr(round(float(value), 9))).removesuffix(".0")


def _kmh(value: float) -> str:
    return plain(f"{value * 3.6:.6g}")


def is_area(tags: Mapping[str, Any]) -> bool:
    """Whether a closed way encloses something rather than going around it."""
    if "area" in tags:
        return bool(tags["area"] != "no")
    return any(k in AREAS and tags[k] not in LINES and tags[k] != "no" for k in tags) and "barrier" not in tags


@dataclass(slots=True)
class Edges:
    """The directed edges of one way: parallel lists. segment: index of the first of the two refs."""

    segment: list[int] = field(default_factory=list)
    ids: list[str] = field(default_factory=list)
    source: list[int] = field(default_factory=list)
    target: list[int] = field(default_factory=list)


LOOP = "self_loop"
"""The tag of ways that are an edge from a node to itself, ``yes``. Without it a node twice in a row is a mistake."""


def is_loop(refs: Sequence[int], tags: Mapping[str, Any]) -> bool:
    """Whether a way is an edge from a node to itself, and not a mistake in the data."""
    return len(refs) == 2 and refs[0] == refs[1] and tags.get(LOOP) == "yes"


def way_edges(way: int, refs: Sequence[int], tags: Mapping[str, Any], absent: Set[int]) -> Edges:
    """The edges that a way means: reader and writer must agree on them, ids included. absent: nodes without a place."""
    out = Edges()
    seen: dict[str, int] = {}
    heading = direction(tags)
    loop = is_loop(refs, tags)
    forward, backward = loop or heading != "backward", not loop and heading != "forward"
    for k, (a, b) in enumerate(pairwise(refs)):
        if (a == b and not loop) or (absent and (a in absent or b in absent)):
            continue
        for is_edge, p, q in ((forward, a, b), (backward, b, a)):
            if is_edge:
                name = f"w{way}:{p}-{q}"
                times = seen[name] = seen.get(name, 0) + 1
                out.segment.append(k)
                out.ids.append(name if times == 1 else f"{name}#{times}")
                out.source.append(p)
                out.target.append(q)
    return out


# --- reading -----------------------------------------------------------------------------------------------------


def detect(name: str, data: bytes) -> bool:  # noqa: ARG001
    """By content: an ``<osm>`` root (also compressed), or a PBF header."""
    head = unpack(data[: 2**16], Limits(), limit=4096)[:4096] if data[:3] in (b"BZh", *_GZIP) else data[:4096]
    if is_pbf(head):
        return True
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        head = head.decode("utf-16", "replace").encode()
    return bool(_FIRST.match(head.lstrip(b"\xef\xbb\xbf")))


_FIRST = re.compile(rb"(?s)\s*+(?>(?:(?><\?.*?\?>|<!--.*?-->)\s*+)*)(?:<osm[\s/>]|<!DOCTYPE\s+osm\b)")
_GZIP = tuple(b"\x1f\x8b" + bytes([k]) for k in (8,))


PROLOG_BYTES = 2**14
"""Of a file's beginning, where stylesheets are named; elements of other formats are refused anywhere."""


def read(files: Files, context: ReadContext) -> Layers:
    """A highway network and all other elements as objects, on earth.

    Raises UnreadableFile, with a line where there is one, for what is no OSM file and for places that are not on earth.
    """
    topology, objects = context.wants("topology"), context.wants("objects")
    xml.report_active_content(files[context.main][:PROLOG_BYTES], context.warn, has_scripts=True)
    data = parse(files[context.main], context.limits, highways_only=not objects)
    for problem, line, location in data.problems:
        context.warn(problem, line=line, where=location)
    _check_version(data, context)
    _warn_of_values(data, context)
    document = _document(data)
    network = _Network(data, context)
    parts: dict[PartKey, Part] = {}
    if topology:
        part = network.features(document)
        if len(part):
            parts[PartKey("topology", context.level, NETWORK)] = part
    if objects:
        parts[PartKey("objects", context.level, FAMILY)] = _objects(data, network, context, document)
    elif not parts:
        nothing = from_columns((), np.empty(0, object), (), "wgs84", document)
        parts[PartKey("objects", context.level, FAMILY)] = nothing
    return Layers(parts)


def _check_version(data: Data, context: ReadContext) -> None:
    version = data.root.get("version")
    if version is None:
        if not any(row[0] == "MetaInfo" for row in data.elements):
            reason = 'the <osm> element needs a version: version="0.6"'
            raise UnreadableFile(reason, [Problem(reason, line=1, where="<osm>")])
        context.warn('the <osm> element has no version; read as "0.6"', where="<osm>")
    elif version != "0.6":
        context.warn(f"OSM version {version} is read as 0.6", where="<osm>")


def _document(data: Data) -> dict[str, Any]:
    source_document: dict[str, Any] = {"attributes": data.root}
    if data.bounds:
        source_document["bounds"] = data.bounds
    if data.elements:
        source_document["elements"] = data.elements
    document: dict[str, Any] = {"osm": source_document}
    boxes = [box for box in map(_box, data.bounds) if box is not None]
    if boxes:
        document["bounds"] = list(_bounding_box(boxes))
    texts = [data.root[k] for k in ("copyright", "attribution", "license") if data.root.get(k)]
    texts += [row[2] for row in data.elements if row[0] == "note" and row[2]]
    if texts:
        document["attribution"] = texts
    return document


def _box(attributes: Mapping[str, str]) -> tuple[float, float, float, float] | None:
    """[west, south, east, north] of a ``<bounds>``, or of the older ``<bound box="s,w,n,e">``."""
    names = ("minlon", "minlat", "maxlon", "maxlat")
    if all(k in attributes for k in names):
        texts = [attributes[k] for k in names]
    elif attributes.get("box", "").count(",") == 3:
        south, west, north, east = attributes["box"].split(",")
        texts = [west, south, east, north]
    else:
        return None
    west_, south_, east_, north_ = (float(t) for t in texts)
    if not (-180 <= west_ <= 180 and -180 <= east_ <= 180 and -90 <= south_ <= north_ <= 90):
        reason = f"the bounds {', '.join(texts)} are no box on earth"
        raise UnreadableFile(reason, [Problem(reason, where="<bounds>")])
    return west_, south_, east_, north_


def _warn_of_values(data: Data, context: ReadContext) -> None:
    """Report the values that would say a size or a speed and are none, each with how often; the tags are kept."""
    occurrences: dict[tuple[str, str], list[Any]] = {}
    tagged = chain(((f"way {w.id}", w.tags) for w in data.ways), ((k, tags) for k, tags in data.tags.items()))
    for place, tags in tagged:
        for key in osm_tags.NUMERIC_KEYS & tags.keys():
            if key not in _OF_WAYS or "highway" in tags:
                occurrences.setdefault((key, tags[key]), [place, 0])[1] += 1
    for (key, value), (place, count) in occurrences.items():
        if not osm_tags.is_understood(key, value):
            location = place if isinstance(place, str) else f"node {data.ids[place]}"
            often = f" ({count} times)" if count > 1 else ""
            reason = f"the tag {key}={str(value)[:40]!r} is not understood: kept without effect{often}"
            context.warn(reason, where=location)


_OF_WAYS = frozenset({"lanes", "maxspeed", "maxspeed:forward", "maxspeed:backward"})
"""Keys that are read for highways only."""


class _Network:
    """Which nodes and ways are the highway network.

    place: node id -> its place in the columns, of the last node with that id. used: ids of the network's nodes.
    """

    def __init__(self, data: Data, context: ReadContext) -> None:
        self.data = data
        self.place = {identity: k for k, identity in enumerate(data.ids)}
        if len(self.place) != len(data.ids):
            _warn_twice("node", data.ids, context)
        ways = {way.id: way for way in data.ways}
        if len(ways) != len(data.ways):
            _warn_twice("way", [way.id for way in data.ways], context)
        self.ways = list(ways.values())
        missing_ids = (
            set(np.array(data.ids, np.int64)[np.isnan(data.lonlat[:, 0])].tolist()) if len(data.ids) else set()
        )
        self.placed = self.place.keys() - missing_ids if missing_ids else self.place.keys()
        self.highways: list[tuple[Way, Edges]] = []
        used: dict[int, None] = {}
        absent_ids: set[int] = set()
        for way in self.ways:
            if "highway" not in way.tags:
                continue
            if is_deleted(way.attributes):
                context.warn("the way is marked as deleted, so it is no part of the network", where=f"way {way.id}")
                continue
            self._report_doubts(way, context)
            present = [r for r in way.refs if r in self.placed]
            absent = set(way.refs) - set(present) if len(present) < len(way.refs) else set()
            used.update(dict.fromkeys(present))
            self.highways.append((way, way_edges(way.id, way.refs, way.tags, absent)))
            absent_ids.update(absent)
        self.used = used
        if absent_ids:
            examples = ", ".join(map(str, sorted(absent_ids)[:5]))
            context.warn(
                f"highways use {len(absent_ids)} nodes that have no place in the file ({examples}); gaps are left there"
            )

    def _report_doubts(self, way: Way, context: ReadContext) -> None:
        location = f"way {way.id}"
        if not is_loop(way.refs, way.tags) and any(a == b for a, b in pairwise(way.refs)):
            context.warn("the way goes from a node to itself; that segment is no edge", where=location)
        oneway = str(way.tags.get("oneway", "no")).strip().lower()
        if oneway not in _FORWARD and oneway not in _BACKWARD and oneway not in _NO:
            context.warn(f"oneway={oneway[:40]} is not known; the way is taken as two-way", where=location)

    def features(self, document: Properties) -> Features:
        data = self.data
        indices = sorted(self.place[i] for i in self.used)
        ids = [f"n{data.ids[k]}" for k in indices]
        pattern, plain_edge = shared_key_dict("kind", "osm"), shared_key_dict("kind", "source", "target", "osm")
        properties: list[Properties] = []
        for k in indices:
            node = pattern.copy()
            node["kind"], node["osm"] = "node", _node_properties(data, k)
            properties.append(node)
        name_of = dict(zip((data.ids[k] for k in indices), ids, strict=True))
        source: list[int] = []
        target: list[int] = []
        for way, edges in self.highways:
            source_properties = {"way": way.id, "tags": way.tags}
            ids += edges.ids
            source += edges.source
            target += edges.target
            forth, back = edge_properties(way.tags, "forward"), edge_properties(way.tags, "backward")
            refs = way.refs
            for k, a, b in zip(edges.segment, edges.source, edges.target, strict=True):
                attributes = forth if forth == back or refs[k] == a else back
                if attributes:
                    edge = {
                        "kind": "edge",
                        "source": name_of[a],
                        "target": name_of[b],
                        **attributes,
                        "osm": source_properties,
                    }
                else:
                    edge = plain_edge.copy()
                    edge["kind"], edge["source"], edge["target"], edge["osm"] = (
                        "edge",
                        name_of[a],
                        name_of[b],
                        source_properties,
                    )
                properties.append(edge)
        geometry = points(data.lonlat[indices]) if indices else np.empty(0, object)
        if source:
            start = np.fromiter(map(self.place.__getitem__, source), np.intp, len(source))
            end = np.fromiter(map(self.place.__getitem__, target), np.intp, len(target))
            geometry = np.concatenate([geometry, segments(data.lonlat[start], data.lonlat[end])])
        about = {k: document[k] for k in ("bounds", "attribution") if k in document}
        return from_columns(ids, geometry, properties, "wgs84", about)


def _warn_twice(noun: str, ids: list[int], context: ReadContext) -> None:
    seen: set[int] = set()
    for identity in ids:
        if identity in seen:
            context.warn("the id stands more than once in the file; the last one counts", where=f"{noun} {identity}")
        seen.add(identity)


_ATTRIBUTES_ONLY = shared_key_dict("attributes")


def _node_properties(data: Data, k: int) -> dict[str, Any]:
    tags, attributes = data.tags.get(k), data.attributes(k)
    source_properties: dict[str, Any]
    if attributes and not tags:
        source_properties = _ATTRIBUTES_ONLY.copy()
        source_properties["attributes"] = attributes
    else:
        source_properties = {"tags": tags} if tags else {}
        if attributes:
            source_properties["attributes"] = attributes
    if children := data.node_children.get(k):
        source_properties["children"] = children
    return source_properties


def _properties(source_properties: dict[str, Any], tags: Tags, otherwise: str) -> Properties:
    if not tags:
        return {"kind": otherwise, "osm": source_properties}
    return {"kind": object_kind(tags, otherwise), **object_properties(tags), "osm": source_properties}


def _objects(data: Data, network: _Network, context: ReadContext, document: Properties) -> Features:
    """Tagged and lone nodes, ways and relations as features, in the file's order."""
    index_by_id = network.place
    relations = {r.id: r for r in data.relations}
    if len(relations) != len(data.relations):
        _warn_twice("relation", [r.id for r in data.relations], context)
    flat = list(chain.from_iterable(way.refs for way in network.ways))
    bent = set(flat)
    members = {i for r in data.relations for kind, i, _ in r.members if kind == "node"}
    nodes = []
    for identity, k in index_by_id.items():
        if identity in network.used:
            continue
        lone = identity not in bent or k in data.tags or identity in members or identity not in network.placed
        if lone or k in data.node_children or is_deleted(data.attributes(k)):
            nodes.append(k)
            if identity not in network.placed:
                context.warn("the node has no place", where=f"node {identity}")
    features = {data.ids[k] for k in nodes} | network.used.keys()
    ids = [f"n{data.ids[k]}" for k in nodes]
    properties = [_properties(_node_properties(data, k), data.tags.get(k, {}), "point") for k in nodes]
    geometry = np.empty(len(nodes), object)
    at = data.lonlat[nodes] if nodes else np.empty((0, 2))
    has_position = ~np.isnan(at[:, 0])
    geometry[has_position] = points(at[has_position])
    geometry[~has_position] = NO_GEOMETRY
    dangling = 0
    index = np.fromiter((index_by_id.get(r, -1) for r in flat), np.intp, len(flat))
    lonlat = np.concatenate([data.lonlat, np.full((1, 2), np.nan)])[index]
    absent = np.isnan(lonlat[:, 0])
    begin = 0
    for way in network.ways:
        end = begin + len(way.refs)
        source_properties: dict[str, Any] = {"refs": way.refs, "tags": way.tags}
        if way.attributes:
            source_properties["attributes"] = way.attributes
        if absent[begin:end].any():
            missing = np.flatnonzero(absent[begin:end]).tolist()
            source_properties["missing"] = missing
            dangling += len(missing)
        if vertices := _vertices(data, way.refs, index[begin:end].tolist(), features):
            source_properties["vertices"] = vertices
        if way.children:
            source_properties["children"] = way.children
        if not way.refs:
            context.warn("the way has no nodes", where=f"way {way.id}")
        properties.append(_properties(source_properties, way.tags, "line"))
        begin = end
    if dangling:
        context.warn(f"ways refer {dangling} times to nodes that have no place in the file; the references are kept")
    ids += [f"w{way.id}" for way in network.ways]
    shapes = _way_geometries(network.ways, lonlat, absent)
    for relation in relations.values():
        source_properties = {"members": [list(m) for m in relation.members], "tags": relation.tags}
        if relation.attributes:
            source_properties["attributes"] = relation.attributes
        if relation.children:
            source_properties["children"] = relation.children
        properties.append(_properties(source_properties, relation.tags, "relation"))
    ids += [f"r{i}" for i in relations]
    nothing = np.full(len(relations), NO_GEOMETRY, object)
    part = from_columns(ids, np.concatenate([geometry, shapes, nothing]), properties, "wgs84", document)
    areas = multipolygon_areas(part, range(len(ids) - len(relations), len(ids)))
    if open_ := [part.ids[k][1:] for k, area in areas.items() if area is None]:
        examples = ", ".join(open_[:5]) + (" …" if len(open_) > 5 else "")
        context.warn(
            f"{len(open_)} multipolygons have no area, since ways are missing or rings do not close: {examples}"
        )
    with_area = part.geometry.copy()
    for k, area in areas.items():
        with_area[k] = area or NO_GEOMETRY
    return replace(part, geometry=with_area)


def _vertices(data: Data, refs: list[int], index: list[int], features: set[int]) -> Any:
    """The attributes of a way's nodes that are no features: one mapping where all agree, else a list like refs."""
    rows = [None if k < 0 or r in features else data.attributes(k) for r, k in zip(refs, index, strict=True)]
    entries = [row for row in rows if row is not None]
    if not entries or not any(entries):
        return None
    first = entries[0]
    return first if all(row is first or row == first for row in entries) else rows


def _way_geometries(ways: list[Way], lonlat: NDArray[np.float64], absent: NDArray[np.bool_]) -> NDArray[np.object_]:
    """For each way the line, area, point or nothing that its nodes with a place make."""
    owner = np.repeat(np.arange(len(ways)), [len(way.refs) for way in ways])[~absent]
    lonlat = lonlat[~absent]
    size = np.bincount(owner, minlength=len(ways))
    out = np.full(len(ways), NO_GEOMETRY, object)
    area = np.array([w.refs[:1] == w.refs[-1:] and len(w.refs) > 3 and is_area(w.tags) for w in ways], bool)
    first = np.cumsum(size) - size
    closed = area & (size > 3)
    if len(lonlat):
        ends = np.clip(first + size - 1, 0, len(lonlat) - 1)
        closed &= (lonlat[np.clip(first, 0, len(lonlat) - 1)] == lonlat[ends]).all(axis=1)
    for mask, make in ((closed, shapely.linearrings), (~closed & (size > 1), shapely.linestrings)):
        if mask.any():
            rows = mask[owner]
            number = np.cumsum(mask) - 1
            shapes = make(lonlat[rows], indices=number[owner[rows]])
            out[mask] = shapely.polygons(shapes) if make is shapely.linearrings else shapes
    single = np.flatnonzero(size == 1)
    out[single] = points(lonlat[first[single]])
    return out


# --- writing -----------------------------------------------------------------------------------------------------

MAX_WAY_NODES = 2000
"""Nodes a way may have (OSM API 0.6)."""

NO_POSITION = (float("nan"), float("nan"))


@dataclass(slots=True)
class _Level:
    """What is being written of one level. nodes: feature id -> OSM id. edges: id -> (source, target, tags,
    properties)."""

    name: str
    nodes: dict[str, int] = field(default_factory=dict)
    moved: dict[int, int] = field(default_factory=dict)
    edges: dict[str, tuple[str, str, Mapping[str, str] | None, Properties]] = field(default_factory=dict)
    explained: set[str] = field(default_factory=set)
    ways: dict[int, list[int]] = field(default_factory=dict)
    relations: dict[int, int] = field(default_factory=dict)
    has_network: bool = False


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """``map.osm``. Raises MissingDatum where anything is in metres and there is no datum."""
    out = _Writer(layers, context)
    levels = list(dict.fromkeys(key.level for key in sorted(layers.parts)))
    for level in sorted(levels, key=lambda name: (name != GROUND, name)):
        out.level(level)
    for key, part in sorted(layers.parts.items()):
        if key.layer not in CARRIES and isinstance(part, Features) and key.layer == "location":
            context.drop("GNSS fence", len(part), "OSM has no word for it; its box is the map's bounds")
    if layers.datum is not None:
        context.drop("datum", 1, "OSM places stand on earth and have no local frame")
    return {"map.osm": out.text()}


class _Writer:
    def __init__(self, layers: Layers, context: WriteContext) -> None:
        self.layers = layers
        self.context = context
        self.nodes: dict[int, Node] = {}
        self.ways: dict[int, tuple[list[int], Mapping[str, str], Mapping[str, str]]] = {}
        self.relations: dict[int, tuple[list[tuple[str, int, str]], Mapping[str, str], Mapping[str, str]]] = {}
        rows = (p for part in layers.vector("objects").values() for p in part.properties)
        own_items = [p for p in rows if isinstance(p.get("osm"), Mapping)]
        refs = [refs for p in own_items if (refs := integers(p["osm"].get("refs")))]
        identities = [element_id(i) for part in layers.parts.values() if isinstance(part, Features) for i in part.ids]
        lowest = min(chain([0], (min(r) for r in refs), (k[1] for k in identities if k)))
        self.next = {"node": lowest - 1, "way": lowest - 1, "relation": lowest - 1}
        self.referenced = set(chain.from_iterable(refs))
        self.lost: dict[str, int] = {}
        self.children: dict[tuple[str, int], Any] = {}

    def next_id(self, kind: str) -> int:
        new = self.next[kind]
        self.next[kind] = new - 1
        return new

    def unknown(self, kind: str, number: int, source_properties: Mapping[str, Any]) -> None:
        """Keep the elements inside an element that OSM does not know."""
        if source_properties.get("children"):
            self.children[kind, number] = source_properties["children"]

    def lose(self, item: str, times: int = 1) -> None:
        self.lost[item] = self.lost.get(item, 0) + times

    # --- one level ---

    def level(self, name: str) -> None:
        level = _Level(name)
        drawn: set[Any] = set()
        topology = list(self.layers.vector("topology", name).values())
        for part in topology:
            self.network_nodes(part, level)
            drawn.update(i for p in part.properties if isinstance(i := p.get("drawn_from"), str))
        new_items: list[tuple[str, Any, Properties, bool]] = []
        own_items: list[tuple[str, int, Any, Mapping[str, Any], Mapping[str, Any]]] = []
        for layer in ("objects", "zones"):
            for key, part in self.layers.vector("objects" if layer == "objects" else "zones", name).items():
                for i, geometry, properties in zip(
                    part.ids, part.in_wgs84(self.layers.frame), part.properties, strict=True
                ):
                    number, source_properties = element_id(i), properties.get("osm")
                    if layer == "objects" and key.name == FAMILY and number and isinstance(source_properties, Mapping):
                        current = _object_tags(source_properties, properties, i)
                        own_items.append((number[0], number[1], geometry, current, properties))
                    elif i in drawn and shapely.get_type_id(geometry) in (0, 1, 2, 5):
                        # The network made from this drawing is written; the line would lie on it a second time.
                        continue
                    else:
                        new_items.append((i, geometry, properties, layer == "zones"))
        for kind, osm_id, geometry, source_properties, _ in own_items:
            if kind == "n":
                self.node(level, osm_id, geometry, source_properties)
        for kind, osm_id, geometry, source_properties, properties in own_items:
            if kind == "w" and not self.write_way(level, osm_id, geometry, source_properties):
                new_items.append((f"w{osm_id}", geometry, properties, False))
        for kind, osm_id, _, _, _ in own_items:
            if kind == "r":
                level.relations[osm_id] = self.next_id("relation") if osm_id in self.relations else osm_id
                self.relations[level.relations[osm_id]] = ([], NO_ATTRIBUTES, NO_ATTRIBUTES)
        for kind, osm_id, _, source_properties, _ in own_items:
            if kind == "r":
                self.relation(level, osm_id, source_properties)
        for part in topology:
            self.add_ways(part, level)
        for i, geometry, properties, zone in new_items:
            self.other(level, i, geometry, properties, zone)

    def network_nodes(self, part: Features, level: _Level) -> None:
        level.has_network = True
        is_node = np.array([p.get("kind") != "edge" for p in part.properties], bool)
        indices = np.flatnonzero(is_node)
        at = part.select(indices).in_wgs84(self.layers.frame) if len(indices) else np.empty(0, object)
        has_point = (shapely.get_type_id(at) == 0) & ~shapely.is_empty(at)
        places = np.full((len(at), 2), np.nan)
        places[has_point] = shapely.get_coordinates(at[has_point])
        lon, lat = places.T.tolist()
        for k, x, y, geometry in zip(indices.tolist(), lon, lat, at, strict=True):
            i, properties = part.ids[k], part.properties[k]
            source_properties = properties.get("osm")
            number = element_id(i)
            is_own = (
                number is not None
                and number[0] == "n"
                and (isinstance(source_properties, Mapping) or number[1] in self.referenced)
            )
            new = number[1] if is_own and number is not None else self.next_id("node")
            if new in self.nodes and (self.nodes[new].lon, self.nodes[new].lat) != (x, y):
                new = self.next_id("node")
            if isinstance(source_properties, Mapping):
                tags, attributes = (
                    as_texts(source_properties.get("tags")),
                    as_texts(source_properties.get("attributes")),
                )
                self.unknown("node", new, source_properties)
            else:
                # A street node that went through another format is called by its id there: that is no name.
                nameless = is_own and properties.get("name", i) == i
                tags, attributes = NO_ATTRIBUTES if nameless else self.tags(i, properties, ("name",)), NO_ATTRIBUTES
            if geometry.has_z and geometry.geom_type == "Point" and not geometry.is_empty and "ele" not in tags:
                tags = {**tags, "ele": repr(float(geometry.z))}
            self.nodes[new] = Node(x, y, tags, attributes)
            level.nodes[i] = new
            if is_own and number is not None:
                level.moved[number[1]] = new
        for k in np.flatnonzero(~is_node).tolist():
            p = part.properties[k]
            source_properties = p.get("osm")
            tags_ = source_properties.get("tags") if isinstance(source_properties, Mapping) else None
            level.edges[part.ids[k]] = (
                str(p.get("source")),
                str(p.get("target")),
                tags_ if isinstance(tags_, Mapping) else None,
                p,
            )

    def node(self, level: _Level, number: int, geometry: Any, source_properties: Mapping[str, Any]) -> None:
        if number in level.moved:
            return
        x, y = (geometry.x, geometry.y) if geometry.geom_type == "Point" and not geometry.is_empty else NO_POSITION
        new = number
        if number in self.nodes and (self.nodes[number].lon, self.nodes[number].lat) != (x, y):
            new = self.next_id("node")
        self.nodes[new] = Node(
            x, y, as_texts(source_properties.get("tags")), as_texts(source_properties.get("attributes"))
        )
        level.moved[number] = new
        self.unknown("node", new, source_properties)

    def write_way(self, level: _Level, number: int, geometry: Any, source_properties: Mapping[str, Any]) -> bool:
        """Write an OSM way; False where its properties or its geometry are no longer those of one."""
        refs = integers(source_properties.get("refs"))
        at = _course(geometry)
        if refs is None or at is None:
            return False
        tags, attributes = as_texts(source_properties.get("tags")), as_texts(source_properties.get("attributes"))
        missing = set(integers(source_properties.get("missing")) or ())
        first = self.next_id("way") if number in self.ways else number
        if level.has_network and "highway" in tags and not is_deleted(attributes):
            runs = self.runs(level, number, refs, tags, {refs[k] for k in missing if 0 <= k < len(refs)})
        else:
            runs = [(0, len(refs), tags)]
        written: list[int] = []
        for begin, end, run_tags in runs:
            new = self.next_id("way") if written else first
            complete = end - begin == len(refs)
            nodes = self.bend(level, refs, at, missing, source_properties.get("vertices"), range(begin, end))
            self.ways[new] = (nodes, run_tags, attributes if complete or not written else NO_ATTRIBUTES)
            written.append(new)
        if written:
            self.unknown("way", written[0], source_properties)
        else:
            self.lose("ways whose edges are no longer in the network")
        level.ways[number] = written
        return True

    def runs(
        self, level: _Level, number: int, refs: list[int], tags: Mapping[str, str], absent: set[int]
    ) -> list[tuple[int, int, Mapping[str, str]]]:
        """The pieces of a highway way that the network still has: (first, one past the last index of refs, tags)."""
        expected = way_edges(number, refs, tags, absent)
        # Of each segment: the directions that are there, of those that the way means, and the tags if they differ.
        headings_by_segment: dict[int, tuple[set[str], Any]] = {}
        edited: dict[int, dict[str, dict[str, Any]]] = {}
        cache: dict[tuple[int, str], Mapping[str, Any]] = {}
        edge_counts: dict[int, int] = {}
        for k, i, a, b in zip(expected.segment, expected.ids, expected.source, expected.target, strict=True):
            edge_counts[k] = edge_counts.get(k, 0) + 1
            edge = level.edges.get(i)
            if edge is not None and edge[0] == f"n{a}" and edge[1] == f"n{b}":
                level.explained.add(i)
                headings, other = headings_by_segment.get(k, (set(), None))
                heading: Literal["forward", "backward"] = "forward" if a == refs[k] else "backward"
                headings.add(heading)
                other = edge[2] if edge[2] is not None and edge[2] != tags else other
                headings_by_segment[k] = (headings, other)
                own_tags = tags if edge[2] is None else edge[2]
                values = cache.get((id(own_tags), heading))
                if values is None:
                    values = cache[id(own_tags), heading] = edge_properties(as_texts(own_tags), heading)
                new = {w: v for w in _EDGE_WORDS if _differs(v := edge[3].get(w), values.get(w))}
                if new:
                    edited.setdefault(k, {})[heading] = new
        for k, changes in edited.items():
            headings, other = headings_by_segment[k]
            headings_by_segment[k] = (
                headings,
                _way_tags(tags if other is None else as_texts(other), changes, headings),
            )
        if all(
            k in headings_by_segment and len(headings_by_segment[k][0]) == n and headings_by_segment[k][1] is None
            for k, n in edge_counts.items()
        ):
            return [(0, len(refs), tags)]
        out: list[tuple[int, int, Mapping[str, str]]] = []
        state: Any = None
        for k in range(len(refs) - 1):
            if k in edge_counts and k not in headings_by_segment:
                state = None
                continue
            values = tags
            if k in headings_by_segment:
                headings, other = headings_by_segment[k]
                values = as_texts(other) if other is not None else tags
                if len(headings) < edge_counts[k]:
                    values = {**values, "oneway": "yes" if "forward" in headings else "-1"}
            elif state is not None:
                values = state
            if state is not None and values == state and out:
                out[-1] = (out[-1][0], k + 2, values)
            else:
                out.append((k, k + 2, values))
            state = values
        return out

    def bend(
        self,
        level: _Level,
        refs: list[int],
        at: NDArray[np.float64],
        missing: set[int],
        vertices: Any,
        span: range,
    ) -> list[int]:
        """The node ids of (part of) a way, making those that exist nowhere but in the way."""
        located = len(refs) - len(missing)
        if located != len(at):
            return self.redraw(level, refs, at)
        attributes = vertices if isinstance(vertices, list) and len(vertices) == len(refs) else [vertices] * len(refs)
        places = at.tolist()
        out, j = [], 0
        for k, ref in enumerate(refs):
            position = None
            if k not in missing:
                position = places[j]
                j += 1
            if k not in span:
                continue
            new = level.moved.get(ref, ref)
            node = self.nodes.get(new)
            if position is not None:
                if node is None:
                    self.nodes[new] = Node(
                        position[0], position[1], NO_ATTRIBUTES, as_texts(attributes[k]), vertex=True
                    )
                elif node.vertex and (node.lon != position[0] or node.lat != position[1]):
                    # Two ways no longer agree where their common node is: each keeps its course.
                    new = self.next_id("node")
                    self.nodes[new] = Node(position[0], position[1], vertex=True)
            out.append(new)
        return out

    def redraw(self, level: _Level, refs: list[int], at: NDArray[np.float64]) -> list[int]:
        """Nodes for a way whose geometry was edited: its own where one stands at a vertex, else new ones."""
        node_ids = {}
        for ref in refs:
            node = self.nodes.get(level.moved.get(ref, ref))
            if node is not None:
                node_ids[node.lon, node.lat] = level.moved.get(ref, ref)
        out = []
        for x, y in at.tolist():
            if (x, y) not in node_ids:
                node_ids[x, y] = new = self.next_id("node")
                self.nodes[new] = Node(x, y, vertex=True)
            out.append(node_ids[x, y])
        return out

    def relation(self, level: _Level, number: int, source_properties: Mapping[str, Any]) -> None:
        members: list[tuple[str, int, str]] = []
        rows = source_properties.get("members")
        for row in rows if isinstance(rows, list) else []:
            if not (isinstance(row, list | tuple) and len(row) == 3 and type(row[1]) is int and abs(row[1]) < INT64):
                self.lose("relation members that are not [type, id, role]")
                continue
            kind, i, role = str(row[0]), row[1], str(row[2])
            if kind == "way" and i in level.ways:
                members += [(kind, new, role) for new in level.ways[i]]
                if not level.ways[i]:
                    self.lose("relation members whose way is no longer in the network")
            elif kind == "node":
                members.append((kind, level.moved.get(i, i), role))
            elif kind == "relation":
                members.append((kind, level.relations.get(i, i), role))
            else:
                members.append((kind, i, role))
        self.unknown("relation", level.relations[number], source_properties)
        tags, attributes = as_texts(source_properties.get("tags")), as_texts(source_properties.get("attributes"))
        self.relations[level.relations[number]] = (members, tags, attributes)

    def add_ways(self, part: Features, level: _Level) -> None:
        """Edges that no way explains, joined to lines where they follow each other and say the same."""
        left = [
            k
            for k, (i, p) in enumerate(zip(part.ids, part.properties, strict=True))
            if p.get("kind") == "edge" and i not in level.explained
        ]
        if not left:
            return
        features = part.select(left)
        pairs: dict[tuple[int, int], list[int]] = {}
        signs: list[tuple[Any, ...]] = []
        for k, (i, p) in enumerate(zip(features.ids, features.properties, strict=True)):
            a, b = level.nodes.get(str(p.get("source"))), level.nodes.get(str(p.get("target")))
            tags = self.edge_tags(i, p, level)
            signs.append((p.get("drawn_from"), tuple(sorted(tags.items()))))
            if a is None or b is None:
                self.lose("edges without both nodes")
            else:
                pairs.setdefault((a, b), []).append(k)
        course: Any = None
        line: list[int] = []
        state: tuple[Any, ...] | None = None
        for (a, b), edges in pairs.items():
            for n, k in enumerate(edges):
                if k < 0:
                    continue
                back = pairs.get((b, a), []) if a != b else []
                twin = n < len(back) and back[n] >= 0 and signs[back[n]] == signs[k]
                if twin:
                    back[n] = -1
                if course is None and shapely.get_num_coordinates(features.geometry).max() > 2:
                    course = features.in_wgs84(self.layers.frame)
                nodes = [a, *self.inner(course[k] if course is not None else None), b]
                sign = (*signs[k], twin)
                if nodes == [a, a]:  # by itself: within a line it would be a node that stands twice
                    self.ways[self.next_id("way")] = (
                        nodes,
                        {**dict(signs[k][1]), "oneway": "yes", LOOP: "yes"},
                        NO_ATTRIBUTES,
                    )
                elif sign == state and line[-1] == a and len(line) + len(nodes) <= MAX_WAY_NODES:
                    line += nodes[1:]
                elif sign == state and twin and line[-1] == b and len(line) + len(nodes) <= MAX_WAY_NODES:
                    line += nodes[-2::-1]
                else:
                    line, state = nodes, sign
                    tags = dict(signs[k][1])
                    if not twin:
                        tags["oneway"] = "yes"
                    elif direction(tags) != "both":
                        tags["oneway"] = "no"
                    self.ways[self.next_id("way")] = (line, tags, NO_ATTRIBUTES)

    def inner(self, geometry: Any) -> list[int]:
        """New nodes for what an edge bends over between its ends."""
        if geometry is None or geometry.geom_type != "LineString":
            return []
        out = []
        for x, y in shapely.get_coordinates(geometry)[1:-1].tolist():
            out.append(self.next_id("node"))
            self.nodes[out[-1]] = Node(x, y, vertex=True)
        return out

    def edge_tags(self, i: str, p: Properties, level: _Level) -> dict[str, str]:
        source_properties = p.get("osm")
        if isinstance(source_properties, Mapping) and isinstance(source_properties.get("tags"), Mapping):
            own_tags = {k: v for k, v in as_texts(source_properties["tags"]).items() if k != "oneway"}
            limits = {own_tags.pop(k, None) for k in ("maxspeed:forward", "maxspeed:backward")} - {None}
            values = edge_properties(own_tags, "forward")
            new = {w: v for w in _EDGE_WORDS if _differs(v := p.get(w), values.get(w))}
            if limits and "speed_limit" not in new and "maxspeed" not in own_tags:
                new["speed_limit"] = min((v for v in map(osm_tags.speed, limits) if v), default=None)
            return dict(_way_tags(own_tags, {"forward": {w: v for w, v in new.items() if v}}, {"forward"}))
        tags = {"highway": "path"}
        for member, key in (("name", "name"), ("action", "action"), ("width", "width")):
            value = p.get(member)
            if isinstance(value, str | int | float) and not isinstance(value, bool) and value != i:
                tags[key] = str(value)
        speed = p.get("speed_limit")
        if isinstance(speed, int | float) and not isinstance(speed, bool):
            tags["maxspeed"] = _kmh(speed)
        tags |= {w: v for w in ("surface", "access") if isinstance(v := p.get(w), str) and v}
        if p.get("stairs") is True:
            tags["highway"] = "steps"
        if level.name != GROUND:
            tags["level"] = level.name
        more = {"kind", "source", "target", "drawn_from", "name", "action", *_EDGE_WORDS, "stairs"}
        if p.keys() - more:
            self.lose("edges' further properties")
        return tags

    # --- items of other formats ---

    def tags(self, i: str, p: Properties, keys: Iterable[str] = (), level: str = GROUND) -> dict[str, str]:
        """Tags for an item that OSM does not know: its name, and the plain values among these words (or all)."""
        tags = {"name": str(p.get("name") or i)}
        names = list(keys) or [k for k in p if k not in ("drawn_from",)]
        for k in names:
            value = p.get(k)
            if isinstance(value, bool):
                tags[k] = "yes" if value else "no"
            elif isinstance(value, str | int | float):
                tags[k] = str(value)
        if any(isinstance(v, Mapping | list | tuple) for v in p.values()):
            self.lose("nested properties of items from other formats")
        if level != GROUND:
            tags.setdefault("level", level)
        return {k: v for k, v in tags.items() if k and v}

    def other(self, level: _Level, i: str, geometry: Any, properties: Properties, zone: bool) -> None:
        tags = self.tags(i, properties, level=level.name)
        source_properties = properties.get("osm")
        if isinstance(source_properties, Mapping):
            tags = {**as_texts(source_properties.get("tags")), **tags}
        if zone:
            tags["zone"] = str(properties.get("kind") or "yes")
        parts = _simple(geometry)
        if not parts:
            self.lose("items without a geometry")
        rings: list[tuple[int, str]] = []
        areas = [p for p in parts if p.geom_type == "Polygon"]
        single = len(areas) == 1 and not len(areas[0].interiors)
        for part in parts:
            if part.geom_type == "Point":
                x, y = part.x, part.y
                self.nodes[self.next_id("node")] = Node(x, y, tags)
            elif part.geom_type == "Polygon" and not single:
                rings.append((self.line(part.exterior, NO_ATTRIBUTES), "outer"))
                rings += [(self.line(r, NO_ATTRIBUTES), "inner") for r in part.interiors]
            elif part.geom_type == "Polygon":
                self.line(part.exterior, {**tags, "area": "yes"})
            else:
                self.line(part, tags)
        if rings:
            members = [("way", number, role) for number, role in rings]
            self.relations[self.next_id("relation")] = (members, {**tags, "type": "multipolygon"}, NO_ATTRIBUTES)

    def line(self, geometry: Any, tags: Mapping[str, str]) -> int:
        """A way along a line or ring, with nodes of its own. A line too long for one way goes on in further ones."""
        at = shapely.get_coordinates(geometry).tolist()
        nodes = []
        for x, y in at[:-1]:
            nodes.append(self.next_id("node"))
            self.nodes[nodes[-1]] = Node(x, y, vertex=True)
        if at[0] == at[-1] and len(at) > 2:
            nodes.append(nodes[0])
        else:
            nodes.append(self.next_id("node"))
            self.nodes[nodes[-1]] = Node(at[-1][0], at[-1][1], vertex=True)
        first = self.next_id("way")
        self.ways[first] = (nodes[:MAX_WAY_NODES], tags, NO_ATTRIBUTES)
        for begin in range(MAX_WAY_NODES - 1, len(nodes) - 1, MAX_WAY_NODES - 1):
            self.ways[self.next_id("way")] = (nodes[begin : begin + MAX_WAY_NODES], tags, NO_ATTRIBUTES)
        return first

    # --- XML ---

    def text(self) -> bytes:
        for item, times in sorted(self.lost.items()):
            self.context.drop(item, times, "OSM has no place for them")
        return xml_text.document(self.head(), self.nodes, self.ways, self.relations, self.children)

    def head(self) -> list[str]:
        documents = [p.document for p in self.layers.parts.values() if isinstance(p, Features)]
        source_documents = [d["osm"] for d in documents if isinstance(d.get("osm"), Mapping)]
        root: dict[str, str] = {"version": "0.6", "generator": GENERATOR}
        for one in source_documents:
            root |= as_texts(one.get("attributes"))
        root["version"] = "0.6"
        if self.context.attribution and not root.keys() & {"attribution", "copyright", "license"}:
            root["attribution"] = "; ".join(self.context.attribution)
        lines = [f"<osm{attribute_text(root, frozenset())}>"]
        for one in source_documents:
            lines += xml_text.element_lines(one.get("elements"))
        boxes = [d["bounds"] for d in documents if _is_box(d.get("bounds"))]
        if not boxes:
            boxes = self.fence()
        if boxes:
            source_bounds = [as_texts(b) for one in source_documents for b in one.get("bounds") or []]
            lines += [f" <bounds{attribute_text(box, frozenset())}/>" for box in _bounds(source_bounds, boxes)]
        return lines

    def fence(self) -> list[list[float]]:
        """The boxes of the sites, where they can be had on earth."""
        out: list[list[float]] = []
        for part in self.layers.vector("location").values():
            if self.layers.frame is not None or not part.local.any():
                boxes = shapely.bounds(part.in_wgs84(self.layers.frame))
                out += boxes[~np.isnan(boxes).any(axis=1)].tolist()
        return out


_EDGE_WORDS = ("speed_limit", "width", "surface", "access")


def _object_tags(source_properties: Mapping[str, Any], p: Properties, i: str) -> Mapping[str, Any]:
    """An object's own words with the tags that its name and measures say now. A highway's are its edges'."""
    tags = as_texts(source_properties.get("tags"))
    if "highway" in tags:
        return source_properties
    values = object_properties(tags)
    new = {w: v for w in _SPOKEN if _differs(v := p.get(w), values.get(w)) and v != i}
    if not new:
        return source_properties
    new_tags = {_SPOKEN[w]: v if isinstance(v, str) else _number(v) for w, v in new.items()}
    return {**source_properties, "tags": {**tags, **new_tags}}


def _way_tags(
    tags: Mapping[str, str], changes: Mapping[str, Mapping[str, Any]], headings: Set[str]
) -> Mapping[str, str]:
    """A highway's tags with the words that its edges say now. changes: by direction; ways: those that are there."""
    out = dict(tags)
    limits = {heading: new["speed_limit"] for heading, new in changes.items() if "speed_limit" in new}
    if limits and limits.keys() == headings and len(set(limits.values())) == 1:
        for key in ("maxspeed:forward", "maxspeed:backward"):
            out.pop(key, None)
        out["maxspeed"] = _kmh(next(iter(limits.values())))
    else:
        out |= {f"maxspeed:{heading}": _kmh(limit) for heading, limit in sorted(limits.items())}
    for new in changes.values():
        out |= {w: v if isinstance(v, str) else _number(v) for w, v in new.items() if w != "speed_limit"}
    return out


def _course(geometry: Any) -> NDArray[np.float64] | None:
    """The vertices of a way's geometry; None where it is not of one piece."""
    is_path = geometry.geom_type in ("LineString", "LinearRing", "Point") or geometry.is_empty
    if is_path or (geometry.geom_type == "Polygon" and not len(geometry.interiors)):
        return np.asarray(shapely.get_coordinates(geometry), np.float64)
    return None


def _simple(geometry: Any) -> list[Any]:
    """Points, lines and polygons of a geometry, however deep."""
    todo, out = [geometry], []
    while todo:
        one = todo.pop()
        if one.is_empty:
            continue
        if hasattr(one, "geoms"):
            todo += reversed(one.geoms)
        else:
            out.append(one)
    return out


def _bounds(
    source_bounds: Sequence[Mapping[str, str]], boxes: Sequence[Sequence[float]]
) -> Sequence[Mapping[str, str]]:
    """The attributes of ``<bounds>``: those that were read, while they are still the box around these boxes, else of
    that one box. What they say besides (their origin) stays with them."""
    extent = _bounding_box(boxes)
    try:
        old_boxes = [box for one in source_bounds if (box := _box(one)) is not None]
    except (UnreadableFile, ValueError):  # edits can put anything there
        old_boxes = []
    if len(old_boxes) != len(source_bounds) or not old_boxes or _bounding_box(old_boxes) != extent:
        old_boxes, source_bounds = [extent], source_bounds if len(source_bounds) == 1 else [NO_ATTRIBUTES]
    names = ("minlat", "minlon", "maxlat", "maxlon")
    out = []
    for one, (w, s, e, n) in zip(source_bounds, old_boxes, strict=True):
        texts = numbers(np.array([s, w, n, e], np.float64), DEGREES)
        attributes = {k: plain(v) for k, v in zip(names, texts, strict=True)}
        out.append({**{k: v for k, v in one.items() if k != "box"}, **attributes})
    return out


def _bounding_box(boxes: Sequence[Sequence[float]]) -> tuple[float, float, float, float]:
    west, south, east, north = zip(*boxes, strict=True)
    return min(west), min(south), max(east), max(north)


def _is_box(value: Any) -> bool:
    return (
        isinstance(value, list | tuple)
        and len(value) == 4
        and all(isinstance(v, int | float) and not isinstance(v, bool) for v in value)
    )


CARRIES = frozenset[Any]({"topology", "objects", "zones"})

register(
    Format(
        name="osm",
        title="OpenStreetMap",
        files={"map.osm": "application/vnd.openstreetmap.data+xml"},
        layers=CARRIES,
        detect=detect,
        read=read,
        check=_osm_rules.check,
        write=write,
        needs=LayerRequirements(one_of=(frozenset({"objects"}), frozenset({"topology"})), anchor="wgs84"),
        version=3,
        extensions=(".osm", "osm.xml", ".osm.gz", ".osm.bz2", ".pbf"),
        claims=Claims(priority=20),
        traits=Traits(own_ids=True, own_network=True),
    )
)
