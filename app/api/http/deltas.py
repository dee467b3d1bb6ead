"""File deltas (RFC 9842): a file compressed with ``dcz``, with a file that the client has as the dictionary.

Exact bytes of any format at the cost of the changes: one moved node of a 400 kB network takes some hundred bytes.
"""

from __future__ import annotations

import base64
import binascii
import sys
import threading
from collections import OrderedDict
from collections.abc import Mapping

from app.api.http.single_flight import SingleFlight
from app.convert.cache import Cache, CachedFile

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

MAGIC = bytes.fromhex("5e2a4d1820000000")
MAX_BYTES = 64 * 2**20
"""Maximum size of a file for deltas; a client needs a window of that size."""

MIN_BYTES = 8
"""Minimum size of a dictionary for Zstandard."""

LEVEL = 3


class Deltas:
    """Cache of deltas; concurrent requests for one delta share one compression."""

    def __init__(self, cache: Cache, room: int = 64 * 2**20) -> None:
        self._cache, self._room, self._size = cache, room, 0
        self._cached: OrderedDict[tuple[str, str], bytes | None] = OrderedDict()
        self._running: SingleFlight[tuple[str, str], bytes | None] = SingleFlight()
        self._lock = threading.Lock()

    async def between(self, old: str, new: str, body: bytes | CachedFile) -> bytes | None:
        """Return ``dcz`` of the new file (by SHA-256) against an old one.

        None if the old one is not cached or the delta is not smaller than the file.
        """
        key = (old, new)
        with self._lock:
            if key in self._cached:
                self._cached.move_to_end(key)
                return self._cached[key]
        return await self._running.run(key, self._between, key, body)

    def _between(self, key: tuple[str, str], body: bytes | CachedFile) -> bytes | None:
        before = self._cache.find_by_hash(key[0], MAX_BYTES)
        if before is None:
            return None  # not cached: the old file may appear at any time, and clients can send any hash
        delta = _smaller(before, body if isinstance(body, bytes) else body.read(), bytes.fromhex(key[0]))
        with self._lock:
            self._cached[key] = delta
            self._size += len(delta or b"") + 200
            while self._size > self._room and len(self._cached) > 1:
                _, dropped = self._cached.popitem(last=False)
                self._size -= len(dropped or b"") + 200
        return delta


def _smaller(before: bytes, after: bytes, digest: bytes) -> bytes | None:
    if len(before) < MIN_BYTES:
        return None
    delta = compress(before, after, digest) if after else b""
    return delta if len(delta) < len(after) else None


def compress(before: bytes, after: bytes, digest: bytes) -> bytes:
    """Compress with a dictionary (RFC 9842). digest: SHA-256 of ``before``, which needs at least 8 bytes."""
    window = max(10, min(27, max(len(before), len(after), 1).bit_length()))
    options: dict[int, int] = {
        zstd.CompressionParameter.compression_level: LEVEL,
        zstd.CompressionParameter.window_log: window,
        zstd.CompressionParameter.enable_long_distance_matching: int(len(before) > 2**20),
        zstd.CompressionParameter.checksum_flag: 1,
    }
    dictionary = zstd.ZstdDict(before, is_raw=True)
    return MAGIC + digest + zstd.compress(after, options=options, zstd_dict=dictionary.as_prefix)


def offered_dictionary(headers: Mapping[str, str]) -> str | None:
    """Return the SHA-256 (hex) of the dictionary that a client offers, if it accepts ``dcz``."""
    header = headers.get("available-dictionary")
    if header is None:
        return None
    codings = {}
    for part in headers.get("accept-encoding", "").split(","):
        name, _, rest = part.strip().partition(";")
        codings[name.strip().lower()] = rest.replace(" ", "")
    if "dcz" not in codings or codings["dcz"] in ("q=0", "q=0.0", "q=0.00", "q=0.000"):
        return None
    text = header.strip()
    if not (text.startswith(":") and text.endswith(":") and len(text) > 2):
        return None
    try:
        digest = base64.b64decode(text[1:-1], validate=True)
    except (binascii.Error, ValueError):
        return None
    return digest.hex() if len(digest) == 32 else None
