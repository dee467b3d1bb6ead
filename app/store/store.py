"""The store: all its services over one database and one blob folder, on SQLite or PostgreSQL."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from datetime import datetime
from pathlib import Path

from sqlalchemy import Connection, select

from app.backends.blobs import BlobFiles
from app.backends.notify import CommitCounter
from app.errors import DatabaseDamaged, NoRoom, Unavailable
from app.store import schema, tables
from app.store.audit import Audit, record
from app.store.backup_source import BackupSource
from app.store.backup_target import BackupTarget, raise_epoch
from app.store.backups import DOCUMENT as BACKUP_DOCUMENT
from app.store.backups import Backups
from app.store.base import utcnow
from app.store.blob_upkeep import BlobUpkeep
from app.store.blobs import COPIES_BYTES, Blobs
from app.store.channels import Channels
from app.store.chunks import Chunks
from app.store.content import ContentReader
from app.store.database import Database
from app.store.documents import StoredDocument
from app.store.drafts import Drafts
from app.store.edge_changes import EdgeChanges
from app.store.environments import Environments
from app.store.fleet_figures import FleetFigures
from app.store.garbage_collection import GarbageCollector
from app.store.jobs import Jobs
from app.store.made_maps import MadeMaps
from app.store.mirror_source import MirrorSource
from app.store.mirror_state import Mirrors
from app.store.mirror_target import MirrorTarget
from app.store.outbox import Outbox
from app.store.overlays import Overlays
from app.store.position import Areas
from app.store.retention import Retention
from app.store.robot_counts import RobotCounts
from app.store.robots import MAX_ROBOTS, Robots
from app.store.search import Search
from app.store.search_index import SearchIndex
from app.store.sessions import Sessions
from app.store.tags import Tags
from app.store.tokens import Tokens
from app.store.verify import Progress, Verifier
from app.store.versions import Versions
from app.store.webhooks import Webhooks
from app.store.wrong_tokens import WrongTokens


class Store:
    """One database and one blob folder. Thread-safe; cheap to open again in a worker process.

    database_url: ``sqlite:///PATH`` or ``postgresql+psycopg://…`` (with PostGIS). readonly: the database itself rejects
    writes; ``versions.prepare`` and all reading work. files: the blob store, by default that folder; with one on
    another machine ``blob_dir`` has copies of at most ``copies_bytes`` bytes. max_robots: of an environment.
    ``generation()`` is a number that changes with every committed write on this host.
    """

    def __init__(
        self,
        database_url: str,
        blob_dir: Path,
        *,
        readonly: bool = False,
        clock: Callable[[], datetime] = utcnow,
        files: BlobFiles | None = None,
        copies_bytes: int = COPIES_BYTES,
        max_robots: int = MAX_ROBOTS,
    ) -> None:
        self.database_url = database_url
        self.blob_dir = Path(blob_dir)
        self.generation = CommitCounter(self.blob_dir)
        self._database = database = Database(
            database_url, readonly=readonly, written=self.generation.change, record=record, clock=clock
        )
        self.chunks = Chunks(database)
        self.blobs = Blobs(database, self.blob_dir, readonly=readonly, files=files, copies_bytes=copies_bytes)
        self.blob_upkeep = BlobUpkeep(database, self.blobs)
        self.environments = Environments(database, self.chunks)
        self.versions = Versions(database, self.chunks, self.blobs)
        self.tags = Tags(database)
        self.retention = Retention(database)
        self.drafts = Drafts(database)
        self.content = ContentReader(self.chunks, self.blobs)
        self.channels = Channels(database)
        self.overlays = Overlays(database)
        self.robots = Robots(database, limit=max_robots)
        self.robot_counts = RobotCounts(database)
        self.fleet_figures = FleetFigures(database)
        self.mirror_source = MirrorSource(database, self.chunks)
        self.mirror_target = MirrorTarget(database)
        self.mirrors = Mirrors(database)
        self.edge_changes = EdgeChanges(database)
        self.events = Outbox(database)
        self.webhooks = Webhooks(database)
        self.areas = Areas(database, self.chunks)
        self.search_index = SearchIndex(database, self.chunks)
        self.search = Search(database, self.search_index)
        self.tokens = Tokens(database)
        self.sessions = Sessions(database, self.tokens)
        self.wrong_tokens = WrongTokens(database)
        self.jobs = Jobs(database)
        self.audit = Audit(database)
        self.made_maps = MadeMaps(database, self.blobs.files)
        self.backups = Backups(StoredDocument(database, self.generation, BACKUP_DOCUMENT))
        self.backup_source = BackupSource(database, self.blobs)
        self.backup_target = BackupTarget(database, self.blobs)
        self.garbage = GarbageCollector(database, self.chunks, self.blobs, self.blob_upkeep, self.made_maps)

    def migrate(self) -> None:
        """Create or migrate the database's schema, and create the blob folder.

        Raises Unavailable if the database does not answer, or if PostGIS is missing and may not be created.
        """
        schema.upgrade(self._database)
        self.blobs.prepare()
        self.areas.refresh()

    def initialise(self) -> None:
        """Create the schema in an empty database, and migrate an SQLite database. For the start of a server."""
        if self._database.sqlite or schema.is_empty(self._database):
            self.migrate()

    def check(self) -> None:
        """Raise Unavailable unless the database answers, has no known damage, and its schema suits this release."""
        schema.check(self._database)
        self._database.check()

    def check_writable(self) -> None:
        """Raise Unavailable (NoRoom: a full disk) unless the blob folder and the database's folder can be written."""
        self.blobs.check()
        self._database.check_room()

    def write_problem(self) -> str | None:
        """Return why nothing can be stored although reading works: a full disk, or a file store that is away, or None.

        For the start. Raises Unavailable if the blob folder is unusable: another folder is needed.
        """
        try:
            self.check_writable()
        except NoRoom as error:
            return error.detail
        except DatabaseDamaged:
            raise
        except Unavailable as error:
            if not self.blobs.files.remote:
                raise
            return error.detail
        return None

    def note_damage(self, error: DatabaseDamaged) -> None:
        """Note that another process found the database damaged: from now on ``check`` fails."""
        self._database.note_damage_from(error)

    def verifier(self, progress: Progress = lambda kind, size: None) -> Verifier:
        """Create a verifier of everything that is stored."""
        return Verifier(self._database, self.chunks, self.blobs, self.blob_upkeep, self.made_maps, progress)

    def check_pages(self, after: str = "") -> Iterator[tuple[str, int, str | None]]:
        """Check SQLite's tables after this one, each in a query of its own: (table, bytes, problem).

        Between two tables no connection is held. A problem is noted, so that ``check`` fails. bytes: the same share of
        the file for each, since SQLite does not report them cheaply.
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

    def transaction(self) -> AbstractContextManager[Connection]:
        """Begin a transaction that changes nothing that is versioned, for the queue of all servers."""
        return self._database.write(notify=False, upkeep=True)

    def recover(self) -> None:
        """Remove the remains of killed uploads, at start. Safe beside other running processes."""
        self.blobs.files.recover()

    @property
    def is_shared(self) -> bool:
        """Whether several servers may use the database."""
        return not self._database.sqlite

    def document(self, name: str) -> StoredDocument:
        """Return a document in the database, for what several servers share."""
        return StoredDocument(self._database, self.generation, name)

    def now(self) -> datetime:
        """Return the present by the store's clock."""
        return self._database.now()

    def integrity(self) -> str | None:
        """Check all pages of SQLite's file, without noting a problem; return it, None if intact or on PostgreSQL."""
        return self._database.integrity(10)

    def database_versions(self) -> dict[str, str]:
        """Return the versions of the database's programs and of the schema. Raises Unavailable."""
        return {**self._database.versions(), "schema": schema.present_revision(self._database) or "none"}

    def clock_offset(self) -> float | None:
        """Return by how many seconds the database's clock is ahead of this machine's; None with SQLite."""
        return self._database.clock_offset()

    def epoch(self) -> int:
        """Return the server's epoch: it rises when the database is restored from a backup; robots order by it first."""
        with self._database.read() as connection:
            return int(connection.execute(select(tables.server.c.epoch)).scalar_one_or_none() or 0)

    def raise_epoch(self) -> int:
        """Raise the server's epoch after a restore by other means, so that robots accept it; returns it."""
        return raise_epoch(self._database)

    def close(self) -> None:
        """Close all connections."""
        self._database.close()
        self.generation.close()


__all__ = ["Store"]
