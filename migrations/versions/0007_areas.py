"""Areas of environments on earth: their GNSS fence, else their floor, else the datum's neighbourhood.

The rows are computed from the trees when the store is first opened after this migration.

Revision ID: 0007
Revises: 0006
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from geoalchemy2 import Geometry

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("environment", sa.Column("area_stale", sa.Boolean, nullable=False, server_default=sa.true()))
    op.create_index("ix_environment_area_stale", "environment", ["area_stale"])
    geometry = sa.LargeBinary().with_variant(Geometry("GEOMETRY", 4326, spatial_index=False), "postgresql")
    op.create_table(
        "area",
        sa.Column("environment_id", sa.String(32), nullable=False),
        sa.Column("piece", sa.Integer, nullable=False, autoincrement=False),
        sa.Column("basis", sa.String(8), nullable=False),
        sa.Column("size", sa.Float(53), nullable=False),
        *(sa.Column(name, sa.Float(53), nullable=True) for name in ("west", "south", "east", "north")),
        sa.Column("geometry", geometry, nullable=False),
        sa.PrimaryKeyConstraint("environment_id", "piece", name="pk_area"),
        sa.ForeignKeyConstraint(
            ["environment_id"], ["environment.id"], name="fk_area_environment_id", ondelete="CASCADE"
        ),
    )
    op.create_index("ix_area_box", "area", ["south", "north", "west", "east"])
    if op.get_bind().dialect.name == "postgresql":
        op.create_index("ix_area_geometry", "area", ["geometry"], postgresql_using="gist")


def downgrade() -> None:
    op.drop_table("area")
    op.drop_index("ix_environment_area_stale", "environment")
    op.drop_column("environment", "area_stale")
