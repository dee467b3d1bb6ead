"""What grows with the number of environments, versions, robots and edits: each against few of them.

The databases are those of ``scale_databases``; the servers are ordinary ones. A request counts by the CPU time of its
server's threads and of the database's processes that serve it, since on a busy machine the time on the clock says
little; that is shown beside it.
"""

from __future__ import annotations

import contextlib
import os
import random
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import psycopg
from numpy.typing import NDArray
from sqlalchemy import insert, update

from app.api.channels import as_dict
from app.api.http.responses import json_bytes
from app.fleet import count_robots
from app.model.grid import OccupancyGrid
from app.model.layers import PartKey
from app.store import tables
from app.store.changes import Changes, Replace
from app.store.store import Store
from app.store.values import Source
from tests.bench import http
from tests.bench.scale_databases import ENVIRONMENTS, VERSIONS, FilledDatabase, filled
from tests.bench.scale_site import AGE, GRACE, TOPOLOGY, datum_of, name_of, network
from tests.ports import free_port
from tests.postgres import running_cluster

ROUNDS = 100
WARM_UP = 10
COLLECTIONS = 5
BOUND = 1.2
TOKEN = "bench-" + "0" * 40


def rows(
    environments: int = ENVIRONMENTS,
    versions: int = VERSIONS,
    *,
    postgres: bool = False,
    folder: Path | None = None,
) -> list[dict[str, Any]]:
    """Measure everything on SQLite, or on a PostgreSQL cluster of its own; growth in bytes only on SQLite.

    folder: where the databases with many environments are, and stay.
    """
    with (
        tempfile.TemporaryDirectory() as temporary,
        filled(folder or Path(temporary), environments, versions, postgres=postgres) as databases,
    ):
        _read_all(folder or Path(temporary))
        compared = compare(databases, f"{environments} × {versions}")
    if not postgres:
        return [*compared, *channels(), *growth()]
    with running_cluster() as cluster:
        return [*compared, *channels(lambda: cluster.url(cluster.create_database()))]


def _read_all(folder: Path) -> None:
    """Read all files, so that requests find both databases in the system's cache: no disk is compared."""
    for file in folder.rglob("*"):
        with contextlib.suppress(OSError):  # ended meanwhile, or private to the database's user
            if file.is_file():
                with file.open("rb") as opened:
                    while opened.read(1 << 20):
                        pass


def compare(databases: list[FilledDatabase], label: str) -> list[dict[str, Any]]:
    """Compare the costs of requests to two databases in turns, and of garbage collections."""
    with contextlib.ExitStack() as stack:
        sites = [stack.enter_context(_server(database)) for database in databases]
        measured = [row for what, request in REQUESTS.items() for row in _compare(f"{what}, {label}", request, sites)]
    collections = _row(f"garbage collection, {label}", *_collections(databases), unit="ms CPU")
    return [*measured, collections]


@dataclass(frozen=True, slots=True)
class _Site:
    """Running server with the number of its environments."""

    client: httpx.Client
    environments: int
    cpu: Callable[[], float]


@contextlib.contextmanager
def _cpu_clock(process: int, database: str) -> Iterator[Callable[[], float]]:
    """Yield a function for the CPU milliseconds of a process's threads and of all connections to a database."""
    query = "SELECT pid FROM pg_stat_activity WHERE datname = current_database() AND pid <> pg_backend_pid()"
    with contextlib.ExitStack() as stack:
        connection: psycopg.Connection[tuple[Any, ...]] | None = None
        if not database.startswith("sqlite"):
            connection = stack.enter_context(psycopg.connect(database.replace("+psycopg", ""), autocommit=True))

        def read() -> float:
            os.sched_yield()  # else the times of this thread are those of the scheduler's last tick
            files = list(Path(f"/proc/{process}/task").glob("*/schedstat"))
            if connection is not None:
                files += [Path(f"/proc/{row[0]}/schedstat") for row in connection.execute(query)]
            total = 0
            for file in files:
                with contextlib.suppress(OSError):  # ended meanwhile
                    total += int(file.read_text().split()[0])
            return total / 1e6

        yield read


