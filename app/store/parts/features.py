"""Vector parts as chunk trees: from features to leaves and back, edits by id, box queries."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import ormsgpack
import shapely
from numpy.typing import NDArray

from app.errors import Damaged, MissingDatum, NotFound
from app.model.antimeridian import cut_at_antimeridian
from app.model.features import Features
from app.model.geodesy import LocalFrame
from app.store import tree
from app.store.encode import (
    EMPTY_BOX,
    ENCODING,
    Columns,
    array_header,
    bounds,
    columns,
    from_wkb,
    pack,
    wkb_bounds,
)
from app.store.parts.boxes import boxes_in_other_frame, crossing_box, split_box
from app.store.parts.roots import (
    EncodedPart,
    PartRoot,
    document_chunks,
    leaf_members,
    put_document,
    put_root,
    read_document,
)
from app.store.tree import ChunkStage, Node
from app.store.values import Bounds, Box

BATCH: Final = 512
"""Maximum number of leaves that are read at once when a whole part is loaded: few queries, bounded memory."""

_FEATURES_HEAD: Final = array_header(8) + pack(ENCODING) + pack("features") + b"\xc4\x04"
"""Parser of a leaf of vector items up to its tail's four bytes."""


class Item(NamedTuple):
    """A stored feature: 0 for local or 1 for wgs84, its WKB, its packed properties. Equal items are equal bytes."""

    anchor: int
    wkb: bytes
    packed: bytes

    @property
    def properties(self) -> dict[str, Any]:
        """Return the unpacked properties."""
        members: dict[str, Any] = ormsgpack.unpackb(self.packed)
        return members


# --- leaves ---


class FeatureLeaf:
    """Leaves of vector items: key = cell, id; item = (WKB, packed properties)."""

    bits = 6

    def decode(self, raw: bytes) -> tuple[list[bytes], list[tuple[bytes, bytes]]]:
        """Decode a leaf into keys and items."""
        ids, cells, wkb, packed = split_leaf(raw)
        keys = [cells[8 * k : 8 * k + 8] + i.encode() for k, i in enumerate(ids)]
        return keys, list(zip(wkb, packed, strict=True))

    def encode(self, keys: Sequence[bytes], items: Sequence[tuple[bytes, bytes]]) -> bytes:
        """Encode a leaf."""
        ids = [k[8:].decode() for k in keys]
        cells = b"".join([k[:8] for k in keys])
        return encode_leaf(ids, cells, [w for w, _ in items], [p for _, p in items])

    def boxes(self, items: Sequence[tuple[bytes, bytes]]) -> NDArray[np.float64]:
        """Return the items' boxes."""
        return wkb_bounds([w for w, _ in items])


class IdLeaf:
    """Leaves of the table id -> position: key = the id's UTF-8; item = anchor and cell, 9 bytes."""

    bits = 8

    def decode(self, raw: bytes) -> tuple[list[bytes], list[bytes]]:
        """Decode a leaf into keys and items."""
        ids, places = leaf_members(raw, "ids")
        return [i.encode() for i in ids], [places[9 * k : 9 * k + 9] for k in range(len(ids))]

    def encode(self, keys: Sequence[bytes], items: Sequence[bytes]) -> bytes:
        """Encode a leaf."""
        return pack([ENCODING, "ids", [k.decode() for k in keys], b"".join(items)])

    def boxes(self, items: Sequence[bytes]) -> None:
        """Return None: ids have no coordinates."""


def encode_leaf(ids: Sequence[str], cells: bytes, wkb: Sequence[bytes], packed: Sequence[bytes]) -> bytes:
    """Encode a leaf of vector items with packed properties, byte for byte as MessagePack encodes the whole array."""
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
    """Split a leaf of vector items into ids, cells, WKB, and properties that stay packed."""
    start = len(_FEATURES_HEAD)
    if not raw.startswith(_FEATURES_HEAD):
        leaf_members(raw, "features")
        raise Damaged("a stored leaf of vector items is malformed")
    end = len(raw) - int.from_bytes(raw[start : start + 4], "little")
    # the array without its last member
    _, _, _, ids, cells, wkb, sizes = ormsgpack.unpackb(array_header(7) + raw[1:end])
    ends = np.cumsum(np.frombuffer(sizes, "<u4")).tolist()
    first = end + len(array_header(len(ids)))
    packed = [raw[first + a : first + b] for a, b in zip([0, *ends], ends, strict=False)]
    return ids, cells, wkb, packed


# --- values -> chunks ---


def compose_features(draft: ChunkStage, part: Features, base_digest: str) -> EncodedPart | None:
    """Write features as chunks; None if their digest is the base's."""
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
    # nearly sorted by NumPy, so that Python's sort is fast
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


