"""Content of vector tiles: the features of collections, simplified to what a tile can show.

A tile has 4096 units on each side, 16 to a pixel. Coordinates are rounded to units. Lines and areas are cut 5 pixels
outside the tile. Left out is what cannot be seen: lines and areas smaller than a quarter of a pixel, areas that have no
unit inside, and points within a quarter of a pixel of an earlier one.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import orjson
import shapely
from numpy.typing import NDArray

from app.convert.recently_used import RecentlyUsed
from app.model import geodesy
from app.model.features import Properties
from app.model.geodesy import WGS84, local_frame
from app.model.imagery import LOCAL
from app.ogc.crs import ReferenceSystem
from app.ogc.tables import Table, TableKey, VectorLayer
from app.ogc.tile_matrix_sets import TileMatrixSet
from app.store.gc_pause import gc_paused
from app.store.values import Box
from app.syntax.packed_properties import Numbered, Value, number, read_maps
from app.syntax.vector_tile import (
    LINE,
    POINT,
    POLYGON,
    EncodedProperties,
    GeometryType,
    Integers,
    Pieces,
    encode_properties,
    layer,
)

WRITER = 2
"""Version of the tiles' content: raise it whenever equal content gives other tiles."""

EXTENT = 4096
BUFFER = 80
"""Units around the tile in which lines and areas are drawn: 5 pixels."""

SMALLEST = 4
"""Units below which a line or an area is left out, and within which one point is enough: a quarter of a pixel."""

TOLERANCE = 1.0
"""Maximum distance in units by which a simplified line leaves its original."""

MAX_SOURCE_BYTES = 192 * 2**20
ROW_BYTES = 300


@dataclass(frozen=True, slots=True, eq=False)
class _Source:
    """Features of a collection in the CRS of a tile matrix set."""

    geometry: NDArray[np.object_]
    bounds: NDArray[np.float64]
    kinds: NDArray[np.int64]
    properties: EncodedProperties

    @property
    def size(self) -> int:
        coordinates = int(shapely.get_num_coordinates(self.geometry).sum())
        return ROW_BYTES * len(self.geometry) + 16 * coordinates + self.properties.size


_SOURCES: RecentlyUsed[_Source] = RecentlyUsed(MAX_SOURCE_BYTES, lambda source: source.size)
"""Sources of this process: they depend on content only, so that all stores can share them."""

TILES: RecentlyUsed[bytes] = RecentlyUsed(32 * 2**20, len)
"""Tiles of this process by ETag."""

_SINGLE = frozenset({str, int, float, bool})
_KINDS = np.array([1, 2, 2, 3, 1, 2, 3, 0])
"""Vector tiles' type of each of shapely's, 0 for none."""


def tile_etag(
    keys: Mapping[VectorLayer, TableKey], collection: str | None, one: TileMatrixSet, address: tuple[int, int, int]
) -> str:
    """Return the strong ETag of a tile of a collection; None: of all of these layers."""
    content = sorted(
        [name, datum.as_dict(), [[k.layer, k.level, k.name, h] for k, h in parts]]
        for name, (datum, parts) in keys.items()
    )
    text = orjson.dumps(["mvt", WRITER, content, collection, one.id, address])
    return f'"{hashlib.sha256(text).hexdigest()[:32]}"'


def vector_tile(
    tables: Mapping[str, tuple[TableKey, Table]], one: TileMatrixSet, z: int, row: int, column: int
) -> bytes:
    """Write a tile with a layer for each collection that has something to show; empty if none has."""
    box = one.box(z, row, column)
    out = []
    for name, (key, table) in tables.items():
        source = _source(name, key, table, one)
        out += [
            layer(name, EXTENT, kind, pieces, source.properties, rows)
            for kind, pieces, rows in _content(source, box)
            if len(rows)
        ]
    return b"".join(out)


def _source(name: str, key: TableKey, table: Table, one: TileMatrixSet) -> _Source:
    cached = _SOURCES.get((name, key, one.id))
    if cached is not None:
        return cached
    geometry = _planar(table, one.code)
    types = shapely.get_type_id(geometry)
    kinds = np.where(types >= 0, _KINDS[types], 0)
    with gc_paused():
        properties = encode_properties(_numbered(table))
    return _SOURCES.put((name, key, one.id), _Source(geometry, shapely.bounds(geometry), kinds, properties))


