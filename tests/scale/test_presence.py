"""What servers on one database write while robots come to the bus and leave it: the changes, however many they are."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import pytest

from app.backends.lead import SharedLeads
from app.fleet import ReportQueue
from app.store.store import Store
from tests.events.conftest import eventually
from tests.postgres import Cluster

ROBOTS = 20
CHANGES = 60


@contextlib.contextmanager
def queues(url: str, folder: Path, count: int) -> Iterator[tuple[Store, list[ReportQueue]]]:
    """Run the report queues of some servers, each with its own store and leads."""
    with contextlib.ExitStack() as stack:
        stores, out = [], []
        for number in range(count):
            place = folder / f"server-{number}"
            place.mkdir(parents=True)
            stores.append(Store(url, place / "blobs"))
            stack.callback(stores[-1].close)
            if not number:
                stores[0].initialise()
            leads = SharedLeads(url, place)
            leads.start()
            stack.callback(leads.close)
            lead = leads.lead("events")
            lead.try_acquire()
            if not number:
                eventually(lead.try_acquire)
            out.append(ReportQueue(stores[-1], lead))
            out[-1].start()
            stack.callback(out[-1].close)
        yield stores[0], out


def written_rows(cluster: Cluster, url: str) -> int:
    """Rows of all tables but that of the elections that were inserted, updated or deleted so far."""
    query = "SELECT sum(n_tup_ins + n_tup_upd + n_tup_del) FROM pg_stat_user_tables WHERE relname <> 'lead'"
    with cluster.connect(url.rpartition("/")[2]) as connection:
        row = connection.execute(query).fetchone()
    assert row is not None
    return int(str(row[0]))


def count_writes(cluster: Cluster, folder: Path, servers: int, monkeypatch: pytest.MonkeyPatch) -> int:
    """Let robots come and go, as every server hears it; returns the rows written for that."""
    monkeypatch.setattr("app.fleet.report_queue.PRESENCE_REFRESH_SECONDS", 3600.0)  # one row for all, by the clock
    name = cluster.create_database()
    try:
        url = cluster.url(name)
        with queues(url, folder / str(servers), servers) as (store, running):
            present = {f"r{k}" for k in range(ROBOTS)}
            for robot in sorted(present):
                for one in running:
                    one.set_presence(robot, on_bus=True)
            eventually(lambda: store.robots.present_robots() == present)
        before = written_rows(cluster, url)  # all sessions have ended, so that their statistics are complete
        with queues(url, folder / f"{servers}-again", servers) as (store, running):
            for robot in sorted(present):
                for one in running:
                    one.set_presence(robot, on_bus=True)  # nothing new
            for change in range(CHANGES):
                robot = f"r{change % ROBOTS}"
                present.symmetric_difference_update({robot})
                for one in running:
                    one.set_presence(robot, on_bus=robot in present)
                eventually(lambda: store.robots.present_robots() == present)
        return written_rows(cluster, url) - before
    finally:
        cluster.drop_database(name)


def test_presence_writes_grow_with_changes_alone(
    postgres_cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = [count_writes(postgres_cluster, tmp_path, servers, monkeypatch) for servers in (1, 3)]
    print(f"rows written for {CHANGES} changes: {written[0]} by one server, {written[1]} by three")
    assert all(CHANGES <= rows <= CHANGES + 2 for rows in written), written
