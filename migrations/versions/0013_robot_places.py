"""Places of robots: pose, node and route of the last report that had any.

Revision ID: 0013
Revises: 0012
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

from app.store.column_types import UtcDateTime

revision = "0013"
down_revision = "0012"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("robot", sa.Column("place", sa.JSON(none_as_null=True), nullable=True))
    op.add_column("robot", sa.Column("placed", UtcDateTime, nullable=True))


def downgrade() -> None:
    op.drop_column("robot", "placed")
    op.drop_column("robot", "place")
