"""Many environments with many versions of distinct content, against ten with ten: what a request costs.

Both databases are filled by the store's own code, which prepares and commits each version; only the transactions are
joined, a thousand commits in one, so that they do not wait for the disk. The servers are ordinary ones.
"""

from __future__ import annotations

import contextlib
import random
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from sqlalchemy import Connection

from app.model.features import Features, from_columns, points
from app.model.frame import Datum
from app.model.layers import NETWORK, PartKey
from app.store.changes import Changes, Put, Replace
from app.store.store import Store
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
    """Measure requests on a small and a large database in turns. url: of an empty database with a name, else SQLite."""
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        clients = []
        for name, sizes in (("small", (10, 10)), ("large", (environments, versions))):
            place = Path(folder) / name
            database = url(name) if url is not None else f"sqlite:///{place / 'fleetmap.sqlite'}"
            fill(database, place, *sizes)
            clients.append((stack.enter_context(_server(database, place)), sizes[0]))
        label = f"{environments} × {versions}"
        return [_compare(f"{what}, {label}", request, clients) for what, request in REQUESTS.items()]


@contextlib.contextmanager
def _server(database: str, folder: Path) -> Iterator[httpx.Client]:
    port = http.free_port()
    env = {"FLEETMAP_DATA_DIR": str(folder), "FLEETMAP_DATABASE_URL": database, "FLEETMAP_ADMIN_TOKEN": TOKEN}
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
    return {
        "what": what,
        "peer": small,
        "ours": large,
        "unit": "ms",
        "ratio": large / small,
        "bound": f"≤ {BOUND}",
        "holds": large <= BOUND * small,
    }
