"""Dry runs: readable for ten minutes, committed exactly, removed with all of their content."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from pathlib import Path

import pytest

from app.errors import Invalid, NotFound, StaleParent, Unavailable
from app.model.layers import Layers
from app.store.changes import Changes, Operation, Replace
from app.store.dry_runs import LIFETIME, MAX_DRY_RUNS
from app.store.pending import as_prepared
from app.store.store import Store
from app.store.values import Source, Version
from tests.store.conftest import NOW, Clock, count
from tests.store.samples import DATUM, GRID, TOPOLOGY, assert_same_layers, everything, grid, network, replaces, save


def attempt(store: Store, *operations: Operation, sources: tuple[Source, ...] = ()) -> Version:
    prepared = store.versions.prepare(store.versions.get("farm"), Changes(operations))
    return store.versions.store_dry_run("farm", prepared, author="ann", message="try", sources=sources)


def commit(store: Store, dry: Version) -> Version:
    return store.versions.commit("farm", as_prepared(dry), author="bob", message="commit", sources=dry.sources)


def test_dry_run_is_read_by_its_id_only(farm: Store) -> None:
    head, sequence = farm.versions.get("farm"), farm.environments.get("farm").sequence
    dry = attempt(farm, *replaces(everything()))
    assert dry.pending is not None
    assert (dry.parent, dry.pending.changed, dry.pending.expires) == (head.number, True, NOW + LIFETIME)
    assert farm.versions.get("farm", dry.ref) == dry
    farm.chunks.forget()
    assert_same_layers(farm.content.load(farm.versions.get("farm", dry.ref)), Layers(everything(), DATUM))
    assert farm.versions.get("farm") == head
    assert len(farm.versions.page("farm")) == head.number + 1
    assert farm.environments.get("farm").sequence == sequence, "no event"
    farm.environments.create("other")
    for environment, ref in (("other", dry.ref), ("farm", "dry:" + "0" * 32), ("farm", "dry:"), ("farm", "dry:\x00")):
        with pytest.raises(NotFound, match="run it again"):
            farm.versions.get(environment, ref)
    for read in (farm.versions.get_committed, farm.channels.target):
        with pytest.raises(Invalid, match="commit it first"):
            read("farm", dry.ref)


def test_committed_dry_run_equals_the_direct_commit(farm: Store) -> None:
    digest = farm.blobs.put(b"original")
    dry = attempt(farm, *replaces(everything()), sources=(Source("o", 8, digest),))
    farm.environments.create("direct", datum=DATUM)
    direct = save(farm, "direct", *replaces(everything()))
    version = commit(farm, dry)
    assert (version.root, version.changes, version.parts) == (direct.root, direct.changes, direct.parts)
    assert (version.number, version.pending, version.sources) == (2, None, dry.sources)
    with pytest.raises(StaleParent):
        commit(farm, dry)


def test_dry_run_of_another_head_is_refused(farm: Store) -> None:
    prepared = farm.versions.prepare(farm.versions.get("farm"), Changes((Replace(TOPOLOGY, network(5)),)))
    dry = attempt(farm, Replace(TOPOLOGY, network(7)))
    save(farm, "farm", Replace(GRID, grid()))
    with pytest.raises(StaleParent):
        farm.versions.store_dry_run("farm", prepared, author="a", message="")
    with pytest.raises(StaleParent):
        commit(farm, dry)
    assert farm.versions.get("farm").number == 2


def test_dry_run_expires_by_the_clock_of_the_store(farm: Store, clock: Clock) -> None:
    dry = attempt(farm, Replace(TOPOLOGY, network(50)))
    clock.now = NOW + LIFETIME - timedelta(seconds=1)
    farm.versions.remove_expired_dry_runs()
    assert farm.versions.get("farm", dry.ref) == dry
    clock.now = NOW + LIFETIME
    for _ in range(2):
        with pytest.raises(NotFound, match="has expired: run it again"):
            farm.versions.get("farm", dry.ref)
        with pytest.raises(NotFound, match="has expired"):
            commit(farm, dry)
        farm.versions.remove_expired_dry_runs()
    assert count(farm, "dry_run") == 0
    assert farm.versions.get("farm").number == 1


def test_garbage_collection_keeps_live_dry_runs_only(farm: Store, clock: Clock) -> None:
    before = count(farm, "chunk")
    digest = farm.blobs.put(b"original")
    dry = attempt(farm, *replaces(everything()), sources=(Source("o", 8, digest),))
    removed = farm.garbage.collect(timedelta(0))
    assert removed["chunks"] == removed["blobs"] == 0
    assert_same_layers(farm.content.load(farm.versions.get("farm", dry.ref)), Layers(everything(), DATUM))
    assert farm.blobs.get(digest) == b"original"
    kept = commit(farm, attempt(farm, Replace(TOPOLOGY, network(60))))
    clock.now += LIFETIME
    removed = farm.garbage.collect(timedelta(0))
    assert removed["chunks"] > 10
    assert removed["blobs"] > 1
    with pytest.raises(NotFound):
        farm.blobs.get(digest)
    assert count(farm, "dry_run") == 0
    assert count(farm, "chunk") > before, "those of the version"
    assert len(farm.content.features(farm.versions.get("farm"), TOPOLOGY)) == 60
    assert kept.root == farm.versions.get("farm").root


def test_commit_while_another_server_collects_finds_all_content_or_nothing(farm: Store) -> None:
    """The clock of the collecting server is ahead: only for that server has the dry run expired."""
    ahead = Store(farm.database_url, farm.blob_dir, clock=lambda: NOW + LIFETIME)
    outcomes = []
    try:
        for k in range(12):
            dry = attempt(farm, Replace(TOPOLOGY, network(200, seed=k)))
            with ThreadPoolExecutor(1) as thread:
                collection = thread.submit(ahead.garbage.collect, timedelta(0))
                time.sleep(0.002 * k)
                try:
                    commit(farm, dry)
                    outcomes.append("committed")
                except NotFound:
                    outcomes.append("expired")
                collection.result()
            farm.chunks.forget()
            assert farm.verifier().run().findings == [], "no version lacks a chunk"
    finally:
        ahead.close()
    assert farm.versions.get("farm").number == 1 + outcomes.count("committed")


def test_oldest_dry_run_is_removed_when_there_are_too_many(farm: Store, clock: Clock) -> None:
    farm.environments.create("other", datum=DATUM)
    elsewhere = farm.versions.store_dry_run(
        "other", farm.versions.prepare(farm.versions.get("other"), Changes()), author="a", message=""
    )
    dry_runs = []
    for k in range(MAX_DRY_RUNS + 1):
        clock.now += timedelta(seconds=1)
        dry_runs.append(attempt(farm, Replace(TOPOLOGY, network(k + 1))))
    first, second = dry_runs[:2]
    with pytest.raises(NotFound):
        farm.versions.get("farm", first.ref)
    assert farm.versions.get("farm", second.ref) == second
    assert count(farm, "dry_run") == MAX_DRY_RUNS + 1
    assert farm.versions.get("other", elsewhere.ref) == elsewhere


def test_purged_environment_has_no_dry_runs(farm: Store) -> None:
    attempt(farm, Replace(TOPOLOGY, network(9)))
    farm.environments.delete("farm")
    farm.environments.purge("farm")
    assert count(farm, "dry_run") == 0


def test_dry_run_with_a_lost_file_is_refused(farm: Store) -> None:
    with pytest.raises(Unavailable, match="send it again"):
        attempt(farm, Replace(TOPOLOGY, network(9)), sources=(Source("o", 8, "0" * 64),))
    assert count(farm, "dry_run") == 0


CHILD = """
import sys, time
from pathlib import Path
from app.store.dry_runs import MAX_DRY_RUNS
from app.store.store import Store
from app.store.changes import Changes, Replace
from tests.store.conftest import NOW, Clock, count
from tests.store.samples import TOPOLOGY, network

