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

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.errors import Problem, UnreadableFile
from app.formats._fields import ANY, COORDINATE, NOT_NEGATIVE, POINT, SPEED, WIDTH, Number, Quaternion, Text, record
from app.model.layers import PartKey
from app.parameters import parameter
from app.syntax import yaml

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
ENTRIES = [record(node=_NODE, meta=record(is_open=True))]
SHAPE = record(
    "metric_map name pointset verts",
    meta=record(is_open=True),
    transformation=record("child parent topo_map", rotation=Quaternion(), translation=POINT),
    nodes=ENTRIES,
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


def parse_number(value: Any, location: str) -> float:
    """A coordinate; one that stands in quotes is one too."""
    try:
        number = yaml.scalar(value) if isinstance(value, str) else value
    except ValueError:
        number = None
    if isinstance(number, bool) or not isinstance(number, (int, float)):
        raise UnreadableFile(
            f"{location}: {value!r} is not a number", [Problem(f"{value!r} is not a number", where=location)]
        )
    return float(number)


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
