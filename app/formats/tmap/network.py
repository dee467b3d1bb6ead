"""What tmap2 and tmap share: the networks of topological_navigation, as YAML.

Nodes with poses, and directed edges listed in their source. Positions are metres in the local frame, orientations
quaternions. Two layouts: the mapping (tmap2, also with a block of ``verts`` anchors on top) and the older list (tmap).
Source: topological_navigation, config/tmap-schema.yaml and its map managers (manager.py reads the list, manager2.py the
mapping).

Canonical: a node's id is its name, an edge's id its ``edge_id``. What only these files know of an item is its
``properties.tmap2``: a node's is the entry of the file, ``{meta?, node: {…}}``, less what is canonical or follows from
the document; an edge's is its mapping in the file, less what is canonical. ``node.name`` and ``edge_id`` stand there
only where they differ from the id (names may repeat), ``node.edges`` only for edges to nowhere. The document's
``tmap2`` is the file's top level without the nodes, ``tmap`` says that it was a list. A node's or edge's own
``properties`` in the file may hold canonical words (``speed_limit``, ``width``, ``name``) and what other formats know
of it (``kml: {…}``): on reading these become canonical properties again, and on writing go there.
"""

from __future__ import annotations

import hashlib
import math
import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import orjson
import shapely
from numpy.typing import NDArray

from app.errors import Problem, UnreadableFile
from app.formats import Files, ReadContext, WriteContext, _fields, all_formats
from app.formats._fields import ANY, COORDINATE, NOT_NEGATIVE, POINT, SPEED, WIDTH, Number, Quaternion, Text, record
from app.model.features import Features, Properties, from_columns, points, unique_ids
from app.model.frame import GROUND
from app.model.layers import NETWORK, Layers, PartKey
from app.parameters import parameter
from app.syntax import yaml
from app.syntax.decimals import METRES, encode_pieces, numbers

NAME = "tmap2"
LAST_UPDATED = re.compile(r"[0-9]{4}-[0-9]{2}-[0-9]{2}_[0-9]{2}-[0-9]{2}-[0-9]{2}\Z")
EPOCH = "1970-01-01_00-00-00"
"""Where a source tells no time: the schema asks for one, and the same network must give the same bytes."""

MAX_NAME = 256
MAX_ID_CHARACTERS = 480

NODE_WORDS = frozenset({"edges", "name", "pose"})
EDGE_WORDS = frozenset({"edge_id", "node", "action"})
CANONICAL_NODE = frozenset({"kind", "name", "orientation", NAME})
CANONICAL_EDGE = frozenset({"kind", "source", "target", "action", NAME})
CROSS_PART_PROPERTIES = frozenset({"drawn_from"})
"""Canonical properties that speak of other parts of the environment, not of the item."""

WRITTEN_ON_DEMAND = frozenset({"osm"})
"""What these formats know of an item is written on demand: OSM's tags and history are larger than all the rest."""

NUMERIC_WORDS = ("speed_limit", "width")

ACTION, ACTION_TYPE = "move_base", "move_base_msgs/MoveBaseGoal"
RADIUS = 0.75


def ring(radius: float) -> list[dict[str, float]]:
    """The influence zone of a node that has none: a regular octagon around it, metres from the node."""
    turns = (math.pi / 8 + k * math.pi / 4 for k in range(8))
    return [{"x": round(radius * math.cos(a), 12), "y": round(radius * math.sin(a), 12)} for a in turns]


EDGE_TEMPLATE: Mapping[str, Any] = {
    "config": [],
    "goal": {"target_pose": {"header": {"frame_id": "$node.parent_frame"}, "pose": "$node.pose"}},
}
"""What new edges get besides what the options say."""

FRAME, ANYWHERE = "map", "True"
"""Frame of nodes, and the restriction that forbids nothing."""

TOLERANCES = {"xy_goal_tolerance": 0.3, "yaw_goal_tolerance": 0.1}
ANY_YAW = 6.29
"""Yaw tolerance of a node whose orientation is not known: any."""

TRANSFORMATION = {
    "child": "topo_map",
    "parent": "map",
    "rotation": {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0},
    "translation": {"x": 0.0, "y": 0.0, "z": 0.0},
}

_YAW = Number(0.0, 1e4, usual=(0.0, 10.0), hint="is it in radians?", unit="rad")
_FREE = record(
    is_open=True,
    is_loose=True,
    speed_limit=replace(SPEED, doubtful=True),
    width=replace(WIDTH, doubtful=True),
    xy_goal_tolerance=NOT_NEGATIVE,
    yaw_goal_tolerance=_YAW,
)
_EDGE = record(
    "action action_type config edge_id fail_policy fluid_navigation node recovery_behaviours_config map_2d",
    goal=record(target_pose=record(is_open=True, pose=ANY)),
    restrictions_planning=Text(),
    restrictions_runtime=Text(),
    properties=_FREE,
    top_vel=SPEED,
    inflation_radius=NOT_NEGATIVE,
)
_NODE = record(
    "name parent_frame localise_by_topic map pointset",
    edges=[_EDGE],
    pose=record(position=POINT, orientation=Quaternion()),
    properties=_FREE,
    restrictions_planning=Text(),
    restrictions_runtime=Text(),
    verts=[record(x=COORDINATE, y=COORDINATE)],
    xy_goal_tolerance=NOT_NEGATIVE,
    yaw_goal_tolerance=_YAW,
)
_ENTRIES = [record(node=_NODE, meta=record(is_open=True))]
SHAPE = record(
    "metric_map name pointset verts",
    meta=record(is_open=True),
    transformation=record("child parent topo_map", rotation=Quaternion(), translation=POINT),
    nodes=_ENTRIES,
)
"""What tmap2 files hold (the older list: its nodes). Source: topological_navigation's map files of all versions."""

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class WriteOptions:
    """What a robot does along edges whose source names no action, and what the file calls itself."""

    action: str = parameter(ACTION, "action of edges that name none")
    action_type: str = parameter(ACTION_TYPE, "type of that action's goal")
    verts_radius: float = parameter(
        RADIUS, "of the octagon around nodes that have no verts", minimum=1e-3, maximum=1000.0, unit="m"
    )
    xy_goal_tolerance: float = parameter(
        TOLERANCES["xy_goal_tolerance"], "of nodes that have none", minimum=0.0, maximum=1000.0, unit="m"
    )
    yaw_goal_tolerance: float = parameter(
        TOLERANCES["yaw_goal_tolerance"],
        f"of nodes that have none; {ANY_YAW} where a node's orientation is not known",
        minimum=0.0,
        maximum=ANY_YAW,
        unit="rad",
    )
    osm: bool = parameter(False, "write OpenStreetMap's tags and attributes under properties of nodes and edges")
    pointset: str | None = parameter(
        None, "name of the network and its pointset; default: the source's, else the map's"
    )
    fail_policy: str = parameter("fail", "what becomes of a failed edge, where its source names nothing")
    fluid_navigation: bool = parameter(True, "whether new edges are driven without a stop at their end")
    recovery: str = parameter("", "recovery_behaviours_config of edges that name none")
    restrictions: str = parameter(ANYWHERE, "for planning and at run time, of nodes and edges that name none")
    parent_frame: str = parameter(FRAME, "frame of nodes that name none")
    localise_by_topic: str = parameter("", "of nodes that name none")


