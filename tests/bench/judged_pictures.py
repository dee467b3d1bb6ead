"""Draw what two checkouts derive of the same map side by side."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.imagery import GeoImage
from app.model.layers import Layers

WIDTH, EDGE, LINE = 1160, 12, 22
"""Width of a picture, the space around panels, and the height of a caption, in pixels."""

GREY = {"free": 255, "between": 150, "occupied": 42, "unknown": 205}
INK, BACKGROUND = (185, 0, 0), (255, 255, 255)
OBJECTS = {"wall": (25, 75, 185), "furniture": (226, 120, 16), "post": (22, 140, 66), "obstacle": (125, 125, 125)}
AREAS = {
    "room": (150, 196, 240),
    "corridor": (178, 224, 170),
    "door": (214, 60, 20),
    "aisle": (250, 220, 140),
    "row": (200, 180, 235),
}

Derived = dict[str, Any]
"""What a checkout derived: ``rows`` [(geometry, properties)] or ``cells``, as stored; or ``fault``, why nothing."""


class _Panel:
    """A map in metres, drawn to the scale of a width in pixels."""

    def __init__(self, layers: Layers, width: int) -> None:
        (part,) = layers.parts.values()
        if isinstance(part, OccupancyGrid):
            pixels, size, corner = grey(part.cells), part.resolution, part.origin[:2]
        else:
            assert isinstance(part, GeoImage)
            pixels, size = np.asarray(part.pixels), part.transform[0]
            corner = (part.transform[2], part.transform[5] - len(pixels) * size)
            pixels = pixels[..., :3] if pixels.shape[2] >= 3 else pixels[..., 0]
        self.corner, self.metres = corner, (pixels.shape[1] * size, len(pixels) * size)
        self.scale = width / self.metres[0]
        self.size = (width, round(self.metres[1] * self.scale))
        self.base = self.fit(pixels)

    def fit(self, pixels: NDArray[np.uint8]) -> Image.Image:
        """Return a picture of the map in the size of the panel, RGB."""
        is_larger = pixels.shape[1] > self.size[0]
        how = Image.Resampling.BOX if is_larger else Image.Resampling.NEAREST
        return Image.fromarray(pixels).convert("RGB").resize(self.size, how)

    def at(self, shape: Any) -> list[tuple[float, float]]:
        """Return the positions of a shape in pixels."""
        x, y = ((shapely.get_coordinates(shape) - self.corner) * self.scale).T
        return list(zip(x.tolist(), (self.size[1] - y).tolist(), strict=True))

    def draw(self, derived: Derived) -> Image.Image:
        """Return what was derived: the grid, or features over the map."""
        if "cells" in derived:
            return self.fit(grey(derived["cells"]))
        out = self.base.copy()
        for shape, properties in sorted(derived.get("rows", []), key=lambda row: row[1].get("kind") == "node"):
            self._draw_shape(out, shape, properties.get("kind", ""))
        return out

    def _draw_shape(self, out: Image.Image, shape: Any, kind: str) -> None:
        if shape.geom_type.startswith(("Multi", "GeometryCollection")):
            for part in shape.geoms:
                self._draw_shape(out, part, kind)
            return
        pen = ImageDraw.Draw(out, "RGBA")
        if kind in AREAS:
            pen.polygon(self.at(shape.exterior), (*AREAS[kind], 255 if kind == "door" else 130), AREAS[kind])
        elif shape.geom_type == "Point":
            ((x, y),) = self.at(shape)
            pen.ellipse((x - 2.5, y - 2.5, x + 2.5, y + 2.5), INK)
        elif shape.geom_type == "LineString":
            pen.line(self.at(shape), OBJECTS["wall"] if kind == "wall" else INK, 3 if kind == "wall" else 1)
        elif shape.geom_type == "Polygon":
            colour = OBJECTS.get(kind, OBJECTS["obstacle"])
            pen.polygon(self.at(shape.exterior), (*colour, 190), colour)


def grey(cells: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the picture of a grid's cells, row 0 below."""
    out = np.full(256, GREY["between"], np.uint8)
    for value, name in ((FREE, "free"), (OCCUPIED, "occupied"), (UNKNOWN, "unknown")):
        out[value] = GREY[name]
    return np.ascontiguousarray(out[cells][::-1])


def summary(derived: Derived) -> str:
    """Return in words how much was derived, or why nothing was."""
    if "fault" in derived:
        return str(derived["fault"])
    if "rows" not in derived:
        return ""
    counts = Counter(str(properties.get("kind", "")) for _, properties in derived["rows"])
    if set(counts) <= {"node", "edge"}:
        counts.pop("edge", None)
    plural = {"furniture": "pieces of furniture"}
    return ", ".join(
        f"{count} {kind if count == 1 else plural.get(kind, kind + 's')}" for kind, count in counts.most_common()
    )


def side_by_side(title: str, layers: Layers, columns: Sequence[tuple[str, Derived]]) -> Image.Image:
    """Return a row of panels under a title: what each checkout derived; first the map itself, if that is a picture.

    columns: name of the checkout, and what it derived.
    """
    is_picture = not isinstance(next(iter(layers.parts.values())), OccupancyGrid)
    count = len(columns) + is_picture
    panel = _Panel(layers, (WIDTH - EDGE) // count - EDGE)
    panels = [("map", panel.base)] * is_picture
    for name, derived in columns:
        counts = summary(derived)
        panels.append((f"{name}: {counts}" if counts else name, panel.draw(derived)))
    out = Image.new("RGB", (WIDTH, panel.size[1] + 2 * LINE + EDGE // 2), BACKGROUND)
    pen, font = ImageDraw.Draw(out), ImageFont.load_default(15)
    pen.text((EDGE, 2), title, (0, 0, 0), font)
    for k, (caption, picture) in enumerate(panels):
        left = EDGE + k * (panel.size[0] + EDGE)
        pen.text((left, LINE + 2), caption, (90, 90, 90), ImageFont.load_default(13))
        out.paste(picture, (left, 2 * LINE))
    return out


def stack(rows: Sequence[Image.Image]) -> Image.Image:
    """Return pictures below each other in a few colours, so that the file is small."""
    out = Image.new("RGB", (WIDTH, sum(row.height + EDGE for row in rows) + EDGE), BACKGROUND)
    top = EDGE
    for row in rows:
        out.paste(row, (0, top))
        top += row.height + EDGE
    return out.quantize(64, dither=Image.Dither.NONE)
