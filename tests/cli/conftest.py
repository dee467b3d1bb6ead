"""A server of its own for the command line's tests, started as a user starts it."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest

from app.cli import run
from app.cli.server import wait_ready
from app.errors import Unavailable
from tests.preloaded import PreloadedProcess

TOKEN = "administrator-of-the-tests"
START_SECONDS = 240.0


@dataclass(frozen=True)
class Result:
    """What a command printed and how it ended."""

    status: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        return json.loads(self.out)


Fleetmap = Callable[..., Result]


class ServerProcess:
    """``fleetmap serve`` (or another command) in a process of its own; ``lines`` is what it printed.

    forked: from a process that has imported its modules, whose memory it shares; else started as by a user.
    """

    process: PreloadedProcess | subprocess.Popen[str]

    def __init__(
        self,
        *arguments: str,
        environment: Mapping[str, str],
        folder: Path,
        command: str = "serve",
        forked: bool = True,
    ) -> None:
        clean = {k: v for k, v in os.environ.items() if not k.startswith("FLEETMAP_")}
        values = {**clean, "FLEETMAP_ZENOH_MODE": "off", **environment, "PYTHONPATH": str(Path(__file__).parents[2])}
        given = [command, "--port", "0", *arguments]
        self.process = PreloadedProcess(given, env=values, cwd=folder) if forked else _start(given, values, folder)
        self.lines: list[str] = []
        self._news = threading.Condition()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            with self._news:
                self.lines.append(line.rstrip("\n"))
                self._news.notify_all()
        with self._news:
            self._news.notify_all()

    def wait_for(self, pattern: str, seconds: float = START_SECONDS) -> re.Match[str]:
        """The first printed line that fits; fails where the server ends or the time is over."""

        def find_match() -> re.Match[str] | None:
            return next((m for line in self.lines if (m := re.search(pattern, line))), None)

        with self._news:
            self._news.wait_for(lambda: find_match() or not self._reader.is_alive(), seconds)
        match = find_match()
        assert match, f"no line with {pattern!r}; printed:\n" + "\n".join(self.lines)
        return match

    @property
    def address(self) -> str:
        return self.wait_for(r"Fleet Map Server: (http://\S+)")[1]

    def ready(self) -> str:
        """Its address, once it answers; fails at once where it has ended."""
        address, deadline = self.address, time.monotonic() + START_SECONDS
        while True:
            try:
                wait_ready(address, seconds=1.0)
            except Unavailable:
                alive = self.process.poll() is None and time.monotonic() < deadline
                assert alive, "the server is not ready; printed:\n" + "\n".join(self.lines)
            else:
                return address

    def seconds_until_healthy(self, start: float) -> float:
        """Wait for /healthz; the seconds since ``start``, which is a time of ``time.monotonic``."""
        return seconds_until_healthy(self.address, start)

    def stop(self, number: int = signal.SIGTERM, seconds: float = 60.0) -> int:
        """Signal it and wait: its exit status. Whatever is left of its group is killed."""
        if self.process.poll() is None:
            self.process.send_signal(number)
        try:
            return self.process.wait(seconds)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait(60)
            self._reader.join(60)
            assert self.process.stdout is not None
            self.process.stdout.close()


def _start(arguments: list[str], environment: Mapping[str, str], folder: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "app.cli", *arguments],
        env=environment,
        cwd=folder,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        process_group=0,
    )


def seconds_until_healthy(address: str, start: float) -> float:
    """Wait for a server's /healthz; the seconds since ``start``, which is a time of ``time.monotonic``."""
    with httpx.Client(base_url=address, timeout=1, verify=False) as client:  # TLS would cost each try 50 ms
        while True:
            with contextlib.suppress(httpx.HTTPError):
                if client.get("/healthz").status_code == 200:
                    return time.monotonic() - start
            assert time.monotonic() - start < START_SECONDS, "the server does not come up"
            time.sleep(0.02)


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of a running server with an empty SQLite store."""
    folder = tmp_path_factory.mktemp("server")
    process = ServerProcess(
        "--data-dir", str(folder / "data"), environment={"FLEETMAP_ADMIN_TOKEN": TOKEN}, folder=folder
    )
    try:
        yield process.ready()
    finally:
        process.stop()


@pytest.fixture
def offline(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Fleetmap:
    """Run a command in this process, without a server in its environment."""
    for name in list(os.environ):
        if name.startswith("FLEETMAP_") or name == "COLUMNS":
            monkeypatch.delenv(name)

    def call(*arguments: str | Path) -> Result:
        capsys.readouterr()
        status = run([str(a) for a in arguments])
        captured = capsys.readouterr()
        return Result(status, captured.out, captured.err)

    return call


@pytest.fixture
def fleetmap(server: str, offline: Fleetmap, monkeypatch: pytest.MonkeyPatch) -> Fleetmap:
    """Run a command in this process against the server, as administrator."""
    monkeypatch.setenv("FLEETMAP_SERVER", server)
    monkeypatch.setenv("FLEETMAP_TOKEN", TOKEN)
    return offline
