"""Backup and restore of a store: what comes back, what it costs, with keys, encrypted, in every kind of place."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import threading
from collections.abc import Iterable, Iterator
from contextlib import closing
from datetime import UTC, datetime, timedelta, tzinfo
from pathlib import Path
from typing import Self

import numpy as np
import pytest

from app.backends.blob_s3 import S3Files
from app.backends.documents import FileDocument
from app.backends.lead import LeadLostError, LocalLead, open_leads
from app.backup.keys import collect_keys, key_documents
from app.backup.packs import Kind
from app.backup.repository import Snapshot
from app.backup.retention import parse_rule
from app.backup.service import opened_place, verify_place
from app.errors import Conflict, Damaged, Invalid
from app.signing import Keys, SharedKeys, SigningKeys
from app.store.backup_source import PART_BYTES, BackupSource
from app.store.blob_rows import BlobRow
from app.store.garbage_collection import CONTENT_LEAD
from app.store.store import Store
from tests.backup.conftest import NewStore, back_up, fill, restore_into, rows_of
from tests.events.conftest import eventually
from tests.postgres import Cluster
from tests.store.samples import GRID, grid, replaces, save


def size_of(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def test_restored_store_is_the_backed_up_one(store: Store, tmp_path: Path, empty_store: NewStore) -> None:
    result = back_up(store, tmp_path / "backup", tmp_path / "data")
    assert result.snapshot.damaged == ()
    assert (store.backup_source.served > 0) == store.database_url.startswith("postgres")
    expected = rows_of(store)
    save(store, "farm", *replaces({GRID: grid(seed=6)}))
    target = empty_store()
    restored = restore_into(target, tmp_path / "backup", tmp_path / "other")
    assert rows_of(target) == expected
    assert restored.verification.findings == []
    assert target.epoch() > store.epoch()
    target.check()
    for number in (1, 2):
        version = target.versions.get("farm", number)
        assert version.root == store.versions.get("farm", number).root
        names = [source.sha256 for source in version.sources]
        assert target.blobs.get_many(names) == store.blobs.get_many(names)
    save(target, "farm", *replaces({GRID: grid(seed=7)}))
    assert target.versions.get("farm").number == 3
    target.garbage.collect(timedelta(0))
    assert target.verifier().run().findings == []
    assert [e.name for e in target.environments.page(limit=10)[0]] == ["farm"]


@pytest.mark.postgres
@pytest.mark.parametrize("to_postgres", [True, False])
def test_backup_of_one_database_is_restored_into_the_other(
    sqlite_store: Store, tmp_path: Path, postgres_cluster: Cluster, migrated_database: str, to_postgres: bool
) -> None:
    names = [postgres_cluster.create_database(migrated_database), postgres_cluster.create_database()]
    url = postgres_cluster.url(names[1] if to_postgres else names[0])
    with closing(Store(url, tmp_path / "shared")) as shared:
        if not to_postgres:
            fill(shared)
        origin = sqlite_store if to_postgres else shared
        with closing(Store(f"sqlite:///{tmp_path / 'new.sqlite3'}", tmp_path / "new")) as new:
            target = shared if to_postgres else new
            back_up(origin, tmp_path / "backup", tmp_path / "data")
            restore_into(target, tmp_path / "backup", tmp_path / "other")
            assert rows_of(target) == rows_of(origin)
            save(target, "farm", *replaces({GRID: grid(seed=7)}))
    for name in names:
        postgres_cluster.drop_database(name)


def test_second_backup_writes_only_the_change(store: Store, tmp_path: Path, empty_store: NewStore) -> None:
    place, data = tmp_path / "backup", tmp_path / "data"
    first = back_up(store, place, data)
    again = back_up(store, place, data)
    assert again.snapshot.written == 0
    before = size_of(place)
    source = store.blobs.put(os.urandom(3 * PART_BYTES // 2))
    save(store, "farm", *replaces({GRID: grid(seed=6)}))
    third = back_up(store, place, data)
    assert 3 * PART_BYTES // 2 < third.snapshot.written <= size_of(place) - before < 1.1 * 3 * PART_BYTES // 2
    target = empty_store()
    restore_into(target, place, tmp_path / "first", first.snapshot.id)
    assert target.versions.get("farm").number == 2
    latest = empty_store()
    restore_into(latest, place, tmp_path / "latest")
    assert latest.versions.get("farm").number == 3
    assert len(latest.blobs.get(source)) == 3 * PART_BYTES // 2


def test_backup_during_writes_is_an_acknowledged_state(store: Store, tmp_path: Path, empty_store: NewStore) -> None:
    stopping = threading.Event()
    acknowledged: list[int] = []

    def write() -> None:
        seed = 10
        while not stopping.is_set():
            acknowledged.append(save(store, "farm", *replaces({GRID: grid(seed=seed)})).number)
            seed += 1

    thread = threading.Thread(target=write)
    thread.start()
    try:
        while len(acknowledged) < 2:
            stopping.wait(0.01)
        before = acknowledged[-1]
        back_up(store, tmp_path / "backup", tmp_path / "data")
    finally:
        stopping.set()
        thread.join()
    target = empty_store()
    restore_into(target, tmp_path / "backup", tmp_path / "other")
    head = target.versions.get("farm").number
    assert before <= head <= acknowledged[-1]
    roots = [target.versions.get("farm", n).root for n in range(1, head + 1)]
    assert roots == [store.versions.get("farm", n).root for n in range(1, head + 1)]


def content_between(low: str, high: str) -> bytes:
    """Make a large content whose SHA-256 begins with one of two digits, like every other one of these."""
    noise = np.random.default_rng(1).bytes(100_000)
    return next(
        data for k in range(10_000) if low <= hashlib.sha256(data := noise + k.to_bytes(4)).hexdigest()[:2] <= high
    )


@pytest.mark.parametrize("is_old_backup", [False, True])
def test_file_stored_during_a_backup_may_have_a_base_that_its_list_has_passed(
    sqlite_store: Store, tmp_path: Path, empty_store: NewStore, monkeypatch: pytest.MonkeyPatch, is_old_backup: bool
) -> None:
    base, patched = content_between("00", "01"), content_between("fe", "ff")
    real = BackupSource.blobs
    lists = 0

    def blobs(self: BackupSource) -> Iterator[list[BlobRow]]:
        nonlocal lists
        lists += 1
        for number, rows in enumerate(real(self)):
            yield rows
            if lists == 2 and number == 0:
                name = sqlite_store.blobs.put(base)
                sqlite_store.blobs.put_many([patched], [name])

    monkeypatch.setattr("app.store.backup_source.READ", 1)
    monkeypatch.setattr(BackupSource, "blobs", blobs)
    if is_old_backup:  # by a release that did not look for bases
        monkeypatch.setattr(BackupSource, "blob_rows", lambda self, names: [])
    back_up(sqlite_store, tmp_path / "backup", tmp_path / "data")
    assert sqlite_store.blobs.rows([hashlib.sha256(patched).hexdigest()]).popitem()[1].base is not None
    target = empty_store()
    restore_into(target, tmp_path / "backup", tmp_path / "other")
    present = target.blobs.rows([hashlib.sha256(data).hexdigest() for data in (base, patched)])
    assert len(present) == (0 if is_old_backup else 2)
    assert target.versions.get("farm").root == sqlite_store.versions.get("farm").root


# --- keys ---


def signing_keys(store: Store, folder: Path) -> SigningKeys:
    return SharedKeys(store.document("keys"), folder / "keys") if store.is_shared else Keys(folder / "keys")


def with_keys(store: Store, folder: Path) -> str:
    """Give a server keys and secrets of links; returns the id of its key."""
    folder.mkdir()
    id_ = signing_keys(store, folder).rotate().id
    links = store.document("links") if store.is_shared else FileDocument(folder / "keys" / "links.json")
    links.update(lambda _: b'{"secret": "of links"}')
    return id_


def test_keys_are_in_a_backup_by_choice(store: Store, tmp_path: Path, empty_store: NewStore) -> None:
    data = tmp_path / "data"
    id_ = with_keys(store, data)
    webhook = store.webhooks.create("https://receiver.example/hook")
    assert not back_up(store, tmp_path / "without", data).snapshot.keys
    bundle = collect_keys(store, data / "keys", None, include=True)
    assert back_up(store, tmp_path / "with", data, keys=bundle).snapshot.keys
    for kind, expected in (("without", False), ("with", True)):
        target, folder = empty_store(), tmp_path / f"place-{kind}"
        restore_into(target, tmp_path / kind, folder)
        documents = key_documents(target, folder / "keys")
        assert sorted(documents) == (["keys", "links"] if expected else [])
        assert (signing_keys(target, folder).public()[0].id == id_) == expected
        assert [one.secret for one in target.webhooks.all()] == ([webhook.secret] if expected else [])
        if not target.is_shared and expected:
            assert {path.stat().st_mode & 0o77 for path in (folder / "keys").iterdir()} == {0}
    with opened_place(str(tmp_path / "without"), tmp_path, key=lambda _: None) as repository:
        entries = [e for p in repository.snapshots().intact[0].packs for e in repository.read_pack(p)]
    for secret in (key_documents(store, data / "keys")["keys"], webhook.secret.encode()):
        assert not any(secret in entry.data for entry in entries)


def test_place_with_keys_of_another_server_is_refused(
    sqlite_store: Store, tmp_path: Path, empty_store: NewStore
) -> None:
    data = tmp_path / "data"
    with_keys(sqlite_store, data)
    bundle = collect_keys(sqlite_store, data / "keys", None, include=True)
    back_up(sqlite_store, tmp_path / "backup", data, keys=bundle)
    Keys(tmp_path / "other" / "keys").public()
    with pytest.raises(Conflict, match="of another server"):
        restore_into(empty_store(), tmp_path / "backup", tmp_path / "other")
    restore_into(empty_store(), tmp_path / "backup", data)  # its own keys stay


# --- encryption ---


@pytest.fixture
def identity() -> tuple[str, str]:
    """A recipient and its identity."""
    try:
        import pyrage
    except ImportError:
        if os.environ.get("CI"):
            raise
        pytest.skip("pyrage is not installed")
    pair = pyrage.x25519.Identity.generate()
    return str(pair.to_public()), str(pair)


def test_encrypted_backup_needs_the_identity(
    sqlite_store: Store, tmp_path: Path, empty_store: NewStore, identity: tuple[str, str]
) -> None:
    recipient, secret = identity
    place, data = tmp_path / "backup", tmp_path / "data"
    back_up(sqlite_store, place, data, recipients=(recipient,))
    sqlite_store.blobs.put(b"top secret" * 10_000)
    second = back_up(sqlite_store, place, data)
    assert second.snapshot.written < 50_000, "the server needs no identity to know what is there"
    for path in place.rglob("*"):
        if path.is_file() and path.parent.parent.name == "packs":
            assert path.read_bytes().startswith(b"age-encryption.org/v1")
    with pytest.raises(Invalid, match="pass the file with the age identity"):
        restore_into(empty_store(), place, tmp_path / "none")
    import pyrage

    with pytest.raises(Invalid, match="for other recipients"):
        restore_into(empty_store(), place, tmp_path / "wrong", identities=(str(pyrage.x25519.Identity.generate()),))
    target = empty_store()
    restore_into(target, place, tmp_path / "right", identities=(secret,))
    assert rows_of(target) == rows_of(sqlite_store)
    assert back_up(target, place, tmp_path / "right").snapshot.written < 50_000, "it goes on in the same place"
    other = str(pyrage.x25519.Identity.generate().to_public())
    with pytest.raises(Conflict, match="encrypted to"):
        back_up(sqlite_store, place, data, recipients=(other,))
    with pytest.raises(Invalid, match="no age recipient"):
        back_up(sqlite_store, tmp_path / "another", data, recipients=("age1nonsense",))


def test_place_whose_recipients_were_changed_is_refused(
    sqlite_store: Store, tmp_path: Path, identity: tuple[str, str]
) -> None:
    place = tmp_path / "backup"
    back_up(sqlite_store, place, tmp_path / "data", recipients=(identity[0],))
    description = place / "fleetmap-backup.json"
    import pyrage

    thief = str(pyrage.x25519.Identity.generate().to_public())
    description.write_text(description.read_text().replace(identity[0], thief))
    with pytest.raises(Conflict, match="same recipients"):
        back_up(sqlite_store, place, tmp_path / "data")


# --- kinds of places ---


def test_single_file_is_complete_or_absent(sqlite_store: Store, tmp_path: Path, empty_store: NewStore) -> None:
    file = tmp_path / "farm.tar"
    back_up(sqlite_store, file, tmp_path / "data")
    assert [path.name for path in tmp_path.glob("farm*")] == ["farm.tar"]
    target = empty_store()
    restore_into(target, file, tmp_path / "other")
    assert rows_of(target) == rows_of(sqlite_store)
    with pytest.raises(Conflict, match="written once"):
        back_up(sqlite_store, file, tmp_path / "data")
    content = file.read_bytes()
    for size in (0, 100, len(content) // 2, len(content) - 12_000):
        file.write_bytes(content[:size])
        with pytest.raises((Damaged, Invalid, Conflict)) as caught:
            restore_into(empty_store(), file, tmp_path / f"cut{size}")
        assert "backup" in str(caught.value)


def test_backup_to_and_from_s3(sqlite_store: Store, tmp_path: Path, s3_url: str, empty_store: NewStore) -> None:
    """The store's files are in S3 as well."""
    files = S3Files(f"{s3_url}/files", tmp_path / "copies")
    with closing(Store(f"sqlite:///{tmp_path / 's3.sqlite3'}", tmp_path / "copies", files=files)) as store:
        store.migrate()
        fill(store)
        result = back_up(store, f"{s3_url}/backup", tmp_path / "data")
        assert back_up(store, f"{s3_url}/backup", tmp_path / "data").snapshot.written == 0
        assert result.place == f"{s3_url}/backup"
        expected = rows_of(store)
    target = empty_store()
    restore_into(target, f"{s3_url}/backup", tmp_path / "other")
    assert rows_of(target) == expected


