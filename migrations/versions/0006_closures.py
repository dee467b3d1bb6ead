"""Closures: overlays in force on every channel, and the server's epoch.

Revision ID: 0006
Revises: 0005
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("environment", sa.Column("closures_sequence", sa.BigInteger, nullable=False, server_default="0"))
    # earlier accepted overlays are in force on every channel from now on: robots fetch them as a change
    op.execute(
        "UPDATE environment SET closures_sequence = sequence "
        "WHERE id IN (SELECT environment_id FROM overlay WHERE state = 'accepted')"
    )
    for table in ("robot", "robot_history"):
        op.add_column(table, sa.Column("overlays", sa.String(64), nullable=True))
    op.add_column("robot", sa.Column("held_overlays", sa.String(64), nullable=True))
    server = op.create_table(
        "server",
        sa.Column("id", sa.Integer, nullable=False, autoincrement=False),
        sa.Column("epoch", sa.BigInteger, nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_server"),
    )
    op.bulk_insert(server, [{"id": 1, "epoch": 0}])


def downgrade() -> None:
    op.drop_table("server")
    op.drop_column("robot", "held_overlays")
    for table in ("robot", "robot_history"):
        op.drop_column(table, "overlays")
    op.drop_column("environment", "closures_sequence")
