"""Server processes that are forked from one in which the server's modules are imported already.

Importing them takes two seconds of processor time, and tests start some hundred servers. Everything else is as if
``python -m app.cli`` was started: environment, folder, output, signals, exit status, and a session of its own.

Run as a program, with a socket as its argument, this is the process that forks: it has one thread, and one pytest
process as its client. Each message is a request in JSON and gets a response.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import importlib
import io
import json
import os
import runpy
import select
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

ROOT = Path(__file__).resolve().parents[1]
MODULES = ("app.ingest.prepare", "app.convert.warm", "app.main", "app.cli.server", "uvicorn", "pydantic_settings")
LARGEST = 1 << 20

SHARES_FORK_SERVER = sys.version_info[:2] in ((3, 11), (3, 12), (3, 13))
"""It needs names that are private to multiprocessing, and were the same in these versions."""


class PreloadedProcess:
    """``python -m app.cli ARGUMENTS``, with the attributes and methods of a ``subprocess.Popen`` with text output."""

    def __init__(
        self, arguments: list[str], *, env: Mapping[str, str], cwd: Path, output: IO[bytes] | None = None
    ) -> None:
        """Start a process that prints into the file ``output``; by default ``stdout`` reads what it prints."""
        self.returncode: int | None = None
        self.stdout: IO[str] | None = None
        if output is None:
            ours, theirs = os.pipe()
            self.stdout, output = os.fdopen(ours), os.fdopen(theirs, "wb")
        request = {"arguments": arguments, "environment": dict(env), "folder": str(cwd)}
        try:
            self.pid: int = _forker().ask(request, output.fileno())["pid"]
        finally:
            if self.stdout is not None:
                output.close()
        self._ended = os.pidfd_open(self.pid)
        self._lock = threading.Lock()

    def poll(self) -> int | None:
        """Return the exit status, negative for a signal, or None while the process runs."""
        with self._lock:
            if self.returncode is None and select.select([self._ended], [], [], 0)[0]:
                self._collect()
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the end; the exit status. Raises TimeoutExpired."""
        if self.returncode is None and not select.select([self._ended], [], [], timeout)[0]:
            raise subprocess.TimeoutExpired("fleetmap", timeout or 0.0)
        status = self.poll()
        assert status is not None
        return status

    def _collect(self) -> None:
        self.returncode = _forker().ask({"wait": self.pid})["status"]
        os.close(self._ended)

    def send_signal(self, number: int) -> None:
        """Send a signal, unless the process has ended."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self) -> None:
        """Send SIGTERM."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """Send SIGKILL."""
        self.send_signal(signal.SIGKILL)


class _Forker:
    """The process that forks, from its client's side."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        environment = {name: value for name, value in os.environ.items() if not name.startswith("FLEETMAP_")}
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "tests.preloaded", str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                cwd=ROOT,
                env={**environment, "PYTHONPATH": str(ROOT)},
            )

    def ask(self, request: dict[str, Any], *descriptors: int) -> dict[str, Any]:
        """Return the response to a request."""
        with self._lock:
            socket.send_fds(self._socket, [json.dumps(request).encode()], descriptors)
            response: dict[str, Any] = json.loads(self._socket.recv(LARGEST))
            return response

    def stop(self) -> None:
        """End the process; servers that still run go on."""
        self._socket.close()
        self._process.wait()


@functools.cache
def _forker() -> _Forker:
    forker = _Forker()
    atexit.register(forker.stop)
    return forker


def _serve(client: socket.socket) -> list[str]:
    """Fork for each request, until the client is gone. In the new process, return its arguments."""
    while True:
        data, descriptors, _, _ = socket.recv_fds(client, LARGEST, 1)
        if not data:
            os._exit(0)
        request = json.loads(data)
        if "wait" in request:
            status = os.waitstatus_to_exitcode(os.waitpid(request["wait"], 0)[1])
            client.send(json.dumps({"status": status}).encode())
            continue
        pid = os.fork()
        if pid == 0:
            client.close()
            _become(request, *descriptors)
            arguments: list[str] = request["arguments"]
            return arguments
        for descriptor in descriptors:
            os.close(descriptor)
        client.send(json.dumps({"pid": pid}).encode())


def _become(request: dict[str, Any], output: int) -> None:
    """Take the session, folder, environment and output of a new process."""
    os.setsid()
    os.chdir(request["folder"])
    os.environ.clear()
    os.environ.update(request["environment"])
    with Path(os.devnull).open() as nothing:
        os.dup2(nothing.fileno(), 0)
    os.dup2(output, 1)
    os.dup2(output, 2)
    os.close(output)
    for stream in (sys.stdout, sys.stderr):
        assert isinstance(stream, io.TextIOWrapper)
        stream.reconfigure(line_buffering=True, write_through=True)
    if SHARES_FORK_SERVER:
        _fork_the_fork_server()


def _fork_the_fork_server() -> None:
    """Start multiprocessing's fork server, which imports for a second otherwise, as a copy of this process."""
    from multiprocessing import connection, forkserver, resource_tracker, util

    resource_tracker.ensure_running()
    server: Any = forkserver._forkserver
    address = connection.arbitrary_address("AF_UNIX")  # type: ignore[attr-defined]
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(address)
        if not util.is_abstract_socket_namespace(address):
            Path(address).chmod(0o600)
        listener.listen()
        reading, writing = os.pipe()
        pid = os.fork()
        if pid == 0:
            os.close(writing)
            status = 1
            with contextlib.suppress(SystemExit):
                forkserver.main(listener.fileno(), reading, [])
                status = 0
            os._exit(status)
        os.close(reading)
        server._forkserver_address, server._forkserver_alive_fd, server._forkserver_pid = address, writing, pid


if __name__ == "__main__":
    for name in MODULES:
        importlib.import_module(name)
    sys.argv = ["fleetmap", *_serve(socket.socket(fileno=int(sys.argv[1])))]
    runpy.run_module("app.cli", run_name="__main__", alter_sys=True)
