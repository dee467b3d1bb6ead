"""HTTP protocol of uvicorn with additional limits, and uniform errors.

Limits: connections, time and size of a request's head, reading pace of a client. A connection is closed if the
response starts before the request body is complete.
"""

from __future__ import annotations

import asyncio
import contextlib
import ssl
from functools import cache
from pathlib import Path
from typing import Any

import orjson
from uvicorn.config import Config
from uvicorn.protocols.http.httptools_impl import STATUS_LINE, HttpToolsProtocol
from uvicorn.protocols.utils import get_remote_addr

from app.api.http.auth import PROVE
from app.api.http.connections import Connections
from app.api.http.problems import MEDIA_TYPE, RETRY_SECONDS, document

MAX_HEAD = 64 * 2**10
"""Maximum size of a request line with headers, in bytes."""

LINGER_SECONDS = 0.7
LINGER_BYTES = 64 * 2**20
"""Maximum time and size for which a connection accepts a refused body, so that the client reads the response."""

ON_STOP = "on_stop"
"""Key in a request scope's ``state``: callback that ends a response when the server stops."""


def _feed(protocol: Any, data: bytearray) -> None:
    """Pass bytes to a protocol with its own read buffers, like those of TLS."""
    while data:
        buffer = protocol.get_buffer(len(data))
        size = min(len(buffer), len(data))
        buffer[:size] = data[:size]
        protocol.buffer_updated(size)
        del data[:size]


