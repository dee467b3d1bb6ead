"""Migrations create exactly the tables of the models, on both databases."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path

import pytest
import sqlalchemy as sa
from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory

from app.errors import Unavailable
from app.main import startup_lock
from app.store.database import Database
from app.store.fleet_values import ReceivedReport, RobotReport
from app.store.schema import RECORDED_SINCE, comparison, config, newest
from app.store.store import Store
from app.store.tables import metadata, server


def test_models_and_migrations_are_equal(store: Store, database_url: str):
    database = Database(database_url, readonly=False)
    with database.engine.connect() as connection:
        context = MigrationContext.configure(connection, opts=comparison(connection.dialect.name))
        assert compare_metadata(context, metadata) == []
    database.close()


def test_schema_comparison_finds_missing_column(store: Store, database_url: str):
    database = Database(database_url, readonly=False)
    with database.write() as connection:
        connection.exec_driver_sql("ALTER TABLE job DROP COLUMN detail")
    with database.engine.connect() as connection:
        differences = compare_metadata(MigrationContext.configure(connection), metadata)
    database.close()
    assert any(d[0] == "add_column" and d[3].name == "detail" for d in differences if isinstance(d, tuple))


def test_repeated_migration_changes_nothing(store: Store):
    store.migrate()
    store.check()


def test_migration_vouches_for_existing_robots(store: Store, database_url: str):
    store.environments.create("farm")
    report = RobotReport("latest", 0, "a" * 64, "active")
    store.robots.note_reports([ReceivedReport("farm", "old", report, datetime.now(UTC), vouched=False)])
    settings = config()
    before = ScriptDirectory.from_config(settings).get_revision("0008").down_revision
    database = Database(database_url, readonly=False)
    with database.engine.connect() as connection:
        connection.execution_options(write=True)
        with connection.begin():
            settings.attributes["connection"] = connection
            command.downgrade(settings, str(before))
    database.close()
    store.migrate()
    assert [r.vouched for r in store.robots.all("farm")] == [True]


def test_schema_check_fails_before_migration(empty_database_url: str, tmp_path: Path):
    store = Store(empty_database_url, tmp_path / "b")
    with pytest.raises(Unavailable, match="fleetmap migrate"):
        store.check()
    store.close()


def test_missing_database_raises_unavailable(tmp_path: Path):
    store = Store("postgresql+psycopg://nobody@127.0.0.1:1/none", tmp_path / "b")
    with pytest.raises(Unavailable):
        store.check()
    with pytest.raises(Unavailable):
        store.environments.get("farm")
    store.close()


def test_sqlite_commits_are_durable(sqlite_store: Store):
    with sqlite_store._database.engine.connect() as connection:
        pragma = {
            name: connection.exec_driver_sql(f"PRAGMA {name}").scalar_one()
            for name in ("journal_mode", "synchronous", "foreign_keys", "busy_timeout")
        }
    assert pragma == {"journal_mode": "wal", "synchronous": 2, "foreign_keys": 1, "busy_timeout": 5000}


@pytest.mark.postgres
def test_postgres_has_gist_indexes_and_uncompressed_chunks(postgres_url: str, tmp_path: Path):
    store = Store(postgres_url, tmp_path / "b")
    store.migrate()
    with store._database.engine.connect() as connection:
        methods = connection.execute(
            sa.text(
                "SELECT c.relname FROM pg_class c JOIN pg_am a ON a.oid = c.relam WHERE a.amname = 'gist' "
                "AND c.relname LIKE 'ix\\_%' ORDER BY 1"
            )
        ).scalars()
        assert list(methods) == ["ix_area_geometry", "ix_environment_extent", "ix_place_geometry"]
        storage = connection.execute(
            sa.text("SELECT attstorage FROM pg_attribute WHERE attrelid = 'chunk'::regclass AND attname = 'data'")
        ).scalar_one()
        assert storage in ("e", b"e")
    store.close()


def test_newest_revision_follows_from_migration_files() -> None:
    assert newest() == ScriptDirectory.from_config(config()).get_current_head()


def test_migrations_declare_what_they_are_compatible_with() -> None:
    script = ScriptDirectory.from_config(config())
    declared = {
        revision.revision: revision.module.min_compatible
        for revision in script.walk_revisions()
        if revision.revision >= RECORDED_SINCE
    }
    assert declared
    assert all(RECORDED_SINCE <= compatible <= revision for revision, compatible in declared.items())
    for revision, compatible in declared.items():
        text = Path(script.get_revision(revision).path).read_text().partition("def downgrade")[0]
        removes = any(word in text for word in ("op.drop_", "op.rename_", "DROP ", "RENAME "))
        assert not removes or compatible == revision, f"{revision} removes what older releases may use"


def test_release_uses_newer_schema_that_is_compatible(store: Store, database_url: str) -> None:
    database = Database(database_url, readonly=False)
    script = ScriptDirectory.from_config(config())
    declared = [r.module.min_compatible for r in script.walk_revisions() if r.revision >= RECORDED_SINCE]
    with database.write() as connection:
        assert connection.execute(sa.select(server.c.min_compatible)).scalar_one() == max(declared)
        connection.exec_driver_sql("UPDATE alembic_version SET version_num = '9999'")
    store.check()
    store.migrate()
    store.initialise()
    with database.write() as connection:
        connection.execute(sa.update(server).values(min_compatible="9998"))
    for refused in (store.check, store.migrate):
        with pytest.raises(Unavailable, match="requires a release with schema 9998 or newer, and this one has"):
            refused()
    database.close()


def test_concurrent_servers_create_one_administrator(empty_database_url: str, tmp_path: Path) -> None:
    def start(number: int) -> str | None:
        store = Store(empty_database_url, tmp_path / "blobs")
        try:
            with startup_lock(tmp_path):
                store.migrate()
            store.check()
            return store.tokens.create_administrator()
        finally:
            store.close()

    with ThreadPoolExecutor(6) as threads:
        tokens = list(threads.map(start, range(6)))
    assert sum(secret is not None for secret in tokens) == 1
    store = Store(empty_database_url, tmp_path / "blobs")
    assert [token.role for token in store.tokens.all()] == ["admin"]
    assert store.tokens.find(next(filter(None, tokens))) is not None
    store.close()
