"""Imagery: georeferenced images (satellite images, terrain models, floor plans)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.errors import Invalid

Affine = tuple[float, float, float, float, float, float]
"""Affine transform (a, b, c, d, e, f): x = a·column + b·row + c, y = d·column + e·row + f."""

LOCAL = "local"
STRIP = 2**18
"""Number of pixels that are converted at a time: they fit into the processor's cache and bound the memory."""

DEFAULT_COLOURS: Mapping[int, tuple[str, ...]] = {
    1: ("gray",),
    2: ("gray", "alpha"),
    3: ("red", "green", "blue"),
    4: ("red", "green", "blue", "alpha"),
}
"""Colours of an image's bands if the source states none."""

CLEAR = ("alpha", "mask")
"""Bands of validity: ``alpha`` in shades, ``mask`` yes (not 0) or no (0)."""


@dataclass(frozen=True, slots=True, eq=False)
class GeoImage:
    """Pixels with their position.

    pixels: [height, width, bands], row 0 on top. transform: (a, b, c, d, e, f) with x = a·column + b·row + c and
    y = d·column + e·row + f for the outer corner of a pixel. crs: ``local`` (metres in the local frame) or a CRS
    that PROJ knows (``EPSG:32630``, or its WKT); x is always easting or longitude.

    properties: ``bands`` [{colour, description?, unit?, scale?, offset?}], one for each band, where colour is GDAL's
    name (gray, red, green, blue, alpha, palette, undefined …) or ``mask``; ``nodata`` a number, or ``nan``, ``inf``,
    ``-inf``; ``palette`` [[red, green, blue, alpha], …], indexed by the values of a ``palette`` band; ``attribution``
    [texts].
    """

    pixels: NDArray[Any]
    transform: Affine
    crs: str = LOCAL
    properties: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.pixels.ndim != 3 or 0 in self.pixels.shape:
            raise Invalid(f"pixels of an image must be [height, width, bands], got {self.pixels.shape}")
        if len(self.transform) != 6 or not all(math.isfinite(v) for v in self.transform):
            raise Invalid(f"an image's transform must be six finite numbers, got {self.transform!r}")
        a, b, _, d, e, _ = self.transform
        if a * e - b * d == 0.0:
            raise Invalid("an image's transform must not be singular: its pixels would have no area")
        if not self.crs:
            raise Invalid("missing CRS of an image: use local, or a code such as EPSG:32630")
        self.pixels.flags.writeable = False

    @property
    def colours(self) -> tuple[str, ...]:
        """Return the colour of each band."""
        count = int(self.pixels.shape[2])
        bands = self.properties.get("bands")
        if isinstance(bands, list | tuple) and len(bands) == count and all(isinstance(b, Mapping) for b in bands):
            return tuple(str(b.get("colour", "undefined")) for b in bands)
        return DEFAULT_COLOURS.get(count, ("gray",) + ("undefined",) * (count - 1))

    @property
    def nodata(self) -> float | int | None:
        """Return the no-data value; None if there is none."""
        value = self.properties.get("nodata")
        if isinstance(value, str):
            return float(value) if value in ("nan", "inf", "-inf") else None
        return value if isinstance(value, int | float) and not isinstance(value, bool) else None

    @property
    def attribution(self) -> tuple[str, ...]:
        """Return licences and credits of the image."""
        texts = self.properties.get("attribution")
        return tuple(text for text in texts if isinstance(text, str)) if isinstance(texts, list | tuple) else ()

    def outline(self, steps: int = 1) -> NDArray[np.float64]:
        """Return points (x, y) along the border, clockwise from the upper left corner: float64 [4 · steps, 2]."""
        height, width = self.pixels.shape[:2]
        part = np.arange(steps) / steps
        u = np.concatenate([part, np.ones(steps), 1 - part, np.zeros(steps)]) * width
        v = np.concatenate([np.zeros(steps), part, np.ones(steps), 1 - part]) * height
        return pixel_positions(self.transform, u, v)


