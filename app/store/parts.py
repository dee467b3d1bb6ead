"""Parts as chunk trees: from values to chunks and back, edits by id, box queries."""

from __future__ import annotations

import gc
import hashlib
import math
import struct
import threading
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Collection, Container, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Any, Final, Literal, NamedTuple, overload

import numpy as np
import ormsgpack
import shapely
from numpy.typing import NDArray

from app.errors import Damaged, Invalid, MissingDatum, NotFound
from app.model.features import Features
from app.model.geodesy import LocalFrame, crs_bounds
from app.model.grid import OccupancyGrid
from app.model.imagery import GeoImage
from app.model.layers import Part, Resources
from app.model.voxels import VoxelMap
from app.store import tree
from app.store.encode import (
    EMPTY_BOX,
    ENCODING,
    Columns,
    array_header,
    bounds,
    columns,
    from_wkb,
    interleave,
    pack,
    pack_value,
    unpack,
    wkb_bounds,
)
from app.store.tree import ChunkStage, Node
from app.store.values import Bounds, Box

PartType = Literal["features", "grid", "voxels", "picture", "resources"]

TILE: Final = 256
INLINE: Final = 2048
"""Bytes up to which a member of a document stands in the part's chunk."""

BATCH: Final = 512
"""Leaves that are read at once when a whole part is loaded: enough for few queries, and bounded memory."""

TILE_BATCH: Final = 128

VOXEL_KEY: Final = 9
"""Bytes of a voxel's key: its place, its depth."""

_FEATURES_HEAD: Final = array_header(8) + pack(ENCODING) + pack("features") + b"\xc4\x04"
"""A leaf of vector items up to its tail's four bytes."""

FetchBlobs = Callable[[Sequence[str]], Mapping[str, bytes]]


@dataclass(frozen=True, slots=True)
class PartRoot:
    """A part's decoded root chunk."""

    type: PartType
    header: dict[str, Any]
    trees: dict[str, Node | None]


@dataclass(frozen=True, slots=True)
class EncodedPart:
    """A part that became chunks. digest: of the canonical upload, empty where it is not worth one."""

    hash: bytes
    count: int
    bounds: Bounds
    digest: str = ""
    blobs: Mapping[str, bytes] = field(default_factory=dict)


class Item(NamedTuple):
    """A stored feature: 0 for local or 1 for wgs84, its WKB, its packed properties. Equal items are equal bytes."""

    anchor: int
    wkb: bytes
    packed: bytes

    @property
    def properties(self) -> dict[str, Any]:
        """The properties, unpacked."""
        members: dict[str, Any] = ormsgpack.unpackb(self.packed)
        return members


# --- leaves of vector parts ---


class FeatureLeaf:
    """Leaves of vector items: key = cell, id; item = (WKB, packed properties)."""

    bits = 6

    def decode(self, raw: bytes) -> tuple[list[bytes], list[tuple[bytes, bytes]]]:
        """A leaf's keys and items."""
        ids, cells, wkb, packed = split_leaf(raw)
        keys = [cells[8 * k : 8 * k + 8] + i.encode() for k, i in enumerate(ids)]
        return keys, list(zip(wkb, packed, strict=True))

    def encode(self, keys: Sequence[bytes], items: Sequence[tuple[bytes, bytes]]) -> bytes:
        """A leaf's bytes."""
        ids = [k[8:].decode() for k in keys]
        cells = b"".join([k[:8] for k in keys])
        return encode_leaf(ids, cells, [w for w, _ in items], [p for _, p in items])

    def boxes(self, items: Sequence[tuple[bytes, bytes]]) -> NDArray[np.float64]:
        """The items' boxes."""
        return wkb_bounds([w for w, _ in items])


class IdLeaf:
    """Leaves of the table id -> place: key = the id's UTF-8; item = anchor and cell, 9 bytes."""

    bits = 8

    def decode(self, raw: bytes) -> tuple[list[bytes], list[bytes]]:
        """A leaf's keys and items."""
        ids, places = _members(raw, "ids")
        return [i.encode() for i in ids], [places[9 * k : 9 * k + 9] for k in range(len(ids))]

    def encode(self, keys: Sequence[bytes], items: Sequence[bytes]) -> bytes:
        """A leaf's bytes."""
        return pack([ENCODING, "ids", [k.decode() for k in keys], b"".join(items)])

    def boxes(self, items: Sequence[bytes]) -> None:
        """Ids have no place."""


def encode_leaf(ids: Sequence[str], cells: bytes, wkb: Sequence[bytes], packed: Sequence[bytes]) -> bytes:
    """A leaf of vector items whose properties are packed already: what MessagePack makes of all of it at once."""
    sizes = [len(p) for p in packed]
    header = array_header(len(packed))
    return b"".join(
        [
            _FEATURES_HEAD,
            (len(header) + sum(sizes)).to_bytes(4, "little"),
            ormsgpack.packb(ids),
            ormsgpack.packb(cells),
            ormsgpack.packb(wkb),
            ormsgpack.packb(np.array(sizes, "<u4").tobytes()),
            header,
            *packed,
        ]
    )


