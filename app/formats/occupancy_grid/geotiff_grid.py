"""Grids as GeoTIFF, for GIS: the canonical cell values with a colour table, at their position on earth.

One band of bytes: 0 (free) to 100 (occupied), 255 unknown, which is the no-data value. Row 0 is on top. With a datum,
the CRS is ``LocalFrame.wkt``, and the transform contains the grid's yaw and the datum's heading; else local metres.
``FLEETMAP_GRID`` has the other keys of the YAML file. Overviews have the maximum of the known cells.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.errors import Invalid, Problem, UnreadableFile
from app.formats import ReadContext, WriteContext
from app.model.geodesy import LocalFrame, between
from app.model.georeference import to_earth
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, halve_cells
from app.model.imagery import LOCAL, Affine, GeoImage, pixel_positions
from app.syntax import geotiff

GRID_TAG = "FLEETMAP_GRID"
"""Metadata item with the keys of the grid's YAML file, as JSON."""

FREE_COLOUR, OCCUPIED_COLOUR, UNKNOWN_COLOUR = (254, 254, 254), (0, 0, 0), (205, 205, 205)
"""The greys of map_saver; between free and occupied the shade is linear. No-data is not drawn, so unknown is clear."""

SAME_CELLS = 1e-3
"""Maximum distance in cells between the corners of a grid's metadata and those of its transform."""

MAX_DEVIATION = 0.1
"""Maximum distance in cells between a raster's corners and those of a grid with square cells."""


def transform_of(grid: OccupancyGrid) -> Affine:
    """Return the transform from (column, row), row 0 on top, to local metres."""
    x, y, yaw = grid.origin
    c, s = math.cos(yaw) * grid.resolution, math.sin(yaw) * grid.resolution
    return (c, s, x - s * grid.height, s, -c, y + c * grid.height)


def place(grid: OccupancyGrid, frame: LocalFrame | None) -> tuple[Affine, str | None]:
    """Return the transform to write, and its CRS; None without a datum."""
    transform = transform_of(grid)
    return (transform, None) if frame is None else (to_earth(transform, frame), frame.wkt)


def write_grid(grid: OccupancyGrid, frame: LocalFrame | None, context: WriteContext, file: str) -> bytes:
    """Write a cloud optimized GeoTIFF."""
    if frame is None:
        context.warn(
            "its coordinates are metres of the local frame, without a position on earth: set a datum for one", file=file
        )
    transform, crs = place(grid, frame)
    properties = {"bands": [{"colour": "palette"}], "palette": _palette(), "nodata": UNKNOWN}
    tags = {geotiff.OWN_TAG: LOCAL, GRID_TAG: json.dumps(_keys(grid))}
    if context.attribution:
        tags["TIFFTAG_COPYRIGHT"] = "; ".join(context.attribution)
    picture = GeoImage(grid.cells[::-1, :, None], transform, LOCAL, properties)
    return geotiff.write_cog(picture, crs, tags, halve_cells)


def _palette() -> list[list[int]]:
    """Return 256 colours. Values that no cell has are the colour of unknown ones."""
    colours = np.full((256, 4), (*UNKNOWN_COLOUR, 255))
    share = np.arange(OCCUPIED + 1)[:, None] / OCCUPIED
    colours[: OCCUPIED + 1, :3] = np.round(np.array(FREE_COLOUR) * (1 - share) + np.array(OCCUPIED_COLOUR) * share)
    table: list[list[int]] = colours.tolist()
    return table


def _keys(grid: OccupancyGrid) -> dict[str, Any]:
    return {
        "size": [grid.width, grid.height],
        "resolution": grid.resolution,
        "origin": list(grid.origin),
        "mode": grid.mode,
        "occupied_thresh": grid.occupied_thresh,
        "free_thresh": grid.free_thresh,
        "negate": grid.negate,
    }


_NAMES = frozenset({"resolution", "origin", "mode", "occupied_thresh", "free_thresh", "negate", "size"})


def is_grid(data: bytes) -> bool:
    """Return whether a file is a GeoTIFF that ``write_grid`` wrote."""
    return geotiff.is_tiff(data) and geotiff.has_item(data, GRID_TAG)