@dataclass(frozen=True, slots=True)
class ListOptions:
    """What a robot does along edges whose source names no action, and what the pointset is called."""

    action: str = parameter(ACTION, "action of edges that name none")
    top_vel: float = parameter(0.55, "speed on edges without a limit", minimum=0.0, maximum=100.0, unit="m/s")
    verts_radius: float = parameter(
        RADIUS, "of the octagon around nodes that have no verts", minimum=1e-3, maximum=1000.0, unit="m"
    )
    xy_goal_tolerance: float = parameter(
        TOLERANCES["xy_goal_tolerance"], "of nodes that have none", minimum=0.0, maximum=1000.0, unit="m"
    )
    yaw_goal_tolerance: float = parameter(
        TOLERANCES["yaw_goal_tolerance"],
        f"of nodes that have none; {ANY_YAW} where a node's orientation is not known",
        minimum=0.0,
        maximum=ANY_YAW,
        unit="rad",
    )
    osm: bool = parameter(False, "write OpenStreetMap's tags and attributes under properties of nodes and edges")
    pointset: str | None = parameter(None, "name of the pointset; default: the source's, else the map's")
    inflation_radius: float = parameter(0.0, "of edges that name none", minimum=0.0, maximum=1000.0, unit="m")
    recovery: str = parameter("", "recovery_behaviours_config of edges that name none")
    localise_by_topic: str = parameter("", "of nodes that name none")


# --- reading ---------------------------------------------------------------------------------------------------------


def read(files: Files, context: ReadContext) -> Layers:
    """The network as topology, or, where no node has an edge, its nodes as objects of kind ``poi``.

    Coordinates are local metres; 2-D where z is 0. Raises UnreadableFile naming the node.
    """
    if not (context.wants("topology") or context.wants("objects")):
        return Layers()
    top = yaml.load(files[context.main or next(iter(files))], context.limits)
    legacy = isinstance(top, list)
    entries, document = _top(top, context)
    nodes = [_entry(entry, k) for k, entry in enumerate(entries)]
    names = [_name(node.get("name"), k, context) for k, node in enumerate(nodes)]
    ids = unique_ids(map(_identifier, names))
    _warn_names(names, context)
    index_by_name = {name: k for k, name in reversed(list(enumerate(names)))}

    rows, dangling = _edges(nodes, names, index_by_name, context)
    common = {"map": document.get("metric_map"), "pointset": document.get("pointset")}
    xyz, orientations = _poses(nodes, names)
    _fields.check(top, _ENTRIES if legacy else SHAPE, context)
    _to_local(xyz, orientations, nodes, document, context)
    has_edges = bool(rows) or bool(dangling)
    kind = "node" if has_edges or not nodes else "poi"
    properties: list[Properties] = []
    for k, (entry, node, name) in enumerate(zip(entries, nodes, names, strict=True)):
        node_properties: dict[str, Any] = {"kind": kind, "name": name}
        if orientations[k] is not None:
            node_properties["orientation"] = orientations[k]
        node_properties[NAME] = source_properties = _extra_node_members(entry, node, name, common)
        if name != ids[k]:
            source_properties["node"]["name"] = name
        if k in dangling:
            source_properties["node"]["edges"] = dangling[k]
        _lift(node_properties, source_properties["node"])
        properties.append(node_properties)
    geometry = _node_points(xyz)
    meta = document.get("meta")
    credit = [
        text for key in ("attribution", "license", "copyright") if isinstance(meta, dict) and (text := meta.get(key))
    ]
    credit = [text for text in credit if isinstance(text, str)]
    collection_document: dict[str, Any] = {"attribution": credit} if credit else {}
    collection_document |= {NAME: document, **({"tmap": {"layout": "list"}} if legacy else {})}
    if kind == "poi":
        context.warn(f"no node has an edge: the {len(nodes)} nodes are taken as points of interest")
        key = PartKey("objects", context.level, NAME)
        return Layers({key: from_columns(ids, geometry, properties, "local", collection_document)})

    sources = np.array([r[0] for r in rows], np.intp)
    targets = np.array([r[1] for r in rows], np.intp)
    _warn_isolated(names, sources, targets, dangling, context)
    edge_ids = unique_ids((_identifier(r[2]) for r in rows), set(ids))
    repeated = []
    for (source, target, source_id, edge), edge_id in zip(rows, edge_ids, strict=True):
        extra_members = {key: value for key, value in edge.items() if key not in EDGE_WORDS}
        line: dict[str, Any] = {"kind": "edge", "source": ids[source], "target": ids[target], NAME: extra_members}
        if "action" in edge:
            if isinstance(edge["action"], str):
                line["action"] = edge["action"]
            else:
                extra_members["action"] = edge["action"]
        if source_id != edge_id:
            extra_members["edge_id"] = source_id
            repeated.append(source_id)
        if "properties" in extra_members:
            _lift(line, extra_members)
        properties.append(line)
    if repeated:
        context.warn(f"{len(repeated)} edge ids stand for several things: {_shorten(repeated)}; all are kept")
    both = np.concatenate([geometry, _edge_lines(xyz, sources, targets)])
    key = PartKey("topology", context.level, NETWORK)
    return Layers({key: from_columns([*ids, *edge_ids], both, properties, "local", collection_document)})