@contextlib.contextmanager
def _server(database: FilledDatabase) -> Iterator[_Site]:
    port = free_port()
    env = {"FLEETMAP_DATA_DIR": str(database.folder), "FLEETMAP_DATABASE_URL": database.url}
    env["FLEETMAP_ADMIN_TOKEN"] = TOKEN
    env |= {
        "FLEETMAP_LOG_LEVEL": "warning",
        "FLEETMAP_ZENOH_MODE": "off",
        "FLEETMAP_SCRUB_HOURS": "0",
        "FLEETMAP_CONVERSION_WORKERS": "1",
    }
    command = [sys.executable, "-m", "app.cli", "serve", "--host", "127.0.0.1", "--port", str(port)]
    auth = {"Authorization": f"Bearer {TOKEN}"}
    with (
        http.serving(command, port, env) as process,
        httpx.Client(base_url=f"http://127.0.0.1:{port}", headers=auth, timeout=120) as client,
        _cpu_clock(process.pid, database.url) as cpu,
    ):
        for _ in range(600):
            if client.get("/api/v1/search", params={"q": "dock"}).status_code != 503:
                break
            time.sleep(0.5)
        yield _Site(client, database.environments, cpu)


# --- requests ---

Request = Callable[[httpx.Client, random.Random, int], None]


def _get(path: str, **parameters: str) -> Request:
    """Return a request for a random environment, whose name, number, position and box stand in the path's braces."""

    def request(client: httpx.Client, dice: random.Random, environments: int) -> None:
        environment = dice.randrange(environments)
        datum = datum_of(environment)
        west, south = datum.longitude - 0.001, datum.latitude - 0.001
        values = {
            "name": name_of(environment),
            "number": environment,
            "position": f"{datum.latitude},{datum.longitude}",
            "box": f"{west},{south},{west + 0.002},{south + 0.002}",
        }
        query = {key: value.format(**values) for key, value in parameters.items()}
        client.get(path.format(**values), params=query).raise_for_status()

    return request


def _commit(client: httpx.Client, dice: random.Random, environments: int) -> None:
    environment = dice.randrange(environments)
    point = {"type": "Point", "coordinates": [datum_of(environment).longitude, datum_of(environment).latitude]}
    properties = {"kind": "node", "name": f"Gate {dice.random()}"}
    feature = {"type": "Feature", "id": "gate", "geometry": point, "properties": properties}
    body = {"changes": [{"op": "put", "layer": "topology", "feature": feature}]}
    client.post(f"/api/v1/environments/{name_of(environment)}/edits", json=body).raise_for_status()


def _get_map(client: httpx.Client, dice: random.Random, environments: int) -> None:
    del environments
    client.get(f"/maps/{name_of(dice.randrange(10))}/tmap2").raise_for_status()


REQUESTS: dict[str, Request] = {
    "read a version": _get("/api/v1/environments/{name}/versions/latest"),
    "GET, a map": _get_map,
    "box": _get("/api/v1/environments", bbox="{box}"),
    "contains": _get("/api/v1/environments", contains="{position}"),
    "search, one item": _get("/api/v1/search", q="dock {number}-7"),
    "search, one item by a part": _get("/api/v1/search", q="ock {number}-7"),
    "search, all items": _get("/api/v1/search", q="dock"),
    "search, two letters": _get("/api/v1/search", q="do"),
    "list, q of one": _get("/api/v1/environments", q="{name}"),
    "commit": _commit,
    "search after a commit": lambda *a: (_commit(*a), _get("/api/v1/search", q="gate")(*a))[0],
}


