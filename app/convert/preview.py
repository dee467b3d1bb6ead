"""Preview of a version: one picture of the whole site in the local frame, +y up."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import orjson
import shapely
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from app.convert.cache import Cache, ConvertedMap
from app.convert.drawing import Canvas, Pixels, fit_frame
from app.convert.painting import THEMES, Painter, Shapes, ThemeName, cells_of_columns, shapes_of
from app.convert.placement import Placement, place_columns, place_raster
from app.convert.pyramid import Size, reduced_transform
from app.convert.report import Report
from app.convert.tiles import Tiles
from app.errors import Invalid, MissingDatum, NotFound, Problem
from app.model import masks
from app.model.features import Features
from app.model.frame import GROUND
from app.model.geodesy import LocalFrame, local_frame
from app.model.grid import UNKNOWN
from app.model.imagery import Affine
from app.model.layers import MAP, VECTOR_LAYERS, PartKey
from app.model.names import did_you_mean
from app.model.network import middle_frame
from app.store.store import Store
from app.store.values import Box, PartEntry, Version
from app.syntax import images

PreviewLayer = Literal["imagery", "voxels", "occupancy", "zones", "objects", "topology", "location"]
LAYERS: tuple[PreviewLayer, ...] = get_args(PreviewLayer)
"""Layers of a preview, from the bottom up."""

WRITER = 2
"""Version of the picture: raise it whenever equal content gives another one."""

MIN_WIDTH, MAX_WIDTH, DEFAULT_WIDTH = 64, 2048, 640
ASPECT = (0.5, 1.25)
"""Limits of height / width."""

MARGIN = 0.04
"""Margin around the content, as a share of the width."""

MAX_SURROUNDINGS = 4.0
"""Maximum area of a site with its objects, per area without them; beyond it, objects are cut off."""

SURROUNDINGS = 0.1
"""Surroundings that are shown of a site whose objects are cut off, as a share of its longer side."""

MAX_IMAGES = 8
"""Maximum number of images below a picture; those with the coarsest pixels are at the bottom."""


@dataclass(frozen=True, slots=True)
class PreviewRequest:
    """What to draw. layers: None for all; level: None for the ground, else the lowest."""

    layers: tuple[PreviewLayer, ...] | None = None
    level: str | None = None
    width: int = DEFAULT_WIDTH
    theme: ThemeName = "light"


@dataclass(frozen=True, slots=True, eq=False)
class _Raster:
    """Drawn pixels RGBA with their position, and the box around those that are not transparent."""

    rgba: Pixels
    transform: Affine
    box: Box | None


def parse_layers(text: str | None) -> tuple[PreviewLayer, ...] | None:
    """Parse a comma-separated list of layers, in the order of drawing. Raises Invalid for unknown ones."""
    if text is None:
        return None
    names = {name.strip() for name in text.split(",")}
    for name in sorted(names - set(LAYERS)):
        raise Invalid(
            f"unknown layer {name[:80]!r}{did_you_mean(name, LAYERS)}; available: {', '.join(LAYERS)}",
            [Problem("unknown layer", where="layers")],
        )
    return tuple(layer for layer in LAYERS if layer in names)


def preview_key(version: Version, request: PreviewRequest) -> str:
    """Return the hash of everything that a picture shows."""
    parts = sorted([e.key.layer, e.key.level, e.key.name, e.hash] for e in version.parts)
    datum = None if version.datum is None else version.datum.as_dict()
    levels = [[level.name, level.elevation] for level in version.levels]
    selection = [request.layers, request.level, request.width, request.theme]
    return hashlib.sha256(orjson.dumps(["preview", WRITER, parts, datum, levels, selection])).hexdigest()


class Previews:
    """Pictures of versions, cached by what they show. Thread-safe; not for the event loop."""

    def __init__(self, store: Store, tiles: Tiles, cache: Cache) -> None:
        self._store, self._tiles, self._cache = store, tiles, cache

    def png(self, version: Version, request: PreviewRequest) -> bytes:
        """Return the picture as PNG. Raises NotFound for a level or layers that the version lacks."""
        entries = select_entries(version, request)

        def make() -> ConvertedMap:
            pixels = _Drawing(self._store, self._tiles, version, request, entries).pixels()
            return ConvertedMap({"preview.png": (images.encode_png(pixels), "image/png")}, None, Report("preview"))

        return self._cache.get_or_make(preview_key(version, request), make, uses_cache=True).files[0].read()


def select_entries(version: Version, request: PreviewRequest) -> list[PartEntry]:
    """Select the parts of a picture: one level, and the fence of all. Raises NotFound."""
    entries = [e for e in version.parts if e.key.layer in LAYERS and e.count]
    levels = sorted({e.key.level for e in entries} | {level.name for level in version.levels})
    if request.level is not None and request.level not in levels:
        raise NotFound(
            f"unknown level {request.level!r}{did_you_mean(request.level, levels)}; available: "
            f"{', '.join(levels) or 'none'}"
        )
    chosen = request.level if request.level is not None else _default_level(version, entries)
    entries = [e for e in entries if e.key.layer == "location" or e.key.level == chosen]
    if request.layers is None:
        base = {e.key.layer for e in entries} & {"imagery", "occupancy"}
        return [e for e in entries if e.key.layer != "voxels" or not base]
    missing = [layer for layer in request.layers if layer not in {e.key.layer for e in entries}]
    if missing:
        existing = ", ".join(layer for layer in LAYERS if any(e.key.layer == layer for e in entries)) or "none"
        raise NotFound(f"level {chosen} has no {missing[0]}; available: {existing}")
    return [e for e in entries if e.key.layer in request.layers]


def _default_level(version: Version, entries: Sequence[PartEntry]) -> str:
    """Return the ground if it has content, else the lowest level with content."""
    heights = {level.name: level.elevation for level in version.levels}
    names = {e.key.level for e in entries if e.key.layer != "location"}
    if GROUND in names or not names:
        return GROUND
    return min(names, key=lambda name: (abs(heights.get(name, math.inf)), name))


class _Drawing:
    """One picture."""

    def __init__(
        self, store: Store, tiles: Tiles, version: Version, request: PreviewRequest, entries: Sequence[PartEntry]
    ) -> None:
        self._store, self._tiles, self._version = store, tiles, version
        self._request, self._entries = request, entries
        self._theme = THEMES[request.theme]
        self._painter = Painter(request.theme, {e.key.layer for e in entries})
        self._features = self._load_features()
        self._frame = self._choose_frame()

    def pixels(self) -> Pixels:
        """Draw the picture: uint8 [height, width, 3]."""
        shapes = {key: self._shapes(part) for key, part in self._features.items()}
        rasters = self._rasters()
        box = _site_box([r.box for r in rasters], {key: part.geometry for key, part in shapes.items()})
        if box is None:
            return self._empty()
        width = self._request.width
        frame = fit_frame(box, width, width * MARGIN, ASPECT)
        canvas = Canvas(frame, self._theme.background)
        for raster in rasters:
            canvas.raster(raster.rgba, raster.transform)
        weight = min(max(width / DEFAULT_WIDTH, 0.5), 2.0)
        self._painter.features(canvas, shapes, weight)
        return canvas.finish()

    def _load_features(self) -> dict[PartKey, Features]:
        keys = [e.key for e in self._entries if e.key.layer in VECTOR_LAYERS]
        loaded = self._store.content.load(self._version, keys).parts
        return {key: part for key, part in loaded.items() if isinstance(part, Features)}

    def _choose_frame(self) -> LocalFrame | None:
        """Return the local frame; without a datum one in the middle of the content, if none of it is in metres."""
        if self._version.datum is not None:
            return local_frame(self._version.datum)
        if any(e.bounds.get("local") is not None for e in self._entries):
            return None
        boxes = [box for e in self._entries if (box := e.bounds.get("wgs84")) is not None]
        return middle_frame(np.array(boxes).reshape(-1, 2)) if boxes else None

    def _shapes(self, part: Features) -> Shapes:
        """Return geometries in metres; without a frame only those that are."""
        if self._frame is None:
            return shapes_of(part, part.geometry[part.local], part.local)
        return shapes_of(part, part.in_local(self._frame), np.ones(len(part), bool))

    # --- rasters ---

    def _rasters(self) -> list[_Raster]:
        by_layer = {layer: [e for e in self._entries if e.key.layer == layer] for layer in LAYERS}
        out = [r for e in by_layer["imagery"] if (r := self._image(e)) is not None]
        out = sorted(out, key=lambda r: -abs(r.transform[0] * r.transform[4] - r.transform[1] * r.transform[3]))
        out = out[:MAX_IMAGES]
        over = bool(out)
        out += [self._columns(e) for e in by_layer["voxels"][:1]]
        grids = [e for e in by_layer["occupancy"] if not self._is_mask(e)]
        grids.sort(key=lambda e: (e.key.name != MAP, e.key.name))
        out += [self._grid(e, over=over) for e in grids[:1]]
        if not by_layer["zones"]:
            out += [self._mask(e) for e in by_layer["occupancy"] if e not in grids]
        return out

    def _is_mask(self, entry: PartEntry) -> bool:
        return entry.key.name in masks.MASKS or masks.NAME in self._tiles.header(entry).header["properties"]

    def _reduce(self, entry: PartEntry, placement: Placement) -> tuple[Pixels, Affine]:
        """Read a raster at about twice the picture's pixels."""
        reader = self._tiles.header(entry)
        k = Size(reader.width, reader.height).reduction(self._request.width)
        return self._tiles.reduced(entry, k), reduced_transform(placement.transform, k)

    def _image(self, entry: PartEntry) -> _Raster | None:
        datum = None if self._frame is None else self._frame.datum
        try:
            placement = place_raster(self._tiles.header(entry), datum)
        except MissingDatum:
            return None
        rgba, transform = self._reduce(entry, placement)
        rgba = self._painter.image(rgba)
        return _Raster(rgba, transform, _visible_box(rgba[..., 3] > 0, transform))

    def _grid(self, entry: PartEntry, *, over: bool) -> _Raster:
        cells, transform = self._reduce(entry, place_raster(self._tiles.header(entry), None))
        return _Raster(self._painter.cells(cells, over=over), transform, _visible_box(cells != UNKNOWN, transform))

    def _columns(self, entry: PartEntry) -> _Raster:
        columns = self._tiles.columns(self._version, entry.key)
        k = Size(columns.width, columns.height).reduction(self._request.width)
        cells, transform = cells_of_columns(columns, k), reduced_transform(place_columns(columns).transform, k)
        return _Raster(self._painter.cells(cells, over=False), transform, _visible_box(cells != UNKNOWN, transform))

    def _mask(self, entry: PartEntry) -> _Raster:
        """Tint the marked cells of a costmap filter mask."""
        cells, transform = self._reduce(entry, place_raster(self._tiles.header(entry), None))
        return _Raster(self._painter.mask(cells, entry.key.name), transform, None)

    def _empty(self) -> Pixels:
        """Return a picture that says that there is nothing to draw."""
        width = self._request.width
        image = Image.new("RGB", (width, width // 2), self._theme.background)
        font = ImageFont.load_default(max(10, width / 32))
        ImageDraw.Draw(image).text((width / 2, width / 4), "nothing to draw", self._theme.text, font, anchor="mm")
        return np.asarray(image)


def _site_box(rasters: Sequence[Box | None], shapes: Mapping[PartKey, NDArray[np.object_]]) -> Box | None:
    """Return the box in metres that a picture shows: all but objects far beyond the rest, such as a ground plane."""
    boxes = [box for box in rasters if box is not None]
    boxes += [_box(shape) for key, shape in shapes.items() if key.layer != "objects" and len(shape)]
    site = _join(boxes)
    objects = [shapely.bounds(shape) for key, shape in shapes.items() if key.layer == "objects" and len(shape)]
    if not objects:
        return site
    bounds = np.concatenate(objects)
    if site is None:  # without its largest object, if that is a ground plane
        largest = int(_areas(bounds).argmax())
        site = _join(np.delete(bounds, largest, axis=0).tolist())
    around = _join([*bounds.tolist(), *([site] if site else [])])
    if site is None or around is None or _area(around) <= MAX_SURROUNDINGS * _area(site):
        return around
    pad = SURROUNDINGS * max(site[2] - site[0], site[3] - site[1])
    return site[0] - pad, site[1] - pad, site[2] + pad, site[3] + pad


def _join(boxes: Sequence[Sequence[float]]) -> Box | None:
    """Return the box around finite boxes, at least ten metres wide or high; None if there are none."""
    finite = np.array([box for box in boxes if all(map(math.isfinite, box))]).reshape(-1, 4)
    if not len(finite):
        return None
    low, high = finite[:, :2].min(axis=0), finite[:, 2:].max(axis=0)
    if not (high > low).any():
        low, high = low - 5.0, high + 5.0
    (x0, y0), (x1, y1) = low.tolist(), high.tolist()
    return x0, y0, x1, y1


def _area(box: Box) -> float:
    """Return the area of the square around a box, since a long one may be thin."""
    return max(box[2] - box[0], box[3] - box[1]) ** 2


def _areas(bounds: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray((bounds[:, 2] - bounds[:, 0]) * (bounds[:, 3] - bounds[:, 1]))


def _visible_box(visible: NDArray[np.bool_], transform: Affine) -> Box | None:
    """Return the box in metres around the chosen pixels of a turned raster; None if there are none."""
    rows, columns = np.flatnonzero(visible.any(axis=1)), np.flatnonzero(visible.any(axis=0))
    if not len(rows):
        return None
    a, b, c, d, e, f = transform
    left, top = int(columns[0]), int(rows[0])
    placement = Placement((a, b, c + a * left + b * top, d, e, f + d * left + e * top), None, None, 0.0)
    return placement.bounds(int(columns[-1]) + 1 - left, int(rows[-1]) + 1 - top)


def _box(shapes: NDArray[np.object_]) -> Box:
    x0, y0, x1, y1 = shapely.total_bounds(shapes).tolist()
    return x0, y0, x1, y1