def _top(top: Any, context: ReadContext) -> tuple[list[Any], dict[str, Any]]:
    """(entries of the nodes, everything else of the top level)."""
    if isinstance(top, list):
        document: dict[str, Any] = {}
        for key, meta_key in (("metric_map", "map"), ("pointset", "pointset"), ("name", "pointset")):
            metas = (e["meta"].get(meta_key) for e in top if isinstance(e, dict) and isinstance(e.get("meta"), dict))
            most_common = Counter(m for m in metas if isinstance(m, str)).most_common(1)
            if most_common:
                document[key] = most_common[0][0]
        return top, document
    if not isinstance(top, dict) or not isinstance(top.get("nodes"), list):
        raise UnreadableFile("there is no list of nodes: not a topological map", [Problem("no list", where="nodes")])
    document = {key: value for key, value in top.items() if key != "nodes"}
    for key in ("name", "metric_map", "pointset"):
        if key not in document:
            context.warn("is missing; tmap2 readers ask for it", where=key)
        elif not isinstance(document[key], str):
            context.warn(f"is {document[key]!r}, not a text; it is served as a text", where=key)
    return top["nodes"], document


def _entry(entry: Any, k: int) -> dict[str, Any]:
    node = entry.get("node") if isinstance(entry, dict) else None
    if not isinstance(node, dict):
        raise UnreadableFile(f"nodes[{k}] has no mapping 'node'", [Problem("no mapping 'node'", where=f"nodes[{k}]")])
    edges = node.get("edges")
    if edges is not None and not (isinstance(edges, list) and all(isinstance(e, dict) for e in edges)):
        location = f"nodes[{k}].node.edges"
        raise UnreadableFile(
            f"{location} must be a list of mappings", [Problem("must be a list of mappings", where=location)]
        )
    if not isinstance(entry.get("meta", {}), (dict, type(None))):
        raise UnreadableFile(f"nodes[{k}].meta must be a mapping", [Problem("not a mapping", where=f"nodes[{k}].meta")])
    return node


def _name(raw_name: Any, k: int, context: ReadContext) -> str:
    location = f"nodes[{k}].node.name"
    name = raw_name if isinstance(raw_name, str) else ""
    if not isinstance(raw_name, str):
        if raw_name is None or isinstance(raw_name, (dict, list)):
            raise UnreadableFile(
                f"{location}: a node must have a name", [Problem("a node must have a name", where=location)]
            )
        context.warn(f"the name {raw_name!r} is no text; it is served as one", where=location)
        name = yaml.text(raw_name)
    if not 0 < len(name) <= MAX_NAME or (
        not name.isprintable() and any(unicodedata.category(c) in ("Cc", "Zl", "Zp") for c in name)
    ):
        reason = f"a name must have 1 to {MAX_NAME} characters and no control characters"
        raise UnreadableFile(f"{location}: {reason}", [Problem(f"{reason}, got {name[:60]!r}", where=location)])
    return name


def _identifier(name: str) -> str:
    """A usable id: the name itself but for invisible characters, other Unicode forms of it, and its length."""
    if name.isascii() and name.isprintable() and len(name) <= MAX_ID_CHARACTERS:
        return name
    plain = unicodedata.normalize("NFC", name)
    plain = "".join(c if c.isprintable() else f"\\u{ord(c):04x}" for c in plain)
    if len(plain) > MAX_ID_CHARACTERS:
        plain = f"{plain[: MAX_ID_CHARACTERS - 17]}~{hashlib.sha256(name.encode()).hexdigest()[:16]}"
    return plain


def _warn_names(names: Sequence[str], context: ReadContext) -> None:
    repeated = [name for name, count in Counter(names).items() if count > 1]
    if repeated:
        context.warn(
            f"{len(repeated)} node names stand twice or more: {_shorten(repeated)}; edges to them go to the first"
        )
    for name in names:
        if not name.isascii() and not name.isprintable():
            context.warn(f"the name {name!r} has invisible characters", where=name)


def _shorten(names: Sequence[Any]) -> str:
    return ", ".join(map(str, names[:5])) + (" …" if len(names) > 5 else "")


Row = tuple[int, int, str, dict[str, Any]]


def _edges(
    nodes: Sequence[dict[str, Any]], names: Sequence[str], index_by_name: Mapping[str, int], context: ReadContext
) -> tuple[list[Row], dict[int, list[Any]]]:
    """((source, target, edge id, mapping) of each edge between nodes; the edges to nowhere by node)."""
    rows: list[Row] = []
    dangling: dict[int, list[Any]] = {}
    loops = []
    for k, node in enumerate(nodes):
        for edge in node.get("edges") or ():
            to = edge.get("node")
            if not isinstance(to, str) and to is not None and not isinstance(to, (dict, list)):
                to = yaml.text(to)
            target = index_by_name.get(to) if isinstance(to, str) else None
            edge_id = edge.get("edge_id")
            if not isinstance(edge_id, str):
                edge_id = (
                    f"{names[k]}_{to}" if edge_id is None or isinstance(edge_id, (dict, list)) else yaml.text(edge_id)
                )
            if target is None:
                dangling.setdefault(k, []).append(edge)
                context.warn(
                    f"the edge {edge_id!r} leads to {to!r}, which is no node; it is kept with its node", where=names[k]
                )
                continue
            if target == k:
                loops.append(edge_id)
            rows.append((k, target, edge_id or f"{names[k]}_{to}", edge))
    if loops:
        context.warn(f"{len(loops)} edges lead from a node to itself: {_shorten(loops)}")
    return rows, dangling


def _warn_isolated(
    names: Sequence[str],
    sources: NDArray[np.intp],
    targets: NDArray[np.intp],
    dangling: Mapping[int, Any],
    context: ReadContext,
) -> None:
    linked = np.zeros(len(names), bool)
    linked[sources] = linked[targets] = linked[list(dangling)] = True
    lonely = [names[k] for k in np.flatnonzero(~linked).tolist()]
    if lonely:
        context.warn(f"{len(lonely)} nodes have no edges: {_shorten(lonely)}")


