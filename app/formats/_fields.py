"""Declared shapes of the values in YAML and JSON files, checked in one walk per file.

A shape is ``ANY``, a rule for a value, a list with the shape of each item, or a ``Record``: keys with their shapes.
Values out of range are rejected with their location. Unknown keys and doubtful values are warned about: one warning
per kind. Absent keys and nulls are left to the reader.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from app.errors import Problem, UnreadableFile
from app.formats import ReadContext
from app.model.frame import MAX_METRES
from app.syntax import yaml

MAX_FINDINGS = 1000
MAX_NAMES_SHOWN = 6
"""Maximum number of names in one warning."""

ANY: Final = None
"""Shape of unchecked values."""


@dataclass(frozen=True, slots=True)
class Number:
    """Rule for a finite number from ``low`` to ``high``, possibly in quotes; doubtful outside of ``usual``.

    above: the number must be larger than ``low``. hint: likely explanation of a doubtful number. or_other: values of
    other types are not checked. doubtful: report errors as doubts (for keys that users may have given another meaning).
    """

    low: float = -MAX_METRES
    high: float = MAX_METRES
    above: bool = False
    usual: tuple[float, float] | None = None
    hint: str = ""
    unit: str = ""
    or_other: bool = False
    doubtful: bool = False

    def check(self, value: Any) -> tuple[str, str]:
        """Return (error, doubt); empty texts if there is none."""
        refusal, doubt = self._check(value)
        return ("", refusal or doubt) if self.doubtful else (refusal, doubt)

    def _check(self, value: Any) -> tuple[str, str]:
        number = _number(value)
        unit = f" {self.unit}" if self.unit else ""
        if number is None and self.or_other:
            return "", ""
        if number is None:
            return f"must be a number{unit and ' of' + unit}, got {_shorten(value)}", ""
        if not self.low <= number <= self.high or (self.above and number == self.low):
            bounds = f"above {self.low:g} and at most" if self.above else f"from {self.low:g} to"
            return f"must be {bounds} {self.high:g}{unit}, got {_shorten(value)}", ""
        if self.usual and not self.usual[0] <= number <= self.usual[1]:
            return "", f"{_shorten(value)}{unit} is unusual: {self.hint}"
        return "", ""


@dataclass(frozen=True, slots=True)
class OneOf:
    """Rule for one of a closed set of texts or booleans; others are doubtful."""

    allowed: tuple[Any, ...]

    def check(self, value: Any) -> tuple[str, str]:
        """Return (error, doubt); the error is always empty."""
        if any(value == literal and type(value) is type(literal) for literal in self.allowed):
            return "", ""
        return "", f"unknown value {_shorten(value)}: must be one of {', '.join(map(str, self.allowed))}"


@dataclass(frozen=True, slots=True)
class Text:
    """Rule for a text that is not code: words combined with and, or, not, and comparisons."""

    def check(self, value: Any) -> tuple[str, str]:
        """Return (error, doubt); the error is always empty."""
        if not isinstance(value, str) or (_CONDITION.fullmatch(value) and not _CALL.search(value)):
            return "", ""
        return "", f"{_shorten(value)} is not a simple condition; a planner that evaluates it would run it as code"


_CONDITION = re.compile(r"[\w\s&|~!()=<>'\",.:/+*-]*")
_CALL = re.compile(r"(?!\b(?:and|or|not|in)\s*\()[\w\])'\"]\s*\(|__|\blambda\b|\bimport\b|\*\*")


@dataclass(frozen=True, slots=True)
class Quaternion:
    """Rule for a mapping x, y, z, w of length 1; other lengths are doubtful (old files leave all at 0)."""

    def check(self, value: Any) -> tuple[str, str]:
        """Return (error, doubt); empty texts if there is none."""
        parts = [_number(value.get(axis, 0.0)) for axis in "xyzw"] if isinstance(value, dict) else [None]
        numbers = [part for part in parts if part is not None]
        if len(numbers) < 4:
            return f"must be a mapping of numbers x, y, z, w, got {_shorten(value)}", ""
        length = math.hypot(*numbers)
        return "", "" if abs(length - 1.0) < 0.01 else f"quaternion of length {length:g}: must be 1"


@dataclass(frozen=True, slots=True)
class Typed:
    """Open-RMF parameter: [type, value], with the shape of the value."""

    shape: Any


@dataclass(frozen=True)
class Record:
    """Mapping with a shape for each key.

    each: shape of unlisted keys, if users may choose names; otherwise unlisted keys are unknown. open: unlisted keys
    may have any value. loose: values of other types are accepted instead of a mapping.
    """

    keys: Mapping[str, Any]
    each: Any = ANY
    open: bool = False
    loose: bool = False
    names: frozenset[str] = field(init=False)
    rules: tuple[tuple[str, Any], ...] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", frozenset(self.keys))
        object.__setattr__(self, "rules", tuple((k, s) for k, s in self.keys.items() if s is not ANY))


def record(names: str = "", each: Any = ANY, *, is_open: bool = False, is_loose: bool = False, **keys: Any) -> Record:
    """Build a mapping's shape. names: keys with unchecked values, separated by spaces."""
    return Record({**dict.fromkeys(names.split()), **keys}, each, is_open, is_loose)


