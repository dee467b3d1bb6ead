"""Writing a site's networks: anchors, locations, lanes and graphs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import shapely

from app.formats._network import get_source_properties
from app.formats.rmf import common
from app.formats.rmf.common import BUILDING, NAV_GRAPH, mapping, parameter_value
from app.formats.rmf.site import vocabulary
from app.formats.rmf.site.draft import Draft, Floor, Lift, sorted_json, spot_of
from app.formats.rmf.site.model_writing import ModelWriter
from app.formats.rmf.site.vocabulary import SAME_METRES
from app.model.features import Properties

TAGS: Mapping[str, str] = {
    "is_charger": "Charger",
    "is_parking_spot": "ParkingSpot",
    "is_holding_point": "HoldingPoint",
}
ORIENTATIONS: Mapping[Any, str] = {"forward": "Forwards", "backward": "Backwards"}
WRITTEN_ELSEWHERE = frozenset(
    {"name", "lift", "lift_cabin", "mutex", "dock_name", common.ROBOT, common.ROBOT_TYPE, *TAGS}
)
"""Vertex parameters that a site stores with its locations, lanes, lifts and models."""

COLOURS = ([1.0, 0.5, 0.3], [0.6, 1.0, 0.5], [0.6, 0.8, 1.0], [0.6, 0.2, 0.3])
"""Colours of new navigation graphs, in turn, as in the editor."""


@dataclass(slots=True)
class _Way:
    """One direction of a lane."""

    source: str
    target: str
    motion: dict[str, Any]
    rest: dict[str, Any]
    reverse: bool


class NetworkWriter:
    """Writer of nodes as anchors and locations, and of edges as lanes."""

    def __init__(self, draft: Draft, models: ModelWriter) -> None:
        self.draft, self.models = draft, models

    def write_nodes(self, floor: Floor) -> None:
        """Write the nodes as anchors and locations, in source order."""
        nodes: list[tuple[tuple[bool, int, int, str], str, Properties, list[float]]] = []
        for part in floor.storey.networks:
            geometry = self.draft.coordinates(part)
            for i, p, g in zip(part.ids, part.properties, geometry, strict=True):
                if p.get("kind") != "node":
                    continue
                if g.geom_type != "Point" or g.is_empty:
                    self.draft.dropped["nodes without a point"] += 1
                    continue
                at = get_source_properties(p, BUILDING).get("index", get_source_properties(p, NAV_GRAPH).get("index"))
                order = (not isinstance(at, int), at if isinstance(at, int) else 0, len(i), i)
                xyz = [g.x, g.y, g.z - floor.elevation if g.has_z else 0.0]
                nodes.append((order, i, p, xyz))
                self.draft.dropped["nodes' orientations"] += p.get("orientation") is not None
        for _, i, p, xyz in sorted(nodes, key=lambda item: item[0]):
            members, parameters = (
                self.draft.source_members(floor, p),
                {**_plain_parameters(p), **self.draft.robots.vertex_properties(floor.storey.name, i)},
            )
            lift = self.draft.lifts.get(
                str(members.get("lift") or parameters.get("lift_cabin") or parameters.get("lift") or "")
            )
            name = str(p.get("name") or ("" if BUILDING in p or NAV_GRAPH in p else i))
            anchor = self._node_anchor(floor, lift, xyz, members, name)
            floor.nodes.setdefault(i, anchor)
            if parameters.get("dock_name"):
                self.draft.docks[floor.storey.name, i] = str(parameters["dock_name"])
            self._location(anchor, name, parameters, mapping(members.get("locations"), "locations"))
            self.models.write_robot(floor, parameters, members, xyz)
            parameters = common.with_area(parameters, p, typed=False)
            for key in parameters.keys() - WRITTEN_ELSEWHERE:
                self.draft.dropped[f"vertices' {key}"] += 1
            if BUILDING not in p and NAV_GRAPH not in p:
                self.draft.dropped["nodes' attributes of other formats"] += any(isinstance(v, dict) for v in p.values())

    def _node_anchor(
        self, floor: Floor, lift: Lift | None, xyz: list[float], members: Mapping[str, Any], name: str
    ) -> str:
        if lift is None:
            anchor = self.draft.claim(members.get("anchor"))
            floor.anchors[anchor] = self._anchor_or_source(xyz, members.get("says"))
            floor.by_place.setdefault(spot_of(xyz), anchor)
            return anchor
        inside = lift.cabin.inward(xyz)
        spot = (round(inside[0], 6) + 0.0, round(inside[1], 6) + 0.0, name)
        if spot not in lift.by_place:
            lift.by_place[spot] = anchor = self.draft.claim(members.get("anchor"))
            lift.anchors[anchor] = self._anchor_or_source([*inside, 0.0], members.get("says"))
        return lift.by_place[spot]

    def _anchor_or_source(self, xyz: Sequence[float], source_anchor: Any) -> dict[str, Any]:
        if source_anchor is None and abs(xyz[2]) > SAME_METRES:
            self.draft.dropped["heights of nodes above their level"] += 1
        return vocabulary.anchor_or_source(xyz if source_anchor is not None else [*xyz[:2], 0.0], source_anchor)

    def _location(self, anchor: str, name: str, parameters: Mapping[str, Any], locations: Mapping[str, Any]) -> None:
        """Write a node's locations; creates one if the node has a name, a tag or a mutex group."""
        tags = [tag for key, tag in TAGS.items() if parameters.get(key) is True]
        mutex = parameters.get("mutex")
        if not locations:
            if name or tags or mutex:
                group = {} if not mutex else {"mutex": int(self.draft.mutex(str(mutex)))}
                one = {"anchor": int(anchor), "tags": tags, "name": name, **group, "graphs": "All"}
                self.draft.locations[self.draft.claim()] = one
            return
        spoken = [str(one.get("name") or "") for one in locations.values()]
        same_name = name in spoken or (not name and set(spoken) <= {"", vocabulary.UNNAMED})
        source_tags = {tag for one in locations.values() for tag in one.get("tags") or [] if isinstance(tag, str)}
        for k, (i, one) in enumerate(locations.items()):
            if self.draft.locations.get(i, {}).get("anchor") == int(anchor):
                continue  # an anchor in a lift's cabin is a node of several levels
            now = {**one, "anchor": int(anchor)}
            if not k and not same_name:
                now["name"] = name
            if not k and source_tags & set(TAGS.values()) != set(tags):
                now["tags"] = [*tags, *(t for t in one.get("tags") or [] if t not in TAGS.values())]
            self.draft.locations[self.draft.claim(int(i))] = now

    def write_lanes(self, everywhere: Mapping[str, str]) -> None:
        """Write the edges as lanes. everywhere: anchors of the nodes of all levels, by node id."""
        groups: dict[Any, list[_Way]] = {}
        waiting: dict[Any, list[Any]] = {}
        for floor in self.draft.floors:
            for order, i, p, bends in self._edges(floor):
                ends = [str(p.get("source")), str(p.get("target"))]
                anchors = [floor.nodes.get(e, everywhere.get(e)) for e in ends]
                if anchors[0] is None or anchors[1] is None:
                    self.draft.dropped["edges without two nodes"] += 1
                    continue
                self.draft.dropped["edges' bends between their nodes"] += bends > 2
                self.draft.dropped["edges' actions"] += p.get("action") is not None
                self.draft.dropped["edges' widths"] += p.get("width") is not None
                direction = self._find_way(floor, p, (anchors[0], anchors[1]), ends)
                lane = self.draft.source_members(floor, p).get("lane")
                group: Any = lane if isinstance(lane, int) else (floor.id, i if order is None else order)
                if order is None and not isinstance(lane, int):  # pair it with the matching opposite edge
                    signature = sorted_json([direction.motion, direction.rest])
                    partners = waiting.get((floor.id, direction.target, direction.source, signature))
                    if partners and direction.source != direction.target:
                        group = partners.pop()
                    else:
                        waiting.setdefault((floor.id, direction.source, direction.target, signature), []).append(group)
                groups.setdefault(group, []).append(direction)
        for group, directions in groups.items():
            self._lane(group if isinstance(group, int) else None, directions)

    def _edges(self, floor: Floor) -> Iterator[tuple[int | None, str, Properties, int]]:
        """Iterate over (index of its lane in a building, id, properties, coordinates) of edges, in lane order."""
        listed = []
        for part in floor.storey.networks:
            counts = shapely.get_num_coordinates(part.geometry)
            for i, p, bends in zip(part.ids, part.properties, counts.tolist(), strict=True):
                if p.get("kind") == "edge":
                    at = get_source_properties(p, BUILDING).get("index")
                    lane_id = at if isinstance(at, int) else None
                    listed.append((lane_id, i, p, bends))
                else:
                    self.draft.dropped["network items that are neither nodes nor edges"] += p.get("kind") != "node"
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

    def _find_way(self, floor: Floor, p: Properties, anchors: tuple[str, str], ends: Sequence[str]) -> _Way:
        members, parameters = self.draft.source_members(floor, p), _plain_parameters(p)
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
            self.draft.created["lanes"] += 1
            self.draft.dropped["edges' attributes of other formats"] += any(isinstance(v, dict) for v in p.values())
            limit = limit or self.draft.options.speed_limit
        reverse = get_source_properties(p, BUILDING).get("reverse") is True
        orientation = parameters.get("orientation", parameters.get("orientation_constraint"))
        orientation = common.reverse_orientation(orientation) if reverse else orientation
        motion = {"orientation_constraint": ORIENTATIONS[orientation]} if orientation in ORIENTATIONS else {}
        motion |= {"speed_limit": limit} if limit else {}
        dock = parameters.get("dock_name") or self.draft.docks.get((floor.storey.name, ends[1]))
        motion |= {"dock": {"name": str(dock)}} if dock else {}
        number = parameters.get(
            "graph_idx", get_source_properties(p, NAV_GRAPH).get("graph", self.draft.options.graph if new else 0)
        )
        number = number if isinstance(number, int) and not isinstance(number, bool) else 0
        mutex = parameters.get("mutex")
        group = {"mutex": int(self.draft.mutex(str(mutex)))} if mutex else {}
        return _Way(*anchors, motion, {"graphs": {"Only": [int(self._graph(number))]}, **group}, reverse)

    def _graph(self, number: int) -> str:
        """Return the id of a building's graph."""
        if number not in self.draft.numbers:
            i = self.draft.numbers[number] = self.draft.claim()
            self.draft.graphs[i] = {
                "name": str(number),
                "color": list(COLOURS[(len(self.draft.graphs)) % len(COLOURS)]),
            }
        return self.draft.numbers[number]

    def _lane(self, hint: int | None, directions: Sequence[_Way]) -> None:
        """Write a pair of directions as one lane, other directions as separate lanes."""
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
        self.draft.lanes[self.draft.claim(hint)] = lane
        for other in directions:
            if other is not first and other is not back:
                self._lane(None, [other])


def _plain_parameters(p: Properties) -> dict[str, Any]:
    """Return the building's or navigation graph's parameters of a vertex or lane, without types."""
    plain = dict(mapping(get_source_properties(p, NAV_GRAPH).get("parameters"), "parameters"))
    typed = mapping(get_source_properties(p, BUILDING).get("parameters"), "parameters")
    return plain | {key: parameter_value(typed, key) for key in typed}
