"""Shared by tmap2 and tmap: networks of topological_navigation, as YAML.

Nodes with poses, and directed edges listed in their source node. Positions are metres in the local frame, orientations
quaternions. Two layouts: the mapping (tmap2, also with a block of ``verts`` anchors on top) and the older list (tmap).
Source: topological_navigation, config/tmap-schema.yaml and its map managers (manager.py reads the list, manager2.py the
mapping).

Canonical: a node's id is its name, an edge's id its ``edge_id``. Data of an item that only these files have is in its
``properties.tmap2``: for a node the entry of the file, ``{meta?, node: {…}}``, without members that are canonical or
follow from the document; for an edge its mapping in the file, without canonical members. ``node.name`` and ``edge_id``
are there only if they differ from the id (names may repeat), ``node.edges`` only for edges to unknown nodes. The
document's ``tmap2`` is the file's top level without the nodes; ``tmap`` marks a list. A node's or edge's own
``properties`` in the file may contain canonical properties (``speed_limit``, ``width``, ``name``) and source properties
of other formats (``kml: {…}``): reading makes them canonical properties again, writing stores them there.
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
LAST_UPDATED = re.compile(r"(?:[0-9]{4}-[0-9]{2}-[0-9]{2}|[0-9]{2}-[0-9]{2}-[0-9]{4})_[0-9]{2}-[0-9]{2}-[0-9]{2}\Z")
"""Time of the last change: year first or, since topological_navigation of 2026, day first."""

EPOCH = "1970-01-01_00-00-00"
"""Default time: the schema requires one, and the same network must give the same bytes."""

MAX_NAME = 256
MAX_ID_CHARACTERS = 480

NODE_WORDS = frozenset({"edges", "name", "pose"})
EDGE_WORDS = frozenset({"edge_id", "node", "action"})
CANONICAL_NODE = frozenset({"kind", "name", "orientation", NAME})
CANONICAL_EDGE = frozenset({"kind", "source", "target", "action", NAME})
CROSS_PART_PROPERTIES = frozenset({"drawn_from"})
"""Canonical properties that describe other parts of the environment, not the item."""

WRITTEN_ON_DEMAND = frozenset({"osm"})
"""Formats whose source properties are written on request only: OSM tags and history are larger than all the rest."""

NUMERIC_WORDS = ("speed_limit", "width")

ACTION, ACTION_TYPE = "move_base", "move_base_msgs/MoveBaseGoal"
RADIUS = 0.75


def ring(radius: float) -> list[dict[str, float]]:
    """Build the default influence zone of a node: a regular octagon, in metres relative to the node."""
    turns = (math.pi / 8 + k * math.pi / 4 for k in range(8))
    return [{"x": round(radius * math.cos(a), 12), "y": round(radius * math.sin(a), 12)} for a in turns]


EDGE_TEMPLATE: Mapping[str, Any] = {
    "config": [],
    "goal": {"target_pose": {"header": {"frame_id": "$node.parent_frame"}, "pose": "$node.pose"}},
}
"""Members of new edges in addition to those set by options."""

FRAME, ANYWHERE = "map", "True"
"""Default frame of nodes, and the restriction that allows everything."""

TOLERANCES = {"xy_goal_tolerance": 0.3, "yaw_goal_tolerance": 0.1}
ANY_YAW = 6.29
"""Yaw tolerance in radians of a node without orientation: accepts any."""

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
    "name parent_frame nav_frame localise_by_topic map pointset",
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
    transformation=record("child parent topo_frame_id topo_map", rotation=Quaternion(), translation=POINT),
    nodes=ENTRIES,
)
"""Schema of tmap2 files and of the older list's nodes. Source: topological_navigation's map files of all versions."""

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class WriteOptions:
    """Defaults for nodes and edges of other formats, and the names in the file."""

    action: str = parameter(ACTION, "action of edges without one")
    action_type: str = parameter(ACTION_TYPE, "goal type of that action")
    verts_radius: float = parameter(
        RADIUS, "radius of the octagon around nodes without verts", minimum=1e-3, maximum=1000.0, unit="m"
    )
    xy_goal_tolerance: float = parameter(
        TOLERANCES["xy_goal_tolerance"], "xy_goal_tolerance of nodes without one", minimum=0.0, maximum=1000.0, unit="m"
    )
    yaw_goal_tolerance: float = parameter(
        TOLERANCES["yaw_goal_tolerance"],
        f"yaw_goal_tolerance of nodes without one; {ANY_YAW} for nodes without an orientation",
        minimum=0.0,
        maximum=ANY_YAW,
        unit="rad",
    )
    osm: bool = parameter(False, "write OpenStreetMap tags and attributes under properties of nodes and edges")
    pointset: str | None = parameter(
        None, "name of the network and its pointset; default: that of the source, else of the map"
    )
    fail_policy: str = parameter("fail", "fail_policy of edges without one")
    fluid_navigation: bool = parameter(True, "drive edges from other formats without stopping at their end")
    recovery: str = parameter("", "recovery_behaviours_config of edges without one")
    restrictions: str = parameter(ANYWHERE, "planning and runtime restrictions of nodes and edges without any")
    parent_frame: str = parameter(FRAME, "parent_frame of nodes without one")
    localise_by_topic: str = parameter("", "localise_by_topic of nodes without one")


@dataclass(frozen=True, slots=True)
class ListOptions:
    """Defaults for nodes and edges of other formats, and the name of the pointset."""

    action: str = parameter(ACTION, "action of edges without one")
    top_vel: float = parameter(0.55, "top_vel of edges without a speed limit", minimum=0.0, maximum=100.0, unit="m/s")
    verts_radius: float = parameter(
        RADIUS, "radius of the octagon around nodes without verts", minimum=1e-3, maximum=1000.0, unit="m"
    )
    xy_goal_tolerance: float = parameter(
        TOLERANCES["xy_goal_tolerance"], "xy_goal_tolerance of nodes without one", minimum=0.0, maximum=1000.0, unit="m"
    )
    yaw_goal_tolerance: float = parameter(
        TOLERANCES["yaw_goal_tolerance"],
        f"yaw_goal_tolerance of nodes without one; {ANY_YAW} for nodes without an orientation",
        minimum=0.0,
        maximum=ANY_YAW,
        unit="rad",
    )
    osm: bool = parameter(False, "write OpenStreetMap tags and attributes under properties of nodes and edges")
    pointset: str | None = parameter(None, "name of the pointset; default: that of the source, else of the map")
    inflation_radius: float = parameter(
        0.0, "inflation_radius of edges without one", minimum=0.0, maximum=1000.0, unit="m"
    )
    recovery: str = parameter("", "recovery_behaviours_config of edges without one")
    localise_by_topic: str = parameter("", "localise_by_topic of nodes without one")


def parse_number(value: Any, location: str) -> float:
    """Parse a coordinate, also a quoted one."""
    try:
        number = yaml.scalar(value) if isinstance(value, str) else value
    except ValueError:
        number = None
    if isinstance(number, bool) or not isinstance(number, (int, float)):
        raise UnreadableFile(
            f"{location}: must be a number, got {value!r}",
            [Problem(f"must be a number, got {value!r}", where=location)],
        )
    return float(number)


_MAPPING = re.compile(rb"(?m)^(?:metric_map|pointset)\s*:")
_LIST = re.compile(rb"\A(?:\xef\xbb\xbf)?\s*(?:#[^\n]*\n\s*|---\s*)*- +(?:meta|node):[ \t]*(?:[\r\n{#])")
HEAD = 4096


def is_list(data: bytes) -> bool:
    """Detect the older list by its first entry."""
    return bool(_LIST.match(data[:HEAD])) and b"node" in data


def is_mapping(data: bytes) -> bool:
    """Detect YAML with tmap2's top-level keys."""
    return b"nodes" in data and bool(_MAPPING.search(data))


def choose(keys: Sequence[PartKey], options: Any) -> Sequence[PartKey]:  # noqa: ARG001 - one signature for all formats
    """Choose the networks, and the points of interest that came from a tmap2 or tmap file."""
    return [key for key in keys if key.layer == "topology" or (key.layer == "objects" and key.name == NAME)]
