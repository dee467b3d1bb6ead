"""Picture of what differs between two versions, in the local frame, +y up."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import shapely
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from app.convert.drawing import Canvas, Colour, Frame, Pixels, fit_frame
from app.convert.placement import place_raster
from app.convert.pyramid import Size, reduced_transform
from app.convert.tiles import Tiles
from app.model.features import Features, features
from app.model.frame import Anchor
from app.model.geodesy import LocalFrame, local_frame
from app.model.grid import OCCUPIED, UNKNOWN
from app.model.imagery import Affine
from app.model.layers import PartKey
from app.model.network import middle_frame
from app.store.diff import cell_box
from app.store.store import Store
from app.store.values import Box, GridDelta, PartEntry, Version
from app.syntax import images

SIDE = 1024
"""Width of the picture in pixels, and its maximum height."""

MARGIN = 40.0
ASPECT = (1 / 16, 1.0)
BACKGROUND: Colour = (255, 255, 255)
ADDED: Colour = (0, 140, 60)
DELETED: Colour = (200, 30, 30)
CHANGED: Colour = (230, 140, 0)
SAME: Colour = (205, 205, 205)

CELLS: dict[int, Colour] = {
    1: (203, 36, 49),
    2: (22, 112, 214),
    3: (128, 136, 140),
    4: (92, 168, 214),
    5: (139, 30, 107),
    6: (196, 140, 10),
}
"""Colours of changed cells, by the numbers of their tiles: red is blocked now, blue is free now."""


class ChangePicture:
    """Drawing of one difference: grids below, what stays in grey, what was deleted, changed and added above."""

    def __init__(self, store: Store, tiles: Tiles, old: Version, new: Version) -> None:
        self._store, self._tiles, self._old, self._new = store, tiles, old, new
        self._delta = store.content.delta_parts(old, new)
        self._groups = self._load_groups()
        self._local = self._choose_frame()

    def png(self) -> bytes:
        """Draw the picture."""
        shapes = {kind: self._shapes(parts) for kind, parts in self._groups.items()}
        boxes = [shapely.total_bounds(some) for some in shapes.values() if len(some)]
        boxes += [box for grid in self._delta.grids for box in self._grid_boxes(grid)]
        finite = np.array([box for box in boxes if np.isfinite(box).all()]).reshape(-1, 4)
        if not len(finite):
            return images.encode_png(_empty())
        canvas = Canvas(fit_frame(_grown(finite), SIDE, MARGIN, ASPECT), BACKGROUND)
        for grid in self._delta.grids:
            self._draw_grid(canvas, grid.key)
        around = self._shapes(self._load_around(canvas.frame))
        canvas.lines(around, SAME, 1.5)
        canvas.dots(around, SAME, 3.0)
        for kind, colour, opacity in (
            ("deleted", DELETED, 1.0),
            ("before", CHANGED, 0.4),
            ("after", CHANGED, 1.0),
            ("added", ADDED, 1.0),
        ):
            canvas.areas(shapes[kind], colour, 0.15 * opacity)
            canvas.lines(shapes[kind], colour, 2.5, opacity)
            canvas.dots(shapes[kind], colour, 4.5, opacity)
        return images.encode_png(canvas.finish())

    # --- features ---

    def _load_groups(self) -> dict[str, list[Features]]:
        groups: dict[str, list[Features]] = {"deleted": [], "before": [], "after": [], "added": []}
        for changed in self._delta.features:
            was = _select(self._store, self._old, changed.key, changed.put.ids)
            old_ids = set(was.ids)
            groups["deleted"].append(_select(self._store, self._old, changed.key, changed.deleted))
            groups["before"].append(was)
            groups["after"].append(changed.put.select([k for k, i in enumerate(changed.put.ids) if i in old_ids]))
            groups["added"].append(changed.put.select([k for k, i in enumerate(changed.put.ids) if i not in old_ids]))
        return groups

    def _choose_frame(self) -> LocalFrame | None:
        """Return the local frame; without a datum one in the middle of what changed, if none of it is in metres."""
        if datum := self._new.datum or self._old.datum:
            return local_frame(datum)
        parts = [part for group in self._groups.values() for part in group if len(part)]
        if self._delta.grids or not parts or any(part.local.any() for part in parts):
            return None
        boxes = np.array([shapely.total_bounds(part.geometry) for part in parts])
        return middle_frame(boxes.reshape(-1, 2))

    def _shapes(self, parts: Sequence[Features]) -> NDArray[np.object_]:
        """Return geometries in metres; without a frame only those that are."""
        frame = self._local
        shapes = [part.geometry[part.local] if frame is None else part.in_local(frame) for part in parts]
        return np.concatenate([np.empty(0, object), *shapes])

    def _load_around(self, frame: Frame) -> list[Features]:
        """Load what the picture shows of the layers that differ, whether it changed or not."""
        box = (frame.left, frame.top - frame.height * frame.scale, frame.left + frame.width * frame.scale, frame.top)
        crs: Anchor = "local"
        if self._new.datum is None and self._local is not None:
            crs, corners = "wgs84", self._local.to_wgs84(np.array(box).reshape(2, 2))
            box = (*corners[0].tolist(), *corners[1].tolist())
        present = [changed.key for changed in self._delta.features if self._new.part(changed.key) is not None]
        return [self._store.content.features(self._new, key, bbox=box, crs=crs) for key in present]

    # --- grids ---

    def _grid_boxes(self, grid: GridDelta) -> list[Box]:
        """Bound the changed cells, or both grids if their frames differ."""
        entries = [entry for version in (self._old, self._new) if (entry := version.part(grid.key)) is not None]
        headers = [self._tiles.header(entry).header for entry in entries]
        if grid.whole or grid.deleted:
            return [cell_box(header, 0, 0, header["width"], header["height"]) for header in headers]
        boxes = []
        for changed in grid.rectangles:
            height, width = changed.cells.shape
            row, column = changed.row, changed.column
            boxes.append(cell_box(headers[-1], column, row, column + width, row + height))
        return boxes

    def _draw_grid(self, canvas: Canvas, key: PartKey) -> None:
        old, new = self._old.part(key), self._new.part(key)
        shown = new or old
        assert shown is not None
        reader = self._tiles.header(shown)
        size, transform = Size(reader.width, reader.height), place_raster(reader, None).transform
        self._draw_cells(canvas, shown, size, transform)
        changes = self._store.content.cell_changes(*(entry.hash if entry else None for entry in (old, new)))
        cell = math.hypot(transform[0], transform[3])
        k = min(max(0, math.floor(math.log2(canvas.frame.scale / cell))), size.reduction(SIDE) + 1)
        small, window = size.reduced(k), reduced_transform(transform, k)
        left, top, right, bottom = _seen(canvas.frame, window, small)
        if right <= left or bottom <= top:
            return
        table = np.zeros((256, 4), np.uint8)
        for value, colour in CELLS.items():
            table[value] = (*colour, 255)
        a, b, c, d, e, f = window
        seen = (a, b, c + a * left + b * top, d, e, f + d * left + e * top)
        canvas.raster(table[changes.reduce(k, top, left, bottom - top, right - left)], seen)

    def _draw_cells(self, canvas: Canvas, entry: PartEntry, size: Size, transform: Affine) -> None:
        """Draw the grid's own cells in light grey."""
        table = np.full((256, 4), 255, np.uint8)
        table[: OCCUPIED + 1, :3] = (250 - np.arange(OCCUPIED + 1))[:, None]
        table[UNKNOWN, :3] = 225
        k = size.reduction(SIDE)
        canvas.raster(table[self._tiles.reduced(entry, k)], reduced_transform(transform, k))


