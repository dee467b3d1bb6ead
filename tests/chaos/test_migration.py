"""kill -9 of a migration at random moments: no version is lost, and the next attempt completes it."""

from __future__ import annotations

import os
import random
import shutil
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import pytest
from alembic import command

from app.model.frame import Datum
from app.store.database import Database
from app.store.fleet_values import ReceivedReport, RobotReport
from app.store.schema import config
from app.store.store import Store
from tests.agent.conftest import ROOT
from tests.postgres import Cluster, postgres_cluster
from tests.preloaded import PreloadedProcess

__all__ = ["postgres_cluster"]

ROUNDS = max(1, int(os.environ.get("FLEETMAP_CHAOS", "4")) // 8)
SEED = int(os.environ.get("FLEETMAP_CHAOS_SEED", "5"))
OLD = "0015"
"""Revision from which is migrated: that before data moved from files into the database."""

ENVIRONMENTS = 20

pytestmark = pytest.mark.timeout(240 + ROUNDS * 120)

State = dict[str, tuple[int, str, int, list[str]]]


def fill(store: Store) -> State:
    for k in range(ENVIRONMENTS):
        name = f"farm-{k}"
        store.environments.create(name, title=f"Farm {k}", datum=Datum(52.0 + k / 100, 5.0))
        store.channels.move(name, "production", 1, author="test")
        report = RobotReport("production", 1, store.environments.get(name).root, "active")
        store.robots.note_reports([ReceivedReport(name, f"robot-{k}", report, datetime.now(UTC), vouched=True)])
    return read(store)


def read(store: Store) -> State:
    """Read what must not be lost: head, root, sequence of events and robots of each environment."""
    out = {}
    for k in range(ENVIRONMENTS):
        name = f"farm-{k}"
        environment = store.environments.get(name)
        events = [event.sequence for event in store.events.page(name)]
        assert events == list(range(1, environment.sequence + 1))
        robots = [status.robot for status in store.robots.all(name)]
        out[name] = (environment.head, environment.root, environment.sequence, robots)
    return out


def downgrade(url: str) -> None:
    settings = config()
    database = Database(url, readonly=False)
    with database.engine.connect() as connection:
        connection.execution_options(write=True)
        with connection.begin():
            settings.attributes["connection"] = connection
            command.downgrade(settings, OLD)
    database.close()


def migrate_and_kill(url: str, blobs: Path, seconds: float | None) -> float:
    """Start a migration and kill it so long after it began; None: let it end. Returns how long it ran."""
    process = PreloadedProcess([url, str(blobs)], env=os.environ, cwd=ROOT, module="tests.chaos.migrator")
    assert process.stdout is not None
    with process.stdout:
        assert process.stdout.readline() == "migrating\n"
        started = time.monotonic()
        if seconds is not None:
            time.sleep(seconds)
            process.kill()
        process.wait(60)
        return time.monotonic() - started


def kill_migrations(old: Callable[[], str], blobs: Path, expected: State) -> None:
    """Kill migrations of copies of an old database, each twice, and complete each. old: makes a copy."""
    dice = random.Random(SEED)
    duration = migrate_and_kill(old(), blobs, None)
    for _ in range(ROUNDS):
        url = old()
        for _ in range(2):
            migrate_and_kill(url, blobs, dice.uniform(0, duration))
        store = Store(url, blobs)
        try:
            store.migrate()
            store.check()
            assert read(store) == expected, "a migration that was killed has lost data"
            assert store.verifier().run().findings == []
        finally:
            store.close()


def test_sqlite_migration_survives_kills(tmp_path: Path) -> None:
    file, blobs = tmp_path / "old.sqlite", tmp_path / "blobs"
    store = Store(f"sqlite:///{file}", blobs)
    store.migrate()
    expected = fill(store)
    store.close()
    downgrade(f"sqlite:///{file}")
    copies = 0

    def old() -> str:
        nonlocal copies
        copies += 1
        copy = tmp_path / f"copy-{copies}.sqlite"
        for end in ("", "-wal", "-shm"):
            if Path(f"{file}{end}").exists():
                shutil.copyfile(f"{file}{end}", f"{copy}{end}")
        return f"sqlite:///{copy}"

    kill_migrations(old, blobs, expected)


@pytest.mark.postgres
def test_postgresql_migration_survives_kills(tmp_path: Path, postgres_cluster: Cluster) -> None:
    blobs, name = tmp_path / "blobs", postgres_cluster.create_database()
    store = Store(postgres_cluster.url(name), blobs)
    store.migrate()
    expected = fill(store)
    store.close()
    downgrade(postgres_cluster.url(name))
    kill_migrations(lambda: postgres_cluster.url(postgres_cluster.create_database(name)), blobs, expected)
