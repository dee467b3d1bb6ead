"""Pictures of a box of a coordinate reference system: maps and map tiles for GIS, in the style of previews.

Everything is drawn in pixels of the picture, +y up. Features are converted exactly. The transform of a raster is fitted
to its visible part, which is exact to a fraction of a pixel for sites of some kilometres.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import orjson
import shapely
from numpy.typing import NDArray

from app.convert.drawing import Canvas, Colour, Frame, Pixels
from app.convert.painting import Painter, Shapes, cells_of_columns, shapes_of
from app.convert.placement import image_transform, place_columns, place_raster
from app.convert.preview import MAX_IMAGES
from app.convert.pyramid import Size
from app.convert.recently_used import RecentlyUsed
from app.convert.tiles import Tiles
from app.model import masks
from app.model.antimeridian import cut_at_antimeridian
from app.model.features import Features
from app.model.frame import Datum
from app.model.geodesy import WGS84, LocalFrame, between, local_frame
from app.model.imagery import LOCAL, Affine, pixel_positions
from app.model.layers import MAP, VECTOR_LAYERS
from app.store.store import Store
from app.store.values import Box, PartEntry, Version
from app.syntax import images
from app.syntax.geotiff import fit_affine

WRITER = 2
"""Version of the pictures: raise it whenever equal content gives another one."""

MAX_SIDE = 2048
"""Maximum width and height of a picture in pixels."""

MAX_PICTURE_BYTES = 48 * 2**20
MAX_SHAPE_BYTES = 128 * 2**20
SHAPE_BYTES = 400
"""Estimated size of a converted feature besides its coordinates."""

MARGIN = 64.0
"""Pixels around the picture in which features are drawn, for their widths."""

FAR = 2.0**15
"""Pixels around the picture beyond which geometries are cut, as coordinates of a drawing are limited."""

GLOBES: Mapping[str, float] = {WGS84: 360.0, "EPSG:3857": 2 * math.pi * 6378137.0}
"""Lengths of the equator in the CRSs that end at the antimeridian."""

STEPS = 5
"""Number of points along each side of a raster's visible part to which its transform is fitted."""

Window = tuple[int, int, int, int]
Colouring = Callable[[Pixels], Pixels]

RASTERS = ("imagery", "voxels", "occupancy")


