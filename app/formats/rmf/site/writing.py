"""Writing a site of Open-RMF: from a site as it was read, from a building, navigation graphs, or any other network.

Elements keep the ids that they had; new ones get the smallest that are free. An element stands on the anchors that it
had where they are still at its place, else on any anchor there, else on a new one: geometry decides.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import Any, Literal

import numpy as np
import orjson
import shapely

from app.errors import MissingLayer
from app.formats import WriteContext
from app.formats._network import get_source_properties
from app.formats.rmf import common
from app.formats.rmf.common import BUILDING, NAV_GRAPH, Storey, mapping, parameter_value
from app.formats.rmf.images import find_stored_image
from app.formats.rmf.site import vocabulary
from app.formats.rmf.site.vocabulary import NAME, SAME_METRES, VERSION, Cabin, metres, place
from app.model.features import Features, Properties
from app.model.layers import Layers, Resources
from app.parameters import parameter
from app.syntax import ron

FILE, FILE_RON = "map.site.json", "map.site.ron"
ZOOM = 15
"""Of map tiles behind a site that says none."""

TAGS: Mapping[str, str] = {
    "is_charger": "Charger",
    "is_parking_spot": "ParkingSpot",
    "is_holding_point": "HoldingPoint",
}
ORIENTATIONS: Mapping[Any, str] = {"forward": "Forwards", "backward": "Backwards"}
WRITTEN_ELSEWHERE = frozenset(
    {"name", "lift", "lift_cabin", "mutex", "dock_name", common.ROBOT, common.ROBOT_TYPE, *TAGS}
)
"""What vertices say that a site says of its locations, lanes, lifts and models."""

COLOURS = ([1.0, 0.5, 0.3], [0.6, 1.0, 0.5], [0.6, 0.8, 1.0], [0.6, 0.2, 0.3])
"""Of new navigation graphs, in turn: those of the editor."""


@dataclass(frozen=True, slots=True)
class WriteOptions(common.WriteOptions):
    """What a site says where no source does, and how it is written."""

    encoding: Literal["json", "ron"] = parameter("json", "json, or ron as older releases of the editor read it")


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """``map.site.json`` or ``map.site.ron``, and the drawings that it names.

    Raises MissingLayer where there is neither a network nor anything that came from Open-RMF.
    """
    storeys = common.storeys(layers)
    if not storeys:
        raise MissingLayer("rmf_site needs a network: upload a site.json, building.yaml, tmap2 or OSM file")
    writer = _Writer(layers, context, storeys)
    site = vocabulary.sort_members(writer.site())
    if writer.options.encoding == "ron":
        main = {FILE_RON: ron.dump(site, vocabulary.SHAPE)}
    else:
        main = {FILE: orjson.dumps(site, option=orjson.OPT_INDENT_2 | orjson.OPT_APPEND_NEWLINE)}
    return {**main, **dict(sorted(writer.used.items()))}


@dataclass(slots=True)
class _Floor:
    """A level being written. said: its element; at: the places of its anchors; fresh: ids by place of new ones."""

    storey: Storey
    id: str
    elevation: float
    document: dict[str, Any]
    said: dict[str, Any]
    nodes: dict[str, str] = field(default_factory=dict)
    by_place: dict[tuple[float, float], str] = field(default_factory=dict)

    @property
    def anchors(self) -> dict[str, Any]:
        anchors: dict[str, Any] = self.said["anchors"]
        return anchors


@dataclass(slots=True)
class _Lift:
    """A lift being written. anchors: of its cabin by id; by_place: those that are nodes, by their place and name."""

    cabin: Cabin
    said: dict[str, Any]
    anchors: dict[str, Any]
    by_place: dict[tuple[float, float, str], str] = field(default_factory=dict)


@dataclass(slots=True)
class _Way:
    """One direction of a lane."""

    source: str
    target: str
    motion: dict[str, Any]
    rest: dict[str, Any]
    reverse: bool


def _key(value: Any) -> bytes:
    return orjson.dumps(value, option=orjson.OPT_SORT_KEYS)


class _Writer:
    """One site being written."""

    def __init__(self, layers: Layers, context: WriteContext, storeys: Sequence[Storey]) -> None:
        self.layers, self.context = layers, context
        self.options = context.options if isinstance(context.options, WriteOptions) else WriteOptions()
        self.robots = common.Robots(self.options, _iterate_nodes(storeys))
        self.dropped: Counter[str] = Counter()
        self.made: Counter[str] = Counter()
        self.used: dict[str, bytes] = {}
        self.resources: dict[str, bytes] = {}
        for part in layers.parts_of("resources", name=BUILDING).values():
            self.resources.update(part.files if isinstance(part, Resources) else {})
        documents = [_document(storey) for storey in storeys]
        first = next((d for d in documents if isinstance(d.get("site"), dict)), {})
        self.known: dict[str, Any] = first.get("site", {})
        if any(d.get("of") != first.get("of") for d in documents if d):
            context.warn("the levels come from different sites: what belongs to all of a site is the first one's")
        documents = [d if first and d.get("of") == first.get("of") else {} for d in documents]
        self.same = {s.name for s, d in zip(storeys, documents, strict=True) if d}
        self.mentioned = _ids(documents, storeys, self.same)
        self.claimed: set[str] = set(_element_ids(self.known))
        self.next = 0
        self.anchors: dict[str, Any] = dict(mapping(self.known.get("anchors"), "anchors"))
        guided = mapping(mapping(self.known.get("navigation"), "navigation").get("guided"), "guided")
        self.guided = dict(guided)
        self.graphs: dict[str, Any] = dict(mapping(guided.get("graphs"), "graphs"))
        ranking = [str(i) for i in guided.get("ranking") or []]
        self.numbers = {n: i for i, n in vocabulary.graph_numbers(self.graphs.items(), ranking).items()}
        self.mutexes: dict[str, Any] = dict(mapping(guided.get("mutex_groups"), "mutex_groups"))
        self.textures: dict[str, Any] = dict(mapping(self.known.get("textures"), "textures"))
        self.texture_ids = {_key(group): i for i, group in self.textures.items()}
        self.groups: dict[str, Any] = dict(mapping(self.known.get("fiducial_groups"), "fiducial_groups"))
        self.descriptions: dict[str, Any] = dict(mapping(self.known.get("model_descriptions"), "model_descriptions"))
        self.robot_types: dict[str, Any] = dict(mapping(self.known.get("robots"), "robots"))
        self.description_ids = {_key([d, i in self.robot_types]): i for i, d in self.descriptions.items()}
        self.mutex_ids, self.group_ids = _ids_by_name(self.mutexes), _ids_by_name(self.groups)
        self.instances: dict[str, Any] = {}
        self.fresh: list[str] = []
        self.moved: dict[str, tuple[Any, Any]] = {}
        self.locations: dict[str, Any] = {}
        self.lanes: dict[str, Any] = {}
        self.floors = [self._floor(s, d) for s, d in zip(storeys, documents, strict=True)]
        self.lifts: dict[str, _Lift] = {}
        self.docks: dict[tuple[str, str], str] = {}

    # ids

    def _claim(self, hint: Any = None) -> str:
        """The wanted id where no other element has it, else a new one."""
        key = str(hint)
        if isinstance(hint, int) and not isinstance(hint, bool) and 0 <= hint < 2**32 and key not in self.claimed:
            self.claimed.add(key)
            return key
        while (key := str(self.next)) in self.mentioned or key in self.claimed:
            self.next += 1
        self.claimed.add(key)
        return key

    def _source_members(self, floor: _Floor, p: Properties) -> dict[str, Any]:
        """What the site says of an item; nothing where it is of another site."""
        return get_source_properties(p, NAME) if floor.storey.name in self.same else {}

    # the whole

    def site(self) -> dict[str, Any]:
        """The site as a JSON-like value."""
        self._lifts()
        for floor in self.floors:
            self._nodes(floor)
        everywhere: dict[str, str] = {}
        for floor in self.floors:
            everywhere = {**floor.nodes, **everywhere}
        self._lanes(everywhere)
        for floor in self.floors:
            self._objects(floor)
            self._drawings(floor)
            floor.said["anchors"] = dict(floor.anchors)
        for lift in self.lifts.values():
            lift.said["cabin_anchors"] = lift.anchors
        self._report()
        properties = self._properties()
        dangling = mapping(self.known.get("dangling"), "dangling")
        guided = {
            **self.guided,
            "graphs": self.graphs,
            "ranking": self._ranking(),
            "lanes": {**self.lanes, **mapping(dangling.get("lanes"), "dangling")},
            "locations": {**self.locations, **mapping(dangling.get("locations"), "dangling")},
        }
        if self.mutexes or "mutex_groups" in guided:
            guided["mutex_groups"] = self.mutexes
        instances = {**self.instances, **mapping(dangling.get("model_instances"), "dangling")}
        navigation = {**mapping(self.known.get("navigation"), "navigation"), "guided": guided}
        out = {
            **{k: v for k, v in self.known.items() if k not in ("dangling", "models")},
            "format_version": self.known.get("format_version", VERSION),
            "properties": properties,
            "levels": {floor.id: floor.said for floor in self.floors},
        }
        collected = {
            "anchors": self.anchors,
            "textures": self.textures,
            "fiducial_groups": self.groups,
            "lifts": {str(k): lift.said for k, lift in self._lifts_by_id()},
            "scenarios": self._scenarios(instances),
            "model_descriptions": self.descriptions,
            "robots": self.robot_types,
            "model_instances": instances,
        }
        out |= {key: value for key, value in collected.items() if value or key in self.known}
        if any(guided[key] for key in ("graphs", "lanes", "locations")):
            out["navigation"] = navigation
        else:
            out.pop("navigation", None)
        return out

    def _lifts_by_id(self) -> Iterable[tuple[str, _Lift]]:
        return ((lift.said.pop("id"), lift) for lift in self.lifts.values())

    def _properties(self) -> dict[str, Any]:
        out = dict(mapping(self.known.get("properties"), "properties"))
        if "name" not in out:
            source_value = next(
                (s.document["building"].get("name") for s in self._storeys() if "building" in s.document), None
            )
            out["name"] = (
                source_value
                if isinstance(source_value, str) and source_value
                else self.options.building or self.context.title
            )
            if out["name"] != source_value:
                self.context.fill("properties.name", out["name"], "no source names the site", "building")
        datum = self.layers.datum
        if datum is not None:
            was = mapping(out.get("geographic_offset"), "geographic_offset")
            source_value = was.get("anchor")
            now = [datum.latitude, datum.longitude]
            same = isinstance(source_value, list) and [np.float32(v) for v in source_value] == [
                np.float32(v) for v in now
            ]
            offset = {"zoom": ZOOM, "visible": False, **was, "anchor": source_value if same else now}
            out["geographic_offset"] = offset
            why = "a site's +y axis is north, and (0, 0) has no altitude"
            self.context.drop("the datum's heading", abs(datum.heading) > 1e-9, why)
            self.context.drop("the datum's altitude", datum.altitude != 0, why)
        return out

    def _storeys(self) -> Iterable[Storey]:
        return (floor.storey for floor in self.floors)

    def _ranking(self) -> list[int]:
        ranking = [i for i in self.guided.get("ranking") or [] if str(i) in self.graphs]
        return ranking + [int(i) for i in self.graphs if int(i) not in ranking]

    # levels

    def _floor(self, storey: Storey, document: dict[str, Any]) -> _Floor:
        level = dict(mapping(document.get("level"), "level"))
        level_id = level.pop("id", None)
        i = self._claim(int(level_id) if isinstance(level_id, str) and level_id.isdigit() else None)
        self.claimed.update(_element_ids(level))
        source_properties = mapping(level.get("properties"), "properties")
        listed = next((level.elevation for level in self.layers.levels if level.name == storey.name), None)
        old = mapping(storey.document.get("level"), "level").get("elevation", 0.0)
        elevation = float(source_properties.get("elevation", old) or 0.0) if listed is None else listed
        properties = {**source_properties, "name": storey.name, "elevation": elevation}
        floor = _Floor(storey, i, elevation, document, {**level, "properties": properties, "anchors": {}})
        if not document:
            spoken = mapping(storey.document.get("level"), "level")
            for section in ("layers", "features", "constraints", "lights", "physical_cameras"):
                self.dropped[f"a building's {section}"] += bool(spoken.get(section))
        return floor

    def _coordinates(self, part: Features) -> np.ndarray[Any, np.dtype[np.object_]]:
        return part.in_local(self.layers.frame)

    def _nodes(self, floor: _Floor) -> None:
        """The nodes as anchors and locations, in the order of their source."""
        nodes: list[tuple[tuple[bool, int, int, str], str, Properties, list[float]]] = []
        for part in floor.storey.networks:
            geometry = self._coordinates(part)
            for i, p, g in zip(part.ids, part.properties, geometry, strict=True):
                if p.get("kind") != "node":
                    continue
                if g.geom_type != "Point" or g.is_empty:
                    self.dropped["nodes without a point"] += 1
                    continue
                at = get_source_properties(p, BUILDING).get("index", get_source_properties(p, NAV_GRAPH).get("index"))
                order = (not isinstance(at, int), at if isinstance(at, int) else 0, len(i), i)
                xyz = [g.x, g.y, g.z - floor.elevation if g.has_z else 0.0]
                nodes.append((order, i, p, xyz))
                self.dropped["nodes' orientations"] += p.get("orientation") is not None
        for _, i, p, xyz in sorted(nodes, key=lambda item: item[0]):
            members, parameters = (
                self._source_members(floor, p),
                {**_plain_parameters(p), **self.robots.vertex_properties(floor.storey.name, i)},
            )
            lift = self.lifts.get(
                str(members.get("lift") or parameters.get("lift_cabin") or parameters.get("lift") or "")
            )
            name = str(p.get("name") or ("" if BUILDING in p or NAV_GRAPH in p else i))
            anchor = self._node_anchor(floor, lift, xyz, members, name)
            floor.nodes.setdefault(i, anchor)
            if parameters.get("dock_name"):
                self.docks[floor.storey.name, i] = str(parameters["dock_name"])
            self._location(anchor, name, parameters, mapping(members.get("locations"), "locations"))
            self._robot(floor, parameters, members, xyz)
            for key in parameters.keys() - WRITTEN_ELSEWHERE:
                self.dropped[f"vertices' {key}"] += 1
            if BUILDING not in p and NAV_GRAPH not in p:
                self.dropped["nodes' attributes of other formats"] += any(isinstance(v, dict) for v in p.values())

    def _node_anchor(
        self, floor: _Floor, lift: _Lift | None, xyz: list[float], members: Mapping[str, Any], name: str
    ) -> str:
        if lift is None:
            anchor = self._claim(members.get("anchor"))
            floor.anchors[anchor] = self._anchor_or_source(xyz, members.get("says"))
            floor.by_place.setdefault(_spot(xyz), anchor)
            return anchor
        inside = lift.cabin.inward(xyz)
        spot = (round(inside[0], 6) + 0.0, round(inside[1], 6) + 0.0, name)
        if spot not in lift.by_place:
            lift.by_place[spot] = anchor = self._claim(members.get("anchor"))
            lift.anchors[anchor] = self._anchor_or_source([*inside, 0.0], members.get("says"))
        return lift.by_place[spot]

    def _anchor_or_source(self, xyz: Sequence[float], source_anchor: Any) -> dict[str, Any]:
        if source_anchor is None and abs(xyz[2]) > SAME_METRES:
            self.dropped["heights of nodes above their level"] += 1
        return vocabulary.anchor_or_source(xyz if source_anchor is not None else [*xyz[:2], 0.0], source_anchor)

    def _location(self, anchor: str, name: str, parameters: Mapping[str, Any], locations: Mapping[str, Any]) -> None:
        """A node's locations; a new one where it has a name, a tag or a mutex group."""
        tags = [tag for key, tag in TAGS.items() if parameters.get(key) is True]
        mutex = parameters.get("mutex")
        if not locations:
            if name or tags or mutex:
                group = {} if not mutex else {"mutex": int(self._mutex(str(mutex)))}
                one = {"anchor": int(anchor), "tags": tags, "name": name, **group, "graphs": "All"}
                self.locations[self._claim()] = one
            return
        spoken = [str(one.get("name") or "") for one in locations.values()]
        same_name = name in spoken or (not name and set(spoken) <= {"", vocabulary.UNNAMED})
        source_tags = {tag for one in locations.values() for tag in one.get("tags") or [] if isinstance(tag, str)}
        for k, (i, one) in enumerate(locations.items()):
            if self.locations.get(i, {}).get("anchor") == int(anchor):
                continue  # of a lift's cabin, whose anchor is a node of several levels
            now = {**one, "anchor": int(anchor)}
            if not k and not same_name:
                now["name"] = name
            if not k and source_tags & set(TAGS.values()) != set(tags):
                now["tags"] = [*tags, *(t for t in one.get("tags") or [] if t not in TAGS.values())]
            self.locations[self._claim(int(i))] = now

    def _mutex(self, name: str) -> str:
        return self._group_named(self.mutexes, self.mutex_ids, name)

    def _group_named(self, groups: dict[str, Any], ids: dict[str, str], name: str) -> str:
        """The group of this name; a new one where there is none."""
        if name not in ids:
            ids[name] = self._claim()
            groups[ids[name]] = {"name": name}
        return ids[name]

    # lanes

    def _lanes(self, everywhere: Mapping[str, str]) -> None:
        groups: dict[Any, list[_Way]] = {}
        waiting: dict[Any, list[Any]] = {}
        for floor in self.floors:
            for order, i, p, bends in self._edges(floor):
                ends = [str(p.get("source")), str(p.get("target"))]
                anchors = [floor.nodes.get(e, everywhere.get(e)) for e in ends]
                if anchors[0] is None or anchors[1] is None:
                    self.dropped["edges without two nodes"] += 1
                    continue
                self.dropped["edges' bends between their nodes"] += bends > 2
                self.dropped["edges' actions"] += p.get("action") is not None
                self.dropped["edges' widths"] += p.get("width") is not None
                direction = self._find_way(floor, p, (anchors[0], anchors[1]), ends)
                lane = self._source_members(floor, p).get("lane")
                group: Any = lane if isinstance(lane, int) else (floor.id, i if order is None else order)
                if order is None and not isinstance(lane, int):  # with the edge back that says the same
                    signature = _key([direction.motion, direction.rest])
                    partners = waiting.get((floor.id, direction.target, direction.source, signature))
                    if partners and direction.source != direction.target:
                        group = partners.pop()
                    else:
                        waiting.setdefault((floor.id, direction.source, direction.target, signature), []).append(group)
                groups.setdefault(group, []).append(direction)
        for group, directions in groups.items():
            self._lane(group if isinstance(group, int) else None, directions)

    def _edges(self, floor: _Floor) -> Iterator[tuple[int | None, str, Properties, int]]:
        """(place of its lane in a building, id, properties, coordinates) of a level's edges, in their lanes' order."""
        listed = []
        for part in floor.storey.networks:
            counts = shapely.get_num_coordinates(part.geometry)
            for i, p, bends in zip(part.ids, part.properties, counts.tolist(), strict=True):
                if p.get("kind") == "edge":
                    at = get_source_properties(p, BUILDING).get("index")
                    lane_id = at if isinstance(at, int) else None
                    listed.append((lane_id, i, p, bends))
                else:
                    self.dropped["items of networks that are neither node nor edge"] += p.get("kind") != "node"
        listed.sort(
            key=lambda e: (
                e[0] is None,
                e[0] or 0,
                get_source_properties(e[2], BUILDING).get("reverse") is True,
                len(e[1]),
                e[1],
            )
        )
        return iter(listed)

    def _find_way(self, floor: _Floor, p: Properties, anchors: tuple[str, str], ends: Sequence[str]) -> _Way:
        members, parameters = self._source_members(floor, p), _plain_parameters(p)
        lane = mapping(members.get("says"), "lane")
        limit = common.limit(p)
        if members:
            reverse = members.get("reverse") is True
            back = lane.get("reverse")
            different = back.get("Different") if isinstance(back, dict) else None
            motion = dict(mapping(different if reverse and different is not None else lane.get("forward"), "motion"))
            if (motion.get("speed_limit") or 0.0) != limit:
                motion.pop("speed_limit", None)
                motion |= {"speed_limit": limit} if limit else {}
            return _Way(*anchors, motion, lane, reverse)
        new = BUILDING not in p and NAV_GRAPH not in p
        if new:
            self.made["lanes"] += 1
            self.dropped["edges' attributes of other formats"] += any(isinstance(v, dict) for v in p.values())
            limit = limit or self.options.speed_limit
        reverse = get_source_properties(p, BUILDING).get("reverse") is True
        orientation = parameters.get("orientation", parameters.get("orientation_constraint"))
        orientation = common.reverse_orientation(orientation) if reverse else orientation
        motion = {"orientation_constraint": ORIENTATIONS[orientation]} if orientation in ORIENTATIONS else {}
        motion |= {"speed_limit": limit} if limit else {}
        dock = parameters.get("dock_name") or self.docks.get((floor.storey.name, ends[1]))
        motion |= {"dock": {"name": str(dock)}} if dock else {}
        number = parameters.get(
            "graph_idx", get_source_properties(p, NAV_GRAPH).get("graph", self.options.graph if new else 0)
        )
        number = number if isinstance(number, int) and not isinstance(number, bool) else 0
        mutex = parameters.get("mutex")
        group = {"mutex": int(self._mutex(str(mutex)))} if mutex else {}
        return _Way(*anchors, motion, {"graphs": {"Only": [int(self._graph(number))]}, **group}, reverse)

    def _graph(self, number: int) -> str:
        """The id of a building's graph."""
        if number not in self.numbers:
            i = self.numbers[number] = self._claim()
            self.graphs[i] = {"name": str(number), "color": list(COLOURS[(len(self.graphs)) % len(COLOURS)])}
        return self.numbers[number]

    def _lane(self, hint: int | None, directions: Sequence[_Way]) -> None:
        """Directions as a lane; those that are no pair as lanes of their own."""
        first = next((direction for direction in directions if not direction.reverse), directions[0])
        back = next(
            (w for w in directions if w is not first and (w.source, w.target) == (first.target, first.source)), None
        )
        lane: dict[str, Any] = {k: v for k, v in first.rest.items() if k not in ("forward", "reverse")}
        lane["anchors"] = [int(first.source), int(first.target)]
        if first.motion:
            lane["forward"] = first.motion
        if back is None:
            lane["reverse"] = "Disable"
        elif back.motion != first.motion:
            lane["reverse"] = {"Different": back.motion}
        lane.setdefault("graphs", "All")
        self.lanes[self._claim(hint)] = lane
        for other in directions:
            if other is not first and other is not back:
                self._lane(None, [other])

    # objects

    def _objects(self, floor: _Floor) -> None:
        sections = {"wall": "walls", "door": "doors", "floor": "floors"}
        self._write_drawings(floor)
        for kind, p, geometry, _ in self._items(floor):
            members = self._source_members(floor, p)
            lines = geometry.geom_type == "LineString" and len(geometry.coords) >= 2
            point = geometry.geom_type == "Point" and not geometry.is_empty
            if kind in ("wall", "door") and lines:
                element = {
                    **mapping(members.get("says"), kind),
                    "anchors": self._corner_anchors(floor, p, geometry, kind),
                }
                self._solid(kind, p, element)
                floor.said.setdefault(sections[kind], {})[self._claim(members.get("id"))] = element
                self.dropped["bends of walls and doors"] += len(geometry.coords) > 2
            elif kind == "floor" and not geometry.is_empty:
                self._floors(floor, p, geometry, members)
            elif kind == "measurement" and lines:
                self._measurement(floor, p, geometry, members)
            elif kind == "fiducial" and point:
                self._fiducial(floor, p, geometry, members)
            elif kind in ("model", "robot") and point:
                self._model(floor, kind, p, geometry, members)
            elif kind != "lift":
                self.dropped["objects that are no part of a site"] += 1

    def _items(self, floor: _Floor) -> Iterator[tuple[str, Properties, Any, str]]:
        """(kind, properties, geometry in metres, id) of the level's objects in the order of their source."""
        for part in floor.storey.objects:
            geometry = self._coordinates(part)

            def order(k: int, part: Features = part) -> tuple[str, bool, int, int, str]:
                p = part.properties[k]
                at = get_source_properties(p, BUILDING).get("index", get_source_properties(p, NAV_GRAPH).get("index"))
                has_position = isinstance(at, int)
                return (
                    str(p.get("kind")),
                    not has_position,
                    at if isinstance(at, int) else 0,
                    len(part.ids[k]),
                    part.ids[k],
                )

            for k in sorted(range(len(part)), key=order):
                yield str(part.properties[k].get("kind")), part.properties[k], geometry[k], part.ids[k]

    def _corner_anchors(self, floor: _Floor, p: Properties, geometry: Any, kind: str) -> list[int]:
        """The anchors of a line's ends or a ring's corners."""
        at = shapely.get_coordinates(geometry)
        at = at if kind == "floor" else at[[0, -1]]
        hints = self._source_members(floor, p).get("anchors")
        hints = hints if isinstance(hints, list) else []
        if kind == "floor" and geometry.geom_type == "Polygon" and len(at) != len(hints):
            at = at[:-1]  # a polygon repeats its first corner, a floor need not
        hints = hints if len(hints) == len(at) else [None] * len(at)
        return [self._anchor(floor, xy, hint, kind.capitalize()) for xy, hint in zip(at.tolist(), hints, strict=True)]

    def _anchor(self, floor: _Floor, xy: Sequence[float], hint: Any, category: str) -> int:
        """The anchor at this place: the one that it was, else any of the level, else a new one."""
        key = str(hint)
        for home in (floor.anchors, self.anchors):
            if key in home and _is_near(place(home[key], category, "anchor"), xy):
                return int(key)
        form = mapping(floor.document.get("forms"), "forms").get(key)
        if form is not None and not _is_near(place(form, category, "anchor"), xy):
            form = None
        spot = _spot(xy)
        if (existing := floor.by_place.get(spot)) is not None and form is None:
            return int(existing)
        anchor = self._claim(hint)
        floor.anchors[anchor] = form or vocabulary.anchor_or_source([*xy, 0.0], None)
        floor.by_place.setdefault(spot, anchor)
        return int(anchor)

    def _solid(self, kind: str, p: Properties, element: dict[str, Any]) -> None:
        """A door's kind, a wall's texture, and the heights of both."""
        parameters = mapping(get_source_properties(p, BUILDING).get("parameters"), "parameters")
        if kind == "door":
            element["name"] = str(p.get("name") or parameter_value(parameters, "name") or "")
            was = str(parameter_value(parameters, "type", "hinged"))
            self.dropped["telescope doors, written as sliding ones"] += was.endswith("telescope")
            element["kind"] = vocabulary.door_kind(parameters, element.get("kind"))
        elif "texture" not in element and (group := vocabulary.texture_group(parameters, kind)) is not None:
            element["texture"] = int(self._texture(group))
        for key, member in (("height", "top"), ("base", "bottom")):
            now, source_value = p.get(key), element.get(member)
            fixed = vocabulary.height(source_value, member)
            if isinstance(now, (int, float)) and not isinstance(now, bool) and now > 0 and now != fixed:
                element[member] = {"fixed": float(now)}

    def _texture(self, group: dict[str, Any]) -> str:
        key = _key(group)
        if key not in self.texture_ids:
            self.texture_ids[key] = self._claim()
            self.textures[self.texture_ids[key]] = group
        return self.texture_ids[key]

    def _floors(self, floor: _Floor, p: Properties, geometry: Any, members: Mapping[str, Any]) -> None:
        pieces = list(geometry.geoms) if geometry.geom_type == "MultiPolygon" else [geometry]
        for k, piece in enumerate(pieces):
            ring = shapely.Polygon(piece.exterior) if piece.geom_type == "Polygon" else piece
            self.dropped["holes in floors"] += len(getattr(piece, "interiors", ()))
            element = {
                **mapping(members.get("says"), "floor"),
                "anchors": self._corner_anchors(floor, p, ring, "floor"),
            }
            parameters = mapping(get_source_properties(p, BUILDING).get("parameters"), "parameters")
            if "texture" not in element and (group := vocabulary.texture_group(parameters, "floor")) is not None:
                element["texture"] = int(self._texture(group))
            floor.said.setdefault("floors", {})[self._claim(None if k else members.get("id"))] = element

    # drawings

    def _write_drawings(self, floor: _Floor) -> None:
        """The drawings of the level's source, without what stands on them."""
        drawings = {
            i: {**drawing, "anchors": dict(mapping(drawing.get("anchors"), "anchors"))}
            for i, drawing in mapping(floor.document.get("drawings"), "drawings").items()
        }
        self.claimed.update(_element_ids({"drawings": drawings}))
        drawing = mapping(mapping(floor.storey.document.get("level"), "level").get("drawing"), "drawing")
        turn = floor.storey.document.get("transform")
        file = drawing.get("filename")
        if (
            not drawings
            and isinstance(file, str)
            and file
            and isinstance(turn, list)
            and len(turn) == 4
            and turn[0] > 0
        ):
            pose = vocabulary.pose_or_source([turn[2], turn[3], 0.0, 0.0, 0.0, turn[1]], None)
            properties = {"name": PurePosixPath(file).stem, "source": {"Local": file}, "pose": pose}
            properties["pixels_per_meter"] = 1.0 / turn[0]
            i = self._claim()
            drawings[i] = {"properties": properties, "transform": list(turn), "anchors": {}}
            floor.said["rankings"] = {"drawings": [int(i)]}
        if drawings:
            floor.said["drawings"] = drawings

    def _drawings(self, floor: _Floor) -> None:
        """The images that drawings name."""
        for i, drawing in mapping(floor.said.get("drawings"), "drawings").items():
            drawing.pop("transform", None)
            location = f"levels.{floor.id}.drawings.{i}.properties.source"
            properties = mapping(drawing.get("properties"), location)
            kind, name = vocabulary.asset(properties.get("source"), location)
            if not name or kind not in ("Local", "Remote"):
                continue
            file = find_stored_image(name, self.resources)
            if file is None:
                problem = f"the image {name[:200]!r} was not in the upload: it is named and not served"
                self.context.warn(problem, where=location)
                continue
            self.used[file] = self.resources[file]
            if file != name or kind != "Local":
                drawing["properties"] = {**properties, "source": {"Local": file}}

    def _place_on_drawing(
        self, floor: _Floor, geometry: Any, members: Mapping[str, Any]
    ) -> tuple[dict[str, Any], list[int]] | None:
        """(drawing, anchors on it) of what is measured in its pixels."""
        drawings = mapping(floor.said.get("drawings"), "drawings")
        i = str(members.get("drawing"))
        i = i if i in drawings else next(iter(drawings), "")
        if i not in drawings:
            self.dropped["measurements and fiducials of levels without a drawing"] += 1
            return None
        drawing = drawings[i]
        scale, turn, x, y = drawing["transform"]
        c, s = math.cos(turn) / scale, math.sin(turn) / scale
        at = shapely.get_coordinates(geometry) - np.array([x, y])
        pixels = np.column_stack([c * at[:, 0] + s * at[:, 1], -s * at[:, 0] + c * at[:, 1]])
        hints = members.get("anchors")
        hints = hints if isinstance(hints, list) and len(hints) == len(pixels) else [None] * len(pixels)
        ids = []
        for place_, hint in zip(pixels.tolist(), hints, strict=True):
            anchor = {"Translate2D": [metres(v) for v in place_]}
            key = str(hint)
            if key not in drawing["anchors"] or drawing["anchors"][key] != anchor:
                key = self._claim(hint)
                drawing["anchors"][key] = anchor
            ids.append(int(key))
        return drawing, ids

    def _measurement(self, floor: _Floor, p: Properties, geometry: Any, members: Mapping[str, Any]) -> None:
        ends = shapely.LineString([geometry.coords[0][:2], geometry.coords[-1][:2]])
        placement = self._place_on_drawing(floor, ends, members)
        if placement is None:
            return
        drawing, anchors = placement
        distance = parameter_value(get_source_properties(p, BUILDING).get("parameters"), "distance")
        length = {} if distance is None else {"distance": distance}
        element = {**mapping(members.get("says"), "measurement"), "anchors": anchors, **length}
        drawing.setdefault("measurements", {})[self._claim(members.get("id"))] = element

    def _fiducial(self, floor: _Floor, p: Properties, geometry: Any, members: Mapping[str, Any]) -> None:
        placement = self._place_on_drawing(floor, geometry, members)
        if placement is None:
            return
        drawing, (anchor,) = placement
        element = {**mapping(members.get("says"), "fiducial"), "anchor": anchor}
        name = str(p.get("name") or "")
        if self.groups.get(str(element.get("affiliation")), {}).get("name", "") != name:
            element.pop("affiliation", None)
            if name:
                element["affiliation"] = int(self._group_named(self.groups, self.group_ids, name))
        drawing.setdefault("fiducials", {})[self._claim(members.get("id"))] = element

    # models

    def _model(self, floor: _Floor, kind: str, p: Properties, geometry: Any, members: Mapping[str, Any]) -> None:
        element = mapping(members.get("says"), "model")
        building = mapping(get_source_properties(p, BUILDING).get("says"), "model")
        pose = common.object_pose(p) or [0.0, 0.0, floor.elevation, 0.0, 0.0, float(building.get("yaw") or 0.0)]
        now = [geometry.x, geometry.y, metres(pose[2] - floor.elevation), *pose[3:]]
        name = str(p.get("name") or "")
        static = building.get("static") is True
        self._instance(
            floor, name, now, element, members.get("id"), str(building.get("model_name") or name), static, kind
        )

    def _instance(
        self,
        floor: _Floor,
        name: str,
        now: Sequence[float],
        element: Mapping[str, Any],
        hint: Any,
        model: str,
        static: bool,
        kind: str,
    ) -> None:
        """A model in its place, and its description where the site has none."""
        description = str(element.get("description"))
        if description not in self.descriptions:
            source = element.get("source", {"Search": model})
            is_static = element.get("is_static", static) is True
            description = self._description(source, is_static, element.get("scale"), model, robot=kind == "robot")
        i = self._claim(hint)
        pose = vocabulary.pose_or_source(now, element.get("pose"))
        older = ("source", "is_static", "scale")
        self.instances[i] = {
            **{k: v for k, v in element.items() if k not in older},
            **{"parent": int(floor.id), "name": name, "pose": pose, "description": int(description)},
        }
        if not element or "source" in element:  # older releases have no scenarios, later ones hide what none includes
            self.fresh.append(i)
        elif pose != element.get("pose"):
            self.moved[i] = (element.get("pose"), pose)

    def _description(self, source: Any, static: bool, scale: Any, model: str, *, robot: bool) -> str:
        description = {"name": PurePosixPath(model).name or model, "source": source}
        description |= {"is_static": True} if static else {}
        description |= {} if scale is None else {"scale": scale}
        key = _key([description, robot])
        if key not in self.description_ids:
            description_id = self.description_ids[key] = self._claim()
            self.descriptions[description_id] = description
            if robot:
                self.robot_types[description_id] = {"properties": {}}
        return self.description_ids[key]

    def _robot(
        self, floor: _Floor, parameters: Mapping[str, Any], members: Mapping[str, Any], xyz: Sequence[float]
    ) -> None:
        """The robot that starts at a node."""
        name, model = parameters.get(common.ROBOT), parameters.get(common.ROBOT_TYPE)
        if not name or not model:
            self.dropped["robots without a name or a type"] += bool(name or model)
            return
        robot = mapping(members.get("robot"), "robot")
        element = mapping(robot.get("says"), "robot") if robot.get("name") == name else {}
        now = [xyz[0], xyz[1], 0.0, 0.0, 0.0, 0.0]
        if element:
            was = vocabulary.pose(element.get("pose"), "robot.pose")
            near = math.dist(was[:2], xyz[:2]) <= 1e-3
            now = was if near else [*xyz[:2], *was[2:]]
        self._instance(floor, str(name), now, element, robot.get("id") if element else None, str(model), False, "robot")

    def _scenarios(self, instances: Mapping[str, Any]) -> dict[str, Any]:
        """The scenarios without the models that are gone, with those that are new in each that starts anew."""
        out: dict[str, Any] = dict(mapping(self.known.get("scenarios"), "scenarios"))
        removed_ids = {str(i) for i in self.known.get("models") or ()} - instances.keys()
        if self.fresh and not out:
            out[self._claim()] = {"instances": {}, "name": "Default Scenario", "parent_scenario": None}
        for i, scenario in out.items():
            modifiers = scenario.get("instances")
            if not isinstance(modifiers, dict) and not self.fresh:
                continue
            listed = {
                k: self._modifier(k, v) for k, v in mapping(modifiers, "instances").items() if k not in removed_ids
            }
            if scenario.get("parent_scenario") is None:
                for k in self.fresh:
                    one = instances[k]
                    listed[k] = {"pose": one["pose"], "inclusion": "Included", "on_level": one["parent"]}
            out[i] = {**scenario, "instances": listed}
        return out

    def _modifier(self, i: str, modifier: Any) -> Any:
        old, new = self.moved.get(i, (None, None))
        moves = isinstance(modifier, dict) and new is not None and modifier.get("pose") == old
        return {**modifier, "pose": new} if moves else modifier

    # lifts

    def _lifts(self) -> None:
        """The lifts of all levels, in the order of their file."""
        lifts = []
        for floor in self.floors:
            for kind, p, geometry, i in self._items(floor):
                if kind != "lift":
                    continue
                if geometry.geom_type != "Point" or geometry.is_empty:
                    self.dropped["lifts without a point"] += 1
                    continue
                at = get_source_properties(p, BUILDING).get("index")
                lifts.append((not isinstance(at, int), at if isinstance(at, int) else 0, i, floor, p, geometry))
        for _, _, i, floor, p, geometry in sorted(lifts, key=lambda item: item[:3]):
            self.lifts.setdefault(str(p.get("name") or i), self._lift(floor, p, geometry, i))

    def _lift(self, floor: _Floor, p: Properties, geometry: Any, i: str) -> _Lift:
        members = self._source_members(floor, p)
        building = mapping(get_source_properties(p, BUILDING).get("says"), "lift")
        pose = common.object_pose(p)
        yaw = pose[5] if pose is not None else float(building.get("yaw") or 0.0)
        depth, width = common.object_size(p) or (1.0, 1.0)
        lift = dict(mapping(members.get("says"), "lift"))
        was = members.get("was")
        now = [geometry.x, geometry.y, yaw, depth, width]
        self.claimed.update(_element_ids(lift))
        cabin_anchors: dict[str, Any] = dict(mapping(lift.get("cabin_anchors"), "cabin_anchors"))
        properties = dict(mapping(lift.get("properties"), "properties"))
        rect = dict(vocabulary.rectangle(properties, "cabin")) if lift else {}
        rect |= {"depth": depth, "width": width}
        cabin_doors = lift.get("cabin_doors")
        if not lift:
            cabin_doors = self._cabin_doors(rect, cabin_anchors, building)
            start = next((f for f in self.floors if f.storey.name == building.get("initial_floor_name")), None)
            properties |= {"is_static": building.get("plugins") is False}
            properties |= {} if start is None else {"initial_level": int(start.id)}
            self.made["lifts"] += BUILDING not in p
        properties |= {"name": str(p.get("name") or i), "cabin": {"Rect": rect}}
        cabin = Cabin(geometry.x, geometry.y, yaw, depth, width, vocabulary.cabin_offset(rect, "cabin"))
        if not isinstance(was, list) or not np.allclose(was, now, rtol=0, atol=SAME_METRES):
            old = properties.get("reference_anchors")
            old = old if isinstance(old, list) and len(old) == 2 else [None, None]
            keys = [str(o) if str(o) in self.anchors else self._claim() for o in old]
            for key, at in zip(keys, cabin.ends(), strict=True):
                self.anchors[key] = vocabulary.anchor_or_source(at, None)
            properties["reference_anchors"] = [int(key) for key in keys]
        element = {**lift, "cabin_doors": cabin_doors, "properties": properties, "id": self._claim(members.get("id"))}
        return _Lift(cabin, element, cabin_anchors)

    def _cabin_doors(
        self, rect: dict[str, Any], anchors: dict[str, Any], building: Mapping[str, Any]
    ) -> dict[str, Any]:
        """A building's lift doors; each becomes a placement in ``rect`` with two anchors in the cabin."""
        out: dict[str, Any] = {}
        served = mapping(building.get("level_doors"), "level_doors")
        for name, door in mapping(building.get("doors"), "doors").items():
            face, placement = vocabulary.door_placement(mapping(door, "door"), rect, f"doors.{name}")
            if face in rect:
                self.dropped["further doors on one face of a lift's cabin"] += 1
                continue
            i = self._claim()
            rect[face] = {"door": int(i), **placement}
            ids = [self._claim(), self._claim()]
            anchors |= dict(zip(ids, vocabulary.door_anchors(rect, face), strict=True))
            visits = [int(f.id) for f in self.floors if name in (served.get(f.storey.name) or ())]
            kind: dict[str, Any] = {"DoubleSliding": {"left_right_ratio": 1.0}}
            if door.get("door_type") == 1:
                kind = {"SingleSliding": {"towards": "Left"}}
            out[i] = {"kind": kind, "reference_anchors": [int(a) for a in ids], "visits": sorted(visits)}
        return out

    # the report

    def _report(self) -> None:
        for noun, count in sorted(self.dropped.items()):
            self.context.drop(noun, count, "a site has no place for it")
        if self.made["lanes"]:
            why = f"{self.made['lanes']} edges come from another format"
            self.context.fill("lanes: graphs", self.options.graph, why, "graph")
            self.context.fill(
                "lanes: speed_limit", self.options.speed_limit, f"{why}, where they have none", "speed_limit"
            )
        self.robots.report(self.context)
        if self.made["lifts"]:
            self.context.fill("lifts: doors", "none", f"{self.made['lifts']} lifts come from a navigation graph")


