"""building.yaml: the buildings of Open-RMF's traffic editor, with the floor plan images that they name.

A level has vertices ``[x, y, z, name, {parameters}]``; lanes, walls, doors, measurements and human lanes are
``[i, j, {parameters}]`` between vertices, floors and holes rings of them; a parameter is ``[type, value]`` with 1 text,
2 integer, 3 decimal, 4 truth value. What the numbers mean, ``coordinate_system`` says:

* ``reference_image`` (also where the key is absent): pixels, y down. y is negated; the scale is the mean of metres per
  pixel over the measurements of the reference level (``reference_level_name``, else the first); every other level takes
  scale, turn and shift from the fiducials that it shares by name with the reference level, never from its own
  measurements. Without two of them (without measurements) a pixel counts as a metre.
* ``cartesian_meters``: metres, y up; ``offset_x`` and ``offset_y`` are told and not applied.
* ``wgs84``: x is the longitude, y the latitude, degrees.
* ``web_mercator``: the world is 256 wide; x from 0 eastward, y from 0 downward to -256.

Source: open-rmf/rmf_traffic_editor, rmf_building_map_tools/building_map (building.py, level.py, transform.py, lift.py).

Canonical: one part of topology and one of objects for each level. A vertex is a node, called by its name, else
``<level>/<index>``; a lane is an edge, a two-way one two edges that come back as one lane. Walls, doors, floors, holes,
models, lifts, fiducials, measurements and human lanes are objects of these kinds. ``properties.openrmf`` keeps an
item's place in its list (``index``), its ``parameters``, and the ``vertices`` that it stood on. The document's
``openrmf`` is ``{building, level, order, transform}``: the file's top level without levels and lifts, the level without
its lists, its place in the file, and [scale, rotation, x, y] from pixels (y up) to metres. Geometry decides: an item
that was moved by an edit gets vertices where it stands.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby, islice, pairwise
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from app.errors import Invalid, MissingLayer
from app.formats import (
    Claims,
    Files,
    Format,
    LayerRequirements,
    ReadContext,
    Selection,
    Traits,
    WriteContext,
    _fields,
    register,
)
from app.formats._fields import ANGLE, ANY, COORDINATE, LENGTH, NOT_NEGATIVE, SPEED, Number, OneOf, Typed, record
from app.formats._network import get_source_properties
from app.formats.rmf import common
from app.formats.rmf import common as _rmf
from app.formats.rmf.building import rules as _openrmf_rules
from app.formats.rmf.common import (
    BUILDING,
    NAV_GRAPH,
    Array,
    Flow,
    Storey,
    index,
    listing,
    mapping,
    number,
    parameter_value,
    raise_unreadable,
)
from app.formats.rmf.images import companion_hook, find_stored_image, images
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
from app.syntax.decimals import DEGREES, METRES, encode_pieces, numbers

NAME = BUILDING
FILE = "building.yaml"
IMAGE, METRIC, ON_EARTH, MERCATOR = "reference_image", "cartesian_meters", "wgs84", "web_mercator"
SYSTEMS = (IMAGE, METRIC, ON_EARTH, MERCATOR)
DEGREE_SYSTEMS = frozenset({ON_EARTH, MERCATOR})

LINES: Mapping[str, str] = {
    "walls": "wall",
    "doors": "door",
    "measurements": "measurement",
    "human_lanes": "human_lane",
}
RINGS: Mapping[str, str] = {"floors": "floor", "holes": "hole"}
LISTS = frozenset({*LINES, *RINGS, "lanes", "vertices", "models", "fiducials"})
"""What a level says in lists of items; all else of it stays in the document."""

IN_PIXELS = frozenset(
    {
        *("constraints", "drawing", "features", "layers", "lights", "physical_cameras"),
        *("flattened_x_offset", "flattened_y_offset", "x_meters", "y_meters"),
    }
)
"""What a level's document says in pixels of its drawing."""

LIFT_WORDS = frozenset({"x", "y", "yaw", "width", "depth"})
LANE_TEMPLATE: Mapping[str, Any] = {"graph_idx": [2, 0], "orientation": [1, ""], "speed_limit": [3, 0.0]}
DOOR_TEMPLATE: Mapping[str, Any] = {
    "motion_axis": [1, "start"],
    "motion_degrees": [3, 90.0],
    "motion_direction": [2, 1],
    "type": [1, "hinged"],
}

MIN_SCALE = 1e-9
"""Metres per pixel, and pixels per metre: beyond it is a mistake."""

MAX_FIDUCIALS = 200
"""In common between two levels; each is compared with each."""

_EARTH_TURN = 180.0 / 128.0


_LANE = record(
    "mutex demo_mock_floor_name demo_mock_lift_name dock_name",
    bidirectional=Typed(OneOf((True, False))),
    graph_idx=Typed(Number(0, 1000)),
    orientation=Typed(OneOf(("", "forward", "backward"))),
    speed_limit=Typed(SPEED),
    width=Typed(NOT_NEGATIVE),
)
_WALL = record(
    "texture_name",
    alpha=Typed(Number(0.0, 1.0)),
    texture_height=Typed(NOT_NEGATIVE),
    texture_scale=Typed(NOT_NEGATIVE),
    texture_width=Typed(NOT_NEGATIVE),
)
_DOOR = record(
    "name motion_axis plugin",
    motion_degrees=Typed(Number(-360.0, 360.0, unit="degrees")),
    motion_direction=Typed(Number(-1, 1)),
    right_left_ratio=Typed(NOT_NEGATIVE),
    type=Typed(OneOf(("hinged", "double_hinged", "sliding", "double_sliding", "telescope", "double_telescope"))),
)
_VERTEX = record(
    "is_charger is_holding_point is_parking_spot is_passthrough_point is_cleaning_zone dock_name mutex lift_cabin "
    "spawn_robot_name spawn_robot_type pickup_dispenser dropoff_ingestor human_goal_set_name",
    merge_radius=Typed(Number(0.0, 1000.0, unit="metres")),
)
_RING = record(
    "vertices",
    parameters=record(
        "indoor ceiling_texture texture_name",
        texture_rotation=Typed(Number(-360.0, 360.0, unit="degrees")),
        texture_scale=Typed(NOT_NEGATIVE),
        ceiling_scale=Typed(NOT_NEGATIVE),
    ),
)
_LAYER = record(
    "features filename visible",
    color=[Number(0.0, 1.0)],
    transform=record(
        scale=Number(MIN_SCALE, 1 / MIN_SCALE, unit="metres per pixel"),
        translation_x=COORDINATE,
        translation_y=COORDINATE,
        yaw=ANGLE,
    ),
)
_LEVEL = record(
    "constraints drawing features fiducials lights physical_cameras",
    doors=[(ANY, ANY, _DOOR)],
    elevation=COORDINATE,
    flattened_x_offset=COORDINATE,
    flattened_y_offset=COORDINATE,
    floors=[_RING],
    holes=[_RING],
    human_lanes=[(ANY, ANY, _LANE)],
    lanes=[(ANY, ANY, _LANE)],
    layers=record(each=_LAYER),
    measurements=[(ANY, ANY, record(distance=Typed(COORDINATE)))],
    models=[
        record("model_name name static dispensable lift_cabin", x=COORDINATE, y=COORDINATE, z=COORDINATE, yaw=ANGLE)
    ],
    vertices=[(COORDINATE, COORDINATE, COORDINATE, ANY, _VERTEX)],
    walls=[(ANY, ANY, _WALL)],
    x_meters=COORDINATE,
    y_meters=COORDINATE,
)
_LIFT = record(
    "highest_floor initial_floor_name level_doors lowest_floor plugins reference_floor_name",
    depth=LENGTH,
    width=LENGTH,
    x=COORDINATE,
    y=COORDINATE,
    yaw=ANGLE,
    doors=record(
        each=record(door_type=Number(0, 100), motion_axis_orientation=ANGLE, width=LENGTH, x=COORDINATE, y=COORDINATE)
    ),
)
SHAPE = record(
    "coordinate_system crowd_sim graphs name reference_level_name",
    parameters=record(
        "generate_crs", suggested_offset_x=Typed(Number(-1e9, 1e9)), suggested_offset_y=Typed(Number(-1e9, 1e9))
    ),
    levels=record(each=_LEVEL),
    lifts=record(each=_LIFT),
)
"""What a building holds. Source: rmf_traffic_editor's files, and rmf_building_map_tools that reads them."""


