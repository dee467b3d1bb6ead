"""Changed cells between two stored grids as an image of classes: reads only the chunks that a window needs.

The image has the frame of the newer grid (of the older one if the grid was deleted), row 0 on top. Cells outside the
older grid count as unknown. If both grids are on one raster, cells are compared one by one; otherwise each cell is
compared with the older cell at its centre.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from app.model.grid import FREE, OCCUPIED, UNKNOWN
from app.store import diff, tree
from app.store.encode import interleave
from app.store.parts.rasters import TILE, tile_cells, tile_leaf, tile_shape
from app.store.parts.roots import TILE_BATCH, PartRoot
from app.store.tree import ChunkStage

Cells = NDArray[np.uint8]

SAME: Final = 0
BLOCKED: Final = 1
FREED: Final = 2
FORGOTTEN: Final = 3
"""Became unknown."""
EXPLORED_FREE: Final = 4
"""Unknown before, now free."""
EXPLORED_OCCUPIED: Final = 5
"""Unknown before, now occupied."""
OTHER: Final = 6
"""Another change of value."""

BLOCK: Final = 2048
"""Side of the squares in which a large image is read, in cells."""

MAX_WINDOW: Final = 2**26
"""Maximum number of cells of the older grid that are read at once."""


def classify(before: Cells, after: Cells) -> Cells:
    """Return the class of change of each cell; of several, the smallest one is the most severe."""
    out = np.zeros(after.shape, np.uint8)
    differs = before != after
    if not differs.any():
        return out
    was, now = before[differs], after[differs]
    rules = (
        (now == UNKNOWN, FORGOTTEN),
        ((was == FREE) & (now == OCCUPIED), BLOCKED),
        ((was == OCCUPIED) & (now == FREE), FREED),
        ((was == UNKNOWN) & (now == FREE), EXPLORED_FREE),
        ((was == UNKNOWN) & (now == OCCUPIED), EXPLORED_OCCUPIED),
    )
    out[differs] = np.select([rule for rule, _ in rules], [np.uint8(change) for _, change in rules], np.uint8(OTHER))
    return out


def halve(changes: Cells) -> Cells:
    """Join 2 × 2 classes from the top left corner: the most severe one; sizes are rounded up."""
    height, width = changes.shape
    padded = np.zeros((height + height % 2, width + width % 2), np.uint8)
    padded[:height, :width] = changes
    padded -= np.uint8(1)  # in uint8 arithmetic 0 becomes 255, the least severe
    joined = np.minimum(padded[0::2], padded[1::2])
    joined = np.minimum(joined[:, 0::2], joined[:, 1::2])
    out: Cells = joined + np.uint8(1)
    return out


class CellChangeImage:
    """Classes of change between two grids, read by windows.

    Attributes:
        header: of the grid whose frame the image has: size, resolution, origin.
    """

    def __init__(self, draft: ChunkStage, old: PartRoot | None, new: PartRoot | None) -> None:
        root = new or old
        if root is None:
            raise ValueError("one of the two grids must exist")
        self.header: Mapping[str, Any] = root.header
        self.height, self.width = int(root.header["height"]), int(root.header["width"])
        self._old, self._new = (None if grid is None else _Tiles(draft, grid) for grid in (old, new))
        self._same_frame = old is not None and new is not None and diff.same_frame(old, new)

    def reduce(self, k: int, row: int, column: int, height: int, width: int) -> Cells:
        """Read a window of the image halved k times, clipped to it: uint8, row 0 on top."""
        height = min(height, _halved(self.height, k) - row)
        width = min(width, _halved(self.width, k) - column)
        out = np.zeros((height, width), np.uint8)
        step = max(1, BLOCK >> k)
        for top in range(0, height, step):
            for left in range(0, width, step):
                target = out[top : top + step, left : left + step]
                target[...] = self._reduce_block(k, row + top, column + left, *target.shape)
        return out

    def _reduce_block(self, k: int, row: int, column: int, height: int, width: int) -> Cells:
        top, left = row << k, column << k
        bottom, right = min((row + height) << k, self.height), min((column + width) << k, self.width)
        changes = self.read(top, left, bottom - top, right - left)
        if not changes.any():
            return np.zeros((height, width), np.uint8)
        for _ in range(k):
            changes = halve(changes)
        return changes

    def read(self, row: int, column: int, height: int, width: int) -> Cells:
        """Read a window inside the image: uint8 [height, width], row 0 on top."""
        bottom = self.height - row - height
        if self._same_frame and self._old is not None and self._new is not None:
            out = np.zeros((height, width), np.uint8)
            for top, left, before, after in _differing_tiles(self._old, self._new, (bottom, column, height, width)):
                out[top - bottom : top - bottom + after.shape[0], left - column : left - column + after.shape[1]] = (
                    classify(before, after)
                )
            return out[::-1]
        unknown = np.full((height, width), UNKNOWN, np.uint8)
        before, after = unknown, unknown
        if self._new is not None:
            after = self._new.window(bottom, column, height, width)
        if self._old is not None:
            before = self._sample_old(self._old, bottom, column, height, width)
        return classify(before, after)[::-1]

    def _sample_old(self, old: _Tiles, row: int, column: int, height: int, width: int) -> Cells:
        """Look up the older cells at the centres of a window; unknown outside."""
        rows, columns = _cells_at_centres(self.header, old.header, row, column, height, width)
        inside = (rows >= 0) & (rows < old.header["height"]) & (columns >= 0) & (columns < old.header["width"])
        out = np.full((height, width), UNKNOWN, np.uint8)
        if not inside.any():
            return out
        r0, r1 = int(rows[inside].min()), int(rows[inside].max()) + 1
        c0, c1 = int(columns[inside].min()), int(columns[inside].max()) + 1
        if (r1 - r0) * (c1 - c0) > MAX_WINDOW and height * width > 1:  # the older grid is much finer
            if height >= width:
                half = height // 2
                out[:half] = self._sample_old(old, row, column, half, width)
                out[half:] = self._sample_old(old, row + half, column, height - half, width)
            else:
                half = width // 2
                out[:, :half] = self._sample_old(old, row, column, height, half)
                out[:, half:] = self._sample_old(old, row, column + half, height, width - half)
            return out
        cells = old.window(r0, c0, r1 - r0, c1 - c0)
        out[inside] = cells[rows[inside] - r0, columns[inside] - c0]
        return out


def _halved(size: int, k: int) -> int:
    return (size + (1 << k) - 1) >> k


def _cells_at_centres(
    header: Mapping[str, Any], old: Mapping[str, Any], row: int, column: int, height: int, width: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return row and column in another grid of the centres of a window's cells: int64 [height, width] each."""
    x, y, yaw = header["origin"]
    old_x, old_y, old_yaw = old["origin"]
    resolution, old_resolution = header["resolution"], old["resolution"]
    u = (np.arange(column, column + width) + 0.5) * resolution
    v = (np.arange(row, row + height) + 0.5)[:, None] * resolution
    c, s = math.cos(yaw), math.sin(yaw)
    px, py = x + c * u - s * v - old_x, y + s * u + c * v - old_y
    c, s = math.cos(old_yaw), math.sin(old_yaw)
    columns = np.floor((c * px + s * py) / old_resolution).astype(np.int64)
    rows = np.floor((c * py - s * px) / old_resolution).astype(np.int64)
    return rows, columns


