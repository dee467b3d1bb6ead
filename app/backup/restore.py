"""Restore a backup into an empty place: everything is read and hashed before a server may use it.

The place is marked in the database from the first row to the last check, so that a restore that ends in the middle
leaves nothing that a server would serve; the next one begins anew there.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import ormsgpack
from sqlalchemy.exc import SQLAlchemyError

from app.backends.blobs import BlobFiles
from app.backup.create import KEYS
from app.backup.packs import Kind, PackEntry, PackReference, object_name
from app.backup.repository import Repository, Snapshot, TableContent
from app.errors import Conflict, Damaged
from app.store import schema
from app.store.backup_source import PART_BYTES
from app.store.backup_target import BackupTarget, next_epoch
from app.store.blob_rows import BlobRow
from app.store.encode import decompress
from app.store.verify import Finding, VerifyResult

_FILE: Final = re.compile(r"[0-9a-f]{2}/[0-9a-f]{64}(\.[0-9a-z]+){0,2}|packs/[0-9a-f]{64}")
"""Pattern of keys of stored files: nothing else is written, whatever a pack says."""

BATCH_BYTES: Final = 4 * 2**20
MAX_SHOWN: Final = 5


@dataclass(frozen=True, slots=True)
class RestoreResult:
    """What was restored. rows: number of those of tables. verification: of the place; it has only known damage."""

    snapshot: Snapshot
    epoch: int
    rows: int
    verification: VerifyResult


@dataclass(slots=True)
class _Pending:
    """What is read and not stored yet."""

    chunks: dict[bytes, bytes] = field(default_factory=dict)
    files: dict[str, bytes] = field(default_factory=dict)
    rows: list[BlobRow] = field(default_factory=list)
    size: int = 0


class Restorer:
    """One restore of a backup.

    Args:
        verify: checks all that is stored in the place.
        place_keys: puts documents with keys into their place, before the place is complete.
        scratch: folder for temporary files, with room for the rows of tables and for the largest stored files.
        progress: called with the numbers of bytes that were read.
    """

    def __init__(
        self,
        repository: Repository,
        target: BackupTarget,
        files: BlobFiles,
        *,
        verify: Callable[[], VerifyResult],
        place_keys: Callable[[Mapping[str, bytes]], None],
        scratch: Path,
        progress: Callable[[int], None] = lambda size: None,
    ) -> None:
        self._repository, self._target, self._files = repository, target, files
        self._verify, self._place_keys = verify, place_keys
        self._scratch, self._progress = scratch, progress
        self._pending = _Pending()
        self._wanted: set[bytes] = set()
        self._segments: set[bytes] = set()
        self._present: set[str] = set()
        self._open: dict[str, set[int]] = {}

    def run(self, snapshot: Snapshot) -> RestoreResult:
        """Restore a backup that ``check_complete`` passed. Raises Conflict if the place is not empty; Damaged."""
        self._target.check_empty(snapshot.revision)
        self._target.begin(snapshot.revision)
        self._wanted = {bytes.fromhex(name) for table in snapshot.tables for name in table.segments}
        for pack in snapshot.packs:
            self._read_pack(pack)
        self._flush()
        self._finish_files()
        self._target.remove_blob_rows(self._present)
        rows = self._write_tables(snapshot.tables)
        self._target.upgrade()
        verification = self._verify()
        problem = unexpected(verification.findings, snapshot)
        if problem is not None:
            raise Damaged(f"the restored data are not intact, and no server will use them: {problem}")
        epoch = next_epoch(snapshot.epoch)
        self._target.complete(epoch)
        return RestoreResult(snapshot, epoch, rows, verification)

    # --- content ---

    def _read_pack(self, pack: PackReference) -> None:
        for entry in self._repository.read_pack(pack):
            self._take(entry)
            if self._pending.size >= BATCH_BYTES:
                self._flush()
        self._progress(pack.size)

    def _take(self, entry: PackEntry) -> None:
        pending = self._pending
        pending.size += len(entry.data) + len(entry.name)
        if entry.kind is Kind.CHUNK:
            pending.chunks[entry.name] = entry.data
        elif entry.kind is Kind.BLOB:
            pending.rows.append(_blob_row(entry.name))
        elif entry.kind is Kind.PART:
            file, _, number = entry.name.decode("ascii", "replace").rpartition("#")
            count = int.from_bytes(entry.data[:4], "big")
            if not _FILE.fullmatch(file) or not number.isdecimal() or int(number) >= count:
                raise Damaged(f"a pack of the backup has a file with the invalid name {file[:80]!r}")
            self._take_part(file, int(number), count, entry.data[4:])
        else:
            name = object_name(self._repository.key, Kind.SEGMENT, entry.name)
            if name in self._wanted:
                (self._scratch / name.hex()).write_bytes(entry.data)
                self._segments.add(name)

    def _take_part(self, file: str, number: int, count: int, data: bytes) -> None:
        if count == 1:
            self._pending.files[file] = data
            return
        if file in self._present:  # another pack has parts of it as well: alone they would replace the whole file
            return
        path = self._scratch / file.replace("/", "-")
        with path.open("r+b" if path.exists() else "w+b") as out:
            out.seek(number * PART_BYTES)
            out.write(data)
        numbers = self._open.setdefault(file, set())
        numbers.add(number)
        if len(numbers) == count:
            self._finish_file(file)

    def _finish_file(self, file: str) -> None:
        del self._open[file]
        self._files.write({file: self._scratch / file.replace("/", "-")})
        (self._scratch / file.replace("/", "-")).unlink(missing_ok=True)
        self._present.add(file)

    def _finish_files(self) -> None:
        """Store files of which a part is missing, too: what they have of blobs is checked with these."""
        for file in list(self._open):
            self._finish_file(file)

    def _flush(self) -> None:
        pending, self._pending = self._pending, _Pending()
        if pending.files:
            self._files.write(pending.files)
            self._present.update(pending.files)
        if pending.chunks:
            self._target.write_chunks(pending.chunks)
        if pending.rows:
            self._target.write_blob_rows(pending.rows)

    # --- tables ---

    def _write_tables(self, contents: Sequence[TableContent]) -> int:
        """Store the rows of tables, in the order of the backup, which has referenced ones first."""
        missing = self._wanted - self._segments
        if missing:
            raise Damaged(f"the backup is not complete: {len(missing)} parts of its tables are missing")
        count = 0
        for content in contents:
            paths = [self._scratch / name for name in content.segments]
            if content.name == KEYS:
                self._place_keys(dict(ormsgpack.unpackb(decompress(paths[0].read_bytes()))))
                continue
            try:
                rows = self._target.write_table(content.name, content.columns, (path.read_bytes() for path in paths))
            except SQLAlchemyError as error:
                raise Damaged(
                    f"rows of the table {content.name} cannot be restored ({type(error).__name__})"
                ) from error
            if rows != content.rows:
                raise Damaged(f"the backup has {rows} rows of the table {content.name} instead of {content.rows}")
            count += rows
        return count


def _blob_row(packed: bytes) -> BlobRow:
    """Read a blob's row. Raises Damaged."""
    try:
        row = BlobRow(*ormsgpack.unpackb(packed))
    except (ValueError, TypeError) as error:
        raise Damaged(f"a pack of the backup has an invalid row of a file ({type(error).__name__})") from error
    if not _FILE.fullmatch(row.key):
        raise Damaged(f"a pack of the backup has a file with the invalid name {row.key[:80]!r}")
    return row


