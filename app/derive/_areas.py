"""Names of areas: given, kept when derived again, and brought to the nodes of a network."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import shapely

from app.derive import _reading_order
from app.model.areas import AREA_KINDS
from app.model.features import Features
from app.model.geodesy import LocalFrame

AREAS = "areas"
"""Name of the part of zones with the areas of a grid."""

STRIP_KINDS = ("aisle", "row")
"""Those that are numbered across the direction of their group."""

SAME = 0.3
"""Minimum overlap (intersection over union) of an area with a stored one whose name it keeps."""

SAME_DOOR = 0.75
"""Maximum distance in metres of a door from a stored one whose name it keeps."""

_NUMBERED = re.compile(r"(?:room|corridor|door|aisle|row)-(\d+)\Z")

Area = tuple[str, Any, dict[str, Any]]
"""Kind, polygon in metres, properties."""

Row = tuple[str, Any, dict[str, Any]]


def keep_names(areas: Sequence[Area], stored: Features | None, frame: LocalFrame | None) -> list[Row]:
    """Return areas as rows of features: those that match a stored one with its id, name and further properties.

    areas: kind, polygon in metres, properties. Of several matches the largest overlap wins. Other areas are called
    by their kind and the next numbers, in the order of ``_reading_order``.
    """
    if stored is None or not len(stored):
        return _numbered(list(areas), {}, [], {})
    old = shapely.make_valid(stored.in_local(frame))  # drawn outlines may cross themselves
    pairs = []
    tree = shapely.STRtree(old)
    for i, (kind, shape, _) in enumerate(areas):
        for k in tree.query(shape.buffer(SAME_DOOR)).tolist():
            score = _sameness(kind, shape, str(stored.properties[k].get("kind")), old[k])
            if score > 0.0:
                pairs.append((-score, i, k))
    matches: dict[int, int] = {}
    used: set[int] = set()
    for _, i, k in sorted(pairs):
        if i not in matches and k not in used:
            matches[i] = k
            used.add(k)
    names = [(stored.ids[k], stored.properties[k]) for k in range(len(stored))]
    taken = [i for i, _ in names] + [str(p.get("name", "")) for _, p in names]
    return _numbered(list(areas), matches, taken, dict(enumerate(names)))


def _sameness(kind: str, shape: Any, old_kind: str, old: Any) -> float:
    """Return how much an area is the stored one: 0 to 1, above 0 if it keeps the name."""
    places = ("room", "corridor")
    if kind != old_kind and not (kind in places and old_kind in places):
        return 0.0
    if kind == "door":
        distance = float(shapely.centroid(shape).distance(shapely.centroid(old)))
        return 1.0 - distance / (2.0 * SAME_DOOR) if distance <= SAME_DOOR else 0.0
    union = shape.union(old).area
    overlap = shape.intersection(old).area / union if union else 0.0
    return overlap if overlap >= SAME else 0.0


def _numbered(
    areas: list[Area], matches: Mapping[int, int], taken: list[str], old: Mapping[int, tuple[str, Mapping[str, Any]]]
) -> list[Row]:
    highest = dict.fromkeys(AREA_KINDS, 0)
    for name in taken:
        if (m := _NUMBERED.match(name)) is not None:
            kind = name.rpartition("-")[0]
            highest[kind] = max(highest[kind], int(m[1]))
    rows: list[Row] = []
    for i in _order(areas):
        kind, shape, words = areas[i]
        if i in matches:
            area_id, before = old[matches[i]]
            kept = {name: value for name, value in before.items() if name not in words}
            rows.append((area_id, shape, {**kept, **words}))
            continue
        highest[kind] += 1
        name = f"{kind}-{highest[kind]}"
        rows.append((name, shape, {"kind": kind, "name": name, **words}))
    return rows


def _order(areas: Sequence[Area]) -> list[int]:
    """Return the areas kind by kind, in the order of their numbers."""
    out: list[int] = []
    for kind in AREA_KINDS:
        index = [i for i, area in enumerate(areas) if area[0] == kind]
        order = _reading_order.strips if kind in STRIP_KINDS else _reading_order.places
        out += [index[k] for k in order([areas[i][1] for i in index])]
    return out