def split_leaf(raw: bytes) -> tuple[list[str], bytes, list[bytes], list[bytes]]:
    """A leaf of vector items: ids, cells, WKB, and properties that stay packed."""
    start = len(_FEATURES_HEAD)
    if not raw.startswith(_FEATURES_HEAD):
        _members(raw, "features")
        raise Damaged("a stored leaf of vector items has another form than its encoding says")
    end = len(raw) - int.from_bytes(raw[start : start + 4], "little")
    # The array without its last member.
    _, _, _, ids, cells, wkb, sizes = ormsgpack.unpackb(array_header(7) + raw[1:end])
    ends = np.cumsum(np.frombuffer(sizes, "<u4")).tolist()
    first = end + len(array_header(len(ids)))
    packed = [raw[first + a : first + b] for a, b in zip([0, *ends], ends, strict=False)]
    return ids, cells, wkb, packed


def _members(raw: bytes, kind: str) -> list[Any]:
    members = unpack(raw)
    if members[1] != kind:
        raise Damaged(f"a stored chunk is {members[1]!r} where {kind!r} belongs")
    return members[2:]


# --- part roots ---


def read_root(draft: ChunkStage, name: bytes) -> PartRoot:
    """A part's root chunk."""
    kind, header, trees = _members(draft.read(name), "part")
    return PartRoot(kind, header, {t: Node.from_list(n) for t, n in trees.items()})


def put_root(draft: ChunkStage, kind: PartType, header: Mapping[str, Any], trees: Mapping[str, Node | None]) -> bytes:
    """Keep a part's root chunk; its hash is the part's."""
    listed = {t: n.as_list() if n else None for t, n in trees.items()}
    return draft.put(pack([ENCODING, "part", kind, dict(header), listed]))


def put_document(draft: ChunkStage, document: Mapping[str, Any]) -> list[list[Any]]:
    """A document's members for the header, in order: [key, 0, value], or [key, 1, hash] of a chunk of its own."""
    out: list[list[Any]] = []
    for key in sorted(document):
        packed = pack_value(document[key], f"document.{key}")
        if len(packed) <= INLINE:
            out.append([key, 0, ormsgpack.unpackb(packed)])
        else:
            out.append([key, 1, draft.put(array_header(3) + pack(ENCODING) + pack("document") + packed)])
    return out


def document_chunks(root: PartRoot) -> list[bytes]:
    """The chunks of a document's large members."""
    return [value for _, inline, value in root.header.get("document", ()) if inline]


def read_document(draft: ChunkStage, root: PartRoot) -> dict[str, Any]:
    """A collection's document."""
    raws = draft.read_many(document_chunks(root))
    return {
        key: _members(raws[value], "document")[0] if chunk else value
        for key, chunk, value in root.header.get("document", ())
    }


# --- values -> chunks ---


def compose(draft: ChunkStage, part: Part, base: PartRoot | None, base_digest: str) -> EncodedPart | None:
    """A part as chunks in the draft; None where its canonical upload is the very one that the base was made of."""
    if isinstance(part, Features):
        return _compose_features(draft, part, base_digest)
    if isinstance(part, OccupancyGrid):
        return _compose_grid(draft, part, base)
    if isinstance(part, VoxelMap):
        return _compose_voxels(draft, part)
    if isinstance(part, GeoImage):
        return _compose_picture(draft, part, base)
    return _compose_resources(draft, part)


def _compose_features(draft: ChunkStage, part: Features, base_digest: str) -> EncodedPart | None:
    document = put_document(draft, part.document)
    table = columns(part)
    digest = table.digest(pack(document))
    if base_digest and digest == base_digest:
        return None
    trees: dict[str, Node | None] = {}
    for name, mask in (("local", table.local), ("wgs84", ~table.local)):
        trees[name] = _build_features(draft, table, np.flatnonzero(mask))
    trees["ids"] = _build_ids(draft, table)
    root = put_root(draft, "features", {"document": document}, trees)
    return EncodedPart(root, len(part), feature_bounds(draft, trees, part), digest)


def _build_features(draft: ChunkStage, table: Columns, index: NDArray[np.intp]) -> Node | None:
    if not len(index):
        return None
    cells = table.cells[index]
    # Nearly sorted by NumPy, so that Python's sort has little left to do.
    index = index[np.argsort(cells, kind="stable")]
    cell_bytes = table.cells[index].astype(">u8").tobytes()
    ids = table.ids
    keys = [cell_bytes[8 * k : 8 * k + 8] + ids[i].encode() for k, i in enumerate(index.tolist())]
    order = sorted(range(len(keys)), key=keys.__getitem__)
    index = index[order]
    keys = [keys[k] for k in order]
    places = index.tolist()
    sorted_ids = [ids[i] for i in places]
    sorted_packed = [table.packed[i] for i in places]
    wkb = table.wkb[index].tolist()
    cell_bytes = table.cells[index].astype(">u8").tobytes()
    return tree.build(
        draft,
        keys,
        FeatureLeaf.bits,
        lambda s, e: encode_leaf(sorted_ids[s:e], cell_bytes[8 * s : 8 * e], wkb[s:e], sorted_packed[s:e]),
        table.boxes[index],
    )


