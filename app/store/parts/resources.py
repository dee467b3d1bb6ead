"""Resources as trees of paths; the files' bytes are blobs."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence

from app.model.layers import Resources
from app.store import tree
from app.store.encode import ENCODING, pack
from app.store.parts.roots import EncodedPart, PartRoot, leaf_members, put_root
from app.store.tree import ChunkStage

FetchBlobs = Callable[[Sequence[str]], Mapping[str, bytes]]


def compose_resources(draft: ChunkStage, part: Resources) -> EncodedPart:
    """Write files as chunks, and as blobs."""
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
    """Return (path, size, SHA-256 in hex) of a leaf of resources."""
    paths, sizes, hashes = leaf_members(raw, "files")
    return [(p, sizes[k], hashes[32 * k : 32 * k + 32].hex()) for k, p in enumerate(paths)]


def resource_files(draft: ChunkStage, root: PartRoot) -> list[tuple[str, int, str]]:
    """Return (path, size, SHA-256 in hex) of all files of a resources part."""
    node = root.trees["files"]
    if node is None:
        return []
    (leaves,) = tree.leaves(draft, [node])
    raws = draft.read_many(leaves)
    return [row for name in leaves for row in file_leaf(raws[name])]


def load_resources(draft: ChunkStage, root: PartRoot, fetch: FetchBlobs) -> Resources:
    """Load files with their bytes, fetched by their hashes."""
    rows = resource_files(draft, root)
    contents = fetch([h for _, _, h in rows])
    return Resources({path: contents[h] for path, _, h in rows})
