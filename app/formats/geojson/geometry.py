"""Convert GeoJSON geometries to shapes: plain points and lines all at once, others one by one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import chain
from typing import Any, NoReturn

import numpy as np
import shapely
from numpy.typing import NDArray

from app.formats.geojson.words import GEOMETRIES
from app.model.features import NO_GEOMETRY

RaiseUnreadable = Callable[[int, str], NoReturn]


def parse_geometries(raw: Sequence[Any], refuse: RaiseUnreadable) -> tuple[NDArray[np.object_], dict[int, Any]]:
    """Convert GeoJSON geometries to shapely ones; also return, by index, those with more content than the shape."""
    out = np.empty(len(raw), object)
    odd: dict[int, Any] = {}
    plain: dict[str, list[int]] = {"Point": [], "LineString": []}
    single: list[int] = []
    for k, geometry in enumerate(raw):
        if geometry is None:
            out[k] = NO_GEOMETRY
        elif len(geometry) == 2 and isinstance(geometry.get("coordinates"), list) and geometry["coordinates"]:
            kind = geometry.get("type")
            (plain[kind] if kind in ("Point", "LineString") else single).append(k)
        else:
            single.append(k)
    # Most features of a network are 2-D points and lines: convert them all at once.
    at = [raw[k]["coordinates"] for k in plain["Point"]]
    if at and _flat(at):
        out[plain["Point"]] = shapely.points(np.array(at, np.float64))
    else:
        single += plain["Point"]
    lines = [raw[k]["coordinates"] for k in plain["LineString"]]
    rows = list(chain.from_iterable(lines))
    sizes = list(map(len, lines))
    if lines and min(sizes) > 1 and _flat(rows):
        owner = np.repeat(np.arange(len(lines)), sizes)
        out[plain["LineString"]] = shapely.linestrings(np.array(rows, np.float64), indices=owner)
    else:
        single += plain["LineString"]
    for k in sorted(single):
        one = GeometryParser()
        try:
            out[k] = one.shape(raw[k])
        except (ValueError, shapely.errors.GEOSException) as error:
            refuse(k, str(error))
        if one.odd or out[k].is_empty:
            odd[k] = raw[k]
    return out, odd


def _flat(rows: list[Any]) -> bool:
    """Whether these are positions of two numbers each."""
    return (
        set(map(type, rows)) == {list}
        and set(map(len, rows)) == {2}
        and set(map(type, chain.from_iterable(rows))) <= {int, float}
    )


class GeometryParser:
    """Convert one GeoJSON geometry to shapely. odd: the geometry has content that the shape lacks."""

    def __init__(self) -> None:
        self.odd = False

    def shape(self, geometry: Any) -> Any:
        """Return the shape. Raises ValueError with the reason if it is not a GeoJSON geometry."""
        if not isinstance(geometry, dict) or geometry.get("type") not in GEOMETRIES:
            kind = geometry.get("type") if isinstance(geometry, dict) else geometry
            raise ValueError(f"unsupported geometry type {str(kind)[:40]!r}")
        kind = geometry["type"]
        inner = geometry.get("geometries" if kind == "GeometryCollection" else "coordinates")
        if not isinstance(inner, list):
            raise ValueError(f"a {kind} needs its coordinates as an array")
        if len(geometry) > 2:
            self.odd = True
        if kind == "GeometryCollection":
            return shapely.GeometryCollection([self.shape(g) for g in inner])
        if not inner:
            self.odd = True
            return NO_GEOMETRY
        if kind == "Point":
            return shapely.points(self._positions([inner])[0])
        if kind == "MultiPoint":
            return shapely.multipoints(shapely.points(self._positions(inner)))
        if kind == "LineString":
            return self._line(inner)
        if kind == "MultiLineString":
            return shapely.multilinestrings([self._line(part) for part in inner])
        if kind == "Polygon":
            return self._polygon(inner)
        return shapely.multipolygons([self._polygon(part) for part in inner])

    def _positions(self, rows: Any) -> NDArray[np.float64]:
        """Return [n, 2 or 3]: three columns if all have an altitude and any is not 0."""
        if not isinstance(rows, list) or not all(isinstance(row, list) for row in rows):
            raise ValueError("coordinates must be arrays of positions")
        if not set(map(type, chain.from_iterable(rows))) <= {int, float} or any(len(row) < 2 for row in rows):
            raise ValueError("a position must be two or three numbers")
        sizes = set(map(len, rows))
        if sizes == {2}:
            return np.array(rows, np.float64)
        if sizes == {3}:
            at = np.array(rows, np.float64)
            if at[:, 2].any():
                return at
        self.odd = True
        return np.array([row[:2] for row in rows], np.float64)

    def _line(self, rows: Any) -> Any:
        at = self._positions(rows)
        if len(at) < 2:
            raise ValueError("a line needs at least two positions")
        return shapely.linestrings(at)

    def _polygon(self, rings: Any) -> Any:
        if not isinstance(rings, list) or not rings:
            raise ValueError("a polygon needs an array of rings")
        shapes = [self._ring(ring) for ring in rings]
        if len({bool(r.has_z) for r in shapes}) > 1:
            self.odd = True
            shapes = [shapely.force_2d(r) for r in shapes]
        return shapely.polygons(shapes[0], shapes[1:] or None)

    def _ring(self, rows: Any) -> Any:
        at = self._positions(rows)
        if len(at) and (at[0] != at[-1]).any():
            # RFC 7946 requires a closed ring; an open one is unambiguous.
            self.odd = True
            at = np.concatenate([at, at[:1]])
        if len(at) < 4:
            raise ValueError("a polygon's ring needs at least four positions, the last one equal to the first")
        return shapely.linearrings(at)