def _build_ids(draft: ChunkStage, table: Columns) -> Node | None:
    places = _places(table)
    order = sorted(range(len(table.ids)), key=table.ids.__getitem__)
    ids = [table.ids[k] for k in order]
    flat = [places[k] for k in order]
    return tree.build(
        draft,
        [i.encode() for i in ids],
        IdLeaf.bits,
        lambda s, e: pack([ENCODING, "ids", ids[s:e], b"".join(flat[s:e])]),
    )


def _places(table: Columns) -> list[bytes]:
    cells = table.cells.astype(">u8").tobytes()
    return [(b"\x00" if local else b"\x01") + cells[8 * k : 8 * k + 8] for k, local in enumerate(table.local.tolist())]


def _compose_grid(draft: ChunkStage, part: OccupancyGrid, base: PartRoot | None) -> EncodedPart:
    header = {
        "height": part.height,
        "width": part.width,
        "resolution": float(part.resolution),
        "origin": [float(v) + 0.0 for v in part.origin],
        "mode": part.mode,
        "occupied_thresh": float(part.occupied_thresh) + 0.0,
        "free_thresh": float(part.free_thresh) + 0.0,
        "negate": bool(part.negate),
        "properties": ormsgpack.unpackb(pack_value(part.properties, "properties")),
    }
    tiles = _build_tiles(draft, part.cells, _tile_names(draft, base))
    name = put_root(draft, "grid", header, {"tiles": tiles})
    return EncodedPart(name, int(part.cells.size), {"local": _bounding_box(part.corners()), "wgs84": None})


def _compose_picture(draft: ChunkStage, part: GeoImage, base: PartRoot | None) -> EncodedPart:
    pixels = part.pixels
    header = {
        "height": pixels.shape[0],
        "width": pixels.shape[1],
        "bands": pixels.shape[2],
        "dtype": _dtype_name(pixels.dtype),
        "transform": [float(v) + 0.0 for v in part.transform],
        "crs": part.crs,
        "properties": ormsgpack.unpackb(pack_value(part.properties, "properties")),
    }
    tiles = _build_tiles(draft, pixels, _tile_names(draft, base))
    name = put_root(draft, "picture", header, {"tiles": tiles})
    return EncodedPart(name, int(pixels.shape[0] * pixels.shape[1]), picture_bounds(header))


def _dtype_name(dtype: np.dtype[Any]) -> str:
    if dtype.kind not in "buif" or dtype.itemsize > 8:
        raise Invalid(f"pixels of type {dtype} cannot be stored; use integers or floats of up to 64 bit")
    return f"{dtype.kind}{dtype.itemsize}"


def _build_tiles(draft: ChunkStage, cells: NDArray[Any], existing_names: Container[bytes]) -> Node | None:
    little = cells.dtype.newbyteorder("<")
    rows, cols = tile_counts(cells.shape[0], cells.shape[1])
    code = interleave(
        np.tile(np.arange(cols, dtype=np.uint64), rows), np.repeat(np.arange(rows, dtype=np.uint64), cols)
    )
    order = np.argsort(code)
    names = []
    for k in order.tolist():
        r, c = divmod(k, cols)
        block = cells[r * TILE : (r + 1) * TILE, c * TILE : (c + 1) * TILE]
        raw = pack([ENCODING, "tile", np.ascontiguousarray(block, little).tobytes()])
        names.append(draft.put_compressed(raw, existing_names))
    codes = code[order].astype(">u8").tobytes()
    keys = [codes[8 * k : 8 * k + 8] for k in range(len(names))]
    return tree.build(
        draft, keys, 6, lambda s, e: pack([ENCODING, "tiles", codes[8 * s : 8 * e], b"".join(names[s:e])])
    )


