"""Rasterisation of triangles and polygons: the cells of a grid or of a stack of grids that they touch or enclose.

Everything becomes **spans**: runs of cells (layer, row, first column, end column). A cell is touched if a surface meets
it; it is enclosed if its middle is inside. A surface exactly on the border of two cells belongs to the cell on its own
inner side: triangles are moved a micrometre against their normals (counter-clockwise seen from outside) and outlines to
their inner side, and lines are half a micrometre shorter at their ends, so that a box of one metre covers ten cells of
0.1 m and not eleven. The result is exact, without Python loops over cells.

A point is inside if the winding number of a closed surface is not zero, row by row: solids that overlap join, a solid
with inverted faces is a solid as well, and a row in which a surface is open encloses nothing. Coordinates are counted
in cells from the grid's corner after conversion; row 0 is the lowest.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from app.errors import CannotConvert

Array = NDArray[np.float64]
Spans = NDArray[np.int64]
"""Spans, int64 [n, 4]: layer, row, first column, end column (exclusive)."""

INSET_METRES = 1e-6
"""Distance in metres by which surfaces are moved inwards; half of it for ends."""

BLOCK_SIZE = 2**18
"""Number of triangles, or of edges times the rows that they cross, per block of work."""

NONE: Spans = np.empty((0, 4), np.int64)


@dataclass(frozen=True, slots=True)
class RasterFrame:
    """Position of a grid: origin (x, y) of its lower left corner in metres, metres per cell, cells along x and y."""

    origin: tuple[float, float]
    resolution: float
    width: int
    height: int

    @classmethod
    def from_box(cls, box: tuple[float, float, float, float], resolution: float) -> RasterFrame:
        """Return the grid of whole cells around a box (min x, min y, max x, max y), its origin a multiple of a cell."""
        first = [math.floor(v / resolution + 1e-6) for v in box[:2]]
        end = [math.ceil(v / resolution - 1e-6) for v in box[2:]]
        width, height = (max(1, b - a) for a, b in zip(first, end, strict=True))
        return cls((round(first[0] * resolution, 9), round(first[1] * resolution, 9)), resolution, width, height)

    @property
    def cells(self) -> int:
        """Return the number of cells."""
        return self.width * self.height

    def to_cells(self, xy: Array) -> Array:
        """Convert metres [..., 2] to cells."""
        return np.asarray((xy - np.array(self.origin)) / self.resolution, np.float64)


# --- surfaces --------------------------------------------------------------------------------------------------------


def surfaces(triangles: Array, frame: RasterFrame, slabs: Array) -> Iterator[Spans]:
    """Return the cells that triangles (float64 [n, 3, 3], metres) touch between the heights of each slab.

    slabs: float64 [k, 2], low and high in metres, ascending and adjacent, or one of any thickness; its index is the
    spans' layer. A slab without thickness is a slice.
    """
    if not len(triangles):
        return
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    length = np.linalg.norm(normal, axis=1)
    inner = np.divide(normal, length[:, None], out=np.zeros_like(normal), where=length[:, None] > 0)
    moved = triangles - INSET_METRES * inner[:, None, :]
    low, high = _shorten(moved[:, :, 2].min(axis=1), moved[:, :, 2].max(axis=1), INSET_METRES / 2)
    xy = frame.to_cells(moved[:, :, :2])
    aside = (xy.max(axis=1) < 0).any(axis=1) | (xy.min(axis=1) > [frame.width, frame.height]).any(axis=1)
    first = np.searchsorted(slabs[:, 1], low, side="left")
    end = np.searchsorted(slabs[:, 0], high, side="right")
    count = np.where(aside, 0, np.maximum(end - first, 0))
    for chosen in _portions(count):
        times = count[chosen]
        owner = np.repeat(chosen, times)
        layer = np.repeat(first[chosen], times) + _within(times)
        corners = np.concatenate([xy[owner], moved[owner][:, :, 2:]], axis=2)
        yield from _touched_cells(*_clip(corners, slabs[layer, 0], slabs[layer, 1]), layer, frame)


def _clip(corners: Array, low: Array, high: Array) -> tuple[Array, NDArray[np.int64]]:
    """Cut triangles [n, 3, 3] into convex pieces between two heights each: edges float64 [m, 2, 2], and their owners.

    A piece is enclosed by its edges' projections; if a triangle only touches, an edge may be a point.
    """
    a, b = corners, np.roll(corners, -1, axis=1)
    run = b[..., 2] - a[..., 2]
    owner = np.repeat(np.arange(len(corners)), 3).reshape(-1, 3)
    # the part of each edge between the heights, as parameters from a to b; level edges have none
    with np.errstate(all="ignore"):
        t0, t1 = (low[:, None] - a[..., 2]) / run, (high[:, None] - a[..., 2]) / run
    level = run == 0
    within = (a[..., 2] >= low[:, None]) & (a[..., 2] <= high[:, None])
    enter = np.where(level, np.where(within, 0.0, 2.0), np.clip(np.minimum(t0, t1), 0.0, None))
    leave = np.where(level, 1.0, np.clip(np.maximum(t0, t1), None, 1.0))
    mask = enter <= leave
    p = a[..., :2] + (b[..., :2] - a[..., :2]) * enter[..., None]
    q = a[..., :2] + (b[..., :2] - a[..., :2]) * leave[..., None]
    parts = [np.stack([p, q], axis=2)[mask]]
    owners = [owner[mask]]
    # two edges meet each cutting height: the line between their points closes the piece
    for z in (low, high):
        side = a[..., 2] > z[:, None]
        crossing = side != np.roll(side, -1, axis=1)
        cut = crossing.sum(axis=1) == 2
        if cut.any():
            with np.errstate(all="ignore"):
                t = np.clip((z[:, None] - a[..., 2]) / run, 0.0, 1.0)
                at = a[..., :2] + (b[..., :2] - a[..., :2]) * t[..., None]
            parts.append(at[cut][crossing[cut]].reshape(-1, 2, 2))
            owners.append(np.flatnonzero(cut))
    return np.concatenate(parts), np.concatenate(owners)


def _touched_cells(
    edges: Array, owner: NDArray[np.int64], layer: NDArray[np.int64], frame: RasterFrame
) -> Iterator[Spans]:
    """Return the cells that convex pieces touch, a span for each row.

    A span extends from the leftmost to the rightmost point of the piece's edges (float64 [m, 2, 2], in cells) in the
    row. layer: of each piece.
    """
    order = np.argsort(owner, kind="stable")
    edges, owner = edges[order], owner[order]
    starts = np.flatnonzero(np.diff(owner, prepend=-1)) if len(owner) else np.empty(0, np.int64)
    if not len(starts):
        return
    end = INSET_METRES / 2 / frame.resolution
    y = edges[..., 1]
    bottom, top = _shorten(np.minimum.reduceat(y.min(axis=1), starts), np.maximum.reduceat(y.max(axis=1), starts), end)
    size = np.diff(np.append(starts, len(owner)))
    low = np.maximum(np.floor(y.min(axis=1)), np.repeat(np.floor(bottom), size))
    high = np.minimum(np.floor(y.max(axis=1)), np.repeat(np.floor(top), size))
    low = np.clip(low, 0, frame.height).astype(np.int64)
    high = np.clip(high, -1, frame.height - 1).astype(np.int64)
    count = np.maximum(high - low + 1, 0)
    of_piece = np.add.reduceat(count, starts)
    bound = np.append(starts, len(owner))
    for pieces in _portions(of_piece):
        indices = np.concatenate([np.arange(bound[pieces[0]], bound[pieces[-1] + 1])])
        times = count[indices]
        edge_index = np.repeat(indices, times)
        if not len(edge_index):
            continue
        row = np.repeat(low[indices], times) + _within(times)
        (x0, y0), (x1, y1) = edges[edge_index, 0].T, edges[edge_index, 1].T
        run = y1 - y0
        with np.errstate(all="ignore"):
            at0, at1 = (row - y0) / run, (row + 1 - y0) / run
        flat = np.abs(run) <= end  # else rounding decides which part of a level edge is in the row
        t0 = np.where(flat, 0.0, np.clip(np.minimum(at0, at1), 0.0, 1.0))
        t1 = np.where(flat, 1.0, np.clip(np.maximum(at0, at1), 0.0, 1.0))
        left, right = x0 + (x1 - x0) * t0, x0 + (x1 - x0) * t1
        key = owner[edge_index] * frame.height + row
        order = np.argsort(key, kind="stable")
        begin = np.flatnonzero(np.diff(key[order], prepend=-1))
        leftmost = np.minimum.reduceat(np.minimum(left, right)[order], begin)
        rightmost = np.maximum.reduceat(np.maximum(left, right)[order], begin)
        leftmost, rightmost = _shorten(leftmost, rightmost, end)
        c0 = np.clip(np.floor(leftmost), 0, frame.width).astype(np.int64)
        c1 = np.clip(np.floor(rightmost) + 1, 0, frame.width).astype(np.int64)
        first = order[begin]
        spans = np.column_stack([layer[owner[edge_index[first]]], row[first], c0, c1])
        yield spans[c1 > c0]


def _shorten(low: Array, high: Array, end: float) -> tuple[Array, Array]:
    """Move the ends of ranges inwards; short ranges become their middle."""
    less = np.minimum(end, (high - low) / 2)
    return low + less, high - less


# --- insides ---------------------------------------------------------------------------------------------------------


def insides(triangles: Array, owner: NDArray[np.int64], frame: RasterFrame, heights: Array) -> Iterator[Spans]:
    """Return the cells whose middle is inside solids at each of the heights (metres, ascending).

    The height's index is the spans' layer. owner: int64 [n], the solid that a triangle belongs to; each solid is
    evaluated separately.
    """
    if not len(triangles):
        return
    z = triangles[:, :, 2]
    first = np.searchsorted(heights, z.min(axis=1), side="left")  # a vertex at a height counts as below it
    end = np.searchsorted(heights, z.max(axis=1), side="left")
    count = np.maximum(end - first, 0)
    # all crossings of a solid at one height must be in one block
    solids, of_solid = np.unique(owner, return_inverse=True)
    load = np.bincount(of_solid, count, len(solids)).astype(np.int64)
    order = np.argsort(of_solid, kind="stable")
    bound = np.append(0, np.cumsum(np.bincount(of_solid, minlength=len(solids))))
    for chosen in _portions(load):
        indices = order[bound[chosen[0]] : bound[chosen[-1] + 1]]
        times = count[indices]
        index = np.repeat(indices, times)
        layer = np.repeat(first[indices], times) + _within(times)
        if len(index):
            a = triangles[index]
            ends, through = _crossings(a, heights[layer])
            group = of_solid[index] * len(heights) + layer
            yield from _enclosed_cells(frame.to_cells(ends[through]), group[through], len(heights), frame)


def _crossings(corners: Array, height: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Intersect triangles with a height each: from the ascending edge to the descending edge.

    Returns float64 [n, 2, 2], and which triangles cross.
    """
    a, b = corners, np.roll(corners, -1, axis=1)
    above = a[..., 2] > height[:, None]
    then = np.roll(above, -1, axis=1)
    up, down = ~above & then, above & ~then
    through: NDArray[np.bool_] = np.asarray(up.any(axis=1))
    with np.errstate(all="ignore"):
        t = (height[:, None] - a[..., 2]) / (b[..., 2] - a[..., 2])
        at = a[..., :2] + (b[..., :2] - a[..., :2]) * t[..., None]
    n = np.arange(len(corners))
    return np.stack([at[n, up.argmax(axis=1)], at[n, down.argmax(axis=1)]], axis=1), through


