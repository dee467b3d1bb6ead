"""Verification and the background scrub, on both databases."""

from __future__ import annotations

import errno
import json
import pickle
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import exc

from app.backends.blobs import unreadable_error as _unreadable_error
from app.backends.lead import LocalLead
from app.errors import Damaged, DatabaseDamaged, NoRoom, Unavailable
from app.ingest.repair import repair
from app.limits import Limits
from app.store.changes import Changes
from app.store.chunks import insert
from app.store.encode import compress, digest
from app.store.scrub import Scrub, current_state, figures
from app.store.store import Store
from app.store.values import Source, Writer
from tests.store.samples import GRID, TOPOLOGY, everything, grid, network, replaces, save

ScrubOf = Callable[..., Scrub]


@pytest.fixture
def scrub_of(tmp_path: Path) -> Iterator[ScrubOf]:
    """Function that makes a scrub whose process has the lead; with ``leads=False`` it has to get it."""
    lead = LocalLead(tmp_path, "scrub")

    def make(
        store: Store, cache: Any = lambda: iter(()), *, rate: int = 10**9, delay: float = 60.0, leads: bool = True
    ) -> Scrub:
        if leads:
            assert lead.try_acquire()
        return Scrub(store, cache, lead if leads else LocalLead(tmp_path, "scrub"), every=3600, rate=rate, delay=delay)

    yield make
    lead.release()


def filled(store: Store) -> None:
    """A store with two versions of every kind of part, with sources: a large file and two packed ones."""
    store.environments.create("farm")
    names = store.blobs.put_many([b"b" * 100_000, b"small", b"other"])
    sources = [Source(f"f{k}", 1, name) for k, name in enumerate(names)]
    prepared = store.versions.prepare(store.versions.get("farm"), Changes(replaces(everything())))
    store.versions.commit("farm", prepared, author="ann", message="all", sources=sources)
    save(store, "farm", *replaces({GRID: grid(seed=5)}))


def spoil_chunk(store: Store, name: str, *, lose: bool = False) -> None:
    mark = "?" if store.database_url.startswith("sqlite") else "%s"
    with store._database.write() as connection:
        if lose:
            connection.exec_driver_sql(f"DELETE FROM chunk WHERE hash = {mark}", (bytes.fromhex(name),))
        else:
            statement = f"UPDATE chunk SET data = {mark} WHERE hash = {mark}"
            connection.exec_driver_sql(statement, (b"spoilt", bytes.fromhex(name)))
    store.chunks.forget()


def test_verification_names_damage_and_affected_versions(store: Store) -> None:
    filled(store)
    verification = store.verifier().run()
    assert verification.findings == []
    assert verification.checked["version"] == 3
    assert verification.checked["blob"] >= 3
    first, second = store.versions.get("farm", 1), store.versions.get("farm", 2)
    only_first = first.part(GRID)
    both = next(e for e in first.parts if e.key != GRID and e in second.parts)
    assert only_first is not None
    spoil_chunk(store, only_first.hash)
    spoil_chunk(store, both.hash, lose=True)
    big, small, _ = (s.sha256 for s in first.sources)
    path = store.blobs.path(big)
    assert path is not None
    path.write_bytes(bytes(100_000))
    (pack,) = [p for p in (store.blob_dir / "packs").iterdir() if b"small" in p.read_bytes()]
    pack.write_bytes(pack.read_bytes().replace(b"small", b"smell"))
    verification = store.verifier().run()
    findings = {(f.kind, f.name): (f.problem, f.versions) for f in verification.findings}
    assert findings == {
        ("chunk", only_first.hash): ("damaged", (("farm", 1),)),
        ("chunk", both.hash): ("lost", (("farm", 1), ("farm", 2))),
        ("blob", big): ("damaged", (("farm", 1),)),
        ("blob", small): ("damaged", (("farm", 1),)),
    }
    assert json.dumps([f.as_dict() for f in verification.findings])
    path.unlink()
    assert ("blob", big, "lost") in {(f.kind, f.name, f.problem) for f in store.verifier().run().findings}
    store.blobs.put_many([b"b" * 100_000, b"small", b"new"])
    assert [f for f in store.verifier().run().findings if f.kind == "blob"] == [], "uploaded again: healed"


def test_verification_covers_every_node_of_tree(sqlite_store: Store) -> None:
    filled(sqlite_store)
    version = sqlite_store.versions.get("farm", 2)
    names = [name for name, _, _ in sqlite_store.verifier().chunks()][::7]
    lost = 0
    for name in names:
        raw = sqlite_store.chunks.read(name)
        spoil_chunk(sqlite_store, name, lose=True)
        findings = sqlite_store.verifier().run().findings
        if findings:
            assert {f.name for f in findings} == {name}
            lost += ("farm", version.number) in findings[0].versions
        sqlite_store.chunks.heal({name: raw})
    assert lost > len(names) // 2
    assert sqlite_store.verifier().run().findings == []
    with pytest.raises(Damaged):
        sqlite_store.chunks.heal({names[0]: b"other bytes"})