def feature_bounds(draft: ChunkStage, trees: Mapping[str, Node | None], part: Features | None = None) -> Bounds:
    """Return the extent of a collection; the box of wgs84 items crosses the antimeridian if that makes it smaller."""
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


# --- edits by id ---


def edit_features(
    draft: ChunkStage, root: PartRoot, put: Features | None, deleted: Collection[str], label: str
) -> EncodedPart:
    """Put features (add, or replace by id) and delete others. Raises NotFound with unknown ids to delete."""
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
    """Return an empty collection's root."""
    return put_root(draft, "features", {"document": []}, {"local": None, "wgs84": None, "ids": None})


def find_places(draft: ChunkStage, root: PartRoot, ids: Sequence[str]) -> dict[str, bytes]:
    """Look up sorted ids -> anchor and cell (9 bytes), of those that exist."""
    keys = [i.encode() for i in ids]
    out: dict[str, bytes] = {}
    for name in tree.paths(draft, root.trees["ids"], keys):
        # code points sort like their UTF-8
        member_ids, places = leaf_members(draft.read(name), "ids")
        for i in ids[bisect_left(ids, member_ids[0]) : bisect_right(ids, member_ids[-1])]:
            k = bisect_left(member_ids, i)
            if member_ids[k] == i:
                out[i] = places[9 * k : 9 * k + 9]
    return out


def items_by_id(draft: ChunkStage, root: PartRoot, ids: Collection[str]) -> dict[str, Item]:
    """Read the stored items with these ids, if they exist."""
    places = find_places(draft, root, sorted(set(ids)))
    out: dict[str, Item] = {}
    for anchor, name in enumerate(("local", "wgs84")):
        keys = sorted(p[1:] + i.encode() for i, p in places.items() if p[0] == anchor)
        leaves = tree.paths(draft, root.trees[name], keys)
        out.update((i, item) for i, item in leaf_items(draft, leaves, anchor) if i in places)
    return out


def leaf_items(draft: ChunkStage, names: Sequence[bytes], anchor: int) -> Iterator[tuple[str, Item]]:
    """Return (id, item) of leaves of vector items."""
    for start in range(0, len(names), BATCH):
        some = names[start : start + BATCH]
        raws = draft.stream(some)
        for name in some:
            ids, _, wkb, packed = split_leaf(raws[name])
            for i, w, p in zip(ids, wkb, packed, strict=True):
                yield i, Item(anchor, w, p)


def features_from_items(items: Mapping[str, Item], document: Mapping[str, Any]) -> Features:
    """Convert stored items into a collection, in the order of their ids."""
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
    """Build a collection without checks: its columns were checked before they were stored, and their hashes match."""
    features = object.__new__(Features)
    geometry.flags.writeable = False
    local.flags.writeable = False
    for name, value in zip(Features.__slots__, (ids, geometry, properties, local, document), strict=True):
        object.__setattr__(features, name, value)
    return features


@dataclass(frozen=True, slots=True, eq=False)
class PackedFeatures:
    """Columns of a vector part in the order of the ids; properties stay packed (MessagePack), as most are not read."""

    ids: Sequence[str]
    geometry: NDArray[np.object_]
    properties: Sequence[bytes]
    local: NDArray[np.bool_]


def packed_from_items(items: Mapping[str, Item]) -> PackedFeatures:
    """Convert stored items into columns, in the order of their ids."""
    ids = sorted(items)
    rows = [items[i] for i in ids]
    local = np.array([row.anchor == 0 for row in rows], bool)
    return PackedFeatures(ids, from_wkb([row.wkb for row in rows]), [row.packed for row in rows], local)


class PackedLeaf(NamedTuple):
    """Columns of a leaf of vector items: 0 for local or 1 for wgs84, ids, WKB, packed properties."""

    anchor: int
    ids: Sequence[str]
    wkb: Sequence[bytes]
    properties: Sequence[bytes]


def packed_leaves(draft: ChunkStage, root: PartRoot) -> Iterator[PackedLeaf]:
    """Read the leaves of a vector part, the local ones first."""
    for anchor, name in enumerate(("local", "wgs84")):
        node = root.trees[name]
        (leaves,) = tree.leaves(draft, [node]) if node is not None else ([],)
        for start in range(0, len(leaves), BATCH):
            some = leaves[start : start + BATCH]
            raws = draft.stream(some)
            for leaf in some:
                ids, _, wkb, packed = split_leaf(raws[leaf])
                yield PackedLeaf(anchor, ids, wkb, packed)


