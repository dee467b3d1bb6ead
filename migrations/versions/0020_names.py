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

KINDS = ("environment", "node", "zone", "object")
"""Kinds of items in ``search_item``, by their number."""

GRAMS = "content='', columnsize=0, detail='none', tokenize='trigram case_sensitive 1'"
"""Options of an index of all three characters in a row, without a copy of the texts."""

ENDS = "char(10, 10)"
"""Two line ends after a text let its last characters begin such a group, too."""

BOXES = """
CREATE TABLE box_number (
    number INTEGER PRIMARY KEY, environment_id VARCHAR(32) NOT NULL, piece INTEGER NOT NULL,
    UNIQUE (environment_id, piece));
CREATE VIRTUAL TABLE box_tree USING rtree(number, west, east, south, north);
CREATE VIRTUAL TABLE environment_text USING fts5(text, {GRAMS});
INSERT INTO box_number (environment_id, piece) SELECT id, -1 FROM environment;
INSERT INTO box_number (environment_id, piece) SELECT environment_id, piece FROM area;
INSERT INTO box_tree SELECT number, {BOX} FROM environment AS row
    JOIN box_number ON environment_id = row.id AND piece = -1 WHERE row.south IS NOT NULL;
INSERT INTO box_tree SELECT number, {BOX} FROM area AS row JOIN box_number USING (environment_id, piece);
INSERT INTO environment_text (rowid, text) SELECT number, {TEXT} FROM environment AS row
    JOIN box_number ON environment_id = row.id AND piece = -1;
"""
"""Indexes of SQLite that find environments by box and by text, and pieces of areas by box.

They need a number that never changes: ``box_number`` has one of each piece, and of each environment as piece -1.
"""

TRIGGERS = {
    "environment_index_insert AFTER INSERT ON environment": """
INSERT INTO box_number (environment_id, piece) VALUES (new.id, -1);
INSERT INTO box_tree SELECT {NEW}, {BOX_NEW} WHERE new.south IS NOT NULL;
INSERT INTO environment_text (rowid, text) VALUES ({NEW}, {TEXT_NEW});""",
    "environment_index_delete AFTER DELETE ON environment": """
INSERT INTO environment_text (environment_text, rowid, text) VALUES ('delete', {OLD}, {TEXT_OLD});
DELETE FROM box_tree WHERE number = {OLD};
DELETE FROM box_number WHERE environment_id = old.id AND piece = -1;""",
    "environment_box_update AFTER UPDATE OF west, east, south, north ON environment WHEN old.west IS NOT new.west "
    "OR old.east IS NOT new.east OR old.south IS NOT new.south OR old.north IS NOT new.north": """
DELETE FROM box_tree WHERE number = {OLD};
INSERT INTO box_tree SELECT {NEW}, {BOX_NEW} WHERE new.south IS NOT NULL;""",
    "environment_text_update AFTER UPDATE OF name, title, description, tags ON environment": """
INSERT INTO environment_text (environment_text, rowid, text) VALUES ('delete', {OLD}, {TEXT_OLD});
INSERT INTO environment_text (rowid, text) VALUES ({NEW}, {TEXT_NEW});""",
    "area_index_insert AFTER INSERT ON area": """
INSERT INTO box_number (environment_id, piece) VALUES (new.environment_id, new.piece);
INSERT INTO box_tree SELECT number, {BOX_NEW} FROM box_number
    WHERE environment_id = new.environment_id AND piece = new.piece;""",
    "area_index_delete AFTER DELETE ON area": """
DELETE FROM box_tree WHERE number = (SELECT number FROM box_number
    WHERE environment_id = old.environment_id AND piece = old.piece);
DELETE FROM box_number WHERE environment_id = old.environment_id AND piece = old.piece;""",
}


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
        _create_texts()
        _create_boxes()

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


def _create_texts() -> None:
    """Create the indexes of SQLite that find texts in the names of items of each kind."""
    for number, kind in enumerate(KINDS):
        table = f"search_{kind}"
        op.execute(f"CREATE VIRTUAL TABLE {table} USING fts5(text, {GRAMS})")
        op.execute(f"CREATE VIRTUAL TABLE {table}_term USING fts5vocab('{table}', 'instance')")
        text = {r: f"{r}.folded || {ENDS} || coalesce({r}.folded_id || {ENDS}, '')" for r in ("new", "old")}
        written = f"INSERT INTO {table}(rowid, text) VALUES (new.id, {text['new']})"  # noqa: S608 - only names
        erased = f"INSERT INTO {table}({table}, rowid, text) VALUES ('delete', old.id, {text['old']})"  # noqa: S608
        for event, row, statement in (("INSERT", "new", written), ("DELETE", "old", erased)):
            name = f"{table}_{event.lower()} AFTER {event} ON search_item WHEN {row}.kind = {number}"
            op.execute(f"CREATE TRIGGER {name} BEGIN {statement}; END")


def _create_boxes() -> None:
    expressions = _expressions()
    for statement in BOXES.format_map(expressions).strip().split(";\n"):
        op.execute(statement.rstrip(";"))
    for name, statements in TRIGGERS.items():
        op.execute(f"CREATE TRIGGER {name} BEGIN {statements.format_map(expressions)} END")


def _expressions() -> dict[str, str]:
    """Return the parts of the statements. A box across the antimeridian counts as one around the earth."""
    box = (
        "CASE WHEN row.west > row.east THEN -180 ELSE row.west END, "
        "CASE WHEN row.west > row.east THEN 180 ELSE row.east END, row.south, row.north"
    )
    members = " || char(10) || ".join(f"row.{name}" for name in ("name", "title", "description", "tags"))
    text = f"lower({members}) || {ENDS}"
    number = "(SELECT number FROM box_number WHERE environment_id = row.id AND piece = -1)"
    out = {"GRAMS": GRAMS, "BOX": box, "TEXT": text}
    for row in ("new", "old"):
        out |= {f"BOX_{row.upper()}": box.replace("row.", f"{row}."), row.upper(): number.replace("row.", f"{row}.")}
        out[f"TEXT_{row.upper()}"] = text.replace("row.", f"{row}.")
    return out


def downgrade() -> None:
    is_sqlite = op.get_bind().dialect.name == "sqlite"
    for name in ("insert", "delete", "update"):
        op.execute(f"DROP TRIGGER robot_tally_{name}" if is_sqlite else f"DROP FUNCTION robot_tally_{name} CASCADE")
    op.drop_index("ix_robot_held", "robot")
    op.drop_table("robot_tally")
    if is_sqlite:
        for trigger in TRIGGERS:
            op.execute(f"DROP TRIGGER {trigger.partition(' ')[0]}")
        for table in ("environment_text", "box_tree", "box_number"):
            op.execute(f"DROP TABLE {table}")
    op.drop_table("search_item")
    if is_sqlite:
        for kind in KINDS:
            op.execute(f"DROP TABLE search_{kind}_term")
            op.execute(f"DROP TABLE search_{kind}")
    for name in ("index_stale", "search_stale"):
        op.drop_index(f"ix_environment_{name}", "environment")
    for name in ("search_stale", "search_updated", "search_sequence", "search_version", "index_stale"):
        op.drop_column("environment", name)
