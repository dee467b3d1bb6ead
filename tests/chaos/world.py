"""Server, router and database in separate processes, with robots that follow and writers that retry forever."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import random
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, ClassVar

import httpx
import zenoh

from app.events.bus import BusOptions, router_configuration
from app.events.router import Router
from app.store.store import Store
from tests.agent.conftest import ROOT, Robot, network
from tests.api.conftest import ADMIN
from tests.chaos import collector
from tests.cli.conftest import ServerProcess, seconds_until_healthy
from tests.events.conftest import Listener, client_config, eventually
from tests.events.receiver import Receiver
from tests.ports import free_port
from tests.postgres import Cluster

ENVIRONMENT = "farm"
HEADERS = {"Authorization": f"Bearer {ADMIN}"}
SIDE = 300
"""Side of the noisy grid in cells: 90 kB that no delta can shrink."""

SHADES = bytes((0, 205, 254)[k % 3] for k in range(256))

UNAVAILABLE = (503, 507)
"""Statuses of a server that is ending, starting, without its database, or on a full disk."""

COMMIT, RELAY, DOWNLOAD, ANY = "commit", "relay", "download", "any"


class World:
    """Server, router, database, and a process that collects garbage.

    own_router: the server's own one; else a separate one. forked: see ServerProcess. more: further variables of the
    server.
    """

    def __init__(
        self, folder: Path, cluster: Cluster | None, *, own_router: bool, forked: bool = True, **more: str
    ) -> None:
        self.folder, self.cluster, self.own_router, self._forked = folder, cluster, own_router, forked
        self.port, self.zenoh = free_port(), free_port()
        self.variables = {
            "FLEETMAP_ADMIN_TOKEN": ADMIN,
            "FLEETMAP_CONVERSION_WORKERS": "1",
            "FLEETMAP_LOG_LEVEL": "warning",
            "FLEETMAP_ZENOH_MODE": "router" if own_router else "client",
            "FLEETMAP_ZENOH_LISTEN": f"tcp/127.0.0.1:{self.zenoh}",
            "FLEETMAP_WEBHOOK_NETWORKS": "127.0.0.1",
            **more,
        }
        if not own_router:
            endpoint = f"tcp/127.0.0.1:{self.zenoh}"
            self.variables |= {"FLEETMAP_ZENOH_CONNECT": endpoint, "FLEETMAP_ZENOH_ADVERTISE": endpoint}
        if cluster is not None:
            url = cluster.url(cluster.create_database())
            self.variables["FLEETMAP_DATABASE_URL"] = url
            (folder / "data" / "blobs").mkdir(parents=True)
            store = Store(url, folder / "data" / "blobs")
            store.migrate()
            store.close()
        self.router = None if own_router else self._separate()
        self.printed: list[str] = []
        self.server: ServerProcess | None = None
        self.serve()
        self.revive_collector()
        self.http = httpx.Client(
            base_url=f"http://127.0.0.1:{self.port}/api/v1", headers=HEADERS, timeout=20, verify=False
        )

    # --- processes that are killed and restarted ---

    def serve(self) -> None:
        """Start the server and wait until it responds."""
        arguments = ("--port", str(self.port), "--data-dir", str(self.folder / "data"))
        self.server = ServerProcess(*arguments, environment=self.variables, folder=ROOT, forked=self._forked)
        self.server.ready()

    def revive(self, target: str) -> float:
        """Restart the killed process; return the seconds until /healthz responds."""
        start = time.monotonic()
        with ThreadPoolExecutor(1) as pool:
            healthy = pool.submit(seconds_until_healthy, f"http://127.0.0.1:{self.port}", start)
            getattr(self, f"revive_{target}")()
            return healthy.result()

    def kill_server(self) -> None:
        assert self.server is not None
        self.server.process.send_signal(signal.SIGKILL)

    def revive_server(self) -> None:
        assert self.server is not None
        self.server.stop(signal.SIGKILL)
        self.printed += self.server.lines
        self.serve()

    def kill_router(self) -> None:
        """Kill the server's own router, which it restarts itself, or the separate one."""
        if self.router is not None:
            self.router._process.kill()
            return
        assert self.server is not None
        listing = subprocess.run(
            ["pgrep", "-P", str(self.server.process.pid), "-f", "app.events.router"],
            capture_output=True,
            text=True,
            check=False,
        )
        for process in listing.stdout.split():
            os.kill(int(process), signal.SIGKILL)

    def revive_router(self) -> None:
        if self.router is not None:
            self.router.close()
            self.router = self._separate()

    def _separate(self) -> Router:
        for _ in range(50):
            router = Router(router_configuration(BusOptions(listen=f"tcp/127.0.0.1:{self.zenoh}")))
            if router.problem is None:
                return router
            time.sleep(0.1)
        raise AssertionError(f"the router does not start again: {router.problem}")

    def kill_database(self) -> None:
        assert self.cluster is not None
        self.cluster.kill()

    def revive_database(self) -> None:
        assert self.cluster is not None
        self.cluster.restart()

    def kill_collector(self) -> None:
        self.collector.kill()
        self.collector.wait(60)

    def revive_collector(self) -> None:
        clean = {name: value for name, value in os.environ.items() if not name.startswith("FLEETMAP_")}
        variables = {**clean, **self.variables, "FLEETMAP_DATA_DIR": str(self.folder / "data")}
        self.collector = collector.start(variables, self.folder, self.folder / "collector.log")

    def close(self) -> None:
        self.http.close()
        self.kill_collector()
        if self.server is not None:
            self.server.stop()
            self.printed += self.server.lines
        if self.router is not None:
            self.router.close()

    # --- requests ---

    def get(self, path: str, seconds: float = 60.0) -> Any:
        """Get JSON from the server; retry while it is restarting."""
        deadline = time.monotonic() + seconds
        while True:
            with contextlib.suppress(httpx.TransportError):
                answer = self.http.get(path)
                if answer.status_code == 200:
                    return answer.json()
                assert answer.status_code == 503, f"{path}: {answer.status_code} {answer.text}"
            assert time.monotonic() < deadline, f"{path} is not answered"
            time.sleep(0.1)