def _planar(table: Table, code: str) -> NDArray[np.object_]:
    """Return the geometries in a CRS: all coordinates at once, as each copy of the geometries takes as long."""
    geometry: NDArray[np.object_]
    if code == LOCAL:
        geometry = shapely.force_2d(table.in_crs(np.arange(len(table)), ReferenceSystem("", "local")))
        return geometry
    geometry = shapely.force_2d(table.geometry) if shapely.has_z(table.geometry).any() else table.geometry.copy()
    points, feature = shapely.get_coordinates(geometry, return_index=True)
    local = table.local[feature]
    points[local] = local_frame(table.datum).to_wgs84(points[local])
    if len(points) and np.ptp(points[:, 0]) > 180.0:  # on both sides of the antimeridian
        return geodesy.geometries_from_wgs84(code, shapely.force_2d(table.in_wgs84(np.arange(len(table)))))
    shapely.set_coordinates(geometry, geodesy.between(WGS84, code, points))
    return geometry


def _numbered(table: Table) -> Numbered:
    """Number the properties of each feature, its place and its id; nested ones become JSON texts."""
    maps = read_maps(table.packed)
    starts, keys = zip(*table.parts, strict=True)
    part = np.searchsorted(starts, np.arange(len(table)), side="right") - 1
    added = (
        ("level", [key.level for key in keys], part),
        ("part", [key.name for key in keys], part),
        ("id", table.ids, np.arange(len(table))),
    )
    other = ~maps.single
    for name, _, _ in added:
        other |= maps.with_key(name)
    rows = np.flatnonzero(other).tolist()
    return number(maps, added, {row: _flat({**table.properties(row), "id": table.ids[row]}) for row in rows})


def _flat(members: Properties) -> dict[str, Value]:
    return {
        name: value if type(value) in _SINGLE else orjson.dumps(value).decode()
        for name, value in members.items()
        if value is not None
    }


def _content(source: _Source, box: Box) -> Iterator[tuple[GeometryType, Pieces, Integers]]:
    """Yield what a tile shows of each type of geometry: pieces in units, and the rows of their features."""
    unit = (box[2] - box[0]) / EXTENT
    margin = BUFFER * unit
    low_x, low_y, high_x, high_y = source.bounds.T
    with np.errstate(invalid="ignore"):  # features without coordinates are in no tile
        near = (high_x >= box[0] - margin) & (low_x <= box[2] + margin)
        near &= (high_y >= box[1] - margin) & (low_y <= box[3] + margin)
        big = np.maximum(high_x - low_x, high_y - low_y) >= SMALLEST * unit
    for kind in (POINT, LINE, POLYGON):
        rows = np.flatnonzero(near & (source.kinds == kind) & (big | (kind == POINT)))
        if len(rows):
            yield kind, *_pieces(kind, source, rows, box, unit)


def _pieces(kind: GeometryType, source: _Source, rows: Integers, box: Box, unit: float) -> tuple[Pieces, Integers]:
    geometry = source.geometry[rows]
    if kind != POINT:
        geometry = _cut(geometry, source.bounds[rows], box, BUFFER * unit)
        if kind == POLYGON or (shapely.get_num_coordinates(geometry) > 2).any():
            geometry = shapely.simplify(geometry, TOLERANCE * unit, preserve_topology=kind == POLYGON)
    geometry, index = shapely.get_parts(geometry, return_index=True)
    if kind == POLYGON:
        keep = shapely.get_type_id(geometry) == 3
        geometry, index = geometry[keep], index[keep]
        geometry, polygons = shapely.get_rings(geometry, return_index=True)
        index = index[polygons]
        outer = np.ones(len(polygons), bool)
        outer[1:] = polygons[1:] != polygons[:-1]
    elif kind == LINE:
        keep = shapely.get_type_id(geometry) == 1
        geometry, index = geometry[keep], index[keep]
    coordinates, piece = shapely.get_coordinates(geometry, return_index=True)
    x = np.rint((coordinates[:, 0] - box[0]) / unit)
    y = np.rint((box[3] - coordinates[:, 1]) / unit)
    points = np.column_stack([x, y]).astype(np.int64)
    if kind == POINT:
        chosen = _thinned(points)
        return _of_features(points[chosen], np.arange(len(chosen)), index[piece[chosen]], rows)  # a piece each
    distinct = _distinct(points, piece)
    points, piece = points[distinct], piece[distinct]
    if kind == LINE:
        long = np.bincount(piece, minlength=len(geometry)) >= 2
        return _of_features(*_only(points, piece, long), index, rows)
    return _of_features(*_rings(points, piece, outer, polygons), index, rows)


