"""An index of names in the database, and indexes that find the environments whose indexes are behind.

Revision ID: 0020
Revises: 0019
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

from app.store.column_types import Grams, UtcDateTime, binary_text

revision = "0020"
down_revision = "0019"
branch_labels = None
depends_on = None
min_compatible = "0018"

COLUMNS = ("environment", "node", "zone", "object")
"""Columns of ``search_text``, by the kind of item: a search looks at one kind."""


def upgrade() -> None:
    stored = op.get_bind().dialect.name == "postgresql"  # SQLite can only add columns that it computes when read
    for column in (
        sa.Column("index_stale", sa.Boolean, sa.Computed("indexed <> head", persisted=stored)),
        sa.Column("search_version", sa.Integer, nullable=False, server_default="-1"),
        sa.Column("search_sequence", sa.BigInteger, nullable=False, server_default="-1"),
        sa.Column("search_updated", UtcDateTime, nullable=True),
        sa.Column(
            "search_stale",
            sa.Boolean,
            sa.Computed("(search_sequence = sequence AND search_updated = updated) IS NOT TRUE", persisted=stored),
        ),
    ):
        op.add_column("environment", column)
    for name in ("index_stale", "search_stale"):
        op.create_index(f"ix_environment_{name}", "environment", [name])
    op.create_table(
        "search_item",
        sa.Column("id", sa.BigInteger().with_variant(sa.Integer, "sqlite"), nullable=False),
        sa.Column("environment_id", sa.String(32), nullable=False),
        sa.Column("environment", binary_text(63), nullable=False),
        sa.Column("kind", sa.SmallInteger, nullable=False),
        sa.Column("level", sa.String(256), nullable=False),
        sa.Column("part", sa.String(256), nullable=False),
        sa.Column("feature", sa.String(512), nullable=False),
        sa.Column("name", sa.Text, nullable=False),
        sa.Column("folded", binary_text(), nullable=False),
        sa.Column("folded_id", binary_text(), nullable=True),
        sa.Column("x", sa.Float(53), nullable=True),
        sa.Column("y", sa.Float(53), nullable=True),
        sa.Column("grams", Grams, nullable=True),
        sa.PrimaryKeyConstraint("id", name="pk_search_item"),
        sa.ForeignKeyConstraint(
            ["environment_id"], ["environment.id"], name="fk_search_item_environment_id", ondelete="CASCADE"
        ),
    )
    op.create_index("ix_search_item_feature", "search_item", ["environment_id", "feature"])
    op.create_index("ix_search_item_folded", "search_item", ["kind", "folded", "environment"])
    op.create_index("ix_search_item_folded_id", "search_item", ["kind", "folded_id", "environment"])
    if op.get_bind().dialect.name == "postgresql":
        op.create_index("ix_search_item_grams", "search_item", ["grams"], postgresql_using="gin")
    else:
        _create_text_index()


def _create_text_index() -> None:
    """Create the index of all three characters in a row, without a copy of the texts.

    Two line ends after each text let the last characters begin such a group, too.
    """
    op.execute(
        f"CREATE VIRTUAL TABLE search_text USING fts5({', '.join(COLUMNS)}, content='', columnsize=0, detail='column', "
        "tokenize='trigram case_sensitive 1')"
    )
    op.execute("CREATE VIRTUAL TABLE search_term USING fts5vocab('search_text', 'instance')")
    for event, row, command in (("INSERT", "new", ""), ("DELETE", "old", "'delete', ")):
        text = f"{row}.folded || char(10, 10) || coalesce({row}.folded_id || char(10, 10), '')"
        values = ", ".join(f"CASE {row}.kind WHEN {kind} THEN {text} END" for kind in range(len(COLUMNS)))
        target = "search_text, rowid" if command else "rowid"
        statement = f"INSERT INTO search_text({target}, {', '.join(COLUMNS)}) VALUES ({command}{row}.id, {values})"  # noqa: S608
        op.execute(f"CREATE TRIGGER search_item_{event.lower()} AFTER {event} ON search_item BEGIN {statement}; END")


def downgrade() -> None:
    if op.get_bind().dialect.name == "sqlite":
        op.execute("DROP TABLE search_term")
        op.execute("DROP TABLE search_text")
    op.drop_table("search_item")
    for name in ("index_stale", "search_stale"):
        op.drop_index(f"ix_environment_{name}", "environment")
    for name in ("search_stale", "search_updated", "search_sequence", "search_version", "index_stale"):
        op.drop_column("environment", name)