def _ids_by_name(groups: Mapping[str, Any]) -> dict[str, str]:
    """The id of the first group of each name."""
    return {str(group.get("name")): i for i, group in reversed(list(groups.items()))}


def _is_near(a: Sequence[float], b: Sequence[float]) -> bool:
    return abs(a[0] - b[0]) < SAME_METRES and abs(a[1] - b[1]) < SAME_METRES


def _spot(at: Sequence[float]) -> tuple[float, float]:
    return metres(at[0]), metres(at[1])


def _plain_parameters(p: Properties) -> dict[str, Any]:
    """What a building or a navigation graph says of a vertex or lane, without types."""
    plain = dict(mapping(get_source_properties(p, NAV_GRAPH).get("parameters"), "parameters"))
    typed = mapping(get_source_properties(p, BUILDING).get("parameters"), "parameters")
    return plain | {key: parameter_value(typed, key) for key in typed}


def _document(storey: Storey) -> dict[str, Any]:
    """What the level's parts say as parts of a site."""
    documents = (part.document.get(NAME) for part in (*storey.objects, *storey.networks))
    return next((document for document in documents if isinstance(document, dict)), {})


def _iterate_nodes(storeys: Iterable[Storey]) -> Iterator[tuple[str, str, Properties]]:
    for storey in storeys:
        for part in storey.networks:
            for i, p in zip(part.ids, part.properties, strict=True):
                if p.get("kind") == "node":
                    yield storey.name, i, p


