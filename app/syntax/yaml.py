"""YAML as plain JSON-like values, read safely and written deterministically: the only way in which formats do it.

``load`` gives None, bool, int (64 bit), finite float, text, list and dict with text keys, and nothing else. What a
plain scalar means follows PyYAML (YAML 1.1), which the robots' own tools use, without its traps:

* dates and times, sexagesimals (``12:30``), numbers with a leading zero (``010``), with underscores (``1_2``) and
  binary ones stay the texts they are; so a node called ``1_2`` is not 12, and ``last_updated`` never becomes a date
* ``1e-05`` is a float although PyYAML takes it for a text (Python and C++ print floats so); ``7e12`` is a text
* keys are the texts as written: ``0``, ``yes`` and ``2022`` are the keys "0", "yes" and "2022"

Two ways lead to the same values: large generated files consist of few different lines in plain block layout, so
``_load_lines`` understands each distinct line once and puts the rest together at dictionary speed (several times
faster than any general parser), also collections in flow style that end with their line; whatever it does not know,
and every error, is left to ``_load_events``, which builds the values from libyaml's events. Tests hold that both agree.

Refused, each with its line: NaN and infinities, integers beyond 64 bit, duplicate keys, ``<<``, tags other than
YAML's own scalars and collections, ``%TAG``, a second document, nesting deeper than ``Limits.yaml_depth``, more than
``Limits.yaml_nodes`` nodes, aliases that unfold to much more than the file, aliases to a collection that contains them.
A format with tags of its own names their prefixes: mappings and lists so tagged come as ``Tagged``, and ``%TAG`` may
stand for these prefixes.

``text``, ``block`` and ``mapping`` write what readers of YAML 1.1 (PyYAML) and 1.2 (yaml-cpp) take for the same value.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Sequence
from typing import Any, NamedTuple

import yaml

from app.errors import Problem, TooLarge, UnreadableFile
from app.limits import Limits

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

_WIDE = r"\u00a0-\u1fff\u2030-\ud7ff\ue000-\ufefe\uff00-\ufffd\U00010000-\U0010ffff"
"""Characters beyond ASCII that libyaml takes for themselves anywhere: no further line breaks, no byte order mark."""

_QUOTABLE = re.compile(rf"[ -~{_WIDE}]*\Z")

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


def load(data: bytes, limits: Limits, *, tags: Sequence[str] = (), typed: bool = True) -> Any:
    """The one document of a UTF-8 YAML file as JSON-like values; an empty file is None.

    tags: prefixes of the format's own tags, which collections may carry. typed: whether scalars get their meaning;
    if not, all are texts, those without quotes ``PlainScalar``.
    Values behind aliases, and equal mappings at the end of rows in flow style, are shared objects: do not change them
    in place. Raises UnreadableFile or TooLarge, with line.
    """
    if len(data) > limits.text_bytes:
        raise TooLarge(f"the file has {len(data)} bytes of YAML; the limit is {limits.text_bytes}")
    document = _text(data)
    if tags or not typed:
        return _load_events(document, limits, tuple(tags), typed=typed)
    try:
        return _load_lines(document, limits)
    except _NotSimpleError:
        return _load_events(document, limits)


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


def _int64(value: int) -> int:
    if value not in INT64:
        raise ValueError(f"the integer {str(value)[:40]} is beyond 64 bit")
    return value


def _finite(value: float) -> float:
    if not math.isfinite(value):
        raise ValueError("a number beyond the range of a float")
    return value


def _yaml_error(
    reason: str, line: int | None, error: type[UnreadableFile] | type[TooLarge] = UnreadableFile
) -> Exception:
    """The error to raise. line: from 0, as YAML marks count."""
    at = None if line is None else line + 1
    return error(reason if at is None else f"line {at}: {reason}", [Problem(reason, line=at)])


def _tagged_scalar(tag: str, text: str) -> Any:
    """The value of a scalar with an explicit tag."""
    if tag in (TAG + "str", "!"):
        return text
    value = scalar(text)
    kind: dict[str, Any] = {"int": int, "float": (int, float), "bool": bool, "null": type(None)}
    expected_type = kind.get(tag.removeprefix(TAG)) if tag.startswith(TAG) else None
    if expected_type is None:
        raise ValueError(f"the tag {tag[:80]} is not supported")
    if not isinstance(value, expected_type) or (isinstance(value, bool) and expected_type is not bool):
        raise ValueError(f"{text[:80]!r} does not fit its tag {tag}")
    return float(value) if tag == TAG + "float" else value


def _load_events(text: str, limits: Limits, tags: tuple[str, ...] = (), *, typed: bool = True) -> Any:
    """The reference: builds the value from libyaml's event stream, without recursion."""
    loader: Any = yaml.CSafeLoader(text)
    event: Any = None
    budget = UNFOLD_FREE + UNFOLD_TIMES * len(text)
    root: list[Any] = []
    # Open collections, outermost first: [value, pending key, is a mapping, weight, what its anchor stands for, tag].
    stack: list[list[Any]] = [[root, None, False, 0, None, None]]
    # What each name stands for, (value, weight), empty while its collection is open. The last anchor of a name counts.
    anchors: dict[str, list[tuple[Any, int]]] = {}
    nodes = documents = 0
    try:
        while True:
            event = loader.get_event()
            kind = type(event)
            weight = 0
            anchor_slot: list[tuple[Any, int]] | None = None
            if kind is yaml.ScalarEvent:
                nodes += 1
                if event.anchor is not None:
                    anchor_slot = anchors[event.anchor] = []
                literal: str = event.value
                top = stack[-1]
                as_key = top[2] and top[1] is None
                plain = event.implicit[0]
                if as_key and (event.tag is None or event.tag == "!"):
                    if plain and literal == "<<":
                        raise ValueError("merge keys (<<) are not supported; write the keys out")
                    value: Any = literal
                elif event.tag is not None:
                    value = _tagged_scalar(event.tag, literal)
                elif typed:
                    value = scalar(literal) if plain else literal
                else:
                    value = PlainScalar(literal) if plain else literal
                weight = 8 + len(literal)
            elif kind is yaml.MappingStartEvent or kind is yaml.SequenceStartEvent:
                nodes += 1
                mapping = kind is yaml.MappingStartEvent
                tag = None
                if event.tag not in (None, "!", TAG + ("map" if mapping else "seq")):
                    if not event.tag.startswith(tags):
                        raise ValueError(f"the tag {event.tag[:80]} is not supported")
                    tag = event.tag
                if stack[-1][2] and stack[-1][1] is None:
                    raise ValueError("a key must be a text, not a collection")
                if len(stack) > limits.yaml_depth:
                    raise ValueError(f"nested deeper than {limits.yaml_depth} levels")
                if event.anchor is not None:
                    anchor_slot = anchors[event.anchor] = []
                stack.append([{} if mapping else [], None, mapping, 8, anchor_slot, tag])
                continue
            elif kind is yaml.MappingEndEvent or kind is yaml.SequenceEndEvent:
                value, _, _, weight, anchor_slot, tag = stack.pop()
                if tag is not None:
                    value = Tagged(tag, value)
            elif kind is yaml.AliasEvent:
                if event.anchor not in anchors:
                    raise ValueError(f"the alias *{event.anchor[:80]} has no anchor before it")
                if not anchors[event.anchor]:
                    raise ValueError(f"the alias *{event.anchor[:80]} stands inside its own anchor")
                value, weight = anchors[event.anchor][0]
                nodes += 1
                budget -= weight
                if budget < 0:
                    raise _yaml_error(
                        "the aliases unfold to far more than the file holds", event.start_mark.line, TooLarge
                    )
            elif kind is yaml.DocumentStartEvent:
                documents += 1
                if documents > 1:
                    raise ValueError("a second document begins here; only one is read")
                if event.tags and not set(event.tags.values()) <= set(tags):
                    raise ValueError("%TAG directives are not supported" if not tags else "an unknown %TAG directive")
                continue
            elif kind is yaml.StreamEndEvent:
                break
            else:
                continue
            if nodes > limits.yaml_nodes:
                raise _yaml_error(f"more than {limits.yaml_nodes} nodes", event.start_mark.line, TooLarge)
            if anchor_slot is not None:
                anchor_slot.append((value, weight))
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
        raise _yaml_error(str(error), event.start_mark.line) from error
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        reason = " ".join(filter(None, [error.context, error.problem])) or "not YAML"
        raise _yaml_error(reason, mark.line if mark else None) from error
    except yaml.YAMLError as error:
        raise _yaml_error(f"not YAML: {error}", None) from error
    finally:
        loader.dispose()
    return root[0] if root else None