def _poses(nodes: Sequence[dict[str, Any]], names: Sequence[str]) -> tuple[Array, list[list[float] | None]]:
    """(float64 [n, 3] positions in metres, a quaternion [x, y, z, w] or None for each)."""
    positions: list[tuple[Any, ...]] = []
    orientations: list[list[float] | None] = []
    for node, name in zip(nodes, names, strict=True):
        try:
            pose = node["pose"]
            at, turned = pose["position"], pose.get("orientation")
            positions.append((at["x"], at["y"], at.get("z", 0.0)))
            orientations.append(None if turned is None else [turned["x"], turned["y"], turned["z"], turned["w"]])
        except (KeyError, TypeError, AttributeError, IndexError) as error:
            reason = f"the node {name!r} needs pose.position with x and y, and x, y, z, w in its orientation, if any"
            raise UnreadableFile(reason, [Problem(reason, where=f"{name}.pose")]) from error
    xyz = _numbers(positions, 3, names, "position")
    indices = [k for k, o in enumerate(orientations) if o is not None]
    turned = _numbers([tuple(orientations[k] or ()) for k in indices], 4, [names[k] for k in indices], "orientation")
    for k, row in zip(indices, turned.tolist(), strict=True):
        orientations[k] = row
    return xyz, orientations


def _numbers(rows: Sequence[tuple[Any, ...]], width: int, names: Sequence[str], member: str) -> Array:
    """float64 [n, width]; a number that stands in quotes is one too."""
    flat = [v for row in rows for v in row]
    if not all(map((float, int).__contains__, map(type, flat))):
        for k, value in enumerate(flat):
            flat[k] = _number(value, f"{names[k // width]}.pose.{member}")
    return np.array(flat, np.float64).reshape(-1, width)


def _number(value: Any, location: str) -> float:
    try:
        number = yaml.scalar(value) if isinstance(value, str) else value
    except ValueError:
        number = None
    if isinstance(number, bool) or not isinstance(number, (int, float)):
        raise UnreadableFile(
            f"{location}: {value!r} is not a number", [Problem(f"{value!r} is not a number", where=location)]
        )
    return float(number)


def _extra_node_members(
    entry: Mapping[str, Any], node: Mapping[str, Any], name: str, common: Mapping[str, Any]
) -> dict[str, Any]:
    """What of a node's entry is neither canonical nor said by the document."""
    extra_members = {key: value for key, value in node.items() if key not in NODE_WORDS}
    pose = node["pose"]
    if len(pose) > 2 or len(pose["position"]) > 3 or len(pose.get("orientation") or ()) not in (0, 4):
        more = {key: value for key, value in pose.items() if key not in ("position", "orientation")}
        for member, axes in (("position", "xyz"), ("orientation", "xyzw")):
            extra = {key: value for key, value in (pose.get(member) or {}).items() if key not in axes}
            more |= {member: extra} if extra else {}
        if more:
            extra_members["pose"] = more
    out: dict[str, Any] = {"node": extra_members}
    if len(entry) > 2:
        out |= {key: value for key, value in entry.items() if key not in ("meta", "node")}
    meta = {
        key: value
        for key, value in (entry.get("meta") or {}).items()
        if not (value == name if key == "node" else key in common and common[key] == value)
    }
    if meta:
        out["meta"] = meta
    return out


def _lift(properties: dict[str, Any], extra_members: dict[str, Any]) -> None:
    """Bring canonical words and other formats' knowledge from an item's ``properties`` to where they belong."""
    inner_properties = extra_members.get("properties")
    if not isinstance(inner_properties, dict):
        return
    lifted = {
        key: value
        for key, value in inner_properties.items()
        if (key in NUMERIC_WORDS and isinstance(value, (int, float)) and not isinstance(value, bool) and value > 0)
        or (key == "name" and isinstance(value, str) and value not in ("", properties.get("name")))
        or (isinstance(value, dict) and key in _families() and key != NAME)
    }
    if lifted:
        properties.update(lifted)
        extra_members["properties"] = {key: value for key, value in inner_properties.items() if key not in lifted}
        if not extra_members["properties"]:
            del extra_members["properties"]


@cache
def _families() -> frozenset[str]:
    """Names under which formats keep what only they know of an item."""
    return frozenset(all_formats())


def _node_points(xyz: Array) -> NDArray[np.object_]:
    """Points, 2-D where z is 0."""
    out = points(np.ascontiguousarray(xyz[:, :2]))
    high = xyz[:, 2] != 0
    if high.any():
        out[high] = points(xyz[high])
    return out


def _edge_lines(xyz: Array, sources: NDArray[np.intp], targets: NDArray[np.intp]) -> NDArray[np.object_]:
    """Lines of two points from node to node, 2-D where both lie at 0."""
    ends = np.stack([xyz[sources], xyz[targets]], axis=1)
    out: NDArray[np.object_] = np.empty(len(ends), object)
    high = (ends[:, :, 2] != 0).any(axis=1)
    if not high.all():
        out[~high] = shapely.linestrings(ends[~high][:, :, :2])
    if high.any():
        out[high] = shapely.linestrings(ends[high])
    return out


# --- frames ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _MapTransform:
    """A file's ``transformation``: a pose in the child frame, turned and shifted, is one in the local frame."""

    child: str
    quaternion: tuple[float, float, float, float]
    shift: Array

    def matrix(self) -> Array:
        """Rotation matrix [3, 3] of the quaternion (x, y, z, w)."""
        x, y, z, w = self.quaternion
        return np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )


def _turn(document: Mapping[str, Any]) -> _MapTransform | None:
    """The file's transformation, where there is one that changes anything."""
    transformation = document.get("transformation")
    if (
        not isinstance(transformation, dict)
        or not isinstance(transformation.get("child"), str)
        or transformation["child"] == transformation.get("parent")
    ):
        return None
    rotation, translation = transformation.get("rotation") or {}, transformation.get("translation") or {}
    if not isinstance(rotation, dict) or not isinstance(translation, dict):
        return None
    location = "transformation"
    x, y, z = (_number(rotation.get(key, 0.0), f"{location}.rotation.{key}") for key in "xyz")
    w = _number(rotation.get("w", 1.0), f"{location}.rotation.w")
    shift = np.array([_number(translation.get(key, 0.0), f"{location}.translation.{key}") for key in "xyz"])
    length = math.sqrt(x * x + y * y + z * z + w * w)
    if not math.isfinite(length) or length < 1e-9:
        raise UnreadableFile(
            "transformation.rotation is no rotation", [Problem("no rotation", where=f"{location}.rotation")]
        )
    if x == y == z == 0.0 and not shift.any():
        return None
    return _MapTransform(transformation["child"], (x / length, y / length, z / length, w / length), shift)


