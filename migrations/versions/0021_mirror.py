"""Environments that follow another server: their centre, what the edge has still to report, its delegated key.

Revision ID: 0021
Revises: 0020
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

from app.store.column_types import UtcDateTime

revision = "0021"
down_revision = "0020"
branch_labels = None
depends_on = None
min_compatible = "0019"


def upgrade() -> None:
    op.add_column("environment", sa.Column("centre", sa.Text, nullable=True))
    op.add_column("environment", sa.Column("centre_epoch", sa.BigInteger, nullable=True))
    op.add_column("environment", sa.Column("edge_sequence", sa.BigInteger, nullable=False, server_default="0"))
    op.create_table(
        "mirror",
        sa.Column("id", sa.Integer, nullable=False, autoincrement=False),
        sa.Column("url", sa.Text, nullable=False),
        sa.Column("key", sa.LargeBinary, nullable=False),
        sa.Column("epoch", sa.BigInteger, nullable=False),
        sa.Column("position", sa.BigInteger, nullable=False),
        sa.Column("reported", sa.BigInteger, nullable=False),
        sa.Column("seen", UtcDateTime, nullable=True),
        sa.Column("centre_keys", sa.JSON, nullable=False),
        sa.Column("contact", UtcDateTime, nullable=True),
        sa.Column("problem", sa.Text, nullable=True),
        sa.Column("failures", sa.JSON, nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_mirror"),
    )
    op.create_table(
        "delegation",
        sa.Column("environment_id", sa.String(32), nullable=False),
        sa.Column("statement", sa.LargeBinary, nullable=False),
        sa.Column("signed_by", sa.String(16), nullable=False),
        sa.Column("signature", sa.LargeBinary, nullable=False),
        sa.Column("key", sa.LargeBinary, nullable=False),
        sa.Column("expires", UtcDateTime, nullable=False),
        sa.PrimaryKeyConstraint("environment_id", name="pk_delegation"),
        sa.ForeignKeyConstraint(
            ["environment_id"], ["environment.id"], name="fk_delegation_environment_id", ondelete="CASCADE"
        ),
    )
    op.create_table(
        "edge_change",
        sa.Column("id", sa.BigInteger().with_variant(sa.Integer, "sqlite"), nullable=False),
        sa.Column("environment_id", sa.String(32), nullable=False),
        sa.Column("overlay_id", sa.String(32), nullable=False),
        sa.Column("body", sa.JSON, nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_edge_change"),
        sa.ForeignKeyConstraint(
            ["environment_id"], ["environment.id"], name="fk_edge_change_environment_id", ondelete="CASCADE"
        ),
    )
    op.create_index("ix_edge_change_environment_id", "edge_change", ["environment_id"])


def downgrade() -> None:
    op.drop_index("ix_edge_change_environment_id", "edge_change")
    for name in ("edge_change", "delegation", "mirror"):
        op.drop_table(name)
    for column in ("edge_sequence", "centre_epoch", "centre"):
        op.drop_column("environment", column)
