"""Channels: movable names for versions, moved at once or at a planned time, each move with its event."""

from __future__ import annotations

from datetime import datetime
from typing import Any, Literal

from sqlalchemy import Connection, Row, insert, select, update

from app.errors import Invalid, NotFound
from app.store import outbox, tables
from app.store.base import CHANNEL_NAME, Base, environment_row, text, utcnow
from app.store.manifest import read_version
from app.store.values import LATEST, Channel, Planned, Version, rfc3339


class Channels(Base):
    """The channels of environments."""

    def channels(self, environment: str) -> list[Channel]:
        """``latest`` first, then the others by name."""
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
            others = [_as_channel(r, r.root, r.planned_root) for r in connection.execute(query)]
        return [Channel(LATEST, row.head, row.root, head.sequence, None, head.author, head.time), *others]

    def standing(self, environment: str, ref: str | int) -> tuple[Version, int]:
        """A version by number or channel, and the sequence of the event that brought it (the channel) there."""
        table, version = tables.channel, tables.version
        with self._database.snapshot() as connection:
            row = environment_row(connection, environment)
            if isinstance(ref, int) or ref == LATEST:
                number = row.head if ref == LATEST else int(ref)
                query = select(version.c.sequence).where(version.c.environment_id == row.id, version.c.number == number)
                sequence = connection.execute(query).scalar()
            else:
                known = connection.execute(
                    select(table.c.version, table.c.sequence).where(
                        table.c.environment_id == row.id, table.c.name == ref
                    )
                ).one_or_none()
                if known is None or known.version is None:
                    raise NotFound(f"{environment} has no channel {ref!r} that stands on a version")
                number, sequence = known.version, known.sequence
            return read_version(connection, row, number), int(sequence or 0)

    def set_channel(
        self, environment: str, channel: str, version: int, *, author: str, activate_at: datetime | None = None
    ) -> Channel:
        """Move a channel to a version, or plan to (``activate_at``, an aware time); the plan of before is dropped.

        The event tells ``rollback: true`` where the version is lower than the channel's. Moving it to where it is
        changes nothing. ``latest`` cannot be moved.
        """
        _check_name(channel)
        if activate_at is not None and activate_at.tzinfo is None:
            raise Invalid("activate_at needs a time zone, for example 2026-05-01T04:00:00Z")
        with self._database.write() as connection:
            row = environment_row(connection, environment, lock=True)
            if activate_at is None:
                _move(connection, row, channel, version, text(author, "an author"), utcnow())
            else:
                _plan(connection, row, channel, version, text(author, "an author"), activate_at)
            return _read(connection, row, channel)

    def cancel_planned(self, environment: str, channel: str, author: str) -> Channel:
        """Forget a planned move; NotFound where there is none."""
        table = tables.channel
        del author
        with self._database.write() as connection:
            row = environment_row(connection, environment, lock=True)
            known = _row(connection, row, channel)
            if known is None or known.planned_version is None:
                raise NotFound(f"channel {channel!r} of {environment} has no planned move")
            connection.execute(
                update(table)
                .where(table.c.environment_id == row.id, table.c.name == channel)
                .values(planned_version=None, planned_at=None, planned_author=None)
            )
            return _read(connection, row, channel)

    def apply_due(self, now: datetime) -> list[tuple[str, Channel]]:
        """Carry out the planned moves whose time has come: (environment, channel), in the order of their times."""
        table, owner = tables.channel, tables.environment
        query = (
            select(owner.c.name.label("environment"), table.c.name)
            .join(owner, owner.c.id == table.c.environment_id)
            .where(table.c.planned_at <= now, owner.c.deleted.is_(None))
            .order_by(table.c.planned_at, owner.c.name, table.c.name)
        )
        with self._database.read() as connection:
            due = connection.execute(query).all()
        out = []
        for environment, name in due:
            with self._database.write() as connection:
                row = environment_row(connection, environment, lock=True)
                known = _row(connection, row, name)
                if known is None or known.planned_version is None or known.planned_at > now:
                    continue
                _move(connection, row, name, known.planned_version, known.planned_author or "", now)
                out.append((environment, _read(connection, row, name)))
        return out


