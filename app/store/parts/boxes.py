"""Bounding boxes in metres and in degrees: around points, across the antimeridian, between frames."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
import shapely
from numpy.typing import NDArray

from app.model.distinct import distinct
from app.model.geodesy import LocalFrame
from app.store.values import Box


def bounding_box(points: NDArray[np.float64]) -> Box:
    """Return the box around points: float64 [n, 2]."""
    x0, y0 = points.min(axis=0).tolist()
    x1, y1 = points.max(axis=0).tolist()
    return (x0, y0, x1, y1)


def crossing_box(points: NDArray[np.float64]) -> Box:
    """Return the box in degrees around (longitude, latitude) points that excludes the widest gap of longitudes."""
    longitude = distinct(points[:, 0])
    south, north = float(points[:, 1].min()), float(points[:, 1].max())
    gaps = np.diff(longitude, append=longitude[:1] + 360.0)
    k = int(gaps.argmax())
    west, east = float(longitude[(k + 1) % len(longitude)]), float(longitude[k])
    return (west, south, east, north)


def split_box(box: Box) -> list[Box]:
    """Split a box in degrees into one or two that do not cross the antimeridian."""
    west, south, east, north = box
    if west <= east:
        return [box]
    return [(west, south, 180.0, north), (-180.0, south, east, north)]


EDGE_POINTS: Final = 9
"""Number of points on each side of a box that is transformed, since its sides become curves."""


def ring(box: Box) -> NDArray[np.float64]:
    """Sample points along a box: float64 [n, 2]."""
    x0, y0, x1, y1 = box
    t = np.linspace(0.0, 1.0, EDGE_POINTS)
    xs, ys = x0 + (x1 - x0) * t, y0 + (y1 - y0) * t
    sides = [np.column_stack(np.broadcast_arrays(*side)) for side in ((xs, y0), (x1, ys), (xs, y1), (x0, ys))]
    return np.concatenate(sides)


def boxes_in_other_frame(box: Box, crs: str, frame: LocalFrame | None) -> list[Box]:
    """Transform a box of ``crs`` into boxes of the other frame, slightly wider: degrees or metres."""
    assert frame is not None
    if crs == "wgs84":
        points = frame.to_local(ring(box))
        if not np.isfinite(points).all():
            return [(-math.inf, -math.inf, math.inf, math.inf)]
        return [widened(bounding_box(points))]
    return split_box(widened(local_box_to_wgs84(box, frame)))


def widened(box: Box) -> Box:
    """Widen a box slightly on each side, for the bulge of a curve between the points."""
    x0, y0, x1, y1 = box
    dx = abs(x1 - x0) * 0.01
    dy = abs(y1 - y0) * 0.01
    return (x0 - dx, y0 - dy, x1 + dx, y1 + dy)


def local_box_to_wgs84(box: Box, frame: LocalFrame) -> Box:
    """Return the box in degrees around a box in local metres; west > east if it crosses the antimeridian."""
    points = frame.to_wgs84(ring(box))
    return unwrapped_box(points, frame.datum.longitude)


def unwrapped_box(points: NDArray[np.float64], around: float) -> Box:
    """Return the box of (longitude, latitude) points with longitudes shifted to within 180 degrees of a given one."""
    longitude = (points[:, 0] - around + 180.0) % 360.0 - 180.0 + around
    west, east = float(longitude.min()), float(longitude.max())
    return (wrap(west), float(points[:, 1].min()), wrap(east), float(points[:, 1].max()))


def wrap(longitude: float) -> float:
    """Normalise a longitude to [-180, 180]."""
    return longitude if -180.0 <= longitude <= 180.0 else (longitude + 180.0) % 360.0 - 180.0


def coordinates(geometry: Any) -> NDArray[np.float64]:
    """Return all (x, y) of one geometry: float64 [n, 2]."""
    return np.asarray(shapely.get_coordinates(geometry), np.float64)
