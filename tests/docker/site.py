"""Services of a compose file as processes: proxy, servers, workers, S3 server and Zenoh routers.

The database is that of the tests.
"""

from __future__ import annotations

import json
import re
import signal
import ssl
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import httpx

from app.events.credentials import ZenohCredentials
from app.events.router import Router
from tests.agent.conftest import network
from tests.docker.containers import Compose, Container
from tests.events.conftest import client_config, eventually

ROBOT = "tractor-7"
START_SECONDS = 120.0


class Site:
    """Running services. https: client of the proxy; servers, workers: clients of each one behind it."""

    FILE: ClassVar[str]
    OPTIONS: ClassVar[tuple[str, ...]] = ()
    """Further options of make_secrets.py."""
    VARIABLES: ClassVar[Mapping[str, str]] = {}
    SERVERS: ClassVar[tuple[str, ...]]
    WORKERS: ClassVar[tuple[str, ...]] = ()
    ROUTERS: ClassVar[tuple[str, ...]]
    OTHERS: ClassVar[tuple[str, ...]]
    """Services beside these that run."""

    def __init__(self, folder: Path, database_url: str) -> None:
        options = ("--host", "127.0.0.1", "--robot", ROBOT, *self.OPTIONS)
        self.compose = Compose(self.FILE, folder, database_url, *options, variables=self.VARIABLES)
        names = (*self.ROUTERS, *self.SERVERS, *self.WORKERS, *self.OTHERS)
        self.containers = {name: Container(self.compose, name) for name in names}
        self.routers: dict[str, Router] = {}
        self.token = self.containers[self.SERVERS[0]].secret("fleetmap_admin_token")
        self.headers = {"Authorization": f"Bearer {self.token}"}
        self.https = self.client()
        self.servers = {name: self._inside(name) for name in self.SERVERS}
        self.workers = {name: self._inside(name) for name in self.WORKERS}

    def client(self) -> httpx.Client:
        """Return another client of the proxy, which trusts the authority of the secrets."""
        trust = ssl.create_default_context(cafile=self.compose.secrets / "ca.pem")
        address = f"https://{self.compose.address('proxy')}"
        return httpx.Client(base_url=address, headers=self.headers, verify=trust, timeout=60)

    def _inside(self, name: str) -> httpx.Client:
        return httpx.Client(base_url=f"http://{self.compose.address(name)}", headers=self.headers, timeout=60)

    # --- processes ---

    def start(self) -> None:
        """Start everything in the order of ``depends_on``."""
        if "store" in self.OTHERS:
            self.containers["store"].start()
        for name in self.ROUTERS:
            self.start_router(name)
        migrate = self.containers["migrate"]
        done = migrate.run(migrate.command)
        assert done.returncode == 0, done.stderr
        if "store" in self.OTHERS:
            eventually(lambda: self._answers("store"), START_SECONDS)
        for name in (*self.SERVERS, *self.WORKERS, "proxy"):
            self.containers[name].start()
        for name in (*self.SERVERS, *self.WORKERS):
            self.wait_ready(name)
        eventually(lambda: all(self.is_connected(name) for name in self.SERVERS))
        eventually(lambda: self.is_ready(self.https), START_SECONDS)

    def _answers(self, name: str) -> bool:
        try:
            return httpx.get(f"http://{self.compose.address(name)}/healthz", timeout=5).status_code == 200
        except httpx.TransportError:
            return False

    def start_router(self, name: str) -> None:
        """Start a router as zenohd does with the service's command."""
        options = self.containers[name].command
        values = dict(option.partition("=")[::2] for option in options)
        configuration = json.loads(Path(values["--config"]).read_text())
        if "--connect" in values:
            configuration["connect"] = {"endpoints": [values["--connect"]]}
        assert "--no-multicast-scouting" in values
        assert configuration["scouting"]["multicast"]["enabled"] is False

        def starts() -> bool:  # its port may be taken for a moment after a stop
            self.routers[name] = Router(json.dumps(configuration))
            return self.routers[name].problem is None

        eventually(starts)

    def wait_ready(self, name: str) -> None:
        """Wait until a server or worker is ready; fails at once if it has ended."""
        container, client = self.containers[name], {**self.servers, **self.workers}[name]

        def ready() -> bool:
            assert container.process is not None
            assert container.process.poll() is None, f"{name} has ended:\n{container.log[-3000:]}"
            return self.is_ready(client)

        eventually(ready, START_SECONDS)

    @staticmethod
    def is_ready(client: httpx.Client) -> bool:
        """Whether /readyz returns 200."""
        try:
            return client.get("/readyz").status_code == 200
        except httpx.TransportError:
            return False

    def is_connected(self, name: str) -> bool:
        """Whether a server is connected to a Zenoh router."""
        return bool(self.servers[name].get("/readyz").json()["events"]["state"] == "connected")

    def leaders(self, names: Sequence[str] | None = None) -> list[str]:
        """Servers that relay events."""
        return [
            name for name in names or self.SERVERS if self.servers[name].get("/readyz").json()["events"].get("leader")
        ]

    def leader(self, names: Sequence[str] | None = None) -> str:
        """Wait until one server relays events; return its name."""
        (name,) = eventually(lambda: len(leaders := self.leaders(names)) == 1 and leaders)
        return str(name)

    @property
    def robot_password(self) -> str:
        """The robot's password at the routers."""
        lines = (self.compose.secrets / "robots").read_text().splitlines()
        return next(line.partition(":")[2] for line in lines if line.startswith(f"{ROBOT}:"))

    def robot_session(self, router: str, password: str | None = None) -> Any:
        """Open the Zenoh session of a robot at one of the routers. password: default the right one."""
        import zenoh

        port = int(self.compose.address(router).rpartition(":")[2])
        login = ZenohCredentials(self.compose.secrets / "ca.pem", user=ROBOT, password=password or self.robot_password)
        endpoint = {"connect/endpoints": [f"tls/127.0.0.1:{port}"], "listen/endpoints": []}
        return zenoh.open(client_config(port, **endpoint, **login.values()))

    def close(self) -> None:
        """Stop everything."""
        for client in (self.https, *self.servers.values(), *self.workers.values()):
            client.close()
        for name in ("proxy", *self.SERVERS, *self.WORKERS):
            process = self.containers[name].process
            if process is not None and process.poll() is None:
                process.terminate()  # all at once; stop() waits
        for container in self.containers.values():
            # SeaweedFS first waits for clients, for 25 seconds.
            container.stop(signal.SIGKILL if container.name == "store" else signal.SIGTERM)
        for router in self.routers.values():
            router.close()

    # --- requests ---

    def call(self, client: httpx.Client, method: str, path: str, **request: Any) -> Any:
        """Call the API and return its JSON; path: below /api/v1."""
        answer = client.request(method, f"/api/v1/{path}", **request)
        assert answer.status_code < 300, f"{answer.status_code} {answer.text}"
        return answer.json() if answer.content else None

    def upload(self, client: httpx.Client, environment: str, moved: float, nodes: int = 60) -> int:
        """Upload a network with one node moved by some metres; return the version."""
        files = {"files": ("n.tmap2.yaml", network(moved, nodes))}
        return int(self.call(client, "POST", f"environments/{environment}/versions", files=files)["version"])

    def conversions(self) -> dict[str, int]:
        """Number of maps that each server and worker has made."""
        clients = {**self.servers, **self.workers}
        texts = {name: client.get("/metrics").text for name, client in clients.items()}
        pattern = re.compile(r'^fleetmap_conversions_total\{.*result="made"\} (\S+)', re.MULTILINE)
        return {name: sum(int(float(value)) for value in pattern.findall(text)) for name, text in texts.items()}
