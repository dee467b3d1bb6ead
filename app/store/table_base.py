"""What the modules of tables share: the metadata, and columns that several tables have."""

from __future__ import annotations

from typing import Any

from sqlalchemy import Column, Float, ForeignKey, MetaData, String


def box() -> list[Column[float]]:
    """Return columns of a box in degrees; west > east crosses the antimeridian."""
    return [Column(name, Float(53), nullable=True) for name in ("west", "south", "east", "north")]


POSTGRESQL = {"dialect": "postgresql"}
"""Mark of objects that only PostgreSQL has: the comparison of models and migrations ignores ddl_if."""

metadata = MetaData(
    naming_convention={
        "ix": "ix_%(table_name)s_%(column_0_name)s",
        "uq": "uq_%(table_name)s_%(column_0_name)s",
        "fk": "fk_%(table_name)s_%(column_0_name)s",
        "pk": "pk_%(table_name)s",
    }
)


def environment_key(**options: Any) -> Column[str]:
    """Return the column of the environment to which a row belongs, and with which it ends."""
    return Column("environment_id", String(32), ForeignKey("environment.id", ondelete="CASCADE"), **options)
