"""Webhooks: where events are sent, and how far each one is.

Revision ID: 0023
Revises: 0022
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

from app.store.column_types import UtcDateTime

revision = "0023"
down_revision = "0022"
branch_labels = None
depends_on = None
min_compatible = "0019"


def _failing() -> list[sa.Column]:
    return [
        sa.Column("failures", sa.Integer, nullable=False, server_default="0"),
        sa.Column("failing_since", UtcDateTime, nullable=True),
        sa.Column("next_try", UtcDateTime, nullable=True),
        sa.Column("error", sa.Text, nullable=True),
    ]


def upgrade() -> None:
    op.create_table(
        "webhook",
        sa.Column("id", sa.String(32), nullable=False),
        sa.Column("url", sa.Text, nullable=False),
        sa.Column("secret", sa.Text, nullable=False),
        sa.Column("environments", sa.String(256), nullable=True),
        sa.Column("types", sa.JSON, nullable=True),
        sa.Column("created", UtcDateTime, nullable=False),
        sa.Column("position", sa.BigInteger, nullable=False),
        sa.Column("delivered", UtcDateTime, nullable=True),
        *_failing(),
        sa.PrimaryKeyConstraint("id", name="pk_webhook"),
    )
    op.create_table(
        "webhook_lag",
        sa.Column("webhook_id", sa.String(32), nullable=False),
        sa.Column("environment_id", sa.String(32), nullable=False),
        sa.Column("environment", sa.String(63), nullable=False),
        sa.Column("position", sa.BigInteger, nullable=False),
        *_failing(),
        sa.PrimaryKeyConstraint("webhook_id", "environment_id", name="pk_webhook_lag"),
        sa.ForeignKeyConstraint(["webhook_id"], ["webhook.id"], name="fk_webhook_lag_webhook_id", ondelete="CASCADE"),
    )


def downgrade() -> None:
    op.drop_table("webhook_lag")
    op.drop_table("webhook")
