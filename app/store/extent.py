"""Extent of an environment on earth: the box around all parts, also across the antimeridian."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import shapely

from app.model.frame import Datum
from app.model.geodesy import local_frame
from app.store.encode import to_wkb
from app.store.parts.boxes import local_box_to_wgs84, split_box, wrap
from app.store.values import Box, PartEntry


def extent(entries: Iterable[PartEntry], datum: Datum | None) -> Box | None:
    """Return (west, south, east, north) in degrees around all parts; without any, the datum."""
    boxes: list[Box] = []
    for entry in entries:
        wgs84, local = entry.bounds.get("wgs84"), entry.bounds.get("local")
        if wgs84 is not None:
            boxes.append(wgs84)
        if local is not None and datum is not None:
            boxes.append(local_box_to_wgs84(local, local_frame(datum)))
    if not boxes and datum is not None:
        boxes.append((datum.longitude, datum.latitude, datum.longitude, datum.latitude))
    return join(boxes, datum.longitude if datum else None)


def join(boxes: Sequence[Box], around: float | None = None) -> Box | None:
    """Join boxes in degrees, each shifted by whole turns to be near ``around`` (else near the first)."""
    if not boxes:
        return None
    near = boxes[0][0] if around is None else around
    spans = []
    for west, _, east, _ in boxes:
        width = east - west if west <= east else east - west + 360.0
        middle = west + width / 2.0
        shift = -360.0 * round((middle - near) / 360.0)
        spans.append((west + shift, west + shift + width))
    west, east = min(s for s, _ in spans), max(e for _, e in spans)
    south, north = min(b[1] for b in boxes), max(b[3] for b in boxes)
    if east - west >= 360.0:
        return (-180.0, south, 180.0, north)
    return (wrap(west), south, wrap(east), north)


def geometry(box: Box | None) -> bytes | None:
    """Convert the box to WKB in degrees: a polygon (or line or point without area), two across the antimeridian."""
    if box is None:
        return None
    shapes = [_shape(one) for one in split_box(box)]
    shape = shapes[0] if len(shapes) == 1 else shapely.GeometryCollection(shapes)
    if len(shapes) == 2 and all(s.geom_type == "Polygon" for s in shapes):
        shape = shapely.MultiPolygon(shapes)
    column = shapely.empty(1)
    column[0] = shape
    return bytes(to_wkb(column)[0])


def _shape(box: Box) -> shapely.Geometry:
    west, south, east, north = box
    if west == east and south == north:
        return shapely.Point(west, south)
    if west == east or south == north:
        return shapely.LineString([(west, south), (east, north)])
    return shapely.box(west, south, east, north)
