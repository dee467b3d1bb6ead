"""Channels: movable names for versions, moved at once or at a planned time, each move with its event."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from typing import Any, Final, Literal

from sqlalchemy import Connection, Row, bindparam, insert, select, update

from app.errors import Conflict, Invalid, NotFound
from app.model.closures import ClosureMode, Closures
from app.store import outbox, tables
from app.store.base import CHANNEL_NAME, checked_text, environment_row, nearest_channel
from app.store.database import Database
from app.store.fleet_values import (
    OPEN_ROLLOUTS,
    Channel,
    ChannelMove,
    PlannedMove,
    Rollout,
    RolloutState,
    RolloutStep,
)
from app.store.manifest import read_version
from app.store.overlays import CHANGE_CLOSURES, read_closures
from app.store.pending import check_committed
from app.store.rollout_robots import OnlineCache, RolloutRobots
from app.store.values import LATEST, Position, Version, rfc3339

_channel, _owner = tables.channel, tables.environment
DUE_MOVES: Final = (
    select(_owner.c.name.label("environment"), _channel.c.name, _channel.c.planned_at)
    .join(_owner, _owner.c.id == _channel.c.environment_id)
    .where(_channel.c.planned_at <= bindparam("now"), _channel.c.rollout_state.is_distinct_from("waiting"))
    .where(_owner.c.deleted.is_(None))
    .where(_owner.c.centre.is_(None) | _channel.c.rollout_state.is_(None))
    .order_by(_channel.c.planned_at, _owner.c.name, _channel.c.name)
)
"""Planned moves whose time has come, the most overdue first, that wait for nothing else."""

OPEN_ROLLOUT_ROWS: Final = (
    select(_channel, _owner.c.name.label("environment"))
    .join(_owner, _owner.c.id == _channel.c.environment_id)
    .where(_channel.c.rollout_state.in_(OPEN_ROLLOUTS), _owner.c.deleted.is_(None), _owner.c.centre.is_(None))
    .order_by(_owner.c.name, _channel.c.name)
)

_NO_PLAN: Final[Mapping[str, None]] = {"planned_version": None, "planned_at": None, "planned_author": None}

MAX_MOVES: Final = 1000
"""Maximum number of past moves of a channel that are read."""


class Channels:
    """Service for the channels of environments."""

    def __init__(self, database: Database) -> None:
        self._database, self._online = database, OnlineCache()

    def all(self, environment: str) -> list[Channel]:
        """List channels: ``latest`` first, then the others by name."""
        table, version = tables.channel, tables.version
        with self._database.read() as connection:
            row = environment_row(connection, environment)
            head = connection.execute(
                select(version.c.author, version.c.time, version.c.sequence).where(
                    version.c.environment_id == row.id, version.c.number == row.head
                )
            ).one()
            planned = version.alias("planned")
            query = (
                select(table, version.c.root, planned.c.root.label("planned_root"))
                .outerjoin(
                    version,
                    (version.c.environment_id == table.c.environment_id) & (version.c.number == table.c.version),
                )
                .outerjoin(
                    planned,
                    (planned.c.environment_id == table.c.environment_id)
                    & (planned.c.number == table.c.planned_version),
                )
                .where(table.c.environment_id == row.id)
                .order_by(table.c.name)
            )
            closures = read_closures(connection, row)
            rows = connection.execute(query).all()
        others = [_as_channel(r, r.root, r.planned_root, row, closures) for r in rows]
        latest = Channel(LATEST, row.head, row.root, head.sequence, None, head.author, head.time)
        return [replace(latest, closures=closures, closures_sequence=row.closures_sequence), *others]

    def target(self, environment: str, ref: str | int, closures: ClosureMode | None = None) -> tuple[Version, Position]:
        """Read a version by number or channel as maps show it, with its position.

        closures: how maps show the closures in force; default: applied for a channel, ignored for a number (history).
        The sequence is that of the event that moved the channel to the version (or created the version) or, if later,
        of the event that last changed the closures in force. Raises Invalid for a dry run or
        draft, which robots cannot get.
        """
        check_committed(ref)
        mode = closures or ("ignore" if isinstance(ref, int) else "apply")
        table, version = tables.channel, tables.version
        with self._database.snapshot() as connection:
            row = environment_row(connection, environment)
            if isinstance(ref, int) or ref == LATEST:
                number = row.head if ref == LATEST else int(ref)
                query = select(version.c.sequence).where(version.c.environment_id == row.id, version.c.number == number)
                sequence = connection.execute(query).scalar()
            else:
                channel_row = connection.execute(
                    select(table.c.version, table.c.sequence).where(
                        table.c.environment_id == row.id, table.c.name == ref
                    )
                ).one_or_none()
                if channel_row is None or channel_row.version is None:
                    near = nearest_channel(connection, row, ref)
                    raise NotFound(f"{environment} has no channel {ref!r:.80} that points to a version{near}")
                number, sequence = channel_row.version, channel_row.sequence
            stored_version, sequence = read_version(connection, row, number), int(sequence or 0)
            if mode == "ignore":
                return stored_version, Position(sequence, int(row.edge_sequence), row.centre_epoch)
            in_force = read_closures(connection, row).for_mode(mode)
            sequence = max(sequence, int(row.closures_sequence))
            position = Position(sequence, int(row.edge_sequence), row.centre_epoch)
            return replace(stored_version, closures=in_force), position

    def move(
        self,
        environment: str,
        channel: str,
        version: int,
        *,
        author: str,
        activate_at: datetime | None = None,
        rollout: Rollout | None = None,
    ) -> Channel:
        """Move a channel to a version at once, or plan the move; replaces an earlier plan.

        Args:
            activate_at: time of the planned move, aware.
            rollout: makes it a two-stage rollout; its version and root are set here.

        A move at once and another rollout end any open rollout; a plan ends one that still waits. Raises Conflict if a
        move is planned while robots are watched: the plan would end the watch unnoticed.

        The event has ``rollback: true`` if the version is lower than the channel's. Moving a channel to its current
        version changes nothing except that a plan is cancelled, with its event. ``latest`` cannot be moved.
        """
        _check_name(channel)
        if activate_at is not None and activate_at.tzinfo is None:
            raise Invalid("activate_at needs a time zone, for example 2026-05-01T04:00:00Z")
        with self._database.write() as connection:
            row = environment_row(connection, environment, lock=True)
            write = _ChannelWrite(connection, row, channel, self._database.now())
            author_name = checked_text(author, "an author")
            if rollout is not None:
                root = read_version(connection, row, version).root
                rollout = replace(rollout, version=version, root=root, activate_at=activate_at, started=write.now)
            if activate_at is None and (rollout is None or rollout.ready is None):
                _move(write, version, author_name, rollout=rollout)
            else:
                _plan(write, version, author_name, activate_at, rollout)
            return write.read()

    def moves(self, environment: str, channel: str) -> list[ChannelMove]:
        """List the newest events that moved a channel, oldest first; for ``latest`` each new version.

        Events that changed the closures in force are included, with an empty root: they move no channel.
        """
        table = tables.event
        kind = table.c.body["type"].as_string()
        with self._database.read() as connection:
            row = environment_row(connection, environment)
            moved = kind == "version.created"
            if channel != LATEST:
                moved = (kind == "channel.moved") & (table.c.body["channel"].as_string() == channel)
            query = select(table.c.sequence, table.c.body, table.c.time).where(
                table.c.environment_id == row.id, moved | kind.in_(CHANGE_CLOSURES)
            )
            rows = connection.execute(query.order_by(table.c.sequence.desc()).limit(MAX_MOVES)).all()
        return [
            ChannelMove(r.sequence, r.body["version"], "" if "overlay" in r.body else r.body["root"], r.time)
            for r in reversed(rows)
        ]

    def cancel_planned(self, environment: str, channel: str, author: str) -> Channel:
        """Cancel a planned move. Raises NotFound if there is none."""
        with self._database.write() as connection:
            row = environment_row(connection, environment, lock=True)
            write = _ChannelWrite(connection, row, channel, self._database.now())
            channel_row = write.read_row()
            if channel_row is None or channel_row.planned_version is None:
                raise NotFound(f"channel {channel!r:.80} of {environment} has no planned move")
            why, author_name = "the plan was cancelled", checked_text(author, "an author")
            if channel_row.rollout_state == "waiting":
                _end_rollout(write, channel_row, "cancelled", why, author_name)
            else:
                write.store(channel_row, **_NO_PLAN)
                _append_cancelled_event(write, channel_row, why, author_name)
            return write.read()

    def apply_due_moves(self, now: datetime) -> list[tuple[str, Channel]]:
        """Carry out the planned moves that are due; returns (environment, channel) in the order of their times.

        A mirror carries out the moves that wait for nothing but their time, since it may be cut off from its centre.
        """
        with self._database.read() as connection:
            due = connection.execute(DUE_MOVES, {"now": now}).all()
        out = []
        for environment, name, _ in due:
            with self._database.write() as connection:
                row = environment_row(connection, environment, lock=True, mirrored=True)
                write = _ChannelWrite(connection, row, name, now)
                channel_row = write.read_row()
                if channel_row is None or channel_row.planned_at is None or channel_row.planned_at > now:
                    continue
                if channel_row.rollout_state == "waiting":
                    continue
                _move(write, channel_row.planned_version, channel_row.planned_author or "")
                out.append((environment, write.read()))
        return out

    def advance_rollouts(self, now: datetime, decide: Decide) -> list[tuple[str, Channel]]:
        """Advance every open rollout by one step, each in its own transaction; returns (environment, channel) of those.

        decide: chooses the step of a rollout, given the robots of its channel. It is called again inside the
        transaction, so that it decides on the current state; before, counts of large channels may be some seconds old.
        """
        with self._database.read() as connection:
            rows = connection.execute(OPEN_ROLLOUT_ROWS).all()
            due = [r for r in rows if _next(connection, r, now, decide, self._online) is not None]
        out = []
        for due_row in due:
            with self._database.write() as connection:
                row = environment_row(connection, due_row.environment, lock=True)
                write = _ChannelWrite(connection, row, due_row.name, now)
                channel_row = write.read_row()
                if channel_row is None or channel_row.rollout_state not in OPEN_ROLLOUTS:
                    continue
                step = _next(connection, channel_row, now, decide)
                if step is not None:
                    _apply_step(write, channel_row, step)
                    out.append((due_row.environment, write.read()))
        return out


Decide = Callable[[Rollout, RolloutRobots, datetime], RolloutStep | None]


@dataclass(frozen=True, slots=True)
class _ChannelWrite:
    """A channel in a transaction that has locked its environment. now: the time of what is written."""

    connection: Connection
    environment: Row[Any]
    name: str
    now: datetime

    def read_row(self) -> Row[Any] | None:
        table = tables.channel
        return self.connection.execute(
            select(table).where(table.c.environment_id == self.environment.id, table.c.name == self.name)
        ).one_or_none()

    def read_version(self, number: int) -> Version:
        return read_version(self.connection, self.environment, number)

    def read(self) -> Channel:
        row = self.read_row()
        if row is None:
            near = nearest_channel(self.connection, self.environment, self.name)
            raise NotFound(f"{self.environment.name} has no channel {self.name!r:.80}{near}")
        root = None if row.version is None else self.read_version(row.version).root
        planned = None if row.planned_version is None else self.read_version(row.planned_version).root
        return _as_channel(row, root, planned, self.environment, read_closures(self.connection, self.environment))

    def store(self, row: Row[Any] | None, **values: Any) -> None:
        """Update the channel's row; row: None inserts one."""
        table = tables.channel
        if row is None:
            self.connection.execute(insert(table).values(environment_id=self.environment.id, name=self.name, **values))
        else:
            self.connection.execute(
                update(table)
                .where(table.c.environment_id == self.environment.id, table.c.name == self.name)
                .values(**values)
            )


