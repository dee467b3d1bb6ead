"""Bounding boxes in OSM files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from app.errors import Problem, UnreadableFile
from app.formats.osm.xml_text import NO_ATTRIBUTES, plain
from app.syntax.decimals import DEGREES, numbers


def read_box(attributes: Mapping[str, str]) -> tuple[float, float, float, float] | None:
    """Return [west, south, east, north] of a ``<bounds>``, or of the older ``<bound box="s,w,n,e">``."""
    names = ("minlon", "minlat", "maxlon", "maxlat")
    if all(k in attributes for k in names):
        texts = [attributes[k] for k in names]
    elif attributes.get("box", "").count(",") == 3:
        south, west, north, east = attributes["box"].split(",")
        texts = [west, south, east, north]
    else:
        return None
    west_, south_, east_, north_ = (float(t) for t in texts)
    if not (-180 <= west_ <= 180 and -180 <= east_ <= 180 and -90 <= south_ <= north_ <= 90):
        reason = f"the bounds {', '.join(texts)} are not a valid box in degrees"
        raise UnreadableFile(reason, [Problem(reason, where="<bounds>")])
    return west_, south_, east_, north_


def written_bounds(
    source_bounds: Sequence[Mapping[str, str]], boxes: Sequence[Sequence[float]]
) -> Sequence[Mapping[str, str]]:
    """Return the attributes of ``<bounds>``.

    The stored ones if they still enclose these boxes exactly, else those of the box around them.

    Further stored attributes (their origin) are kept.
    """
    extent = bounding_box(boxes)
    try:
        old_boxes = [box for one in source_bounds if (box := read_box(one)) is not None]
    except (UnreadableFile, ValueError):  # edits can store anything
        old_boxes = []
    if len(old_boxes) != len(source_bounds) or not old_boxes or bounding_box(old_boxes) != extent:
        old_boxes, source_bounds = [extent], source_bounds if len(source_bounds) == 1 else [NO_ATTRIBUTES]
    names = ("minlat", "minlon", "maxlat", "maxlon")
    out = []
    for one, (w, s, e, n) in zip(source_bounds, old_boxes, strict=True):
        texts = numbers(np.array([s, w, n, e], np.float64), DEGREES)
        attributes = {k: plain(v) for k, v in zip(names, texts, strict=True)}
        out.append({**{k: v for k, v in one.items() if k != "box"}, **attributes})
    return out


def bounding_box(boxes: Sequence[Sequence[float]]) -> tuple[float, float, float, float]:
    """Return the box around boxes, each [west, south, east, north]."""
    west, south, east, north = zip(*boxes, strict=True)
    return min(west), min(south), max(east), max(north)


def is_box(value: Any) -> bool:
    """Whether a value is a list of four numbers."""
    return (
        isinstance(value, list | tuple)
        and len(value) == 4
        and all(isinstance(v, int | float) and not isinstance(v, bool) for v in value)
    )
