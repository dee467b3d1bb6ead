"""What several servers share: leads, documents, counts of wrong tokens, time of the last presence check.

Revision ID: 0016
Revises: 0015
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

from app.store.column_types import UtcDateTime

revision = "0016"
down_revision = "0015"
branch_labels = None
depends_on = None
min_compatible = "0016"  # earlier releases require exactly their own schema


def upgrade() -> None:
    op.create_table(
        "lead",
        sa.Column("name", sa.String(32), nullable=False),
        sa.Column("term", sa.BigInteger, nullable=False),
        sa.Column("holder", sa.Text, nullable=False),
        sa.Column("since", UtcDateTime, nullable=False),
        sa.PrimaryKeyConstraint("name", name="pk_lead"),
    )
    op.create_table(
        "document",
        sa.Column("name", sa.String(32), nullable=False),
        sa.Column("content", sa.LargeBinary, nullable=False),
        sa.Column("revision", sa.BigInteger, nullable=False),
        sa.PrimaryKeyConstraint("name", name="pk_document"),
    )
    op.create_table(
        "wrong_token",
        sa.Column("source", sa.String(64), nullable=False),
        sa.Column("count", sa.Integer, nullable=False),
        sa.Column("since", UtcDateTime, nullable=False),
        sa.PrimaryKeyConstraint("source", name="pk_wrong_token"),
    )
    op.add_column("server", sa.Column("min_compatible", sa.String(32), nullable=True))
    op.add_column("server", sa.Column("presence_checked", UtcDateTime, nullable=True))


def downgrade() -> None:
    op.drop_column("server", "presence_checked")
    op.drop_column("server", "min_compatible")
    op.drop_table("wrong_token")
    op.drop_table("document")
    op.drop_table("lead")
