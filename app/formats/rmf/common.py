"""Shared by the Open-RMF formats: typed parameters, YAML rows in flow style, lanes as pairs of edges.

Source: open-rmf/rmf_traffic_editor, rmf_building_map_tools (building_map/param_value.py, edge.py, level.py).
"""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NoReturn

import numpy as np
import orjson
import shapely
from numpy.typing import NDArray

from app.errors import Problem, UnreadableFile
from app.formats import WriteContext
from app.formats._network import natural_sort_key, shorten_list
from app.model.features import Features, Properties, unique_ids
from app.model.frame import MAX_METRES
from app.model.layers import Layers, PartKey
from app.parameters import parameter
from app.syntax import yaml

BUILDING, NAV_GRAPH = "openrmf", "rmf_nav_graph"
"""Format families: keys of an item's source properties from buildings and from navigation graphs."""

OPEN_RMF = (BUILDING, NAV_GRAPH)

CABIN_HEIGHT = 2.5
"""Height of every lift cabin in rmf_building_map_tools, in metres."""

MAX_GRAPHS = 9
"""Number of graphs: building_map_generator writes graphs 0 … 8 and skips lanes of any other."""

MAX_ID_CHARACTERS = 240
"""Maximum characters of a node id; an edge id consists of two and must be valid, too."""

Array = NDArray[np.float64]


def raise_unreadable(reason: str, location: str) -> NoReturn:
    """Raise UnreadableFile with a reason and its location in the file."""
    raise UnreadableFile(f"{location}: {reason}" if location else reason, [Problem(reason, where=location or None)])


def mapping(value: Any, location: str) -> dict[str, Any]:
    """Check that a value is a mapping; None becomes an empty one."""
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise_unreadable("must be a mapping", location)
    return value


def listing(value: Any, location: str) -> list[Any]:
    """Check that a value is a list; None and ``{}`` (as the editor writes it) become an empty one."""
    if value is None or value == {}:
        return []
    if not isinstance(value, list):
        raise_unreadable("must be a list", location)
    return value


def number(value: Any, location: str) -> float:
    """Convert a value, also a quoted one, to a number within ±MAX_METRES."""
    if isinstance(value, str):
        try:
            value = yaml.scalar(value)
        except ValueError:
            value = None
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise_unreadable("must be a number", location)
    if abs(value) > MAX_METRES:
        raise_unreadable(f"must be within ±{MAX_METRES:g}", location)
    return float(value)


def places(rows: Sequence[Any], location: str) -> Array:
    """Return the first two numbers of each row as float64 [n, 2]."""
    try:
        flat = [v for row in rows for v in (row[0], row[1])]
    except (TypeError, LookupError):
        k = next(k for k, row in enumerate(rows) if not isinstance(row, list) or len(row) < 2)
        raise_unreadable("must be a list that starts with x and y", f"{location}[{k}]")
    if not all(map((float, int).__contains__, map(type, flat))):
        flat = [number(v, f"{location}[{k // 2}][{k % 2}]") for k, v in enumerate(flat)]
    return np.array(flat, np.float64).reshape(-1, 2)


def index(value: Any, location: str) -> int:
    """Check that a value is a vertex index."""
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if isinstance(value, bool) or not isinstance(value, int):
        raise_unreadable("must be a vertex index", location)
    return value


def parameter_value(parameters: Any, key: str, default: Any = None) -> Any:
    """Return the value of a parameter ``[type, value]``."""
    pair = parameters.get(key) if isinstance(parameters, Mapping) else None
    return pair[1] if isinstance(pair, list) and len(pair) == 2 else default


def typed_parameter(value: Any) -> Any:
    """Convert a value to a typed parameter (1 text, 2 integer, 3 decimal, 4 boolean); nested values stay."""
    kinds: dict[type, int] = {str: 1, int: 2, float: 3, bool: 4}
    kind = kinds.get(type(value))
    return value if kind is None else [kind, value]


AREA = "area"
"""Parameter of a vertex with the name of the room or aisle that it is in; Open-RMF's programs keep and ignore it."""