class Writer:
    """Writer that commits changes one by one, each with an idempotency key and repeated until acknowledged."""

    def __init__(self, world: World, name: str, seed: int, pause: float = 0.3) -> None:
        self._world, self._dice = world, random.Random(seed)
        self.name, self._pause = name, pause
        self.busy = threading.Event()
        self.stopping = threading.Event()
        self.commits: dict[str, int] = {}
        self.tries = 0
        self.last = 0.0
        self.problem: BaseException | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self.stopping.set()
        self._thread.join(90)
        assert not self._thread.is_alive(), f"{self.name} hangs"
        if self.problem is not None:
            raise self.problem

    def _run(self) -> None:
        try:
            with httpx.Client(base_url=self._world.http.base_url, headers=HEADERS, timeout=20, verify=False) as client:
                count = 0
                while not self.stopping.is_set():
                    count += 1
                    self._commit(client, f"{self.name} {count}")
                    self.stopping.wait(self._dice.uniform(0, self._pause))
        except BaseException as error:  # noqa: BLE001  the test's thread raises it
            self.problem = error

    def _commit(self, client: httpx.Client, message: str) -> None:
        files = self._files()
        while True:
            self.tries += 1
            self.busy.set()
            try:
                answer = client.post(
                    f"environments/{ENVIRONMENT}/versions",
                    files=[("files", (name, data)) for name, data in files.items()],
                    data={"message": message},
                    headers={"Idempotency-Key": message},
                )
            except httpx.TransportError:
                time.sleep(self._dice.uniform(0, 0.2))
                continue
            finally:
                self.busy.clear()
            if answer.status_code == 201:
                self.commits[message] = answer.json()["version"]
                self.last = time.monotonic()
                return
            assert answer.status_code in UNAVAILABLE, f"{answer.status_code} {answer.text}"
            time.sleep(self._dice.uniform(0, 0.2))

    def _files(self) -> dict[str, bytes]:
        raise NotImplementedError


