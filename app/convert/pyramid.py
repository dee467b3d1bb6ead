"""Overviews of grids and images: each level halves the one below, rounding its size up, from the top left corner.

Reduction k joins 2^k × 2^k pixels. Cells take the maximum of the known ones, so that no obstacle disappears, and are
unknown only if all are; colours are averaged, weighted by their opacity. Row 0 is the top row of all pixels here.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from app.model.grid import UNKNOWN, halve_cells
from app.model.imagery import Affine, GeoImage, display_pixels, display_range
from app.store.windows import RasterReader
from app.syntax import images

TILE = 256
"""Side of a tile in pixels."""

DIRECT = 2
"""Highest reduction that is computed from the cells of a tile: at most 16 tiles of them."""

STORED = DIRECT + 1
"""Lowest reduction that is stored for the whole raster, at 1/64 of its size."""

BLOCK = TILE << STORED
"""Side of the squares in which a raster is reduced, in its pixels."""

Pixels = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Size:
    """Size of a raster in pixels, and of its levels. Level ``levels - 1`` is the raster itself, level 0 one tile."""

    width: int
    height: int

    @property
    def levels(self) -> int:
        """Return the number of levels."""
        return max(0, (max(self.width, self.height) - 1) // TILE).bit_length() + 1

    def reduced(self, k: int) -> Size:
        """Return the size at a reduction."""
        return Size(_round_up(self.width, k), _round_up(self.height, k))

    def reduction(self, width: int) -> int:
        """Return the reduction at which it is at most two pixels wide or high per pixel of a picture."""
        return max(0, math.ceil(math.log2(max(self.width, self.height) / (2 * width))))

    def tiles(self) -> tuple[int, int]:
        """Return the number of rows and columns of tiles."""
        return -(-self.height // TILE), -(-self.width // TILE)


def reduced_transform(transform: Affine, k: int) -> Affine:
    """Return the transform of a raster's pixels at a reduction."""
    a, b, c, d, e, f = transform
    side = 2**k
    return a * side, b * side, c, d * side, e * side, f


def _round_up(value: int, k: int) -> int:
    return (value + (1 << k) - 1) >> k


class Source(ABC):
    """Pixels of a stored raster, row 0 on top, as tiles show them."""

    bands: ClassVar[tuple[int, ...]]

    def __init__(self, reader: RasterReader) -> None:
        self.reader = reader
        self.size = Size(reader.width, reader.height)

    @abstractmethod
    def read(self, row: int, column: int, height: int, width: int) -> Pixels:
        """Read a window inside the raster."""

    @abstractmethod
    def halve(self, pixels: Pixels) -> Pixels:
        """Reduce pixels by 1."""

    @abstractmethod
    def encode(self, pixels: Pixels) -> bytes:
        """Write a tile as PNG; what is missing to 256 × 256 pixels is unknown or transparent."""

    def reduce(self, k: int, row: int, column: int, height: int, width: int) -> Pixels:
        """Return a window of the pixels at a reduction, clipped to the raster."""
        top, left = row << k, column << k
        bottom, right = min((row + height) << k, self.size.height), min((column + width) << k, self.size.width)
        pixels = self.read(top, left, bottom - top, right - left)
        for _ in range(k):
            pixels = self.halve(pixels)
        return pixels

    def reduce_all(self, k: int) -> Pixels:
        """Return all pixels at a reduction; the raster is read in squares."""
        size = self.size.reduced(k)
        out = np.empty((size.height, size.width, *self.bands), np.uint8)
        step = max(1, BLOCK >> k)
        for row in range(0, size.height, step):
            for column in range(0, size.width, step):
                block = self.reduce(k, row, column, step, step)
                out[row : row + block.shape[0], column : column + block.shape[1]] = block
        return out


