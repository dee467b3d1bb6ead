"""Differences between two versions of a part: reads only what their trees do not share."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.model.grid import FREE, OCCUPIED, UNKNOWN
from app.model.voxels import DEPTH
from app.store import tree
from app.store.encode import pack
from app.store.gc_pause import gc_paused
from app.store.parts.features import Item, leaf_items
from app.store.parts.rasters import TILE, grid_cells, tile_cells, tile_leaf, tile_shape
from app.store.parts.resources import file_leaf
from app.store.parts.roots import TILE_BATCH, PartRoot
from app.store.parts.voxels import voxel_leaf
from app.store.tree import ChunkStage
from app.store.values import Box, ChangedCells


@dataclass(slots=True)
class FeatureChanges:
    """Ids that were added, changed and deleted, sorted, with both items. document: whether it differs."""

    added: list[str] = field(default_factory=list)
    changed: list[str] = field(default_factory=list)
    deleted: list[str] = field(default_factory=list)
    before: Mapping[str, Item] = field(default_factory=dict)
    after: Mapping[str, Item] = field(default_factory=dict)
    document: bool = False

    def counts(self) -> dict[str, int]:
        """Count each kind of change."""
        return {"added": len(self.added), "changed": len(self.changed), "deleted": len(self.deleted)}

    def as_dict(self) -> dict[str, Any]:
        """Return the difference as JSON."""
        return {
            "added": self.added,
            "changed": [{"id": i, "fields": fields(self.before[i], self.after[i])} for i in self.changed],
            "deleted": self.deleted,
        }


def fields(a: Item, b: Item) -> list[str]:
    """Return the sorted names of differing properties, including ``geometry`` and ``anchor``."""
    old, new = a.properties, b.properties
    out = {
        key
        for key in old.keys() | new.keys()
        # compared as packed bytes, since 1 == 1.0 == True in Python
        if key not in old or key not in new or old[key] != new[key] or pack(old[key]) != pack(new[key])
    }
    if a.wkb != b.wkb:
        out.add("geometry")
    if a.anchor != b.anchor:
        out.add("anchor")
    return sorted(out)


def features(draft: ChunkStage, a: PartRoot | None, b: PartRoot | None) -> FeatureChanges:
    """Compare two collections; None is one without items."""
    before: dict[str, Item] = {}
    after: dict[str, Item] = {}
    with gc_paused():
        for anchor, name in enumerate(("local", "wgs84")):
            left, right = tree.differing(draft, a.trees[name] if a else None, b.trees[name] if b else None)
            before.update(leaf_items(draft, left, anchor))
            for i, item in leaf_items(draft, right, anchor):
                if before.get(i) == item:
                    del before[i]  # most items of changed leaves are equal
                else:
                    after[i] = item
    return FeatureChanges(
        sorted(after.keys() - before.keys()),
        sorted(after.keys() & before.keys()),
        sorted(before.keys() - after.keys()),
        before,
        after,
        (a.header["document"] if a else []) != (b.header["document"] if b else []),
    )


# --- grids ---

FRAME: Final = ("height", "width", "resolution", "origin")


@dataclass(frozen=True, slots=True)
class TileChange:
    """A tile that differs: its position in cells of the new grid, and both contents (uint8 [height, width])."""

    row: int
    column: int
    before: NDArray[np.uint8]
    after: NDArray[np.uint8]


def same_frame(a: PartRoot, b: PartRoot) -> bool:
    """Return whether the cells of two grids cover the same positions."""
    return all(a.header[name] == b.header[name] for name in FRAME)


def diff_tiles(draft: ChunkStage, a: PartRoot, b: PartRoot) -> Iterator[TileChange]:
    """Return the tiles that differ between two grids of the same frame."""
    left, right = tree.differing(draft, a.trees["tiles"], b.trees["tiles"])
    raws = draft.read_many([*left, *right])
    before = {code: name for leaf in left for code, name in tile_leaf(raws[leaf])}
    after = {code: name for leaf in right for code, name in tile_leaf(raws[leaf])}
    codes = [code for code in sorted(after) if before.get(code) != after[code]]
    for start in range(0, len(codes), TILE_BATCH):
        some = codes[start : start + TILE_BATCH]
        raw = draft.stream([*(before[c] for c in some), *(after[c] for c in some)])
        for code in some:
            row, column, height, width = tile_shape(b.header, code)
            yield TileChange(
                row,
                column,
                tile_cells(raw[before[code]]).reshape(height, width),
                tile_cells(raw[after[code]]).reshape(height, width),
            )


@dataclass(slots=True)
class CellChanges:
    """Counts of changed cells by their new value, and the box around them in metres."""

    freed: int = 0
    blocked: int = 0
    unknown: int = 0
    other: int = 0
    box: Box | None = None
    fields: list[str] = field(default_factory=list)

    def add(self, before: NDArray[np.uint8], after: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Count the cells that differ; returns their mask."""
        differs: NDArray[np.bool_] = before != after
        now = after[differs]
        freed, blocked, unknown = (int((now == value).sum()) for value in (FREE, OCCUPIED, UNKNOWN))
        self.freed += freed
        self.blocked += blocked
        self.unknown += unknown
        self.other += len(now) - freed - blocked - unknown
        return differs

    def as_dict(self) -> dict[str, Any]:
        """Return all counts, the box, and the names of differing header members, if any, as JSON."""
        out: dict[str, Any] = {
            "freed": self.freed,
            "blocked": self.blocked,
            "unknown": self.unknown,
            "other": self.other,
            "bbox": None if self.box is None else list(self.box),
        }
        if self.fields:
            out["fields"] = self.fields
        return out


