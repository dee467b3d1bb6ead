"""Sessions of browsers, and one-time codes that start them.

Revision ID: 0011
Revises: 0010
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

from app.store.column_types import UtcDateTime

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "session",
        sa.Column("hash", sa.String(64), primary_key=True),
        sa.Column("token_id", sa.String(32), sa.ForeignKey("token.id", ondelete="CASCADE"), nullable=False),
        sa.Column("created", UtcDateTime, nullable=False),
        sa.Column("used", UtcDateTime, nullable=False),
    )
    op.create_index("ix_session_token_id", "session", ["token_id"])
    op.create_index("ix_session_used", "session", ["used"])
    op.create_table(
        "sign_in_code",
        sa.Column("hash", sa.String(64), primary_key=True),
        sa.Column("token_id", sa.String(32), sa.ForeignKey("token.id", ondelete="CASCADE"), nullable=False),
        sa.Column("expires", UtcDateTime, nullable=False),
    )
    op.create_index("ix_sign_in_code_token_id", "sign_in_code", ["token_id"])


def downgrade() -> None:
    op.drop_table("sign_in_code")
    op.drop_table("session")
