"""Retention: versions and files that a rule has removed, tags, and how long links name a version.

Revision ID: 0022
Revises: 0021
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

from app.store.column_types import UtcDateTime

revision = "0022"
down_revision = "0021"
branch_labels = None
depends_on = None
min_compatible = "0021"


def upgrade() -> None:
    op.add_column("version", sa.Column("thinned", UtcDateTime, nullable=True))
    op.add_column("version", sa.Column("thinned_rule", sa.Text, nullable=True))
    op.add_column("version", sa.Column("linked", UtcDateTime, nullable=True))
    op.add_column("source", sa.Column("removed", UtcDateTime, nullable=True))
    op.add_column("collection", sa.Column("thinned", sa.BigInteger, nullable=False, server_default="0"))
    thinned = sa.text("thinned IS NOT NULL")
    op.create_index(
        "ix_version_thinned",
        "version",
        ["environment_id", "thinned"],
        sqlite_where=thinned,
        postgresql_where=thinned,
    )
    op.create_table(
        "version_tag",
        sa.Column("environment_id", sa.String(32), nullable=False),
        sa.Column("name", sa.String(63), nullable=False),
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("author", sa.Text, nullable=False),
        sa.Column("time", UtcDateTime, nullable=False),
        sa.PrimaryKeyConstraint("environment_id", "name", name="pk_version_tag"),
        sa.ForeignKeyConstraint(
            ["environment_id"], ["environment.id"], name="fk_version_tag_environment_id", ondelete="CASCADE"
        ),
    )
    op.create_index("ix_version_tag_number", "version_tag", ["environment_id", "number"])


def downgrade() -> None:
    """Versions that were thinned stay without content: the release before reports them as damaged."""
    op.drop_index("ix_version_tag_number", "version_tag")
    op.drop_table("version_tag")
    op.drop_index("ix_version_thinned", "version")
    op.drop_column("collection", "thinned")
    op.drop_column("source", "removed")
    for column in ("linked", "thinned_rule", "thinned"):
        op.drop_column("version", column)
