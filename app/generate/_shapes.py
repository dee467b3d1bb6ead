"""Simple shapes in whole millimetres, and their values in files."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import shapely


def mm(value: float) -> float:
    """Round a coordinate or length to whole millimetres."""
    return round(float(value), 3) + 0.0


def angle(value: float) -> float:
    """Round an angle to whole microradians, from -π to π."""
    return round(math.remainder(float(value), 2 * math.pi), 6) + 0.0


def round_geometry(geometry: Any) -> Any:
    """Round a geometry to whole millimetres."""
    return shapely.transform(geometry, lambda xy: np.round(xy, 3) + 0.0)


def rectangle(x: float, y: float, yaw: float, length: float, width: float) -> Any:
    """Return a rectangle around a centre, its length along the yaw."""
    c, s = math.cos(yaw), math.sin(yaw)
    corners = [(u * length / 2, v * width / 2) for u, v in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    return round_geometry(shapely.Polygon([(x + c * u - s * v, y + s * u + c * v) for u, v in corners]))


_CIRCLE = [(round(math.cos(math.pi * k / 8), 6), round(math.sin(math.pi * k / 8), 6)) for k in range(16)]


def disc(x: float, y: float, radius: float) -> Any:
    """Return a polygon of 16 sides around a centre."""
    return shapely.Polygon([(mm(x + radius * c), mm(y + radius * s)) for c, s in _CIRCLE])


def orientation(yaw: float) -> list[float]:
    """Return the quaternion [x, y, z, w] of a yaw."""
    return [0.0, 0.0, round(math.sin(yaw / 2), 6) + 0.0, round(math.cos(yaw / 2), 6) + 0.0]
