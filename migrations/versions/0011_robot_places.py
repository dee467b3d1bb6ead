"""Places of robots: pose, node and route of the last report that had any.

Revision ID: 0011
Revises: 0010
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

from app.store.tables import UtcDateTime

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("robot", sa.Column("place", sa.JSON(none_as_null=True), nullable=True))
    op.add_column("robot", sa.Column("placed", UtcDateTime, nullable=True))


def downgrade() -> None:
    op.drop_column("robot", "placed")
    op.drop_column("robot", "place")