store = Store(sys.argv[1], Path(sys.argv[2]))
for seed in range(MAX_DRY_RUNS):
    change = Changes((Replace(TOPOLOGY, network(400, seed=seed)),))
    prepared = store.versions.prepare(store.versions.get("farm"), change)
    dry = store.versions.store_dry_run("farm", prepared, author="child", message=str(seed))
    print(dry.ref, dry.root, flush=True)
time.sleep(600)
"""


@pytest.mark.parametrize("lines", [1, 3, 6])
def test_dry_runs_of_a_killed_process_are_readable(store: Store, lines: int) -> None:
    """Another process reads and commits what a process that was killed had announced, and nothing is half stored."""
    store.environments.create("farm", datum=DATUM)
    arguments = [sys.executable, "-c", CHILD, store.database_url, str(store.blob_dir)]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True, env=environment) as child:
        assert child.stdout is not None
        announced = [child.stdout.readline().split() for _ in range(lines)]
        child.send_signal(signal.SIGKILL)
    store.recover()
    store.garbage.collect(timedelta(0))
    for ref, root in announced:
        dry = store.versions.get("farm", ref)
        assert dry.root == root
        assert len(store.content.features(dry, TOPOLOGY)) == 400
    with store._database.read() as connection:
        stored = [row[0] for row in connection.exec_driver_sql("SELECT id FROM dry_run")]
    for name in stored:  # also the one that was stored and not announced, if any
        assert len(store.content.features(store.versions.get("farm", f"dry:{name}"), TOPOLOGY)) == 400
    assert len(stored) >= lines
    assert store.versions.get("farm").number == 1
    assert commit(store, dry).root == announced[-1][1]
    assert store.verifier().run().findings == []
