"""What KML and KMZ share: reading KML into layers, and how its coordinates and our own words are spelled in it.

Source: OGC KML 2.2/2.3 and Google's ``gx`` extension. Positions are longitude, latitude[, altitude]: degrees WGS 84,
metres.

**What is kept of a drawing.** A placemark or overlay is one object. ``properties.kml`` keeps where it stood and what
the canonical words cannot say:

``document``  key of the file it came from: ``Features.document["kml"]["documents"][key]`` has the rest of that file, of
              which the key is made, not of the file's name: equal drawings are equal content
``place``     its number in that file
``xml``       the element as text, with slots instead of what the canonical words say: ``<?n?>`` the name, ``<?c?>`` a
              list of coordinates, ``<?d NAME?>`` a plain value of its ExtendedData, which stands in ``properties``
              under its own name (or under ``properties.kml.data``, where the name means something else here)
``shape``     the geometry that the coordinate slots belong to; without it ``xml`` holds the geometry itself

A document is ``{"xml": …}``: the file without its objects, ``<?items N?>`` where those from number N on stood, and
``<?end?>`` where more can be added. Slots are processing instructions, which a reader never lets in, so no text of a
file can pass for one.

**Our own words.** Items of other layers and format families carry in their ExtendedData: ``layer``, ``id``, every
property under its own name, ``level`` and ``part`` where they are not the usual ones, and ``local``: the exact metres
of an item that is anchored in the local frame. Values are texts, or JSON where they are no texts. What such items have
in common stands in the ExtendedData of their folder, marked by ``fleetmap``.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any
from urllib.parse import quote

import numpy as np
import orjson
import shapely
from lxml import etree
from numpy.typing import NDArray

from app.errors import Problem, UnreadableFile
from app.formats import ReadContext, all_formats
from app.formats._fields import COORDINATE, LATITUDE, LONGITUDE, Number, OneOf
from app.model.features import MAX_ID, NO_GEOMETRY, Features, unique_ids
from app.model.frame import MAX_METRES, Datum, Level
from app.model.geodesy import LocalFrame, local_frame
from app.model.grid import OccupancyGrid
from app.model.imagery import GeoImage
from app.model.layers import MAP, NETWORK, SITE, VECTOR_LAYERS, ZONES, Layers, Part, PartKey
from app.syntax import images, xml

FAMILY = "kml"
MAIN = "map.kml"

CONTAINERS = frozenset({"kml", "Document", "Folder"})
OVERLAYS = frozenset({"GroundOverlay", "ScreenOverlay", "PhotoOverlay"})
ITEMS = frozenset({"Placemark", "NetworkLink"}) | OVERLAYS
SIMPLE = frozenset({"Point", "LineString", "LinearRing", "Polygon"})
GEOMETRIES = SIMPLE | {"MultiGeometry", "Model", "Track", "MultiTrack"}

OWN_ELEMENT = "fleetmap"
STYLE = "fleetmap-"
DEFAULT_PART: Mapping[str, str] = {
    **{"topology": NETWORK, "location": SITE, "zones": ZONES, "occupancy": MAP, "objects": "", "imagery": "satellite"}
}
OWN_KEYS = frozenset({"layer", "level", "part", "id", "local", "geometry", "more", OWN_ELEMENT})
"""Names in ExtendedData that place an item; a property of such a name travels in ``more``."""

PLACE_KEYS = frozenset({"layer", "level", "part", "id"})
"""Those whose values are names."""

_CANONICAL = OWN_KEYS | {
    *("kind", "name", "source", "target", "orientation", "action", "speed_limit", "width", "value", "expires"),
    *("pose", "size", "datum", "drawn_from", "data", "documents", "tags", "properties", "style"),
}


@cache
def reserved_names() -> frozenset[str]:
    """Property names that mean something to us: a drawing's own value of that name stays under ``kml.data``."""
    return _CANONICAL | all_formats().keys()


DOCUMENT_KEY_DIGITS = 16
"""Hexadecimal digits of a SHA-256 that serve as a drawing's key among the drawings of an environment."""

COORDINATES, NAME, END = "<?c?>", "<?n?>", "<?end?>"
SLOT = re.compile(r"<\?(c|n|d ([^?]*))\?>")

# Marks that stand for slots while libxml2 holds the tree: four C1 controls in a row, which no text has, not even UTF-8
# misread as Latin-1 (and such characters keep a Python text at one byte a character). A file that has them is refused.
_MARK = "\x91\x9c\x82"
_M_ITEM, _M_COORDINATES, _M_NAME, _M_OPEN, _M_CLOSE, _M_END = (_MARK + chr(0x86 + k) for k in range(6))
_SLOTS = {
    m[-1]: s
    for m, s in ((_M_COORDINATES, COORDINATES), (_M_NAME, NAME), (_M_OPEN, "<?d "), (_M_CLOSE, "?>"), (_M_END, END))
}

_BLANK, _CUT, _COMMA, _DIGIT, _OTHER = range(5)
_CLASSES = bytearray([_OTHER] * 256)
for _byte in b" \t\r\n":
    _CLASSES[_byte] = _BLANK
for _byte in b"0123456789+-.eE":
    _CLASSES[_byte] = _DIGIT
_CLASSES[ord(",")], _CLASSES[ord(";")] = _COMMA, _CUT
_SPACES = bytes.maketrans(b",;", b"  ")

MOVED = 1e-8
"""Degrees (a millimetre): an item of ours whose drawn place differs more from its exact metres has been moved."""


def local_name(element: etree._Element) -> str:
    """The tag without its namespace."""
    tag: str = element.tag
    return tag.rpartition("}")[2]


def child(element: etree._Element, name: str) -> etree._Element | None:
    """The first child of this name, in any namespace: KML is found in five of them, and without one."""
    return next(element.iterchildren("{*}" + name), None)


def child_text(element: etree._Element, name: str) -> str:
    """The stripped text of the first child of this name, else an empty text."""
    match = child(element, name)
    return "" if match is None else (match.text or "").strip()


# --- coordinates ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Sequences:
    """k lists of coordinates. points: float64 [n, 3], altitude 0 where none is given. start: int [k + 1], where each
    list begins. odd: bool [k], True where a text is not plain tuples of two or three numbers (its list is empty).
    """

    points: NDArray[np.float64]
    start: NDArray[np.int64]
    odd: NDArray[np.bool_]


