"""Position of an environment: its datum and its levels.

The local frame is x east, y north, z up, in metres, with its origin at the datum, turned by the datum's heading.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Literal

from app.errors import Invalid

Anchor = Literal["local", "wgs84"]
"""Anchor of an item: metres (x, y[, z]) in the local frame, or degrees (longitude, latitude[, altitude])."""

GROUND = "ground"

MAX_DATUM_LATITUDE = 85.0
"""Maximum latitude of a datum, in degrees: nearer to a pole the local frame's axes lose their meaning."""

MAX_METRES = 1e7
"""Maximum of every local coordinate: far beyond any site, and float64 still resolves a nanometre."""


_UNWRITABLE = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")


def is_writable(text: str) -> bool:
    """Return whether a name fits in one line of any format: no control characters, line ends or lone surrogates.

    Zero-width and bidirectional marks and unusual spaces are accepted: real names have them.
    """
    return text.isprintable() or _UNWRITABLE.search(text) is None


@dataclass(frozen=True, slots=True)
class Datum:
    """Position of an environment's local origin on earth (WGS 84).

    ``latitude`` and ``longitude`` in degrees, ``altitude`` in metres above the ellipsoid, ``heading`` in degrees
    clockwise from true north to the local +y axis.
    """

    latitude: float
    longitude: float
    altitude: float = 0.0
    heading: float = 0.0

    def __post_init__(self) -> None:
        for name, low, high in (
            ("latitude", -MAX_DATUM_LATITUDE, MAX_DATUM_LATITUDE),
            ("longitude", -180.0, 180.0),
            ("altitude", -12_000.0, 100_000.0),
            ("heading", -360.0, 360.0),
        ):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
                raise Invalid(f"datum {name} must be a finite number, got {value!r:.80}")
            if not low <= value <= high:
                raise Invalid(f"datum {name} must be between {low:g} and {high:g}, got {value:g}")
            object.__setattr__(self, name, float(value) + 0.0)

    def as_dict(self) -> dict[str, float]:
        """Return the datum as JSON."""
        return {
            "latitude": self.latitude,
            "longitude": self.longitude,
            "altitude": self.altitude,
            "heading": self.heading,
        }


@dataclass(frozen=True, slots=True)
class Level:
    """A level: its name and the height of its floor in metres above the local origin."""

    name: str = GROUND
    elevation: float = 0.0

    def __post_init__(self) -> None:
        if not self.name or len(self.name) > 256 or not is_writable(self.name):
            raise Invalid(
                f"a level's name must have 1 to 256 characters and no control characters, got {self.name!r:.80}"
            )
        if not math.isfinite(self.elevation) or abs(self.elevation) > MAX_METRES:
            raise Invalid(f"level {self.name}: elevation must be a finite number of metres, got {self.elevation!r}")
        object.__setattr__(self, "elevation", float(self.elevation) + 0.0)
