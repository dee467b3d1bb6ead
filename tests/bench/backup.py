"""Backups: commits during one, what it contains, what a second one costs, the robots after a restore, verification.

FLEETMAP_BENCH_BACKUP_GB: size of the store (1). Everything runs as an operator runs it: a server's process, 5 writers
over HTTP, ``fleetmap backup`` and ``restore`` in processes of their own, agents in this one.
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import httpx
import numpy as np

from app import native
from app.agent.agent import Agent
from app.agent.options import AgentOptions
from app.model.grid import OccupancyGrid
from app.store.changes import Changes, Replace
from app.store.store import Store
from app.store.values import Source
from tests.agent.conftest import network
from tests.api.conftest import ADMIN
from tests.cli.conftest import ServerProcess
from tests.postgres import running_cluster
from tests.store.samples import GRID

GIGABYTES = float(os.environ.get("FLEETMAP_BENCH_BACKUP_GB", "1"))
STEP_BYTES = 24 * 2**20
"""Bytes that each version of the filling adds: one third a grid's tiles, two thirds its upload."""

SHARE_CHANGED = 0.05
WRITERS = 5
PAUSE_SECONDS = 0.1
"""Pause of a writer after a commit: so many writers would otherwise measure the server's processor."""

PHASE_SECONDS = 10.0
MAX_COMPILE_SECONDS = 600.0
WINDOW_SECONDS = 4.0
CYCLES = 2
ROBOTS = 20
MAX_SLOWER, MAX_WRITTEN, MIN_VERIFY_MB, MIN_OF_SHA256SUM = 1.1, 1.1, 500.0, 0.8
ENVIRONMENT = "filled"
ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Home:
    """Data folder of a server, and its database: SQLite's file in it, or the URL of another one."""

    data: Path
    database: str | None = None

    def open_store(self, *, readonly: bool = False) -> Store:
        """Open the store."""
        url = self.database or f"sqlite:///{self.data / 'fleetmap.sqlite3'}"
        return Store(url, self.data / "blobs", readonly=readonly)

    @property
    def window_seconds(self) -> float:
        """Time for which a backup is stopped: PostgreSQL gives what it holds to others once it is silent for 2 s."""
        return WINDOW_SECONDS if self.database is None else WINDOW_SECONDS / 4

    @property
    def options(self) -> tuple[str, ...]:
        """Options of a command on this data."""
        database = () if self.database is None else ("--database-url", self.database)
        return ("--data-dir", str(self.data), *database)


def rows(*, postgres: bool = False) -> list[dict[str, Any]]:
    """Measure everything on SQLite, or on PostgreSQL with synced commits."""
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        if not postgres:
            return _rows(folder, Home(folder / "data"), Home(folder / "restored"))
        cluster = stack.enter_context(running_cluster(synced=True))
        (folder / "data" / "blobs").mkdir(parents=True)
        urls = [cluster.url(cluster.create_database()) for _ in "12"]
        return _rows(folder, Home(folder / "data", urls[0]), Home(folder / "restored", urls[1]))


def _rows(folder: Path, home: Home, target: Home) -> list[dict[str, Any]]:
    """Measure everything on one database."""
    place = folder / "backup"
    with closing(home.open_store()) as store:
        store.migrate()
        fill(store, int(GIGABYTES * 2**30))
    with running_server(home) as (server, client):
        out, acknowledged, former = _during(client, home, place)
        out += _incremental(client, home, place, former)
        robots = _Robots(server.address, folder / "robots")
        robots.sync()
        promote(client, "writer-0", -1)
        robots.sync()
        port = int(server.address.rpartition(":")[2])
    out += _restored(target, place, acknowledged, robots, port)
    if target.database is None:  # sha256sum reads what is in files
        out += _verification(target.data)
    return out


# --- filling ---