def test_verification_finds_changed_version_row(store: Store) -> None:
    filled(store)
    with store._database.write() as connection:
        connection.exec_driver_sql("UPDATE version SET root = 'f' || substr(root, 2) WHERE number = 1")
    (finding,) = store.verifier().run().findings
    assert (finding.kind, finding.name, finding.versions) == ("version", "farm 1", (("farm", 1),))
    assert "was committed" in finding.problem


def test_scrub_finds_damage_resumes_and_reports_age(store: Store, scrub_of: ScrubOf) -> None:
    filled(store)
    entry = store.versions.get("farm", 1).part(GRID)
    assert entry is not None
    spoil_chunk(store, entry.hash)
    assert figures(current_state(store))["age"] == float("inf")
    cache = [("00", 10, True), ("01", 0, False)]
    scrub = scrub_of(store, lambda: iter(cache))
    scrub._stopped.set()  # stopped within the first step
    scrub.pass_if_due()
    begun = current_state(store)
    assert begun.started
    assert not begun.completed
    scrub = scrub_of(store, lambda: iter(cache))
    scrub.pass_if_due()
    state = current_state(store)
    assert state.findings == {"chunk": 1, "cache": 1}
    assert state.size > 100_000
    assert 0 <= figures(state)["age"] < 60
    scrub.pass_if_due()
    assert current_state(store) == state, "the next pass is not due yet"