def area_property(parameters: Mapping[str, Any], *, typed: bool) -> dict[str, str]:
    """Return a node's property ``area`` from its vertex's parameters. typed: whether they are ``[type, value]``."""
    area = parameter_value(parameters, AREA) if typed else parameters.get(AREA)
    return {AREA: area} if isinstance(area, str) and area else {}


def with_area(parameters: Mapping[str, Any], p: Properties, *, typed: bool) -> dict[str, Any]:
    """Return the parameters of a vertex with its node's ``area``, without that of its source."""
    out = {key: value for key, value in parameters.items() if key not in area_property(parameters, typed=typed)}
    area = p.get(AREA)
    if isinstance(area, str) and area:
        out[AREA] = typed_parameter(area) if typed else area
    return out


def short(text: str, max_length: int = MAX_ID_CHARACTERS) -> str:
    """Shorten a text that is too long for an id to its start and a hash of the full text."""
    if len(text) <= max_length:
        return text
    return f"{text[: max_length - 18]}~{hashlib.blake2b(text.encode(), digest_size=8).hexdigest()}"


def limit(p: Properties) -> float:
    """Return an edge's speed limit in m/s, 0 if there is none."""
    speed = p.get("speed_limit")
    valid = isinstance(speed, (int, float)) and not isinstance(speed, bool) and math.isfinite(speed) and speed > 0
    return float(speed) if valid and speed is not None else 0.0


def reverse_orientation(orientation: Any) -> Any:
    """Return the orientation constraint for the reverse direction of a lane."""
    return {"forward": "backward", "backward": "forward"}.get(orientation, orientation)


def object_pose(p: Properties) -> list[float] | None:
    """Return an object's pose [x, y, z, roll, pitch, yaw], or None."""
    pose = p.get("pose")
    if not isinstance(pose, (list, tuple)) or len(pose) != 6:
        return None
    if not all(isinstance(v, (int, float)) and not isinstance(v, bool) and math.isfinite(v) for v in pose):
        return None
    return list(map(float, pose))


def object_size(p: Properties) -> tuple[float, float] | None:
    """Return an object's width (along x) and depth (along y) in metres, or None."""
    size = p.get("size")
    if not isinstance(size, (list, tuple)) or len(size) < 2:
        return None
    if not all(isinstance(v, (int, float)) and not isinstance(v, bool) and math.isfinite(v) for v in size):
        return None
    return float(size[0]), float(size[1])


def ends(geometry: Any) -> Array:
    """Return the first and last point of a line as float64 [2, 2]."""
    at: Array = shapely.get_coordinates(geometry)
    return at[[0, -1]]


@dataclass(slots=True)
class Storey:
    """Level to be written: its parts, and the building data of their documents."""

    name: str
    networks: list[Features] = field(default_factory=list)
    objects: list[Features] = field(default_factory=list)
    document: dict[str, Any] = field(default_factory=dict)


def storeys(layers: Layers) -> list[Storey]:
    """Return the levels in the order of their file; levels from other sources come last."""
    by_level: dict[str, Storey] = {}
    own_names = {
        (str(p.get("kind")), str(p.get("name")))
        for key, part in layers.vector("objects").items()
        if key.name == BUILDING
        for p in part.properties
    }
    for key, objects in layers.vector("objects").items():
        part = objects
        if key.name == NAV_GRAPH:  # graphs repeat doors and lifts of their building
            part = part.select(
                [k for k, p in enumerate(part.properties) if (str(p.get("kind")), str(p.get("name"))) not in own_names]
            )
        if key.name in (BUILDING, NAV_GRAPH) and (len(part) or BUILDING in part.document):
            by_level.setdefault(key.level, Storey(key.level)).objects.append(part)
    for key, part in layers.vector("topology").items():
        if len(part) or BUILDING in part.document:
            by_level.setdefault(key.level, Storey(key.level)).networks.append(part)
    for storey in by_level.values():
        for part in [*storey.objects, *storey.networks]:
            building = part.document.get(BUILDING)
            if isinstance(building, dict) and not storey.document:
                storey.document = building
    rank = {level.name: (level.elevation, level.name) for level in layers.levels}

    def order(storey: Storey) -> tuple[bool, int, tuple[float, str]]:
        position = storey.document.get("order")
        has_position = isinstance(position, int)
        return (
            not has_position,
            position if isinstance(position, int) else 0,
            rank.get(storey.name, (0.0, storey.name)),
        )

    return sorted(by_level.values(), key=order)


