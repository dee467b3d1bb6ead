"""Robots: their last reports and active maps, the history of both, and their presence on the bus."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from datetime import datetime, timedelta
from fnmatch import fnmatchcase
from typing import Any, Final

from sqlalchemy import ColumnElement, Connection, Row, Select, case, delete, func, insert, select, true, tuple_, update

from app.errors import Conflict, FleetMapError, Invalid, NotFound
from app.event_types import RobotPlace
from app.store import tables
from app.store.base import environment_row, storable_text, upsert
from app.store.database import Database
from app.store.fleet_values import NO_ROOT, ActiveMap, ReceivedReport, Robot, RobotReport

HISTORY: Final = 200
"""Maximum number of reports stored per robot and environment."""

MAX_ROBOTS: Final = 10_000
"""Default of the number of robots that an environment may have: on a router without users anyone can invent names."""

MAX_PRESENT: Final = 100_000
"""Maximum number of robots whose presence on the bus is known."""

LAST_SEEN: Final = timedelta(seconds=60)
"""Minimum time between two stored times of a robot whose reports do not change."""


class Robots:
    """Store of the fleet. limit: number of robots that an environment may have."""

    def __init__(self, database: Database, *, limit: int = MAX_ROBOTS) -> None:
        self._database, self._limit = database, limit

    def note_reports(self, reports: Sequence[ReceivedReport]) -> list[FleetMapError | None]:
        """Store robot reports in the given order, in one transaction; returns for each None, or the error.

        A repetition of the last report, or of an earlier one received by another transport, only renews the time.
        Errors: NotFound for an unknown environment, Conflict if it has too many robots.
        """
        out: list[FleetMapError | None] = [None] * len(reports)
        with self._database.write(notify=False, upkeep=True) as connection:
            owners: dict[str, str | FleetMapError] = {}
            # same order for all writers, which avoids deadlocks; the order of each robot's reports stays
            for k in sorted(range(len(reports)), key=lambda k: (reports[k].environment, reports[k].robot)):
                name = reports[k].environment
                if name not in owners:
                    try:
                        owners[name] = environment_row(connection, name).id
                    except NotFound as error:
                        owners[name] = error
                owner = owners[name]
                out[k] = (
                    owner if isinstance(owner, FleetMapError) else _note(connection, owner, reports[k], self._limit)
                )
        return out

    def all(self, environment: str | None = None, robot: str | None = None) -> list[Robot]:
        """List robots by environment and name, of environments that are not deleted. Raises NotFound."""
        return self._list(environment, true() if robot is None else tables.robot.c.robot == robot)

    def received_since(self, environment: str | None, since: datetime) -> list[Robot]:
        """List robots whose last report was received after ``since``, by environment and name. Raises NotFound."""
        return self._list(environment, tables.robot.c.time > since)

    def page(
        self,
        environment: str | None = None,
        *,
        channel: str | None = None,
        limit: int = 100,
        cursor: str | None = None,
        allowed: str | None = None,
    ) -> tuple[list[Robot], str | None]:
        """List a page of robots, with the cursor of the next one: ``<environment>/<robot>``, the last one on the page.

        channel: only those that report on it. allowed: a pattern of environments' names (fnmatch). Raises Invalid for
        an invalid cursor.
        """
        table, owner = tables.robot, tables.environment
        query = _robots().where(owner.c.deleted.is_(None)).order_by(owner.c.name, table.c.robot)
        if channel is not None:
            query = query.where(table.c.channel == channel)
        out: list[Robot] = []
        many = limit + 1
        with self._database.read() as connection:
            if environment is not None:
                query = query.where(table.c.environment_id == environment_row(connection, environment).id)
            while len(out) <= limit:
                page = query
                if cursor is not None:
                    place, slash, robot = cursor.partition("/")
                    if not slash:
                        raise Invalid("invalid cursor: take it from the Link header of the previous page")
                    page = query.where(tuple_(owner.c.name, table.c.robot) > tuple_(place, robot))
                robots = [_as_robot(row) for row in connection.execute(page.limit(many))]
                out += [r for r in robots if allowed is None or fnmatchcase(r.environment, allowed)]
                if len(robots) < many:
                    break
                cursor = _cursor(robots[-1])
        return out[:limit], _cursor(out[limit - 1]) if len(out) > limit else None

    def history(self, environment: str, robot: str, limit: int = HISTORY) -> list[tuple[datetime, RobotReport]]:
        """List a robot's changed reports in an environment, each with the time of receipt, newest first."""
        table = tables.robot_history
        with self._database.read() as connection:
            row = environment_row(connection, environment)
            query = (
                select(table)
                .where(table.c.environment_id == row.id, table.c.robot == robot)
                .order_by(table.c.id.desc())
                .limit(limit)
            )
            return [(r.time, _as_report(r)) for r in connection.execute(query)]

    def forget(self, environment: str, robot: str) -> None:
        """Remove a robot and its history from an environment. Raises NotFound. Its next report adds it again."""
        with self._database.write(notify=False) as connection:
            row = environment_row(connection, environment)
            for table in (tables.robot_history, tables.robot):
                deleted_count = connection.execute(
                    delete(table).where(table.c.environment_id == row.id, table.c.robot == robot)
                ).rowcount
            if not deleted_count:
                raise NotFound(f"no robot {robot[:80]!r} has reported in {environment}")

    def present_robots(self) -> set[str]:
        """Return the names of the robots that are stored as being on the bus."""
        table = tables.presence
        with self._database.read() as connection:
            return set(connection.execute(select(table.c.robot).where(table.c.there)).scalars())

    def renew_presence(self, now: datetime) -> None:
        """Store that the robots on the bus are still there."""
        with self._database.write(notify=False, upkeep=True) as connection:
            connection.execute(update(tables.server).values(presence_checked=now))

    def note_presence(self, present_robots: Collection[str], absent_robots: Collection[str], now: datetime) -> None:
        """Store the robots that have come to the bus, and those that have left it."""
        table = tables.presence
        with self._database.write(notify=False, upkeep=True) as connection:
            room = MAX_PRESENT - int(connection.execute(select(func.count()).select_from(table)).scalar_one())
            rows = sorted([(name, True) for name in present_robots] + [(name, False) for name in absent_robots])
            for name, is_present in rows:
                if room < len(rows):  # table full: update stored robots, add no new ones
                    connection.execute(update(table).where(table.c.robot == name).values(there=is_present, time=now))
                    continue
                upsert(connection, table, {"robot": name}, {"there": is_present, "time": now})

    def _list(self, environment: str | None, condition: ColumnElement[bool]) -> list[Robot]:
        table, owner = tables.robot, tables.environment
        with self._database.read() as connection:
            query = _robots().where(owner.c.deleted.is_(None), condition).order_by(owner.c.name, table.c.robot)
            if environment is not None:
                query = query.where(table.c.environment_id == environment_row(connection, environment).id)
            return [_as_robot(row) for row in connection.execute(query)]