def test_scrub_checks_sqlite_by_table_with_pauses(
    sqlite_store: Store, scrub_of: ScrubOf, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pauses hold no connection; a stop between two tables loses nothing, and damage counts once."""
    real, checked = sqlite_store._database.integrity, list[str]()

    def integrity(limit: int, *, table: str | None = None) -> str | None:
        checked.append(str(table))
        return "a page is bad" if table == "blob" else real(limit, table=table)

    monkeypatch.setattr(sqlite_store._database, "integrity", integrity)
    tables, size = sqlite_store._database.tables()
    assert {"sqlite_master", "blob", "chunk"} <= set(tables)
    assert sqlite_store._database.file is not None
    assert size <= sqlite_store._database.file.stat().st_size + 2**22  # pages still in the write-ahead log
    waited: list[float] = []

    def wait(seconds: float | None = None) -> bool:
        assert sqlite_store._database.engine.pool.checkedout() == 0  # type: ignore[attr-defined]
        waited.append(seconds or 0.0)
        return False

    for _ in range(len(tables)):
        scrub = scrub_of(sqlite_store, rate=size // len(tables))
        scrub._stopped.wait = wait  # type: ignore[method-assign]
        scrub._stopped.set()
        scrub.pass_if_due()
    assert checked == tables
    assert len(waited) >= len(tables)
    assert min(waited) >= 0.9
    scrub_of(sqlite_store).pass_if_due()
    assert checked == tables
    assert current_state(sqlite_store).findings == {"database": 1}
    with pytest.raises(DatabaseDamaged, match="a page is bad"):
        sqlite_store._database.check()


def test_scrub_skips_unreadable_files(
    sqlite_store: Store, scrub_of: ScrubOf, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    names = sorted(sqlite_store.blobs.put(bytes([k]) * 100) for k in range(3))
    real = sqlite_store.blobs._problem

    def problem(row: Any) -> str | None:
        name = row.name
        if name == names[0]:
            raise _unreadable_error(PermissionError(errno.EACCES, "refused", "/srv/data"))
        return "damaged" if name == names[1] else real(row)

    monkeypatch.setattr(sqlite_store.blobs, "_problem", problem)
    scrub_of(sqlite_store).pass_if_due()
    assert current_state(sqlite_store).findings == {"blob": 1}
    assert "Permission denied" in caplog.text
    assert "/srv" not in caplog.text


def test_scrub_continues_after_unexpected_error(
    sqlite_store: Store, scrub_of: ScrubOf, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("app.store.scrub.POLL_SECONDS", 0.01)
    errors = [ValueError("a defect"), *[OSError(errno.EIO, "refused", "/srv/data")] * 2]

    def check_pages(after: str) -> Iterator[tuple[str, int, str | None]]:
        if errors:
            raise errors.pop(0)
        return iter(())

    monkeypatch.setattr(sqlite_store, "check_pages", check_pages)
    scrub = scrub_of(sqlite_store, delay=0.0)
    scrub.start()
    deadline = time.monotonic() + 30
    while not current_state(sqlite_store).completed:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    scrub.close()
    assert "a defect" in caplog.text
    assert caplog.text.count("Input/output error") == 1
    assert "/srv" not in caplog.text


def test_scrub_runs_in_one_process(sqlite_store: Store, scrub_of: ScrubOf) -> None:
    scrubs = [scrub_of(sqlite_store, delay=0.0, leads=False) for _ in range(2)]
    for scrub in scrubs:
        scrub.start()
    deadline = time.monotonic() + 30
    while not current_state(sqlite_store).completed:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    assert [scrub._lead.is_held for scrub in scrubs].count(True) == 1
    for scrub in scrubs:
        scrub.close()


def test_scrub_keeps_to_its_rate(sqlite_store: Store, scrub_of: ScrubOf) -> None:
    sqlite_store.blobs.put(b"x" * 40_000)
    waited: list[float] = []
    scrub = scrub_of(sqlite_store, rate=100_000)
    scrub._stopped.wait = lambda seconds=None: bool(waited.append(seconds or 0.0))  # type: ignore[method-assign]
    scrub.pass_if_due()
    assert sum(waited) >= 0.4


def test_database_errors_name_remedy(tmp_path: Path) -> None:
    file = tmp_path / "some.sqlite"
    for content, kind, text in ((b"no database at all" * 500, DatabaseDamaged, "fleetmap verify"),):
        file.write_bytes(content)
        store = Store(f"sqlite:///{file}", tmp_path / "blobs")
        with pytest.raises(kind, match=text) as raised:
            store.environments.page()
        assert "some.sqlite" in raised.value.detail
        store.close()
    file.unlink()
    with pytest.raises(DatabaseDamaged, match="missing"):
        Store(f"sqlite:///{file}", tmp_path / "blobs", readonly=True).environments.page()
    assert not file.exists()
    folder = tmp_path / "folder.sqlite"
    folder.mkdir()
    store = Store(f"sqlite:///{folder}", tmp_path / "blobs")
    with pytest.raises(Unavailable, match="check the file"):
        store.environments.page()
    store.close()


def test_full_or_read_only_database_rejects_writes(sqlite_store: Store) -> None:
    sqlite_store.environments.create("farm")
    with sqlite_store._database.read() as connection:
        pages = connection.exec_driver_sql("PRAGMA page_count").scalar_one()

    def limit(connection: object, *_: object) -> None:
        connection.exec_driver_sql(f"PRAGMA max_page_count={pages}")  # type: ignore[attr-defined]

    from sqlalchemy import event

    sqlite_store._database.engine.dispose()
    event.listen(sqlite_store._database.engine, "begin", limit)
    with pytest.raises(NoRoom, match="no disk space"):
        save(sqlite_store, "farm", *replaces(everything()))
    event.remove(sqlite_store._database.engine, "begin", limit)
    assert sqlite_store.versions.get("farm").number == 0
    reading = Store(sqlite_store.database_url, sqlite_store.blob_dir, readonly=True)
    with pytest.raises(Unavailable, match="cannot be written"):
        reading.environments.create("other")
    reading.close()


@pytest.mark.parametrize(
    ("state", "kind"),
    [("XX001", DatabaseDamaged), ("XX002", DatabaseDamaged), ("58P01", DatabaseDamaged), ("53100", NoRoom)],
)
def test_postgresql_errors_are_classified(sqlite_store: Store, state: str, kind: type[Unavailable]) -> None:
    class Refused(Exception):
        sqlstate = state

    with pytest.raises(kind), sqlite_store._database.read():
        raise exc.InternalError("SELECT 1", {}, Refused("invalid page in block 3 of relation base/5/16385"))
    if kind is DatabaseDamaged:
        with pytest.raises(DatabaseDamaged, match="fleetmap verify"):
            sqlite_store.check()


def test_missing_postgresql_library_is_no_damage(sqlite_store: Store) -> None:
    class Refused(Exception):
        sqlstate = "58P01"

    library = 'could not access file "$libdir/postgis-3": No such file or directory'
    with pytest.raises(Unavailable, match="postgis-3") as caught, sqlite_store._database.read():
        raise exc.OperationalError("SELECT 1", {}, Refused(library))
    assert not isinstance(caught.value, DatabaseDamaged)
    sqlite_store.check()


def test_temporarily_missing_database_file_is_no_permanent_damage(sqlite_store: Store) -> None:
    file = Path(sqlite_store.database_url.removeprefix("sqlite:///"))
    away = file.rename(file.with_suffix(".away"))
    with pytest.raises(DatabaseDamaged, match="missing") as caught:
        sqlite_store.environments.page()
    sqlite_store.note_damage(pickle.loads(pickle.dumps(caught.value)))
    away.rename(file)
    sqlite_store.check()
    sqlite_store.note_damage(DatabaseDamaged("a page is bad"))
    with pytest.raises(DatabaseDamaged, match="a page is bad"):
        sqlite_store.check()


def test_page_checks_run_one_at_a_time(sqlite_store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    database, release, checks = sqlite_store._database, threading.Event(), list[int]()

    def integrity(limit: int) -> str:
        checks.append(limit)
        assert release.wait(30)
        return "a page is bad"

    monkeypatch.setattr(database, "integrity", integrity)
    database._damage = time.monotonic() - 100, "the database is damaged"

    def check() -> None:
        with pytest.raises(DatabaseDamaged, match="the database is damaged"):
            database.check()

    with ThreadPoolExecutor(1) as first:
        running = first.submit(check)
        while not checks:
            time.sleep(0.01)
        for _ in range(5):
            check()
        release.set()
        running.result(30)
    check()
    assert len(checks) == 1
    database._damage = time.monotonic() - 100, "the database is damaged"
    monkeypatch.setattr(database, "integrity", lambda limit: None)
    database.check()
    database.check()


def test_verification_covers_drafts_and_dry_runs(farm: Store) -> None:
    draft = farm.drafts.create("farm", Writer("1", "ann"))
    current, base = farm.versions.get("farm", draft.ref), farm.versions.get("farm")
    assert current.pending is not None
    prepared = farm.versions.prepare_further(base, current, Changes(replaces({TOPOLOGY: network(60)})))
    farm.drafts.store("farm", current.pending, prepared, rebased=False)
    digest = farm.blobs.put(b"original" * 10_000)
    tried = farm.versions.prepare(base, Changes(replaces({TOPOLOGY: network(50)})))
    source = Source("o", 80_000, digest)
    dry = farm.versions.store_dry_run("farm", tried, author="ann", message="", sources=(source,))
    verification = farm.verifier().run()
    assert verification.findings == []
    assert verification.checked["version"] == 4
    for ref in (draft.ref, dry.ref):
        entry = farm.versions.get("farm", ref).part(TOPOLOGY)
        assert entry is not None
        spoil_chunk(farm, entry.hash)
        verification = farm.verifier().run()
        (finding,) = [f for f in verification.findings if f.name == entry.hash]
        assert (finding.kind, finding.problem, finding.versions) == ("chunk", "damaged", (("farm", ref),))
        assert entry.hash not in verification.unused_chunks, "else a repair would take it from the draft"
    assert repair(farm, verification.findings, [], lambda *_: pytest.fail("a draft has no uploads"), Limits()) == {}
    path = farm.blobs.path(digest)
    assert path is not None
    path.unlink()
    assert ("blob", digest, (("farm", dry.ref),)) in {
        (f.kind, f.name, f.versions) for f in farm.verifier().run().findings
    }
    farm.drafts.delete("farm", draft.id)
    left = {users for f in farm.verifier().run().findings for users in f.versions}
    assert left == {("farm", dry.ref)}


def test_draft_that_changes_during_the_verification_is_no_damage(farm: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    draft = farm.drafts.create("farm", Writer("1", "ann"))
    current, base = farm.versions.get("farm", draft.ref), farm.versions.get("farm")
    assert current.pending is not None
    prepared = farm.versions.prepare_further(base, current, Changes(replaces({TOPOLOGY: network(60)})))
    farm.drafts.store("farm", current.pending, prepared, rebased=False)
    entry = farm.versions.get("farm", draft.ref).part(TOPOLOGY)
    assert entry is not None
    verifier = farm.verifier()
    rows = list(verifier._pending())
    monkeypatch.setattr(verifier, "_pending", lambda: iter(rows))
    farm.drafts.delete("farm", draft.id)
    spoil_chunk(farm, entry.hash, lose=True)
    assert verifier.run().findings == []


def test_repair_removes_only_damaged_unused_chunks(store: Store) -> None:
    raws = {digest(raw).hex(): raw for raw in (b"healed" * 50, b"in use" * 50, b"unused" * 50)}
    healed, in_use, unused = raws
    with store._database.write() as connection:
        insert(connection, dict.fromkeys(raws, b"damaged"), now=time.time() - 100)
    verification = store.verifier().run()
    assert {f.name for f in verification.findings} == set(raws)
    with store._database.write() as connection:  # uploads of other processes during the check
        insert(connection, {healed: compress(raws[healed])}, now=time.time() - 50)
        insert(connection, {in_use: b"damaged"})
    assert store.chunks.remove_damaged(verification.unused_chunks, verification.started) == {unused}
    assert store.chunks.read(healed) == raws[healed]
    assert {f.name for f in store.verifier().run().findings} == {in_use}
