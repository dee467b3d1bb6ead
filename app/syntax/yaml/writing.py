"""Write YAML with the same value for readers of YAML 1.1 (PyYAML) and 1.2 (yaml-cpp)."""

from __future__ import annotations

import re
from typing import Any

from app.syntax.yaml.scalars import CONSTANTS, WIDE

_QUOTABLE = re.compile(rf"[ -~{WIDE}]*\Z")


_BARE = re.compile(r"[A-Za-z_$/][\w$/.+|()-]*(?: [\w$/.+|()][\w$/.+|()-]*)*\Z", re.ASCII)
_JOINTS = str.maketrans(":-.", "___")

_RESERVED = frozenset(word.lower() for word in CONSTANTS) | {"y", "n", "nan", "inf", "infinity"}
_ESCAPES = {"\\": "\\\\", '"': '\\"', "\n": "\\n", "\t": "\\t", "\r": "\\r", "\0": "\\0"}
MAX_KEY_CHARACTERS = 200


def text(value: str | float | None) -> str:
    """Format a scalar as YAML on one line. Quotes strings that some reader could resolve to another type."""
    if isinstance(value, str):
        # Most names end with a digit; no word with a special meaning does.
        if value.isascii() and value[-1:].isdigit():
            if value.isidentifier():
                return value
            if value[0] not in "-." and value.translate(_JOINTS).isidentifier():
                return f"'{value}'"
        if _BARE.match(value) and value.lower() not in _RESERVED:
            return value
        if _QUOTABLE.match(value):
            return "'" + value.replace("'", "''") + "'"
        return '"' + "".join(_escape(c) for c in value) + '"'
    if isinstance(value, float):
        return decimal(repr(value))
    return "null" if value is None else str(value).lower()


def decimal(literal: str) -> str:
    """Convert a float's shortest text to YAML 1.1: ``1e-09`` is a string for PyYAML, ``1.0e-09`` a number."""
    return literal.replace("e", ".0e") if "e" in literal and "." not in literal else literal


def block(value: Any, column: int) -> str:
    """Format the text after the colon of a key in this column, with the final line break; mappings by sorted keys."""
    if isinstance(value, dict) and value:
        return "\n" + mapping(value, column + 2)
    if isinstance(value, (list, tuple)) and value:
        return "\n" + "".join(_item(v, column) for v in value)
    return " {}\n" if isinstance(value, dict) else " []\n" if isinstance(value, (list, tuple)) else f" {text(value)}\n"


def mapping(value: dict[str, Any], column: int) -> str:
    """Format a non-empty mapping with sorted keys in this column, with the final line break."""
    pad = " " * column
    out = []
    for key in sorted(value):
        name = text(key)
        if len(name) > MAX_KEY_CHARACTERS:  # a key of more than 1024 characters needs an explicit mark
            out.append(f"{pad}? {name}\n{pad}:{block(value[key], column + 2)}")
        else:
            out.append(f"{pad}{name}:{block(value[key], column)}")
    return "".join(out)


def _item(value: Any, column: int) -> str:
    pad = " " * column
    if isinstance(value, dict) and value:
        return f"{pad}- {mapping(value, column + 2)[column + 2 :]}"
    return f"{pad}-{block(value, column + 2)}"


def _escape(character: str) -> str:
    if character in _ESCAPES:
        return _ESCAPES[character]
    code = ord(character)
    if _QUOTABLE.match(character):
        return character
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"