def tile_counts(height: int, width: int) -> tuple[int, int]:
    """(rows, columns) of tiles."""
    return -(-height // TILE), -(-width // TILE)


def tile_leaf(raw: bytes) -> list[tuple[int, bytes]]:
    """(Morton code, tile's name) of a leaf of a raster."""
    codes, names = _members(raw, "tiles")
    return [
        (int.from_bytes(codes[8 * k : 8 * k + 8], "big"), names[32 * k : 32 * k + 32]) for k in range(len(codes) // 8)
    ]


def _tile_names(draft: ChunkStage, base: PartRoot | None) -> set[bytes]:
    """The names of a raster's tiles."""
    root = base.trees.get("tiles") if base else None
    if root is None:
        return set()
    (leaves,) = tree.leaves(draft, [root])
    return {name for raw in draft.read_many(leaves).values() for _, name in tile_leaf(raw)}


def _compose_voxels(draft: ChunkStage, part: VoxelMap) -> EncodedPart:
    depth, code = part.depth, part.code
    log_odds = (part.log_odds + np.float32(0.0)).astype("<f4")
    colour = None if part.colour is None else np.ascontiguousarray(part.colour)
    flat = np.empty((len(code), VOXEL_KEY), np.uint8)
    flat[:, :8] = part.place.astype(">u8").view(np.uint8).reshape(-1, 8)
    flat[:, 8] = depth

    def encode(s: int, e: int) -> bytes:
        steps = np.diff(code[s:e], prepend=np.uint64(0)).astype("<u8")
        shades = None if colour is None else colour[s:e].tobytes()
        return pack([ENCODING, "voxels", depth[s:e].tobytes(), steps.tobytes(), log_odds[s:e].tobytes(), shades])

    header = {
        "resolution": float(part.resolution),
        "binary": bool(part.binary),
        "colour": part.colour is not None,
        "properties": ormsgpack.unpackb(pack_value(part.properties, "properties")),
    }
    leaves = tree.build(draft, _FixedWidthKeys(flat.tobytes(), VOXEL_KEY), 12, encode)
    name = put_root(draft, "voxels", header, {"voxels": leaves})
    return EncodedPart(name, len(code), {"local": _voxel_box(part), "wgs84": None})


class _FixedWidthKeys(Sequence[bytes]):
    """Keys of one length, cut from one text when they are asked for: millions of objects would take their time."""

    def __init__(self, flat: bytes, width: int) -> None:
        self._flat, self._width = flat, width

    def __len__(self) -> int:
        return len(self._flat) // self._width

    @overload
    def __getitem__(self, k: int) -> bytes: ...
    @overload
    def __getitem__(self, k: slice) -> Sequence[bytes]: ...
    def __getitem__(self, k: int | slice) -> bytes | Sequence[bytes]:
        if isinstance(k, slice):
            return [self[i] for i in range(*k.indices(len(self)))]
        i = range(len(self))[k] * self._width
        return self._flat[i : i + self._width]

    def __iter__(self) -> Iterator[bytes]:
        return map(itemgetter(0), struct.iter_unpack(f"{self._width}s", self._flat))


def _voxel_box(part: VoxelMap) -> Box | None:
    if not len(part):
        return None
    r = float(part.resolution)
    (x0, x1), (y0, y1) = ((float(low.min()) * r, float(high.max()) * r) for low, high in map(part.axis, (0, 1)))
    return (x0, y0, x1, y1)


def _compose_resources(draft: ChunkStage, part: Resources) -> EncodedPart:
    paths = sorted(part.files)
    contents = [bytes(part.files[p]) for p in paths]
    hashes = [hashlib.sha256(data).digest() for data in contents]

    def encode(s: int, e: int) -> bytes:
        return pack([ENCODING, "files", paths[s:e], [len(c) for c in contents[s:e]], b"".join(hashes[s:e])])

    files = tree.build(draft, [p.encode() for p in paths], 6, encode)
    name = put_root(draft, "resources", {}, {"files": files})
    blobs = {h.hex(): data for h, data in zip(hashes, contents, strict=True)}
    return EncodedPart(name, len(paths), {"local": None, "wgs84": None}, blobs=blobs)


def file_leaf(raw: bytes) -> list[tuple[str, int, str]]:
    """(path, size, SHA-256 in hex) of a leaf of resources."""
    paths, sizes, hashes = _members(raw, "files")
    return [(p, sizes[k], hashes[32 * k : 32 * k + 32].hex()) for k, p in enumerate(paths)]


# --- bounds ---


def _bounding_box(points: NDArray[np.float64]) -> Box:
    x0, y0 = points.min(axis=0).tolist()
    x1, y1 = points.max(axis=0).tolist()
    return (x0, y0, x1, y1)


def picture_bounds(header: Mapping[str, Any]) -> Bounds:
    """Where a picture lies."""
    a, b, c, d, e, f = header["transform"]
    w, h = header["width"], header["height"]
    corners = np.array([[a * u + b * v + c, d * u + e * v + f] for u, v in ((0, 0), (w, 0), (w, h), (0, h))])
    if header["crs"] == "local":
        return {"local": _bounding_box(corners), "wgs84": None}
    return {"local": None, "wgs84": crs_bounds(header["crs"], corners)}


def feature_bounds(draft: ChunkStage, trees: Mapping[str, Node | None], part: Features | None = None) -> Bounds:
    """Where a collection's items lie; the box of wgs84 items crosses the antimeridian where that makes it smaller."""
    local, wgs84 = trees["local"], trees["wgs84"]
    out: dict[Literal["local", "wgs84"], Box | None] = {
        "local": local.box if local and local.box != EMPTY_BOX else None,
        "wgs84": wgs84.box if wgs84 and wgs84.box != EMPTY_BOX else None,
    }
    box = out["wgs84"]
    if box is not None and box[2] - box[0] > 180.0 and wgs84 is not None:
        if part is not None:
            geometry = part.geometry[~part.local]
        else:
            (names,) = tree.leaves(draft, [wgs84])
            wkb = [w for raw in draft.read_many(names).values() for w in split_leaf(raw)[2]]
            geometry = from_wkb(wkb)
        out["wgs84"] = crossing_box(shapely.get_coordinates(geometry))
    return out


def crossing_box(points: NDArray[np.float64]) -> Box:
    """The box in degrees around (longitude, latitude) points that leaves out the widest gap of longitudes."""
    longitude = np.unique(points[:, 0])
    south, north = float(points[:, 1].min()), float(points[:, 1].max())
    gaps = np.diff(longitude, append=longitude[:1] + 360.0)
    k = int(gaps.argmax())
    west, east = float(longitude[(k + 1) % len(longitude)]), float(longitude[k])
    return (west, south, east, north)


# --- edits by id ---


def edit_features(
    draft: ChunkStage, root: PartRoot, put: Features | None, deleted: Collection[str], label: str
) -> EncodedPart:
    """A collection with features put (added, or replaced by id) and others deleted; NotFound names unknown ids."""
    table = columns(put) if put is not None and len(put) else None
    touched = sorted({*(table.ids if table else ()), *deleted})
    places = find_places(draft, root, touched)
    missing = [i for i in deleted if i not in places]
    if missing:
        raise NotFound(f"{label} has no feature {', '.join(map(repr, missing[:10]))}")
    puts: tuple[dict[bytes, Any], dict[bytes, Any]] = ({}, {})
    removals: tuple[set[bytes], set[bytes]] = (set(), set())
    new_places: dict[bytes, bytes] = {}
    for i in touched:
        if i in places:
            removals[places[i][0]].add(places[i][1:] + i.encode())
    if table:
        for i, place, wkb, packed in zip(table.ids, _places(table), table.wkb, table.packed, strict=True):
            key = place[1:] + i.encode()
            puts[place[0]][key] = (wkb, packed)
            removals[place[0]].discard(key)
            if places.get(i) != place:
                new_places[i.encode()] = place
    leaf = FeatureLeaf()
    trees = {
        "local": tree.edit(draft, leaf, root.trees["local"], puts[0], removals[0]),
        "wgs84": tree.edit(draft, leaf, root.trees["wgs84"], puts[1], removals[1]),
        "ids": tree.edit(draft, IdLeaf(), root.trees["ids"], new_places, {i.encode() for i in deleted}),
    }
    header = dict(root.header)
    if put is not None and put.document:
        joined = {row[0]: row for row in [*header.get("document", ()), *put_document(draft, put.document)]}
        header["document"] = [joined[key] for key in sorted(joined)]
    count = trees["ids"].count if trees["ids"] else 0
    return EncodedPart(put_root(draft, "features", header, trees), count, feature_bounds(draft, trees))


def empty_features(draft: ChunkStage) -> bytes:
    """An empty collection's root."""
    return put_root(draft, "features", {"document": []}, {"local": None, "wgs84": None, "ids": None})


def find_places(draft: ChunkStage, root: PartRoot, ids: Sequence[str]) -> dict[str, bytes]:
    """Sorted ids -> anchor and cell (9 bytes), of those that exist."""
    keys = [i.encode() for i in ids]
    out: dict[str, bytes] = {}
    for name in tree.paths(draft, root.trees["ids"], keys):
        # Code points sort like their UTF-8.
        member_ids, places = _members(draft.read(name), "ids")
        for i in ids[bisect_left(ids, member_ids[0]) : bisect_right(ids, member_ids[-1])]:
            k = bisect_left(member_ids, i)
            if member_ids[k] == i:
                out[i] = places[9 * k : 9 * k + 9]
    return out


def items_by_id(draft: ChunkStage, root: PartRoot, ids: Collection[str]) -> dict[str, Item]:
    """The stored items with these ids, as far as they exist."""
    places = find_places(draft, root, sorted(set(ids)))
    out: dict[str, Item] = {}
    for anchor, name in enumerate(("local", "wgs84")):
        keys = sorted(p[1:] + i.encode() for i, p in places.items() if p[0] == anchor)
        leaves = tree.paths(draft, root.trees[name], keys)
        out.update((i, item) for i, item in leaf_items(draft, leaves, anchor) if i in places)
    return out


def leaf_items(draft: ChunkStage, names: Sequence[bytes], anchor: int) -> Iterator[tuple[str, Item]]:
    """(id, item) of leaves of vector items."""
    for start in range(0, len(names), BATCH):
        some = names[start : start + BATCH]
        raws = draft.stream(some)
        for name in some:
            ids, _, wkb, packed = split_leaf(raws[name])
            for i, w, p in zip(ids, wkb, packed, strict=True):
                yield i, Item(anchor, w, p)


def features_from_items(items: Mapping[str, Item], document: Mapping[str, Any]) -> Features:
    """Stored items as a collection, in the order of their ids."""
    ids = sorted(items)
    rows = [items[i] for i in ids]
    return unchecked_features(
        tuple(ids),
        from_wkb([r.wkb for r in rows]),
        tuple(r.properties for r in rows),
        np.array([r.anchor == 0 for r in rows], bool),
        document,
    )


def unchecked_features(
    ids: tuple[str, ...],
    geometry: NDArray[np.object_],
    properties: tuple[Mapping[str, Any], ...],
    local: NDArray[np.bool_],
    document: Mapping[str, Any],
) -> Features:
    """A collection without the checks: its columns were checked before they were stored, and their hashes agree."""
    features = object.__new__(Features)
    geometry.flags.writeable = False
    local.flags.writeable = False
    for name, value in zip(Features.__slots__, (ids, geometry, properties, local, document), strict=True):
        object.__setattr__(features, name, value)
    return features


# --- box queries ---


def features_in_box(draft: ChunkStage, root: PartRoot, box: Box, crs: str, frame: LocalFrame | None) -> dict[str, Item]:
    """Items whose box meets ``box``, given in local metres or in degrees (west > east crosses the antimeridian)."""
    out: dict[str, Item] = {}
    for anchor, name in enumerate(("local", "wgs84")):
        node = root.trees[name]
        if node is None or node.box == EMPTY_BOX:
            continue
        same = crs == name
        if not same and frame is None:
            raise MissingDatum(
                f"the environment has no datum, so its {name} items cannot be found by a box in {crs} coordinates: "
                f"ask with crs={name}, or set a datum"
            )
        boxes = split_box(box) if crs == "wgs84" else [box]
        coarse = boxes if same else [c for b in boxes for c in _other_boxes(b, crs, frame)]
        leaves = tree.select(draft, node, lambda have, coarse=coarse: _meets(have, coarse))  # type: ignore[misc]
        candidates = dict(leaf_items(draft, leaves, anchor))
        ids = list(candidates)
        wkb = [candidates[i].wkb for i in ids]
        if same or frame is None:
            have = wkb_bounds(wkb)
        else:
            geometry = from_wkb(wkb)
            have = bounds(
                frame.geometries_to_local(geometry) if crs == "local" else frame.geometries_to_wgs84(geometry)
            )
        hits = np.flatnonzero(_meets(have, boxes)) if ids else np.empty(0, np.intp)
        out.update((ids[k], candidates[ids[k]]) for k in hits.tolist())
    return out


def _meets(have: NDArray[np.float64], boxes: Sequence[Box]) -> NDArray[np.bool_]:
    out = np.zeros(len(have), bool)
    for x0, y0, x1, y1 in boxes:
        out |= (have[:, 0] <= x1) & (have[:, 2] >= x0) & (have[:, 1] <= y1) & (have[:, 3] >= y0)
    return out


def split_box(box: Box) -> list[Box]:
    """A box in degrees as one or two that do not cross the antimeridian."""
    west, south, east, north = box
    if west <= east:
        return [box]
    return [(west, south, 180.0, north), (-180.0, south, east, north)]


EDGE_POINTS: Final = 9
"""Points on each side of a box when it goes from one frame to the other, since its sides become curves."""


def ring(box: Box) -> NDArray[np.float64]:
    """Points around a box: float64 [n, 2]."""
    x0, y0, x1, y1 = box
    t = np.linspace(0.0, 1.0, EDGE_POINTS)
    xs, ys = x0 + (x1 - x0) * t, y0 + (y1 - y0) * t
    sides = [np.column_stack(np.broadcast_arrays(*side)) for side in ((xs, y0), (x1, ys), (xs, y1), (x0, ys))]
    return np.concatenate(sides)


def _other_boxes(box: Box, crs: str, frame: LocalFrame | None) -> list[Box]:
    assert frame is not None
    if crs == "wgs84":
        points = frame.to_local(ring(box))
        if not np.isfinite(points).all():
            return [(-math.inf, -math.inf, math.inf, math.inf)]
        return [_wider(_bounding_box(points))]
    return split_box(_wider(local_box_to_wgs84(box, frame)))


def _wider(box: Box) -> Box:
    """A little more on each side, for the bulge of a curve between the points."""
    x0, y0, x1, y1 = box
    dx = abs(x1 - x0) * 0.01
    dy = abs(y1 - y0) * 0.01
    return (x0 - dx, y0 - dy, x1 + dx, y1 + dy)


def local_box_to_wgs84(box: Box, frame: LocalFrame) -> Box:
    """The box in degrees around a box in local metres; west > east where it crosses the antimeridian."""
    points = frame.to_wgs84(ring(box))
    return unwrapped_box(points, frame.datum.longitude)


def unwrapped_box(points: NDArray[np.float64], around: float) -> Box:
    """The box of (longitude, latitude) points whose longitudes lie within 180 degrees of a given one."""
    longitude = (points[:, 0] - around + 180.0) % 360.0 - 180.0 + around
    west, east = float(longitude.min()), float(longitude.max())
    return (wrap(west), float(points[:, 1].min()), wrap(east), float(points[:, 1].max()))


def wrap(longitude: float) -> float:
    """A longitude in [-180, 180]."""
    return longitude if -180.0 <= longitude <= 180.0 else (longitude + 180.0) % 360.0 - 180.0


# --- chunks -> values ---

_gc_lock = threading.Lock()
_gc_users = 0
_gc_was_on = False


@contextmanager
def gc_paused() -> Iterator[None]:
    """Without Python's cycle collector, for work that makes very many objects and no cycles.

    It would look at all of them again and again (a whole layer loads two to three times slower with it). At the end
    they are counted among the old objects, or the next collection of the young ones would take as long as it saved;
    freezing and unfreezing does that without a look at any of them.
    """
    global _gc_users, _gc_was_on  # noqa: PLW0603 - one switch for the interpreter
    with _gc_lock:
        if _gc_users == 0:
            _gc_was_on = gc.isenabled()
            gc.disable()
        _gc_users += 1
    try:
        yield
    finally:
        with _gc_lock:
            _gc_users -= 1
            if _gc_users == 0 and _gc_was_on:
                if gc.get_freeze_count() == 0:
                    gc.freeze()
                    gc.unfreeze()
                gc.enable()


@dataclass(slots=True)
class _Columns:
    ids: list[str] = field(default_factory=list)
    wkb: list[bytes] = field(default_factory=list)
    properties: list[Mapping[str, Any]] = field(default_factory=list)
    local: int = 0


def load(draft: ChunkStage, root_hashes: Mapping[Any, bytes], fetch: FetchBlobs) -> dict[Any, Part]:
    """Parts by their hashes, with few queries for all of them together."""
    draft.read_many(list(root_hashes.values()))
    roots = {key: read_root(draft, name) for key, name in root_hashes.items()}
    with gc_paused():
        out: dict[Any, Part] = dict(_load_collections(draft, {k: r for k, r in roots.items() if r.type == "features"}))
    for key, root in roots.items():
        if root.type == "grid":
            out[key] = _load_grid(draft, root)
        elif root.type == "picture":
            out[key] = _load_picture(draft, root)
        elif root.type == "voxels":
            out[key] = _load_voxels(draft, root)
        elif root.type == "resources":
            out[key] = _load_resources(draft, root, fetch)
    return {key: out[key] for key in root_hashes}


def _load_collections(draft: ChunkStage, roots: Mapping[Any, PartRoot]) -> Iterator[tuple[Any, Features]]:
    trees = [(key, name, r.trees[name]) for key, r in roots.items() for name in ("local", "wgs84")]
    present = [(key, name, node) for key, name, node in trees if node is not None]
    documents = [name for r in roots.values() for name in document_chunks(r)]
    all_leaves = tree.leaves(draft, [node for _, _, node in present])
    todo = [(key, name, leaf) for (key, name, _), leaves in zip(present, all_leaves, strict=True) for leaf in leaves]
    columns_of = {key: _Columns() for key in roots}
    if documents:
        draft.read_many(documents)
    for start in range(0, len(todo), BATCH):
        some = todo[start : start + BATCH]
        raws = draft.stream([leaf for _, _, leaf in some])
        for key, name, leaf in some:
            _, ids, _, wkb, _, properties = _members(raws[leaf], "features")
            c = columns_of[key]
            c.ids += ids
            c.wkb += wkb
            c.properties += properties
            if name == "local":
                c.local = len(c.ids)
    for key, root in roots.items():
        c = columns_of[key]
        order = sorted(range(len(c.ids)), key=c.ids.__getitem__)
        local = np.zeros(len(order), bool)
        local[: c.local] = True
        yield (
            key,
            unchecked_features(
                tuple([c.ids[k] for k in order]),
                from_wkb([c.wkb[k] for k in order]),
                tuple([c.properties[k] for k in order]),
                local[order] if order else local,
                read_document(draft, root),
            ),
        )


def _load_tiles(draft: ChunkStage, root: PartRoot, out: NDArray[Any]) -> None:
    node = root.trees["tiles"]
    if node is None:
        return
    (leaves,) = tree.leaves(draft, [node])
    raws = draft.read_many(leaves)
    rows: dict[bytes, list[int]] = {}
    for leaf in leaves:
        for code, name in tile_leaf(raws[leaf]):
            rows.setdefault(name, []).append(code)
    names = list(rows)
    for start in range(0, len(names), TILE_BATCH):
        for name, raw in draft.stream(names[start : start + TILE_BATCH]).items():
            for code in rows[name]:
                place_tile(out, code, raw)


def morton(code: int) -> tuple[int, int]:
    """(row, column) of a tile's code."""
    col = row = 0
    for bit in range(32):
        col |= (code >> (2 * bit) & 1) << bit
        row |= (code >> (2 * bit + 1) & 1) << bit
    return row, col


def place_tile(out: NDArray[Any], code: int, raw: bytes) -> None:
    """Copy a tile's values to its place in [height, width(, bands)]."""
    row, col = morton(code)
    target = out[row * TILE : (row + 1) * TILE, col * TILE : (col + 1) * TILE]
    (data,) = _members(raw, "tile")
    target[...] = np.frombuffer(data, out.dtype.newbyteorder("<")).reshape(target.shape)


def tile_shape(header: Mapping[str, Any], code: int) -> tuple[int, int, int, int]:
    """(first row, first column, height, width) of a tile."""
    row, col = morton(code)
    return (
        row * TILE,
        col * TILE,
        min(TILE, header["height"] - row * TILE),
        min(TILE, header["width"] - col * TILE),
    )


def tile_cells(raw: bytes) -> NDArray[np.uint8]:
    """A grid tile's cells, flat."""
    (data,) = _members(raw, "tile")
    return np.frombuffer(data, np.uint8)


def grid_cells(draft: ChunkStage, root: PartRoot) -> NDArray[np.uint8]:
    """A grid's cells."""
    cells = np.empty((root.header["height"], root.header["width"]), np.uint8)
    _load_tiles(draft, root, cells)
    return cells


def _load_grid(draft: ChunkStage, root: PartRoot) -> OccupancyGrid:
    h = root.header
    cells = grid_cells(draft, root)
    x, y, yaw = h["origin"]
    return OccupancyGrid(
        cells,
        h["resolution"],
        (x, y, yaw),
        h["mode"],
        h["occupied_thresh"],
        h["free_thresh"],
        h["negate"],
        h["properties"],
    )


def _load_picture(draft: ChunkStage, root: PartRoot) -> GeoImage:
    h = root.header
    pixels = np.empty((h["height"], h["width"], h["bands"]), np.dtype(h["dtype"]) if h["dtype"] != "b1" else np.bool_)
    _load_tiles(draft, root, pixels)
    a, b, c, d, e, f = h["transform"]
    return GeoImage(pixels, (a, b, c, d, e, f), h["crs"], h["properties"])


def voxel_leaf(raw: bytes, colour: bool) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any] | None]:
    """(depth, code, log-odds, colour or None) of a leaf of voxels."""
    depth, steps, log_odds, shades = _members(raw, "voxels")
    code = np.cumsum(np.frombuffer(steps, "<u8"), dtype=np.uint64)
    return (
        np.frombuffer(depth, np.uint8),
        code,
        np.frombuffer(log_odds, "<f4").astype(np.float32),
        np.frombuffer(shades, np.uint8).reshape(-1, 3) if colour else None,
    )


