"""Images for derivations: select one per level, and resample it to the local frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.derive import DerivationNotes
from app.errors import CannotConvert, Invalid
from app.model.frame import Datum
from app.model.geodesy import LocalFrame, crs_to_wgs84, local_frame
from app.model.imagery import CLEAR, LOCAL, GeoImage, display_pixels
from app.model.layers import Layers, PartKey
from app.model.resampling import resample
from app.model.selection import parts_with_name, select_per_level

SATELLITE = "satellite"
"""Default name of an image."""

STEPS = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)
"""Default pixel sizes in metres: the first that is not finer than the image is used."""

DEFAULT_MAX_PIXELS = 2**21
"""Maximum number of pixels at the default pixel size; larger images use a coarser one."""

MAX_PIXELS = 2**25
"""Maximum number of pixels at a requested pixel size."""

SIDE_POINTS = 64
"""Number of points on each side of an image along which its longitudes are followed."""

OPAQUE = 128
"""Minimum alpha of a valid pixel."""

INFRARED = ("nir", "near infrared", "near-infrared", "near_infrared", "infrared")


@dataclass(frozen=True, slots=True, eq=False)
class GroundImage:
    """Image resampled to the local frame, row 0 on top, north up.

    Attributes:
        rgb: uint8 [h, w, 3].
        valid: bool [h, w], pixels that the image covers.
        resolution: metres per pixel.
        left, top: metres of the upper left corner.
        raw: the resampled bands.
        frame: the local frame; a temporary one if the environment has no datum.
        grey: whether the image has no colours.
        on_earth: whether the image is anchored in WGS 84.
    """

    rgb: NDArray[np.uint8]
    valid: NDArray[np.bool_]
    resolution: float
    left: float
    top: float
    raw: NDArray[Any]
    frame: LocalFrame | None
    grey: bool
    on_earth: bool

    @property
    def transform(self) -> tuple[float, float, float, float, float, float]:
        """Affine transform from pixels to metres."""
        return (self.resolution, 0.0, self.left, 0.0, -self.resolution, self.top)


def select_pictures(layers: Layers, name: str | None) -> dict[PartKey, GeoImage]:
    """Select an image per level: the named one, else ``satellite``, else the only one. Raises NotFound, Ambiguous."""
    pictures = {key: part for key, part in layers.parts_of("imagery").items() if isinstance(part, GeoImage)}
    if name is not None:
        return parts_with_name(pictures, name, "picture")
    return select_per_level(pictures, SATELLITE, "picture", "picture")


def picture_label(key: PartKey) -> str:
    """Return the name of an image for messages."""
    return f"the image {key.name!r} of level {key.level!r}"


def ground(
    picture: GeoImage, frame: LocalFrame | None, resolution: float | None, notes: DerivationNotes, name: str
) -> GroundImage:
    """Resample an image to the local frame. frame: None uses a temporary one at the image's own position.

    Raises CannotConvert if it would be too large, Invalid if PROJ has no transformation.
    """
    on_earth = picture.crs != LOCAL
    if on_earth and frame is None:
        frame = local_frame(_middle(picture))
    size = _native(picture, frame)
    if resolution is None:
        resolution = next((step for step in STEPS if step >= size * 0.999), size)
        for step in STEPS:
            if step >= resolution and _count(picture, size, step) <= DEFAULT_MAX_PIXELS:
                resolution = step
                break
        if resolution > size * 2:
            notes.fill(
                "resolution", resolution, f"{name} is segmented at this pixel size in metres; a finer one can be set"
            )
    if _count(picture, size, resolution) > MAX_PIXELS:
        raise CannotConvert(
            f"{name} would have more than {MAX_PIXELS} pixels of {resolution:g} m: use a coarser resolution"
        )
    try:
        seen = resample(picture, frame, crs=LOCAL, resolution=resolution, most_pixels=2 * MAX_PIXELS)
    except Invalid as error:
        raise CannotConvert(f"{name}: {error.detail}", error.problems) from error
    shown = display_pixels(seen)
    bands = shown.shape[2]
    valid = shown[..., -1] >= OPAQUE if bands in (2, 4) else np.ones(shown.shape[:2], bool)
    grey = bands < 3
    rgb = np.repeat(shown[..., :1], 3, axis=2) if grey else np.ascontiguousarray(shown[..., :3])
    if not valid.any():
        raise CannotConvert(f"{name} is empty: every pixel is transparent or has no data")
    _, _, left, _, _, top = seen.transform
    return GroundImage(rgb, valid, seen.transform[0], left, top, seen.pixels, frame, grey, on_earth)


def infrared_band(picture: GeoImage, number: int | None, name: str) -> int | None:
    """Return the index of the near-infrared band: the given number (from 1), else the band described as such.

    Raises CannotConvert for a band that does not exist or is an alpha band.
    """
    count = picture.pixels.shape[2]
    if number is not None:
        if number > count:
            raise CannotConvert(f"{name} has {count} bands, no band {number}: correct near_infrared")
        if picture.colours[number - 1] in CLEAR:
            raise CannotConvert(f"band {number} of {name} is its {picture.colours[number - 1]}: correct near_infrared")
        return number - 1
    bands = picture.properties.get("bands")
    for k, band in enumerate(bands if isinstance(bands, list | tuple) else ()):
        if isinstance(band, Mapping):
            words = [str(band.get(word, "")).strip().lower() for word in ("colour", "description")]
            if any(word in INFRARED for word in words):
                return k
    return None


def _middle(picture: GeoImage) -> Datum:
    """Return the centre of an image in WGS 84: the mean of its corners."""
    outline = picture.outline(SIDE_POINTS)
    lonlat = crs_to_wgs84(picture.crs, np.column_stack([outline, np.zeros(len(outline))]))[:, :2]
    if not np.isfinite(lonlat).all():
        raise CannotConvert("the image has no valid position on earth: correct its CRS or transform")
    lonlat[:, 0] = np.unwrap(lonlat[:, 0], period=360.0)  # across the antimeridian
    longitude, latitude = lonlat[::SIDE_POINTS].mean(axis=0).tolist()
    return Datum(round(latitude, 9), round(longitude - 360.0 * round(longitude / 360.0), 9))


def _native(picture: GeoImage, frame: LocalFrame | None) -> float:
    """Return the image's own pixel size in metres, at its centre."""
    if picture.crs == LOCAL or frame is None:
        a, b, _, d, e, _ = picture.transform
        return float(np.sqrt(abs(a * e - b * d)))
    a, b, c, d, e, f = picture.transform
    height, width = picture.pixels.shape[:2]
    u, v = width / 2, height / 2
    at = np.array([[u, v, 0.0], [u + 1, v, 0.0], [u, v + 1, 0.0]])
    places = np.column_stack([a * at[:, 0] + b * at[:, 1] + c, d * at[:, 0] + e * at[:, 1] + f, at[:, 2]])
    p, q, r = frame.to_local(crs_to_wgs84(picture.crs, places)[:, :2])
    size = float(np.sqrt(abs((q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0]))))
    if not np.isfinite(size) or size <= 0.0:
        raise CannotConvert("the image is too far from the datum: correct one of the two")
    return size


def _count(picture: GeoImage, size: float, resolution: float) -> float:
    height, width = picture.pixels.shape[:2]
    return float(float(height) * width * (size / resolution) ** 2)
