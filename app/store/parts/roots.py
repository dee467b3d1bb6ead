"""Part roots: a part's first chunk with its header, trees and document, and helpers for all kinds of parts."""

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
"""Maximum size of a document's member inside the part's chunk, in bytes; larger ones get a chunk of their own."""

TILE_BATCH: Final = 128


@dataclass(frozen=True, slots=True)
class PartRoot:
    """A part's decoded root chunk."""

    type: PartType
    header: dict[str, Any]
    trees: dict[str, Node | None]


@dataclass(frozen=True, slots=True)
class EncodedPart:
    """A part written as chunks. digest: of the canonical upload, empty if it is not worth one."""

    hash: bytes
    count: int
    bounds: Bounds
    digest: str = ""
    blobs: Mapping[str, bytes] = field(default_factory=dict)


def leaf_members(raw: bytes, kind: str) -> list[Any]:
    """Return a chunk's members after its kind. Raises Damaged if it is of another kind."""
    members = unpack(raw)
    if members[1] != kind:
        raise Damaged(f"a stored chunk is of kind {members[1]!r} instead of {kind!r}")
    return members[2:]


def read_root(draft: ChunkStage, name: bytes) -> PartRoot:
    """Read a part's root chunk."""
    kind, header, trees = leaf_members(draft.read(name), "part")
    return PartRoot(kind, header, {t: Node.from_list(n) for t, n in trees.items()})


def put_root(draft: ChunkStage, kind: PartType, header: Mapping[str, Any], trees: Mapping[str, Node | None]) -> bytes:
    """Stage a part's root chunk; its hash is the part's."""
    listed = {t: n.as_list() if n else None for t, n in trees.items()}
    return draft.put(pack([ENCODING, "part", kind, dict(header), listed]))


def put_document(draft: ChunkStage, document: Mapping[str, Any]) -> list[list[Any]]:
    """Return a document's members for the header, in order: [key, 0, value], or [key, 1, hash] of a separate chunk."""
    out: list[list[Any]] = []
    for key in sorted(document):
        packed = pack_value(document[key], f"document.{key}")
        if len(packed) <= INLINE:
            out.append([key, 0, ormsgpack.unpackb(packed)])
        else:
            out.append([key, 1, draft.put(array_header(3) + pack(ENCODING) + pack("document") + packed)])
    return out


def document_chunks(root: PartRoot) -> list[bytes]:
    """Return the chunks of a document's large members."""
    return [value for _, inline, value in root.header.get("document", ()) if inline]


def read_document(draft: ChunkStage, root: PartRoot) -> dict[str, Any]:
    """Load a collection's document."""
    raws = draft.read_many(document_chunks(root))
    return {
        key: leaf_members(raws[value], "document")[0] if chunk else value
        for key, chunk, value in root.header.get("document", ())
    }
