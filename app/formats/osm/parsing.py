"""Parse OpenStreetMap files into columns of nodes, ways and relations: XML, compressed XML, PBF.

There are two XML parsers. Files in the form of the OSM tools (double quotes, one attribute order, no comments) are
checked by expat, which needs no memory, and scanned by regular expressions whose matches are compared with the number
of tags (``scanning``). Everything else goes through lxml's event parser (``strict``), which is slower and
authoritative: the fast parser leaves to it everything that it does not support.
"""

from __future__ import annotations

import bz2
import zlib
from collections.abc import Callable
from typing import Any

from app.errors import Problem, UnreadableFile
from app.formats.osm.elements import Data
from app.formats.osm.scanning import scan
from app.formats.osm.strict import read_events, read_pbf
from app.limits import Limits
from app.syntax import xml


def parse(data: bytes, limits: Limits, *, highways_only: bool = False) -> Data:
    """Parse any OSM container. highways_only: skip ways without a ``highway`` tag, and relations.

    Raises UnreadableFile (with a line if known) or TooLarge.
    """
    if is_pbf(data):
        return read_pbf(data, limits)
    data = unpack(data, limits)
    if is_pbf(data):
        return read_pbf(data, limits)
    if not data.strip():
        raise UnreadableFile("the file is empty", [Problem("empty file", line=1)])
    xml.check_prolog(data)
    return scan(data, limits, highways_only) or read_events(data, limits)


def unpack(data: bytes, limits: Limits, limit: int | None = None) -> bytes:
    """Decompress ``.gz`` or ``.bz2``, else return the bytes unchanged. limit: stop after that many bytes."""
    if data[:2] == b"\x1f\x8b":
        new: Callable[[], Any] = lambda: zlib.decompressobj(wbits=31)  # noqa: E731
    elif data[:3] == b"BZh":
        new = bz2.BZ2Decompressor
    else:
        return data
    out, remainder, size = [], data, 0
    bound = limits.max_unpacked(len(data)) if limit is None else limit
    try:
        while remainder:
            stream = new()
            while not stream.eof:
                piece = stream.decompress(remainder, 2**20)
                out.append(piece)
                size += len(piece)
                if size > bound:
                    if limit is not None:
                        return b"".join(out)[:limit]
                    limits.check_unpacked(size, len(data))
                remainder = stream.unconsumed_tail if hasattr(stream, "unconsumed_tail") else b""
                if not piece and not remainder and not stream.eof:
                    if limit is not None:
                        return b"".join(out)
                    raise UnreadableFile("the compressed file is truncated", [Problem("truncated")])
            remainder = stream.unused_data
    except (zlib.error, OSError) as error:
        if limit is not None:
            return b"".join(out)
        raise UnreadableFile(f"the file cannot be decompressed: {error}", [Problem(str(error))]) from error
    return b"".join(out)


def is_pbf(data: bytes) -> bool:
    """Whether these bytes begin like a ``.pbf``: a length and the type of its first block."""
    return data[4:6] == b"\x0a\x09" and data[6:15] == b"OSMHeader"
