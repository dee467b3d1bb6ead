"""OpenStreetMap's multipolygons: areas whose outer and inner rings are ways, each of them whole or split.

Source: OSM wiki, Relation:multipolygon. Which ring is outer follows from how the rings lie in each other, by even and
odd, as osmium's assembler has it; the members' roles are not needed for it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import reduce
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from app.model.features import Features, Properties

Lines = Sequence[NDArray[np.float64]]


def is_multipolygon(properties: Properties) -> bool:
    """Whether an object is a relation that says that it is an area."""
    own = properties.get("osm")
    tags = own.get("tags") if isinstance(own, Mapping) else None
    return isinstance(tags, Mapping) and tags.get("type") == "multipolygon"


def areas_of(part: Features, rows: Iterable[int]) -> dict[int, Any | None]:
    """The area of each multipolygon among these rows, in the coordinates of its ways; None where its rings do not
    close. Ways that are missing are left out."""
    wanted = [k for k in rows if part.ids[k].startswith("r") and is_multipolygon(part.properties[k])]
    index = part.index() if wanted else {}
    out: dict[int, Any | None] = {}
    for k in wanted:
        members = part.properties[k]["osm"].get("members")
        ways = [
            index.get(f"w{member[1]}", -1)
            for member in (members if isinstance(members, (list, tuple)) else ())
            if isinstance(member, (list, tuple)) and len(member) == 3 and member[0] == "way"
        ]
        lines = [shapely.get_coordinates(part.geometry[row]) for row in ways if row >= 0]
        complete = not any(part.properties[row]["osm"].get("missing") for row in ways if row >= 0)
        out[k] = assembled(lines) if complete else None
    return out


def assembled(lines: Lines) -> Any | None:
    """The area that ways enclose (float64 [n, 2] each): a polygon or several; None where they leave a ring open."""
    rings = _rings(lines)
    if not rings:
        return None
    areas = [shapely.make_valid(shapely.Polygon(ring)) for ring in rings]
    whole = reduce(shapely.symmetric_difference, areas)
    flat = [g for g in shapely.get_parts(shapely.get_parts(whole)) if shapely.get_type_id(g) == 3]
    if not flat:
        return None
    return flat[0] if len(flat) == 1 else shapely.multipolygons(flat)


def _rings(lines: Lines) -> list[NDArray[np.float64]] | None:
    """The lines joined end to end to closed rings; None where one stays open."""
    ends: dict[tuple[float, ...], list[int]] = {}
    for k, line in enumerate(lines):
        if len(line) < 2:
            return None
        for end in (line[0], line[-1]):
            ends.setdefault(tuple(end.tolist()), []).append(k)
    left = set(range(len(lines)))
    out = []
    for k in range(len(lines)):
        if k not in left:
            continue
        left.remove(k)
        ring = [lines[k]]
        start, end = (tuple(lines[k][n].tolist()) for n in (0, -1))
        while end != start:
            following = next((other for other in ends[end] if other in left), None)
            if following is None:
                return None
            left.remove(following)
            line = lines[following]
            line = line if tuple(line[0].tolist()) == end else line[::-1]
            ring.append(line[1:])
            end = tuple(line[-1].tolist())
        joined = np.concatenate(ring)
        if len(joined) < 4:
            return None
        out.append(joined)
    return out
