"""Writing KML: the drawings that were uploaded as they were, and everything else in our own words (see ``reading``)."""

from __future__ import annotations

import bisect
import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any
from urllib.parse import unquote
from xml.parsers import expat

import numpy as np
import orjson
import shapely
from lxml import etree
from numpy.typing import NDArray

from app.errors import Invalid
from app.formats import LayerRequirements, WriteContext
from app.formats.kml.reading import (
    COORDINATES,
    DEFAULT_PART,
    END,
    FAMILY,
    GEOMETRIES,
    NAME,
    OWN_ELEMENT,
    OWN_KEYS,
    SLOT,
    STYLE,
    child,
    escape,
    item_geometry,
    local_name,
    quote_attribute,
    spell,
)
from app.model.features import Features, Properties, concatenate, unique_ids
from app.model.frame import GROUND, MAX_DATUM_LATITUDE, Datum
from app.model.geodesy import LocalFrame, crs_to_wgs84, local_frame
from app.model.grid import OccupancyGrid
from app.model.imagery import DEFAULT_COLOURS, LOCAL, GeoImage, display_pixels
from app.model.layers import Layer, Layers, PartKey
from app.syntax import decimals, images

KML = "http://www.opengis.net/kml/2.2"
GX = "http://www.google.com/kml/ext/2.2"
ATOM = "http://www.w3.org/2005/Atom"
HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n'
_NAMESPACES = f'xmlns="{KML}" xmlns:gx="{GX}" xmlns:kml="{KML}" xmlns:atom="{ATOM}"'

_SAME_PLACE = 1e-10
"""Degrees: a geometry that differs less from what the kept element says has not been edited (coordinates are printed
to 1e-12)."""

NEEDS = LayerRequirements(
    (
        frozenset({"objects"}),
        frozenset({"topology"}),
        frozenset({"location"}),
        frozenset({"zones"}),
        frozenset({"occupancy"}),
    ),
    anchor="wgs84",
)
"""What ``write_kml`` can draw: any of these layers."""

_COLOURS = {
    "node": "<IconStyle><color>ff00a5ff</color><scale>0.6</scale><Icon><href>"
    "http://maps.google.com/mapfiles/kml/shapes/shaded_dot.png</href></Icon></IconStyle>",
    "edge": "<LineStyle><color>ff00a5ff</color><width>3</width></LineStyle>",
    "location": "<LineStyle><color>ff2f2fd3</color><width>4</width></LineStyle>"
    "<PolyStyle><color>402f2fd3</color></PolyStyle>",
    "zone": "<LineStyle><color>ff2f2fd3</color><width>2</width></LineStyle>"
    "<PolyStyle><color>802f2fd3</color></PolyStyle>",
    "object": "<LineStyle><color>ffb0b0b0</color><width>2</width></LineStyle>"
    "<PolyStyle><color>60b0b0b0</color></PolyStyle>",
}
"""Our styles, by what they are for; colours are aabbggrr."""


@dataclass(frozen=True, slots=True)
class WrittenKml:
    """A KML file, the pictures that it refers to, and the name its one source had inside an archive, if any."""

    kml: bytes
    pictures: dict[str, bytes]
    entry: str | None


@dataclass(frozen=True, slots=True)
class _Document:
    """A drawing with its items, as text. level and name: where it came from. root: the start tag's declarations."""

    level: str
    name: str
    entry: str | None
    xml: str


def write_kml(layers: Layers, context: WriteContext, *, with_pictures: bool, taken: frozenset[str]) -> WrittenKml:
    """All vector layers and the places of grids. with_pictures: grids' pictures are made too; taken: names in use."""
    frame = layers.frame
    documents: list[_Document] = []
    folders: list[str] = []
    drawn = {i for part in layers.vector("objects").values() for i in part.ids}
    parts = _group_by_drawing(layers)
    claimed = {text for part in parts.values() for text in _attribution_texts(part)}
    shared = [text for text in context.attribution if text not in claimed]
    for key in sorted(parts):
        part = parts[key]
        remainder: Features | None = part
        if key.layer == "objects" and key.name == FAMILY:
            drawings, remainder = _drawings(key, part, frame, context)
            documents += drawings
        elif key.layer == "topology":
            remainder = _drop_drawing(part, drawn)
        if remainder is not None:
            folders.append(_folder(key, remainder, layers, frame, shared))
    overlays, pictures = _overlays(layers, context, with_pictures, taken)
    # A drawing that is all there is comes back as it was: the datum stands beside what is ours, not inside it.
    datum = [_datum(layers)] if folders or overlays or not documents else []
    ours = "".join([*datum, *folders, *overlays])
    context.drop("voxels", len(layers.parts_of("voxels")), "KML has no place for it")
    entry = documents[0].entry if len(documents) == 1 else None
    return WrittenKml((HEAD + _file(documents, ours, context)).encode(), pictures, entry)


