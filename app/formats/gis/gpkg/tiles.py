"""Pyramids of PNG tiles, written strip by strip: no raster is in memory twice."""

from __future__ import annotations

import io
import sqlite3
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from app.formats._grid_files import cell_colours
from app.formats.gis.gpkg.schema import TILE_TABLE
from app.formats.gis.gpkg.words import quoted
from app.model.grid import UNKNOWN, OccupancyGrid, halve_cells
from app.model.imagery import GeoImage, display_pixels, display_range, needs_range
from app.syntax.images import encode_png

TILE = 512
"""Side of a written tile, in pixels."""

PNG_LEVEL = 4
"""Compression of photos: a quarter larger than with the highest level, in a fifth of the time."""

Bytes = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Pyramid:
    """Raster to write as tiles.

    rows: returns the pixels of rows (first, end) from the top: uint8 [rows, width] or [rows, width, bands].
    halve: makes the next zoom level of such pixels.
    encode: returns the file of a tile (pixels of at most TILE by TILE), None if nothing of it would be seen.
    """

    width: int
    height: int
    rows: Callable[[int, int], Bytes]
    halve: Callable[[Bytes], Bytes]
    encode: Callable[[Bytes], bytes | None]

    @property
    def zooms(self) -> int:
        """Return the largest zoom level: level 0 is one tile, each further one has twice the columns and rows."""
        return ((max(self.width, self.height) - 1) // TILE).bit_length()


def write_tiles(database: sqlite3.Connection, table: str, pyramid: Pyramid) -> None:
    """Create a table with the tiles of all zoom levels."""
    database.execute(TILE_TABLE.format(quoted(table)))
    insert = f"INSERT INTO {quoted(table)} (zoom_level, tile_column, tile_row, tile_data) VALUES (?, ?, ?, ?)"  # noqa: S608
    height, rows = pyramid.height, pyramid.rows
    for zoom in range(pyramid.zooms, -1, -1):
        overview: Bytes | None = None
        for row in range(-(-height // TILE)):
            strip = rows(row * TILE, min((row + 1) * TILE, height))
            database.executemany(insert, _tiles(strip, zoom, row, pyramid))
            if zoom:
                half = pyramid.halve(strip)
                if overview is None:
                    overview = np.empty((-(-height // 2), *half.shape[1:]), np.uint8)
                overview[row * TILE // 2 : row * TILE // 2 + len(half)] = half
        if overview is not None:
            height = len(overview)
            rows = _slicer(overview)


def _slicer(pixels: Bytes) -> Callable[[int, int], Bytes]:
    return lambda first, end: pixels[first:end]


def _tiles(strip: Bytes, zoom: int, row: int, pyramid: Pyramid) -> Iterator[tuple[int, int, int, bytes]]:
    for column in range(-(-strip.shape[1] // TILE)):
        pixels = strip[:, column * TILE : (column + 1) * TILE]
        data = pyramid.encode(pixels)
        if data is None and row == column == 0:
            data = _encode(np.zeros((TILE, TILE, 2), np.uint8))  # a level without a tile is taken for damage
        if data is not None:
            yield zoom, column, row, data


# --- grids ------------------------------------------------------------------------------------------------------------
def grid_pyramid(grid: OccupancyGrid) -> Pyramid:
    """Return the cells of a grid: values are indices of a palette, in which unknown is clear."""
    palette = cell_colours()
    palette[UNKNOWN, 3] = 0
    height = grid.height

    def encode(cells: Bytes) -> bytes | None:
        return None if (cells == UNKNOWN).all() else encode_png(_padded(cells, UNKNOWN), palette=palette)

    return Pyramid(grid.width, height, lambda y, end: grid.cells[height - end : height - y][::-1], halve_cells, encode)


def _padded(pixels: Bytes, value: int) -> Bytes:
    """Return pixels as a complete tile, with a value below and to the right."""
    height, width = pixels.shape[:2]
    if (height, width) == (TILE, TILE):
        return pixels
    out = np.full((TILE, TILE, *pixels.shape[2:]), value, np.uint8)
    out[:height, :width] = pixels
    return out


# --- images -----------------------------------------------------------------------------------------------------------
def is_kept(picture: GeoImage) -> bool:
    """Return whether PNG tiles keep all values of an image: 8-bit grey, colours or a palette."""
    if picture.pixels.dtype != np.uint8:
        return False
    colours = picture.colours
    if colours == ("palette",):
        return picture.nodata is None and isinstance(picture.properties.get("palette"), list | tuple)
    plain = colours[:-1] if colours[-1] in ("alpha", "mask") else colours
    return plain == ("red", "green", "blue") or len(plain) == 1


def image_pyramid(picture: GeoImage) -> Pyramid:
    """Return the pixels of an image as they are shown: a palette stays one, no-data becomes clear."""
    height, width = picture.pixels.shape[:2]
    if picture.colours == ("palette",) and is_kept(picture):
        return _palette_pyramid(picture)
    shown_range = display_range([picture]) if needs_range(picture) else None

    def rows(first: int, end: int) -> Bytes:
        piece = GeoImage(picture.pixels[first:end], picture.transform, picture.crs, picture.properties)
        return display_pixels(piece, shown_range)

    return Pyramid(width, height, rows, _halve_shades, _encode_shades)


def _palette_pyramid(picture: GeoImage) -> Pyramid:
    height, width = picture.pixels.shape[:2]
    entries = np.array(picture.properties["palette"][:256], np.uint8).reshape(-1, 4)
    palette = np.zeros((256, 4), np.uint8)
    palette[: len(entries)] = entries
    clear = 255 if len(entries) < 256 else 0  # beyond the extent nothing is shown

    def encode(indices: Bytes) -> bytes:
        return encode_png(_padded(indices, clear), palette=palette)

    return Pyramid(width, height, lambda y, end: picture.pixels[y:end, :, 0], lambda part: part[::2, ::2], encode)


def _image(pixels: Bytes) -> Image.Image:
    return Image.fromarray(np.ascontiguousarray(pixels[..., 0] if pixels.shape[2] == 1 else pixels))


def _halve_shades(pixels: Bytes) -> Bytes:
    """Average 2 by 2 pixels, colours by their opacity."""
    half = np.asarray(_image(pixels).reduce(2))
    return half.reshape(*half.shape[:2], pixels.shape[2])


def _encode_shades(pixels: Bytes) -> bytes | None:
    height, width, bands = pixels.shape
    if bands in (2, 4) and not pixels[..., -1].any() and not pixels.any():
        return None
    if bands in (1, 3) and (height, width) != (TILE, TILE):
        pixels = np.concatenate([pixels, np.full((height, width, 1), 255, np.uint8)], axis=2)
    return _encode(_padded(pixels, 0))


def _encode(pixels: Bytes) -> bytes:
    out = io.BytesIO()
    _image(pixels).save(out, "PNG", compress_level=PNG_LEVEL)
    return out.getvalue()
