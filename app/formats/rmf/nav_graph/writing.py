"""Writing navigation graphs, as rmf_building_map_tools generates them from a building."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from itertools import islice
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from app.errors import MissingLayer
from app.formats import WriteContext
from app.formats._network import get_source_properties
from app.formats.rmf import common
from app.formats.rmf.common import BUILDING, MAX_GRAPHS, Array, Flow, mapping, parameter_value
from app.formats.rmf.nav_graph.reading import lane_speed_limit
from app.formats.rmf.nav_graph.vocabulary import NAME
from app.model.features import Features, Properties, segments
from app.model.layers import Layers
from app.syntax import yaml
from app.syntax.decimals import METRES, numbers

SHAFT_GAP = 0.05
"""Metres between a lift's cabin and its shaft on each side; a vertex inside the shaft belongs to the lift."""

PARALLEL = 0.01
"""Determinant of directions below which rmf_building_map_tools regards a lane and a door as parallel, in units of the
building's file."""

LINES_PER_WRITE = 10_000
"""Number of lines encoded at once."""

LANE_WORDS = ("mutex", "demo_mock_floor_name", "demo_mock_lift_name")
"""Lane parameters of a building that a graph copies unless they are empty."""


@dataclass(slots=True)
class _Door:
    name: str
    level: str
    ends: Array
    graphs: list[int] | None
    says: dict[str, Any]


@dataclass(slots=True)
class _Lift:
    """Lift of a graph. corners: float64 [4, 2] of the shaft; levels: the levels that it serves."""

    name: str
    position: tuple[float, float, float]
    dims: tuple[float, float]
    corners: Array
    levels: frozenset[str]
    graphs: list[int] | None
    says: dict[str, Any]


@dataclass(slots=True)
class _Edge:
    id: str
    source: int
    target: int
    p: Properties
    paired: bool = False

    @property
    def order(self) -> tuple[bool, int, bool, int, str]:
        """Return the sort key: order of the lanes in their file; other edges follow by id."""
        source_members = get_source_properties(self.p, NAME) or get_source_properties(self.p, BUILDING)
        was = source_members.get("index")
        has_index = isinstance(was, int)
        return (
            not has_index,
            was if isinstance(was, int) else 0,
            source_members.get("reverse") is True,
            len(self.id),
            self.id,
        )


@dataclass(slots=True)
class _LevelWriter:
    """Level being written. at: float64 [n, 2], positions of its nodes in metres; edges by graph."""

    name: str
    ids: list[str]
    nodes: list[Properties]
    at: Array
    edges: dict[int, list[_Edge]]
    document: dict[str, Any]
    parallel: float
    lifts: list[str | None] = field(default_factory=list)


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """Write one file per graph that has lanes, ``0.yaml`` first. Raises MissingLayer if none has."""
    return _Writer(layers, context).files()


