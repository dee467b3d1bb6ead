"""Resampling of an image in any CRS to a north-up grid of square pixels, in the local frame or in a CRS.

Stored images keep their pixels and their grid; users that need another grid resample them on use. Every target pixel is
looked up through PROJ, to a ten thousandth of a pixel; the only other approximation is the interpolation of values.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from app.errors import Invalid, MissingDatum
from app.model.frame import MAX_METRES
from app.model.gdal import gdal, native, open_memory_dataset
from app.model.geodesy import WGS84, LocalFrame, between, is_geographic
from app.model.georeference import Turn, turn
from app.model.imagery import CLEAR, LOCAL, Affine, GeoImage, pixel_positions

Method = Literal["nearest", "bilinear", "cubic"]
TOLERANCE = 1e-4
"""Maximum error of a pixel's position in pixels of the source; GDAL rejects 0."""

STEPS = 64
"""Number of points on each side of an image from which its extent in the target is computed."""

MAX_PIXELS = 2**28
_NO_CRS = "EPSG:3857"
"""Placeholder for the local frame on both sides if neither is on earth: a CRS to itself is no transformation."""


def resample(
    picture: GeoImage,
    frame: LocalFrame | None = None,
    *,
    crs: str = LOCAL,
    resolution: float | None = None,
    method: Method | None = None,
    most_pixels: int = MAX_PIXELS,
) -> GeoImage:
    """Resample an image to a grid of ``crs`` (``local``: metres of ``frame``; else a name that PROJ knows).

    Args:
        resolution: side of the square pixels, metres or degrees of that CRS. Default: as many pixels as the image has
            on its area.
        method: interpolation. Default: ``bilinear``, ``nearest`` for palettes and booleans.

    The grid's rows run along x, its columns against y, and its upper left corner is a whole multiple of the resolution.
    Pixels outside the image get its no-data value, NaN for floats without one; otherwise a further band marks them
    (``alpha`` for 8 bit, ``mask`` for others). An image on such a grid is returned unchanged.

    Raises MissingDatum if a datum is needed, Invalid if there is no conversion, or for too many pixels.
    """
    if frame is None and (picture.crs == LOCAL) != (crs == LOCAL):
        raise MissingDatum('the picture can only be placed with a datum: PATCH the environment with {"datum": {…}}')
    if picture.crs == crs and resolution is None and _is_upright(picture.transform):
        return picture
    target, back = _target_crs(crs, frame)
    source, forth = _target_crs(picture.crs, frame)
    if picture.crs == LOCAL and crs == LOCAL:
        source = target = _NO_CRS
        back = forth = (1.0, 0.0, 0.0, 1.0)
    base = turn(picture.transform, forth)
    around_globe = is_geographic(target)

    def to_target(points: NDArray[np.float64]) -> NDArray[np.float64]:
        if source == target:
            return _rotate_back(points, back)
        out = _rotate_back(between(source, target, points), back)
        if around_globe:  # points in a row that cross the antimeridian continue beyond ±180 degrees
            unwrapped = np.unwrap(out[:, 0], period=360.0)
            if abs(unwrapped[-1] - unwrapped[0]) <= 180.0:  # else they are all around a pole
                out[:, 0] = unwrapped
        return out

    height, width = picture.pixels.shape[:2]
    outline = to_target(_transform_points(picture.outline(STEPS), forth))
    if not np.isfinite(outline).all() or (crs == LOCAL and np.abs(outline).max() > MAX_METRES):
        raise Invalid("the image extends beyond the target CRS: it is too large, or too far from the datum")
    if resolution is None:
        u, v = width / 2, height / 2
        near = pixel_positions(base, np.array([u, u + 1, u]), np.array([v, v, v + 1]))
        p, q, r = to_target(near)
        area = abs((q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0]))
        resolution = float(f"{math.sqrt(area):.9g}")
    if not (math.isfinite(resolution) and resolution > 0.0):
        raise Invalid("the image has no area in the target CRS")
    low = np.floor(outline.min(axis=0) / resolution + 1e-6)
    high = np.maximum(np.ceil(outline.max(axis=0) / resolution - 1e-6), low + 1)
    columns, rows = (float(n) for n in high - low)
    if columns * rows > most_pixels:
        raise Invalid(
            f"the image would have {columns:.0f} × {rows:.0f} pixels; the limit is "
            f"{most_pixels}: set a coarser resolution"
        )
    grid = (resolution, 0.0, float(low[0]) * resolution, 0.0, -resolution, float(high[1]) * resolution)
    shape = (int(rows), int(columns))
    pixels, properties = _warp(picture, method, shape, base, source, turn(grid, back), target)
    return replace(picture, pixels=pixels, transform=grid, crs=crs, properties=properties)


