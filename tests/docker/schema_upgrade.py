"""Migration of a later release, made up for tests: it only adds to what this release reads and writes."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from app.store import schema
from app.store.database import Database

LATER = "9001"
MIGRATION = '''
"""A column and an index that this release does not know."""

import sqlalchemy as sa
from alembic import op

revision = "{revision}"
down_revision = "{newest}"
branch_labels = None
depends_on = None
min_compatible = "{newest}"


def upgrade() -> None:
    op.add_column("version", sa.Column("later", sa.String(64), nullable=True))
    op.add_column("job", sa.Column("later", sa.Boolean, nullable=False, server_default=sa.false()))
    op.create_index("ix_version_later", "version", ["later"])
'''


def upgrade_to_later_revision(database_url: str) -> None:
    """Apply this release's migrations and a later one, as ``fleetmap migrate`` of the next release does."""
    from alembic import command

    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "migrations"
        shutil.copytree(schema.folder(), folder, ignore=shutil.ignore_patterns("__pycache__"))
        text = MIGRATION.format(revision=LATER, newest=schema.newest())
        (folder / "versions" / f"{LATER}_later.py").write_text(text)
        settings = schema.config()
        settings.set_main_option("script_location", str(folder))
        database = Database(database_url, readonly=False)
        try:
            with database.connection() as connection:
                connection.execution_options(write=True)
                with connection.begin():
                    settings.attributes["connection"] = connection
                    command.upgrade(settings, "head")
        finally:
            database.close()
