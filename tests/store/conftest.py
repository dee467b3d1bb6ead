"""Conformance suite for both databases: each test with ``database_url`` or ``store`` runs on both."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest

from app.store.store import Store
from tests.postgres import Cluster
from tests.store.samples import DATUM

DATABASES = ["sqlite", pytest.param("postgres", marks=pytest.mark.postgres)]


@pytest.fixture(params=DATABASES)
def empty_database_url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """URL of a database without a schema."""
    if request.param == "sqlite":
        return f"sqlite:///{tmp_path / 'fleetmap.sqlite'}"
    url: str = request.getfixturevalue("postgres_url")
    return url


@pytest.fixture(scope="session")
def migrated_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Empty SQLite database with the schema: copying it takes a hundredth of the time of migrating."""
    folder = tmp_path_factory.mktemp("migrated")
    migrated(f"sqlite:///{folder / 'fleetmap.sqlite'}", folder)
    return folder / "fleetmap.sqlite"


@pytest.fixture(scope="session")
def migrated_database(postgres_cluster: Cluster, tmp_path_factory: pytest.TempPathFactory) -> str:
    """Template database with the schema in PostgreSQL."""
    name = postgres_cluster.create_database()
    migrated(postgres_cluster.url(name), tmp_path_factory.mktemp("migrated"))
    return name


def migrated(url: str, folder: Path) -> None:
    store = Store(url, folder / "blobs")
    store.migrate()
    store.close()


@pytest.fixture(params=DATABASES)
def database_url(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    """URL of an empty database with the schema."""
    if request.param == "sqlite":
        path = tmp_path / "fleetmap.sqlite"
        shutil.copyfile(request.getfixturevalue("migrated_file"), path)
        yield f"sqlite:///{path}"
        return
    cluster: Cluster = request.getfixturevalue("postgres_cluster")
    name = cluster.create_database(request.getfixturevalue("migrated_database"))
    yield cluster.url(name)
    cluster.drop_database(name)


@pytest.fixture
def store(database_url: str, tmp_path: Path) -> Iterator[Store]:
    """A migrated store."""
    new_store = Store(database_url, tmp_path / "blobs")
    new_store.migrate()
    yield new_store
    new_store.close()


NOW = datetime(2030, 1, 1, tzinfo=UTC)


class Clock:
    """Clock that a test sets."""

    now = NOW

    def __call__(self) -> datetime:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def farm(store: Store, clock: Clock) -> Iterator[Store]:
    """Store with an environment ``farm`` at version 1, and a clock."""
    timed = Store(store.database_url, store.blob_dir, clock=clock)
    timed.environments.create("farm", datum=DATUM)
    yield timed
    timed.close()


def count(store: Store, table: str) -> int:
    """Count the rows of a table."""
    with store._database.read() as connection:
        return int(connection.exec_driver_sql(f"SELECT count(*) FROM {table}").scalar_one())


@pytest.fixture
def sqlite_store(tmp_path: Path, migrated_file: Path) -> Iterator[Store]:
    """A store on SQLite, for tests that do not depend on the database."""
    shutil.copyfile(migrated_file, tmp_path / "only.sqlite")
    new_store = Store(f"sqlite:///{tmp_path / 'only.sqlite'}", tmp_path / "only-blobs")
    new_store.migrate()
    yield new_store
    new_store.close()
