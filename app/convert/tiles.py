"""Tiles of stored grids, images and voxel maps, made from the hash of a part and cached by it.

Reductions up to ``pyramid.DIRECT`` are computed from the chunks of a tile. The others are computed once for the whole
raster and stored in the cache of maps, as PNG tiles in one file.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import orjson
from numpy.typing import NDArray
from PIL import Image

from app.convert.cache import Cache, CachedFile, ConvertedMap, LostMap
from app.convert.pyramid import (
    STORED,
    TILE,
    GridSource,
    ImageSource,
    Pixels,
    Size,
    Source,
    encode_cells,
    piece_of_image,
    range_of_image,
)
from app.convert.recently_used import RecentlyUsed
from app.convert.report import Report
from app.convert.voxel_tiles import Columns, Span
from app.errors import NotFound, Unavailable
from app.model.imagery import needs_range
from app.model.layers import PartKey
from app.model.voxels import VoxelMap
from app.store.store import Store
from app.store.values import PartEntry, Version
from app.store.windows import RasterReader

Kind = Literal["occupancy", "imagery", "voxels"]
KINDS: tuple[Kind, ...] = get_args(Kind)

WRITER = 1
"""Version of the tiles' content: raise it whenever equal parts give other tiles."""

MAX_TILE_BYTES = 48 * 2**20
MAX_COLUMN_BYTES = 256 * 2**20
MAX_SOURCES = 64
MAX_LOST_ATTEMPTS = 3
"""Maximum number of times that a pyramid is built if it leaves the cache before it is read."""

_INDEX = struct.Struct("<QII")
"""Entry of a pyramid's index: offset, size and CRC-32 of a tile."""


@dataclass(frozen=True, slots=True)
class TileAddress:
    """One tile: its level (``z``; the highest has one pixel per cell), row from the top, and column."""

    z: int
    row: int
    column: int


