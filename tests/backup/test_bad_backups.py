"""Backups that are cut off, altered, newer, or of another server; places that are not empty; work that was killed."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import ormsgpack
import pytest

from app.backup.packs import Kind, object_name, part_name
from app.backup.repository import Repository, Snapshot
from app.backup.service import opened_place, verify_place
from app.errors import Conflict, Damaged, Invalid, Unavailable
from app.store import schema
from app.store.backup_target import BackupTarget
from app.store.encode import compress, decompress, digest
from app.store.store import Store
from tests.backup.conftest import NewStore, Rows, back_up, fill, restore_into, rows_of
from tests.store.samples import GRID
from tests.store.test_verify import spoil_chunk

Spoil = Callable[[Path], None]


def largest_pack(place: Path) -> Path:
    return max(place.glob("packs/*/*"), key=lambda path: path.stat().st_size)


def manifest(place: Path) -> Path:
    return next(place.glob("snapshots/*.json"))


def cut_pack(place: Path) -> None:
    path = largest_pack(place)
    path.write_bytes(path.read_bytes()[:-1])


def alter_pack(place: Path) -> None:
    content = bytearray(largest_pack(place).read_bytes())
    content[len(content) // 2] ^= 1
    largest_pack(place).write_bytes(bytes(content))


def cut_manifest(place: Path) -> None:
    manifest(place).write_bytes(manifest(place).read_bytes()[:-50])


def alter_manifest(place: Path) -> None:
    head, body, *_ = manifest(place).read_bytes().split(b"\n")
    members = json.loads(body)
    members["epoch"] += 1
    manifest(place).write_bytes(head + b"\n" + json.dumps(members, separators=(",", ":")).encode() + b"\n")


def rename_manifest(place: Path) -> None:
    manifest(place).rename(place / "snapshots" / "20990101T000000Z-00000000.json")


def newer_form(place: Path) -> None:
    path = place / "fleetmap-backup.json"
    path.write_text(path.read_text().replace('"format": 1', '"format": 2'))


def newer_manifest(place: Path) -> None:
    manifest(place).write_bytes(manifest(place).read_bytes().replace(b'"format": 1', b'"format": 2', 1))


SPOILT = {
    "cut pack": (cut_pack, Damaged, "not complete: the pack"),
    "lost pack": (lambda place: largest_pack(place).unlink(), Damaged, "is missing"),
    "altered pack": (alter_pack, Damaged, "does not match its hash"),
    "cut manifest": (cut_manifest, Damaged, "cut off or was altered"),
    "altered manifest": (alter_manifest, Damaged, "cut off or was altered"),
    "renamed manifest": (rename_manifest, Damaged, "is that of"),
    "lost manifest": (lambda place: manifest(place).unlink(), Damaged, "cut off .* another copy"),
    "cut description": (lambda place: (place / "fleetmap-backup.json").write_text("{"), Damaged, "cut off"),
    "lost description": (lambda place: (place / "fleetmap-backup.json").unlink(), Invalid, "has no backups"),
    "newer form": (newer_form, Conflict, "newer one"),
    "newer manifest": (newer_manifest, Conflict, "newer one"),
}


@pytest.fixture(scope="module")
def finished_backup(migrated_file: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Rows]:
    """A place with one backup, which tests copy, and the rows that are in it."""
    folder = tmp_path_factory.mktemp("finished")
    shutil.copyfile(migrated_file, folder / "one.sqlite3")
    with closing(Store(f"sqlite:///{folder / 'one.sqlite3'}", folder / "blobs")) as store:
        store.migrate()
        fill(store)
        back_up(store, folder / "backup", folder / "data")
        return folder / "backup", rows_of(store)


@pytest.mark.parametrize("case", SPOILT)
def test_spoilt_backup_is_refused_and_nothing_served(
    case: str, finished_backup: tuple[Path, Rows], tmp_path: Path, empty_store: NewStore
) -> None:
    spoil, kind, text = SPOILT[case]
    place = shutil.copytree(finished_backup[0], tmp_path / "backup")
    spoil(place)
    target = empty_store()
    with pytest.raises(kind, match=text):
        restore_into(target, place, tmp_path / "other")
    with pytest.raises(Unavailable):
        target.check()
    if kind is Damaged and "description" not in case and case != "lost manifest":
        with opened_place(str(place), tmp_path, key=lambda _: None) as repository:
            assert verify_place(repository).problems


def test_altered_pack_is_refused_where_it_can_no_longer_be_served(
    store: Store, tmp_path: Path, empty_store: NewStore
) -> None:
    """The middle of a restore: the database is there, and stays marked."""
    place = tmp_path / "backup"
    back_up(store, place, tmp_path / "data")
    shutil.copytree(place, tmp_path / "intact")
    alter_pack(place)
    target = empty_store()
    with pytest.raises(Damaged, match="does not match its hash"):
        restore_into(target, place, tmp_path / "other")
    for refused in (target.check, target.migrate):
        with pytest.raises(Unavailable, match="being restored into this database"):
            refused()
    restore_into(target, tmp_path / "intact", tmp_path / "other")
    target.check()
    assert rows_of(target) == rows_of(store)


def test_backup_of_a_newer_release_is_refused(
    store: Store, tmp_path: Path, empty_store: NewStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    back_up(store, tmp_path / "backup", tmp_path / "data")
    older = f"{int(schema.newest()) - 1:04}"
    target = empty_store()
    monkeypatch.setattr(schema, "newest", lambda: older)
    with pytest.raises(Conflict, match="newer than"):
        restore_into(target, tmp_path / "backup", tmp_path / "other")
    assert schema.present_revision(target._database) is None


def test_database_of_another_release_is_not_backed_up(
    sqlite_store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.store.backup_source.newest", lambda: "9999")
    with pytest.raises(Unavailable, match="this release backs up schema 9999"):
        back_up(sqlite_store, tmp_path / "backup", tmp_path / "data")


def test_backup_of_an_older_release_is_migrated(
    store: Store, tmp_path: Path, empty_store: NewStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Columns and tables that the newer release added are absent in the backup."""
    older = "0020"
    added = {"mirror", "delegation", "edge_change", "version_tag", "webhook", "webhook_lag"}
    columns = {
        "environment": {"centre", "centre_epoch", "edge_sequence"},
        "version": {"thinned", "thinned_rule", "linked"},
        "source": {"removed"},
        "collection": {"thinned"},
    }
    snapshot = back_up(store, tmp_path / "backup", tmp_path / "data").snapshot
    expected = rows_of(store)
    target = empty_store()
    real = BackupTarget.write_table

    def write_table(self: BackupTarget, name: str, names: object, segments: object) -> int:
        assert name not in added
        return real(self, name, names, segments)  # type: ignore[arg-type]

    monkeypatch.setattr(BackupTarget, "write_table", write_table)
    with opened_place(str(tmp_path / "backup"), tmp_path, key=lambda _: None) as repository:
        old = older_snapshot(repository, snapshot, older, added, columns)
        repository.remove_snapshots([snapshot.id])
        repository.write_snapshot(old)
    restore_into(target, tmp_path / "backup", tmp_path / "other")
    target.check()
    assert {n: r for n, r in rows_of(target).items() if n not in added} == {
        n: r for n, r in expected.items() if n not in added
    }


