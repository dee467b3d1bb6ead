"""Parameters of ``items``: parsed strictly, and applied to a table."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
import shapely
from numpy.typing import NDArray

from app.api.http.parameters import parse_number, parse_numbers
from app.errors import Invalid, Problem
from app.model.names import did_you_mean
from app.ogc.crs import CRS84, ReferenceSystem, parse_crs
from app.ogc.description import DEFAULT_LIMIT, MAX_LIMIT
from app.ogc.tables import Table
from app.ogc.vector import RESERVED, queryables
from app.store.values import Box

MAX_FILTERS = 20
FILTERS_OF_PART_3 = frozenset({"filter", "filter-lang", "filter-crs"})
_TIME = re.compile(r"\d{4}-\d{2}-\d{2}(?:[Tt]\d{2}:\d{2}:\d{2}(?:\.\d{1,9})?(?:[Zz]|[+-]\d{2}:\d{2}))?", re.ASCII)

Rows = NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class ItemQuery:
    """Parsed parameters. crs: None if the request has none. heights: lowest and highest z of the box."""

    limit: int = DEFAULT_LIMIT
    cursor: str | None = None
    box: Box | None = None
    heights: tuple[float, float] | None = None
    box_crs: ReferenceSystem | None = None
    crs: ReferenceSystem | None = None
    filters: tuple[tuple[str, str], ...] = ()

    @property
    def is_plain(self) -> bool:
        """Return whether the page is a slice of the collection in CRS84, of no more than the default size."""
        unconverted = self.crs is None or self.crs.kind == "crs84"
        return self.box is None and not self.filters and unconverted and self.limit <= DEFAULT_LIMIT


def invalid(parameter: str, reason: str, detail: str | None = None) -> Invalid:
    """Build the error for a parameter."""
    return Invalid(detail or f"{parameter} {reason}", [Problem(reason, where=parameter)])


def parse_items_query(
    pairs: Sequence[tuple[str, str]], table: Table, systems: Mapping[str, ReferenceSystem]
) -> ItemQuery:
    """Parse the parameters of ``items``. Raises Invalid, which names the parameter."""
    values: dict[str, str] = {}
    filters = []
    properties = queryables(table)
    for name, value in pairs:
        if name in values:
            raise invalid(name[:80], "is given twice", f"duplicate parameter {name[:80]!r}: give it once")
        values[name] = value
        if name in FILTERS_OF_PART_3:
            raise invalid(name, "is not supported: filter by the properties that /queryables lists")
        if name in RESERVED:
            continue
        if name not in properties:
            accepted = sorted((RESERVED - FILTERS_OF_PART_3) | properties.keys())
            near = did_you_mean(name, accepted)
            raise invalid(
                name[:80],
                "is unknown",
                f"unknown query parameter {name[:80]!r}{near}; accepted: {', '.join(accepted)[:2000]}",
            )
        _check_filter(name, value, properties[name])
        filters.append((name, value))
    if len(filters) > MAX_FILTERS:
        raise invalid(filters[MAX_FILTERS][0][:80], f"is too much: at most {MAX_FILTERS} properties filter")
    box_crs = parse_crs(values["bbox-crs"], systems, "bbox-crs") if "bbox-crs" in values else systems[CRS84]
    if "bbox-crs" in values and "bbox" not in values:
        raise invalid("bbox-crs", "needs bbox: give both or none")
    box, heights = parse_bbox(values["bbox"], box_crs) if "bbox" in values else (None, None)
    if "datetime" in values:
        check_datetime(values["datetime"])
    crs = parse_crs(values["crs"], systems, "crs") if "crs" in values else None
    limit = parse_limit(values["limit"]) if "limit" in values else DEFAULT_LIMIT
    return ItemQuery(limit, values.get("cursor"), box, heights, box_crs, crs, tuple(filters))


def parse_limit(text: str) -> int:
    """Parse ``limit``; larger values become MAX_LIMIT, as the standard demands. Raises Invalid."""
    digits = text.lstrip("0")
    if not (text.isascii() and text.isdigit() and digits):
        raise invalid("limit", f"must be a whole number of at least 1; values above {MAX_LIMIT} count as {MAX_LIMIT}")
    return MAX_LIMIT if len(digits) > len(str(MAX_LIMIT)) else min(int(digits), MAX_LIMIT)


def parse_bbox(text: str, crs: ReferenceSystem) -> tuple[Box, tuple[float, float] | None]:
    """Parse a box of 4 numbers, or 6 with heights, in the axis order of its CRS. Raises Invalid."""
    numbers = parse_numbers(text)
    if len(numbers) not in (4, 6):
        raise invalid("bbox", "must be 4 or 6 finite numbers, separated by commas")
    half = len(numbers) // 2
    x0, y0, x1, y1 = numbers[0], numbers[1], numbers[half], numbers[half + 1]
    first, second = ("latitude", "longitude") if crs.swap else ("x", "y")
    if crs.is_geographic:
        first, second = ("latitude", "longitude") if crs.swap else ("longitude", "latitude")
        south, north, west, east = (x0, x1, y0, y1) if crs.swap else (y0, y1, x0, x1)
        if not -90.0 <= south <= north <= 90.0:
            raise invalid("bbox", "must have latitudes within ±90 degrees, the lower one first")
        if not (-180.0 <= west <= 180.0 and -180.0 <= east <= 180.0):
            raise invalid("bbox", "must have longitudes within ±180 degrees; west > east crosses the antimeridian")
    elif x0 > x1 or y0 > y1 or max(map(abs, (x0, y0, x1, y1))) > 1e9:
        raise invalid("bbox", f"must have the lower {first} and the lower {second} first, within ±1e9")
    heights = (numbers[2], numbers[5]) if half == 3 else None
    if heights is not None and heights[0] > heights[1]:
        raise invalid("bbox", "must have the lower height first")
    return (x0, y0, x1, y1), heights


def check_datetime(text: str) -> None:
    """Check a time or interval of RFC 3339. Features have no times, so that all match. Raises Invalid."""
    ends = text.split("/")
    instants = [None if end in ("", "..") and len(ends) == 2 else _parse_time(end) for end in ends[:3]]
    if len(ends) > 2 or instants == [None, None]:
        raise invalid("datetime", "must be a time, or an interval START/END with at most one end open as ..")
    if len(instants) == 2 and instants[0] is not None and instants[1] is not None and instants[0] > instants[1]:
        raise invalid("datetime", "must have the earlier time first")


def _parse_time(text: str) -> datetime:
    if not _TIME.fullmatch(text):
        raise invalid("datetime", "must be in RFC 3339, such as 2026-01-31T12:00:00Z, or an interval of such times")
    normal = re.sub(r":60(?=[.Z+-])", ":59", text.upper())  # a leap second
    try:
        parsed = datetime.fromisoformat(normal)
    except ValueError:
        raise invalid("datetime", "must be an existing day and time") from None
    return parsed if parsed.tzinfo else parsed.replace(tzinfo=UTC)


def _check_filter(name: str, value: str, types: frozenset[str]) -> None:
    """Raise Invalid if no value of a property can equal the text."""
    if "string" not in types and not _readings(value, types):
        accepted = " or ".join(sorted(types))
        raise invalid(name, f"must be of type {accepted}", f"{name} must be of type {accepted}, got {value[:80]!r}")


def _readings(text: str, types: frozenset[str]) -> list[object]:
    """Return the values of a property that equal a text."""
    out: list[object] = [text] if "string" in types else []
    if "boolean" in types and text in ("true", "false"):
        out.append(text == "true")
    if types & {"number", "integer"}:
        number = parse_number(text)
        out += [] if number is None else [number]
    return out


# --- selection ---


def select_rows(table: Table, query: ItemQuery) -> Rows:
    """Return the rows that match a query, in their order."""
    rows = np.arange(len(table))
    if query.box is not None:
        assert query.box_crs is not None
        rows = _in_box(table, query.box, query.box_crs)
    if query.heights is not None:
        low, high = query.heights
        z = table.heights[rows]
        rows = rows[np.isnan(z[:, 0]) | ((z[:, 0] <= high) & (z[:, 1] >= low))]
    types = queryables(table) if query.filters else {}
    for name, text in query.filters:
        rows = _with_value(table, rows, name, _readings(text, types[name]))
    return rows


def _in_box(table: Table, box: Box, crs: ReferenceSystem) -> Rows:
    """Return the rows whose geometry intersects a box: by their boxes, then those that cross its edge exactly."""
    degrees = crs.box_in_wgs84(box, table.datum, "bbox")
    hits = np.zeros(len(table), bool)
    inside = np.zeros(len(table), bool)
    west, south, east, north = table.boxes.T
    for x0, y0, x1, y1 in degrees:
        hits |= (west <= x1) & (east >= x0) & (south <= y1) & (north >= y0)
        if crs.is_geographic:
            inside |= (west >= x0) & (east <= x1) & (south >= y0) & (north <= y1)
    rows = np.flatnonzero(hits & ~inside)
    if len(rows):
        geometry = table.in_wgs84(rows) if crs.is_geographic else table.in_crs(rows, crs)
        exact = np.zeros(len(rows), bool)
        for shape in (shapely.box(*one) for one in (degrees if crs.is_geographic else [box])):
            shapely.prepare(shape)
            exact |= shapely.intersects(shape, geometry)
        hits[rows] = exact
    return np.flatnonzero(hits)


def _with_value(table: Table, rows: Rows, name: str, values: Sequence[object]) -> Rows:
    """Return the rows whose property has one of these values. Booleans and numbers are never equal."""
    chosen = []
    for row in table.with_property(rows.tolist(), name, values):
        value = table.properties(row).get(name)
        if any(value == one and isinstance(value, bool) == isinstance(one, bool) for one in values):
            chosen.append(row)
    return np.array(chosen, np.intp)
