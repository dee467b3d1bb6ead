"""Fast parser for generated files in plain block layout: parses each distinct line once."""

from __future__ import annotations

import re
import sys
from typing import Any

from app.limits import Limits
from app.syntax.yaml.scalars import CONSTANTS, MAX_NUMBER_CHARACTERS, UNFOLD_FREE, UNFOLD_TIMES, WIDE, scalar


class NotSimpleError(Exception):
    """A line is not in plain block layout, or has an error: the reference parser decides."""


_LINE = re.compile(
    rf"""
    (?P<indent>\ *+) (?P<dash>-\ ++)?
    (?:
        (?P<key> [A-Za-z_0-9$/](?:[ !"$-9;-~{WIDE}]{{0,200}}(?<!\ ))? | '[ -&(-~{WIDE}]{{1,200}}' ) :
        (?:\ +(?=\S) | \ *$)
    )?
    (?:
        (?P<plain>(?:[A-Za-z_0-9$/(.~] | [-+](?=[0-9.])) (?:[ !"$-9;-~{WIDE}]*(?<!\ ))?)
      | '(?P<single>(?:[ -&(-~{WIDE}] | '')*)'
      | "(?P<double>[ !\#-\[\]-~{WIDE}]*)"
      | (?P<empty>\[\ *\] | \{{\ *\}})
      | \*(?P<alias>[A-Za-z0-9_]+)
      | &(?P<anchor>[A-Za-z0-9_]+)
    )?
    (?:\ *$ | \ +\#[ -~{WIDE}]*$)
    """,
    re.VERBOSE,
)
"""Pattern of ``- key: value``, each part optional. A plain value has no ``:`` or ``#``, a quoted one no escapes."""

_COMMON_LINE = re.compile(
    r"( *)([A-Za-z_]\w{0,200}): (?:(-?[0-9]{1,16}\.[0-9]{1,24})|([A-Za-z_$][\w./$]*))\Z", re.ASCII
)
"""Pattern of most lines of most files: a key with a number or a word, which need no further parsing."""

_BLANK = re.compile(rf" *(?:#[ -~{WIDE}]*)?\Z")

_FLOW_LINE = re.compile(
    rf"""(?P<indent>\ *+)
    (?:
        (?P<dash>-\ )(?=[\[{{])
      | (?P<dashed>-\ )?(?P<key>[A-Za-z_][A-Za-z_0-9]{{0,200}}):\ (?=[\[{{])
    )
    (?P<flow>(?!\[\]|\{{\}})[\[{{][ -~{WIDE}]*[\]}}])\Z""",
    re.VERBOSE,
)
"""Pattern of a flow collection that ends with its line: ``- [1, 2, {key: value}]`` or ``key: {…}``."""

_NUMBER = r"-?(?:0|[1-9][0-9]{0,15})(?:\.[0-9]{1,24})?"
_ROW = re.compile(rf"( *)- \[({_NUMBER}), ({_NUMBER}), (.*)\Z", re.ASCII)
_PLACE = re.compile(rf"({_NUMBER}), (?:([A-Za-z_]\w*)|(?:''|\"\"))\]\Z", re.ASCII)
"""Patterns of the start of most rows, and of the end of many."""

_PLAIN_IN_FLOW = rf"(?:[A-Za-z_0-9$/(.~]|[-+](?=[0-9.]))(?:[ \w./$+()*|%@&=^<>;'\-{WIDE}]*(?<!\ ))?"
_FLOW = re.compile(
    rf"""
    (?P<key> (?:{_PLAIN_IN_FLOW}) (?=:\ ) | '[ -&(-~{WIDE}]{{1,200}}'(?=:\ ) | "[ !\#-\[\]-~{WIDE}]{{1,200}}"(?=:\ ) )
  | (?P<plain>{_PLAIN_IN_FLOW}) (?=[,\]}}])
  | '(?P<single>(?:[ -&(-~{WIDE}] | '')*)' (?=[,\]}}])
  | "(?P<double>[ !\#-\[\]-~{WIDE}]*)" (?=[,\]}}])
  | (?P<open>[\[{{])
    """,
    re.VERBOSE | re.ASCII,
)
"""Pattern of a token in a flow collection, before ``: `` (a key) or a comma or bracket (a scalar)."""

