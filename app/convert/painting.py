"""Colours of a site's layers, and how they are drawn on a canvas: the one style of all pictures."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from app.convert.drawing import Canvas, Colour, Pixels
from app.convert.pyramid import Size
from app.convert.voxel_tiles import Columns
from app.derive.zones_to_occupancy import KEEPOUTS, LANES, SPEEDS
from app.model.areas import AREA_COLOUR, AREA_KINDS, AREA_OPACITY, DARK_AREA_COLOUR
from app.model.features import Features
from app.model.grid import FREE, OCCUPIED, UNKNOWN
from app.model.layers import VECTOR_LAYERS, PartKey

ThemeName = Literal["light", "dark"]

SLICE = (0.2, 2.0)
"""Heights in metres above the lowest voxel at which a voxel is drawn as occupied; lower ones are the floor."""


@dataclass(frozen=True, slots=True)
class Theme:
    """Colours of a picture. brightness: of images."""

    background: Colour
    free: Colour
    occupied: Colour
    edge: Colour
    node: Colour
    halo: Colour
    fence: Colour
    objects: Colour
    keepout: Colour
    lane: Colour
    speed: Colour
    zone: Colour
    area: Colour
    text: Colour
    brightness: float = 1.0


THEMES: Mapping[ThemeName, Theme] = {
    "light": Theme(
        background=(238, 240, 242),
        free=(254, 254, 254),
        occupied=(58, 64, 72),
        edge=(37, 99, 202),
        node=(22, 66, 148),
        halo=(255, 255, 255),
        fence=(92, 104, 116),
        objects=(120, 130, 142),
        keepout=(206, 58, 58),
        lane=(34, 146, 86),
        speed=(214, 138, 22),
        zone=(118, 92, 190),
        area=AREA_COLOUR,
        text=(96, 104, 114),
    ),
    "dark": Theme(
        background=(20, 23, 27),
        free=(38, 43, 50),
        occupied=(176, 186, 198),
        edge=(96, 158, 252),
        node=(172, 206, 255),
        halo=(20, 23, 27),
        fence=(150, 160, 172),
        objects=(134, 146, 160),
        keepout=(240, 98, 98),
        lane=(74, 196, 128),
        speed=(240, 178, 74),
        zone=(160, 138, 236),
        area=DARK_AREA_COLOUR,
        text=(150, 158, 168),
        brightness=0.7,
    ),
}


@dataclass(frozen=True, slots=True, eq=False)
class Shapes:
    """Geometries to draw. kinds: the ``kind`` of each, in lower case. spacing: typical distance of nodes."""

    geometry: NDArray[np.object_]
    kinds: Sequence[str]
    spacing: float


def shapes_of(part: Features, geometry: NDArray[np.object_], chosen: NDArray[np.bool_]) -> Shapes:
    """Return what is not empty of a part. geometry: of its chosen features; chosen: bool [n]."""
    some = ~shapely.is_empty(geometry) & ~shapely.is_missing(geometry)
    kinds = [str(part.properties[k].get("kind", "")).lower() for k in np.flatnonzero(chosen)[some].tolist()]
    shown = geometry[some]
    types = shapely.get_type_id(shown)
    return Shapes(shown, kinds, _spacing(shown[types != 0], shown[types == 0]))


def _spacing(edges: NDArray[np.object_], nodes: NDArray[np.object_]) -> float:
    """Return the typical distance in metres between neighbours of a network."""
    if len(edges):
        return float(np.median(shapely.length(edges)))
    if len(nodes) < 2:
        return math.inf
    x0, y0, x1, y1 = shapely.total_bounds(nodes)
    return math.hypot(x1 - x0, y1 - y0) / math.sqrt(len(nodes))


def cells_of_columns(columns: Columns, k: int) -> Pixels:
    """Return a voxel map at a reduction as cells: occupied where a robot would hit something."""
    size = Size(columns.width, columns.height).reduced(k)
    side, (low, high) = max(size.width, size.height), columns.heights
    cells = columns.tile(k, 0, 0, side, columns.heights)
    cells[cells != UNKNOWN] = FREE
    heights = (low + math.ceil(SLICE[0] / columns.resolution), low + math.ceil(SLICE[1] / columns.resolution))
    walls = columns.tile(k, 0, 0, side, heights if heights[0] < high else columns.heights) == OCCUPIED
    cells[walls] = OCCUPIED
    return cells[: size.height, : size.width]


class Painter:
    """Style of one picture. layers: those that it shows."""

    def __init__(self, theme: ThemeName, layers: Collection[str]) -> None:
        self._theme = THEMES[theme]
        self._over_raster = any(layer not in VECTOR_LAYERS for layer in layers)
        self._over_image = "imagery" in layers

    def image(self, rgba: Pixels) -> Pixels:
        """Adapt an image to the theme."""
        if self._theme.brightness == 1.0:
            return rgba
        return np.concatenate(
            [np.round(rgba[..., :3] * self._theme.brightness).astype(np.uint8), rgba[..., 3:]], axis=2
        )

    def cells(self, cells: Pixels, *, over: bool) -> Pixels:
        """Colour cells from free to occupied; unknown ones are transparent, and free ones over an image."""
        table = np.zeros((256, 4), np.uint8)
        share = np.arange(OCCUPIED + 1)[:, None] / OCCUPIED
        free, occupied = np.array(self._theme.free), np.array(self._theme.occupied)
        table[: OCCUPIED + 1, :3] = occupied if over else np.round(free + (occupied - free) * share)
        table[: OCCUPIED + 1, 3] = np.round(share[:, 0] * 230) if over else 255
        return table[cells]

    def mask(self, cells: Pixels, name: str) -> Pixels:
        """Tint the marked cells of a costmap filter mask."""
        rgba = np.zeros((*cells.shape, 4), np.uint8)
        rgba[(cells > 0) & (cells != UNKNOWN)] = (*(self._theme.speed if "speed" in name else self._theme.keepout), 70)
        return rgba

    def features(self, canvas: Canvas, parts: Mapping[PartKey, Shapes], weight: float) -> None:
        """Draw features. weight: factor of all widths."""
        for layer, draw in (
            ("zones", self._draw_zones),
            ("objects", self._draw_objects),
            ("location", self._draw_fence),
            ("topology", self._draw_network),
        ):
            for key in sorted(parts):
                if key.layer == layer:
                    draw(canvas, parts[key], weight)

    def _draw_zones(self, canvas: Canvas, part: Shapes, weight: float) -> None:
        theme, shapes = self._theme, part.geometry
        named = (KEEPOUTS, LANES, SPEEDS, AREA_KINDS)
        group = np.array([next((k for k, names in enumerate(named) if kind in names), -1) for kind in part.kinds])
        drawn = (3, theme.area), (-1, theme.zone), (1, theme.lane), (2, theme.speed), (0, theme.keepout)
        for k, colour in drawn:
            chosen = shapes[group == k]
            if len(chosen):
                canvas.areas(chosen, colour, AREA_OPACITY if k == 3 else 0.2)
                canvas.lines(chosen, colour, (0.8 if k == 3 else 1.1) * weight, 0.8)

    def _draw_objects(self, canvas: Canvas, part: Shapes, weight: float) -> None:
        raster, shapes = self._over_raster, part.geometry
        canvas.areas(shapes, self._theme.objects, 0.12 if raster else 0.28)
        canvas.lines(shapes, self._theme.objects, 0.9 * weight, 0.9)
        canvas.dots(shapes, self._theme.objects, 1.6 * weight, 0.9)

    def _draw_fence(self, canvas: Canvas, part: Shapes, weight: float) -> None:
        canvas.dashes(part.geometry, self._theme.fence, 1.2 * weight, 7.0 * weight, 5.0 * weight)

    def _draw_network(self, canvas: Canvas, part: Shapes, weight: float) -> None:
        types = shapely.get_type_id(part.geometry)
        edges, nodes = part.geometry[types != 0], part.geometry[types == 0]
        spacing = part.spacing / canvas.frame.scale  # pixels
        width = min(max(spacing * 0.12, 0.5), 1.5) * weight
        if self._over_image:
            canvas.lines(edges, self._theme.halo, width + 1.6 * weight, 0.6)
        canvas.lines(edges, self._theme.edge, width, 0.95)
        radius = min(max(spacing * 0.16, 0.8), 2.8) * weight
        if radius >= 1.5 * weight:
            canvas.dots(nodes, self._theme.halo, radius + 1.1 * weight)
        canvas.dots(nodes, self._theme.node, radius)
