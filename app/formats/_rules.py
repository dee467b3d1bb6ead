"""What the checks of the consumers' loader rules share (see ``Format.check``): findings, numbers as C++ reads them."""

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
"""A check reads what is served, or files that the user of a command line has: within the usual bounds."""

MAX_QUICK_BYTES = 2**19
HEAD_BYTES = 2**13
"""Of a larger text that was just written here, only so much of its beginning is looked at."""

MAX_NAMES_SHOWN = 5


def is_brief(data: bytes) -> bool:
    """Whether this text is too large to be read once more while somebody waits for it."""
    return len(data) > MAX_QUICK_BYTES and JUST_WRITTEN.get()


def error_finding(
    problem: str, file: str | None = None, *, line: int | None = None, where: str | None = None
) -> Problem:
    """A finding: the consumer does not load the map, or takes it for another one."""
    return Problem(problem, file, line, where, "error")


def warning_finding(
    problem: str, file: str | None = None, *, line: int | None = None, where: str | None = None
) -> Problem:
    """A finding: the consumer loads the map, and may not do with it what its maker meant."""
    return Problem(problem, file, line, where, "warning")


def names(items: Iterable[object]) -> str:
    """The first few, and how many more there are: one finding for all that break one rule."""
    every = [str(item)[:60] for item in items]
    more = f" and {len(every) - MAX_NAMES_SHOWN} more" if len(every) > MAX_NAMES_SHOWN else ""
    return ", ".join(every[:MAX_NAMES_SHOWN]) + more


def shown(value: Any) -> str:
    """A value in a finding."""
    text = repr(value)
    return text if len(text) <= 60 else text[:59] + "…"


def is_number(value: Any) -> TypeGuard[float]:
    """A finite JSON or YAML number; a truth value is none."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def numbers(value: Any, minimum: int, maximum: int | None = None) -> bool:
    """A list of that many finite numbers."""
    return isinstance(value, list) and minimum <= len(value) <= (maximum or len(value)) and all(map(is_number, value))


_CPP = re.compile(r"\s*[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?\s*\Z", re.ASCII)
_SPECIAL = {"": 1.0, "+": 1.0, "-": -1.0}


def cpp_number(text: Any) -> float | None:
    """The number that yaml-cpp's ``as<double>`` makes of a scalar's text (quoted or not); None where it throws."""
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
    """The truth value that yaml-cpp's ``as<bool>`` makes of a scalar's text; None where it throws."""
    if text in _TRUE or text in _FALSE:
        return text in _TRUE
    return None


MAX_WHOLE_YAML_BYTES = 8 * 2**20
"""Bytes of YAML up to which a check reads a file as a whole."""


def mappings(value: Any) -> list[tuple[int, dict[str, Any]]]:
    """The mappings of a list, with their places; of anything else nothing."""
    return [(k, v) for k, v in enumerate(value) if isinstance(v, dict)] if isinstance(value, list) else []


def duplicates(items: Iterable[Any]) -> list[Any]:
    """Each item that occurs more than once, in order."""
    return [item for item, count in Counter(items).items() if count > 1]


def missing(members: Any, keys: Iterable[str]) -> list[str]:
    """Which of the keys a mapping lacks."""
    return [key for key in keys if not isinstance(members, dict) or members.get(key) is None]
