"""Column types that both databases have: times in UTC, geometries on earth."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from sqlalchemy import DateTime, Dialect, LargeBinary, String, Text
from sqlalchemy.dialects.postgresql import TSVECTOR
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.elements import BindParameter, ColumnElement
from sqlalchemy.sql.functions import FunctionElement
from sqlalchemy.types import TypeDecorator, TypeEngine


class UtcDateTime(TypeDecorator[datetime]):
    """An aware time in UTC; SQLite stores it without the zone."""

    impl = DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Convert a time of any zone to UTC."""
        if value is None:
            return None
        utc = value.astimezone(UTC)
        return utc.replace(tzinfo=None) if dialect.name == "sqlite" else utc

    def process_result_value(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Return an aware time in UTC."""
        del dialect
        if value is None:
            return None
        return value.replace(tzinfo=UTC) if value.tzinfo is None else value.astimezone(UTC)


class from_wkb(FunctionElement[bytes]):  # noqa: N801 - an SQL function
    """SQL function from WKB in degrees to the column's form."""

    inherit_cache = True


class as_wkb(FunctionElement[bytes]):  # noqa: N801 - an SQL function
    """SQL function from the column's form to WKB."""

    inherit_cache = True


class as_grams(FunctionElement[Any]):  # noqa: N801 - an SQL function
    """SQL function from an array of texts to the column's form."""

    inherit_cache = True


@compiles(from_wkb)
@compiles(as_wkb)
@compiles(as_grams)
def _as_is(element: FunctionElement[Any], compiler: Any, **kw: Any) -> str:
    return str(compiler.process(next(iter(element.clauses)), **kw))


@compiles(from_wkb, "postgresql")
def _from_wkb(element: from_wkb, compiler: Any, **kw: Any) -> str:
    return f"ST_GeomFromWKB({compiler.process(next(iter(element.clauses)), **kw)}, 4326)"


@compiles(as_wkb, "postgresql")
def _as_wkb(element: as_wkb, compiler: Any, **kw: Any) -> str:
    return f"ST_AsBinary({compiler.process(next(iter(element.clauses)), **kw)})"


class WkbGeometry(TypeDecorator[bytes]):
    """A geometry in degrees (WGS 84): WKB in and out; PostGIS' type on PostgreSQL, bytes on SQLite."""

    impl = LargeBinary
    cache_ok = True

    def load_dialect_impl(self, dialect: Dialect | None) -> TypeEngine[Any]:
        """Return PostGIS' type on PostgreSQL only (SQLAlchemy also calls this without a dialect)."""
        if dialect is not None and dialect.name == "postgresql":
            from app.store.postgis import PlainGeometry

            return PlainGeometry()
        return LargeBinary()

    def bind_expression(self, bindparam: BindParameter[Any]) -> ColumnElement[Any]:
        """Convert WKB into the column's form."""
        return from_wkb(bindparam)

    def column_expression(self, column: ColumnElement[Any]) -> ColumnElement[Any]:
        """Convert the column's form into WKB."""
        return as_wkb(column)


def binary_text(length: int | None = None) -> String:
    """Return the type of a text that both databases compare and sort by code points, whatever language theirs have."""
    return String(length).with_variant(String(length, collation="C"), "postgresql")


@compiles(as_grams, "postgresql")
def _as_grams(element: as_grams, compiler: Any, **kw: Any) -> str:
    return f"array_to_tsvector(CAST({compiler.process(next(iter(element.clauses)), **kw)} AS TEXT[]))"


class Grams(TypeDecorator[list[str]]):
    """A set of short texts with an index by each, also by its beginning: a tsvector on PostgreSQL, unused on SQLite."""

    impl = Text
    cache_ok = True

    def load_dialect_impl(self, dialect: Dialect | None) -> TypeEngine[Any]:
        """Return PostgreSQL's type."""
        return TSVECTOR() if dialect is not None and dialect.name == "postgresql" else Text()

    def process_bind_param(self, value: list[str] | None, dialect: Dialect) -> Any:
        """Return the texts on PostgreSQL, nothing on SQLite."""
        return value if dialect.name == "postgresql" else None

    def bind_expression(self, bindparam: BindParameter[Any]) -> ColumnElement[Any]:
        """Convert an array of texts."""
        return as_grams(bindparam)