def _times(a: Sequence[float], b: Sequence[float]) -> list[float]:
    """The product of two quaternions (x, y, z, w): first b, then a."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return [
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    ]


def _to_local(
    xyz: Array,
    orientations: list[list[float] | None],
    nodes: Sequence[Mapping[str, Any]],
    document: Mapping[str, Any],
    context: ReadContext,
) -> None:
    """Bring the poses of nodes whose parent_frame is the transformation's child to the local frame, in place."""
    turn = _turn(document)
    if turn is None:
        return
    inside = [k for k, node in enumerate(nodes) if node.get("parent_frame") == turn.child]
    if not inside:
        return
    xyz[inside] = xyz[inside] @ turn.matrix().T + turn.shift
    for k in inside:
        orientations[k] = _times(turn.quaternion, orientations[k] or [0.0, 0.0, 0.0, 1.0])
    context.warn(
        f"{len(inside)} nodes stand in the frame {turn.child!r} and were brought to the local one by the file's "
        "transformation"
    )


# --- writing ---------------------------------------------------------------------------------------------------------


def write(layers: Layers, context: WriteContext, *, listed: bool = False) -> bytes:
    """The text of a file: all networks of the environment in one, nodes and edges sorted by length and text of id.

    listed: as the older list. Wgs84 items are brought to local metres (MissingDatum without a datum). What the source
    did not say is filled in.
    """
    return _Writer(layers, context, listed=listed).file()


Lines = list[tuple[int, str, str]]
"""(length, name or id, text) of nodes or edges: sorted so, WayPoint9 stands before WayPoint10."""