class Tiles:
    """Tiles of stored parts. Thread-safe; every method may take seconds the first time, none is for the event loop."""

    def __init__(self, store: Store, cache: Cache) -> None:
        self._store, self._cache = store, cache
        self._tiles: RecentlyUsed[bytes] = RecentlyUsed(MAX_TILE_BYTES, len)
        self._sources: RecentlyUsed[Source] = RecentlyUsed(MAX_SOURCES, lambda _: 1)
        self._columns: RecentlyUsed[Columns] = RecentlyUsed(MAX_COLUMN_BYTES, lambda columns: columns.size_bytes)

    def header(self, entry: PartEntry) -> RasterReader:
        """Return the reader of a stored grid or image: size and position without a pixel."""
        return RasterReader(self._store.chunks.stage(), entry.hash)

    def cached(self, entry: PartEntry, address: TileAddress, heights: Span | None = None) -> bytes | None:
        """Return a tile that is in memory."""
        return self._tiles.get((entry.hash, address, heights))

    def raster_tile(self, entry: PartEntry, address: TileAddress) -> bytes:
        """Return a tile of a grid or image as PNG. Raises NotFound outside the raster."""
        cached = self.cached(entry, address)
        if cached is not None:
            return cached
        source = self._source(entry)
        k = _reduction(source.size, address)
        if k >= STORED:
            png = self._stored_tile(entry, source, k, address)
        else:
            pixels = source.reduce(k, address.row * TILE, address.column * TILE, TILE, TILE)
            png = source.encode(pixels)
        return self._tiles.put((entry.hash, address, None), png)

    def is_ready(self, entry: PartEntry, z: int) -> bool:
        """Return whether a level of a grid or image needs no work on the whole raster (``prepare``)."""
        source = self._sources.get(entry.hash)
        if source is None:
            reader = self.header(entry)
            size, waits = Size(reader.width, reader.height), _needs_range(reader)
        else:
            size, waits = source.size, False
        return not waits and (size.levels - 1 - z < STORED or self._cache.get(_key(entry, "pyramid")) is not None)

    def prepare(self, entry: PartEntry) -> None:
        """Do the work on the whole raster that its overviews need; once for each content."""
        source = self._source(entry)
        if source.size.levels > STORED:
            self._pyramid(entry, source)

    def reduced(self, entry: PartEntry, k: int) -> NDArray[np.uint8]:
        """Return all pixels of a grid (uint8 [h, w]) or image (RGBA, [h, w, 4]) at a reduction, row 0 on top."""
        source = self._source(entry)
        if k < STORED:
            return source.reduce_all(k)
        size = source.size.reduced(k)
        return self.window(entry, k, (0, 0, size.height, size.width))

    def window(self, entry: PartEntry, k: int, box: tuple[int, int, int, int]) -> NDArray[np.uint8]:
        """Return some pixels of a grid or image at a reduction. box: first row and column, and those after the last."""
        source = self._source(entry)
        top, left, bottom, right = box
        if k < STORED:
            return source.reduce(k, top, left, bottom - top, right - left)
        z = source.size.levels - 1 - k
        out = np.empty((bottom - top, right - left, *source.bands), np.uint8)
        for row in range(top // TILE, -(-bottom // TILE)):
            for column in range(left // TILE, -(-right // TILE)):
                tile = _decode(self.raster_tile(entry, TileAddress(z, row, column)), source)
                r0, r1 = max(top, row * TILE), min(bottom, (row + 1) * TILE)
                c0, c1 = max(left, column * TILE), min(right, (column + 1) * TILE)
                part = tile[r0 - row * TILE : r1 - row * TILE, c0 - column * TILE : c1 - column * TILE]
                out[r0 - top : r1 - top, c0 - left : c1 - left] = part
        return out

    def columns(self, version: Version, key: PartKey) -> Columns:
        """Return the leaves of a voxel map. Raises NotFound if it is empty."""
        entry = version.part(key)
        assert entry is not None
        cached = self._columns.get(entry.hash)
        if cached is not None:
            return cached
        voxels = self._store.content.load(version, [key]).parts[key]
        assert isinstance(voxels, VoxelMap)
        if not len(voxels):
            raise NotFound(f"the voxel map {key.name!r} is empty: it has no tiles")
        return self._columns.put(entry.hash, Columns(voxels))

    def voxel_tile(self, version: Version, key: PartKey, address: TileAddress, heights: Span) -> bytes:
        """Return a tile of a slice of a voxel map as PNG. Raises NotFound outside the raster."""
        entry = version.part(key)
        assert entry is not None
        cached = self.cached(entry, address, heights)
        if cached is not None:
            return cached
        columns = self.columns(version, key)
        k = _reduction(Size(columns.width, columns.height), address)
        cells = columns.tile(k, address.row * TILE, address.column * TILE, TILE, heights)
        return self._tiles.put((entry.hash, address, heights), encode_cells(cells))

    def _source(self, entry: PartEntry) -> Source:
        cached = self._sources.get(entry.hash)
        if cached is not None:
            return cached
        reader = self.header(entry)
        source: Source
        if reader.kind == "grid":
            source = GridSource(reader)
        else:
            source = ImageSource(reader, self._range(entry, reader) if _needs_range(reader) else None)
        return self._sources.put(entry.hash, source)

    def _range(self, entry: PartEntry, reader: RasterReader) -> tuple[float, float]:
        """Return the displayed range of values of an image that is not 8-bit."""

        def make() -> ConvertedMap:
            text = orjson.dumps([value.hex() for value in range_of_image(reader)])
            return ConvertedMap({"range.json": (text, "application/json")}, None, Report("tiles"))

        file = self._cache.get_or_make(_key(entry, "range"), make).files[0]
        low, high = orjson.loads(file.read())
        return float.fromhex(low), float.fromhex(high)

    def _pyramid(self, entry: PartEntry, source: Source) -> CachedFile:
        def make() -> ConvertedMap:
            return ConvertedMap({"tiles": (_pack(source), "application/octet-stream")}, None, Report("tiles"))

        return self._cache.get_or_make(_key(entry, "pyramid"), make).files[0]

    def _stored_tile(self, entry: PartEntry, source: Source, k: int, address: TileAddress) -> bytes:
        """Read a tile of the pyramid, and build it again if it is damaged or evicted."""
        position = _position(source.size, k, address)
        for _ in range(MAX_LOST_ATTEMPTS):
            file = self._pyramid(entry, source)
            with contextlib.suppress(LostMap):
                return _read_tile(file, position)
        raise Unavailable("the overviews of this raster cannot be kept in the cache: try again in a few seconds")


def tile_etag(entry: PartEntry, address: TileAddress | None, heights: Span | None = None, *more: object) -> str:
    """Return the strong ETag of a tile, or of the description of its raster (address None)."""
    place = None if address is None else [address.z, address.row, address.column]
    text = orjson.dumps([WRITER, entry.hash, place, heights, *more])
    return f'"{hashlib.sha256(text).hexdigest()[:32]}"'


def _key(entry: PartEntry, purpose: str) -> str:
    return hashlib.sha256(f"tiles {purpose} {WRITER} {entry.hash}".encode()).hexdigest()


def _needs_range(reader: RasterReader) -> bool:
    """Return whether an image's tiles need the range of its values."""
    if reader.kind == "grid":
        return False
    return needs_range(piece_of_image(reader, np.zeros((1, 1, reader.bands or 1), reader.dtype)))


def _reduction(size: Size, address: TileAddress) -> int:
    """Return the reduction of a tile's level. Raises NotFound if there is no such tile."""
    k = size.levels - 1 - address.z
    if k < 0:
        raise NotFound(f"level {address.z} does not exist: use z from 0 to {size.levels - 1}")
    rows, columns = size.reduced(k).tiles()
    if address.row >= rows or address.column >= columns:
        raise NotFound(
            f"there is no tile {address.row}/{address.column}: level {address.z} has rows 0 to {rows - 1} and columns "
            f"0 to {columns - 1}"
        )
    return k


# --- pyramids ---


def _position(size: Size, k: int, address: TileAddress) -> int:
    """Return the position of a tile in the index of a pyramid: lowest reduction first, row by row."""
    before = 0
    for lower in range(STORED, k):
        rows, columns = size.reduced(lower).tiles()
        before += rows * columns
    return before + address.row * size.reduced(k).tiles()[1] + address.column


def _pack(source: Source) -> bytes:
    """Write all tiles of the stored reductions: number of tiles, index, PNGs."""
    tiles: list[bytes] = []
    pixels = source.reduce_all(STORED)
    for k in range(STORED, source.size.levels):
        if k > STORED:
            pixels = source.halve(pixels)
        tiles += _cut(source, pixels)
    start = len(tiles) * _INDEX.size
    index = bytearray()
    for png in tiles:
        index += _INDEX.pack(start, len(png), zlib.crc32(png))
        start += len(png)
    return b"".join([index, *tiles])


def _cut(source: Source, pixels: Pixels) -> Sequence[bytes]:
    """Encode all tiles of a level, row by row."""
    rows, columns = Size(pixels.shape[1], pixels.shape[0]).tiles()
    return [
        source.encode(pixels[row * TILE : (row + 1) * TILE, column * TILE : (column + 1) * TILE])
        for row in range(rows)
        for column in range(columns)
    ]


def _read_tile(file: CachedFile, position: int) -> bytes:
    """Read a tile of a pyramid. Raises LostMap if it is damaged or evicted."""
    at = position * _INDEX.size
    if file.path is None:
        data = file.data or b""
        start, size, crc = _INDEX.unpack_from(data, at)
        return data[start : start + size]
    try:
        with file.path.open("rb") as stream:
            start, size, crc = _INDEX.unpack(os.pread(stream.fileno(), _INDEX.size, at))
            png = os.pread(stream.fileno(), size, start)
    except OSError as error:
        raise file.lost_error(error) from error
    except struct.error as error:
        raise file.lost_error(None) from error
    if zlib.crc32(png) != crc:
        raise file.lost_error(None)
    return png


def _decode(png: bytes, source: Source) -> Pixels:
    """Read a tile back: cells, or RGBA."""
    with Image.open(io.BytesIO(png)) as image:
        return np.asarray(image.convert("RGBA" if source.bands else "L"))