def parse_coordinates(texts: Sequence[str]) -> Sequences:
    """Coordinate texts -> numbers, all at once; what is not plain is marked, not refused."""
    joined = ";".join(texts).encode() + b";"
    classes = joined.translate(_CLASSES)
    kind = np.frombuffer(classes, np.uint8)
    cuts = np.flatnonzero(kind == _CUT)
    if len(cuts) != len(texts):
        return _parse_each(texts)
    odd = np.zeros(len(texts), bool)
    inside = kind >= _COMMA
    begins = np.flatnonzero(inside[1:] > inside[:-1]) + 1
    if inside[0]:
        begins = np.concatenate([[0], begins])
    commas = np.flatnonzero(kind == _COMMA)
    # Commas before the n-th tuple begins: their differences are the commas within each.
    size = np.diff(np.searchsorted(commas, begins), append=len(commas)) + 1
    strange = begins[(size != 2) & (size != 3)]
    if len(strange):
        odd[np.searchsorted(cuts, strange)] = True
    # A comma needs a number on either side; other characters are no numbers.
    alone = commas[(kind[commas + 1] != _DIGIT) | (kind[commas - 1] != _DIGIT)]
    odd[np.searchsorted(cuts, alone)] = True
    if bytes([_OTHER]) in classes:
        odd[np.searchsorted(cuts, np.flatnonzero(kind == _OTHER))] = True
    if odd.any():
        plain = parse_coordinates(["" if bad else t for t, bad in zip(texts, odd.tolist(), strict=True)])
        return Sequences(plain.points, plain.start, odd | plain.odd)
    try:
        values = np.array(list(map(float, joined.translate(_SPACES).split())), np.float64)
    except ValueError:
        return _parse_each(texts)
    if len(values) == 3 * len(begins) and (size == 3).all():
        points = values.reshape(-1, 3)
    else:
        points = np.zeros((len(begins), 3))
        first = np.cumsum(size) - size
        points[:, 0], points[:, 1] = values[first], values[first + 1]
        deep = size == 3
        points[deep, 2] = values[first[deep] + 2]
    start = np.concatenate([[0], np.searchsorted(begins, cuts)])
    return Sequences(points, start, odd)


def _parse_two_way_rings(parsed: Sequences, rings: Sequence[int]) -> Sequences:
    """The same with these rings of three points (an edge drawn as an area: there and back) made ones of four, as few as
    a ring can have, by giving their second point twice.
    """
    times = np.ones(len(parsed.points), np.int64)
    times[parsed.start[list(rings)] + 1] = 2
    before = np.concatenate([[0], np.cumsum(times)])
    return Sequences(np.repeat(parsed.points, times, axis=0), before[parsed.start], parsed.odd)


def _parse_each(texts: Sequence[str]) -> Sequences:
    """The same where one text spoils the others."""
    if len(texts) == 1:
        return Sequences(np.empty((0, 3)), np.zeros(2, np.int64), np.ones(1, bool))
    each = [parse_coordinates([t]) for t in texts]
    start = np.concatenate([[0], np.cumsum([len(s.points) for s in each])])
    return Sequences(np.concatenate([s.points for s in each]), start, np.concatenate([s.odd for s in each]))


_SPACED_COMMA = re.compile(r"[ \t\r\n]*,[ \t\r\n]*")
_PLAIN_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?\Z")


def parse_lenient_tuples(text: str, line: int | None) -> list[tuple[float, float, float]]:
    """Coordinates as Google Earth reads them: blanks around commas, a stray comma, and a,b,c,d,e,f without blanks.

    Tuples of one number are left out. Raises UnreadableFile for what is no number.
    """
    out = []
    for token in _SPACED_COMMA.sub(",", text).split():
        parts = [p for p in token.split(",") if p]
        for p in parts:
            if not _PLAIN_NUMBER.match(p):
                raise UnreadableFile(
                    f"{p[:40]!r} is not a coordinate", [_with_line(f"{p[:40]!r} is not a number", line)]
                )
        values = [float(p) for p in parts]
        step = 3 if len(values) % 3 == 0 else len(values) if len(values) == 2 else 0
        if step:
            out += [_point(values[k : k + step], line) for k in range(0, len(values), step)]
    return out


def _point(values: Sequence[float], line: int | None) -> tuple[float, float, float]:
    x, y, z = (*values, 0.0, 0.0)[:3]
    if not (abs(x) <= 180.0 and abs(y) <= 90.0 and math.isfinite(z)):
        raise UnreadableFile(f"the coordinates {x:g},{y:g} are not on earth", [_is_off_earth(x, y, line)])
    return x, y, z


def _is_off_earth(x: float, y: float, line: int | None) -> Problem:
    return _with_line(f"longitude {x:g}, latitude {y:g}: must be finite, within ±180 and ±90 degrees", line)


def _with_line(problem: str, line: int | None) -> Problem:
    return Problem(problem, line=line)


def _flat(points: Sequence[tuple[float, float, float]]) -> NDArray[np.float64]:
    """float64 [n, 2], or [n, 3] where any altitude is not 0."""
    array = np.array(points, np.float64).reshape(-1, 3)
    return array if array[:, 2].any() else array[:, :2]


def _line(points: Sequence[tuple[float, float, float]]) -> Any:
    """A line; one point is a point, none is nothing."""
    if len(points) > 1:
        return shapely.linestrings(_flat(points))
    return shapely.points(_flat(points)[0]) if points else NO_GEOMETRY


def _area(rings: Sequence[Sequence[tuple[float, float, float]]]) -> Any:
    """A polygon from its rings, closed if they are open. A ring of too few points (edges are drawn so: there and back)
    is filled up with a point it has: an area of nothing, but still what was drawn.
    """
    if not rings or not rings[0]:
        return NO_GEOMETRY
    closed = [[*r, r[0]] if r[0] != r[-1] else list(r) for r in rings if r]
    closed = [r if len(r) >= 4 else [*r[:-1], *[r[-2 if len(r) > 1 else 0]] * (4 - len(r)), r[-1]] for r in closed]
    deep = any(p[2] for r in closed for p in r)
    make = [shapely.linearrings(np.array(r)[:, : 3 if deep else 2]) for r in closed]
    return shapely.polygons(make[0], holes=make[1:] or None)


def _join_geometries(parts: Sequence[Any]) -> Any:
    """Several geometries as one: Multi… where they are of one type."""
    flat = list(parts)
    while any(p.geom_type.startswith(("Multi", "Geometry")) for p in flat):
        flat = [q for p in flat for q in shapely.get_parts(p)]
    flat = [p for p in flat if not p.is_empty]
    if not flat:
        return NO_GEOMETRY
    types = {p.geom_type for p in flat}
    make = {"Point": shapely.multipoints, "LineString": shapely.multilinestrings, "Polygon": shapely.multipolygons}
    deep = any(p.has_z for p in flat)
    flat = [shapely.force_3d(p) if deep and not p.has_z else p for p in flat]
    if len(types) == 1 and (one := types.pop()) in make:
        return make[one](flat)
    return shapely.geometrycollections(flat)


