"""Part roots: a part's first chunk with its header, its trees and its document, and what all kinds of parts share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Literal

import ormsgpack

from app.errors import Damaged
from app.store.encode import ENCODING, array_header, pack, pack_value, unpack
from app.store.tree import ChunkStage, Node
from app.store.values import Bounds

PartType = Literal["features", "grid", "voxels", "picture", "resources"]

INLINE: Final = 2048
"""Bytes up to which a member of a document stands in the part's chunk."""

TILE_BATCH: Final = 128


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


def leaf_members(raw: bytes, kind: str) -> list[Any]:
    """A chunk's members after its kind; Damaged where it is of another kind."""
    members = unpack(raw)
    if members[1] != kind:
        raise Damaged(f"a stored chunk is {members[1]!r} where {kind!r} belongs")
    return members[2:]


def read_root(draft: ChunkStage, name: bytes) -> PartRoot:
    """A part's root chunk."""
    kind, header, trees = leaf_members(draft.read(name), "part")
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
        key: leaf_members(raws[value], "document")[0] if chunk else value
        for key, chunk, value in root.header.get("document", ())
    }
