"""What a backup reads of a store: the rows of tables in one snapshot, then chunks and files.

What a version refers to is never changed, only collected. So the tables come first, from one snapshot, and the content
may follow as slowly as it likes, as long as no garbage collection runs.
"""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Any, Final

from sqlalchemy import Connection, Table, func, select

from app.errors import Unavailable
from app.store import blob_coding, blob_rows, chunks, tables
from app.store.backup_tables import OWN_DOCUMENTS, order_of, segments, stored_columns
from app.store.blob_rows import BlobRow
from app.store.blobs import Blobs
from app.store.chunks import problem
from app.store.database import Database
from app.store.schema import newest, present_revision

NAMES: Final = 20_000
READ: Final = 500
PART_BYTES: Final = 8 * 2**20
"""Size of the parts that a stored file is kept in."""


@dataclass(frozen=True, slots=True)
class StoreState:
    """State that a backup is of. position: of the newest event."""

    revision: str
    epoch: int
    position: int
    database: str


class BackupSource:
    """Reader of one store for a backup."""

    def __init__(self, database: Database, blobs: Blobs) -> None:
        self._database, self._blobs = database, blobs
        self.served = 0.0
        """Seconds that this source waited for a database server while that worked for it; 0 on SQLite."""

    @contextmanager
    def _read(self) -> Iterator[Connection]:
        started, worked = time.monotonic(), time.thread_time()
        with self._database.read() as connection:
            yield connection
        if not self._database.sqlite:
            self.served += (time.monotonic() - started) - (time.thread_time() - worked)

    def check(self) -> None:
        """Raise Unavailable unless the schema is that of this release: it knows all of its columns."""
        present = present_revision(self._database)
        if present != newest():
            raise Unavailable(
                f"the database's schema is {present or 'missing'}, this release backs up schema {newest()}: run the "
                "release of the server, or `fleetmap migrate`"
            )

    def has_schema(self) -> bool:
        """Return whether the database has a schema."""
        return present_revision(self._database) is not None

    def snapshot(self) -> AbstractContextManager[Connection]:
        """Begin the transaction that the tables are read in."""
        return self._database.snapshot()

    def state(self, connection: Connection) -> StoreState:
        """Read what the snapshot is of."""
        epoch = connection.execute(select(tables.server.c.epoch)).scalar_one_or_none() or 0
        position = connection.execute(select(tables.log.c.position)).scalar_one_or_none() or 0
        return StoreState(newest(), int(epoch), int(position), connection.dialect.name)

    def segments(self, connection: Connection, table: Table) -> Iterator[tuple[int, bytes]]:
        """Read the rows of a table in segments: (number of rows, packed rows)."""
        query = select(*stored_columns(table)).order_by(*order_of(table))
        if table is tables.document:
            query = query.where(table.c.name.not_in(OWN_DOCUMENTS))
        rows = connection.execution_options(yield_per=1000).execute(query)
        yield from segments(table, rows)

    def chunk_names(self) -> Iterator[list[bytes]]:
        """List the names of all chunks, in ascending order, page by page."""
        table, last = tables.chunk, b""
        while True:
            query = select(table.c.hash).where(table.c.hash > last).order_by(table.c.hash).limit(NAMES)
            with self._read() as connection:
                names = [bytes(name) for name in connection.execute(query).scalars()]
            yield names
            if len(names) < NAMES:
                return
            last = names[-1]

    def chunks(self, names: Sequence[bytes]) -> Iterator[tuple[bytes, bytes, str | None]]:
        """Read chunks and check each against its hash: (name, stored bytes, ``damaged`` or None)."""
        for start in range(0, len(names), READ):
            with self._read() as connection:
                rows = list(chunks.select_rows(connection, names[start : start + READ]))
            yield from ((name, data, problem(name, data)) for name, data in rows)

    def blobs(self) -> Iterator[list[BlobRow]]:
        """List the rows of all blobs, page by page."""
        table, last = tables.blob, ""
        while True:
            query = select(table.c.sha256).where(table.c.sha256 > last).order_by(table.c.sha256).limit(READ)
            with self._read() as connection:
                rows = blob_rows.select_rows(connection, list(connection.execute(query).scalars()))
            yield [rows[name] for name in sorted(rows)]
            if len(rows) < READ:
                return
            last = max(rows)

    def blob_rows(self, names: Sequence[str]) -> list[BlobRow]:
        """Read the rows of some blobs, those that exist."""
        return list(self._blobs.rows(names).values())

    def pack_sizes(self) -> dict[str, int]:
        """Return the number of bytes of each pack that its blobs take."""
        table = tables.blob
        end = func.max(table.c.start + func.coalesce(table.c.stored, table.c.size))
        query = select(table.c.pack, end).where(table.c.pack.is_not(None))
        with self._read() as connection:
            return {str(pack): int(size) for pack, size in connection.execute(query.group_by(table.c.pack))}

    def packed_rows(self, pack: str) -> list[BlobRow]:
        """Return the rows of the blobs in a pack."""
        table = tables.blob
        with self._read() as connection:
            names = list(connection.execute(select(table.c.sha256).where(table.c.pack == pack)).scalars())
            return list(blob_rows.select_rows(connection, names).values())

    def check_blob(self, row: BlobRow) -> str | None:
        """Check a blob against its hash: ``lost``, ``damaged`` or None."""
        return self._blobs.check_row(row)

    def file_parts(self, key: str, size: int) -> Iterator[tuple[int, bytes]]:
        """Read a stored file in parts of PART_BYTES: (number, bytes). Raises FileNotFoundError, OSError, Unreadable."""
        number, part = 0, bytearray()
        for piece in self._blobs.files.stream(key, 0, size):
            part += piece
            while len(part) >= PART_BYTES:
                yield number, bytes(part[:PART_BYTES])
                del part[:PART_BYTES]
                number += 1
        if part or number == 0:
            yield number, bytes(part)


def number_of_parts(size: int) -> int:
    """Return how many parts a stored file of this size has."""
    return max(1, math.ceil(size / PART_BYTES))


def packed_problem(row: BlobRow, data: bytes) -> str | None:
    """Check a blob within the bytes of its pack against its hash: ``damaged`` or None."""
    digest = hashlib.sha256()
    try:
        for piece in blob_coding.decoded(iter([data[row.start : row.start + row.stored]]), row.coding):
            digest.update(piece)
    except blob_coding.Undecodable:
        return "damaged"
    return None if digest.hexdigest() == row.name else "damaged"


def plain_values(row: BlobRow) -> list[Any]:
    """Return a blob's row for a backup."""
    return [row.name, row.size, row.pack, row.start, row.stored, row.coding, row.base, row.chain]
