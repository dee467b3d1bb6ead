"""Robots' reports, and their presence on the bus.

Revision ID: 0003
Revises: 0002
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None


def upgrade() -> None:
    moment = sa.DateTime(timezone=True)
    op.create_table(
        "robot",
        sa.Column("environment_id", sa.String(32), nullable=False),
        sa.Column("robot", sa.String(128), nullable=False),
        sa.Column("channel", sa.String(63), nullable=False),
        sa.Column("version", sa.BigInteger, nullable=False),
        sa.Column("root", sa.String(64), nullable=False),
        sa.Column("state", sa.String(16), nullable=False),
        sa.Column("detail", sa.Text, nullable=True),
        sa.Column("sequence", sa.BigInteger, nullable=True),
        sa.Column("said", moment, nullable=True),
        sa.Column("time", moment, nullable=False),
        sa.Column("since", moment, nullable=False),
        sa.Column("held_version", sa.BigInteger, nullable=True),
        sa.Column("held_root", sa.String(64), nullable=True),
        sa.Column("held_sequence", sa.BigInteger, nullable=True),
        sa.Column("held_since", moment, nullable=True),
        sa.PrimaryKeyConstraint("environment_id", "robot", name="pk_robot"),
        sa.ForeignKeyConstraint(
            ["environment_id"], ["environment.id"], name="fk_robot_environment_id", ondelete="CASCADE"
        ),
    )
    op.create_index("ix_robot_robot", "robot", ["robot"])
    op.create_table(
        "robot_history",
        sa.Column("id", sa.BigInteger().with_variant(sa.Integer, "sqlite"), nullable=False),
        sa.Column("environment_id", sa.String(32), nullable=False),
        sa.Column("robot", sa.String(128), nullable=False),
        sa.Column("channel", sa.String(63), nullable=False),
        sa.Column("version", sa.BigInteger, nullable=False),
        sa.Column("root", sa.String(64), nullable=False),
        sa.Column("state", sa.String(16), nullable=False),
        sa.Column("detail", sa.Text, nullable=True),
        sa.Column("sequence", sa.BigInteger, nullable=True),
        sa.Column("said", moment, nullable=True),
        sa.Column("time", moment, nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_robot_history"),
        sa.ForeignKeyConstraint(
            ["environment_id"], ["environment.id"], name="fk_robot_history_environment_id", ondelete="CASCADE"
        ),
    )
    op.create_index("ix_robot_history_robot", "robot_history", ["environment_id", "robot", "id"])
    op.create_table(
        "presence",
        sa.Column("robot", sa.String(128), nullable=False),
        sa.Column("there", sa.Boolean, nullable=False),
        sa.Column("time", moment, nullable=False),
        sa.PrimaryKeyConstraint("robot", name="pk_presence"),
    )


def downgrade() -> None:
    op.drop_table("presence")
    op.drop_table("robot_history")
    op.drop_table("robot")
