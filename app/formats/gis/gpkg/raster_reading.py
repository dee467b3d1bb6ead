"""Read tables of tiles: our own grids and images whole, others as images, or as grids on request."""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from app.errors import BadUpload, Invalid, Problem, UnreadableFile
from app.formats import ReadContext
from app.formats._grid_files import corners_of, corners_to_local, grid_from_keys, place_grid, transform_of
from app.formats.gis.gpkg.coverages import Coverage
from app.formats.gis.gpkg.placing import place
from app.formats.gis.gpkg.tile_matrix import Matrix, check_size, find_matrix, paint
from app.formats.gis.shapes import raise_unreadable
from app.model.geodesy import LocalFrame
from app.model.georeference import to_local
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, outline
from app.model.imagery import LOCAL, Affine, GeoImage
from app.model.layers import Layer, Part, PartKey
from app.syntax import geotiff, images

SAME_PIXELS = 1e-3
"""Maximum distance in pixels between the stored position of a raster and that of its tiles."""

OCCUPIED_SHADE, FREE_SHADE = 0.65, 0.196
"""Darkness from which a cell is occupied, and up to which it is free: Nav2's defaults."""

Pixels = NDArray[np.uint8]


class RasterReader:
    """Reads rasters. entries: our own descriptions. frame: of the file's datum, else of the environment's."""

    def __init__(
        self,
        database: sqlite3.Connection,
        context: ReadContext,
        entries: Sequence[Mapping[str, Any]],
        frame: LocalFrame | None,
    ) -> None:
        self.database = database
        self.context = context
        self.frame = frame
        self.entries = {str(entry.get("table")): entry for entry in entries}

    def read(self, name: str, table: str, crs: str | None, *, is_coverage: bool) -> dict[PartKey, Part]:
        """Return the raster of a table; nothing if it is not wanted or has no tiles. Errors name the table."""
        entry = self.entries.get(name, {})
        matrix = find_matrix(self.database, name, table, is_sparse=bool(entry))
        if matrix is None:
            self.context.warn("the table has no tiles", where=name)
            return {}
        layer = entry.get("layer", "occupancy" if self.context.layer == "occupancy" else "imagery")
        if layer not in ("occupancy", "imagery") or not self.context.wants(cast(Layer, layer)):
            return {}
        try:
            key = self._key(cast(Layer, layer), name, entry)
            if layer == "occupancy":
                return {key: self._grid(matrix, entry, crs, is_coverage=is_coverage)}
            return {key: self._image(matrix, entry, crs, is_coverage=is_coverage)}
        except BadUpload as error:
            if error.detail.startswith(name):
                raise
            raise type(error)(f"{name}: {error.detail}", [Problem(error.detail, where=name)]) from error
        except Invalid as error:
            raise_unreadable(error.detail, name)

    def _key(self, layer: Layer, name: str, entry: Mapping[str, Any]) -> PartKey:
        if entry:
            return PartKey(layer, str(entry.get("level")), str(entry.get("part")))
        return PartKey(layer, self.context.level, (self.context.grid if layer == "occupancy" else None) or name)

    # --- position ---

    def _is_where_stored(self, matrix: Matrix, transform: Affine, crs: str, size: tuple[int, int]) -> bool:
        """Return whether tiles are where a raster of ours was written."""
        stored = place(transform, crs, self.frame)
        if stored is None or (matrix.width, matrix.height) != size:
            return False
        a, _, left, _, e, top = matrix.transform
        far = max(abs(left - stored.left) / a, abs(top - stored.top) / -e)
        wide = max(abs(a - stored.dx) / a * matrix.width, abs(e + stored.dy) / -e * matrix.height)
        return max(far, wide) <= SAME_PIXELS

    def _position(self, matrix: Matrix, crs: str | None) -> tuple[Affine, str]:
        """Return transform and CRS of a raster whose position we did not store."""
        crs = crs or getattr(self.context.options, "crs", None)
        if crs is None:
            raise_unreadable("it names no CRS: set crs=EPSG:<number>, crs=wgs84 or crs=local", matrix.name)
        crs = {"wgs84": "EPSG:4326", LOCAL: LOCAL}.get(crs.lower(), crs)
        if crs != LOCAL and not geotiff.CRS_NAME.fullmatch(crs):
            crs = geotiff.crs_from_wkt(crs)
        transform = matrix.transform
        if crs != LOCAL and self.frame is not None:
            local = to_local(transform, crs, (matrix.width, matrix.height), self.frame)
            if local is not None:
                return local, LOCAL
        return transform, crs

    # --- grids ---

    def _grid(self, matrix: Matrix, entry: Mapping[str, Any], crs: str | None, *, is_coverage: bool) -> OccupancyGrid:
        check_size(matrix, 4 if is_coverage or not entry else 1, self.context.limits)
        if not self.context.decode_cells:
            cells = outline(matrix.height, matrix.width)
        elif entry:
            cells = self._stored_cells(matrix)
        elif is_coverage:
            cells = _cells_of_values(Coverage(self.database, matrix.name).read(matrix, self.context.limits))
        else:
            cells = _cells_of_shades(self._shown(matrix))
            reason = f"cells are read from its shades: darkness from {OCCUPIED_SHADE} is occupied, to {FREE_SHADE} free"
            self.context.warn(reason, where=matrix.name)
        stored = None
        if entry:
            keys = {k: entry[k] for k in entry if k not in ("table", "layer", "level", "part")}
            origin = keys.get("origin")
            keys["origin"] = tuple(origin) if isinstance(origin, list) else origin
            stored = grid_from_keys(cells, keys, "description of the grid in gpkg_metadata")
            if self._is_where_stored(matrix, transform_of(stored), LOCAL, (stored.width, stored.height)):
                return stored
            self.context.warn("its tiles are not where they were written: their position is used", where=matrix.name)
        transform, named = self._position(matrix, crs)
        corners = corners_of(transform, matrix.width, matrix.height)
        if named != LOCAL:
            if self.frame is None:
                raise_unreadable("it is placed on earth, and the environment has no datum: set one first", matrix.name)
            corners = corners_to_local(corners, named, self.frame)
        return place_grid(cells, stored, corners)

    def _stored_cells(self, matrix: Matrix) -> Pixels:
        """Return the cells of a grid that we wrote: the indices of the palette."""
        out = np.full((matrix.height, matrix.width, 1), UNKNOWN, np.uint8)

        def decode(data: bytes, _: int) -> Pixels:
            image = self._open(data, matrix)
            if image.mode == "P":
                return np.asarray(image)[..., None]
            if image.mode != "LA" or np.asarray(image).any():
                raise UnreadableFile("another program has changed this tile: send the grid as a GeoTIFF")
            return np.full((image.height, image.width, 1), UNKNOWN, np.uint8)

        paint(self.database, matrix, out, decode)
        return out[::-1, :, 0]

    # --- images ---

    def _image(self, matrix: Matrix, entry: Mapping[str, Any], crs: str | None, *, is_coverage: bool) -> GeoImage:
        check_size(matrix, 4, self.context.limits)
        properties = dict(entry.get("properties", {}))
        bands = entry.get("bands")
        pixels: NDArray[Any]
        if is_coverage:
            coverage = Coverage(self.database, matrix.name)
            pixels, properties = coverage.read(matrix, self.context.limits), coverage.properties
        elif isinstance(bands, int) and 1 <= bands <= 4:
            pixels = self._stored_pixels(matrix, bands)
        else:
            pixels = _without_opacity(self._shown(matrix))
        size = (matrix.width, matrix.height)
        stored = entry.get("transform")
        if isinstance(stored, list) and len(stored) == 6:
            transform = cast(Affine, tuple(map(float, stored)))
            own_crs = str(entry.get("crs"))
            if self._is_where_stored(matrix, transform, own_crs, size):
                return GeoImage(pixels, transform, own_crs, properties)
            self.context.warn("its tiles are not where they were written: their position is used", where=matrix.name)
        picture = GeoImage(pixels, *self._position(matrix, crs), properties)
        reason = geotiff.position_problem(picture)
        if reason is not None:
            raise_unreadable(f"{reason}: correct its CRS", matrix.name)
        return picture

    def _stored_pixels(self, matrix: Matrix, bands: int) -> Pixels:
        """Return the pixels of an image that we wrote: those beyond its extent may have one band more."""
        out = np.zeros((matrix.height, matrix.width, bands), np.uint8)

        def decode(data: bytes, _: int) -> Pixels:
            image = self._open(data, matrix)
            pixels = np.asarray(image) if image.mode in ("P", "L", "LA", "RGB", "RGBA") else _rgba(image)
            pixels = pixels.reshape(*pixels.shape[:2], -1)
            if pixels.shape[2] < bands:
                raise UnreadableFile(f"it has {pixels.shape[2]} bands, the image has {bands}: send it as a GeoTIFF")
            return pixels[..., :bands]

        paint(self.database, matrix, out, decode)
        return out

    def _shown(self, matrix: Matrix) -> Pixels:
        """Return the pixels of any tiles as RGBA; clear where there is none."""
        out = np.zeros((matrix.height, matrix.width, 4), np.uint8)
        paint(self.database, matrix, out, lambda data, _: _rgba(self._open(data, matrix)))
        return out

    def _open(self, data: bytes, matrix: Matrix) -> Image.Image:
        """Decode a tile after its size is checked."""
        return open_tile(data, matrix, self.context)


