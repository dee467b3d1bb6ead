"""The canonical encoding of stored content, version 1: the same content gives the same bytes on every machine.

A **chunk** is one MessagePack array. Its name is the SHA-256 of these bytes; the database keeps them compressed (zstd),
so another compressor or level changes no name. The first member is the encoding's version (1), the second its kind:

``[1, "features", tail, ids, cells, geometry, sizes, properties]``
    a leaf of vector items in ascending order of (cell, id). ids: array of texts. cells: binary, 8 bytes big-endian per
    item, the z-order cell (below). geometry: array of binaries, ISO WKB, little endian, XY or XYZ, no SRID, no M, no
    negative zero. properties: array of maps with keys in ascending order; integers stay integers and floats stay
    floats (64 bit), no NaN, no infinity, no negative zero. sizes: binary, 4 bytes little endian per item, bytes of its
    properties; tail: binary, 4 bytes little endian, bytes of the member ``properties``: with these two an item is
    found, compared and moved to another leaf without unpacking it.
``[1, "ids", ids, places]``
    a leaf of the table id -> place, ascending by the ids' UTF-8. places: binary, 9 bytes per item: 0 for local or 1 for
    wgs84, then the cell.
``[1, "tiles", codes, hashes]``
    a leaf of a raster, ascending. codes: binary, 8 bytes big-endian per tile, Morton code of (column, row) of the tile,
    column in the lowest bit. hashes: binary, 32 bytes per tile, each the name of a ``tile``.
``[1, "tile", cells]``
    the values of one tile, row by row, row 0 first, bands interleaved, little endian; its size follows from the
    raster's header (256 × 256, less at the upper edges).
``[1, "voxels", depth, code, log_odds, colour]``
    a leaf of an octree's leaves in ascending order of (place, depth), place = code << 3·(16 - depth). depth: uint8.
    code: the difference to the code before (the first one's to 0), uint64. log_odds: float32. colour: uint8 [n, 3] or
    nil. All little-endian binaries.
``[1, "files", paths, sizes, hashes]``
    a leaf of resources, ascending by path. sizes: array of integers. hashes: binary, SHA-256 of the contents, 32 bytes
    each; the contents are blobs.
``[1, "inner", level, keys, hashes, counts, leaves, boxes]``
    children in ascending order. keys: each one's last key. counts: items below. leaves: leaves below. boxes: binary, 4
    float64 little endian per child: x and y of the minimum and of the maximum, (inf, inf, -inf, -inf) if no item below
    has coordinates.
``[1, "document", value]``
    one long member of a collection's document.
``[1, "part", type, header, trees]``
    the root of a part; its hash is the part's hash. type: ``features``, ``grid``, ``voxels``, ``picture`` or
    ``resources``. header: map of the data about the whole part. trees: map of name -> ``[hash, level, count, leaves,
    box]`` or nil.

A part's **tree** is a function of its items alone, independent of the edits that led to them: items are sorted by key,
and an item ends its node if a public hash of its key has low zero bits (``tree.py``). Keys: ``features`` cell (8 bytes
big-endian), then the id's UTF-8; ``ids`` and ``files`` UTF-8; ``tiles`` the code; ``voxels`` place (8 bytes
big-endian), depth. Local and wgs84 features have a tree each.

The **z-order cell** of a feature interleaves the bits of column and row (column lowest) of the middle of its box: local
metres floor(x + 2^24), floor(y + 2^24); wgs84 floor((longitude + 180) · 2^17), floor((latitude + 90) · 2^17): about one
metre each. Without coordinates it is 0.

The **root** of a version is the SHA-256 of ``[1, "version", parts, datum, levels]``: parts = ``[layer, level, name,
hash]`` ascending, datum = ``[latitude, longitude, altitude, heading]`` or nil, levels = ``[name, elevation]``
ascending. A version with templates has them as a sixth member, a map.

A later encoding gets a new number; encoding 1 stays readable in all later releases.
"""

from __future__ import annotations