def _enclosed_cells(edges: Array, group: NDArray[np.int64], layers: int, frame: RasterFrame) -> Iterator[Spans]:
    """Return the cells whose middle is inside closed directed edges (float64 [m, 2, 2], in cells), by group.

    The layer is the group modulo ``layers``.
    """
    y0, y1 = edges[:, 0, 1], edges[:, 1, 1]
    low = np.clip(np.ceil(np.minimum(y0, y1) - 0.5), 0, frame.height).astype(np.int64)
    end = np.clip(np.ceil(np.maximum(y0, y1) - 0.5), 0, frame.height).astype(np.int64)
    count = np.maximum(end - low, 0)
    groups, of_group = np.unique(group, return_inverse=True)
    load = np.bincount(of_group, count, len(groups)).astype(np.int64)
    order = np.argsort(of_group, kind="stable")
    bound = np.append(0, np.cumsum(np.bincount(of_group, minlength=len(groups))))
    for chosen in _portions(load):
        indices = order[bound[chosen[0]] : bound[chosen[-1] + 1]]
        times = count[indices]
        index = np.repeat(indices, times)
        if not len(index):
            continue
        row = np.repeat(low[indices], times) + _within(times)
        (ax, ay), (bx, by) = edges[index, 0].T, edges[index, 1].T
        x = ax + (bx - ax) * ((row + 0.5 - ay) / (by - ay))
        sign = np.where(by > ay, 1, -1)
        column = np.clip(np.ceil(x - 0.5), 0, frame.width).astype(np.int64)
        key = of_group[index] * frame.height + row
        sort = np.lexsort((column, key))
        key, column, sign, row, index = key[sort], column[sort], sign[sort], row[sort], index[sort]
        begin = np.flatnonzero(np.diff(key, prepend=-1))
        size = np.diff(np.append(begin, len(key)))
        total = np.add.reduceat(sign, begin)
        winding = np.cumsum(sign)
        winding -= np.repeat((winding - sign)[begin], size)
        closed = np.repeat(total == 0, size)
        inside = closed & (winding != 0)
        at = np.flatnonzero(inside)  # never a row's last crossing: there the winding of a closed row is 0 again
        spans = np.column_stack([groups[of_group[index[at]]] % layers, row[at], column[at], column[at + 1]])
        yield spans[spans[:, 3] > spans[:, 2]]