def _next(
    connection: Connection, channel: Row[Any], now: datetime, decide: Decide, cache: OnlineCache | None = None
) -> RolloutStep | None:
    rollout = Rollout.from_row(channel.rollout)
    robots = RolloutRobots(connection, channel.environment_id, channel.name, rollout.root, cache)
    return decide(rollout, robots, now)


def _with_prior_failures(write: _ChannelWrite, rollout: Rollout) -> Rollout:
    """Note the robots that had reported a failure of this version before the rollout's stage began."""
    robots = RolloutRobots(write.connection, write.environment.id, write.name, rollout.root)
    failed = robots.failed(on_bus_after=write.now, heard_after=write.now)
    return replace(rollout, said_before={one.robot: rfc3339(one.time) for one in failed})


def _apply_step(write: _ChannelWrite, channel: Row[Any], step: RolloutStep) -> None:
    """Apply one step of a rollout: move or move back with an event, or end."""
    rollout = Rollout.from_row(channel.rollout)
    ended = replace(rollout, state=step.state, detail=step.detail)
    if step.do == "move":
        _move(write, rollout.version, channel.planned_author or "", rollout=ended, reason=step.detail)
    elif step.do == "move_back" and rollout.before is not None:
        _move(write, rollout.before, channel.author, rollout=ended, reason=step.detail, rollback=True)
    else:
        _end_rollout(write, channel, step.state, step.detail, channel.planned_author or "")


