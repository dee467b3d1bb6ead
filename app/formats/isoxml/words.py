"""Elements and types of ISOXML that reader and writer share."""

from __future__ import annotations

import hashlib
import re
from typing import Any

import numpy as np
import shapely

NAME = "isoxml"
ROOT = "ISO11783_TaskData"

POLYGONS = (
    *("boundary", "treatment zone", "water", "building", "road", "obstacle", "flag", "other", "mainland", "headland"),
    *("buffer zone", "windbreak"),
)
LINES = (
    *("exterior", "interior", "tram line", "sampling route", "guidance line", "drainage", "fence", "flag", "obstacle"),
)
POINTS = (
    *("flag", "other", "field access", "storage", "obstacle", "guidance a", "guidance b", "guidance centre"),
    *("guidance point", "reference point", "home base"),
)
"""Types of polygons, lines and points, by number from 1 (ISO 11783-10, annex D)."""

GUIDANCE = "guidance line"

PATTERN = "CDEFGHIJKMNO"
"""Attributes of a guidance pattern (GPN) that come back as they were: its type (C), options, direction, extension,
heading (G, degrees), radius (H, mm), accuracies and swaths; not its id, name and base station."""

VALUE = re.compile("[ -~]{1,32}")
"""An attribute of a guidance pattern: a number, or the SRID of its source."""

AB, CURVE = "1", "3"
"""Types of guidance patterns that are what their line shows; A+ is 2, pivots are 4, spirals 5."""

DECIMALS = 9
"""Decimals of a degree: 0.1 mm on the ground. The standard has no exponents."""


def plain_pattern(count: int) -> tuple[dict[str, str], list[str]]:
    """Return the attributes and the types of the points (A, guidance points, B) of a line of ``count`` points."""
    return {"C": AB if count == 2 else CURVE}, ["6", *["9"] * (count - 2), "7"]


def place_hash(shape: Any) -> str:
    """Return a hash of the longitudes and latitudes of a shape, as they are written."""
    degrees = np.round(shapely.get_coordinates(shape), DECIMALS) + 0.0  # no negative zero
    return hashlib.sha256(degrees.astype("<f8").tobytes()).hexdigest()[:16]
