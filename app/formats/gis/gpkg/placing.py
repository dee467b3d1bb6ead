"""Position of tiles: they are upright in a CRS, so a turned raster gets a CRS with its own axes."""

from __future__ import annotations

import math
from dataclasses import dataclass

from app.formats.gis.gpkg.words import CARTESIAN, DEGREES, LOCAL_SRS
from app.model.geodesy import WGS84, LocalFrame
from app.model.georeference import to_earth, turn
from app.model.imagery import LOCAL, Affine
from app.syntax import geotiff

UPRIGHT = 1e-9
"""Largest part of a pixel's side along the other axis that counts as none: 0.03 mm in 27 000 pixels of 1 m."""


@dataclass(frozen=True, slots=True)
class Place:
    """CRS of tiles and position in it. srs_id: None for a CRS without a number. definition: None for predefined ones.

    left, top: of the outer corner of the first pixel. dx, dy: size of a pixel, positive.
    """

    srs_id: int | None
    definition: str | None
    left: float
    top: float
    dx: float
    dy: float


def place(transform: Affine, crs: str, frame: LocalFrame | None) -> Place | None:
    """Return where a raster of this transform to ``crs`` is written; None if no CRS has its axes.

    crs: LOCAL (metres of the local frame) or a CRS that PROJ knows.
    """
    if crs != LOCAL:
        return _upright(transform, *_named(crs))
    if frame is None:
        return _upright(transform, CARTESIAN, None)
    a, b, c, d, e, f = to_earth(transform, frame)
    angle = math.atan2(d, a)
    if abs(angle) < UPRIGHT:
        return _upright((a, b, c, d, e, f), LOCAL_SRS, None)
    cos, sin = math.cos(angle), math.sin(angle)
    return _upright(turn((a, b, c, d, e, f), (cos, sin, -sin, cos)), None, frame.turned_wkt(angle))


def _named(crs: str) -> tuple[int | None, str | None]:
    if crs.upper() in (WGS84, "OGC:CRS84"):
        return DEGREES, None
    authority, _, code = crs.partition(":")
    is_number = authority.upper() == "EPSG" and code.isdigit() and len(code) < 8
    return int(code) if is_number else None, geotiff.crs_to_wkt(crs)


def _upright(transform: Affine, srs_id: int | None, definition: str | None) -> Place | None:
    a, b, c, d, e, f = transform
    if a <= 0.0 or e >= 0.0 or max(abs(b), abs(d)) > UPRIGHT * min(a, -e):
        return None
    return Place(srs_id, definition, c, f, a, -e)
