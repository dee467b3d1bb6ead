"""Two-stage rollouts: channels that wait for robots, or are watched after a move.

Revision ID: 0004
Revises: 0003
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("channel", sa.Column("rollout", sa.JSON, nullable=True))
    op.add_column("channel", sa.Column("rollout_state", sa.String(16), nullable=True))
    op.create_index("ix_channel_rollout_state", "channel", ["rollout_state"])


def downgrade() -> None:
    op.drop_index("ix_channel_rollout_state", "channel")
    op.drop_column("channel", "rollout_state")
    op.drop_column("channel", "rollout")