# --- polygons --------------------------------------------------------------------------------------------------------


def areas(polygons: Iterable[object], frame: RasterFrame, *, touched: bool) -> Iterator[Spans]:
    """Return the cells that polygons (shapely, metres) enclose, with ``touched`` also those that their outlines touch.

    The layer is 0. Lines and points count by the cells that they touch, in both cases.
    """
    # twice: a collection may contain several polygons in one of its parts
    parts = shapely.get_parts(shapely.get_parts(np.array(list(polygons), object)))
    parts = parts[~shapely.is_empty(parts)]
    flat = shapely.get_type_id(parts) == 3
    rings, owner = shapely.get_rings(shapely.orient_polygons(parts[flat]), return_index=True)
    edges, of_ring = _edges(rings)
    if len(edges):
        yield from _enclosed_cells(frame.to_cells(edges), owner[of_ring], 1, frame)
    if touched and len(edges):
        step = edges[:, 1] - edges[:, 0]
        length = np.linalg.norm(step, axis=1)
        left = np.column_stack([-step[:, 1], step[:, 0]])
        left = np.divide(left, length[:, None], out=np.zeros_like(left), where=length[:, None] > 0)
        yield from _merge_spans(lines(edges + INSET_METRES * left[:, None, :], frame))
    others = parts[~flat]
    straight, _ = _edges(others[np.isin(shapely.get_type_id(others), (1, 2))])
    yield from _merge_spans(lines(straight, frame))
    at = shapely.get_coordinates(others[shapely.get_type_id(others) == 0])
    yield from _merge_spans(lines(np.stack([at, at], axis=1), frame))


