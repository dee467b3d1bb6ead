"""Several servers as real processes on one PostgreSQL database, each with a data folder of its own."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import pytest

from app.events.bus import BusOptions, router_configuration
from app.events.router import Router
from tests.agent.conftest import ROOT
from tests.api.conftest import ADMIN
from tests.cli.conftest import ServerProcess
from tests.events.conftest import eventually
from tests.ports import free_port
from tests.postgres import Cluster


@dataclass
class Server:
    """One server: its process, and a client with an administrator's token."""

    process: ServerProcess
    http: httpx.Client

    @property
    def leads(self) -> bool:
        """Whether it relays events."""
        return bool(self.http.get("/readyz").json()["events"].get("leader"))

    def signal(self, number: int) -> None:
        """Send a signal to the server's own process."""
        self.process.process.send_signal(number)


@dataclass
class Servers:
    """Servers on one database, which is empty at first, and one Zenoh router.

    Attributes:
        url: database URL.
        zenoh: port of the router; None without events.
        all: servers that run; a test removes those that it kills.
    """

    folder: Path
    url: str
    zenoh: int | None
    all: list[Server] = field(default_factory=list)
    started: list[Server] = field(default_factory=list)

    def launch(self, url: str | None = None, **settings: str) -> ServerProcess:
        """Start one more server, without waiting for it. url: another way to the database."""
        values = {
            "FLEETMAP_ADMIN_TOKEN": ADMIN,
            "FLEETMAP_CONVERSION_WORKERS": "1",
            "FLEETMAP_DATABASE_URL": url or self.url,
        }
        if self.zenoh is not None:
            endpoint = f"tcp/127.0.0.1:{self.zenoh}"
            values |= {"FLEETMAP_ZENOH_MODE": "client", "FLEETMAP_ZENOH_CONNECT": endpoint}
        values |= {f"FLEETMAP_{name.upper()}": value for name, value in settings.items() if value}
        values = {name: value for name, value in values.items() if settings.get(name[9:].lower()) != ""}
        number = len(list(self.folder.glob("server-*")))
        data = self.folder / f"server-{number}"
        data.mkdir()
        return ServerProcess("--data-dir", str(data), environment=values, folder=ROOT)

    def add(self, process: ServerProcess) -> Server:
        """Wait until a started server is ready, and add it."""
        http = httpx.Client(base_url=process.ready(), headers={"Authorization": f"Bearer {ADMIN}"}, timeout=30)
        server = Server(process, http)
        self.all.append(server)
        self.started.append(server)
        if self.zenoh is not None:
            eventually(lambda: http.get("/readyz").json()["events"]["state"] == "connected")
        return server

    def start(self, count: int, **settings: str) -> list[Server]:
        """Start servers at the same time and wait until all are ready."""
        return [self.add(process) for process in [self.launch(**settings) for _ in range(count)]]

    def leader(self) -> Server:
        """The server that relays events."""
        return eventually(lambda: next((server for server in self.all if server.leads), None))  # type: ignore[no-any-return]

    def call(self, server: Server, method: str, path: str, **more: Any) -> Any:
        """Call a server and return its JSON."""
        answer = server.http.request(method, f"/api/v1/{path}", **more)
        assert answer.status_code < 300, answer.text
        return answer.json() if answer.content else None

    def close(self) -> None:
        """Stop all servers."""
        for server in self.started:
            server.http.close()
            with contextlib.suppress(ProcessLookupError):
                server.signal(signal.SIGCONT)
            server.process.stop(signal.SIGKILL)


@contextmanager
def servers_on(cluster: Cluster, folder: Path, *, zenoh: bool = True) -> Iterator[Servers]:
    """Make servers on a database without a schema, of which none runs yet."""
    with ExitStack() as stack:
        database = cluster.create_database()
        stack.callback(cluster.drop_database, database)
        port = None
        if zenoh:
            port = free_port()
            router = Router(router_configuration(BusOptions(listen=f"tcp/127.0.0.1:{port}")))
            stack.callback(router.close)
            assert router.problem is None
        servers = Servers(folder, cluster.url(database), port)
        stack.callback(servers.close)
        yield servers


@pytest.fixture
def empty_servers(postgres_cluster: Cluster, tmp_path: Path) -> Iterator[Servers]:
    """Servers of which none runs yet."""
    with servers_on(postgres_cluster, tmp_path) as servers:
        yield servers


@pytest.fixture
def servers(empty_servers: Servers) -> Servers:
    """Three running servers on one database, each with a data folder of its own, connected to one Zenoh router."""
    empty_servers.start(3)
    return empty_servers