def cells(draft: ChunkStage, a: PartRoot | None, b: PartRoot | None) -> CellChanges:
    """Compare two grids. Cells outside a grid count as unknown.

    Grids on the same raster (equal resolution and yaw, origins whole cells apart) are compared cell by cell; for others
    only the differences of the header and the box of the new grid (or of the old one) are returned.
    """
    out = CellChanges()
    if a is None and b is None:
        return out
    if a is not None and b is not None:
        out.fields = sorted(k for k in a.header.keys() | b.header.keys() if a.header.get(k) != b.header.get(k))
        if same_frame(a, b):
            low = np.array([math.inf, math.inf])
            high = -low
            for change in diff_tiles(draft, a, b):
                rows, columns = np.nonzero(out.add(change.before, change.after))
                if len(rows):
                    low = np.minimum(low, [columns.min() + change.column, rows.min() + change.row])
                    high = np.maximum(high, [columns.max() + change.column + 1, rows.max() + change.row + 1])
            if math.isfinite(low[0]):
                out.box = cell_box(b.header, *low.tolist(), *high.tolist())
            return out
        if _offset(a.header, b.header) is None:
            out.box = cell_box(b.header, 0, 0, b.header["width"], b.header["height"])
            return out
    return _diff_aligned(draft, a, b, out)


def _diff_aligned(draft: ChunkStage, a: PartRoot | None, b: PartRoot | None, out: CellChanges) -> CellChanges:
    """Compare two grids on one raster on the rectangle around both, in blocks of rows."""
    header = b.header if b else a.header if a else {}
    place = (0, 0) if a is None or b is None else (_offset(a.header, b.header) or (0, 0))
    old = _read_all_cells(draft, a)
    new = _read_all_cells(draft, b)
    # (row, column) of each grid's first cell in cells of the new one.
    old_row, old_column = place if b is not None else (0, 0)
    spans = [(old_row, old_column, old)] * (a is not None) + [(0, 0, new)] * (b is not None)
    r0 = min(r for r, _, _ in spans)
    c0 = min(c for _, c, _ in spans)
    r1 = max(r + g.shape[0] for r, _, g in spans)
    c1 = max(c + g.shape[1] for _, c, g in spans)
    low = np.array([math.inf, math.inf])
    high = -low
    for start in range(r0, r1, TILE):
        end = min(start + TILE, r1)
        before = _window(old, old_row, old_column, start, end, c0, c1) if a is not None else None
        after = _window(new, 0, 0, start, end, c0, c1) if b is not None else None
        blank = np.full((end - start, c1 - c0), UNKNOWN, np.uint8)
        rows, columns = np.nonzero(out.add(blank if before is None else before, blank if after is None else after))
        if len(rows):
            low = np.minimum(low, [columns.min() + c0, rows.min() + start])
            high = np.maximum(high, [columns.max() + c0 + 1, rows.max() + start + 1])
    if math.isfinite(low[0]):
        out.box = cell_box(header, *low.tolist(), *high.tolist())
    return out


def _window(
    grid: NDArray[np.uint8], row: int, column: int, start: int, end: int, left: int, right: int
) -> NDArray[np.uint8]:
    """Read rows [start, end), columns [left, right) of a grid whose first cell is (row, column); unknown outside."""
    out = np.full((end - start, right - left), UNKNOWN, np.uint8)
    r0, r1 = max(start, row), min(end, row + grid.shape[0])
    if r0 < r1:
        out[r0 - start : r1 - start, column - left : column - left + grid.shape[1]] = grid[r0 - row : r1 - row]
    return out


def _read_all_cells(draft: ChunkStage, root: PartRoot | None) -> NDArray[np.uint8]:
    return grid_cells(draft, root) if root else np.empty((0, 0), np.uint8)


def _offset(a: Mapping[str, Any], b: Mapping[str, Any]) -> tuple[int, int] | None:
    """Return (row, column) of a's first cell in cells of b if both are on one raster; else None."""
    ax, ay, ayaw = a["origin"]
    bx, by, byaw = b["origin"]
    if a["resolution"] != b["resolution"] or ayaw != byaw:
        return None
    c, s = math.cos(byaw), math.sin(byaw)
    column = (c * (ax - bx) + s * (ay - by)) / b["resolution"]
    row = (c * (ay - by) - s * (ax - bx)) / b["resolution"]
    far = abs(column) > 1e5 or abs(row) > 1e5
    if far or abs(column - round(column)) > 1e-3 or abs(row - round(row)) > 1e-3:
        return None
    return round(row), round(column)


