"""uvicorn's HTTP protocol with bounds that it lacks, and errors in one shape.

Bounds: connections, time and size of a request's head, pace of a client that reads an answer. A connection is
closed where its request is answered before the body has come completely.
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
"""Bytes of a request line and headers."""

LINGER_SECONDS = 0.7
LINGER_BYTES = 64 * 2**20
"""How long, and how much of a refused body, a connection still takes in, so that the client reads the answer."""

ON_STOP = "on_stop"
"""In the ``state`` of a request's scope: what to call where the server stops before its answer has ended."""


def _feed(protocol: Any, data: bytearray) -> None:
    """Hand bytes to a protocol that reads into buffers of its own, as those of TLS do."""
    while data:
        buffer = protocol.get_buffer(len(data))
        size = min(len(buffer), len(data))
        buffer[:size] = data[:size]
        protocol.buffer_updated(size)
        del data[:size]


@cache
def tls_context(certificate: Path, key: Path) -> ssl.SSLContext:
    """Create what HTTPS is served with (TLS 1.2 and newer) from PEM files; OSError where they cannot be used."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, key)
    return context


class BoundedProtocol(HttpToolsProtocol):
    """A connection that cannot take up more of the server than its share."""

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
        """Whether no request is under way."""
        return self.cycle is None or self.cycle.response_complete

    @property
    def lingers(self) -> bool:
        """Whether all has been said, and what still comes in is dropped."""
        return self._linger_timer is not None

    @property
    def is_broken(self) -> bool:
        """Whether something that is no request came after the last one, whose answer is still due."""
        return self._broken

    def close_idle(self) -> None:
        """Close at once."""
        self.transport.abort()

    def prove(self) -> None:
        """A request has shown a valid token or link."""
        if not self._proven:
            self._proven = True
            self._connections.prove(self)

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """A connection opens: there must be a place for it, and its first request must come soon."""
        peer = get_remote_addr(transport)
        accepted = self._connections.open(self, peer[0] if peer else None)
        if self._tls is None:
            self._start(transport)
            if not accepted:
                self._reject(503, "too many connections are open: try again in a few seconds")
            return
        self.transport = transport
        if not accepted:
            transport.abort()  # nothing can be said before the handshake
            return
        self._pending = bytearray()
        self._handshake = self.loop.create_task(self._start_tls(transport, self._tls))

    async def _start_tls(self, transport: asyncio.Transport, tls: tuple[Path, Path]) -> None:
        """Agree on TLS. The event loop's own way to do so counts no connection before its handshake is over."""
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
        await asyncio.sleep(0)  # from here on TLS reads; what came before is handed to it
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
        """It is over."""
        self._connections.close(self)
        for timer in (self._head_timer, self._stall_timer, self._linger_timer):
            if timer is not None:
                timer.cancel()
        super().connection_lost(exc)

    def on_message_begin(self) -> None:
        """A further request starts on the connection."""
        self._head_size = 0
        self._await_head()
        super().on_message_begin()
        self.scope["state"][PROVE] = self.prove

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
        # Until its body has come, whatever is answered says that the connection closes.
        self._keep_alive, self.cycle.keep_alive = self.cycle.keep_alive, False
        self.cycle.transport = self._closing

    def on_message_complete(self) -> None:
        """The body is whole."""
        if not self.cycle.response_started:
            self.cycle.keep_alive = self._keep_alive
        super().on_message_complete()

    def on_response_complete(self) -> None:
        """An answer is complete: the next request may come, unless the connection closes."""
        if not self.lingers:
            super().on_response_complete()

    def pause_writing(self) -> None:
        """The client reads more slowly than the answer is made: it must go on reading."""
        super().pause_writing()
        self._await_reader()

    def resume_writing(self) -> None:
        """The client has caught up."""
        super().resume_writing()
        if self._stall_timer is not None:
            self._stall_timer.cancel()
            self._stall_timer = None

    def shutdown(self) -> None:
        """The server stops: an answer that has no end of its own is told to come to one."""
        if self.cycle is not None and not self.cycle.response_complete:
            ending = self.cycle.scope["state"].get(ON_STOP)
            if ending is not None:
                ending()
        super().shutdown()

    def data_received(self, data: bytes) -> None:
        """Bytes came in."""
        if self._pending is not None:  # TLS has not begun to read, or its handshake is just over
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
            self._await_head()  # also for what the parser skips, like empty lines
        super().data_received(data)

    def send_400_response(self, msg: str) -> None:  # noqa: ARG002  uvicorn's text is plain
        """Not HTTP: told in the shape of all other errors, unless another answer is due before."""
        if self.pipeline or not (self.is_idle or (self.cycle.more_body and not self.cycle.response_started)):
            self._end_after_answers()
        elif self._head_size > MAX_HEAD:
            self._reject(431, "the request's head is too large")
        else:
            self._reject(400, "this is not a valid HTTP request")

    def linger(self) -> None:
        """Close, but first let the client read the answer: bytes that nobody takes in would reset the connection."""
        self._head_came()
        self._linger_timer = self.loop.call_later(LINGER_SECONDS, self.transport.abort)
        self.flow.resume_reading()
        if self.transport.can_write_eof():
            self.transport.write_eof()

    def _end_after_answers(self) -> None:
        """Close once the requests that came completely are answered; nothing after them can be understood."""
        if self.cycle.more_body:  # half of a request, whose answer has begun or comes after others
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
    """The transport as an answer sees it: closing it lingers where the request has not come completely."""

    def __init__(self, connection: BoundedProtocol) -> None:
        super().__init__()
        self._connection = connection

    def write(self, data: bytes | bytearray | memoryview[Any]) -> None:
        """Send, unless the connection is closed: the answer to a pipelined request is not told of it."""
        if not self._connection.transport.is_closing():
            self._connection.transport.write(data)

    def is_closing(self) -> bool:
        """Whether nothing more can be said."""
        return self._connection.lingers or self._connection.transport.is_closing()

    def close(self) -> None:
        """The answer is complete."""
        if self._connection.cycle.more_body or self._connection.is_broken:
            self._connection.linger()
        else:
            self._connection.transport.close()
