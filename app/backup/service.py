"""Backups and restores of one server's store: opens places, holds off garbage collection, records the outcome."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from app.backends.archive_file import ArchiveFiles
from app.backends.blobs import BlobFiles
from app.backends.destinations import is_foreign, open_destination, shown
from app.backends.lead import LeadLostError, Leads
from app.backup.check import PlaceCheck, check_place
from app.backup.create import BackupWriter, KeyBundle
from app.backup.pace import Pace, current_times
from app.backup.repository import Repository, Snapshot, choose, finish, read_description
from app.backup.restore import Restorer, RestoreResult, check_complete, check_release
from app.backup.retention import KeepRule
from app.errors import Conflict, FleetMapError, Invalid, Unavailable
from app.store.backups import BackupRecord
from app.store.garbage_collection import CONTENT_LEAD
from app.store.store import Store

WAIT_SECONDS: Final = 60.0
"""Time that a backup waits for the end of a garbage collection or of another backup."""

Progress = Callable[[int], None]


@dataclass(frozen=True, slots=True)
class BackupOptions:
    """Options of a backup. recipients: of age. identities: to take over an encrypted place. keep: which ones stay."""

    recipients: tuple[str, ...] = ()
    identities: tuple[str, ...] = ()
    keep: KeepRule | None = None


@dataclass(frozen=True, slots=True)
class BackupResult:
    """A backup that was written. removed: ids of backups that went by the rule; freed: bytes of their packs."""

    snapshot: Snapshot
    place: str
    removed: tuple[str, ...]
    freed: int


class BackupService:
    """Backups of one store.

    Args:
        leads: of this server; garbage collection of all servers is held off through them.
        wait_seconds: time to wait for a garbage collection or another backup.
    """

    def __init__(self, store: Store, leads: Leads, *, wait_seconds: float = WAIT_SECONDS) -> None:
        self._store, self._leads, self._wait_seconds = store, leads, wait_seconds

    def back_up(
        self, place: str, keys: KeyBundle, options: BackupOptions, progress: Progress = lambda size: None
    ) -> BackupResult:
        """Write a backup to a place, and record it. A failure is recorded as well.

        Raises Invalid, Conflict (the place is another server's, or a backup runs), Unavailable, Damaged.
        """
        started = time.monotonic()
        self._store.backup_source.check()
        try:
            result = self._write(place, keys, options, progress)
        except FleetMapError as error:
            if not isinstance(error, Invalid):
                with contextlib.suppress(FleetMapError):
                    self._store.backups.note_failure(datetime.now(UTC), error.detail)
            raise
        snapshot = result.snapshot
        record = BackupRecord(
            finished=snapshot.finished,
            destination=result.place,
            snapshot=snapshot.id,
            size=snapshot.size,
            written=snapshot.written,
            seconds=round(time.monotonic() - started, 3),
        )
        self._store.backups.note_success(record)
        return result

    def _write(self, place: str, keys: KeyBundle, options: BackupOptions, progress: Progress) -> BackupResult:
        source = self._store.backup_source
        pace = Pace(lambda: current_times(source.served))

        def advance(size: int) -> None:
            progress(size)
            pace.rest()

        with self._content_held() as guard, self._store.blobs.files.workspace() as scratch:
            files = open_destination(place, scratch, new=True)
            try:
                repository = self._repository(place, files, options)
                writer = BackupWriter(source, repository, keys, guard=guard, scratch=scratch, progress=advance)
                snapshot = writer.run()
                finish(files)
            except BaseException:
                if isinstance(files, ArchiveFiles):
                    files.discard()
                raise
            removed, freed = self._remove_outdated(repository, options.keep, guard)
        return BackupResult(snapshot, shown(place), removed, freed)

    def _repository(self, place: str, files: BlobFiles, options: BackupOptions) -> Repository:
        """Open the place of this server, or begin one in an empty place."""
        backups = self._store.backups
        description = None if isinstance(files, ArchiveFiles) else read_description(files)
        if description is None:
            if not isinstance(files, ArchiveFiles) and (is_foreign(place) or next(files.list(), None) is not None):
                raise Conflict(f"{shown(place)} has other files, but no backups: use an empty place")
            repository = Repository.create(files, options.recipients)
            if not isinstance(files, ArchiveFiles):
                backups.add_place(repository.id, repository.key, repository.age.recipients)
            return repository
        own_place = backups.place(description.id)
        if own_place is None and not options.identities:
            raise Conflict(
                f"{shown(place)} has backups of another server, or this one lost its record of them: use another place"
            )
        recipients = description.recipients if own_place is None else own_place.recipients
        if set(recipients) != set(description.recipients) or (
            options.recipients and set(options.recipients) != set(recipients)
        ):
            raise Conflict(
                f"{shown(place)} has backups that are {_encrypted_to(recipients)}: use the same recipients, or another "
                "place"
            )
        key = None if own_place is None else own_place.key
        opened = Repository.open(files, key=key, identities=options.identities)
        if opened is None:
            raise Unavailable(f"{shown(place)} was removed meanwhile")
        if own_place is None:
            backups.add_place(opened.id, opened.key, opened.age.recipients)
        return opened

    def _remove_outdated(
        self, repository: Repository, keep: KeepRule | None, guard: Callable[[], None]
    ) -> tuple[tuple[str, ...], int]:
        """Remove the backups that the rule does not keep, then packs that no backup needs, not even a running one."""
        if isinstance(repository.files, ArchiveFiles):
            return (), 0
        listed = repository.snapshots()
        outdated = [] if keep is None else keep.outdated(listed.intact)
        gone = {snapshot.id for snapshot in outdated}
        repository.remove_snapshots(sorted(gone))
        stay = [snapshot for snapshot in listed.intact if snapshot.id not in gone]
        guard()
        freed = 0 if listed.broken else repository.remove_unused_packs(stay)
        return tuple(sorted(gone)), freed

    @contextlib.contextmanager
    def _content_held(self) -> Iterator[Callable[[], None]]:
        """Hold off garbage collection and other backups; the function raises Unavailable if that was lost."""
        lead = self._leads.lead(CONTENT_LEAD)
        first = lead.acquire(self._wait_seconds)
        if first is None:
            raise Conflict("another backup or a garbage collection is running: try again later")

        def guard() -> None:
            """A backup takes hours, in which its process may stand still: it goes on if nobody else led meanwhile."""
            if first.goes_on:
                return
            if lead.acquire(self._wait_seconds) is None or lead.unbroken_since > first.number:
                raise LeadLostError(
                    "the connection to the database was lost, and content could have been removed meanwhile: the "
                    "backup was given up, run it again"
                )

        try:
            yield guard
        finally:
            lead.release()


def _encrypted_to(recipients: Sequence[str]) -> str:
    return f"encrypted to {', '.join(recipients)}" if recipients else "not encrypted"


@contextlib.contextmanager
def opened_place(
    place: str, scratch: Path, *, key: Callable[[str], bytes | None], identities: Sequence[str] = ()
) -> Iterator[Repository]:
    """Open a place of backups for reading. key: returns the key of a place that this server knows, by its id.

    Raises Invalid if there are no backups, Damaged, Conflict for a newer form, Unavailable.
    """
    files = open_destination(place, scratch, new=False)
    try:
        description = read_description(files)
        repository = None
        if description is not None:
            repository = Repository.open(files, key=key(description.id), identities=identities)
        if repository is None:
            raise Invalid(f"{shown(place)} has no backups: fleetmap-backup.json is missing")
        yield repository
    finally:
        if isinstance(files, ArchiveFiles):
            files.close()


def verify_place(repository: Repository, progress: Progress = lambda size: None) -> PlaceCheck:
    """Read and hash everything in a place."""
    return check_place(repository, repository.snapshots(), progress)


def choose_restorable(repository: Repository, snapshot_id: str | None) -> Snapshot:
    """Choose a backup, before anything is created for it.

    snapshot_id: begin of its id; None: the newest. Raises Invalid, Conflict for a backup of a newer release; Damaged if
    it is cut off or altered.
    """
    snapshot = choose(repository.snapshots(), snapshot_id)
    check_release(snapshot)
    check_complete(repository, snapshot)
    return snapshot


def restore(
    store: Store,
    repository: Repository,
    snapshot: Snapshot,
    *,
    present_keys: Sequence[str],
    place_keys: Callable[[Mapping[str, bytes]], None],
    progress: Progress = lambda size: None,
) -> RestoreResult:
    """Restore a backup into an empty store.

    Args:
        snapshot: from ``choose_restorable``.
        present_keys: ids of the signing keys that the place has already, newest first.
        place_keys: puts documents with keys into their place.

    Raises Conflict if the place is not empty or the backup is of another server; Damaged if it is altered; Unavailable.
    """
    if present_keys and snapshot.key_ids and not set(present_keys) & set(snapshot.key_ids):
        raise Conflict(
            f"the backup is of another server: its signing key is {snapshot.key_ids[0]}, this place has "
            f"{present_keys[0]}: move the keys of this place away, or use the backup of its server"
        )
    store.blobs.prepare()
    with store.blobs.files.workspace() as scratch:
        restorer = Restorer(
            repository,
            store.backup_target,
            store.blobs.files,
            verify=lambda: store.verifier().run(),
            place_keys=lambda documents: None if present_keys else place_keys(documents),
            scratch=scratch,
            progress=progress,
        )
        result = restorer.run(snapshot)
    if not isinstance(repository.files, ArchiveFiles):
        store.backups.add_place(repository.id, repository.key, repository.age.recipients)
    return result
