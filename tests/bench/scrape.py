"""What the figures of robots cost a scrape of ``/metrics``: ``python -m tests.bench.scrape --robots 100000``."""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from datetime import timedelta
from pathlib import Path
from typing import Any

from sqlalchemy import insert

from app.store import tables
from app.store.changes import Replace
from app.store.store import Store
from tests.store.samples import GRID, grid, save

SITES = 10
ROWS = 10_000


def fill(store: Store, robots: int) -> None:
    """Create sites with two versions each, and robots that have run the first one, which is production, for a while."""
    ids, roots = [], []
    for number in range(SITES):
        name = f"site-{number}"
        ids.append(store.environments.create(name).id)
        roots.append(save(store, name, Replace(GRID, grid(seed=1))).root)
        save(store, name, Replace(GRID, grid(seed=2)))
        store.channels.move(name, "production", 1, author="bench")
    then = store.now() - timedelta(minutes=20)
    values = {"channel": "production", "version": 1, "state": "active", "held_version": 1, "vouched": True}
    times = {"time": then, "since": then, "held_since": then}
    for start in range(0, robots, ROWS):
        rows: list[dict[str, Any]] = [
            {**values, **times, "environment_id": ids[k % SITES], "robot": f"r{k}", "root": root, "held_root": root}
            for k in range(start, min(robots, start + ROWS))
            for root in [roots[k % SITES]]
        ]
        with store._database.write(notify=False, upkeep=True) as connection:
            connection.execute(insert(tables.robot), rows)
    store.robot_counts.join()


def milliseconds(work: Callable[[], Any], tries: int) -> float:
    """Measure the CPU time of the fastest of some tries, with SQLite in this process."""
    times = []
    for _ in range(tries):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return round(min(times) * 1e3, 2)


def measure(robots: int) -> dict[str, float]:
    """Measure reading the figures: all robots hold their map, all are behind (counted one by one), again at once."""
    with tempfile.TemporaryDirectory() as folder:
        store = Store(f"sqlite:///{folder}/fleetmap.sqlite3", Path(folder) / "blobs")
        with closing(store):
            store.migrate()
            fill(store, robots)

            def read() -> int:
                now = store.now()
                figures = store.fleet_figures.robots(
                    on_bus_after=now - timedelta(minutes=1), heard_after=now - timedelta(hours=1)
                )
                return sum(channel.late for channel in figures)

            out = {"robots": float(robots), "all_hold_ms": milliseconds(read, 5)}
            for number in range(SITES):
                store.channels.move(f"site-{number}", "production", 2, author="bench")
            store.fleet_figures._counted = float("-inf")
            out["all_behind_ms"] = milliseconds(read, 1)
            assert read() == robots
            return {**out, "again_ms": milliseconds(read, 5)}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=100_000)
    print(json.dumps(measure(parser.parse_args().robots)))
