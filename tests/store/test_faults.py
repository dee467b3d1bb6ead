"""Faults: a killed process, damaged bytes, a full disk, a database that does not answer."""

from __future__ import annotations

import errno
import hashlib
import os
import random
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest

from app.errors import Damaged, Invalid, NotFound, Unavailable
from app.model.features import Features
from app.model.layers import VECTOR_LAYERS, Layers
from app.store import versions
from app.store.changes import Changes, Replace
from app.store.encode import compress, digest
from app.store.store import Store
from app.store.values import Source, Version
from tests.store.samples import (
    DATUM,
    GRID,
    TOPOLOGY,
    add_sources,
    assert_same_layers,
    everything,
    grid,
    network,
    replaces,
    save,
)

CHILD = """
import sys
from pathlib import Path
from app.model.layers import PartKey
from app.store.store import Store
from app.store.changes import Changes, Replace
from app.store.values import Source
from tests.store.samples import TOPOLOGY, GRID, network, grid

store = Store(sys.argv[1], Path(sys.argv[2]))
print("ready", flush=True)
for n in range(1000):
    head = store.versions.get("farm")
    data = b"upload %d" % head.number + bytes(100_000)
    files = store.blobs.put_many([data, b"small %d" % n, b"other %d" % n])
    operations = (Replace(TOPOLOGY, network(400, seed=head.number)), Replace(GRID, grid(seed=head.number)))
    prepared = store.versions.prepare(head, Changes(operations))
    sources = [Source(f"f{k}", 1, sha) for k, sha in enumerate(files)]
    version = store.versions.commit("farm", prepared, author="child", message=str(head.number), sources=sources)
    print("committed", version.number, version.root, flush=True)
"""


def test_closed_store_keeps_no_connection_that_a_thread_still_uses(database_url: str, tmp_path: Path) -> None:
    store = Store(database_url, tmp_path / "blobs")
    pool = store._database.engine.pool
    with store._database.read() as connection:
        store.close()
        assert connection.exec_driver_sql("SELECT 1").scalar_one() == 1, "its use goes on"
    assert pool.checkedin() == 0  # type: ignore[attr-defined]
    store.environments.page()  # by a thread that the end of its process overtook
    assert store._database.engine.pool is pool
    assert pool.checkedin() == 0  # type: ignore[attr-defined]


