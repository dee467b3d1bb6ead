"""Short lists of pending entries of PostgreSQL's indexes on groups of three characters.

A search reads all that is pending: up to 4 MB by default, which took longer than all else.

Revision ID: 0027
Revises: 0026
"""

from __future__ import annotations

from alembic import op

revision = "0027"
down_revision = "0026"
branch_labels = None
depends_on = None
min_compatible = "0019"

INDEXES = ("ix_search_item_grams", "ix_environment_text_grams")


def upgrade() -> None:
    if op.get_bind().dialect.name == "postgresql":
        for index in INDEXES:
            op.execute(f"ALTER INDEX {index} SET (gin_pending_list_limit = 128)")  # kB


def downgrade() -> None:
    if op.get_bind().dialect.name == "postgresql":
        for index in INDEXES:
            op.execute(f"ALTER INDEX {index} RESET (gin_pending_list_limit)")