def _check_name(channel: str) -> None:
    if channel == LATEST:
        raise Invalid("the channel latest moves by itself: it is always the newest version")
    if not CHANNEL_NAME.fullmatch(channel):
        raise Invalid(
            f"a channel cannot be called {channel[:80]!r}: use at most 63 of a-z, 0-9, _ and -, starting with a letter"
        )


def _row(connection: Connection, environment: Row[Any], channel: str) -> Row[Any] | None:
    table = tables.channel
    return connection.execute(
        select(table).where(table.c.environment_id == environment.id, table.c.name == channel)
    ).one_or_none()


def _read(connection: Connection, environment: Row[Any], channel: str) -> Channel:
    row = _row(connection, environment, channel)
    if row is None:
        raise NotFound(f"{environment.name} has no channel {channel!r}")
    root = None if row.version is None else read_version(connection, environment, row.version).root
    planned = None
    if row.planned_version is not None:
        planned = read_version(connection, environment, row.planned_version).root
    return _as_channel(row, root, planned)


def _as_channel(row: Row[Any], root: str | None, planned_root: str | None) -> Channel:
    planned = None
    if row.planned_version is not None:
        planned = Planned(row.planned_version, row.planned_at, row.planned_author or "", planned_root or "")
    return Channel(row.name, row.version, root, row.sequence, planned, row.author, row.time)


def _store(connection: Connection, environment: Row[Any], channel: str, known: object, **values: Any) -> None:
    table = tables.channel
    if known is None:
        connection.execute(insert(table).values(environment_id=environment.id, name=channel, **values))
    else:
        connection.execute(
            update(table).where(table.c.environment_id == environment.id, table.c.name == channel).values(**values)
        )


def _move(connection: Connection, environment: Row[Any], channel: str, number: int, author: str, now: datetime) -> None:
    target = read_version(connection, environment, number)
    known = _row(connection, environment, channel)
    nothing = {"planned_version": None, "planned_at": None, "planned_author": None}
    before = None
    if known is not None and known.version is not None:
        before = read_version(connection, environment, known.version)
        if before.number == number:
            _store(connection, environment, channel, known, **nothing)
            return
    sequence = environment.sequence + 1
    _store(
        connection,
        environment,
        channel,
        known,
        version=number,
        sequence=sequence,
        author=author,
        time=now,
        **nothing,
    )
    _bump(connection, environment, sequence)
    _tell(connection, environment, "channel.moved", channel, before, target, sequence=sequence, author=author, time=now)


def _plan(connection: Connection, environment: Row[Any], channel: str, number: int, author: str, at: datetime) -> None:
    target = read_version(connection, environment, number)
    known = _row(connection, environment, channel)
    now = utcnow()
    before = None
    if known is not None and known.version is not None:
        before = read_version(connection, environment, known.version)
    sequence = environment.sequence + 1
    plan: dict[str, Any] = {"planned_version": number, "planned_at": at, "planned_author": author}
    if known is None:
        plan |= {"version": None, "sequence": 0, "author": author, "time": now}
    _store(connection, environment, channel, known, **plan)
    _bump(connection, environment, sequence)
    about: dict[str, Any] = {"sequence": sequence, "author": author, "time": now, "activate_at": rfc3339(at)}
    _tell(connection, environment, "channel.planned", channel, before, target, **about)


def _tell(
    connection: Connection,
    environment: Row[Any],
    kind: Literal["channel.planned", "channel.moved"],
    channel: str,
    before: Version | None,
    target: Version,
    **about: Any,
) -> None:
    """The event of a channel that goes, or is planned to go, from one version to another."""
    outbox.append(
        connection,
        environment_id=environment.id,
        environment=environment.name,
        kind=kind,
        version=target.number,
        root=target.root,
        previous=None if before is None else (before.number, before.root),
        layers=outbox.layer_changes(before.parts if before else (), target.parts),
        message=target.message,
        channel=channel,
        rollback=before is not None and target.number < before.number,
        **about,
    )


def _bump(connection: Connection, environment: Row[Any], sequence: int) -> None:
    table = tables.environment
    connection.execute(update(table).where(table.c.id == environment.id).values(sequence=sequence))