def read_geometry(g: etree._Element) -> Any:
    """One geometry element, whatever oddity it has; empty ones give NO_GEOMETRY. Raises UnreadableFile."""
    name = local_name(g)
    if name in ("Point", "LineString", "LinearRing"):
        points = _coordinate_tuples(g)
        return _line(points[:1] if name == "Point" else points)
    if name == "Polygon":
        rings = [
            _coordinate_tuples(r)
            for side in ("outer", "inner")
            for r in g.iterfind(f"{{*}}{side}BoundaryIs/{{*}}LinearRing")
        ]
        return _area(rings)
    if name == "Track":
        texts = [(c, (c.text or "").split()) for c in g.iterchildren("{*}coord")]
        return _line([_point(_floats(t, c.sourceline), c.sourceline) for c, t in texts if len(t) in (2, 3)])
    if name == "Model":
        spot = child(g, "Location")
        texts3 = [] if spot is None else [child_text(spot, w) for w in ("longitude", "latitude", "altitude")]
        if len(texts3) < 3 or not (texts3[0] and texts3[1]):
            return NO_GEOMETRY
        return _line([_point(_floats([t or "0" for t in texts3], g.sourceline), g.sourceline)])
    inner = [read_geometry(c) for c in g if isinstance(c.tag, str) and local_name(c) in GEOMETRIES]
    return _join_geometries(inner)


def _coordinate_tuples(g: etree._Element) -> list[tuple[float, float, float]]:
    return [t for c in g.iterchildren("{*}coordinates") for t in parse_lenient_tuples(c.text or "", c.sourceline)]


def _floats(texts: Sequence[str], line: int | None) -> list[float]:
    for t in texts:
        if not _PLAIN_NUMBER.match(t.strip()):
            raise UnreadableFile(f"{t[:40]!r} is not a number", [_with_line(f"{t[:40]!r} is not a number", line)])
    return [float(t) for t in texts]


def item_geometry(element: etree._Element) -> Any:
    """The geometry of a placemark or overlay, of any shape. Raises UnreadableFile."""
    if local_name(element) == "GroundOverlay":
        return overlay_footprint(element)
    geometries = [c for c in element if isinstance(c.tag, str) and local_name(c) in GEOMETRIES]
    if len(geometries) == 1:
        return read_geometry(geometries[0])
    shapes = [s for s in map(read_geometry, geometries) if not s.is_empty]
    return shapes[0] if len(shapes) == 1 else _join_geometries(shapes)


def overlay_footprint(element: etree._Element) -> Any:
    """Where a GroundOverlay lies: its gx:LatLonQuad, else its LatLonBox turned about its middle (counter-clockwise)."""
    quad, box = child(element, "LatLonQuad"), child(element, "LatLonBox")
    if quad is not None:
        corners = _coordinate_tuples(quad)
        return shapely.polygons([p[:2] for p in corners]) if len(corners) == 4 else NO_GEOMETRY
    if box is None:
        return NO_GEOMETRY
    texts = [child_text(box, side) for side in ("west", "south", "east", "north", "rotation")]
    if not all(texts[:4]):
        return NO_GEOMETRY
    west, south, east, north, turn = _floats([*texts[:4], texts[4] or "0"], box.sourceline)
    for x, y in ((west, south), (east, north)):
        if not (abs(x) <= 360.0 and abs(y) <= 90.0):
            raise UnreadableFile(
                f"an overlay's corner {x:g},{y:g} is not on earth", [_is_off_earth(x, y, box.sourceline)]
            )
    if not math.isfinite(turn):
        raise UnreadableFile(
            "an overlay's rotation is not finite", [_with_line("rotation is not finite", box.sourceline)]
        )
    if east < west:
        east += 360.0
    corners2 = np.array([[west, south], [east, south], [east, north], [west, north]])
    angle = math.radians(turn)
    if angle:
        middle = corners2.mean(axis=0)
        shrink = max(math.cos(math.radians(middle[1])), 1e-6)
        u, v = (corners2 - middle).T * np.array([[shrink], [1.0]])
        c, s = math.cos(angle), math.sin(angle)
        corners2 = middle + np.stack([(c * u - s * v) / shrink, s * u + c * v], axis=1)
    return _is_within_earth(shapely.polygons(corners2))


def _is_within_earth(shape: Any) -> Any:
    """A footprint that crosses the antimeridian as two, one on either side."""
    west, _, east, _ = shape.bounds
    if west >= -180.0 and east <= 180.0:
        return shapely.intersection(shape, shapely.box(-180.0, -90.0, 180.0, 90.0)) if shape.bounds[3] > 90 else shape
    pieces = []
    for shift in (-360.0, 0.0, 360.0):
        moved = shapely.transform(shape, lambda p, by=shift: p + np.array([by, 0.0]))
        piece = shapely.intersection(moved, shapely.box(-180.0, -90.0, 180.0, 90.0))
        if piece.area > 0.0:
            pieces.append(piece)
    return pieces[0] if len(pieces) == 1 else _join_geometries(pieces)


# --- values -----------------------------------------------------------------------------------------------------------

_ILLEGAL = "\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff"
ILLEGAL = re.compile(f"[{_ILLEGAL}]")
"""Characters that XML 1.0 cannot hold."""

_PLAIN = re.compile(rf"(?!(?:true|false|null)\Z)[^\s\-0-9{{\[\"{_ILLEGAL}][^{_ILLEGAL}]*\Z")
_ESCAPES = str.maketrans({"&": "&amp;", "<": "&lt;", ">": "&gt;", "\r": "&#13;"})


def escape(text: str) -> str:
    """A text for XML content and (with ``quote_attribute``) attributes; what XML cannot hold becomes U+FFFD."""
    return ILLEGAL.sub("\ufffd", text).translate(_ESCAPES)


def quote_attribute(text: str) -> str:
    """A text for an attribute in double quotes."""
    return escape(text).replace('"', "&quot;").replace("\n", "&#10;").replace("\t", "&#9;")


def spell(value: Any) -> str:
    """A property's value as an escaped text: texts as they are where that is unmistakable, all else as JSON."""
    if isinstance(value, str):
        if _PLAIN.match(value):
            return value.translate(_ESCAPES)
        value = value.encode("utf-16", "surrogatepass").decode("utf-16", "replace")
    text = orjson.dumps(value, option=orjson.OPT_SORT_KEYS).decode()
    if ILLEGAL.search(text):
        text = ILLEGAL.sub(lambda m: f"\\u{ord(m[0]):04x}", text)
    return text.translate(_ESCAPES)


def unspell(text: str) -> Any:
    """The value that ``spell`` wrote; a text that is no JSON stays one."""
    if text[:1] in _JSON_STARTS or text in ("true", "false", "null"):
        try:
            return orjson.loads(text)
        except orjson.JSONDecodeError:
            return text
    return text


_JSON_STARTS = frozenset('-0123456789{["')