def _load_voxels(draft: ChunkStage, root: PartRoot) -> VoxelMap:
    h = root.header
    node = root.trees["voxels"]
    leaves = tree.leaves(draft, [node])[0] if node else []
    columns_read = []
    for start in range(0, len(leaves), TILE_BATCH):
        some = leaves[start : start + TILE_BATCH]
        raws = draft.stream(some)
        columns_read += [voxel_leaf(raws[name], h["colour"]) for name in some]
    if not columns_read:
        colour = np.empty((0, 3), np.uint8) if h["colour"] else None
        empty = (np.empty(0, np.uint8), np.empty(0, np.uint64), np.empty(0, np.float32))
        return VoxelMap(h["resolution"], *empty, colour, h["binary"], h["properties"])
    depth, code, log_odds, shades = zip(*columns_read, strict=True)
    return VoxelMap(
        h["resolution"],
        np.concatenate(depth),
        np.concatenate(code),
        np.concatenate(log_odds),
        np.concatenate([s for s in shades if s is not None]) if h["colour"] else None,
        h["binary"],
        h["properties"],
    )


def resource_files(draft: ChunkStage, root: PartRoot) -> list[tuple[str, int, str]]:
    """(path, size, SHA-256 in hex) of all files of a resources part."""
    node = root.trees["files"]
    if node is None:
        return []
    (leaves,) = tree.leaves(draft, [node])
    raws = draft.read_many(leaves)
    return [row for name in leaves for row in file_leaf(raws[name])]


