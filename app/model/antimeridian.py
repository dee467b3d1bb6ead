"""Geometries in degrees that cross the antimeridian: cut there, as RFC 7946 (3.1.9) asks, and joined again.

A line whose longitude changes by more than 180 degrees from one vertex to the next crosses the antimeridian, which is
the shorter way. What only touches it does not cross it: it stays in one piece, on one side.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

Array = NDArray[np.float64]

HALF, TURN = 180.0, 360.0


def cut_at_antimeridian(geometry: NDArray[np.object_]) -> NDArray[np.object_]:
    """Cut lines and areas that cross the antimeridian: they become multiple ones within ±180 degrees.

    Areas around a pole stay as they are: they have no such pieces.
    """
    wide = np.flatnonzero(_is_wide(geometry))
    if not len(wide):
        return geometry
    out = geometry.copy()
    for row in wide.tolist():
        out[row] = _cut(out[row])
    return out


def join_at_antimeridian(shape: Any) -> Any:
    """Join the pieces of a geometry that was cut at the antimeridian: its longitudes continue beyond 180 degrees."""
    if shape.geom_type not in ("MultiLineString", "MultiPolygon") or not _is_wide(np.array([shape], object))[0]:
        return shape
    parts = [_turned(part, 1.0) if part.bounds[2] <= 0.0 else part for part in shape.geoms]
    if shape.geom_type == "MultiPolygon":
        return shapely.union_all(parts)
    return shapely.line_merge(shapely.multilinestrings(parts), directed=True)


def _is_wide(geometry: NDArray[np.object_]) -> NDArray[np.bool_]:
    """Return which geometries extend over more than half of the globe."""
    west, _, east, _ = shapely.bounds(geometry).reshape(-1, 4).T
    with np.errstate(invalid="ignore"):  # no coordinates, or infinite ones
        return np.asarray(np.isfinite(east - west) & (east - west > HALF))


def _turned(shape: Any, turns: float) -> Any:
    """Move a geometry around the globe."""
    move = np.array([TURN * turns, 0.0, 0.0])
    deep = bool(shapely.has_z(shape))
    return shapely.transform(shape, lambda points: points + move[: points.shape[1]], include_z=deep)


def _cut(shape: Any) -> Any:
    kind = shape.geom_type
    if kind == "GeometryCollection":
        return shapely.GeometryCollection([_cut(part) for part in shape.geoms])
    if kind.endswith("Point"):
        return shape
    cut = _pieces_of_area if kind.endswith("Polygon") else _pieces_of_line
    parts = shapely.get_parts(shape)
    pieces = [piece for part in parts for piece in cut(part)]
    if len(pieces) == len(parts) and all(piece is part for piece, part in zip(pieces, parts, strict=True)):
        return shape
    if len(pieces) == 1 and not kind.startswith("Multi"):
        return pieces[0]
    return shapely.multipolygons(pieces) if kind.endswith("Polygon") else shapely.multilinestrings(pieces)


def _continued(ring: Any, near: float | None = None) -> Array:
    """Return the points of a line, [n, 2 or 3]: longitudes continue beyond ±180. near: longitude to begin near to."""
    points: Array = shapely.get_coordinates(ring, include_z=ring.has_z)
    points[:, 0] = np.unwrap(points[:, 0], period=TURN)
    if near is not None:
        points[:, 0] -= TURN * np.round((points[0, 0] - near) / TURN)
    return points


def _pieces_of_line(line: Any) -> list[Any]:
    """Return the pieces of a line in its direction: itself if it does not reach the antimeridian's other side."""
    points = _continued(line)
    if (points[:, 0] == shapely.get_coordinates(line)[:, 0]).all():
        return [line]
    sides = np.round(points[:, 0] / TURN)  # of the globe on which each vertex is; ±180 is on that of the middle
    pieces: list[Any] = []
    piece = [points[0]]
    for k in range(1, len(points)):
        before, after = points[k - 1], points[k]
        if sides[k] != sides[k - 1]:
            border = HALF * (sides[k] + sides[k - 1])
            crossing = before + (border - before[0]) / (after[0] - before[0]) * (after - before)
            crossing[0] = border
            _add_piece(pieces, [*piece, crossing], sides[k - 1])
            piece = [crossing]
        piece.append(after)
    _add_piece(pieces, piece, sides[-1])
    return pieces or [line]


def _add_piece(pieces: list[Any], points: list[Array], side: float) -> None:
    at = np.array(points)
    at = at[np.append(True, (at[1:] != at[:-1]).any(axis=1))]
    if len(at) > 1:
        pieces.append(_turned(shapely.linestrings(at), -side))


def _pieces_of_area(polygon: Any) -> list[Any]:
    """Return the pieces of a polygon, counter-clockwise: itself if it is on one side only, or around a pole."""
    outer = _continued(polygon.exterior)
    if (outer[:, 0] == shapely.get_coordinates(polygon.exterior)[:, 0]).all():
        return [polygon]
    middle = float(outer[:, 0].min() + outer[:, 0].max()) / 2
    rings = [outer, *(_continued(ring, middle) for ring in polygon.interiors)]
    if any(abs(ring[0, 0] - ring[-1, 0]) > HALF for ring in rings):
        return [polygon]
    whole = shapely.make_valid(shapely.Polygon(outer, rings[1:]))
    pieces = []
    for side in (-1.0, 0.0, 1.0):
        globe = shapely.box(TURN * side - HALF, -90.0, TURN * side + HALF, 90.0)
        cut = _turned(shapely.intersection(whole, globe), -side)
        pieces += [part for part in shapely.get_parts(shapely.get_parts(cut)) if part.geom_type == "Polygon"]
    pieces = [piece for piece in pieces if piece.area > 0.0]
    return list(shapely.orient_polygons(np.array(pieces, object))) or [polygon]
