"""Real server on a loopback port, in a thread of its own, so that tests see what clients see."""

from __future__ import annotations

import ssl
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import httpx
import pytest
import uvicorn
from fastapi import FastAPI

from app.config import Settings
from app.main import create_app, server_config
from app.store.store import Store
from tests.api import samples

ADMIN = "administrators-token-for-tests"
API = "/api/v1"
JOB_SECONDS = 250.0

Files = dict[str, bytes]


@dataclass
class Api:
    """Running server and a client with one token."""

    url: str
    app: FastAPI
    token: str | None = ADMIN
    verify: ssl.SSLContext | bool = False

    def __post_init__(self) -> None:
        headers = {"Authorization": f"Bearer {self.token}"} if self.token else {}
        self.others: list[Api] = []
        self.http = httpx.Client(base_url=self.url, headers=headers, timeout=60.0, verify=self.verify)

    def __call__(self, method: str, path: str, expect: int | None = None, **more: Any) -> httpx.Response:
        """Send a request; a path that does not start with / is below the API.

        expect: its status. If a GET that must succeed becomes a job because it takes long, as on a busy machine, wait
        for the job, and send it again.
        """
        target = path if path.startswith("/") else f"{API}/{path}"
        answer = self.http.request(method, target, **more)
        if method == "GET" and (expect, answer.status_code) == (200, 202):
            self.finished(answer.json())
            answer = self.http.request(method, target, **more)
        if expect is not None:
            assert answer.status_code == expect, f"{method} {path}: {answer.status_code} {answer.text[:2000]}"
        return answer

    def get(self, path: str, expect: int | None = 200, **more: Any) -> httpx.Response:
        return self("GET", path, expect, **more)

    def post(self, path: str, json: Any = None, expect: int | None = 201, **more: Any) -> httpx.Response:
        return self("POST", path, expect, json=json, **more)

    def upload(
        self, env: str, files: Files, expect: int | None = 201, headers: Any = None, **fields: str
    ) -> httpx.Response:
        return self(
            "POST", f"environments/{env}/versions", expect, files=parts(files), data=fields, headers=headers or {}
        )

    def problem(self, method: str, path: str, status: int, **more: Any) -> dict[str, Any]:
        """Send a request that must fail; return its problem, with checked members."""
        return problem(self(method, path, status, **more))

    def finished(self, job: dict[str, Any]) -> dict[str, Any]:
        """Wait until a job has ended, and return it."""
        deadline = time.monotonic() + JOB_SECONDS
        while job["state"] in ("queued", "running"):
            assert time.monotonic() < deadline, job
            time.sleep(0.25)
            job = self.get(f"jobs/{job['id']}").json()
        return job

    def as_(self, token: str | None) -> Api:
        """Return a client with another token; it is closed together with this one."""
        other = Api(self.url, self.app, token, self.verify)
        self.others.append(other)
        return other

    def token_for(self, role: str, **more: Any) -> Api:
        """Return a client with a new token."""
        return self.as_(self.post("tokens", {"name": f"a-{role}", "role": role, **more}).json()["token"])

    def close(self) -> None:
        for other in self.others:
            other.close()
        self.http.close()


def parts(files: Files) -> list[tuple[str, tuple[str, bytes]]]:
    return [("files", (name, data)) for name, data in files.items()]


def problem(answer: httpx.Response) -> dict[str, Any]:
    """Return the problem of a response: RFC 9457 with its members, `errors` and no others."""
    assert answer.headers["content-type"] == "application/problem+json", answer.text[:500]
    body: dict[str, Any] = answer.json()
    assert set(body) <= {"type", "title", "status", "detail", "errors"}, body
    assert body["status"] == answer.status_code
    assert body["type"]
    assert body["title"]
    assert body["detail"]
    for item in body.get("errors", ()):
        assert set(item) <= {"file", "line", "where", "problem"}, item
        assert item["problem"]
    assert "Traceback" not in answer.text
    assert "site-packages" not in answer.text
    return body


@cache
def empty_database() -> bytes:
    """Return an SQLite database with the schema: writing it takes a hundredth of the time of migrating one."""
    with tempfile.TemporaryDirectory() as folder:
        store = Store(f"sqlite:///{folder}/empty.sqlite3", Path(folder) / "blobs")
        store.migrate()
        store.close()
        return (Path(folder) / "empty.sqlite3").read_bytes()


@contextmanager
def running(settings: Settings, verify: ssl.SSLContext | bool = False, *, migrates: bool = False) -> Iterator[Api]:
    """Run a server with these settings.

    verify: TLS settings of its client, for HTTPS. migrates: whether it makes its SQLite database itself, with the
    write-ahead log that this leaves; else it gets a copy of an empty one.
    """
    file = settings.data_dir / "fleetmap.sqlite3"
    if not migrates and settings.database_url is None and not file.exists():
        settings.data_dir.mkdir(parents=True, exist_ok=True)
        file.write_bytes(empty_database())
    app = create_app(settings)
    server = uvicorn.Server(server_config(settings, app, port=0))
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        deadline = time.monotonic() + 60
        while not server.started:
            assert thread.is_alive(), "the server did not start"
            assert time.monotonic() < deadline, "the server did not start in time"
            time.sleep(0.01)
        assert app.state.services.prepared.wait(240), "the server was not ready in time"
        port = server.servers[0].sockets[0].getsockname()[1]
        scheme = "https" if settings.tls_certificate else "http"
        api = Api(f"{scheme}://127.0.0.1:{port}", app, verify=verify)
        try:
            yield api
        finally:
            api.close()
    finally:
        server.should_exit = True
        thread.join(60)
        assert not thread.is_alive(), "the server did not stop"


def settings_for(folder: Path, **more: Any) -> Settings:
    """Create settings that ignore the environment variables of the test run."""
    values = {"admin_token": ADMIN, "conversion_workers": 1, "max_memory_bytes": 4 * 2**30, "log_level": "warning"}
    values["zenoh_mode"] = "off"  # tests of events set the addresses of their router
    return Settings(_env_file=None, data_dir=folder, **{**values, **more})  # type: ignore[call-arg]


def create_farm(api: Api, name: str) -> str:
    """Create an environment with a datum (version 1), a network (2) and a grid (3)."""
    api.post("environments", {"name": name, "title": "Farm", "tags": ["wheat"]})
    api.upload(name, {"datum.yaml": samples.DATUM}, message="measured")
    api.upload(name, {"network.tmap2.yaml": samples.tmap2()}, message="driven")
    api.upload(name, samples.grid(), message="mapped")
    return name


@pytest.fixture
def farm(api: Api, fresh: Callable[[], str]) -> str:
    """Create an environment of the test's own, as ``create_farm`` does."""
    return create_farm(api, fresh())


@pytest.fixture(scope="session")
def unchanged_farm(api: Api) -> str:
    """Return the environment that tests share which only read, or whose requests are refused."""
    return create_farm(api, "unchanged-farm")


@pytest.fixture
def bare(api: Api, fresh: Callable[[], str]) -> str:
    """Create an empty environment."""
    name = fresh()
    api.post("environments", {"name": name})
    return name