_OPEN = object()
"""Marker for nothing after the colon or the dash: the next lines contain the value."""


class _Alias(str):
    """Name after a ``*``, as the value of a line."""

    __slots__ = ()


_Line = tuple[int, str | None, Any, tuple[int, bool, int, str | None]]
"""Parsed line: position, key, value, and (first column, dash?, column of the key, anchor) for the general case.

The position is the column of ``key: value``, -10 - the column of the dash of ``- key: value``, -3 for a blank line,
else -2.
"""


class _FlowParser:
    """Parser of flow collections on one line. Equal mappings at the end of rows become one object, as with aliases.

    nodes: number of nodes, shared ones counted each time. depth: of the deepest collection.
    """

    def __init__(self, limits: Limits) -> None:
        self.nodes = self.depth = 0
        self._limits = limits
        self._cache: dict[str, tuple[Any, int, int]] = {}

    def row(self, x: str, y: str, tail: str) -> list[Any]:
        """Return the value of ``[x, y, tail``, x and y being plain decimals."""
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
        """Return the value of a collection."""
        value, nodes, depth = self._collection(flow, 1, "]" if flow[0] == "[" else "}", 1)
        self._count(nodes, depth)
        return value

    def _count(self, nodes: int, depth: int) -> None:
        self.nodes += nodes
        self.depth = max(self.depth, depth)
        if self.nodes > self._limits.yaml_nodes:
            raise NotSimpleError

    def _collection(self, flow: str, at: int, end: str, depth: int) -> tuple[Any, int, int]:
        """Parse a collection from the start of its content to the end of the text: (value, nodes, depth)."""
        value, after, nodes, deepest = self._content(flow, at, end, depth)
        if after != len(flow):
            raise NotSimpleError
        return value, nodes, deepest

    def _content(self, flow: str, at: int, end: str, depth: int) -> tuple[Any, int, int, int]:
        """Parse a collection from the start of its content: (value, end, nodes, depth). end: its closing bracket."""
        if depth > self._limits.yaml_depth:
            raise NotSimpleError
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
                    raise NotSimpleError
                at = m.end() + 2
                nodes += 1
                if key[0] in "'\"":
                    key = key[1:-1]
                if key in out:
                    raise NotSimpleError
                m = _FLOW.match(flow, at)
            if m is None or m["key"] is not None:
                raise NotSimpleError
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
                        raise NotSimpleError from None
                else:
                    value = text.replace("''", "'") if kind == "single" else text
            if key is None:
                out.append(value)
            else:
                out[sys.intern(key)] = value
            if flow.startswith(end, at):
                return out, at + 1, nodes, deepest
            if not flow.startswith(", ", at):
                raise NotSimpleError
            at += 2

    def _inner(self, flow: str, at: int, depth: int) -> tuple[Any, int, int, int]:
        """Parse a nested collection like ``_content``; share equal mappings at the end of rows."""
        end = "]" if flow[at - 1] == "[" else "}"
        if end == "]" or depth != 2 or flow[-2:] != "}]" or flow.find("}", at) != len(flow) - 2:
            return self._content(flow, at, end, depth)
        remainder = flow[at:]
        cached = self._cache.get(remainder)
        if cached is None:
            value, after, nodes, deepest = self._content(flow, at, end, depth)
            if after != len(flow) - 1:
                return value, after, nodes, deepest
            cached = self._cache[remainder] = (value, nodes, deepest)
        return cached[0], len(flow) - 1, cached[1], cached[2]


