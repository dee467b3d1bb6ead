"""Blobs that are kept compressed or as differences; made maps that servers share.

Revision ID: 0018
Revises: 0016
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0018"
down_revision = "0016"
branch_labels = None
depends_on = None
min_compatible = "0018"


def upgrade() -> None:
    for column in (
        sa.Column("stored", sa.BigInteger, nullable=True),
        sa.Column("coding", sa.String(8), nullable=True),
        sa.Column("base", sa.String(64), nullable=True),
        sa.Column("chain", sa.Integer, nullable=False, server_default="0"),
    ):
        op.add_column("blob", column)
    op.create_index("ix_blob_base", "blob", ["base"])
    for table in ("blob", "chunk"):
        op.add_column(table, sa.Column("kept", sa.Boolean, nullable=False, server_default=sa.false()))
        young = sa.text("kept IS false")
        op.create_index(f"ix_{table}_young", table, ["used"], sqlite_where=young, postgresql_where=young)
        op.drop_index(f"ix_{table}_used", table)
    op.create_index("ix_version_time", "version", ["time"])
    op.create_table(
        "collection",
        sa.Column("id", sa.Integer, nullable=False, autoincrement=False),
        sa.Column("purges", sa.BigInteger, nullable=False),
        sa.Column("collected", sa.BigInteger, nullable=False),
        sa.Column("time", sa.BigInteger, nullable=False),
        sa.Column("complete", sa.BigInteger, nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_collection"),
    )
    op.execute("INSERT INTO collection (id, purges, collected, time, complete) VALUES (1, 1, 0, 0, 0)")
    op.create_table(
        "made_map",
        sa.Column("key", sa.String(64), nullable=False),
        sa.Column("object", sa.String(64), nullable=False),
        sa.Column("size", sa.BigInteger, nullable=False),
        sa.Column("entry", sa.LargeBinary, nullable=False),
        sa.Column("used", sa.BigInteger, nullable=False),
        sa.PrimaryKeyConstraint("key", name="pk_made_map"),
    )
    op.create_index("ix_made_map_object", "made_map", ["object"])
    op.create_index("ix_made_map_used", "made_map", ["used"])
    op.create_table(
        "made_file",
        sa.Column("key", sa.String(64), nullable=False),
        sa.Column("position", sa.Integer, nullable=False),
        sa.Column("sha256", sa.String(64), nullable=False),
        sa.Column("size", sa.BigInteger, nullable=False),
        sa.Column("start", sa.BigInteger, nullable=False),
        sa.Column("stored", sa.BigInteger, nullable=False),
        sa.Column("coding", sa.String(8), nullable=True),
        sa.PrimaryKeyConstraint("key", "position", name="pk_made_file"),
        sa.ForeignKeyConstraint(["key"], ["made_map.key"], name="fk_made_file_key", ondelete="CASCADE"),
    )
    op.create_index("ix_made_file_sha256", "made_file", ["sha256"])


def downgrade() -> None:
    for table in ("made_file", "made_map", "collection"):
        op.drop_table(table)
    op.drop_index("ix_version_time", "version")
    for table in ("blob", "chunk"):
        op.create_index(f"ix_{table}_used", table, ["used"])
        op.drop_index(f"ix_{table}_young", table)
        op.drop_column(table, "kept")
    op.drop_index("ix_blob_base", "blob")
    for name in ("chain", "base", "coding", "stored"):
        op.drop_column("blob", name)
