"""Alembic migrations, run from code: ``migrations`` in a checkout, ``app/_migrations`` in a wheel."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from sqlalchemy import Connection, exc, inspect, select, text, update

from app.errors import Unavailable
from app.store.database import Database
from app.store.tables import metadata, server

if TYPE_CHECKING:
    from alembic.config import Config
    from alembic.script import ScriptDirectory

RECORDED_SINCE = "0016"
"""First revision that states its ``min_compatible``: the revision of the oldest release that can use the schema."""

RESTORING = "restoring-"
"""Begin of the revision of a database that a backup is being restored into: no server may use it."""

LOCK = 4_820_117_001
"""Key of PostgreSQL's advisory lock: two servers that start together migrate one after the other."""


def folder() -> Path:
    """Return the folder of the migrations."""
    package = Path(__file__).resolve().parents[1]
    for path in (package / "_migrations", package.parent / "migrations"):
        if (path / "env.py").is_file():
            return path
    raise Unavailable("the migrations are missing from this installation: reinstall it")


def config() -> Config:
    """Create Alembic's configuration without a file. (Late import: worker processes never need Alembic.)"""
    from alembic.config import Config

    alembic_config = Config()
    alembic_config.set_main_option("script_location", str(folder()).replace("%", "%%"))
    alembic_config.set_main_option("path_separator", "os")
    return alembic_config


def comparison(dialect: str) -> dict[str, Any]:
    """Return Alembic's options for comparing a database with the models.

    They exclude PostGIS' own tables, and the indexes of the other dialect.
    """

    def ours(thing: Any, name: str | None, kind: str, reflected: bool, compared_to: Any) -> bool:
        del compared_to
        if kind == "table":
            return name in metadata.tables
        return kind != "index" or reflected or thing.info.get("dialect", dialect) == dialect

    return {"compare_type": True, "include_object": ours}


def newest() -> str:
    """Return this release's revision: the file name of a migration starts with its revision."""
    return max(path.name.partition("_")[0] for path in (folder() / "versions").glob("[0-9]*_*.py"))


def _present(database: Database) -> tuple[str | None, str]:
    """Return the revision of the database's schema (None without one) and the oldest one that is compatible with it.

    Alembic's own query takes ten times as long.
    """
    with database.connection() as connection:
        inspector = inspect(connection)
        if not inspector.has_table("alembic_version"):
            return None, ""
        present = connection.execute(text("SELECT version_num FROM alembic_version")).scalar_one_or_none()
        compatible = None
        if present is not None and present >= RECORDED_SINCE:
            compatible = connection.execute(select(server.c.min_compatible)).scalar_one_or_none()
    return present, compatible or present or ""


def note_compatibility(connection: Connection, script: ScriptDirectory) -> None:
    """Store, at the end of a migration, the oldest revision whose release can use the schema. It never decreases."""
    present = connection.execute(text("SELECT version_num FROM alembic_version")).scalar_one_or_none()
    if present is None or present < RECORDED_SINCE:
        return
    declared = [
        revision.module.min_compatible
        for revision in script.iterate_revisions(present, "base")
        if revision.revision >= RECORDED_SINCE
    ]
    connection.execute(update(server).values(min_compatible=max(declared)))


def present_revision(database: Database) -> str | None:
    """Return the revision of the database's schema, None without one."""
    return _present(database)[0]


def create_for_restore(database: Database, revision: str) -> None:
    """Create the schema of a revision in an empty database, marked so that no server uses it.

    Raises Unavailable as ``upgrade``.
    """
    _migrate(database, revision, marked=True)


def upgrade_restored(database: Database) -> None:
    """Migrate a database that is marked as being restored to the newest schema; it stays marked."""
    present = present_revision(database) or ""
    if present != RESTORING + newest():
        _migrate(database, "head", marked=True, present=present.removeprefix(RESTORING))


def unmark_restored(connection: Connection) -> None:
    """Let servers use a database that was restored, with the newest schema."""
    connection.execute(text("UPDATE alembic_version SET version_num = :revision"), {"revision": newest()})


def is_empty(database: Database) -> bool:
    """Return whether the database has no schema yet."""
    return _present(database)[0] is None


def upgrade(database: Database) -> None:
    """Migrate the database to the newest schema. A compatible newer one stays as it is.

    Raises Unavailable if this release cannot use it.
    """
    present, compatible = _present(database)
    _check_restored(present)
    if present == newest():
        return
    if present is not None and present > newest():
        _check_compatible(present, compatible)
        return
    _migrate(database, "head")


def _migrate(database: Database, target: str, *, marked: bool = False, present: str | None = None) -> None:
    """Migrate in one transaction. marked: leave the database marked as being restored.

    present: revision of a database that is marked.
    """
    from alembic import command
    from alembic.util import CommandError

    settings = config()
    with database.connection() as connection:
        connection.execution_options(write=True)
        try:
            with connection.begin():
                if not database.sqlite:
                    connection.exec_driver_sql(f"SELECT pg_advisory_xact_lock({LOCK})")
                if present is not None:
                    connection.execute(text("UPDATE alembic_version SET version_num = :present"), {"present": present})
                settings.attributes["connection"] = connection
                command.upgrade(settings, target)
                if marked:
                    mark = {"mark": RESTORING}
                    connection.execute(text("UPDATE alembic_version SET version_num = :mark || version_num"), mark)
        except CommandError as error:  # a newer release has migrated it in the meantime
            raise Unavailable("another server is migrating the database: start this one again") from error
        except exc.ProgrammingError as error:
            raise Unavailable(
                f"the database cannot be migrated: {str(error.orig).splitlines()[0]}. On PostgreSQL PostGIS must be "
                "installed; if the server's user may not create it, run as a superuser: CREATE EXTENSION postgis"
            ) from error


def check(database: Database) -> None:
    """Raise Unavailable unless this release can use the schema: it is the newest, or a newer one that is compatible."""
    present, compatible = _present(database)
    _check_restored(present)
    if present is None or present < newest():
        raise Unavailable(
            f"the database's schema is {present or 'missing'}, this release needs {newest()}: run fleetmap migrate"
        )
    _check_compatible(present, compatible)


def _check_restored(present: str | None) -> None:
    if present is not None and present.startswith(RESTORING):
        raise Unavailable(
            "a backup is being restored into this database, or that was interrupted: wait until `fleetmap restore` has "
            "ended, or run it again"
        )


def _check_compatible(present: str, compatible: str) -> None:
    if newest() < compatible:
        raise Unavailable(
            f"the database was migrated by a newer release of this server: its schema is {present}, which requires a "
            f"release with schema {compatible} or newer, and this one has {newest()}: run that release, or restore a "
            "backup of the database from this release"
        )
