"""What a restore writes: rows of tables, chunks and files of a backup, into an empty store.

Until ``complete``, the database is marked in the table of its schema's revision, so that every server, also of an older
release, refuses it: a restore that ends in the middle leaves nothing that could be served.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Final

from sqlalchemy import Column, Connection, MetaData, Table, delete, exists, func, insert, inspect, select, text, update
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.types import TypeEngine

from app.errors import Conflict, Damaged, Unavailable
from app.store import chunks, schema, tables
from app.store.backup_tables import dumped_tables, rows_of
from app.store.blob_rows import BlobRow, select_rows
from app.store.blobs import Blobs
from app.store.database import Database

BATCH: Final = 500
SEEDS: Final = frozenset({"alembic_version", "server", "log", "relay", "collection", "lead"})
"""Tables that have rows before anything is stored."""


class BackupTarget:
    """Writer into one store for a restore."""

    def __init__(self, database: Database, blobs: Blobs) -> None:
        self._database, self._blobs = database, blobs

    def check_empty(self, revision: str) -> bool:
        """Check that nothing is stored yet; returns whether a restore was interrupted here, which goes on.

        revision: the schema of the backup. Raises Conflict if there are data, or another schema.
        """
        present = schema.present_revision(self._database)
        if present is not None and present.startswith(schema.RESTORING):
            if present != schema.RESTORING + revision:
                raise Conflict(
                    "the restore of another backup was interrupted in this database: remove the database, create it "
                    "again, and restore then"
                )
            return True
        used = self._tables_with_rows()
        if used:
            raise Conflict(
                f"the database has data already (in {', '.join(used[:3])}): restore into an empty place, with another "
                "--data-dir or FLEETMAP_DATABASE_URL"
            )
        if present not in (None, revision):
            raise Conflict(
                f"the database is empty but has schema {present}, and the backup has {revision}: remove the database, "
                "create it again, and restore then"
            )
        if next(self._blobs.files.list(), None) is not None:
            raise Conflict(
                "the folder or bucket of stored files has files already: restore into an empty place, with another "
                "--data-dir or FLEETMAP_BLOB_URL"
            )
        return False

    def _tables_with_rows(self) -> list[str]:
        with self._database.read() as connection:
            present = set(inspect(connection).get_table_names())
            names = [table.name for table in tables.metadata.sorted_tables if table.name in present]
            return [name for name in names if name not in SEEDS and _has_rows(connection, name)]

    def begin(self, revision: str) -> None:
        """Create the schema of the backup, marked, or remove what an interrupted restore has left."""
        present = schema.present_revision(self._database)
        if present is None:
            schema.create_for_restore(self._database, revision)
            return
        with self._database.write(notify=False, upkeep=True) as connection:
            names = set(inspect(connection).get_table_names())
            for table in reversed(tables.metadata.sorted_tables):
                if table.name in names:
                    connection.execute(delete(table))
            if present == revision:
                mark = {"mark": schema.RESTORING + revision}
                connection.execute(text("UPDATE alembic_version SET version_num = :mark"), mark)

    def write_chunks(self, rows: Mapping[bytes, bytes]) -> None:
        """Store chunks: name -> stored bytes."""
        with self._database.write(notify=False, upkeep=True) as connection:
            chunks.insert(connection, {name.hex(): data for name, data in rows.items()}, kept=True)

    def write_blob_rows(self, rows: Sequence[BlobRow]) -> None:
        """Store where blobs are; a later row replaces an earlier one."""
        latest = {row.name: row for row in rows}
        make = sqlite.insert if self._database.sqlite else postgresql.insert
        statement = make(tables.blob)
        columns = ("size", "pack", "start", "stored", "coding", "base", "chain")
        again = {name: statement.excluded[name] for name in columns}
        used = {"used": int(time.time()), "kept": True}
        values = [
            {"sha256": name, **used, **{column: getattr(row, column) for column in columns}}
            for name, row in sorted(latest.items())
        ]
        with self._database.write(notify=False, upkeep=True) as connection:
            connection.execute(statement.on_conflict_do_update(index_elements=["sha256"], set_=again), values)

    def remove_blob_rows(self, present: set[str]) -> None:
        """Remove the rows of blobs that cannot be read: the backup kept the row longer than its file or its base.

        present: keys of the files.
        """
        last = ""
        while True:
            table = tables.blob
            query = select(table.c.sha256).where(table.c.sha256 > last).order_by(table.c.sha256).limit(BATCH)
            with self._database.read() as connection:
                rows = self._blob_rows(connection, list(connection.execute(query).scalars()))
            lost = [name for name, key in rows if key not in present]
            if lost:
                with self._database.write(notify=False, upkeep=True) as connection:
                    connection.execute(delete(table).where(table.c.sha256.in_(lost)))
            if len(rows) < BATCH:
                break
            last = max(name for name, _ in rows)
        self._remove_without_base()

    def _remove_without_base(self) -> None:
        base = tables.blob.alias()
        is_there = exists(select(base.c.sha256).where(base.c.sha256 == tables.blob.c.base))
        removed = 1
        while removed:  # each time what had the last ones as its base
            with self._database.write(notify=False, upkeep=True) as connection:
                removed = connection.execute(
                    delete(tables.blob).where(tables.blob.c.base.is_not(None), ~is_there)
                ).rowcount

    @staticmethod
    def _blob_rows(connection: Connection, names: list[str]) -> list[tuple[str, str]]:
        return [(name, row.key) for name, row in select_rows(connection, names).items()]

    def write_table(self, name: str, columns: Sequence[str], segments: Iterable[bytes]) -> int:
        """Store the rows of a table's segments; returns their number. Raises Damaged, Conflict for an unknown table."""
        with self._database.write(notify=False, upkeep=True, alone=True) as connection:  # waits for segments
            table = _table(connection, name, columns)
            if name in SEEDS:
                connection.execute(delete(table))
            count = 0
            for rows in _rows(table, segments):
                connection.execute(insert(table), rows)
                count += len(rows)
        return count

    def upgrade(self) -> None:
        """Migrate to the schema of this release, and have made anew what the backup leaves out."""
        schema.upgrade_restored(self._database)
        environment, collection, server = tables.environment, tables.collection, tables.server
        stale = {"area_stale": True, "search_version": -1, "search_sequence": -1, "search_updated": None}
        with self._database.write(notify=False, upkeep=True) as connection:
            connection.execute(update(environment).values(stale))
            connection.execute(update(collection).values(purges=collection.c.collected + 1))
            connection.execute(update(server).values(presence_checked=None))
            if not self._database.sqlite:
                for table in tables.metadata.sorted_tables:
                    _advance_sequence(connection, table)

    def complete(self, epoch: int) -> None:
        """Let servers use the database, with this epoch."""
        with self._database.write(notify=False, upkeep=True) as connection:
            connection.execute(update(tables.server).values(epoch=epoch))
            schema.unmark_restored(connection)