# --- retention ---


@pytest.fixture
def snapshot(sqlite_store: Store, tmp_path: Path) -> Snapshot:
    return back_up(sqlite_store, tmp_path / "backup", tmp_path / "data").snapshot


NOON = datetime(2030, 6, 15, 12, tzinfo=UTC)
EARLIER = "20200101T000000Z-00000000"


def nightly(snapshot: Snapshot, times: Iterable[datetime]) -> list[Snapshot]:
    """Copy a manifest for each of these times, with a higher position of the log each time."""
    return [
        dataclasses.replace(snapshot, id=f"{time:%Y%m%dT%H%M%SZ}-00000000", started=time, position=number)
        for number, time in enumerate(times)
    ]


@pytest.mark.parametrize(
    ("rule", "expected"),
    [
        ("0d", [0]),
        ("2d", [0, 1, 2]),
        ("1d/4d", [0, 1, 2, 3, 40]),
        ("1d/3d/60d", [0, 1, 2, 3, 40, 200]),
        ("1d/3d/400d", [0, 1, 2, 3, 40, 200, 500]),
    ],
)
def test_rule_keeps_all_then_one_a_day_then_one_a_month(snapshot: Snapshot, rule: str, expected: list[int]) -> None:
    """Days and months without a backup are not counted."""
    ages = [500, 200, 41, 40, 3, 2, 1, 0]
    snapshots = nightly(snapshot, (NOON - timedelta(days=age, hours=-1 if age else 0) for age in ages))
    gone = parse_rule(rule).outdated(snapshots)
    assert [age for age, one in zip(ages, snapshots, strict=True) if one not in gone][::-1] == expected