def fill(store: Store, size: int) -> None:
    """Fill an environment with versions of noise, of which nothing can be compressed or shared."""
    store.environments.create(ENVIRONMENT)
    dice = np.random.default_rng(1)
    for number in range(max(1, size // STEP_BYTES)):
        _commit_noise(store, dice, number)


def _commit_noise(store: Store, dice: np.random.Generator, number: int) -> None:
    cells = dice.integers(0, 101, (2048, 4096), np.uint8)
    change = Changes((Replace(GRID, OccupancyGrid(cells, 0.05, (0.0, 0.0, 0.0), mode="scale")),))
    sha256 = store.blobs.put(dice.bytes(STEP_BYTES * 2 // 3))
    prepared = store.versions.prepare(store.versions.get(ENVIRONMENT), change)
    sources = [Source(f"scan{number}.bin", STEP_BYTES * 2 // 3, sha256)]
    store.versions.commit(ENVIRONMENT, prepared, author="bench", message=str(number), sources=sources)


# --- the server and its writers ---


@contextlib.contextmanager
def running_server(home: Home, port: int = 0) -> Iterator[tuple[ServerProcess, httpx.Client]]:
    """Run a server on a data folder, with a client."""
    variables = {"FLEETMAP_ADMIN_TOKEN": ADMIN, "FLEETMAP_LOG_LEVEL": "warning", "FLEETMAP_SCRUB_HOURS": "0"}
    # in the session of the backup: Linux gives sessions equal shares, whatever the niceness of the processes in them
    server = ServerProcess(*home.options, "--port", str(port), environment=variables, folder=ROOT, forked=False)
    try:
        address = server.ready()
        headers = {"Authorization": f"Bearer {ADMIN}"}
        with httpx.Client(base_url=f"{address}/api/v1", headers=headers, timeout=120, verify=False) as client:
            yield server, client
    finally:
        server.stop()


class Writers:
    """Writers that commit small uploads, each to an environment of its own."""

    def __init__(self, client: httpx.Client) -> None:
        self._client = client
        self._stopping = threading.Event()
        self.commits: list[tuple[float, float]] = []
        self.versions: dict[tuple[str, int], str] = {}
        for number in range(WRITERS):
            client.post("environments", json={"name": f"writer-{number}", "datum": {"latitude": 53, "longitude": 0}})
        self._pool = ThreadPoolExecutor(WRITERS)
        self._tasks = [self._pool.submit(self._write, f"writer-{number}") for number in range(WRITERS)]

    def _write(self, environment: str) -> None:
        moved = 0.0
        while not self._stopping.is_set():
            moved += 0.001
            begin = time.perf_counter()
            files = [("files", ("network.tmap2.yaml", network(moved, 100)))]
            answer = self._client.post(f"environments/{environment}/versions", files=files)
            answer.raise_for_status()
            self.commits.append((time.monotonic(), time.perf_counter() - begin))
            self.versions[environment, answer.json()["version"]] = answer.json()["root"]
            self._stopping.wait(PAUSE_SECONDS)

    def times(self, begin: float, end: float) -> list[float]:
        """Return the durations of the commits that ended in this time."""
        return [seconds for at, seconds in self.commits if begin <= at < end]

    def stop(self) -> None:
        """Let the writers end. Raises what they have met."""
        self._stopping.set()
        for task in self._tasks:
            task.result()
        self._pool.shutdown()


def fleetmap(*arguments: str) -> Any:
    """Run a command; returns its JSON."""
    return finish_fleetmap(start_fleetmap(*arguments))


def start_fleetmap(*arguments: str) -> subprocess.Popen[str]:
    """Start a command in a process of its own."""
    clean = {k: v for k, v in os.environ.items() if not k.startswith("FLEETMAP_")}
    command = [sys.executable, "-m", "app.cli", *arguments, "--json"]
    return subprocess.Popen(command, env=clean, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finish_fleetmap(process: subprocess.Popen[str]) -> Any:
    """Wait for the end of a command; returns its JSON."""
    out, error = process.communicate()
    if process.returncode:
        raise RuntimeError(f"fleetmap failed: {out}{error}")
    return json.loads(out)


def _during(
    client: httpx.Client, home: Home, place: Path
) -> tuple[list[dict[str, Any]], dict[str, dict[tuple[str, int], str]], int]:
    """Measure commits during backups; returns what was acknowledged before and after the first one, and its size.

    The backup is stopped and continued in turn, so that other work on the machine slows both sides alike.
    """
    compiled = Path(os.environ.get(native.FOLDER, home.data / "native"))
    deadline = time.monotonic() + MAX_COMPILE_SECONDS
    while not native.is_filled(compiled) and time.monotonic() < deadline:  # a new server compiles in the background
        time.sleep(1)
    writers = Writers(client)
    time.sleep(PHASE_SECONDS)
    acknowledged: dict[str, dict[tuple[str, int], str]] = {}
    windows: dict[bool, list[tuple[float, float]]] = {True: [], False: []}
    former = 0
    for cycle in range(CYCLES):
        acknowledged.setdefault("before", dict(writers.versions))
        into = place if cycle == 0 else place.with_name(f"backup{cycle}")
        process = start_fleetmap("backup", str(into), "--keys", *home.options)
        while process.poll() is None:
            for is_running in (True, False):
                process.send_signal(signal.SIGCONT if is_running else signal.SIGSTOP)
                begin = time.monotonic()
                time.sleep(home.window_seconds)
                windows[is_running].append((begin, time.monotonic()))
            process.send_signal(signal.SIGCONT)
        size = finish_fleetmap(process)["bytes"]
        acknowledged.setdefault("after", dict(writers.versions))
        former = former or _content_bytes(home)
    writers.stop()
    times = {kind: [s for begin, end in spans for s in writers.times(begin, end)] for kind, spans in windows.items()}
    seconds = {kind: sum(end - begin for begin, end in spans) for kind, spans in windows.items()}
    busy, quiet = times[True], times[False]
    label = f"{CYCLES} backups of {size / 1e9:.1f} GB, {seconds[True] / CYCLES:.0f} s each, {WRITERS} writers"
    rates = len(quiet) / seconds[False], len(busy) / seconds[True]
    out = [
        row(f"{label}: commit (peer: while it is stopped)", median(busy) * 1e3, MAX_SLOWER, "ms", median(quiet) * 1e3),
        row("commits a second while it is stopped (peer: during)", rates[0], MAX_SLOWER, "1/s", rates[1]),
    ]
    return out, acknowledged, former


def _incremental(client: httpx.Client, home: Home, place: Path, former: int) -> list[dict[str, Any]]:
    """Measure what a second backup writes of a change: uploads, a large grid, and many small commits.

    former: bytes of what there was at the end of the first one.
    """
    with closing(home.open_store()) as store:
        dice = np.random.default_rng(2)
        for number in range(max(1, int(GIGABYTES * 2**30 * SHARE_CHANGED) // STEP_BYTES)):
            _commit_noise(store, dice, number)
    writers = Writers(client)
    time.sleep(PHASE_SECONDS)
    writers.stop()
    change = _content_bytes(home) - former
    before = _folder_bytes(place)
    begin = time.perf_counter()
    fleetmap("backup", str(place), *home.options)
    seconds = time.perf_counter() - begin
    written = _folder_bytes(place) - before
    label = f"second backup, {seconds:.0f} s: bytes written (peer: the change)"
    return [row(label, written / 1e6, MAX_WRITTEN, "MB", change / 1e6)]


def _content_bytes(home: Home) -> int:
    """Count the bytes of chunks and files: less than what the database's file grows by."""
    with closing(home.open_store(readonly=True)) as store:
        with store._database.read() as connection:
            chunks = int(connection.exec_driver_sql("SELECT sum(length(data)) FROM chunk").scalar_one())
        return chunks + sum(file.size for file in store.blobs.files.list())


def _folder_bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


# --- restore ---


class _Robots:
    """Agents in this process, each with a map directory of its own that outlives it."""

    def __init__(self, server: str, folder: Path) -> None:
        self._server, self._folder = server, folder
        folder.mkdir()

    def sync(self) -> dict[str, int]:
        """Let each agent sync once; returns the version that each has."""
        with ThreadPoolExecutor(4) as pool:
            return dict(pool.map(self._sync, range(ROBOTS)))

    def _sync(self, number: int) -> tuple[str, int]:
        name = f"robot-{number}"
        options = AgentOptions(
            server=self._server,
            environment="writer-0",
            formats=("tmap2",),
            into=self._folder / name,
            channel="production",
            token=ADMIN,
            robot=name,
        )
        agent = Agent(options, lambda *_, **__: None)
        agent.open()
        try:
            is_done = agent.run_once()
        finally:
            agent.close()
        manifest = self._folder / name / "current" / "manifest.json"
        return name, json.loads(manifest.read_text())["version"] if is_done else -1


def promote(client: httpx.Client, environment: str, version: int) -> int:
    """Move the channel production; a negative version counts from the newest."""
    if version < 0:
        version = client.get(f"environments/{environment}/versions/latest").json()["version"] + 1 + version
    client.put(f"environments/{environment}/channels/production", json={"version": version}).raise_for_status()
    return version


def _restored(
    target: Home, place: Path, acknowledged: dict[str, dict[tuple[str, int], str]], robots: _Robots, port: int
) -> list[dict[str, Any]]:
    """Restore the first backup, which the robots are ahead of, and let them converge."""
    listed = fleetmap("backup", str(place), "--list")["backups"]
    begin = time.perf_counter()
    fleetmap("restore", str(place), "--snapshot", listed[0]["id"], *target.options)
    seconds = time.perf_counter() - begin
    with closing(target.open_store(readonly=True)) as store:
        roots = {
            (e.name, v): store.versions.get(e.name, v).root
            for e in store.environments.page(limit=100)[0]
            if e.name != ENVIRONMENT
            for v in range(1, e.head + 1)
        }
    missing = sum(roots.get(version) != root for version, root in acknowledged["before"].items())
    invented = sum(acknowledged["after"].get(v) != root for v, root in roots.items() if v in acknowledged["after"])
    invented += sum(v not in acknowledged["after"] and v[1] > 1 for v in roots)
    with running_server(target, port) as (_, client):
        version = promote(client, "writer-0", -1)
        converged = sum(at == version for at in robots.sync().values())
    label = f"restored in {seconds:.0f} s"
    return [
        row(f"{label}: acknowledged before the backup and not in it, of {len(acknowledged['before'])}", missing, 0, ""),
        row(f"{label}: in it and never acknowledged, of {len(roots)}", invented, 0, ""),
        row(f"{ROBOTS} robots, ahead of the backup, that do not follow the restored server", ROBOTS - converged, 0, ""),
    ]


# --- verification ---


def _verification(data: Path) -> list[dict[str, Any]]:
    """Compare ``fleetmap verify`` with sha256sum on the same data, by processor time of one core."""
    files = [str(path) for path in data.rglob("*") if path.is_file()]
    size = sum(Path(path).stat().st_size for path in files)
    sums = min(_seconds(lambda: subprocess.run(["sha256sum", *files], check=True, capture_output=True)) for _ in "12")
    ours = min(_seconds(lambda: fleetmap("verify", "--data-dir", str(data))) for _ in "12")
    start = _seconds(lambda: fleetmap("verify", "--data-dir", str(_empty(data.parent))))
    speed, floor = size / (ours - start) / 1e6, size / sums / 1e6
    label = f"fleetmap verify of {size / 1e9:.1f} GB, a core (peer: sha256sum); or {MIN_VERIFY_MB:g} MB/s"
    holds = speed >= MIN_VERIFY_MB or speed / floor >= MIN_OF_SHA256SUM
    return [{**row(label, speed, MIN_OF_SHA256SUM, "MB/s", floor), "bound": f"≥ {MIN_OF_SHA256SUM:g}", "holds": holds}]


def _empty(folder: Path) -> Path:
    """Create a data folder without content, whose check takes what the command costs anyway."""
    data = folder / "empty"
    if not data.exists():
        with closing(Store(f"sqlite:///{data / 'fleetmap.sqlite3'}", data / "blobs")) as store:
            store.migrate()
    return data


def _seconds(work: Callable[[], Any]) -> float:
    """Measure the processor time of child processes."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    work()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def row(what: str, ours: float, bound: float, unit: str, peer: float | None = None) -> dict[str, Any]:
    """Return a row of the table; the bound is of the ratio to the peer if there is one."""
    ratio = None if not peer else ours / peer
    holds = (ours if ratio is None else ratio) <= bound
    shown = f"≤ {bound:g}" if bound else "0"
    return {"what": what, "peer": peer, "ours": ours, "unit": unit, "ratio": ratio, "bound": shown, "holds": holds}