# --- reading ----------------------------------------------------------------------------------------------------------


@dataclass(slots=True)
class _OwnItems:
    """Items of ours on their way back to one part."""

    ids: list[str] = field(default_factory=list)
    geometry: list[Any] = field(default_factory=list)
    properties: list[dict[str, Any]] = field(default_factory=list)
    local: list[Any] = field(default_factory=list)
    document: dict[str, Any] = field(default_factory=dict)


@dataclass(slots=True)
class _Item:
    """A placemark or overlay while its tree is read."""

    element: etree._Element
    title: etree._Element | None = None
    data: tuple[tuple[str, etree._Element], ...] = ()
    geometries: tuple[etree._Element, ...] = ()
    sequences: tuple[tuple[str, int, etree._Element], ...] = ()
    shape: str = ""


def read_kml(
    data: bytes, context: ReadContext, pictures: Mapping[str, bytes], entry: str | None = None
) -> tuple[Layers, set[str]]:
    """KML -> layers, and the names of the pictures that became grids.

    pictures: what relative references may mean (KMZ). entry: the name of this document inside its archive. Raises
    UnreadableFile with the line.
    """
    root = xml.parse(data, context.limits, remove_blank_text=True)
    if local_name(root) not in CONTAINERS | ITEMS:
        raise UnreadableFile(
            f"the root element is <{local_name(root)}>: KML starts with <kml>",
            [Problem(f"<{local_name(root)}> is not KML", line=root.sourceline)],
        )
    xml.report_active_content(data, context.warn)
    defined = {schema.get("name", "") for schema in root.iter("{*}Schema")}
    xml.report_unknown_elements(data, root, ELEMENTS | defined, context.warn, free={*FREE, *defined}, namespace="kml")
    _check_values(root, context)
    reader = _Reader(context, pictures)
    reader.read(root, entry)
    return reader.layers(), reader.used


FREE = frozenset({"ExtendedData", "Metadata"})
"""Elements in which anything may stand."""

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
"""Plain values of KML, by element: places are refused if they are out of range, views and styles are doubtful.

Source: OGC KML 2.3, Google's gx extension.
"""


def _check_values(root: etree._Element, context: ReadContext) -> None:
    """Refuse places that are out of range, with the line; report doubtful values, once for each element."""
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
        if _PLAIN_NUMBER.match(north) and _PLAIN_NUMBER.match(south) and float(north) < float(south):
            reason = f"north {north} is south of south {south}"
            if local_name(box) == "LatLonBox":
                raise UnreadableFile(f"<LatLonBox>: {reason}", [_with_line(reason, box.sourceline)])
            doubts.setdefault("LatLonAltBox", [reason, box.sourceline, 0])[2] += 1
    for name, (doubt, line, count) in doubts.items():
        more = "" if count == 1 else f" ({count} times)"
        context.warn(f"<{name}>: {doubt}{more}", line=line, where=name)


