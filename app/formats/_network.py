"""Shared code of network formats: names as ids, poses of nodes, and merging the networks of an environment.

Nodes are points and edges directed lines between them (see ``app.model.features``); metres in the local frame.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NoReturn

import numpy as np
import shapely
from numpy.typing import NDArray

from app.errors import Problem, UnreadableFile
from app.formats import WriteContext
from app.model.features import Features, Properties, unique_ids
from app.model.frame import is_writable
from app.model.layers import Layers, PartKey

Array = NDArray[np.float64]

MAX_NAME = 256
MAX_ID_CHARACTERS = 480

SAME_ANGLE = 1e-9
"""Angle tolerance in radians, within which a quaternion built from an angle returns it."""

CROSS_PART_PROPERTIES = frozenset({"drawn_from"})
"""Canonical properties that refer to other parts of the environment, not to the item."""


def raise_unreadable(reason: str, location: str) -> NoReturn:
    """Raise UnreadableFile for the value at this location."""
    raise UnreadableFile(f"{location}: {reason}", [Problem(reason, where=location)])


def is_name(name: str) -> bool:
    """Whether a text can be written in one line of any format."""
    return 0 < len(name) <= MAX_NAME and is_writable(name)


def check_name(name: str, location: str) -> str:
    """Return the name. Raises UnreadableFile if it is invalid."""
    if not is_name(name):
        raise_unreadable(
            f"a name must have 1 to {MAX_NAME} characters and no control characters, got {name[:60]!r}", location
        )
    return name


def identifier(name: str) -> str:
    """Return the name as an id; a name that is too long becomes its beginning and a hash."""
    if len(name) <= MAX_ID_CHARACTERS:
        return name
    return f"{name[: MAX_ID_CHARACTERS - 17]}~{hashlib.sha256(name.encode()).hexdigest()[:16]}"


def number(value: Any, location: str) -> float:
    """Return a finite number. Raises UnreadableFile for texts, booleans and numbers that a float cannot represent."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise_unreadable(f"{str(value)[:60]!r} is not a number", location)
    if not math.isfinite(value):
        raise_unreadable("the number is not finite", location)
    return float(value)


def shorten_list(names: Sequence[Any]) -> str:
    """Format the first few names for a message."""
    return ", ".join(map(str, names[:5])) + (" …" if len(names) > 5 else "")


def natural_sort_key(name: str) -> tuple[int, str]:
    """Return a key that sorts WayPoint9 before WayPoint10."""
    return len(name), name


def node_points(xyz: Array) -> NDArray[np.object_]:
    """Build points from float64 [n, 3]; points with z = 0 become two-dimensional."""
    out = np.asarray(shapely.points(xyz[:, :2]), object).reshape(len(xyz))
    high = xyz[:, 2] != 0
    if high.any():
        out[high] = shapely.points(xyz[high])
    return out


def edge_lines(
    xyz: Array, sources: Sequence[int] | NDArray[np.intp], targets: Sequence[int] | NDArray[np.intp]
) -> NDArray[np.object_]:
    """Build lines of two points between nodes, given by index; two-dimensional if both ends have z = 0."""
    ends = np.stack([xyz[np.array(sources, np.intp)], xyz[np.array(targets, np.intp)]], axis=1)
    out: NDArray[np.object_] = np.empty(len(ends), object)
    high = (ends[:, :, 2] != 0).any(axis=1)
    if not high.all():
        out[~high] = shapely.linestrings(ends[~high][:, :, :2])
    if high.any():
        out[high] = shapely.linestrings(ends[high])
    return out


def quaternion(yaw: float) -> list[float]:
    """Return the quaternion [x, y, z, w] of a rotation about z by this angle in radians."""
    return [0.0, 0.0, math.sin(yaw / 2.0) + 0.0, math.cos(yaw / 2.0) + 0.0]


def yaw(orientation: Any) -> float | None:
    """Return the angle about z in radians, -π to π, of a quaternion [x, y, z, w]; None if it is invalid."""
    if not isinstance(orientation, (list, tuple)) or len(orientation) != 4:
        return None
    if not all(isinstance(v, (int, float)) and not isinstance(v, bool) and math.isfinite(v) for v in orientation):
        return None
    x, y, z, w = map(float, orientation)
    length = x * x + y * y + z * z + w * w
    if not 1e-12 < length < 1e12:
        return None
    return math.atan2(2.0 * (w * z + x * y), length - 2.0 * (y * y + z * z))


def is_flat(orientation: Any) -> bool:
    """Whether a quaternion rotates about z only."""
    return yaw(orientation) is None or max(abs(orientation[0]), abs(orientation[1])) < SAME_ANGLE


def yaw_or_source(source_yaw: Any, orientation: Any) -> float | None:
    """Return a quaternion's angle in radians: the source's value if it is the same angle, else from -π to π."""
    now = yaw(orientation)
    if now is None:
        return None
    is_number = isinstance(source_yaw, (int, float)) and not isinstance(source_yaw, bool)
    return (
        source_yaw
        if is_number and abs(math.remainder(source_yaw - now, math.tau)) < SAME_ANGLE
        else round(now, 12) + 0.0
    )