def _file(documents: list[_Document], ours: str, context: WriteContext) -> str:
    """Drawings and our own folders as one document, in the simplest way that keeps all of it."""
    if len(documents) == 1:
        only = documents[0].xml
        if not ours and all(escape(text) in only for text in context.attribution):
            return only.replace(END, "") + "\n"
        if END in only and not re.match(r"<[\w.-]+:", only):
            return only.replace(END, _map(ours, context, [])) + "\n"
    inner = _unique_names([d.xml.replace(END, "") for d in documents])
    wrapped = [_wrap_document(d, xml) for d, xml in zip(documents, inner, strict=True)]
    return f"<kml {_NAMESPACES}>{_map(ours, context, wrapped)}</kml>\n"


def _map(ours: str, context: WriteContext, documents: list[str]) -> str:
    """Our own Document: its styles, what we tell in our words, and the documents of others."""
    credit = escape("\n".join(context.attribution))
    styles = "".join(f'<Style id="{STYLE}{n}">{s}</Style>' for n, s in _COLOURS.items() if f"#{STYLE}{n}<" in ours)
    return "".join(
        [
            f"<Document><name>{escape(context.title)}</name>",
            f"<description>{credit}</description>" if credit else "",
            styles,
            f"<ExtendedData>{_data(OWN_ELEMENT, 'map')}</ExtendedData>\n",
            *documents,
            ours,
            "</Document>",
        ]
    )


def _data(name: str, value: Any) -> str:
    return f'<Data name="{quote_attribute(name)}"><value>{spell(value)}</value></Data>'


# --- coordinates ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Texts:
    """The coordinate lists of n geometries as text: those of geometry k are texts[start[k]:start[k + 1]], in the order
    of its parts and rings; shape[k] is the geometry in the letters of ``reading``.
    """

    texts: list[str]
    start: list[int]
    shape: list[str]

    def texts_of(self, k: int) -> list[str]:
        return self.texts[self.start[k] : self.start[k + 1]]


_LETTERS = {0: "P", 1: "L", 2: "L"}


def _coordinate_texts(
    geometry: NDArray[np.object_], digits: int, form: Callable[..., str], glue: str, *, thin: bool = False
) -> _Texts:
    """All coordinates as text at once. form: joins the numbers of one position; glue: stands between positions. thin:
    rings that were drawn as three points get back to three.
    """
    parts, owner = shapely.get_parts(geometry, return_index=True)
    while len(parts) and (shapely.get_type_id(parts) > 3).any():
        parts, inner = shapely.get_parts(parts, return_index=True)
        owner = owner[inner]
    types = shapely.get_type_id(parts)
    area = types == 3
    count = np.where(area, 1 + np.maximum(shapely.get_num_interior_rings(parts), 0), 1)
    nothing = shapely.is_empty(parts)
    count[nothing] = 0
    part_of = np.repeat(np.arange(len(parts)), count)
    lists = np.empty(len(part_of), object)
    from_area = area[part_of]
    lists[~from_area] = parts[~area & ~nothing]
    lists[from_area] = shapely.get_rings(parts[area])
    points, list_of = shapely.get_coordinates(lists, include_z=True, return_index=True)
    columns = [decimals.numbers(points[:, 0], digits), decimals.numbers(points[:, 1], digits)]
    deep = shapely.has_z(lists)
    if deep.any():
        heights = decimals.numbers(np.where(np.isnan(points[:, 2]), 0.0, points[:, 2]), decimals.METRES)
        flat = (~deep[list_of]).tolist()
        triples = zip(*columns, heights, flat, strict=True)
        positions = [form(x, y) if plain else form(x, y, z) for x, y, z, plain in triples]
    else:
        positions = list(map(form, *columns))
    bounds = np.searchsorted(list_of, np.arange(len(lists) + 1)).tolist()
    texts = [glue.join(positions[a:b]) for a, b in pairwise(bounds)]
    if thin:
        begin = np.array(bounds[:-1], np.int64)
        four = np.flatnonzero(from_area & (np.diff(bounds) == 4))
        finite = np.nan_to_num(points)
        back = four[(finite[begin[four] + 1] == finite[begin[four] + 2]).all(axis=1)]
        for k in back.tolist():
            a = bounds[k]
            texts[k] = glue.join([positions[a], positions[a + 1], positions[a + 3]])
    places = np.searchsorted(owner[part_of], np.arange(len(geometry) + 1)).tolist()
    letters = [_LETTERS.get(t, f"A{n}") if n else "" for t, n in zip(types.tolist(), count.tolist(), strict=True)]
    starts = np.searchsorted(owner, np.arange(len(geometry) + 1)).tolist()
    several = (shapely.get_type_id(geometry) > 3).tolist()
    shape = [
        ("M" if many else "") + (letters[a] if b - a == 1 else "".join(letters[a:b]))
        for a, b, many in zip(starts, starts[1:], several, strict=False)
    ]
    return _Texts(texts, places, shape)


