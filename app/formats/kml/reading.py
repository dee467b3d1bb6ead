"""Shared by KML and KMZ: read KML into layers; document how KML content and our own data are stored.

Source: OGC KML 2.2/2.3 and Google's ``gx`` extension. Positions are longitude, latitude[, altitude]: degrees WGS 84,
metres.

**Stored data of a drawing.** A placemark or overlay is one object. ``properties.kml`` contains its place in the
document and everything that canonical properties cannot express:

``document``  key of the source file: ``Features.document["kml"]["documents"][key]`` has the rest of that file. The key
              is a hash of that rest, not the file's name: equal drawings are equal content
``place``     its index in that file
``xml``       the element as text, with slots for the canonical values: ``<?n?>`` the name, ``<?c?>`` a list of
              coordinates, ``<?d NAME?>`` a plain value of its ExtendedData, which is in ``properties`` under its own
              name (or under ``properties.kml.data`` if that name has a canonical meaning)
``shape``     the geometry that the coordinate slots belong to; without it ``xml`` contains the geometry itself

A document is ``{"xml": …}``: the file without its objects, with ``<?items N?>`` in place of the objects from index N
on, and ``<?end?>`` where more can be added. Slots are processing instructions, which the reader rejects in files, so no
text of a file can be mistaken for one.

**Our own data.** Items of other layers and format families have in their ExtendedData: ``layer``, ``id``, every
property under its own name, ``level`` and ``part`` if they are not the default, and ``local``: the exact metres of an
item that is anchored in the local frame. Values are texts, or JSON if they are not texts. Data shared by such items is
in the ExtendedData of their folder, marked by ``fleetmap``.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import shapely
from lxml import etree
from numpy.typing import NDArray

from app.errors import Problem, UnreadableFile
from app.formats import ReadContext
from app.formats.kml.coordinates import Sequences, off_earth_problem, parse_coordinates, parse_two_way_rings
from app.formats.kml.geometry import item_geometries, parse_plain_sequences
from app.formats.kml.items import Item, extended_values, find_items, own_words, usable_text
from app.formats.kml.slots import keep_element_text
from app.formats.kml.values import ELEMENTS, FREE, check_values, parse_metres
from app.formats.kml.words import (
    CONTAINERS,
    DEFAULT_PART,
    FAMILY,
    ITEMS,
    OVERLAYS,
    OWN_ELEMENT,
    OWN_KEYS,
    PLACE_KEYS,
    STYLE,
    child,
    child_text,
    local_name,
    reserved_names,
    unspell,
)
from app.model.features import Features, unique_ids
from app.model.frame import MAX_METRES, Datum, Level
from app.model.geodesy import LocalFrame, local_frame
from app.model.grid import OccupancyGrid
from app.model.imagery import GeoImage
from app.model.layers import VECTOR_LAYERS, Layers, Part, PartKey
from app.syntax import images, xml

DOCUMENT_KEY_DIGITS = 16
"""Number of hexadecimal digits of a SHA-256 in a drawing's key within an environment."""

MOVED = 1e-8
"""Distance in degrees (a millimetre) beyond which an item of ours counts as moved from its exact metres."""


@dataclass(slots=True)
class _OwnItems:
    """Items of ours that are read back into one part."""

    ids: list[str] = field(default_factory=list)
    geometry: list[Any] = field(default_factory=list)
    properties: list[dict[str, Any]] = field(default_factory=list)
    local: list[Any] = field(default_factory=list)
    document: dict[str, Any] = field(default_factory=dict)


