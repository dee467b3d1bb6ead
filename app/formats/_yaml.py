"""YAML as plain JSON-like values, read safely: the only way in which formats read YAML.

``load`` gives None, bool, int (64 bit), finite float, text, list and dict with text keys, and nothing else. What a
plain scalar means follows PyYAML (YAML 1.1), which the robots' own tools use, without its traps:

* dates and times, sexagesimals (``12:30``), numbers with a leading zero (``010``), with underscores (``1_2``) and
  binary ones stay the texts they are; so a node called ``1_2`` is not 12, and ``last_updated`` never becomes a date
* ``1e-05`` is a float although PyYAML takes it for a text (Python and C++ print floats so); ``7e12`` is a text
* keys are the texts as written: ``0``, ``yes`` and ``2022`` are the keys "0", "yes" and "2022"

Refused, each with its line: NaN and infinities, integers beyond 64 bit, duplicate keys, ``<<``, tags other than
YAML's own scalars and collections, ``%TAG``, a second document, nesting deeper than ``Limits.yaml_depth``, more than
``Limits.yaml_nodes`` nodes, aliases that unfold to much more than the file, aliases to a collection that contains them.
"""

from __future__ import annotations

import math
import re
from typing import Any

import yaml

from app.errors import Problem, TooLarge, UnreadableFile
from app.formats import Limits

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

INT64 = range(-(2**63), 2**63)
LONGEST_NUMBER = 400
"""Characters; the longest float64 written out in full has fewer than 350."""

UNFOLD_FREE, UNFOLD_TIMES = 16 * 2**20, 4
"""Aliases may add this many characters, and this many times the file's size."""


def load(data: bytes, limits: Limits) -> Any:
    """The one document of a UTF-8 YAML file as JSON-like values; an empty file is None.

    Values behind aliases are shared objects: do not change them in place. Raises UnreadableFile or TooLarge, with line.
    """
    if len(data) > limits.text_bytes:
        raise TooLarge(f"the file has {len(data)} bytes of YAML; the limit is {limits.text_bytes}")
    return _load_events(data, limits)


def scalar(text: str) -> Any:
    """What a plain (unquoted) scalar means. ValueError where it is a number that cannot be stored."""
    if text in CONSTANTS:
        return CONSTANTS[text]
    if text[0] not in "-+.0123456789":
        return text
    if len(text) > LONGEST_NUMBER:
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


def _refuse(reason: str, line: int | None, error: type[UnreadableFile] | type[TooLarge] = UnreadableFile) -> Exception:
    """The error to raise. line: from 0, as YAML marks count."""
    at = None if line is None else line + 1
    return error(reason if at is None else f"line {at}: {reason}", [Problem(reason, line=at)])


def _tagged(tag: str, text: str) -> Any:
    """The value of a scalar with an explicit tag."""
    if tag in (TAG + "str", "!"):
        return text
    value = scalar(text)
    kind: dict[str, Any] = {"int": int, "float": (int, float), "bool": bool, "null": type(None)}
    wanted = kind.get(tag.removeprefix(TAG)) if tag.startswith(TAG) else None
    if wanted is None:
        raise ValueError(f"the tag {tag[:80]} is not supported")
    if not isinstance(value, wanted) or (isinstance(value, bool) and wanted is not bool):
        raise ValueError(f"{text[:80]!r} does not fit its tag {tag}")
    return float(value) if tag == TAG + "float" else value


def _load_events(data: bytes, limits: Limits) -> Any:
    """The reference: builds the value from libyaml's event stream, without recursion."""
    text = _text(data)
    loader: Any = yaml.CSafeLoader(text)
    event: Any = None
    budget = UNFOLD_FREE + UNFOLD_TIMES * len(data)
    root: list[Any] = []
    # Open collections, outermost first: [value, pending key, is a mapping, weight, anchor].
    stack: list[list[Any]] = [[root, None, False, 0, None]]
    anchors: dict[str, tuple[Any, int] | None] = {}
    nodes = documents = 0
    try:
        while True:
            event = loader.get_event()
            kind = type(event)
            weight = 0
            anchor: str | None = None
            if kind is yaml.ScalarEvent:
                nodes += 1
                anchor = event.anchor
                said: str = event.value
                top = stack[-1]
                as_key = top[2] and top[1] is None
                plain = event.implicit[0]
                if as_key and (event.tag is None or event.tag == "!"):
                    if plain and said == "<<":
                        raise ValueError("merge keys (<<) are not supported; write the keys out")
                    value: Any = said
                elif event.tag is not None:
                    value = _tagged(event.tag, said)
                else:
                    value = scalar(said) if plain else said
                weight = 8 + len(said)
            elif kind is yaml.MappingStartEvent or kind is yaml.SequenceStartEvent:
                nodes += 1
                mapping = kind is yaml.MappingStartEvent
                if event.tag not in (None, "!", TAG + ("map" if mapping else "seq")):
                    raise ValueError(f"the tag {event.tag[:80]} is not supported")
                if stack[-1][2] and stack[-1][1] is None:
                    raise ValueError("a key must be a text, not a collection")
                if len(stack) > limits.yaml_depth:
                    raise ValueError(f"nested deeper than {limits.yaml_depth} levels")
                if event.anchor is not None:
                    anchors[event.anchor] = None
                stack.append([{} if mapping else [], None, mapping, 8, event.anchor])
                continue
            elif kind is yaml.MappingEndEvent or kind is yaml.SequenceEndEvent:
                value, _, _, weight, anchor = stack.pop()
            elif kind is yaml.AliasEvent:
                if event.anchor not in anchors:
                    raise ValueError(f"the alias *{event.anchor[:80]} has no anchor before it")
                known = anchors[event.anchor]
                if known is None:
                    raise ValueError(f"the alias *{event.anchor[:80]} stands inside its own anchor")
                value, weight = known
                nodes += 1
                budget -= weight
                if budget < 0:
                    raise _refuse("the aliases unfold to far more than the file holds", event.start_mark.line, TooLarge)
            elif kind is yaml.DocumentStartEvent:
                documents += 1
                if documents > 1:
                    raise ValueError("a second document begins here; only one is read")
                if event.tags:
                    raise ValueError("%TAG directives are not supported")
                continue
            elif kind is yaml.StreamEndEvent:
                break
            else:
                continue
            if nodes > limits.yaml_nodes:
                raise _refuse(f"more than {limits.yaml_nodes} nodes", event.start_mark.line, TooLarge)
            if anchor is not None:
                anchors[anchor] = (value, weight)
            top = stack[-1]
            top[3] += weight
            if not top[2]:
                top[0].append(value)
            elif top[1] is None:
                if not isinstance(value, str):
                    raise ValueError("a key must be a text")
                if value in top[0]:
                    raise ValueError(f"the key {value[:80]!r} stands twice in one mapping")
                top[1] = value
            else:
                top[0][top[1]] = value
                top[1] = None
    except ValueError as error:
        raise _refuse(str(error), event.start_mark.line) from error
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        reason = " ".join(filter(None, [error.context, error.problem])) or "not YAML"
        raise _refuse(reason, mark.line if mark else None) from error
    except yaml.YAMLError as error:
        raise _refuse(f"not YAML: {error}", None) from error
    finally:
        loader.dispose()
    return root[0] if root else None


def _text(data: bytes) -> str:
    """Strict UTF-8 without a byte order mark."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise _refuse(
            f"not UTF-8 text (byte 0x{data[error.start]:02x}); save the file as UTF-8",
            data.count(b"\n", 0, error.start),
        ) from error