@dataclass(frozen=True, slots=True)
class WriteOptions:
    """Values of a building or its graphs that no source specifies."""

    building: str | None = parameter(None, "building name if no source specifies one; default: the name of the map")
    chargers: tuple[str, ...] | None = parameter(
        None, "nodes that are chargers, parking spots and holding points, as comma-separated ids or names"
    )
    robot_name: str | None = parameter(
        None,
        "name prefix of robots that start at chargers without a robot: tractor_1 …; default: no robots start there",
    )
    robot_type: str = parameter("TinyRobot", "robot model at chargers that specify none")
    graph: int = parameter(0, "index of the graph for lanes from other formats", minimum=0, maximum=MAX_GRAPHS - 1)
    speed_limit: float = parameter(
        0.0,
        "speed limit of lanes from other formats whose edge has none; 0: no limit",
        minimum=0.0,
        maximum=100.0,
        unit="m/s",
    )


class VertexNames:
    """Names of vertices. Fleet adapters refuse a name that occurs twice; nodes of other formats have ids instead."""

    def __init__(self, nodes: Iterable[tuple[Hashable, str, Properties]]) -> None:
        """nodes: (key, id, properties) of all nodes of a building or a graph; ids repeat on other levels, keys do not.

        A name of Open-RMF's stays. Another stays if no other vertex has it, or on the first node whose id it is.
        """
        rows = [(key, i, _vertex_name(i, p), not p.keys().isdisjoint(OPEN_RMF)) for key, i, p in nodes]
        counts = Counter(name for _, _, name, _ in rows)
        kept = {name for _, _, name, is_open_rmf in rows if is_open_rmf or counts[name] == 1}
        replaced: dict[Hashable, tuple[str, str]] = {}
        for key, i, name, is_open_rmf in rows:
            if is_open_rmf or counts[name] == 1:
                continue
            if name == i and name not in kept:
                kept.add(name)
            else:
                replaced[key] = i, name
        ids = unique_ids((i for i, _ in replaced.values()), kept)
        self._ids = dict(zip(replaced, ids, strict=True))
        self._replaced = sorted({name for _, name in replaced.values()})

    def choose(self, key: Hashable, i: str, p: Properties) -> str:
        """Return the name of a node's vertex: its own or, if another has it, its id or one made from it."""
        return self._ids.get(key) or _vertex_name(i, p)

    def report(self, context: WriteContext, file: str, location: str) -> None:
        """Report the names that were not written."""
        if self._replaced:
            problem = f"{len(self._replaced)} names occur more than once: {shorten_list(self._replaced)}"
            ids = "their nodes' ids are written, with a number if they are taken"
            context.warn(f"{problem}; {ids}, as names must be unique", file=file, where=location)


def _vertex_name(i: str, p: Properties) -> str:
    """Return the name of a node's vertex, its id if it has none and comes from another format."""
    name = p.get("name")
    if isinstance(name, (int, float)) and not isinstance(name, bool):
        name = str(name)
    return name if isinstance(name, str) and name else i if p.keys().isdisjoint(OPEN_RMF) else ""


CHARGER = ("is_charger", "is_parking_spot", "is_holding_point")
ROBOT, ROBOT_TYPE = "spawn_robot_name", "spawn_robot_type"


