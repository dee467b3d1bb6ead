"""What a rollout has to know of its channel's robots: those that failed, and how many are online and ready.

No robot but those that failed is read: the database counts. Only authenticated robots count.
"""

from __future__ import annotations

import time
from datetime import datetime
from functools import lru_cache
from typing import Any, Final

from sqlalchemy import ColumnElement, Connection, Select, and_, bindparam, case, func, literal_column, or_, select

from app.store import tables
from app.store.fleet_values import FailedRobot, OnlineCounts
from app.store.robot_counts import FRESH_SECONDS, LARGE, is_online


class OnlineCache:
    """Counts of large channels, which are used for some seconds. For one thread."""

    def __init__(self) -> None:
        self._counts: dict[tuple[str, str, str], tuple[float, OnlineCounts]] = {}

    def get(self, key: tuple[str, str, str]) -> OnlineCounts | None:
        """Return counts that are recent enough."""
        until, counts = self._counts.get(key, (0.0, None))
        return counts if time.monotonic() < until else None

    def put(self, key: tuple[str, str, str], counts: OnlineCounts) -> None:
        """Store the counts of a channel with many robots."""
        now = time.monotonic()
        self._counts = {k: entry for k, entry in self._counts.items() if entry[0] > now}
        if counts.online > LARGE:
            self._counts[key] = (now + FRESH_SECONDS, counts)


class RolloutRobots:
    """Robots of a channel within a transaction, as a rollout of the version with ``root`` sees them.

    cache: of counts that may be some seconds old; None for a decision that is carried out.
    """

    def __init__(
        self, connection: Connection, environment_id: str, channel: str, root: str, cache: OnlineCache | None = None
    ) -> None:
        self._connection, self._key, self._cache = connection, (environment_id, channel, root), cache

    def failed(self, *, on_bus_after: datetime, heard_after: datetime) -> list[FailedRobot]:
        """List the robots that report a failure of the version, by name. Times: as of ``RobotCounts.read``."""
        rows = self._connection.execute(_failed_query(), self._values(on_bus_after, heard_after))
        failed = [FailedRobot(row.robot, row.time, bool(row.online)) for row in rows]
        return sorted(failed, key=lambda one: one.robot)  # sorted by the database, SQLite would read all robots

    def online(self, *, on_bus_after: datetime, heard_after: datetime) -> OnlineCounts:
        """Count the robots that are online, and of them those that have or run the version."""
        counts = None if self._cache is None else self._cache.get(self._key)
        if counts is None:
            row = self._connection.execute(_online_query(), self._values(on_bus_after, heard_after)).one()
            counts = OnlineCounts(row.online, row.ready or 0)
            if self._cache is not None:
                self._cache.put(self._key, counts)
        return counts

    def _values(self, on_bus_after: datetime, heard_after: datetime) -> dict[str, Any]:
        environment_id, channel, root = self._key
        values = {"environment": environment_id, "channel": channel, "root": root}
        return {**values, "on_bus_after": on_bus_after, "heard_after": heard_after}


_FAILED: Final[ColumnElement[str]] = literal_column("'failed'")
"""As in the condition of the index ``ix_robot_failed``: SQLite does not use it for a parameter."""


def _of_channel() -> tuple[ColumnElement[bool], ...]:
    table = tables.robot
    return (
        table.c.environment_id == bindparam("environment"),
        table.c.channel == bindparam("channel"),
        table.c.vouched,
    )


@lru_cache
def _failed_query() -> Select[Any]:
    table, presence = tables.robot, tables.presence
    return (
        select(table.c.robot, table.c.time, is_online().label("online"))
        .outerjoin(presence, presence.c.robot == table.c.robot)
        .where(*_of_channel(), table.c.state == _FAILED, table.c.root == bindparam("root"))
    )


@lru_cache
def _online_query() -> Select[Any]:
    """Count robots: ready are those that have fetched the version or run it."""
    table, presence = tables.robot, tables.presence
    loaded = and_(table.c.state.in_(("ready", "active")), table.c.root == bindparam("root"))
    is_ready = or_(loaded, func.coalesce(table.c.held_root, "") == bindparam("root"))
    columns: tuple[ColumnElement[Any], ...] = (
        func.count().label("online"),
        func.sum(case((is_ready, 1), else_=0)).label("ready"),
    )
    return (
        select(*columns)
        .select_from(table)
        .outerjoin(presence, presence.c.robot == table.c.robot)
        .where(*_of_channel(), is_online())
    )
