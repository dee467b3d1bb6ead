"""map.site.json, map.site.ron: the sites of Open-RMF's site editor, which takes the place of traffic editor's building.

A site has levels with anchors (places in metres), and walls, doors, floors and drawings on them; lifts, whose cabins
have anchors of their own; models; and, for all levels together, the navigation graphs with lanes and locations.
Releases of the editor up to 2024 wrote RON, later ones write JSON; both are read, and members that only the older
ones have. ``geographic_offset`` is the latitude and longitude of (0, 0), whose +y axis the editor takes as UTM's north.

Canonical: as a building (``openrmf``), in its words, so that either format is written from the other, and
navigation graphs from both. An anchor is a node unless only walls, doors or floors stand on it, called by its location,
else ``<level>/<id>``; an anchor in a lift's cabin is a node on each level from which a lane leads to it. A lane is an
edge there and, unless its reverse is disabled, one back. What only a site says of an item stands in its
``properties.rmf_site``, of a level and of the site in the documents' ``rmf_site``: ``{site, level, order}``.

Source: open-rmf/rmf_site, crates/rmf_site_format; crates/rmf_site_editor/src/site (lift.rs, georeference.rs, save.rs).
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import shapely

from app.formats import Claims, Files, Format, LayerRequirements, ReadContext, Selection, Traits, register
from app.formats._network import number
from app.formats.rmf import common
from app.formats.rmf.common import BUILDING, NAV_GRAPH, Array, mapping, raise_unreadable
from app.formats.rmf.images import companion_hook, images
from app.formats.rmf.site import rules as _rmf_site_rules
from app.formats.rmf.site import vocabulary
from app.formats.rmf.site.vocabulary import (
    NAME,
    UNNAMED,
    Cabin,
    elements,
    members_by_id,
    place,
    reference,
    references,
    text,
    unknown,
    variant,
)
from app.formats.rmf.site.writing import FILE, FILE_RON, WriteOptions, write
from app.model.features import Features, Properties, features, points, segments, unique_ids
from app.model.frame import GROUND, Datum, Level
from app.model.layers import NETWORK, Layers, Part, PartKey, Resources
from app.syntax import json, ron

_VERSION = re.compile(r"(\d{1,6})\.(\d{1,6})")
_TAGS: Mapping[str, str] = {
    "Charger": "is_charger",
    "ParkingSpot": "is_parking_spot",
    "HoldingPoint": "is_holding_point",
}
_ORIENTATIONS: Mapping[str, str] = {"Forwards": "forward", "Backwards": "backward"}
_LISTS = frozenset({"anchors", "doors", "floors", "walls", "models", "drawings"})
"""What of a level is items; all else of it stays in the document."""

SAME_PLACE = 1e-3
"""Metres between a robot and the location that it starts at."""


@dataclass(slots=True)
class _Level:
    """A level as its file says it.

    anchors: [x, y, z] by id. nodes: id of a node by its anchor. cabins: anchors in lifts that are nodes of the level.
    """

    id: str
    name: str
    order: int
    said: dict[str, Any]
    elevation: float
    anchors: dict[str, list[float]]
    nodes: dict[str, str] = field(default_factory=dict)
    cabins: set[str] = field(default_factory=set)

    @property
    def location(self) -> str:
        return f"levels.{self.id}"


@dataclass(slots=True)
class _Lift:
    id: str
    name: str
    said: dict[str, Any]
    cabin: Cabin
    visits: list[str]


def read(files: Files, context: ReadContext) -> Layers:
    """Topology and objects for each level, the drawings that were uploaded with the site, and its datum.

    Raises UnreadableFile naming the place.
    """
    main = context.main or next(iter(files))
    data = files[main]
    top = ron.load(data, context.limits) if _is_ron(main, data) else json.load(data, context.limits)
    if not isinstance(top, dict):
        raise_unreadable("must be a site: a mapping with format_version and levels", "")
    reader = _Reader(top, context)
    parts = reader.parts()
    pictures = images(files, main, list(reader.drawings()), context)
    if pictures and context.wants("resources"):
        parts[PartKey("resources", GROUND, BUILDING)] = Resources(pictures)
    parts = {key: part for key, part in parts.items() if context.wants(key.layer)}
    levels = tuple(Level(level.name, level.elevation) for level in reader.levels.values())
    return Layers(parts, reader.datum(), levels)


def _is_ron(name: str, data: bytes) -> bool:
    start = data[:4096].removeprefix(b"\xef\xbb\xbf").lstrip()[:1]
    return start in (b"(", b"#", b"/") or (start != b"{" and name.lower().endswith(".ron"))


class _Reader:
    """A site being read."""

    def __init__(self, top: dict[str, Any], context: ReadContext) -> None:
        self.top, self.context = top, context
        self.unknown_members: Counter[str] = Counter()
        self._version()
        self.site_anchors = self._anchors(top.get("anchors"), "anchors")
        self.levels = self._levels()
        guided = mapping(mapping(top.get("navigation"), "navigation").get("guided"), "navigation.guided")
        self.guided = guided
        location = "navigation.guided"
        self.lanes = elements(guided.get("lanes"), f"{location}.lanes")
        self.locations = elements(guided.get("locations"), f"{location}.locations")
        graphs = elements(guided.get("graphs"), f"{location}.graphs")
        self.graphs = vocabulary.graph_numbers(graphs, references(guided.get("ranking") or [], f"{location}.ranking"))
        self.mutexes = {
            i: text(element.get("name"), f"{location}.mutex_groups.{i}.name")
            for i, element in elements(guided.get("mutex_groups"), f"{location}.mutex_groups")
        }
        self.lifts = [self._lift(i, element) for i, element in elements(top.get("lifts"), "lifts")]
        self.cabins = {
            anchor: lift
            for lift in self.lifts
            for anchor in mapping(lift.said.get("cabin_anchors"), f"lifts.{lift.id}.cabin_anchors")
        }
        self.homes: dict[str, list[_Level]] = {}
        self.textures = dict(elements(top.get("textures"), "textures"))
        self.groups = dict(elements(top.get("fiducial_groups"), "fiducial_groups"))
        self.descriptions = dict(elements(top.get("model_descriptions"), "model_descriptions"))
        self.robots = dict(elements(top.get("robots"), "robots"))
        for i, scenario in elements(top.get("scenarios"), "scenarios"):
            mapping(scenario.get("instances"), f"scenarios.{i}.instances")
        self.dangling: dict[str, dict[str, Any]] = {}
        self.placed = self._models_by_level()
        for section in ("", "properties", "navigation"):
            self._count_unknown_members(mapping(top.get(section), section) if section else top, section)
        self._count_unknown_members(guided, "navigation.guided")

    # what stands where

    def _version(self) -> None:
        version = self.top.get("format_version")
        match = _VERSION.fullmatch(version) if isinstance(version, str) else None
        if match is None:
            raise_unreadable(f'must be a text "major.minor", is {str(version)[:40]!r}', "format_version")
        if int(match[1]) > 0:
            raise_unreadable(
                f"version {version} is not supported, only 0.x: save the site with a release that writes 0.x",
                "format_version",
            )

    def _count_unknown_members(self, element: Mapping[str, Any], section: str) -> None:
        """Count members that no release has."""
        for member in unknown(element, section):
            self.unknown_members[f"{section}: {member[:60]}" if section else member[:60]] += 1

    def _anchors(self, anchors: Any, location: str) -> dict[str, list[float]]:
        return {key: place(raw, "General", f"{location}.{key}") for key, raw in members_by_id(anchors, location)}

    def _levels(self) -> dict[str, _Level]:
        listed = elements(self.top.get("levels"), "levels")
        if not listed:
            raise_unreadable("a site needs at least one level", "levels")
        if self.context.level != GROUND:
            problem = f"its levels have names of their own: level={self.context.level} is not used"
            self.context.warn(problem, where="levels")
        properties = [mapping(level.get("properties"), f"levels.{i}.properties") for i, level in listed]
        level_names = []
        for (i, level), p in zip(listed, properties, strict=True):
            self._count_unknown_members(level, "levels")
            self._count_unknown_members(p, "levels.properties")
            level_names.append(common.short(text(p.get("name"), f"levels.{i}.properties.name")) or f"level {i}")
        names = unique_ids(level_names)
        if twice := sorted({a for a, b in zip(level_names, names, strict=True) if a != b}):
            self.context.warn(f"levels have the same name: {', '.join(twice[:5])}; they get a number", where="levels")
        return {
            i: _Level(
                i,
                name,
                order,
                level,
                number(p.get("elevation", 0.0), f"levels.{i}.properties.elevation"),
                self._anchors(level.get("anchors"), f"levels.{i}.anchors"),
            )
            for order, ((i, level), p, name) in enumerate(zip(listed, properties, names, strict=True))
        }

    def datum(self) -> Datum | None:
        """The place on earth of (0, 0); a warning where it is not the environment's."""
        offset = mapping(self.top.get("properties"), "properties").get("geographic_offset")
        location = "properties.geographic_offset"
        if offset is None:
            return None
        latitude, longitude = vocabulary.vector(mapping(offset, location).get("anchor"), 2, f"{location}.anchor")
        datum = self.context.frame.datum if self.context.frame is not None else None
        if datum is None:
            return Datum(latitude, longitude)
        near = abs(datum.latitude - latitude) < 1e-5 and abs(datum.longitude - longitude) < 1e-5
        if not near:  # the editor keeps single precision: a metre or so
            self.context.warn(
                f"its place {latitude!r}, {longitude!r} is not the environment's datum {datum.latitude!r}, "
                f"{datum.longitude!r}, which stays: change the environment's datum, or the site",
                where=location,
            )
        return None

    def _lift(self, i: str, lift: dict[str, Any]) -> _Lift:
        location = f"lifts.{i}"
        self._count_unknown_members(lift, "lifts")
        properties = mapping(lift.get("properties"), f"{location}.properties")
        ends = references(properties.get("reference_anchors"), f"{location}.properties.reference_anchors", 2)
        at = []
        for anchor in ends:
            raw = mapping(self.top.get("anchors"), "anchors").get(anchor)
            if raw is None:
                raise_unreadable(f"there is no anchor {anchor} of the site", f"{location}.properties.reference_anchors")
            at.append(place(raw, "Lift", f"anchors.{anchor}"))
        name = common.short(text(properties.get("name"), f"{location}.properties.name")) or f"lift {i}"
        visits: list[str] = []
        for key, door in elements(lift.get("cabin_doors"), f"{location}.cabin_doors"):
            visits += references(door.get("visits", []), f"{location}.cabin_doors.{key}.visits")
        served = [level for level in self.levels if level in visits]
        cabin = vocabulary.parse_cabin(properties, at[0], at[1], f"{location}.properties")
        return _Lift(i, name, lift, cabin, served)

    # the parts

    def parts(self) -> dict[PartKey, Part]:
        """A network and objects for each level."""
        taken: set[str] = set()
        networks = self._networks(taken)
        lifts: dict[str, list[tuple[str, Any, Properties]]] = {}
        for k, lift in enumerate(self.lifts):
            home, row = self._lift_row(k, lift)
            lifts.setdefault(home, []).append(row)
        objects = {i: [*self._objects(level), *lifts.get(i, [])] for i, level in self.levels.items()}
        building = self._building()
        out: dict[PartKey, Part] = {}
        site = {
            **{k: v for k, v in self.top.items() if k not in ("levels", "lifts", "model_instances", "navigation")},
            "navigation": {
                **{k: v for k, v in mapping(self.top.get("navigation"), "navigation").items() if k != "guided"},
                "guided": {k: v for k, v in self.guided.items() if k not in ("lanes", "locations")},
            },
        }
        if self.placed:
            site["models"] = sorted(int(i) for listed in self.placed.values() for i, _ in listed)
        if self.dangling:
            site["dangling"] = self.dangling
        digest = vocabulary.digest(site)
        for i, level in self.levels.items():
            document = {BUILDING: building[i], NAME: {"of": digest, **self._document(level)}}
            if not level.order:
                document[NAME]["site"] = site
            out[PartKey("topology", level.name, NETWORK)] = networks[i].with_document(document)
            out[PartKey("objects", level.name, BUILDING)] = features(objects[i], "local", document)
        if not taken:  # nothing of the network is there: a map of this family alone, and of no other
            for level in self.levels.values():
                network = out.pop(PartKey("topology", level.name, NETWORK))
                out[PartKey("topology", level.name, BUILDING)] = network
        self._warn_unknown()
        return out

    def _warn_unknown(self) -> None:
        for member, count in sorted(self.unknown_members.items()):
            times = f" ({count} times)" if count > 1 else ""
            self.context.warn(f"unknown member {member!r}{times}: it is kept for the way back and not understood")

    def _document(self, level: _Level) -> dict[str, Any]:
        """What of a level is no item, and what its items do not say."""
        members = {key: value for key, value in level.said.items() if key not in _LISTS}
        members["id"] = level.id
        drawings: dict[str, Any] = {}
        for i, drawing in elements(level.said.get("drawings"), f"{level.location}.drawings"):
            location = f"{level.location}.drawings.{i}"
            drawings[i] = {k: v for k, v in drawing.items() if k not in ("anchors", "fiducials", "measurements")}
            drawings[i]["transform"] = self._transform(drawing, location)
            used: set[str] = set()
            for key, one in elements(drawing.get("measurements"), f"{location}.measurements"):
                used.update(references(one.get("anchors"), f"{location}.measurements.{key}.anchors", 2))
            used |= {str(one.get("anchor")) for _, one in elements(drawing.get("fiducials"), f"{location}.fiducials")}
            drawings[i]["anchors"] = {
                a: raw for a, raw in mapping(drawing.get("anchors"), location).items() if a not in used
            }
        forms = {
            anchor: raw
            for anchor, raw in mapping(level.said.get("anchors"), f"{level.location}.anchors").items()
            if anchor not in level.nodes and "Translate2D" not in raw
        }
        return {"level": members, "drawings": drawings, "forms": forms, "order": level.order}

    # the network

    def _networks(self, taken: set[str]) -> dict[str, Features]:
        locations = self._locations()
        self._name_nodes(locations, taken)
        rows: dict[str, list[tuple[str, Any, Properties]]] = {i: [] for i in self.levels}
        docks = self._edges(rows, taken)
        robots = self._robots_by_anchor()
        out = {}
        for i, level in self.levels.items():
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

    def _node_place(self, level: _Level, anchor: str) -> list[float]:
        """[x, y, height above the level] of a node."""
        if anchor in level.anchors:
            return level.anchors[anchor]
        lift = self.cabins[anchor]
        raw = lift.said["cabin_anchors"][anchor]
        return [*lift.cabin.outward(place(raw, "General", f"lifts.{lift.id}.cabin_anchors.{anchor}")), 0.0]

    def _locations(self) -> dict[str, list[tuple[str, dict[str, Any]]]]:
        """The locations by anchor."""
        out: dict[str, list[tuple[str, dict[str, Any]]]] = {}
        for i, element in self.locations:
            self._count_unknown_members(element, "locations")
            anchor = reference(element.get("anchor"), f"navigation.guided.locations.{i}.anchor")
            out.setdefault(anchor, []).append((i, element))
        return out

    def _name_nodes(self, locations: Mapping[str, Sequence[tuple[str, Mapping[str, Any]]]], taken: set[str]) -> None:
        """Which anchors of which levels are nodes, and their ids."""
        owners = {anchor: level for level in self.levels.values() for anchor in level.anchors}
        moved: set[str] = set(locations)
        for i, element in self.lanes:
            self._count_unknown_members(element, "lanes")
            ends = references(element.get("anchors"), f"navigation.guided.lanes.{i}.anchors", 2)
            moved.update(ends)
            for end, other in (ends, ends[::-1]):
                if end in self.cabins and other in owners:
                    owners[other].cabins.add(end)
        inside = {anchor for level in self.levels.values() for anchor in level.cabins}
        for anchor in locations.keys() & self.cabins.keys() - inside:
            served = self.cabins[anchor].visits
            self.levels[served[0] if served else next(iter(self.levels))].cabins.add(anchor)
        for level in self.levels.values():
            fixed = {a for kind in ("walls", "doors", "floors") for _, s in self._items(level, kind) for a in s[0]}
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
                self.homes.setdefault(anchor, []).append(level)
        dangling = {
            i: element for anchor, listed in locations.items() if anchor not in self.homes for i, element in listed
        }
        if dangling:
            self._keep_document("locations", dangling)

    def _keep_document(self, section: str, items: dict[str, Any]) -> None:
        self.dangling.setdefault(section, {}).update(items)
        problem = f"{len(items)} stand on no anchor of a level or a lift's cabin: they are kept for the way back only"
        self.context.warn(problem, where=f"navigation.guided.{section}")

    def _node(
        self,
        level: _Level,
        anchor: str,
        k: int,
        locations: Sequence[tuple[str, Mapping[str, Any]]],
        dock: str | None,
    ) -> dict[str, Any]:
        p: dict[str, Any] = {"kind": "node"}
        source_properties: dict[str, Any] = {"anchor": int(anchor)}
        parameters: dict[str, Any] = {}
        source: Any = level.said.get("anchors")
        if anchor in level.cabins:
            lift = self.cabins[anchor]
            parameters["lift_cabin"] = [1, lift.name]
            source = lift.said["cabin_anchors"]
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
        return None if group is None else self.mutexes.get(reference(group, f"{location}.mutex"))

    def _edges(self, rows: dict[str, list[tuple[str, Any, Properties]]], taken: set[str]) -> dict[tuple[str, str], str]:
        """The lanes as edges in the rows of their levels; gives the docks by level and anchor."""
        docks: dict[tuple[str, str], str] = {}
        dangling: dict[str, Any] = {}
        counts: Counter[str] = Counter()
        edges: list[tuple[str, str, Any, Properties]] = []
        several = 0
        for i, element in self.lanes:
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
            graph, graphs = vocabulary.parse_graphs(element.get("graphs"), self.graphs, f"{location}.graphs")
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
            self._keep_document("lanes", dangling)
        if several:
            problem = f"{several} lanes are of several graphs; a building and navigation graphs have them in the first"
            self.context.warn(problem, where="navigation.guided.lanes")
        return docks

    def _motions(self, element: Mapping[str, Any], location: str) -> Iterable[tuple[bool, Mapping[str, Any], bool]]:
        """(whether a building's two-way lane says it, motion, backward) of a lane's one or two directions."""
        forward = mapping(element.get("forward"), f"{location}.forward")
        name, content = variant(element.get("reverse", "Same"), f"{location}.reverse")
        if name not in ("Same", "Disable", "Different"):
            raise_unreadable(f"must be Same, Disable or Different, is {name[:40]!r}", f"{location}.reverse")
        back = forward if name == "Same" else mapping(content, f"{location}.reverse")
        forth_words, back_words = (motion_properties(motion, location) for motion in (forward, back))
        both = name != "Disable" and back_words == (common.reverse_orientation(forth_words[0]), forth_words[1])
        yield both, forward, False
        if name != "Disable":
            yield both, back, True

    def _levels_of_ends(self, ends: Sequence[str]) -> tuple[_Level, _Level] | None:
        """The levels of a lane's start and end."""
        first, second = (self.homes.get(end, []) for end in ends)
        both = next((level for level in first if ends[1] in level.nodes), None)
        if both is not None:
            return both, both
        return (first[0], second[0]) if first and second else None

    # objects

    def _items(self, level: _Level, section: str) -> list[tuple[str, tuple[list[str], dict[str, Any]]]]:
        """(id, (anchors, what else it says)) of walls, doors and floors."""
        out = []
        for i, element in elements(level.said.get(section), f"{level.location}.{section}"):
            location = f"{level.location}.{section}.{i}.anchors"
            out.append((i, (references(element.get("anchors"), location, None if section == "floors" else 2), element)))
        return out

    def _raw_anchor(self, level: _Level, anchor: str) -> Any:
        for home in (level.said.get("anchors"), self.top.get("anchors")):
            if isinstance(home, dict) and anchor in home:
                return home[anchor]
        return None

    def _objects(self, level: _Level) -> list[tuple[str, Any, Properties]]:
        rows: list[tuple[str, Any, Properties]] = []
        for section, kind, category in (
            ("walls", "wall", "Wall"),
            ("doors", "door", "Door"),
            ("floors", "floor", "Floor"),
        ):
            for k, (i, (anchors, element)) in enumerate(self._items(level, section)):
                self._count_unknown_members(element, section)
                raws = [self._raw_anchor(level, a) for a in anchors]
                if any(raw is None for raw in raws):
                    raise_unreadable(
                        "stands on anchors that neither its level nor the site has", f"{level.location}.{section}.{i}"
                    )
                at = np.array([place(raw, category, "anchors")[:2] for raw in raws]).reshape(-1, 2)
                location = f"{level.location}.{section}.{i}"
                p = self._solid(kind, k, element, location)
                members = {key: value for key, value in element.items() if key not in ("anchors", "name")}
                p[NAME] = {"id": int(i), "anchors": [int(a) for a in anchors], "says": members}
                rows.append((self._id(level, kind, i), shapely.LineString(at) if kind != "floor" else _ring(at), p))
        return [*rows, *self._read_drawn(level), *self._models(level)]

    def _id(self, level: _Level, kind: str, i: str) -> str:
        return f"{common.short(level.name, 200)}/{kind}/{i}"

    def _solid(self, kind: str, k: int, element: Mapping[str, Any], location: str) -> dict[str, Any]:
        p: dict[str, Any] = {"kind": kind}
        parameters: dict[str, Any] = {}
        if kind == "door":
            name = text(element.get("name"), f"{location}.name")
            if name:
                p["name"] = name
            parameters = vocabulary.door_parameters(element.get("kind"), f"{location}.kind")
            parameters["name"] = [1, name]
        elif element.get("texture") is not None:
            group = self.textures.get(reference(element["texture"], f"{location}.texture"))
            parameters = vocabulary.texture_parameters(group, kind) if group is not None else {}
        if kind != "floor":
            for key, member in (("height", "top"), ("base", "bottom")):
                height = vocabulary.height(element.get(member), f"{location}.{member}")
                if height is not None and height > 0:
                    p[key] = height
        p[BUILDING] = {"index": k, "parameters": parameters}
        return p

    def drawings(self) -> Iterable[tuple[str, str]]:
        """(place, file) of the images that are named on this machine."""
        for level in self.levels.values():
            for i, drawing in elements(level.said.get("drawings"), f"{level.location}.drawings"):
                location = f"{level.location}.drawings.{i}.properties.source"
                kind, name = vocabulary.asset(mapping(drawing.get("properties"), location).get("source"), location)
                if name and kind in ("Local", "Remote"):
                    yield location, name

    def _primary(self, level: _Level) -> str | None:
        """The drawing that a building would have."""
        listed = dict(elements(level.said.get("drawings"), f"{level.location}.drawings"))
        rankings = mapping(level.said.get("rankings"), f"{level.location}.rankings").get("drawings") or []
        ranked = references(rankings, f"{level.location}.rankings.drawings")
        return next((i for i in ranked if i in listed), next(iter(listed), None))

    def _transform(self, drawing: Mapping[str, Any], location: str) -> list[float]:
        """[scale, rotation, x, y] from a drawing's pixels (y up) to metres.

        Measurements that say the same scale in double precision say it better than pixels_per_meter.
        """
        p = mapping(drawing.get("properties"), f"{location}.properties")
        pixels = number(p.get("pixels_per_meter", 100.0), f"{location}.properties.pixels_per_meter")
        if not 1e-6 <= pixels <= 1e9:
            raise_unreadable("must be between 1e-6 and 1e9", f"{location}.properties.pixels_per_meter")
        x, y, _, _, _, yaw = vocabulary.pose(p.get("pose"), f"{location}.properties.pose")
        anchors = self._anchors(drawing.get("anchors"), f"{location}.anchors")
        scales = []
        for k, m in elements(drawing.get("measurements"), f"{location}.measurements"):
            a, b = references(m.get("anchors"), f"{location}.measurements.{k}.anchors", 2)
            if m.get("distance") is not None and a in anchors and b in anchors:
                length = math.dist(anchors[a][:2], anchors[b][:2])
                scales.append(
                    number(m["distance"], f"{location}.measurements.{k}.distance") / length if length else 0.0
                )
        mean = sum(scales) / len(scales) if scales else 0.0
        scale = mean if abs(mean * pixels - 1.0) < vocabulary.SINGLE_PRECISION else 1.0 / pixels
        return [scale, yaw, x, y]

    def _read_drawn(self, level: _Level) -> list[tuple[str, Any, Properties]]:
        """The measurements and fiducials of a level's drawings, in metres."""
        rows: list[tuple[str, Any, Properties]] = []
        counts: Counter[str] = Counter()
        for i, drawing in elements(level.said.get("drawings"), f"{level.location}.drawings"):
            location = f"{level.location}.drawings.{i}"
            self._count_unknown_members(drawing, "drawings")
            transform = self._transform(drawing, location)
            anchors = self._anchors(drawing.get("anchors"), f"{location}.anchors")
            at = {key: pixels_to_metres(transform, place_) for key, place_ in anchors.items()}

            def places(ids: Sequence[str], path: str, at: Mapping[str, Array] = at) -> list[Array]:
                if any(a not in at for a in ids):
                    raise_unreadable("stands on anchors that its drawing does not have", path)
                return [at[a] for a in ids]

            for section, kind in (("measurements", "measurement"), ("fiducials", "fiducial")):
                for key, one in elements(drawing.get(section), f"{location}.{section}"):
                    self._count_unknown_members(one, section)
                    item_location = f"{location}.{section}.{key}"
                    p: dict[str, Any] = {"kind": kind, BUILDING: {"index": counts[kind]}}
                    counts[kind] += 1
                    if kind == "measurement":
                        ids = references(one.get("anchors"), f"{item_location}.anchors", 2)
                        geometry = shapely.LineString(places(ids, item_location))
                        distance = one.get("distance")
                        parameters = (
                            {} if distance is None else {"distance": [3, number(distance, f"{item_location}.distance")]}
                        )
                        p[BUILDING]["parameters"] = parameters
                    else:
                        ids = [reference(one.get("anchor"), f"{item_location}.anchor")]
                        geometry = shapely.Point(places(ids, item_location)[0])
                        if one.get("affiliation") is not None:
                            group = self.groups.get(reference(one["affiliation"], f"{item_location}.affiliation"), {})
                            p["name"] = text(group.get("name"), "fiducial_groups")
                    members = {k: v for k, v in one.items() if k not in ("anchor", "anchors")}
                    p[NAME] = {"id": int(key), "drawing": int(i), "anchors": [int(a) for a in ids], "says": members}
                    rows.append((self._id(level, kind, key), geometry, p))
        return rows

    # models and robots

    def _instances(self, level: _Level) -> list[tuple[str, dict[str, Any], dict[str, Any]]]:
        """(id, instance, description) of the level's models; older releases say both at once, below the level."""
        out = []
        for i, element in self.placed.get(level.id, []):
            key = element.get("description")
            description_id = None if key is None else reference(key, f"model_instances.{i}.description")
            out.append((i, element, self.descriptions.get(description_id or "", {})))
        older = elements(level.said.get("models"), f"{level.location}.models")
        return out + [(i, element, element) for i, element in older]

    def _models_by_level(self) -> dict[str, list[tuple[str, dict[str, Any]]]]:
        """The models by the level that they stand on."""
        out: dict[str, list[tuple[str, dict[str, Any]]]] = {}
        for i, element in elements(self.top.get("model_instances"), "model_instances"):
            parent = reference(element.get("parent"), f"model_instances.{i}.parent")
            if parent not in self.levels:
                self.dangling.setdefault("model_instances", {})[i] = element
            out.setdefault(parent, []).append((i, element))
        return out

    def _robots_by_anchor(self) -> dict[tuple[str, str], dict[str, Any]]:
        """The robots that start at a location, by level and anchor."""
        out: dict[tuple[str, str], dict[str, Any]] = {}
        for level in self.levels.values():
            listed = [a for a in level.nodes if a in level.anchors]
            if not self.robots or not listed:
                continue
            tree = shapely.STRtree(points(np.array([level.anchors[a][:2] for a in listed])))
            for i, element, description in self._instances(level):
                if str(element.get("description")) not in self.robots:
                    continue
                now = vocabulary.pose(element.get("pose"), f"model_instances.{i}.pose")
                near = tree.query_nearest(shapely.Point(now[:2]), max_distance=SAME_PLACE, all_matches=False)
                anchor = listed[int(near[0])] if len(near) else None
                name = text(element.get("name"), f"model_instances.{i}.name")
                if anchor is None or (level.id, anchor) in out or not name:
                    continue
                members = {k: v for k, v in element.items() if k not in ("parent", "name")}
                model = _model_name(description, f"model_instances.{i}")
                out[level.id, anchor] = {"id": int(i), "name": name, "says": members, "model_name": model}
        self.placed_robots = {robot["id"] for robot in out.values()}
        return out

    def _models(self, level: _Level) -> list[tuple[str, Any, Properties]]:
        rows: list[tuple[str, Any, Properties]] = []
        for i, element, description in self._instances(level):
            if int(i) in self.placed_robots:
                continue
            location = f"model_instances.{i}"
            self._count_unknown_members(element, "model_instances")
            x, y, z, *turn = vocabulary.pose(element.get("pose"), f"{location}.pose")
            name = text(element.get("name"), f"{location}.name")
            p: dict[str, Any] = {
                "kind": "robot" if str(element.get("description")) in self.robots else "model",
                **({"name": name} if name else {}),
                "pose": [x, y, z + level.elevation, *turn],
                BUILDING: {
                    "index": len(rows),
                    "says": {
                        "model_name": _model_name(description, location),
                        "static": description.get("is_static") is True,
                    },
                },
                NAME: {"id": int(i), "says": {k: v for k, v in element.items() if k not in ("parent", "name")}},
            }
            rows.append((self._id(level, "model", i), shapely.Point(x, y), p))
        return rows

    # lifts

    def _lift_row(self, k: int, lift: _Lift) -> tuple[str, tuple[str, Any, Properties]]:
        """(level, row) of a lift; it stands on its initial level, else on the lowest that it visits."""
        properties = mapping(lift.said.get("properties"), f"lifts.{lift.id}.properties")
        location = f"lifts.{lift.id}"
        rect = vocabulary.rectangle(properties, location)
        initial = properties.get("initial_level")
        home = None if initial is None else reference(initial, f"{location}.properties.initial_level")
        floors = sorted(lift.visits or self.levels, key=lambda i: self.levels[i].elevation)
        level = self.levels[home if home in self.levels else floors[0]]
        doors: dict[str, Any] = {}
        served: dict[str, list[str]] = {self.levels[i].name: [] for i in lift.visits}
        door_elements = dict(elements(lift.said.get("cabin_doors"), f"{location}.cabin_doors"))
        for face in vocabulary.FACES:
            door = vocabulary.cabin_door(rect, face, f"{location}.properties.cabin.{face}")
            if door is None:
                continue
            doors[face] = door
            key = reference(rect[face].get("door"), f"{location}.properties.cabin.{face}.door")
            for visit in references(
                door_elements.get(key, {}).get("visits", []), f"{location}.cabin_doors.{key}.visits"
            ):
                if visit in self.levels:
                    served[self.levels[visit].name].append(face)
        says = {
            "doors": doors,
            "level_doors": served,
            "reference_floor_name": level.name,
            "initial_floor_name": level.name if home is not None else "",
            "lowest_floor": self.levels[floors[0]].name,
            "highest_floor": self.levels[floors[-1]].name,
            "plugins": properties.get("is_static") is not True,
        }
        cabin = lift.cabin
        members = {
            **lift.said,
            "cabin_anchors": {
                a: raw for a, raw in mapping(lift.said.get("cabin_anchors"), location).items() if a not in self.homes
            },
        }
        p = {
            "kind": "lift",
            "name": lift.name,
            "size": vocabulary.cabin_size(cabin),
            "pose": [cabin.x, cabin.y, level.elevation, 0.0, 0.0, cabin.yaw],
            BUILDING: {"index": k, "says": says},
            NAME: {"id": int(lift.id), "says": members, "was": [*cabin.pose, cabin.depth, cabin.width]},
        }
        return level.id, (self._id(level, "lift", lift.id), shapely.Point(cabin.x, cabin.y), p)

    # as a building

    def _building(self) -> dict[str, dict[str, Any]]:
        """What a building's documents would say: pixels where each level has a drawing, else metres."""
        name = text(mapping(self.top.get("properties"), "properties").get("name"), "properties.name")
        drawings: dict[str, tuple[list[float], str]] = {}
        for i, level in self.levels.items():
            primary = self._primary(level)
            if primary is None:
                continue
            members = mapping(level.said["drawings"], "drawings")[primary]
            location = f"{level.location}.drawings.{primary}"
            _, file = vocabulary.asset(mapping(members.get("properties"), location).get("source"), location)
            drawings[i] = self._transform(members, location), file
        drawn = len(drawings) == len(self.levels)
        system = "reference_image" if drawn else "cartesian_meters"
        building: dict[str, Any] = {"name": name, "coordinate_system": system}
        straight = [i for i, (turn, _) in drawings.items() if turn[1:] == [0.0, 0.0, 0.0]]
        if drawn and straight:
            building["reference_level_name"] = self.levels[straight[0]].name
        out: dict[str, dict[str, Any]] = {}
        for i, level in self.levels.items():
            members = {"elevation": level.elevation}
            out[i] = {"building": building, "level": members, "order": level.order}
            if i in drawings:
                out[i]["transform"], file = drawings[i]
                members["drawing"] = {"filename": file}
        return out


