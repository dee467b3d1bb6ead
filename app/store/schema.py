"""Migrations: Alembic's, run from code; in a checkout they lie in ``migrations``, in a wheel in ``app/_migrations``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from sqlalchemy import exc, inspect, text

from app.errors import Unavailable
from app.store.database import Database
from app.store.tables import metadata

if TYPE_CHECKING:
    from alembic.config import Config

LOCK = 4_820_117_001
"""PostgreSQL's advisory lock: two servers that start together migrate one after the other."""


def folder() -> Path:
    """Where the migrations are."""
    package = Path(__file__).resolve().parents[1]
    for path in (package / "_migrations", package.parent / "migrations"):
        if (path / "env.py").is_file():
            return path
    raise Unavailable("the migrations are missing from this installation: install it again")


def config() -> Config:
    """Alembic's settings, without a file. (It is imported late: worker processes never need it.)"""
    from alembic.config import Config

    alembic_config = Config()
    alembic_config.set_main_option("script_location", str(folder()).replace("%", "%%"))
    alembic_config.set_main_option("path_separator", "os")
    return alembic_config


def comparison(dialect: str) -> dict[str, Any]:
    """Options for Alembic to compare a database with the models: without PostGIS' own tables, and without the indexes
    that another dialect has.
    """

    def ours(thing: Any, name: str | None, kind: str, reflected: bool, compared_to: Any) -> bool:
        del compared_to
        if kind == "table":
            return name in metadata.tables
        return kind != "index" or reflected or thing.info.get("dialect", dialect) == dialect

    return {"compare_type": True, "include_object": ours}


def newest() -> str:
    """This release's revision: files of migrations start with theirs."""
    return max(path.name.partition("_")[0] for path in (folder() / "versions").glob("[0-9]*_*.py"))


def _present(database: Database) -> str | None:
    """The revision of the database's schema; None where it has none. (Alembic's own look takes ten times as long.)"""
    with database.connection() as connection:
        if not inspect(connection).has_table("alembic_version"):
            return None
        return connection.execute(text("SELECT version_num FROM alembic_version")).scalar_one_or_none()


def upgrade(database: Database) -> None:
    """To the newest schema."""
    if _present(database) == newest():
        return
    from alembic import command
    from alembic.util import CommandError

    settings = config()
    with database.connection() as connection:
        connection.execution_options(write=True)
        try:
            with connection.begin():
                if not database.sqlite:
                    connection.exec_driver_sql(f"SELECT pg_advisory_xact_lock({LOCK})")
                settings.attributes["connection"] = connection
                command.upgrade(settings, "head")
        except CommandError as error:
            raise Unavailable(
                "the database was made by a newer release of this server: run that release, or restore a backup of "
                "the database that is as old as this one"
            ) from error
        except exc.ProgrammingError as error:
            raise Unavailable(
                f"the database cannot be migrated: {str(error.orig).splitlines()[0]}. On PostgreSQL PostGIS must be "
                "installed, and created in the database by a superuser where ours may not: CREATE EXTENSION postgis"
            ) from error


def check(database: Database) -> None:
    """Unavailable unless the schema is the newest."""
    present = _present(database)
    if present != newest():
        raise Unavailable(
            f"the database's schema is {present or 'not there'}, this release needs {newest()}: run fleetmap migrate"
        )
