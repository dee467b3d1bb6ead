"""Compression of JSON responses as ASGI middleware: zstd or gzip, as the client accepts.

Left alone: files (maps, sources, images, converted files), ranges, deltas, signed manifests, event streams, and
responses that the response cache repeats within microseconds. A compressed response has other bytes, so its ETag
becomes weak; conditions compare weakly, and ``If-Match`` names versions, so clients may send it back as it is.
"""

from __future__ import annotations

import sys
import zlib
from collections.abc import Callable

from starlette.concurrency import run_in_threadpool
from starlette.types import ASGIApp, Message, Receive, Scope, Send

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

MIN_BYTES = 1024
"""Minimum size of a compressed response: smaller ones fit into one packet."""

SMALL_DIGITS = 3
"""Maximum number of digits of a Content-Length that is small for certain."""

INLINE_BYTES = 32 * 2**10
"""Maximum size of a response that is compressed at once, in less than a millisecond; others are in a thread."""

GZIP_LEVEL = 5
ZSTD_LEVEL = 3
_GZIP_WINDOW = 31
"""Window of 2^15 bytes, with the header and trailer of gzip."""

UNCOMPRESSED = "uncompressed"
"""Key of ``scope["state"]``: the response is sent as it is."""

_BINARY = frozenset(
    {b"content-encoding", b"content-range", b"accept-ranges", b"content-disposition", b"fleetmap-signature"}
)
"""Headers of responses whose bytes count."""


def _gzip(body: bytes) -> bytes:
    packer = zlib.compressobj(GZIP_LEVEL, zlib.DEFLATED, _GZIP_WINDOW)
    return packer.compress(body) + packer.flush()


def _zstd(body: bytes) -> bytes:
    return zstd.compress(body, ZSTD_LEVEL)


CODINGS: dict[bytes, Callable[[bytes], bytes]] = {b"zstd": _zstd, b"gzip": _gzip}
"""Supported codings, the preferred one first."""


class JsonCompression:
    """ASGI middleware around everything but the response cache."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, and compress its response."""
        if scope["type"] != "http" or scope["method"] == "HEAD":
            await self._app(scope, receive, send)
        else:
            await self._app(scope, receive, _Compressor(scope, send))


class _Compressor:
    """Wrapper of ``send``: holds the start of a JSON response until its body arrives."""

    __slots__ = ("_scope", "_send", "_start")

    def __init__(self, scope: Scope, send: Send) -> None:
        self._scope, self._send = scope, send
        self._start: Message | None = None

    async def __call__(self, message: Message) -> None:
        if message["type"] == "http.response.start":
            if message["status"] == 304:
                message = _with_condition(message, self._scope)
            elif _is_compressible(message) and not self._scope.get("state", {}).get(UNCOMPRESSED):
                self._start = message
                return
            await self._send(message)
            return
        start, self._start = self._start, None
        if start is not None:
            start, message = await self._compress(start, message)
            await self._send(start)
        await self._send(message)

    async def _compress(self, start: Message, message: Message) -> tuple[Message, Message]:
        body = message.get("body", b"")
        if message.get("more_body", False) or len(body) < MIN_BYTES:  # a stream, or not worth it
            return start, message
        headers = _with_vary(list(start["headers"]))
        coding = accepted_coding(_header(self._scope, b"accept-encoding"))
        if coding is not None:
            pack = CODINGS[coding]
            packed = pack(body) if len(body) <= INLINE_BYTES else await run_in_threadpool(pack, body)
            headers = [(name, _weak(value) if name == b"etag" else value) for name, value in headers]
            headers = [item for item in headers if item[0] != b"content-length"]
            headers += [(b"content-encoding", coding), (b"content-length", str(len(packed)).encode())]
            message = {**message, "body": packed}
        return {**start, "headers": headers}, message


def accepted_coding(accept_encoding: bytes) -> bytes | None:
    """Select the coding that the client prefers (RFC 9110, 12.5.3); None for the plain bytes."""
    if not accept_encoding:
        return None
    qualities: dict[bytes, float] = {}
    for item in accept_encoding.lower().split(b",")[:50]:
        name, _, parameter = item.partition(b";")
        weight = parameter.strip()
        try:
            qualities[name.strip()] = float(weight[2:]) if weight.startswith(b"q=") else 1.0
        except ValueError:
            qualities[name.strip()] = 0.0
    other = qualities.get(b"*", 0.0)
    quality, coding = max(((qualities.get(name, other), name) for name in CODINGS), key=lambda pair: pair[0])
    return coding if quality > 0.0 and quality >= qualities.get(b"identity", 0.0) else None


def _is_compressible(start: Message) -> bool:
    """Test if a response is JSON that is not a file, and not known to be small."""
    compressible = False
    for name, value in start.get("headers", ()):
        if name == b"content-length":
            if len(value) <= SMALL_DIGITS:
                return False
        elif name == b"content-type":
            media_type = value.partition(b";")[0].strip()
            compressible = media_type == b"application/json" or media_type.endswith(b"+json")
        elif name in _BINARY:
            return False
    return compressible


def _with_condition(start: Message, scope: Scope) -> Message:
    """Return a 304 with the ETag as the client has it: caches update only the response with exactly that tag.

    Responses that set ``Vary: accept-encoding`` themselves are files, whose tags are always strong.
    """
    if _with_vary(start["headers"]) is start["headers"]:
        return start
    condition = _header(scope, b"if-none-match")
    headers = [
        (name, _weak(value) if name == b"etag" and _weak(value) in condition else value)
        for name, value in start["headers"]
    ]
    return {**start, "headers": _with_vary(headers)}


def _with_vary(headers: list[tuple[bytes, bytes]]) -> list[tuple[bytes, bytes]]:
    """Add ``Accept-Encoding`` to ``Vary``."""
    fields = [value for name, value in headers if name == b"vary"]
    if any(b"accept-encoding" in value.lower() or value.strip() == b"*" for value in fields):
        return headers
    others = [item for item in headers if item[0] != b"vary"]
    return [*others, (b"vary", b", ".join([*fields, b"accept-encoding"]))]


def _weak(etag: bytes) -> bytes:
    return etag if etag.startswith(b"W/") else b"W/" + etag


def _header(scope: Scope, wanted: bytes) -> bytes:
    return b",".join(value for name, value in scope["headers"] if name == wanted)