def older_snapshot(
    repository: Repository, snapshot: Snapshot, revision: str, tables: set[str], columns: dict[str, set[str]]
) -> Snapshot:
    """Write a manifest as an older release would have, with rows without the new columns, by table."""
    entries = {
        object_name(repository.key, Kind.SEGMENT, e.name).hex(): e.data
        for pack in snapshot.packs
        for e in repository.read_pack(pack)
        if e.kind is Kind.SEGMENT
    }
    writer = repository.writer()
    older = []
    for table in snapshot.tables:
        if table.name in tables:
            continue
        kept = [k for k, name in enumerate(table.columns) if name not in columns.get(table.name, ())]
        rows = [row for name in table.segments for row in ormsgpack.unpackb(decompress(entries[name]))]
        if table.name in columns and rows:
            segment = ormsgpack.packb([[row[k] for k in kept] for row in rows])
            writer.add(Kind.SEGMENT, digest(segment), compress(segment))
            segments = (object_name(repository.key, Kind.SEGMENT, digest(segment)).hex(),)
            table = dataclasses.replace(table, segments=segments)
        older.append(dataclasses.replace(table, columns=tuple(table.columns[k] for k in kept)))
    writer.flush()
    packs = (*snapshot.packs, *writer.packs)
    return dataclasses.replace(snapshot, revision=revision, tables=tuple(older), packs=packs)


