"""Helpers for consumer checks (see ``Format.check``): findings, and numbers as C++ reads them."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable
from typing import Any, TypeGuard

from app.errors import Problem
from app.formats import JUST_WRITTEN
from app.limits import Limits

LIMITS = Limits()
"""Limits for files that a check reads: exported maps, or files of a command-line user."""

MAX_QUICK_BYTES = 2**19
HEAD_BYTES = 2**13
"""Number of bytes that are checked at the start of a larger text that the server has just written."""

MAX_NAMES_SHOWN = 5


def is_brief(data: bytes) -> bool:
    """Whether this text is too large to be parsed again during a request."""
    return len(data) > MAX_QUICK_BYTES and JUST_WRITTEN.get()


def error_finding(
    problem: str, file: str | None = None, *, line: int | None = None, where: str | None = None
) -> Problem:
    """Build a finding of level error: the consumer rejects the map, or misreads it."""
    return Problem(problem, file, line, where, "error")


def warning_finding(
    problem: str, file: str | None = None, *, line: int | None = None, where: str | None = None
) -> Problem:
    """Build a finding of level warning: the consumer loads the map but may not use it as intended."""
    return Problem(problem, file, line, where, "warning")


def names(items: Iterable[object]) -> str:
    """List the first few items and the number of others, for one finding per broken rule."""
    every = [str(item)[:60] for item in items]
    more = f" and {len(every) - MAX_NAMES_SHOWN} more" if len(every) > MAX_NAMES_SHOWN else ""
    return ", ".join(every[:MAX_NAMES_SHOWN]) + more


def shown(value: Any) -> str:
    """Format a value for a finding."""
    text = repr(value)
    return text if len(text) <= 60 else text[:59] + "…"


def is_number(value: Any) -> TypeGuard[float]:
    """Whether a value is a finite JSON or YAML number; a boolean is not."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def numbers(value: Any, minimum: int, maximum: int | None = None) -> bool:
    """Whether a value is a list of that many finite numbers."""
    return isinstance(value, list) and minimum <= len(value) <= (maximum or len(value)) and all(map(is_number, value))


_CPP = re.compile(r"\s*[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?\s*\Z", re.ASCII)
_SPECIAL = {"": 1.0, "+": 1.0, "-": -1.0}


def cpp_number(text: Any) -> float | None:
    """Parse a scalar's text (quoted or not) as yaml-cpp's ``as<double>`` does; None if that throws."""
    if not isinstance(text, str):
        return None
    if _CPP.match(text):
        return float(text)
    special = re.fullmatch(r"([-+]?)\.(inf|Inf|INF|nan|NaN|NAN)", text)
    if special is None:
        return None
    return math.nan if special[2].lower() == "nan" else _SPECIAL[special[1]] * math.inf


_TRUE = frozenset(w for word in ("y", "yes", "true", "on") for w in (word, word.capitalize(), word.upper()))
_FALSE = frozenset(w for word in ("n", "no", "false", "off") for w in (word, word.capitalize(), word.upper()))


def cpp_bool(text: Any) -> bool | None:
    """Parse a scalar's text as yaml-cpp's ``as<bool>`` does; None if that throws."""
    if text in _TRUE or text in _FALSE:
        return text in _TRUE
    return None


MAX_WHOLE_YAML_BYTES = 8 * 2**20
"""Maximum size of a YAML file that a check parses completely, in bytes."""


def mappings(value: Any) -> list[tuple[int, dict[str, Any]]]:
    """Yield the mappings of a list with their index; nothing if the value is not a list."""
    return [(k, v) for k, v in enumerate(value) if isinstance(v, dict)] if isinstance(value, list) else []


def duplicates(items: Iterable[Any]) -> list[Any]:
    """Return each item that occurs more than once, in order."""
    return [item for item, count in Counter(items).items() if count > 1]


def missing(members: Any, keys: Iterable[str]) -> list[str]:
    """Return the keys that a mapping lacks."""
    return [key for key in keys if not isinstance(members, dict) or members.get(key) is None]
