"""The elements of KML, and their allowed values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import orjson
import shapely
from lxml import etree

from app.errors import Problem, UnreadableFile
from app.formats import ReadContext
from app.formats._fields import COORDINATE, LATITUDE, LONGITUDE, Number, OneOf
from app.formats.kml.coordinates import PLAIN_NUMBER, with_line
from app.formats.kml.words import child_text, local_name
from app.model.frame import MAX_METRES

FREE = frozenset({"ExtendedData", "Metadata"})
"""Elements with arbitrary content."""

_NAMES = """
    address Alias altitude altitudeMode altitudeOffset angles AnimatedUpdate antialias BalloonStyle
    balloonVisibility begin bgColor bottomFov Camera CascadingStyle
    Change color colorMode cookie coord coordinates Create Data
    delayedStart Delete description displayMode displayName Document drawOrder duration east end expires
    ExtendedData extrude fill flyTo FlyTo flyToMode flyToView Folder fovy geomColor GeometryCollection geomScale
    gridOrigin GroundOverlay h heading horizFov hotSpot href httpQuery Icon IconStyle ImagePyramid innerBoundaryIs
    interpolate ItemIcon key kml LabelStyle labelVisibility latitude LatLonAltBox LatLonBox LatLonQuad leftFov
    LinearRing LineString LineStyle Link linkDescription linkName linkSnippet listItemType ListStyle Location Lod
    longitude LookAt maxAltitude maxFadeExtent maxHeight maxLodPixels maxSessionLength maxSnippetLines maxWidth
    message Metadata minAltitude minFadeExtent minLodPixels minRefreshPeriod Model MultiGeometry MultiTrack name
    near NetworkLink NetworkLinkControl north ObjArrayField ObjField open option Orientation outerBoundaryIs
    outerColor outerWidth outline overlayXY Pair parent phoneNumber PhotoOverlay physicalWidth Placemark Playlist
    playMode Point Polygon PolyStyle range refreshInterval refreshMode refreshVisibility Region Replace ResourceMap
    rightFov roll rotation rotationXY scale Scale Schema SchemaData ScreenOverlay screenXY shape SimpleArrayData
    SimpleArrayField SimpleData SimpleField size Snippet snippet SoundCue sourceHref south state Style StyleMap
    styleUrl targetHref tessellate text textColor tileSize tilt TimeInstant timePosition TimeSpan TimeStamp topFov
    Tour TourControl Track Update Url value viewBoundScale ViewerOptions viewFormat viewRefreshMode viewRefreshTime
    ViewVolume visibility w Wait west when width x y z
"""
ELEMENTS = frozenset(_NAMES.split())
"""Elements of KML 2.0 to 2.3 and of Google's gx extension, without their namespace."""

_ANGLE = Number(-360.0, 360.0, unit="degrees")
_TURN = replace(_ANGLE, doubtful=True)
_SIZE = Number(0.0, MAX_METRES, doubtful=True)
_FLAG = OneOf(("0", "1", "true", "false"))
_VALUES: Mapping[str, Number | OneOf] = {
    "rotation": _ANGLE,
    **dict.fromkeys(("heading", "tilt", "roll"), _TURN),
    **dict.fromkeys(("leftFov", "rightFov", "bottomFov", "topFov"), _TURN),
    "latitude": LATITUDE,
    "longitude": LONGITUDE,
    **dict.fromkeys(("altitude", "minAltitude", "maxAltitude", "near"), replace(COORDINATE, doubtful=True)),
    **dict.fromkeys(("width", "scale", "refreshInterval", "viewRefreshTime", "viewBoundScale"), _SIZE),
    "range": Number(0.0, 1e9, unit="metres", doubtful=True),
    **dict.fromkeys(("open", "visibility", "extrude", "tessellate", "fill", "outline"), _FLAG),
    "altitudeMode": OneOf(
        ("clampToGround", "relativeToGround", "absolute", "clampToSeaFloor", "relativeToSeaFloor"),
    ),
}
"""Rules for plain values of KML, by element: positions out of range are rejected, doubtful views and styles reported.

Source: OGC KML 2.3, Google's gx extension.
"""


def check_values(root: etree._Element, context: ReadContext) -> None:
    """Reject positions that are out of range, with the line; report doubtful values, once for each element."""
    doubts: dict[str, list[Any]] = {}
    for name, rule in _VALUES.items():
        for element in root.iter("{*}" + name):
            text = (element.text or "").strip()
            if not text or len(element):
                continue
            refusal, doubt = rule.check(text)
            if refusal:
                raise UnreadableFile(f"<{name}>: {refusal}", [Problem(refusal, line=element.sourceline, where=name)])
            if doubt:
                doubts.setdefault(name, [doubt, element.sourceline, 0])[2] += 1
    for box in root.iter("{*}LatLonBox", "{*}LatLonAltBox"):
        north, south = child_text(box, "north"), child_text(box, "south")
        if PLAIN_NUMBER.match(north) and PLAIN_NUMBER.match(south) and float(north) < float(south):
            reason = f"north {north} is south of south {south}"
            if local_name(box) == "LatLonBox":
                raise UnreadableFile(f"<LatLonBox>: {reason}", [with_line(reason, box.sourceline)])
            doubts.setdefault("LatLonAltBox", [reason, box.sourceline, 0])[2] += 1
    for name, (doubt, line, count) in doubts.items():
        more = "" if count == 1 else f" ({count} times)"
        context.warn(f"<{name}>: {doubt}{more}", line=line, where=name)


def parse_metres(texts: Sequence[str | None], elements: Sequence[etree._Element]) -> list[Any]:
    """Parse the exact coordinates of local items (None: not local).

    They are nested JSON lists of a point, a line or an area, or a GeoJSON geometry. Points and lines are built all at
    once.
    """
    out: list[Any] = [None] * len(texts)
    points: list[tuple[int, Any]] = []
    lines: list[tuple[int, Any]] = []
    for k, text in enumerate(texts):
        if text is None:
            continue
        try:
            value = orjson.loads(text)
            if isinstance(value, dict):
                out[k] = shapely.from_geojson(orjson.dumps(value))
            elif isinstance(value[0], int | float):
                points.append((k, (len(value), value)))
            elif isinstance(value[0][0], int | float):
                lines.append((k, (len(value[0]), value)))
            else:
                rings = [shapely.linearrings(r) for r in value]
                out[k] = shapely.polygons(rings[0], holes=rings[1:] or None)
        except (ValueError, TypeError, LookupError, shapely.errors.ShapelyError) as error:
            raise _no_metres(elements[k]) from error
    for width in (2, 3):
        dots = [(k, v) for k, (w, v) in points if w == width]
        if dots:
            for (k, _), geometry in zip(dots, shapely.points(np.array([v for _, v in dots], np.float64)), strict=True):
                out[k] = geometry
        strings = [(k, v) for k, (w, v) in lines if w == width and len(v) > 1]
        if strings:
            index = np.repeat(np.arange(len(strings)), [len(v) for _, v in strings])
            flat = np.array([p for _, v in strings for p in v], np.float64).reshape(-1, width)
            for (k, _), geometry in zip(strings, shapely.linestrings(flat, indices=index), strict=True):
                out[k] = geometry
    for k, text in enumerate(texts):
        if text is not None and out[k] is None:
            raise _no_metres(elements[k])
    return out


def _no_metres(element: etree._Element) -> UnreadableFile:
    reason = "the local coordinates of an item must be [x, y], a list of them, or a GeoJSON geometry"
    return UnreadableFile(reason, [Problem(reason, line=element.sourceline)])