import hashlib
import re
import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import orjson
import ormsgpack
import shapely
import zstandard
from numpy.typing import NDArray

from app.errors import Damaged, Invalid, Problem
from app.model.features import Features, Properties
from app.model.frame import Datum, Level

ENCODING: Final = 1

OPTIONS: Final = (
    ormsgpack.OPT_SORT_KEYS
    | ormsgpack.OPT_PASSTHROUGH_DATETIME
    | ormsgpack.OPT_PASSTHROUGH_DATACLASS
    | ormsgpack.OPT_PASSTHROUGH_ENUM
    | ormsgpack.OPT_PASSTHROUGH_UUID
)

_SUSPECT: Final = re.compile(rb"\xcb(?:[\x7f\xff][\xf0-\xff]|\x80\x00{7})", re.DOTALL)
"""Pattern of a NaN, an infinity or a negative zero, or by chance of other bytes: then the values are checked."""

_BINARY: Final = re.compile(rb"[\xc4-\xc6]")
"""Pattern of the first byte of a MessagePack binary, or by chance of text (such as č): then JSON decides."""

LEVEL: Final = 1

EMPTY_BOX: Final = (np.inf, np.inf, -np.inf, -np.inf)
"""Box without content: joined with any box it gives that box."""


class _Codecs(threading.local):
    """One compressor per thread: sharing one between threads crashes the interpreter."""

    def __init__(self) -> None:
        self.compressor = zstandard.ZstdCompressor(level=LEVEL, write_checksum=False, write_content_size=True)
        self.decompressor = zstandard.ZstdDecompressor()


_codecs = _Codecs()


def compress(raw: bytes) -> bytes:
    """Compress a chunk into its stored form."""
    return _codecs.compressor.compress(raw)


def decompress(stored: bytes) -> bytes:
    """Decompress a chunk into its canonical bytes. Raises Damaged if the stored bytes are invalid."""
    try:
        return _codecs.decompressor.decompress(stored)
    except zstandard.ZstdError as error:
        raise Damaged(f"a stored chunk cannot be decompressed: {error}") from error


def digest(raw: bytes) -> bytes:
    """Return a chunk's name: 32 bytes."""
    return hashlib.sha256(raw).digest()


def pack(value: Any) -> bytes:
    """Pack values that are already canonical as MessagePack with sorted keys."""
    return ormsgpack.packb(value, option=OPTIONS)


def unpack(raw: bytes) -> list[Any]:
    """Decode a chunk into its members. Raises Damaged if it is invalid or of an encoding that is unsupported."""
    try:
        members = ormsgpack.unpackb(raw)
    except ValueError as error:
        raise Damaged(f"a stored chunk is not valid MessagePack: {error}") from error
    if not isinstance(members, list) or len(members) < 2 or members[0] != ENCODING:
        raise Damaged("a stored chunk has an unsupported encoding: it may have been written by a newer release")
    return members


def array_header(n: int) -> bytes:
    """Return MessagePack's shortest header of an array."""
    if n < 16:
        return bytes((0x90 | n,))
    if n < 65536:
        return b"\xdc" + n.to_bytes(2, "big")
    return b"\xdd" + n.to_bytes(4, "big")


def pack_value(value: Any, location: str) -> bytes:
    """Return the canonical bytes of a JSON-like value. Raises Invalid with the location if it cannot be stored."""
    try:
        packed = ormsgpack.packb(value, default=_plain, option=OPTIONS)
    except (TypeError, ValueError, RecursionError) as error:
        reason = f"the value cannot be stored: {error}"
        raise Invalid(f"{location}: {reason}", [Problem(reason, where=location)]) from error
    if _BINARY.search(packed):
        try:
            orjson.dumps(value, default=_plain)
        except TypeError as error:
            reason = f"the value cannot be stored: {error}"
            raise Invalid(f"{location}: {reason}", [Problem(reason, where=location)]) from error
    if _SUSPECT.search(packed):
        packed = ormsgpack.packb(_normalise(value, location), default=_plain, option=OPTIONS)
    return packed