# --- the quick way ---------------------------------------------------------------------------------------------------


class _NotSimpleError(Exception):
    """A line beyond the plain block layout, or an error: the reference decides."""


_LINE = re.compile(
    rf"""
    (?P<indent>\ *+) (?P<dash>-\ ++)?
    (?:
        (?P<key> [A-Za-z_0-9$/](?:[ !"$-9;-~{_WIDE}]{{0,200}}(?<!\ ))? | '[ -&(-~{_WIDE}]{{1,200}}' ) :
        (?:\ +(?=\S) | \ *$)
    )?
    (?:
        (?P<plain>(?:[A-Za-z_0-9$/(.~] | [-+](?=[0-9.])) (?:[ !"$-9;-~{_WIDE}]*(?<!\ ))?)
      | '(?P<single>(?:[ -&(-~{_WIDE}] | '')*)'
      | "(?P<double>[ !\#-\[\]-~{_WIDE}]*)"
      | (?P<empty>\[\ *\] | \{{\ *\}})
      | \*(?P<alias>[A-Za-z0-9_]+)
      | &(?P<anchor>[A-Za-z0-9_]+)
    )?
    (?:\ *$ | \ +\#[ -~{_WIDE}]*$)
    """,
    re.VERBOSE,
)
"""``- key: value``, each of the three optional. A plain value has no ``:`` and no ``#``, a quoted one no escapes."""