def next_epoch(epoch: int) -> int:
    """Return an epoch above this one, and above that of an earlier restore of the same backup: the time in seconds."""
    return max(epoch + 1, int(time.time()))


def raise_epoch(database: Database) -> int:
    """Raise the server's epoch, so that robots accept lower sequences than before; returns it."""
    table = tables.server
    with database.write(upkeep=True) as connection:
        present = connection.execute(select(table.c.epoch).with_for_update()).scalar_one_or_none()
        if present is None:
            raise Unavailable("the database has no server yet: start it once")
        epoch = next_epoch(int(present))
        connection.execute(update(table).values(epoch=epoch))
    return epoch


def _has_rows(connection: Connection, name: str) -> bool:
    return connection.exec_driver_sql(f'SELECT 1 FROM "{name}" LIMIT 1').first() is not None  # noqa: S608  our own names


def _table(connection: Connection, name: str, columns: Sequence[str]) -> Table:
    """Describe a table as the backup has it, whose schema may be older than that of this release."""
    if name not in {table.name for table in dumped_tables()}:
        raise Damaged(f"the backup has rows of the table {name[:80]}, which no backup contains")
    present = {column["name"]: column["type"] for column in inspect(connection).get_columns(name)}
    unknown = sorted(set(columns) - set(present))
    if unknown:
        raise Conflict(f"the backup has columns that the table {name} lacks: {', '.join(unknown)}")
    current = tables.metadata.tables.get(name)
    types: dict[str, TypeEngine[Any]] = dict(present)
    if current is not None:
        types |= {column.name: column.type for column in current.columns}
    return Table(name, MetaData(), *(Column(column, types[column]) for column in columns))


def _rows(table: Table, segments: Iterable[bytes]) -> Iterator[list[dict[str, Any]]]:
    for data in segments:
        rows = rows_of(data, list(table.columns))
        yield from (rows[start : start + BATCH] for start in range(0, len(rows), BATCH))


def _advance_sequence(connection: Connection, table: Table) -> None:
    """Let a numbered table go on after its highest number."""
    column = next((c for c in table.primary_key.columns if c.name == "id" and c.autoincrement is not False), None)
    if column is None or len(table.primary_key.columns) != 1:
        return
    name = connection.execute(select(func.pg_get_serial_sequence(table.name, column.name))).scalar_one_or_none()
    if name is not None:
        following = select(func.coalesce(func.max(column), 0) + 1).scalar_subquery()
        connection.execute(select(func.setval(name, following, False)))