@pytest.mark.parametrize("leap", [timedelta(days=3650), timedelta(days=-3650)])
@pytest.mark.parametrize("rule", ["7d", "30d", "7d/90d", "7d/90d/2y"])
def test_clock_that_leaps_removes_no_more_than_a_night_does(snapshot: Snapshot, rule: str, leap: timedelta) -> None:
    """Also not after some nights with the wrong clock, and after it is right again."""
    nights = [NOON + timedelta(days=night) for night in range(500)]
    times = [*nights[:480], *(night + leap for night in nights[480:483]), *nights[483:]]
    stay: list[Snapshot] = []
    for number, one in enumerate(nightly(snapshot, times)):
        gone = parse_rule(rule).outdated([*stay, one])
        stay = [other for other in [*stay, one] if other not in gone]
        if number >= 480:
            assert len(gone) <= 1
            assert one in stay
            assert {f"{night:%Y%m%d}" for night in times[number - 7 : number]} <= {other.id[:8] for other in stay}


def test_backup_of_a_clock_ahead_is_not_the_newest(
    sqlite_store: Store, tmp_path: Path, empty_store: NewStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    place, data = tmp_path / "backup", tmp_path / "data"

    class Ahead(datetime):
        @classmethod
        def now(cls, tz: tzinfo | None = None) -> Self:
            return cls(2090, 1, 1, tzinfo=tz)

    with monkeypatch.context() as patch:
        patch.setattr("app.backup.create.datetime", Ahead)
        ahead = back_up(sqlite_store, place, data).snapshot
    save(sqlite_store, "farm", *replaces({GRID: grid(seed=8)}))
    later = back_up(sqlite_store, place, data, keep=parse_rule("1d")).snapshot
    assert later.started < ahead.started
    with opened_place(str(place), tmp_path, key=lambda _: None) as repository:
        assert [one.id for one in repository.snapshots().intact] == [ahead.id, later.id]
        repository.write_snapshot(dataclasses.replace(later, epoch=later.epoch + 1, position=0, id=EARLIER))
        assert repository.snapshots().intact[-1].id == EARLIER, "a restored server counts from a lower position"
        repository.remove_snapshots([EARLIER])
    target = empty_store()
    assert restore_into(target, place, tmp_path / "other").snapshot.id == later.id
    assert target.versions.get("farm").number == 3


@pytest.mark.parametrize("rule", ["", "30", "30d/7d", "1d/2d/3d/4d", "d", "0.5d", "-1d"])
def test_unclear_rules_are_refused(rule: str) -> None:
    with pytest.raises(Invalid, match="--keep"):
        parse_rule(rule)


def test_what_no_backup_needs_is_removed(sqlite_store: Store, tmp_path: Path, empty_store: NewStore) -> None:
    place, data = tmp_path / "backup", tmp_path / "data"
    for _ in range(3):
        sqlite_store.blobs.put(os.urandom(300_000))
        back_up(sqlite_store, place, data)
    full = size_of(place)
    assert sqlite_store.garbage.collect(timedelta(0))["blobs"] == 3, "no version refers to these files"
    result = back_up(sqlite_store, place, data, keep=parse_rule("0d"))
    assert len(result.removed) == 3
    assert result.freed > 600_000
    assert size_of(place) < full - 600_000
    with opened_place(str(place), tmp_path, key=lambda _: None) as repository:
        assert [s.id for s in repository.snapshots().intact] == [result.snapshot.id]
        assert verify_place(repository).problems == ()
    target = empty_store()
    restore_into(target, place, tmp_path / "other")
    assert rows_of(target) == rows_of(sqlite_store)


def test_many_small_packs_are_joined(
    sqlite_store: Store, tmp_path: Path, empty_store: NewStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.backup.create.MANY_PACKS", 4)
    place = tmp_path / "backup"
    counts = []
    for seed in range(20, 26):
        save(sqlite_store, "farm", *replaces({GRID: grid(seed=seed)}))
        counts.append(len(back_up(sqlite_store, place, tmp_path / "data", keep=parse_rule("0d")).snapshot.packs))
    assert max(counts) <= 4 + 2
    target = empty_store()
    restore_into(target, place, tmp_path / "other")
    assert rows_of(target) == rows_of(sqlite_store)


def test_objects_of_packs_that_were_left_are_written_once(
    sqlite_store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Older backups keep the packs, so that the place has these objects twice."""
    monkeypatch.setattr("app.backup.create.MANY_PACKS", 4)
    place, data = tmp_path / "backup", tmp_path / "data"
    for seed in range(20, 25):
        save(sqlite_store, "farm", *replaces({GRID: grid(seed=seed)}))
        back_up(sqlite_store, place, data)
    joined = back_up(sqlite_store, place, data).snapshot
    assert len(joined.packs) <= 4
    for _ in range(4):
        again = back_up(sqlite_store, place, data).snapshot
        assert (again.written, set(again.packs)) == (0, set(joined.packs))


def test_file_whose_parts_are_in_several_packs_is_restored_whole(
    sqlite_store: Store, tmp_path: Path, empty_store: NewStore
) -> None:
    content = os.urandom(5 * PART_BYTES // 2)
    name = sqlite_store.blobs.put(content)
    place = tmp_path / "backup"
    snapshot = back_up(sqlite_store, place, tmp_path / "data").snapshot
    with opened_place(str(place), tmp_path, key=lambda _: None) as repository:
        parts = [e for pack in snapshot.packs for e in repository.read_pack(pack) if e.kind is Kind.PART]
        large = [e for e in parts if e.data[:4] == (3).to_bytes(4, "big")]
        writer = repository.writer()
        for entry in large[:2]:
            writer.add(entry.kind, entry.name, entry.data)
        writer.flush()
        repository.write_snapshot(dataclasses.replace(snapshot, packs=(*snapshot.packs, *writer.packs)))
    target = empty_store()
    restore_into(target, place, tmp_path / "other")
    assert target.blobs.get(name) == content


# --- one at a time, and records ---


def test_backup_and_garbage_collection_exclude_each_other(store: Store, tmp_path: Path) -> None:
    data = tmp_path / "data"
    data.mkdir()
    with closing(open_leads(store.database_url, data)) as leads:
        leads.start()
        lead = leads.lead(CONTENT_LEAD)
        while not lead.try_acquire():
            threading.Event().wait(0.05)
        with pytest.raises(Conflict, match="garbage collection is running"):
            back_up(store, tmp_path / "backup", data, wait=0.1)
    assert store.backups.failures().count == 1
    back_up(store, tmp_path / "backup", data)
    assert store.backups.failures().count == 0


def test_backup_that_lost_its_hold_is_given_up(
    sqlite_store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = sqlite_store.backup_source.chunk_names

    def chunk_names() -> Iterator[list[bytes]]:
        monkeypatch.setattr(LocalLead, "term", None)
        return real()

    monkeypatch.setattr(sqlite_store.backup_source, "chunk_names", chunk_names)
    with pytest.raises(LeadLostError, match="the backup was given up"):
        back_up(sqlite_store, tmp_path / "backup", tmp_path / "data", wait=0.1)
    assert not list((tmp_path / "backup").glob("snapshots/*"))


@pytest.mark.postgres
@pytest.mark.parametrize("database_url", ["postgres"], indirect=True)
@pytest.mark.parametrize("others", [0, 1])
def test_backup_outlives_a_lost_connection_unless_another_process_led_meanwhile(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, others: int
) -> None:
    """As after some seconds in which the process stood still."""
    real = store.backup_source.chunk_names

    def chunk_names() -> Iterator[list[bytes]]:
        monkeypatch.setattr(store.backup_source, "chunk_names", real)
        with store._database.write(upkeep=True) as connection:
            connection.exec_driver_sql("UPDATE lead SET term = term + %s", (others,))
        eventually(end_session)
        eventually(lambda: term() >= 2 + others)
        return real()

    def end_session() -> bool:
        ended = "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = current_database() AND "
        with store._database.read() as connection:
            return connection.exec_driver_sql(ended + "application_name = 'fleetmap lead'").scalars().all() == [True]

    def term() -> int:
        with store._database.read() as connection:
            query = "SELECT term FROM lead WHERE name = %s"
            return int(connection.exec_driver_sql(query, (CONTENT_LEAD,)).scalar_one())

    monkeypatch.setattr(store.backup_source, "chunk_names", chunk_names)
    if others:
        with pytest.raises(LeadLostError, match="the backup was given up"):
            back_up(store, tmp_path / "backup", tmp_path / "data")
        return
    result = back_up(store, tmp_path / "backup", tmp_path / "data")
    assert result.snapshot.damaged == ()
    with opened_place(str(tmp_path / "backup"), tmp_path, key=lambda _: None) as repository:
        assert verify_place(repository).problems == ()


def test_last_backup_is_recorded(store: Store, tmp_path: Path, empty_store: NewStore) -> None:
    assert store.backups.last() is None
    result = back_up(store, tmp_path / "backup", tmp_path / "data")
    record = store.backups.last()
    assert record is not None
    assert (record.snapshot, record.destination) == (result.snapshot.id, str(tmp_path / "backup"))
    assert record.finished == result.snapshot.finished
    assert record.size == result.snapshot.size > 0
    (tmp_path / "full").write_text("a file")
    with pytest.raises(Exception, match="full"):
        back_up(store, tmp_path / "full" / "below", tmp_path / "data")
    failures = store.backups.failures()
    assert failures.count == 1
    assert failures.last is not None
    assert "full" in failures.last[1]
    assert store.backups.last() == record
    target = empty_store()
    restore_into(target, tmp_path / "backup", tmp_path / "other")
    assert target.backups.last() is None, "the restored server has no backup yet"
    assert back_up(target, tmp_path / "backup", tmp_path / "other").snapshot.written < result.snapshot.size / 2