@dataclass(frozen=True, slots=True)
class Edge:
    """Directed edge: id, indexes of its nodes in ``MergedNetwork.nodes``, shape in metres, and its network's key."""

    id: str
    source: int
    target: int
    properties: Properties
    geometry: Any
    part: PartKey


@dataclass(frozen=True, slots=True)
class Node:
    """Node: an id that is unique in all networks, and a position in metres; z is None in 2-D."""

    id: str
    x: float
    y: float
    z: float | None
    properties: Properties
    level: str


@dataclass(slots=True)
class MergedNetwork:
    """All networks of an environment as one; node ids are unique, and so are edge ids."""

    nodes: list[Node] = field(default_factory=list)
    edges: list[Edge] = field(default_factory=list)
    levels: list[str] = field(default_factory=list)


def merge_networks(layers: Layers, context: WriteContext) -> MergedNetwork:
    """Merge all networks, with nodes and edges in the order of their parts.

    Edges refer to nodes of their own part first, then of other parts. Items that are neither a node with a point nor an
    edge between nodes are declared as dropped; ids that occur in several networks get a number, with a warning. Raises
    MissingDatum if a network is in wgs84 and there is no datum.
    """
    net = MergedNetwork()
    homes: list[dict[str, int]] = []
    everywhere: dict[str, int] = {}
    taken: set[str] = set()
    renamed: list[str] = []
    strange = 0
    parts = layers.vector("topology")
    shapes = {}
    for key, part in parts.items():
        geometry = shapes[key] = part.in_local(layers.frame)
        is_point = (shapely.get_type_id(geometry) == 0) & ~shapely.is_empty(geometry)
        places = [k for k in np.flatnonzero(is_point).tolist() if part.properties[k].get("kind") == "node"]
        strange += sum(p.get("kind") != "edge" for p in part.properties) - len(places)
        part_ids = [part.ids[k] for k in places]
        ids = unique_ids(part_ids, taken)
        renamed += [a for a, b in zip(part_ids, ids, strict=True) if a != b]
        taken.update(ids)
        home = dict(zip(part_ids, range(len(net.nodes), len(net.nodes) + len(part_ids)), strict=True))
        homes.append(home)
        everywhere = {**home, **everywhere}
        xyz = shapely.get_coordinates(geometry[places], include_z=True)
        for k, i, (x, y, z) in zip(places, ids, xyz.tolist(), strict=True):
            net.nodes.append(Node(i, x, y, None if math.isnan(z) else z, part.properties[k], key.level))
        net.levels.append(key.level)
    dropped_count = _join_edges(net, parts, shapes, homes, everywhere)
    if renamed:
        context.warn(
            f"{len(renamed)} ids occur in more than one network; a numeric suffix makes them unique: "
            f"{shorten_list(renamed)}"
        )
    context.drop("items that are neither a node with a point nor an edge", strange, "they are not part of a network")
    context.drop("edges without both end nodes", dropped_count, "they connect nothing")
    return net


def _join_edges(
    net: MergedNetwork, parts: Any, shapes: Any, homes: list[dict[str, int]], everywhere: dict[str, int]
) -> int:
    taken: set[str] = set()
    dropped_count = 0
    for (key, part), home in zip(parts.items(), homes, strict=True):
        rows: list[tuple[int, int, int]] = []
        for k, p in enumerate(part.properties):
            if p.get("kind") != "edge":
                continue
            ends = [p.get("source"), p.get("target")]
            end_nodes = [home.get(e, everywhere.get(e)) if isinstance(e, str) else None for e in ends]
            if end_nodes[0] is None or end_nodes[1] is None:
                dropped_count += 1
            else:
                rows.append((k, end_nodes[0], end_nodes[1]))
        ids = unique_ids((part.ids[k] for k, _, _ in rows), taken)
        taken.update(ids)
        for (k, source, target), i in zip(rows, ids, strict=True):
            net.edges.append(Edge(i, source, target, part.properties[k], shapes[key][k], key))
    return dropped_count


def source_document(layers: Layers, name: str) -> dict[str, Any]:
    """Return the document of the first network from this format; empty if there is none."""
    for part in layers.vector("topology").values():
        document = part.document.get(name)
        if isinstance(document, dict):
            return dict(document)
    return {}


def get_source_properties(properties: Properties, name: str) -> dict[str, Any]:
    """Return an item's source properties of a format; empty if there are none."""
    members = properties.get(name)
    return members if isinstance(members, dict) else {}


def count(items: Any) -> int:
    """Return a list's length; 0 for any other value (files of other formats may contain anything)."""
    return len(items) if isinstance(items, list) else 0


def report_3d_loss(net: MergedNetwork, context: WriteContext, why: str) -> None:
    """Declare the data that a flat format without levels drops."""
    context.drop("altitudes of nodes", sum(bool(n.z) for n in net.nodes), why)
    if len(set(net.levels)) > 1:
        context.drop("levels of nodes", len(net.nodes), "all networks are joined into one")


def duplicates(names: Sequence[str]) -> list[str]:
    """Return the names that occur more than once, each once, in order."""
    seen: set[str] = set()
    repeats: dict[str, None] = {}
    for name in names:
        if name in seen:
            repeats[name] = None
        seen.add(name)
    return list(repeats)


def empty(document: Properties) -> Features:
    """Return a part without items that contains only a collection document."""
    return Features((), np.empty(0, object), (), np.empty(0, bool), document)
