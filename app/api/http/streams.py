"""Responses with files: complete or one range, from memory or in chunks from disk."""

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
"""Maximum size of files that are served from memory; larger ones are streamed from disk."""

CHUNK = 256 * 2**10

Headers = list[tuple[bytes, bytes]]


def raw_response(status: int, headers: Headers, body: bytes = b"") -> Response:
    """Build a response with exactly these headers."""
    response = Response(body, status)
    response.raw_headers = list(headers)
    return response


def requested_range(request: Request, etag: str, size: int) -> tuple[int, int] | None:
    """Return the requested half-open range [start, end), None for the complete file. Raises 416 if it is outside."""
    part = byte_range(request.headers.get("range"), request.headers.get("if-range"), etag, size)
    if isinstance(part, Unsatisfiable):
        raise HTTPException(
            416, f"the range is outside the file, which has {size} bytes", {"content-range": f"bytes */{size}"}
        )
    return part


def range_headers(part: tuple[int, int] | None, size: int) -> Headers:
    """Build the headers with the length of a response and its range."""
    start, end = part or (0, size)
    length = (b"content-length", str(end - start).encode())
    return [length] if part is None else [length, (b"content-range", f"bytes {start}-{end - 1}/{size}".encode())]


def stream_file(
    file: BinaryIO, start: int, end: int, status: int, headers: Headers, check: Callable[[str], None] | None = None
) -> Response:
    """Stream the bytes [start, end) of an open file, which is closed at the end.

    check: called with the hash of the streamed bytes before the last chunk is sent; an exception breaks the
    connection, so that the client does not accept damaged content.
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
                    raise OSError("a file became shorter while it was sent")
                left -= len(chunk)
                if check is not None and not left:
                    check(digest.hexdigest())
                yield chunk
        finally:
            file.close()

    response = StreamingResponse(chunks(), status)
    response.raw_headers = list(headers)
    return response
