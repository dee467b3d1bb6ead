"""Bounding boxes of parts in both frames: local metres, and degrees."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.convert.placement import border, image_transform
from app.model.frame import Datum
from app.model.geodesy import LocalFrame, crs_to_wgs84, local_frame
from app.model.imagery import LOCAL, pixel_positions
from app.store.extent import join
from app.store.parts.boxes import bounding_box, local_box_to_wgs84, ring, split_box, unwrapped_box
from app.store.values import Bounds, Box, PartEntry
from app.store.windows import RasterReader

BORDER_STEPS = 9
"""Number of points on each side of a raster that is transformed, since its sides become curves."""


def bounds_in_both_frames(entry: PartEntry, datum: Datum | None, header: Callable[[PartEntry], RasterReader]) -> Bounds:
    """Return the boxes of a part in local metres and in degrees (west > east crosses the antimeridian).

    Without a datum, those of the frame in which it is stored. Rasters: the box of their turned outline. Other parts:
    the box around the converted box, which may be larger than necessary if the datum has a heading.
    """
    if datum is None or not entry.count:
        return entry.bounds
    frame = local_frame(datum)
    if entry.key.layer in ("occupancy", "imagery"):
        return _raster_bounds(header(entry), frame)
    local, wgs84 = entry.bounds.get("local"), entry.bounds.get("wgs84")
    boxes = [box for box in (wgs84, None if local is None else local_box_to_wgs84(local, frame)) if box is not None]
    local_boxes = [] if local is None else [ring(local)]
    if wgs84 is not None:
        local_boxes += [frame.to_local(ring(part)) for part in split_box(wgs84)]
    return {
        "local": _finite(bounding_box(np.concatenate(local_boxes))) if local_boxes else None,
        "wgs84": _finite(join([box for box in boxes if _finite(box)], datum.longitude)),
    }


def _raster_bounds(reader: RasterReader, frame: LocalFrame) -> Bounds:
    local, degrees = raster_outline(reader.header, reader.kind, frame)
    return {
        "local": _finite(bounding_box(local)),
        "wgs84": _finite(unwrapped_box(degrees, frame.datum.longitude)),
    }


def raster_outline(
    header: Mapping[str, Any], kind: str, frame: LocalFrame
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return points on the border of a raster in metres and in degrees."""
    columns, rows = border(header, BORDER_STEPS).T
    if kind == "grid":
        x, y, yaw = header["origin"]
        along, up = columns * header["resolution"], rows * header["resolution"]
        local = np.column_stack(
            [x + np.cos(yaw) * along - np.sin(yaw) * up, y + np.sin(yaw) * along + np.cos(yaw) * up]
        )
        return local, frame.to_wgs84(local)
    points = pixel_positions(image_transform(header), columns, rows)
    if header["crs"] == LOCAL:
        return points, frame.to_wgs84(points)
    degrees = crs_to_wgs84(header["crs"], np.column_stack([points, np.zeros(len(points))]))[:, :2]
    return frame.to_local(degrees), degrees


def _finite(box: Box | None) -> Box | None:
    return box if box is not None and bool(np.isfinite(box).all()) else None
