"""Network that lanelets form, for reader and writer alike."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import shapely

from app.errors import Invalid, Problem
from app.formats.lanelet2 import lane_geometry
from app.formats.lanelet2.lane_geometry import Array
from app.formats.lanelet2.tags import BACK, EDGE, NAME, SOURCE, TARGET, is_two_way, parse_speed, positive
from app.formats.osm.tags import is_deleted
from app.model.features import Features, Properties, SharedKeyDicts, from_columns, unique_ids
from app.model.frame import MAX_DATUM_LATITUDE, MAX_METRES, Anchor, Datum
from app.model.geodesy import local_frame

SAME_PLACE = {"wgs84": 1e-9, "local": 1e-4}
"""Tolerance in degrees and metres within which an edge still follows its lanelet's middle."""


@dataclass(slots=True)
class Lane:
    """A lanelet as in its relation; bounds as node ids."""

    id: int
    tags: Mapping[str, str]
    left: list[int]
    right: list[int]
    middle: list[int] | None = None


@dataclass(slots=True)
class PointTable:
    """Positions of points. row: node id -> row of ``xyz``, [n, 3] in their anchor, z NaN if absent."""

    row: dict[int, int]
    xyz: Array
    anchor: Anchor
    names: dict[str, int] = field(default_factory=dict)
    labels: dict[str, str] = field(default_factory=dict)

    def metres(self) -> Array:
        """Return [n, 2] metres; for wgs84 in a frame near the middle of the data, exact to a few parts in 100 000."""
        if self.anchor == "local" or not len(self.xyz):
            return self.xyz[:, :2]
        lonlat = self.xyz[:, :2]
        low, high = lonlat.min(axis=0), lonlat.max(axis=0)
        # A tenth of a degree: an edit at the map's border must not move the frame and change the digits of all points.
        lon, lat = np.round((low + high) / 2.0, 1).tolist()
        frame = local_frame(Datum(float(np.clip(lat, -MAX_DATUM_LATITUDE, MAX_DATUM_LATITUDE)), lon))
        xy = frame.to_local(lonlat)
        if not (np.abs(xy) <= MAX_METRES).all():
            reason = "the lanes spread over too large an area for one network: upload the lanes of one site"
            raise Invalid(reason, [Problem(reason)])
        return xy


def network(lanes: Sequence[Lane], places: PointTable, document: Properties) -> Features:
    """Build nodes and directed edges of lanelets whose points all have a position."""
    compact = SharedKeyDicts()
    lines, widths, ends = _follow(lanes, places) if lanes else ([], [], [])
    two_way = [is_two_way(lane.tags) for lane in lanes]
    marks = _JoinedEnds()
    for pairs, both in zip(ends, two_way, strict=True):
        for pair in pairs:
            marks.add(pair, both)
    id_by_place: dict[tuple[int, int], str] = {}
    for pair in marks.all():
        top = marks.find(pair)
        if top not in id_by_place:
            id_by_place[top] = f"n{top[0]}:{top[1]}"
    # A node with our own tags keeps its position; every other one is half-way between its two points.
    used: dict[str, tuple[int, int] | None] = dict.fromkeys(places.names)
    edges: list[tuple[str, Any, Properties]] = []
    for lane, line, width, pairs, both in zip(lanes, lines, widths, ends, two_way, strict=True):
        names = lane.tags.get(SOURCE, ""), lane.tags.get(TARGET, "")
        source, target = (
            name if name in places.names else id_by_place[marks.find(pair)]
            for name, pair in zip(names, pairs, strict=True)
        )
        for name, pair in zip((source, target), pairs, strict=True):
            if name not in places.names:
                used.setdefault(name, marks.find(pair))
        edge_properties = compact(_edge_properties(lane, source, target, width, compact))
        edges.append((lane.tags.get(EDGE) or f"l{lane.id}", line, edge_properties))
        if both:
            back = compact({**edge_properties, "source": target, "target": source})
            edges.append((lane.tags.get(BACK) or f"l{lane.id}:back", shapely.reverse(line), back))
    nodes = [_node(name, pair, places, compact) for name, pair in used.items()]
    ids = unique_ids([*used, *(i for i, _, _ in edges)])
    out = np.empty(len(ids), object)
    out[:] = [*(point for point, _ in nodes), *(line for _, line, _ in edges)]
    properties = [*(p for _, p in nodes), *(p for _, _, p in edges)]
    return from_columns(ids, out, properties, places.anchor, document)


Pair = tuple[int, int]
"""Return the left and the right point of an end, by id."""


