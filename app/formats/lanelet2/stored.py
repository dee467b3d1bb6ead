"""Write the elements of a map that was read."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import shapely

from app.formats._network import get_source_properties
from app.formats.lanelet2.document import Document, Level, Point, is_same_place
from app.formats.lanelet2.network import SAME_PLACE, Lane, PointTable, network, read_lanes
from app.formats.lanelet2.tags import NAME, NODE, kmh, metres_per_second
from app.formats.osm.elements import INT64
from app.formats.osm.xml_text import NO_ATTRIBUTES, as_texts, element_id, integers
from app.model.features import Features, Properties
from app.model.layers import PartKey


class StoredElements:
    """Writer of stored elements, updated from the network."""

    def __init__(self, out: Document) -> None:
        self.out, self.context, self.layers = out, out.context, out.layers

    def level(self, name: str) -> None:
        """Write the elements of one level."""
        level = self.out.levels[name] = Level()
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
        self.out.lost["objects that are not elements of a map"] += len(part) - len(rows)
        for kind, i, shape, source_members in rows:
            if kind == "n":
                self._point(level, i, shape, source_members, local, nodes if networks else None)
        drawn_anew = [
            (i, shape, source_members)
            for kind, i, shape, source_members in rows
            if kind == "w" and not self._write_way(level, i, shape, source_members, local)
        ]
        for i, shape, source_members in drawn_anew:  # after the points of all other elements
            refs = integers(source_members.get("refs")) or []
            points = self._redrawn(level, refs, _course(shape), local)
            self.out.ways[level.ways[i]] = (
                points,
                as_texts(source_members.get("tags")),
                as_texts(source_members.get("attributes")),
            )
        relations = [(i, source_members) for kind, i, _, source_members in rows if kind == "r"]
        for i, _ in relations:
            level.relations[i] = self.out.next_id() if i in self.out.relations else i
            self.out.relations[level.relations[i]] = ([], NO_ATTRIBUTES, NO_ATTRIBUTES)
        lane_tags = self._lanelets(level, part, local, relations, networks)
        for i, source_members in relations:
            self._relation(level, i, source_members, lane_tags.get(i, (NO_ATTRIBUTES, False)))

    def _point(
        self, level: Level, i: int, shape: Any, source_members: Mapping[str, Any], local: bool, nodes: set[str] | None
    ) -> None:
        xyz = _xyz(shape)
        new = self.out.next_id() if i in self.out.points else i
        tags = as_texts(source_members.get("tags"))
        if nodes is not None and NODE in tags and tags[NODE] not in nodes:
            tags = {k: v for k, v in tags.items() if k != NODE}
        self.out.points[new] = Point(
            xyz, local, tags, as_texts(source_members.get("attributes")), _pair(source_members.get("at"))
        )
        level.nodes[i] = new
        self.out.unknown("node", new, source_members)

    def _write_way(self, level: Level, i: int, shape: Any, source_members: Mapping[str, Any], local: bool) -> bool:
        """Write a way; False if its geometry no longer has the stored points."""
        refs = integers(source_members.get("refs"))
        at = _course(shape)
        new = level.ways[i] = self.out.next_id() if i in self.out.ways else i
        self.out.unknown("way", new, source_members)
        tags, attributes = as_texts(source_members.get("tags")), as_texts(source_members.get("attributes"))
        missing = set(integers(source_members.get("missing")) or ())
        if refs is None or len(refs) - len(missing) != len(at):
            self.out.ways[new] = ([], tags, attributes)
            return False
        bends = source_members.get("vertices")
        rows = bends if isinstance(bends, list) and len(bends) == len(refs) else [bends] * len(refs)
        out, j = [], 0
        for k, ref in enumerate(refs):
            name = level.nodes.get(ref, ref)
            if k not in missing:
                point = self.out.points.get(name)
                bend: Mapping[str, Any] = row if isinstance(row := rows[k], Mapping) else {}
                if point is None or (ref not in level.nodes and not is_same_place(point.xyz, at[j])):
                    # Two ways disagree on the position of their common point: each keeps its course.
                    if point is not None:
                        name = self.out.next_id()
                    tags_, attributes_ = as_texts(bend.get("tags")), as_texts(bend.get("attributes"))
                    position = _pair(bend.get("at"))
                    self.out.points[name] = Point(at[j], local, tags_, attributes_, position, vertex=True)
                    if point is None:
                        level.nodes[ref] = name
                elif point.vertex and not is_same_place(point.xyz, at[j]):
                    name = self.out.next_id()
                    self.out.points[name] = Point(at[j], local, vertex=True)
                j += 1
            out.append(name)
        self.out.ways[new] = (out, tags, attributes)
        return True

    def _redrawn(self, level: Level, refs: list[int], at: list[tuple[float, float, float]], local: bool) -> list[int]:
        """Create points for a way with edited geometry: its own point if one is at a bend, else new ones."""
        names = (level.nodes.get(r, r) for r in refs)
        point_names = {self.out.points[n].xyz[:2]: n for n in names if n in self.out.points}
        out = []
        for position in at:
            if position[:2] not in point_names:
                point_names[position[:2]] = new = self.out.next_id()
                self.out.points[new] = Point(position, local, vertex=True)
            out.append(point_names[position[:2]])
        return out

    def _lanelets(
        self,
        level: Level,
        part: Features,
        local: bool,
        relations: Sequence[tuple[int, Mapping[str, Any]]],
        networks: Mapping[PartKey, Features],
    ) -> dict[int, tuple[Mapping[str, str], bool] | None]:
        """Return each lanelet's tags and whether it is reversed, according to the network.

        None if its edges were removed. Without a network the result is empty.
        """
        if not networks:
            return {}
        table, ways = self._points_and_ways(level, part, local)
        rows = (
            (
                i,
                _members(source_members),
                as_texts(source_members.get("tags")),
                as_texts(source_members.get("attributes")),
            )
            for i, source_members in relations
        )
        lanes, broken = read_lanes(rows, ways, table.row)
        drawn = network(lanes, table, {})
        out = self._compare_lanelets(lanes, drawn, networks)
        # A lanelet with a redrawn bound is written as drawn; its edges stay with it.
        redrawn = {i for i, _ in broken}
        for key, net in networks.items():
            own_edges = (
                k
                for k, p in zip(net.ids, net.properties, strict=True)
                if get_source_properties(p, NAME).get("lanelet") in redrawn
            )
            self.out.explained.setdefault(key, set()).update(own_edges)
        return out

    def _points_and_ways(
        self, level: Level, part: Features, local: bool
    ) -> tuple[PointTable, dict[int, tuple[list[int], Mapping[str, str]]]]:
        """Return the unchanged points and ways of a part, by their stored ids."""
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
                if len(refs) != size:  # redrawn: not the stored points
                    continue
                ways[identity[1]] = (refs, as_texts(source_members.get("attributes")))
            if any(r not in level.nodes for r in refs):
                continue  # refers to a point that was removed by an edit
            for r in refs:
                if r not in row:
                    row[r] = len(xyz)
                    xyz.append(self.out.points[level.nodes[r]].xyz)
        table = PointTable(row, np.array(xyz, np.float64).reshape(-1, 3), "local" if local else "wgs84", names, labels)
        return table, ways

    def _compare_lanelets(
        self, lanes: Sequence[Lane], drawn: Features, networks: Mapping[PartKey, Features]
    ) -> dict[int, tuple[Mapping[str, str], bool] | None]:
        """Compare lanelets with the current networks. drawn: the network that the stored lanelets form."""
        index_by_id = drawn.index()
        net_properties: dict[str, Properties] = {}
        for key, net in networks.items():
            near = SAME_PLACE["local" if bool(drawn.local.all()) else "wgs84"]
            own_rows = [(k, index_by_id[i]) for k, i in enumerate(net.ids) if i in index_by_id]
            now, then = [k for k, _ in own_rows], [k for _, k in own_rows]
            same = shapely.equals_exact(net.geometry[now], drawn.geometry[then], tolerance=near) if now else []
            still = {net.ids[k] for k, ok in zip(now, same, strict=True) if ok and net.local[k] == drawn.local[0]}
            self.out.moved[key] = {net.ids[k] for k in now} - still
            explained_ids = self.out.explained.setdefault(key, set())
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
                self.out.lost["lanelets whose edges are no longer in the network"] += 1
                continue
            tags = self._edited_tags(lane, drawn.properties[matches[0]], net_properties[drawn.ids[matches[0]]])
            if len(matches) < len(edges):
                tags = {**{k: v for k, v in tags.items() if not k.startswith("one_way:")}, "one_way": "yes"}
            out[lane.id] = (tags, matches[0] != edges[0])
        return out

    def _edited_tags(self, lane: Lane, drawn: Properties, now: Properties) -> dict[str, str]:
        """Update a lanelet's tags from the network."""
        tags = dict(lane.tags)
        if now.get("speed_limit") != drawn.get("speed_limit"):
            tags.pop("speed_limit", None)
            if (speed := metres_per_second(now)) is not None:
                tags["speed_limit"] = kmh(speed)
        if now.get("name") != drawn.get("name"):
            tags.pop("name", None)
            tags.pop("road_name", None)
            if isinstance(now.get("name"), str):
                tags["name"] = now["name"]
        if now.get("width") != drawn.get("width"):
            self.out.lost["widths of edges that differ from the bounds of their lanelet"] += 1
        return tags

    def _relation(
        self, level: Level, i: int, source_members: Mapping[str, Any], about: tuple[Mapping[str, str], bool] | None
    ) -> None:
        if about is None:
            del self.out.relations[level.relations[i]]
            return
        tags, turned = about
        members = []
        for kind, ref, role in _members(source_members):
            names = {"node": level.nodes, "way": level.ways, "relation": level.relations}.get(kind, {})
            other = {"left": "right", "right": "left"}.get(role) if turned else None
            members.append((kind, names.get(ref, ref), other or role))
        stated = source_members.get("members")
        self.out.lost["relation members that are not [type, id, role]"] += (
            len(stated) - len(members) if isinstance(stated, list) else 0
        )
        self.out.unknown("relation", level.relations[i], source_members)
        tags = tags or as_texts(source_members.get("tags"))
        self.out.relations[level.relations[i]] = (members, tags, as_texts(source_members.get("attributes")))


def _xyz(shape: Any) -> tuple[float, float, float]:
    at = _course(shape)
    return at[0] if at else (math.nan, math.nan, math.nan)


def _course(shape: Any) -> list[tuple[float, float, float]]:
    """Return the points of a line or ring, z NaN if it has none; nothing for any other geometry."""
    if shape.geom_type not in ("LineString", "LinearRing", "Point") or shape.is_empty:
        return []
    return [(x, y, z) for x, y, z in shapely.get_coordinates(shape, include_z=True).tolist()]


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
