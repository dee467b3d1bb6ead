"""YAML texts that readers of YAML 1.1 (PyYAML) and 1.2 (yaml-cpp) take for the same value."""

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
    """A scalar as YAML, on one line. Texts are quoted wherever some reader could take them for something else."""
    if isinstance(value, str):
        # What most names look like: no word that means something else ends with a digit.
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
    """A float's shortest text as YAML 1.1 wants it: PyYAML takes ``1e-09`` for a text, ``1.0e-09`` for the number."""
    return literal.replace("e", ".0e") if "e" in literal and "." not in literal else literal


def block(value: Any, column: int) -> str:
    """What stands behind the colon of a key in this column, with the line break at the end; mappings by sorted keys."""
    if isinstance(value, dict) and value:
        return "\n" + mapping(value, column + 2)
    if isinstance(value, (list, tuple)) and value:
        return "\n" + "".join(_item(v, column) for v in value)
    return " {}\n" if isinstance(value, dict) else " []\n" if isinstance(value, (list, tuple)) else f" {text(value)}\n"


def mapping(value: dict[str, Any], column: int) -> str:
    """A mapping that is not empty, its keys sorted and in this column, with the line break at the end."""
    pad = " " * column
    out = []
    for key in sorted(value):
        name = text(key)
        if len(name) > MAX_KEY_CHARACTERS:  # beyond 1024 characters a key must be marked as one
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