def check_release(snapshot: Snapshot) -> None:
    """Raise Conflict for a backup of a newer release."""
    if snapshot.revision > schema.newest():
        raise Conflict(
            f"the backup was written by release {snapshot.release}, whose schema {snapshot.revision} is newer than "
            f"{schema.newest()} of this release: restore with that release or a newer one"
        )


def check_complete(repository: Repository, snapshot: Snapshot) -> None:
    """Raise Damaged if a pack of a backup is missing or has another size."""
    sizes = {file.key: file.size for file in repository.files.list("packs/")}
    for pack in snapshot.packs:
        size = sizes.get(pack.key)
        if size != pack.size:
            fault = "is missing" if size is None else f"has {size} of {pack.size} bytes"
            raise Damaged(f"backup {snapshot.id} is not complete: the pack {pack.name[:16]}… {fault}")


def unexpected(findings: Sequence[Finding], snapshot: Snapshot) -> str | None:
    """Return the damage that the backup does not have from the store already, None if there is none."""
    rest = [f for f in findings if f.name not in snapshot.damaged and not _comes_of(f, snapshot)]
    if not rest:
        return None
    shown = "; ".join(f"{f.kind} {f.name[:16]} {f.problem}" for f in rest[:MAX_SHOWN])
    return f"{shown}{f' and {len(rest) - MAX_SHOWN} more' if len(rest) > MAX_SHOWN else ''}"


def _comes_of(finding: Finding, snapshot: Snapshot) -> bool:
    """Whether a blob is lost since its file was damaged or lost when the backup was written."""
    return finding.kind == "blob" and any(name.rpartition("/")[2][:64] == finding.name for name in snapshot.damaged)
