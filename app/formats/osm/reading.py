"""Read OSM: the network of highways, and all features as objects."""

from __future__ import annotations

from dataclasses import replace
from itertools import chain, pairwise
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from app.errors import Problem, UnreadableFile
from app.formats import Files, ReadContext
from app.formats.osm.bounds import bounding_box, read_box
from app.formats.osm.elements import Data, Relation, Tags, Way
from app.formats.osm.parsing import parse
from app.formats.osm.tags import (
    BACKWARD,
    BOTH,
    FAMILY,
    FORWARD,
    Edges,
    edge_properties,
    is_area,
    is_deleted,
    is_loop,
    object_kind,
    object_properties,
    way_edges,
)
from app.model import osm_tags
from app.model.features import NO_GEOMETRY, Features, Properties, from_columns, points, segments, shared_key_dict
from app.model.layers import NETWORK, Layers, Part, PartKey
from app.model.osm_areas import multipolygon_areas
from app.syntax import xml

PROLOG_BYTES = 2**14
"""Number of bytes at the start of a file that are searched for stylesheets.

Elements of other formats are rejected anywhere.
"""


def read(files: Files, context: ReadContext) -> Layers:
    """Read a highway network, and all other elements as objects, in wgs84.

    Raises UnreadableFile, with a line if known, for files that are not OSM and for positions that are not on earth.
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
    boxes = [box for box in map(read_box, data.bounds) if box is not None]
    if boxes:
        document["bounds"] = list(bounding_box(boxes))
    texts = [data.root[k] for k in ("copyright", "attribution", "license") if data.root.get(k)]
    texts += [row[2] for row in data.elements if row[0] == "note" and row[2]]
    if texts:
        document["attribution"] = texts
    return document


def _warn_of_values(data: Data, context: ReadContext) -> None:
    """Warn about tags with an invalid size or speed, each with its number of occurrences; the tags are stored."""
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
    """Nodes and ways of the highway network.

    place: node id -> its index in the columns, of the last node with that id. used: ids of the network's nodes.
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
                context.warn("the way is marked as deleted; it is not part of the network", where=f"way {way.id}")
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
                f"highways refer to {len(absent_ids)} nodes that have no position in the file ({examples}); the "
                "network has gaps there"
            )

    def _report_doubts(self, way: Way, context: ReadContext) -> None:
        location = f"way {way.id}"
        if not is_loop(way.refs, way.tags) and any(a == b for a, b in pairwise(way.refs)):
            context.warn("the way repeats a node directly; that segment is skipped", where=location)
        oneway = str(way.tags.get("oneway", "no")).strip().lower()
        if oneway not in FORWARD and oneway not in BACKWARD and oneway not in BOTH:
            context.warn(f"unknown value oneway={oneway[:40]}; the way is read as bidirectional", where=location)

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
            context.warn("duplicate id in the file; the last element is used", where=f"{noun} {identity}")
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
    """Convert tagged and isolated nodes, ways and relations to features, in the file's order."""
    relations = {r.id: r for r in data.relations}
    if len(relations) != len(data.relations):
        _warn_twice("relation", [r.id for r in data.relations], context)
    refs = list(chain.from_iterable(way.refs for way in network.ways))
    nodes = _object_nodes(data, network, set(refs), context)
    properties = [_properties(_node_properties(data, k), data.tags.get(k, {}), "point") for k in nodes]
    index = np.fromiter((network.place.get(r, -1) for r in refs), np.intp, len(refs))
    lonlat = np.concatenate([data.lonlat, np.full((1, 2), np.nan)])[index]
    absent = np.isnan(lonlat[:, 0])
    features = {data.ids[k] for k in nodes} | network.used.keys()
    properties += _way_properties(data, network.ways, index, absent, features, context)
    properties += [_relation_properties(relation) for relation in relations.values()]
    ids = [f"n{data.ids[k]}" for k in nodes]
    ids += [f"w{way.id}" for way in network.ways]
    ids += [f"r{i}" for i in relations]
    shapes = _way_geometries(network.ways, lonlat, absent)
    nothing = np.full(len(relations), NO_GEOMETRY, object)
    geometry = np.concatenate([_node_geometries(data, nodes), shapes, nothing])
    part = from_columns(ids, geometry, properties, "wgs84", document)
    return _with_areas(part, range(len(ids) - len(relations), len(ids)), context)


def _object_nodes(data: Data, network: _Network, bent: set[int], context: ReadContext) -> list[int]:
    """Return the rows of nodes that are objects: not in the network, and not only bends of ways (``bent``)."""
    members = {i for r in data.relations for kind, i, _ in r.members if kind == "node"}
    nodes = []
    for identity, k in network.place.items():
        if identity in network.used:
            continue
        lone = identity not in bent or k in data.tags or identity in members or identity not in network.placed
        if lone or k in data.node_children or is_deleted(data.attributes(k)):
            nodes.append(k)
            if identity not in network.placed:
                context.warn("the node has no position", where=f"node {identity}")
    return nodes


def _node_geometries(data: Data, nodes: list[int]) -> NDArray[np.object_]:
    geometry = np.empty(len(nodes), object)
    at = data.lonlat[nodes] if nodes else np.empty((0, 2))
    has_position = ~np.isnan(at[:, 0])
    geometry[has_position] = points(at[has_position])
    geometry[~has_position] = NO_GEOMETRY
    return geometry


def _way_properties(
    data: Data,
    ways: list[Way],
    index: NDArray[np.intp],
    absent: NDArray[np.bool_],
    features: set[int],
    context: ReadContext,
) -> list[Properties]:
    """Build the properties of ways.

    index, absent: for all ways' references in sequence, each node's row and whether it has no position.
    """
    out = []
    dangling = 0
    begin = 0
    for way in ways:
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
        out.append(_properties(source_properties, way.tags, "line"))
        begin = end
    if dangling:
        context.warn(
            f"ways contain {dangling} references to nodes without a position in the file; the references are stored"
        )
    return out


def _relation_properties(relation: Relation) -> Properties:
    source_properties: dict[str, Any] = {"members": [list(m) for m in relation.members], "tags": relation.tags}
    if relation.attributes:
        source_properties["attributes"] = relation.attributes
    if relation.children:
        source_properties["children"] = relation.children
    return _properties(source_properties, relation.tags, "relation")


def _with_areas(part: Features, relations: range, context: ReadContext) -> Features:
    """Add the areas of multipolygons, whose rows are among ``relations``."""
    areas = multipolygon_areas(part, relations)
    if open_ := [part.ids[k][1:] for k, area in areas.items() if area is None]:
        examples = ", ".join(open_[:5]) + (" …" if len(open_) > 5 else "")
        context.warn(
            f"{len(open_)} multipolygons have no area because ways are missing or rings are not closed: {examples}"
        )
    geometry = part.geometry.copy()
    for k, area in areas.items():
        geometry[k] = area or NO_GEOMETRY
    return replace(part, geometry=geometry)


def _vertices(data: Data, refs: list[int], index: list[int], features: set[int]) -> Any:
    """Return the attributes of a way's nodes that are not features.

    One mapping if all are equal, else a list parallel to refs.
    """
    rows = [None if k < 0 or r in features else data.attributes(k) for r, k in zip(refs, index, strict=True)]
    entries = [row for row in rows if row is not None]
    if not entries or not any(entries):
        return None
    first = entries[0]
    return first if all(row is first or row == first for row in entries) else rows


def _way_geometries(ways: list[Way], lonlat: NDArray[np.float64], absent: NDArray[np.bool_]) -> NDArray[np.object_]:
    """Build each way's geometry from its nodes with a position: line, area, point or none."""
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
