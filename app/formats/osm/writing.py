"""Write OSM: stored nodes, ways and relations unchanged, and everything else as new ones."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import chain
from typing import Any, Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from app.formats import WriteContext
from app.formats.osm import xml_text
from app.formats.osm.bounds import is_box, written_bounds
from app.formats.osm.elements import INT64
from app.formats.osm.tags import (
    CARRIES,
    EDGE_WORDS,
    FAMILY,
    LOOP,
    differs,
    direction,
    edge_properties,
    is_deleted,
    kmh,
    object_tags,
    way_edges,
    way_tags,
)
from app.formats.osm.xml_text import NO_ATTRIBUTES, Node, as_texts, attribute_text, element_id, integers
from app.model import osm_tags
from app.model.features import Features, Properties
from app.model.frame import GROUND
from app.model.layers import Layers

GENERATOR = "Fleet Map Server"


MAX_WAY_NODES = 2000
"""Maximum number of nodes of a way (OSM API 0.6)."""

NO_POSITION = (float("nan"), float("nan"))


@dataclass(slots=True)
class _Level:
    """Writer state of one level. nodes: feature id -> OSM id. edges: id -> (source, target, tags, properties)."""

    name: str
    nodes: dict[str, int] = field(default_factory=dict)
    moved: dict[int, int] = field(default_factory=dict)
    edges: dict[str, tuple[str, str, Mapping[str, str] | None, Properties]] = field(default_factory=dict)
    explained: set[str] = field(default_factory=set)
    ways: dict[int, list[int]] = field(default_factory=dict)
    relations: dict[int, int] = field(default_factory=dict)
    has_network: bool = False


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """Write ``map.osm``. Raises MissingDatum if anything is in metres and there is no datum."""
    out = _Writer(layers, context)
    levels = list(dict.fromkeys(key.level for key in sorted(layers.parts)))
    for level in sorted(levels, key=lambda name: (name != GROUND, name)):
        out.level(level)
    for key, part in sorted(layers.parts.items()):
        if key.layer not in CARRIES and isinstance(part, Features) and key.layer == "location":
            context.drop("GNSS fence", len(part), "OSM cannot express it; its box is written as the map's bounds")
    zones = sum(map(len, layers.vector("zones").values()))
    context.drop("zones", zones, "they become areas with a tag zone, which are read as objects")
    if layers.datum is not None:
        context.drop("datum", 1, "OSM positions are in wgs84, without a local frame")
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
        """Store the elements inside an element that OSM does not define."""
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
        new_items: list[tuple[Any, Properties, bool]] = []
        own_items: list[tuple[str, int, Any, Mapping[str, Any], Mapping[str, Any]]] = []
        for layer in ("objects", "zones"):
            for key, part in self.layers.vector("objects" if layer == "objects" else "zones", name).items():
                for i, geometry, properties in zip(
                    part.ids, part.in_wgs84(self.layers.frame), part.properties, strict=True
                ):
                    number, source_properties = element_id(i), properties.get("osm")
                    if layer == "objects" and key.name == FAMILY and number and isinstance(source_properties, Mapping):
                        current = object_tags(source_properties, properties, i)
                        own_items.append((number[0], number[1], geometry, current, properties))
                    elif i in drawn and shapely.get_type_id(geometry) in (0, 1, 2, 5):
                        # The network derived from this drawing is written; this line would duplicate it.
                        continue
                    else:
                        new_items.append((geometry, properties, layer == "zones"))
        for kind, osm_id, geometry, source_properties, _ in own_items:
            if kind == "n":
                self.node(level, osm_id, geometry, source_properties)
        for kind, osm_id, geometry, source_properties, properties in own_items:
            if kind == "w" and not self.write_way(level, osm_id, geometry, source_properties):
                new_items.append((geometry, properties, False))
        for kind, osm_id, _, _, _ in own_items:
            if kind == "r":
                level.relations[osm_id] = self.next_id("relation") if osm_id in self.relations else osm_id
                self.relations[level.relations[osm_id]] = ([], NO_ATTRIBUTES, NO_ATTRIBUTES)
        for kind, osm_id, _, source_properties, _ in own_items:
            if kind == "r":
                self.relation(level, osm_id, source_properties)
        for part in topology:
            self.add_ways(part, level)
        for geometry, properties, zone in new_items:
            self.other(level, geometry, properties, zone)

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
                # A street node that was converted by another format has its id as name, which is not a real name.
                nameless = is_own and properties.get("name", i) == i
                tags, attributes = (
                    NO_ATTRIBUTES if nameless else {"name": i, **self.tags(properties, ("name",))},
                    NO_ATTRIBUTES,
                )
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
        """Write an OSM way; False if its properties or geometry are not valid for one."""
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
        """Return the pieces of a highway way that are still in the network.

        Each piece is (first, one past the last index of refs, tags).
        """
        expected = way_edges(number, refs, tags, absent)
        # For each segment: its existing directions among the way's, and its tags if they differ.
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
                new = {w: v for w in EDGE_WORDS if differs(v := edge[3].get(w), values.get(w))}
                if new:
                    edited.setdefault(k, {})[heading] = new
        for k, changes in edited.items():
            headings, other = headings_by_segment[k]
            headings_by_segment[k] = (
                headings,
                way_tags(tags if other is None else as_texts(other), changes, headings),
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
        """Return the node ids of (part of) a way, creating nodes that exist only in the way."""
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
                    # Two ways disagree on the position of their common node: each keeps its course.
                    new = self.next_id("node")
                    self.nodes[new] = Node(position[0], position[1], vertex=True)
            out.append(new)
        return out

    def redraw(self, level: _Level, refs: list[int], at: NDArray[np.float64]) -> list[int]:
        """Create nodes for a way with edited geometry: its own node if one is at a vertex, else new ones."""
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
        """Write edges without a stored way, joined to lines if consecutive ones have equal tags."""
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
                if nodes == [a, a]:  # alone: within a line it would be a repeated node
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
        """Create nodes for an edge's bends between its ends."""
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
            new = {w: v for w in EDGE_WORDS if differs(v := p.get(w), values.get(w))}
            if limits and "speed_limit" not in new and "maxspeed" not in own_tags:
                new["speed_limit"] = min((v for v in map(osm_tags.speed, limits) if v), default=None)
            return dict(way_tags(own_tags, {"forward": {w: v for w, v in new.items() if v}}, {"forward"}))
        tags = {"highway": "path"}
        for member, key in (("name", "name"), ("action", "action"), ("width", "width")):
            value = p.get(member)
            if isinstance(value, str | int | float) and not isinstance(value, bool) and value != i:
                tags[key] = str(value)
        speed = p.get("speed_limit")
        if isinstance(speed, int | float) and not isinstance(speed, bool):
            tags["maxspeed"] = kmh(speed)
        tags |= {w: v for w in ("surface", "access") if isinstance(v := p.get(w), str) and v}
        if p.get("stairs") is True:
            tags["highway"] = "steps"
        if level.name != GROUND:
            tags["level"] = level.name
        more = {"kind", "source", "target", "drawn_from", "name", "action", *EDGE_WORDS, "stairs"}
        if p.keys() - more:
            self.lose("further properties of edges")
        return tags

    # --- items of other formats ---

    def tags(self, p: Properties, keys: Iterable[str] = (), level: str = GROUND) -> dict[str, str]:
        """Build tags for an item of another format: the plain values of these properties (or of all)."""
        tags: dict[str, str] = {}
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

    def other(self, level: _Level, geometry: Any, properties: Properties, zone: bool) -> None:
        tags = self.tags(properties, level=level.name)
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
        """Write a line or ring as a way with new nodes; a line with too many nodes continues in further ways."""
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
            self.context.drop(item, times, "OSM cannot express them")
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
        boxes = [d["bounds"] for d in documents if is_box(d.get("bounds"))]
        if not boxes:
            boxes = self.fence()
        if boxes:
            source_bounds = [as_texts(b) for one in source_documents for b in one.get("bounds") or []]
            lines += [f" <bounds{attribute_text(box, frozenset())}/>" for box in written_bounds(source_bounds, boxes)]
        return lines

    def fence(self) -> list[list[float]]:
        """Return the boxes of the sites that can be converted to wgs84."""
        out: list[list[float]] = []
        for part in self.layers.vector("location").values():
            if self.layers.frame is not None or not part.local.any():
                boxes = shapely.bounds(part.in_wgs84(self.layers.frame))
                out += boxes[~np.isnan(boxes).any(axis=1)].tolist()
        return out


def _course(geometry: Any) -> NDArray[np.float64] | None:
    """Return the vertices of a way's geometry; None if it has several parts."""
    is_path = geometry.geom_type in ("LineString", "LinearRing", "Point") or geometry.is_empty
    if is_path or (geometry.geom_type == "Polygon" and not len(geometry.interiors)):
        return np.asarray(shapely.get_coordinates(geometry), np.float64)
    return None


def _simple(geometry: Any) -> list[Any]:
    """Yield points, lines and polygons of a geometry, at any depth."""
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
