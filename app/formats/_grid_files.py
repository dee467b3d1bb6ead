"""Grids in files of GIS programs: colours and keys of their cells, and their position."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.errors import Invalid, Problem, UnreadableFile
from app.model.geodesy import LocalFrame, between
from app.model.grid import OCCUPIED, OccupancyGrid
from app.model.imagery import Affine, pixel_positions

FREE_COLOUR, OCCUPIED_COLOUR, UNKNOWN_COLOUR = (254, 254, 254), (0, 0, 0), (205, 205, 205)
"""The greys of map_saver; between free and occupied the shade is linear."""

SAME_CELLS = 1e-3
"""Maximum distance in cells between the corners of a grid's metadata and those of its transform."""

MAX_DEVIATION = 0.1
"""Maximum distance in cells between a raster's corners and those of a grid with square cells."""

Array = NDArray[np.float64]


def transform_of(grid: OccupancyGrid) -> Affine:
    """Return the transform from (column, row), row 0 on top, to local metres."""
    x, y, yaw = grid.origin
    c, s = math.cos(yaw) * grid.resolution, math.sin(yaw) * grid.resolution
    return (c, s, x - s * grid.height, s, -c, y + c * grid.height)


def cell_colours() -> NDArray[np.uint8]:
    """Return RGBA of the cell values: uint8 [256, 4]. Values that no cell has are the colour of unknown ones."""
    colours = np.full((256, 4), (*UNKNOWN_COLOUR, 255), np.uint8)
    share = np.arange(OCCUPIED + 1)[:, None] / OCCUPIED
    colours[: OCCUPIED + 1, :3] = np.round(np.array(FREE_COLOUR) * (1 - share) + np.array(OCCUPIED_COLOUR) * share)
    return colours


def grid_keys(grid: OccupancyGrid) -> dict[str, Any]:
    """Return everything but the cells and the properties of a grid, JSON-like."""
    return {
        "size": [grid.width, grid.height],
        "resolution": grid.resolution,
        "origin": list(grid.origin),
        "mode": grid.mode,
        "occupied_thresh": grid.occupied_thresh,
        "free_thresh": grid.free_thresh,
        "negate": grid.negate,
    }


def grid_from_keys(cells: NDArray[np.uint8], keys: Mapping[str, Any], item: str) -> OccupancyGrid:
    """Return the grid that ``grid_keys`` describes. Raises UnreadableFile, naming the metadata item."""
    try:
        return OccupancyGrid(cells, **{name: value for name, value in keys.items() if name != "size"})
    except (Invalid, TypeError, ValueError) as error:
        raise raster_error(f"invalid {item}: remove this item, or export the grid again") from error


def raster_error(reason: str) -> UnreadableFile:
    """Return the error for a raster that is no grid."""
    return UnreadableFile(reason, [Problem(reason)])


def corners_of(transform: Affine, width: int, height: int) -> Array:
    """Return the corners (x, y) of a raster, counter-clockwise from the lower left one: float64 [4, 2]."""
    columns, rows = np.array([0.0, width, width, 0.0]), np.array([height, height, 0.0, 0.0])
    return pixel_positions(transform, columns, rows)


def corners_to_local(corners: Array, crs: str, frame: LocalFrame) -> Array:
    """Convert corners of a CRS on earth to local metres. Raises UnreadableFile if they are too far away."""
    p, q, r, s = frame.from_local
    east_north = between(crs, frame.crs, corners)
    if not np.isfinite(east_north).all():
        raise raster_error("it is too far from the datum for the local frame: correct one of them")
    metres: Array = east_north @ np.array([[p, q], [r, s]])
    return metres


def place_grid(cells: NDArray[np.uint8], stored: OccupancyGrid | None, corners: Array) -> OccupancyGrid:
    """Return the grid of cells at these corners (local metres), with the meaning of a stored one.

    The stored one is returned if its corners are the same: it is exact. Raises UnreadableFile if no square cells fit.
    """
    height, width = cells.shape
    resolution, origin, deviation = _fit(corners, width, height)
    if deviation > MAX_DEVIATION * resolution:
        raise raster_error(
            "its pixels are not square in local metres: warp it (gdalwarp -t_srs) to a transverse Mercator CRS"
        )
    if stored is None:
        return OccupancyGrid(cells, resolution, origin)
    if np.abs(stored.corners() - corners).max() <= SAME_CELLS * resolution:
        return stored
    # Cropped, warped, or written for another datum: the transform is right, and the meaning of the cells is the same.
    return replace(stored, resolution=resolution, origin=origin)


def _fit(corners: Array, width: int, height: int) -> tuple[float, tuple[float, float, float], float]:
    """Fit a grid with square cells to corners: resolution, origin, and the maximum deviation in metres."""
    along = corners[1] - corners[0]
    up = corners[3] - corners[0]
    resolution = round(float(math.hypot(*along) / width), 12)
    yaw = math.atan2(along[1], along[0])
    yaw = 0.0 if abs(yaw) < 1e-12 else yaw
    x, y = (round(float(v), 9) for v in corners[0])
    c, s = math.cos(yaw) * resolution, math.sin(yaw) * resolution
    expected = np.array([[c * width, s * width], [-s * height, c * height]])
    deviation = max(
        float(np.abs(np.array([along, up]) - expected).max()),
        float(np.abs(corners[2] - corners[0] - expected.sum(axis=0)).max()),
    )
    return resolution, (x, y, yaw), deviation
