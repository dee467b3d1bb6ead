"""Geometries and values as KML texts."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from app.formats.kml.words import DEFAULT_PART, FAMILY, quote_attribute, spell
from app.model.frame import GROUND
from app.model.layers import PartKey
from app.syntax import decimals

KML = "http://www.opengis.net/kml/2.2"
GX = "http://www.google.com/kml/ext/2.2"

SAME_PLACE = 1e-10
"""Tolerance in degrees between a geometry and its stored element; a larger difference is an edit.

Coordinates are printed to 1e-12.
"""


def data_element(name: str, value: Any) -> str:
    """Write a value of ExtendedData."""
    return f'<Data name="{quote_attribute(name)}"><value>{spell(value)}</value></Data>'


@dataclass(frozen=True, slots=True)
class CoordinateTexts:
    """Coordinate lists of n geometries as text.

    Those of geometry k are texts[start[k]:start[k + 1]], in the order of its parts and rings; shape[k] is the geometry
    in the codes of ``reading``.
    """

    texts: list[str]
    start: list[int]
    shape: list[str]

    def texts_of(self, k: int) -> list[str]:
        """Return the lists of geometry k."""
        return self.texts[self.start[k] : self.start[k + 1]]


_LETTERS = {0: "P", 1: "L", 2: "L"}


def coordinate_texts(
    geometry: NDArray[np.object_], digits: int, form: Callable[..., str], glue: str, *, thin: bool = False
) -> CoordinateTexts:
    """Write all coordinates as text at once.

    form: joins the numbers of one position; glue: separates positions. thin: rings drawn as three points are written as
    three again.
    """
    parts, owner = shapely.get_parts(geometry, return_index=True)
    while len(parts) and (shapely.get_type_id(parts) > 3).any():
        parts, inner = shapely.get_parts(parts, return_index=True)
        owner = owner[inner]
    types = shapely.get_type_id(parts)
    area = types == 3
    count = np.where(area, 1 + np.maximum(shapely.get_num_interior_rings(parts), 0), 1)
    nothing = shapely.is_empty(parts)
    count[nothing] = 0
    part_of = np.repeat(np.arange(len(parts)), count)
    lists = np.empty(len(part_of), object)
    from_area = area[part_of]
    lists[~from_area] = parts[~area & ~nothing]
    lists[from_area] = shapely.get_rings(parts[area])
    points, list_of = shapely.get_coordinates(lists, include_z=True, return_index=True)
    columns = [decimals.numbers(points[:, 0], digits), decimals.numbers(points[:, 1], digits)]
    deep = shapely.has_z(lists)
    if deep.any():
        heights = decimals.numbers(np.where(np.isnan(points[:, 2]), 0.0, points[:, 2]), decimals.METRES)
        flat = (~deep[list_of]).tolist()
        triples = zip(*columns, heights, flat, strict=True)
        positions = [form(x, y) if plain else form(x, y, z) for x, y, z, plain in triples]
    else:
        positions = list(map(form, *columns))
    bounds = np.searchsorted(list_of, np.arange(len(lists) + 1)).tolist()
    texts = [glue.join(positions[a:b]) for a, b in pairwise(bounds)]
    if thin:
        begin = np.array(bounds[:-1], np.int64)
        four = np.flatnonzero(from_area & (np.diff(bounds) == 4))
        finite = np.nan_to_num(points)
        back = four[(finite[begin[four] + 1] == finite[begin[four] + 2]).all(axis=1)]
        for k in back.tolist():
            a = bounds[k]
            texts[k] = glue.join([positions[a], positions[a + 1], positions[a + 3]])
    places = np.searchsorted(owner[part_of], np.arange(len(geometry) + 1)).tolist()
    letters = [_LETTERS.get(t, f"A{n}") if n else "" for t, n in zip(types.tolist(), count.tolist(), strict=True)]
    starts = np.searchsorted(owner, np.arange(len(geometry) + 1)).tolist()
    several = (shapely.get_type_id(geometry) > 3).tolist()
    shape = [
        ("M" if many else "") + (letters[a] if b - a == 1 else "".join(letters[a:b]))
        for a, b, many in zip(starts, starts[1:], several, strict=False)
    ]
    return CoordinateTexts(texts, places, shape)


def _comma(*numbers: str) -> str:
    return ",".join(numbers)


def bracket(*numbers: str) -> str:
    """Write a position as JSON."""
    return f"[{','.join(numbers)}]"


def degree_texts(geometry: NDArray[np.object_], *, thin: bool = False) -> CoordinateTexts:
    """Write coordinates in degrees as KML lists them."""
    return coordinate_texts(geometry, decimals.DEGREES, _comma, " ", thin=thin)


def geometry_element(geometry: Any, lists: Iterator[str], extra: str = "") -> str:
    """Write a geometry as KML; its coordinate lists come from ``lists``."""
    kind = geometry.geom_type
    if geometry.is_empty:
        return ""
    if kind == "Point":
        return f"<Point>{extra}<coordinates>{next(lists)}</coordinates></Point>"
    hug = extra or "<tessellate>1</tessellate>"
    if kind in ("LineString", "LinearRing"):
        return f"<LineString>{hug}<coordinates>{next(lists)}</coordinates></LineString>"
    if kind == "Polygon":
        rings = [
            f"<{side}BoundaryIs><LinearRing><coordinates>{next(lists)}</coordinates></LinearRing></{side}BoundaryIs>"
            for side in ["outer"] + ["inner"] * len(geometry.interiors)
        ]
        return f"<Polygon>{hug}{''.join(rings)}</Polygon>"
    inner = "".join(geometry_element(g, lists, extra) for g in geometry.geoms)
    return f"<MultiGeometry>{inner}</MultiGeometry>"


def place_members(key: PartKey) -> str:
    """Return an item's level and part, as far as they are not the reader's defaults."""
    data = data_element("layer", key.layer)
    if key.level != GROUND:
        data += data_element("level", key.level)
    if key.name != (DEFAULT_PART[key.layer] or FAMILY):
        data += data_element("part", key.name)
    return data
