"""Write a backup: tables from one snapshot, then the content that the place does not have yet, then the manifest."""

from __future__ import annotations

import hashlib
import secrets
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Final, TypeVar

import ormsgpack

from app import __version__
from app.backends.blobs import Unreadable
from app.backup.packs import Kind, ObjectIndex, PackReference, object_name, part_name
from app.backup.repository import Repository, Snapshot, TableContent
from app.store.backup_source import BackupSource, StoreState, number_of_parts, packed_problem, plain_values
from app.store.backup_tables import compressed, dumped_tables, stored_columns
from app.store.blob_rows import BlobRow

KEYS: Final = "keys"
"""Name of the keys among the tables of a manifest; their rows are (name, content)."""

USED_SHARE: Final = 0.5
"""Share of a pack's bytes that are still needed below which these are written again, so that the pack can go."""

SMALL_PACK: Final = 2**20
MANY_PACKS: Final = 64
"""Number of packs below SMALL_PACK bytes from which on they are joined."""

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class KeyBundle:
    """Keys of a server for a backup: documents by name (``keys``, ``links``). ids: of the public keys, newest first."""

    documents: dict[str, bytes]
    ids: tuple[str, ...]


@dataclass(slots=True)
class _Content:
    """What a backup consists of so far. names: of what is damaged in the store."""

    tables: list[TableContent] = field(default_factory=list)
    damaged: list[str] = field(default_factory=list)


