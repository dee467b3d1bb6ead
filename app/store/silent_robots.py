"""Removal of robots that have been silent for long, without holding up those that report.

Tables are read outside of write transactions, and rows removed by their keys, some at a time. History is read from its
oldest rows on, and no further than they are old. An index on the time of the last report would save the daily look at
the robots, but would be written with each report, thousands of times as often.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from typing import Any, Final

from sqlalchemy import ColumnElement, Row, Table, delete, select, tuple_

from app.store import tables
from app.store.database import Database
from app.store.robots import presence_seen

PAGE: Final = 500


def remove_silent(database: Database, before: datetime) -> int:
    """Remove robots, their history and presence of before a time; returns how many rows."""
    robot, presence = tables.robot, tables.presence
    count = _remove(database, robot, [robot.c.environment_id, robot.c.robot], robot.c.time < before)
    count += _remove(database, presence, [presence.c.robot], presence_seen() < before)
    return count + _remove_history(database, before)


def _remove(database: Database, table: Table, key: Sequence[ColumnElement[Any]], condition: ColumnElement[bool]) -> int:
    with database.read() as connection:
        rows = connection.execute(select(*key).where(condition)).all()
    return _delete(database, table, key, rows, condition)


def _remove_history(database: Database, before: datetime) -> int:
    table = tables.robot_history
    count = 0
    while True:
        with database.read() as connection:
            page = connection.execute(select(table.c.id, table.c.time).order_by(table.c.id).limit(PAGE)).all()
        old = [(row.id,) for row in page if row.time < before]
        count += _delete(database, table, [table.c.id], old, table.c.time < before)
        if len(old) < PAGE:
            return count


def _delete(
    database: Database,
    table: Table,
    key: Sequence[ColumnElement[Any]],
    rows: Sequence[Row[Any] | tuple[Any, ...]],
    condition: ColumnElement[bool],
) -> int:
    """Delete rows by their keys if they still meet a condition; returns how many."""
    count = 0
    for start in range(0, len(rows), PAGE):
        keys = [tuple(row) for row in rows[start : start + PAGE]]
        some = key[0].in_([one for (one,) in keys]) if len(key) == 1 else tuple_(*key).in_(keys)
        with database.write(notify=False, upkeep=True) as connection:
            count += connection.execute(delete(table).where(some, condition)).rowcount
    return count
