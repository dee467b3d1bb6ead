"""Steps of jobs; figures of a mirror; an index of robots that report a failure, which open rollouts look for.

Revision ID: 0025
Revises: 0024
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0025"
down_revision = "0024"
branch_labels = None
depends_on = None
min_compatible = "0019"


def upgrade() -> None:
    op.add_column("job", sa.Column("step", sa.Text, nullable=True))
    op.add_column("mirror", sa.Column("skipped", sa.JSON(none_as_null=True), nullable=True))
    for name in ("centre_position", "received", "sent"):
        op.add_column("mirror", sa.Column(name, sa.BigInteger, nullable=False, server_default="0"))
    failed = sa.text("state = 'failed'")
    op.create_index(
        "ix_robot_failed", "robot", ["environment_id", "channel", "root"], sqlite_where=failed, postgresql_where=failed
    )


def downgrade() -> None:
    op.drop_index("ix_robot_failed", "robot")
    op.drop_column("job", "step")
    for name in ("sent", "received", "centre_position", "skipped"):
        op.drop_column("mirror", name)