def test_forged_pack_writes_nothing_elsewhere(
    finished_backup: tuple[Path, Rows], tmp_path: Path, empty_store: NewStore
) -> None:
    """Who may write to a place that is not encrypted can make a manifest that fits."""
    place = shutil.copytree(finished_backup[0], tmp_path / "backup")
    with opened_place(str(place), tmp_path, key=lambda _: None) as repository:
        (snapshot,) = repository.snapshots().intact
        for number, file in enumerate(("../../../escaped", "/tmp/escaped", "ab/../../escaped")):
            writer = repository.writer()
            writer.add(Kind.PART, part_name(file, 0), (1).to_bytes(4, "big") + b"evil")
            writer.flush()
            forged = dataclasses.replace(snapshot, id=f"2099010{number + 1}T000000Z-00000000")
            repository.write_snapshot(dataclasses.replace(forged, packs=(*snapshot.packs, *writer.packs)))
            with pytest.raises(Damaged, match="invalid name"):
                restore_into(empty_store(), place, tmp_path / "other", forged.id)
        foreign = dataclasses.replace(snapshot.tables[0], name="session")
        repository.write_snapshot(
            dataclasses.replace(snapshot, id="20990109T000000Z-00000000", tables=(*snapshot.tables, foreign))
        )
    with pytest.raises(Damaged, match="no backup contains"):
        restore_into(empty_store(), place, tmp_path / "other", "20990109")
    assert not list(tmp_path.rglob("escaped"))


# --- places that are not empty ---


def test_restore_onto_data_is_refused(store: Store, tmp_path: Path, empty_store: NewStore) -> None:
    place = tmp_path / "backup"
    back_up(store, place, tmp_path / "data")
    before = rows_of(store)
    with pytest.raises(Conflict, match="the database has data already"):
        restore_into(store, place, tmp_path / "other")
    store.check()
    assert rows_of(store) == before
    target = empty_store()
    target.blobs.prepare()
    (target.blob_dir / "ab").mkdir()
    (target.blob_dir / "ab" / ("ab" * 32)).write_bytes(b"a file")
    with pytest.raises(Conflict, match="has files already"):
        restore_into(target, place, tmp_path / "other")
    migrated = empty_store()
    migrated.migrate()
    restore_into(migrated, place, tmp_path / "other")  # as `fleetmap migrate` leaves it
    assert rows_of(migrated) == before


def test_place_of_another_server_is_refused(sqlite_store: Store, tmp_path: Path, migrated_file: Path) -> None:
    place = tmp_path / "backup"
    back_up(sqlite_store, place, tmp_path / "data")
    shutil.copyfile(migrated_file, tmp_path / "third.sqlite3")
    with closing(Store(f"sqlite:///{tmp_path / 'third.sqlite3'}", tmp_path / "third")) as third:
        third.migrate()
        with pytest.raises(Conflict, match="of another server"):
            back_up(third, place, tmp_path / "third")
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "letter.txt").write_text("private")
    with pytest.raises(Conflict, match="has other files"):
        back_up(sqlite_store, tmp_path / "home", tmp_path / "data")
    for folder in ("tmp", "packs"):  # what a first backup leaves that is killed at once
        (tmp_path / "killed" / folder).mkdir(parents=True)
    back_up(sqlite_store, tmp_path / "killed", tmp_path / "data")
    with pytest.raises(Invalid, match="unsupported place"):
        back_up(sqlite_store, "ftp://host/place", tmp_path / "data")


