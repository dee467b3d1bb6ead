"""PCD files as point clouds: text header, and ``ascii``, ``binary`` or ``binary_compressed`` data.

Header lines ``VERSION``, ``FIELDS`` (``COLUMNS`` before 0.6), ``SIZE``, ``TYPE`` (I, U, F), ``COUNT``, ``WIDTH``,
``HEIGHT``, ``VIEWPOINT``, ``POINTS``, ``DATA``. Numbers are little endian. A field ``_`` is padding. Compressed data:
uint32 compressed and uncompressed size, then LZF of all values of the first field, then of the second …; PCL omits
padding there, others do not. Source: PCL's pcd_io.cpp and the format's documentation.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from app.errors import TooLarge
from app.formats import ReadContext
from app.formats.clouds.points import (
    IDENTITY_VIEWPOINT,
    RGB,
    Cloud,
    check_columns,
    check_count,
    table,
    unreadable_error,
)
from app.syntax.lzf import expand, squeeze

Data = Literal["ascii", "binary", "binary_compressed"]
KINDS: tuple[Data, ...] = get_args(Data)
WORDS = ("VERSION", "FIELDS", "COLUMNS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
HEADER_BYTES = 2**16
RECORD_BYTES = 2**16
PADDING = "_"
START = re.compile(rb"(?:\xef\xbb\xbf)?(?:[ \t]*(?:#[^\n]*)?\r?\n)*[ \t]*(?:VERSION|FIELDS|COLUMNS)[ \t]")

_TYPES = {f"{kind}{size}": f"<{kind.lower()}{size}" for kind in "IU" for size in (1, 2, 4, 8)}
_TYPES |= {"F4": "<f4", "F8": "<f8"}


def detect(name: str, data: bytes) -> bool:
    """Detect a header that starts with a version or fields, after comments, and declares its data."""
    del name
    head = data[:HEADER_BYTES]
    return START.match(head) is not None and re.search(rb"^[ \t]*DATA[ \t]", head, re.MULTILINE) is not None


@dataclass(frozen=True, slots=True)
class _Field:
    """Field of the header. position: index of its first column in text rows."""

    name: str
    dtype: np.dtype[Any]
    count: int


@dataclass(frozen=True, slots=True)
class _Header:
    fields: tuple[_Field, ...]
    width: int
    height: int
    viewpoint: tuple[float, ...]
    comments: tuple[str, ...]
    data: Data
    body: int
    lines: int


def parse(data: bytes, context: ReadContext) -> Cloud:
    """Parse all points. Raises UnreadableFile (line and keyword of the header, or the reason) or TooLarge."""
    header = _header(data, context)
    count = header.width * header.height
    check_count(count, context)
    record = sum(f.dtype.itemsize * f.count for f in header.fields)
    if record > RECORD_BYTES:
        raise unreadable_error(f"a point has {record} bytes; the limit is {RECORD_BYTES}", where="SIZE")
    if header.data == "ascii":
        columns = _from_text(data, header, count, context)
    elif header.data == "binary":
        columns = _from_binary(data, header, count, record, context)
    else:
        columns = _from_compressed(data, header, count, context)
    check_columns(columns)
    return Cloud(columns, header.width, header.height, header.viewpoint, header.comments)


def _header(data: bytes, context: ReadContext) -> _Header:
    entries: dict[str, tuple[list[str], int]] = {}
    comments: list[str] = []
    position, number = 3 if data.startswith(b"\xef\xbb\xbf") else 0, 0
    while "DATA" not in entries:
        end = data.find(b"\n", position, HEADER_BYTES)
        if end < 0:
            raise unreadable_error("incomplete header: the line DATA is missing", number + 1, "DATA")
        number += 1
        line, position = data[position:end].decode("utf-8", "replace").strip(), end + 1
        if line.startswith("#"):
            comments.append(line)
            continue
        key, *values = line.split() or [""]
        if key in WORDS:
            entries[key] = (values, number)
        elif key:
            context.warn(f"unknown keyword {key[:40]!r} in the header; it is ignored", line=number, where=key[:40])
    for key in ("SIZE", "TYPE", "WIDTH"):
        if key not in entries:
            raise unreadable_error(f"the header has no {key}", where=key)
    fields = _fields(entries)
    width = _integer(entries, "WIDTH")
    height = _integer(entries, "HEIGHT") if "HEIGHT" in entries else 1
    if "POINTS" in entries and _integer(entries, "POINTS") != width * height:
        reason = f"POINTS is {_integer(entries, 'POINTS')}, but WIDTH × HEIGHT is {width * height}"
        raise unreadable_error(reason, entries["POINTS"][1], "POINTS")
    (kind, *_), line_number = entries["DATA"][0] or [""], entries["DATA"][1]
    data_kind = next((k for k in KINDS if k == kind), None)
    if data_kind is None:
        raise unreadable_error(f"DATA must be one of {', '.join(KINDS)}, got {kind[:40]!r}", line_number, "DATA")
    user_comments = [c for c in comments if not c.startswith("# .PCD")]
    return _Header(fields, width, height, _viewpoint(entries), tuple(user_comments), data_kind, position, number)


def _fields(entries: Mapping[str, tuple[list[str], int]]) -> tuple[_Field, ...]:
    key = "FIELDS" if "FIELDS" in entries else "COLUMNS"
    if key not in entries:
        raise unreadable_error("the header has no FIELDS", where="FIELDS")
    names, line = entries[key]
    counts, count_line = entries.get("COUNT", (["1"] * len(names), line))
    (sizes, size_line), (types, type_line) = entries["SIZE"], entries["TYPE"]
    for label, values, at in (("SIZE", sizes, size_line), ("TYPE", types, type_line), ("COUNT", counts, count_line)):
        if len(values) != len(names):
            raise unreadable_error(f"{label} has {len(values)} values for {len(names)} fields", at, label)
    out = []
    seen: set[str] = set()
    for name, size, kind, count in zip(names, sizes, types, counts, strict=True):
        dtype = _TYPES.get(f"{kind}{size}")
        if dtype is None:
            raise unreadable_error(f"field {name[:40]}: unknown type {kind[:8]} of {size[:8]} bytes", type_line, "TYPE")
        if not re.fullmatch(r"[1-9][0-9]{0,4}", count):
            raise unreadable_error(
                f"field {name[:40]}: COUNT must be a number from 1 to 99999, got {count[:8]!r}", count_line, "COUNT"
            )
        if name != PADDING and name in seen:
            raise unreadable_error(f"duplicate field {name[:40]!r}", line, key)
        seen.add(name)
        out.append(_Field(name, np.dtype(dtype), int(count)))
    return tuple(out)


def _integer(entries: Mapping[str, tuple[list[str], int]], key: str) -> int:
    values, line = entries[key]
    if len(values) != 1 or not re.fullmatch(r"[0-9]{1,12}", values[0]):
        raise unreadable_error(f"{key} must be an integer, got {' '.join(values)[:40]!r}", line, key)
    return int(values[0])


def _viewpoint(entries: Mapping[str, tuple[list[str], int]]) -> tuple[float, ...]:
    if "VIEWPOINT" not in entries:
        return IDENTITY_VIEWPOINT
    values, line = entries["VIEWPOINT"]
    pattern = r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d{1,3})?"
    if len(values) != 7 or not all(re.fullmatch(pattern, v, re.ASCII) for v in values):
        raise unreadable_error(f"VIEWPOINT must be seven numbers, got {' '.join(values)[:80]!r}", line, "VIEWPOINT")
    numbers = tuple(float(v) + 0.0 for v in values)
    if not all(map(math.isfinite, numbers)):
        raise unreadable_error("VIEWPOINT must be seven finite numbers", line, "VIEWPOINT")
    return numbers


def _dtype(fields: tuple[_Field, ...]) -> np.dtype[Any]:
    return np.dtype([(f"{k}", f.dtype, (f.count,)) if f.count > 1 else (f"{k}", f.dtype) for k, f in enumerate(fields)])


def _columns(rows: NDArray[Any], fields: tuple[_Field, ...]) -> dict[str, NDArray[Any]]:
    return {f.name: rows[f"{k}"] for k, f in enumerate(fields) if f.name != PADDING}


def _from_text(data: bytes, header: _Header, count: int, context: ReadContext) -> dict[str, NDArray[Any]]:
    if len(data) - header.body > context.limits.text_bytes:
        raise TooLarge(
            f"the points have {len(data) - header.body} bytes of text; the limit is {context.limits.text_bytes}"
        )
    flat = np.dtype([(f"{k}.{j}", f.dtype) for k, f in enumerate(header.fields) for j in range(f.count)])
    rows = table(data[header.body :], flat, count, header.lines + 1)
    if len(rows) > count:
        context.warn(f"more rows follow the {count} points of the header; they are ignored", where="POINTS")
    return _columns(np.ascontiguousarray(rows[:count]).view(_dtype(header.fields)), header.fields)


def _from_binary(
    data: bytes, header: _Header, count: int, record: int, context: ReadContext
) -> dict[str, NDArray[Any]]:
    body_size = len(data) - header.body
    if body_size < count * record:
        raise unreadable_error(
            f"{count} points of {record} bytes need {count * record} bytes, but the file has {body_size}", where="DATA"
        )
    if body_size > count * record:
        context.warn(f"{body_size - count * record} bytes follow the last point; they are ignored", where="DATA")
    return _columns(np.frombuffer(data, _dtype(header.fields), count, header.body), header.fields)


def _from_compressed(data: bytes, header: _Header, count: int, context: ReadContext) -> dict[str, NDArray[Any]]:
    if not count and len(data) - header.body < 8:
        return {f.name: np.empty(0, f.dtype) for f in header.fields if f.name != PADDING}
    if len(data) - header.body < 8:
        raise unreadable_error("the sizes of the compressed data are missing", where="DATA")
    packed, size = struct.unpack_from("<II", data, header.body)
    real = tuple(f for f in header.fields if f.name != PADDING)
    fields = next(
        (fields for fields in (real, header.fields) if size == count * sum(f.dtype.itemsize * f.count for f in fields)),
        None,
    )
    if fields is None:
        raise unreadable_error(f"{count} points do not match the uncompressed size of {size} bytes", where="DATA")
    start = header.body + 8
    if len(data) - start < packed:
        raise unreadable_error(
            f"the compressed data has {len(data) - start} bytes, but the file declares {packed}", where="DATA"
        )
    context.limits.check_unpacked(size, packed)
    try:
        flat = expand(data[start : start + packed], size)
    except ValueError as error:
        raise unreadable_error(str(error), where="DATA") from error
    out: dict[str, NDArray[Any]] = {}
    offset = 0
    for f in fields:
        values = np.frombuffer(flat, f.dtype, count * f.count, offset)
        offset += values.nbytes
        if f.name != PADDING:
            out[f.name] = values if f.count == 1 else values.reshape(count, f.count)
    return out


# --- writing ------------------------------------------------------------------------------------------------------
def pack(cloud: Cloud, kind: Data) -> bytes:
    """Encode a PCD of version 0.7."""
    columns = {name: np.ascontiguousarray(c, c.dtype.newbyteorder("<")) for name, c in cloud.columns.items()}
    if kind == "ascii":  # packed colours with alpha 255 are NaN as floats; PCL writes integers, too
        columns |= {
            name: c.view("<u4") for name, c in columns.items() if name in ("rgb", "rgba") and c.dtype == np.float32
        }
    n = len(cloud)
    counts = [1 if c.ndim == 1 else c.shape[1] for c in columns.values()]
    header = [
        "# .PCD v0.7 - Point Cloud Data file format",
        *cloud.comments,
        "VERSION 0.7",
        f"FIELDS {' '.join(columns)}",
        f"SIZE {' '.join(str(c.dtype.itemsize) for c in columns.values())}",
        f"TYPE {' '.join(c.dtype.kind.upper() for c in columns.values())}",
        f"COUNT {' '.join(map(str, counts))}",
        f"WIDTH {cloud.width}",
        f"HEIGHT {cloud.height}",
        f"VIEWPOINT {' '.join(f'{v:.17g}' for v in cloud.viewpoint)}",
        f"POINTS {n}",
        f"DATA {kind}",
    ]
    return ("\n".join(header) + "\n").encode() + _body(columns, n, kind)


def _body(columns: Mapping[str, NDArray[Any]], n: int, kind: Data) -> bytes:
    if kind == "binary_compressed":
        flat = b"".join(c.tobytes() for c in columns.values())
        packed = squeeze(flat)
        return struct.pack("<II", len(packed), len(flat)) + packed
    if kind == "binary":
        dtype = np.dtype([(name, c.dtype, c.shape[1:]) for name, c in columns.items()])
        rows = np.empty(n, dtype)
        for name, column in columns.items():
            rows[name] = column
        return rows.tobytes()
    return text_rows([c if c.ndim == 1 else c[:, k] for c in columns.values() for k in range(c.size // max(n, 1))], n)


def text_rows(columns: list[NDArray[Any]], n: int) -> bytes:
    """Format rows as the shortest texts that read back as the same values, a few thousand at a time."""
    out = []
    for start in range(0, n, 2**14):
        texts = [
            c[start : start + 2**14].astype("U") if c.dtype.kind == "f" else map(str, c[start : start + 2**14].tolist())
            for c in columns
        ]
        out.append("".join(" ".join(row) + "\n" for row in zip(*texts, strict=True)))
    return "".join(out).encode()


def add_padding(columns: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Rename columns as in PCL: normals to ``normal_x`` …, colours packed into one ``rgb``."""
    out: dict[str, NDArray[Any]] = {}
    names = {"nx": "normal_x", "ny": "normal_y", "nz": "normal_z"}
    coloured = all(name in columns for name in RGB)
    for name, column in columns.items():
        if coloured and name in RGB:
            if name == RGB[0]:
                red, green, blue = (columns[c].astype(np.uint32) for c in RGB)
                packed = red << np.uint32(16) | green << np.uint32(8) | blue
                if "alpha" in columns:
                    out["rgba"] = packed | columns["alpha"].astype(np.uint32) << np.uint32(24)
                else:
                    out["rgb"] = packed.astype("<u4").view("<f4")
        elif not (name == "alpha" and coloured):
            ascii_name = names.get(name, re.sub(r"[^!-~]", "_", name))
            out[ascii_name if ascii_name not in out and ascii_name != PADDING else f"{ascii_name}_{len(out)}"] = column
    return out
