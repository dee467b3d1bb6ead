"""How blobs are kept: as they are, compressed (zstd), or as the difference from a similar blob.

A difference is one of two kinds, whichever is smaller. ``patch``: zstd with the similar blob as the dictionary, which
follows text that moved. ``xor``: zstd of the exclusive or of both, for blobs of equal size: of a grid with much
repetition, whose cells do not move, it takes a hundredth of a patch. Both are compressed once more: they are long runs.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final, Literal

import numpy as np

from app.backends.blobs import BLOCK

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

Coding = Literal["zstd", "patch", "xor"]

MAX_PATCHED: Final = 64 * 2**20
"""Maximum size in bytes of a content that is kept as a patch, or serves as the base of one: both are in memory."""

PAYS: Final = 0.9
"""Share of the size that a compressed blob may have, else it is kept as it is."""

CLEARLY: Final = 1000
"""How many times smaller than its content a difference is that no other kind is tried for."""

LEVEL: Final = 3
_OPTIONS: Final[dict[int, int]] = {
    zstd.CompressionParameter.compression_level: LEVEL,
    zstd.CompressionParameter.checksum_flag: 0,
}
_WINDOW: Final = 27
"""Base-2 logarithm of the window of patches, which spans the base and the content."""


class Undecodable(ValueError):
    """Stored bytes that are no zstd of this kind."""


def compress_bytes(data: bytes) -> bytes | None:
    """Compress; None if it does not pay."""
    out = zstd.compress(data, options=_OPTIONS)
    return out if len(out) < len(data) * PAYS else None


def compress_file(source: bytes | Path, target: Path) -> int:
    """Compress into a file; returns its size. The whole content is never in memory if it is in a file."""
    compressor = zstd.ZstdCompressor(options=_OPTIONS)
    with target.open("wb") as out:
        for piece in pieces(source):
            out.write(compressor.compress(piece))
        out.write(compressor.flush())
        return out.tell()


def make_difference(base: bytes, content: bytes) -> tuple[Coding, bytes]:
    """Return the smaller difference of a content from another."""
    xor: bytes | None = None
    if len(base) == len(content):
        xor = zstd.compress(zstd.compress(_xor(base, content), options=_OPTIONS))
        if len(xor) * CLEARLY < len(content):
            return "xor", xor
    options: dict[int, int] = {
        zstd.CompressionParameter.compression_level: LEVEL,
        zstd.CompressionParameter.window_log: _WINDOW,
        zstd.CompressionParameter.enable_long_distance_matching: 1,
        zstd.CompressionParameter.checksum_flag: 0,
    }
    dictionary = zstd.ZstdDict(base, is_raw=True)
    patch = zstd.compress(zstd.compress(content, options=options, zstd_dict=dictionary.as_prefix))
    return ("patch", patch) if xor is None or len(patch) < len(xor) else ("xor", xor)


def _xor(one: bytes | memoryview, other: bytes) -> bytes:
    return np.bitwise_xor(np.frombuffer(one, np.uint8), np.frombuffer(other, np.uint8)).tobytes()


def decoded(chunks: Iterable[bytes], coding: Coding | None, base: bytes = b"") -> Iterator[bytes]:
    """Decode stored pieces to pieces of the content. Raises Undecodable; the hash is the caller's to check."""
    if coding is None:
        yield from chunks
        return
    try:
        inner = _decompress(chunks, zstd.ZstdDecompressor())
        if coding == "zstd":
            yield from inner
        elif coding == "xor":
            yield from _apply_xor(_decompress(inner, zstd.ZstdDecompressor()), base)
        else:
            dictionary = zstd.ZstdDict(base, is_raw=True).as_prefix
            options: dict[int, int] = {zstd.DecompressionParameter.window_log_max: _WINDOW}
            yield from _decompress(inner, zstd.ZstdDecompressor(zstd_dict=dictionary, options=options))
    except (zstd.ZstdError, EOFError, ValueError) as error:
        raise Undecodable(str(error)) from error


def _apply_xor(chunks: Iterable[bytes], base: bytes) -> Iterator[bytes]:
    at, view = 0, memoryview(base)
    for chunk in chunks:
        yield _xor(view[at : at + len(chunk)], chunk)
        at += len(chunk)


def pieces(source: bytes | Path) -> Iterator[bytes]:
    """Read a content in pieces."""
    if isinstance(source, bytes):
        yield source
        return
    with source.open("rb") as file:
        while block := file.read(BLOCK):
            yield block


def _decompress(chunks: Iterable[bytes], decompressor: zstd.ZstdDecompressor) -> Iterator[bytes]:
    """Decompress piece by piece, so that wrong bytes cannot fill the memory."""
    for chunk in chunks:
        data = chunk
        while not decompressor.eof:
            out = decompressor.decompress(data, BLOCK)
            data = b""
            if out:
                yield out
            if decompressor.needs_input:
                break
        if decompressor.eof:
            return
    raise Undecodable("the end is missing")