def _select(store: Store, version: Version, key: PartKey, ids: tuple[str, ...]) -> Features:
    """Load the given features, skipping those that the version lacks."""
    if version.part(key) is None:
        return features((), "local")
    return store.content.features(version, key, ids=ids)


def _grown(boxes: NDArray[np.float64]) -> Box:
    """Return the box around all boxes; around a single point, ten metres."""
    (x0, y0), (x1, y1) = boxes[:, :2].min(axis=0).tolist(), boxes[:, 2:].max(axis=0).tolist()
    return (x0, y0, x1, y1) if x1 > x0 or y1 > y0 else (x0 - 5.0, y0 - 5.0, x1 + 5.0, y1 + 5.0)


def _seen(frame: Frame, transform: Affine, size: Size) -> tuple[int, int, int, int]:
    """Return the columns and rows of a raster that a picture shows: left, top, right, bottom."""
    a, b, c, d, e, f = transform
    width, height = frame.width * frame.scale, frame.height * frame.scale
    corners = np.array([(x, y) for x in (frame.left, frame.left + width) for y in (frame.top, frame.top - height)])
    pixels = np.linalg.solve(np.array([[a, b], [d, e]]), (corners - (c, f)).T)
    low, high = np.floor(pixels.min(axis=1)).astype(int) - 1, np.ceil(pixels.max(axis=1)).astype(int) + 1
    (left, top), (right, bottom) = np.maximum(low, 0).tolist(), np.minimum(high, (size.width, size.height)).tolist()
    return left, top, right, bottom


def _empty() -> Pixels:
    image = Image.new("RGB", (256, 64), "white")
    ImageDraw.Draw(image).text((12, 24), "no differences to draw", fill=(60, 60, 60))
    return np.asarray(image)