class BackupWriter:
    """One backup of a store into a place.

    Args:
        keys: documents with keys to be included, and the ids of the server's keys.
        guard: raises if garbage collection may have begun: then the backup could be incomplete.
        scratch: folder for a temporary file with the rows of tables.
        progress: called with the numbers of bytes that were read.
    """

    def __init__(
        self,
        source: BackupSource,
        repository: Repository,
        keys: KeyBundle,
        *,
        guard: Callable[[], None],
        scratch: Path,
        progress: Callable[[int], None] = lambda size: None,
    ) -> None:
        self._source, self._repository, self._keys = source, repository, keys
        self._guard, self._scratch, self._progress = guard, scratch, progress
        self._index = ObjectIndex((), ())
        self._dropped: frozenset[int] = frozenset()
        self._content = _Content()
        self._new_segments: set[bytes] = set()
        self._writer, self._rows_writer = repository.writer(), repository.writer()

    def run(self) -> Snapshot:
        """Write the backup; returns its manifest. Raises Unavailable if the store or the place fails."""
        started = datetime.now(UTC)
        self._index = self._repository.load_index()
        with (self._scratch / "rows").open("w+b") as spool:
            state, segments = self._read_tables(spool)
            self._note_used(segments)
            self._write_segments(spool, segments)
        self._write_chunks()
        self._write_blobs()
        for writer in (self._writer, self._rows_writer):
            writer.flush()
        self._guard()
        snapshot = self._snapshot(started, state)
        self._repository.write_snapshot(snapshot)
        return snapshot

    # --- tables ---

    def _read_tables(self, spool: IO[bytes]) -> tuple[StoreState, dict[bytes, tuple[int, int]]]:
        """Write the rows of all tables to a file, from one snapshot; returns object name -> (start, bytes)."""
        places: dict[bytes, tuple[int, int]] = {}
        with self._source.snapshot() as connection:
            state = self._source.state(connection)
            for table in dumped_tables(keys=bool(self._keys.documents)):
                count, names = 0, list[str]()
                for number, segment in self._source.segments(connection, table):
                    count += number
                    names.append(self._spool(segment, spool, places).hex())
                columns = tuple(column.name for column in stored_columns(table))
                self._content.tables.append(TableContent(table.name, columns, count, tuple(names)))
        if self._keys.documents:
            segment = ormsgpack.packb(sorted(self._keys.documents.items()))
            name = self._spool(segment, spool, places).hex()
            count = len(self._keys.documents)
            self._content.tables.append(TableContent(KEYS, ("name", "content"), count, (name,)))
        return state, places

    def _spool(self, segment: bytes, spool: IO[bytes], places: dict[bytes, tuple[int, int]]) -> bytes:
        name = object_name(self._repository.key, Kind.SEGMENT, hashlib.sha256(segment).digest())
        if name not in places:
            data = hashlib.sha256(segment).digest() + compressed(segment)
            places[name] = spool.tell(), len(data)
            spool.write(data)
        return name

    def _write_segments(self, spool: IO[bytes], segments: dict[bytes, tuple[int, int]]) -> None:
        for names in _pages(list(segments)):
            for name in self._missing(names, names):
                start, size = segments[name]
                spool.seek(start)
                data = spool.read(size)
                self._rows_writer.add(Kind.SEGMENT, data[:32], data[32:])
                self._progress(size)

    # --- content ---

    def _note_used(self, segments: dict[bytes, tuple[int, int]]) -> None:
        """Find which packs are still worth keeping."""
        key = self._repository.key
        for page in _pages(list(segments)):
            self._index.find(page)
        for names in self._source.chunk_names():
            self._index.find([object_name(key, Kind.CHUNK, name) for name in names])
        for rows in self._source.blobs():
            self._index.find([object_name(key, Kind.BLOB, _packed(row)) for row in rows])
            self._index.find([name for row in rows if row.pack is None for name in self._parts(row.key, row.stored)])
        for pack, size in self._source.pack_sizes().items():
            self._index.find(self._parts(f"packs/{pack}", size))
        shares = self._index.used_shares()
        packs = self._index.packs
        dropped = {number for number, share in enumerate(shares) if share < USED_SHARE}
        small = {number for number, pack in enumerate(packs) if pack.size < SMALL_PACK} - dropped
        self._dropped = frozenset(dropped | (small if len(small) > MANY_PACKS else set()))

    def _parts(self, file: str, size: int) -> list[bytes]:
        key = self._repository.key
        return [object_name(key, Kind.PART, part_name(file, k)) for k in range(number_of_parts(size))]

    def _missing(self, items: Sequence[T], names: Sequence[bytes]) -> list[T]:
        """Return the items whose objects are in no pack that stays."""
        numbers = self._index.find(names)
        return [item for item, pack in zip(items, numbers.tolist(), strict=True) if pack < 0 or pack in self._dropped]

    def _write_chunks(self) -> None:
        key = self._repository.key
        for names in self._source.chunk_names():
            missing = self._missing(names, [object_name(key, Kind.CHUNK, name) for name in names])
            for name, data, problem in self._source.chunks(missing):
                if problem is not None:
                    self._content.damaged.append(name.hex())
                    continue
                self._writer.add(Kind.CHUNK, name, data)
                self._progress(len(data))
            self._guard()

    def _write_blobs(self) -> None:
        listed: set[str] = set()
        bases: set[str] = set()
        for rows in self._source.blobs():
            self._write_blob_rows(rows)
            listed.update(row.name for row in rows)
            bases.update(row.base for row in rows if row.base is not None)
        while bases - listed:  # stored while the list was read, before the place that it had reached
            rows = self._source.blob_rows(sorted(bases - listed))
            self._write_blob_rows(rows)
            listed |= bases
            bases = {row.base for row in rows if row.base is not None}
        for pack, size in self._source.pack_sizes().items():
            if self._write_file(f"packs/{pack}", size):
                self._guard()

    def _write_blob_rows(self, rows: Sequence[BlobRow]) -> None:
        key = self._repository.key
        for row in self._missing(rows, [object_name(key, Kind.BLOB, _packed(row)) for row in rows]):
            if row.pack is None and self._source.check_blob(row) is not None:
                self._content.damaged.append(row.name)
            self._writer.add(Kind.BLOB, _packed(row), b"")
        for row in rows:
            if row.pack is None:
                self._write_file(row.key, row.stored)
        self._guard()

    def _write_file(self, file: str, size: int) -> bool:
        """Write the parts of a stored file that are missing; returns whether there were any."""
        numbers = list(range(number_of_parts(size)))
        missing = set(self._missing(numbers, self._parts(file, size)))
        if not missing:
            return False
        parts = list[tuple[int, bytes]]()
        is_pack = file.startswith("packs/")
        try:
            for number, data in self._source.file_parts(file, size):
                if is_pack:
                    parts.append((number, data))
                if number in missing:
                    self._add_part(file, number, len(numbers), data)
        except Unreadable:
            raise
        except OSError:  # lost or broken: what a version needs of it, it cannot read anyway
            self._content.damaged.append(file)
        if is_pack:
            data = b"".join(part for _, part in parts)
            rows = self._source.packed_rows(file.removeprefix("packs/"))
            self._content.damaged += [row.name for row in rows if packed_problem(row, data) is not None]
        return True

    def _add_part(self, file: str, number: int, count: int, data: bytes) -> None:
        self._writer.add(Kind.PART, part_name(file, number), count.to_bytes(4, "big") + data)
        self._progress(len(data))

    # --- manifest ---

    def _snapshot(self, started: datetime, state: StoreState) -> Snapshot:
        shares = self._index.used_shares()
        former = [
            pack for number, pack in enumerate(self._index.packs) if number not in self._dropped and shares[number] > 0
        ]
        new = self._writer.packs + self._rows_writer.packs
        return Snapshot(
            id=f"{started:%Y%m%dT%H%M%SZ}-{secrets.token_hex(4)}",
            started=started,
            finished=datetime.now(UTC),
            release=__version__,
            revision=state.revision,
            database=state.database,
            epoch=state.epoch,
            position=state.position,
            key_ids=self._keys.ids,
            keys=bool(self._keys.documents),
            tables=tuple(self._content.tables),
            packs=tuple(_unique([*former, *new])),
            written=sum(pack.size for pack in _unique(new)),
            damaged=tuple(dict.fromkeys(self._content.damaged)),
        )


def _packed(row: BlobRow) -> bytes:
    return ormsgpack.packb(plain_values(row))


def _unique(packs: Sequence[PackReference]) -> list[PackReference]:
    return list(dict.fromkeys(packs))


def _pages(names: list[bytes], size: int = 20_000) -> Iterator[list[bytes]]:
    return (names[start : start + size] for start in range(0, len(names), size))