def _cut(geometry: NDArray[np.object_], bounds: NDArray[np.float64], box: Box, margin: float) -> NDArray[np.object_]:
    """Clip what reaches beyond the tile and its buffer."""
    x0, y0, x1, y1 = box[0] - margin, box[1] - margin, box[2] + margin, box[3] + margin
    beyond = (bounds[:, 0] < x0) | (bounds[:, 1] < y0) | (bounds[:, 2] > x1) | (bounds[:, 3] > y1)
    if beyond.any():
        geometry = geometry.copy()
        geometry[beyond] = shapely.clip_by_rect(geometry[beyond], x0, y0, x1, y1)
    return geometry


def _thinned(points: Integers) -> Integers:
    """Return the indices of the points in the tile, one for each square of a quarter of a pixel."""
    inside = np.flatnonzero(((points >= 0) & (points <= EXTENT)).all(axis=1))
    cells = points[inside] // SMALLEST
    _, first = np.unique(cells[:, 0] * (EXTENT + 1) + cells[:, 1], return_index=True)
    out: Integers = inside[np.sort(first)]
    return out


def _distinct(points: Integers, piece: Integers) -> NDArray[np.bool_]:
    """Mark the points that differ from the one before in the same piece."""
    out = np.ones(len(points), bool)
    out[1:] = (points[1:] != points[:-1]).any(axis=1) | (piece[1:] != piece[:-1])
    return out


def _only(points: Integers, piece: Integers, keep: NDArray[np.bool_]) -> tuple[Integers, Integers]:
    """Return the points of the chosen pieces."""
    chosen = keep[piece]
    return points[chosen], piece[chosen]


def _rings(
    points: Integers, piece: Integers, outer: NDArray[np.bool_], polygons: Integers
) -> tuple[Integers, Integers]:
    """Open and orient rings: outer ones clockwise as displayed, holes the other way; drop those without an area."""
    count = len(outer)
    last = np.ones(len(points), bool)
    last[:-1] = piece[1:] != piece[:-1]
    following = np.roll(points, -1, axis=0)
    doubled = np.where(last, 0, points[:, 0] * following[:, 1] - following[:, 0] * points[:, 1])
    areas = np.bincount(piece, doubled, minlength=count)
    points, piece = points[~last], piece[~last]
    keep = (areas != 0) & (np.bincount(piece, minlength=count) >= 3)
    shown = np.zeros(polygons.max() + 1 if len(polygons) else 0, bool)
    shown[polygons[keep & outer]] = True
    keep &= shown[polygons]
    turn = (areas > 0) != outer
    points, piece = _only(points, piece, keep)
    starts = np.searchsorted(piece, np.arange(count))
    lengths = np.bincount(piece, minlength=count)
    within = np.arange(len(points)) - starts[piece]
    source = np.where(turn[piece], starts[piece] + lengths[piece] - 1 - within, np.arange(len(points)))
    return points[source], piece


def _of_features(points: Integers, piece: Integers, index: Integers, rows: Integers) -> tuple[Pieces, Integers]:
    """Number the pieces and the features that are left. index: of each piece in ``rows``."""
    pieces, starts = np.unique(piece, return_index=True)
    features, numbers = np.unique(index[pieces], return_inverse=True)
    ends = np.concatenate([starts, [len(points)]]).astype(np.int64)
    return Pieces(points, ends, numbers.astype(np.int64)), rows[features]