def _merge_spans(parts: Iterable[Spans]) -> Iterator[Spans]:
    """Return the spans, all in layer 0."""
    for spans in parts:
        spans[:, 0] = 0
        yield spans


def lines(edges: Array, frame: RasterFrame) -> Iterator[Spans]:
    """Return the cells that straight lines (float64 [n, 2, 2], metres) touch; a line's index is the spans' layer."""
    if len(edges):
        xy = frame.to_cells(edges)
        aside = (xy.max(axis=1) < 0).any(axis=1) | (xy.min(axis=1) > [frame.width, frame.height]).any(axis=1)
        indices = np.flatnonzero(~aside)
        yield from _touched_cells(xy[indices], np.arange(len(indices)), indices, frame)


def _edges(lines: NDArray[np.object_]) -> tuple[Array, NDArray[np.int64]]:
    """Return consecutive vertices of lines or rings as float64 [m, 2, 2], and the index of their line."""
    at, owner = shapely.get_coordinates(lines, return_index=True)
    same = owner[1:] == owner[:-1]
    return np.stack([at[:-1], at[1:]], axis=1)[same], owner[:-1][same]


# --- from spans to cells ---------------------------------------------------------------------------------------------


def paint(cells: NDArray[np.uint8], spans: Iterable[Spans], value: int) -> None:
    """Set the cells of spans (of any layer) to a value; cells: uint8 [height, width], row 0 the lowest."""
    width = cells.shape[1]
    rows = max(1, 2**22 // width)
    for part in spans:
        if not len(part):
            continue
        ordered = part[np.argsort(part[:, 1], kind="stable")]
        for low in range(int(ordered[0, 1]) // rows * rows, int(ordered[-1, 1]) + 1, rows):
            a, b = np.searchsorted(ordered[:, 1], (low, low + rows))
            band_spans = ordered[a:b]
            if not len(band_spans):
                continue
            low_row, high_row = int(band_spans[0, 1]), int(band_spans[-1, 1]) + 1
            left, right = int(band_spans[:, 2].min()), int(band_spans[:, 3].max())
            depth = np.zeros((high_row - low_row, right - left + 1), np.int32)
            np.add.at(depth, (band_spans[:, 1] - low_row, band_spans[:, 2] - left), 1)
            np.add.at(depth, (band_spans[:, 1] - low_row, band_spans[:, 3] - left), -1)
            np.cumsum(depth, axis=1, out=depth)
            cells[low_row:high_row, left:right][depth[:, :-1] > 0] = value


def expand_spans(spans: Spans) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return (layer, row, column) of every cell of the spans, with repeats."""
    times = spans[:, 3] - spans[:, 2]
    layer, row = np.repeat(spans[:, 0], times), np.repeat(spans[:, 1], times)
    return layer, row, np.repeat(spans[:, 2], times) + _within(times)


def flood(cells: NDArray[np.uint8], value: int, new: int) -> None:
    """Set all cells of a value that are connected to the border, by their sides through such cells, to a new value."""
    import cv2

    height, width = cells.shape
    rows, columns = np.arange(height), np.arange(width)
    for row, column in ((rows, 0), (rows, width - 1), (0, columns), (height - 1, columns)):
        for k in np.flatnonzero(cells[row, column] == value).tolist():
            x, y = (column, k) if isinstance(column, int) else (k, row)
            if cells[y, x] == value:  # not reached from another cell of the border
                cv2.floodFill(cells, None, (int(x), int(y)), new, flags=4)


def grow(cells: NDArray[np.uint8], value: int, distance: float) -> None:
    """Set all cells whose middle is at most ``distance`` cells from the middle of a cell of a value to it."""
    import cv2

    if distance <= 0 or not (cells == value).any():
        return
    height, width = cells.shape
    margin = math.ceil(distance) + 1
    rows = max(margin, 2**24 // width)
    source = cells.copy()
    for low in range(0, height, rows):
        top, end = max(0, low - margin), min(height, low + rows + margin)
        mask = source[top:end] == value
        if mask.any():
            away = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
            near = away[low - top : low - top + rows] <= distance + 1e-4
            cells[low : low + rows][near] = value


def check_frame(frame: RasterFrame, cap: int, longest: int) -> RasterFrame:
    """Check a frame. Raises CannotConvert if it has more cells than ``cap`` or a side longer than ``longest`` cells."""
    if frame.cells > cap or max(frame.width, frame.height) > longest:
        side = max(frame.width, frame.height) * frame.resolution
        needed = max(math.sqrt(frame.cells * frame.resolution**2 / cap), side / longest)
        raise CannotConvert(
            f"{frame.width} × {frame.height} cells of {frame.resolution:g} m are needed; the limit is {cap} cells and "
            f"{longest} along a side: set a resolution of at least {needed:.3g} m, or draw a smaller fence"
        )
    return frame


def _within(times: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return 0 … n-1 for each n, concatenated."""
    return np.arange(int(times.sum())) - np.repeat(np.cumsum(times) - times, times)


def _portions(load: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    """Split indexes into runs with a total load of about BLOCK_SIZE each; runs without load are skipped."""
    if not len(load) or not int(load.sum()):
        return
    bucket = (np.cumsum(load) - load) // BLOCK_SIZE
    cuts = np.flatnonzero(np.diff(bucket)) + 1
    for part in np.split(np.arange(len(load)), cuts):
        if int(load[part].sum()):
            yield part
