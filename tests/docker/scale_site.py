"""All services of compose.scale.yaml as processes: proxy, three servers, two workers, S3 server, two Zenoh routers."""

from __future__ import annotations

import base64
import contextlib
import hashlib
import itertools
import json
import re
import signal
import ssl
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx

from app.agent.signatures import key_id, verify_signature
from app.errors import Untrusted
from app.events.credentials import ZenohCredentials
from app.events.router import Router
from tests.agent.conftest import network
from tests.docker.containers import Compose, Container
from tests.events.conftest import client_config, eventually

SERVERS = ("server-1", "server-2", "server-3")
WORKERS = ("worker-1", "worker-2")
ROUTERS = ("router-1", "router-2")
ROBOT, ROBOT_PASSWORD = "tractor-7", "ploughs-at-dawn"
START_SECONDS = 120.0


class Site:
    """Running services. https: client of the proxy; servers, workers: clients of each one behind it."""

    def __init__(self, folder: Path, database_url: str) -> None:
        self.compose = Compose("compose.scale.yaml", folder, database_url, "--scale", "--host", "127.0.0.1")
        with (self.compose.secrets / "robots").open("a") as robots:
            robots.write(f"{ROBOT}:{ROBOT_PASSWORD}\n")
        self.compose.make_secrets("--scale")
        names = [name for name in self.compose.services if name != "database"]
        self.containers = {name: Container(self.compose, name) for name in names}
        self.routers: dict[str, Router] = {}
        token = self.containers[SERVERS[0]].secret("fleetmap_admin_token")
        self.headers = {"Authorization": f"Bearer {token}"}
        self.https = self.client()
        self.servers = {name: self._inside(name) for name in SERVERS}
        self.workers = {name: self._inside(name) for name in WORKERS}

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
        self.containers["store"].start()
        for name in ROUTERS:
            self.start_router(name)
        migrate = self.containers["migrate"]
        done = migrate.run(migrate.command)
        assert done.returncode == 0, done.stderr
        eventually(lambda: self._answers("store"), START_SECONDS)
        for name in (*SERVERS, *WORKERS, "proxy"):
            self.containers[name].start()
        for name in (*SERVERS, *WORKERS):
            self.wait_ready(name)
        eventually(lambda: all(self.is_connected(name) for name in SERVERS))
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

    def leaders(self, names: Sequence[str] = SERVERS) -> list[str]:
        """Servers that relay events."""
        return [name for name in names if self.servers[name].get("/readyz").json()["events"].get("leader")]

    def leader(self, names: Sequence[str] = SERVERS) -> str:
        """Wait until one server relays events; return its name."""
        (name,) = eventually(lambda: len(leaders := self.leaders(names)) == 1 and leaders)
        return str(name)

    def robot_session(self, router: str) -> Any:
        """Open the Zenoh session of a robot at one of the routers."""
        import zenoh

        port = int(self.compose.address(router).rpartition(":")[2])
        login = ZenohCredentials(self.compose.secrets / "ca.pem", user=ROBOT, password=ROBOT_PASSWORD)
        endpoint = {"connect/endpoints": [f"tls/127.0.0.1:{port}"], "listen/endpoints": []}
        return zenoh.open(client_config(port, **endpoint, **login.values()))

    def close(self) -> None:
        """Stop everything."""
        for client in (self.https, *self.servers.values(), *self.workers.values()):
            client.close()
        for name in ("proxy", *SERVERS, *WORKERS):
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


@contextlib.contextmanager
def running_site(folder: Path, database_url: str) -> Iterator[Site]:
    """Run all services on a database."""
    site = Site(folder, database_url)
    try:
        site.start()
        yield site
    finally:
        site.close()


@dataclass
class Fetches:
    """What a pinned robot got. recipes: maps that differ by content, format or parameters."""

    count: int = 0
    refusals: list[str] = field(default_factory=list)
    signers: list[str] = field(default_factory=list)
    recipes: set[str] = field(default_factory=set)


def fetch_round_robin(
    site: Site, environment: str, count: int, rotate_at: Sequence[int], commit_at: Sequence[int] = ()
) -> Fetches:
    """Fetch manifest and maps like a robot, each from the next server; in between rotate keys and commit versions.

    A refusal is a manifest whose signer the robot's key does not endorse, or a map of another hash than its manifest's.
    """
    fetches, versions = Fetches(), f"/api/v1/environments/{environment}/versions"
    turn = itertools.cycle(site.servers.values())
    pinned = base64.b64decode(site.call(next(turn), "GET", "keys")[0]["public_key"])
    for number in range(count):
        if number in rotate_at:
            site.call(next(turn), "POST", "keys", json={})
        if number in commit_at:
            site.upload(next(turn), environment, 1.0 + number / 100)
        answer = next(turn).get(f"{versions}/latest/manifest?formats=tmap2,geojson")
        assert answer.status_code == 200, answer.text
        signature = answer.headers["Fleetmap-Signature"]
        try:
            pinned = verify_signature(
                answer.content, signature, pinned, None, lambda: site.call(next(turn), "GET", "keys")
            )
        except Untrusted as error:
            fetches.refusals.append(str(error))
            continue
        fetches.signers.append(key_id(pinned))
        manifest = answer.json()
        for file in manifest["files"]:
            served = next(turn).get(f"{versions}/{manifest['version']}/maps/{file['format']}/{file['name']}")
            if hashlib.sha256(served.content).hexdigest() != file["sha256"]:
                fetches.refusals.append(f"{file['name']}: {served.status_code}, another hash")
            fetches.recipes.add(f"{file['format']} {manifest['root']}")
        fetches.count += 1
    return fetches