class Surveyor(Writer):
    """Writer that moves a node of the network."""

    def _files(self) -> dict[str, bytes]:
        return {"n.tmap2.yaml": network(round(self._dice.uniform(0.001, 5), 6), 100)}


class Mapper(Writer):
    """Writer that replaces the noisy grid."""

    def _files(self) -> dict[str, bytes]:
        pixels = self._dice.randbytes(SIDE * SIDE).translate(SHADES)
        described = b"image: map.pgm\nresolution: 0.1\norigin: [0.0, 0.0, 0.0]\nnegate: 0\n"
        described += b"occupied_thresh: 0.65\nfree_thresh: 0.196\n"
        return {"map.yaml": described, "map.pgm": b"P5 %d %d 255\n" % (SIDE, SIDE) + pixels}


class Promoter(Writer):
    """Writer that moves the channel production forward, and sometimes back. moves: acknowledged versions."""

    def __init__(self, world: World, name: str, seed: int, pause: float = 0.3) -> None:
        super().__init__(world, name, seed, pause)
        self.moves: list[int] = []

    def _commit(self, client: httpx.Client, message: str) -> None:
        del message
        with contextlib.suppress(httpx.TransportError):
            head = client.get(f"environments/{ENVIRONMENT}/versions/latest")
            if head.status_code == 200:
                back = self._dice.choice((0, 0, 0, 1, 3))
                version = max(2, head.json()["version"] - back)
                if self.promote(client, version) and self.moves[-1:] != [version]:
                    self.moves.append(version)
        self.stopping.wait(self._pause)

    @staticmethod
    def promote(client: httpx.Client, version: int) -> bool:
        answer = client.put(f"environments/{ENVIRONMENT}/channels/production", json={"version": version})
        assert answer.status_code in (200, *UNAVAILABLE), answer.text
        return bool(answer.status_code == 200)


class Closer(Writer):
    """Writer that reports closures, accepts them and ends most. states: what was acknowledged, by id."""

    RANKS: ClassVar = {"pending": 0, "accepted": 1, "ended": 2}

    def __init__(self, world: World, name: str, seed: int, pause: float = 1.5) -> None:
        super().__init__(world, name, seed, pause)
        self.states: dict[str, str] = {}

    def _commit(self, client: httpx.Client, message: str) -> None:
        x = self._dice.uniform(0, 40)
        ring = [[x, 0], [x + 0.2, 0], [x + 0.2, 0.2], [x, 0]]
        square = {"type": "Polygon", "coordinates": [ring]}
        body = {"kind": "blocked", "polygon": square, "crs": "local", "ttl_seconds": 86_400, "detail": message}
        url = f"environments/{ENVIRONMENT}/overlays"
        created = self._send(client, url, body)
        identifier = str(created["id"])
        self.states[identifier] = "pending"
        for step, state in (("accept", "accepted"), ("end", "ended")):
            self.stopping.wait(self._dice.uniform(0, 0.5))
            self._send(client, f"{url}/{identifier}/{step}", {})
            self.states[identifier] = state
        self.stopping.wait(self._dice.uniform(0.2, self._pause))

    def _send(self, client: httpx.Client, path: str, body: dict[str, Any]) -> Any:
        """Send until it is acknowledged. 409: an earlier try was carried out, and its response lost."""
        while True:
            self.busy.set()
            try:
                answer = client.post(path, json=body)
            except httpx.TransportError:
                time.sleep(self._dice.uniform(0, 0.2))
                continue
            finally:
                self.busy.clear()
            if answer.status_code in (200, 201, 409):
                return answer.json()
            assert answer.status_code in UNAVAILABLE, f"{path}: {answer.status_code} {answer.text}"
            time.sleep(self._dice.uniform(0, 0.2))


