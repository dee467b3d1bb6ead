"""What plain scalars mean, and what the two ways of reading share."""

from __future__ import annotations

import math
import re
from typing import Any, NamedTuple

from app.errors import Problem, TooLarge, UnreadableFile

TAG = "tag:yaml.org,2002:"
CONSTANTS: dict[str, Any] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL")),
    **{text: True for word in ("yes", "true", "on") for text in (word, word.capitalize(), word.upper())},
    **{text: False for word in ("no", "false", "off") for text in (word, word.capitalize(), word.upper())},
}
"""Plain scalars that are no text (PyYAML's resolver for YAML 1.1)."""

INTEGER = re.compile(r"[-+]?(?:0|[1-9][0-9]*)\Z")
HEXADECIMAL = re.compile(r"[-+]?0x[0-9a-fA-F]+\Z")
FLOAT = re.compile(r"[-+]?(?:(?:[0-9]+\.[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?|[0-9]+[eE][-+][0-9]+)\Z")
NOT_FINITE = re.compile(r"[-+]?\.(?:inf|Inf|INF|nan|NaN|NAN)\Z")

WIDE = r"\u00a0-\u1fff\u2030-\ud7ff\ue000-\ufefe\uff00-\ufffd\U00010000-\U0010ffff"
"""Characters beyond ASCII that libyaml takes for themselves anywhere: no further line breaks, no byte order mark."""

INT64 = range(-(2**63), 2**63)
MAX_NUMBER_CHARACTERS = 400
"""Characters; the longest float64 written out in full has fewer than 350."""

UNFOLD_FREE, UNFOLD_TIMES = 16 * 2**20, 4
"""Aliases may add this many characters, and this many times the file's size."""


class Tagged(NamedTuple):
    """A mapping or list that carries a tag of the format's own; the tag is written out in full."""

    tag: str
    value: Any


class PlainScalar(str):
    """A scalar without quotes as its text, for formats whose readers take it for one (``no``, ``010``); ``scalar`` says
    what else it may mean."""

    __slots__ = ()


def scalar(text: str) -> Any:
    """What a plain (unquoted) scalar means. ValueError where it is a number that cannot be stored."""
    if text in CONSTANTS:
        return CONSTANTS[text]
    if text[0] not in "-+.0123456789":
        return text
    if len(text) > MAX_NUMBER_CHARACTERS:
        if INTEGER.match(text) or HEXADECIMAL.match(text) or FLOAT.match(text):
            raise ValueError(f"a number of {len(text)} characters")
        return text
    if INTEGER.match(text):
        return _int64(int(text))
    if FLOAT.match(text):
        return _finite(float(text))
    if HEXADECIMAL.match(text):
        return _int64(int(text, 16))
    if NOT_FINITE.match(text):
        raise ValueError(f"{text} is not a finite number")
    return text


def _int64(value: int) -> int:
    if value not in INT64:
        raise ValueError(f"the integer {str(value)[:40]} is beyond 64 bit")
    return value


def _finite(value: float) -> float:
    if not math.isfinite(value):
        raise ValueError("a number beyond the range of a float")
    return value


def yaml_error(
    reason: str, line: int | None, error: type[UnreadableFile] | type[TooLarge] = UnreadableFile
) -> Exception:
    """The error to raise. line: from 0, as YAML marks count."""
    at = None if line is None else line + 1
    return error(reason if at is None else f"line {at}: {reason}", [Problem(reason, line=at)])
