"""Write OpenStreetMap XML in the form of the OSM tools, for all formats based on OSM.

Values come from stored properties, which anyone can edit: values of a wrong type are converted to text or skipped, and
characters that XML cannot contain become the replacement character.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any

from app.formats.osm.elements import INT64, MAX_UNKNOWN_DEPTH
from app.syntax.decimals import DEGREES, numbers

MAX_CACHED_ATTRIBUTES = 4096
"""Maximum number of attribute mappings whose text is cached for the next elements."""

NO_ATTRIBUTES: Mapping[str, str] = {}

LINES = 10_000
"""Number of lines that are encoded at once."""

Way = tuple[Sequence[int], Mapping[str, str], Mapping[str, str]]
"""A way: the ids of its nodes, tags, attributes."""

Relation = tuple[Sequence[tuple[str, int, str]], Mapping[str, str], Mapping[str, str]]
"""A relation: members as (type, id, role), tags, attributes."""


@dataclass(slots=True)
class Node:
    """A node in degrees, NaN if it has no position. vertex: it is only a bend of a way."""

    lon: float
    lat: float
    tags: Mapping[str, str] = field(default_factory=dict)
    attributes: Mapping[str, str] = field(default_factory=dict)
    vertex: bool = False


Children = Mapping[tuple[str, int], Any]
"""Elements that OSM does not define, by the type and id of their parent element (see ``element_lines``)."""


def document(
    head: Iterable[str],
    nodes: Mapping[int, Node],
    ways: Mapping[int, Way],
    relations: Mapping[int, Relation],
    children: Children,
) -> bytes:
    """Write the file: the lines of ``head`` (the root element first), then nodes, ways and relations, each by id.

    Lines are encoded in batches: all lines as texts would need four times the memory.
    """
    done = BytesIO()  # its content is moved out without a copy
    lines: list[str] = []
    for line in _lines(head, nodes, ways, relations, children):
        lines.append(line)
        if len(lines) == LINES:
            lines.append("")
            done.write("\n".join(lines).encode())
            lines.clear()
    done.write("\n".join([*lines, ""]).encode())
    return done.getvalue()


def _lines(
    head: Iterable[str],
    nodes: Mapping[int, Node],
    ways: Mapping[int, Way],
    relations: Mapping[int, Relation],
    children: Children,
) -> Iterator[str]:
    cache: dict[int, str] = {}

    def attributes(values: Mapping[str, str]) -> str:
        if not values:
            return ""
        cached = cache.get(id(values))
        if cached is None:
            # Keyed by identity: thousands of elements of one changeset share one mapping, referenced here.
            if len(cache) >= MAX_CACHED_ATTRIBUTES:
                cache.clear()  # a file in which every element has its own history
            cached = cache[id(values)] = attribute_text(values, RESERVED)
        return cached

    def unknown(kind: str, i: int) -> list[str]:
        return element_lines(children[kind, i], "  ") if (kind, i) in children else []

    yield '<?xml version="1.0" encoding="UTF-8"?>'
    yield from head
    order = sorted(nodes, key=rank)
    lon = degrees([nodes[i].lon for i in order])
    lat = degrees([nodes[i].lat for i in order])
    for i, x, y in zip(order, lon, lat, strict=True):
        node = nodes[i]
        position = f' lat="{y}" lon="{x}"' if x is not None else ""
        further = unknown("node", i) if children else ()
        if node.tags or further:
            yield f' <node id="{i}"{attributes(node.attributes)}{position}>'
            yield from tag_lines(node.tags)
            yield from further
            yield " </node>"
        else:
            yield f' <node id="{i}"{attributes(node.attributes)}{position}/>'
    for i in sorted(ways, key=rank):
        refs, tags, element_attributes = ways[i]
        inner = [*[f'  <nd ref="{r}"/>' for r in refs], *tag_lines(tags), *unknown("way", i)]
        yield from _element_with("way", i, attributes(element_attributes), inner)
    for i in sorted(relations, key=rank):
        members, tags, element_attributes = relations[i]
        inner = [f'  <member type="{escape(t)}" ref="{r}" role="{escape(role)}"/>' for t, r, role in members]
        inner += [*tag_lines(tags), *unknown("relation", i)]
        yield from _element_with("relation", i, attributes(element_attributes), inner)
    yield "</osm>"


def _element_with(kind: str, i: int, attributes: str, inner: list[str]) -> Iterator[str]:
    if not inner:
        yield f' <{kind} id="{i}"{attributes}/>'
        return
    yield f' <{kind} id="{i}"{attributes}>'
    yield from inner
    yield f" </{kind}>"


def element_lines(rows: Any, indent: str = " ", depth: int = 1) -> list[str]:
    """Write lines for elements that OSM does not define or that are not map data (``note``, ``meta``, ``changeset``).

    rows: [name, attributes], then text and a list of such rows, if any. Other values are skipped.
    """
    lines = []
    for row in rows if isinstance(rows, list) and depth <= MAX_UNKNOWN_DEPTH else []:
        name, attributes, text, inner = (
            ([*row, "", []] if len(row) == 2 else [*row, []])[:4] if is_row(row) else ("",) * 4
        )
        if not _NAME.fullmatch(str(name)):
            continue
        start = f"{indent}<{name}{attribute_text(as_texts(attributes), frozenset())}>{escape(str(text))}"
        below = element_lines(inner, f"{indent} ", depth + 1)
        lines += [start, *below, f"{indent}</{name}>"] if below else [f"{start}</{name}>"]
    return lines


def is_row(row: Any) -> bool:
    """Whether a value is an unknown element in stored form."""
    return isinstance(row, list) and 2 <= len(row) <= 4


_ID = re.compile(r"([nwr])(-?\d{1,19})", re.ASCII)
_NAME = re.compile(r"[A-Za-z_][\w.:-]*", re.ASCII)
RESERVED = frozenset({"id", "lat", "lon"})
_SPECIAL = re.compile('[&<>"\\x00-\\x1f\\ud800-\\udfff\\ufffe\\uffff]')
_ESCAPES = {"&": "&amp;", "<": "&lt;", ">": "&gt;", '"': "&quot;", "\t": "&#9;", "\n": "&#10;", "\r": "&#13;"}


def escape(text: str) -> str:
    """Escape text for an attribute; characters that XML cannot contain become the replacement character."""
    return _SPECIAL.sub(lambda m: _ESCAPES.get(m[0], "\ufffd"), text) if _SPECIAL.search(text) else text


def element_id(i: str) -> tuple[str, int] | None:
    """Parse ``n12`` to ("n", 12), ``w…`` and ``r…`` alike; None for any other text."""
    match = _ID.fullmatch(i)
    if match is None or abs(int(match[2])) >= INT64 or str(int(match[2])) != match[2]:
        return None
    return match[1], int(match[2])


def rank(i: int) -> tuple[bool, int]:
    """Return the sort key of the OSM tools: negative ids first, by magnitude."""
    return i > 0, abs(i)


def integers(value: Any) -> list[int] | None:
    """Return a list of 64-bit integers, or None if it is not one (properties can be edited by anyone)."""
    if not isinstance(value, list | tuple):
        return None
    return list(value) if all(type(v) is int and abs(v) < INT64 for v in value) else None


def as_texts(value: Any) -> Mapping[str, str]:
    """Convert any stored value to a mapping of texts to texts."""
    if not isinstance(value, Mapping):
        return NO_ATTRIBUTES
    try:
        "".join(value.values())
    except TypeError:
        pass
    else:
        return value
    return {k: v if isinstance(v, str) else str(v) for k, v in value.items() if v is not None}


def degrees(values: list[float]) -> list[str | None]:
    """Format degrees as text, None for NaN."""
    return [None if v == "nan" else plain(v) for v in numbers(values, DEGREES)]


def plain(text: str) -> str:
    """Format a number without exponent: some OSM readers do not support one."""
    return f"{float(text):.12f}".rstrip("0") if "e" in text else text


def attribute_text(attributes: Mapping[str, str], without: frozenset[str]) -> str:
    """Write XML attributes, each with a space before it; names that are invalid in XML are skipped."""
    return "".join(f' {k}="{escape(v)}"' for k, v in attributes.items() if k not in without and _NAME.fullmatch(k))


def tag_lines(tags: Mapping[str, str]) -> list[str]:
    """Write a ``<tag>`` for each."""
    return [f'  <tag k="{escape(k)}" v="{escape(v)}"/>' for k, v in tags.items()]
