"""Reading a site's networks: anchors and locations as nodes, lanes as edges."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import shapely

from app.formats._network import number
from app.formats.rmf import common
from app.formats.rmf.common import BUILDING, mapping, raise_unreadable
from app.formats.rmf.site import vocabulary
from app.formats.rmf.site.object_reading import model_name
from app.formats.rmf.site.source import Source, SourceLevel
from app.formats.rmf.site.vocabulary import NAME, UNNAMED, place, reference, references, text, variant
from app.model.features import Features, Properties, features, points, segments, unique_ids

_TAGS: Mapping[str, str] = {
    "Charger": "is_charger",
    "ParkingSpot": "is_parking_spot",
    "HoldingPoint": "is_holding_point",
}
_ORIENTATIONS: Mapping[str, str] = {"Forwards": "forward", "Backwards": "backward"}

SAME_PLACE = 1e-3
"""Maximum distance between a robot and its start location, in metres."""


class NetworkReader:
    """Reader of the networks of a site's levels: anchors, locations and lanes."""

    def __init__(self, source: Source) -> None:
        self.source = source

    def read(self, taken: set[str]) -> dict[str, Features]:
        """Return the network of each level by level id; adds the ids of its items to ``taken``."""
        locations = self._locations()
        self._name_nodes(locations, taken)
        rows: dict[str, list[tuple[str, Any, Properties]]] = {i: [] for i in self.source.levels}
        docks = self._edges(rows, taken)
        robots = self._robots_by_anchor()
        out = {}
        for i, level in self.source.levels.items():
            ids, properties = list(level.nodes.values()), []
            for k, anchor in enumerate(level.nodes):
                p = self._node(level, anchor, k, locations.get(anchor, []), docks.get((i, anchor)))
                if (robot := robots.get((i, anchor))) is not None:
                    parameters = p[BUILDING].setdefault("parameters", {})
                    parameters[common.ROBOT], parameters[common.ROBOT_TYPE] = (
                        [1, robot["name"]],
                        [1, robot.pop("model_name")],
                    )
                    p[NAME]["robot"] = robot
                properties.append(p)
            xyz = np.array([self._node_place(level, a) for a in level.nodes], np.float64).reshape(-1, 3)
            geometry = points(xyz[:, :2])
            if (high := xyz[:, 2] != 0).any():
                geometry[high] = points(xyz[high] + np.array([0.0, 0.0, level.elevation]))
            nodes = list(zip(ids, geometry, properties, strict=True))
            out[i] = features([*nodes, *rows[i]], "local")
        return out

    def _node_place(self, level: SourceLevel, anchor: str) -> list[float]:
        """Return [x, y, height above the level] of a node."""
        if anchor in level.anchors:
            return level.anchors[anchor]
        lift = self.source.cabins[anchor]
        raw = lift.element["cabin_anchors"][anchor]
        return [*lift.cabin.outward(place(raw, "General", f"lifts.{lift.id}.cabin_anchors.{anchor}")), 0.0]

    def _locations(self) -> dict[str, list[tuple[str, dict[str, Any]]]]:
        """Group the locations by anchor."""
        out: dict[str, list[tuple[str, dict[str, Any]]]] = {}
        for i, element in self.source.locations:
            self.source.count_unknown_members(element, "locations")
            anchor = reference(element.get("anchor"), f"navigation.guided.locations.{i}.anchor")
            out.setdefault(anchor, []).append((i, element))
        return out

    def _name_nodes(self, locations: Mapping[str, Sequence[tuple[str, Mapping[str, Any]]]], taken: set[str]) -> None:
        """Determine the anchors of each level that are nodes, and assign their ids."""
        owners = {anchor: level for level in self.source.levels.values() for anchor in level.anchors}
        moved: set[str] = set(locations)
        for i, element in self.source.lanes:
            self.source.count_unknown_members(element, "lanes")
            ends = references(element.get("anchors"), f"navigation.guided.lanes.{i}.anchors", 2)
            moved.update(ends)
            for end, other in (ends, ends[::-1]):
                if end in self.source.cabins and other in owners:
                    owners[other].cabins.add(end)
        inside = {anchor for level in self.source.levels.values() for anchor in level.cabins}
        for anchor in locations.keys() & self.source.cabins.keys() - inside:
            served = self.source.cabins[anchor].visits
            self.source.levels[served[0] if served else next(iter(self.source.levels))].cabins.add(anchor)
        for level in self.source.levels.values():
            fixed = {
                a for kind in ("walls", "doors", "floors") for _, s in self.source.items(level, kind) for a in s[0]
            }
            names = [a for a in level.anchors if a in moved or a not in fixed]
            names += sorted(level.cabins, key=int)
            node_names = []
            for anchor in names:
                name = text(locations[anchor][0][1].get("name"), "locations") if anchor in locations else ""
                name = "" if name == UNNAMED else name
                node_names.append(common.short(name) or f"{common.short(level.name, 200)}/{anchor}")
            ids = unique_ids(node_names, taken)
            taken.update(ids)
            level.nodes = dict(zip(names, ids, strict=True))
            for anchor in names:
                self.source.homes.setdefault(anchor, []).append(level)
        dangling = {
            i: element
            for anchor, listed in locations.items()
            if anchor not in self.source.homes
            for i, element in listed
        }
        if dangling:
            self.source.keep_document("locations", dangling)

    def _node(
        self,
        level: SourceLevel,
        anchor: str,
        k: int,
        locations: Sequence[tuple[str, Mapping[str, Any]]],
        dock: str | None,
    ) -> dict[str, Any]:
        p: dict[str, Any] = {"kind": "node"}
        source_properties: dict[str, Any] = {"anchor": int(anchor)}
        parameters: dict[str, Any] = {}
        source: Any = level.element.get("anchors")
        if anchor in level.cabins:
            lift = self.source.cabins[anchor]
            parameters["lift_cabin"] = [1, lift.name]
            source = lift.element["cabin_anchors"]
            source_properties["lift"] = lift.name
        if "Translate2D" not in (raw := source[anchor]):
            source_properties["says"] = raw
        for i, element in locations:
            location = f"navigation.guided.locations.{i}"
            name = text(element.get("name"), f"{location}.name")
            if name and name != UNNAMED:
                p.setdefault("name", name)
            for m, tag in enumerate(element.get("tags") or []):
                tag_name, _ = variant(tag, f"{location}.tags[{m}]")
                if tag_name in _TAGS:
                    parameters[_TAGS[tag_name]] = [4, True]
            if (mutex := self._mutex(element, location)) is not None:
                parameters["mutex"] = [1, mutex]
        if dock is not None:
            parameters["dock_name"] = [1, dock]
        if locations:
            source_properties["locations"] = {
                i: {k: v for k, v in element.items() if k != "anchor"} for i, element in locations
            }
        p[BUILDING] = {"index": k, **({"parameters": parameters} if parameters else {})}
        p[NAME] = source_properties
        return p

    def _mutex(self, element: Mapping[str, Any], location: str) -> str | None:
        group = element.get("mutex")
        return None if group is None else self.source.mutexes.get(reference(group, f"{location}.mutex"))

    def _edges(self, rows: dict[str, list[tuple[str, Any, Properties]]], taken: set[str]) -> dict[tuple[str, str], str]:
        """Add the lanes as edges to the rows of their levels; return the docks by level and anchor."""
        docks: dict[tuple[str, str], str] = {}
        dangling: dict[str, Any] = {}
        counts: Counter[str] = Counter()
        edges: list[tuple[str, str, Any, Properties]] = []
        several = 0
        for i, element in self.source.lanes:
            location = f"navigation.guided.lanes.{i}"
            ends = references(element.get("anchors"), f"{location}.anchors", 2)
            homes = self._levels_of_ends(ends)
            if homes is None:
                dangling[i] = element
                continue
            level, target = homes
            xyz = np.array([self._node_place(home, end) for home, end in zip(homes, ends, strict=True)])
            if target is not level or xyz[:, 2].any():
                xyz[:, 2] += [home.elevation for home in homes]
            line = xyz if target is not level or xyz[:, 2].any() else xyz[:, :2]
            graph, graphs = vocabulary.parse_graphs(element.get("graphs"), self.source.graphs, f"{location}.graphs")
            several += graphs > 1
            for both, motion, backward in self._motions(element, location):
                mirrored = both and backward
                a, b = (1, 0) if backward else (0, 1)
                source, end = homes[a].nodes[ends[a]], homes[b].nodes[ends[b]]
                counts[level.id] += not mirrored
                orientation, limit = motion_properties(motion, location)
                mutex = self._mutex(element, location)
                parameters: dict[str, Any] = {
                    "bidirectional": [4, both],
                    "graph_idx": [2, graph],
                    "orientation": [1, common.reverse_orientation(orientation) if mirrored else orientation],
                    **({} if mutex is None else {"mutex": [1, mutex]}),
                    **({"speed_limit": [3, limit]} if limit else {}),
                }
                if motion.get("dock") is not None:
                    dock = mapping(motion["dock"], f"{location}.dock")
                    docks[homes[b].id, ends[b]] = text(dock.get("name"), f"{location}.dock.name")
                lane_properties = {"index": counts[level.id] - 1, "parameters": parameters}
                if mirrored:
                    lane_properties["reverse"] = True
                p: dict[str, Any] = {"kind": "edge", **({"speed_limit": limit} if limit else {})}
                p |= {"source": source, "target": end, BUILDING: lane_properties}
                p[NAME] = {"lane": int(i), "says": {k: v for k, v in element.items() if k != "anchors"}}
                if backward:
                    p[NAME]["reverse"] = True
                edges.append((level.id, common.short(f"{source}_{end}", 490), segments(line[[a]], line[[b]])[0], p))
        names = unique_ids((name for _, name, _, _ in edges), taken)
        taken.update(names)
        for name, (home, _, geometry, edge) in zip(names, edges, strict=True):
            rows[home].append((name, geometry, edge))
        if dangling:
            self.source.keep_document("lanes", dangling)
        if several:
            problem = (
                f"{several} lanes belong to several graphs; buildings and navigation graphs have them in the first only"
            )
            self.source.context.warn(problem, where="navigation.guided.lanes")
        return docks

    def _motions(self, element: Mapping[str, Any], location: str) -> Iterable[tuple[bool, Mapping[str, Any], bool]]:
        """Iterate over (is part of a building's two-way lane, motion, backward) of a lane's directions."""
        forward = mapping(element.get("forward"), f"{location}.forward")
        name, content = variant(element.get("reverse", "Same"), f"{location}.reverse")
        if name not in ("Same", "Disable", "Different"):
            raise_unreadable(f"must be Same, Disable or Different, got {name[:40]!r}", f"{location}.reverse")
        back = forward if name == "Same" else mapping(content, f"{location}.reverse")
        forth_words, back_words = (motion_properties(motion, location) for motion in (forward, back))
        both = name != "Disable" and back_words == (common.reverse_orientation(forth_words[0]), forth_words[1])
        yield both, forward, False
        if name != "Disable":
            yield both, back, True

    def _levels_of_ends(self, ends: Sequence[str]) -> tuple[SourceLevel, SourceLevel] | None:
        """Return the levels of a lane's start and end."""
        first, second = (self.source.homes.get(end, []) for end in ends)
        both = next((level for level in first if ends[1] in level.nodes), None)
        if both is not None:
            return both, both
        return (first[0], second[0]) if first and second else None

    def _robots_by_anchor(self) -> dict[tuple[str, str], dict[str, Any]]:
        """Find the robots that start at a location, by level and anchor."""
        out: dict[tuple[str, str], dict[str, Any]] = {}
        for level in self.source.levels.values():
            listed = [a for a in level.nodes if a in level.anchors]
            if not self.source.robots or not listed:
                continue
            tree = shapely.STRtree(points(np.array([level.anchors[a][:2] for a in listed])))
            for i, element, description in self.source.instances(level):
                if str(element.get("description")) not in self.source.robots:
                    continue
                now = vocabulary.pose(element.get("pose"), f"model_instances.{i}.pose")
                near = tree.query_nearest(shapely.Point(now[:2]), max_distance=SAME_PLACE, all_matches=False)
                anchor = listed[int(near[0])] if len(near) else None
                name = text(element.get("name"), f"model_instances.{i}.name")
                if anchor is None or (level.id, anchor) in out or not name:
                    continue
                members = {k: v for k, v in element.items() if k not in ("parent", "name")}
                model = model_name(description, f"model_instances.{i}")
                out[level.id, anchor] = {"id": int(i), "name": name, "says": members, "model_name": model}
        self.source.placed_robots = {robot["id"] for robot in out.values()}
        return out


def motion_properties(motion: Mapping[str, Any], location: str) -> tuple[str, float]:
    """Return (orientation as in a building, speed limit or 0) of a motion along a lane."""
    name, content = variant(motion.get("orientation_constraint") or "None", f"{location}.orientation_constraint")
    if name in ("RelativeYaw", "AbsoluteYaw"):
        vocabulary.angle(content, f"{location}.orientation_constraint")
    elif name not in _ORIENTATIONS and name != "None":
        raise_unreadable(f"unknown orientation constraint {name[:40]!r}", location)
    limit = motion.get("speed_limit")
    return _ORIENTATIONS.get(name, ""), 0.0 if limit is None else max(0.0, number(limit, f"{location}.speed_limit"))