class _Reader:
    """One file. Its documents (ours may hold several) are read one after the other into shared columns."""

    def __init__(self, context: ReadContext, pictures: Mapping[str, bytes]) -> None:
        self.context = context
        self.pictures = pictures
        self.used: set[str] = set()
        self.datum: Datum | None = None
        self.levels: dict[str, float] = {}
        self.own: dict[PartKey, _OwnItems] = {}
        self.rasters: dict[PartKey, OccupancyGrid | GeoImage] = {}
        self.columns: dict[str, list[tuple[list[str], list[Any], list[dict[str, Any]]]]] = {}
        self.documents: dict[str, dict[str, Any]] = {}
        self.credit: list[str] = []

    def read(self, root: etree._Element, entry: str | None) -> None:
        """A document, and those that we have put inside it."""
        marks = self._marks(root)
        for element, values in marks:
            if values.get(OWN_ELEMENT) == "document" and element is not root and element.getparent() is not None:
                level = values.get("level") or self.context.level
                self._detach(element)
                self._read_document(element, values.get("document"), values.get("entry"), level, [])
        ours = [(e, w) for e, w in marks if w.get(OWN_ELEMENT) != "document"]
        self._read_document(root, None, entry, self.context.level, ours)

    def _marks(self, root: etree._Element) -> list[tuple[etree._Element, dict[str, str]]]:
        """Containers that carry our mark, innermost last, with their words."""
        out = []
        for extended in root.iter("{*}ExtendedData"):
            parent = extended.getparent()
            if parent is not None and local_name(parent) in CONTAINERS:
                values = _words(_values(extended), PLACE_KEYS | {"document", "entry"})
                if OWN_ELEMENT in values:
                    out.append((parent, values))
        return out

    def _detach(self, element: etree._Element) -> None:
        """Take a document of its own out of ours: it becomes a ``kml`` root again."""
        for added in (child(element, "ExtendedData"), child(element, "name")):
            if added is not None:
                element.remove(added)
        namespace = element.tag.rpartition("}")[0]
        element.getparent().remove(element)
        element.tag = f"{namespace}}}kml" if namespace else "kml"

    def _read_document(
        self,
        root: etree._Element,
        name: str | None,
        entry: str | None,
        level: str,
        ours: list[tuple[etree._Element, dict[str, str]]],
    ) -> None:
        items = _items(root)
        for schema in root.iter("{*}Schema"):
            if schema.get("parent"):
                noun = f"<{schema.get('name', '')[:80]}> elements, placemarks of KML's oldest Schema form,"
                self.context.warn(f"{noun} are kept but not read as objects", line=schema.sourceline)
        parsed = self._sequences(items)
        _check_places(items, parsed)
        own_items, other_items = [], []
        for item in items:
            values = _words(item.data, PLACE_KEYS)
            if values.get("layer") in DEFAULT_PART:
                own_items.append((item, values))
            else:
                other_items.append(item)
        self._take_own_items(own_items, parsed)
        all_own = self._remove_ours(root, ours)
        if (other_items or not all_own) and self.context.wants("objects"):
            self._take_drawing(root, other_items, parsed, name, entry, level)

    # --- our own words ---

    def _key(self, values: Mapping[str, str], layer: str) -> PartKey:
        part = values.get("part") or DEFAULT_PART[layer] or FAMILY
        return PartKey(layer, values.get("level") or self.context.level, part)  # type: ignore[arg-type]

    def _take_own_items(self, own_items: Sequence[tuple[_Item, dict[str, str]]], parsed: Sequences) -> None:
        """Items of ours go back to their parts."""
        geometry = _geometries([item for item, _ in own_items], parsed)
        metres = _metres([values.get("local") for _, values in own_items], [item.element for item, _ in own_items])
        for (item, values), drawn, exact in zip(own_items, geometry, metres, strict=True):
            element = item.element
            parent = element.getparent()
            if parent is not None:
                parent.remove(element)
            layer = values["layer"]
            title = child_text(element, "name")
            if layer in ("occupancy", "imagery"):
                self._take_raster(element, values, title)
                continue
            properties: dict[str, Any] = {"name": title} if title else {}
            for label, text in values.items():
                if label not in OWN_KEYS:
                    properties[label] = unspell(text)
            if "more" in values and isinstance(more := unspell(values["more"]), dict):
                properties |= more
            if layer == "location" and properties.get("kind") == "datum" and "id" not in values:
                self._take_datum(properties, element)
                continue
            shape = drawn
            if values.get("geometry") == "GeometryCollection" and drawn.geom_type != "GeometryCollection":
                shape = shapely.geometrycollections(list(shapely.get_parts(drawn)))
            part_items = self.own.setdefault(self._key(values, layer), _OwnItems())
            part_items.ids.append(_usable(values.get("id") or title or local_name(element)))
            part_items.geometry.append(shape)
            part_items.properties.append(properties)
            part_items.local.append(exact)

    def _take_datum(self, properties: Mapping[str, Any], element: etree._Element) -> None:
        names = ("latitude", "longitude", "altitude", "heading")
        numbers = {n: properties[n] for n in names if isinstance(properties.get(n), int | float)}
        if "latitude" not in numbers or "longitude" not in numbers:
            reason = "the datum has no latitude and longitude"
            raise UnreadableFile(reason, [Problem(reason, line=element.sourceline)])
        self.datum = Datum(**numbers)

    def _take_raster(self, element: etree._Element, values: Mapping[str, str], title: str) -> None:
        """A grid or a picture of ours, where its image travels with the drawing."""
        icon = child(element, "Icon")
        href = "" if icon is None else child_text(icon, "href")
        layer = values["layer"]
        label = values.get("part") or title or DEFAULT_PART[layer]
        noun = "grid" if layer == "occupancy" else "picture"
        data = self.pictures.get(href)
        if data is None:
            self.context.warn(
                f"its image {href!r} is not in the upload, so the {noun} is left out: upload the KMZ, or both files",
                line=element.sourceline,
                where=label,
            )
            return
        parameters = {n: unspell(t) for n, t in values.items()}
        self.used.add(href)
        read = self._grid if layer == "occupancy" else self._picture
        try:
            self.rasters[self._key(values, layer)] = read(data, href, parameters)
        except (KeyError, TypeError) as error:
            reason = f"the {noun} {label} lacks what places it: {error}"
            raise UnreadableFile(reason, [Problem(reason, line=element.sourceline)]) from error

    def _grid(self, data: bytes, href: str, parameters: Mapping[str, Any]) -> OccupancyGrid:
        """A grid: the image's palette index is the cell."""
        image = images.read_image(data, self.context.limits)
        if image.mode != "P":
            raise UnreadableFile(f"{href} is no longer the picture of a grid: its colours have changed")
        properties = parameters.get("properties")
        return OccupancyGrid(
            np.ascontiguousarray(np.asarray(image, np.uint8)[::-1]),
            float(parameters["resolution"]),
            tuple(float(v) for v in parameters["origin"]),  # type: ignore[arg-type]
            parameters.get("mode", "trinary"),
            float(parameters.get("occupied_thresh", 0.65)),
            float(parameters.get("free_thresh", 0.196)),
            bool(parameters.get("negate", False)),
            properties if isinstance(properties, dict) else {},
        )

    def _picture(self, data: bytes, href: str, parameters: Mapping[str, Any]) -> GeoImage:
        """A picture: its pixels, and the exact place that its overlay has in our words."""
        image = images.read_image(data, self.context.limits)
        if image.mode not in ("L", "LA", "RGB", "RGBA"):
            raise UnreadableFile(f"{href} is no longer the picture that was written: its colours have changed")
        pixels = np.asarray(image, np.uint8).reshape(image.height, image.width, -1)
        a, b, c, d, e, f = (float(v) for v in parameters["transform"])
        properties = parameters.get("properties")
        picture_properties = properties if isinstance(properties, dict) else {}
        return GeoImage(np.ascontiguousarray(pixels), (a, b, c, d, e, f), str(parameters["crs"]), picture_properties)

    def _remove_ours(self, root: etree._Element, ours: list[tuple[etree._Element, dict[str, str]]]) -> bool:
        """Take out our folders and styles; True where nothing of anybody else is left in the file."""
        for element, values in reversed(ours):
            for extended in element.findall("{*}ExtendedData")[:1]:
                element.remove(extended)
            for style in element.findall("{*}Style"):
                if style.get("id", "").startswith(STYLE):
                    element.remove(style)
            if values[OWN_ELEMENT] == "part" and values.get("layer") in VECTOR_LAYERS:
                level = values.get("level") or self.context.level
                elevation = unspell(values.get("elevation", "0"))
                if isinstance(elevation, int | float):
                    self.levels[level] = float(elevation)
                document = unspell(values.get("document", "{}"))
                part_items = self.own.setdefault(self._key(values, values["layer"]), _OwnItems())
                part_items.document |= document if isinstance(document, dict) else {}
            described = child(element, "description")
            if values[OWN_ELEMENT] == "map" and described is not None:
                self.credit += [line for line in (described.text or "").splitlines() if line]
            left = [c for c in element if local_name(c) not in ("name", "description", "visibility", "open")]
            parent = element.getparent()
            if left:
                continue
            if parent is None or (parent is root and local_name(root) == "kml" and len(root) == 1):
                return True
            parent.remove(element)
        return False

    # --- drawings ---

    def _sequences(self, items: Sequence[_Item]) -> Sequences:
        """Find the lists of coordinates of all items with a plain structure, and read them at once."""
        texts: list[str] = []
        for item in items:
            if len(item.geometries) != 1 or local_name(item.element) == "GroundOverlay":
                continue
            sequences = _parse_plain_sequences(item.geometries[0])
            if sequences is None:
                continue
            item.shape = sequences[0]
            for role, c in sequences[1]:
                item.sequences += ((role, len(texts), c),)
                texts.append(c.text or "")
        if not texts:
            return Sequences(np.empty((0, 3)), np.zeros(1, np.int64), np.zeros(0, bool))
        parsed = parse_coordinates(texts)
        count = np.diff(parsed.start)
        min_points = {"P": 1, "L": 2, "R": 3}
        closed = np.zeros(len(texts), bool)
        full = count > 0
        ends = parsed.points[parsed.start[1:][full] - 1]
        closed[full] = (parsed.points[parsed.start[:-1][full]] == ends).all(axis=1)
        # A ring that is "there and back" already in four points would be taken for one of three (see _there_and_back).
        four = np.flatnonzero(count == 4)
        second = parsed.points[parsed.start[four] + 1]
        closed[four[(second == parsed.points[parsed.start[four] + 2]).all(axis=1)]] = False
        counts, odd, closes = count.tolist(), parsed.odd.tolist(), closed.tolist()
        strange = []
        for item in items:
            for role, k, _ in item.sequences:
                n = counts[k]
                if odd[k] or n < min_points[role] or (role == "P" and n > 1) or (role == "R" and not closes[k]):
                    item.shape = ""
            if item.sequences and not item.shape:
                strange.append(item.element)
        if strange:
            self.context.warn(
                f"{len(strange)} geometries have coordinates that are not plain tuples, open rings or too few points; "
                "they are read as Google Earth does and kept as they are",
                line=strange[0].sourceline,
                where=child_text(strange[0], "name")[:200] or None,
            )
        rings = [k for item in items for role, k, _ in item.sequences if role == "R" and counts[k] == 3]
        return _parse_two_way_rings(parsed, rings) if rings else parsed

    def _take_drawing(
        self,
        root: etree._Element,
        items: list[_Item],
        parsed: Sequences,
        name: str | None,
        entry: str | None,
        level: str,
    ) -> None:
        """Somebody's drawing: its items become objects, the rest of it the document. name: its key, if it has one."""
        geometry = _geometries(items, parsed)
        ids, titles = _identify(items, self.context)
        properties: list[dict[str, Any]] = []
        types = shapely.get_type_id(geometry).tolist()
        reserved = reserved_names()
        for k, item in enumerate(items):
            title = titles[k]
            kind = "overlay" if local_name(item.element) in OVERLAYS else _KINDS[types[k]] or _mixed_type(geometry[k])
            item_properties: dict[str, Any] = {"kind": kind}
            source_element: dict[str, Any] = {"place": k}
            if title is not None and title[1]:
                item_properties["name"] = title[1]
            for label, value in item.data:
                aside = label in reserved
                (source_element.setdefault("data", {}) if aside else item_properties)[label] = value.text or ""
            item_properties[FAMILY] = source_element
            properties.append(item_properties)
        self.columns.setdefault(level, []).append((ids, list(geometry), properties))
        documents = self.documents.setdefault(level, {})
        if self.context.keep_source_properties:
            document_xml = _keep_element_text(root, items, [t[0] if t else None for t in titles], properties)
            key = name or hashlib.sha256(f"{entry or ''}\0{document_xml}".encode()).hexdigest()[:DOCUMENT_KEY_DIGITS]
            documents[key] = {"xml": document_xml} if entry is None else {"xml": document_xml, "entry": entry}
            for item_properties in properties:
                item_properties[FAMILY]["document"] = key

    # --- the result ---

    def layers(self) -> Layers:
        parts: dict[PartKey, Part] = dict(self.rasters)
        for level, columns in self.columns.items():
            ids = unique_ids(i for c in columns for i in c[0])
            shapes = [g for c in columns for g in c[1]]
            geometry = np.empty(len(shapes), object)
            geometry[:] = shapes
            properties = [p for c in columns for p in c[2]]
            document = {FAMILY: {"documents": self.documents[level]}} if self.documents[level] else {}
            key = PartKey("objects", level, FAMILY)
            parts[key] = Features(tuple(ids), geometry, tuple(properties), np.zeros(len(ids), bool), document)
        for key, part_items in self.own.items():
            part = self._read_own_part(key, part_items)
            existing = parts.get(key)
            parts[key] = _concatenate(existing, part) if isinstance(existing, Features) else part
        parts = self._with_credits(parts)
        levels = tuple(Level(n, e) for n, e in sorted(self.levels.items(), key=lambda v: (v[1], v[0])))
        return Layers(parts, self.datum, levels or (Level(self.context.level),))

    def _with_credits(self, parts: dict[PartKey, Part]) -> dict[PartKey, Part]:
        """Our map's description tells the licences and credits of all its parts; some parts tell their own besides."""
        stated = {
            k: texts if isinstance(texts := p.document.get("attribution"), list) else []
            for k, p in parts.items()
            if isinstance(p, Features)
        }
        all_texts = [text for texts in stated.values() for text in texts]
        extra = [text for text in self.credit if text not in all_texts]
        out = dict(parts)
        for key, part in parts.items() if extra else ():
            if isinstance(part, Features):
                out[key] = part.with_document({**part.document, "attribution": [*stated[key], *extra]})
        return out

    def _read_own_part(self, key: PartKey, part_items: _OwnItems) -> Features:
        """Items of ours as they were: the exact metres where they were local, unless somebody has moved them."""
        n = len(part_items.ids)
        ids = unique_ids(part_items.ids)
        if ids != part_items.ids:
            repeats = [i for i, c in Counter(part_items.ids).items() if c > 1]
            self.context.warn(
                f"{len(repeats)} ids of {key.layer} are used twice: later ones got #2, #3 …", where=repeats[0]
            )
        geometry = np.empty(n, object)
        geometry[:] = part_items.geometry
        local = np.array([m is not None for m in part_items.local], bool)
        indices = np.flatnonzero(local)
        if len(indices):
            metres = np.empty(len(indices), object)
            metres[:] = [part_items.local[k] for k in indices]
            geometry[indices] = self._restore_metres(geometry[indices], metres)
        return Features(tuple(ids), geometry, tuple(part_items.properties), local, part_items.document)

    def _restore_metres(self, drawn: NDArray[np.object_], metres: NDArray[np.object_]) -> NDArray[np.object_]:
        """The exact metres, or what was drawn since, brought to metres."""
        if self.datum is None:
            return metres
        frame: LocalFrame = local_frame(self.datum)
        moved = ~shapely.equals_exact(frame.geometries_to_wgs84(metres), drawn, tolerance=MOVED)
        moved &= ~shapely.is_empty(drawn)
        if not moved.any():
            return metres
        out = metres.copy()
        out[moved] = frame.geometries_to_local(drawn[moved])
        self.context.warn(
            f"{int(moved.sum())} items were moved in the drawing: their new places count, not their metres"
        )
        return out