def _comma(*numbers: str) -> str:
    return ",".join(numbers)


def _bracket(*numbers: str) -> str:
    return f"[{','.join(numbers)}]"


def _degrees(geometry: NDArray[np.object_], *, thin: bool = False) -> _Texts:
    return _coordinate_texts(geometry, decimals.DEGREES, _comma, " ", thin=thin)


def _element(geometry: Any, lists: Iterator[str], extra: str = "") -> str:
    """A geometry as KML; its coordinate lists come from ``lists``."""
    kind = geometry.geom_type
    if geometry.is_empty:
        return ""
    if kind == "Point":
        return f"<Point>{extra}<coordinates>{next(lists)}</coordinates></Point>"
    hug = extra or "<tessellate>1</tessellate>"
    if kind in ("LineString", "LinearRing"):
        return f"<LineString>{hug}<coordinates>{next(lists)}</coordinates></LineString>"
    if kind == "Polygon":
        rings = [
            f"<{side}BoundaryIs><LinearRing><coordinates>{next(lists)}</coordinates></LinearRing></{side}BoundaryIs>"
            for side in ["outer"] + ["inner"] * len(geometry.interiors)
        ]
        return f"<Polygon>{hug}{''.join(rings)}</Polygon>"
    inner = "".join(_element(g, lists, extra) for g in geometry.geoms)
    return f"<MultiGeometry>{inner}</MultiGeometry>"


# --- our own words ----------------------------------------------------------------------------------------------------


def _drop_drawing(part: Features, drawn: set[str]) -> Features | None:
    """A network without what was made from a drawing that is written too; None where nothing else is in it."""
    mask = [isinstance(i := p.get("drawn_from"), str) and i in drawn for p in part.properties]
    if not any(mask):
        return part
    return part.select(~np.array(mask)) if not all(mask) else None


def _place_members(key: PartKey) -> str:
    """Where an item belongs, as far as it is not what a reader takes for granted."""
    data = _data("layer", key.layer)
    if key.level != GROUND:
        data += _data("level", key.level)
    if key.name != (DEFAULT_PART[key.layer] or FAMILY):
        data += _data("part", key.name)
    return data


def _datum(layers: Layers) -> str:
    """The environment's datum as a placemark; the numbers that count stand in its ExtendedData."""
    datum = layers.datum
    if datum is None:
        return ""
    data = "".join(_data(n, v) for n, v in {"kind": "datum", **datum.as_dict()}.items())
    at = ",".join(decimals.numbers([datum.longitude, datum.latitude], decimals.DEGREES))
    return (
        f"<Placemark><name>datum</name><ExtendedData>{_data('layer', 'location')}{data}</ExtendedData>"
        f"<Point><coordinates>{at}</coordinates></Point></Placemark>\n"
    )


def _attribution_texts(part: Features) -> list[str]:
    """The licences and credits that a part's own document tells."""
    attribution = part.document.get("attribution")
    return [text for text in attribution if isinstance(text, str)] if isinstance(attribution, list) else []