LATITUDE = Number(-90.0, 90.0, unit="degrees")
LONGITUDE = Number(-180.0, 180.0, unit="degrees")
COORDINATE = Number(unit="metres")
LENGTH = Number(0.0, MAX_METRES, above=True, unit="metres")
WIDTH = Number(0.0, MAX_METRES, usual=(1e-6, MAX_METRES), hint="should be above 0", unit="metres")
NOT_NEGATIVE = Number(0.0, MAX_METRES)
SPEED = Number(0.0, 1000.0, usual=(0.0, 50.0), hint="is it in metres per second?", unit="m/s")
MAX_USUAL_ANGLE = 6.3
"""Largest usual angle, in radians: a full turn. Larger values may be degrees."""

ANGLE = Number(-1e4, 1e4, usual=(-MAX_USUAL_ANGLE, MAX_USUAL_ANGLE), hint="is it in radians?", unit="rad")
POINT = record(x=COORDINATE, y=COORDINATE, z=COORDINATE)

Path = tuple[Any, ...]
"""Keys and indexes from the inside out: (key, (key of the parent, …))."""


def check(value: Any, shape: Any, context: ReadContext, file: str | None = None) -> None:
    """Check a file's value against its shape. file: default: the main file.

    Raises UnreadableFile for the first value that is out of range.
    """
    findings = _Findings(file)
    _walk(value, shape, (), findings)
    findings.report(context)


class _Findings:
    """Findings of a walk: locations by reason."""

    def __init__(self, file: str | None) -> None:
        self.file = file
        self.unknown: dict[str, int] = {}
        self.doubts: dict[tuple[str, str], list[Any]] = {}

    def add_unknown(self, path: Path, keys: frozenset[str]) -> None:
        for key in sorted(keys):
            name = _pattern((key, path))[:120]
            if name in self.unknown or len(self.unknown) < MAX_FINDINGS:
                self.unknown[name] = self.unknown.get(name, 0) + 1

    def add_doubt(self, path: Path, reason: str) -> None:
        key = _pattern(path), re.sub(r"^(unknown value )?('[^']*'|\S+)", "", reason)
        if key in self.doubts:
            self.doubts[key][0] += 1
        elif len(self.doubts) < MAX_FINDINGS:
            self.doubts[key] = [1, _path_text(path), reason]

    def report(self, context: ReadContext) -> None:
        if self.unknown:
            names = [
                name if n == 1 else f"{name} ({n} times)" for name, n in list(self.unknown.items())[:MAX_NAMES_SHOWN]
            ]
            more = len(self.unknown) - MAX_NAMES_SHOWN
            names += [f"and {more} more"] if more > 0 else []
            context.warn(f"unknown keys, kept without effect: {', '.join(names)}", file=self.file)
        for count, location, reason in self.doubts.values():
            context.warn(reason if count == 1 else f"{reason} ({count} times)", file=self.file, where=location)


def _walk(value: Any, shape: Any, path: Path, findings: _Findings) -> None:
    if shape is ANY or value is None:
        return
    if isinstance(value, yaml.Tagged):
        value = value.value
    kind = type(shape)
    if kind is Record:
        if not isinstance(value, dict):
            if shape.loose:
                return
            findings.add_doubt(path, f"{_shorten(value)} is not a mapping")
            return
        if not (shape.open or shape.each is not ANY) and not value.keys() <= shape.names:
            findings.add_unknown(path, frozenset(value.keys() - shape.names))
        for key, rule in shape.rules:
            if (inner := value.get(key)) is not None:
                _walk(inner, rule, (key, path), findings)
        if shape.each is not ANY:
            for key in value.keys() - shape.names:
                _walk(value[key], shape.each, (key, path), findings)
    elif kind is list:
        if not isinstance(value, list):
            findings.add_doubt(path, f"{_shorten(value)} is not a list")
            return
        for k, item in enumerate(value):
            _walk(item, shape[0], (k, path), findings)
    elif kind is tuple:  # one shape per item
        for k, (item, rule) in enumerate(zip(value, shape, strict=False) if isinstance(value, list) else ()):
            _walk(item, rule, (k, path), findings)
    elif kind is Typed:
        _walk(value[1] if isinstance(value, list) and len(value) == 2 else value, shape.shape, path, findings)
    else:
        refusal, doubt = shape.check(value)
        if refusal:
            location = _path_text(path)
            raise UnreadableFile(f"{location}: {refusal}", [Problem(refusal, findings.file, where=location)])
        if doubt:
            findings.add_doubt(path, doubt)


def _number(value: Any) -> float | None:
    if isinstance(value, str):
        try:
            value = yaml.scalar(str.__str__(value).strip() or "~")
        except ValueError:
            return None
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    number = float(value)
    return number if math.isfinite(number) else None


def _shorten(value: Any) -> str:
    text = (
        repr(value) if not isinstance(value, (dict, list)) else f"a {'mapping' if isinstance(value, dict) else 'list'}"
    )
    return text if len(text) <= 60 else f"{text[:59]}…"


def _steps(path: Path) -> Iterator[Any]:
    while path:
        key, path = path
        yield key


def _path_text(path: Path) -> str:
    steps = [f"[{s}]" if isinstance(s, int) else f".{s[:80]}" for s in reversed(list(_steps(path)))]
    return "".join(steps).removeprefix(".") or "top"


def _pattern(path: Path) -> str:
    steps = ["[]" if isinstance(s, int) else f".{s[:80]}" for s in reversed(list(_steps(path)))]
    return "".join(steps).removeprefix(".") or "top"