_KINDS = ("poi", "path", "path", "region", "poi", "path", "region", "")
"""Kind of an object by its geometry's type number; a collection is judged by what is in it."""


def _mixed_type(geometry: Any) -> str:
    widest = shapely.get_dimensions(geometry)
    return "note" if geometry.is_empty else ("poi", "path", "region")[widest]


def _concatenate(a: Features, b: Features) -> Features:
    """Objects that were drawn and objects that we had written, in one part."""
    ids = unique_ids([*a.ids, *b.ids])
    return Features(
        tuple(ids),
        np.concatenate([a.geometry, b.geometry]),
        (*a.properties, *b.properties),
        np.concatenate([a.local, b.local]),
        {**b.document, **a.document},
    )


def _check_places(items: Sequence[_Item], parsed: Sequences) -> None:
    """Refuse coordinates that are not on earth, with the line of their geometry."""
    points = parsed.points
    valid = (np.abs(points[:, 0]) <= 180.0) & (np.abs(points[:, 1]) <= 90.0) & (np.abs(points[:, 2]) <= MAX_METRES)
    if valid.all():
        return
    at = int(np.flatnonzero(~valid)[0])
    sequence = int(np.searchsorted(parsed.start, at, "right")) - 1
    owner = next((i for i in items if any(k == sequence for _, k, _ in i.sequences)), None)
    x, y, _ = points[at]
    line = None if owner is None else owner.geometries[0].sourceline
    raise UnreadableFile(f"the coordinates {x:g},{y:g} are not on earth", [_is_off_earth(x, y, line)])


