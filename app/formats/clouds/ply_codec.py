"""PLY files as point clouds: text header, and ``ascii`` or binary data of either byte order.

``element <name> <count>`` is followed by its properties: ``property <type> <name>``, or ``property list <type of the
count> <type> <name>``. The element ``vertex`` is the cloud; other elements (faces …) are counted and
checked for completeness. Source: Greg Turk's "The PLY Polygon File Format".
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from app.errors import TooLarge
from app.formats import ReadContext
from app.formats.clouds.pcd_codec import text_rows
from app.formats.clouds.points import Cloud, check_columns, check_count, table, unreadable_error

Data = Literal["binary_little_endian", "binary_big_endian", "ascii"]
KINDS: tuple[Data, ...] = get_args(Data)
HEADER_BYTES = 2**16
VERTEX = "vertex"

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"},
    **{"int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"},
}
_CODES = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I"}
_NAMES = {code: name for name, code in list(_TYPES.items())[:8]}


def detect(name: str, data: bytes) -> bool:
    """Detect a line with the magic word followed by a format line."""
    del name
    return re.match(rb"ply[ \t]*\r?\n", data[:64]) is not None


@dataclass(frozen=True, slots=True)
class _Property:
    """Property of an element. count: type of a list's length, None for a single value."""

    name: str
    type: str
    count: str | None


@dataclass(slots=True)
class _Element:
    name: str
    count: int
    properties: list[_Property]
    line: int

    @property
    def lists(self) -> bool:
        return any(p.count is not None for p in self.properties)

    def dtype(self, order: str, sizes: tuple[int, ...] = ()) -> np.dtype[Any]:
        """Return the dtype of a record with lists of these lengths."""
        left = list(sizes)
        columns: list[Any] = []
        for k, p in enumerate(self.properties):
            if p.count is None:
                columns.append((f"{k}", order + p.type))
            else:
                columns += [(f"{k}n", order + p.count), (f"{k}", order + p.type, (left.pop(0),))]
        return np.dtype(columns)


@dataclass(frozen=True, slots=True)
class _Header:
    data: Data
    elements: tuple[_Element, ...]
    comments: tuple[str, ...]
    body: int
    lines: int


def parse(data: bytes, context: ReadContext) -> Cloud:
    """Parse all vertices. Raises UnreadableFile (line and keyword of the header, or the reason) or TooLarge."""
    header = _header(data)
    vertices = [e for e in header.elements if e.name == VERTEX]
    if len(vertices) != 1:
        raise unreadable_error(f"a PLY must have one element {VERTEX}, got {len(vertices)}", where=VERTEX)
    for element in header.elements:
        check_count(element.count, context)
    if vertices[0].lists:
        reason = "vertices with list properties are unsupported: save them with one value per property"
        raise unreadable_error(reason, vertices[0].line, VERTEX)
    columns = (_from_text if header.data == "ascii" else _from_binary)(data, header, context)
    check_columns(columns)
    further = {e.name: e.count for e in header.elements if e.name != VERTEX and e.count}
    return Cloud(columns, vertices[0].count, comments=header.comments, further=further)


def _header(data: bytes) -> _Header:
    kind: Data | None = None
    elements: list[_Element] = []
    comments: list[str] = []
    position, number = 0, 0
    while True:
        end = data.find(b"\n", position, HEADER_BYTES)
        if end < 0:
            raise unreadable_error("incomplete header: the line end_header is missing", number + 1, "end_header")
        number += 1
        line, position = data[position:end].decode("utf-8", "replace").strip(), end + 1
        key, *values = line.split() or [""]
        if number == 1:
            if line != "ply":
                raise unreadable_error("the first line must be 'ply'", 1)
        elif key in ("comment", "obj_info"):
            comments.append(line)
        elif key == "format":
            kind = next((k for k in KINDS if values == [k, "1.0"]), None)
            if kind is None:
                raise unreadable_error(
                    f"the format must be one of {', '.join(KINDS)} in version 1.0, got {line[:80]!r}", number
                )
        elif key == "element":
            if len(values) != 2 or not re.fullmatch(r"[0-9]{1,12}", values[1]):
                raise unreadable_error(
                    f"an element must have a name and a number, got {line[:80]!r}", number, "element"
                )
            elements.append(_Element(values[0], int(values[1]), [], number))
        elif key == "property":
            if not elements:
                raise unreadable_error("a property precedes the first element", number, "property")
            _add_property(elements[-1], values, line, number)
        elif key == "end_header":
            break
        elif key:
            raise unreadable_error(f"unknown keyword {key[:40]!r} in the header", number, key[:40])
    if kind is None:
        raise unreadable_error("the header has no format", where="format")
    return _Header(kind, tuple(elements), tuple(comments), position, number)


def _add_property(element: _Element, values: list[str], line: str, number: int) -> None:
    *types, name = values or [""]
    listed = types[:1] == ["list"]
    types = types[1:] if listed else types
    if len(types) != (2 if listed else 1) or any(t not in _TYPES for t in types):
        raise unreadable_error(
            f"a property must have a supported type and a name, got {line[:80]!r}", number, "property"
        )
    if listed and _TYPES[types[0]][0] == "f":
        raise unreadable_error(f"the length of a list must have an integer type, got {types[0]}", number, name[:40])
    if any(p.name == name for p in element.properties):
        raise unreadable_error(f"duplicate property {name[:40]!r} of {element.name[:40]}", number, name[:40])
    if len(element.properties) >= 1000:
        raise unreadable_error("an element has more than 1000 properties", number, element.name[:40])
    element.properties.append(_Property(name, _TYPES[types[-1]], _TYPES[types[0]] if listed else None))


