"""Write fields, their boundaries, zones, objects and guidance lines as ISOXML task data."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import shapely
from lxml import etree

from app.formats import WriteContext
from app.formats.isoxml.words import (
    AB,
    CURVE,
    DECIMALS,
    GUIDANCE,
    LINES,
    NAME,
    PATTERN,
    POINTS,
    POLYGONS,
    ROOT,
    VALUE,
    place_hash,
    plain_pattern,
)
from app.model.features import Features, Properties
from app.model.frame import GROUND, Level
from app.model.geodesy import surface
from app.model.layers import Layer, Layers, PartKey

MAX_TEXT = 32
"""Maximum length of a name, in characters."""

KINDS: Mapping[str, str] = {
    "barrier": "fence", "building": "building", "fence": "fence", "field": "mainland", "headland": "headland",
    "obstacle": "obstacle", "road": "road", "wall": "obstacle", "water": "water",
}  # fmt: skip
"""Type of an object that was not read from ISOXML, by its kind, where shapes of its dimension have such a type."""

_TYPES: tuple[Sequence[str], ...] = (POINTS, LINES, POLYGONS)
_ID = {0: re.compile(r"PNT-?[0-9]{1,11}"), 1: re.compile(r"LSG-?[0-9]{1,11}"), 2: re.compile(r"PLN-?[0-9]{1,11}")}
_GUIDANCE_ID = re.compile(r"GPN-?[0-9]{1,11}")
_ILLEGAL = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that XML cannot contain."""
_POINT_TYPES = {str(number) for number in range(1, len(POINTS) + 1)}


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """Write ``TASKDATA.XML``. Raises MissingDatum for items in metres without a datum."""
    unwritten: tuple[Layer, ...] = ("occupancy", "voxels", "imagery")
    for layer in unwritten:
        context.drop(layer, len(layers.parts_of(layer)), "ISOXML fields contain shapes, not cells or pixels")
    context.drop("resources", len(layers.resources()), "ISOXML fields have no further files")
    context.drop("elevations of levels", int(layers.levels != (Level(),)), "ISOXML fields have no levels")
    writer = _Writer(context)
    for key, part in sorted(layers.parts.items(), key=lambda item: (item[0].layer != "location", item[0])):
        if isinstance(part, Features):
            writer.add_part(key, part, part.in_wgs84(layers.frame))
    return {"TASKDATA.XML": writer.text()}


