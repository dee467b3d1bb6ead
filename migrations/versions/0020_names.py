"""An index of names, indexes that find the environments whose indexes are behind, and counts of robots.

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

    _create_tally()


TALLIED = ("channel", "state", "root", "held_root", "held_overlays", "vouched")
"""Columns of ``robot`` by which robots are counted."""


def _create_tally() -> None:
    """Create the counts of robots, with the triggers that keep them, whichever release writes."""
    op.create_table(
        "robot_tally",
        sa.Column("id", sa.BigInteger().with_variant(sa.Integer, "sqlite"), nullable=False),
        sa.Column("environment_id", sa.String(32), nullable=False),
        sa.Column("channel", sa.String(63), nullable=False),
        sa.Column("state", sa.String(16), nullable=False),
        sa.Column("root", sa.String(64), nullable=False),
        sa.Column("held_root", sa.String(64), nullable=True),
        sa.Column("held_overlays", sa.String(64), nullable=True),
        sa.Column("vouched", sa.Boolean, nullable=False),
        sa.Column("number", sa.Integer, nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_robot_tally"),
    )
    op.create_index("ix_robot_tally_environment", "robot_tally", ["environment_id", "id"])
    op.create_index("ix_robot_held", "robot", ["environment_id", "channel", "held_since"])
    columns = ", ".join(("environment_id", *TALLIED))
    target = f"INSERT INTO robot_tally ({columns}, number)"
    op.execute(f"{target} SELECT {columns}, count(*) FROM robot GROUP BY {columns}")  # noqa: S608 - only names
    values = {row: ", ".join(f"{row}.{name}" for name in ("environment_id", *TALLIED)) for row in ("new", "old")}
    come, go = f"{target} VALUES ({values['new']}, 1)", f"{target} VALUES ({values['old']}, -1)"
    events = (("insert", "INSERT", come), ("delete", "DELETE", go), ("update", "UPDATE", f"{go}; {come}"))
    is_postgres = op.get_bind().dialect.name == "postgresql"
    different = "IS DISTINCT FROM" if is_postgres else "IS NOT"
    changed = " OR ".join(f"old.{name} {different} new.{name}" for name in TALLIED)
    for name, event, statements in events:
        condition = f"WHEN ({changed}) " if event == "UPDATE" else ""
        trigger = f"CREATE TRIGGER robot_tally_{name} AFTER {event} ON robot FOR EACH ROW {condition}"
        if is_postgres:
            op.execute(
                f"CREATE FUNCTION robot_tally_{name}() RETURNS trigger LANGUAGE plpgsql AS "
                f"$$ BEGIN {statements}; RETURN NULL; END $$"
            )
            op.execute(f"{trigger} EXECUTE FUNCTION robot_tally_{name}()")
        else:
            op.execute(f"{trigger} BEGIN {statements}; END")


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
    for name in ("insert", "delete", "update"):
        if op.get_bind().dialect.name == "sqlite":
            op.execute(f"DROP TRIGGER robot_tally_{name}")
        else:
            op.execute(f"DROP FUNCTION robot_tally_{name} CASCADE")
    op.drop_index("ix_robot_held", "robot")
    op.drop_table("robot_tally")
    if op.get_bind().dialect.name == "sqlite":
        op.execute("DROP TABLE search_term")
        op.execute("DROP TABLE search_text")
    op.drop_table("search_item")
    for name in ("index_stale", "search_stale"):
        op.drop_index(f"ix_environment_{name}", "environment")
    for name in ("search_stale", "search_updated", "search_sequence", "search_version", "index_stale"):
        op.drop_column("environment", name)
