"""What grows with the number of environments, versions, robots and edits: each against few of them.

Both databases are filled by the store's own code, which prepares and commits each version; only the transactions are
joined, a thousand commits in one, so that they do not wait for the disk. The servers are ordinary ones.
"""

from __future__ import annotations

import contextlib
import random
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, insert, update

from app.api.channels import as_dict
from app.api.http.responses import json_bytes
from app.fleet import count_robots
from app.model.features import Features, from_columns, points
from app.model.frame import Datum
from app.model.grid import OccupancyGrid
from app.model.layers import NETWORK, PartKey
from app.store import tables
from app.store.changes import Changes, Put, Replace
from app.store.store import Store
from app.store.values import Source
from tests.bench import http

TOPOLOGY = PartKey("topology", "ground", NETWORK)
NODES = 20
ROUNDS = 60
BOUND = 1.2
TOKEN = "bench-" + "0" * 40
JOINED = 1000
"""Number of commits in one transaction while a database is filled."""


def rows(
    environments: int = 10_000, versions: int = 10, url: Callable[[str], str] | None = None
) -> list[dict[str, Any]]:
    """Measure everything; url: of an empty database with a name, else SQLite."""
    return [*requests(environments, versions, url), *channels(url), *growth()]


def requests(environments: int, versions: int, url: Callable[[str], str] | None = None) -> list[dict[str, Any]]:
    """Measure requests on a small and a large database in turns, and a garbage collection on both."""
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        clients, databases = [], []
        for name, sizes in (("small", (10, 10)), ("large", (environments, versions))):
            place = Path(folder) / name
            database = url(name) if url is not None else f"sqlite:///{place / 'fleetmap.sqlite'}"
            databases.append((database, place))
            fill(database, place, *sizes)
            clients.append((stack.enter_context(_server(database, place)), sizes[0]))
        label = f"{environments} × {versions}"
        measured = [_compare(f"{what}, {label}", request, clients) for what, request in REQUESTS.items()]
        times = [_collection(database, place) for database, place in databases]
        return [*measured, _row(f"garbage collection, {label}", *times, unit="ms")]


@contextlib.contextmanager
def _server(database: str, folder: Path) -> Iterator[httpx.Client]:
    port = http.free_port()
    env = {"FLEETMAP_DATA_DIR": str(folder), "FLEETMAP_DATABASE_URL": database, "FLEETMAP_ADMIN_TOKEN": TOKEN}
    env["FLEETMAP_ZENOH_MODE"] = "off"
    command = [sys.executable, "-m", "app.cli", "serve", "--host", "127.0.0.1", "--port", str(port)]
    auth = {"Authorization": f"Bearer {TOKEN}"}
    with (
        http.serving(command, port, env),
        httpx.Client(base_url=f"http://127.0.0.1:{port}", headers=auth, timeout=120) as client,
    ):
        for _ in range(600):
            if client.get("/api/v1/search", params={"q": "dock"}).status_code != 503:
                break
            time.sleep(0.5)
        yield client


# --- content ---


def name_of(environment: int) -> str:
    """Return an environment's name: none begins with another."""
    return f"site-{environment:05}"


def datum_of(environment: int) -> Datum:
    """Return an environment's place on earth: a lattice whose points are a kilometre apart."""
    row, column = divmod(environment, 100)
    return Datum(50.0 + row * 0.01, 5.0 + column * 0.015)


def _network(environment: int) -> Features:
    xy = np.random.default_rng(environment).random((NODES, 2)) * 100
    names = [f"Dock {environment}-{k}" for k in range(NODES)]
    properties = [{"kind": "node", "name": name} for name in names]
    return from_columns([f"n{k}" for k in range(NODES)], points(xy), properties, "local")


def fill(url: str, folder: Path, environments: int, versions: int) -> float:
    """Create environments, each with this many versions of distinct content; returns the seconds."""
    started = time.perf_counter()
    store = Store(url, folder / "blobs")
    store.migrate()
    number = 0
    with contextlib.ExitStack() as stack:
        for environment in range(environments):
            if number >= JOINED or not environment:
                stack.close()
                stack.enter_context(_joined(store))
                number = 0
            _fill_environment(store, environment, versions)
            number += versions
    store.search_index.refresh(environments)
    if not url.startswith("sqlite"):
        with store._database.engine.connect() as connection:
            connection.execution_options(isolation_level="AUTOCOMMIT").exec_driver_sql("ANALYZE")
    store.close()
    return time.perf_counter() - started


def _fill_environment(store: Store, environment: int, versions: int) -> None:
    name = name_of(environment)
    store.environments.create(name, title=f"Site {environment}", datum=datum_of(environment))
    head = store.versions.get(name)
    dice = random.Random(environment)
    for version in range(2, versions + 1):
        if version == 2:
            changes = Changes((Replace(TOPOLOGY, _network(environment)),))
        else:
            k = dice.randrange(NODES)
            moved = points(np.array([[dice.random() * 100, dice.random() * 100]]))
            properties = [{"kind": "node", "name": f"Dock {environment}-{k}"}]
            changes = Changes((Put(TOPOLOGY, from_columns([f"n{k}"], moved, properties, "local")),))
        head = store.versions.commit(name, store.versions.prepare(head, changes), author="bench", message="")


