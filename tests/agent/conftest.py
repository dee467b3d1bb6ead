"""Fixtures: real agent processes, a real server, and a proxy between them that breaks, changes and delays traffic."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import httpx
import pytest

from app.agent import freshness
from tests.agent.fake import Fake, StoppedClock
from tests.api import samples
from tests.events.conftest import eventually
from tests.ports import free_port

if sys.version_info >= (3, 11):  # the server's
    from tests.api.conftest import ADMIN, Api, running, settings_for
    from tests.preloaded import PreloadedProcess

ROOT = Path(__file__).parents[2]


def find_python310() -> Path | None:
    """A Python 3.10 of this machine, or the one that FLEETMAP_PYTHON310 names."""
    named = os.environ.get("FLEETMAP_PYTHON310") or shutil.which("python3.10")
    places = [Path(named)] if named else []
    places += sorted(Path.home().glob(".pyenv/versions/3.10.*/bin/python3.10"))
    for path in places:
        ended = subprocess.run(
            [path, "-c", "import sys, venv; print(*sys.version_info[:2])"], capture_output=True, text=True, check=False
        )
        if ended.stdout.split() == ["3", "10"]:
            return path
    return None


collect_ignore = [] if find_python310() else ["test_python310.py"]
"""The agent's tests on Python 3.10 run where there is one."""


@pytest.fixture
def stopped(monkeypatch: pytest.MonkeyPatch) -> StoppedClock:
    """The clock by which the agent judges the age of signed responses and of events."""
    clock = StoppedClock()
    monkeypatch.setattr(freshness, "time", clock)
    return clock


@pytest.fixture(scope="module")
def port() -> int:
    return free_port()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The server's data folder."""
    return tmp_path_factory.mktemp("server")


@pytest.fixture(scope="module")
def api(folder: Path, port: int) -> Iterator[Api]:
    """A server with a router of its own, for all tests of a module."""
    if sys.version_info < (3, 11):
        pytest.skip("the server needs Python 3.11")
    with running(settings_for(folder, zenoh_mode="router", zenoh_listen=f"tcp/127.0.0.1:{port}")) as api:
        eventually(lambda: api.get("/readyz").json()["events"]["state"] == "connected")
        yield api


@pytest.fixture
def place(api: Api, request: pytest.FixtureRequest) -> str:
    """An environment of the test's own with a network (version 1)."""
    name = "a" + hashlib.sha256(request.node.nodeid.encode()).hexdigest()[:12]
    api.post("environments", {"name": name})
    api.upload(name, {"n.tmap2.yaml": network()})
    return name


def network(moved: float = 0.0, count: int = 600) -> bytes:
    """A network of some hundred kilobytes; one of its nodes can be moved."""
    nodes = {f"n{k}": (float(k % 50), k / 50.0) for k in range(count)} | {"n30": (7.0 + moved, 6.0)}
    return samples.tmap2(nodes, tuple((f"n{k}", f"n{k + 1}") for k in range(count - 1)))


class Robot:
    """Process ``fleetmap agent --json``; ``lines`` is its output.

    FLEETMAP_TEST_PYTHON: interpreter to start, instead of a fork of a process that has imported the agent.
    """

    def __init__(self, server: str, env: str, into: Path, *more: str, formats: str = "tmap2", **variables: str) -> None:
        clean = {k: v for k, v in os.environ.items() if not k.startswith("FLEETMAP_")}
        arguments = ["agent", "--server", server, "-e", env, "-f", formats, "--into", str(into), "--json"]
        if "--robot" not in more:
            arguments += ["--robot", into.name]
        self.into = into
        environment = {**clean, "FLEETMAP_TOKEN": ADMIN, "PYTHONPATH": str(ROOT), **variables}
        python = os.environ.get("FLEETMAP_TEST_PYTHON")
        self.process: subprocess.Popen[str] | PreloadedProcess
        if python is None:
            self.process = PreloadedProcess([*arguments, *more], env=environment, cwd=Path.cwd())
        else:
            self.process = subprocess.Popen(
                [python, "-m", "app.cli", *arguments, *more],
                env=environment,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL,
                text=True,
            )
        self.lines: list[dict[str, Any]] = []
        self._news = threading.Condition()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            with self._news:
                try:
                    self.lines.append(json.loads(line))
                except ValueError:
                    self.lines.append({"event": "text", "text": line.rstrip()})
                self._news.notify_all()
        with self._news:
            self._news.notify_all()

    def saw(self, event: str, after: int = 0, **members: Any) -> dict[str, Any] | None:
        """The first line of this kind after so many lines."""
        for line in self.lines[after:]:
            if line["event"] == event and all(line.get(k) == v for k, v in members.items()):
                return line
        return None

    def wait(self, event: str, seconds: float = 60.0, after: int = 0, **members: Any) -> dict[str, Any]:
        """Until such a line came."""
        with self._news:
            self._news.wait_for(lambda: self.saw(event, after, **members) or not self._reader.is_alive(), seconds)
        line = self.saw(event, after, **members)
        assert line, f"no {event} {members}; printed:\n" + "\n".join(map(str, self.lines))
        return line

    @property
    def standing(self) -> dict[str, Any]:
        """The manifest of what stands, after all of its files were looked at."""
        return whole(self.into)

    def file(self, name: str = "tmap2/network.tmap2.yaml") -> bytes:
        return (self.into / "current" / name).read_bytes()

    def end(self, seconds: float = 60.0) -> int:
        """Until it ends by itself: its exit status."""
        try:
            return self.process.wait(seconds)
        finally:
            self.kill()

    def stop(self) -> int:
        """SIGTERM: its exit status."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
        return self.end()

    def kill(self) -> None:
        """As the power goes."""
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait(60)
        self._reader.join(60)
        if self.process.stdout is not None:
            self.process.stdout.close()


def whole(into: Path) -> dict[str, Any]:
    """What ``current`` holds; fails where it is not whole."""
    version = (into / "current").resolve()
    manifest: dict[str, Any] = json.loads((version / "manifest.json").read_bytes())
    for file in manifest["files"]:
        data = (version / file["format"] / file["name"]).read_bytes()
        assert (len(data), hashlib.sha256(data).hexdigest()) == (file["size"], file["sha256"]), file
    files = {str(p.relative_to(version)) for p in version.rglob("*") if p.is_file() and p.suffix != ".new"}
    expected = {f"{f['format']}/{f['name']}" for f in manifest["files"]}
    assert files == expected | {"manifest.json", "manifest.sig", "environment.sh", "closures.json", "levels.json"}
    return manifest


@pytest.fixture
def fake(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Fake]:
    """A test server of signed maps; version 1 has the files ``A`` of the test's module."""
    server = Fake(tmp_path / "keys")
    server.put(request.module.A)
    yield server
    server.close()