def _folder(key: PartKey, part: Features, layers: Layers, frame: LocalFrame | None, shared: Sequence[str] = ()) -> str:
    """A part in our own words. shared: credits that no part's document tells."""
    data = [_data(OWN_ELEMENT, "part"), _place_members(key)]
    elevation = layers.elevation(key.level)
    if elevation:
        data.append(_data("elevation", elevation))
    document = part.document if key.name != FAMILY else {}
    if shared and key.name != FAMILY:
        document = {**document, "attribution": [*_attribution_texts(part), *shared]}
    if document:
        data.append(_data("document", dict(document)))
    title = key.layer if key.level == GROUND else f"{key.layer}, {key.level}"
    return "".join(
        [
            f"<Folder><name>{escape(title)}</name><ExtendedData>{''.join(data)}</ExtendedData>\n",
            *_placemarks(key, part, frame),
            "</Folder>\n",
        ]
    )


def _placemarks(key: PartKey, part: Features, frame: LocalFrame | None) -> Iterator[str]:
    """Every item of a part as a placemark that says all we know of it."""
    geometry = part.in_wgs84(frame)
    texts = _degrees(geometry)
    exact = _local_texts(part)
    part_data = _place_members(key)
    opening: dict[str, str] = {}
    types = shapely.get_type_id(geometry).tolist()
    for k, (i, p) in enumerate(zip(part.ids, part.properties, strict=True)):
        out = ["<Placemark>"]
        data = [part_data, f'<Data name="id"><value>{spell(i)}</value></Data>']
        more: dict[str, Any] = {}
        for label in sorted(p):
            value = p[label]
            if label == "name" and isinstance(value, str) and value == value.strip() != "":
                shown = escape(value)
                if "\ufffd" not in shown:
                    out.append(f"<name>{shown}</name>")
                    continue
            start = opening.get(label)
            if start is None:
                plain = label not in OWN_KEYS and label and label.isprintable() and label == label.strip()
                start = opening[label] = f'<Data name="{quote_attribute(label)}"><value>' if plain else ""
            if start:
                data.append(f"{start}{spell(value)}</value></Data>")
            else:
                more[label] = value
        if more:
            data.append(_data("more", more))
        if exact[k]:
            data.append(f'<Data name="local"><value>{exact[k]}</value></Data>')
        if types[k] == 7 and not geometry[k].is_empty:
            data.append('<Data name="geometry"><value>GeometryCollection</value></Data>')
        out.append(f"<styleUrl>#{STYLE}{_style(key.layer, p)}</styleUrl><ExtendedData>{''.join(data)}</ExtendedData>")
        if types[k] == 0 and texts.start[k] < texts.start[k + 1] and not geometry[k].is_empty:
            out.append(f"<Point><coordinates>{texts.texts[texts.start[k]]}</coordinates></Point>")
        else:
            out.append(_element(geometry[k], iter(texts.texts_of(k))))
        out.append("</Placemark>\n")
        yield "".join(out)


def _style(layer: Layer, properties: Properties) -> str:
    if layer == "topology":
        return "edge" if properties.get("kind") == "edge" else "node"
    return {"location": "location", "zones": "zone"}.get(layer, "object")


def _local_texts(part: Features) -> list[str]:
    """The exact metres of local items as JSON, an empty text for the others."""
    out = [""] * len(part)
    indices = np.flatnonzero(part.local)
    if not len(indices):
        return out
    geometry = part.geometry[indices]
    texts = _coordinate_texts(geometry, decimals.METRES, _bracket, ",")
    for n, k in enumerate(indices.tolist()):
        shape, lists = texts.shape[n], texts.texts_of(n)
        if shape == "P":
            out[k] = lists[0]
        elif shape == "L":
            out[k] = f"[{lists[0]}]"
        elif shape[:1] == "A":
            out[k] = f"[[{'],['.join(lists)}]]"
        else:
            out[k] = orjson.dumps(orjson.loads(shapely.to_geojson(geometry[n]))).decode()
        if "[]" in out[k] and not geometry[n].is_empty:
            out[k] = orjson.dumps(orjson.loads(shapely.to_geojson(geometry[n]))).decode()
    return out


