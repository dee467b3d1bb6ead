"""Processes of ``fleetmap`` that are forked from one in which its modules are imported already.

Importing them takes half a second of processor time for a command and two for a server, and tests start some hundred
of each. Everything else is as if ``python -m app.cli`` was started: environment, folder, input and output, signals,
exit status, and a session of its own.

Run as a program, with a listening socket and a pipe as its arguments, this is the process that forks: it has one thread
and pytest's processes as its clients. It imports when the first of them connects, and ends when nobody can write into
the pipe any more. Each message is a request in JSON and gets a response.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import gc
import importlib
import io
import json
import os
import pkgutil
import runpy
import select
import selectors
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

ROOT = Path(__file__).resolve().parents[1]
MODULES = (
    *("app.ingest.prepare", "app.convert.warm", "app.main", "uvicorn", "pydantic_settings"),
    *("alembic.command", "geoalchemy2"),  # what migrations import
    *("app.agent.agent", "zenoh"),
)
COMMANDS = "app.cli"
"""The module that is run, and the package whose modules are imported as well."""

LARGEST = 1 << 20

SHARED_FORKER = "PYTEST_FORKER"
"""Variable with the address of a forker that pytest's workers share."""

SHARES_FORK_SERVER = sys.version_info[:2] in ((3, 11), (3, 12), (3, 13))
"""It needs names that are private to multiprocessing, and were the same in these versions."""


class PreloadedProcess:
    """``python -m app.cli ARGUMENTS``, with the attributes and methods of a ``subprocess.Popen`` with text output."""

    def __init__(
        self,
        arguments: list[str],
        *,
        env: Mapping[str, str],
        cwd: Path,
        output: IO[Any] | None = None,
        module: str = COMMANDS,
    ) -> None:
        """Start a process that prints into the file ``output``; by default ``stdout`` reads what it prints.

        module: what is run instead of ``app.cli``.
        """
        self.stdout: IO[str] | None = None
        if output is None:
            ours, theirs = os.pipe()
            self.stdout, output = os.fdopen(ours), os.fdopen(theirs, "wb")
        request = {"module": module, "arguments": arguments, "environment": dict(env), "folder": str(cwd)}
        try:
            with Path(os.devnull).open() as nothing:
                self._start(request, nothing.fileno(), output.fileno(), output.fileno())
        finally:
            if self.stdout is not None:
                output.close()

    def _start(self, request: dict[str, Any], *streams: int) -> None:
        self.returncode: int | None = None
        self.pid: int = _forker().ask(request, *streams)["pid"]
        self._ended = os.pidfd_open(self.pid)
        self._lock = threading.Lock()

    def communicate(self, timeout: float | None = None) -> tuple[str, None]:
        """Wait for the end, and return what it and its children printed. Raises TimeoutExpired."""
        assert self.stdout is not None
        text: list[str] = []
        reader = threading.Thread(target=lambda stdout: text.append(stdout.read()), args=(self.stdout,), daemon=True)
        reader.start()
        self.wait(timeout)
        reader.join()
        self.stdout.close()
        return text[0], None

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


def run_preloaded(
    arguments: list[str], *, env: Mapping[str, str], cwd: Path, timeout: float = 120.0
) -> subprocess.CompletedProcess[str]:
    """Run a command to its end; ``stdout`` has what it printed on both streams."""
    process = PreloadedProcess(arguments, env=env, cwd=cwd)
    try:
        output, _ = process.communicate(timeout)
    finally:
        process.kill()
    return subprocess.CompletedProcess(arguments, process.wait(), output)


class _StreamedProcess(PreloadedProcess):
    """A process with these files as its input, output and errors."""

    def __init__(self, request: dict[str, Any], *streams: int) -> None:
        self.stdout = None
        self._start(request, *streams)


COMMAND = """#!{python} -IS
import json, os, signal, socket, sys
client = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
client.connect({address!r})
request = {{"arguments": sys.argv[1:], "environment": dict(os.environ), "folder": os.getcwd()}}
socket.send_fds(client, [json.dumps(request).encode()], [0, 1, 2])
process = int(client.recv(32))
for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, lambda number, _: os.kill(process, number))
status = int(client.recv(32))
sys.exit(status if status >= 0 else 128 - status)
"""