def pack_properties(ids: Sequence[str], properties: Sequence[Properties]) -> list[bytes]:
    """Return each item's properties as canonical bytes. Raises Invalid with the item that cannot be stored."""
    packb = ormsgpack.packb
    try:
        packed = [packb(p, default=_plain, option=OPTIONS) for p in properties]
    except (TypeError, ValueError, RecursionError):
        return [pack_value(p, i) for i, p in zip(ids, properties, strict=True)]
    content = b"".join(packed)
    if _BINARY.search(content):
        try:
            orjson.dumps(properties, default=_plain)
        except TypeError:
            return [pack_value(p, i) for i, p in zip(ids, properties, strict=True)]
    if _SUSPECT.search(content):
        packed = [pack_value(properties[k], ids[k]) if _SUSPECT.search(one) else one for k, one in enumerate(packed)]
    return packed


def _plain(value: Any) -> Any:
    """Convert JSON-like values that MessagePack does not support: NumPy's scalars and other mappings."""
    if isinstance(value, (np.bool_, np.integer, np.floating)):
        return value.item()
    if isinstance(value, Mapping):
        return dict(value)
    raise TypeError(f"{type(value).__name__} is not a JSON value")


def _normalise(value: Any, location: str) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        if not np.isfinite(value):
            reason = f"a number must be finite, got {value}"
            raise Invalid(f"{location}: {reason}", [Problem(reason, where=location)])
        return value + 0.0
    if isinstance(value, Mapping):
        return {key: _normalise(member, location) for key, member in value.items()}
    if isinstance(value, (list, tuple)):
        return [_normalise(member, location) for member in value]
    return value


@dataclass(frozen=True, slots=True)
class Columns:
    """Canonical vector items in their original order. boxes: float64 [n, 4]; cells: uint64 [n]; local: bool [n]."""

    ids: Sequence[str]
    wkb: NDArray[np.object_]
    packed: list[bytes]
    local: NDArray[np.bool_]
    boxes: NDArray[np.float64]
    cells: NDArray[np.uint64]

    def digest(self, document: bytes) -> str:
        """Hash everything in order: equal only for the same items in the same order."""
        h = hashlib.sha256(document)
        h.update(pack(list(self.ids)))
        h.update(np.packbits(self.local).tobytes())
        h.update(pack([len(p) for p in self.packed]))
        for one in (self.wkb, self.packed):
            h.update(b"".join(one))
        return h.hexdigest()


def columns(features: Features) -> Columns:
    """Convert features into canonical columns."""
    geometry = _without_negative_zero(features.geometry)
    boxes = bounds(geometry)
    return Columns(
        features.ids,
        to_wkb(geometry),
        pack_properties(features.ids, features.properties),
        features.local,
        boxes,
        z_cells(boxes, features.local),
    )


def to_wkb(geometry: NDArray[np.object_]) -> NDArray[np.object_]:
    """Write ISO WKB, little endian, XY or XYZ, independent of the machine and the version of GEOS."""
    if not len(geometry):
        return np.empty(0, object)
    return np.asarray(
        shapely.to_wkb(geometry, output_dimension=3, byte_order=1, include_srid=False, flavor="iso"), object
    )


def from_wkb(wkb: Sequence[bytes] | NDArray[np.object_]) -> NDArray[np.object_]:
    """Read geometries from WKB, all at once."""
    column = np.empty(len(wkb), object)
    column[:] = wkb
    return np.asarray(shapely.from_wkb(column), object) if len(column) else column