Window = tuple[int, int, int, int]
"""First row and column, height and width in cells, row 0 at the bottom."""


class _Tiles:
    """Stored tiles of a grid."""

    def __init__(self, draft: ChunkStage, root: PartRoot) -> None:
        self.draft, self.header, self._node = draft, root.header, root.trees["tiles"]

    def names(self, window: Window) -> dict[int, bytes]:
        """Return the tiles in a window: Morton code -> chunk."""
        row, column, height, width = window
        rows = np.arange(row // TILE, -(-(row + height) // TILE), dtype=np.uint64)
        columns = np.arange(column // TILE, -(-(column + width) // TILE), dtype=np.uint64)
        codes = np.sort(interleave(np.tile(columns, len(rows)), np.repeat(rows, len(columns))))
        packed = codes.astype(">u8").tobytes()
        keys = [packed[8 * k : 8 * k + 8] for k in range(len(codes))]
        leaves = tree.paths(self.draft, self._node, keys)
        wanted = set(codes.tolist())
        raws = self.draft.read_many(leaves)
        return {code: name for leaf in leaves for code, name in tile_leaf(raws[leaf]) if code in wanted}

    def window(self, row: int, column: int, height: int, width: int) -> Cells:
        """Read the cells of a window inside the grid."""
        out = np.empty((height, width), np.uint8)
        window = (row, column, height, width)
        named = list(self.names(window).items())
        for start in range(0, len(named), TILE_BATCH):
            some = named[start : start + TILE_BATCH]
            raws = self.draft.stream([name for _, name in some])
            for code, name in some:
                top, left, cells = _clip(self.header, code, raws[name], window)
                out[top - row : top - row + cells.shape[0], left - column : left - column + cells.shape[1]] = cells
        return out


def _differing_tiles(old: _Tiles, new: _Tiles, window: Window) -> Iterator[tuple[int, int, Cells, Cells]]:
    """Yield the pieces of tiles in a window that differ between grids of one frame: row, column, both contents."""
    before, after = old.names(window), new.names(window)
    codes = [code for code in after if before[code] != after[code]]
    for start in range(0, len(codes), TILE_BATCH):
        some = codes[start : start + TILE_BATCH]
        raws = new.draft.stream([*(before[code] for code in some), *(after[code] for code in some)])
        for code in some:
            top, left, was = _clip(old.header, code, raws[before[code]], window)
            yield top, left, was, _clip(new.header, code, raws[after[code]], window)[2]


def _clip(header: Mapping[str, Any], code: int, raw: bytes, window: Window) -> tuple[int, int, Cells]:
    """Return the piece of a tile in a window: its first row and column in the grid, and its cells."""
    top, left, tile_height, tile_width = tile_shape(header, code)
    row, column, height, width = window
    r0, r1 = max(row, top), min(row + height, top + tile_height)
    c0, c1 = max(column, left), min(column + width, left + tile_width)
    return r0, c0, tile_cells(raw).reshape(tile_height, tile_width)[r0 - top : r1 - top, c0 - left : c1 - left]