def _from_text(data: bytes, header: _Header, context: ReadContext) -> dict[str, NDArray[Any]]:
    text = data[header.body :]
    if len(text) > context.limits.text_bytes:
        raise TooLarge(f"the points have {len(text)} bytes of text; the limit is {context.limits.text_bytes}")
    total = sum(e.count for e in header.elements)
    lines = text.count(b"\n") + (not text.endswith(b"\n"))
    if lines < total:
        raise unreadable_error(
            f"the header declares {total} elements, but the file has {lines} lines of them", header.lines + 1
        )
    before = 0
    for element in header.elements:
        if element.name == VERTEX:
            break
        before += element.count
    last = header.elements[-1].name == VERTEX
    rows = table(text, element.dtype("<"), element.count, header.lines + 1, before, alone=last)
    if len(rows) > element.count and last:
        context.warn(f"more rows follow the {element.count} vertices of the header; they are ignored", where=VERTEX)
    return {p.name: rows[f"{k}"][: element.count] for k, p in enumerate(element.properties)}


def _from_binary(data: bytes, header: _Header, context: ReadContext) -> dict[str, NDArray[Any]]:
    order = "<" if header.data == KINDS[0] else ">"
    position = header.body
    columns: dict[str, NDArray[Any]] = {}
    for element in header.elements:
        if element.lists:
            position = _end_of_lists(data, position, element, order)
            continue
        dtype = element.dtype(order)
        need = dtype.itemsize * element.count
        if len(data) - position < need:
            reason = f"{element.count} × {element.name[:40]} need {need} bytes, but the file has {len(data) - position}"
            raise unreadable_error(reason, element.line, element.name[:40])
        if element.name == VERTEX:
            rows = np.frombuffer(data, dtype, element.count, position)
            columns = {p.name: rows[f"{k}"] for k, p in enumerate(element.properties)}
        position += need
    if position < len(data):
        context.warn(f"{len(data) - position} bytes follow the last element; they are ignored")
    return columns


def _end_of_lists(data: bytes, start: int, element: _Element, order: str) -> int:
    """Find the end of an element with lists. Equal lengths (triangles) are checked at once, else row by row."""
    if not element.count:
        return start
    short = unreadable_error(f"the file ends within {element.name[:40]}", element.line, element.name[:40])

    # For each property: reader of a list's length, bytes of that length (or of the value), bytes of a list's value.
    parts = [
        (struct.Struct(order + _CODES[p.count]) if p.count else None, int((p.count or p.type)[1]), int(p.type[1]))
        for p in element.properties
    ]

    def row_end(position: int) -> tuple[int, list[int]]:
        sizes = []
        for length, first, each in parts:
            if length is not None:
                if position + first > len(data):
                    raise short
                (size,) = length.unpack_from(data, position)
                if size < 0:
                    raise short
                sizes.append(size)
                position += size * each
            position += first
            if position > len(data):
                raise short
        return position, sizes

    end, sizes = row_end(start)
    dtype = element.dtype(order, tuple(sizes))
    if start + dtype.itemsize * element.count <= len(data):
        rows = np.frombuffer(data, dtype, element.count, start)
        lists = [f"{k}n" for k, p in enumerate(element.properties) if p.count is not None]
        if all(bool((rows[name] == size).all()) for name, size in zip(lists, sizes, strict=True)):
            return start + rows.nbytes
    for _ in range(element.count - 1):
        end, _sizes = row_end(end)
    return end


# --- writing ------------------------------------------------------------------------------------------------------
def pack(cloud: Cloud, kind: Data) -> bytes:
    """Encode a PLY with vertices only. 64-bit integers, which PLY lacks, become doubles."""
    order = ">" if kind == "binary_big_endian" else "<"
    columns: dict[str, NDArray[Any]] = {}
    for name, column in _single(cloud.columns).items():
        code = f"{column.dtype.kind}{column.dtype.itemsize}"
        columns[name] = column.astype(order + (code if code in _NAMES else "f8"))
    header = ["ply", f"format {kind} 1.0", *cloud.comments, f"element {VERTEX} {len(cloud)}"]
    header += [f"property {_NAMES[f'{c.dtype.kind}{c.dtype.itemsize}']} {name}" for name, c in columns.items()]
    head = ("\n".join([*header, "end_header"]) + "\n").encode()
    if kind == "ascii":
        return head + text_rows(list(columns.values()), len(cloud))
    rows = np.empty(len(cloud), np.dtype([(name, c.dtype) for name, c in columns.items()]))
    for name, column in columns.items():
        rows[name] = column
    return head + rows.tobytes()


def _single(columns: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Make the columns' names unique and free of spaces."""
    out: dict[str, NDArray[Any]] = {}
    for name, column in columns.items():
        ascii_name = re.sub(r"[^!-~]", "_", name)
        out[ascii_name if ascii_name not in out else f"{ascii_name}_{len(out)}"] = column
    return out