def _note(connection: Connection, environment_id: str, received: ReceivedReport, limit: int) -> FleetMapError | None:
    table, report = tables.robot, received.report
    conditions = (table.c.environment_id == environment_id, table.c.robot == received.robot)
    row = connection.execute(select(table).where(*conditions).with_for_update()).one_or_none()
    report_columns: dict[str, Any] = {
        "channel": report.channel,
        "version": report.version,
        "root": report.root,
        "state": report.state,
        "detail": None if report.detail is None else storable_text(report.detail),
        "sequence": report.sequence,
        "overlays": report.overlays,
    }
    values: dict[str, Any] = {**report_columns, "said": report.reported_at, "time": received.time}
    again = row is not None and all(getattr(row, name) == value for name, value in report_columns.items())
    if row is not None and again and _is_recent(connection, received, row):
        return None
    if row is not None and received.late and received.time < row.time:
        if not again and not _is_in_history(connection, environment_id, received, report_columns):
            _remember(connection, environment_id, received, report_columns)
        return None
    if row is not None and not again and _is_duplicate_report(connection, environment_id, received, report_columns):
        connection.execute(
            update(table).where(*conditions).values(time=received.time, vouched=row.vouched or received.vouched)
        )
        return None
    if not again:
        values["since"] = received.time
    values["vouched"] = received.vouched or (row is not None and row.vouched)
    values |= _held_values(report, row, received.time)
    if report.place is not None and not _is_delayed(report, row):
        values |= {"place": report.place.as_dict(), "placed": received.time}
    if row is not None:
        connection.execute(update(table).where(*conditions).values(values))
    else:
        tally = tables.robot_tally.c  # its sum: counting the robots of a large fleet takes a hundred times as long
        others = select(func.coalesce(func.sum(tally.number), 0)).where(tally.environment_id == environment_id)
        if connection.execute(others).scalar_one() >= limit:
            return Conflict(
                f"{received.environment} has {limit} robots: remove robots that no longer exist, or raise the limit"
            )
        keys = {"environment_id": environment_id, "robot": received.robot}
        upsert(connection, table, keys, values)  # the later writer wins
    if not again:
        _remember(connection, environment_id, received, report_columns)
    return None