def cell_box(header: Mapping[str, Any], x0: float, y0: float, x1: float, y1: float) -> Box:
    """Return the box in metres around cells [x0, x1) × [y0, y1) of a grid."""
    x, y, yaw = header["origin"]
    r = header["resolution"]
    c, s = math.cos(yaw), math.sin(yaw)
    corners = [(u * r, v * r) for u, v in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))]
    xs = [x + c * u - s * v for u, v in corners]
    ys = [y + s * u + c * v for u, v in corners]
    return (min(xs), min(ys), max(xs), max(ys))


def rectangles(draft: ChunkStage, a: PartRoot, b: PartRoot) -> tuple[ChangedCells, ...]:
    """Return the changed cells between two grids of one frame: the smallest rectangle in each tile that differs."""
    out = []
    for change in diff_tiles(draft, a, b):
        rows, columns = np.nonzero(change.before != change.after)
        r0, r1, c0, c1 = int(rows.min()), int(rows.max()) + 1, int(columns.min()), int(columns.max()) + 1
        block = np.ascontiguousarray(change.after[r0:r1, c0:c1])
        out.append(ChangedCells(change.row + r0, change.column + c0, block))
    return tuple(out)


# --- the other layers ---


def diff_other_parts(draft: ChunkStage, a: PartRoot | None, b: PartRoot | None) -> dict[str, Any]:
    """Count voxels, image tiles or files that were added, changed and deleted; list differing header members."""
    if a is not None and b is not None and a.type != b.type:
        a = None
    kind = b.type if b else a.type if a else "resources"
    name = {"voxels": "voxels", "picture": "tiles", "resources": "files"}[kind]
    old, new = a.trees[name] if a else None, b.trees[name] if b else None
    if old is None or new is None:
        out: dict[str, Any] = {"added": new.count if new else 0, "changed": 0, "deleted": old.count if old else 0}
    else:
        left, right = tree.differing(draft, old, new)
        if kind == "voxels":
            out = _voxel_changes(_voxels(draft, left, a), _voxels(draft, right, b))
        else:
            before, after = _rows(draft, left, kind), _rows(draft, right, kind)
            out = {
                "added": len(after.keys() - before.keys()),
                "changed": sum(1 for k in after.keys() & before.keys() if before[k] != after[k]),
                "deleted": len(before.keys() - after.keys()),
            }
    if a is not None and b is not None:
        header = sorted(k for k in a.header.keys() | b.header.keys() if a.header.get(k) != b.header.get(k))
        if header:
            out["fields"] = header
    return out


def _rows(draft: ChunkStage, names: Sequence[bytes], kind: str) -> dict[Any, Any]:
    rows: dict[Any, Any] = {}
    for start in range(0, len(names), TILE_BATCH):
        some = names[start : start + TILE_BATCH]
        raws = draft.stream(some)
        for name in some:
            if kind == "picture":
                rows.update(tile_leaf(raws[name]))
            else:
                rows.update((path, sha) for path, _, sha in file_leaf(raws[name]))
    return rows


class _Voxels(NamedTuple):
    """Octree leaves in ascending order. key: uint64 [n], position and depth. content: [n], comparable as a whole."""

    key: NDArray[np.uint64]
    content: NDArray[np.void]


def _voxels(draft: ChunkStage, names: Sequence[bytes], root: PartRoot | None) -> _Voxels:
    colour = root is not None and bool(root.header["colour"])
    record = np.dtype([("odds", "<f4"), ("colour", "u1", 3), ("coloured", "u1")])
    keys, records = [np.empty(0, np.uint64)], [np.empty(0, record)]
    for start in range(0, len(names), TILE_BATCH):
        some = names[start : start + TILE_BATCH]
        raws = draft.stream(some)
        for name in some:
            depth, code, log_odds, shades = voxel_leaf(raws[name], colour)
            below = np.multiply(np.uint8(DEPTH) - depth, np.uint8(3), dtype=np.uint64)
            keys.append(code << below << np.uint64(5) | depth)
            rows = np.zeros(len(code), record)
            rows["odds"] = log_odds
            if shades is not None:
                rows["colour"], rows["coloured"] = shades, 1
            records.append(rows)
    return _Voxels(np.concatenate(keys), np.concatenate(records).view("V8"))


def _voxel_changes(before: _Voxels, after: _Voxels) -> dict[str, Any]:
    """Count added, changed and deleted leaves, without an object for each of possibly millions."""
    at = np.searchsorted(before.key, after.key)
    common = at < len(before.key)
    common[common] = before.key[at[common]] == after.key[common]
    shared = int(np.count_nonzero(common))
    changed = int(np.count_nonzero(before.content[at[common]] != after.content[common]))
    return {"added": len(after.key) - shared, "changed": changed, "deleted": len(before.key) - shared}
