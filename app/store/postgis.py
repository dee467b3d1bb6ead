"""PostGIS' column type. It is imported for PostgreSQL alone: GeoAlchemy2 takes a fifth of a second to load."""

from __future__ import annotations

from typing import Any

from geoalchemy2 import Geometry
from sqlalchemy import Dialect
from sqlalchemy.sql.elements import BindParameter, ColumnElement


class PlainGeometry(Geometry):
    """PostGIS' column type without GeoAlchemy2's conversions of values: ours are WKB in and out."""

    cache_ok = True

    def __init__(self) -> None:
        super().__init__(geometry_type="GEOMETRY", srid=4326, spatial_index=False)

    def bind_processor(self, dialect: Dialect) -> None:
        """Values are bytes already."""

    def result_processor(self, dialect: Dialect, coltype: object) -> None:
        """Values stay bytes."""

    def bind_expression(self, bindvalue: BindParameter[Any]) -> None:
        """``app.store.tables.WkbGeometry`` does it, by dialect."""

    def column_expression(self, col: ColumnElement[Any]) -> ColumnElement[Any]:
        """``app.store.tables.WkbGeometry`` does it, by dialect."""
        return col