def read_kml(
    data: bytes, context: ReadContext, pictures: Mapping[str, bytes], entry: str | None = None
) -> tuple[Layers, set[str]]:
    """Read KML into layers; also return the names of the images that became grids.

    pictures: targets of relative references (KMZ). entry: the name of this document inside its archive. Raises
    UnreadableFile with the line.
    """
    root = xml.parse(data, context.limits, remove_blank_text=True)
    if local_name(root) not in CONTAINERS | ITEMS:
        raise UnreadableFile(
            f"the root element is <{local_name(root)}>: KML must start with <kml>",
            [Problem(f"<{local_name(root)}> is not KML", line=root.sourceline)],
        )
    xml.report_active_content(data, context.warn)
    defined = {schema.get("name", "") for schema in root.iter("{*}Schema")}
    xml.report_unknown_elements(data, root, ELEMENTS | defined, context.warn, free={*FREE, *defined}, namespace="kml")
    check_values(root, context)
    reader = _Reader(context, pictures)
    reader.read(root, entry)
    return reader.layers(), reader.used


class _Reader:
    """Reader of one file; its documents (ours may contain several) are read in turn into shared columns."""

    def __init__(self, context: ReadContext, pictures: Mapping[str, bytes]) -> None:
        self.context = context
        self.pictures = pictures
        self.used: set[str] = set()
        self.datum: Datum | None = None
        self.levels: dict[str, float] = {}
        self.own_items: dict[PartKey, _OwnItems] = {}
        self.rasters: dict[PartKey, OccupancyGrid | GeoImage] = {}
        self.columns: dict[str, list[tuple[list[str], list[Any], list[dict[str, Any]]]]] = {}
        self.documents: dict[str, dict[str, Any]] = {}
        self.credit: list[str] = []

    def read(self, root: etree._Element, entry: str | None) -> None:
        """Read a document, and those embedded in it."""
        marks = self._marks(root)
        for element, values in marks:
            if values.get(OWN_ELEMENT) == "document" and element is not root and element.getparent() is not None:
                level = values.get("level") or self.context.level
                self._detach(element)
                self._read_document(element, values.get("document"), values.get("entry"), level, [])
        ours = [(e, w) for e, w in marks if w.get(OWN_ELEMENT) != "document"]
        self._read_document(root, None, entry, self.context.level, ours)

    def _marks(self, root: etree._Element) -> list[tuple[etree._Element, dict[str, str]]]:
        """Return the containers with our mark, innermost last, and their values."""
        out = []
        for extended in root.iter("{*}ExtendedData"):
            parent = extended.getparent()
            if parent is not None and local_name(parent) in CONTAINERS:
                values = own_words(extended_values(extended), PLACE_KEYS | {"document", "entry"})
                if OWN_ELEMENT in values:
                    out.append((parent, values))
        return out

    def _detach(self, element: etree._Element) -> None:
        """Extract an embedded document: it becomes a ``kml`` root again."""
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
        items = find_items(root)
        for schema in root.iter("{*}Schema"):
            if schema.get("parent"):
                noun = f"<{schema.get('name', '')[:80]}> elements, placemarks of KML's oldest Schema form,"
                self.context.warn(f"{noun} are stored but not read as objects", line=schema.sourceline)
        parsed = self._sequences(items)
        _check_places(items, parsed)
        own_items, other_items = [], []
        for item in items:
            values = own_words(item.data, PLACE_KEYS)
            if values.get("layer") in DEFAULT_PART:
                own_items.append((item, values))
            else:
                other_items.append(item)
        self._take_own_items(own_items, parsed)
        all_own = self._remove_ours(root, ours)
        if (other_items or not all_own) and self.context.wants("objects"):
            self._take_drawing(root, other_items, parsed, name, entry, level)

    # --- our own data ---

    def _key(self, values: Mapping[str, str], layer: str) -> PartKey:
        part = values.get("part") or DEFAULT_PART[layer] or FAMILY
        return PartKey(layer, values.get("level") or self.context.level, part)  # type: ignore[arg-type]

    def _take_own_items(self, own_items: Sequence[tuple[Item, dict[str, str]]], parsed: Sequences) -> None:
        """Read items of ours back into their parts."""
        geometry = item_geometries([item for item, _ in own_items], parsed)
        metres = parse_metres([values.get("local") for _, values in own_items], [item.element for item, _ in own_items])
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
            part_items = self.own_items.setdefault(self._key(values, layer), _OwnItems())
            part_items.ids.append(usable_text(values.get("id") or title or local_name(element)))
            part_items.geometry.append(shape)
            part_items.properties.append(properties)
            part_items.local.append(exact)

    def _take_datum(self, properties: Mapping[str, Any], element: etree._Element) -> None:
        names = ("latitude", "longitude", "altitude", "heading")
        numbers = {n: properties[n] for n in names if isinstance(properties.get(n), int | float)}
        if "latitude" not in numbers or "longitude" not in numbers:
            reason = "the datum lacks latitude and longitude"
            raise UnreadableFile(reason, [Problem(reason, line=element.sourceline)])
        self.datum = Datum(**numbers)

    def _take_raster(self, element: etree._Element, values: Mapping[str, str], title: str) -> None:
        """Read a grid or an image of ours whose image file came with the drawing."""
        icon = child(element, "Icon")
        href = "" if icon is None else child_text(icon, "href")
        layer = values["layer"]
        label = values.get("part") or title or DEFAULT_PART[layer]
        noun = "grid" if layer == "occupancy" else "image"
        data = self.pictures.get(href)
        if data is None:
            self.context.warn(
                f"image {href!r} is not in the upload; the {noun} is skipped: upload the KMZ, or both files",
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
            reason = f"the {noun} {label} lacks its georeference: {error}"
            raise UnreadableFile(reason, [Problem(reason, line=element.sourceline)]) from error

    def _grid(self, data: bytes, href: str, parameters: Mapping[str, Any]) -> OccupancyGrid:
        """Build a grid: the palette index of a pixel is the cell value."""
        image = images.read_image(data, self.context.limits)
        if image.mode != "P":
            raise UnreadableFile(f"{href} no longer shows a grid: its colours have changed")
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
        """Build an image: its pixels, and the exact georeference in our own data."""
        image = images.read_image(data, self.context.limits)
        if image.mode not in ("L", "LA", "RGB", "RGBA"):
            raise UnreadableFile(f"{href} is not the image that was written: its colours have changed")
        pixels = np.asarray(image, np.uint8).reshape(image.height, image.width, -1)
        a, b, c, d, e, f = (float(v) for v in parameters["transform"])
        properties = parameters.get("properties")
        picture_properties = properties if isinstance(properties, dict) else {}
        return GeoImage(np.ascontiguousarray(pixels), (a, b, c, d, e, f), str(parameters["crs"]), picture_properties)

    def _remove_ours(self, root: etree._Element, ours: list[tuple[etree._Element, dict[str, str]]]) -> bool:
        """Remove our folders and styles; return True if nothing else is left in the file."""
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
                part_items = self.own_items.setdefault(self._key(values, values["layer"]), _OwnItems())
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

    def _sequences(self, items: Sequence[Item]) -> Sequences:
        """Find the coordinate lists of all items of regular structure, and parse them at once."""
        texts: list[str] = []
        for item in items:
            if len(item.geometries) != 1 or local_name(item.element) == "GroundOverlay":
                continue
            sequences = parse_plain_sequences(item.geometries[0])
            if sequences is None:
                continue
            item.shape = sequences[0]
            for role, c in sequences[1]:
                item.sequences.append((role, len(texts), c))
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
        # A ring of four points that is "there and back" would be confused with a padded one (see _there_and_back).
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
                f"{len(strange)} geometries have irregular coordinates, open rings or too few points; they are "
                "read as Google Earth does and stored unchanged",
                line=strange[0].sourceline,
                where=child_text(strange[0], "name")[:200] or None,
            )
        rings = [k for item in items for role, k, _ in item.sequences if role == "R" and counts[k] == 3]
        return parse_two_way_rings(parsed, rings) if rings else parsed

    def _take_drawing(
        self,
        root: etree._Element,
        items: list[Item],
        parsed: Sequences,
        name: str | None,
        entry: str | None,
        level: str,
    ) -> None:
        """Read a drawing: its items become objects, the rest of it the document. name: its key, if it has one."""
        geometry = item_geometries(items, parsed)
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
            document_xml = keep_element_text(root, items, [t[0] if t else None for t in titles], properties)
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
        for key, part_items in self.own_items.items():
            part = self._read_own_part(key, part_items)
            existing = parts.get(key)
            parts[key] = _concatenate(existing, part) if isinstance(existing, Features) else part
        parts = self._with_credits(parts)
        levels = tuple(Level(n, e) for n, e in sorted(self.levels.items(), key=lambda v: (v[1], v[0])))
        return Layers(parts, self.datum, levels or (Level(self.context.level),))

    def _with_credits(self, parts: dict[PartKey, Part]) -> dict[PartKey, Part]:
        """Add those credits of our map's description to every part that no part's own document states."""
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
        """Restore items of ours: exact metres if they were local, unless they have been moved."""
        n = len(part_items.ids)
        ids = unique_ids(part_items.ids)
        if ids != part_items.ids:
            repeats = [i for i, c in Counter(part_items.ids).items() if c > 1]
            self.context.warn(f"{len(repeats)} duplicate ids of {key.layer}; later ones got #2, #3 …", where=repeats[0])
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
        """Return the exact metres; for items that were moved, the drawn position converted to metres."""
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
            f"{int(moved.sum())} items were moved in the drawing; their new positions are used instead of the "
            "exact metres"
        )
        return out


