"""Parts of any kind as chunk trees: from values to chunks and back, and the chunks that a part refers to.

``roots`` the first chunk · ``features``, ``rasters``, ``voxels``, ``resources`` the kinds · ``boxes`` bounding boxes.
"""

from __future__ import annotations

from collections.abc import Container, Mapping
from typing import Any

from app.model.features import Features
from app.model.grid import OccupancyGrid
from app.model.imagery import GeoImage
from app.model.layers import Part
from app.model.voxels import VoxelMap
from app.store import tree
from app.store.gc_pause import gc_paused
from app.store.parts.features import compose_features, load_collections
from app.store.parts.rasters import compose_grid, compose_picture, load_grid, load_picture, tile_leaf, tile_names
from app.store.parts.resources import FetchBlobs, compose_resources, load_resources, resource_files
from app.store.parts.roots import EncodedPart, PartRoot, document_chunks, read_root
from app.store.parts.voxels import compose_voxels, load_voxels
from app.store.tree import ChunkStage


def compose(draft: ChunkStage, part: Part, base: PartRoot | None, base_digest: str) -> EncodedPart | None:
    """Write a part as chunks into the stage; None if its canonical upload is the one that the base was made from."""
    if isinstance(part, Features):
        return compose_features(draft, part, base_digest)
    if isinstance(part, OccupancyGrid):
        return compose_grid(draft, part, base)
    if isinstance(part, VoxelMap):
        return compose_voxels(draft, part)
    if isinstance(part, GeoImage):
        return compose_picture(draft, part, base)
    return compose_resources(draft, part)


def load(draft: ChunkStage, root_hashes: Mapping[Any, bytes], fetch: FetchBlobs) -> dict[Any, Part]:
    """Load parts by their hashes, with few queries for all of them together."""
    draft.read_many(list(root_hashes.values()))
    roots = {key: read_root(draft, name) for key, name in root_hashes.items()}
    with gc_paused():
        out: dict[Any, Part] = dict(load_collections(draft, {k: r for k, r in roots.items() if r.type == "features"}))
    for key, root in roots.items():
        if root.type == "grid":
            out[key] = load_grid(draft, root)
        elif root.type == "picture":
            out[key] = load_picture(draft, root)
        elif root.type == "voxels":
            out[key] = load_voxels(draft, root)
        elif root.type == "resources":
            out[key] = load_resources(draft, root, fetch)
    return {key: out[key] for key in root_hashes}


def all_chunks(draft: ChunkStage, name: bytes, existing_names: Container[bytes]) -> tuple[set[bytes], set[str]]:
    """Return all chunks and blobs (hex) of a part by hash, except those below nodes with ``existing_names``."""
    root = read_root(draft, name)
    out = {name, *document_chunks(root)}
    blobs: set[str] = set()
    for node in root.trees.values():
        out |= tree.names(draft, node, existing_names)
    if root.type in ("grid", "picture"):
        out |= tile_names(draft, root)
    elif root.type == "resources":
        blobs = {h for _, _, h in resource_files(draft, root)}
    return out, blobs


def new_chunks(draft: ChunkStage, name: bytes, existing_names: Container[bytes]) -> tuple[list[bytes], list[bytes]]:
    """Return the stage's new chunks of a part: (nodes and documents, tiles). existing_names: of the base."""
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
