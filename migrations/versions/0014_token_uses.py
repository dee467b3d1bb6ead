"""Time of a token's last use, to the hour.

Revision ID: 0014
Revises: 0013
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

from app.store.column_types import UtcDateTime

revision = "0014"
down_revision = "0013"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("token", sa.Column("used", UtcDateTime, nullable=True))


def downgrade() -> None:
    op.drop_column("token", "used")
