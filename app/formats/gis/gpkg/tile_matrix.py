"""Read tiles of untrusted GeoPackages into one raster: the finest zoom level that has some."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from app.errors import BadUpload, Problem, TooLarge
from app.formats.gis.gpkg.words import quoted
from app.formats.gis.shapes import raise_unreadable
from app.limits import Limits
from app.model.imagery import Affine

MAX_ZOOMS = 100
MEMORY_DIVISOR = 3
"""Divisor: decoded pixels may use 1/3 of a worker's memory, since storing and writing them needs the rest."""

Decode = Callable[[bytes, int], NDArray[Any]]
"""Decodes a tile: (file, its id) -> pixels [height, width, bands]."""

_SET = "SELECT srs_id, min_x, max_y FROM gpkg_tile_matrix_set WHERE table_name = ?"
_LEVELS = """
SELECT zoom_level, matrix_width, matrix_height, tile_width, tile_height, pixel_x_size, pixel_y_size
FROM gpkg_tile_matrix WHERE table_name = ? ORDER BY zoom_level DESC
"""
_BOX = "SELECT min_x, min_y, max_x, max_y FROM gpkg_contents WHERE table_name = ?"


@dataclass(frozen=True, slots=True)
class Matrix:
    """Tiles of one zoom level, and the window of pixels (from the matrix's upper left corner) that has content.

    left, top: of the matrix. dx, dy: size of a pixel. table: its quoted name.
    """

    name: str
    table: str
    zoom: int
    srs_id: Any
    left: float
    top: float
    dx: float
    dy: float
    tile_width: int
    tile_height: int
    x: int
    y: int
    width: int
    height: int

    @property
    def transform(self) -> Affine:
        """Return the transform of the window."""
        return (self.dx, 0.0, self.left + self.x * self.dx, 0.0, -self.dy, self.top - self.y * self.dy)


def find_matrix(database: sqlite3.Connection, name: str, table: str, *, is_sparse: bool) -> Matrix | None:
    """Return the finest zoom level with tiles; None if there is none. name: in the GeoPackage's own tables.

    is_sparse: the extent counts also location there are no tiles.

    Raises UnreadableFile for a damaged description.
    """
    set_row = database.execute(_SET, (name,)).fetchone()
    levels = database.execute(_LEVELS, (name,)).fetchmany(MAX_ZOOMS)
    if set_row is None or not levels:
        raise_unreadable("its tiles are not described in gpkg_tile_matrix_set and gpkg_tile_matrix", name)
    bounds = f"SELECT min(tile_column), min(tile_row), max(tile_column), max(tile_row) FROM {quoted(table)}"  # noqa: S608
    tiles_of_levels = (
        (level, database.execute(f"{bounds} WHERE zoom_level = ?", level[:1]).fetchone()) for level in levels
    )
    finest = next(((level, tiles) for level, tiles in tiles_of_levels if tiles[0] is not None), None)
    if finest is None:
        return None
    (zoom, *sizes), tiles = finest
    numbers = [zoom, *sizes[:4], *tiles]
    if not all(isinstance(v, int) and 0 <= v < 2**31 for v in numbers) or 0 in sizes[:4]:
        raise_unreadable(f"sizes and numbers of tiles must be positive integers, got {numbers!r:.100}", name)
    columns, rows, tile_width, tile_height, dx, dy = sizes
    srs_id, left, top = set_row
    if not all(isinstance(v, int | float) and math.isfinite(v) for v in (left, top, dx, dy)) or not (dx > 0 and dy > 0):
        raise_unreadable("the extent and the pixel size of its tiles must be numbers", name)
    if tiles[2] >= columns or tiles[3] >= rows:
        raise_unreadable(f"tile {tiles[2]}, {tiles[3]} is outside the matrix of {columns} × {rows} tiles", name)
    low = (0, 0) if is_sparse else (tiles[0] * tile_width, tiles[1] * tile_height)
    last = (columns - 1, rows - 1) if is_sparse else tiles[2:]
    high = ((last[0] + 1) * tile_width, (last[1] + 1) * tile_height)
    box = database.execute(_BOX, (name,)).fetchone()
    x, y, end_x, end_y = _window(low, high, box, (float(left), float(top), float(dx), float(dy)))
    size = (x, y, end_x - x, end_y - y)
    return Matrix(name, quoted(table), zoom, srs_id, left, top, dx, dy, tile_width, tile_height, *size)