_COMMON_LINE = re.compile(
    r"( *)([A-Za-z_]\w{0,200}): (?:(-?[0-9]{1,16}\.[0-9]{1,24})|([A-Za-z_$][\w./$]*))\Z", re.ASCII
)
"""Most lines of most files: a key with a number or a word, which need no further look."""

_BLANK = re.compile(rf" *(?:#[ -~{_WIDE}]*)?\Z")

_FLOW_LINE = re.compile(
    rf"""(?P<indent>\ *+)
    (?:
        (?P<dash>-\ )(?=[\[{{])
      | (?P<dashed>-\ )?(?P<key>[A-Za-z_][A-Za-z_0-9]{{0,200}}):\ (?=[\[{{])
    )
    (?P<flow>(?!\[\]|\{{\}})[\[{{][ -~{_WIDE}]*[\]}}])\Z""",
    re.VERBOSE,
)
"""``- [1, 2, {key: value}]`` or ``key: {…}``: a collection in flow style that ends with its line."""

_NUMBER = r"-?(?:0|[1-9][0-9]{0,15})(?:\.[0-9]{1,24})?"
_ROW = re.compile(rf"( *)- \[({_NUMBER}), ({_NUMBER}), (.*)\Z", re.ASCII)
_PLACE = re.compile(rf"({_NUMBER}), (?:([A-Za-z_]\w*)|(?:''|\"\"))\]\Z", re.ASCII)
"""What most rows begin with, and what many end with."""

