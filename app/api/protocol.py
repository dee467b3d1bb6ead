"""uvicorn's HTTP protocol with bounds that it lacks: time and size of a request's head, and errors in one shape."""

from __future__ import annotations

import asyncio
from typing import Any

import orjson
from uvicorn.config import Config
from uvicorn.protocols.http.httptools_impl import STATUS_LINE, HttpToolsProtocol

from app.api.problems import MEDIA_TYPE, document

MAX_HEAD = 64 * 2**10
"""Bytes of a request line and headers."""


ON_STOP = "on_stop"
"""In the ``state`` of a request's scope: what to call where the server stops before its answer has ended."""


class BoundedProtocol(HttpToolsProtocol):
    """A client that sends its request's head slowly, or a huge one, is not waited for."""

    def __init__(self, config: Config, *args: Any, **kwargs: Any) -> None:
        super().__init__(config, *args, **kwargs)
        self._head_seconds = float(getattr(config, "head_seconds", 20.0))
        self._head_timer: asyncio.TimerHandle | None = None
        self._head_size = 0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """A connection opens: its first request must come soon."""
        super().connection_made(transport)
        self._await_head()

    def connection_lost(self, exc: Exception | None) -> None:
        """It is over."""
        self._head_came()
        super().connection_lost(exc)

    def on_message_begin(self) -> None:
        """A further request starts on the connection."""
        self._head_size = 0
        self._await_head()
        super().on_message_begin()

    def on_url(self, url: bytes) -> None:
        """A piece of the request line."""
        self._grow(len(url))
        super().on_url(url)

    def on_header(self, name: bytes, value: bytes) -> None:
        """One header."""
        self._grow(len(name) + len(value) + 4)
        super().on_header(name, value)

    def on_headers_complete(self) -> None:
        """The head is whole."""
        self._head_came()
        super().on_headers_complete()

    def shutdown(self) -> None:
        """The server stops: an answer that has no end of its own is told to come to one."""
        if self.cycle is not None and not self.cycle.response_complete:
            ending = self.cycle.scope["state"].get(ON_STOP)
            if ending is not None:
                ending()
        super().shutdown()

    def data_received(self, data: bytes) -> None:
        """Bytes came in."""
        if self.transport.is_closing():
            return
        super().data_received(data)

    def send_400_response(self, msg: str) -> None:  # noqa: ARG002  uvicorn's text is plain
        """Not HTTP: told in the shape of all other errors."""
        status = 431 if self._head_size > MAX_HEAD else 400
        detail = "the request's head is too large" if status == 431 else "this is not a valid HTTP request"
        body = orjson.dumps(document(status, detail))
        head = [
            STATUS_LINE[status],
            f"content-type: {MEDIA_TYPE}\r\ncontent-length: {len(body)}\r\nconnection: close\r\n\r\n".encode(),
        ]
        self.transport.write(b"".join([*head, body]))
        self.transport.close()

    def _grow(self, size: int) -> None:
        self._head_size += size
        if self._head_size > MAX_HEAD:
            raise ValueError("head too large")  # the parser wraps it, and uvicorn calls send_400_response

    def _await_head(self) -> None:
        if self._head_timer is None:
            self._head_timer = self.loop.call_later(self._head_seconds, self._give_up)

    def _head_came(self) -> None:
        if self._head_timer is not None:
            self._head_timer.cancel()
            self._head_timer = None

    def _give_up(self) -> None:
        self._head_timer = None
        if not self.transport.is_closing():
            self.transport.close()
