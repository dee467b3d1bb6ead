"""An index of the robots that report a failure, which open rollouts look for each second; steps of jobs.

Revision ID: 0026
Revises: 0021
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0026"
down_revision = "0021"
branch_labels = None
depends_on = None
min_compatible = "0019"


def upgrade() -> None:
    op.add_column("job", sa.Column("step", sa.Text, nullable=True))
    failed = sa.text("state = 'failed'")
    op.create_index(
        "ix_robot_failed", "robot", ["environment_id", "channel", "root"], sqlite_where=failed, postgresql_where=failed
    )


def downgrade() -> None:
    op.drop_index("ix_robot_failed", "robot")
    op.drop_column("job", "step")