class _Writer:
    """One file being written: its head, the templates of items met so far, counts for the report."""

    def __init__(self, layers: Layers, context: WriteContext, *, listed: bool) -> None:
        self.layers, self.context, self.listed = layers, context, listed
        kind = ListOptions if listed else WriteOptions
        self.options: WriteOptions | ListOptions = context.options if isinstance(context.options, kind) else kind()
        self.document = self._document()
        self.turn = _turn(self.document)
        self.ring = ring(self.options.verts_radius)
        self.legacy = False  # whether the network at hand came as the older list, which lacks much that tmap2 asks for
        self.unwritten = CROSS_PART_PROPERTIES if self.options.osm else CROSS_PART_PROPERTIES | WRITTEN_ON_DEMAND
        # Properties without anything for an item's own ``properties``.
        self.plain_node, self.plain_edge = CANONICAL_NODE | self.unwritten, CANONICAL_EDGE | self.unwritten
        self.templates: dict[Any, list[str]] = {}
        self.filled: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()

    def _document(self) -> dict[str, Any]:
        """The top level without the nodes: as the source says, completed."""
        parts = list(self.layers.vector("topology").values())
        parts += [part for key, part in self.layers.vector("objects").items() if key.name == NAME]
        source_document: Any = next((p.document[NAME] for p in parts if isinstance(p.document.get(NAME), Mapping)), {})
        document = {key: value for key, value in source_document.items() if key != "nodes"}
        default_name = next((document[key] for key in ("pointset", "name", "metric_map") if document.get(key)), None)
        title = default_name if isinstance(default_name, str) else self.context.title
        if self.listed:
            more = [key for key in document if key not in ("metric_map", "pointset")]
            if document.get("name") == document.get("pointset"):
                more = [key for key in more if key != "name"]
            self.context.drop("top level keys of a tmap2 file", len(more), "a list has no place for " + _shorten(more))
            document = {key: document[key] for key in ("metric_map", "pointset") if key in document}
        for key in ("metric_map", "pointset") if self.listed else ("metric_map", "name", "pointset"):
            value = document.get(key)
            if value is None or isinstance(value, (dict, list)):
                document[key] = title
                self.context.fill(key, title, "no source names it")
            elif not isinstance(value, str):
                document[key] = yaml.text(value)
                self.context.warn(f"the source's {key} is no text; {document[key]!r} is written", where=key)
        if self.options.pointset is not None:
            document["name"] = document["pointset"] = self.options.pointset
        if self.listed:
            return document
        meta = dict(document["meta"]) if isinstance(document.get("meta"), dict) else {}
        updated = meta.get("last_updated")
        if not (isinstance(updated, str) and LAST_UPDATED.match(updated)):
            meta["last_updated"] = EPOCH
            self.context.fill("meta.last_updated", EPOCH, "no source tells it in the form that the schema wants")
            if updated is not None:
                self.context.warn(f"last_updated {updated!r} is no time; {EPOCH} is written", where="meta.last_updated")
        if self.context.attribution and not meta.keys() & {"attribution", "license", "copyright"}:
            meta["attribution"] = "; ".join(self.context.attribution)
        document["meta"] = meta
        if "transformation" not in document:
            document["transformation"] = TRANSFORMATION
            self.context.fill("transformation", "identity, from map to topo_map", "no source names it")
        return document

    def file(self) -> bytes:
        """The whole file."""
        nodes: Lines = []
        taken: set[str] = set()
        networks = self.layers.vector("topology")
        for key, part in networks.items():
            nodes += self._network(part, key.level, taken)
        if len({key.level for key in networks}) > 1:
            count = sum(len(part) for key, part in networks.items() if key.level != GROUND)
            why = "the format knows no levels: all networks are joined, 2-D points at their level's elevation"
            self.context.drop("levels of nodes and edges", count, why)
        self._report()
        items = [text for _, _, text in sorted(nodes)]
        nodes.clear()
        if self.listed:
            return encode_pieces([items[0].lstrip(" "), *items[1:]] if items else ["[]\n"])
        before, after = _split({**self.document, "nodes": None}, 0, "nodes")
        pieces = [before, "\n" if items else " []\n", *items, after]
        items.clear()
        return encode_pieces(pieces)

    def _network(self, part: Features, level: str, taken: set[str]) -> Lines:
        """The nodes of a network, each with its edges."""
        self.legacy = "tmap" in part.document
        is_point = (shapely.get_type_id(part.geometry) == 0) & ~shapely.is_empty(part.geometry)
        kinds = [p.get("kind") for p in part.properties]
        places = [k for k, point in enumerate(is_point.tolist()) if point and kinds[k] == "node"]
        names = self._names(part, places, taken)
        name_texts = {i: yaml.text(name) for i, name in names.items()}
        edges = self._edges(part, kinds, name_texts)
        coordinates = self._positions(part, places, 0.0 if level == GROUND else self.layers.elevation(level))
        out = []
        plain = self._plain_node()
        for index, at in zip(places, coordinates, strict=True):
            i, p = part.ids[index], part.properties[index]
            name = names[i]
            if self._is_plain(p, self.plain_node) and "orientation" not in p and p.get("name", name) == name:
                self.filled["nodes"] += 1
                self.filled["orientations"] += 1
                self.filled["any yaw"] += 1
                text = plain(name_texts[i], _list_text(edges.pop(i)), at)
            else:
                text = self._node(p, name, name_texts[i], at, edges.pop(i))
            out.append((len(name), name, text))
        return out

    def _is_plain(self, p: Properties, keys: frozenset[str]) -> bool:
        """Whether an item comes from another format and has nothing for its own ``properties``."""
        return NAME not in p and not self.legacy and p.keys() <= keys

    def _plain_node(self) -> Callable[[str, str, tuple[str, str, str]], str]:
        """The quick way for nodes that have only a name and a place: (name, edges, position) as texts -> entry."""
        a, b, c, d, e = self._node_template({}, {}, None, has_yaw=False, fill=True)
        d += self._pose(None, ("\0", "\0", "\0"), [0.0, 0.0, 0.0, 1.0], turned=False)
        d, y, z, end = d.split("\0")
        e = end + e

        def plain(name_text: str, listed: str, at: tuple[str, str, str]) -> str:
            return f"{a} {name_text}\n{b}{listed}{c} {name_text}\n{d}{at[0]}{y}{at[1]}{z}{at[2]}{e}"

        return plain

    def _names(self, part: Features, places: Sequence[int], taken: set[str]) -> dict[str, str]:
        """What each node is called in the file, by id. Names repeat where they did so in their source."""
        names = []
        for k in places:
            source_properties = part.properties[k].get(NAME)
            node = source_properties.get("node") if isinstance(source_properties, dict) else None
            node_name = node.get("name") if isinstance(node, dict) else None
            names.append(node_name if isinstance(node_name, str) and node_name else part.ids[k])
        clashing = sorted({name for name in names if name in taken})
        if clashing:
            renamed = dict(zip(clashing, unique_ids(clashing, taken | set(names)), strict=True))
            names = [renamed.get(name, name) for name in names]
            self.context.warn(f"{len(clashing)} names stand in several networks and got a number: {_shorten(clashing)}")
        taken.update(names)
        return {part.ids[k]: name for k, name in zip(places, names, strict=True)}

    def _edges(self, part: Features, kinds: Sequence[Any], name_texts: Mapping[str, str]) -> dict[str, Lines]:
        """The edges by the id of the node that they start at. said: each node's name as YAML, by id."""
        edges: dict[str, Lines] = {i: [] for i in name_texts}
        a, b, c = self._edge_template({}, None, None, fill=True)
        plain = dropped_count = 0
        for i, p, kind in zip(part.ids, part.properties, kinds, strict=True):
            source, target = p.get("source"), p.get("target")
            if not (kind == "edge" and isinstance(source, str) and isinstance(target, str) and source in name_texts):
                dropped_count += kind != "node"
                continue
            to = name_texts.get(target) or yaml.text(target)
            if self._is_plain(p, self.plain_edge) and "action" not in p:
                plain += 1
                text = f"{a} {yaml.text(i)}\n{b} {to}\n{c}"
            else:
                i, text = self._edge(p, i, to)  # noqa: PLW2901  by the id that is written: read again, the order stays
            edges[source].append((len(i), i, text))
        self.filled["edges"] += plain
        self.dropped["items that are neither a node nor an edge from a node"] += dropped_count
        self.dropped["nodes without a point"] += kinds.count("node") - len(name_texts)
        return edges

    def _positions(self, part: Features, places: Sequence[int], elevation: float) -> list[tuple[str, str, str]]:
        """x, y, z as texts: metres in the frame that each node's parent_frame names."""
        nodes = part.select(places)
        xyz: Array = shapely.get_coordinates(nodes.in_local(self.layers.frame), include_z=True).reshape(-1, 3)
        xyz[np.isnan(xyz[:, 2]), 2] = elevation
        if self.turn is not None:
            inside = [k for k, p in enumerate(nodes.properties) if self._is_in_child_frame(p)]
            xyz[inside] = (xyz[inside] - self.turn.shift) @ self.turn.matrix()
        texts = list(map(yaml.decimal, numbers(xyz.ravel(), METRES)))
        return list(zip(texts[::3], texts[1::3], texts[2::3], strict=True))

    def _is_in_child_frame(self, p: Properties) -> bool:
        """Whether a node's pose stands in the child frame of the transformation."""
        source_properties = p.get(NAME)
        node = source_properties.get("node") if isinstance(source_properties, dict) else None
        return self.turn is not None and isinstance(node, dict) and node.get("parent_frame") == self.turn.child

    def _edge(self, p: Properties, i: str, target: str) -> tuple[str, str]:
        """The id as it is written, and the text of an edge. target: its target's name as YAML."""
        source_properties, action = p.get(NAME), p.get("action")
        extra_members: dict[str, Any] = source_properties if isinstance(source_properties, dict) else {}
        if "edge_id" in extra_members:
            i = str(extra_members["edge_id"])
            extra_members = {key: value for key, value in extra_members.items() if key != "edge_id"}
        more = None if p.keys() <= self.plain_edge else self._more(p, CANONICAL_EDGE)
        fill = source_properties is None or self.legacy
        self.filled["edges"] += source_properties is None if self.listed else fill
        # Edges alike but for their id and target share their text.
        key = orjson.dumps((action, extra_members, more, fill)).decode() if extra_members or more or action else fill
        pieces = self.templates.get(key)
        if pieces is None:
            pieces = self.templates[key] = self._edge_template(extra_members, action, more, fill=fill)
        return i, f"{pieces[0]} {yaml.text(i)}\n{pieces[1]} {target}\n{pieces[2]}"

    def _edge_template(
        self, extra_members: Mapping[str, Any], action: Any, more: dict[str, Any] | None, *, fill: bool
    ) -> list[str]:
        """The text of an edge in three pieces, around its id and its target."""
        if isinstance(self.options, ListOptions):
            limit = (more or {}).get("speed_limit")
            speed = limit if isinstance(limit, (int, float)) and not isinstance(limit, bool) else self.options.top_vel
            fixed = {"map_2d": self.document["metric_map"], "top_vel": float(speed)}
            # What the list's reader takes of an edge; it looks at no other key.
            fixed |= {
                "inflation_radius": self.options.inflation_radius,
                "recovery_behaviours_config": self.options.recovery,
            }
            out = {**fixed, **extra_members}
        else:
            out = (
                {**EDGE_TEMPLATE, **self._default_edge(self.options), **extra_members} if fill else dict(extra_members)
            )
        if action is not None:
            out["action"] = action
        if fill or self.listed:
            out.setdefault("action", self.options.action)
        if more:
            out["properties"] = {**_mapping_text(extra_members.get("properties")), **more}
        pieces = _split({**out, "edge_id": None, "node": None}, 6, "edge_id", "node")
        pieces[0] = f"    - {pieces[0][6:]}"
        return pieces

    @staticmethod
    def _default_edge(options: WriteOptions) -> dict[str, Any]:
        """What the options say of a new edge of a tmap2 file."""
        return {
            "action_type": options.action_type,
            "fail_policy": options.fail_policy,
            "fluid_navigation": options.fluid_navigation,
            "recovery_behaviours_config": options.recovery,
            "restrictions_planning": options.restrictions,
            "restrictions_runtime": options.restrictions,
        }

    def _default_node(self) -> dict[str, Any]:
        """What the options say of a new node of a tmap2 file."""
        assert isinstance(self.options, WriteOptions)
        return {
            "localise_by_topic": self.options.localise_by_topic,
            "parent_frame": self.options.parent_frame,
            "restrictions_planning": self.options.restrictions,
            "restrictions_runtime": self.options.restrictions,
        }

    def _node(self, p: Properties, name: str, name_text: str, at: tuple[str, str, str], edges: Lines) -> str:
        """The text of a node's entry. said: its name as YAML. at: its position as texts."""
        source_properties = p.get(NAME)
        extra_members: dict[str, Any] = source_properties if isinstance(source_properties, dict) else {}
        node = _mapping_text(extra_members.get("node"))
        more = None
        if not p.keys() <= self.plain_node or p.get("name", name) != name:
            more = self._more(p, CANONICAL_NODE)
            if isinstance(p.get("name"), str) and p["name"] not in ("", name):
                more["name"] = p["name"]
        if "name" in node or "edges" in node:
            dangling = [e for e in node.get("edges") or () if isinstance(e, dict)]
            edges = edges + [_dangling(e, name) for e in dangling]
            node = {key: value for key, value in node.items() if key not in ("name", "edges")}
            extra_members = {**extra_members, "node": node}
        quaternion = _quaternion(p.get("orientation"))
        self.filled["orientations"] += quaternion is None
        fill = source_properties is None or self.legacy
        self.filled["nodes"] += source_properties is None if self.listed else fill
        if fill or self.listed:
            node_members = {**({} if self.listed else node), **_mapping_text(node.get("properties"))}
            self.filled["any yaw" if quaternion is None else "yaw"] += "yaw_goal_tolerance" not in node_members
        key = (
            "node",
            quaternion is None,
            fill,
            orjson.dumps((extra_members, more)).decode() if extra_members or more else None,
        )
        pieces = self.templates.get(key)
        if pieces is None:
            pieces = self.templates[key] = self._node_template(
                extra_members, node, more, has_yaw=quaternion is not None, fill=fill
            )
        meta = extra_members.get("meta")
        called = yaml.text(str(meta["node"])) if isinstance(meta, dict) and "node" in meta else name_text
        pose = self._pose(node.get("pose"), at, quaternion or [0.0, 0.0, 0.0, 1.0], turned=self._is_in_child_frame(p))
        return (
            f"{pieces[0]} {called}\n{pieces[1]}{_list_text(edges)}{pieces[2]} {name_text}\n{pieces[3]}{pose}{pieces[4]}"
        )

    def _pose(self, extra: Any, at: tuple[str, str, str], quaternion: list[float], *, turned: bool) -> str:
        """What stands behind ``pose:``."""
        if turned and self.turn is not None:
            x, y, z, w = self.turn.quaternion
            quaternion = _times((-x, -y, -z, w), quaternion)
        if isinstance(extra, dict):
            position = {**dict(zip("xyz", map(float, at), strict=True)), **_mapping_text(extra.get("position"))}
            orientation = {**dict(zip("xyzw", quaternion, strict=True)), **_mapping_text(extra.get("orientation"))}
            return yaml.block({**extra, "orientation": orientation, "position": position}, 4)
        ox, oy, oz, ow = map(yaml.text, quaternion)
        return (
            f"\n      orientation:\n        w: {ow}\n        x: {ox}\n        y: {oy}\n        z: {oz}\n"
            f"      position:\n        x: {at[0]}\n        y: {at[1]}\n        z: {at[2]}\n"
        )

    def _tolerances(self, has_yaw: bool) -> dict[str, float]:
        """Of a node that has none. known: whether it has an orientation."""
        yaw = self.options.yaw_goal_tolerance if has_yaw else ANY_YAW
        return {"xy_goal_tolerance": self.options.xy_goal_tolerance, "yaw_goal_tolerance": yaw}

    def _node_template(
        self,
        extra_members: Mapping[str, Any],
        node: Mapping[str, Any],
        more: dict[str, Any] | None,
        *,
        has_yaw: bool,
        fill: bool,
    ) -> list[str]:
        """The text of a node's entry in five pieces, around meta.node, edges, name and pose."""
        inner = dict(node)
        if self.listed:
            inner_properties = _mapping_text(inner.get("properties"))
            tolerances = {key: inner_properties.get(key, value) for key, value in self._tolerances(has_yaw).items()}
            fixed = {"map": self.document["metric_map"], "pointset": self.document["pointset"]}
            fixed |= {"localise_by_topic": self.options.localise_by_topic}
            inner = {"verts": self.ring, **fixed, **tolerances, **inner}
        elif fill:
            inner = {**self._default_node(), "verts": self.ring, **inner}
            tolerances = self._tolerances(has_yaw)
            # The older layout has its tolerances beside the name.
            tolerances = {key: inner.get(key, value) for key, value in tolerances.items()}
            inner["properties"] = {**tolerances, **_mapping_text(inner.get("properties"))}
        elif "nav_frame" not in inner:
            inner.setdefault("parent_frame", FRAME)
        if more:
            inner["properties"] = {**_mapping_text(inner.get("properties")), **more}
        meta = {"map": self.document["metric_map"], "pointset": self.document["pointset"]}
        meta = {**meta, **_mapping_text(extra_members.get("meta")), "node": None}
        head, middle = _split(meta, 4, "node")
        pieces = _split({**inner, "edges": None, "name": None, "pose": None}, 4, "edges", "name", "pose")
        before, between, after = _split({**extra_members, "meta": None, "node": None}, 2, "meta", "node")
        opening = f"{before}\n{head}"
        return [f"- {opening[2:]}", f"{middle}{between}\n{pieces[0]}", pieces[1], pieces[2], pieces[3] + after]

    def _more(self, p: Properties, canonical: frozenset[str]) -> dict[str, Any]:
        """Canonical words and other formats' knowledge, for an item's own ``properties``."""
        return {key: value for key, value in p.items() if key not in canonical and key not in self.unwritten}

    def _report(self) -> None:
        fill, filled, options = self.context.fill, self.filled, self.options
        if filled["edges"]:
            why = f"{filled['edges']} edges come from a format that does not say it"
            reason = f"{why}, where they name none"
            fill("edges: action", options.action, reason, "action")
            if isinstance(options, ListOptions):
                fill("edges: top_vel", options.top_vel, f"{why}, where they have no speed limit", "top_vel")
                fill("edges: inflation_radius", options.inflation_radius, why, "inflation_radius")
                fill("edges: map_2d", self.document["metric_map"], why)
            else:
                fill("edges: action_type", options.action_type, reason, "action_type")
                fill("edges: fail_policy", options.fail_policy, why, "fail_policy")
                fill("edges: fluid_navigation", options.fluid_navigation, why, "fluid_navigation")
                fill("edges: restrictions", options.restrictions, why, "restrictions")
                fill("edges: config, goal", "the usual ones", why)
            fill("edges: recovery_behaviours_config", options.recovery, why, "recovery")
        if filled["nodes"]:
            why = f"{filled['nodes']} nodes come from a format that does not say it"
            reason = f"{why}, where they have none"
            fill("nodes: verts", f"an octagon of {options.verts_radius:g} m", reason, "verts_radius")
            fill("nodes: xy_goal_tolerance", options.xy_goal_tolerance, reason, "xy_goal_tolerance")
            fill("nodes: localise_by_topic", options.localise_by_topic, why, "localise_by_topic")
            if isinstance(options, WriteOptions):
                fill("nodes: parent_frame", options.parent_frame, why, "parent_frame")
                fill("nodes: restrictions", options.restrictions, why, "restrictions")
            else:
                fill("nodes: map, pointset", "the map's", why)
        if filled["yaw"]:
            why = f"{filled['yaw']} nodes with an orientation have none; in radians"
            fill("nodes: yaw_goal_tolerance", options.yaw_goal_tolerance, why, "yaw_goal_tolerance")
        if filled["any yaw"]:
            why = f"{filled['any yaw']} nodes have none and no orientation, so that any will do; in radians"
            fill("nodes without an orientation: yaw_goal_tolerance", ANY_YAW, why)
        if filled["orientations"]:
            fill("nodes: pose.orientation", [0.0, 0.0, 0.0, 1.0], f"{filled['orientations']} nodes have none")
        for noun, count in sorted(self.dropped.items()):
            self.context.drop(noun, count, "the format has no place for it")
        for family in sorted(WRITTEN_ON_DEMAND & self.unwritten):
            items = [p for part in self.layers.vector("topology").values() for p in part.properties if family in p]
            self.context.drop(f"{family} tags and attributes", len(items), f"left out for size; ask with {family}=true")