def motion_properties(motion: Mapping[str, Any], location: str) -> tuple[str, float]:
    """(orientation in a building's words, speed limit or 0) of a motion along a lane."""
    name, content = variant(motion.get("orientation_constraint") or "None", f"{location}.orientation_constraint")
    if name in ("RelativeYaw", "AbsoluteYaw"):
        vocabulary.angle(content, f"{location}.orientation_constraint")
    elif name not in _ORIENTATIONS and name != "None":
        raise_unreadable(f"unknown orientation constraint {name[:40]!r}", location)
    limit = motion.get("speed_limit")
    return _ORIENTATIONS.get(name, ""), 0.0 if limit is None else max(0.0, number(limit, f"{location}.speed_limit"))


def pixels_to_metres(transform: Sequence[float], at: Sequence[float]) -> Array:
    """Metres of a drawing's pixel (y up)."""
    scale, turn, x, y = transform
    c, s = scale * math.cos(turn), scale * math.sin(turn)
    return np.array([c * at[0] - s * at[1] + x, s * at[0] + c * at[1] + y])


def _ring(at: Array) -> Any:
    """A polygon; where there are too few corners for one, its points."""
    if not len(at):
        return None
    closed = (at[0] == at[-1]).all()
    return shapely.MultiPoint(at) if len(at) < (4 if closed else 3) else shapely.Polygon(at)