def load_packed(draft: ChunkStage, root: PartRoot) -> PackedFeatures:
    """Load a vector part without unpacking its properties."""
    ids: list[str] = []
    wkb: list[bytes] = []
    packed: list[bytes] = []
    local_count = 0
    for leaf in packed_leaves(draft, root):
        ids += leaf.ids
        wkb += leaf.wkb
        packed += leaf.properties
        local_count = len(ids) if leaf.anchor == 0 else local_count
    order = sorted(range(len(ids)), key=ids.__getitem__)
    local = np.array(order, np.intp) < local_count
    return PackedFeatures([ids[k] for k in order], from_wkb([wkb[k] for k in order]), [packed[k] for k in order], local)


# --- box queries ---


def features_in_box(draft: ChunkStage, root: PartRoot, box: Box, crs: str, frame: LocalFrame | None) -> dict[str, Item]:
    """Find items whose box intersects ``box``, in local metres or in degrees (west > east: antimeridian)."""
    out: dict[str, Item] = {}
    for anchor, name in enumerate(("local", "wgs84")):
        node = root.trees[name]
        if node is None or node.box == EMPTY_BOX:
            continue
        same = crs == name
        if not same and frame is None:
            raise MissingDatum(
                f"the environment has no datum, so its {name} items cannot be found by a box in {crs} coordinates: "
                f"use crs={name}, or set a datum"
            )
        boxes = split_box(box) if crs == "wgs84" else [box]
        coarse = boxes if same else [c for b in boxes for c in boxes_in_other_frame(b, crs, frame)]
        meets = _meets_on_earth if name == "wgs84" else _meets
        leaves = tree.select(draft, node, lambda have, meets=meets, coarse=coarse: meets(have, coarse))  # type: ignore[misc]
        candidates = dict(leaf_items(draft, leaves, anchor))
        ids = list(candidates)
        hits = _hits([candidates[i].wkb for i in ids], boxes, crs, None if same else frame)
        out.update((ids[k], candidates[ids[k]]) for k in hits.tolist())
    return out


def _hits(wkb: Sequence[bytes], boxes: Sequence[Box], crs: str, frame: LocalFrame | None) -> NDArray[np.intp]:
    """Return which geometries meet boxes of ``crs``. frame: of geometries in the other one, else None."""
    if not wkb:
        return np.empty(0, np.intp)
    geometry = None if frame is None else from_wkb(wkb)
    if geometry is not None and frame is not None:
        geometry = frame.geometries_to_local(geometry) if crs == "local" else frame.geometries_to_wgs84(geometry)
    have = wkb_bounds(wkb) if geometry is None else bounds(geometry)
    if crs == "local":
        return np.flatnonzero(_meets(have, boxes))
    hits = _meets_on_earth(have, boxes)
    wide = np.flatnonzero(hits & _is_wide(have))
    if len(wide):
        pieces = cut_at_antimeridian(from_wkb([wkb[k] for k in wide.tolist()]) if geometry is None else geometry[wide])
        parts, index = shapely.get_parts(pieces, return_index=True)
        hits[wide] = np.bincount(index, _meets(bounds(parts), boxes), len(wide)) > 0
    return np.flatnonzero(hits)


def _meets(have: NDArray[np.float64], boxes: Sequence[Box]) -> NDArray[np.bool_]:
    out = np.zeros(len(have), bool)
    for x0, y0, x1, y1 in boxes:
        out |= (have[:, 0] <= x1) & (have[:, 2] >= x0) & (have[:, 1] <= y1) & (have[:, 3] >= y0)
    return out


def _is_wide(have: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which boxes in degrees may be around what crosses the antimeridian: it is outside of them."""
    with np.errstate(invalid="ignore"):  # of a box around nothing
        return np.asarray(have[:, 2] - have[:, 0] > 180.0)


def _meets_on_earth(have: NDArray[np.float64], boxes: Sequence[Box]) -> NDArray[np.bool_]:
    """Return which boxes in degrees may meet others, also across the antimeridian."""
    around = have.copy()
    around[_is_wide(have), 0::2] = -180.0, 180.0
    return _meets(around, boxes)


# --- chunks -> values ---


@dataclass(slots=True)
class _Columns:
    ids: list[str] = field(default_factory=list)
    wkb: list[bytes] = field(default_factory=list)
    properties: list[Mapping[str, Any]] = field(default_factory=list)
    local: int = 0


def load_collections(draft: ChunkStage, roots: Mapping[Any, PartRoot]) -> Iterator[tuple[Any, Features]]:
    """Load vector parts as (key, features), with few queries for all of them together."""
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
            _, ids, _, wkb, _, properties = leaf_members(raws[leaf], "features")
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