def _compare(what: str, request: Request, sites: list[_Site]) -> list[dict[str, Any]]:
    """Measure the median cost of a request on both servers, in turns: CPU time, which is bounded, and time."""
    spent: list[list[float]] = [[], []]
    times: list[list[float]] = [[], []]
    dice = random.Random()  # not seeded: in a kept database, the same commits again would change nothing
    for number in range(ROUNDS + WARM_UP):
        for k, site in enumerate(sites):
            before, started = site.cpu(), time.perf_counter()
            request(site.client, dice, site.environments)
            elapsed = (time.perf_counter() - started) * 1e3
            if number >= WARM_UP:
                times[k].append(elapsed)
                spent[k].append(site.cpu() - before)
    cpu, clock = ([sorted(some)[len(some) // 2] for some in both] for both in (spent, times))
    return [_row(what, *cpu, unit="ms CPU"), {**_row(what, *clock, unit="ms"), "bound": "–", "holds": True}]


def _row(what: str, small: float, large: float, *, unit: str, bound: float = BOUND) -> dict[str, Any]:
    return {
        "what": what,
        "peer": small,
        "ours": large,
        "unit": unit,
        "ratio": large / small,
        "bound": f"≤ {bound}",
        "holds": large <= bound * small,
    }


def _collections(databases: list[FilledDatabase]) -> list[float]:
    """Measure garbage collections after ten commits each, in turns: median CPU milliseconds on each database."""
    spent: list[list[float]] = [[] for _ in databases]
    with contextlib.ExitStack() as stack:
        stores = [Store(database.url, database.folder / "blobs") for database in databases]
        clocks = [stack.enter_context(_cpu_clock(os.getpid(), database.url)) for database in databases]
        for store in stores:
            stack.callback(store.close)
        for turn in range(COLLECTIONS + 1):
            for store, clock, times in zip(stores, clocks, spent, strict=True):
                _make_older(store)
                _commit_ten(store)
                before = clock()
                store.garbage.collect(GRACE)
                if turn:  # the first one also has the commits of the requests
                    times.append(clock() - before)
    return [sorted(times)[COLLECTIONS // 2] for times in spent]


def _make_older(store: Store) -> None:
    """Have the last hours' versions be a day old: a collection looks again at those since an hour before the last."""
    time = tables.version.c.time
    with store._database.write() as connection:
        now = datetime.now(UTC)
        connection.execute(update(tables.version).where(time > now - AGE / 2).values(time=now - AGE))


def _commit_ten(store: Store) -> None:
    for environment in range(10):
        head = store.versions.get(name_of(environment))
        changes = Changes((Replace(TOPOLOGY, network(random.getrandbits(60))),))
        store.versions.commit(head.environment, store.versions.prepare(head, changes), author="bench", message="")


# --- robots ---


def channels(url: Callable[[], str] | None = None) -> list[dict[str, Any]]:
    """Measure the body of ``GET /channels`` in environments with 100 and 100 000 robots, half of them on the bus."""
    spent: list[list[float]] = [[], []]
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        stores, clocks = [], []
        for number in (100, 100_000):
            place = Path(folder) / str(number)
            database = url() if url is not None else f"sqlite:///{place / 'fleetmap.sqlite'}"
            store = Store(database, place / "blobs")
            stack.callback(store.close)
            store.migrate()
            _add_robots(store, number)
            if url is not None:
                _vacuum(database)
            stores.append(store)
            clocks.append(stack.enter_context(_cpu_clock(os.getpid(), database)))
        for _ in range(ROUNDS):
            for store, clock, times in zip(stores, clocks, spent, strict=True):
                before = clock()
                _list_channels(store)
                times.append(clock() - before)
    small, large = (sorted(times)[ROUNDS // 2] for times in spent)
    what = "channels with their robots, 100 000 robots against 100"
    return [_row(what, small, large, unit="ms CPU", bound=2.0)]


def _vacuum(database: str) -> None:
    """Do what PostgreSQL does by itself within a minute of such a change."""
    with psycopg.connect(database.replace("+psycopg", ""), autocommit=True) as connection:
        connection.execute("VACUUM ANALYZE")


def _add_robots(store: Store, number: int) -> None:
    environment, now = store.environments.create("farm").id, datetime.now(UTC)
    rows = [
        {
            "environment_id": environment,
            "robot": f"r{k}",
            "channel": ("latest", "production")[k % 2],
            "version": k % 5,
            "root": str(k % 5) * 64,
            "state": "active",
            "held_version": k % 5,
            "held_root": str(k % 5) * 64,
            "held_since": now,
            "time": now,
            "since": now,
        }
        for k in range(number)
    ]
    with store.transaction() as connection:
        connection.execute(insert(tables.robot), rows)
        present = [{"robot": row["robot"], "there": True, "time": now} for row in rows[::2]]
        connection.execute(insert(tables.presence), present)
    store.channels.move("farm", "production", 0, author="bench")
    store.robot_counts.join()


def _list_channels(store: Store) -> bytes:
    counts = count_robots(store.robot_counts, "farm", datetime.now(UTC))
    return json_bytes([as_dict(channel, counts) for channel in store.channels.all("farm")])


# --- edits and re-uploads ---


def growth() -> list[dict[str, Any]]:
    """Measure what is stored of a 20 MB grid after 100 edits of 25 cells, and after 100 uploads of the edited grid."""
    out = []
    for what, again in (("edits", False), ("uploads", True)):
        with tempfile.TemporaryDirectory() as folder:
            store = Store(f"sqlite:///{folder}/fleetmap.sqlite", Path(folder) / "blobs")
            store.migrate()
            store.environments.create("farm")
            cells = rooms(4000, 5000)
            last = commit_grid(store, cells, "", upload=True)
            one = stored_bytes(store)
            dice = np.random.default_rng(1)
            for k in range(100):
                y, x = dice.integers(0, 3995), dice.integers(0, 4995)
                cells[y : y + 5, x : x + 5] = 100 * (k % 2)
                last = commit_grid(store, cells, last, upload=again)
            label = f"stored of a 20 MB grid, after 100 {what}"
            out.append(_row(label, one / 1e6, stored_bytes(store) / 1e6, unit="MB", bound=1.3))
            store.close()
    return out


def rooms(height: int, width: int) -> NDArray[np.uint8]:
    """Draw rooms with walls on unknown ground, with a sensor's noise on a fiftieth of the free cells."""
    dice = np.random.default_rng(4)
    cells = np.full((height, width), 255, np.uint8)
    for y, x, h, w in dice.integers((0, 0, 20, 20), (height, width, 300, 300), (1600, 4)).tolist():
        cells[y : y + h, x : x + w] = 0
        cells[y : y + 2, x : x + w] = cells[y : y + h, x : x + 2] = 100
    cells[(dice.random(cells.shape) < 0.02) & (cells == 0)] = 1
    return cells


def commit_grid(store: Store, cells: NDArray[np.uint8], last: str, *, upload: bool) -> str:
    """Commit a grid, with its file as a source if it is uploaded; returns the file's hash."""
    sources: tuple[Source, ...] = ()
    if upload:
        data = b"P5\n%d %d\n255\n" % cells.shape[::-1] + cells.tobytes()
        (last,) = store.blobs.put_many([data], [last] if last else [])
        sources = (Source("map.pgm", len(data), last),)
    head = store.versions.get("farm")
    grid = OccupancyGrid(cells.copy(), 0.05, (0.0, 0.0, 0.0), mode="trinary")
    prepared = store.versions.prepare(head, Changes((Replace(PartKey("occupancy", "ground", "map"), grid),)))
    store.versions.commit("farm", prepared, author="bench", message="", sources=sources)
    return last


def stored_bytes(store: Store) -> int:
    """Return the bytes of the chunks, files, versions and events."""
    columns = ("chunk", "data"), ("version", "manifest"), ("event", "body")
    with store._database.read() as connection:
        rows = [
            connection.exec_driver_sql(f"SELECT sum(length({name})) FROM {table}").scalar_one()
            for table, name in columns
        ]
    return sum(rows) + sum(file.size for file in store.blobs.files.list())
