"""Databases of ``scale_site`` that are kept in a folder: filling takes long, and measuring needs a quiet machine.

``python -m tests.bench.scale_databases FOLDER sqlite`` (or ``postgresql``) fills them, and goes on where it was
interrupted. On SQLite the store's own commits do so; PostgreSQL gets a copy of these rows, which takes less time.
"""

from __future__ import annotations

import argparse
import contextlib
import sqlite3
import struct
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import psycopg
from psycopg import sql
from sqlalchemy import Column, Table

from app.store import tables
from app.store.backup_tables import stored_columns
from app.store.column_types import Grams, WkbGeometry
from app.store.grams import grams
from app.store.store import Store
from tests.bench.scale_site import fill
from tests.postgres import Cluster, running_cluster

ENVIRONMENTS: Final = 10_000
VERSIONS: Final = 100
FILE: Final = "fleetmap.sqlite"

SMALL: Final = 10, 10
"""Numbers of environments and of versions in each, of the database that others are compared with."""


@dataclass(frozen=True, slots=True)
class FilledDatabase:
    """A database that is filled. folder: the data folder of its server."""

    url: str
    folder: Path
    environments: int


@contextlib.contextmanager
def filled(
    folder: Path, environments: int = ENVIRONMENTS, versions: int = VERSIONS, *, postgres: bool
) -> Iterator[list[FilledDatabase]]:
    """Yield a small database and one of this size; fill what is missing. PostgreSQL runs meanwhile."""
    sources = [_on_sqlite(folder / "sqlite", *size) for size in (SMALL, (environments, versions))]
    if not postgres:
        yield sources
        return
    with running_cluster(folder / "cluster") as cluster:
        yield [_on_postgresql(cluster, folder / "postgresql", source) for source in sources]


def _on_sqlite(folder: Path, environments: int, versions: int) -> FilledDatabase:
    place = folder / f"{environments}x{versions}"
    place.mkdir(parents=True, exist_ok=True)
    url = f"sqlite:///{place / FILE}"
    _once(place, lambda: fill(url, place, environments, versions))
    return FilledDatabase(url, place, environments)


def _on_postgresql(cluster: Cluster, folder: Path, source: FilledDatabase) -> FilledDatabase:
    place = folder / source.folder.name
    place.mkdir(parents=True, exist_ok=True)
    url = cluster.url(place.name)

    def copy() -> None:
        cluster.drop_database(place.name)
        cluster.create_database(name=place.name)
        store = Store(url, place / "blobs")
        store.migrate()
        store.close()
        copy_rows(source.folder / FILE, url)

    _once(place, copy)
    return FilledDatabase(url, place, source.environments)


def _once(folder: Path, work: Callable[[], None]) -> None:
    """Fill a database, unless that was completed."""
    done = folder / "filled"
    if done.exists():
        return
    started = time.perf_counter()
    work()
    print(f"{folder}: filled in {time.perf_counter() - started:.0f} s", flush=True)
    done.touch()


# --- copy from SQLite to PostgreSQL ---


def copy_rows(source: Path, url: str) -> None:
    """Copy all rows of an SQLite file into a PostgreSQL database, which has the schema and nothing else."""
    with (
        contextlib.closing(sqlite3.connect(f"{source.absolute().as_uri()}?mode=ro", uri=True)) as rows,
        psycopg.connect(url.replace("+psycopg", ""), autocommit=True) as target,
    ):
        target.execute("SET TIME ZONE 'UTC'")  # SQLite's times have no zone
        with target.transaction():
            for table in reversed(tables.metadata.sorted_tables):  # some have a row from the beginning
                target.execute(sql.SQL("DELETE FROM {}").format(sql.Identifier(table.name)))
            for table in tables.metadata.sorted_tables:
                _copy_table(table, rows, target)
        target.execute("VACUUM ANALYZE")


def _copy_table(table: Table, rows: sqlite3.Connection, target: psycopg.Connection[Any]) -> None:
    columns = stored_columns(table)
    names = [column.name for column in columns]
    listed = ", ".join(f'"{name}"' for name in names)
    into = sql.SQL("COPY {} ({}) FROM STDIN").format(
        sql.Identifier(table.name), sql.SQL(", ").join(map(sql.Identifier, names))
    )
    with target.cursor() as cursor, cursor.copy(into) as copy:
        for row in _converted(columns, rows.execute(f'SELECT {listed} FROM "{table.name}"')):
            copy.write_row(row)
    if "id" in names and table.c["id"].type.python_type is int and table.c["id"].autoincrement is not False:
        following = sql.SQL("SELECT setval(pg_get_serial_sequence({}, 'id'), max(id)) FROM {}")
        target.execute(following.format(sql.Literal(table.name), sql.Identifier(table.name)))


def _converted(columns: Sequence[Column[Any]], rows: Iterable[tuple[Any, ...]]) -> Iterator[Sequence[Any]]:
    """Convert what is not the same text on both databases: geometries, and grams, which SQLite has elsewhere."""
    shapes = [k for k, column in enumerate(columns) if isinstance(column.type, WkbGeometry)]
    sets = [k for k, column in enumerate(columns) if isinstance(column.type, Grams)]
    names = [column.name for column in columns]
    for row in rows:
        if not shapes and not sets:
            yield row
            continue
        values = list(row)
        for k in shapes:
            values[k] = None if row[k] is None else _with_reference_system(row[k]).hex()
        for k in sets:
            texts = [row[names.index(name)] for name in ("folded", "folded_id")]
            values[k] = _as_tsvector(grams(*(text for text in texts if text is not None)))
        yield values


def _with_reference_system(wkb: bytes) -> bytes:
    """Return a geometry in degrees, in little-endian WKB, as PostGIS reads it: with the number 4326."""
    order, kind = struct.unpack_from("<BI", wkb)
    assert order == 1, "little-endian"
    return struct.pack("<BII", order, kind | 0x20000000, 4326) + wkb[5:]


def _as_tsvector(texts: Iterable[str]) -> str:
    """Return texts as PostgreSQL reads a tsvector."""
    escaped = (text.replace("\\", "\\\\").replace("'", "''") for text in texts)
    return " ".join(f"'{text}'" for text in escaped)


def main() -> None:
    """Fill the databases in a folder."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.scale_databases", description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("engine", choices=["sqlite", "postgresql"], help="postgresql: sqlite first, if it is missing")
    parser.add_argument("--environments", type=int, default=ENVIRONMENTS)
    parser.add_argument("--versions", type=int, default=VERSIONS)
    arguments = parser.parse_args()
    size = arguments.environments, arguments.versions
    with filled(arguments.folder, *size, postgres=arguments.engine == "postgresql") as databases:
        for database in databases:
            print(f"{database.folder}: {database.environments} environments")


if __name__ == "__main__":
    main()