def read_delays(site: Site, environment: str, commits: int) -> list[float]:
    """Commit on one server and poll another one, which serves the version before from memory.

    Returns the seconds from each commit's answer to the new map, sorted.
    """
    writer, reader, *_ = site.servers.values()
    address, delays = f"/maps/{environment}/tmap2", []
    for number in range(commits):
        before = reader.get(address).headers["etag"]
        site.upload(writer, environment, 2.0 + number / 1000)
        start = time.monotonic()
        while reader.head(address).headers["etag"] == before:
            assert time.monotonic() - start < START_SECONDS
        delays.append(time.monotonic() - start)
    return sorted(delays)


class Load:
    """Clients of the proxy that read and commit until they are stopped. failures: requests that were not answered.

    A refusal to do more work (503) is a failure, too: nothing here overloads the servers.
    """

    def __init__(self, site: Site, environment: str) -> None:
        self._site, self._environment = site, environment
        self._stop = threading.Event()
        self.failures: list[str] = []
        self.requests = 0
        self.commits: dict[str, int] = {}
        steps: list[Callable[[httpx.Client, int], httpx.Response]] = [self._read, self._read, self._commit]
        self._threads = [threading.Thread(target=self._run, args=(step,), daemon=True) for step in steps]
        for thread in self._threads:
            thread.start()

    def _run(self, step: Callable[[httpx.Client, int], httpx.Response]) -> None:
        with self._site.client() as client:
            for number in itertools.count():
                if self._stop.wait(0.05):
                    return
                try:
                    answer = step(client, number)
                except httpx.HTTPError as error:
                    self.failures.append(f"{step.__name__}: {error!r}")
                    continue
                self.requests += 1
                if answer.status_code >= 400:
                    self.failures.append(f"{step.__name__}: {answer.status_code} {answer.text[:300]}")

    def _read(self, client: httpx.Client, number: int) -> httpx.Response:
        addresses = (f"/maps/{self._environment}/tmap2", f"/api/v1/environments/{self._environment}/versions/latest")
        return client.get(addresses[number % 2])

    def _commit(self, client: httpx.Client, number: int) -> httpx.Response:
        message = f"commit {id(self)} {number}"
        answer = client.post(
            f"/api/v1/environments/{self._environment}/versions",
            files={"files": ("n.tmap2.yaml", network(0.01 * (number % 100) + 1.0, 40))},
            data={"message": message},
            headers={"Idempotency-Key": message},
        )
        if answer.status_code == 201:
            self.commits[message] = answer.json()["version"]
        return answer

    def wait_for_more(self, requests: int = 30) -> None:
        """Wait until so many more requests are answered, and another version is committed."""
        before, commits = self.requests, len(self.commits)
        eventually(lambda: self.requests >= before + requests and len(self.commits) > commits)

    def stop(self) -> None:
        """Stop, and check that every acknowledged version is there once, under its number."""
        self._stop.set()
        for thread in self._threads:
            thread.join(120)
            assert not thread.is_alive(), "a request is never answered"
        site, messages = self._site, {}
        path = f"environments/{self._environment}/versions?limit=100"
        cursor = ""
        while page := site.call(site.https, "GET", path + cursor):
            messages.update({version["version"]: version["message"] for version in page})
            cursor = f"&cursor={page[-1]['version']}"
        assert {message: number for number, message in messages.items() if message in self.commits} == self.commits


class ReadinessWatch:
    """Polls /readyz of running servers. unready: what it saw except 200."""

    def __init__(self, site: Site, names: Sequence[str]) -> None:
        self.names = set(names)
        self.unready: list[str] = []
        self.polls = 0
        self._site, self._stop = site, threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(0.1):
            for name in sorted(self.names):
                try:
                    answer = self._site.servers[name].get("/readyz")
                    problem = None if answer.status_code == 200 else f"{answer.status_code} {answer.text[:300]}"
                except httpx.TransportError as error:
                    problem = repr(error)
                self.polls += 1
                if problem and name in self.names:  # else it was taken away meanwhile
                    self.unready.append(f"{time.monotonic():.1f} {name}: {problem}")

    def stop(self) -> None:
        """Stop polling."""
        self._stop.set()
        self._thread.join(60)
