"""Time at which a token was found to have expired: it stays so, even if the clock is set back.

Revision ID: 0009
Revises: 0008
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("token", sa.Column("ended", sa.DateTime(timezone=True), nullable=True))


def downgrade() -> None:
    op.drop_column("token", "ended")
