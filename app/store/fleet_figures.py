"""Figures for an operator: robots behind their channel, rollouts that do not go on, closures that end soon.

A reading costs the number of different reports of robots, of open rollouts and of closures, not the number of robots.
Only robots that are behind are counted one by one, by an index; if they are many, at most every FRESH_SECONDS.
"""

from __future__ import annotations

import math
import threading
import time
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, Final

from sqlalchemy import ColumnElement, Connection, Row, Select, bindparam, case, func, select

from app.model.closures import NO_CLOSURES
from app.store import tables
from app.store.channels import DUE_MOVES, OPEN_ROLLOUT_ROWS
from app.store.column_types import UtcDateTime
from app.store.database import Database
from app.store.fleet_values import RobotGroup, Rollout
from app.store.overlays import read_closures
from app.store.robot_counts import is_online
from app.store.values import LATEST

LATE: Final = timedelta(minutes=15)
"""Age of the map of a robot behind its channel from which on it is late: robots take a new map within seconds."""

ENDS_SOON: Final = timedelta(hours=1)
LASTING: Final = timedelta(hours=6)
"""Time before its end within which a closure ends soon, and minimum duration of closures that are worth a message."""

LARGE: Final = 1000
"""Number of robots behind their channels above which they are counted at most every FRESH_SECONDS."""

FRESH_SECONDS: Final = 60.0
MAX_ROWS: Final = 10_000
"""Maximum number of channels, rollouts and closures that are read."""


@dataclass(frozen=True, slots=True)
class ChannelRobots:
    """Numbers of a channel's robots. failed: of those that do not run its map, robots that reported a failure.

    late: robots that are online, do not run the channel's map, and have run their map for LATE.
    """

    environment: str
    channel: str
    holding: int
    lagging: int
    failed: int
    late: int


@dataclass(frozen=True, slots=True)
class OpenRollout:
    """An open rollout.

    overdue: seconds since its time (without one, since its start), or since the end of its watch; 0 before.
    """

    environment: str
    channel: str
    state: str
    overdue: float


@dataclass(frozen=True, slots=True)
class OverlayCounts:
    """Numbers of an environment's overlays. ending: closures of at least LASTING that end within ENDS_SOON."""

    environment: str
    in_force: int
    pending: int
    ending: int


Group = tuple[str | None, str | None]
"""Root and digest of closures of the map that robots run."""