@dataclass(frozen=True, slots=True)
class View:
    """Picture of a box. crs: ``local``, or a CRS of PROJ; box: in it, x (easting, longitude) first; size in pixels."""

    crs: str
    box: Box
    width: int
    height: int

    def to_pixels(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert coordinates of the CRS to pixels, +y up."""
        x0, y0, x1, y1 = self.box
        return (points - (x0, y0)) * (self.width / (x1 - x0), self.height / (y1 - y0))

    def globes(self) -> Iterator[View]:
        """Yield the view, and the same one of the globe beyond the antimeridian if it reaches there."""
        yield self
        x0, y0, x1, y1 = self.box
        turn = GLOBES.get(self.crs, math.inf)
        for beyond in (-turn if x0 < -turn / 2 else 0.0, turn if x1 > turn / 2 else 0.0):
            if beyond:
                yield replace(self, box=(x0 - beyond, y0, x1 - beyond, y1))

    @property
    def unit(self) -> float:
        """Return the pixels of one unit of the CRS."""
        x0, y0, x1, y1 = self.box
        return math.sqrt(self.width / (x1 - x0) * self.height / (y1 - y0))


@dataclass(frozen=True, slots=True)
class ViewContent:
    """What to draw. parts: in any order; shape_types: of features to draw, shapely's numbers; None: all."""

    parts: Sequence[PartEntry]
    shape_types: frozenset[int] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class _Converted:
    """Features of a part in a CRS, with their boxes."""

    shapes: Shapes
    bounds: NDArray[np.float64]

    @property
    def size(self) -> int:
        geometry = self.shapes.geometry
        return SHAPE_BYTES * len(geometry) + 16 * int(shapely.get_num_coordinates(geometry).sum())


def view_key(version: Version, content: ViewContent, view: View, background: Colour | None) -> str:
    """Return the hash of everything that a picture shows."""
    parts = sorted([e.key.layer, e.key.level, e.key.name, e.hash] for e in content.parts)
    datum = None if version.datum is None else version.datum.as_dict()
    types = None if content.shape_types is None else sorted(content.shape_types)
    values = ["view", WRITER, parts, types, datum, view.crs, view.box, view.width, view.height, background]
    return hashlib.sha256(orjson.dumps(values)).hexdigest()


class Views:
    """Pictures of boxes. Thread-safe; every method may take seconds, none is for the event loop."""

    def __init__(self, store: Store, tiles: Tiles) -> None:
        self._store, self._tiles = store, tiles
        self._converted: RecentlyUsed[_Converted] = RecentlyUsed(MAX_SHAPE_BYTES, lambda one: one.size)
        self._pictures: RecentlyUsed[bytes] = RecentlyUsed(MAX_PICTURE_BYTES, len)

    def png(self, version: Version, content: ViewContent, view: View, background: Colour | None) -> bytes:
        """Draw a picture of a version with a datum, as PNG; transparent without a background."""
        assert version.datum is not None
        key = view_key(version, content, view, background)
        cached = self._pictures.get(key)
        if cached is not None:
            return cached
        canvas = Canvas(Frame(view.width, view.height, 0.0, float(view.height), 1.0), background)
        painter = Painter("light", {e.key.layer for e in content.parts})
        drawing = _Drawing(self._tiles, version, view, canvas, painter)
        drawing.rasters(content.parts)
        parts = {}
        for entry in content.parts:
            if entry.key.layer in VECTOR_LAYERS:
                converted = self._convert(version, version.datum, entry, view.crs)
                parts[entry.key] = _joined([_visible(converted, one, content.shape_types) for one in view.globes()])
        painter.features(canvas, parts, 1.0)
        return self._pictures.put(key, images.encode_png(canvas.finish()))

    def _convert(self, version: Version, datum: Datum, entry: PartEntry, crs: str) -> _Converted:
        key = (entry.hash, datum, crs)
        cached = self._converted.get(key)
        if cached is not None:
            return cached
        part = self._store.content.load(version, [entry.key]).parts[entry.key]
        assert isinstance(part, Features)
        frame = local_frame(datum)
        if crs == LOCAL:
            geometry = part.geometry.copy()
            geometry[~part.local] = frame.near_geometries_to_local(geometry[~part.local])
        else:
            geometry = shapely.force_2d(part.in_wgs84(frame))
            geometry = cut_at_antimeridian(geometry) if crs in GLOBES else geometry
            geometry = shapely.transform(geometry, partial(between, WGS84, crs))
        shapes = shapes_of(part, geometry, np.ones(len(part), bool))
        return self._converted.put(key, _Converted(shapes, shapely.bounds(shapes.geometry).reshape(-1, 4)))


def _visible(converted: _Converted, view: View, types: Collection[int] | None) -> Shapes:
    """Return the features that a picture shows, in its pixels."""
    corners = view.to_pixels(converted.bounds.reshape(-1, 2)).reshape(-1, 4)
    x0, y0, x1, y1 = corners.T
    with np.errstate(invalid="ignore"):  # nothing is visible of a feature outside the CRS
        shown = (x1 >= -MARGIN) & (y1 >= -MARGIN) & (x0 <= view.width + MARGIN) & (y0 <= view.height + MARGIN)
        far = (x0 < -FAR) | (y0 < -FAR) | (x1 > view.width + FAR) | (y1 > view.height + FAR)
    shapes = converted.shapes
    if types is not None:
        shown &= np.isin(shapely.get_type_id(shapes.geometry), list(types))
    rows = np.flatnonzero(shown)
    geometry = shapely.transform(shapes.geometry[rows], view.to_pixels)
    cut = np.flatnonzero(far[rows])
    if len(cut):
        geometry[cut] = shapely.clip_by_rect(geometry[cut], -FAR, -FAR, view.width + FAR, view.height + FAR)
    return Shapes(geometry, [shapes.kinds[row] for row in rows.tolist()], shapes.spacing * view.unit)


def _joined(shapes: Sequence[Shapes]) -> Shapes:
    if len(shapes) == 1:
        return shapes[0]
    geometry = np.concatenate([one.geometry for one in shapes])
    return Shapes(geometry, [kind for one in shapes for kind in one.kinds], shapes[0].spacing)


class _Drawing:
    """The rasters of one picture."""

    def __init__(self, tiles: Tiles, version: Version, view: View, canvas: Canvas, painter: Painter) -> None:
        assert version.datum is not None
        self._tiles, self._version, self._view = tiles, version, view
        self._frame: LocalFrame = local_frame(version.datum)
        self._canvas, self._painter = canvas, painter

    def rasters(self, parts: Sequence[PartEntry]) -> None:
        """Draw images, then voxels, then grids with ``map`` first, then masks."""
        by_layer = {layer: [e for e in parts if e.key.layer == layer] for layer in RASTERS}
        over = bool(by_layer["imagery"])
        for entry in sorted(by_layer["imagery"], key=self._pixel_area)[::-1][:MAX_IMAGES]:
            self._raster(entry, self._painter.image)
        for entry in by_layer["voxels"]:
            self._columns(entry)
        grids = [e for e in by_layer["occupancy"] if not self._is_mask(e)]
        for entry in sorted(grids, key=lambda e: (e.key.name != MAP, e.key.name))[:1]:
            self._raster(entry, partial(self._painter.cells, over=over))
        for entry in by_layer["occupancy"]:
            if self._is_mask(entry):
                self._raster(entry, partial(self._painter.mask, name=entry.key.name))

    def _is_mask(self, entry: PartEntry) -> bool:
        return entry.key.name in masks.MASKS or masks.NAME in self._tiles.header(entry).header["properties"]

    def _pixel_area(self, entry: PartEntry) -> float:
        a, b, _, d, e, _ = place_raster(self._tiles.header(entry), self._frame.datum).transform
        return abs(a * e - b * d)

    def _raster(self, entry: PartEntry, colour: Colouring) -> None:
        reader = self._tiles.header(entry)
        image = reader.kind != "grid"
        crs = str(reader.header["crs"]) if image else LOCAL
        transform = image_transform(reader.header) if image else place_raster(reader, None).transform
        place = self._place(transform, crs, Size(reader.width, reader.height))
        if place is None:
            return
        (top, left, bottom, right), k, fitted = place
        pixels = self._tiles.window(entry, k, (top, left, bottom, right))
        self._canvas.raster(colour(pixels), _part_transform(fitted, k, top, left))

    def _columns(self, entry: PartEntry) -> None:
        columns = self._tiles.columns(self._version, entry.key)
        place = self._place(place_columns(columns).transform, LOCAL, Size(columns.width, columns.height))
        if place is not None:
            (top, left, bottom, right), k, fitted = place
            cells = cells_of_columns(columns, k)[top:bottom, left:right]
            self._canvas.raster(self._painter.cells(cells, over=False), _part_transform(fitted, k, top, left))

    def _place(self, transform: Affine, crs: str, size: Size) -> tuple[Window, int, Affine] | None:
        """Return what of a raster is visible: a window at a reduction, the reduction, and the transform to pixels.

        None if nothing is. The transform is for the raster's own pixels.
        """
        whole = (0.0, 0.0, float(size.height), float(size.width))
        fitted = self._fit(transform, crs, whole)
        window = None if fitted is None else self._seen(fitted, whole)
        if fitted is None or window is None:
            return None
        fitted = self._fit(transform, crs, window) or fitted
        a, b, _, d, e, _ = fitted
        k = min(max(0, round(-math.log2(math.sqrt(abs(a * e - b * d))))), size.levels - 1)
        side = 2**k
        top, left = (int(v // side) for v in window[:2])
        reduced = size.reduced(k)
        bottom, right = (
            min(math.ceil(window[2] / side), reduced.height),
            min(math.ceil(window[3] / side), reduced.width),
        )
        return (top, left, bottom, right), k, fitted

    def _fit(self, transform: Affine, crs: str, window: Sequence[float]) -> Affine | None:
        """Fit the transform from (column, row) to pixels of the picture; None if the window is not in its CRS."""
        top, left, bottom, right = window
        sides = np.meshgrid(np.linspace(left, right, STEPS), np.linspace(top, bottom, STEPS))
        columns, rows = (side.ravel() for side in sides)
        points = pixel_positions(transform, columns, rows)
        if crs != self._view.crs:
            points = self._frame.to_wgs84(points) if crs == LOCAL else between(crs, WGS84, points)
            to_local = self._view.crs == LOCAL
            points = self._frame.to_local(points) if to_local else between(WGS84, self._view.crs, points)
        turn = GLOBES.get(self._view.crs)
        if turn is not None:  # a raster across the antimeridian continues beyond it, on the side that is drawn
            points[:, 0] -= turn * np.round((points[:, 0] - points[0, 0]) / turn)
            middle = (self._view.box[0] + self._view.box[2]) / 2
            points[:, 0] -= turn * round((float(points[:, 0].mean()) - middle) / turn)
        fit = fit_affine(np.column_stack([columns, rows, self._view.to_pixels(points)]).tolist())
        return None if fit is None or fit[0][0] * fit[0][4] == fit[0][1] * fit[0][3] else fit[0]

    def _seen(self, fitted: Affine, whole: Sequence[float]) -> tuple[float, float, float, float] | None:
        """Return the rows and columns that the picture shows, with a margin; None if there are none."""
        a, b, c, d, e, f = fitted
        area = a * e - b * d
        x = np.array([-1.0, -1.0, 1.0, 1.0]) * (self._view.width / 2 + 2) + self._view.width / 2 - c
        y = np.array([-1.0, 1.0, -1.0, 1.0]) * (self._view.height / 2 + 2) + self._view.height / 2 - f
        columns, rows = (e * x - b * y) / area, (a * y - d * x) / area
        pad = 2.0 / math.sqrt(abs(area)) + 2.0
        top, bottom = max(whole[0], rows.min() - pad), min(whole[2], rows.max() + pad)
        left, right = max(whole[1], columns.min() - pad), min(whole[3], columns.max() + pad)
        return (float(top), float(left), float(bottom), float(right)) if top < bottom and left < right else None


def _part_transform(transform: Affine, k: int, top: int, left: int) -> Affine:
    """Return the transform of a window of a raster at a reduction."""
    a, b, c, d, e, f = transform
    side = 2**k
    u, v = left * side, top * side
    return a * side, b * side, c + a * u + b * v, d * side, e * side, f + d * u + e * v