def read_grid(data: bytes, context: ReadContext) -> OccupancyGrid:
    """Read a GeoTIFF with cell values. Raises UnreadableFile or TooLarge."""
    raster = geotiff.read_tiff(data, context.limits)
    cells = raster.pixels[::-1, :, 0]
    if raster.pixels.shape[2] != 1 or raster.pixels.dtype != np.uint8:
        raise _unreadable(
            f"a grid is one band of bytes, got {raster.pixels.shape[2]} of {raster.pixels.dtype}: upload it as "
            "format=satellite",
        )
    if not bool(((cells <= OCCUPIED) | (cells == UNKNOWN)).all()):
        raise _unreadable(
            f"cells must be {FREE} (free) to {OCCUPIED} (occupied), or {UNKNOWN} (unknown): upload it as "
            "format=satellite, or reclassify it"
        )
    height, width = cells.shape
    keys = _stored_keys(raster)
    stored = None if keys is None else _stored_grid(cells, keys)
    corners = _local_corners(raster, stored, width, height, context)
    resolution, origin, deviation = _fit(corners, width, height)
    if deviation > MAX_DEVIATION * resolution:
        raise _unreadable(
            "its pixels are not square in local metres: warp it (gdalwarp -t_srs) to a transverse Mercator CRS"
        )
    if stored is None:
        return OccupancyGrid(cells, resolution, origin)
    if np.abs(stored.corners() - corners).max() <= SAME_CELLS * resolution:
        return stored
    # Cropped, warped, or written for another datum: the transform is right, and the meaning of the cells is the same.
    return replace(stored, resolution=resolution, origin=origin)


def _stored_grid(cells: NDArray[np.uint8], keys: Mapping[str, Any]) -> OccupancyGrid:
    try:
        return OccupancyGrid(cells, **{name: value for name, value in keys.items() if name != "size"})
    except (Invalid, TypeError, ValueError) as error:
        raise _unreadable(f"invalid {GRID_TAG}: remove this item, or export the grid again") from error


def _unreadable(reason: str) -> UnreadableFile:
    return UnreadableFile(reason, [Problem(reason)])


def _stored_keys(raster: geotiff.Raster) -> dict[str, Any] | None:
    """Return the keys of the YAML file in the metadata; None if there are none."""
    source = raster.properties.get("satellite")
    text = source.get("tags", {}).get(GRID_TAG) if isinstance(source, Mapping) else None
    if text is None:
        return None
    try:
        keys: dict[str, Any] = json.loads(text)
        if keys.keys() == _NAMES:
            return {**keys, "origin": tuple(map(float, keys["origin"])), "negate": bool(keys["negate"])}
    except (ValueError, TypeError, AttributeError, RecursionError):
        pass
    raise _unreadable(f"invalid {GRID_TAG}: remove this item, or export the grid again")


def _local_corners(
    raster: geotiff.Raster, stored: OccupancyGrid | None, width: int, height: int, context: ReadContext
) -> NDArray[np.float64]:
    """Return the corners in local metres, counter-clockwise from the lower left one: float64 [4, 2]."""
    if raster.transform is None:
        raise _unreadable("it has no position: add its transform (gdal_translate -a_ullr), or upload a YAML file")
    columns, rows = np.array([0.0, width, width, 0.0]), np.array([height, height, 0.0, 0.0])
    ends = pixel_positions(raster.transform, columns, rows)
    if raster.crs in (None, LOCAL):
        return ends
    if context.frame is None:
        keys = _stored_keys(raster)
        if stored is None or keys is None or keys["size"] != [width, height]:
            raise _unreadable("it is placed on earth, and the environment has no datum: set one first")
        context.warn("the environment has no datum: the grid's local metres are used, not its position on earth")
        return stored.corners()
    p, q, r, s = context.frame.from_local
    east_north = between(str(raster.crs), context.frame.crs, ends)
    if not np.isfinite(east_north).all():
        raise _unreadable("it is too far from the datum for the local frame: correct one of them")
    metres: NDArray[np.float64] = east_north @ np.array([[p, q], [r, s]])
    return metres


def _fit(corners: NDArray[np.float64], width: int, height: int) -> tuple[float, tuple[float, float, float], float]:
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