# --- from the file's numbers to metres or degrees, and back -----------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Transform:
    """From a drawing's pixels (y up) to local metres: turned, scaled, then shifted."""

    scale: float = 1.0
    rotation: float = 0.0
    shift: tuple[float, float] = (0.0, 0.0)

    def apply(self, xy: Array) -> Array:
        """Metres [n, 2] of pixels [n, 2]."""
        with np.errstate(all="ignore"):  # what is not finite is refused with the item's name
            return np.asarray((xy @ self._matrix().T) * self.scale + np.array(self.shift), np.float64)

    def invert(self, xy: Array) -> Array:
        """Pixels [n, 2] of metres [n, 2]."""
        return np.asarray(((xy - np.array(self.shift)) / self.scale) @ self._matrix(), np.float64)

    def _matrix(self) -> Array:
        c, s = math.cos(self.rotation), math.sin(self.rotation)
        return np.array([[c, -s], [s, c]])

    def as_list(self) -> list[float]:
        """The transform as a document keeps it."""
        return [self.scale, self.rotation, *self.shift]

    def is_close(self, other: Transform) -> bool:
        """Whether both bring a pixel to the same place, to a micrometre or so."""
        moved = max(abs(a - b) for a, b in zip(self.shift, other.shift, strict=True))
        turn = abs(math.remainder(self.rotation - other.rotation, 2 * math.pi))
        return abs(self.scale - other.scale) <= 1e-8 * abs(self.scale) and turn <= 1e-8 and moved <= 1e-6


@dataclass(frozen=True, slots=True)
class Scaling:
    """What of a level decides on transforms: measurements (pixels, metres) and fiducials (name, x, y; y up)."""

    measurements: list[tuple[float, float]]
    fiducials: list[tuple[str, float, float]]


def transforms(levels: Mapping[str, Scaling], reference: str, warn: Callable[[str, str], None]) -> dict[str, Transform]:
    """The transform of each level of a building in pixels, as rmf_building_map_tools computes it.

    warn: called with (problem, place) where the scale cannot be told.
    """
    scales = [metres / pixels for pixels, metres in levels[reference].measurements if pixels > 0 and metres > 0]
    if len(scales) < len(levels[reference].measurements):
        warn("a measurement without length is not used", f"levels.{reference}.measurements")
    if not scales:
        warn("no measurement tells the scale: a pixel is taken as a metre", f"levels.{reference}.measurements")
    scale = sum(scales) / len(scales) if scales else 1.0
    if not MIN_SCALE <= scale <= 1 / MIN_SCALE:
        raise_unreadable(f"gives {scale:g} metres per pixel, which is no scale", f"levels.{reference}.measurements")
    out = {reference: Transform(scale)}
    for name, level in levels.items():
        if name != reference:
            transform = _fit_fiducials(levels[reference].fiducials, level.fiducials, scale)
            if transform is None:
                problem = "shares fewer than two fiducials with the reference level: a pixel is taken as a metre"
                warn(problem, f"levels.{name}.fiducials")
            out[name] = transform or Transform()
    return out


def _fit_fiducials(
    reference: Sequence[tuple[str, float, float]], other: Sequence[tuple[str, float, float]], scale: float
) -> Transform | None:
    """Circular mean of the turns, mean of the relative scales and of the shifts, over pairs of common fiducials."""
    by_name: dict[str, list[tuple[float, float]]] = {}
    for name, x, y in other:
        by_name.setdefault(name, []).append((x, y))
    pairs = ((x, y, *b) for name, x, y in reference for b in by_name.get(name, ()))
    common = np.array(list(islice(pairs, MAX_FIDUCIALS + 1)), np.float64).reshape(-1, 4)
    if len(common) > MAX_FIDUCIALS:
        raise_unreadable(f"two levels have more than {MAX_FIDUCIALS} fiducials in common", "fiducials")
    first, second = np.triu_indices(len(common), 1)
    with np.errstate(all="ignore"):
        step = common[second] - common[first]
        reference_lengths, lengths = np.hypot(step[:, 0], step[:, 1]), np.hypot(step[:, 2], step[:, 3])
        valid = (reference_lengths > 0) & (lengths > 0)
        if not valid.any():
            return None
        step, relative = step[valid], float(np.mean(lengths[valid] / reference_lengths[valid]))
        turn = np.arctan2(step[:, 3], step[:, 2]) - np.arctan2(step[:, 1], step[:, 0])
        rotation = -math.atan2(float(np.sin(turn).sum()), float(np.cos(turn).sum()))
    if not MIN_SCALE <= scale / relative <= 1 / MIN_SCALE:
        raise_unreadable("two levels whose fiducials lie at no common scale", "fiducials")
    turned = Transform(1.0 / relative, rotation).apply(common[:, 2:])
    shift = (common[:, :2] - turned).mean(axis=0) * scale
    return Transform(scale / relative, rotation, (float(shift[0]), float(shift[1])))


def _to_canonical(system: str, raw: Array, transform: Transform) -> Array:
    """Local metres, or longitude and latitude in degrees, of the file's x and y."""
    if system == IMAGE:
        return transform.apply(raw * np.array([1.0, -1.0]))
    if system == MERCATOR:
        north = np.clip(raw[:, 1] / 128.0 + 1.0, -16.0, 16.0)
        latitude: Array = np.degrees(2.0 * np.arctan(np.exp(np.pi * north)) - np.pi / 2.0)
        return np.asarray(np.column_stack([raw[:, 0] * _EARTH_TURN - 180.0, latitude]), np.float64)
    return raw


