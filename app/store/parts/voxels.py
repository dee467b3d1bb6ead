"""Voxel maps as chunk trees, and back."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from operator import itemgetter
from typing import Any, Final, overload

import numpy as np
import ormsgpack
from numpy.typing import NDArray

from app.model.voxels import VoxelMap
from app.store import tree
from app.store.encode import ENCODING, pack, pack_value
from app.store.parts.roots import TILE_BATCH, EncodedPart, PartRoot, leaf_members, put_root
from app.store.tree import ChunkStage
from app.store.values import Box

VOXEL_KEY: Final = 9
"""Size of a voxel's key in bytes: its position and depth."""


def compose_voxels(draft: ChunkStage, part: VoxelMap) -> EncodedPart:
    """Write a voxel map as chunks."""
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
    """Sequence of keys of one length, cut from one string on access: millions of objects would be slow."""

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


def voxel_leaf(raw: bytes, colour: bool) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any] | None]:
    """Return (depth, code, log-odds, colour or None) of a leaf of voxels."""
    depth, steps, log_odds, shades = leaf_members(raw, "voxels")
    code = np.cumsum(np.frombuffer(steps, "<u8"), dtype=np.uint64)
    return (
        np.frombuffer(depth, np.uint8),
        code,
        np.frombuffer(log_odds, "<f4").astype(np.float32),
        np.frombuffer(shades, np.uint8).reshape(-1, 3) if colour else None,
    )


def load_voxels(draft: ChunkStage, root: PartRoot) -> VoxelMap:
    """Load a voxel map with all its leaves."""
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