def _items(root: etree._Element) -> list[_Item]:
    """The placemarks and overlays of the document: those that stand in nothing but containers (elsewhere, as in an
    Update or in an element that nobody knows, they are part of what they stand in).
    """
    usable: dict[etree._Element, bool] = {}

    def contained(element: etree._Element) -> bool:
        chain = []
        while element is not None and element not in usable:
            chain.append(element)
            if local_name(element) not in CONTAINERS:
                usable[element] = False
                break
            element = element.getparent()
        answer = True if element is None else usable[element]
        usable.update(dict.fromkeys(chain, answer))
        return answer

    items: list[_Item] = []
    index: dict[etree._Element, _Item] = {}
    for element in root.iter(*(f"{{*}}{name}" for name in sorted(ITEMS))):
        parent = element.getparent()
        if parent is None or usable.get(parent) or contained(parent):
            item = _Item(element)
            items.append(item)
            index[element] = item
    for g in root.iter(*(f"{{*}}{name}" for name in sorted(GEOMETRIES))):
        owner = index.get(g.getparent())
        if owner is not None:
            owner.geometries += (g,)
    for tag in root.iter("{*}name"):
        owner = index.get(tag.getparent())
        if owner is not None and owner.title is None:
            owner.title = tag
    for extended in root.iter("{*}ExtendedData"):
        owner = index.get(extended.getparent())
        if owner is not None:
            owner.data += tuple(_values(extended))
    return items


def _values(extended: etree._Element) -> list[tuple[str, etree._Element]]:
    """The plain values of an ExtendedData: (name, element whose text is the value), the first of each name."""
    out: dict[str, etree._Element] = {}
    for entry in extended.iter("{*}Data", "{*}SimpleData"):
        name = entry.get("name")
        if local_name(entry) == "SimpleData":
            value = entry
        else:
            value = entry[0] if len(entry) == 1 and local_name(entry[0]) == "value" else child(entry, "value")
        if name and value is not None and not len(value) and name not in out:
            out[name] = value
    return list(out.items())


def _words(data: Iterable[tuple[str, etree._Element]], names: frozenset[str]) -> dict[str, str]:
    """The values by name as texts; of these names as they were before ``spell`` quoted what looks like a number."""
    values = {name: value.text or "" for name, value in data}
    for name in names & values.keys():
        value = unspell(values[name])
        values[name] = value if isinstance(value, str) else values[name]
    return values


def _parse_plain_sequences(g: etree._Element) -> tuple[str, list[tuple[str, etree._Element]]] | None:
    """Shape and coordinate elements of a geometry without oddities of structure: ``P`` point, ``L`` line, ``A2`` area
    of two rings, ``M…`` several of them; (role, element) in the order of the geometry's own coordinates.
    """
    name = local_name(g)
    if name == "Polygon":
        if len(g) == 1 and (c := _single_ring(g[0])) is not None:
            return "A1", [("R", c)]
        coordinates = list(g.iter("{*}coordinates"))
        for k, c in enumerate(coordinates):
            ring = c.getparent()
            side = ring.getparent()
            tag = "outerBoundaryIs" if k == 0 else "innerBoundaryIs"
            alone = len(list(ring.iterchildren(c.tag))) == 1 and not len(c)
            if not alone or local_name(side) != tag or side.getparent() is not g:
                return None
        return (f"A{len(coordinates)}", [("R", c) for c in coordinates]) if coordinates else None
    if name in SIMPLE:
        if len(g) == 1 and not len(g[0]) and g[0].tag.endswith("}coordinates"):
            role = "P" if name == "Point" else "L"
            return role, [(role, g[0])]
        coordinates = list(g.iterchildren("{*}coordinates"))
        if len(coordinates) != 1 or len(coordinates[0]) or len(list(g.iter("{*}coordinates"))) != 1:
            return None
        role = "P" if name == "Point" else "L"
        return role, [(role, coordinates[0])]
    if name != "MultiGeometry":
        return None
    shape, out = "M", []
    for c in g:
        inner = _parse_plain_sequences(c) if local_name(c) in SIMPLE else None
        if inner is None:
            return None
        shape += inner[0]
        out += inner[1]
    return (shape, out) if out else None


def _single_ring(side: etree._Element) -> etree._Element | None:
    """The coordinates of ``<outerBoundaryIs><LinearRing><coordinates/>`` with nothing else in it, as nearly all are."""
    if len(side) == 1 and local_name(side) == "outerBoundaryIs":
        ring = side[0]
        if len(ring) == 1 and not len(ring[0]) and local_name(ring) == "LinearRing":
            c = ring[0]
            return c if local_name(c) == "coordinates" else None
    return None


def _geometries(items: Sequence[_Item], parsed: Sequences) -> NDArray[np.object_]:
    """All geometries, the plain ones made by the array. 3-D only where an altitude is not 0."""
    out = np.full(len(items), NO_GEOMETRY, object)
    rows_by_shape: dict[str, list[tuple[int, int]]] = {"P": [], "L": [], "A1": []}
    for n, item in enumerate(items):
        if item.shape in rows_by_shape:
            rows_by_shape[item.shape].append((n, item.sequences[0][1]))
        elif item.shape:
            out[n] = _assemble_geometry(item, parsed)
        else:
            out[n] = item_geometry(item.element)
    make: dict[str, Callable[..., Any]] = {
        "P": lambda p, indices, out: out.__setitem__(slice(None), shapely.points(p)),
        "L": lambda p, indices, out: shapely.linestrings(p, indices=indices, out=out),
        "A1": lambda p, indices, out: out.__setitem__(
            slice(None), shapely.polygons(shapely.linearrings(p, indices=indices))
        ),
    }
    deep_points = np.concatenate([[0], np.cumsum(parsed.points[:, 2] != 0.0)])
    for shape, rows in rows_by_shape.items():
        if not rows:
            continue
        indices, sequence = np.array(rows).T
        begin, end = parsed.start[sequence], parsed.start[sequence + 1]
        deep = deep_points[end] > deep_points[begin]
        for mask, width in ((~deep, 2), (deep, 3)):
            if not mask.any():
                continue
            size = (end - begin)[mask]
            offset = np.repeat(begin[mask] - np.concatenate([[0], np.cumsum(size)[:-1]]), size)
            points = parsed.points[np.arange(size.sum()) + offset, :width]
            geometries = np.empty(len(size), object)
            make[shape](points, np.repeat(np.arange(len(size)), size), geometries)
            out[indices[mask]] = geometries
    return out


