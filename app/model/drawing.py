"""Features as a screen can show them: simplified to a pixel, nothing smaller, and one node per pixel."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from app.model.frame import Anchor

METRES_PER_PIXEL: Final = 156543.034
"""Metres per pixel at zoom 0 at the equator, for tiles of 256 pixels in web Mercator."""

METRES_PER_DEGREE: Final = 111_319.49
"""Metres per degree of latitude, for the size of a pixel."""


class Drawing(NamedTuple):
    """Features to draw: their indices, and the geometries of these, simplified."""

    indices: NDArray[np.intp]
    geometry: NDArray[np.object_]


def for_zoom(kinds: NDArray[np.object_], geometry: NDArray[np.object_], crs: Anchor, zoom: int) -> Drawing:
    """Select what is visible at a zoom, and simplify it. geometry: in ``crs``, of features of these kinds.

    Edges keep their geometry. Points other than nodes are all kept.
    """
    pixel = METRES_PER_PIXEL / 2**zoom / (1.0 if crs == "local" else METRES_PER_DEGREE)
    points = shapely.get_dimensions(geometry) == 0
    visible = points | _is_visible(geometry, crs, pixel)
    nodes = np.flatnonzero(points & (kinds == "node") & ~shapely.is_empty(geometry))
    visible[nodes] = False
    visible[_one_per_pixel(nodes, geometry, pixel)] = True
    indices = np.flatnonzero(visible)
    out = geometry[indices]
    shapes = (kinds[indices] != "edge") & ~points[indices]
    out[shapes] = shapely.simplify(out[shapes], pixel)
    return Drawing(indices, out)


def _is_visible(geometry: NDArray[np.object_], crs: Anchor, pixel: float) -> NDArray[np.bool_]:
    """Test if geometries are at least a pixel wide or high; empty ones are not."""
    x0, y0, x1, y1 = np.nan_to_num(shapely.bounds(geometry), nan=0.0).T
    width = x1 - x0
    if crs == "wgs84":
        width = width * np.cos(np.radians((y0 + y1) / 2))
    visible: NDArray[np.bool_] = ~shapely.is_empty(geometry) & (np.maximum(width, y1 - y0) >= pixel)
    return visible


def _one_per_pixel(nodes: NDArray[np.intp], geometry: NDArray[np.object_], pixel: float) -> NDArray[np.intp]:
    """Select the first node of each pixel. Pixels are multiples of their size, so every box of a map gets the same."""
    corners = shapely.bounds(geometry[nodes])[:, :2]
    if not len(corners) or pixel < math.ulp(1.0):
        return nodes
    _, first = np.unique(np.floor(corners / pixel).astype(np.int64), axis=0, return_index=True)
    chosen: NDArray[np.intp] = nodes[np.sort(first)]
    return chosen