def _overlays(
    layers: Layers, context: WriteContext, with_pictures: bool, taken: frozenset[str]
) -> tuple[list[str], dict[str, bytes]]:
    """Each grid and picture as a GroundOverlay at its place, with all that its image does not say, and the images."""
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
        why = "their images travel in KMZ, or beside the KML with pictures=true; without them it tells where they lie"
        context.drop(layer, count, why)
    return out, image_files if with_pictures else {}


def _corners(
    key: PartKey, part: OccupancyGrid | GeoImage, layers: Layers, context: WriteContext
) -> NDArray[np.float64] | None:
    """The lower left, lower right, upper right and upper left corner of an image, (longitude, latitude); None, with
    the reason in the report, where KML has no place for it."""
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
        problem = "it lies in local metres, and there is no datum"
    else:
        corners = layers.frame.to_wgs84(corners)
    if not problem and not (np.isfinite(corners).all() and (np.abs(corners) <= [180.0, 90.0]).all()):
        problem = "its corners are not on earth"
    if not problem and abs(corners[:, 1].mean()) > MAX_DATUM_LATITUDE:
        problem = f"it lies beyond ±{MAX_DATUM_LATITUDE:g} degrees of latitude"
    if not problem and np.ptp(corners[:, 0]) > 180.0:
        problem = "it crosses the antimeridian, and an overlay cannot"
    context.drop(f"imagery {key.level}/{key.name}", int(bool(problem)), f"it cannot be placed: {problem}")
    return None if problem else corners


def _png(key: PartKey, part: OccupancyGrid | GeoImage, context: WriteContext) -> bytes:
    if isinstance(part, OccupancyGrid):
        return images.overlay_png(part)
    if not _is_displayable(part):
        why = "an overlay's image has 8-bit grey or colours: bands, values and palettes beyond them are drawn as shown"
        context.drop(f"imagery {key.level}/{key.name}: pixel values", 1, why)
    return images.encode_png(display_pixels(part))


def _is_displayable(picture: GeoImage) -> bool:
    """Whether a PNG holds the picture's very pixels."""
    plain = picture.pixels.dtype == np.uint8 and picture.colours == DEFAULT_COLOURS.get(len(picture.colours))
    return plain and picture.nodata is None


def _overlay(key: PartKey, part: OccupancyGrid | GeoImage, href: str, ring: NDArray[np.float64]) -> str:
    """Where an image lies: a box and its rotation (exact to the box's own flatness), and the exact corners."""
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
    data = _place_members(key) + "".join(_data(n, v) for n, v in parameters.items())
    box = zip(("north", "south", "east", "west", "rotation"), (north, south, east, west, turn), strict=True)
    sides_text = "".join(f"<{n}>{decimals.number(v, decimals.DEGREES)}</{n}>" for n, v in box if n != "rotation" or v)
    quad = _degrees(shapely.linestrings(ring[None])).texts[0]
    return (
        f"<GroundOverlay><name>{escape(key.name)}</name><ExtendedData>{data}</ExtendedData>"
        f"<Icon><href>{escape(href)}</href></Icon><LatLonBox>{sides_text}</LatLonBox>"
        f'<gx:LatLonQuad xmlns:gx="{GX}"><coordinates>{quad}</coordinates></gx:LatLonQuad></GroundOverlay>\n'
    )


# --- drawings ---------------------------------------------------------------------------------------------------------

_ITEMS = re.compile(r"<\?items ([0-9]+)\?>")
_PREFIX = re.compile(r"[<\s]/?([\w.-]+):[\w.-]+(?=[\s=>/])")
_DECLARED = re.compile(r"xmlns:([\w.-]+)=")
_ROOT = re.compile(r"<((?:[\w.-]+:)?([\w.-]+))((?:\s[^>]*?)?)(/?)>")
_TITLE = re.compile(r"<(?:[\w.-]+:)?name>([^<]*)</")
_XMLNS = re.compile(r"""\sxmlns(?::[\w.-]+)?="[^"]*\"""")


