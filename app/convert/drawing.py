"""Drawing of maps: local metres to anti-aliased pixels, +y up."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from app.model.imagery import Affine
from app.store.values import Box

OVERSAMPLING = 2
"""Pixels of the drawing per pixel of the picture, along each side."""

SHIFT = 4
"""Bits of a pixel's fraction in OpenCV's coordinates."""

MAX_DASHES = 20_000

Colour = tuple[int, int, int]
Pixels = NDArray[np.uint8]


class Frame(NamedTuple):
    """Size of a picture in pixels, and the local metres of its upper left corner and of a pixel."""

    width: int
    height: int
    left: float
    top: float
    scale: float


def fit_frame(box: Box, width: int, margin: float, aspect: tuple[float, float]) -> Frame:
    """Fit a box in metres into a picture of a width. margin: pixels; aspect: limits of height / width."""
    x0, y0, x1, y1 = box
    across, up = max(x1 - x0, 1e-6), max(y1 - y0, 1e-6)
    inner = width - 2 * margin
    height = round(min(max(inner * up / across + 2 * margin, width * aspect[0]), width * aspect[1]))
    scale = max(across / inner, up / (height - 2 * margin))
    left, top = (x0 + x1 - width * scale) / 2, (y0 + y1 + height * scale) / 2
    return Frame(width, height, left, top, scale)


class Canvas:
    """Picture in local metres, drawn from the bottom up. Widths and radii are pixels of the finished picture.

    background: None for a transparent one.
    """

    def __init__(self, frame: Frame, background: Colour | None) -> None:
        self.frame = frame
        self._size = (frame.height * OVERSAMPLING, frame.width * OVERSAMPLING)
        self._scale = frame.scale / OVERSAMPLING
        # Red, green, blue and opacity; the colours are multiplied by the opacity.
        self._pixels = np.zeros((*self._size, 3 if background else 4), np.uint8)
        if background:
            self._pixels[:] = background

    def finish(self) -> Pixels:
        """Return the picture: uint8 [height, width, 3], or 4 with a transparent background."""
        import cv2

        size = (self.frame.width, self.frame.height)
        small = np.asarray(cv2.resize(self._pixels, size, interpolation=cv2.INTER_AREA), np.uint8)
        if small.shape[2] == 4:
            opacity = np.maximum(small[..., 3:], 1).astype(np.float32)
            small[..., :3] = np.round(small[..., :3] * (np.float32(255) / opacity)).clip(0, 255)
        return small

    def raster(self, rgba: Pixels, transform: Affine) -> None:
        """Lay an image over the picture. transform: from its pixels to metres."""
        import cv2

        a, b, c, d, e, f = transform
        left, top, scale = self.frame.left, self.frame.top, self._scale
        # From the middles of the image's pixels to the middles of the canvas's.
        matrix = np.array([[a, b, c + (a + b) / 2 - left], [-d, -e, top - f - (d + e) / 2]]) / scale
        matrix[:, 2] -= 0.5
        shrinks = max(math.hypot(a, d), math.hypot(b, e)) < scale
        weighted = rgba.astype(np.float32)
        weighted[..., :3] *= weighted[..., 3:] / np.float32(255)
        how = cv2.INTER_LINEAR if shrinks else cv2.INTER_NEAREST
        drawn = np.asarray(cv2.warpAffine(weighted, matrix, (self._size[1], self._size[0]), flags=how))
        clear = np.float32(1.0) - drawn[..., 3:] / np.float32(255)
        bands = self._pixels.shape[2]
        self._pixels = np.round(self._pixels * clear + drawn[..., :bands]).clip(0, 255).astype(np.uint8)

    def areas(self, shapes: NDArray[np.object_], colour: Colour, opacity: float) -> None:
        """Fill polygons; where they overlap, the colour is not added."""
        import cv2

        mask = np.zeros(self._size, np.uint8)
        for polygon in _pieces(shapes, "Polygon"):
            rings = [self._places(shapely.get_coordinates(ring)) for ring in (polygon.exterior, *polygon.interiors)]
            cv2.fillPoly(mask, rings, 255, lineType=cv2.LINE_AA, shift=SHIFT)
        self._blend(mask, colour, opacity)

    def lines(self, shapes: NDArray[np.object_], colour: Colour, width: float, opacity: float = 1.0) -> None:
        """Draw lines, and outlines of polygons."""
        self._draw([shapely.get_coordinates(line) for line in outlines(shapes)], colour, width, opacity)

    def dashes(self, shapes: NDArray[np.object_], colour: Colour, width: float, dash: float, gap: float) -> None:
        """Draw dashed lines, and dashed outlines of polygons."""
        pieces: list[NDArray[np.float64]] = []
        step = (dash + gap) * self.frame.scale
        for line in outlines(shapes):
            count = min(MAX_DASHES, max(1, round(line.length / step)))
            starts = np.arange(count) / count
            share = np.linspace(0.0, dash / (dash + gap), 5) / count
            places = shapely.line_interpolate_point(line, (starts[:, None] + share).ravel(), normalized=True)
            pieces += list(shapely.get_coordinates(places).reshape(count, 5, 2))
        self._draw(pieces, colour, width, 1.0)

    def dots(self, shapes: NDArray[np.object_], colour: Colour, radius: float, opacity: float = 1.0) -> None:
        """Draw points."""
        import cv2

        points = list(_pieces(shapes, "Point"))
        if not points:
            return
        mask = np.zeros(self._size, np.uint8)
        size = round(radius * OVERSAMPLING * 2**SHIFT)
        for place in self._places(shapely.get_coordinates(points)).tolist():
            cv2.circle(mask, place, size, 255, -1, lineType=cv2.LINE_AA, shift=SHIFT)
        self._blend(mask, colour, opacity)

    def _draw(self, lines: list[NDArray[np.float64]], colour: Colour, width: float, opacity: float) -> None:
        import cv2

        if not lines:
            return
        mask = np.zeros(self._size, np.uint8)
        places = [self._places(line) for line in lines]
        thickness = max(1, round(width * OVERSAMPLING))
        cv2.polylines(mask, places, False, 255, thickness, lineType=cv2.LINE_AA, shift=SHIFT)
        self._blend(mask, colour, opacity)

    def _blend(self, mask: Pixels, colour: Colour, opacity: float) -> None:
        import cv2

        x, y, width, height = cv2.boundingRect(mask)
        part = self._pixels[y : y + height, x : x + width]
        share = mask[y : y + height, x : x + width, None] * np.float32(opacity / 255)
        full = np.array((*colour, 255)[: part.shape[2]], np.float32)
        part[...] = np.round(part + (full - part) * share).astype(np.uint8)

    def _places(self, points: NDArray[np.float64]) -> NDArray[np.int32]:
        """Convert (x, y) in metres to OpenCV's fixed-point pixels, whose middles are whole numbers."""
        x = (points[:, 0] - self.frame.left) / self._scale - 0.5
        y = (self.frame.top - points[:, 1]) / self._scale - 0.5
        places: NDArray[np.float64] = np.round(np.column_stack([x, y]) * 2**SHIFT)
        return places.clip(-(2**24), 2**24).astype(np.int32)


def outlines(shapes: NDArray[np.object_]) -> list[shapely.Geometry]:
    """Return all lines, and the rings of polygons."""
    out = [*_pieces(shapes, "LineString"), *_pieces(shapes, "LinearRing")]
    for polygon in _pieces(shapes, "Polygon"):
        out += [polygon.exterior, *polygon.interiors]
    return out


def _pieces(shapes: NDArray[np.object_], kind: str) -> Iterable[shapely.Geometry]:
    """Yield the geometries of a type, also those inside collections; empty ones are skipped."""
    flat = np.asarray(shapes, object).ravel()
    while len(flat) and (shapely.get_type_id(flat) >= 4).any():  # from MultiPoint on
        flat = shapely.get_parts(flat)
    return (shape for shape in flat.tolist() if shape.geom_type == kind and not shape.is_empty)