def _is_upright(transform: Affine) -> bool:
    a, b, _, d, e, _ = transform
    return b == 0.0 and d == 0.0 and a > 0.0 and abs(a + e) <= 1e-12 * a


def _target_crs(crs: str, frame: LocalFrame | None) -> tuple[str, Turn]:
    """Return the CRS for PROJ, and the rotation of coordinates into its own."""
    if crs == LOCAL:
        return (frame.crs, frame.from_local) if frame is not None else (_NO_CRS, (1.0, 0.0, 0.0, 1.0))
    return crs, (1.0, 0.0, 0.0, 1.0)


def _transform_points(points: NDArray[np.float64], matrix: Turn) -> NDArray[np.float64]:
    p, q, r, s = matrix
    return np.column_stack([p * points[:, 0] + q * points[:, 1], r * points[:, 0] + s * points[:, 1]])


def _rotate_back(points: NDArray[np.float64], matrix: Turn) -> NDArray[np.float64]:
    """Rotate back: the inverse of a rotation is its transpose."""
    p, q, r, s = matrix
    return _transform_points(points, (p, r, q, s))


def _warp(
    picture: GeoImage,
    method: Method | None,
    shape: tuple[int, int],
    transform: Affine,
    source: str,
    to_transform: Affine,
    target: str,
) -> tuple[NDArray[Any], Mapping[str, Any]]:
    colours = picture.colours
    if method is None:
        method = "nearest" if "palette" in colours or picture.pixels.dtype == np.bool_ else "bilinear"
    from rasterio.vrt import WarpedVRT

    pixels = native(picture.pixels)
    kind, nodata = pixels.dtype, picture.nodata
    properties = dict(picture.properties)
    count = len(colours)
    clear = next((k for k, colour in enumerate(colours) if colour in CLEAR), None)
    options: dict[str, Any] = {}
    added = clear is None and nodata is None and kind.kind != "f"
    if clear is not None:
        max_alpha = _opaque(pixels[..., clear], colours[clear])
        options = {
            "src_alpha": clear + 1,
            "dst_alpha": clear + 1,
            "SRC_ALPHA_MAX": max_alpha,
            "DST_ALPHA_MAX": max_alpha,
        }
    elif added:
        max_alpha = 127 if kind == np.int8 else 255
        options = {"add_alpha": True, "DST_ALPHA_MAX": max_alpha}
        bands = properties.get("bands") or [{"colour": colour} for colour in colours]
        properties["bands"] = [*bands, {"colour": "alpha" if kind == np.uint8 else "mask"}]
    else:
        if nodata is None:
            nodata, properties["nodata"] = math.nan, "nan"
        options = {"src_nodata": nodata, "nodata": nodata}
    with gdal() as rasterio, open_memory_dataset(rasterio, pixels, count) as dataset:
        matrix = rasterio.Affine
        with WarpedVRT(
            dataset,
            src_crs=rasterio.crs.CRS.from_user_input(source),
            src_transform=matrix(*transform),
            crs=rasterio.crs.CRS.from_user_input(target),
            transform=matrix(*to_transform),
            height=shape[0],
            width=shape[1],
            resampling=rasterio.enums.Resampling[method],
            tolerance=TOLERANCE,
            warp_mem_limit=32,
            **options,
        ) as warped:
            return np.moveaxis(warped.read(), 0, 2), properties


def _opaque(band: NDArray[Any], colour: str) -> float:
    """Return the value of an alpha or mask band that means fully opaque."""
    if colour == "mask":
        return float(max(1, band.max()))
    return float(np.iinfo(band.dtype).max) if band.dtype.kind in "iu" else 1.0


def to_wgs84(picture: GeoImage, frame: LocalFrame | None = None, **options: Any) -> GeoImage:
    """Resample like ``resample``, to a grid of longitude and latitude."""
    return resample(picture, frame, crs=WGS84, **options)
