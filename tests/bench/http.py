"""Requests per second of one loopback server, with a client that costs less than any Python server."""

from __future__ import annotations

import os
import re
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

BARE = """
import sys
from starlette.applications import Starlette
from starlette.responses import Response
from starlette.routing import Route
import uvicorn
bodies = {"/1k": b"x" * 1000, "/100k": b"x" * 100_000}
def answer(body):
    async def route(request):
        if request.headers.get("if-none-match") == '"tag"':
            return Response(status_code=304, headers={"etag": '"tag"'})
        return Response(body, media_type="application/octet-stream", headers={"etag": '"tag"'})
    return route
app = Starlette(routes=[Route(path, answer(body)) for path, body in bodies.items()])
uvicorn.run(app, host="127.0.0.1", port=int(sys.argv[1]), log_level="error", access_log=False)
"""


@contextmanager
def serving(command: list[str], port: int, env: dict[str, str] | None = None) -> Iterator[subprocess.Popen[bytes]]:
    """Run a server process on a loopback port."""
    process = subprocess.Popen(command, env={**os.environ, **(env or {})}, stdout=subprocess.DEVNULL)
    try:
        for _ in range(2400):
            with socket.socket() as s:
                if s.connect_ex(("127.0.0.1", port)) == 0:
                    break
            if process.poll() is not None:
                raise RuntimeError(f"the server ended with {process.returncode}")
            time.sleep(0.05)
        else:
            raise RuntimeError("the server did not start within 120 s")
        yield process
    finally:
        process.terminate()
        process.wait(120)


def bare(port: int) -> list[str]:
    """Return the command of the peer: a Starlette route that returns bytes from memory."""
    return [sys.executable, "-c", BARE, str(port)]


def rate(port: int, path: str, headers: dict[str, str], *, seconds: float = 2.0, connections: int = 16) -> float:
    """Measure requests per second over keep-alive connections, with complete responses; raises if one is an error."""
    lines = [f"GET {path} HTTP/1.1", f"Host: 127.0.0.1:{port}", *(f"{k}: {v}" for k, v in headers.items())]
    request = ("\r\n".join(lines) + "\r\n\r\n").encode()
    sockets = [socket.create_connection(("127.0.0.1", port)) for _ in range(connections)]
    try:
        for s in sockets:
            s.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            s.sendall(request)
            _check(_answer(s))
        length = _measure(sockets[0], request)
        done, end = 0, time.perf_counter() + seconds
        start = time.perf_counter()
        while time.perf_counter() < end:
            for s in sockets:
                s.sendall(request)
            for s in sockets:
                left = length
                while left:
                    got = s.recv(min(left, 1 << 20))
                    if not got:
                        raise RuntimeError("the server closed the connection")
                    left -= len(got)
            done += connections
        return done / (time.perf_counter() - start)
    finally:
        for s in sockets:
            s.close()


def _measure(s: socket.socket, request: bytes) -> int:
    s.sendall(request)
    return len(_answer(s))


def _answer(s: socket.socket) -> bytes:
    data = b""
    while b"\r\n\r\n" not in data:
        data += s.recv(1 << 20)
    head, _, body = data.partition(b"\r\n\r\n")
    match = re.search(rb"(?i)content-length: *(\d+)", head)
    need = int(match[1]) if match and b" 304 " not in head.split(b"\r\n")[0] else 0
    while len(body) < need:
        body += s.recv(1 << 20)
    return head + b"\r\n\r\n" + body


def _check(answer: bytes) -> None:
    status = answer.split(b"\r\n", 1)[0]
    if b" 200 " not in status and b" 304 " not in status:
        raise RuntimeError(f"unexpected answer: {answer[:300]!r}")
