"""Overlays: obstructions reported by robots, until an editor decides or they expire.

Revision ID: 0005
Revises: 0004
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None


def upgrade() -> None:
    moment = sa.DateTime(timezone=True)
    op.create_table(
        "overlay",
        sa.Column("id", sa.String(32), nullable=False),
        sa.Column("environment_id", sa.String(32), nullable=False),
        sa.Column("kind", sa.String(16), nullable=False),
        sa.Column("state", sa.String(16), nullable=False),
        sa.Column("level", sa.String(256), nullable=False),
        sa.Column("polygon", sa.JSON, nullable=True),
        sa.Column("edge", sa.String(512), nullable=True),
        sa.Column("crs", sa.String(8), nullable=True),
        sa.Column("detail", sa.Text, nullable=True),
        sa.Column("reporter", sa.Text, nullable=False),
        sa.Column("created", moment, nullable=False),
        sa.Column("expires", moment, nullable=False),
        sa.Column("decided_by", sa.Text, nullable=True),
        sa.Column("decided", moment, nullable=True),
        sa.Column("version", sa.Integer, nullable=True),
        sa.PrimaryKeyConstraint("id", name="pk_overlay"),
        sa.ForeignKeyConstraint(
            ["environment_id"], ["environment.id"], name="fk_overlay_environment_id", ondelete="CASCADE"
        ),
    )
    op.create_index("ix_overlay_environment", "overlay", ["environment_id", "state"])
    op.create_index("ix_overlay_expires", "overlay", ["state", "expires"])


def downgrade() -> None:
    op.drop_table("overlay")