def _assemble_geometry(item: _Item, parsed: Sequences) -> Any:
    """A plain geometry of several lists: an area with holes, or a collection."""
    lists = [parsed.points[parsed.start[k] : parsed.start[k + 1]] for _, k, _ in item.sequences]
    deep = any(p[:, 2].any() for p in lists)
    rows = iter([p if deep else p[:, :2] for p in lists])
    shapes = []
    for piece in re.findall(r"P|L|A\d+", item.shape):
        if piece == "P":
            shapes.append(shapely.points(next(rows)[0]))
        elif piece == "L":
            shapes.append(shapely.linestrings(next(rows)))
        else:
            rings = [shapely.linearrings(next(rows)) for _ in range(int(piece[1:]))]
            shapes.append(shapely.polygons(rings[0], holes=rings[1:] or None))
    return _join_geometries(shapes) if item.shape[0] == "M" else shapes[0]


def _usable(text: str) -> str:
    """A text as an id: printable and not too long."""
    if text.isprintable() and 0 < len(text) <= MAX_ID - 12 and text[0] != " " != text[-1]:
        return text
    clean = "".join(c if c.isprintable() else " " for c in text).strip()
    return clean[: MAX_ID - 12] or "_"


def _identify(
    items: Sequence[_Item], context: ReadContext
) -> tuple[list[str], list[tuple[etree._Element, str] | None]]:
    """Ids (the id attribute where it is the only one of its kind, else the name) and (element, text) of the names."""
    attributes = [
        e.get("id") or next((v for a, v in xml.attributes(e).items() if a.endswith("}id")), "") if e.attrib else ""
        for e in (item.element for item in items)
    ]
    counts = Counter(attributes)
    titles: list[tuple[etree._Element, str] | None] = []
    ids = []
    for item, attribute in zip(items, attributes, strict=True):
        tag = item.title
        title = None if tag is None or len(tag) else (tag, (tag.text or "").strip())
        titles.append(title)
        if attribute and counts[attribute] == 1:
            ids.append(_usable(attribute))
        else:
            ids.append(_usable(title[1] if title and title[1] else attribute or local_name(item.element)))
    repeats = [n for n, c in Counter(t[1] for t in titles if t and t[1]).items() if c > 1]
    if repeats:
        suffix = f" and {len(repeats) - 1} more" if len(repeats) > 1 else ""
        context.warn(f"several placemarks are called {repeats[0]!r}{suffix}; all are kept", where=repeats[0][:200])
    return ids, titles


def _keep_element_text(
    root: etree._Element,
    items: Sequence[_Item],
    titles: Sequence[etree._Element | None],
    properties: Sequence[dict[str, Any]],
) -> str:
    """Put each item's element as text, with slots, into its properties; the rest of the document is the answer."""
    names = values = coordinates = 0
    for item, title, item_properties in zip(items, titles, properties, strict=True):
        if title is not None:
            title.text = _M_NAME
            names += 1
        for label, value in item.data:
            value.text = f"{_M_OPEN}{quote(label)}{_M_CLOSE}"
            values += 1
        if item.shape:
            item_properties[FAMILY]["shape"] = item.shape
            for _, _, c in item.sequences:
                c.text = _M_COORDINATES
            coordinates += len(item.sequences)
    text, begins = _serialise(root, [item.element for item in items])
    pieces, counts = _cut_into_slots(text)
    marks = (_M_ITEM, _M_NAME, _M_COORDINATES, _M_OPEN, _M_CLOSE)
    expected = [len(items) + sum(begins), names, coordinates, values, values]
    if [counts.pop(m[-1], 0) for m in marks] != expected or counts.pop(_M_END[-1], 0) > 1 or counts:
        reason = "the file has runs of control characters (U+0091 U+009C U+0082 …) that serve as marks here"
        raise UnreadableFile(reason, [Problem(reason)])
    skeleton = []
    for k, (item_properties, first) in enumerate(zip(properties, begins, strict=True)):
        if first:
            skeleton += [next(pieces), f"<?items {k}?>"]
        item_properties[FAMILY]["xml"] = next(pieces)
    return "".join([*skeleton, *pieces])


def _cut_into_slots(text: str) -> tuple[Iterator[str], Counter[str]]:
    """The text cut at its item marks, with slots for its other marks, and how many there are of each."""
    first, *chunks = text.split(_MARK)
    pieces: list[str] = []
    current = [first]
    counts = Counter(c[:1] for c in chunks)
    item = _M_ITEM[-1]
    for chunk in chunks:
        code = chunk[:1]
        if code == item:
            pieces.append("".join(current))
            current = [chunk[1:]]
        else:
            current += (_SLOTS.get(code, ""), chunk[1:])
    pieces.append("".join(current))
    return iter(pieces), counts


def _serialise(root: etree._Element, items: Sequence[etree._Element]) -> tuple[str, list[bool]]:
    """The tree as text with a mark behind each item, before each that follows no other item directly (True in the
    list), and where more can be added.
    """
    top = [c for c in root if local_name(c) in CONTAINERS | ITEMS]
    if local_name(root) == "kml" and len(top) == 1 and local_name(top[0]) in CONTAINERS:
        last = top[0][-1] if len(top[0]) else None
        if last is None:
            top[0].text = (top[0].text or "") + _M_END
        else:
            last.tail = (last.tail or "") + _M_END
    begins = []
    previous = None
    for element in items:
        before = element.getprevious()
        first = before is None or before is not previous
        if before is None:
            parent = element.getparent()
            if parent is not None:
                parent.text = (parent.text or "") + _M_ITEM
        elif first:
            before.tail = (before.tail or "") + _M_ITEM
        tail = element.tail
        if element is not root:
            element.tail = _M_ITEM + tail if tail else _M_ITEM
        begins.append(first)
        previous = None if tail else element
    text: str = etree.tostring(root, encoding="unicode")
    return (f"{_M_ITEM}{text}{_M_ITEM}" if items and items[0] is root else text), begins


def _metres(texts: Sequence[str | None], elements: Sequence[etree._Element]) -> list[Any]:
    """The exact coordinates of local items (None: not local): nested JSON lists, of a point, a line or an area, or a
    GeoJSON geometry. Points and lines are made all at once.
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
    reason = "the local coordinates of an item are not [x, y], a list of them, or a GeoJSON geometry"
    return UnreadableFile(reason, [Problem(reason, line=element.sourceline)])