class _Writer:
    """Writer of all graphs of an environment."""

    def __init__(self, layers: Layers, context: WriteContext) -> None:
        self.layers, self.context = layers, context
        self.flow = Flow()
        self.lost: Counter[str] = Counter()
        self.building, self.tops = self._documents()
        self.doors, self.lifts = self._doors(), self._lifts()
        self.options = context.options if isinstance(context.options, common.WriteOptions) else common.WriteOptions()
        self.storeys = self._storeys()
        nodes = ((s.name, i, p) for s in self.storeys for i, p in zip(s.ids, s.nodes, strict=True))
        self.robots = common.Robots(self.options, nodes)
        self.new_lanes = 0
        self.names = common.VertexNames(())  # of the graph that is being written

    def _documents(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return the top-level members of the building, and those of each graph."""
        building: dict[str, Any] = {}
        tops: dict[str, Any] = {}
        for part in [*self.layers.vector("topology").values(), *self.layers.vector("objects").values()]:
            document = part.document.get(BUILDING)
            if isinstance(document, dict) and not building:
                building = mapping(document.get("building"), "building")
            document = part.document.get(NAME)
            if isinstance(document, dict) and not tops:
                tops = mapping(document.get("graphs"), "graphs")
        return building, tops

    def files(self) -> dict[str, bytes]:
        """Return the graphs by file name."""
        graphs = sorted({g for s in self.storeys for g in s.edges} | {int(g) for g in self.tops if g.isdecimal()})
        if not graphs:
            raise MissingLayer(
                "rmf_nav_graph needs lanes, but no network has edges: supply one (building.yaml, tmap2, OSM …)"
            )
        out = {f"{graph}.yaml": self._graph(graph) for graph in graphs}
        self._count_dropped()
        if self.new_lanes:
            why = f"{self.new_lanes} edges come from another format"
            self.context.fill("lanes: graph", self.options.graph, why, "graph")
            if self.options.speed_limit:
                limited = f"{why}; used for those without one"
                self.context.fill("lanes: speed_limit", self.options.speed_limit, limited, "speed_limit")
        self.robots.report(self.context)
        for item, count in sorted(self.lost.items()):
            self.context.drop(item, count, "a navigation graph cannot store it")
        if self.building.get("coordinate_system") in ("wgs84", "web_mercator"):
            self.context.warn(
                "the building has geographic coordinates; its graphs are in metres of the environment's local frame, "
                "not in the coordinates of generate_crs",
                where="coordinate_system",
            )
        return out

    def _count_dropped(self) -> None:
        for storey in self.storeys:
            used = np.array([NAME in p for p in storey.nodes], bool)
            for edges in storey.edges.values():
                for ends in ([e.source for e in edges], [e.target for e in edges]):
                    used[ends] = True
            self.lost["nodes without lanes"] += int((~used).sum())
        for key, part in self.layers.vector("objects").items():
            if key.name in (BUILDING, NAME):
                count = sum(p.get("kind") not in ("door", "lift") for p in part.properties)
                self.lost["objects that are neither doors nor lifts"] += count

    # inputs

    def _items(self, kind: str) -> Iterable[tuple[str, str, Properties, Any, Mapping[str, Any]]]:
        """Iterate over (level, id, properties, geometry in metres, document) of doors or lifts, in file order."""
        for key, part in self.layers.vector("objects").items():
            if key.name not in (BUILDING, NAME):
                continue
            subset = part.select_kinds(kind)
            geometry = subset.in_local(self.layers.frame)
            rows = list(zip(subset.ids, subset.properties, geometry, strict=True))
            rows.sort(key=lambda row: (_place(row[1]), row[0]))
            for i, p, g in rows:
                yield key.level, i, p, g, part.document

    def _doors(self) -> list[_Door]:
        out = []
        names: set[str] = set()
        for level, i, p, g, _ in self._items("door"):
            name = str(p.get("name") or i)
            if int(shapely.get_type_id(g)) != 1 or g.is_empty or name in names:
                self.lost["doors without two ends or with a duplicate name"] += 1
                continue
            names.add(name)
            source_members = get_source_properties(p, NAME)
            inside = source_members.get("graphs") if isinstance(source_members.get("graphs"), list) else None
            out.append(_Door(name, level, common.ends(g), inside, mapping(source_members.get("says"), "says")))
        return out

    def _lifts(self) -> list[_Lift]:
        lifts = []
        names: set[str] = set()
        for _, i, p, g, _ in self._items("lift"):
            name = str(p.get("name") or i)
            if int(shapely.get_type_id(g)) != 0 or g.is_empty or name in names:
                self.lost["lifts without a point or with a duplicate name"] += 1
                continue
            names.add(name)
            lift_members = mapping(get_source_properties(p, BUILDING).get("says"), "says")
            pose, size = common.object_pose(p), common.object_size(p) or (1.0, 1.0)
            yaw = pose[5] if pose else lift_members.get("yaw", 0.0)
            yaw = float(yaw) if isinstance(yaw, (int, float)) else 0.0
            source_members = get_source_properties(p, NAME)
            inside = source_members.get("graphs") if isinstance(source_members.get("graphs"), list) else None
            position = (float(g.x), float(g.y), yaw)
            says = mapping(source_members.get("says"), "says")
            served = self._served_levels(lift_members)
            lift = _Lift(name, position, size, _shaft(position, size), served, inside, says)
            lifts.append((_place(p), name, lift))
        lifts.sort(key=lambda row: row[:2])
        return [lift for _, _, lift in lifts]

    def _served_levels(self, lift_members: Mapping[str, Any]) -> frozenset[str]:
        """Return the levels between a lift's lowest and highest floor; none if it has no door on any."""
        if not lift_members.get("level_doors"):
            return frozenset()
        elevations = {level.name: level.elevation for level in self.layers.levels}
        low = elevations.get(str(lift_members.get("lowest_floor") or ""), -math.inf)
        high = elevations.get(str(lift_members.get("highest_floor") or ""), math.inf)
        names = {key.level for key in self.layers.vector("topology")}
        return frozenset(name for name in names if low <= elevations.get(name, 0.0) <= high)

    def _storeys(self) -> list[_LevelWriter]:
        by_level: dict[str, list[Features]] = {}
        for key, part in self.layers.vector("topology").items():
            if len(part) or NAME in part.document or BUILDING in part.document:
                by_level.setdefault(key.level, []).append(part)
        out = []
        for level, networks in sorted(by_level.items()):
            ids: list[str] = []
            nodes: list[Properties] = []
            at: list[Array] = []
            documents: dict[str, Any] = {}
            for part in networks:
                documents = {**part.document, **documents}
                point = (shapely.get_type_id(part.geometry) == 0) & ~shapely.is_empty(part.geometry)
                indices = [k for k, p in enumerate(part.properties) if p.get("kind") == "node" and point[k]]
                ids += [part.ids[k] for k in indices]
                nodes += [part.properties[k] for k in indices]
                at.append(shapely.get_coordinates(part.select(indices).in_local(self.layers.frame)))
            places = {i: k for k, i in reversed(list(enumerate(ids)))}
            edges = self._edges(networks, places)
            document = mapping(documents.get(NAME), NAME)
            scale = mapping(documents.get(BUILDING), BUILDING).get("transform")
            ratio = scale[0] if isinstance(scale, list) and scale else None
            factor = float(ratio) ** 2 if isinstance(ratio, (int, float)) else 1.0
            storey = _LevelWriter(level, ids, nodes, np.concatenate(at), edges, document, PARALLEL * factor)
            storey.lifts = self._inside(storey)
            out.append(storey)
        return out

    def _inside(self, storey: _LevelWriter) -> list[str | None]:
        """Return for each node the first lift whose shaft contains it."""
        out: list[str | None] = [None] * len(storey.ids)
        for lift in reversed(self.lifts):
            if storey.name in lift.levels:
                a = lift.corners[None] - storey.at[:, None]
                b = np.roll(lift.corners, 1, axis=0) - lift.corners
                cross = a[..., 0] * b[:, 1] - a[..., 1] * b[:, 0]
                inside = (cross >= 0).all(axis=1) | (cross <= 0).all(axis=1)
                for k in np.flatnonzero(inside).tolist():
                    out[k] = lift.name
        return out

    def _edges(self, networks: Sequence[Features], places: Mapping[str, int]) -> dict[int, list[_Edge]]:
        """Group the edges of a level by graph, in the order of their lanes."""
        out: dict[int, list[_Edge]] = {}
        for part in networks:
            for i, p in zip(part.ids, part.properties, strict=True):
                if p.get("kind") == "node":
                    continue
                source, target = places.get(str(p.get("source"))), places.get(str(p.get("target")))
                graph = self.options.graph if NAME not in p and BUILDING not in p else _edge_graph(p)
                if p.get("kind") != "edge" or source is None or target is None:
                    self.lost["edges without two nodes on their level"] += 1
                elif graph is None:
                    self.lost[f"lanes of graphs outside 0 to {MAX_GRAPHS - 1}"] += 1
                else:
                    self.lost["edges' actions"] += p.get("action") is not None
                    self.lost["edges' widths"] += p.get("width") is not None
                    if NAME not in p and BUILDING not in p:
                        self.lost["edges' attributes of other formats"] += any(isinstance(v, dict) for v in p.values())
                    out.setdefault(graph, []).append(_Edge(i, source, target, p))
        for edges in out.values():
            edges.sort(key=lambda e: e.order)
            for e, paired in zip(edges, _find_pairs(edges, len(places)), strict=True):
                e.paired = paired
        return out

    # a graph

    def _graph(self, graph: int) -> bytes:
        top = dict(mapping(self.tops.get(str(graph)), "graphs"))
        if "building_name" not in top:
            name = self.building.get("building_name", self.building.get("name"))
            default = self.options.building or self.context.title
            top["building_name"] = default if name is None else name
            if name is None:
                self.context.fill("building_name", default, "no source names the building", "building")
        if self.building.get("coordinate_system") == "cartesian_meters":
            parameters = self.building.get("parameters")
            top.setdefault("offset", [parameter_value(parameters, key, 0) for key in ("offset_x", "offset_y")])
            if parameter_value(parameters, "generate_crs") is not None:
                top.setdefault("crs_name", parameter_value(parameters, "generate_crs"))
        doors = {
            d.name: {"endpoints": _round(d.ends), "map": d.level, **d.says}
            for d in self.doors
            if d.graphs is None or graph in d.graphs
        }
        lifts = {
            lift.name: {"dims": list(lift.dims), "position": _round(np.array(lift.position)), **lift.says}
            for lift in self.lifts
            if lift.graphs is None or graph in lift.graphs
        }
        before = {**{k: v for k, v in top.items() if k < "levels"}, "doors": doors}
        out = BytesIO()  # rows as bytes use a third of the memory
        out.write(f"{yaml.mapping(before, 0)}levels:\n".encode())
        orders = [_order(storey, graph) for storey in self.storeys]
        self.names = common.VertexNames(
            ((s.name, k), s.ids[k], s.nodes[k]) for s, order in zip(self.storeys, orders, strict=True) for k in order
        )
        names: Counter[str] = Counter()
        lifts_of_vertices: set[str] = set()
        for storey, order in zip(self.storeys, orders, strict=True):
            rows = self._level(storey, graph, order, names, lifts_of_vertices)
            while batch := list(islice(rows, LINES_PER_WRITE)):
                out.write("".join(batch).encode())
        after = {k: v for k, v in top.items() if k > "levels"}
        # Fleet adapters refuse a vertex in a lift that the section lacks, but load graphs without the section.
        if lifts or not lifts_of_vertices:
            after["lifts"] = lifts
        out.write(yaml.mapping(after, 0).encode() if after else b"")
        self.names.report(self.context, f"{graph}.yaml", "levels")
        twice = sorted(name for name, count in names.items() if count > 1)
        if twice:
            listed = ", ".join(twice[:5]) + (" …" if len(twice) > 5 else "")
            problem = f"{len(twice)} duplicate vertex names: {listed}; fleet adapters reject them"
            self.context.warn(problem, file=f"{graph}.yaml", where="levels")
        return out.getvalue()

    def _level(
        self, storey: _LevelWriter, graph: int, order: Sequence[int], names: Counter[str], lifts: set[str]
    ) -> Iterator[str]:
        """Iterate over the lines of a level in a graph; adds to ``names`` (vertices per name) and ``lifts``."""
        edges = storey.edges.get(graph, [])
        new_index = {k: n for n, k in enumerate(order)}
        yield f"  {yaml.text(storey.name)}:\n"
        yield from _section("lanes", self._lanes(storey, graph, edges, new_index))
        yield from _section("vertices", self._vertices(storey, order, names, lifts))
        extra_members = mapping(mapping(storey.document.get("level"), "level").get(str(graph)), "level")
        yield yaml.mapping(extra_members, 4) if extra_members else ""

    def _vertices(
        self, storey: _LevelWriter, order: Sequence[int], names: Counter[str], lifts: set[str]
    ) -> Iterator[str]:
        texts = list(map(yaml.decimal, numbers(storey.at[order].ravel(), METRES)))
        for n, k in enumerate(order):
            vertex = common.with_area(self._vertex(storey, k), storey.nodes[k], typed=False)
            options = {**vertex, **self.robots.vertex_properties(storey.name, storey.ids[k])}
            if options.get("name"):
                names[str(options["name"])] += 1
            if options.get("lift"):
                lifts.add(str(options["lift"]))
            more = "".join(f", {self.flow(v)}" for v in get_source_properties(storey.nodes[k], NAME).get("more") or ())
            yield f"      - [{texts[2 * n]}, {texts[2 * n + 1]}, {self.flow(options)}{more}]\n"

    def _lanes(
        self, storey: _LevelWriter, graph: int, edges: Sequence[_Edge], new_index: Mapping[int, int]
    ) -> Iterator[str]:
        crossed = self._crossed_doors(storey, edges)
        blocked = {(e.source, e.target) for e in edges if e.p.get("blocked") is True}
        for n, e in enumerate(edges):
            if get_source_properties(e.p, NAME).get("reverse") is True and e.paired:
                continue  # covered by the lane with is_bidirectional
            more = "".join(f", {self.flow(v)}" for v in get_source_properties(e.p, NAME).get("more") or ())
            options = self._lane(storey, e, crossed[n])
            if e.p.get("blocked") is True or (
                options.get("is_bidirectional") is True and (e.target, e.source) in blocked
            ):
                options["blocked"] = True  # a two-way lane is one lane: a closed direction blocks it
            yield f"      - [{new_index[e.source]}, {new_index[e.target]}, {self.flow(options)}{more}]\n"
        for row in mapping(storey.document.get("dangling"), "dangling").get(str(graph), ()):
            if all(0 <= v < len(new_index) for v in row[:2]):
                self.lost["lanes to vertices that did not exist"] += 1
            else:
                yield f"      - {self.flow(row)}\n"
                problem = "a lane joins vertices that do not exist; fleet adapters will reject the graph"
                self.context.warn(problem, file=f"{graph}.yaml", where=f"levels.{storey.name}.lanes")

    def _vertex(self, storey: _LevelWriter, k: int) -> dict[str, Any]:
        p = storey.nodes[k]
        if NAME in p:
            options = dict(mapping(get_source_properties(p, NAME).get("parameters"), "parameters"))
            name = p.get("name")
            if isinstance(name, str) or "name" not in options:
                options["name"] = name or ""
            return options
        if BUILDING in p:
            parameters = mapping(get_source_properties(p, BUILDING).get("parameters"), "parameters")
            options = {"name": p.get("name") or ""}
            options |= {key: parameter_value(parameters, key, value) for key, value in parameters.items()}
        else:
            self.lost["nodes' orientations"] += p.get("orientation") is not None
            self.lost["nodes' attributes of other formats"] += any(isinstance(v, dict) for v in p.values())
            options = {"name": self.names.choose((storey.name, k), storey.ids[k], p)}
        if storey.lifts[k] is not None:
            options["lift"] = storey.lifts[k]
        return options

    def _lane(self, storey: _LevelWriter, e: _Edge, door: str | None) -> dict[str, Any]:
        limit = common.limit(e.p)
        if NAME in e.p:
            options = dict(mapping(get_source_properties(e.p, NAME).get("parameters"), "parameters"))
            if lane_speed_limit(options) != limit:
                options["speed_limit"] = limit
            if options.get("is_bidirectional") is True and not e.paired:
                options["is_bidirectional"] = False
            return options
        options = {}
        if BUILDING not in e.p:
            self.new_lanes += 1
            limit = limit or self.options.speed_limit
        if door is not None:
            options["door_name"] = door
        if limit:
            options["speed_limit"] = limit
        source_members = get_source_properties(e.p, BUILDING)
        parameters = source_members.get("parameters")
        orientation = parameter_value(parameters, "orientation")
        if orientation:
            turned = common.reverse_orientation(orientation) if orientation in ("forward", "backward") else ""
            options["orientation_constraint"] = turned if source_members.get("reverse") is True else orientation
        for key in LANE_WORDS:
            if parameter_value(parameters, key):
                options[key] = parameter_value(parameters, key)
        for dock_key, k in (("dock_name", e.target), ("undock_name", e.source)):
            dock = parameter_value(get_source_properties(storey.nodes[k], BUILDING).get("parameters"), "dock_name")
            if dock:
                options[dock_key] = dock
        if not e.paired:
            options["is_bidirectional"] = False
        return options

    def _crossed_doors(self, storey: _LevelWriter, edges: Sequence[_Edge]) -> list[str | None]:
        """Return for each edge the door that it crosses, the last one if there are several."""
        out: list[str | None] = [None] * len(edges)
        doors = [d for d in self.doors if d.level == storey.name]
        if not edges or not doors:
            return out
        a = storey.at[[e.source for e in edges]]
        b = storey.at[[e.target for e in edges]]
        tree = shapely.STRtree(segments(a, b))
        for door in doors:
            near = np.sort(tree.query(shapely.LineString(door.ends)))
            for k in near[_meet(a[near], b[near], door.ends, storey.parallel)].tolist():
                out[k] = door.name
        return out


def _order(storey: _LevelWriter, graph: int) -> list[int]:
    """Return the nodes of a level in a graph: those that the source lists, then others in the order of the lanes."""
    graphs = [get_source_properties(p, NAME).get("graphs") for p in storey.nodes]
    listed = [members.get(str(graph)) if isinstance(members, dict) else None for members in graphs]
    order = sorted((k for k, at in enumerate(listed) if isinstance(at, int)), key=lambda k: (listed[k], k))
    return list(dict.fromkeys([*order, *(k for e in storey.edges.get(graph, []) for k in (e.source, e.target))]))


def _section(key: str, rows: Iterator[str]) -> Iterator[str]:
    """Format a list of rows under a level's key."""
    first = next(rows, None)
    if first is None:
        yield f"    {key}: []\n"
    else:
        yield f"    {key}:\n{first}"
        yield from rows


def _find_pairs(edges: Sequence[_Edge], nodes: int) -> list[bool]:
    """Check for each edge whether its lane has the opposite edge, too.

    nodes: number of nodes, above every node index.
    """
    ends = np.array([(e.source, e.target) for e in edges], np.int64).reshape(-1, 2)
    lanes: dict[int | None, int] = {}
    lane = np.array([lanes.setdefault(_lane_number(e.p), len(lanes)) for e in edges], np.int64)
    forth, back = ends[:, 0] * nodes + ends[:, 1], ends[:, 1] * nodes + ends[:, 0]
    pair_index = np.unique(np.concatenate([forth, back]), return_inverse=True)[1]
    key = pair_index.reshape(2, -1) * len(lanes) + lane
    paired: list[bool] = (np.isin(key[0], key[1]) & (ends[:, 0] != ends[:, 1])).tolist()
    return paired


def _meet(a: Array, b: Array, door: Array, parallel: float) -> NDArray[np.bool_]:
    """Mark the segments a-b [n, 2] that intersect the door [2, 2], ends included; parallel ones do not."""
    c, d = door
    u, v = a - b, c - d
    det = u[:, 0] * v[1] - u[:, 1] * v[0]
    w = a - c
    safe = np.where(np.abs(det) < parallel, 1.0, det)
    t = (w[:, 0] * v[1] - w[:, 1] * v[0]) / safe
    s = -(u[:, 0] * w[:, 1] - u[:, 1] * w[:, 0]) / safe
    inside = (t >= 0) & (t <= 1) & (s >= 0) & (s <= 1)
    return np.asarray(inside & (np.abs(det) >= parallel), np.bool_)


def _shaft(position: tuple[float, float, float], dims: tuple[float, float]) -> Array:
    """Compute the corners of a lift's shaft as float64 [4, 2]."""
    x, y, yaw = position
    w, d = dims[0] / 2 + SHAFT_GAP, dims[1] / 2 + SHAFT_GAP
    across = np.array([math.cos(yaw), math.sin(yaw)]) * w
    along = np.array([-math.sin(yaw), math.cos(yaw)]) * d
    corners = np.array([along - across, -along - across, across - along, across + along])
    return np.asarray(corners + np.array([x, y]), np.float64)


def _place(p: Properties) -> int:
    at = (get_source_properties(p, BUILDING) or get_source_properties(p, NAME)).get("index")
    return at if isinstance(at, int) else 2**62


def _edge_graph(p: Properties) -> int | None:
    """Return the graph of an edge, or None for a building's lane outside all graphs."""
    if NAME in p:
        graph = get_source_properties(p, NAME).get("graph")
        return graph if isinstance(graph, int) and graph >= 0 else 0
    graph = parameter_value(get_source_properties(p, BUILDING).get("parameters"), "graph_idx", 0)
    if isinstance(graph, bool) or not isinstance(graph, int):
        return 0
    return graph if 0 <= graph < MAX_GRAPHS else None


def _lane_number(p: Properties) -> int | None:
    """Return the lane's index in its file, which both edges of a two-way lane share."""
    source_members = get_source_properties(p, NAME) if NAME in p else get_source_properties(p, BUILDING)
    if NAME in p:
        parameters = source_members.get("parameters")
        if not isinstance(parameters, dict) or parameters.get("is_bidirectional") is not True:
            return None
    index = source_members.get("index")
    return index if isinstance(index, int) else None


def _round(values: Array) -> Any:
    return (np.round(values, METRES) + 0.0).tolist()
