"""The versioned store: environments, versions, content, channels, tokens, events and jobs, on SQLite or PostgreSQL.

``values`` what is handed out · ``changes`` what a version shall change · ``encode`` canonical bytes · ``tree`` the
chunk tree · ``parts`` layers as trees · ``difference`` what differs · ``prepare`` working out a version · ``versions``
committing it · ``blobs`` files · ``collect`` upkeep · ``schema`` migrations.
"""

from __future__ import annotations

from pathlib import Path

from sqlalchemy import select

from app.store import schema, tables
from app.store.audit import Audit, record
from app.store.blobs import Blobs
from app.store.channels import Channels
from app.store.chunks import Chunks
from app.store.collect import Collection
from app.store.content import Content
from app.store.database import Database
from app.store.environments import Environments
from app.store.generation import Generation
from app.store.index import SpatialIndex
from app.store.jobs import Jobs
from app.store.outbox import Outbox
from app.store.overlays import Overlays
from app.store.position import Position
from app.store.robots import Robots
from app.store.tokens import Tokens
from app.store.versions import Versions

ABANDONED_SECONDS = 24 * 3600.0
"""A pack of this age that no row knows is no living upload's: the row comes right after it."""


class Store(
    Audit,
    Environments,
    Versions,
    Content,
    SpatialIndex,
    Position,
    Channels,
    Outbox,
    Tokens,
    Jobs,
    Robots,
    Overlays,
    Collection,
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
        self.generation = Generation(self.blob_dir)
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
        """Unavailable unless the database and the blob folder answer and the schema is this release's."""
        schema.check(self._database)
        self.blobs.check()

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