def _group_by_drawing(layers: Layers) -> dict[PartKey, Features]:
    """The vector parts; fences and zones that were drawn in a document stand with the objects of that document."""
    out = {key: part for key, part in layers.parts.items() if isinstance(part, Features)}
    for key in sorted(out):
        part = out[key]
        if key.layer not in ("location", "zones"):
            continue
        source_document = part.document.get(FAMILY)
        skeletons = _skeletons(part)
        drawn = np.array([_kept_element(p, skeletons) is not None for p in part.properties])
        if not drawn.any():
            continue
        home = PartKey("objects", key.level, FAMILY)
        siblings = [out[home]] if home in out else []
        moved = part.select(drawn).with_document({FAMILY: source_document})
        ids = unique_ids(moved.ids, {i for other in siblings for i in other.ids})
        out[home] = concatenate([*siblings, replace(moved, ids=tuple(ids))])
        left = {name: value for name, value in part.document.items() if name != FAMILY}
        out[key] = part.select(~drawn).with_document(left)
        if drawn.all() and not left:
            del out[key]
    return out


def _skeletons(part: Features) -> dict[str, Mapping[str, Any]]:
    """The drawings that a part remembers, by name. Edits can put anything there: what does not fit is left out."""
    source_document = part.document.get(FAMILY)
    documents = source_document.get("documents") if isinstance(source_document, Mapping) else None
    return {
        name: document
        for name, document in (documents.items() if isinstance(documents, Mapping) else ())
        if isinstance(document, Mapping)
        and isinstance(document.get("xml"), str)
        and isinstance(document.get("entry"), str | None)
    }


def _kept_element(p: Properties, documents: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """What an item remembers of its element in one of the known drawings, where that can be made use of."""
    source_element = p.get(FAMILY)
    usable = (
        isinstance(source_element, Mapping)
        and isinstance(name := source_element.get("document"), str)
        and name in documents
        and isinstance(source_element.get("xml"), str)
        and isinstance(source_element.get("shape"), str | None)
        and isinstance(source_element.get("place", 0), int)
    )
    return source_element if usable else None


def _drawings(
    key: PartKey, part: Features, frame: LocalFrame | None, context: WriteContext
) -> tuple[list[_Document], Features | None]:
    """The uploaded drawings with their items in place, and the objects that belong to none of them."""
    skeletons = _skeletons(part)
    geometry = part.in_wgs84(frame)
    texts = _degrees(geometry, thin=True)
    placed: dict[str, list[tuple[int, int, str]]] = {name: [] for name in skeletons}
    loose = []
    roots = {name: _declarations(document["xml"]) for name, document in skeletons.items()}
    for k, p in enumerate(part.properties):
        source_element = _kept_element(p, skeletons)
        if source_element is None:
            loose.append(k)
            continue
        name = source_element["document"]
        try:
            placed[name].append(
                (
                    source_element.get("place", 0),
                    k,
                    _fill_element(source_element, p, geometry[k], texts, k, roots[name]),
                )
            )
        except (etree.LxmlError, ValueError, LookupError, AttributeError, StopIteration):
            loose.append(k)  # not an element as it was read from a file
    documents = []
    for name, document in sorted(skeletons.items()):
        items = sorted(placed[name])
        text = _fill_skeleton(document["xml"], items)
        if not _is_well_formed(text):
            bad = {k for _, k, xml in items if not _is_well_formed(f"<w{roots[name]}>{xml}</w>")}
            items = [item for item in items if item[1] not in bad]
            text = _fill_skeleton(document["xml"], items)
            if not _is_well_formed(text):
                bad.update(k for _, k, _ in items)
                context.drop("drawing", 1, "what is remembered of its document is damaged; its objects are written")
                text = ""
            loose += bad
        if text:
            documents.append(_Document(key.level, name, document.get("entry"), text))
    return documents, part.select(sorted(loose)) if loose else None


def _is_well_formed(xml: str) -> bool:
    """Whether it is XML, its prefixes declared."""
    try:
        expat.ParserCreate(namespace_separator=" ").Parse(xml, True)
    except (expat.ExpatError, UnicodeError):
        return False
    return True


def _fill_skeleton(skeleton: str, items: Sequence[tuple[int, int, str]]) -> str:
    """A document with its items where they stood."""
    pieces = _ITEMS.split(skeleton)
    starts = [int(n[:18]) for n in pieces[1::2]]
    groups: list[list[str]] = [[] for _ in starts]
    over: list[str] = []
    for position, _, xml in items:
        at = bisect.bisect_right(starts, position) - 1
        (groups[at] if at >= 0 else over).append(xml)
    out = [pieces[0]]
    for group, after in zip(groups, pieces[2::2], strict=True):
        out += ["\n", "\n".join(group), "\n", after]
    text = "".join(out)
    return text.replace(END, "\n".join(over) + END) if over else text


def _declarations(xml: str) -> str:
    """The namespace declarations of a document's root."""
    root = _ROOT.match(xml)
    return "".join(_XMLNS.findall(root[3])) if root else ""


def _fill_element(
    source_element: Mapping[str, Any], p: Properties, geometry: Any, texts: _Texts, k: int, declarations: str
) -> str:
    """A kept element with the name, the values and the place that the object has now."""
    xml: str = source_element["xml"]
    shape = source_element.get("shape")
    if shape is None:
        xml = _update_geometry(xml, geometry, declarations, texts.texts_of(k))
    elif shape != texts.shape[k]:
        xml = _redraw(xml, geometry, declarations, texts.texts_of(k))
    else:
        begin, end = texts.start[k], texts.start[k + 1]
        if end - begin == 1:
            xml = xml.replace(COORDINATES, texts.texts[begin], 1)
        else:
            lists = iter(texts.texts[begin:end])
            xml = "".join(next(lists) if s == COORDINATES else s for s in re.split(r"(<\?c\?>)", xml))
    name = p.get("name")
    if NAME in xml:
        xml = xml.replace(NAME, "" if name is None else escape(str(name)), 1)
    elif name is not None and "<name>" not in xml:
        xml = _ROOT.sub(lambda m: _with_name(m, escape(str(name))), xml, count=1)
    if "<?d " in xml:
        aside = source_element.get("data")
        aside = aside if isinstance(aside, Mapping) else {}
        xml = SLOT.sub(lambda m: _value(unquote(m[2]), p, aside) if m[2] is not None else "", xml)
    return xml


def _with_name(start: re.Match[str], name: str) -> str:
    """A start tag, and the name as its first child."""
    qname, _, attributes, empty = start.groups()
    prefix = qname.rpartition(":")[0]
    tag = f"{prefix}:name" if prefix else "name"
    close = f"</{qname}>" if empty else ""
    return f"<{qname}{attributes}><{tag}>{name}</{tag}>{close}"


def _value(label: str, p: Properties, aside: Mapping[str, Any]) -> str:
    value = aside[label] if label in aside else p.get(label, "")
    return escape(value if isinstance(value, str) else orjson.dumps(value, option=orjson.OPT_SORT_KEYS).decode())


def _parse_element(xml: str, declarations: str) -> etree._Element:
    """A kept element as a tree, inside a wrapper with its document's namespaces; slots stay as instructions."""
    parser = etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False, huge_tree=False)
    wrapper = etree.fromstring(f"<w{declarations}>{xml}</w>".encode(), parser)
    return wrapper[0]