def _model_name(description: Mapping[str, Any], location: str) -> str:
    """The name that a building would find the model by."""
    if "source" not in description:
        return ""
    kind, name = vocabulary.asset(description["source"], f"{location}.source")
    if kind == "Search":
        return name
    parts = [part for part in name.split("/") if part and "." not in part]
    return parts[-1] if parts else name


# --- the format ------------------------------------------------------------------------------------------------------

_JSON_SITE = re.compile(rb'"format_version"\s*:\s*"')
_RON_SITE = re.compile(rb'\bformat_version\s*:\s*"')
_OF_SITE = re.compile(rb'[\s,{("](?:levels|navigation|geographic_offset|model_instances)"?\s*:')


def detect(name: str, data: bytes) -> bool:
    """JSON or RON with a format's version and what only a site has."""
    low = name.lower()
    if low.endswith(".json"):
        return bool(_JSON_SITE.search(data) and _OF_SITE.search(data))
    return low.endswith(".ron") and bool(_RON_SITE.search(data) and _OF_SITE.search(data))


def options_from_filename(name: str) -> dict[str, str]:
    """``map.site.ron`` asks for RON."""
    return {"encoding": "ron" if name.endswith(".ron") else "json"} if name.endswith((".ron", ".json")) else {}


def choose(keys: Sequence[PartKey], options: Any) -> Sequence[PartKey]:  # noqa: ARG001 - one signature for all formats
    """The networks, the objects that came from Open-RMF, and the drawings."""
    return [
        key
        for key in keys
        if key.layer == "topology"
        or (key.layer == "objects" and key.name in (BUILDING, NAV_GRAPH))
        or (key.layer == "resources" and key.name == BUILDING)
    ]


register(
    Format(
        name=NAME,
        title="Site (Open-RMF site editor)",
        files={FILE: "application/json", FILE_RON: "text/plain"},
        layers=frozenset({"topology", "objects", "resources"}),
        detect=detect,
        read=read,
        check=_rmf_site_rules.check,
        write=write,
        needs=LayerRequirements(one_of=(frozenset({"topology"}),), also=frozenset({"objects", "resources"})),
        write_options=WriteOptions,
        extensions=(".site.json", ".site.ron", ".json", ".ron"),
        selection=Selection(choose=choose, from_filename=options_from_filename),
        claims=Claims(
            priority=45, companions=companion_hook(re.compile(rb'\b(?:Local|Remote)"?\s*[:(]\s*"([^"\n]{1,500})"'))
        ),
        traits=Traits(family=BUILDING, keeps_bends="nodes", has_title=True),
    )
)
