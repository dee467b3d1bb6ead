"""Alembic's entry point: uses the connection from the store, or for developers the URL of alembic.ini."""

from __future__ import annotations

import os

from alembic import context
from sqlalchemy import Connection

from app.store.schema import comparison, note_compatibility
from app.store.tables import metadata


def run(connection: Connection) -> None:
    """Run the migrations in the transaction of the connection."""
    context.configure(
        connection=connection,
        target_metadata=metadata,
        **comparison(connection.dialect.name),
        render_as_batch=connection.dialect.name == "sqlite",
        transaction_per_migration=False,
    )
    with context.begin_transaction():
        context.run_migrations()
        note_compatibility(connection, context.script)


def main() -> None:
    given = context.config.attributes.get("connection")
    if given is not None:
        run(given)
        return
    from app.store.database import Database

    url = os.environ.get("FLEETMAP_DATABASE_URL") or context.config.get_main_option("sqlalchemy.url")
    database = Database(str(url), readonly=False)
    with database.write() as connection:
        run(connection)
    database.close()


main()
