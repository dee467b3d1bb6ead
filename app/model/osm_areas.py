"""OpenStreetMap's multipolygons: areas whose outer and inner rings are ways, each of them complete or split.

Source: OSM wiki, Relation:multipolygon. Which ring is outer follows from the nesting of the rings by the even-odd rule,
as in osmium's assembler; the members' roles are not needed.
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

LINES = frozenset({"barrier", "waterway", "highway"})
"""Tags of closed ways that apply to their course and not to the ground inside."""


def is_multipolygon(properties: Properties) -> bool:
    """Return whether an object is a relation that is tagged as an area."""
    source_properties = properties.get("osm")
    tags = source_properties.get("tags") if isinstance(source_properties, Mapping) else None
    return isinstance(tags, Mapping) and tags.get("type") == "multipolygon"


def multipolygon_areas(part: Features, rows: Iterable[int]) -> dict[int, Any | None]:
    """Return the area of each multipolygon among these rows, as its ways are anchored; None if its rings are open.

    Missing ways are skipped.
    """
    relation_rows = [k for k in rows if part.ids[k].startswith("r") and is_multipolygon(part.properties[k])]
    index = part.index() if relation_rows else {}
    out: dict[int, Any | None] = {}
    for k in relation_rows:
        way_rows = [index.get(way, -1) for way, _ in _ways(part.properties[k])]
        lines = [shapely.get_coordinates(part.geometry[row]) for row in way_rows if row >= 0]
        complete = not any(part.properties[row]["osm"].get("missing") for row in way_rows if row >= 0)
        out[k] = assemble_area(lines) if complete else None
    return out


def incomplete_areas(part: Features, rows: Iterable[int]) -> dict[int, Any]:
    """Return the available ways of each incomplete area among these rows: a collection, possibly empty.

    Incomplete: a multipolygon with open rings or missing outer ways, and a closed way of an area without some of its
    nodes.
    """
    out: dict[int, Any] = {}
    chosen = [k for k in rows if isinstance(part.properties[k].get("osm"), Mapping)]
    index = part.index() if any(is_multipolygon(part.properties[k]) for k in chosen) else {}
    areas = multipolygon_areas(part, [k for k in chosen if part.geometry[k].is_empty])
    for k in chosen:
        p = part.properties[k]
        if is_multipolygon(p) and part.ids[k].startswith("r"):
            way_rows = [(index.get(way, -1), role) for way, role in _ways(p)]
            if (k in areas and areas[k] is None) or any(row < 0 and role != "inner" for row, role in way_rows):
                out[k] = shapely.geometrycollections([part.geometry[row] for row, _ in way_rows if row >= 0])
        elif _has_missing_nodes(p["osm"]):
            out[k] = shapely.geometrycollections([part.geometry[k]])
    return out


def ground_around(ways: Any, radius: float) -> Any:
    """Return the ground that an area may cover if only these ways are available: polygons; empty if there are none.

    It is their convex hull and a disc over each gap from a loose end to the next one: a missing way with a right angle
    follows its rim.

    Args:
        ways: a collection in metres.
        radius: metres around the hull.
    """
    lines = shapely.get_parts(ways)
    lines = lines[(shapely.get_type_id(lines) == 1) & ~shapely.is_empty(lines)]
    both = shapely.get_coordinates([shapely.get_point(lines, 0), shapely.get_point(lines, -1)])
    at, count = np.unique(both, axis=0, return_counts=True)
    loose = at[count % 2 == 1]
    ground = [shapely.buffer(shapely.convex_hull(ways), radius)]
    if len(loose) > 1:
        ends = shapely.points(loose)
        (one, other), gap = shapely.STRtree(ends).query_nearest(ends, exclusive=True, return_distance=True)
        ground += list(shapely.buffer(shapely.points((loose[one] + loose[other]) / 2), gap / 2))
    return shapely.union_all(ground)


def _ways(p: Properties) -> list[tuple[str, Any]]:
    """Return (id, role) of a relation's ways."""
    members = p["osm"].get("members")
    return [
        (f"w{member[1]}", member[2])
        for member in (members if isinstance(members, (list, tuple)) else ())
        if isinstance(member, (list, tuple)) and len(member) == 3 and member[0] == "way"
    ]


def _has_missing_nodes(source_properties: Mapping[str, Any]) -> bool:
    """Return whether a way goes around an area and some of its nodes have no coordinates."""
    refs, tags = source_properties.get("refs"), source_properties.get("tags")
    is_ring = isinstance(refs, (list, tuple)) and len(refs) > 3 and refs[0] == refs[-1]
    return is_ring and bool(source_properties.get("missing")) and isinstance(tags, Mapping) and not LINES & tags.keys()


def assemble_area(lines: Lines) -> Any | None:
    """Return the area that ways (float64 [n, 2] each) enclose: one or several polygons; None if a ring stays open."""
    rings = _rings(lines)
    if not rings:
        return None
    areas = [shapely.make_valid(shapely.Polygon(ring)) for ring in rings]
    area = reduce(shapely.symmetric_difference, areas)
    flat = [g for g in shapely.get_parts(shapely.get_parts(area)) if shapely.get_type_id(g) == 3]
    if not flat:
        return None
    return flat[0] if len(flat) == 1 else shapely.multipolygons(flat)


def _rings(lines: Lines) -> list[NDArray[np.float64]] | None:
    """Join lines end to end to closed rings; None if one stays open."""
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
