"""Names in Nav2's route graphs, and the shape of a file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from app.formats._fields import NOT_NEGATIVE, SPEED, Number, OneOf, record
from app.formats._network import CROSS_PART_PROPERTIES

NAME = "nav2_route"
FRAME = "map"
LINES = ("LineString", "MultiLineString")
MAX_ID = 2**32 - 1
MAX_USED_ID = 2**16 - 1
"""Largest id in ComputeRoute's start and goal, and in the edges that DynamicEdges closes."""

FLOATS = frozenset({"speed_limit", "abs_speed_limit", "penalty", "abs_time_taken"})
"""Metadata that Nav2's own plugins read as floats."""

TEXTS: Mapping[str, str] = {"name": "name", "action": "action", "area": "area"}
NUMBERS: Mapping[str, str] = {"abs_speed_limit": "speed_limit", "width": "width"}
CANONICAL_METADATA: Mapping[str, str] = {**TEXTS, **NUMBERS}
"""Canonical properties by metadata key, for values that are texts and numbers."""

TRIGGERS = ("NODE", "ON_ENTER", "ON_EXIT")

_SPEED, _LENGTH = replace(SPEED, or_other=True), replace(NOT_NEGATIVE, or_other=True)
_METADATA = record(
    is_open=True,
    is_loose=True,
    speed_limit=_SPEED,
    abs_speed_limit=_SPEED,
    penalty=_LENGTH,
    abs_time_taken=_LENGTH,
    width=_LENGTH,
)
_FEATURE = record(
    is_open=True,
    type=OneOf(("Feature",)),
    properties=record(
        "id startid endid overridable frame operations graph_id",
        metadata=_METADATA,
        cost=Number(0.0, 1e9, or_other=True),
    ),
)
SHAPE = record(is_open=True, type=OneOf(("FeatureCollection",)), features=[_FEATURE])
"""Shape of a graph. Source: nav2_route, GeoJsonGraphFileLoader; further members belong to GeoJSON or QGIS."""

CANONICAL_NODE = frozenset({"kind", "name", "action", "area", "speed_limit", "width", NAME}) | CROSS_PART_PROPERTIES
CANONICAL_EDGE = CANONICAL_NODE | {"source", "target"}
