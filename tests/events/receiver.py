"""A receiver of webhooks: a real HTTP server that checks each signature with an independent implementation."""

from __future__ import annotations

import json
import ssl
import sys
import threading
import time
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from standardwebhooks import Webhook

Answer = Callable[["Handler", dict[str, Any]], int | None]
"""Function (request, event) -> status of the response; None: it has answered, or never will."""


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: Server

    def do_POST(self) -> None:
        size = int(self.headers["content-length"])
        body = self.rfile.read(size)
        if len(body) < size:  # the sender was killed
            self.close_connection = True
            return
        receiver = self.server.receiver
        if receiver.secret is not None:
            Webhook(receiver.secret).verify(body, dict(self.headers.items()))
        event = json.loads(body)
        status = receiver.answer(self, event)
        with receiver.lock:
            receiver.attempts.append((self.headers["webhook-id"], event, status))
            if status is not None and 200 <= status < 300:
                receiver.events.append(event)
        if status is None:
            self.close_connection = True
            return
        self.send_response(status)
        self.send_header("content-length", "0")
        for name, value in receiver.headers.items():
            self.send_header(name, value)
        self.end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        """Print nothing."""


class Server(ThreadingHTTPServer):
    daemon_threads = True
    receiver: Receiver

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Note what failed, such as a wrong signature; a sender may be killed at any time."""
        problem = sys.exception()
        if not isinstance(problem, ConnectionError):
            self.receiver.problems.append(f"a request of {client_address} failed: {problem!r}")
            super().handle_error(request, client_address)


class Receiver:
    """A receiver on a loopback port. events: acknowledged ones; attempts: (id, event, status) of all requests."""

    def __init__(self, port: int = 0, certificate: tuple[Path, Path] | None = None) -> None:
        self.secret: str | None = None
        self.answer: Answer = lambda _, __: 204
        self.headers: dict[str, str] = {}
        self.events: list[dict[str, Any]] = []
        self.attempts: list[tuple[str, dict[str, Any], int | None]] = []
        self.problems: list[str] = []
        self.lock = threading.Lock()
        self._server = Server(("127.0.0.1", port), Handler)
        self._server.receiver = self
        scheme = "http"
        if certificate is not None:
            context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
            context.load_cert_chain(*certificate)
            self._server.socket = context.wrap_socket(self._server.socket, server_side=True)
            scheme = "https"
        self.port = int(self._server.server_address[1])
        self.url = f"{scheme}://{'localhost' if certificate else '127.0.0.1'}:{self.port}/hook"
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.02,), daemon=True)
        self._thread.start()

    def sequences(self, environment: str) -> list[int]:
        """Acknowledged sequences of an environment, in the order they came."""
        with self.lock:
            return [e["sequence"] for e in self.events if e.get("environment") == environment and "sequence" in e]

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(30)


def drip(handler: Handler, _: dict[str, Any]) -> None:
    """Answer with a byte of the header now and then, forever."""
    handler.wfile.write(b"HTTP/1.1 200 OK\r\nx-slow: ")
    while True:
        try:
            handler.wfile.write(b"x")
            handler.wfile.flush()
        except OSError:
            return
        time.sleep(0.05)


def flood(handler: Handler, _: dict[str, Any]) -> None:
    """Answer 200 with a body without end."""
    handler.wfile.write(b"HTTP/1.1 200 OK\r\ntransfer-encoding: chunked\r\n\r\n")
    while True:
        try:
            handler.wfile.write(b"1000\r\n" + b"x" * 4096 + b"\r\n")
        except OSError:
            return