@contextlib.contextmanager
def preloaded_command(file: Path, env: Mapping[str, str]) -> Iterator[None]:
    """Make ``file`` a program that is ``fleetmap`` for shells. env: variables in addition to the caller's."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        address = f"{file}.socket"
        listener.bind(address)
        listener.listen()
        file.write_text(COMMAND.format(python=sys.executable, address=address))
        file.chmod(0o755)
        thread = threading.Thread(target=_accept, args=(listener, env), daemon=True)
        thread.start()
        yield
        listener.shutdown(socket.SHUT_RDWR)
        thread.join()


def _accept(listener: socket.socket, env: Mapping[str, str]) -> None:
    while True:
        try:
            client, _ = listener.accept()
        except OSError:  # shut down
            return
        threading.Thread(target=_run_for, args=(client, env), daemon=True).start()


def _run_for(client: socket.socket, env: Mapping[str, str]) -> None:
    """Run what a client asks for, and end it if the client is killed."""
    with client:
        data, streams, _, _ = socket.recv_fds(client, LARGEST, 3)
        request = json.loads(data)
        try:
            request["environment"] |= env
            process = _StreamedProcess({"module": COMMANDS, **request}, *streams)
        finally:
            for stream in streams:
                os.close(stream)
        client.send(str(process.pid).encode())
        if client.fileno() in select.select([client.fileno(), process._ended], [], [])[0]:
            process.terminate()
        status = process.wait()
        with contextlib.suppress(OSError):
            client.send(str(status).encode())


class Forker:
    """The process that forks, from the side of the process that started it."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="forker-")
        self.address = f"{self._folder.name}/socket"
        environment = {name: value for name, value in os.environ.items() if not name.startswith("FLEETMAP_")}
        reading, self._writing = os.pipe()
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
            listener.bind(self.address)
            listener.listen()
            self._process = subprocess.Popen(
                [sys.executable, "-m", "tests.preloaded", str(listener.fileno()), str(reading)],
                pass_fds=[listener.fileno(), reading],
                cwd=ROOT,
                env={**environment, "PYTHONPATH": str(ROOT)},
            )
        os.close(reading)

    def stop(self) -> None:
        """End the process; servers that still run go on."""
        os.close(self._writing)
        self._process.wait()
        self._folder.cleanup()


class _Client:
    """A connection to the process that forks: the one that pytest's workers share, or else one of this process."""

    def __init__(self) -> None:
        address = os.environ.get(SHARED_FORKER)
        if address is None:
            forker = Forker()
            atexit.register(forker.stop)
            address = forker.address
        self._lock = threading.Lock()
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.connect(address)
        atexit.register(self._socket.close)

    def ask(self, request: dict[str, Any], *descriptors: int) -> dict[str, Any]:
        """Return the response to a request."""
        with self._lock:
            socket.send_fds(self._socket, [json.dumps(request).encode()], descriptors)
            response: dict[str, Any] = json.loads(self._socket.recv(LARGEST))
            return response


@functools.cache
def _forker() -> _Client:
    return _Client()


def _serve(listener: socket.socket, alive: int) -> tuple[str, list[str]]:
    """Fork for each request of any client. In the new process, return its module and arguments."""
    clients: list[socket.socket] = []
    with selectors.DefaultSelector() as selector:
        selector.register(listener, selectors.EVENT_READ)
        selector.register(alive, selectors.EVENT_READ)
        while True:
            for client in [key.fileobj for key, _ in selector.select()]:
                if client is listener:
                    clients.append(listener.accept()[0])
                    selector.register(clients[-1], selectors.EVENT_READ)
                    _preload()
                elif not isinstance(client, socket.socket):
                    os._exit(0)
                elif (answered := _answer(client)) is None:
                    selector.unregister(client)
                    clients.remove(client)
                    client.close()
                elif answered:
                    for other in (listener, *clients):
                        other.close()
                    os.close(alive)
                    request, streams = answered
                    _become(request, *streams)
                    return request["module"], request["arguments"]


def _answer(client: socket.socket) -> tuple[dict[str, Any], list[int]] | tuple[()] | None:
    """Answer a client's request; return None if the client is gone. In a new process, return the request and files."""
    data, descriptors, _, _ = socket.recv_fds(client, LARGEST, 3)
    if not data:
        return None
    request: dict[str, Any] = json.loads(data)
    if "wait" in request:
        response = {"status": os.waitstatus_to_exitcode(os.waitpid(request["wait"], 0)[1])}
    else:
        response = {"pid": os.fork()}
        if response["pid"] == 0:
            return request, descriptors
        for descriptor in descriptors:
            os.close(descriptor)
    client.send(json.dumps(response).encode())
    return ()


def _become(request: dict[str, Any], *streams: int) -> None:
    """Take the session, folder, environment, input and output of a new process."""
    os.setsid()
    os.chdir(request["folder"])
    os.environ.clear()
    os.environ.update(request["environment"])
    for number, stream in enumerate(streams):
        os.dup2(stream, number)
        os.close(stream)
    for file in (sys.stdout, sys.stderr):
        assert isinstance(file, io.TextIOWrapper)
        file.reconfigure(line_buffering=True, write_through=True)
    if SHARES_FORK_SERVER and request["arguments"][:1] in (["serve"], ["worker"]):
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


@functools.cache
def _preload() -> None:
    commands = importlib.import_module(COMMANDS)
    for name in (*MODULES, *(f"{COMMANDS}.{found.name}" for found in pkgutil.iter_modules(commands.__path__))):
        if not name.endswith("__main__"):
            importlib.import_module(name)
    for name in ("app.api", "app.ogc"):  # their modules are discovered when an application is made
        list(importlib.import_module(name).routers())
    gc.collect()
    gc.freeze()  # the collector of a new process would copy this memory by marking it


if __name__ == "__main__":
    module, sys.argv[1:] = _serve(socket.socket(fileno=int(sys.argv[1])), int(sys.argv[2]))
    sys.argv[0] = "fleetmap"
    runpy.run_module(module, run_name="__main__", alter_sys=True)
