"""Reading a building: its levels as networks, objects and floor plans."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

import numpy as np
import shapely

from app.errors import Invalid
from app.formats import Files, ReadContext, _fields
from app.formats.rmf import common
from app.formats.rmf.building.coordinates import (
    DEGREE_SYSTEMS,
    IMAGE,
    SYSTEMS,
    Scaling,
    Transform,
    to_canonical,
    transforms,
)
from app.formats.rmf.building.vocabulary import LINES, LISTS, NAME, RINGS, SHAPE
from app.formats.rmf.common import Array, index, listing, mapping, number, parameter_value, raise_unreadable
from app.formats.rmf.images import images
from app.model.features import (
    Features,
    Properties,
    features,
    from_columns,
    points,
    segments,
    shared_key_dict,
    unique_ids,
)
from app.model.frame import GROUND, Level
from app.model.geodesy import check_crs
from app.model.layers import NETWORK, Layers, Part, PartKey, Resources
from app.syntax import yaml


@dataclass(slots=True)
class _Level:
    """Level as read from the file.

    raw: float64 [n, 2] as in the file; at: the same in metres or degrees; ids: node ids of the vertices.
    """

    name: str
    order: int
    members: dict[str, Any]
    raw: Array
    rows: list[Any]
    elevation: float
    transform: Transform = field(default_factory=Transform)
    at: Array = field(default_factory=lambda: np.empty((0, 2)))
    ids: list[str] = field(default_factory=list)
    dangling: dict[str, list[Any]] = field(default_factory=dict)

    def location_of(self, section: str, k: int) -> str:
        return f"levels.{self.name}.{section}[{k}]"


def read(files: Files, context: ReadContext) -> Layers:
    """Read topology and objects of each level, and the named images as resources.

    Coordinates are local metres, or degrees if the building's are. Raises UnreadableFile with the location.
    """
    main = context.main or next(iter(files))
    top = yaml.load(files[main], context.limits)
    if not isinstance(top, dict):
        raise_unreadable("must be a mapping with levels", "")
    _fields.check(top, SHAPE, context)
    _check_crs(top.get("parameters"))
    raw_value = mapping(top.get("levels"), "levels")
    if not raw_value:
        raise_unreadable("a building needs at least one level", "levels")
    system = top.get("coordinate_system", IMAGE)
    if system not in SYSTEMS:
        raise_unreadable(f"must be one of {', '.join(SYSTEMS)}, got {str(system)[:80]!r}", "coordinate_system")
    levels = {name: _level(name, k, one) for k, (name, one) in enumerate(raw_value.items())}
    if context.level != GROUND:
        context.warn(f"the file names its own levels; level={context.level} is ignored", where="levels")
    reference = _reference(top, levels)
    if system == IMAGE:
        scaling = {name: _scaling(level) for name, level in levels.items()}
        level_transforms = transforms(
            scaling, reference, lambda problem, location: context.warn(problem, where=location)
        )
        for name, level in levels.items():
            level.transform = level_transforms[name]
    taken: set[str] = set()
    for level in levels.values():
        level.at = to_canonical(system, level.raw, level.transform)
        level.ids = _node_ids(level, taken)
        taken.update(level.ids)
    building = {key: value for key, value in top.items() if key not in ("levels", "lifts")}
    reader = _Reader(system, context, levels, reference)
    parts: dict[PartKey, Part] = {}
    lifts = reader.lifts(mapping(top.get("lifts"), "lifts"))
    del top, raw_value  # so that each level can free what has been read
    for level in levels.values():
        network = reader.topology(level, taken)
        objects = reader.objects(level, lifts.get(level.name, []))
        document = {NAME: reader.document(level, building)}
        parts[PartKey("topology", level.name, NETWORK)] = network.with_document(document)
        parts[PartKey("objects", level.name, NAME)] = objects.with_document(document)
    if not taken:  # without a network the map is a map of this format only
        for level in levels.values():
            parts[PartKey("topology", level.name, NAME)] = parts[PartKey("topology", level.name, NETWORK)]
    named = [
        (f"levels.{level.name}.{key}.filename", raw_value)
        for level in levels.values()
        for key, raw_value in named_images(level.members)
    ]
    pictures = images(files, main, named, context)
    if pictures and context.wants("resources"):
        parts[PartKey("resources", GROUND, NAME)] = Resources(pictures)
    parts = {key: part for key, part in parts.items() if context.wants(key.layer)}
    return Layers(parts, None, tuple(Level(level.name, level.elevation) for level in levels.values()))


def _check_crs(parameters: Any) -> None:
    """Reject a building that names an unknown CRS."""
    crs = parameter_value(parameters, "generate_crs") if isinstance(parameters, dict) else None
    if crs not in (None, ""):
        try:
            check_crs(str(crs))
        except Invalid as error:
            raise_unreadable(error.detail, "parameters.generate_crs")


def _level(name: str, order: int, members: Any) -> _Level:
    location = f"levels.{name}"
    one = dict(mapping(members, location))
    rows = listing(one.pop("vertices", None), f"{location}.vertices")
    raw = common.places(rows, f"{location}.vertices")
    elevation = number(one.get("elevation", 0.0) or 0.0, f"{location}.elevation")
    return _Level(name, order, one, raw, rows, elevation)


def _reference(top: Mapping[str, Any], levels: Mapping[str, _Level]) -> str:
    raw_value = top.get("reference_level_name")
    if raw_value is None or raw_value == "":
        return next(iter(levels))
    name = raw_value if isinstance(raw_value, str) else yaml.text(raw_value)
    if name not in levels:
        raise_unreadable(f"unknown level {name[:80]!r}", "reference_level_name")
    return name


def _scaling(level: _Level) -> Scaling:
    measurements = []
    for k, row in enumerate(listing(level.members.get("measurements"), f"levels.{level.name}.measurements")):
        i, j, parameters, _ = _edge(row, level.location_of("measurements", k))
        if 0 <= i < len(level.raw) and 0 <= j < len(level.raw):
            metres = number(parameter_value(parameters, "distance"), f"{level.location_of('measurements', k)}.distance")
            measurements.append((math.dist(level.raw[i], level.raw[j]), metres))
    rows = listing(level.members.get("fiducials"), f"levels.{level.name}.fiducials")
    at = common.places(rows, f"levels.{level.name}.fiducials")
    names = [plain_text(row[2]) if len(row) > 2 else "" for row in rows]
    return Scaling(measurements, [(name, x, -y) for name, (x, y) in zip(names, at.tolist(), strict=True)])


def _edge(row: Any, location: str) -> tuple[int, int, dict[str, Any], list[Any]]:
    """Parse a row ``[i, j, {…}, …]`` into (start, end, parameters, further values)."""
    if not isinstance(row, list) or len(row) < 2:
        raise_unreadable("must be a list [vertex, vertex, {parameters}]", location)
    parameters = mapping(row[2] if len(row) > 2 else None, f"{location}[2]")
    return index(row[0], f"{location}[0]"), index(row[1], f"{location}[1]"), parameters, row[3:]


def plain_text(value: Any) -> str:
    """Convert a scalar to text; None becomes an empty text."""
    return value if isinstance(value, str) else "" if value is None else yaml.text(value)


def _node_ids(level: _Level, taken: set[str]) -> list[str]:
    names = []
    for k, row in enumerate(level.rows):
        name = row[3] if len(row) > 3 else ""
        if isinstance(name, (list, dict)):
            raise_unreadable("the name of a vertex must be a string", f"{level.location_of('vertices', k)}[3]")
        names.append(common.short(plain_text(name)) or f"{common.short(level.name, 200)}/{k}")
    return unique_ids(names, taken)


class _Reader:
    """Reader of a building; holds what its levels share."""

    def __init__(self, system: str, context: ReadContext, levels: Mapping[str, _Level], reference: str) -> None:
        self.system, self.context, self.levels, self.reference = system, context, levels, reference
        self.degrees = system in DEGREE_SYSTEMS

    def document(self, level: _Level, building: dict[str, Any]) -> dict[str, Any]:
        """Build the collection document of a level's parts."""
        extra_members = {key: value for key, value in level.members.items() if key not in LISTS}
        out: dict[str, Any] = {"building": building, "level": extra_members, "order": level.order}
        if self.system == IMAGE:
            out["transform"] = level.transform.as_list()
        if level.dangling:
            out["dangling"] = level.dangling
        return out

    def topology(self, level: _Level, taken: set[str]) -> Features:
        """Convert vertices to nodes and lanes to directed edges."""
        sources, targets, lanes = self._lanes(level)
        properties: list[Properties] = []
        heights = np.zeros(len(level.rows))
        names = Counter[str]()
        named, nameless, index_template = (
            shared_key_dict("kind", "name", NAME),
            shared_key_dict("kind", NAME),
            shared_key_dict("index"),
        )
        for k, row in enumerate(level.rows):
            node_properties = (named if len(row) > 3 and row[3] != "" else nameless).copy()
            node_properties["kind"] = "node"
            source_properties = index_template.copy()
            source_properties["index"] = k
            if len(row) > 3 and row[3] != "":
                node_properties["name"] = plain_text(row[3])
                names[node_properties["name"]] += 1
                if not isinstance(row[3], str):
                    source_properties["name"] = row[3]
            if len(row) > 2 and row[2] != 0:
                heights[k] = number(row[2], f"{level.location_of('vertices', k)}[2]")
            if len(row) > 4 and row[4]:
                parameters = mapping(row[4], f"{level.location_of('vertices', k)}[4]")
                source_properties["parameters"] = parameters
                node_properties |= common.area_property(parameters, typed=True)
            if len(row) > 5:
                source_properties["more"] = row[5:]
            node_properties[NAME] = source_properties
            properties.append(node_properties)
        twice = sorted(name for name, count in names.items() if count > 1)
        if twice:
            self.context.warn(
                f"{len(twice)} duplicate vertex names: {', '.join(twice[:5])}; robots cannot tell them apart",
                where=f"levels.{level.name}.vertices",
            )
        geometry = points(level.at)
        high = heights != 0
        if high.any():
            geometry[high] = points(np.column_stack([level.at[high], heights[high] + level.elevation]))
        level.rows = []
        edge_names = (
            common.short(f"{level.ids[i]}_{level.ids[j]}", 490) for i, j in zip(sources, targets, strict=True)
        )
        ids = [*level.ids, *unique_ids(edge_names, taken)]
        taken.update(islice(ids, len(level.ids), None))
        properties += lanes
        lines = segments(level.at[sources], level.at[targets]) if sources else np.empty(0, object)
        both = np.concatenate([geometry, lines])
        del lanes, sources, targets, geometry, lines
        return from_columns(ids, both, properties, "wgs84" if self.degrees else "local")

    def _lanes(self, level: _Level) -> tuple[list[int], list[int], list[Properties]]:
        """Return (sources, targets, properties) of the edges; a two-way lane gives two."""
        sources: list[int] = []
        targets: list[int] = []
        out: list[Properties] = []
        unlimited = shared_key_dict("kind", "source", "target", NAME)
        limited = shared_key_dict("kind", "source", "target", NAME, "speed_limit")
        forth, back = shared_key_dict("index", "parameters"), shared_key_dict("index", "parameters", "reverse")

        def edge(i: int, j: int, source_properties: dict[str, Any], limit: float) -> None:
            sources.append(i)
            targets.append(j)
            properties = (limited if limit else unlimited).copy()
            properties["kind"], properties["source"], properties["target"], properties[NAME] = (
                "edge",
                level.ids[i],
                level.ids[j],
                source_properties,
            )
            if limit:
                properties["speed_limit"] = limit
            out.append(properties)

        graphless = loops = 0
        for k, i, j, parameters, more in self._between(level, "lanes"):
            source_properties = forth.copy()
            source_properties["index"], source_properties["parameters"] = k, parameters
            if more:
                source_properties["more"] = more
            speed = parameter_value(parameters, "speed_limit", 0.0)
            limit = 0.0
            if isinstance(speed, (int, float)) and not isinstance(speed, bool) and speed > 0:
                limit = float(speed)
            graphless += parameter_value(parameters, "graph_idx") is None
            loops += i == j
            edge(i, j, source_properties, limit)
            if parameter_value(parameters, "bidirectional") is True:
                reverse = {**source_properties, "reverse": True} if more else back.copy()
                reverse["index"], reverse["parameters"], reverse["reverse"] = k, parameters, True
                edge(j, i, reverse, limit)
        location = f"levels.{level.name}.lanes"
        if loops:
            self.context.warn(f"{loops} lanes lead from a vertex to itself", where=location)
        if graphless:
            problem = f"{graphless} lanes have no graph_idx; they are read as lanes of graph 0"
            self.context.warn(problem, where=location)
        return sources, targets, out

    def _between(self, level: _Level, section: str) -> Iterable[tuple[int, int, int, dict[str, Any], list[Any]]]:
        """Iterate over (index, start, end, parameters, more) of the rows whose vertices exist; frees each row."""
        n = len(level.raw)
        rows = list(listing(level.members.pop(section, None), f"levels.{level.name}.{section}"))
        for k in range(len(rows)):
            row, rows[k] = rows[k], None
            i, j, parameters, more = _edge(row, level.location_of(section, k))
            if 0 <= i < n and 0 <= j < n:
                yield k, i, j, parameters, more
            else:
                level.dangling.setdefault(section, []).append(row)
                problem = (
                    f"joins the vertices {i} and {j}, but the level has {n}; it is stored in the level's document only"
                )
                self.context.warn(problem, where=level.location_of(section, k))

    def objects(self, level: _Level, lifts: list[tuple[str, Any, Properties]]) -> Features:
        """Convert everything but vertices and lanes to objects."""
        rows: list[tuple[str, Any, Properties]] = []
        prefix = common.short(level.name, 200)
        template = shared_key_dict("index", "parameters", "vertices")
        for section, kind in LINES.items():
            for k, i, j, parameters, more in self._between(level, section):
                source_properties = template.copy()
                source_properties["index"], source_properties["parameters"], source_properties["vertices"] = (
                    k,
                    parameters,
                    [i, j],
                )
                if more:
                    source_properties["more"] = more
                properties: dict[str, Any] = {"kind": kind, NAME: source_properties}
                name = parameter_value(parameters, "name")
                if isinstance(name, str) and name:
                    properties["name"] = name
                rows.append((f"{prefix}/{kind}/{k}", shapely.LineString(level.at[[i, j]]), properties))
        for section, kind in RINGS.items():
            for k, one in enumerate(listing(level.members.pop(section, None), f"levels.{level.name}.{section}")):
                location = level.location_of(section, k)
                properties = dict(mapping(one, location))
                corners = listing(properties.pop("vertices", None), f"{location}.vertices")
                ring = [index(v, f"{location}.vertices[{m}]") for m, v in enumerate(corners)]
                valid = [v for v in ring if 0 <= v < len(level.raw)]
                if len(valid) < len(ring):
                    level.dangling.setdefault(section, []).append(one)
                    self.context.warn(
                        "has vertices that do not exist; it is stored in the level's document only", where=location
                    )
                    continue
                source_properties = {"index": k, "vertices": ring, **properties}
                rows.append((f"{prefix}/{kind}/{k}", _ring(level.at[ring]), {"kind": kind, NAME: source_properties}))
        rows += self._models(level, prefix)
        marks = listing(level.members.get("fiducials"), f"levels.{level.name}.fiducials")
        at = self._level_position(common.places(marks, f"levels.{level.name}.fiducials"), level)
        for k, row in enumerate(marks):
            properties = {"kind": "fiducial", NAME: {"index": k, **({"more": row[3:]} if len(row) > 3 else {})}}
            if len(row) > 2:
                properties["name"] = plain_text(row[2])
            rows.append((f"{prefix}/fiducial/{k}", shapely.Point(at[k]), properties))
        return features([*rows, *lifts], "wgs84" if self.degrees else "local")

    def _level_position(self, raw: Array, level: _Level) -> Array:
        return to_canonical(self.system, raw, level.transform)

    def _models(self, level: _Level, prefix: str) -> list[tuple[str, Any, Properties]]:
        listed = listing(level.members.get("models"), f"levels.{level.name}.models")
        raw = np.empty((len(listed), 2))
        for k, one in enumerate(listed):
            location = level.location_of("models", k)
            raw[k] = [number(mapping(one, location).get(axis), f"{location}.{axis}") for axis in "xy"]
        out: list[tuple[str, Any, Properties]] = []
        for k, (one, (x, y)) in enumerate(zip(listed, self._level_position(raw, level).tolist(), strict=True)):
            location = level.location_of("models", k)
            members = {key: value for key, value in one.items() if key not in ("x", "y")}
            z, yaw = number(members.get("z", 0.0), f"{location}.z"), number(members.get("yaw", 0.0), f"{location}.yaw")
            properties: dict[str, Any] = {"kind": "model"}
            if isinstance(members.get("name"), str) and members["name"]:
                properties["name"] = members.pop("name")
            if not self.degrees:
                properties["pose"] = [x, y, z + level.elevation, 0.0, 0.0, yaw + level.transform.rotation]
                members = {key: value for key, value in members.items() if key != "yaw" and (key != "z" or value == 0)}
            properties[NAME] = {"index": k, "says": members}
            out.append((f"{prefix}/model/{k}", shapely.Point(x, y), properties))
        return out

    def lifts(self, listed: Mapping[str, Any]) -> dict[str, list[tuple[str, Any, Properties]]]:
        """Group the lifts by the level of the floor plan that they are drawn on."""
        out: dict[str, list[tuple[str, Any, Properties]]] = {}
        for k, (name, one) in enumerate(listed.items()):
            location = f"lifts.{name}"
            members = dict(mapping(one, location))
            floor = plain_text(members.get("reference_floor_name")) or self.reference
            if floor not in self.levels:
                problem = f"unknown level {floor[:80]!r}; {self.reference} is used"
                self.context.warn(problem, where=f"{location}.reference_floor_name")
                floor = self.reference
            x, y = (number(members.pop(axis, None), f"{location}.{axis}") for axis in "xy")
            yaw = number(members.get("yaw", 0.0), f"{location}.yaw")
            width, depth = (number(members.pop(key, None), f"{location}.{key}") for key in ("width", "depth"))
            at = self._level_position(np.array([[x, y]]), self.levels[floor])[0].tolist()
            properties: dict[str, Any] = {"kind": "lift", "name": name, "size": [width, depth, common.CABIN_HEIGHT]}
            if not self.degrees:
                # The tools do not rotate a lift's yaw with its floor plan.
                properties["pose"] = [*at, self.levels[floor].elevation, 0.0, 0.0, yaw]
                members.pop("yaw", None)
            properties[NAME] = {"index": k, "says": members}
            row = (f"{common.short(floor, 200)}/lift/{common.short(name)}", shapely.Point(at), properties)
            out.setdefault(floor, []).append(row)
        return out


def _ring(at: Array) -> Any:
    """Build a polygon, or points if there are too few corners."""
    if not len(at):
        return None
    closed = (at[0] == at[-1]).all()
    if len(at) < (4 if closed else 3):
        return shapely.MultiPoint(at)
    return shapely.Polygon(at)


def named_images(members: Mapping[str, Any]) -> Iterable[tuple[str, str]]:
    """Iterate over (location, file name) of the images that a level's document names."""
    drawing = members.get("drawing")
    if isinstance(drawing, dict) and isinstance(drawing.get("filename"), str):
        yield "drawing", drawing["filename"]
    layers = members.get("layers")
    for name, layer in layers.items() if isinstance(layers, dict) else ():
        if isinstance(layer, dict) and isinstance(layer.get("filename"), str):
            yield f"layers.{name}", layer["filename"]