@contextlib.contextmanager
def _joined(store: Store) -> Iterator[None]:
    """Have all transactions of the store be one."""
    database = store._database
    methods = {name: getattr(database, name) for name in ("read", "snapshot", "write")}
    with database.connection() as connection:
        connection.execution_options(write=True)
        with connection.begin():

            @contextlib.contextmanager
            def joined(**options: Any) -> Iterator[Connection]:
                yield connection

            for name in methods:
                setattr(database, name, joined)
            try:
                yield
            finally:
                for name, method in methods.items():
                    setattr(database, name, method)


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


def _compare(what: str, request: Request, clients: list[tuple[httpx.Client, int]]) -> dict[str, Any]:
    """Measure the median time of a request on both servers, alternately."""
    times: list[list[float]] = [[], []]
    dice = random.Random(what)
    for number in range(ROUNDS + 10):
        for k, (client, environments) in enumerate(clients):
            started = time.perf_counter()
            request(client, dice, environments)
            if number >= 10:
                times[k].append((time.perf_counter() - started) * 1e3)
    small, large = (sorted(some)[len(some) // 2] for some in times)
    return _row(what, small, large, unit="ms")


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


def _collection(url: str, folder: Path) -> float:
    """Measure a garbage collection after ten commits: the second one, since the first looks at everything."""
    store = Store(url, folder / "blobs")
    store.garbage.collect(timedelta(hours=6))
    with store._database.write() as connection:  # the overlap of an hour would cover all versions
        connection.execute(update(tables.version).values(time=datetime.now(UTC) - timedelta(days=1)))
    for environment in range(10):
        head = store.versions.get(name_of(environment))
        changes = Changes((Replace(TOPOLOGY, _network(environment + 10**6)),))
        store.versions.commit(head.environment, store.versions.prepare(head, changes), author="bench", message="")
    started = time.perf_counter()
    store.garbage.collect(timedelta(hours=6))
    spent = (time.perf_counter() - started) * 1e3
    store.close()
    return spent


# --- robots ---


def channels(url: Callable[[str], str] | None = None) -> list[dict[str, Any]]:
    """Measure the body of ``GET /channels`` in an environment with 100 and 100 000 robots, half of them on the bus."""
    with tempfile.TemporaryDirectory() as folder:
        times = []
        for number in (100, 100_000):
            place = Path(folder) / str(number)
            database = url(f"robots_{number}") if url is not None else f"sqlite:///{place / 'fleetmap.sqlite'}"
            store = Store(database, place / "blobs")
            store.migrate()
            _add_robots(store, number)
            times.append(_median(lambda store=store: _list_channels(store)))  # type: ignore[misc]
            store.close()
    return [_row("channels with their robots, 100 000 robots against 100", *times, unit="ms", bound=2.0)]


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


def _median(work: Callable[[], Any]) -> float:
    times = []
    for _ in range(ROUNDS):
        started = time.perf_counter()
        work()
        times.append((time.perf_counter() - started) * 1e3)
    return sorted(times)[ROUNDS // 2]


# --- edits and re-uploads ---


def growth() -> list[dict[str, Any]]:
    """Measure what is stored of a 20 MB grid after 100 edits of 25 cells, and after 100 uploads of the edited grid."""
    out = []
    for what, again in (("edits", False), ("uploads", True)):
        with tempfile.TemporaryDirectory() as folder:
            store = Store(f"sqlite:///{folder}/fleetmap.sqlite", Path(folder) / "blobs")
            store.migrate()
            store.environments.create("farm")
            cells = _rooms(4000, 5000)
            last = _commit_grid(store, cells, "", upload=True)
            one = _stored_bytes(store)
            dice = np.random.default_rng(1)
            for k in range(100):
                y, x = dice.integers(0, 3995), dice.integers(0, 4995)
                cells[y : y + 5, x : x + 5] = 100 * (k % 2)
                last = _commit_grid(store, cells, last, upload=again)
            label = f"stored of a 20 MB grid, after 100 {what}"
            out.append(_row(label, one / 1e6, _stored_bytes(store) / 1e6, unit="MB", bound=1.3))
            store.close()
    return out


def _rooms(height: int, width: int) -> NDArray[np.uint8]:
    """Draw rooms with walls on unknown ground, with a sensor's noise on a fiftieth of the free cells."""
    dice = np.random.default_rng(4)
    cells = np.full((height, width), 255, np.uint8)
    for y, x, h, w in dice.integers((0, 0, 20, 20), (height, width, 300, 300), (1600, 4)).tolist():
        cells[y : y + h, x : x + w] = 0
        cells[y : y + 2, x : x + w] = cells[y : y + h, x : x + 2] = 100
    cells[(dice.random(cells.shape) < 0.02) & (cells == 0)] = 1
    return cells


def _commit_grid(store: Store, cells: NDArray[np.uint8], last: str, *, upload: bool) -> str:
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


def _stored_bytes(store: Store) -> int:
    """Return the bytes of the chunks, files, versions and events."""
    columns = ("chunk", "data"), ("version", "manifest"), ("event", "body")
    with store._database.read() as connection:
        rows = [
            connection.exec_driver_sql(f"SELECT sum(length({name})) FROM {table}").scalar_one()
            for table, name in columns
        ]
    return sum(rows) + sum(file.size for file in store.blobs.files.list())