_PLAIN_IN_FLOW = rf"(?:[A-Za-z_0-9$/(.~]|[-+](?=[0-9.]))(?:[ \w./$+()*|%@&=^<>;'\-{_WIDE}]*(?<!\ ))?"
_FLOW = re.compile(
    rf"""
    (?P<key> (?:{_PLAIN_IN_FLOW}) (?=:\ ) | '[ -&(-~{_WIDE}]{{1,200}}'(?=:\ ) | "[ !\#-\[\]-~{_WIDE}]{{1,200}}"(?=:\ ) )
  | (?P<plain>{_PLAIN_IN_FLOW}) (?=[,\]}}])
  | '(?P<single>(?:[ -&(-~{_WIDE}] | '')*)' (?=[,\]}}])
  | "(?P<double>[ !\#-\[\]-~{_WIDE}]*)" (?=[,\]}}])
  | (?P<open>[\[{{])
    """,
    re.VERBOSE | re.ASCII,
)
"""What stands in a collection in flow style, before ``: `` (a key) or a comma or bracket (a scalar)."""

_OPEN = object()
"""Nothing stands behind the colon or the dash: what it is shows on the next lines."""


class _Alias(str):
    """The name behind a ``*``, as the value of a line."""

    __slots__ = ()


_Line = tuple[int, str | None, Any, tuple[int, bool, int, str | None]]
"""Where it goes: for ``key: value`` the column, for ``- key: value`` -10 - the column of the dash, for a blank line -3,
else -2; key; value; (first column, dash?, column of the key, anchor) for the general case."""


class _FlowParser:
    """Collections in flow style on one line. Equal mappings at the end of rows are one object, as behind aliases.

    nodes: how many were said, shared ones each time; depth: of the deepest collection.
    """

    def __init__(self, limits: Limits) -> None:
        self.nodes = self.depth = 0
        self._limits = limits
        self._known: dict[str, tuple[Any, int, int]] = {}

    def row(self, x: str, y: str, tail: str) -> list[Any]:
        """The value of ``[x, y, tail``, x and y being plain decimals."""
        out: list[Any] = [float(x) if "." in x else int(x), float(y) if "." in y else int(y)]
        match = _PLACE.match(tail)
        if match:
            third, name = match.groups()
            out += (float(third) if "." in third else int(third), CONSTANTS.get(name, name) if name else "")
            self._count(5, 1)
        else:
            extra, nodes, depth = self._collection(tail, 0, "]", 1)
            out += extra
            self._count(nodes + 2, depth)
        return out

    def value(self, flow: str) -> Any:
        """The value of a collection."""
        value, nodes, depth = self._collection(flow, 1, "]" if flow[0] == "[" else "}", 1)
        self._count(nodes, depth)
        return value

    def _count(self, nodes: int, depth: int) -> None:
        self.nodes += nodes
        self.depth = max(self.depth, depth)
        if self.nodes > self._limits.yaml_nodes:
            raise _NotSimpleError

    def _collection(self, flow: str, at: int, end: str, depth: int) -> tuple[Any, int, int]:
        """(value, nodes, depth) of the collection whose content begins here and which ends the text."""
        value, after, nodes, deepest = self._content(flow, at, end, depth)
        if after != len(flow):
            raise _NotSimpleError
        return value, nodes, deepest

    def _content(self, flow: str, at: int, end: str, depth: int) -> tuple[Any, int, int, int]:
        """(value, where it ends, nodes, depth) of a collection whose content begins here; end: its bracket."""
        if depth > self._limits.yaml_depth:
            raise _NotSimpleError
        out: Any = [] if end == "]" else {}
        nodes, deepest = 1, depth
        if flow.startswith(end, at):
            return out, at + 1, nodes, deepest
        while True:
            key = None
            m = _FLOW.match(flow, at)
            if m and end == "}":
                key = m["key"]
                if key is None:
                    raise _NotSimpleError
                at = m.end() + 2
                nodes += 1
                if key[0] in "'\"":
                    key = key[1:-1]
                if key in out:
                    raise _NotSimpleError
                m = _FLOW.match(flow, at)
            if m is None or m["key"] is not None:
                raise _NotSimpleError
            kind, at = m.lastgroup, m.end()
            if kind == "open":
                value, at, more, below = self._inner(flow, at, depth + 1)
                nodes += more
                deepest = max(deepest, below)
            else:
                nodes += 1
                text = m[m.lastindex or 0]
                if kind == "plain":
                    try:
                        value = scalar(text)
                    except ValueError:
                        raise _NotSimpleError from None
                else:
                    value = text.replace("''", "'") if kind == "single" else text
            if key is None:
                out.append(value)
            else:
                out[sys.intern(key)] = value
            if flow.startswith(end, at):
                return out, at + 1, nodes, deepest
            if not flow.startswith(", ", at):
                raise _NotSimpleError
            at += 2

    def _inner(self, flow: str, at: int, depth: int) -> tuple[Any, int, int, int]:
        """As ``_content``, for a collection inside another; a mapping that ends a row is known again."""
        end = "]" if flow[at - 1] == "[" else "}"
        if end == "]" or depth != 2 or flow[-2:] != "}]" or flow.find("}", at) != len(flow) - 2:
            return self._content(flow, at, end, depth)
        remainder = flow[at:]
        cached = self._known.get(remainder)
        if cached is None:
            value, after, nodes, deepest = self._content(flow, at, end, depth)
            if after != len(flow) - 1:
                return value, after, nodes, deepest
            cached = self._known[remainder] = (value, nodes, deepest)
        return cached[0], len(flow) - 1, cached[1], cached[2]


