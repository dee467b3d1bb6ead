"""Files as answers: whole or one range, from memory or in chunks from disk."""

from __future__ import annotations

import hashlib
from collections.abc import AsyncIterator, Callable
from typing import BinaryIO

from fastapi import Request
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.responses import Response, StreamingResponse

from app.api.http.caching import Unsatisfiable, byte_range

IN_MEMORY = 8 * 2**20
"""Files up to this many bytes are answered from memory; larger ones are streamed from disk."""

CHUNK = 256 * 2**10

Headers = list[tuple[bytes, bytes]]


def raw_response(status: int, headers: Headers, body: bytes = b"") -> Response:
    """An answer with exactly these headers."""
    response = Response(body, status)
    response.raw_headers = list(headers)
    return response


def requested_range(request: Request, etag: str, size: int) -> tuple[int, int] | None:
    """The half-open range [start, end) that a client asks for, None for the whole. Status 416 if it lies outside."""
    part = byte_range(request.headers.get("range"), request.headers.get("if-range"), etag, size)
    if isinstance(part, Unsatisfiable):
        raise HTTPException(416, f"the file has {size} bytes", {"content-range": f"bytes */{size}"})
    return part


def range_headers(part: tuple[int, int] | None, size: int) -> Headers:
    """Length of an answer, and which range it has."""
    start, end = part or (0, size)
    length = (b"content-length", str(end - start).encode())
    return [length] if part is None else [length, (b"content-range", f"bytes {start}-{end - 1}/{size}".encode())]


def stream_file(
    file: BinaryIO, start: int, end: int, status: int, headers: Headers, check: Callable[[str], None] | None = None
) -> Response:
    """The bytes [start, end) of an open file, which is closed at the end.

    check: called with the hash of all of it before the last bytes are sent; what it raises breaks the connection, so
    that nobody takes damaged content for whole.
    """
    digest = hashlib.sha256()

    def read(size: int) -> bytes:
        chunk = file.read(size)
        if check is not None:
            digest.update(chunk)
        return chunk

    async def chunks() -> AsyncIterator[bytes]:
        try:
            await run_in_threadpool(file.seek, start)
            left = end - start
            while left > 0:
                chunk = await run_in_threadpool(read, min(CHUNK, left))
                if not chunk:
                    raise OSError("a file that is being sent became shorter")
                left -= len(chunk)
                if check is not None and not left:
                    check(digest.hexdigest())
                yield chunk
        finally:
            file.close()

    response = StreamingResponse(chunks(), status)
    response.raw_headers = list(headers)
    return response
