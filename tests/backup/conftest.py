"""A store with everything in it, on both databases, and its backups in a folder."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select

from app.backends.lead import open_leads
from app.backup.create import KeyBundle
from app.backup.keys import collect_keys, key_documents, place_keys
from app.backup.restore import RestoreResult
from app.backup.service import BackupOptions, BackupResult, BackupService, choose_restorable, opened_place, restore
from app.store.backup_tables import dumped_tables, order_of, stored_columns
from app.store.store import Store
from app.store.values import Source
from tests.store.conftest import database_url, migrated_database, migrated_file
from tests.store.samples import GRID, everything, grid, replaces, save

__all__ = ["database_url", "migrated_database", "migrated_file"]


@pytest.fixture
def store(database_url: str, tmp_path: Path) -> Iterator[Store]:
    """A store with two versions of every kind of part, sources, a channel, a token and an overlay's events."""
    with closing(Store(database_url, tmp_path / "blobs")) as store:
        store.migrate()
        fill(store)
        yield store


@pytest.fixture
def sqlite_store(migrated_file: Path, tmp_path: Path) -> Iterator[Store]:
    """The same on SQLite only."""
    shutil.copyfile(migrated_file, tmp_path / "only.sqlite3")
    with closing(Store(f"sqlite:///{tmp_path / 'only.sqlite3'}", tmp_path / "only-blobs")) as store:
        store.migrate()
        fill(store)
        yield store


def fill(store: Store) -> None:
    store.environments.create("farm")
    names = store.blobs.put_many([bytes(range(256)) * 500, b"small", b"other"])
    sources = [Source(f"f{k}", 1, name) for k, name in enumerate(names)]
    prepared = store.versions.prepare(store.versions.get("farm"), changes_of_everything())
    store.versions.commit("farm", prepared, author="ann", message="all", sources=sources)
    save(store, "farm", *replaces({GRID: grid(seed=5)}))
    store.channels.move("farm", "production", 1, author="ann")
    store.tokens.create("robots", "viewer")
    with store._database.write() as connection:  # equal rows in two tables
        connection.exec_driver_sql("UPDATE relay SET position = (SELECT position FROM log)")


def changes_of_everything() -> Any:
    from app.store.changes import Changes

    return Changes(replaces(everything()))


def back_up(
    store: Store, place: Path | str, folder: Path, *, keys: KeyBundle | None = None, wait: float = 30.0, **options: Any
) -> BackupResult:
    """Back up a store whose data folder is this one."""
    folder.mkdir(exist_ok=True)
    with closing(open_leads(store.database_url, folder)) as leads:
        leads.start()
        bundle = collect_keys(store, folder / "keys", None, include=False) if keys is None else keys
        return BackupService(store, leads, wait_seconds=wait).back_up(str(place), bundle, BackupOptions(**options))


def restore_into(
    store: Store, place: Path | str, folder: Path, snapshot: str | None = None, identities: tuple[str, ...] = ()
) -> RestoreResult:
    """Restore a backup into a store whose data folder is this one."""
    folder.mkdir(exist_ok=True)

    def bring(documents: Mapping[str, bytes]) -> None:
        place_keys(store, folder / "keys", documents)

    from app.signing import exported_key_ids

    present = key_documents(store, folder / "keys").get("keys")
    ids = [] if present is None else exported_key_ids(present)
    with opened_place(str(place), folder, key=lambda _: None, identities=identities) as repository:
        chosen = choose_restorable(repository, snapshot)
        return restore(store, repository, chosen, present_keys=ids, place_keys=bring)


NewStore = Callable[[], Store]


@pytest.fixture
def empty_store(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[NewStore]:
    """Function that opens an empty place, without a schema, on the database of the test's store."""
    opened: list[Store] = []
    names: list[str] = []
    is_postgres = "postgres" in request.node.name

    def open_one() -> Store:
        number = len(opened)
        url = f"sqlite:///{tmp_path / f'restored{number}.sqlite3'}"
        if is_postgres:
            cluster = request.getfixturevalue("postgres_cluster")
            names.append(cluster.create_database())
            url = cluster.url(names[-1])
        opened.append(Store(url, tmp_path / f"restored{number}" / "blobs"))
        return opened[-1]

    yield open_one
    for one in opened:
        one.close()
    for name in names:
        request.getfixturevalue("postgres_cluster").drop_database(name)


Rows = dict[str, list[tuple[Any, ...]]]


def rows_of(store: Store) -> Rows:
    """Read the rows of all tables that a backup contains."""
    out = {}
    with store._database.read() as connection:
        for table in dumped_tables():
            columns = [c for c in stored_columns(table) if c.name not in MADE_ANEW]
            if table.name not in ("document", "collection", "alembic_version"):
                out[table.name] = [tuple(r) for r in connection.execute(select(*columns).order_by(*order_of(table)))]
    return out


MADE_ANEW = {
    *("area_stale", "epoch", "presence_checked"),
    *("search_version", "search_sequence", "search_updated"),
}
"""Columns that a restore changes."""