def _element_ids(value: Any) -> set[str]:
    """The ids of the elements in mappings, wherever they stand; a scenario's are those of models elsewhere."""
    if not isinstance(value, dict):
        return set()
    ids = {k for k in value if k.isascii() and k.isdigit()}
    return ids.union(*(_element_ids(v) for k, v in value.items() if k not in ("extensions", "tasks", "instances")))


def _ids(documents: Iterable[Mapping[str, Any]], storeys: Iterable[Storey], same: set[str]) -> set[str]:
    """All ids that the site's items and documents had, so that no new element takes one of them."""
    out: set[str] = set()
    for document in documents:
        out |= _element_ids(document)
        out.add(str(mapping(document.get("level"), "level").get("id")))
    for storey in storeys:
        if storey.name not in same:
            continue
        for part in (*storey.objects, *storey.networks):
            for p in part.properties:
                members = get_source_properties(p, NAME)
                listed = members.get("anchors")
                ids = [
                    members.get("id"),
                    members.get("lane"),
                    members.get("anchor"),
                    mapping(members.get("robot"), "").get("id"),
                ]
                out.update(str(i) for i in [*ids, *(listed if isinstance(listed, list) else ())] if i is not None)
                out |= _element_ids({k: v for k, v in members.items() if k in ("locations", "says")})
    return out
