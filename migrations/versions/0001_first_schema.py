"""The first schema.

Revision ID: 0001
Revises:
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from geoalchemy2 import Geometry

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None

MOMENT = sa.DateTime(timezone=True)
TABLES = (
    "environment",
    "version",
    "source",
    "chunk",
    "blob",
    "channel",
    "event",
    "log",
    "retired",
    "idempotency",
    "token",
    "job",
    "place",
)


def geometry() -> sa.types.TypeEngine[object]:
    """WKB on SQLite, PostGIS' type on PostgreSQL."""
    return sa.LargeBinary().with_variant(Geometry("GEOMETRY", 4326, spatial_index=False), "postgresql")


def box() -> list[sa.Column[float]]:
    return [sa.Column(name, sa.Float(53), nullable=True) for name in ("west", "south", "east", "north")]


def environment(**options: bool) -> sa.Column[str]:
    return sa.Column("environment_id", sa.String(32), nullable=False, **options)


def owned(table: str) -> sa.ForeignKeyConstraint:
    name = f"fk_{table}_environment_id"
    return sa.ForeignKeyConstraint(["environment_id"], ["environment.id"], name=name, ondelete="CASCADE")


def upgrade() -> None:
    postgresql = op.get_bind().dialect.name == "postgresql"
    if postgresql:
        op.execute("CREATE EXTENSION IF NOT EXISTS postgis")
    op.create_table(
        "environment",
        sa.Column("id", sa.String(32), nullable=False),
        sa.Column("name", sa.String(63), nullable=False),
        sa.Column("title", sa.Text, nullable=False),
        sa.Column("description", sa.Text, nullable=False),
        sa.Column("tags", sa.JSON, nullable=False),
        sa.Column("head", sa.Integer, nullable=False),
        sa.Column("root", sa.String(64), nullable=False),
        sa.Column("sequence", sa.BigInteger, nullable=False),
        sa.Column("datum", sa.JSON, nullable=True),
        sa.Column("indexed", sa.Integer, nullable=False),
        sa.Column("created", MOMENT, nullable=False),
        sa.Column("updated", MOMENT, nullable=False),
        sa.Column("deleted", MOMENT, nullable=True),
        *box(),
        sa.Column("extent", geometry(), nullable=True),
        sa.PrimaryKeyConstraint("id", name="pk_environment"),
        sa.UniqueConstraint("name", name="uq_environment_name"),
    )
    op.create_index("ix_environment_box", "environment", ["south", "north", "west", "east"])
    op.create_table(
        "version",
        environment(),
        sa.Column("number", sa.Integer, nullable=False, autoincrement=False),
        sa.Column("root", sa.String(64), nullable=False),
        sa.Column("parent", sa.Integer, nullable=True),
        sa.Column("author", sa.Text, nullable=False),
        sa.Column("message", sa.Text, nullable=False),
        sa.Column("time", MOMENT, nullable=False),
        sa.Column("sequence", sa.BigInteger, nullable=False),
        sa.Column("changes", sa.JSON, nullable=False),
        sa.Column("warnings", sa.JSON, nullable=False),
        sa.Column("manifest", sa.LargeBinary, nullable=False),
        sa.PrimaryKeyConstraint("environment_id", "number", name="pk_version"),
        owned("version"),
    )
    op.create_table(
        "source",
        environment(),
        sa.Column("number", sa.Integer, nullable=False, autoincrement=False),
        sa.Column("position", sa.Integer, nullable=False, autoincrement=False),
        sa.Column("name", sa.Text, nullable=False),
        sa.Column("size", sa.BigInteger, nullable=False),
        sa.Column("sha256", sa.String(64), nullable=False),
        sa.Column("format", sa.Text, nullable=True),
        sa.Column("used", sa.Boolean, nullable=False),
        sa.PrimaryKeyConstraint("environment_id", "number", "position", name="pk_source"),
        owned("source"),
    )
    op.create_index("ix_source_sha256", "source", ["sha256"])
    op.create_table(
        "chunk",
        sa.Column("hash", sa.LargeBinary(32), nullable=False),
        sa.Column("data", sa.LargeBinary, nullable=False),
        sa.Column("used", sa.BigInteger, nullable=False),
        sa.PrimaryKeyConstraint("hash", name="pk_chunk"),
    )
    op.create_index("ix_chunk_used", "chunk", ["used"])
    op.create_table(
        "blob",
        sa.Column("sha256", sa.String(64), nullable=False),
        sa.Column("size", sa.BigInteger, nullable=False),
        sa.Column("pack", sa.String(64), nullable=True),
        sa.Column("start", sa.BigInteger, nullable=False),
        sa.Column("used", sa.BigInteger, nullable=False),
        sa.PrimaryKeyConstraint("sha256", name="pk_blob"),
    )
    op.create_index("ix_blob_pack", "blob", ["pack"])
    op.create_index("ix_blob_used", "blob", ["used"])
    op.create_table(
        "channel",
        environment(),
        sa.Column("name", sa.String(63), nullable=False),
        sa.Column("version", sa.Integer, nullable=True),
        sa.Column("sequence", sa.BigInteger, nullable=False),
        sa.Column("author", sa.Text, nullable=False),
        sa.Column("time", MOMENT, nullable=False),
        sa.Column("planned_version", sa.Integer, nullable=True),
        sa.Column("planned_at", MOMENT, nullable=True),
        sa.Column("planned_author", sa.Text, nullable=True),
        sa.PrimaryKeyConstraint("environment_id", "name", name="pk_channel"),
        owned("channel"),
    )
    op.create_index("ix_channel_planned_at", "channel", ["planned_at"])
    op.create_table(
        "event",
        sa.Column("position", sa.BigInteger, nullable=False, autoincrement=False),
        sa.Column("environment_id", sa.String(32), nullable=False),
        sa.Column("environment", sa.String(63), nullable=False),
        sa.Column("sequence", sa.BigInteger, nullable=False),
        sa.Column("body", sa.JSON, nullable=False),
        sa.Column("time", MOMENT, nullable=False),
        sa.PrimaryKeyConstraint("position", name="pk_event"),
    )
    op.create_index("uq_event_sequence", "event", ["environment_id", "sequence"], unique=True)
    log = op.create_table(
        "log",
        sa.Column("id", sa.Integer, nullable=False, autoincrement=False),
        sa.Column("position", sa.BigInteger, nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_log"),
    )
    op.bulk_insert(log, [{"id": 1, "position": 0}])
    op.create_table(
        "retired",
        sa.Column("name", sa.String(63), nullable=False),
        sa.Column("sequence", sa.BigInteger, nullable=False),
        sa.PrimaryKeyConstraint("name", name="pk_retired"),
    )
    op.create_table(
        "idempotency",
        environment(),
        sa.Column("key", sa.String(255), nullable=False),
        sa.Column("fingerprint", sa.Text, nullable=False),
        sa.Column("version", sa.Integer, nullable=False),
        sa.Column("time", MOMENT, nullable=False),
        sa.PrimaryKeyConstraint("environment_id", "key", name="pk_idempotency"),
        owned("idempotency"),
    )
    op.create_table(
        "token",
        sa.Column("id", sa.String(32), nullable=False),
        sa.Column("hash", sa.String(64), nullable=False),
        sa.Column("name", sa.Text, nullable=False),
        sa.Column("role", sa.String(16), nullable=False),
        sa.Column("environments", sa.Text, nullable=True),
        sa.Column("robot", sa.Text, nullable=True),
        sa.Column("expires", MOMENT, nullable=True),
        sa.Column("created", MOMENT, nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_token"),
        sa.UniqueConstraint("hash", name="uq_token_hash"),
    )
    op.create_table(
        "job",
        sa.Column("id", sa.String(32), nullable=False),
        sa.Column("state", sa.String(16), nullable=False),
        sa.Column("progress", sa.Float(53), nullable=False),
        sa.Column("detail", sa.Text, nullable=False),
        sa.Column("result", sa.JSON, nullable=True),
        sa.Column("problem", sa.JSON, nullable=True),
        sa.Column("owner", sa.Text, nullable=False),
        sa.Column("created", MOMENT, nullable=False),
        sa.Column("updated", MOMENT, nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_job"),
    )
    op.create_table(
        "place",
        sa.Column("id", sa.BigInteger().with_variant(sa.Integer, "sqlite"), nullable=False, autoincrement=True),
        environment(),
        sa.Column("layer", sa.String(16), nullable=False),
        sa.Column("level", sa.String(256), nullable=False),
        sa.Column("name", sa.String(256), nullable=False),
        sa.Column("feature", sa.String(512), nullable=False),
        *box(),
        sa.Column("geometry", geometry(), nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_place"),
        owned("place"),
    )
    op.create_index("ix_place_feature", "place", ["environment_id", "feature"])
    op.create_index("ix_place_box", "place", ["south", "north", "west", "east"])
    if postgresql:
        op.create_index("ix_environment_extent", "environment", ["extent"], postgresql_using="gist")
        op.create_index("ix_place_geometry", "place", ["geometry"], postgresql_using="gist")
        # chunks are compressed already: no second compression, and no access to parts of them
        op.execute("ALTER TABLE chunk ALTER COLUMN data SET STORAGE EXTERNAL")


def downgrade() -> None:
    for name in reversed(TABLES):
        op.drop_table(name)