def pixel_positions(transform: Affine, column: NDArray[np.float64], row: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert positions in the image (columns, rows from the outer corner of the first pixel) to float64 [n, 2]."""
    a, b, c, d, e, f = transform
    return np.column_stack([a * column + b * row + c, d * column + e * row + f])


def display_pixels(picture: GeoImage, shown_range: tuple[float, float] | None = None) -> NDArray[np.uint8]:
    """Convert an image for display: uint8 [height, width, 1…4] (grey, grey + alpha, RGB, RGBA).

    8-bit values stay as they are (without a copy if nothing changes); others are stretched so that the minimum becomes
    0 and the maximum 255, all bands alike. Bands beyond the colours are dropped, a palette is looked up. No-data and
    NaN become transparent.

    shown_range: values that become 0 and 255, for a part of a larger image; None: of these pixels (``display_range``).
    """
    pixels, colours = picture.pixels, picture.colours
    height, width, _ = pixels.shape
    clear = next((k for k, colour in enumerate(colours) if colour in CLEAR), None)
    table = _palette(picture)
    shown = _shown_bands(colours)
    nodata = picture.nodata
    holes = clear is not None or nodata is not None or pixels.dtype.kind == "f"
    if pixels.dtype == np.uint8 and table is None and colours == DEFAULT_COLOURS.get(len(colours)) and nodata is None:
        return pixels
    rows = max(1, STRIP // width)
    low, high = (0.0, 255.0) if shown_range is None else shown_range
    if needs_range(picture) and shown_range is None:
        low, high = display_range([picture])
    if table is not None:
        out = np.empty((height, width, 4), np.uint8)
    else:
        out = np.empty((height, width, len(shown) + holes), np.uint8)
    for y in range(0, height, rows):
        block = pixels[y : y + rows]
        values = block[..., shown]
        valid = _valid_mask(values, nodata)
        if table is not None:
            index = np.clip(values[..., 0], 0, 255).astype(np.uint8)
            out[y : y + rows] = table[index]
            out[y : y + rows, :, 3][~valid] = 0
        elif pixels.dtype == np.uint8:
            out[y : y + rows, :, : len(shown)] = values
        else:
            # halved, since the difference of two float64 may overflow
            scaled = np.where(valid[..., None], values, low).astype(np.float64) / 2 - low / 2
            scaled = scaled / (high / 2 - low / 2) * 255.0
            out[y : y + rows, :, : len(shown)] = np.clip(np.round(scaled), 0, 255)
        if holes:
            opaque = np.where(valid, 255, 0).astype(np.uint8)
            if clear is not None:
                opaque = np.minimum(opaque, _opacity(block[..., clear], colours[clear]))
            last = out[y : y + rows, :, -1]
            last[...] = np.minimum(last, opaque) if table is not None else opaque
    return out


def _shown_bands(colours: tuple[str, ...]) -> list[int]:
    """Return the bands with red, green and blue, or the one that is shown in grey."""
    if all(colour in colours for colour in DEFAULT_COLOURS[3]):
        return [colours.index(colour) for colour in DEFAULT_COLOURS[3]]
    clear = next((k for k, colour in enumerate(colours) if colour in CLEAR), None)
    first = next((k for k, colour in enumerate(colours) if colour in ("palette", "gray")), None)
    return [first if first is not None else next((k for k in range(len(colours)) if k != clear), 0)]


def needs_range(picture: GeoImage) -> bool:
    """Return whether the values of an image are stretched for display: those that are not 8-bit."""
    return picture.pixels.dtype != np.uint8 and _palette(picture) is None


def display_range(pieces: Iterable[GeoImage]) -> tuple[float, float]:
    """Return the values of an image that become 0 and 255 for display. pieces: of the image, with its properties."""
    low, high = math.inf, -math.inf
    for piece in pieces:
        rows = max(1, STRIP // piece.pixels.shape[1])
        piece_low, piece_high = _range(piece, _shown_bands(piece.colours), rows)
        low, high = min(low, piece_low), max(high, piece_high)
    if not low < high:  # no data, or one value everywhere
        return (low, low + 1.0) if math.isfinite(low) and low + 1.0 > low else (0.0, 1.0)
    return low, high


def _valid_mask(values: NDArray[Any], nodata: float | int | None) -> NDArray[np.bool_]:
    """Return which pixels have data: [rows, columns] of values [rows, columns, bands]."""
    valid = np.isfinite(values).all(axis=-1) if values.dtype.kind == "f" else np.ones(values.shape[:-1], bool)
    if nodata is not None and math.isfinite(nodata):
        valid &= ~(values == nodata).all(axis=-1)
    return valid


def _range(picture: GeoImage, shown: list[int], rows: int) -> tuple[float, float]:
    """Return the minimum and maximum value that is shown; infinite if there is none."""
    low, high = math.inf, -math.inf
    for y in range(0, len(picture.pixels), rows):
        values = picture.pixels[y : y + rows][..., shown]
        values = values[_valid_mask(values, picture.nodata)]
        if values.size:
            low, high = min(low, float(values.min())), max(high, float(values.max()))
    return low, high


def _opacity(values: NDArray[Any], colour: str) -> NDArray[np.uint8]:
    if colour == "mask":
        return np.where(values != 0, 255, 0).astype(np.uint8)
    if values.dtype == np.uint8:
        return values
    maximum = float(np.iinfo(values.dtype).max) if values.dtype.kind in "iu" else 1.0
    shares = np.clip(np.nan_to_num(values.astype(np.float64) / maximum, nan=0.0), 0.0, 1.0)  # NaN is not shown
    return np.round(shares * 255.0).astype(np.uint8)


def _palette(picture: GeoImage) -> NDArray[np.uint8] | None:
    """Return RGBA [256, 4] of the values if the image has a palette of that size."""
    palette = picture.properties.get("palette")
    if "palette" not in picture.colours or not isinstance(palette, list | tuple) or picture.pixels.dtype != np.uint8:
        return None
    table = np.zeros((256, 4), np.uint8)
    table[:, 3] = 255
    entries = np.array(palette[:256], np.uint8).reshape(-1, 4)
    table[: len(entries)] = entries
    return table
