"""Build lanelets for edges of other formats: bounds beside them, connected where the edges are."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from app.errors import MissingDatum
from app.formats._network import CROSS_PART_PROPERTIES, Edge, MergedNetwork, get_source_properties, merge_networks
from app.formats.lanelet2 import lane_geometry
from app.formats.lanelet2.document import Document, Level, is_same_place
from app.formats.lanelet2.lane_geometry import Arm, Array, Border
from app.formats.lanelet2.tags import BACK, EDGE, NAME, NODE, SOURCE, SUBTYPES, TARGET, kmh, metres_per_second, positive
from app.formats.osm.xml_text import NO_ATTRIBUTES, as_texts, integers
from app.model.layers import Layers, Part, PartKey
from app.parameters import parameter

CANONICAL_EDGE = frozenset({"kind", "name", "source", "target", "speed_limit", "width", NAME}) | CROSS_PART_PROPERTIES
CANONICAL_NODE = frozenset({"kind", "name", NAME}) | CROSS_PART_PROPERTIES


@dataclass(frozen=True, slots=True)
class WriteOptions:
    """Properties of new lanelets that the network does not specify."""

    width: float = parameter(1.0, "width of lanes for edges without width", minimum=0.01, maximum=100.0, unit="m")
    subtype: str = parameter("road", "subtype of lanes whose source has none, such as road, walkway or crosswalk")
    location: str = parameter("urban", "location of new lanes: urban or nonurban")
    bounds: str = parameter("virtual", "type of the bounds of new lanes, such as virtual, line_thin or curbstone")
    projector_info: bool = parameter(
        False, "also write map_projector_info.yaml (Local: local_x and local_y are metres in the environment's frame)"
    )


@dataclass(slots=True)
class _NewLanelet:
    """A lanelet to build: its middle [k, 3] in metres, the edge along it, and its reverse if it is bidirectional."""

    middle: Array
    half: float
    edge: Edge
    back: Edge | None


class NewLanelets:
    """Builder of lanelets for edges without a stored lanelet."""

    def __init__(self, out: Document) -> None:
        self.out, self.context, self.layers = out, out.context, out.layers
        self.options: WriteOptions = out.context.options

    def add_network(self) -> None:
        """Add lanelets for all edges without a stored one, and points for nodes."""
        parts: dict[PartKey, Part] = {}
        for key, part in self.layers.vector("topology").items():
            explained_ids = self.out.explained.get(key, set())
            keep = [k for k, i in enumerate(part.ids) if i not in explained_ids]
            if any(part.properties[k].get("kind") == "edge" for k in keep) or not explained_ids:
                parts[key] = part.select(keep)
        if not parts:
            return
        if self.layers.frame is None and not self.out.metric:
            raise MissingDatum(
                "lanelet2 needs positions on earth, but the environment has no datum: set one with PATCH "
                '/api/v1/environments/{env} {"datum": {"latitude": …, "longitude": …}} or upload a datum.yaml'
            )
        net = merge_networks(Layers(parts, self.layers.datum, self.layers.levels), self.context)
        new = self._make_lanelets(net)
        centres = self._node_points(net, {n for lane in new for n in (lane.edge.source, lane.edge.target)})
        self._bounds(net, new, centres)
        self._report_new_lanelets(net, new)

    def _report_new_lanelets(self, net: MergedNetwork, new: Sequence[_NewLanelet]) -> None:
        """Report defaults of new lanelets, and losses."""
        if new:
            why = "not specified by the network's edges"
            if default := sum("width" not in lane.edge.properties for lane in new):
                self.context.fill("width of lanes", self.options.width, f"{default} edges have no width", "width")
            self.context.fill("type of bounds", self.options.bounds, why, "bounds")
            self.context.fill("location of lanelets", self.options.location, why, "location")
            if any(self._subtype(lane.edge) == self.options.subtype for lane in new):
                self.context.fill("subtype of lanelets", self.options.subtype, why, "subtype")
        more = sum(bool(e.properties.keys() - CANONICAL_EDGE) for e in net.edges)
        self.context.drop("further properties of edges", more, "lanelets cannot express them")
        more = sum(bool(n.properties.keys() - CANONICAL_NODE) for n in net.nodes)
        self.context.drop("further properties of nodes", more, "points cannot express them")
        if len(set(net.levels)) > 1:
            self.context.drop("levels of nodes", len(net.nodes), "Lanelet2 has no levels: all networks are joined")

    def _make_lanelets(self, net: MergedNetwork) -> list[_NewLanelet]:
        """Build one lanelet for each edge, or for an edge and its equal reverse."""
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
            width = positive(edge.properties.get("width")) or self.options.width
            out.append(_NewLanelet(middle, width / 2.0, edge, back))
        self.context.drop("edges from a node to itself", loops, "a lanelet cannot end at the border where it begins")
        self.context.drop("edges without length", without, "a lanelet needs bounds along its course")
        return out

    def _node_points(self, net: MergedNetwork, used: set[int]) -> dict[int, int]:
        """Add a point for each node of the network; return node index -> id in the file.

        Nodes of unchanged lanelets need one only if a new lanelet begins there.
        """
        out = {}
        for k, node in enumerate(net.nodes):
            source_members = get_source_properties(node.properties, NAME)
            stored = source_members.get("point")
            level = self.out.levels.get(node.level, Level())
            if type(stored) is int and stored in level.nodes and self.out.points[level.nodes[stored]].tags.get(NODE):
                new = level.nodes[stored]
                if not is_same_place(
                    self.out.points[new].xyz, self.out.to_anchor(node.x, node.y, node.z, self.out.points[new].local)
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
                new = self.out.add_point(node.x, node.y, node.z or 0.0 if node.z is not None else math.nan, tags)
            out[k] = new
        return out

    def _bounds(self, net: MergedNetwork, new: Sequence[_NewLanelet], centres: Mapping[int, int]) -> None:
        """Add bounds, centrelines and relations of the new lanelets."""
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
            stored = self._read_border(net, node)
            border = stored[0] if stored else lane_geometry.border((at.x, at.y), node_arms)
            if border is None:
                continue
            borders[node] = border
            if stored:
                shared[node] = list(stored[1])
            joins |= {(arm.lane, arm.far): (node, border.along(arm)) for arm in node_arms if border.is_shared_by(arm)}
        narrow = 0
        for k, lane in enumerate(new):
            left, right, squeezed = self._sides(k, lane, joins, borders)
            narrow += squeezed
            sides = []
            for side, points in enumerate((left, right)):
                names = []
                for n, (x, y) in enumerate(points.tolist()):
                    join = joins.get((k, n > 0)) if n in (0, len(points) - 1) else None
                    z = float(lane.middle[n, 2])
                    if join is None:
                        names.append(self.out.add_point(x, y, z))
                        continue
                    node, straight = join
                    if node not in shared:
                        border = borders[node]
                        shared[node] = [self.out.add_point(*p, z) for p in (border.left, border.right)]
                    names.append(shared[node][side if straight else 1 - side])
                sides.append(names)
            self._emit(net, lane, sides, centres)
        if narrow:
            self.context.warn(
                f"{narrow} lanes are narrower than the width of their edges, so that their bounds do not cross"
            )
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
                f"{breaks} of {possible} pairs of successive lanes are not connected in Lanelet2's sense; their "
                "turns are too sharp for shared bounds"
            )

    def _read_border(self, net: MergedNetwork, node: int) -> tuple[Border, tuple[int, int]] | None:
        """Return the two points of a node of stored lanelets, in metres, if they still exist."""
        at = net.nodes[node]
        pair = integers(get_source_properties(at.properties, NAME).get("points"))
        level = self.out.levels.get(at.level)
        if pair is None or len(pair) != 2 or level is None or any(at.id in moved for moved in self.out.moved.values()):
            return None
        names = [level.nodes.get(i, i) for i in pair]
        if pair[0] == pair[1] or any(n not in self.out.points for n in names):
            return None
        left, right = (self.out.point_in_metres(self.out.points[n]) for n in names)
        if left is None or right is None:
            return None
        x, y = left[0] - right[0], left[1] - right[1]
        length = math.hypot(x, y)
        return (Border((y / length, -x / length), left, right), (names[0], names[1])) if length > 1e-6 else None

    def _sides(
        self, k: int, lane: _NewLanelet, joins: dict[tuple[int, bool], tuple[int, bool]], borders: Mapping[int, Border]
    ) -> tuple[Array, Array, bool]:
        """Return (left, right, whether they are narrower); ends that a border would spoil leave ``joins``."""
        half = lane.half
        if not shapely.LineString(lane.middle[:, :2]).is_simple:  # the middle crosses itself at any width
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

    def _emit(
        self, net: MergedNetwork, lane: _NewLanelet, sides: Sequence[list[int]], centres: Mapping[int, int]
    ) -> None:
        edge = lane.edge
        middle = [centres[edge.source]]
        middle += [self.out.add_point(x, y, z) for x, y, z in lane.middle[1:-1].tolist()]
        middle.append(centres[edge.target])
        members = []
        for role, refs in (("left", sides[0]), ("right", sides[1]), ("centerline", middle)):
            new = self.out.next_id()
            kind = "virtual" if role == "centerline" else self.options.bounds
            self.out.ways[new] = (refs, {"type": kind}, NO_ATTRIBUTES)
            members.append(("way", new, role))
        source_tags = get_source_properties(edge.properties, NAME).get("tags")
        tags = {"type": "lanelet", "subtype": self._subtype(edge), "location": self.options.location}
        stated = as_texts(source_tags) if isinstance(source_tags, Mapping) else NO_ATTRIBUTES
        tags |= {k: v for k, v in stated.items() if k != "one_way" and not k.startswith(("one_way:", "fleetmap:"))}
        tags["one_way"] = "yes" if lane.back is None else "no"
        for key in ("name", "speed_limit", "width"):
            tags.pop(key, None)
        name = edge.properties.get("name")
        if isinstance(name, str) and name != edge.id:
            tags["name"] = name
        if (speed := metres_per_second(edge.properties)) is not None:
            tags["speed_limit"] = kmh(speed)
        if (width := positive(edge.properties.get("width"))) is not None:
            tags["width"] = repr(width)
        tags |= {EDGE: edge.id, SOURCE: net.nodes[edge.source].id, TARGET: net.nodes[edge.target].id}
        if lane.back is not None:
            tags[BACK] = lane.back.id
        self.out.relations[self.out.next_id()] = (members, tags, NO_ATTRIBUTES)

    def _subtype(self, edge: Edge) -> str:
        """Return the Lanelet2 subtype for the source's kind."""
        source_subtype = as_texts(get_source_properties(edge.properties, NAME).get("tags")).get("subtype")
        highway = as_texts(get_source_properties(edge.properties, "osm").get("tags")).get("highway")
        if source_subtype:
            return source_subtype
        return SUBTYPES.get(highway, "road") if highway else self.options.subtype


def _is_same_road(a: Edge, b: Edge) -> bool:
    """Whether two edges, one the reverse of the other, can be one lanelet."""
    keys = ("speed_limit", "width", "name")
    return all(a.properties.get(w) == b.properties.get(w) for w in keys) and a.part.level == b.part.level


def _middle_line(edge: Edge, net: MergedNetwork) -> Array | None:
    """Return [k, 3] from node to node in metres, no point twice in a row; z NaN in 2-D; None for length 0."""
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
    if not keep[-1]:  # the last point is the node: drop equal points before it
        before = np.flatnonzero(keep)[-1]
        keep[before], keep[-1] = before == 0, before != 0
    line = line[keep]
    return line if len(line) > 1 else None