class _Writer:
    """Task data in the making: a field for each name."""

    def __init__(self, context: WriteContext) -> None:
        self.context = context
        self.root = etree.Element(ROOT, VersionMajor="4", VersionMinor="3", DataTransferOrigin="1")
        self.root.set("ManagementSoftwareManufacturer", "Fleet Map Server")
        self.root.set("ManagementSoftwareVersion", "1")
        self.fields: dict[str, etree._Element] = {}
        self.areas: dict[str, float] = {}
        self.groups: dict[tuple[str, str], etree._Element] = {}
        self.taken: set[str] = set()
        self.drawn: set[bytes] = set()
        self.lost: Counter[tuple[str, str]] = Counter()
        self.counts = {"PFD": 0, "GGP": 0, "GPN": 0}

    def text(self) -> bytes:
        """Return the file, and report what it lacks."""
        for (subject, why), count in self.lost.items():
            self.context.drop(subject, count, why)
        for name, field in self.fields.items():
            field.set("D", str(round(self.areas.get(name, 0.0))))
        data: bytes = etree.tostring(self.root, xml_declaration=True, encoding="UTF-8", pretty_print=True)
        return data

    def add_part(self, key: PartKey, part: Features, geometry: Any) -> None:
        """Add the features of a part; what has no place is reported."""
        for k, properties in enumerate(part.properties):
            shape = geometry[k]
            if shape.is_empty or shape.geom_type == "GeometryCollection":
                self.lost["items without a single shape", "ISOXML has points, lines and polygons"] += 1
            elif key.layer == "topology":
                self._add_topology(key, part.ids[k], shape, properties)
            else:
                self._add_shape(key, part.ids[k], shape, properties)

    # --- fields ---

    def _field(self, key: PartKey, properties: Properties) -> tuple[str, etree._Element]:
        """Return the field of an item: the one that it was read from, else the one of its level."""
        source = properties.get(NAME)
        name = source.get("field") if isinstance(source, Mapping) else None
        if not isinstance(name, str) or not name:
            name = self.context.title if key.level == GROUND else f"{self.context.title} {key.level}"
        if name not in self.fields:
            self.counts["PFD"] += 1
            self.fields[name] = etree.SubElement(self.root, "PFD", A=f"PFD{self.counts['PFD']}", C=self._short(name))
        return name, self.fields[name]

    def _short(self, text: str) -> str:
        self.lost["ends of long names", "a name has at most 32 characters"] += int(len(text) > MAX_TEXT)
        return _ILLEGAL.sub("\ufffd", text[:MAX_TEXT])

    # --- shapes ---

    def _add_shape(self, key: PartKey, identifier: str, shape: Any, properties: Properties) -> None:
        dimension = int(shapely.get_dimensions(shape))
        source = properties.get(NAME)
        kind = self._type(key, dimension, properties, source if isinstance(source, Mapping) else {})
        if kind is None:
            self.lost["lines", "ISOXML lines are fences, obstacles, drainage … and have no other type"] += 1
            return
        self._report_properties(properties, has_width=dimension == 1 or kind == GUIDANCE)
        name, field = self._field(key, properties)
        if kind == GUIDANCE:
            group = source.get("group") if isinstance(source, Mapping) else None
            self._add_guidance((name, str(group or "")), identifier, shape, properties)
            return
        title = properties.get("name")
        if kind == "boundary":
            title = None if title == f"{name} boundary" else title
            self.areas[name] = self.areas.get(name, 0.0) + surface(shape)
        known_id = identifier if _ID[dimension].fullmatch(identifier) and identifier not in self.taken else None
        number = str(_TYPES[dimension].index(kind) + 1)
        pieces = shapely.get_parts(shape)
        self.lost["joins of several shapes", "each is an item of its own in ISOXML 4"] += int(len(pieces) > 1)
        for shown in pieces:
            if dimension == 2:
                element = self._polygon(field, number, shown)
            elif dimension == 1:
                element = self._line(field, number, shown)
                _set_width(element, properties)
            else:
                element = _point(field, number, shapely.get_coordinates(shown, include_z=True)[0])
            if isinstance(title, str) and title:
                element.set("B", self._short(title))
            if known_id is not None:
                element.set(("G", "F", "E")[dimension], known_id)
                self.taken.add(known_id)
                known_id = None

    def _type(self, key: PartKey, dimension: int, properties: Properties, source: Mapping[str, Any]) -> str | None:
        """Return the type of an item: that of its layer, that of its source, or that of its kind; None if none fits."""
        kind = properties.get("kind")
        if dimension == 2 and key.layer == "location":
            return "boundary"
        if dimension == 2 and key.layer == "zones":
            return "obstacle" if kind == "keepout" else "treatment zone"
        if dimension == 0 and source.get("type") == GUIDANCE and isinstance(source.get("pattern"), Mapping):
            return GUIDANCE  # a direction (A+), or a circle around a point
        names = _TYPES[dimension]
        for candidate in (source.get("type"), KINDS.get(str(kind))):
            if candidate in names:
                return str(candidate)
        return "other" if "other" in names else None

    def _report_properties(self, properties: Properties, *, has_width: bool) -> None:
        written = {"kind", "name", NAME, "width"} if has_width else {"kind", "name", NAME}
        further = [name for name in properties if name not in written]
        self.lost["further properties", "ISOXML shapes have a type and a name"] += len(further)

    def _polygon(self, parent: etree._Element, kind: str, shape: Any) -> etree._Element:
        element = etree.SubElement(parent, "PLN", A=kind)
        element.set("C", str(round(surface(shape))))
        self._line(element, "1", shape.exterior)
        for ring in shape.interiors:
            self._line(element, "2", ring)
        return element

    def _line(self, parent: etree._Element, kind: str, line: Any, points: Sequence[str] = ()) -> etree._Element:
        element = etree.SubElement(parent, "LSG", A=kind)
        rows = shapely.get_coordinates(line, include_z=True)
        for k, row in enumerate(rows):
            _point(element, points[k] if points else "2", row)
        return element

    # --- guidance ---

    def _add_topology(self, key: PartKey, identifier: str, shape: Any, properties: Properties) -> None:
        if properties.get("kind") != "edge" or int(shapely.get_dimensions(shape)) != 1:
            self.lost["nodes", "guidance lines have no network"] += 1
            return
        codes = sorted(shapely.to_wkb([shape, shapely.reverse(shape)]))
        if codes[0] in self.drawn:
            return  # the other direction of a two-way edge
        self.drawn.add(codes[0])
        further = [name for name in properties if name not in ("kind", "name", "width")]
        self.lost["properties of edges", "guidance lines have a name and a width"] += len(further)
        name, _ = self._field(key, properties)
        self._add_guidance((name, key.name), identifier, shape, properties)

    def _add_guidance(self, key: tuple[str, str], identifier: str, shape: Any, properties: Properties) -> None:
        """Add a pattern for each line of a shape: the one that was read, else a straight one or a curve."""
        source = properties.get(NAME)
        kept = source.get("pattern") if isinstance(source, Mapping) else None
        for line in shapely.get_parts(shape):
            drawn = self._pattern(line, kept if isinstance(kept, Mapping) else None)
            if drawn is None:
                continue
            attributes, points = drawn
            pattern = etree.SubElement(self._group(key), "GPN", A=self._pattern_id(identifier))
            title = properties.get("name")
            if isinstance(title, str) and title:
                pattern.set("B", self._short(title))
            for name, value in attributes.items():
                pattern.set(name, value)
            _set_width(self._line(pattern, "5", line, points), properties)

    def _group(self, key: tuple[str, str]) -> etree._Element:
        """Return the group of guidance lines of a field and a name."""
        if key not in self.groups:
            self.counts["GGP"] += 1
            group = etree.SubElement(self.fields[key[0]], "GGP", A=f"GGP{self.counts['GGP']}")
            if key[1]:
                group.set("B", self._short(key[1]))
            self.groups[key] = group
        return self.groups[key]

    def _pattern(self, line: Any, kept: Mapping[str, Any] | None) -> tuple[dict[str, str], Sequence[str]] | None:
        """Return attributes and types of points: those that were read, as far as they still hold. None: left out."""
        count = int(shapely.get_num_coordinates(line))
        attributes, points = plain_pattern(count)
        if kept is None:
            return attributes, points
        read = {name: kept[name] for name in PATTERN if VALUE.fullmatch(str(kept.get(name, "")))}
        types = kept.get("points")
        if not isinstance(types, Sequence) or len(types) != count or not _POINT_TYPES.issuperset(map(str, types)):
            if read.get("C", AB) in (AB, CURVE):
                self.lost["properties of guidance lines", "points were added or removed"] += len(read.keys() - {"C"})
                return attributes, points
            self.lost["guidance patterns", "points of a pivot, spiral or direction were added or removed"] += 1
            return None
        if count > 1 and kept.get("place") != place_hash(line):
            stale = {name for name in "GH" if name in read}
            self.lost["headings and radii", "the points of the guidance pattern were moved"] += len(stale)
            read = {name: value for name, value in read.items() if name not in stale}
        return {**attributes, **{name: str(value) for name, value in read.items()}}, [str(kind) for kind in types]

    def _pattern_id(self, identifier: str) -> str:
        if _GUIDANCE_ID.fullmatch(identifier) and identifier not in self.taken:
            self.taken.add(identifier)
            return identifier
        while True:
            self.counts["GPN"] += 1
            name = f"GPN{self.counts['GPN']}"
            if name not in self.taken:
                self.taken.add(name)
                return name


def _set_width(line: etree._Element, properties: Properties) -> None:
    """Set the width of a line, in millimetres."""
    width = properties.get("width")
    if isinstance(width, int | float) and 0 < width < 1e6:
        line.set("C", str(round(width * 1000)))


def _point(parent: etree._Element, kind: str, row: Any) -> etree._Element:
    """Add a point: latitude, longitude, and its height in millimetres if it has one."""
    longitude, latitude, height = row.tolist()
    element = etree.SubElement(parent, "PNT", A=kind, C=_degrees(latitude), D=_degrees(longitude))
    if np.isfinite(height):
        element.set("E", str(round(height * 1000)))
    return element


def _degrees(value: float) -> str:
    text = f"{value:.{DECIMALS}f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text
