"""Parse WKB of untrusted files, and change the coordinates of many geometries at once."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, NoReturn

import numpy as np
import shapely
from numpy.typing import NDArray

from app.errors import Problem, UnreadableFile
from app.model.features import NO_GEOMETRY
from app.syntax.decimals import METRES

MAX_NESTED = 10_000
"""Maximum number of nested geometries of one geometry: GEOS reads them recursively."""

_NESTED = re.compile(
    rb"\x01[\x04-\x07\xec-\xef\xd4-\xd7\xbc-\xbf][\x00\x03\x07\x0b]\x00[\x00\x20\x40\x60\x80\xa0\xc0\xe0]"
    rb"|\x00[\x00\x20\x40\x60\x80\xa0\xc0\xe0]\x00[\x00\x03\x07\x0b][\x04-\x07\xec-\xef\xd4-\xd7\xbc-\xbf]"
)
"""Header of a WKB geometry that contains others: little or big endian, with z and m of ISO or EWKB."""


def raise_unreadable(reason: str, location: str | None = None) -> NoReturn:
    """Raise UnreadableFile for a location in the file."""
    raise UnreadableFile(f"{location}: {reason}" if location else reason, [Problem(reason, where=location)])


def parse_shapes(codes: list[bytes | None], table: str) -> NDArray[np.object_]:
    """Parse WKB; absent and empty geometries become NO_GEOMETRY. Raises UnreadableFile naming table and row."""
    for k, code in enumerate(codes):
        if code is not None and len(code) > 9 * MAX_NESTED and len(_NESTED.findall(code)) > MAX_NESTED:
            raise_unreadable(f"a geometry of more than {MAX_NESTED} parts: split it", f"{table}, row {k + 1}")
    try:
        shapes = np.asarray(shapely.from_wkb(np.array([*codes, None], object)), object)[:-1]
    except (shapely.errors.ShapelyError, NotImplementedError, ValueError) as error:
        raise_unreadable(*_first_unreadable(codes, table, error))
    return plain_shapes(shapes)


def _first_unreadable(codes: list[bytes | None], table: str, error: Exception) -> tuple[str, str]:
    for k, code in enumerate(codes):
        try:
            shapely.from_wkb(code)
        except NotImplementedError:
            return "curves are unsupported: convert them to lines (in QGIS: Segmentize)", f"{table}, row {k + 1}"
        except (shapely.errors.ShapelyError, ValueError) as reason:
            return f"invalid geometry: {reason}", f"{table}, row {k + 1}"
    return f"invalid geometry: {error}", table


def plain_shapes(geometry: NDArray[np.object_]) -> NDArray[np.object_]:
    """Return geometries without measures (M); absent and empty ones become NO_GEOMETRY."""
    out = geometry.copy()
    absent = shapely.is_missing(out) | shapely.is_empty(out)
    out[absent] = NO_GEOMETRY
    measured = shapely.has_m(out)
    deep = measured & shapely.has_z(out)
    if measured.any():
        out[measured & ~deep] = shapely.force_2d(out[measured & ~deep])
        out[deep] = shapely.from_wkb(shapely.to_wkb(out[deep], output_dimension=3))
    return out


def transformed(geometry: NDArray[np.object_], function: Any) -> NDArray[np.object_]:
    """Apply a function of coordinates (float64 [n, 2] or [n, 3]) to all geometries."""
    out = np.empty(len(geometry), object)
    deep = shapely.has_z(geometry)
    for mask, include_z in ((~deep, False), (deep, True)):
        if mask.any():
            out[mask] = shapely.transform(geometry[mask], function, include_z=include_z)
    return out


def scaled(geometry: NDArray[np.object_], factors: Sequence[float]) -> NDArray[np.object_]:
    """Multiply x, y and z by their factors, and round the results to 9 decimals (a nanometre, of metres)."""
    return transformed(geometry, lambda points: np.round(points * factors[: points.shape[1]], METRES))
