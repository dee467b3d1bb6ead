"""Retention: what thinning costs, and what the collection after it costs. ``python -m tests.bench.retention``.

An environment with a network of 20 000 nodes and 2000 versions that each move one; another one with the same, which
stays. CPU seconds of one process, on SQLite.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from app.store.changes import Changes, Put, Replace
from app.store.retention_rule import Rule
from app.store.store import Store
from tests.store.samples import TOPOLOGY, network

NODES, VERSIONS, PER_DAY = 20_000, 2000, 20
RULE = Rule(all_days=30, daily_days=365)


def rows() -> list[dict[str, Any]]:
    """Measure each step. bytes: stored after it."""
    out: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        now = datetime(2026, 1, 1, tzinfo=UTC)
        store = Store(f"sqlite:///{folder}/b.sqlite3", Path(folder) / "blobs", clock=lambda: now)
        store.migrate()
        for first, name in enumerate(("thinned", "kept")):
            now = datetime(2026, 1, 1, tzinfo=UTC)
            store.environments.create(name)
            _commit(store, name, Changes((Replace(TOPOLOGY, network(NODES, seed=first)),)))
            for k in range(VERSIONS):
                now += timedelta(days=1 / PER_DAY)
                _commit(store, name, Changes((Put(TOPOLOGY, network(1, seed=2 * k + first)),)))
        store.garbage.collect(timedelta(0))
        now += timedelta(days=90)

        def step(name: str, work: Callable[[], Any]) -> Any:
            start = time.process_time()
            result = work()
            seconds = time.process_time() - start
            out.append({"step": name, "cpu_seconds": round(seconds, 2), "bytes": store.garbage.removable_bytes()[1]})
            return result

        plans = step("plan both environments", lambda: list(store.retention.plan(RULE)))
        step("space of the plan", lambda: store.garbage.removable_bytes(plans))
        plan = next(p for p in plans if p.environment == "thinned")
        step(f"thin {len(plan.thinned)} versions", lambda: list(store.retention.apply(plan, RULE)))
        step("collect", lambda: store.garbage.collect(timedelta(0)))
        step("collect again", lambda: store.garbage.collect(timedelta(0)))
        store.close()
    return out


def _commit(store: Store, environment: str, changes: Changes) -> None:
    prepared = store.versions.prepare(store.versions.get(environment), changes)
    store.versions.commit(environment, prepared, author="bench", message="")


if __name__ == "__main__":
    for row in rows():
        print(row)
