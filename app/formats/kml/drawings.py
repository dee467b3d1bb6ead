"""Write uploaded drawings again: stored texts with slots that are filled from the layers."""

from __future__ import annotations

import bisect
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any
from urllib.parse import unquote
from xml.parsers import expat

import numpy as np
import orjson
import shapely
from lxml import etree

from app.formats import WriteContext
from app.formats.kml.geometry import item_geometry
from app.formats.kml.texts import GX, KML, SAME_PLACE, CoordinateTexts, data_element, degree_texts, geometry_element
from app.formats.kml.words import (
    COORDINATES,
    END,
    FAMILY,
    GEOMETRIES,
    NAME,
    OWN_ELEMENT,
    SLOT,
    child,
    escape,
    local_name,
)
from app.model.features import Features, Properties, concatenate, unique_ids
from app.model.frame import GROUND
from app.model.geodesy import LocalFrame
from app.model.layers import Layers, PartKey
from app.syntax import decimals


@dataclass(frozen=True, slots=True)
class Document:
    """A drawing with its items, as text. level and name: of its part. root: the start tag's declarations."""

    level: str
    name: str
    entry: str | None
    xml: str


_ITEMS = re.compile(r"<\?items ([0-9]+)\?>")
_PREFIX = re.compile(r"[<\s]/?([\w.-]+):[\w.-]+(?=[\s=>/])")
_ROOT = re.compile(r"<((?:[\w.-]+:)?([\w.-]+))((?:\s[^>]*?)?)(/?)>")
_TITLE = re.compile(r"<(?:[\w.-]+:)?name>([^<]*)</")
_XMLNS = re.compile(r"""\sxmlns(?::[\w.-]+)?="[^"]*\"""")


def group_by_drawing(layers: Layers) -> dict[PartKey, Features]:
    """Return the vector parts; fences and zones drawn in a document are moved to the objects of that document."""
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
    """Return a part's stored drawings by name; entries that edits made invalid are skipped."""
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
    """Return an item's stored element in one of the existing drawings, if it is valid."""
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


def fill_drawings(
    key: PartKey, part: Features, frame: LocalFrame | None, context: WriteContext
) -> tuple[list[Document], Features | None]:
    """Return the uploaded drawings with their items in place, and the objects that belong to none of them."""
    skeletons = _skeletons(part)
    geometry = part.in_wgs84(frame)
    texts = degree_texts(geometry, thin=True)
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
            loose.append(k)  # not an element of a file
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
                context.drop("drawing", 1, "the stored rest of its document is damaged; its objects are still written")
                text = ""
            loose += bad
        if text:
            documents.append(Document(key.level, name, document.get("entry"), text))
    return documents, part.select(sorted(loose)) if loose else None


def _is_well_formed(xml: str) -> bool:
    """Whether a text is XML once its prefixes are declared."""
    try:
        expat.ParserCreate(namespace_separator=" ").Parse(xml, True)
    except (expat.ExpatError, UnicodeError):
        return False
    return True


def _fill_skeleton(skeleton: str, items: Sequence[tuple[int, int, str]]) -> str:
    """Write a document with its items at their original positions."""
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
    """Return the namespace declarations of a document's root."""
    root = _ROOT.match(xml)
    return "".join(_XMLNS.findall(root[3])) if root else ""


def _fill_element(
    source_element: Mapping[str, Any], p: Properties, geometry: Any, texts: CoordinateTexts, k: int, declarations: str
) -> str:
    """Write a stored element with the object's current name, values and geometry."""
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
    """Write a start tag, with the name as its first child."""
    qname, _, attributes, empty = start.groups()
    prefix = qname.rpartition(":")[0]
    tag = f"{prefix}:name" if prefix else "name"
    close = f"</{qname}>" if empty else ""
    return f"<{qname}{attributes}><{tag}>{name}</{tag}>{close}"


def _value(label: str, p: Properties, aside: Mapping[str, Any]) -> str:
    value = aside[label] if label in aside else p.get(label, "")
    return escape(value if isinstance(value, str) else orjson.dumps(value, option=orjson.OPT_SORT_KEYS).decode())


def _parse_element(xml: str, declarations: str) -> etree._Element:
    """Parse a stored element inside a wrapper with its document's namespaces; slots remain processing instructions."""
    parser = etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False, huge_tree=False)
    wrapper = etree.fromstring(f"<w{declarations}>{xml}</w>".encode(), parser)
    return wrapper[0]


def _serialise_element(element: etree._Element) -> str:
    text: str = etree.tostring(element.getparent(), encoding="unicode")
    return text[text.index(">") + 1 : text.rindex("<")]


def _update_geometry(xml: str, geometry: Any, declarations: str, lists: list[str]) -> str:
    """Write an element that contains its own geometry: unchanged unless the object has moved."""
    element = _parse_element(xml, declarations)
    before = item_geometry(element)
    both_empty = before.is_empty and geometry.is_empty
    if both_empty or shapely.equals_exact(before, geometry, tolerance=SAME_PLACE):
        return xml
    return _redraw(xml, geometry, declarations, lists)


def _redraw(xml: str, geometry: Any, declarations: str, lists: list[str]) -> str:
    """Replace an element's geometry; an overlay gets new corners, a model a new position."""
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
    element_text = geometry_element(geometry, iter(lists), extra)
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


def unique_names(documents: list[str]) -> list[str]:
    """Make style ids unique across documents, so that each placemark keeps its own style."""
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


def wrap_document(document: Document, xml: str) -> str:
    """Embed a complete document in ours: its root becomes a Document with its source."""
    data = data_element(OWN_ELEMENT, "document") + data_element("document", document.name)
    if document.entry is not None:
        data += data_element("entry", document.entry)
    if document.level != GROUND:
        data += data_element("level", document.level)
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
