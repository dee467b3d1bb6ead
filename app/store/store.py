"""The store: its services over one database and one blob folder, on SQLite or PostgreSQL."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from datetime import datetime
from pathlib import Path

from sqlalchemy import select

from app.errors import DatabaseDamaged
from app.store import schema, tables
from app.store.audit import Audit, record
from app.store.base import utcnow
from app.store.blobs import Blobs
from app.store.channels import Channels
from app.store.chunks import Chunks
from app.store.commit_counter import CommitCounter
from app.store.content import ContentReader
from app.store.database import Database
from app.store.environments import Environments
from app.store.garbage_collection import GarbageCollector
from app.store.index import SpatialIndex
from app.store.jobs import Jobs
from app.store.outbox import Outbox
from app.store.overlays import Overlays
from app.store.position import Areas
from app.store.robots import Robots
from app.store.tokens import Tokens
from app.store.verify import Progress, Verifier
from app.store.versions import Versions

ABANDONED_SECONDS = 24 * 3600.0
"""A pack of this age that no row knows is no living upload's: the row comes right after it."""


class Store:
    """One database and one blob folder. Thread-safe; cheap to open again in a worker process.

    database_url: ``sqlite:///PATH`` or ``postgresql+psycopg://…`` (with PostGIS). readonly: nothing can be written,
    by the database's own means; ``versions.prepare`` and all reading work. ``generation()`` is a number that changes
    with every committed write on this host.
    """

    def __init__(
        self,
        database_url: str,
        blob_dir: Path,
        *,
        readonly: bool = False,
        clock: Callable[[], datetime] = utcnow,
    ) -> None:
        self.database_url = database_url
        self.blob_dir = Path(blob_dir)
        self.generation = CommitCounter(self.blob_dir)
        self._database = database = Database(
            database_url, readonly=readonly, written=self.generation.change, record=record, clock=clock
        )
        self.chunks = Chunks(database)
        self.blobs = Blobs(database, self.blob_dir, readonly=readonly)
        self.environments = Environments(database, self.chunks)
        self.versions = Versions(database, self.chunks, self.blobs)
        self.content = ContentReader(self.chunks, self.blobs)
        self.channels = Channels(database)
        self.overlays = Overlays(database)
        self.robots = Robots(database)
        self.events = Outbox(database)
        self.index = SpatialIndex(database, self.chunks)
        self.areas = Areas(database, self.chunks)
        self.tokens = Tokens(database)
        self.jobs = Jobs(database)
        self.audit = Audit(database)
        self.garbage = GarbageCollector(database, self.chunks, self.blobs)

    def migrate(self) -> None:
        """Bring the database's schema up to date (creates it where there is none), and make the blob folder.

        Unavailable where the database does not answer, or where PostGIS is missing and may not be created.
        """
        schema.upgrade(self._database)
        self.blobs.prepare()
        self.areas.refresh()

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
        return Verifier(self._database, self.chunks, self.blobs, progress)

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