def _follow(lanes: Sequence[Lane], places: PointTable) -> tuple[list[Any], list[float | None], list[tuple[Pair, Pair]]]:
    """Return each lane's middle, width, and two ends."""
    xy = places.metres()
    rows = ([[places.row[r] for r in side] for side in sides] for sides in _bounds(lanes))
    left, right = map(lane_geometry.runs, rows)
    left, right = lane_geometry.align_bounds(left, right, xy)
    lines, widths = _middles(lanes, left, right, places, xy)
    node_ids = {row: i for i, row in places.row.items()}
    corners = (left.first_points, right.first_points, left.last_points, right.last_points)
    columns = ([node_ids[row] for row in points.tolist()] for points in corners)
    return lines, widths, [((a, b), (c, d)) for a, b, c, d in zip(*columns, strict=True)]


def _edge_properties(
    lane: Lane, source: str, target: str, width: float | None, compact: SharedKeyDicts
) -> dict[str, Any]:
    out: dict[str, Any] = {"kind": "edge", "source": source, "target": target}
    if title := lane.tags.get("name") or lane.tags.get("road_name"):
        out["name"] = title
    if width is not None:
        out["width"] = width
    if (speed := parse_speed(lane.tags.get("speed_limit"))) is not None:
        out["speed_limit"] = speed
    out[NAME] = compact({"lanelet": lane.id, "tags": lane.tags})
    return out


def _node(name: str, pair: Pair | None, places: PointTable, compact: SharedKeyDicts) -> tuple[Any, Properties]:
    """Return shape and properties of a node between two points, or (None) at the point with its name."""
    if pair is None:
        at = places.xyz[places.row[places.names[name]]]
        properties: Properties = {
            "kind": "node",
            "name": places.labels.get(name) or name,
            NAME: {"point": places.names[name]},
        }
    else:
        at = (places.xyz[places.row[pair[0]]] + places.xyz[places.row[pair[1]]]) / 2.0
        properties = compact({"kind": "node", NAME: compact({"points": list(pair)})})
    return shapely.Point(*at[:2].tolist()) if math.isnan(at[2]) else shapely.Point(*at.tolist()), properties


def _bounds(lanes: Sequence[Lane]) -> tuple[list[list[int]], list[list[int]]]:
    return [lane.left for lane in lanes], [lane.right for lane in lanes]


def _middles(
    lanes: Sequence[Lane], left: lane_geometry.LineSet, right: lane_geometry.LineSet, places: PointTable, xy: Array
) -> tuple[list[Any], list[float | None]]:
    """Return each lane's middle as a line, and its width in metres, None if the bounds touch."""
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
        # For bounds of our own the edge's width is in a tag; without one their distance is meaningless.
        between = round(width, 6) if width >= 0.01 and EDGE not in lane.tags else None
        tag_width = positive(lane.tags.get("width"))
        widths.append(between if tag_width is None else tag_width)
    return out, widths


class _JoinedEnds:
    """Disjoint sets of lane ends that are one node.

    An end is its (left, right) points, looking along the lane; on a bidirectional lane it is also (right, left).
    """

    def __init__(self) -> None:
        self.parent: dict[tuple[int, int], tuple[int, int]] = {}

    def add(self, pair: tuple[int, int], both: bool) -> None:
        a = self.find(pair)
        if both:
            b = self.find((pair[1], pair[0]))
            # The smaller one represents both, so that a node's id does not depend on the order of lanelets.
            self.parent[max(a, b)] = min(a, b)

    def find(self, pair: tuple[int, int]) -> tuple[int, int]:
        top = self.parent.setdefault(pair, pair)
        while self.parent[top] != top:
            top = self.parent[top]
        self.parent[pair] = top
        return top

    def all(self) -> list[tuple[int, int]]:
        return list(self.parent)


def read_lanes(
    relations: Iterable[tuple[int, Sequence[Sequence[Any]], Mapping[str, str], Mapping[str, str]]],
    ways: Mapping[int, tuple[Sequence[int], Mapping[str, str]]],
    located: Mapping[int, Any],
) -> tuple[list[Lane], list[tuple[int, str]]]:
    """Return the usable lanelets, and (id, reason) of the others. relations: (id, members, tags, attributes)."""
    out, broken = [], []
    for i, members, tags, attributes in relations:
        if tags.get("type") != "lanelet":
            continue
        if is_deleted(attributes):
            broken.append((i, "it is marked as deleted"))
            continue
        sides: dict[str, list[list[int]]] = {"left": [], "right": [], "centerline": []}
        for kind, ref, role in members:
            if kind == "way" and role in sides and ref in ways and not is_deleted(ways[ref][1]):
                sides[role].append([r for r in ways[ref][0] if r in located])
        if any(len(sides[s]) != 1 or len(sides[s][0]) < 2 for s in ("left", "right")):
            broken.append((i, "it needs one left and one right bound of at least two points each"))
            continue
        middle = sides["centerline"][0] if len(sides["centerline"]) == 1 and len(sides["centerline"][0]) > 1 else None
        out.append(Lane(i, tags, sides["left"][0], sides["right"][0], middle))
    return out, broken