class _Lines(dict[str, _Line]):
    """Line -> what it says, understood when first asked for."""

    def __init__(self, limits: Limits) -> None:
        super().__init__()
        self.flows = _FlowParser(limits)

    def __missing__(self, line: str) -> _Line:
        row = _ROW.match(line)
        if row:  # hardly any comes twice: not kept
            first = len(row[1])
            value: Any = self.flows.row(row[2], row[3], row[4])
            return (-2, None, value, (first, True, first + 2, None))
        if line[-1:] in ("]", "}"):
            flow = _FLOW_LINE.match(line)
            if flow:
                first, key = len(flow["indent"]), flow["key"]
                dashed = (flow["dash"] or flow["dashed"]) is not None
                value = self.flows.value(flow["flow"])
                position = -2 if key is None else -10 - first if dashed else first
                return (position, key, value, (first, dashed, first + 2 * dashed, None))
        return self._block(line)

    def _block(self, line: str) -> _Line:
        match = _COMMON_LINE.match(line)
        if match:
            spaces, key, decimal, literal = match.groups()
            first = len(spaces)
            value: Any = CONSTANTS.get(literal, literal) if decimal is None else float(decimal)
            entry: _Line = (first, key, value, (first, False, first, None))
        elif _BLANK.match(line):
            entry = (-3, None, None, (0, False, 0, None))
        else:
            m = _LINE.match(line)
            if not m:
                raise _NotSimpleError
            indent, dash, key, plain, single, double, empty, alias, anchor = m.groups()
            value = _OPEN
            if plain is not None:
                try:
                    value = scalar(plain)
                except ValueError:
                    raise _NotSimpleError from None
            elif single is not None:
                value = single.replace("''", "'")
            elif double is not None:
                value = double
            elif empty is not None:
                value = [] if empty[0] == "[" else {}
            elif alias is not None:
                value = _Alias(alias)
            if key is None:
                if dash is None:
                    raise _NotSimpleError
            elif key[0] == "'":
                key = key[1:-1]
            first = len(indent)
            column = first + len(dash or "")
            position = -2
            if key is not None and alias is None and anchor is None:
                position = first if dash is None else -10 - first
            entry = (position, key, value, (first, dash is not None, column, anchor))
        self[line] = entry
        return entry


