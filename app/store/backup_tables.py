"""Which tables a backup contains, and how their rows are written: the same on SQLite and PostgreSQL.

A row is an array of plain values in the order of its columns, rows are grouped into segments. A segment ends where a
public hash of the row's key says so, so that a change rewrites only the segment that it is in.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import datetime
from typing import Any, Final

import ormsgpack
from sqlalchemy import Column, Table

from app.errors import Damaged
from app.store import tables
from app.store.column_types import UtcDateTime
from app.store.encode import compress, decompress

CONTENT: Final = frozenset({"chunk", "blob"})
"""Tables whose rows are content by its hash: a backup keeps each once."""

LEFT_OUT: Final = frozenset(
    {
        *("area", "search_item", "robot_tally"),  # made anew from the others
        "place",  # not used
        *("made_map", "made_file"),  # maps that can be made again
        *("job", "lead", "presence"),  # what processes do at the moment
        *("session", "sign_in_code", "wrong_token"),  # people sign in again
    }
)
"""Tables that a backup does not contain."""

WITH_KEYS: Final = frozenset({"webhook", "webhook_lag"})
"""Tables with secrets: a backup contains them only if it contains keys."""

OWN_DOCUMENTS: Final = frozenset({"keys", "links", "scrub", "backup"})
"""Documents that are no rows of a backup: keys are in it only by choice, the others are of this server alone."""

ORDERS: Final[Mapping[str, Sequence[str]]] = {
    "version": ("time", "environment_id", "number"),
    "event": ("position",),
    "audit": ("id",),
    "robot_history": ("id",),
}
"""Columns by which tables that only grow are sorted, so that new rows are in the last segment; others: by their key."""

LONG_SEGMENT: Final = 256
SHORT_SEGMENT: Final = 32
"""Average number of rows of a segment: of tables that grow at the end, and of others."""

SEGMENT_BYTES: Final = 2**20
"""Size at which a segment ends in any case."""


def dumped_tables(*, keys: bool = True) -> list[Table]:
    """Return the tables whose rows a backup contains, referenced ones first. keys: also those with secrets."""
    omitted = CONTENT | LEFT_OUT | (frozenset() if keys else WITH_KEYS)
    return [table for table in tables.metadata.sorted_tables if table.name not in omitted]


def stored_columns(table: Table) -> list[Column[Any]]:
    """Return the columns that the database does not compute."""
    return [column for column in table.columns if column.computed is None]


def order_of(table: Table) -> list[Column[Any]]:
    """Return the columns by which the rows of a table are written."""
    names = ORDERS.get(table.name)
    return list(table.primary_key.columns) if names is None else [table.c[name] for name in names]


def segments(table: Table, rows: Iterable[Sequence[Any]]) -> Iterator[tuple[int, bytes]]:
    """Group rows of a table into segments: (number of rows, packed rows, not compressed)."""
    columns = stored_columns(table)
    times = [k for k, column in enumerate(columns) if isinstance(column.type, UtcDateTime)]
    keys = [columns.index(column) for column in table.primary_key.columns]
    average = LONG_SEGMENT if table.name in ORDERS else SHORT_SEGMENT
    group: list[bytes] = []
    size = 0
    for row in rows:
        values = list(row)
        for k in times:
            values[k] = None if values[k] is None else values[k].isoformat()
        packed = ormsgpack.packb(values)
        group.append(packed)
        size += len(packed)
        key = ormsgpack.packb([values[k] for k in keys])
        if zlib.crc32(key) % average == 0 or size >= SEGMENT_BYTES:
            yield len(group), _joined(group)
            group, size = [], 0
    if group:
        yield len(group), _joined(group)


def compressed(segment: bytes) -> bytes:
    """Compress a segment."""
    return compress(segment)


def rows_of(data: bytes, columns: Sequence[Column[Any]]) -> list[dict[str, Any]]:
    """Read the rows of a compressed segment: column -> value. Raises Damaged."""
    times = {column.name for column in columns if isinstance(column.type, UtcDateTime)}
    names = [column.name for column in columns]
    try:
        listed = ormsgpack.unpackb(decompress(data))
        out = [dict(zip(names, row, strict=True)) for row in listed]
        for row in out:
            row.update({name: datetime.fromisoformat(row[name]) for name in times if row[name] is not None})
    except (ValueError, TypeError) as error:
        raise Damaged(f"a part of the backup cannot be read ({type(error).__name__}: {error})") from error
    return out


def _joined(rows: Sequence[bytes]) -> bytes:
    """Pack rows that are packed already as one array."""
    return b"\xdd" + len(rows).to_bytes(4, "big") + b"".join(rows)