_KINDS = ("poi", "path", "path", "region", "poi", "path", "region", "")
"""Return an object's kind by its geometry's type number; a collection is judged by its contents."""


def _mixed_type(geometry: Any) -> str:
    widest = shapely.get_dimensions(geometry)
    return "note" if geometry.is_empty else ("poi", "path", "region")[widest]


def _concatenate(a: Features, b: Features) -> Features:
    """Merge drawn objects and objects written by us into one part."""
    ids = unique_ids([*a.ids, *b.ids])
    return Features(
        tuple(ids),
        np.concatenate([a.geometry, b.geometry]),
        (*a.properties, *b.properties),
        np.concatenate([a.local, b.local]),
        {**b.document, **a.document},
    )


def _check_places(items: Sequence[Item], parsed: Sequences) -> None:
    """Reject coordinates that are not on earth, with the line of their geometry."""
    points = parsed.points
    valid = (np.abs(points[:, 0]) <= 180.0) & (np.abs(points[:, 1]) <= 90.0) & (np.abs(points[:, 2]) <= MAX_METRES)
    if valid.all():
        return
    at = int(np.flatnonzero(~valid)[0])
    sequence = int(np.searchsorted(parsed.start, at, "right")) - 1
    owner = next((i for i in items if any(k == sequence for _, k, _ in i.sequences)), None)
    x, y, _ = points[at]
    line = None if owner is None else owner.geometries[0].sourceline
    raise UnreadableFile(f"the coordinates {x:g},{y:g} are not on earth", [off_earth_problem(x, y, line)])


def _identify(items: Sequence[Item], context: ReadContext) -> tuple[list[str], list[tuple[etree._Element, str] | None]]:
    """Return ids (the id attribute if unique, else the name) and (element, text) of the names."""
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
            ids.append(usable_text(attribute))
        else:
            ids.append(usable_text(title[1] if title and title[1] else attribute or local_name(item.element)))
    repeats = [n for n, c in Counter(t[1] for t in titles if t and t[1]).items() if c > 1]
    if repeats:
        suffix = f" and {len(repeats) - 1} more" if len(repeats) > 1 else ""
        context.warn(f"several placemarks have the name {repeats[0]!r}{suffix}; all are stored", where=repeats[0][:200])
    return ids, titles