def _serialise_element(element: etree._Element) -> str:
    text: str = etree.tostring(element.getparent(), encoding="unicode")
    return text[text.index(">") + 1 : text.rindex("<")]


def _update_geometry(xml: str, geometry: Any, declarations: str, lists: list[str]) -> str:
    """An element that holds its own geometry: as it is, unless the object lies elsewhere by now."""
    element = _parse_element(xml, declarations)
    before = item_geometry(element)
    both_empty = before.is_empty and geometry.is_empty
    if both_empty or shapely.equals_exact(before, geometry, tolerance=_SAME_PLACE):
        return xml
    return _redraw(xml, geometry, declarations, lists)


def _redraw(xml: str, geometry: Any, declarations: str, lists: list[str]) -> str:
    """The element with another geometry. An overlay gets new corners, a model a new place."""
    element = _parse_element(xml, declarations)
    kind = local_name(element)
    if kind == "GroundOverlay":
        return _move_overlay(element, geometry, lists)
    old = [c for c in element if isinstance(c.tag, str) and local_name(c) in GEOMETRIES]
    spot = child(old[0], "Location") if len(old) == 1 and local_name(old[0]) == "Model" else None
    if spot is not None and geometry.geom_type == "Point" and not geometry.is_empty:
        numbers = lists[0].split(",")
        for name, text in zip(("longitude", "latitude", "altitude"), [*numbers, "0.0"][:3], strict=True):
            match = child(spot, name)
            if match is not None:
                match.text = text
        return _serialise_element(element)
    at = element.index(old[0]) if old else len(element)
    modes = old[0] if old and local_name(old[0]) in ("Point", "LineString", "LinearRing", "Polygon") else ()
    keep = [c for c in modes if isinstance(c.tag, str) and local_name(c) in ("extrude", "tessellate", "altitudeMode")]
    namespace = etree.QName(element).namespace
    extra = "".join(f"<{local_name(c)}>{escape(c.text or '')}</{local_name(c)}>" for c in keep)
    for c in old:
        element.remove(c)
    element_text = _element(geometry, iter(lists), extra)
    if element_text:
        declared = f' xmlns="{namespace}"' if namespace else ""
        element.insert(at, etree.fromstring(f"<w{declared}>{element_text}</w>")[0])
    return _serialise_element(element)


