"""PostGIS' column type. Imported for PostgreSQL only: GeoAlchemy2 takes a fifth of a second to load."""

from __future__ import annotations

from typing import Any

from geoalchemy2 import Geometry
from sqlalchemy import Dialect
from sqlalchemy.sql.elements import BindParameter, ColumnElement


class PlainGeometry(Geometry):
    """PostGIS' column type without GeoAlchemy2's conversions of values: WKB in and out."""

    cache_ok = True

    def __init__(self) -> None:
        super().__init__(geometry_type="GEOMETRY", srid=4326, spatial_index=False)

    def bind_processor(self, dialect: Dialect) -> None:
        """Return None: values are bytes already."""

    def result_processor(self, dialect: Dialect, coltype: object) -> None:
        """Return None: values stay bytes."""

    def bind_expression(self, bindvalue: BindParameter[Any]) -> None:
        """Return no SQL function: ``app.store.column_types.WkbGeometry`` converts, by dialect."""

    def column_expression(self, col: ColumnElement[Any]) -> ColumnElement[Any]:
        """Return the column: ``app.store.column_types.WkbGeometry`` converts, by dialect."""
        return col
