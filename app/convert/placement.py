"""Position of rasters in the local frame: pixel to metres, corners, and the box on earth."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.convert.voxel_tiles import Columns
from app.errors import MissingDatum
from app.model.frame import Datum
from app.model.geodesy import crs_to_wgs84, local_frame
from app.model.imagery import LOCAL, Affine, pixel_positions
from app.store.values import Box
from app.store.windows import RasterReader
from app.syntax.geotiff import fit_affine

FIT_STEPS = 9
"""Number of points along each side of an image in another CRS, to which its transform is fitted."""


@dataclass(frozen=True, slots=True)
class Placement:
    """Position of a raster.

    Attributes:
        transform: (a, b, c, d, e, f) with x = a·column + b·row + c and y = d·column + e·row + f, in local metres, for
            the outer corner of a pixel; row 0 on top.
        resolution: metres per pixel, origin: (x, y, yaw) of the lower left corner; both None if pixels are not square.
        deviation: maximum distance in metres between the transform and the exact position of a pixel.
    """

    transform: Affine
    resolution: float | None
    origin: tuple[float, float, float] | None
    deviation: float

    def bounds(self, width: int, height: int) -> Box:
        """Return the box around the turned raster in local metres."""
        corners = pixel_positions(
            self.transform, np.array([0.0, width, width, 0.0]), np.array([0.0, 0, height, height])
        )
        (x0, y0), (x1, y1) = corners.min(axis=0).tolist(), corners.max(axis=0).tolist()
        return x0, y0, x1, y1


def place_columns(columns: Columns) -> Placement:
    """Return the position of a voxel map's raster."""
    r = columns.resolution
    left, top = round(columns.left * r, 9), round(columns.top * r, 9)
    origin = (left, round((columns.top - columns.height) * r, 9), 0.0)
    return Placement((r, 0.0, left, 0.0, -r, top), r, origin, 0.0)


def place_raster(reader: RasterReader, datum: Datum | None) -> Placement:
    """Return the position of a stored grid or image. Raises MissingDatum for an image that is anchored on earth."""
    if reader.kind == "grid":
        x, y, yaw = reader.header["origin"]
        return _turned(reader.header["resolution"], x, y, yaw, reader.height)
    transform = image_transform(reader.header)
    if reader.header["crs"] == LOCAL:
        return _from_transform(transform, reader.height, 0.0)
    if datum is None:
        raise MissingDatum(
            "the image is placed on earth, and the environment has no datum: set one to place it in the local frame"
        )
    return _fitted(reader, transform, datum)


def image_transform(header: Mapping[str, Any]) -> Affine:
    """Return an image's transform to its own CRS."""
    a, b, c, d, e, f = header["transform"]
    return a, b, c, d, e, f


def border(header: Mapping[str, Any], steps: int) -> NDArray[np.float64]:
    """Return (column, row) of points along the border of a raster: float64 [4 · steps, 2]."""
    part = np.arange(steps) / steps
    zeros, ones = np.zeros(steps), np.ones(steps)
    columns = np.concatenate([part, ones, 1 - part, zeros]) * header["width"]
    rows = np.concatenate([zeros, part, ones, 1 - part]) * header["height"]
    return np.column_stack([columns, rows])


def _turned(resolution: float, x: float, y: float, yaw: float, height: int) -> Placement:
    c, s = math.cos(yaw) * resolution, math.sin(yaw) * resolution
    transform = (c, s, x - s * height, s, -c, y + c * height)
    return Placement(transform, resolution, (x, y, yaw), 0.0)


def _from_transform(transform: Affine, height: int, deviation: float) -> Placement:
    """Derive resolution and origin from a transform, if its pixels are square and not mirrored."""
    a, b, c, d, e, f = transform
    across, down = math.hypot(a, d), math.hypot(b, e)
    if math.hypot(b - d, e + a) > 1e-9 * (across + down):
        return Placement(transform, None, None, deviation)
    return Placement(transform, across, (b * height + c, e * height + f, math.atan2(d, a)), deviation)


def _fitted(reader: RasterReader, transform: Affine, datum: Datum) -> Placement:
    """Fit a transform to the exact positions of points of an image in another CRS."""
    steps = np.linspace(0.0, 1.0, FIT_STEPS)
    columns, rows = (side.ravel() for side in np.meshgrid(steps * reader.width, steps * reader.height))
    points = np.column_stack([pixel_positions(transform, columns, rows), np.zeros(len(columns))])
    local = local_frame(datum).to_local(crs_to_wgs84(reader.header["crs"], points)[:, :2])
    fit = fit_affine(np.column_stack([columns, rows, local]).tolist())
    if fit is None:
        raise MissingDatum("the image is too far from the datum to be placed in the local frame: correct the datum")
    exact = pixel_positions(fit[0], columns, rows)
    deviation = float(np.hypot(*(exact - local).T).max())
    return _from_transform(fit[0], reader.height, deviation)
