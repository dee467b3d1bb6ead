"""The store as one class, on SQLite or PostgreSQL."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from sqlalchemy import select

from app.errors import Damaged, DatabaseDamaged
from app.store import schema, tables
from app.store.audit import Audit, record
from app.store.base import environment_row
from app.store.blobs import Blobs
from app.store.channels import Channels
from app.store.chunks import Chunks, delete, insert, problem, select_rows
from app.store.commit_counter import CommitCounter
from app.store.content import ContentReader
from app.store.database import Database
from app.store.encode import compress, digest
from app.store.environments import Environments
from app.store.garbage_collection import GarbageCollector
from app.store.index import SpatialIndex
from app.store.jobs import Jobs
from app.store.manifest import read_version
from app.store.outbox import Outbox
from app.store.overlays import Overlays
from app.store.position import Position
from app.store.robots import Robots
from app.store.tokens import Tokens
from app.store.tree import ChunkStage
from app.store.values import Version
from app.store.verify import Progress, Verifier, VerifyResult
from app.store.versions import Versions

ABANDONED_SECONDS = 24 * 3600.0
"""A pack of this age that no row knows is no living upload's: the row comes right after it."""


class Store(
    Audit,
    Environments,
    Versions,
    ContentReader,
    SpatialIndex,
    Position,
    Channels,
    Outbox,
    Tokens,
    Jobs,
    Robots,
    Overlays,
    GarbageCollector,
):
    """One database and one blob folder. Thread-safe; cheap to open again in a worker process.

    database_url: ``sqlite:///PATH`` or ``postgresql+psycopg://…`` (with PostGIS). readonly: nothing can be written,
    by the database's own means; ``prepare`` and all reading work. ``generation()`` is a number that changes with every
    committed write on this host.
    """

    def __init__(self, database_url: str, blob_dir: Path, *, readonly: bool = False) -> None:
        self.database_url = database_url
        self.blob_dir = Path(blob_dir)
        self.readonly = readonly
        self.generation = CommitCounter(self.blob_dir)
        self._database = Database(database_url, readonly=readonly, written=self.generation.change, record=record)
        self._chunks = Chunks(self._database)
        self.blobs = Blobs(self._database, self.blob_dir, readonly=readonly)

    def migrate(self) -> None:
        """Bring the database's schema up to date (creates it where there is none), and make the blob folder.

        Unavailable where the database does not answer, or where PostGIS is missing and may not be created.
        """
        schema.upgrade(self._database)
        self.blobs.prepare()
        self.refresh_areas()

    def check(self) -> None:
        """Unavailable unless the database answers, is whole as far as is known, and its schema is this release's."""
        schema.check(self._database)
        self._database.check()

    def check_writable(self) -> None:
        """Unavailable (NoRoom: a full disk) unless the blob folder and the database's folder can be written."""
        self.blobs.check()
        self._database.check_room()

    def note_damage(self, error: DatabaseDamaged) -> None:
        """Report that another process found the database damaged: from now on ``check`` fails."""
        self._database.note_damage_from(error)

    def verifier(self, progress: Progress = lambda kind, size: None) -> Verifier:
        """Checks of everything that is stored."""
        return Verifier(self._database, self._chunks, self.blobs, progress)

    def check_pages(self, after: str = "") -> Iterator[tuple[str, int, str | None]]:
        """(table, bytes, problem) of SQLite's tables after this one, each by a quick check in a query of its own.

        Between two tables no connection is held. A problem is noted, so that ``check`` fails. bytes: the same share of
        the file for each, since SQLite does not tell them cheaply.
        """
        try:
            tables, size = self._database.tables()
        except DatabaseDamaged as error:
            yield "database", 0, error.detail
            return
        for table in tables:
            if table > after:
                problem = self._database.integrity(1, table=table)
                if problem is not None:
                    self._database.report_damage(problem)
                yield table, size // len(tables), problem

    def version_and_base(self, environment: str, number: int) -> tuple[Version, Version | None]:
        """A version, also of a deleted environment, and the one before it."""
        with self._database.read() as connection:
            row = environment_row(connection, environment, deleted=True)
            base = read_version(connection, row, number - 1) if number else None
            return read_version(connection, row, number), base

    def draft(self) -> ChunkStage:
        """Chunks in the making over the stored ones."""
        return ChunkStage(self._chunks)

    def chunk(self, sha256: str) -> bytes:
        """A chunk's canonical bytes, hashed again; Damaged where it is lost or damaged."""
        return self._chunks.read_many([bytes.fromhex(sha256)])[bytes.fromhex(sha256)]

    def heal_chunks(self, chunks: Mapping[str, bytes]) -> None:
        """Store chunks (hash in hex -> canonical bytes) in place of damaged or lost ones. Damaged for a wrong hash."""
        for name, raw in chunks.items():
            if digest(raw).hex() != name:
                raise Damaged(f"these are not the bytes of chunk {name}")
        with self._database.write() as connection:
            insert(connection, {name: compress(raw) for name, raw in chunks.items()})

    def remove_unused_chunks(self, verification: VerifyResult) -> set[str]:
        """Remove damaged chunks that no version has; their hashes. For when all others were healed.

        A check takes minutes: a chunk that was used or healed since it started stays.
        """
        names = [bytes.fromhex(f.name) for f in verification.findings if f.kind == "chunk" and not f.versions]
        with self._database.write() as connection:
            damaged = [name for name, data in select_rows(connection, names) if problem(name, data) is not None]
            return {name.hex() for name in delete(connection, damaged, int(verification.started))}

    def recover(self) -> None:
        """At start: remove what a killed upload left behind. Safe beside other processes that are at work."""
        self.blobs.recover(ABANDONED_SECONDS)

    def epoch(self) -> int:
        """The server's epoch: it rises when the database is restored from a backup. Robots order by it first."""
        with self._database.read() as connection:
            return int(connection.execute(select(tables.server.c.epoch)).scalar_one_or_none() or 0)

    def close(self) -> None:
        """Give back connections."""
        self._database.close()
        self.generation.close()


__all__ = ["Store"]
