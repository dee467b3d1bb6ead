"""OpenStreetMap's values in SI units: lengths, widths, heights, speeds; for the format and for users of its tags.

Sources: OSM wiki, Map features/Units (metres unless a unit is given; ``7'6"`` are feet and inches), Key:maxspeed (km/h
unless a unit is given), Key:lanes, Simple 3D buildings (``height`` and ``min_height`` count from the ground; if they
are missing, a storey has 3 m).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from typing import Any, Literal

LEVEL_HEIGHT = 3.0
"""Height of a storey in metres, if only the number of storeys is known (Simple 3D buildings)."""

LANE = 3.0
"""Width of a lane in metres, if only the number of lanes is known: the lower end of built widths (Key:lanes)."""

WALK = 6 / 3.6
"""Speed of ``maxspeed=walk`` in metres per second: 6 km/h, as in GraphHopper."""

MAX_METRES = 1e6
"""Maximum length in metres: a larger value is an error."""

_LENGTH = re.compile(r"\s*(\d{1,9}(?:[.,]\d{1,9})?)\s*(m|cm|mm|km|mi|ft|feet|in|'|\")?\s*", re.ASCII)
_FEET = re.compile(r"\s*(\d{1,6})\s*'\s*(\d{1,3}(?:\.\d{1,9})?)\s*\"\s*", re.ASCII)
_UNITS: Mapping[str | None, float] = {
    None: 1.0,
    **{"m": 1.0, "cm": 0.01, "mm": 0.001, "km": 1000.0, "mi": 1609.344},
    **{"ft": 0.3048, "feet": 0.3048, "'": 0.3048, "in": 0.0254, '"': 0.0254},
}
_SPEED = re.compile(r"\s*(\d{1,4}(?:\.\d{1,9})?)\s*(km/h|kmh|kph|mph|knots)?\s*", re.ASCII)
_SPEEDS: Mapping[str | None, float] = {
    **dict.fromkeys((None, "km/h", "kmh", "kph"), 1 / 3.6),
    **{"mph": 0.44704, "knots": 1852 / 3600},
}
_COUNT = re.compile(r"\s*(\d{1,3}(?:\.\d{1,3})?)\s*", re.ASCII)


def metres(text: Any) -> float | None:
    """Parse a length in metres; None if it is none."""
    if not isinstance(text, str) or len(text) > 40:
        return None
    if match := _FEET.fullmatch(text):
        value = int(match[1]) * 0.3048 + float(match[2]) * 0.0254
    elif match := _LENGTH.fullmatch(text):
        value = float(match[1].replace(",", ".")) * _UNITS[match[2]]
    else:
        return None
    return round(value, 9) if value <= MAX_METRES else None


def speed(value: Any) -> float | None:
    """Parse a speed limit in m/s, the lowest of several; None for others (``none``, ``RO:urban``, a condition)."""
    if not isinstance(value, str) or len(value) > 80:
        return None
    speeds = []
    for one in value.split(";"):
        if one.strip() == "walk":
            speeds.append(round(WALK, 9))
        elif match := _SPEED.fullmatch(one):
            speeds.append(round(float(match[1]) * _SPEEDS[match[2]], 9))
    return min((v for v in speeds if v > 0), default=None)


def count(value: Any) -> float | None:
    """Parse a number of storeys or lanes; None if it is none."""
    match = _COUNT.fullmatch(value) if isinstance(value, str) and len(value) < 40 else None
    return None if match is None else float(match[1])


def is_understood(key: str, value: Any) -> bool:
    """Return whether the functions below understand a tag's value; true for all tags that they do not read."""
    read = _PARSERS.get(key)
    return read is None or read(value) is not None or (read is speed and value in _NO_LIMIT)


def width(tags: Mapping[str, Any]) -> float | None:
    """Return metres across a line or a point: ``width``, ``est_width``, or from ``diameter`` or ``circumference``."""
    value = metres(tags.get("width")) or metres(tags.get("est_width"))
    if not value and tags.get("natural") == "tree":
        value = metres(tags.get("diameter"))
        if not value and (around := metres(tags.get("circumference"))):
            value = round(around / math.pi, 9)
    return value or None


def way_width(tags: Mapping[str, Any]) -> float | None:
    """Return metres across a way that is driven or walked on: its width, else its lanes'."""
    value = width(tags)
    if value:
        return value
    lanes = count(tags.get("lanes"))
    return round(lanes * LANE, 9) if lanes else None


def height(tags: Mapping[str, Any]) -> float | None:
    """Return metres of the top above the ground: ``height``, else its storeys'."""
    value = metres(tags.get("height"))
    if not value and (storeys := count(tags.get("building:levels"))):
        value = round(storeys * LEVEL_HEIGHT, 9)
    return value or None


def base(tags: Mapping[str, Any]) -> float | None:
    """Return metres of the underside above the ground: ``min_height``, else that of the omitted storeys."""
    value = metres(tags.get("min_height"))
    if value is None and (storeys := count(tags.get("building:min_level"))) is not None:
        value = round(storeys * LEVEL_HEIGHT, 9)
    return value or None


def speed_limit(tags: Mapping[str, Any], direction: Literal["forward", "backward"]) -> float | None:
    """Return metres per second along a way's direction or against it; the limit of the direction wins."""
    return speed(tags.get(f"maxspeed:{direction}")) or speed(tags.get("maxspeed"))


_NO_LIMIT = frozenset({"none", "signals", "variable"})
"""Values of ``maxspeed`` that mean no permanent limit (Key:maxspeed)."""

_PARSERS: Mapping[str, Callable[[Any], float | None]] = {
    **dict.fromkeys(("width", "est_width", "height", "min_height"), metres),
    **dict.fromkeys(("lanes", "building:levels", "building:min_level"), count),
    **dict.fromkeys(("maxspeed", "maxspeed:forward", "maxspeed:backward"), speed),
}
NUMERIC_KEYS = frozenset(_PARSERS)
"""Keys of the tags whose values are read as numbers."""
