"""Names in KML that reader and writer share, and values as texts."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache
from typing import Any

import orjson
from lxml import etree

from app.formats import all_formats
from app.model.layers import MAP, NETWORK, SITE, ZONES

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
"""Names in ExtendedData that locate an item; a property of such a name is stored in ``more``."""

PLACE_KEYS = frozenset({"layer", "level", "part", "id"})
"""Those of them whose values are names."""

_CANONICAL = OWN_KEYS | {
    *("kind", "name", "source", "target", "orientation", "action", "speed_limit", "width", "value", "expires"),
    *("pose", "size", "datum", "drawn_from", "data", "documents", "tags", "properties", "style"),
}


@cache
def reserved_names() -> frozenset[str]:
    """Property names with a canonical meaning: a drawing's own value of that name is stored under ``kml.data``."""
    return _CANONICAL | all_formats().keys()


COORDINATES, NAME, END = "<?c?>", "<?n?>", "<?end?>"
SLOT = re.compile(r"<\?(c|n|d ([^?]*))\?>")


def local_name(element: etree._Element) -> str:
    """Return the tag without its namespace."""
    tag: str = element.tag
    return tag.rpartition("}")[2]


def child(element: etree._Element, name: str) -> etree._Element | None:
    """Return the first child of this name, in any namespace: files use five, or none."""
    return next(element.iterchildren("{*}" + name), None)


def child_text(element: etree._Element, name: str) -> str:
    """Return the stripped text of the first child of this name, else an empty text."""
    match = child(element, name)
    return "" if match is None else (match.text or "").strip()


_ILLEGAL = "\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff"
ILLEGAL = re.compile(f"[{_ILLEGAL}]")
"""Characters that XML 1.0 cannot contain."""

_PLAIN = re.compile(rf"(?!(?:true|false|null)\Z)[^\s\-0-9{{\[\"{_ILLEGAL}][^{_ILLEGAL}]*\Z")
_ESCAPES = str.maketrans({"&": "&amp;", "<": "&lt;", ">": "&gt;", "\r": "&#13;"})


def escape(text: str) -> str:
    """Escape a text for XML content; characters that XML cannot contain become U+FFFD. See ``quote_attribute``."""
    return ILLEGAL.sub("\ufffd", text).translate(_ESCAPES)


def quote_attribute(text: str) -> str:
    """Escape a text for an attribute in double quotes."""
    return escape(text).replace('"', "&quot;").replace("\n", "&#10;").replace("\t", "&#9;")


def spell(value: Any) -> str:
    """Write a property's value as an escaped text: unambiguous texts unchanged, everything else as JSON."""
    if isinstance(value, str):
        if _PLAIN.match(value):
            return value.translate(_ESCAPES)
        value = value.encode("utf-16", "surrogatepass").decode("utf-16", "replace")
    text = orjson.dumps(value, option=orjson.OPT_SORT_KEYS).decode()
    if ILLEGAL.search(text):
        text = ILLEGAL.sub(lambda m: f"\\u{ord(m[0]):04x}", text)
    return text.translate(_ESCAPES)


def unspell(text: str) -> Any:
    """Parse a value that ``spell`` wrote; a text that is not JSON is returned unchanged."""
    if text[:1] in _JSON_STARTS or text in ("true", "false", "null"):
        try:
            return orjson.loads(text)
        except orjson.JSONDecodeError:
            return text
    return text


_JSON_STARTS = frozenset('-0123456789{["')