class _Lines(dict[str, _Line]):
    """Cache of parsed lines, filled on first access."""

    def __init__(self, limits: Limits) -> None:
        super().__init__()
        self.flows = _FlowParser(limits)

    def __missing__(self, line: str) -> _Line:
        row = _ROW.match(line)
        if row:  # rarely repeated: not cached
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
                raise NotSimpleError
            indent, dash, key, plain, single, double, empty, alias, anchor = m.groups()
            value = _OPEN
            if plain is not None:
                try:
                    value = scalar(plain)
                except ValueError:
                    raise NotSimpleError from None
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
                    raise NotSimpleError
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


def load_lines(text: str, limits: Limits) -> Any:
    """Parse a document in plain block layout: one key or item per line. Raises NotSimpleError for other layouts."""
    if "\r" in text:
        text = text.replace("\r\n", "\n")
    lines = text.split("\n")
    if 4 * len(lines) > limits.yaml_nodes:
        raise NotSimpleError
    if lines[0] == "---":
        lines[0] = ""
    root: list[Any] = []
    # Open collections, outermost first: (column, collection, anchored).
    stack: list[tuple[int, Any, bool]] = [(-1, root, False)]
    anchors: dict[str, Any] = {}
    weights: dict[str, int] = {}
    budget = UNFOLD_FREE + UNFOLD_TIMES * len(text)
    current: Any = root  # the innermost collection
    at = -1  # its column, if it is a mapping and no key is pending
    item = -1  # -10 - the column of the dash, if the mapping is an item of a list and no key is pending
    waiting = True  # the last key or dash has no value yet
    key: str | None = None
    anchor: str | None = None  # of the pending value
    line_cache = _Lines(limits)
    flows = line_cache.flows
    for position, name, value, layout in map(line_cache.__getitem__, lines):
        if position == at:
            if name in current:
                raise NotSimpleError
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
                    raise NotSimpleError
                _insert(current, key, None)
            while first < stack[-1][0] or (first == stack[-1][0] and not dash and type(current) is list):
                stack.pop()
                current = stack[-1][1]
            if first != stack[-1][0] or dash != (type(current) is list):
                raise NotSimpleError
        if dash and name is not None:
            new = {}
            current.append(new)
            stack.append((inner, new, False))
            current = new
        if len(stack) - 1 + flows.depth > limits.yaml_depth or (name is not None and name in current):
            raise NotSimpleError
        key, anchor = name, its_anchor
        if anchor is not None and anchor in anchors:
            raise NotSimpleError
        waiting = value is _OPEN
        if type(value) is _Alias:
            # The reference parses aliases below an anchor, so the weights ignore aliases in aliases.
            if value not in anchors or any(anchored for _, _, anchored in stack):
                raise NotSimpleError
            if value not in weights:
                weights[value] = _weight(anchors[value])
            budget -= weights[value]
            if budget < 0:
                raise NotSimpleError
            _insert(current, key, anchors[value])
        elif not waiting:
            _insert(current, key, value)
        at = stack[-1][0] if type(current) is dict and not waiting else -1
        item = -10 - first if dash and name is not None and not waiting else -1
    if waiting:
        if anchor is not None:
            raise NotSimpleError
        _insert(current, key, None)
    if 4 * len(lines) + flows.nodes > limits.yaml_nodes:
        raise NotSimpleError
    return root[0]


def _insert(collection: Any, key: str | None, value: Any) -> None:
    if key is None or type(collection) is list:
        collection.append(value)
    else:
        collection[key] = value


def _weight(value: Any) -> int:
    """Compute a value's weight, not less than the reference parser's: its characters, and 8 for each node."""
    if isinstance(value, dict):
        return 8 + sum(8 + len(k) + _weight(v) for k, v in value.items())
    if isinstance(value, list):
        return 8 + sum(map(_weight, value))
    return 8 + (len(value) if isinstance(value, str) else MAX_NUMBER_CHARACTERS)
