"""Grids as GeoTIFF, for GIS: the canonical cell values with a colour table, at their position on earth.

One band of bytes: 0 (free) to 100 (occupied), 255 unknown, which is the no-data value. Row 0 is on top. With a datum,
the CRS is ``LocalFrame.wkt``, and the transform contains the grid's yaw and the datum's heading; else local metres.
``FLEETMAP_GRID`` has the other keys of the YAML file. Overviews have the maximum of the known cells.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.formats import ReadContext, WriteContext
from app.formats._grid_files import (
    cell_colours,
    corners_of,
    corners_to_local,
    grid_from_keys,
    grid_keys,
    place_grid,
    raster_error,
    transform_of,
)
from app.model.geodesy import LocalFrame
from app.model.georeference import to_earth
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, halve_cells
from app.model.imagery import LOCAL, Affine, GeoImage
from app.syntax import geotiff

GRID_TAG = "FLEETMAP_GRID"
"""Metadata item with the keys of the grid's YAML file, as JSON."""


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
    properties = {"bands": [{"colour": "palette"}], "palette": cell_colours().tolist(), "nodata": UNKNOWN}
    tags = {geotiff.OWN_TAG: LOCAL, GRID_TAG: json.dumps(grid_keys(grid))}
    if context.attribution:
        tags["TIFFTAG_COPYRIGHT"] = "; ".join(context.attribution)
    picture = GeoImage(grid.cells[::-1, :, None], transform, LOCAL, properties)
    return geotiff.write_cog(picture, crs, tags, halve_cells)


_NAMES = frozenset({"resolution", "origin", "mode", "occupied_thresh", "free_thresh", "negate", "size"})


def is_grid(data: bytes) -> bool:
    """Return whether a file is a GeoTIFF that ``write_grid`` wrote."""
    return geotiff.is_tiff(data) and geotiff.has_item(data, GRID_TAG)


def read_grid(data: bytes, context: ReadContext) -> OccupancyGrid:
    """Read a GeoTIFF with cell values. Raises UnreadableFile or TooLarge."""
    raster = geotiff.read_tiff(data, context.limits)
    cells = raster.pixels[::-1, :, 0]
    if raster.pixels.shape[2] != 1 or raster.pixels.dtype != np.uint8:
        raise raster_error(
            f"a grid is one band of bytes, got {raster.pixels.shape[2]} of {raster.pixels.dtype}: upload it as "
            "format=satellite",
        )
    if not bool(((cells <= OCCUPIED) | (cells == UNKNOWN)).all()):
        raise raster_error(
            f"cells must be {FREE} (free) to {OCCUPIED} (occupied), or {UNKNOWN} (unknown): upload it as "
            "format=satellite, or reclassify it"
        )
    height, width = cells.shape
    keys = _stored_keys(raster)
    stored = None if keys is None else grid_from_keys(cells, keys, GRID_TAG)
    corners = _local_corners(raster, stored, width, height, context)
    return place_grid(cells, stored, corners)


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
    raise raster_error(f"invalid {GRID_TAG}: remove this item, or export the grid again")


def _local_corners(
    raster: geotiff.Raster, stored: OccupancyGrid | None, width: int, height: int, context: ReadContext
) -> NDArray[np.float64]:
    """Return the corners in local metres, counter-clockwise from the lower left one: float64 [4, 2]."""
    if raster.transform is None:
        raise raster_error("it has no position: add its transform (gdal_translate -a_ullr), or upload a YAML file")
    ends = corners_of(raster.transform, width, height)
    if raster.crs in (None, LOCAL):
        return ends
    if context.frame is None:
        keys = _stored_keys(raster)
        if stored is None or keys is None or keys["size"] != [width, height]:
            raise raster_error("it is placed on earth, and the environment has no datum: set one first")
        context.warn("the environment has no datum: the grid's local metres are used, not its position on earth")
        return stored.corners()
    return corners_to_local(ends, str(raster.crs), context.frame)
