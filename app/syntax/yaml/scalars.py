"""Resolution of plain scalars, and code shared by the two parsers."""

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
"""Values of plain scalars that are no strings (PyYAML's resolver for YAML 1.1)."""

INTEGER = re.compile(r"[-+]?(?:0|[1-9][0-9]*)\Z")
HEXADECIMAL = re.compile(r"[-+]?0x[0-9a-fA-F]+\Z")
FLOAT = re.compile(r"[-+]?(?:(?:[0-9]+\.[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?|[0-9]+[eE][-+][0-9]+)\Z")
NOT_FINITE = re.compile(r"[-+]?\.(?:inf|Inf|INF|nan|NaN|NAN)\Z")

WIDE = r"\u00a0-\u1fff\u2030-\ud7ff\ue000-\ufefe\uff00-\ufffd\U00010000-\U0010ffff"
"""Non-ASCII characters without a special meaning in libyaml: no line breaks, no byte order mark."""

INT64 = range(-(2**63), 2**63)
MAX_NUMBER_CHARACTERS = 400
"""Maximum length of a number, in characters: the longest float64 written in full has fewer than 350."""

UNFOLD_FREE, UNFOLD_TIMES = 16 * 2**20, 4
"""Size that aliases may add: this number of characters, plus this multiple of the file's size."""


class Tagged(NamedTuple):
    """Mapping or list with a tag of the format's own; the tag is unabbreviated."""

    tag: str
    value: Any


class PlainScalar(str):
    """Text of an unquoted scalar, for formats whose readers use it as a string (``no``, ``010``).

    ``scalar`` resolves it.
    """

    __slots__ = ()


def scalar(text: str) -> Any:
    """Resolve a plain (unquoted) scalar. Raises ValueError for a number that cannot be stored."""
    if text in CONSTANTS:
        return CONSTANTS[text]
    if text[0] not in "-+.0123456789":
        return text
    if len(text) > MAX_NUMBER_CHARACTERS:
        if INTEGER.match(text) or HEXADECIMAL.match(text) or FLOAT.match(text):
            raise ValueError(f"number too long: {len(text)} characters, the limit is {MAX_NUMBER_CHARACTERS}")
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
        raise ValueError(f"the integer {str(value)[:40]} exceeds 64 bits")
    return value


def _finite(value: float) -> float:
    if not math.isfinite(value):
        raise ValueError("the number exceeds the range of a float")
    return value


def yaml_error(
    reason: str, line: int | None, error: type[UnreadableFile] | type[TooLarge] = UnreadableFile
) -> Exception:
    """Build the error to raise. line: from 0, as in YAML marks."""
    at = None if line is None else line + 1
    return error(reason if at is None else f"line {at}: {reason}", [Problem(reason, line=at)])