def _end_rollout(write: _ChannelWrite, channel: Row[Any], state: RolloutState, detail: str, author: str) -> None:
    """End a rollout; a planned move that still waits for it is cancelled, with its event."""
    rollout = replace(Rollout.from_row(channel.rollout), state=state, detail=detail)
    values: dict[str, Any] = {"rollout": rollout.as_row(), "rollout_state": state}
    dropped = channel.rollout_state == "waiting" and channel.planned_version is not None
    write.store(channel, **values, **(_NO_PLAN if dropped else {}))
    if dropped:
        _append_cancelled_event(write, channel, detail, author)


def _check_name(channel: str) -> None:
    if channel == LATEST:
        raise Invalid("channel latest cannot be moved: it always points to the newest version")
    if not CHANNEL_NAME.fullmatch(channel):
        raise Invalid(
            f"invalid channel name {channel[:80]!r}: use at most 63 of a-z, 0-9, _ and -, starting with a letter"
        )


def _as_channel(
    row: Row[Any], root: str | None, planned_root: str | None, environment: Row[Any], closures: Closures
) -> Channel:
    planned = None
    if row.planned_version is not None:
        planned = PlannedMove(row.planned_version, row.planned_at, row.planned_author or "", planned_root or "")
    rollout = None if row.rollout is None else Rollout.from_row(row.rollout)
    more = (closures, environment.closures_sequence)
    return Channel(row.name, row.version, root, row.sequence, planned, row.author, row.time, rollout, *more)