def _window(
    low: tuple[int, int], high: tuple[int, int], box: tuple[Any, ...], grid: tuple[float, float, float, float]
) -> tuple[int, int, int, int]:
    """Return the pixels inside the extent in gpkg_contents (as GDAL does); those of all tiles if it has no sense."""
    left, top, dx, dy = grid
    if not all(isinstance(v, int | float) and math.isfinite(v) for v in box):
        return (*low, *high)
    ends = [(box[0] - left) / dx, (top - box[3]) / dy, (box[2] - left) / dx, (top - box[1]) / dy]
    x, y, end_x, end_y = (round(max(-1.0, min(v, 2.0**53))) for v in ends)
    if end_x - x < 1 or end_y - y < 1 or x >= high[0] or y >= high[1] or end_x <= low[0] or end_y <= low[1]:
        return (*low, *high)
    return max(x, low[0]), max(y, low[1]), min(end_x, high[0]), min(end_y, high[1])


def check_size(matrix: Matrix, bytes_per_pixel: int, limits: Limits) -> None:
    """Raise TooLarge before memory is allocated."""
    count = matrix.width * matrix.height
    tile = matrix.tile_width * matrix.tile_height
    if max(count, tile) > limits.pixels:
        reason = f"its tiles are {matrix.width} × {matrix.height} pixels; the limit is {limits.pixels}"
        raise TooLarge(f"{matrix.name}: {reason} (FLEETMAP_MAX_PIXELS)", [Problem(reason, where=matrix.name)])
    limit = limits.memory_bytes // MEMORY_DIVISOR
    if max(count, tile) * bytes_per_pixel > limit:
        reason = f"its pixels take {count * bytes_per_pixel} bytes; the limit is {limit}"
        raise TooLarge(f"{matrix.name}: {reason}", [Problem(reason, where=matrix.name)])


def paint(database: sqlite3.Connection, matrix: Matrix, out: NDArray[Any], decode: Decode) -> None:
    """Put the tiles of a window into ``out`` [height, width, bands]; location there is none, it stays as it is.

    Raises UnreadableFile, naming the tile.
    """
    for tile_id, column, row, data in _tiles(database, matrix):
        location = f"{matrix.name}, zoom {matrix.zoom}, column {column}, row {row}"
        if not isinstance(data, bytes):
            raise_unreadable("a tile must be an image", location)
        try:
            pixels = decode(data, tile_id)
        except BadUpload as error:
            raise type(error)(f"{location}: {error.detail}", [Problem(error.detail, where=location)]) from error
        if pixels.shape[:2] != (matrix.tile_height, matrix.tile_width):
            got, wanted = f"{pixels.shape[1]} × {pixels.shape[0]}", f"{matrix.tile_width} × {matrix.tile_height}"
            raise_unreadable(f"a tile of {got} pixels; gpkg_tile_matrix says {wanted}", location)
        x, y = column * matrix.tile_width - matrix.x, row * matrix.tile_height - matrix.y
        end_x, end_y = min(x + matrix.tile_width, matrix.width), min(y + matrix.tile_height, matrix.height)
        first_x, first_y = max(x, 0), max(y, 0)
        if first_x < end_x and first_y < end_y:
            out[first_y:end_y, first_x:end_x] = pixels[first_y - y : end_y - y, first_x - x : end_x - x]


def _tiles(database: sqlite3.Connection, matrix: Matrix) -> Iterator[tuple[int, int, int, Any]]:
    """Yield (id, column, row, content) of the tiles that touch the window.

    Raises UnreadableFile if one exists twice.
    """
    first = (matrix.x // matrix.tile_width, matrix.y // matrix.tile_height)
    last = (
        (matrix.x + matrix.width - 1) // matrix.tile_width,
        (matrix.y + matrix.height - 1) // matrix.tile_height,
    )
    query = (
        f"SELECT rowid, tile_column, tile_row, tile_data FROM {matrix.table} WHERE zoom_level = ? "  # noqa: S608
        "AND tile_column BETWEEN ? AND ? AND tile_row BETWEEN ? AND ?"
    )
    seen: set[tuple[int, int]] = set()
    for row in database.execute(query, (matrix.zoom, first[0], last[0], first[1], last[1])):
        if row[1:3] in seen:
            raise_unreadable(f"tile {row[1]}, {row[2]} of zoom {matrix.zoom} exists twice", matrix.name)
        seen.add(row[1:3])
        yield row