@pytest.mark.postgres
@pytest.mark.parametrize("database_url", ["postgres"], indirect=True)
def test_commit_of_a_stopped_server_blocks_others_for_a_limited_time(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It stands still right after it has locked the environment: PostgreSQL ends its transaction."""
    store.environments.create("farm", datum=DATUM)
    head = store.versions.get("farm").number
    stops, goes_on = threading.Event(), threading.Event()
    check_head, refused = versions._check_head, []

    def stand_still(*arguments: Any) -> None:
        if threading.current_thread() is stopped:
            stops.set()
            goes_on.wait(120)
        check_head(*arguments)

    def commit_late() -> None:
        with pytest.raises(Unavailable) as caught:
            save(store, "farm", Replace(TOPOLOGY, network(2)))
        refused.append(caught.value)

    monkeypatch.setattr(versions, "_check_head", stand_still)
    monkeypatch.setattr("app.store.database.MAX_STANDSTILL_SECONDS", 5)
    stopped = threading.Thread(target=commit_late)
    other = threading.Thread(target=save, args=(store, "farm", Replace(TOPOLOGY, network(3))), daemon=True)
    stopped.start()
    try:
        assert stops.wait(60)
        other.start()
        other.join(60)
        assert not other.is_alive(), "it waits for the environment's row"
    finally:
        goes_on.set()
        stopped.join()
    assert refused
    assert store.versions.get("farm").number == head + 1, "only the other commit is stored"


@pytest.mark.postgres
@pytest.mark.parametrize("database_url", ["postgres"], indirect=True)
def test_writing_transactions_may_stand_still_for_a_limited_time(store: Store) -> None:
    def limit(**options: bool) -> str:
        with store._database.write(**options) as connection:
            return str(connection.exec_driver_sql("SHOW idle_in_transaction_session_timeout").scalar_one())

    assert (limit(), limit(upkeep=True), limit(alone=True)) == ("30s", "30s", "0")
    with store._database.read() as connection:
        assert connection.exec_driver_sql("SHOW idle_in_transaction_session_timeout").scalar_one() == "0"


def test_kill_9_leaves_old_or_new_state(store: Store):
    store.environments.create("farm", datum=DATUM)
    random.seed(1)
    acknowledged: dict[int, str] = {}
    root = Path(__file__).resolve().parents[2]
    for left in range(3, -1, -1):
        child = subprocess.Popen(
            [sys.executable, "-c", CHILD, store.database_url, str(store.blob_dir)],
            stdout=subprocess.PIPE,
            text=True,
            cwd=root,
            env={**os.environ, "PYTHONPATH": str(root)},
        )
        assert child.stdout is not None
        assert child.stdout.readline() == "ready\n"
        # on a busy machine every process may be killed before its commit: then the last one may commit once
        lines = [child.stdout.readline()] if not left and not acknowledged else []
        time.sleep(random.uniform(0.05, 0.6))
        child.send_signal(signal.SIGKILL)
        for line in (*lines, *child.stdout):
            if line.startswith("committed") and line.endswith("\n"):
                _, number, root_hash = line.split()
                acknowledged[int(number)] = root_hash
        child.stdout.close()
        child.wait()
        again = Store(store.database_url, store.blob_dir)
        again.recover()
        assert temporary(again) == []
        again.check()
        head = again.versions.get("farm")
        listed = again.versions.page("farm", limit=1000)
        assert [v.number for v in listed] == list(range(head.number, -1, -1))
        for number, root_hash in acknowledged.items():
            assert again.versions.get("farm", number).root == root_hash
        assert [e.sequence for e in again.events.page("farm", limit=10_000)] == list(range(1, head.number + 2))
        for version in listed[:2]:
            loaded = again.content.load(version)
            if version.parts:
                expected = {TOPOLOGY: network(400, seed=version.number - 1), GRID: grid(seed=version.number - 1)}
                assert_same_layers(loaded, Layers(expected, DATUM))
            for source in version.sources:
                assert again.blobs.get(source.sha256)
        if again.database_url.startswith("sqlite"):
            with again._database.read() as connection:
                assert connection.exec_driver_sql("PRAGMA integrity_check").scalar_one() == "ok"
        again.close()
    assert acknowledged
    save(store, "farm", Replace(TOPOLOGY, network(3)))
    store.garbage.collect(timedelta(0))
    assert temporary(store) == []
    assert store.blob_upkeep.verify() == []


def temporary(store: Store) -> list[Path]:
    """Return the workspaces of uploads."""
    return [p for p in (store.blob_dir / "tmp").iterdir() if p.name != ".lock"]


def files_in(store: Store) -> list[tuple[Path, int]]:
    """Return all stored files with their times."""
    files = sorted(p for p in store.blob_dir.rglob("*") if p.is_file() and not p.name.startswith("."))
    return [(p, p.stat().st_mtime_ns) for p in files]


def read_all(store: Store, version: Version) -> None:
    """Read every chunk of a version; loading alone skips the tables of ids."""
    store.content.load(version)
    for entry in version.parts:
        if entry.key.layer in VECTOR_LAYERS:
            part = everything()[entry.key]
            assert isinstance(part, Features)
            store.content.has_ids(version, entry.key, part.ids)


def test_damaged_chunk_raises_damaged(store: Store):
    store.environments.create("farm", datum=DATUM)
    version = save(store, "farm", *replaces(everything()))
    with store._database.read() as connection:
        chunks = connection.exec_driver_sql("SELECT hash, data FROM chunk").all()
    mark = "?" if store.database_url.startswith("sqlite") else "%s"
    random.seed(2)
    for name, data in random.sample(chunks, 6):
        flipped = bytearray(bytes(data))
        flipped[len(flipped) // 2] ^= 1
        for wrong in (bytes(flipped), compress(b"something else"), b"", None):
            with store._database.write() as connection:
                if wrong is None:
                    connection.exec_driver_sql(f"DELETE FROM chunk WHERE hash = {mark}", (name,))
                else:
                    connection.exec_driver_sql(f"UPDATE chunk SET data = {mark} WHERE hash = {mark}", (wrong, name))
            store.chunks.forget()
            with pytest.raises(Damaged):
                read_all(store, version)
        with store._database.write() as connection:
            if store.database_url.startswith("sqlite"):
                statement = "INSERT OR REPLACE INTO chunk (hash, data, used) VALUES (?, ?, 0)"
            else:
                statement = "INSERT INTO chunk (hash, data, used) VALUES (%s, %s, 0)"
            connection.exec_driver_sql(statement, (name, data))
        store.chunks.forget()
        assert_same_layers(store.content.load(version), Layers(everything(), DATUM))


def test_garbage_collection_stops_at_damage(sqlite_store: Store):
    sqlite_store.environments.create("farm")
    version = save(sqlite_store, "farm", Replace(GRID, grid()))
    root = bytes.fromhex(version.parts[0].hash)
    with sqlite_store._database.write() as connection:
        connection.exec_driver_sql("DELETE FROM chunk WHERE hash = ?", (root,))
        before = connection.exec_driver_sql("SELECT count(*) FROM chunk").scalar_one()
    with pytest.raises(Damaged):
        sqlite_store.garbage.collect(timedelta(0))
    with sqlite_store._database.read() as connection:
        assert connection.exec_driver_sql("SELECT count(*) FROM chunk").scalar_one() == before


def test_damaged_and_lost_blobs_raise_damaged(store: Store):
    big, small, other = random.Random(1).randbytes(100_000), b"small", b"other"
    names = store.blobs.put_many([big, small, other])
    assert [hashlib.sha256(d).hexdigest() for d in (big, small, other)] == names
    path = store.blobs.path(names[0])
    assert path is not None
    assert store.blobs.path(names[1]) is None
    (pack,) = (store.blob_dir / "packs").iterdir()
    assert pack.read_bytes() == small + other
    assert store.blob_upkeep.verify() == []
    path.write_bytes(big[1:] + b"c")
    pack.write_bytes(b"S" + pack.read_bytes()[1:])
    for name in names[:2]:
        with pytest.raises(Damaged, match="backup"):
            store.blobs.get(name)
        with pytest.raises(Damaged, match="backup"):
            store.blobs.open(name)
    assert store.blobs.get(names[2]) == other
    assert store.blob_upkeep.verify() == sorted(names[:2])
    path.unlink()
    pack.unlink()
    for name in names:
        with pytest.raises(Damaged, match="lost"):
            store.blobs.get(name)
    store.blobs.put_many([big, small, other])
    assert store.blobs.get_many(names) == dict(zip(names, (big, small, other), strict=True))
    with pytest.raises(NotFound):
        store.blobs.get("0" * 64)


def test_blobs_from_bytes_and_files_are_written_once(store: Store, tmp_path: Path):
    spooled = tmp_path / "upload"
    spooled.write_bytes(b"x" * 3_000_000)
    (tmp_path / "tiny").write_bytes(b"t")
    names = store.blobs.put_many([spooled, tmp_path / "tiny", b"t", b"", spooled])
    assert names[0] == names[4]
    assert names[1] == names[2]
    assert store.blobs.size(names[0]) == 3_000_000
    assert store.blobs.get(names[3]) == b""
    with store.blobs.open(names[0]) as file:
        file.seek(2_999_999)
        assert file.read() == b"x"
    with store.blobs.open(names[1]) as file:
        assert file.read() == b"t"
    before = files_in(store)
    assert store.blobs.put_many([spooled, b"t"]) == [names[0], names[1]]
    assert store.blobs.put(spooled) == names[0]
    assert files_in(store) == before
    assert temporary(store) == []


def test_recover_removes_remains_of_killed_upload(store: Store):
    old = time.time() - 3 * 24 * 3600
    stray = store.blob_dir / "packs" / ("1" * 64)
    stray.write_bytes(b"half")
    os.utime(stray, (old, old))
    (name,) = store.blobs.put_many([b"z" * 70_000])
    stop_here = (
        "import sys, os; from pathlib import Path; from app.store.store import Store\n"
        "import app.backends.blob_folder as b\n"
        "b.os.fsync = lambda d: os.kill(os.getpid(), 9)\n"
        "Store(sys.argv[1], Path(sys.argv[2])).blobs.put_many([os.urandom(100_000)])"
    )
    killed = subprocess.run(
        [sys.executable, "-c", stop_here, store.database_url, str(store.blob_dir)], check=False, timeout=60
    )
    assert killed.returncode == -signal.SIGKILL
    assert temporary(store)
    with store.blobs.files.workspace() as workspace:
        (workspace / "half").write_bytes(b"in progress")
        store.recover()
        assert [workspace] == temporary(store)
        assert (workspace / "half").exists()
    assert temporary(store) == []
    add_sources(store, store.environments.create("farm").name, 0, Source("z", 70_000, name))
    store.garbage.collect(timedelta(days=1))
    assert not list((store.blob_dir / "packs").iterdir()), "the first collection also looks for files without a row"
    assert store.blobs.get(name) == b"z" * 70_000


def test_unwritable_disk_raises_unavailable_and_leaves_no_files(store: Store, monkeypatch: pytest.MonkeyPatch):
    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("app.backends.blob_folder.os.fsync", full)
    with pytest.raises(Unavailable, match="No space"):
        store.blobs.put(b"x" * 100_000)
    with pytest.raises(Unavailable, match="No space"):
        store.blobs.put_many([b"x", b"y"])
    monkeypatch.undo()
    assert temporary(store) == []
    with store._database.read() as connection:
        assert connection.exec_driver_sql("SELECT count(*) FROM blob").scalar_one() == 0


def test_failed_commit_stores_nothing(store: Store, monkeypatch: pytest.MonkeyPatch):
    store.environments.create("farm", datum=DATUM)
    head = store.versions.get("farm")
    prepared = store.versions.prepare(head, Changes((Replace(GRID, grid()),)))
    events = store.events.page("farm")

    def fail(*args: object, **more: object) -> None:
        raise RuntimeError("after everything but the event")

    monkeypatch.setattr("app.store.outbox.append_event", fail)
    with pytest.raises(RuntimeError):
        store.versions.commit("farm", prepared, author="a", message="m")
    monkeypatch.undo()
    assert store.versions.get("farm") == head
    assert store.events.page("farm") == events
    with store._database.read() as connection:
        assert connection.exec_driver_sql("SELECT count(*) FROM chunk").scalar_one() == 0
    with pytest.raises(Unavailable):
        store.versions.commit("farm", prepared, author="a", message="m", sources=[Source("x", 1, "f" * 64)])
    assert store.versions.get("farm") == head


def test_locked_sqlite_raises_unavailable(sqlite_store: Store, monkeypatch: pytest.MonkeyPatch):
    import app.store.database as database

    monkeypatch.setattr(database, "BUSY_MILLISECONDS", 50)
    other = Store(sqlite_store.database_url, sqlite_store.blob_dir)
    with sqlite_store._database.write(), pytest.raises(Unavailable, match="locked"):
        other.environments.create("farm")
    other.environments.create("farm")
    other.close()


def test_unsupported_database_urls_are_rejected(tmp_path: Path):
    for url in ("mysql://x/y", "nonsense"):
        with pytest.raises(Invalid, match="postgresql"):
            Store(url, tmp_path)


def test_chunk_names_are_hashes_of_canonical_bytes(store: Store):
    store.environments.create("farm")
    save(store, "farm", *replaces(everything()))
    from app.store.encode import decompress

    with store._database.read() as connection:
        rows = connection.exec_driver_sql("SELECT hash, data FROM chunk").all()
    assert len(rows) > 20
    assert all(digest(decompress(bytes(data))) == bytes(name) for name, data in rows)


@pytest.mark.parametrize("number", [errno.EIO, errno.EBADMSG, errno.EUCLEAN, errno.EMFILE, errno.EACCES])
def test_blob_is_damaged_only_with_broken_storage(
    sqlite_store: Store, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    name = sqlite_store.blobs.put(random.Random(1).randbytes(100_000))
    real = Path.open

    def refuse(path: Path, mode: str = "r", **more: Any) -> Any:
        if path.name == name and "r" in mode:
            raise OSError(number, os.strerror(number), str(path))
        return real(path, mode, **more)

    monkeypatch.setattr(Path, "open", refuse)
    broken = number not in {errno.EMFILE, errno.EACCES}
    for read in (sqlite_store.blobs.open, sqlite_store.blobs.get):
        with pytest.raises(Damaged if broken else Unavailable, match=os.strerror(number)) as caught:
            read(name)
        assert str(sqlite_store.blob_dir) not in caught.value.detail
    if broken:
        assert sqlite_store.blob_upkeep.verify() == [name]
    else:
        with pytest.raises(Unavailable, match=os.strerror(number)):
            sqlite_store.blob_upkeep.verify()


@pytest.mark.postgres
def test_server_that_stands_still_in_a_commit_does_not_block_the_others(
    postgres_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.store.outbox.MAX_IDLE_SECONDS", 1)
    servers = [Store(postgres_url, tmp_path / name) for name in ("a", "b")]
    servers[0].migrate()
    is_still, may_go_on = threading.Event(), threading.Event()

    def stand_still(_: object) -> None:
        if not is_still.is_set():
            is_still.set()
            may_go_on.wait(60)

    monkeypatch.setattr("app.store.database.check_fences", stand_still)  # right before the commit
    with ThreadPoolExecutor(2) as pool:
        try:
            late = pool.submit(servers[0].environments.create, "late")
            assert is_still.wait(60)
            pool.submit(servers[1].environments.create, "farm").result(20)
        finally:
            may_go_on.set()
        with pytest.raises(Unavailable, match="idle-in-transaction"):
            late.result(60)
    assert [e.name for e in servers[0].environments.page()[0]] == ["farm"]
    for server in servers:
        server.close()