def _is_recent(connection: Connection, received: ReceivedReport, row: Row[Any]) -> bool:
    """Return whether a repeated report has nothing to store: the robot's last time is recent.

    A failure is stored each time: a rollout counts those after its begin. So is the first report after the robot has
    left the bus, which shows that it is online without it.
    """
    presence = tables.presence
    report = received.report
    changes = report.place is not None or (received.vouched and not row.vouched) or report.state == "failed"
    changes = changes or (report.state != "active" and report.holds is not None)
    if changes or not timedelta(0) <= received.time - row.time < LAST_SEEN:
        return False
    left = select(presence.c.robot).where(
        presence.c.robot == received.robot, ~presence.c.there, presence.c.time >= row.time
    )
    return connection.execute(left).first() is None


def _is_delayed(report: RobotReport, row: Row[Any] | None) -> bool:
    """Return whether the stored report is newer by the robot's clock, so that its place counts."""
    return row is not None and None not in (row.said, report.reported_at) and report.reported_at < row.said


def _held_values(report: RobotReport, row: Row[Any] | None, time: datetime) -> dict[str, Any]:
    """Return the changed columns of a robot's active map.

    The report's ``holds`` counts in any report: a status may be lost, so that the first report that is received after a
    switch may be a failure of the next version.
    """
    holds = (report.version, report.root) if report.state == "active" else report.holds
    if holds is None:
        return {}
    version, root = holds
    if root == NO_ROOT:
        return dict.fromkeys(("held_version", "held_root", "held_sequence", "held_since", "held_overlays"))
    same = row is not None and (row.held_root, row.held_overlays) == (root, report.overlays)
    since = row.held_since if same and row is not None else time
    values = {"held_version": version, "held_root": root, "held_sequence": report.sequence, "held_since": since}
    return {**values, "held_overlays": report.overlays}


def _is_duplicate_report(
    connection: Connection, environment_id: str, received: ReceivedReport, report_columns: dict[str, Any]
) -> bool:
    """Return whether an equal report was received before: robots report over Zenoh and HTTP, one may be delayed."""
    table = tables.robot_history
    if received.report.reported_at is None:
        return False
    query = select(table.c.id).where(
        table.c.environment_id == environment_id,
        table.c.robot == received.robot,
        table.c.said == received.report.reported_at,
        *(table.c[name].is_not_distinct_from(value) for name, value in report_columns.items()),
    )
    return connection.execute(query.limit(1)).scalar_one_or_none() is not None


def _is_in_history(
    connection: Connection, environment_id: str, received: ReceivedReport, report_columns: dict[str, Any]
) -> bool:
    """Return whether a late report was handed on before."""
    table = tables.robot_history
    query = select(table.c.id).where(
        table.c.environment_id == environment_id,
        table.c.robot == received.robot,
        table.c.time == received.time,
        *(table.c[name].is_not_distinct_from(value) for name, value in report_columns.items()),
    )
    return connection.execute(query.limit(1)).scalar_one_or_none() is not None


def _remember(
    connection: Connection, environment_id: str, received: ReceivedReport, report_columns: dict[str, Any]
) -> None:
    table = tables.robot_history
    connection.execute(
        insert(table).values(
            environment_id=environment_id,
            robot=received.robot,
            said=received.report.reported_at,
            time=received.time,
            **report_columns,
        )
    )
    conditions = (table.c.environment_id == environment_id, table.c.robot == received.robot)
    oldest = select(table.c.id).where(*conditions).order_by(table.c.id.desc()).offset(HISTORY).limit(1)
    last = connection.execute(oldest).scalar_one_or_none()
    if last is not None:
        connection.execute(delete(table).where(*conditions, table.c.id <= last))


def _robots() -> Select[Any]:
    table, owner, presence = tables.robot, tables.environment, tables.presence
    return (
        select(table, owner.c.name.label("environment"), presence.c.there, presence_seen().label("seen"))
        .join(owner, owner.c.id == table.c.environment_id)
        .outerjoin(presence, presence.c.robot == table.c.robot)
    )


def presence_seen() -> ColumnElement[datetime]:
    """SQL expression: when a robot's presence was last checked, or else changed. NULL if it was never on the bus."""
    presence = tables.presence
    checked = select(tables.server.c.presence_checked).scalar_subquery()
    return case((presence.c.there & (checked > presence.c.time), checked), else_=presence.c.time)


def _as_report(row: Row[Any]) -> RobotReport:
    return RobotReport(row.channel, row.version, row.root, row.state, row.detail, row.sequence, row.said, row.overlays)


def _cursor(robot: Robot) -> str:
    return f"{robot.environment}/{robot.robot}"


def _as_robot(row: Row[Any]) -> Robot:
    active_map = None
    if row.held_root is not None:
        active_map = ActiveMap(row.held_version, row.held_root, row.held_sequence, row.held_since, row.held_overlays)
    more = (active_map, row.there, row.seen, row.vouched)
    place = None if row.place is None else RobotPlace.from_dict(row.place)
    return Robot(row.robot, row.environment, _as_report(row), row.time, row.since, *more, place, row.placed)
