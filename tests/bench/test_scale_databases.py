"""The databases of the scale bench, in a small size: what fills SQLite, and its copy on PostgreSQL."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy import select

from app.store import tables
from app.store.backup_tables import stored_columns
from app.store.column_types import Grams
from app.store.store import Store
from tests.bench import scale_site
from tests.bench.scale_databases import FILE, FilledDatabase, _on_postgresql, _on_sqlite
from tests.bench.scale_site import NODES, SHORT, fill, name_of
from tests.postgres import Cluster

ENVIRONMENTS = 3
VERSIONS = SHORT + 2
"""So many that environments share a history."""

NAMES = [name_of(k) for k in range(ENVIRONMENTS)]


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> FilledDatabase:
    """A filled SQLite database."""
    return _on_sqlite(tmp_path_factory.mktemp("sqlite"), ENVIRONMENTS, VERSIONS)


@pytest.fixture
def copy(source: FilledDatabase, postgres_cluster: Cluster, tmp_path: Path) -> Iterator[FilledDatabase]:
    """Its copy on PostgreSQL."""
    yield _on_postgresql(postgres_cluster, tmp_path, source)
    postgres_cluster.drop_database(source.folder.name)


def opened(database: FilledDatabase) -> Store:
    return Store(database.url, database.folder / "blobs")


def rows(store: Store) -> dict[str, list[str]]:
    """All rows of each table, but for what the databases store in different ways."""
    out = {}
    with store.transaction() as connection:
        for table in tables.metadata.sorted_tables:
            columns = [column for column in stored_columns(table) if not isinstance(column.type, Grams)]
            out[table.name] = sorted(repr(tuple(row)) for row in connection.execute(select(*columns)))
    return out


def check_sites(store: Store) -> None:
    """Check environments, versions and search."""
    assert [e.name for e in store.environments.page()[0]] == NAMES
    for k, name in enumerate(NAMES):
        head = store.versions.get(name)
        assert head.number == VERSIONS
        assert len(store.content.load(head).parts[scale_site.TOPOLOGY]) == NODES
        for text in (f"Dock {k}-7", f"ock {k}-7"):  # by its beginning, and in the middle
            hits, has_more = store.search.find(text, limit=10)
            assert [(hit.environment, hit.name) for hit in hits] == [(name, f"Dock {k}-7")]
            assert not has_more


def test_filling_goes_on_where_it_was_interrupted(source: FilledDatabase, tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / FILE}"
    fill(url, tmp_path, ENVIRONMENTS - 1, VERSIONS)
    fill(url, tmp_path, ENVIRONMENTS, VERSIONS)
    store, at_once = Store(url, tmp_path / "blobs"), opened(source)
    check_sites(store)
    check_sites(at_once)
    assert [store.versions.get(name).root for name in NAMES] == [at_once.versions.get(name).root for name in NAMES]
    store.close()
    at_once.close()


@pytest.mark.postgres
def test_copy_on_postgresql_has_the_same_rows_and_can_be_searched_and_changed(
    source: FilledDatabase, copy: FilledDatabase
) -> None:
    first, second = opened(source), opened(copy)
    before = rows(first)
    assert before == rows(second)
    assert len(before["version"]) >= ENVIRONMENTS * VERSIONS
    assert len(before["environment"]) == ENVIRONMENTS
    check_sites(second)
    second.environments.create("later")
    assert [e.name for e in second.environments.page()[0]] == ["later", *NAMES]
    first.close()
    second.close()