class Reader:
    """Reader of server-sent events that resumes with ``Last-Event-ID``. sequences: those that it processed."""

    def __init__(self, world: World) -> None:
        self._world = world
        self.sequences: list[int] = []
        self.connections = 0
        self.stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self.stopping.is_set():
            with contextlib.suppress(httpx.TransportError):
                self._read()
            self.stopping.wait(0.1)

    def _read(self) -> None:
        headers = {**HEADERS, "Last-Event-ID": str(self.sequences[-1] if self.sequences else 0)}
        params = {"environment": ENVIRONMENT}
        timeout = httpx.Timeout(5.0, read=20.0)
        with (
            httpx.Client(base_url=self._world.http.base_url, headers=headers, timeout=timeout, verify=False) as client,
            client.stream("GET", "events", params=params) as answer,
        ):
            if answer.status_code != 200:
                return
            self.connections += 1
            for line in answer.iter_lines():
                if line.startswith("data:"):
                    self.sequences.append(json.loads(line[5:])["sequence"])
                if self.stopping.is_set():
                    return

    def stop(self) -> None:
        self.stopping.set()
        self._thread.join(30)


class Watcher:
    """Watcher that polls the robots' disks: maps are always complete and never go back."""

    def __init__(self, robots: list[Robot]) -> None:
        self._robots = robots
        self.looks = 0
        self.problem: BaseException | None = None
        self.stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        marks: dict[str, int] = {}
        try:
            while not self.stopping.wait(0.05):
                for robot in self._robots:
                    sequence = check_current_map(robot.into)
                    if sequence is not None:
                        self.looks += 1
                        name = robot.into.name
                        assert sequence >= marks.get(name, 0), f"{name} went back to the sequence {sequence}"
                        marks[name] = sequence
        except BaseException as error:  # noqa: BLE001  the test's thread raises it
            self.problem = error

    def stop(self) -> None:
        self.stopping.set()
        self._thread.join(30)
        if self.problem is not None:
            raise self.problem


def check_current_map(into: Path) -> int | None:
    """Return the sequence of the current map after verifying its files; None if there is no map yet."""
    for _ in range(20):
        try:
            version = (into / "current").resolve(strict=True)
        except FileNotFoundError:
            return None
        try:
            manifest = json.loads((version / "manifest.json").read_bytes())
            for file in manifest["files"]:
                data = (version / file["format"] / file["name"]).read_bytes()
                expected = (file["size"], file["sha256"])
                assert (len(data), hashlib.sha256(data).hexdigest()) == expected, f"{into.name}: half a map: {file}"
            return int(manifest["sequence"])
        except FileNotFoundError:
            # After three more switches the old version was removed. The current one must be complete.
            assert (into / "current").resolve() != version, f"{into.name}: the current map lacks a file"
    raise AssertionError(f"{into.name} switches faster than its map can be read")


