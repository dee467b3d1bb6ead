"""LZF compression, used by ``binary_compressed`` PCD files.

A byte n below 32 is followed by n + 1 literal bytes. Any other byte is a back reference: its upper three bits are the
length - 2 (7: the next byte is added), its lower five bits and the next byte are the distance - 1. Source: liblzf's
lzf_d.c and lzf_c.c, as in PCL.

The same loops run in plain Python for little data and as native code by Numba for more (compiling takes a second).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAX_INTERPRETED_BYTES = 2**22
"""Size in bytes up to which compiling takes longer than it saves."""

MAX_MATCH_BYTES = 264
TABLE_BITS = 14

Bytes = NDArray[np.uint8]


def expand(data: bytes, size: int) -> bytes:
    """Decompress a stream to exactly ``size`` bytes; allocates no more. Raises ValueError if the size differs."""
    if size > len(data) * MAX_MATCH_BYTES:  # a reference of two or three bytes yields at most that
        raise ValueError(f"{len(data)} compressed bytes cannot decompress to {size} bytes")
    if size <= MAX_INTERPRETED_BYTES and len(data) <= MAX_INTERPRETED_BYTES:
        little = bytearray(size)
        end = _expand(data, little)
        out = bytes(little)
    else:
        large = np.empty(size, np.uint8)
        end = _compile(_expand)(np.frombuffer(data, np.uint8), large)
        out = large.tobytes()
    if end < 0:
        raise ValueError("the compressed data is damaged: invalid back reference or wrong length")
    if end != size:
        raise ValueError(f"the compressed data decompresses to {end} bytes, the file declares {size}")
    return out


def squeeze(data: bytes) -> bytes:
    """Compress data; the result is the same on every machine."""
    room = len(data) + len(data) // 32 + 16
    if len(data) <= MAX_INTERPRETED_BYTES // 16:
        little = bytearray(room)
        return bytes(little[: _squeeze(data, little, [-1] * 2**TABLE_BITS)])
    large = np.empty(room, np.uint8)
    table = np.full(2**TABLE_BITS, -1, np.int64)
    end = _compile(_squeeze)(np.frombuffer(data, np.uint8), large, table)
    return large[:end].tobytes()


@cache
def _compile(function: Callable[..., int]) -> Callable[..., int]:
    import numba

    compiled: Callable[..., int] = numba.njit(function)
    return compiled


def _expand(data: Any, out: Any) -> int:
    """Return the number of bytes written, or -1 for an invalid stream."""
    i, o, n, room = 0, 0, len(data), len(out)
    while i < n:
        control = int(data[i])
        i += 1
        if control < 32:
            length = control + 1
            if i + length > n or o + length > room:
                return -1
            for _ in range(length):
                out[o] = data[i]
                i += 1
                o += 1
            continue
        length = control >> 5
        if length == 7:
            if i >= n:
                return -1
            length += int(data[i])
            i += 1
        if i >= n:
            return -1
        back = o - (((control & 31) << 8) | int(data[i])) - 1
        i += 1
        length += 2
        if back < 0 or o + length > room:
            return -1
        for _ in range(length):
            out[o] = out[back]
            o += 1
            back += 1
    return o


def _squeeze(data: Any, out: Any, table: Any) -> int:
    """Return the number of bytes written. table: last position of three bytes by their hash, initially -1."""
    i, o, n, literal = 0, 0, len(data), 0
    while i < n:
        length = 0
        before = 0
        if i + 2 < n:
            triple = (int(data[i]) << 16) | (int(data[i + 1]) << 8) | int(data[i + 2])
            slot = ((triple * 2654435761) >> 12) & 16383
            before = int(table[slot])
            table[slot] = i
            if before >= 0 and i - before <= 8192:
                max_length = min(n - i, 264)
                while length < max_length and data[before + length] == data[i + length]:
                    length += 1
        if length < 3:
            i += 1
            literal += 1
        if literal and (length >= 3 or literal == 32 or i == n):
            out[o] = literal - 1
            o += 1
            for k in range(i - literal, i):
                out[o] = data[k]
                o += 1
            literal = 0
        if length >= 3:
            away, more = i - before - 1, length - 2
            if more < 7:
                out[o] = (more << 5) | (away >> 8)
            else:
                out[o] = (7 << 5) | (away >> 8)
                o += 1
                out[o] = more - 7
            out[o + 1] = away & 255
            o += 2
            i += length
    return o