class GridSource(Source):
    """Cells of an occupancy grid: uint8 [height, width]."""

    bands = ()

    def read(self, row: int, column: int, height: int, width: int) -> Pixels:
        """Read a window inside the grid."""
        return self.reader.window(self.size.height - row - height, column, height, width)[::-1]

    def halve(self, pixels: Pixels) -> Pixels:
        """Take the maximum of the known cells."""
        return halve_cells(pixels)

    def encode(self, pixels: Pixels) -> bytes:
        """Write a grey PNG of the cells."""
        return encode_cells(pixels)


class ImageSource(Source):
    """Pixels of an image as it is displayed: uint8 [height, width, 4]."""

    bands = (4,)

    def __init__(self, reader: RasterReader, shown_range: tuple[float, float] | None) -> None:
        super().__init__(reader)
        self._shown_range = shown_range

    def read(self, row: int, column: int, height: int, width: int) -> Pixels:
        """Read a window inside the image."""
        out = np.empty((height, width, 4), np.uint8)
        for block_row, block_column, block in self.reader.blocks(row, column, height, width):
            shown = _as_rgba(display_pixels(piece_of_image(self.reader, block), self._shown_range))
            top, left = block_row - row, block_column - column
            out[top : top + shown.shape[0], left : left + shown.shape[1]] = shown
        return out

    def halve(self, pixels: Pixels) -> Pixels:
        """Average the colours."""
        return halve_colours(pixels)

    def encode(self, pixels: Pixels) -> bytes:
        """Write an RGB PNG, or RGBA if any pixel is transparent."""
        out = np.zeros((TILE, TILE, 4), np.uint8)
        out[: pixels.shape[0], : pixels.shape[1]] = pixels
        return images.encode_png(out[..., :3] if (out[..., 3] == 255).all() else out)


def encode_cells(cells: Pixels) -> bytes:
    """Write a tile of cells as grey PNG of 256 × 256 pixels; the missing ones are unknown."""
    out = np.full((TILE, TILE), UNKNOWN, np.uint8)
    out[: cells.shape[0], : cells.shape[1]] = cells
    return images.encode_png(out)


def halve_colours(pixels: Pixels) -> Pixels:
    """Join 2 × 2 pixels of RGBA: the mean opacity, and the mean colour weighted by opacity."""
    import cv2

    odd = pixels.shape[0] % 2, pixels.shape[1] % 2
    if any(odd):  # a pixel at the edge has only its neighbours inside the image
        pixels = np.pad(pixels, ((0, odd[0]), (0, odd[1]), (0, 0)), "edge")
    size = (pixels.shape[1] // 2, pixels.shape[0] // 2)
    if (pixels[..., 3] == 255).all():
        return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8)
    values = pixels.astype(np.float32)
    values[..., :3] *= values[..., 3:] / np.float32(255.0)
    mean = np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_AREA))
    with np.errstate(invalid="ignore", divide="ignore"):
        colour = np.where(mean[..., 3:] > 0.0, mean[..., :3] / (mean[..., 3:] / np.float32(255.0)), 0.0)
    return np.clip(np.floor(np.concatenate([colour, mean[..., 3:]], axis=2) + 0.5), 0, 255).astype(np.uint8)


def piece_of_image(reader: RasterReader, pixels: NDArray[np.generic]) -> GeoImage:
    """Return some pixels of an image with its properties; their position does not matter."""
    return GeoImage(pixels, (1.0, 0.0, 0.0, 0.0, 1.0, 0.0), properties=reader.header["properties"])


def range_of_image(reader: RasterReader) -> tuple[float, float]:
    """Return the values of a stored image that become 0 and 255 for display; reads all of it."""
    blocks = reader.blocks(0, 0, reader.height, reader.width)
    return display_range(piece_of_image(reader, block) for _, _, block in blocks)


def _as_rgba(pixels: Pixels) -> Pixels:
    """Convert grey, grey and alpha, RGB or RGBA to RGBA."""
    bands = pixels.shape[2]
    if bands == 4:
        return pixels
    out = np.empty((*pixels.shape[:2], 4), np.uint8)
    out[..., :3] = pixels[..., :1] if bands <= 2 else pixels
    out[..., 3] = pixels[..., 1] if bands == 2 else 255
    return out