def _move(
    write: _ChannelWrite,
    number: int,
    author: str,
    *,
    rollout: Rollout | None = None,
    reason: str = "",
    rollback: bool = False,
) -> None:
    """Move a channel.

    rollout: the rollout that the move belongs to; if it has a limit of failures, it is watched from now on.
    """
    target = write.read_version(number)
    channel_row = write.read_row()
    nothing: dict[str, Any] = {**_NO_PLAN}
    before = None
    if channel_row is not None and channel_row.version is not None:
        before = write.read_version(channel_row.version)
    if rollout is not None and rollout.state in OPEN_ROLLOUTS:
        watched = rollout.failed is not None and before is not None and before.number != number
        state: RolloutState = "watching" if watched else "done"
        rollout = replace(rollout, state=state, moved=write.now, before=before.number if before else None)
        rollout = _with_prior_failures(write, rollout)
    nothing |= {"rollout": None, "rollout_state": None}
    if rollout is not None:
        nothing |= {"rollout": rollout.as_row(), "rollout_state": rollout.state}
    if before is not None and before.number == number:
        write.store(channel_row, **nothing)
        if channel_row is not None and channel_row.planned_version not in (None, number):
            _append_cancelled_event(write, channel_row, "the channel stays at its version", author)
        return
    # in a mirror the next sequence is its centre's: the move is in order by the number of the mirror's own changes
    sequence = write.environment.sequence + (1 if write.environment.centre is None else 0)
    write.store(channel_row, version=number, sequence=sequence, author=author, time=write.now, **nothing)
    about = {"reason": reason} if reason else {}
    _append_event(write, "channel.moved", before, target, author, rollback=rollback, **about)


