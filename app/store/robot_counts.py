"""Counts of an environment's robots by what they report, which cost the number of different reports.

Triggers write what has changed into ``robot_tally``; its rows are summed when they are read, and joined now and then,
so that writers never wait for each other. Who is online changes without a report: that is counted in ``robot``, for
large fleets at most every few seconds.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Mapping
from datetime import datetime
from typing import Any, Final

from sqlalchemy import (
    Column,
    ColumnElement,
    Connection,
    Row,
    Select,
    and_,
    bindparam,
    delete,
    false,
    func,
    insert,
    or_,
    select,
    true,
)

from app.store import tables
from app.store.base import environment_row
from app.store.column_types import UtcDateTime
from app.store.database import Database
from app.store.fleet_values import FleetCounts, RobotGroup
from app.store.robots import presence_seen

MAX_ROWS: Final = 200
"""Number of rows of an environment above which they are joined."""

LARGE: Final = 1000
"""Number of robots above which the number of those that are online is counted at most every FRESH_SECONDS."""

FRESH_SECONDS: Final = 5.0

_GROUP: Final = ("channel", "state", "root", "held_root", "held_overlays", "vouched")


class RobotCounts:
    """Service for the counts of robots. Thread-safe."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._online: dict[str, tuple[float, dict[str, int]]] = {}
        self._joined = 0

    def read(self, environment: str, *, on_bus_after: datetime, heard_after: datetime) -> FleetCounts:
        """Count an environment's robots. Raises NotFound.

        Args:
            on_bus_after: robots on the bus count as online if they were seen there after this time.
            heard_after: other robots, if they have reported after this time and not left the bus since.
        """
        with self._database.read() as connection:
            environment_id = environment_row(connection, environment).id
            groups = [_as_group(row) for row in connection.execute(_GROUPS, {"environment": environment_id})]
            channels = sorted({group.channel for group in groups})
            values = {"environment": environment_id}
            last = {name: connection.execute(_LAST_HELD, {**values, "channel": name}).scalar() for name in channels}
            times = {"on_bus_after": on_bus_after, "heard_after": heard_after}
            total = sum(group.number for group in groups)
            online = self._count_online(connection, {**values, **times}, total) if total else {}
        return FleetCounts(groups, online, last)

    def _count_online(self, connection: Connection, values: Mapping[str, Any], total: int) -> dict[str, int]:
        """Count the robots of each channel that are online; of a large fleet the count may be some seconds old."""
        key, now = values["environment"], time.monotonic()
        counted, online = self._online.get(key, (-math.inf, {}))
        if total > LARGE and now - counted < FRESH_SECONDS:
            return online
        online = {row.channel: row.number for row in connection.execute(_ONLINE, values)}
        if total > LARGE:
            self._online[key] = (now, online)
        return online

    def join(self) -> None:
        """Join the rows of environments that have many. One process of all servers calls this, now and then."""
        table = tables.robot_tally
        with self._database.read() as connection:
            newest = connection.execute(select(func.max(table.c.id))).scalar() or 0
            if newest <= self._joined:
                return
            changed = select(table.c.environment_id).where(table.c.id > self._joined).distinct().subquery()
            many = (
                select(table.c.environment_id)
                .join(changed, changed.c.environment_id == table.c.environment_id)
                .group_by(table.c.environment_id)
                .having(func.count() > MAX_ROWS)
            )
            environments = list(connection.execute(many).scalars())
        for environment_id in environments:
            self._join(environment_id)
        self._joined = newest

    def _join(self, environment_id: str) -> None:
        """Replace an environment's rows by one for each group, in one transaction: readers see the same sums."""
        table = tables.robot_tally
        with self._database.write(notify=False, upkeep=True) as connection:
            gone = (
                delete(table)
                .where(table.c.environment_id == environment_id)
                .returning(*_group_columns(), table.c.number)
            )
            sums: Counter[tuple[Any, ...]] = Counter()
            for *group, number in connection.execute(gone):
                sums[tuple(group)] += number
            rows = [
                {"environment_id": environment_id, **dict(zip(_GROUP, group, strict=True)), "number": number}
                for group, number in sums.items()
                if number
            ]
            if rows:
                connection.execute(insert(table), rows)


def _group_columns() -> list[Column[Any]]:
    return [tables.robot_tally.c[name] for name in _GROUP]


def _as_group(row: Row[Any]) -> RobotGroup:
    return RobotGroup(row.channel, row.state, row.root, row.held_root, row.held_overlays, row.vouched, row.number)


def _groups_query() -> Select[Any]:
    table = tables.robot_tally
    number = func.sum(table.c.number)
    query = select(*_group_columns(), number.label("number")).where(table.c.environment_id == bindparam("environment"))
    return query.group_by(*_group_columns()).having(number != 0)


def is_online() -> ColumnElement[bool]:
    """SQL expression on a robot and its presence: the rule of ``app.fleet.is_online``.

    Its parameters are ``on_bus_after`` and ``heard_after``, see ``RobotCounts.read``.
    """
    table, presence = tables.robot, tables.presence
    on_bus, seen = func.coalesce(presence.c.there, false()), presence_seen()
    has_left = and_(presence.c.there.is_(False), seen >= table.c.time)
    is_heard = and_(table.c.time > bindparam("heard_after", type_=UtcDateTime), func.coalesce(~has_left, true()))
    return or_(and_(on_bus, seen > bindparam("on_bus_after", type_=UtcDateTime)), is_heard)


def _online_query() -> Select[Any]:
    table, presence = tables.robot, tables.presence
    return (
        select(table.c.channel, func.count().label("number"))
        .select_from(table)
        .outerjoin(presence, presence.c.robot == table.c.robot)
        .where(table.c.environment_id == bindparam("environment"), is_online())
        .group_by(table.c.channel)
    )


def _last_held_query() -> Select[Any]:
    table = tables.robot
    of_channel = table.c.environment_id == bindparam("environment"), table.c.channel == bindparam("channel")
    query = select(table.c.held_since).where(*of_channel, table.c.held_since.is_not(None))
    return query.order_by(table.c.held_since.desc()).limit(1)


_GROUPS: Final = _groups_query()
_ONLINE: Final = _online_query()
_LAST_HELD: Final = _last_held_query()
"""Queries, made once, since making one takes longer than executing it."""
