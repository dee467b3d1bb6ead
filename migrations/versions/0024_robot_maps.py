"""An index of robots by the map that they run, so that those behind their channel are counted without the others.

Revision ID: 0024
Revises: 0023
"""

from __future__ import annotations

from alembic import op

revision = "0024"
down_revision = "0023"
branch_labels = None
depends_on = None
min_compatible = "0019"


def upgrade() -> None:
    op.create_index("ix_robot_map", "robot", ["environment_id", "channel", "held_root", "held_overlays"])


def downgrade() -> None:
    op.drop_index("ix_robot_map", "robot")