def _plan(write: _ChannelWrite, number: int, author: str, at: datetime | None, rollout: Rollout | None) -> None:
    target = write.read_version(number)
    channel_row = write.read_row()
    before = None
    if channel_row is not None and channel_row.version is not None:
        before = write.read_version(channel_row.version)
    if rollout is None and channel_row is not None and channel_row.rollout_state == "watching":
        watched = Rollout.from_row(channel_row.rollout)
        until = "" if watched.moved is None else f" until {rfc3339(watched.moved + timedelta(seconds=watched.window))}"
        raise Conflict(f"version {watched.version} is watched for failures{until}: plan after that, or move now")
    if rollout is not None:
        rollout = _with_prior_failures(write, rollout)
    plan: dict[str, Any] = {"planned_version": number, "planned_at": at, "planned_author": author}
    plan |= {"rollout": rollout and rollout.as_row(), "rollout_state": rollout and rollout.state}
    if channel_row is None:
        plan |= {"version": None, "sequence": 0, "author": author, "time": write.now}
    write.store(channel_row, **plan)
    about: dict[str, Any] = {}
    if at is not None:
        about["activate_at"] = rfc3339(at)
    if rollout is not None:
        about["rollout"] = {
            "ready": rollout.ready,
            "failed": rollout.failed,
            "deadline": None if rollout.deadline is None else rfc3339(rollout.deadline),
        }
    _append_event(write, "channel.planned", before, target, author, **about)


def _append_cancelled_event(write: _ChannelWrite, channel: Row[Any], reason: str, author: str) -> None:
    """Append the event of a plan that was cancelled without a move. channel: the row that still has the plan."""
    before = None if channel.version is None else write.read_version(channel.version)
    target = write.read_version(channel.planned_version)
    _append_event(write, "channel.cancelled", before, target, author, reason=reason)


def _append_event(
    write: _ChannelWrite,
    kind: Literal["channel.planned", "channel.cancelled", "channel.moved"],
    before: Version | None,
    target: Version,
    author: str,
    *,
    rollback: bool = False,
    **about: Any,
) -> None:
    """Append the event of a channel that was moved, planned, or whose plan was cancelled."""
    environment, sequence, edge = write.environment, write.environment.sequence + 1, None
    values = {"sequence": sequence}
    if environment.centre is not None:
        sequence, edge = environment.sequence, environment.edge_sequence + 1
        values = {"edge_sequence": edge}
    table = tables.environment
    write.connection.execute(update(table).where(table.c.id == environment.id).values(values))
    outbox.append_event(
        write.connection,
        environment_id=environment.id,
        environment=environment.name,
        kind=kind,
        version=target.number,
        root=target.root,
        previous=None if before is None else (before.number, before.root),
        layers=()
        if kind == "channel.cancelled"
        else outbox.layer_changes(before.parts if before else (), target.parts),
        message=target.message,
        channel=write.name,
        rollback=rollback or (before is not None and target.number < before.number),
        sequence=sequence,
        author=author,
        time=write.now,
        edge=edge,
        **about,
    )
