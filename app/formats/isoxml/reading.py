"""Read the fields of ISOXML task data."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import shapely
from lxml import etree

from app.errors import Problem, UnreadableFile
from app.formats import Files, ReadContext
from app.formats.isoxml.words import (
    AB,
    CURVE,
    GUIDANCE,
    LINES,
    NAME,
    PATTERN,
    POINTS,
    POLYGONS,
    VALUE,
    place_hash,
    plain_pattern,
)
from app.model.features import MAX_ID, NO_GEOMETRY, Properties, features, unique_ids
from app.model.frame import MAX_METRES, is_writable
from app.model.layers import Layers, PartKey
from app.syntax import xml

_ROOT = re.compile(rb"<ISO11783_TaskData[\s>]")
_EXTERNAL = re.compile(r"[A-Z]{3}\d{5}")


def detect(name: str, data: bytes) -> bool:  # noqa: ARG001
    """Detect XML whose root is that of a TASKDATA.XML."""
    head = data[:4096].lstrip(b"\xef\xbb\xbf \t\r\n")
    return head[:1] == b"<" and _ROOT.search(head) is not None


def companions(main: str, data: bytes, names: Sequence[str]) -> Iterable[str]:
    """Return the files with parts of the task data beside it."""
    del data
    folder = main.rpartition("/")[0]
    return [
        name
        for name in names
        if name != main
        and name.rpartition("/")[0] == folder
        and _EXTERNAL.fullmatch(name.rpartition("/")[2].upper().removesuffix(".XML"))
    ]


def read(files: Files, context: ReadContext) -> Layers:
    """Read all fields. Raises UnreadableFile, with the line, for damaged files and positions that are not on earth."""
    root = xml.parse(files[context.main], context.limits)
    reader = _Reader(context)
    for element in [*root, *_external(root, files, context)]:
        if element.tag == "PFD":
            reader.read_field(element)
        elif element.tag != "XFR":
            reader.unread[str(element.tag)] += 1
    reader.report()
    if not reader.rows:
        context.warn("it has no field (PFD) with a geometry")
    ids = unique_ids(i for i, _, _ in reader.rows)
    rows = [(i, shape, properties) for i, (_, shape, properties) in zip(ids, reader.rows, strict=True)]
    return Layers({PartKey("objects", context.level, NAME): features(rows, "wgs84")})


def _external(root: etree._Element, files: Files, context: ReadContext) -> Iterator[etree._Element]:
    """Yield the elements of the files that the task data refers to."""
    by_name = {name.rpartition("/")[2].upper().removesuffix(".XML"): data for name, data in files.items()}
    for reference in root.iterchildren("XFR"):
        name = str(reference.get("A", "")).upper()
        if not _EXTERNAL.fullmatch(name) or name not in by_name:
            context.warn(f"{name[:40] or 'a file'} is not in the upload", line=reference.sourceline, where="XFR")
            continue
        yield from xml.parse(by_name[name], context.limits)


class _Reader:
    def __init__(self, context: ReadContext) -> None:
        self.context = context
        self.rows: list[tuple[str, Any, Properties]] = []
        self.field = ""
        self.field_id = ""
        self.unread: Counter[str] = Counter()
        self.unusual = 0
        """Number of guidance patterns that are no lines."""

    def report(self) -> None:
        """Warn of what is not read, and of what its shape does not show."""
        if self.unread:
            tags = ", ".join(f"{tag[:20]} ({n})" for tag, n in sorted(self.unread.items())[:30])
            self.context.warn(f"not read: {tags}; only the shapes and guidance lines of fields (PFD) are")
        if self.unusual:
            self.context.warn(
                f"{self.unusual} guidance patterns are neither straight lines (AB) nor curves: their shapes are the "
                "points that define them, not where a machine drives",
                where="GPN",
            )

    def read_field(self, field: etree._Element) -> None:
        """Read the polygons, lines, points and guidance lines of a field."""
        self.field_id = str(field.get("A") or f"PFD{field.sourceline}")
        self.field = str(field.get("C") or self.field_id)
        for element in field:
            if element.tag == "PLN":
                self.add_polygon(element)
            elif element.tag == "LSG":
                kind, width = _type(element, LINES), self.width(element)
                self.add(element, element.get("F"), element.get("B"), kind, self.line(element), width=width)
            elif element.tag == "PNT":
                self.add(element, element.get("G"), element.get("B"), _type(element, POINTS), self.point(element))
            elif element.tag == "GGP":
                self.add_guidance(element)
            else:
                self.unread[str(element.tag)] += 1

    def add_polygon(self, element: etree._Element) -> None:
        rings = [(child.get("A"), self.positions(child)) for child in element.iterchildren("LSG")]
        outer = [r for kind, r in rings if kind == "1"]
        inner = [r for kind, r in rings if kind == "2"]
        kind = _type(element, POLYGONS)
        title = element.get("B") or (f"{self.field} boundary" if kind == "boundary" else None)
        shells = [shapely.linearrings(_closed(ring)) for ring in outer if len(ring) > 2]
        holes = [shapely.linearrings(_closed(ring)) for ring in inner if len(ring) > 2]
        if len(shells) < len(outer) or len(holes) < len(inner):
            self.context.warn("a ring of fewer than three points is not read", line=element.sourceline, where="PLN")
        if len(shells) == 1:
            shape = shapely.polygons(shells[0], holes or None)
        else:  # a hole belongs to the shell that contains it
            parts = [shapely.Polygon(s, [h for h in holes if shapely.Polygon(s).covers(h)]) for s in shells]
            shape = shapely.multipolygons(parts) if parts else NO_GEOMETRY
        self.add(element, element.get("E"), title, kind, shape)

    def add_guidance(self, group: etree._Element) -> None:
        title = group.get("B") or group.get("A")
        for pattern in group:
            if pattern.tag != "GPN":
                self.unread[str(pattern.tag)] += 1
                continue
            for line in pattern:
                if line.tag != "LSG":
                    self.unread[str(line.tag)] += 1
                    continue
                shape = self.line(line)
                more = {"group": title, "pattern": self.pattern(pattern, line, shape)}
                name, width = pattern.get("B"), self.width(line)
                self.add(line, pattern.get("A"), name, GUIDANCE, shape, more, width=width)

    def pattern(self, pattern: etree._Element, line: etree._Element, shape: Any) -> Properties | None:
        """Return what the shape of a guidance pattern does not say: attributes, and types of points; None if nothing.

        ``place`` tells whether the points have been moved since.
        """
        attributes = {name: str(pattern.get(name)) for name in PATTERN if VALUE.fullmatch(pattern.get(name) or "")}
        kinds = [str(point.get("A") or "2") for point in line.iterchildren("PNT")]
        self.unusual += int(bool(kinds) and attributes.get("C", AB) not in (AB, CURVE))
        if (attributes, kinds) == plain_pattern(len(kinds)):
            return None
        return {**attributes, "points": kinds, "place": place_hash(shape)}

    def width(self, line: etree._Element) -> float | None:
        """Return the width of a line in metres; None if it has none."""
        text = str(line.get("C") or "0")
        if not (text.isascii() and text.isdigit() and len(text) < 10):
            self.context.warn(f"C must be a width in mm, got {text[:40]!r}", line=line.sourceline, where="LSG")
            return None
        return int(text) / 1000 or None

    def add(
        self,
        element: etree._Element,
        identifier: str | None,
        title: str | None,
        kind: str,
        shape: Any,
        more: Properties | None = None,
        *,
        width: float | None = None,
    ) -> None:
        if shape.is_empty:
            self.context.warn("it has no points and is not read", line=element.sourceline, where=str(element.tag))
            return
        text = identifier or f"{self.field_id}/{element.tag}{len(self.rows) + 1}"
        if len(text) > MAX_ID or not is_writable(text):
            text = f"{element.tag}{len(self.rows) + 1}"
        properties: dict[str, Any] = {"kind": ("poi", "path", "region")[int(shapely.get_dimensions(shape))]}
        if title:
            properties["name"] = title
        if width is not None:
            properties["width"] = width
        details = {"field": self.field, "type": kind, **(more or {})}
        properties[NAME] = {name: value for name, value in details.items() if value}
        self.rows.append((text, shape, properties))

    def line(self, element: etree._Element) -> Any:
        positions = self.positions(element)
        if len(positions) < 2:
            return shapely.points(positions[0]) if len(positions) else NO_GEOMETRY
        return shapely.linestrings(positions)

    def point(self, element: etree._Element) -> Any:
        return shapely.points(self.position(element))

    def positions(self, element: etree._Element) -> list[list[float]]:
        """Return the positions of a line; heights only if all points have one."""
        rows = [self.position(point) for point in element.iterchildren("PNT")]
        return rows if len({len(row) for row in rows}) < 2 else [row[:2] for row in rows]

    def position(self, point: etree._Element) -> list[float]:
        out = [_number(point, "D", 180.0), _number(point, "C", 90.0)]
        return [*out, _number(point, "E", MAX_METRES * 1000) / 1000] if point.get("E") else out


def _number(point: etree._Element, name: str, bound: float) -> float:
    text = point.get(name) or ""
    try:
        value = float(text) if text.isascii() and "_" not in text else math.nan
    except ValueError:
        value = math.nan
    if not abs(value) <= bound:
        reason = f"{name} must be a number within ±{bound:g}, got {text[:40]!r}"
        raise UnreadableFile(f"PNT: {reason}", [Problem(reason, line=point.sourceline, where="PNT")])
    return value


def _closed(ring: Sequence[Sequence[float]]) -> Any:
    return np.array([*ring, ring[0]] if ring[0] != ring[-1] else ring, np.float64)


def _type(element: etree._Element, names: Sequence[str]) -> str:
    text = str(element.get("A") or "")
    number = int(text) if text.isascii() and text.isdigit() and len(text) < 10 else 0
    return names[number - 1] if 0 < number <= len(names) else "other"