def _list_text(items: Lines) -> str:
    """What stands behind ``edges:`` or ``nodes:``."""
    return "\n" + "".join([text for _, _, text in sorted(items)]) if items else " []\n"


def _mapping_text(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _quaternion(value: Any) -> list[float] | None:
    """Four finite numbers, else None."""
    if not isinstance(value, (list, tuple)) or len(value) != 4:
        return None
    if not all(isinstance(v, (int, float)) and not isinstance(v, bool) and math.isfinite(v) for v in value):
        return None
    return list(map(float, value))


def _dangling(edge: Mapping[str, Any], name: str) -> tuple[int, str, str]:
    """An edge to nowhere as it was, with the id that the schema asks for."""
    edge_id = edge.get("edge_id")
    i = (
        edge_id
        if isinstance(edge_id, str) and edge_id
        else f"{name}_{edge.get('node')}"
        if edge_id is None
        else str(edge_id)
    )
    return len(i), i, f"    - {yaml.mapping({**edge, 'edge_id': i}, 6)[6:]}"


def _split(values: Mapping[str, Any], column: int, *holes: str) -> list[str]:
    """A mapping's text in pieces around the values of these keys, which are named in alphabetical order.

    A piece before a hole ends with the key's colon, so that what is put there brings its space and its line break.
    """
    pieces = []
    part: dict[str, Any] = {}
    for key in sorted(values):
        if key in holes:
            pieces.append(f"{yaml.mapping(part, column) if part else ''}{' ' * column}{key}:")
            part = {}
        else:
            part[key] = values[key]
    return [*pieces, yaml.mapping(part, column) if part else ""]


# --- telling ---------------------------------------------------------------------------------------------------------

_MAPPING = re.compile(rb"(?m)^(?:metric_map|pointset)\s*:")
_LIST = re.compile(rb"\A(?:\xef\xbb\xbf)?\s*(?:#[^\n]*\n\s*|---\s*)*- +(?:meta|node):[ \t]*(?:[\r\n{#])")
HEAD = 4096


def is_list(data: bytes) -> bool:
    """Whether this is the older list, judged by its first entry."""
    return bool(_LIST.match(data[:HEAD])) and b"node" in data


def is_mapping(data: bytes) -> bool:
    """Whether this is YAML with tmap2's top-level keys."""
    return b"nodes" in data and bool(_MAPPING.search(data))


def choose(keys: Sequence[PartKey], options: Any) -> Sequence[PartKey]:  # noqa: ARG001 - one signature for all formats
    """The networks, and the points of interest that came from a tmap2 or tmap file."""
    return [key for key in keys if key.layer == "topology" or (key.layer == "objects" and key.name == NAME)]