class FleetFigures:
    """Service for the figures of all environments. Thread-safe."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._lock = threading.Lock()
        self._late: Mapping[tuple[str, str], int] = {}
        self._counted = -math.inf

    def robots(self, *, on_bus_after: datetime, heard_after: datetime) -> list[ChannelRobots]:
        """Count the robots of all channels. on_bus_after, heard_after: see ``RobotCounts.read``."""
        with self._database.read() as connection:
            rows = connection.execute(_GROUPS.limit(MAX_ROWS)).all()
            digests = _closure_digests(connection)
            behind: dict[tuple[str, str], set[Group]] = defaultdict(set)
            counts: dict[tuple[str, str], list[int]] = defaultdict(lambda: [0, 0, 0])
            names: dict[str, str] = {}
            for row in rows:
                key, group = (row.environment_id, row.channel), _as_group(row)
                names[row.environment_id] = row.environment
                shows = group.shows(row.channel_root, digests.get(row.environment_id, NO_CLOSURES.digest))
                counts[key][0 if shows else 2 if group.state == "failed" else 1] += group.number
                if not shows:
                    behind[key].add((group.held_root, group.held_overlays))
            number = sum(lagging + failed for _, lagging, failed in counts.values())
            times = {"on_bus_after": on_bus_after, "heard_after": heard_after}
            late = self._count_late(connection, behind, number, times)
        return [
            ChannelRobots(names[key[0]], key[1], holding, lagging, failed, late.get(key, 0))
            for key, (holding, lagging, failed) in sorted(counts.items(), key=lambda c: (names[c[0][0]], c[0][1]))
        ]

    def _count_late(
        self,
        connection: Connection,
        behind: Mapping[tuple[str, str], Iterable[Group]],
        number: int,
        times: Mapping[str, datetime],
    ) -> Mapping[tuple[str, str], int]:
        """Count the late robots of channels. number: of robots that are behind."""
        with self._lock:
            if number > LARGE and time.monotonic() - self._counted < FRESH_SECONDS:
                return self._late
            self._counted = time.monotonic()
        values = {**times, "taken_before": self._database.now() - LATE}
        late = {
            (environment, channel): sum(
                connection.execute(
                    _late_query(*group), {**values, "environment": environment, "channel": channel}
                ).scalar_one()
                for group in groups
            )
            for (environment, channel), groups in behind.items()
        }
        with self._lock:
            self._late = late
        return late

    def rollouts(self) -> list[OpenRollout]:
        """List the open rollouts."""
        with self._database.read() as connection:
            rows = connection.execute(OPEN_ROLLOUT_ROWS.limit(MAX_ROWS)).all()
        now = self._database.now()
        out = []
        for row in rows:
            rollout = Rollout.from_row(row.rollout)
            overdue = max(0.0, (now - _rollout_due(rollout)).total_seconds())
            out.append(OpenRollout(row.environment, row.name, rollout.state, overdue))
        return out

    def overdue_moves(self) -> float:
        """Return by how many seconds the planned move of a channel that is the most overdue is late; 0 without one."""
        now = self._database.now()
        with self._database.read() as connection:
            first = connection.execute(DUE_MOVES.limit(1), {"now": now}).first()
        return 0.0 if first is None else (now - first.planned_at).total_seconds()

    def overlays(self) -> list[OverlayCounts]:
        """Count the overlays of environments that have some pending or in force."""
        table, owner = tables.overlay, tables.environment
        open_ones = table.c.state.in_(("pending", "accepted"))
        query = (
            select(table.c.environment_id, owner.c.name, table.c.state, func.count().label("number"))
            .join(owner, owner.c.id == table.c.environment_id)
            .where(open_ones, owner.c.deleted.is_(None))
            .group_by(table.c.environment_id, owner.c.name, table.c.state)
            .order_by(owner.c.name)
        )
        now = self._database.now()
        soon = select(table.c.environment_id, table.c.created, table.c.decided, table.c.expires)
        soon = soon.where(table.c.state == "accepted", table.c.expires <= now + ENDS_SOON).order_by(table.c.expires)
        with self._database.read() as connection:
            rows = connection.execute(query.limit(MAX_ROWS)).all()
            ending: dict[str, int] = defaultdict(int)
            for row in connection.execute(soon.limit(MAX_ROWS)):
                ending[row.environment_id] += row.expires - (row.decided or row.created) >= LASTING
        numbers: dict[tuple[str, str], dict[str, int]] = defaultdict(dict)
        for row in rows:
            numbers[row.environment_id, row.name][row.state] = row.number
        return [
            OverlayCounts(name, states.get("accepted", 0), states.get("pending", 0), ending[environment_id])
            for (environment_id, name), states in numbers.items()
        ]


def _rollout_due(rollout: Rollout) -> datetime:
    """Return from when on a rollout could go on, but for its robots."""
    if rollout.state == "watching":
        return (rollout.moved or rollout.started) + timedelta(seconds=rollout.window)
    return rollout.activate_at or rollout.started


def _closure_digests(connection: Connection) -> dict[str, str]:
    """Return the digests of the closures in force, of environments that have some."""
    table, owner = tables.overlay, tables.environment
    with_closures = select(table.c.environment_id).where(table.c.state == "accepted").distinct()
    rows: Sequence[Row[Any]] = connection.execute(select(owner).where(owner.c.id.in_(with_closures))).all()
    return {row.id: read_closures(connection, row).digest for row in rows}


def _as_group(row: Row[Any]) -> RobotGroup:
    return RobotGroup(row.channel, row.state, "", row.held_root, row.held_overlays, True, row.number)


def _groups_query() -> Select[Any]:
    table, owner, channel, version = tables.robot_tally, tables.environment, tables.channel, tables.version
    columns = [table.c.environment_id, table.c.channel, table.c.state, table.c.held_root, table.c.held_overlays]
    number = func.sum(table.c.number)
    # grouped before the joins: there are up to 200 rows of an environment with equal values
    groups = select(*columns, number.label("number")).group_by(*columns).having(number != 0).subquery()
    root: ColumnElement[str] = case((groups.c.channel == LATEST, owner.c.root), else_=version.c.root)
    named = (channel.c.environment_id == groups.c.environment_id) & (channel.c.name == groups.c.channel)
    pointed = (version.c.environment_id == groups.c.environment_id) & (version.c.number == channel.c.version)
    return (
        select(groups, owner.c.name.label("environment"), root.label("channel_root"))
        .join(owner, owner.c.id == groups.c.environment_id)
        .outerjoin(channel, named)
        .outerjoin(version, pointed)
        .where(owner.c.deleted.is_(None), root.is_not(None))
        .order_by(owner.c.name, groups.c.channel)
    )


def _late_query(root: str | None, overlays: str | None) -> Select[Any]:
    """Count the late robots of a channel that run a map. PostgreSQL uses the index only for ``=`` and ``IS NULL``."""
    table, presence = tables.robot, tables.presence
    return (
        select(func.count())
        .select_from(table)
        .outerjoin(presence, presence.c.robot == table.c.robot)
        .where(
            table.c.environment_id == bindparam("environment"),
            table.c.channel == bindparam("channel"),
            table.c.held_root.is_(None) if root is None else table.c.held_root == root,
            table.c.held_overlays.is_(None) if overlays is None else table.c.held_overlays == overlays,
            func.coalesce(table.c.held_since, table.c.since) <= bindparam("taken_before", type_=UtcDateTime),
            is_online(),
        )
    )


_GROUPS: Final = _groups_query()