class Robots:
    """Chargers and the robots that start at them, as set by options and not by sources."""

    def __init__(self, options: WriteOptions, nodes: Iterable[tuple[str, str, Properties]]) -> None:
        """nodes: (level, id, properties) of all nodes."""
        self._options = options
        self._more: dict[tuple[str, str], dict[str, Any]] = {}
        self._unknown: list[str] = []
        if options.chargers or options.robot_name is not None:
            self._find(sorted(nodes, key=lambda node: (node[0], natural_sort_key(node[1]))))

    def _find(self, nodes: Sequence[tuple[str, str, Properties]]) -> None:
        charger_names = {name.strip() for name in self._options.chargers or ()} - {""}
        parameter_sets = [_vertex_parameters(p) for _, _, p in nodes]
        taken = {str(parameters[ROBOT]) for parameters in parameter_sets if parameters.get(ROBOT)}
        met: set[str] = set()
        number = 0
        for (level, i, p), parameters in zip(nodes, parameter_sets, strict=True):
            names = charger_names & {i, str(p.get("name"))}
            met |= names
            more: dict[str, Any] = {key: True for key in CHARGER if names and key not in parameters}
            charger = bool(names) or parameters.get(CHARGER[0]) is True
            if charger and not parameters.get(ROBOT) and self._options.robot_name is not None:
                number += 1
                while f"{self._options.robot_name}_{number}" in taken:
                    number += 1
                more[ROBOT] = f"{self._options.robot_name}_{number}"
                if not parameters.get(ROBOT_TYPE):
                    more[ROBOT_TYPE] = self._options.robot_type
            if more:
                self._more[level, i] = more
        self._unknown = sorted(charger_names - met)

    def vertex_properties(self, level: str, i: str) -> dict[str, Any]:
        """Return the additional parameters of a vertex, by key."""
        return self._more.get((level, i), {})

    def report(self, context: WriteContext) -> None:
        """Report filled-in values and unknown node names."""
        many = list(self._more.values())
        if charger_count := sum(CHARGER[0] in more for more in many):
            context.fill(
                "vertices: " + ", ".join(CHARGER), True, f"{charger_count} nodes do not specify it", "chargers"
            )
        if names := sorted((str(more[ROBOT]) for more in many if ROBOT in more), key=natural_sort_key):
            why = f"{len(names)} chargers name no robot"
            context.fill(f"vertices: {ROBOT}", names if len(names) <= 20 else [*names[:20], "…"], why, "robot_name")
            context.fill(f"vertices: {ROBOT_TYPE}", self._options.robot_type, why, "robot_type")
        if self._unknown:
            context.warn(
                f"unknown nodes: {', '.join(self._unknown[:5])}; they do not become chargers", where="chargers"
            )


def _vertex_parameters(p: Properties) -> dict[str, Any]:
    """Return a vertex's parameters without their types."""
    graph, building = p.get(NAV_GRAPH), p.get(BUILDING)
    plain = graph.get("parameters") if isinstance(graph, Mapping) else None
    typed_ = building.get("parameters") if isinstance(building, Mapping) else None
    out = dict(plain) if isinstance(plain, Mapping) else {}
    return out | ({key: parameter_value(typed_, key) for key in typed_} if isinstance(typed_, Mapping) else {})


class Flow:
    """Formatter of values in YAML flow style, on one line. Equal mappings are formatted once."""

    MAX_CACHED = 4096
    """Maximum number of cached mappings: mappings with unique names never repeat."""

    def __init__(self) -> None:
        self._cache: dict[str, str] = {}

    def __call__(self, value: Any) -> str:
        """Format a value as YAML that PyYAML and yaml-cpp read alike, mappings with sorted keys."""
        if isinstance(value, dict):
            if not value:
                return "{}"
            key = orjson.dumps(value).decode()  # orjson's bytes occupy 4 kB each, even if short
            text = self._cache.get(key)
            if text is None:
                if len(self._cache) >= self.MAX_CACHED:
                    self._cache.clear()
                text = "{" + ", ".join(f"{yaml.text(k)}: {self(value[k])}" for k in sorted(value)) + "}"
                self._cache[key] = text
            return text
        if isinstance(value, (list, tuple)):
            return "[" + ", ".join(map(self, value)) + "]"
        return yaml.text(value)


def choose_building(keys: Sequence[PartKey], options: Any) -> Sequence[PartKey]:  # noqa: ARG001 - one signature for all formats
    """Choose the networks, the objects that came from Open-RMF formats, and the building's images."""
    return [
        key
        for key in keys
        if key.layer == "topology"
        or (key.layer == "objects" and key.name in (BUILDING, NAV_GRAPH))
        or (key.layer == "resources" and key.name == BUILDING)
    ]