Start = Callable[..., Robot]


@pytest.fixture
def robot(api: Api, place: str, tmp_path: Path) -> Iterator[Start]:
    """Start an agent of the test's environment; all end with the test."""
    started: list[Robot] = []

    def start(*more: str, name: str = "robot", server: str | None = None, **rest: Any) -> Robot:
        env = rest.pop("env", place)
        new_robot = Robot(server or api.url, env, tmp_path / name, *more, **rest)
        started.append(new_robot)
        return new_robot

    yield start
    for one in started:
        one.kill()


class Gate:
    """An HTTP proxy in front of the server. ``change(path, status, headers, body)`` gives another body or headers;
    ``cut`` ends bodies of maps after so many bytes; ``slow`` seconds are slept for each 4 kB; not ``open``: nobody.
    not ``deltas``: files come whole.
    """

    def __init__(self, upstream: str) -> None:
        self.upstream = upstream
        self.change: Callable[[str, int, dict[str, str], bytes], tuple[int, dict[str, str], bytes]] | None = None
        self.cut: int | None = None
        self.slow = 0.0
        self.open = True
        self.deltas = True
        self.statuses: list[dict[str, Any]] = []
        self.requests: list[tuple[str, str, dict[str, str], int]] = []
        gate = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def _pass(self) -> None:
                self.close_connection = True
                if not gate.open:
                    self.connection.close()
                    return
                length = int(self.headers.get("content-length") or 0)
                sent = {k.lower(): v for k, v in self.headers.items() if k.lower() not in ("host", "connection")}
                content = self.rfile.read(length)
                if self.command == "PUT":
                    gate.statuses.append(json.loads(content))
                if not gate.deltas:
                    sent.pop("available-dictionary", None)
                with (
                    httpx.Client(timeout=60, verify=False) as client,
                    client.stream(self.command, gate.upstream + self.path, headers=sent, content=content) as answer,
                ):
                    body = b"".join(answer.iter_raw())
                    headers = dict(answer.headers.items())
                    status = answer.status_code
                if gate.change is not None:
                    status, headers, body = gate.change(self.path, status, headers, body)
                gate.requests.append((self.command, self.path, sent, len(body)))
                for hop in ("transfer-encoding", "connection", "content-length", "date", "server"):
                    headers.pop(hop, None)
                self.send_response(status)
                for name, value in headers.items():
                    self.send_header(name, value)
                self.send_header("content-length", str(len(body)))
                self.send_header("connection", "close")
                self.end_headers()
                is_map = "/maps/" in self.path
                if gate.cut is not None and is_map and status < 300:
                    body = body[: gate.cut]
                for at in range(0, len(body), 4096):
                    with contextlib.suppress(OSError):
                        self.wfile.write(body[at : at + 4096])
                        if gate.slow and is_map:
                            time.sleep(gate.slow)

            do_GET = do_PUT = do_POST = _pass

            def log_message(self, *_: Any) -> None:
                pass

        class Server(ThreadingHTTPServer):
            daemon_threads = True

            def handle_error(self, *_: Any) -> None:
                pass

        self._server = Server(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self._server.server_port}"
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,), daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(60)


@pytest.fixture
def gate(api: Api) -> Iterator[Gate]:
    proxy = Gate(api.url)
    yield proxy
    proxy.close()
