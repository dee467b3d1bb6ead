"""Benchmark of versions of 100 000 features: ``python -m tests.store.bench_layout [sqlite|postgres] [features]``.

Prints milliseconds (the minimum of several runs, without caches in memory) and bytes added.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from app.model.features import Features, from_columns, points
from app.model.frame import Datum
from app.model.layers import PartKey
from app.store.changes import Changes, Operation, Put, Replace
from app.store.store import Store

BOX = (500.0, 500.0, 700.0, 700.0)
KEY = PartKey("topology", "ground", "network")


def network(n: int) -> Features:
    """Return half nodes, half edges of two points, about 390 bytes of properties and geometry each, on 2 × 2 km."""
    random = np.random.default_rng(1)
    xy = random.random((n, 2)) * 2000
    geometry = points(xy)
    half = n // 2
    ends = xy[half:] + random.random((n - half, 2)) * 10
    geometry[half:] = shapely.linestrings(np.stack([xy[half:], ends], axis=1))
    properties: list[dict[str, Any]] = [
        {
            "kind": "node" if i < half else "edge",
            "name": f"WayPoint{i}",
            "orientation": [0.0, 0.0, 0.7, 0.7],
            "action": "move_base",
            "tags": {"highway": "residential", "surface": "asphalt", "lanes": i % 3, "note": f"x{i * 7919 % 10007}"},
            "speed_limit": 1.5,
        }
        for i in range(n)
    ]
    return from_columns([f"n{i}" for i in range(n)], geometry, properties, "local")


def bench(store: Store, n: int) -> None:
    """Print all rows of the table."""
    store.migrate()
    store.environments.create("farm", datum=Datum(53.2, -0.5))
    network_part = network(n)
    commit(store, "upload", Replace(KEY, network_part))
    first = store.versions.get("farm")
    row(
        "the same upload again",
        shortest_time(lambda: store.versions.prepare(first, Changes((Replace(KEY, network_part),))), 3, store),
    )
    nodes = np.arange(n // 2)
    xy = shapely.get_coordinates(network_part.geometry[nodes])
    near = nodes[np.argsort(((xy - [700, 900]) ** 2).sum(axis=1))[: n // 100]]
    scattered = np.random.default_rng(2).choice(nodes, n // 100, replace=False)
    for name, some, metres in (
        ("one feature", near[:1], 0.0),
        ("1 % close together", near, 0.0),
        ("1 % close together, moved", near, 0.2),
        ("1 % scattered", scattered, 0.0),
    ):
        commit(store, f"commit {name}", Put(KEY, edited(network_part, some, metres, 0)))
        for k in range(1, 4):
            commit(store, "", Put(KEY, edited(network_part, some, metres, k)))
    head = store.versions.get("farm")
    for name, version in (("head", head), ("first version", first)):
        row(f"read, {name}", shortest_time(lambda version=version: store.content.load(version), 4, store))  # type: ignore[misc]
        row(
            f"box of 1 %, {name}",
            shortest_time(lambda version=version: store.content.features(version, KEY, bbox=BOX), 4, store),  # type: ignore[misc]
        )
    row(
        "diff, near (one feature)",
        shortest_time(lambda: store.content.diff(first, store.versions.get("farm", first.number + 1)), 4, store),
    )
    row("diff, far (first to head)", shortest_time(lambda: store.content.diff(first, head), 3, store))
    changed = Features(
        network_part.ids,
        network_part.geometry,
        tuple({**p, "speed_limit": 2.5} for p in network_part.properties),
        network_part.local,
    )
    commit(store, "replace, all changed", Replace(KEY, changed))


def edited(original: Features, some: Any, metres: float, k: int) -> Features:
    """Return these features with another name, with or without a small move."""
    part = original.select(some)
    moved = points(shapely.get_coordinates(part.geometry) + np.random.default_rng(k).random((len(part), 2)) * metres)
    return Features(part.ids, moved, tuple({**p, "name": f"v{k}"} for p in part.properties), part.local.copy())


def commit(store: Store, name: str, *operations: Operation) -> None:
    """Prepare and commit; prints a row if it has a name."""
    store.chunks.forget()
    head = store.versions.get("farm")
    start = time.perf_counter()
    prepared = store.versions.prepare(head, Changes(operations))
    middle = time.perf_counter()
    store.versions.commit("farm", prepared, author="bench", message=name)
    end = time.perf_counter()
    if name:
        size = sum(map(len, prepared.chunks.values()))
        more = f"(prepare {(middle - start) * 1e3:.1f}), {len(prepared.chunks)} chunks, {size / 1e3:.1f} kB"
        row(name, (end - start) * 1e3, more)


def shortest_time(run: Callable[[], object], times: int, store: Store) -> float:
    """Return the minimum milliseconds of several runs, each without cached chunks."""
    out = []
    for _ in range(times):
        store.chunks.forget()
        start = time.perf_counter()
        result = run()
        out.append((time.perf_counter() - start) * 1e3)
        del result
    return min(out)


def row(name: str, milliseconds: float, more: str = "") -> None:
    """One line."""
    print(f"{name:36} {milliseconds:9.1f} ms {more}")


def main() -> None:
    """Run on a new database."""
    kind = sys.argv[1] if len(sys.argv) > 1 else "sqlite"
    n = int(sys.argv[2]) if len(sys.argv) > 2 else 100_000
    with tempfile.TemporaryDirectory() as folder:
        if kind == "sqlite":
            store = Store(f"sqlite:///{folder}/bench.sqlite", Path(folder) / "blobs")
            bench(store, n)
            store.close()
            return
        from tests.postgres import running_cluster

        with running_cluster() as cluster:
            store = Store(cluster.url(cluster.create_database()), Path(folder) / "blobs")
            bench(store, n)
            store.close()


if __name__ == "__main__":
    main()
