"""Names in Fawkes' navgraphs, and the shape of a file."""

from __future__ import annotations

import re

from app.formats._fields import ANGLE, COORDINATE, Number, Record, record
from app.formats._network import CROSS_PART_PROPERTIES

NAME = "navgraph"
PREFIX = "tag:fawkesrobotics.org,navgraph/"
TAGS = (PREFIX, "!")
"""Prefixes of tags with Fawkes' %TAG line, and without it (then Fawkes ignores them)."""

DIRECTED, UNCONNECTED, CROSSING = "dir", "unconnected", "allow-intersection"
MODES = frozenset({CROSSING, "no-intersection", "split-intersection"})
KNOWN_TAGS = MODES | {DIRECTED, "bidir"}

WORD = re.compile(r"[A-Za-z0-9_-]{1,64}\Z")

NAME_KEYS = frozenset({"graph-name", "root"})
TOP_KEYS = frozenset({"nodes", "connections", "default-properties"})
NODE_KEYS = frozenset({"name", "pos", "properties"})
CANONICAL_NODE = frozenset({"kind", "name", "orientation", NAME}) | CROSS_PART_PROPERTIES
CANONICAL_EDGE = frozenset({"kind", "source", "target", NAME}) | CROSS_PART_PROPERTIES

_TOLERANCE = Number(0.0, 1e4)
_PROPERTIES = [
    record(
        is_open=True,
        is_loose=True,
        orientation=ANGLE,
        travel_tolerance=_TOLERANCE,
        target_tolerance=_TOLERANCE,
        orientation_tolerance=_TOLERANCE,
        shortcut_tolerance=_TOLERANCE,
    )
]
SHAPE = Record(
    {
        **dict.fromkeys(("graph-name", "root", "connections")),
        "default-properties": _PROPERTIES,
        "nodes": [record("name", pos=(COORDINATE, COORDINATE), properties=_PROPERTIES)],
    }
)
"""Shape of a navgraph. Source: Fawkes, libs/navgraph/yaml_navgraph.cpp."""