def wkb_bounds(wkb: Sequence[bytes]) -> NDArray[np.float64]:
    """Return the boxes of geometries in canonical WKB, as ``bounds`` does; most shapes need no GEOS for it."""
    out = np.empty((len(wkb), 4))
    lengths = np.fromiter(map(len, wkb), np.intp, len(wkb))
    rest = np.ones(len(wkb), bool)
    for length, kind, first in ((21, 1, 5), (41, 2, 9)):
        indices = np.flatnonzero(lengths == length)
        if not len(indices):
            continue
        rows = np.frombuffer(b"".join([wkb[k] for k in indices.tolist()]), np.uint8).reshape(len(indices), length)
        plain = np.ascontiguousarray(rows[:, 1:5]).view("<u4")[:, 0] == kind
        rows, indices = rows[plain], indices[plain]
        xy = np.ascontiguousarray(rows[:, first:]).view("<f8").reshape(len(indices), -1, 2)
        out[indices, :2] = xy.min(axis=1)
        out[indices, 2:] = xy.max(axis=1)
        rest[indices] = False
    others = np.flatnonzero(rest)
    if len(others):
        out[others] = bounds(from_wkb([wkb[k] for k in others.tolist()]))
    nowhere = np.isnan(out).any(axis=1)
    if nowhere.any():
        out[nowhere] = EMPTY_BOX
    return out


def bounds(geometry: NDArray[np.object_]) -> NDArray[np.float64]:
    """Return boxes, float64 [n, 4]; NOWHERE for geometries without coordinates."""
    out = np.asarray(shapely.bounds(geometry), np.float64).reshape(len(geometry), 4)
    nowhere = np.isnan(out).any(axis=1)
    if nowhere.any():
        out[nowhere] = EMPTY_BOX
    return out


def _without_negative_zero(geometry: NDArray[np.object_]) -> NDArray[np.object_]:
    if not len(geometry):
        return geometry
    coordinates, owner = shapely.get_coordinates(geometry, include_z=True, return_index=True)
    negative = (coordinates == 0.0) & np.signbit(coordinates)
    if not negative.any():
        return geometry
    out = geometry.copy()
    for k in np.unique(owner[negative.any(axis=1)]):
        out[k] = shapely.transform(out[k], lambda c: c + 0.0, include_z=bool(shapely.has_z(out[k])))
    return out


def z_cells(boxes: NDArray[np.float64], local: NDArray[np.bool_]) -> NDArray[np.uint64]:
    """Return the z-order cell of each box: uint64 [n]."""
    placed = np.isfinite(boxes).all(axis=1)
    middle = np.zeros((len(boxes), 2))
    middle[placed] = (boxes[placed, :2] + boxes[placed, 2:]) / 2.0
    scale = np.where(local, 1.0, float(2**17))[:, None]
    offset = np.where(local[:, None], float(2**24), np.array([180.0, 90.0]))
    grid = np.floor((middle + offset) * scale).astype(np.uint64)
    cells = interleave(grid[:, 0], grid[:, 1])
    cells[~placed] = 0
    return cells


def interleave(x: NDArray[np.uint64], y: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return the Morton code of two numbers below 2^32, x in the lowest bit."""
    return _spread(x) | (_spread(y) << np.uint64(1))


_SPREAD: Final = (
    (16, 0x0000FFFF0000FFFF),
    (8, 0x00FF00FF00FF00FF),
    (4, 0x0F0F0F0F0F0F0F0F),
    (2, 0x3333333333333333),
    (1, 0x5555555555555555),
)


def _spread(v: NDArray[np.uint64]) -> NDArray[np.uint64]:
    out = v.astype(np.uint64)
    for shift, mask in _SPREAD:
        out = (out | (out << np.uint64(shift))) & np.uint64(mask)
    return out


def root_hash(
    parts: Iterable[tuple[str, str, str, str]],
    datum: Datum | None,
    levels: Iterable[Level],
    templates: Mapping[str, Any] | None = None,
) -> str:
    """Compute a version's root (hex) from (layer, level, name, hash in hex) of its parts, its datum and its levels.

    templates: result of ``Templates.as_dict``; if empty, it is not part of the hash.
    """
    place = None if datum is None else [datum.latitude, datum.longitude, datum.altitude, datum.heading]
    storeys = sorted([level.name, level.elevation] for level in levels)
    named = [[layer, level, name, bytes.fromhex(h)] for layer, level, name, h in sorted(parts)]
    more = [templates] if templates else []
    return digest(pack([ENCODING, "version", named, place, storeys, *more])).hex()
