"""Elements and types of ISOXML that reader and writer share."""

from __future__ import annotations

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