def _move_overlay(element: etree._Element, geometry: Any, lists: list[str]) -> str:
    for name in ("LatLonBox", "LatLonQuad"):
        old_box = child(element, name)
        if old_box is not None:
            element.remove(old_box)
    corners = [] if geometry.is_empty or geometry.geom_type != "Polygon" else lists[0].split(" ")[:-1]
    if len(corners) == 4:
        quad = f'<gx:LatLonQuad xmlns:gx="{GX}"><coordinates>{" ".join(corners)}</coordinates></gx:LatLonQuad>'
        element.append(etree.fromstring(quad))
    elif not geometry.is_empty:
        box = zip(("west", "south", "east", "north"), decimals.numbers(geometry.bounds, decimals.DEGREES), strict=True)
        namespace = etree.QName(element).namespace
        declared = f' xmlns="{namespace}"' if namespace else ""
        sides = "".join(f"<{n}>{v}</{n}>" for n, v in box)
        element.append(etree.fromstring(f"<LatLonBox{declared}>{sides}</LatLonBox>"))
    return _serialise_element(element)


_STYLE_ID = re.compile(r'(<(?:[\w.-]+:)?(?:Style|StyleMap|CascadingStyle)\s(?:[^>]*?\s)?(?:[\w.-]+:)?id=")([^"]*)(")')
_STYLE_URL = re.compile(r"(<(?:[\w.-]+:)?styleUrl(?:\s[^>]*)?>\s*#)([^<\s]*)")


def _unique_names(documents: list[str]) -> list[str]:
    """The documents with style ids that no other one has, so that each placemark keeps its own style."""
    used: set[str] = set()
    out = []
    for xml in documents:
        style_ids = {m[2] for m in _STYLE_ID.finditer(xml)}
        names: dict[str, str] = {}
        for i in sorted(style_ids & used):
            n = 2
            while f"{i}-{n}" in used or f"{i}-{n}" in style_ids or f"{i}-{n}" in names.values():
                n += 1
            names[i] = f"{i}-{n}"
        used |= {names.get(i, i) for i in style_ids}
        out.append(_rename(xml, names) if names else xml)
    return out


def _rename(xml: str, names: Mapping[str, str]) -> str:
    xml = _STYLE_ID.sub(lambda m: f"{m[1]}{names.get(m[2], m[2])}{m[3]}", xml)
    return _STYLE_URL.sub(lambda m: f"{m[1]}{names.get(m[2], m[2])}", xml)


def _wrap_document(document: _Document, xml: str) -> str:
    """A whole document inside ours: its root becomes a Document that says where it came from."""
    data = _data(OWN_ELEMENT, "document") + _data("document", document.name)
    if document.entry is not None:
        data += _data("entry", document.entry)
    if document.level != GROUND:
        data += _data("level", document.level)
    declarations = _declarations(xml)
    root = _ROOT.match(xml)
    if root and root[2] == "kml":
        xml = "" if root[4] else xml[root.end() : xml.rindex("<")]
    default = "" if ' xmlns="' in declarations else f' xmlns="{KML}"'
    title = _TITLE.search(xml)
    shown = title[1] if title and title[1].strip() else "drawing"
    return (
        f'<Document{default}{declarations}><name>{shown}</name><ExtendedData xmlns="{KML}">{data}</ExtendedData>'
        f"{xml}</Document>\n"
    )