# --- damage and interruptions ---


def test_damaged_store_is_backed_up_as_far_as_it_is_intact(store: Store, tmp_path: Path, empty_store: NewStore) -> None:
    entry = store.versions.get("farm", 1).part(GRID)
    assert entry is not None
    spoil_chunk(store, entry.hash)
    name = store.versions.get("farm", 1).sources[0].sha256
    path = store.blobs.path(name)
    assert path is not None
    path.write_bytes(b"something else")
    result = back_up(store, tmp_path / "backup", tmp_path / "data")
    assert {entry.hash, name} <= set(result.snapshot.damaged)
    target = empty_store()
    restored = restore_into(target, tmp_path / "backup", tmp_path / "other")
    assert {f.name for f in restored.verification.findings} == {entry.hash, name}
    assert target.versions.get("farm").root == store.versions.get("farm").root


def test_interrupted_backup_goes_on(
    sqlite_store: Store, tmp_path: Path, empty_store: NewStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "backup"
    with monkeypatch.context() as patch:
        patch.setattr(Repository, "write_snapshot", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            back_up(sqlite_store, place, tmp_path / "data")
    with pytest.raises(Damaged, match="no complete backup"):
        restore_into(empty_store(), place, tmp_path / "other")
    result = back_up(sqlite_store, place, tmp_path / "data")
    assert result.snapshot.written == 0, "what was written is used"
    target = empty_store()
    restore_into(target, place, tmp_path / "another")
    assert rows_of(target) == rows_of(sqlite_store)


def test_lost_and_cut_packs_are_written_again(sqlite_store: Store, tmp_path: Path, empty_store: NewStore) -> None:
    place = tmp_path / "backup"
    back_up(sqlite_store, place, tmp_path / "data")
    cut_pack(place)
    index = place / "index" / min(path.name for path in place.glob("index/*") if path.name != largest_pack(place).name)
    index.write_bytes(index.read_bytes()[:-1])
    back_up(sqlite_store, place, tmp_path / "data")
    target = empty_store()
    restore_into(target, place, tmp_path / "other")
    assert rows_of(target) == rows_of(sqlite_store)


STEPS = ("begin", "write_chunks", "write_blob_rows", "remove_blob_rows", "write_table", "upgrade", "complete")


@pytest.mark.parametrize("step", STEPS)
def test_interrupted_restore_is_refused_and_repeated(
    step: str,
    finished_backup: tuple[Path, Rows],
    tmp_path: Path,
    empty_store: NewStore,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    place, rows = finished_backup
    target = empty_store()
    interrupt(step, target, place, tmp_path, monkeypatch)
    with pytest.raises(Unavailable, match="being restored"):
        target.initialise()
    restore_into(target, place, tmp_path / "other")
    target.check()
    assert rows_of(target) == rows
    assert target.verifier().run().findings == []


def test_interrupted_restore_on_any_database(
    store: Store, tmp_path: Path, empty_store: NewStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    back_up(store, tmp_path / "backup", tmp_path / "data")
    target = empty_store()
    for step in ("write_table", "complete"):
        interrupt(step, target, tmp_path / "backup", tmp_path, monkeypatch)
        with pytest.raises(Unavailable, match="being restored"):
            target.check()
    restore_into(target, tmp_path / "backup", tmp_path / "other")
    assert rows_of(target) == rows_of(store)


def interrupt(step: str, target: Store, place: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Restore until a step: after it if it can be repeated, else before it."""
    real = getattr(BackupTarget, step)

    def killed(*args: object) -> None:
        if step not in ("complete", "upgrade"):
            real(*args)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(BackupTarget, step, killed)
        with pytest.raises(KeyboardInterrupt):
            restore_into(target, place, folder / "other")


def test_raised_epoch_is_higher_than_after_an_earlier_restore(store: Store) -> None:
    first = store.raise_epoch()
    assert first > 1_000_000_000
    assert store.raise_epoch() > first
    assert store.epoch() > first
