"""Parsing of values in URLs and forms: numbers, positions, boxes, versions, parameters of maps."""

from __future__ import annotations

import math
import re
from urllib.parse import parse_qsl

from app import formats
from app.errors import Invalid, NotFound, Problem
from app.formats import Format
from app.model.closures import CLOSURE_MODES, ClosureMode
from app.store.values import Box

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)


def parse_number(text: str) -> float | None:
    """Parse a finite number; None if it is something else (Python reads `1_0`, too)."""
    number = float(text) if _NUMBER.fullmatch(text) else math.inf
    return number if math.isfinite(number) else None


def parse_numbers(text: str) -> list[float]:
    """Parse finite numbers separated by commas; none if one is something else."""
    values = [parse_number(part.strip(" ")) for part in text.split(",")] if len(text) <= 1000 else []
    return [value for value in values if value is not None] if None not in values else []


def numbers(text: str, parameter: str, names: str) -> tuple[float, ...]:
    """Parse comma-separated numbers. Raises Invalid unless there is one per name in ``names`` (``LAT,LON``)."""
    count = names.count(",") + 1
    values = tuple(parse_numbers(text))
    if len(values) != count or not all(abs(v) <= 1e9 for v in values):
        raise Invalid(
            f"{parameter} must be {names}: {count} comma-separated numbers", [Problem(names, where=parameter)]
        )
    return values


def parse_box(text: str, parameter: str = "bbox") -> Box:
    """Parse west, south, east, north in degrees; west > east crosses the antimeridian. Raises Invalid."""
    west, south, east, north = numbers(text, parameter, "W,S,E,N")
    if not (-180 <= west <= 180 and -180 <= east <= 180 and -90 <= south <= north <= 90):
        raise Invalid(
            f"{parameter} must be west, south, east, north in degrees, with south ≤ north",
            [Problem("must be west, south, east, north", where=parameter)],
        )
    return west, south, east, north


def parse_position(text: str, parameter: str = "contains") -> tuple[float, float]:
    """Parse latitude and longitude in degrees. Raises Invalid."""
    latitude, longitude = numbers(text, parameter, "LAT,LON")
    if not (-90 <= latitude <= 90 and -180 <= longitude <= 180):
        raise Invalid(
            f"{parameter} must be LAT,LON in degrees: the latitude comes first, within ±90",
            [Problem("must be LAT,LON", where=parameter)],
        )
    return latitude, longitude


def require_format(name: str, parameter: str) -> Format:
    """Return a format by id. Raises Invalid with the existing ids for an unknown one."""
    try:
        return formats.get_format(name)
    except NotFound as error:
        raise Invalid(error.detail, [Problem("unknown format", where=parameter)]) from None


def parse_version_ref(ref: str) -> str | int:
    """Parse a version in a URL: a number, or the name of a channel."""
    return int(ref) if ref.isascii() and ref.isdigit() and len(ref) <= 18 else ref


def parse_options(query: str) -> tuple[dict[str, str], bool, ClosureMode | None]:
    """Parse a map's query: options, whether derived information is allowed, and how closures are shown.

    Raises Invalid, also for duplicates.
    """
    try:
        pairs = parse_qsl(query, keep_blank_values=True, max_num_fields=100, errors="strict")
    except ValueError:
        raise Invalid("unreadable query: it must be percent-encoded UTF-8 with at most 100 parameters") from None
    values: dict[str, str] = {}
    for name, value in pairs:
        if name in values:
            raise Invalid(f"duplicate parameter {name[:80]!r}: give it once", [Problem("duplicate", where=name[:80])])
        values[name] = value
    derive = values.pop("derive", "true")
    if derive not in ("true", "false"):
        raise Invalid(
            f"derive must be true or false, got {derive[:80]!r}", [Problem("must be true or false", where="derive")]
        )
    return values, derive == "true", closure_mode(values.pop("closures", None))


def closure_mode(text: str | None) -> ClosureMode | None:
    """Parse the parameter ``closures`` of a map; None for the default of the URL. Raises Invalid."""
    if text is None:
        return None
    for mode in CLOSURE_MODES:
        if mode == text:
            return mode
    accepted = ", ".join(CLOSURE_MODES)
    raise Invalid(f"closures must be one of {accepted}, got {text[:80]!r}", [Problem(accepted, where="closures")])
