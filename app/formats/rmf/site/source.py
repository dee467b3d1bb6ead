"""Validated site file: levels, lifts, drawings and site-wide data."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from app.formats import ReadContext
from app.formats._network import number
from app.formats.rmf import common
from app.formats.rmf.common import mapping, raise_unreadable
from app.formats.rmf.site import vocabulary
from app.formats.rmf.site.vocabulary import Cabin, elements, members_by_id, place, reference, references, text, unknown
from app.model.features import unique_ids
from app.model.frame import GROUND, Datum

_VERSION = re.compile(r"(\d{1,6})\.(\d{1,6})")


@dataclass(slots=True)
class SourceLevel:
    """Level as read from the file.

    anchors: [x, y, z] by id. nodes: node id by anchor. cabins: anchors in lifts that are nodes of the level.
    """

    id: str
    name: str
    order: int
    element: dict[str, Any]
    elevation: float
    anchors: dict[str, list[float]]
    nodes: dict[str, str] = field(default_factory=dict)
    cabins: set[str] = field(default_factory=set)

    @property
    def location(self) -> str:
        """Return its location in the file, for messages."""
        return f"levels.{self.id}"


@dataclass(slots=True)
class SourceLift:
    """Lift as read from the file. visits: ids of the levels that it serves."""

    id: str
    name: str
    element: dict[str, Any]
    cabin: Cabin
    visits: list[str]


class Source:
    """Site as read from the file, with the data that all levels share."""

    def __init__(self, top: dict[str, Any], context: ReadContext) -> None:
        self.top, self.context = top, context
        self.unknown_members: Counter[str] = Counter()
        self._version()
        self.site_anchors = self.parse_anchors(top.get("anchors"), "anchors")
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
            for anchor in mapping(lift.element.get("cabin_anchors"), f"lifts.{lift.id}.cabin_anchors")
        }
        self.homes: dict[str, list[SourceLevel]] = {}
        self.placed_robots: set[int] = set()
        self.textures = dict(elements(top.get("textures"), "textures"))
        self.groups = dict(elements(top.get("fiducial_groups"), "fiducial_groups"))
        self.descriptions = dict(elements(top.get("model_descriptions"), "model_descriptions"))
        self.robots = dict(elements(top.get("robots"), "robots"))
        for i, scenario in elements(top.get("scenarios"), "scenarios"):
            mapping(scenario.get("instances"), f"scenarios.{i}.instances")
        self.dangling: dict[str, dict[str, Any]] = {}
        self.placed = self._models_by_level()
        for section in ("", "properties", "navigation"):
            self.count_unknown_members(mapping(top.get(section), section) if section else top, section)
        self.count_unknown_members(guided, "navigation.guided")

    def _version(self) -> None:
        version = self.top.get("format_version")
        match = _VERSION.fullmatch(version) if isinstance(version, str) else None
        if match is None:
            raise_unreadable(f'must be a string "major.minor", got {str(version)[:40]!r}', "format_version")
        if int(match[1]) > 0:
            raise_unreadable(
                f"version {version} is not supported, only 0.x: save the site with a release that writes 0.x",
                "format_version",
            )

    def count_unknown_members(self, element: Mapping[str, Any], section: str) -> None:
        """Count members that no release of the format has."""
        for member in unknown(element, section):
            self.unknown_members[f"{section}: {member[:60]}" if section else member[:60]] += 1

    def parse_anchors(self, anchors: Any, location: str) -> dict[str, list[float]]:
        """Parse anchors to [x, y, z] by id."""
        return {key: place(raw, "General", f"{location}.{key}") for key, raw in members_by_id(anchors, location)}

    def _levels(self) -> dict[str, SourceLevel]:
        listed = elements(self.top.get("levels"), "levels")
        if not listed:
            raise_unreadable("a site needs at least one level", "levels")
        if self.context.level != GROUND:
            problem = f"the file names its own levels; level={self.context.level} is ignored"
            self.context.warn(problem, where="levels")
        properties = [mapping(level.get("properties"), f"levels.{i}.properties") for i, level in listed]
        level_names = []
        for (i, level), p in zip(listed, properties, strict=True):
            self.count_unknown_members(level, "levels")
            self.count_unknown_members(p, "levels.properties")
            level_names.append(common.short(text(p.get("name"), f"levels.{i}.properties.name")) or f"level {i}")
        names = unique_ids(level_names)
        if twice := sorted({a for a, b in zip(level_names, names, strict=True) if a != b}):
            self.context.warn(
                f"duplicate level names: {', '.join(twice[:5])}; a number makes them unique", where="levels"
            )
        return {
            i: SourceLevel(
                i,
                name,
                order,
                level,
                number(p.get("elevation", 0.0), f"levels.{i}.properties.elevation"),
                self.parse_anchors(level.get("anchors"), f"levels.{i}.anchors"),
            )
            for order, ((i, level), p, name) in enumerate(zip(listed, properties, names, strict=True))
        }

    def datum(self) -> Datum | None:
        """Return the geographic position of (0, 0); warn if it differs from the environment's datum."""
        offset = mapping(self.top.get("properties"), "properties").get("geographic_offset")
        location = "properties.geographic_offset"
        if offset is None:
            return None
        latitude, longitude = vocabulary.vector(mapping(offset, location).get("anchor"), 2, f"{location}.anchor")
        datum = self.context.frame.datum if self.context.frame is not None else None
        if datum is None:
            return Datum(latitude, longitude)
        near = abs(datum.latitude - latitude) < 1e-5 and abs(datum.longitude - longitude) < 1e-5
        if not near:  # the editor's single precision is about a metre
            self.context.warn(
                f"the site's origin {latitude!r}, {longitude!r} differs from the environment's datum "
                f"{datum.latitude!r}, {datum.longitude!r}, which is kept; change the environment's datum or the site",
                where=location,
            )
        return None

    def _lift(self, i: str, lift: dict[str, Any]) -> SourceLift:
        location = f"lifts.{i}"
        self.count_unknown_members(lift, "lifts")
        properties = mapping(lift.get("properties"), f"{location}.properties")
        ends = references(properties.get("reference_anchors"), f"{location}.properties.reference_anchors", 2)
        at = []
        for anchor in ends:
            raw = mapping(self.top.get("anchors"), "anchors").get(anchor)
            if raw is None:
                raise_unreadable(f"unknown anchor {anchor} of the site", f"{location}.properties.reference_anchors")
            at.append(place(raw, "Lift", f"anchors.{anchor}"))
        name = common.short(text(properties.get("name"), f"{location}.properties.name")) or f"lift {i}"
        visits: list[str] = []
        for key, door in elements(lift.get("cabin_doors"), f"{location}.cabin_doors"):
            visits += references(door.get("visits", []), f"{location}.cabin_doors.{key}.visits")
        served = [level for level in self.levels if level in visits]
        cabin = vocabulary.parse_cabin(properties, at[0], at[1], f"{location}.properties")
        return SourceLift(i, name, lift, cabin, served)

    def warn_unknown(self) -> None:
        """Warn about the unknown members."""
        for member, count in sorted(self.unknown_members.items()):
            times = f" ({count} times)" if count > 1 else ""
            self.context.warn(f"unknown member {member!r}{times}; it is stored and written back unchanged")

    def keep_document(self, section: str, items: dict[str, Any]) -> None:
        """Store items without an anchor in the document, to be written back, and warn."""
        self.dangling.setdefault(section, {}).update(items)
        problem = (
            f"{len(items)} items use no anchor of a level or a lift's cabin; they are stored for writing back only"
        )
        self.context.warn(problem, where=f"navigation.guided.{section}")

    def items(self, level: SourceLevel, section: str) -> list[tuple[str, tuple[list[str], dict[str, Any]]]]:
        """Return (id, (anchors, other members)) of walls, doors and floors."""
        out = []
        for i, element in elements(level.element.get(section), f"{level.location}.{section}"):
            location = f"{level.location}.{section}.{i}.anchors"
            out.append((i, (references(element.get("anchors"), location, None if section == "floors" else 2), element)))
        return out

    def drawings(self) -> Iterable[tuple[str, str]]:
        """Iterate over (location, file name) of the images with a local source."""
        for level in self.levels.values():
            for i, drawing in elements(level.element.get("drawings"), f"{level.location}.drawings"):
                location = f"{level.location}.drawings.{i}.properties.source"
                kind, name = vocabulary.asset(mapping(drawing.get("properties"), location).get("source"), location)
                if name and kind in ("Local", "Remote"):
                    yield location, name

    def primary(self, level: SourceLevel) -> str | None:
        """Return the level's drawing for a building: the highest-ranked, else the first, or None."""
        listed = dict(elements(level.element.get("drawings"), f"{level.location}.drawings"))
        rankings = mapping(level.element.get("rankings"), f"{level.location}.rankings").get("drawings") or []
        ranked = references(rankings, f"{level.location}.rankings.drawings")
        return next((i for i in ranked if i in listed), next(iter(listed), None))

    def transform(self, drawing: Mapping[str, Any], location: str) -> list[float]:
        """Return [scale, rotation, x, y] from a drawing's pixels (y up) to metres.

        Measurements take precedence if they give the same scale: they have double precision, pixels_per_meter has not.
        """
        p = mapping(drawing.get("properties"), f"{location}.properties")
        pixels = number(p.get("pixels_per_meter", 100.0), f"{location}.properties.pixels_per_meter")
        if not 1e-6 <= pixels <= 1e9:
            raise_unreadable("must be between 1e-6 and 1e9", f"{location}.properties.pixels_per_meter")
        x, y, _, _, _, yaw = vocabulary.pose(p.get("pose"), f"{location}.properties.pose")
        anchors = self.parse_anchors(drawing.get("anchors"), f"{location}.anchors")
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

    def instances(self, level: SourceLevel) -> list[tuple[str, dict[str, Any], dict[str, Any]]]:
        """Return (id, instance, description) of the level's models.

        Older releases store instance and description as one element below the level.
        """
        out = []
        for i, element in self.placed.get(level.id, []):
            key = element.get("description")
            description_id = None if key is None else reference(key, f"model_instances.{i}.description")
            out.append((i, element, self.descriptions.get(description_id or "", {})))
        older = elements(level.element.get("models"), f"{level.location}.models")
        return out + [(i, element, element) for i, element in older]

    def _models_by_level(self) -> dict[str, list[tuple[str, dict[str, Any]]]]:
        """Group the models by their level."""
        out: dict[str, list[tuple[str, dict[str, Any]]]] = {}
        for i, element in elements(self.top.get("model_instances"), "model_instances"):
            parent = reference(element.get("parent"), f"model_instances.{i}.parent")
            if parent not in self.levels:
                self.dangling.setdefault("model_instances", {})[i] = element
            out.setdefault(parent, []).append((i, element))
        return out
