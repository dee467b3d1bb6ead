"""Windows of stored grids and images: reads only the chunks that a window needs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from app.errors import Invalid
from app.store import tree
from app.store.encode import interleave
from app.store.parts.rasters import TILE, tile_leaf, tile_shape
from app.store.parts.roots import leaf_members, read_root
from app.store.tree import ChunkStage

BATCH_BYTES = 16 * 2**20
"""Maximum number of bytes of chunks that are read at once, if a chunk is not larger itself."""


class RasterReader:
    """One stored grid or image, with rows in the order of the store: a grid's first row is its bottom one.

    draft: the stage to read from, stored or not. part_hash: in hex. Thread-safe.

    Attributes:
        kind: ``grid`` or ``picture``.
        header: size, position and properties, as in the part's first chunk.
        dtype, bands: of the pixels; bands is None for grids, whose pixels are [height, width].
    """

    def __init__(self, draft: ChunkStage, part_hash: str) -> None:
        self._draft = draft
        root = read_root(draft, bytes.fromhex(part_hash))
        if root.type not in ("grid", "picture"):
            raise Invalid(f"a part of type {root.type} is no raster: read a grid or an image")
        self._node = root.trees["tiles"]
        self.kind: Literal["grid", "picture"] = "grid" if root.type == "grid" else "picture"
        self.header: Mapping[str, Any] = root.header
        self.height, self.width = int(root.header["height"]), int(root.header["width"])
        self.bands: int | None = None if self.kind == "grid" else int(root.header["bands"])
        kind = "u1" if self.kind == "grid" else root.header["dtype"]
        self.dtype = np.dtype(np.bool_) if kind == "b1" else np.dtype(kind)

    def window(self, row: int, column: int, height: int, width: int) -> NDArray[Any]:
        """Read a window inside the raster: [height, width] or [height, width, bands]."""
        out = np.empty((height, width, *self._last()), self.dtype)
        for block_row, block_column, block in self.blocks(row, column, height, width):
            out[
                block_row - row : block_row - row + block.shape[0],
                block_column - column : block_column - column + block.shape[1],
            ] = block
        return out

    def blocks(self, row: int, column: int, height: int, width: int) -> Iterator[tuple[int, int, NDArray[Any]]]:
        """Yield a window inside the raster chunk by chunk: row, column and pixels of each piece."""
        rows = np.arange(row // TILE, -(-(row + height) // TILE), dtype=np.uint64)
        columns = np.arange(column // TILE, -(-(column + width) // TILE), dtype=np.uint64)
        codes = np.sort(interleave(np.tile(columns, len(rows)), np.repeat(rows, len(columns))))
        named = self._names(codes)
        size = TILE * TILE * (self.bands or 1) * self.dtype.itemsize
        batch = max(1, BATCH_BYTES // size)
        for start in range(0, len(named), batch):
            some = named[start : start + batch]
            raws = self._draft.stream([name for _, name in some])
            for code, name in some:
                yield self._piece(code, raws[name], (row, column, row + height, column + width))

    def _piece(self, code: int, raw: bytes, window: tuple[int, int, int, int]) -> tuple[int, int, NDArray[Any]]:
        top, left, height, width = tile_shape(self.header, code)
        (data,) = leaf_members(raw, "tile")
        pixels = np.frombuffer(data, self.dtype.newbyteorder("<")).reshape(height, width, *self._last())
        r0, r1 = max(window[0], top), min(window[2], top + height)
        c0, c1 = max(window[1], left), min(window[3], left + width)
        return r0, c0, pixels[r0 - top : r1 - top, c0 - left : c1 - left]

    def _names(self, codes: NDArray[np.uint64]) -> list[tuple[int, bytes]]:
        """Look up the chunks of sorted Morton codes."""
        packed = codes.astype(">u8").tobytes()
        keys = [packed[8 * k : 8 * k + 8] for k in range(len(codes))]
        leaves = tree.paths(self._draft, self._node, keys)
        chosen = set(codes.tolist())
        raws = self._draft.read_many(leaves)
        return [row for leaf in leaves for row in tile_leaf(raws[leaf]) if row[0] in chosen]

    def _last(self) -> tuple[int, ...]:
        return () if self.bands is None else (self.bands,)