def _to_file(system: str, at: Array, transform: Transform) -> Array:
    """The reverse of ``_to_canonical``."""
    if system == IMAGE:
        return np.asarray(transform.invert(at) * np.array([1.0, -1.0]), np.float64)
    if system == MERCATOR:
        north = np.arctanh(np.sin(np.radians(np.clip(at[:, 1], -89.9999, 89.9999))))
        return np.asarray(np.column_stack([at[:, 0] / _EARTH_TURN + 128.0, (north / np.pi - 1.0) * 128.0]), np.float64)
    return at


# --- reading ---------------------------------------------------------------------------------------------------------


@dataclass(slots=True)
class _Level:
    """A level as its file says it. raw: float64 [n, 2] as in the file; at: metres or degrees; ids: of the vertices."""

    name: str
    order: int
    said: dict[str, Any]
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
    """Topology and objects for each level, and the images that the file names as resources.

    Coordinates are local metres, or degrees where the building's are. Raises UnreadableFile naming the place.
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
        context.warn(f"its levels have names of their own: level={context.level} is not used", where="levels")
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
        level.at = _to_canonical(system, level.raw, level.transform)
        level.ids = _node_ids(level, taken)
        taken.update(level.ids)
    building = {key: value for key, value in top.items() if key not in ("levels", "lifts")}
    reader = _Reader(system, context, levels, reference)
    parts: dict[PartKey, Part] = {}
    lifts = reader.lifts(mapping(top.get("lifts"), "lifts"))
    del top, raw_value  # each level lets go of what has been read of it
    for level in levels.values():
        network = reader.topology(level, taken)
        objects = reader.objects(level, lifts.get(level.name, []))
        document = {NAME: reader.document(level, building)}
        parts[PartKey("topology", level.name, NETWORK)] = network.with_document(document)
        parts[PartKey("objects", level.name, NAME)] = objects.with_document(document)
    if not taken:  # nothing of the network is there: a map of this format alone, and of no other
        for level in levels.values():
            parts[PartKey("topology", level.name, NAME)] = parts[PartKey("topology", level.name, NETWORK)]
    named = [
        (f"levels.{level.name}.{key}.filename", raw_value)
        for level in levels.values()
        for key, raw_value in _named_images(level.said)
    ]
    pictures = images(files, main, named, context)
    if pictures and context.wants("resources"):
        parts[PartKey("resources", GROUND, NAME)] = Resources(pictures)
    parts = {key: part for key, part in parts.items() if context.wants(key.layer)}
    return Layers(parts, None, tuple(Level(level.name, level.elevation) for level in levels.values()))


def _check_crs(parameters: Any) -> None:
    """Refuse a building whose coordinates are said to be of a CRS that does not exist."""
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
        raise_unreadable(f"names the level {name[:80]!r}, which is not there", "reference_level_name")
    return name


def _scaling(level: _Level) -> Scaling:
    measurements = []
    for k, row in enumerate(listing(level.said.get("measurements"), f"levels.{level.name}.measurements")):
        i, j, parameters, _ = _edge(row, level.location_of("measurements", k))
        if 0 <= i < len(level.raw) and 0 <= j < len(level.raw):
            metres = number(parameter_value(parameters, "distance"), f"{level.location_of('measurements', k)}.distance")
            measurements.append((math.dist(level.raw[i], level.raw[j]), metres))
    rows = listing(level.said.get("fiducials"), f"levels.{level.name}.fiducials")
    at = common.places(rows, f"levels.{level.name}.fiducials")
    names = [_text(row[2]) if len(row) > 2 else "" for row in rows]
    return Scaling(measurements, [(name, x, -y) for name, (x, y) in zip(names, at.tolist(), strict=True)])


def _edge(row: Any, location: str) -> tuple[int, int, dict[str, Any], list[Any]]:
    """(start, end, parameters, what stands behind them) of a row ``[i, j, {…}]``."""
    if not isinstance(row, list) or len(row) < 2:
        raise_unreadable("must be a list [vertex, vertex, {parameters}]", location)
    parameters = mapping(row[2] if len(row) > 2 else None, f"{location}[2]")
    return index(row[0], f"{location}[0]"), index(row[1], f"{location}[1]"), parameters, row[3:]


def _text(value: Any) -> str:
    return value if isinstance(value, str) else "" if value is None else yaml.text(value)


def _node_ids(level: _Level, taken: set[str]) -> list[str]:
    names = []
    for k, row in enumerate(level.rows):
        name = row[3] if len(row) > 3 else ""
        if isinstance(name, (list, dict)):
            raise_unreadable("the name of a vertex must be a text", f"{level.location_of('vertices', k)}[3]")
        names.append(common.short(_text(name)) or f"{common.short(level.name, 200)}/{k}")
    return unique_ids(names, taken)


class _Reader:
    """A building being read: what its levels share."""

    def __init__(self, system: str, context: ReadContext, levels: Mapping[str, _Level], reference: str) -> None:
        self.system, self.context, self.levels, self.reference = system, context, levels, reference
        self.degrees = system in DEGREE_SYSTEMS

    def document(self, level: _Level, building: dict[str, Any]) -> dict[str, Any]:
        """What stands in the documents of a level's parts."""
        extra_members = {key: value for key, value in level.said.items() if key not in LISTS}
        out: dict[str, Any] = {"building": building, "level": extra_members, "order": level.order}
        if self.system == IMAGE:
            out["transform"] = level.transform.as_list()
        if level.dangling:
            out["dangling"] = level.dangling
        return out

    def topology(self, level: _Level, taken: set[str]) -> Features:
        """The vertices as nodes, the lanes as directed edges."""
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
                node_properties["name"] = _text(row[3])
                names[node_properties["name"]] += 1
                if not isinstance(row[3], str):
                    source_properties["name"] = row[3]
            if len(row) > 2 and row[2] != 0:
                heights[k] = number(row[2], f"{level.location_of('vertices', k)}[2]")
            if len(row) > 4 and row[4]:
                source_properties["parameters"] = mapping(row[4], f"{level.location_of('vertices', k)}[4]")
            if len(row) > 5:
                source_properties["more"] = row[5:]
            node_properties[NAME] = source_properties
            properties.append(node_properties)
        twice = sorted(name for name, count in names.items() if count > 1)
        if twice:
            self.context.warn(
                f"{len(twice)} names stand for several vertices: {', '.join(twice[:5])}; robots cannot tell them apart",
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
        """(sources, targets, properties) of the edges, two-way lanes as two."""
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
            problem = f"{graphless} lanes have no graph_idx: they are taken as lanes of graph 0"
            self.context.warn(problem, where=location)
        return sources, targets, out

    def _between(self, level: _Level, section: str) -> Iterable[tuple[int, int, int, dict[str, Any], list[Any]]]:
        """(place in the list, start, end, parameters, more) of the rows whose vertices exist. Each row is let go."""
        n = len(level.raw)
        rows = list(listing(level.said.pop(section, None), f"levels.{level.name}.{section}"))
        for k in range(len(rows)):
            row, rows[k] = rows[k], None
            i, j, parameters, more = _edge(row, level.location_of(section, k))
            if 0 <= i < n and 0 <= j < n:
                yield k, i, j, parameters, more
            else:
                level.dangling.setdefault(section, []).append(row)
                problem = f"joins the vertices {i} and {j}, but the level has {n}: it is kept in the level's document"
                self.context.warn(problem, where=level.location_of(section, k))

    def objects(self, level: _Level, lifts: list[tuple[str, Any, Properties]]) -> Features:
        """Everything but vertices and lanes."""
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
            for k, one in enumerate(listing(level.said.pop(section, None), f"levels.{level.name}.{section}")):
                location = level.location_of(section, k)
                properties = dict(mapping(one, location))
                corners = listing(properties.pop("vertices", None), f"{location}.vertices")
                ring = [index(v, f"{location}.vertices[{m}]") for m, v in enumerate(corners)]
                valid = [v for v in ring if 0 <= v < len(level.raw)]
                if len(valid) < len(ring):
                    level.dangling.setdefault(section, []).append(one)
                    self.context.warn("has vertices that do not exist: kept in the level's document", where=location)
                    continue
                source_properties = {"index": k, "vertices": ring, **properties}
                rows.append((f"{prefix}/{kind}/{k}", _ring(level.at[ring]), {"kind": kind, NAME: source_properties}))
        rows += self._models(level, prefix)
        marks = listing(level.said.get("fiducials"), f"levels.{level.name}.fiducials")
        at = self._level_position(common.places(marks, f"levels.{level.name}.fiducials"), level)
        for k, row in enumerate(marks):
            properties = {"kind": "fiducial", NAME: {"index": k, **({"more": row[3:]} if len(row) > 3 else {})}}
            if len(row) > 2:
                properties["name"] = _text(row[2])
            rows.append((f"{prefix}/fiducial/{k}", shapely.Point(at[k]), properties))
        return features([*rows, *lifts], "wgs84" if self.degrees else "local")

    def _level_position(self, raw: Array, level: _Level) -> Array:
        return _to_canonical(self.system, raw, level.transform)

    def _models(self, level: _Level, prefix: str) -> list[tuple[str, Any, Properties]]:
        listed = listing(level.said.get("models"), f"levels.{level.name}.models")
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
        """The lifts by the level whose floor plan they are drawn on."""
        out: dict[str, list[tuple[str, Any, Properties]]] = {}
        for k, (name, one) in enumerate(listed.items()):
            location = f"lifts.{name}"
            members = dict(mapping(one, location))
            floor = _text(members.get("reference_floor_name")) or self.reference
            if floor not in self.levels:
                problem = f"names the level {floor[:80]!r}, which is not there: {self.reference} is taken"
                self.context.warn(problem, where=f"{location}.reference_floor_name")
                floor = self.reference
            x, y = (number(members.pop(axis, None), f"{location}.{axis}") for axis in "xy")
            yaw = number(members.get("yaw", 0.0), f"{location}.yaw")
            width, depth = (number(members.pop(key, None), f"{location}.{key}") for key in ("width", "depth"))
            at = self._level_position(np.array([[x, y]]), self.levels[floor])[0].tolist()
            properties: dict[str, Any] = {"kind": "lift", "name": name, "size": [width, depth, common.CABIN_HEIGHT]}
            if not self.degrees:
                # The tools take a lift's yaw as it stands, on whatever floor plan it was drawn.
                properties["pose"] = [*at, self.levels[floor].elevation, 0.0, 0.0, yaw]
                members.pop("yaw", None)
            properties[NAME] = {"index": k, "says": members}
            row = (f"{common.short(floor, 200)}/lift/{common.short(name)}", shapely.Point(at), properties)
            out.setdefault(floor, []).append(row)
        return out


def _ring(at: Array) -> Any:
    """A polygon; where there are too few corners for one, its points."""
    if not len(at):
        return None
    closed = (at[0] == at[-1]).all()
    if len(at) < (4 if closed else 3):
        return shapely.MultiPoint(at)
    return shapely.Polygon(at)


# --- floor plan images -----------------------------------------------------------------------------------------------

_FILENAME = re.compile(
    rb"\bfilename[\"']?[ \t]*:[ \t]*(?:\"([^\"\n]{1,500})\"|'([^'\n]{1,500})'|([^\s,}#\"'][^,}#\n]{0,500}))"
)


def _named_images(members: Mapping[str, Any]) -> Iterable[tuple[str, str]]:
    """(place, file name) of the images that a level's document names."""
    drawing = members.get("drawing")
    if isinstance(drawing, dict) and isinstance(drawing.get("filename"), str):
        yield "drawing", drawing["filename"]
    layers = members.get("layers")
    for name, layer in layers.items() if isinstance(layers, dict) else ():
        if isinstance(layer, dict) and isinstance(layer.get("filename"), str):
            yield f"layers.{name}", layer["filename"]


# --- writing ---------------------------------------------------------------------------------------------------------


class _RewriteError(Exception):
    """The levels no longer agree on their coordinates: metres must be written. The text says why."""


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """``building.yaml`` and the images it names, in the coordinates it came in; networks of other formats in metres.

    Raises MissingLayer where there is neither a network nor anything that came from a building.
    """
    storeys = common.storeys(layers)
    if not storeys:
        raise MissingLayer("openrmf needs a network: upload a building.yaml, tmap2 or OSM file")
    resources: dict[str, bytes] = {}
    for part in layers.parts_of("resources", name=NAME).values():
        resources.update(part.files if isinstance(part, Resources) else {})
    buildings: list[dict[str, Any]] = []
    for storey in storeys:
        building = storey.document.get("building")
        if isinstance(building, dict) and building not in buildings:
            buildings.append(building)
    systems = {building.get("coordinate_system", IMAGE) for building in buildings}
    system = systems.pop() if len(systems) == 1 and (len(buildings) == 1 or systems == {METRIC}) else METRIC
    why = "the levels come from different buildings" if len(buildings) > 1 and system == METRIC else ""
    draft = WriteContext(context.title, context.options, context.attribution)
    try:
        files = _Writer(layers, draft, storeys, buildings[0] if buildings else {}, system, resources, why).files()
        context.dropped += draft.dropped
        context.template += draft.template
        context.warnings += draft.warnings
        return files
    except _RewriteError as changed:
        return _Writer(layers, context, storeys, buildings[0], METRIC, resources, str(changed)).files()


Sections = dict[str, list[str]]
"""By name: a level's lists as they are written, in pieces of whole lines."""


def _section_lines(rows: Iterable[str]) -> list[str]:
    """Rows as lines of a section, thousands together: far fewer texts are held than there are rows."""
    left = iter(rows)
    pieces = iter(lambda: "".join(f"      - {row}\n" for row in islice(left, 4096)), "")
    return list(pieces)


class _Vertices:
    """The vertex list of a level being written: nodes first, then whatever corners the objects need."""

    def __init__(self, rows: list[str], old: Mapping[int, int]) -> None:
        self.rows = rows
        self._old = old
        self._by_place: dict[str, int] = {}

    def __len__(self) -> int:
        return len(self.rows)

    def find_or_add(self, position: tuple[str, str], hint: Any) -> int:
        """The vertex at this place (x and y as texts): the one it stood on, else any, else a new one."""
        start = f"[{position[0]}, {position[1]}, "
        old_row = self._old.get(hint) if isinstance(hint, int) else None
        if old_row is not None and self.rows[old_row].startswith(start):
            return old_row
        if not self._by_place:  # most maps need it nowhere
            for k, row in enumerate(self.rows):
                self._by_place.setdefault(", ".join(row.split(", ", 2)[:2]) + ", ", k)
        new_row = self._by_place.get(start)
        if new_row is None:
            new_row = self._by_place[start] = len(self.rows)
            self.rows.append(f"{start}0.0, '']")
        return new_row


class _Writer:
    """One building being written in one coordinate system."""

    def __init__(
        self,
        layers: Layers,
        context: WriteContext,
        storeys: Sequence[Storey],
        building: Mapping[str, Any],
        system: str,
        resources: Mapping[str, bytes],
        why: str,
    ) -> None:
        self.layers, self.context, self.storeys, self.system = layers, context, storeys, system
        self.options = context.options if isinstance(context.options, common.WriteOptions) else common.WriteOptions()
        self.robots = common.Robots(self.options, _iterate_nodes(storeys))
        self.building = dict(building)
        self.resources = resources
        self.why = why
        self.converted = bool(building) and self.building.get("coordinate_system", IMAGE) != system
        self.degrees = system in DEGREE_SYSTEMS
        self.decimals = DEGREES if self.degrees else METRES
        self.flow = Flow()
        self.dropped: Counter[str] = Counter()
        self.created_ids: Counter[str] = Counter()
        self.used: dict[str, bytes] = {}
        self.scaling: dict[str, Scaling] = {}
        self.transforms = {s.name: self._transform(s) for s in storeys}
        reference = self.building.get("reference_level_name")
        self.reference = _text(reference) if _text(reference) in self.transforms else storeys[0].name

    def _transform(self, storey: Storey) -> Transform:
        values = storey.document.get("transform")
        if self.system != IMAGE or not isinstance(values, list) or len(values) != 4:
            return Transform()
        return Transform(values[0], values[1], (values[2], values[3]))

    def files(self) -> dict[str, bytes]:
        """``building.yaml``, then the images."""
        levels = [piece for storey in self.storeys for piece in self._level(storey)]
        lifts = self._lifts()
        if self.system == IMAGE:
            self._check()
        top = self._top()
        before = {key: value for key, value in top.items() if key < "levels"}
        after = {key: value for key, value in top.items() if key > "levels"}
        text = [yaml.mapping(before, 0) if before else "", "levels:\n", *levels, lifts]
        text.append(yaml.mapping(after, 0) if after else "")
        self._report()
        levels.clear()
        return {FILE: encode_pieces(text), **dict(sorted(self.used.items()))}

    def _top(self) -> dict[str, Any]:
        top = {key: value for key, value in self.building.items() if key not in ("levels", "lifts")}
        if "name" not in top and "building_name" not in top:
            name = self._graph_name()
            default = self.options.building or self.context.title
            top["name"] = default if name is None else name
            if name is None:
                self.context.fill("name", default, "no source names the building", "building")
        if self.system != IMAGE or "coordinate_system" in top:
            top["coordinate_system"] = self.system
        if "reference_level_name" in top and _text(top["reference_level_name"]) not in self.transforms:
            del top["reference_level_name"]
        return top

    def _graph_name(self) -> Any:
        """What navigation graphs call the building."""
        for storey in self.storeys:
            for part in storey.networks:
                graphs = mapping(mapping(part.document.get(NAV_GRAPH), NAV_GRAPH).get("graphs"), "graphs")
                for graph in sorted(graphs):
                    if isinstance(graphs[graph], dict) and graphs[graph].get("building_name") is not None:
                        return graphs[graph]["building_name"]
        return None

    def _served_levels(self, lift: str) -> dict[str, list[str]]:
        """The levels with a node that a navigation graph puts into this lift, without doors."""
        return {
            storey.name: []
            for storey in self.storeys
            for part in storey.networks
            if any(
                mapping(get_source_properties(p, NAV_GRAPH).get("parameters"), "").get("lift") == lift
                for p in part.properties
            )
        }

    def _check(self) -> None:
        """Whether a reader of this file places the levels where they are."""
        level_transforms = transforms(self.scaling, self.reference, lambda problem, location: None)
        for name, transform in self.transforms.items():
            if not transform.is_close(level_transforms[name]):
                raise _RewriteError(f"measurements and fiducials no longer place level {name} where it is")

    # places

    def _coordinates(self, part: Features, indices: NDArray[np.intp], storey: str) -> tuple[Array, NDArray[np.intp]]:
        """The file's x and y of all coordinates of these items, and the item each belongs to."""
        geometry = part.geometry[indices]
        if (part.local[indices] == self.degrees).any():
            subset, frame = part.select(indices), self.layers.frame
            geometry = subset.in_wgs84(frame) if self.degrees else subset.in_local(frame)
        at, owner = shapely.get_coordinates(geometry, return_index=True)
        return _to_file(self.system, at, self.transforms[storey]), owner

    def _texts(self, raw: Array) -> list[tuple[str, str]]:
        texts = list(map(yaml.decimal, numbers(raw.ravel(), self.decimals)))
        return list(zip(texts[::2], texts[1::2], strict=True))

    # levels

    def _elevation(self, storey: Storey) -> Any:
        """As the level says it, unless the environment knows better."""
        source_elevation = mapping(storey.document.get("level"), "level").get("elevation", 0.0)
        elevation = next((level.elevation for level in self.layers.levels if level.name == storey.name), None)
        return source_elevation if elevation is None or source_elevation == elevation else elevation

    def _level(self, storey: Storey) -> list[str]:
        """The level's lines, in pieces."""
        members = dict(mapping(storey.document.get("level"), "level"))
        if self.converted:
            dropped_keys = sorted(key for key in members if key in IN_PIXELS and members[key])
            self.dropped["what levels say in pixels of their drawing"] += len(dropped_keys)
            members = {key: value for key, value in members.items() if key not in IN_PIXELS}
        members["elevation"] = self._elevation(storey)
        self._drawings(members, storey.name)
        vertices, ids = self._nodes(storey)
        sections: Sections = {"lanes": _section_lines(self._lanes(storey, ids))}
        self._objects(storey, vertices, sections)
        self._dangling(storey, vertices, sections)
        sections["vertices"] = _section_lines(vertices.rows)
        out = [f"  {yaml.text(storey.name)}:\n"]
        for key in sorted({*members, *(k for k, rows in sections.items() if rows)}):
            if key in sections:
                out.append(f"    {key}:\n")
                out += sections[key]
            else:
                out.append(yaml.mapping({key: members[key]}, 4))
        return out

    def _drawings(self, members: dict[str, Any], level: str) -> None:
        """Take along the images that the level names, under names that stay below the building's folder."""
        for key, image in list(_named_images(members)):
            name = find_stored_image(image, self.resources)
            if name is None:
                if image:
                    problem = f"the image {image[:200]!r} was not in the upload: it is named and not served"
                    self.context.warn(problem, where=f"levels.{level}.{key}.filename")
                continue
            self.used[name] = self.resources[name]
            if name != image:
                outer, _, inner = key.partition(".")
                if inner:
                    members[outer] = {**members[outer], inner: {**members[outer][inner], "filename": name}}
                else:
                    members[outer] = {**members[outer], "filename": name}

    def _nodes(self, storey: Storey) -> tuple[_Vertices, dict[str, int]]:
        """The nodes as vertices in their old order, and each id's place among them."""
        elevation = float(self._elevation(storey))
        nodes: list[tuple[tuple[bool, int, int, str], str]] = []
        for part in storey.networks:
            point = (shapely.get_type_id(part.geometry) == 0) & ~shapely.is_empty(part.geometry)
            node: NDArray[np.bool_] = np.array([p.get("kind") == "node" for p in part.properties], bool)
            self.dropped["nodes without a point"] += int((node & ~point).sum())
            indices = np.flatnonzero(node & point)
            raw, _ = self._coordinates(part, indices, storey.name)
            z = shapely.get_z(part.geometry[indices])
            for k, position, high in zip(indices.tolist(), self._texts(raw), z.tolist(), strict=True):
                p = part.properties[k]
                at = get_source_properties(p, NAME).get("index")
                has_index = isinstance(at, int)
                key = (not has_index, at if isinstance(at, int) else 0, len(part.ids[k]), part.ids[k])
                height = 0.0 if math.isnan(high) else high - elevation
                row = self._vertex(
                    part.ids[k], p, position, height, self.robots.vertex_properties(storey.name, part.ids[k])
                )
                nodes.append((key, row))
        nodes.sort(key=lambda item: item[0])
        ids: dict[str, int] = {}
        old: dict[int, int] = {}
        for k, ((unknown, was, _, i), _) in enumerate(nodes):
            ids.setdefault(i, k)
            if not unknown:
                old.setdefault(was, k)
        return _Vertices([row for _, row in nodes], old), ids

    def _vertex(self, i: str, p: Properties, position: tuple[str, str], z: float, further: Mapping[str, Any]) -> str:
        source_members = get_source_properties(p, NAME)
        title = p.get("name")
        parameters = source_members.get("parameters")
        if NAME in p:
            name = (
                source_members["name"]
                if "name" in source_members and _text(source_members["name"]) == title
                else title or ""
            )
        else:
            name = title if isinstance(title, str) and (title or NAV_GRAPH in p) else "" if NAV_GRAPH in p else i
            graph = mapping(get_source_properties(p, NAV_GRAPH).get("parameters"), "parameters")
            parameters = {
                key: common.typed_parameter(value) for key, value in graph.items() if key not in ("name", "lift")
            }
            self.dropped["nodes' attributes of other formats"] += any(
                isinstance(v, dict) for key, v in p.items() if key != NAV_GRAPH
            )
        if further:
            parameters = {
                **(parameters or {}),
                **{key: common.typed_parameter(value) for key, value in further.items()},
            }
        self.dropped["nodes' orientations"] += p.get("orientation") is not None
        row = f"[{position[0]}, {position[1]}, {yaml.text(round(z, METRES) + 0.0)}, {yaml.text(name)}"
        if parameters or source_members.get("more"):
            row += f", {self.flow(parameters or {})}"
        return row + "".join(f", {self.flow(v)}" for v in source_members.get("more") or ()) + "]"

    # lanes

    def _lanes(self, storey: Storey, ids: Mapping[str, int]) -> Iterator[str]:
        """The edges as lanes: those of one lane, or opposite ones that say the same, as one two-way lane."""
        for _, lanes in groupby(self._edges(storey, ids), key=lambda lane: lane.was):
            waiting: dict[Any, list[_Lane]] = {}
            out: list[_Lane] = []
            for lane in lanes:
                partner = waiting.get(lane.partner())
                if partner and lane.source != lane.target:
                    first = partner.pop()
                    first.both = True
                    continue
                waiting.setdefault(lane.parameters_key(), []).append(lane)
                out.append(lane)
            for lane in out:
                yield lane.row(self.flow)

    def _edges(self, storey: Storey, ids: Mapping[str, int]) -> Iterator[_Lane]:
        """The level's edges, in the order of the lanes that they were."""
        for _, p in _sort_by_lane(storey.networks):
            source, target = ids.get(str(p.get("source"))), ids.get(str(p.get("target")))
            if p.get("kind") != "edge" or source is None or target is None:
                self.dropped["edges without two nodes on their level"] += 1
                continue
            self.dropped["edges' actions"] += p.get("action") is not None
            self.dropped["edges' widths"] += p.get("width") is not None
            source_members = get_source_properties(p, NAME)
            if NAME not in p:
                self.created_ids["lanes"] += NAV_GRAPH not in p
                source_members = {"parameters": _lane_parameters(p, self.options)}
                self.dropped["edges' attributes of other formats"] += any(
                    isinstance(v, dict) for key, v in p.items() if key != NAV_GRAPH
                )
            limit = common.limit(p) or (self.options.speed_limit if NAME not in p and NAV_GRAPH not in p else 0.0)
            yield _Lane.from_edge(limit, source_members, source, target, self.flow)

    def _dangling(self, storey: Storey, vertices: _Vertices, sections: Sections) -> None:
        """Rows to vertices that did not exist come back where they still do not."""
        for section, rows in mapping(storey.document.get("dangling"), "dangling").items():
            for row in rows:
                ends = row["vertices"] if isinstance(row, dict) else row[:2]
                if section in RINGS or not all(0 <= v < len(vertices) for v in ends):
                    sections.setdefault(section, []).extend(_section_lines([self.flow(row)]))
                    problem = f"{section} with vertices that do not exist: rmf_building_map_tools will refuse the file"
                    self.context.warn(problem, where=f"levels.{storey.name}.{section}")
                else:
                    self.dropped[f"{section} to vertices that did not exist"] += 1

    # objects

    def _objects(self, storey: Storey, vertices: _Vertices, sections: Sections) -> None:
        sections_of = {kind: section for section, kind in {**LINES, **RINGS}.items()}
        rows_by_section: dict[str, list[tuple[tuple[bool, int, str], str]]] = {}
        scaling = Scaling([], [])
        for part in storey.objects:
            everything = np.arange(len(part))
            raw, owner = self._coordinates(part, everything, storey.name)
            texts = self._texts(raw)
            first = np.searchsorted(owner, everything)
            last = np.searchsorted(owner, everything, side="right")
            order = sorted(range(len(part)), key=lambda k: _place(part.ids[k], part.properties[k]))
            for k in order:
                p = part.properties[k]
                kind, at = p.get("kind"), texts[first[k] : last[k]]
                coordinates = raw[first[k] : last[k]]
                key = _place(part.ids[k], p)
                if kind == "lift":
                    continue
                if kind in LINES.values() and len(at) >= 2:
                    row, parameters = self._line(p, vertices, [at[0], at[-1]])
                    self.dropped["bends of walls, doors and measurements"] += int(len(at) > 2)
                    if kind == "measurement":
                        metres = parameter_value(parameters, "distance", 0.0)
                        length = math.dist(coordinates[0], coordinates[-1])
                        scaling.measurements.append((length, float(metres)))
                    rows_by_section.setdefault(sections_of[str(kind)], []).append((key, row))
                elif kind in RINGS.values() and len(at):
                    rows = [(key, row) for row in self._rings(p, part.geometry[k], vertices, at)]
                    rows_by_section.setdefault(sections_of[str(kind)], []).extend(rows)
                elif kind == "model" and len(at) == 1:
                    rows_by_section.setdefault("models", []).append((key, self._model(p, at[0], storey)))
                elif kind == "fiducial" and len(at) == 1:
                    name = str(p.get("name") or "")
                    more = get_source_properties(p, NAME).get("more") or []
                    row = f"[{at[0][0]}, {at[0][1]}, {yaml.text(name)}{''.join(', ' + self.flow(v) for v in more)}]"
                    rows_by_section.setdefault("fiducials", []).append((key, row))
                    scaling.fiducials.append((name, float(at[0][0]), -float(at[0][1])))
                else:
                    self.dropped["objects that are no part of a building"] += 1
        for section, rows_of in rows_by_section.items():
            sections[section] = _section_lines(row for _, row in sorted(rows_of, key=lambda item: item[0]))
        self.scaling[storey.name] = scaling

    def _line(self, p: Properties, vertices: _Vertices, ends: list[tuple[str, str]]) -> tuple[str, dict[str, Any]]:
        source_members = get_source_properties(p, NAME)
        hints = source_members.get("vertices")
        hints = hints if isinstance(hints, list) and len(hints) == 2 else [None, None]
        i, j = (vertices.find_or_add(position, hint) for position, hint in zip(ends, hints, strict=True))
        parameters = dict(mapping(source_members.get("parameters"), "parameters"))
        if p.get("kind") == "door" and "parameters" not in source_members:
            parameters = dict(DOOR_TEMPLATE)
            self.created_ids["doors"] += 1
        name = p.get("name")
        if isinstance(name, str) and name and parameter_value(parameters, "name") != name:
            parameters["name"] = [1, name]
        more = "".join(f", {self.flow(v)}" for v in source_members.get("more") or ())
        return f"[{i}, {j}, {self.flow(parameters)}{more}]", parameters

    def _rings(self, p: Properties, geometry: Any, vertices: _Vertices, texts: list[tuple[str, str]]) -> Iterable[str]:
        source_members = get_source_properties(p, NAME)
        members = {key: value for key, value in source_members.items() if key not in ("index", "vertices")}
        members.setdefault("parameters", {})
        source_hints = source_members.get("vertices")
        hints: list[Any] = source_hints if isinstance(source_hints, list) else []
        pieces = list(geometry.geoms) if geometry.geom_type == "MultiPolygon" else [geometry]
        done = 0
        for piece in pieces:
            count = int(shapely.get_num_coordinates(piece))
            ring = texts[done : done + count]
            done += count
            if piece.geom_type == "Polygon":
                self.dropped["holes in floors"] += len(piece.interiors)
                ring = ring[: len(piece.exterior.coords)]
                if len(ring) != len(hints):  # a polygon repeats its first corner, a floor need not
                    ring = ring[:-1]
            corner_hints = hints if len(hints) == len(ring) else [None] * len(ring)
            corners = [vertices.find_or_add(position, hint) for position, hint in zip(ring, corner_hints, strict=True)]
            yield self.flow({**members, "vertices": corners})

    def _model(self, p: Properties, position: tuple[str, str], storey: Storey) -> str:
        members = dict(mapping(get_source_properties(p, NAME).get("says"), "says"))
        pose = common.object_pose(p)
        if pose is not None and not self.degrees:
            z = round(pose[2] - float(self._elevation(storey)), METRES) + 0.0
            if z or "z" not in members:
                members["z"] = z
            members["yaw"] = round(pose[5] - self.transforms[storey.name].rotation, DEGREES) + 0.0
            self.dropped["models' roll and pitch"] += bool(pose[3] or pose[4])
        members.setdefault("yaw", 0.0)
        if isinstance(p.get("name"), str):
            members["name"] = p["name"]
        members["x"], members["y"] = (float(v) for v in position)
        return self.flow(members)

    def _lifts(self) -> str:
        """The lifts of all levels, in the order of their file."""
        lifts: list[tuple[tuple[bool, int, str], str, dict[str, Any]]] = []
        for storey in self.storeys:
            for part in storey.objects:
                for k, p in enumerate(part.properties):
                    if p.get("kind") != "lift":
                        continue
                    if int(shapely.get_type_id(part.geometry[k])) != 0 or part.geometry[k].is_empty:
                        self.dropped["lifts without a point"] += 1
                        continue
                    members = dict(mapping(get_source_properties(p, NAME).get("says"), "says"))
                    floor = _text(members.get("reference_floor_name"))
                    floor = floor if floor in self.transforms else self.reference
                    raw, _ = self._coordinates(part, np.array([k]), floor)
                    (x, y) = self._texts(raw)[0]
                    members["x"], members["y"] = float(x), float(y)
                    size = common.object_size(p) or (1.0, 1.0)
                    members["width"], members["depth"] = size
                    pose = common.object_pose(p)
                    if pose is not None and not self.degrees:
                        members["yaw"] = round(pose[5], DEGREES) + 0.0
                    members.setdefault("yaw", 0.0)
                    if NAME not in p:
                        self.created_ids["lifts"] += 1
                        served = self._served_levels(str(p.get("name")))
                        members |= {"doors": {}, "level_doors": served, "reference_floor_name": floor, "plugins": True}
                    lifts.append((_place(part.ids[k], p), str(p.get("name") or part.ids[k]), members))
        lifts.sort(key=lambda item: item[0])
        names = unique_ids(name for _, name, _ in lifts)
        if not lifts:
            return "lifts: {}\n"
        # The first lift whose shaft holds a vertex is the vertex' lift, so their order is kept.
        rows = zip(names, lifts, strict=True)
        return "lifts:\n" + "".join(yaml.mapping({name: members}, 2) for name, (_, _, members) in rows)

    def _report(self) -> None:
        if self.why:
            text = "cartesian_meters is written instead of the source's coordinates"
            self.context.warn(f"{self.why}: {text}", file=FILE, where="coordinate_system")
        for text, count in sorted(self.dropped.items()):
            self.context.drop(text, count, "a building in these coordinates has no place for it")
        if self.created_ids["lanes"]:
            why = f"{self.created_ids['lanes']} edges come from another format"
            self.context.fill("lanes: graph_idx", self.options.graph, why, "graph")
            limited = f"{why}, where they have none"
            self.context.fill("lanes: speed_limit", self.options.speed_limit, limited, "speed_limit")
            self.context.fill("lanes: orientation", LANE_TEMPLATE["orientation"][1], why)
        self.robots.report(self.context)
        if self.created_ids["doors"]:
            parameters = {key: value[1] for key, value in DOOR_TEMPLATE.items()}
            self.context.fill(
                "doors: parameters", parameters, f"{self.created_ids['doors']} doors come from a navigation graph"
            )
        if self.created_ids["lifts"]:
            why = f"{self.created_ids['lifts']} lifts come from a navigation graph"
            self.context.fill(
                "lifts: doors, level_doors, reference floor",
                "none, on the levels of its vertices, the first level",
                why,
            )


def _place(i: str, p: Properties) -> tuple[bool, int, str]:
    """The order of items in their list: as in the file, then by id."""
    at = get_source_properties(p, NAME).get("index", get_source_properties(p, NAV_GRAPH).get("index"))
    has_index = isinstance(at, int)
    return (not has_index, at if isinstance(at, int) else 0, i)


def _sort_by_lane(parts: Sequence[Features]) -> Iterable[tuple[str, Properties]]:
    """(id, properties) of what is no node: by the lane it was and its direction, then the others by id."""

    def each() -> Iterator[tuple[str, Properties]]:
        for part in parts:
            for i, p in zip(part.ids, part.properties, strict=True):
                if p.get("kind") != "node":
                    yield i, p

    def key(item: tuple[str, Properties]) -> tuple[bool, int, bool, int, str]:
        i, p = item
        source_members = get_source_properties(p, NAME)
        was = source_members.get("index")
        has_index = isinstance(was, int)
        return (not has_index, was if isinstance(was, int) else 0, source_members.get("reverse") is True, len(i), i)

    # As they were read they are in order: then none is held.
    return each() if all(a <= b for a, b in pairwise(map(key, each()))) else sorted(each(), key=key)


def _iterate_nodes(storeys: Iterable[Storey]) -> Iterator[tuple[str, str, Properties]]:
    for storey in storeys:
        for part in storey.networks:
            for i, p in zip(part.ids, part.properties, strict=True):
                if p.get("kind") == "node":
                    yield storey.name, i, p


def _lane_parameters(p: Properties, options: common.WriteOptions) -> dict[str, Any]:
    """The parameters of a lane that comes from another format."""
    out = {key: list(value) for key, value in LANE_TEMPLATE.items()}
    if NAV_GRAPH not in p:
        out["graph_idx"] = [2, options.graph]
    graph = get_source_properties(p, NAV_GRAPH)
    graph_parameters = mapping(graph.get("parameters"), "parameters")
    if isinstance(graph.get("graph"), int):
        out["graph_idx"] = [2, graph["graph"]]
    for key, value in graph_parameters.items():
        if key == "orientation_constraint":
            out["orientation"] = [1, value]
        elif key not in ("door_name", "speed_limit", "is_bidirectional", "dock_name", "undock_name"):
            out[key] = common.typed_parameter(value)
    return out


@dataclass(slots=True)
class _Lane:
    """A directed edge on its way to a lane. was: its lane's place in the file; reverse: it is that lane backwards."""

    source: int
    target: int
    was: int | None
    reverse: bool
    limit: float
    parameters: dict[str, Any]
    more: Sequence[Any]
    signature: str
    both: bool = False

    @classmethod
    def from_edge(cls, limit: float, source_members: Mapping[str, Any], source: int, target: int, flow: Flow) -> _Lane:
        """The edge with this speed limit (0: none); rest: what is known of its lane."""
        was = source_members.get("index") if isinstance(source_members.get("index"), int) else None
        reverse = source_members.get("reverse") is True
        parameters = mapping(source_members.get("parameters"), "parameters")
        speed = parameter_value(parameters, "speed_limit", 0.0)
        if (speed if isinstance(speed, (int, float)) and speed > 0 else 0.0) != limit:
            parameters = {**parameters, "speed_limit": [3, limit]}
        signature = str(was)
        if was is None:
            signature = flow({k: v for k, v in parameters.items() if k != "orientation"})
        more = source_members.get("more")
        return cls(source, target, was, reverse, limit, parameters, more if isinstance(more, list) else (), signature)

    def _orientation(self) -> Any:
        return str(parameter_value(self.parameters, "orientation", ""))

    def parameters_key(self) -> Any:
        """Equal for edges that could be one."""
        direction = self._orientation() if self.was is None else self.reverse
        return (self.source, self.target, self.limit, self.signature, direction)

    def partner(self) -> Any:
        """What the edge back says, if both are one two-way lane."""
        direction = common.reverse_orientation(self._orientation()) if self.was is None else not self.reverse
        return (self.target, self.source, self.limit, self.signature, direction)

    def row(self, flow: Flow) -> str:
        """The lane's row."""
        parameters = self.parameters
        if self.both or parameter_value(parameters, "bidirectional") is True or self.was is None:
            parameters = {**parameters, "bidirectional": [4, self.both]}
        if self.reverse and "orientation" in parameters:
            parameters = {**parameters, "orientation": [1, common.reverse_orientation(self._orientation())]}
        more = "".join(f", {flow(v)}" for v in self.more)
        return f"[{self.source}, {self.target}, {flow(parameters)}{more}]"


# --- the format ------------------------------------------------------------------------------------------------------

_LEVELS = re.compile(rb"(?m)^levels[ \t]*:")
_OF_GRAPH = re.compile(rb"(?m)^building_name[ \t]*:")
_OF_BUILDING = re.compile(
    rb"(?m)^(?:coordinate_system|crowd_sim|reference_level_name)[ \t]*:"
    rb"|^[ \t]+(?:walls|measurements|drawing|elevation|floors|fiducials|models|human_lanes|flattened_x_offset)[ \t]*:"
)
_VERTICES = re.compile(rb"(?m)^[ \t]+vertices[ \t]*:")
_NAMED = re.compile(rb"(?m)^name[ \t]*:")


def detect(name: str, data: bytes) -> bool:
    """YAML with levels that have what only a building has, or a name and vertices."""
    if not name.lower().endswith((".yaml", ".yml")) or not _LEVELS.search(data):
        return False
    if _OF_BUILDING.search(data):
        return True
    return bool(not _OF_GRAPH.search(data) and _NAMED.search(data) and _VERTICES.search(data))


def choose(keys: Sequence[PartKey], options: Any) -> Sequence[PartKey]:  # noqa: ARG001 - one signature for all formats
    """The networks, the objects that came from a building or a navigation graph, and the building's images."""
    return [
        key
        for key in keys
        if key.layer == "topology"
        or (key.layer == "objects" and key.name in (NAME, NAV_GRAPH))
        or (key.layer == "resources" and key.name == NAME)
    ]


register(
    Format(
        name=NAME,
        title="Building (Open-RMF traffic editor)",
        files={FILE: "application/yaml"},
        layers=frozenset({"topology", "objects", "resources"}),
        detect=detect,
        read=read,
        check=_openrmf_rules.check,
        write=write,
        needs=LayerRequirements(one_of=(frozenset({"topology"}),), also=frozenset({"objects", "resources"})),
        write_options=_rmf.WriteOptions,
        extensions=(".building.yaml", ".yaml", ".yml"),
        version=2,
        selection=Selection(choose),
        claims=Claims(priority=40, companions=companion_hook(_FILENAME)),
        traits=Traits(keeps_bends="nodes", has_title=True),
    )
)
