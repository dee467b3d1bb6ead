"""All services of compose.scale.yaml as processes: proxy, three servers, two workers, S3 server, two Zenoh routers."""

from __future__ import annotations

import base64
import contextlib
import hashlib
import itertools
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import httpx

from app.agent.signatures import key_id, verify_signature
from app.errors import Untrusted
from tests.agent.conftest import network
from tests.docker.site import START_SECONDS, Site
from tests.events.conftest import eventually

SERVERS = ("server-1", "server-2", "server-3")
WORKERS = ("worker-1", "worker-2")
ROUTERS = ("router-1", "router-2")


class ScaleSite(Site):
    """Services of compose.scale.yaml."""

    FILE = "compose.scale.yaml"
    OPTIONS = ("--scale",)
    SERVERS, WORKERS, ROUTERS = SERVERS, WORKERS, ROUTERS
    OTHERS = ("proxy", "store", "migrate")


@contextlib.contextmanager
def running_site(folder: Path, database_url: str) -> Iterator[ScaleSite]:
    """Run all services on a database."""
    site = ScaleSite(folder, database_url)
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