class Fleet:
    """Robots, the event readers and the writers of one world.

    pause: maximum pause of a writer after each write, in seconds. proxy: port by which robots reach the server.
    robots: folder of their maps, if it is not the world's.
    """

    def __init__(
        self, world: World, seed: int, *, pause: float = 0.3, proxy: int | None = None, robots: Path | None = None
    ) -> None:
        folder = robots or world.folder
        self.world = world
        self.dice = random.Random(seed)
        self.receiver = Receiver()
        hook = world.http.post("webhooks", json={"url": self.receiver.url}).raise_for_status().json()
        self.receiver.secret = hook["secret"]
        world.http.post("environments", json={"name": ENVIRONMENT}).raise_for_status()
        self.writers: list[Writer] = [
            Surveyor(world, "surveyor", seed + 1, pause),
            Mapper(world, "mapper", seed + 2, pause),
        ]
        self.first = [Mapper(world, "first map", seed + 3), Surveyor(world, "first network", seed + 4)]
        for writer in self.first:
            writer._commit(world.http, writer.name)
        assert Promoter.promote(world.http, 2)
        self.promoter = Promoter(world, "promoter", seed + 5, pause)
        self.closer = Closer(world, "closer", seed + 6, max(1.5, pause))
        self.robots: list[Robot] = []
        server = f"http://127.0.0.1:{proxy or world.port}"
        for name, *more in (
            ("hearing", "--poll", "3600", "--channel", "latest"),  # only events, and the router's return
            ("polling", "--poll", "1", "--channel", "latest"),
            ("promoted", "--poll", "3600", "--channel", "production"),
        ):
            hook = f'echo "$FLEETMAP_SEQUENCE $FLEETMAP_VERSION $FLEETMAP_ROOT" >> {folder}/{name}.hooks'
            variables = {"FLEETMAP_ZENOH_CONNECT": "tcp/127.0.0.1:1"} if name == "polling" else {}
            self.robots.append(
                Robot(
                    server,
                    ENVIRONMENT,
                    folder / name,
                    *more,
                    "--on-change",
                    hook,
                    formats="tmap2,occupancy_grid",
                    **variables,
                )
            )
        for robot in self.robots:
            robot.wait("active")
        self.session = zenoh.open(client_config(world.zenoh))
        self.listener = Listener(self.session, f"fleetmap/{ENVIRONMENT}/events")
        self.reader = Reader(world)
        self.watcher = Watcher(self.robots)
        for writer in (*self.writers, self.promoter, self.closer):
            writer.start()

    def count_commits(self) -> int:
        """Number of acknowledged commits."""
        return sum(len(writer.commits) for writer in self.writers)

    def wait_for(self, phase: str) -> None:
        """Wait until a phase is in progress."""
        if phase == COMMIT:
            self._until(lambda: any(writer.busy.is_set() for writer in self.writers))
            time.sleep(self.dice.uniform(0, 0.08))
        elif phase == RELAY:
            count = self.count_commits()
            self._until(lambda: self.count_commits() > count)
            time.sleep(self.dice.uniform(0, 0.01))
        elif phase == DOWNLOAD:
            lines = [len(robot.lines) for robot in self.robots]
            self._until(lambda: any(self._fetching(r, n) for r, n in zip(self.robots, lines, strict=True)))
            time.sleep(self.dice.uniform(0, 0.05))
        else:
            time.sleep(self.dice.uniform(0, 0.5))

    def under_way(self) -> set[str]:
        """Return the phases in progress."""
        stages = set()
        if any(writer.busy.is_set() for writer in self.writers):
            stages.add(COMMIT)
        received = {event["version"] for event in list(self.listener.events)}
        if any(version not in received for writer in self.writers for version in list(writer.commits.values())[-3:]):
            stages.add(RELAY)
        if any(self._fetching(robot) for robot in self.robots):
            stages.add(DOWNLOAD)
        return stages

    @staticmethod
    def _fetching(robot: Robot, after: int = 0) -> bool:
        kinds = [line["event"] for line in list(robot.lines)[after:]]
        last = next((kind for kind in reversed(kinds) if kind in ("downloading", "switched", "failed")), None)
        return last == "downloading"

    @staticmethod
    def _until(condition: Callable[[], bool], seconds: float = 20.0) -> None:
        deadline = time.monotonic() + seconds
        while not condition() and time.monotonic() < deadline:
            time.sleep(0.001)

    def settle(self, seconds: float = 90.0) -> dict[str, Any]:
        """Stop the writers, promote the head, and wait until all robots and readers have it. Returns the head."""
        for writer in (*self.writers, self.promoter, self.closer):
            writer.stop()
        head: dict[str, Any] = self.world.get(f"environments/{ENVIRONMENT}/versions/latest")
        eventually(lambda: Promoter.promote(self.world.http, head["version"]), seconds)
        for robot in self.robots:
            try:
                eventually(lambda r=robot: r.standing["root"] == head["root"], seconds)
            except AssertionError:
                log = "\n".join(map(str, robot.lines[-20:]))
                raise AssertionError(f"{robot.into.name} does not come to {head['version']}:\n{log}") from None
        return head

    def close(self) -> None:
        for writer in (*self.writers, self.promoter, self.closer):
            writer.stopping.set()
        self.watcher.stopping.set()
        self.reader.stop()
        for robot in self.robots:
            robot.kill()
        self.receiver.close()
        self.session.close()  # type: ignore[no-untyped-call]


@contextlib.contextmanager
def fleet_of(folder: Path, cluster: Cluster | None, *, own_router: bool, seed: int) -> Iterator[Fleet]:
    """Run a world with a working fleet."""
    world = World(folder, cluster, own_router=own_router)
    try:
        fleet = Fleet(world, seed)
        try:
            yield fleet
        finally:
            fleet.close()
    finally:
        world.close()
