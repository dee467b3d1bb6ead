"""Tags of Lanelet2: names, subtypes, directions and speeds."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

from app.formats.osm import xml_text
from app.model.features import Properties
from app.model.frame import MAX_METRES

NAME = "lanelet2"
MAIN = "lanelet2.osm"
PROJECTOR = "map_projector_info.yaml"
GENERATOR = "Fleet Map Server"

EDGE, BACK, SOURCE, TARGET, NODE = (f"fleetmap:{w}" for w in ("edge", "back", "source", "target", "node"))
"""Our own tags, with which a network of another format is read back with its ids."""

LOCAL = ("local_x", "local_y")
PLAIN_TAGS = frozenset({*LOCAL, "ele", "mgrs_code"})
"""Tags of points that contain only their position."""

ON_FOOT = frozenset({"walkway", "crosswalk", "stairs"})
"""Subtypes for pedestrians only, bidirectional by default (Lanelet2: LaneletAndAreaTagging)."""

SUBTYPES: Mapping[str, str] = {
    **dict.fromkeys(("footway", "path", "pedestrian", "corridor"), "walkway"),
    "crossing": "crosswalk",
    "steps": "stairs",
    "cycleway": "bicycle_lane",
    "motorway": "highway",
    "motorway_link": "highway",
    "trunk": "highway",
    "living_street": "play_street",
    "busway": "bus_lane",
}
"""Lanelet2 subtypes of OSM's ``highway`` values; any other value is a road."""

UNITS = {"m/s": 1.0, "mps": 1.0, "mph": 0.44704, "m/h": 0.44704, "kmh": 1 / 3.6, "km/h": 1 / 3.6, "kph": 1 / 3.6}
"""Speed units in metres per second; the default is km/h (Lanelet2: Attribute)."""


def is_two_way(tags: Mapping[str, str]) -> bool:
    """Whether a lanelet is bidirectional (Lanelet2: LaneletAndAreaTagging, "Direction")."""
    one_way = _truth(tags.get("one_way"))
    if one_way is not None:
        return not one_way
    allowed = {k.removeprefix("participant:") for k, v in tags.items() if k.startswith("participant:") and _truth(v)}
    on_foot = allowed == {"pedestrian"} if allowed else tags.get("subtype") in ON_FOOT
    special = {k.removeprefix("one_way:"): _truth(v) for k, v in tags.items() if k.startswith("one_way:")}
    if on_foot:
        return not special.get("pedestrian", False)
    # The permission of one participant does not apply to others.
    return bool(allowed) and all(special.get(participant) is False for participant in allowed)


def _truth(value: str | None) -> bool | None:
    text = (value or "").strip().lower()
    return True if text in ("yes", "true", "1") else False if text in ("no", "false", "0") else None


_SPEED = re.compile(r"\s*(\d{1,9}(?:\.\d{1,20})?)\s*([A-Za-z/]*)\s*", re.ASCII)


MAX_SPEED = 150.0
"""Maximum valid speed limit, in metres per second."""


def parse_speed(text: str | None) -> float | None:
    """Parse a speed to metres per second, or None if it is invalid."""
    match = _SPEED.fullmatch(text or "")
    if match is None:
        return None
    unit = UNITS.get(match[2].lower()) if match[2] else 1 / 3.6
    return None if unit is None else round(float(match[1]) * unit, 9)


def decimal(text: Any) -> float:
    """Parse a finite number within the bound of local coordinates, else return NaN."""
    try:
        value = float(text)
    except (TypeError, ValueError):
        return math.nan
    return value if abs(value) <= MAX_METRES else math.nan


def positive(text: Any) -> float | None:
    """Parse a number above 0, else return None."""
    value = decimal(text)
    return value if value > 0 else None


def metres_per_second(properties: Properties) -> float | None:
    """Return the speed limit of an edge; None if it is not a number from 0."""
    value = properties.get("speed_limit")
    valid = isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value < 1e9
    return float(value) if valid and value is not None else None


def kmh(speed: float) -> str:
    """Format a speed as Autoware reads it: km/h without a unit."""
    return xml_text.plain(repr(round(speed * 3.6, 9) + 0.0)).removesuffix(".0")