def _load_lines(text: str, limits: Limits) -> Any:
    """The value of a document in plain block layout: one key or item a line. _NotSimpleError where it is not."""
    if "\r" in text:
        text = text.replace("\r\n", "\n")
    lines = text.split("\n")
    if 4 * len(lines) > limits.yaml_nodes:
        raise _NotSimpleError
    if lines[0] == "---":
        lines[0] = ""
    root: list[Any] = []
    # Open collections, outermost first: (column, collection, anchored).
    stack: list[tuple[int, Any, bool]] = [(-1, root, False)]
    anchors: dict[str, Any] = {}
    weights: dict[str, int] = {}
    budget = UNFOLD_FREE + UNFOLD_TIMES * len(text)
    current: Any = root  # the innermost collection
    at = -1  # its column, where it is a mapping and no key waits for its value
    item = -1  # -10 - the column of the dash, where the mapping is an item of a list and no key waits
    waiting = True  # the last key or dash has no value yet
    key: str | None = None
    anchor: str | None = None  # of what is waited for
    line_cache = _Lines(limits)
    flows = line_cache.flows
    for position, name, value, layout in map(line_cache.__getitem__, lines):
        if position == at:
            if name in current:
                raise _NotSimpleError
            key = name
            if value is _OPEN:
                waiting, at, item = True, -1, -1
            else:
                current[key] = value
            continue
        if position == item and value is not _OPEN:
            current = {name: value}
            at = layout[2]
            stack[-1] = (at, current, False)
            stack[-2][1].append(current)
            continue
        if position == -3:
            continue
        first, dash, inner, its_anchor = layout
        opened = stack[-1][0]
        if waiting and (first > opened or (first == opened and dash and type(current) is dict)):
            new: Any = [] if dash else {}
            _insert(current, key, new)
            if anchor is not None:
                anchors[anchor] = new
            stack.append((first, new, anchor is not None))
            current = new
        else:
            if waiting:
                if anchor is not None:
                    raise _NotSimpleError
                _insert(current, key, None)
            while first < stack[-1][0] or (first == stack[-1][0] and not dash and type(current) is list):
                stack.pop()
                current = stack[-1][1]
            if first != stack[-1][0] or dash != (type(current) is list):
                raise _NotSimpleError
        if dash and name is not None:
            new = {}
            current.append(new)
            stack.append((inner, new, False))
            current = new
        if len(stack) - 1 + flows.depth > limits.yaml_depth or (name is not None and name in current):
            raise _NotSimpleError
        key, anchor = name, its_anchor
        if anchor is not None and anchor in anchors:
            raise _NotSimpleError
        waiting = value is _OPEN
        if type(value) is _Alias:
            # An alias below an anchor is left to the reference, so the weights need no care for aliases in aliases.
            if value not in anchors or any(anchored for _, _, anchored in stack):
                raise _NotSimpleError
            if value not in weights:
                weights[value] = _weight(anchors[value])
            budget -= weights[value]
            if budget < 0:
                raise _NotSimpleError
            _insert(current, key, anchors[value])
        elif not waiting:
            _insert(current, key, value)
        at = stack[-1][0] if type(current) is dict and not waiting else -1
        item = -10 - first if dash and name is not None and not waiting else -1
    if waiting:
        if anchor is not None:
            raise _NotSimpleError
        _insert(current, key, None)
    if 4 * len(lines) + flows.nodes > limits.yaml_nodes:
        raise _NotSimpleError
    return root[0]


def _insert(collection: Any, key: str | None, value: Any) -> None:
    if key is None or type(collection) is list:
        collection.append(value)
    else:
        collection[key] = value


def _weight(value: Any) -> int:
    """At least what the reference counts for a value: characters, and 8 for each node."""
    if isinstance(value, dict):
        return 8 + sum(8 + len(k) + _weight(v) for k, v in value.items())
    if isinstance(value, list):
        return 8 + sum(map(_weight, value))
    return 8 + (len(value) if isinstance(value, str) else MAX_NUMBER_CHARACTERS)


def _text(data: bytes) -> str:
    """Strict UTF-8 without a byte order mark."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise _yaml_error(
            f"not UTF-8 text (byte 0x{data[error.start]:02x}); save the file as UTF-8",
            data.count(b"\n", 0, error.start),
        ) from error