def _load_resources(draft: ChunkStage, root: PartRoot, fetch: FetchBlobs) -> Resources:
    rows = resource_files(draft, root)
    contents = fetch([h for _, _, h in rows])
    return Resources({path: contents[h] for path, _, h in rows})


def all_chunks(draft: ChunkStage, name: bytes, existing_names: Container[bytes]) -> tuple[set[bytes], set[str]]:
    """Everything a part refers to, but what is below known nodes: hashes of its chunks, and of its blobs (hex)."""
    root = read_root(draft, name)
    out = {name, *document_chunks(root)}
    blobs: set[str] = set()
    for node in root.trees.values():
        out |= tree.names(draft, node, existing_names)
    if root.type in ("grid", "picture"):
        out |= _tile_names(draft, root)
    elif root.type == "resources":
        blobs = {h for _, _, h in resource_files(draft, root)}
    return out, blobs


def new_chunks(draft: ChunkStage, name: bytes, existing_names: Container[bytes]) -> tuple[list[bytes], list[bytes]]:
    """The draft's own chunks that a part needs: (nodes and documents, tiles). known: chunks that the base has."""
    root = read_root(draft, name)
    nodes = [h for h in (name, *document_chunks(root)) if h in draft.new and not draft.was_read(h)]
    tiles: list[bytes] = []
    todo = [node for node in root.trees.values() if node is not None]
    raster = root.type in ("grid", "picture")
    while todo:
        node = todo.pop()
        if node.hash not in draft.new or node.hash in existing_names or draft.was_read(node.hash):
            continue
        nodes.append(node.hash)
        if node.level:
            todo.extend(draft.inner(node.hash).children())
        elif raster:
            tiles.extend(t for _, t in tile_leaf(draft.new[node.hash]) if t in draft.stored)
    return nodes, tiles


def coordinates(geometry: Any) -> NDArray[np.float64]:
    """All (x, y) of one geometry: float64 [n, 2]."""
    return np.asarray(shapely.get_coordinates(geometry), np.float64)