@cache
def tls_context(certificate: Path, key: Path) -> ssl.SSLContext:
    """Create the TLS context of the server (TLS 1.2 and newer) from PEM files. Raises OSError if they are unusable."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, key)
    return context


class BoundedProtocol(HttpToolsProtocol):
    """HTTP connection with limits on the resources that it can use."""

    def __init__(
        self, connections: Connections, tls: tuple[Path, Path] | None, /, config: Config, *args: Any, **kwargs: Any
    ) -> None:
        super().__init__(config, *args, **kwargs)
        self._connections = connections
        self._tls = tls
        self._handshake: asyncio.Task[None] | None = None
        self._pending: bytearray | None = None
        self._limits = connections.limits
        self._head_timer: asyncio.TimerHandle | None = None
        self._stall_timer: asyncio.TimerHandle | None = None
        self._linger_timer: asyncio.TimerHandle | None = None
        self._head_size = 0
        self._left = LINGER_BYTES
        self._keep_alive = True
        self._proven = False
        self._broken = False

    @property
    def is_idle(self) -> bool:
        """Whether no request is in progress."""
        return self.cycle is None or self.cycle.response_complete

    @property
    def lingers(self) -> bool:
        """Whether the response is complete and further input is discarded."""
        return self._linger_timer is not None

    @property
    def is_broken(self) -> bool:
        """Whether invalid data followed the last request, whose response is still pending."""
        return self._broken

    def close_idle(self) -> None:
        """Close immediately."""
        self.transport.abort()

    def prove(self) -> None:
        """Mark the connection as proven after a valid token or link."""
        if not self._proven:
            self._proven = True
            self._connections.prove(self)

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Register the connection and start the timer for its first request."""
        peer = get_remote_addr(transport)
        accepted = self._connections.open(self, peer[0] if peer else None)
        if self._tls is None:
            self._start(transport)
            if not accepted:
                self._reject(503, "too many connections are open: try again in a few seconds")
            return
        self.transport = transport
        if not accepted:
            transport.abort()  # no response is possible before the handshake
            return
        self._pending = bytearray()
        self._handshake = self.loop.create_task(self._start_tls(transport, self._tls))

    async def _start_tls(self, transport: asyncio.Transport, tls: tuple[Path, Path]) -> None:
        """Run the TLS handshake here: the event loop's own TLS would not count connections during the handshake."""
        secured = None
        handshake = asyncio.ensure_future(
            self.loop.start_tls(
                transport,
                self,
                tls_context(*tls),
                server_side=True,
                ssl_handshake_timeout=self._limits.head_seconds,
                ssl_shutdown_timeout=LINGER_SECONDS,
            )
        )
        await asyncio.sleep(0)  # TLS reads from now on; pass it what arrived before
        hello, self._pending = self._pending, bytearray()
        if hello:
            self.loop.call_soon(_feed, transport.get_protocol(), hello)
        with contextlib.suppress(OSError):
            secured = await handshake
        if secured is None or secured.is_closing():
            self._connections.close(self)
            transport.abort()
            return
        self._start(secured)
        early, self._pending = self._pending, None
        if early:
            self.data_received(bytes(early))

    def _start(self, transport: asyncio.Transport) -> None:
        super().connection_made(transport)
        self._closing = _Closing(self)
        self._await_head()

    def connection_lost(self, exc: Exception | None) -> None:
        """Cancel the timers and unregister the connection."""
        self._connections.close(self)
        for timer in (self._head_timer, self._stall_timer, self._linger_timer):
            if timer is not None:
                timer.cancel()
        super().connection_lost(exc)

    def on_message_begin(self) -> None:
        """Start a further request on the connection."""
        self._head_size = 0
        self._await_head()
        super().on_message_begin()
        self.scope["state"][PROVE] = self.prove

    def on_url(self, url: bytes) -> None:
        """Count a piece of the request line."""
        self._grow(len(url))
        super().on_url(url)

    def on_header(self, name: bytes, value: bytes) -> None:
        """Count a header."""
        self._grow(len(name) + len(value) + 4)
        super().on_header(name, value)

    def on_headers_complete(self) -> None:
        """Stop the timer for the head."""
        self._head_came()
        super().on_headers_complete()
        # Until the body is complete, every response closes the connection.
        self._keep_alive, self.cycle.keep_alive = self.cycle.keep_alive, False
        self.cycle.transport = self._closing

    def on_message_complete(self) -> None:
        """Allow keep-alive again, since the body is complete."""
        if not self.cycle.response_started:
            self.cycle.keep_alive = self._keep_alive
        super().on_message_complete()

    def on_response_complete(self) -> None:
        """Continue with the next request, unless the connection closes."""
        if not self.lingers:
            super().on_response_complete()

    def pause_writing(self) -> None:
        """Start to check the client's pace, since it reads more slowly than the response is produced."""
        super().pause_writing()
        self._await_reader()

    def resume_writing(self) -> None:
        """Stop the check of the client's pace."""
        super().resume_writing()
        if self._stall_timer is not None:
            self._stall_timer.cancel()
            self._stall_timer = None

    def shutdown(self) -> None:
        """End endless responses, since the server stops."""
        if self.cycle is not None and not self.cycle.response_complete:
            ending = self.cycle.scope["state"].get(ON_STOP)
            if ending is not None:
                ending()
        super().shutdown()

    def data_received(self, data: bytes) -> None:
        """Parse received bytes, or discard them if the connection is closing."""
        if self._pending is not None:  # TLS does not read yet, or its handshake has just ended
            if self.transport.get_protocol() is self:
                self.transport.pause_reading()
            self._pending += data
            return
        if self.lingers or self._broken:
            self._left -= len(data)
            if self._left < 0:
                self.transport.abort()
            return
        if self.transport.is_closing():
            return
        if self.is_idle:
            self._await_head()  # also for data that the parser skips, like empty lines
        super().data_received(data)

    def send_400_response(self, msg: str) -> None:  # noqa: ARG002  uvicorn's text is plain
        """Reject invalid HTTP with a problem, unless another response is pending."""
        if self.pipeline or not (self.is_idle or (self.cycle.more_body and not self.cycle.response_started)):
            self._end_after_answers()
        elif self._head_size > MAX_HEAD:
            self._reject(431, "the request head is too large: shorten the address or the headers")
        else:
            self._reject(400, "invalid HTTP request")

    def linger(self) -> None:
        """Close after the client had time to read the response: unread input would reset the connection."""
        self._head_came()
        self._linger_timer = self.loop.call_later(LINGER_SECONDS, self.transport.abort)
        self.flow.resume_reading()
        if self.transport.can_write_eof():
            self.transport.write_eof()

    def _end_after_answers(self) -> None:
        """Close after the responses to complete requests; data after them cannot be parsed."""
        if self.cycle.more_body:  # incomplete request, whose response has started or is queued
            self.transport.abort()
            return
        self._head_came()
        self._broken = True
        self.cycle.keep_alive = False

    def _reject(self, status: int, detail: str) -> None:
        body = orjson.dumps(document(status, detail))
        retry = f"retry-after: {RETRY_SECONDS}\r\n" if status == 503 else ""
        head = f"content-type: {MEDIA_TYPE}\r\ncontent-length: {len(body)}\r\n{retry}connection: close\r\n\r\n"
        self.transport.write(STATUS_LINE[status] + head.encode() + body)
        self.linger()

    def _grow(self, size: int) -> None:
        self._head_size += size
        if self._head_size > MAX_HEAD:
            raise ValueError("head too large")  # the parser wraps it, and uvicorn calls send_400_response

    def _await_head(self) -> None:
        if self._head_timer is None:
            self._head_timer = self.loop.call_later(self._limits.head_seconds, self._abort)

    def _head_came(self) -> None:
        if self._head_timer is not None:
            self._head_timer.cancel()
            self._head_timer = None

    def _abort(self) -> None:
        self._head_timer = None
        if not self.transport.is_closing():
            self.transport.close()

    def _await_reader(self) -> None:
        waiting = self.transport.get_write_buffer_size()
        self._stall_timer = self.loop.call_later(self._limits.stall_seconds, self._check_reader, waiting)

    def _check_reader(self, waiting: int) -> None:
        if waiting - self.transport.get_write_buffer_size() < self._limits.pace * self._limits.stall_seconds:
            self.transport.abort()
        else:
            self._await_reader()


class _Closing(asyncio.Transport):
    """Transport for responses: closing it lingers if the request is incomplete."""

    def __init__(self, connection: BoundedProtocol) -> None:
        super().__init__()
        self._connection = connection

    def write(self, data: bytes | bytearray | memoryview[Any]) -> None:
        """Send, unless the connection is closed: responses to pipelined requests are not notified of that."""
        if not self._connection.transport.is_closing():
            self._connection.transport.write(data)

    def is_closing(self) -> bool:
        """Test if nothing more can be sent."""
        return self._connection.lingers or self._connection.transport.is_closing()

    def close(self) -> None:
        """Close after a complete response."""
        if self._connection.cycle.more_body or self._connection.is_broken:
            self._connection.linger()
        else:
            self._connection.transport.close()
