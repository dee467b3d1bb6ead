"""Small readers of cloud files for tests: slow, simple, and independent of the product's code."""

from __future__ import annotations

import struct
from functools import lru_cache
from typing import Any

LETTERS = {"F4": "f", "F8": "d", "U1": "B", "U2": "H", "U4": "I", "U8": "Q", "I1": "b", "I2": "h", "I4": "i", "I8": "q"}
PLY = {"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d"}


@lru_cache(maxsize=2)
def pcd(data: bytes) -> tuple[dict[str, str], list[list[Any]]]:
    """Return header and points, each a list of all values without padding, floats in their own precision."""
    head, _, rest = data.partition(b"DATA ")
    kind, _, body = rest.partition(b"\n")
    header = {
        line.split()[0]: line.partition(" ")[2].strip()
        for line in head.decode().splitlines()
        if line.strip() and line[0] != "#"
    }
    names = header["FIELDS"].split()
    types = [LETTERS[t + s] for t, s in zip(header["TYPE"].split(), header["SIZE"].split(), strict=True)]
    counts = list(map(int, header["COUNT"].split()))
    n = int(header["POINTS"])
    real = [k for k, name in enumerate(names) if name != "_"]
    if kind.strip() == b"ascii":
        points = []
        for row in body.decode().splitlines()[:n]:
            tokens = row.split()
            values: list[Any] = []
            for name, t, c in zip(names, types, counts, strict=True):
                for _ in range(c):
                    token = tokens.pop(0)
                    if name != "_":
                        values.append(struct.unpack(t, struct.pack(t, float(token) if t in "fd" else int(token)))[0])
            assert not tokens
            points.append(values)
        return header, points
    if kind.strip() == b"binary":
        record = struct.Struct("<" + "".join(f"{c}x" * struct.calcsize(t) if name == "_" else f"{c}{t}" for name, t, c in zip(names, types, counts, strict=True)))  # fmt: skip  # noqa: E501
        return header, [list(record.unpack_from(body, k * record.size)) for k in range(n)]
    packed, size = struct.unpack_from("<II", body)
    flat = lzf(body[8 : 8 + packed])
    assert len(flat) == size
    points = [[] for _ in range(n)]
    offset = 0
    for k in real:
        for p in points:
            p += struct.unpack_from(f"<{counts[k]}{types[k]}", flat, offset)
            offset += counts[k] * struct.calcsize(types[k])
    return header, points


def lzf(data: bytes) -> bytes:
    """Decompress an LZF stream."""
    out = bytearray()
    stream = iter(data)
    for control in stream:
        if control < 32:
            out += bytes(next(stream) for _ in range(control + 1))
            continue
        length = (control >> 5) + (next(stream) if control >> 5 == 7 else 0) + 2
        back = (control & 31) * 256 + next(stream) + 1
        for _ in range(length):
            out.append(out[-back])
    return bytes(out)


def ply(data: bytes) -> tuple[list[str], list[list[Any]]]:
    """Return property names and vertices of a PLY with vertices as first element, without lists."""
    head, _, body = data.partition(b"end_header\n")
    lines = head.decode().splitlines()
    start = next(k for k, line in enumerate(lines) if line.startswith("element vertex"))
    n = int(lines[start].split()[2])
    properties = []
    for line in lines[start + 1 :]:
        if not line.startswith("property"):
            break
        properties.append(line.split()[1:])
    types = "".join(PLY[t] for t, _ in properties)
    if "format ascii" in head.decode():
        rows = [line.split() for line in body.decode().splitlines()[:n]]
        return [name for _, name in properties], [
            [float(v) if t in "fd" else int(v) for v, t in zip(row, types, strict=True)] for row in rows
        ]
    record = struct.Struct((">" if "big" in head.decode() else "<") + types)
    return [name for _, name in properties], [list(record.unpack_from(body, k * record.size)) for k in range(n)]
