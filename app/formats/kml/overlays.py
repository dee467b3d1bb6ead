"""Grids and images as ground overlays with image files."""

from __future__ import annotations

import math
import re
from collections import Counter
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from app.errors import Invalid
from app.formats import WriteContext
from app.formats.kml.texts import GX, data_element, degree_texts, place_members
from app.formats.kml.words import escape
from app.model.features import Features
from app.model.frame import GROUND, MAX_DATUM_LATITUDE, Datum
from app.model.geodesy import crs_to_wgs84, local_frame
from app.model.grid import OccupancyGrid
from app.model.imagery import DEFAULT_COLOURS, LOCAL, GeoImage, display_pixels
from app.model.layers import Layers, PartKey
from app.syntax import decimals, images


def write_overlays(
    layers: Layers, context: WriteContext, with_pictures: bool, taken: frozenset[str]
) -> tuple[list[str], dict[str, bytes]]:
    """Write each grid and image as a GroundOverlay, with metadata that its image lacks, and the image files."""
    out: list[str] = []
    image_files: dict[str, bytes] = {}
    counts: Counter[str] = Counter()
    for key, part in layers.parts.items():
        if not isinstance(part, OccupancyGrid | GeoImage):
            continue
        corners = _corners(key, part, layers, context)
        if corners is None:
            continue
        label = key.name if key.level == GROUND else f"{key.level}-{key.name}"
        stem = re.sub(r"[^\w.-]+", "_", label).strip(".") or key.layer
        name, n = f"{stem}.png", 2
        while name in taken or name in image_files:
            name, n = f"{stem}-{n}.png", n + 1
        image_files[name] = _png(key, part, context) if with_pictures else b""
        out.append(_overlay(key, part, name, corners))
        counts[key.layer] += 1
    for layer, count in sorted(counts.items() if not with_pictures else ()):
        why = "the images are in KMZ only, or beside the KML with pictures=true; this KML contains the positions only"
        context.drop(layer, count, why)
    return out, image_files if with_pictures else {}


def _corners(
    key: PartKey, part: OccupancyGrid | GeoImage, layers: Layers, context: WriteContext
) -> NDArray[np.float64] | None:
    """Return an image's lower left, lower right, upper right and upper left corner as (longitude, latitude).

    None if KML cannot express the position; the reason is reported.
    """
    if isinstance(part, OccupancyGrid):
        shape = np.array([shapely.polygons(part.corners())], object)
        local = Features((key.name,), shape, ({},), np.ones(1, bool))
        return np.asarray(shapely.get_coordinates(local.in_wgs84(layers.frame))[:4], np.float64)
    corners = part.outline()[[3, 2, 1, 0]]
    problem = ""
    if part.crs != LOCAL:
        try:
            corners = crs_to_wgs84(part.crs, np.column_stack([corners, np.zeros(4)]))[:, :2]
        except Invalid as error:
            problem = error.detail
    elif layers.frame is None:
        problem = "it is in local metres, and there is no datum"
    else:
        corners = layers.frame.to_wgs84(corners)
    if not problem and not (np.isfinite(corners).all() and (np.abs(corners) <= [180.0, 90.0]).all()):
        problem = "its corners are not on earth"
    if not problem and abs(corners[:, 1].mean()) > MAX_DATUM_LATITUDE:
        problem = f"it is beyond ±{MAX_DATUM_LATITUDE:g} degrees of latitude"
    if not problem and np.ptp(corners[:, 0]) > 180.0:
        problem = "it crosses the antimeridian, which an overlay cannot"
    context.drop(f"imagery {key.level}/{key.name}", int(bool(problem)), f"no position in KML: {problem}")
    return None if problem else corners


def _png(key: PartKey, part: OccupancyGrid | GeoImage, context: WriteContext) -> bytes:
    if isinstance(part, OccupancyGrid):
        return images.overlay_png(part)
    if not _is_displayable(part):
        why = "an overlay's image has 8-bit grey or colours: other bands, values and palettes are written as displayed"
        context.drop(f"imagery {key.level}/{key.name}: pixel values", 1, why)
    return images.encode_png(display_pixels(part))


def _is_displayable(picture: GeoImage) -> bool:
    """Whether a PNG stores the image's pixels without loss."""
    plain = picture.pixels.dtype == np.uint8 and picture.colours == DEFAULT_COLOURS.get(len(picture.colours))
    return plain and picture.nodata is None


def _overlay(key: PartKey, part: OccupancyGrid | GeoImage, href: str, ring: NDArray[np.float64]) -> str:
    """Return an image's position: a box and its rotation (assuming a flat box), and the exact corners."""
    longitude, latitude = ring.mean(axis=0).tolist()
    frame = local_frame(Datum(latitude, longitude))
    metres = frame.to_local(ring)
    right, up = metres[1] + metres[2] - metres[0] - metres[3], metres[2] + metres[3] - metres[0] - metres[1]
    w, h = np.hypot(*right) / 4, np.hypot(*up) / 4
    sides = frame.to_wgs84(metres.mean(axis=0) + np.array([[w, 0.0], [-w, 0.0], [0.0, h], [0.0, -h]]))
    east, west, north, south = sides[0, 0], sides[1, 0], sides[2, 1], sides[3, 1]
    turn = round(math.degrees(math.atan2(right[1], right[0])), 9) + 0.0
    parameters: dict[str, Any]
    if isinstance(part, OccupancyGrid):
        parameters = {
            "resolution": part.resolution,
            "origin": list(part.origin),
            "mode": part.mode,
            "occupied_thresh": part.occupied_thresh,
            "free_thresh": part.free_thresh,
            "negate": part.negate,
            "size": [part.width, part.height],
        }
    else:
        parameters = {"crs": part.crs, "transform": list(part.transform)}
    if part.properties:
        properties = part.properties
        plain = isinstance(part, OccupancyGrid) or _is_displayable(part)
        parameters["properties"] = (
            dict(properties) if plain else {k: v for k, v in properties.items() if k == "attribution"}
        )
    data = place_members(key) + "".join(data_element(n, v) for n, v in parameters.items())
    box = zip(("north", "south", "east", "west", "rotation"), (north, south, east, west, turn), strict=True)
    sides_text = "".join(f"<{n}>{decimals.number(v, decimals.DEGREES)}</{n}>" for n, v in box if n != "rotation" or v)
    quad = degree_texts(shapely.linestrings(ring[None])).texts[0]
    return (
        f"<GroundOverlay><name>{escape(key.name)}</name><ExtendedData>{data}</ExtendedData>"
        f"<Icon><href>{escape(href)}</href></Icon><LatLonBox>{sides_text}</LatLonBox>"
        f'<gx:LatLonQuad xmlns:gx="{GX}"><coordinates>{quad}</coordinates></gx:LatLonQuad></GroundOverlay>\n'
    )