def open_tile(data: bytes, matrix: Matrix, context: ReadContext) -> Image.Image:
    """Decode a tile (PNG or JPEG) after its size is checked. Raises UnreadableFile."""
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        raise UnreadableFile("WebP tiles are unsupported: convert them (gdal_translate -co TILE_FORMAT=PNG)")
    width, height = images.read_size(data, context.limits)
    if (width, height) != (matrix.tile_width, matrix.tile_height):
        wanted = f"{matrix.tile_width} × {matrix.tile_height}"
        raise UnreadableFile(f"a tile of {width} × {height} pixels; gpkg_tile_matrix says {wanted}")
    return images.read_image(data, context.limits)


def _rgba(image: Image.Image) -> Pixels:
    if image.mode.startswith("I"):
        raise UnreadableFile("16-bit tiles need the extension for gridded coverages: use 8-bit PNG")
    return np.asarray(image.convert("RGBA"))


def _without_opacity(pixels: Pixels) -> Pixels:
    """Return RGB if everything is opaque."""
    return pixels[..., :3].copy() if bool((pixels[..., 3] == 255).all()) else pixels


def _cells_of_values(values: NDArray[np.float32]) -> Pixels:
    """Return cells, row 0 the lowest, of a coverage with cell values. Raises UnreadableFile for other values."""
    shown = values[::-1, :, 0]
    whole = np.where(np.isnan(shown) | (shown == -1), np.float32(UNKNOWN), shown)
    if not bool((((whole >= FREE) & (whole <= OCCUPIED)) | (whole == UNKNOWN)).all()):
        reason = f"cells must be {FREE} (free) to {OCCUPIED} (occupied), or {UNKNOWN} or -1 (unknown)"
        raise UnreadableFile(f"{reason}: upload it as an image, without layer=occupancy")
    return np.round(whole).astype(np.uint8)


def _cells_of_shades(pixels: Pixels) -> Pixels:
    """Return cells, row 0 the lowest, of a picture of a grid, by Nav2's rule for images."""
    grey = np.asarray(Image.fromarray(pixels).convert("L"))[::-1]
    table = np.full(256, UNKNOWN, np.uint8)
    darkness = 1 - np.arange(256) / 255
    table[darkness >= OCCUPIED_SHADE] = OCCUPIED
    table[darkness <= FREE_SHADE] = FREE
    return np.where(pixels[::-1, :, 3] < 128, np.uint8(UNKNOWN), table[grey])
