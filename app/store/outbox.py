"""Outbox: events stored in the transaction of their change. It is also the log from which clients resume."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal

from sqlalchemy import Connection, Row, func, insert, select, update

from app.backends.fence import LIMIT_IDLE_TIME
from app.errors import NotFound
from app.event_types import EventType, check_members
from app.store import tables
from app.store.base import environment_row
from app.store.database import Database
from app.store.values import Event, PartEntry, rfc3339

RelayName = Literal["zenoh", "mqtt"]
_RELAYS: Mapping[RelayName, int] = {"zenoh": 1, "mqtt": 2}
"""Rows of the table ``relay``, by where the events go."""

LOG_SEARCH_WINDOW = 100_000
"""Number of newest log positions in which former names are searched, and in which environments compete for history."""

MAX_IDLE_SECONDS = 10
"""Maximum time for which a server that stands still, or has no network, blocks the commits of all others."""


@dataclass(frozen=True, slots=True)
class HistoryRange:
    """Events of one environment from a log position on, at most the last ``most``."""

    environment_id: str
    first: int
    most: int


def layer_changes(before: Sequence[PartEntry], after: Sequence[PartEntry]) -> list[dict[str, Any]]:
    """List the parts that differ as ``[{layer, level, name, change, hash}]``, by key."""
    old = {e.key: e.hash for e in before}
    new = {e.key: e.hash for e in after}
    out = []
    for key in sorted(old.keys() | new.keys()):
        if old.get(key) == new.get(key):
            continue
        change = "added" if key not in old else "deleted" if key not in new else "changed"
        out.append({"layer": key.layer, "level": key.level, "name": key.name, "change": change, "hash": new.get(key)})
    return out


def append_event(
    connection: Connection,
    *,
    environment_id: str,
    environment: str,
    sequence: int,
    kind: EventType,
    version: int,
    root: str,
    previous: tuple[int, str] | None,
    layers: Sequence[Mapping[str, Any]],
    message: str,
    author: str,
    time: datetime,
    edge: int | None = None,
    **more: Any,
) -> None:
    """Add one event. The caller has locked the environment's row and stores ``sequence`` in it.

    Call it last: it takes the lock that puts all environments' events in one order. more: members of this type only.
    edge: number of a change that a mirror made by itself; the environment's sequence then stays, since the next one is
    its centre's, and the event is published but is not part of the environment's log.
    """
    if edge is not None:
        more["edge_sequence"] = edge
    check_members(kind, more)
    body = {
        "sequence": sequence,
        "type": kind,
        "environment": environment,
        "version": version,
        "root": root,
        "previous": None if previous is None else {"version": previous[0], "root": previous[1]},
        **more,
        "layers": list(layers),
        "message": message,
        "author": author,
        "time": rfc3339(time),
    }
    row = {
        "position": _advance(connection, 1),
        "environment_id": environment_id if edge is None else _edge_stream(environment_id),
        "environment": environment,
        "sequence": sequence if edge is None else edge,
        "body": body,
        "time": time,
    }
    connection.execute(insert(tables.event), row)


def append_copies(connection: Connection, environment_id: str, events: Sequence[Event]) -> None:
    """Add events of another server with their own sequences, in order. Call it last, as ``append_event``."""
    if not events:
        return
    last = _advance(connection, len(events))
    rows = [
        {
            "position": last - len(events) + 1 + k,
            "environment_id": environment_id,
            "environment": event.environment,
            "sequence": event.sequence,
            "body": event.body,
            "time": event.time,
        }
        for k, event in enumerate(events)
    ]
    connection.execute(insert(tables.event), rows)


def _advance(connection: Connection, count: int) -> int:
    """Take the next positions of the log; return the last one.

    The commits of all servers wait for each other here, so PostgreSQL ends the transaction of one that stands still.
    """
    advanced = update(tables.log).where(tables.log.c.id == 1).values(position=tables.log.c.position + count)
    if connection.dialect.name != "postgresql":
        return int(connection.execute(advanced.returning(tables.log.c.position)).scalar_one())
    limit = func.set_config("idle_in_transaction_session_timeout", f"{MAX_IDLE_SECONDS}s", True)
    return int(connection.execute(advanced.returning(tables.log.c.position, limit)).one().position)


def lock_log(connection: Connection) -> int:
    """Lock the log until the transaction ends; return its last position. Later commits have higher ones."""
    return _advance(connection, 0)


def as_event(row: Row[Any]) -> Event:
    """Convert a row into a value."""
    return Event(row.sequence, row.environment, row.body, row.time, row.position, row.environment_id)


def _edge_stream(environment_id: str) -> str:
    """Return the id under which a mirror logs its own changes of an environment."""
    return hashlib.sha256(f"edge {environment_id}".encode()).hexdigest()[:32]


def _reach(connection: Connection) -> int:
    """Return the position before which the log is not searched without an index."""
    return (
        int(connection.execute(select(tables.log.c.position).where(tables.log.c.id == 1)).scalar_one())
        - LOG_SEARCH_WINDOW
    )


class Outbox:
    """Read access to the log."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def page(self, environment: str | None, since: int = 0, limit: int = 1000) -> list[Event]:
        """List events after ``since``, oldest first: a sequence with an environment, else a position of the whole log.

        For a former name (renamed or purged environment) lists the events published under it; raises NotFound if there
        are none.
        """
        table = tables.event
        with self._database.read() as connection:
            query = select(table)
            if environment is None:
                query = query.where(table.c.position > since).order_by(table.c.position)
            else:
                try:
                    condition = table.c.environment_id == environment_row(connection, environment, deleted=True).id
                except NotFound:
                    condition = (table.c.environment == environment) & (table.c.position > _reach(connection))
                    if connection.execute(query.where(condition, table.c.sequence > since).limit(1)).first() is None:
                        raise
                query = query.where(condition, table.c.sequence > since).order_by(table.c.sequence)
            rows = connection.execute(query.limit(limit)).all()
        return [as_event(r) for r in rows]

    def last_sequence(self, environment: str) -> int:
        """Return the sequence of an environment's newest event."""
        with self._database.read() as connection:
            return int(environment_row(connection, environment, deleted=True).sequence)

    def relay_position(self, relay: RelayName = "zenoh", *, from_now: bool = False) -> int:
        """Return the position up to which a relay has handed events over.

        from_now: one that has not handed over any begins with the next event instead of with the first one.
        """
        table = tables.relay
        with self._database.read() as connection:
            position = connection.execute(select(table.c.position).where(table.c.id == _RELAYS[relay])).scalar()
        if position is None and from_now:
            position = self.last_position()
            self.set_relayed(position, relay)
        return int(position or 0)

    def unsent(self, now: datetime) -> tuple[int, float]:
        """Return the number of events that were not handed to the bus yet, and the age of the oldest in seconds."""
        table = tables.event
        relayed = select(tables.relay.c.position).where(tables.relay.c.id == _RELAYS["zenoh"])
        with self._database.read() as connection:
            position = int(connection.execute(relayed).scalar() or 0)
            newest = int(connection.execute(select(tables.log.c.position).where(tables.log.c.id == 1)).scalar_one())
            after = select(table.c.time).where(table.c.position > position).order_by(table.c.position).limit(1)
            oldest = connection.execute(after).scalar()
        return max(0, newest - position), 0.0 if oldest is None else max(0.0, (now - oldest).total_seconds())

    def set_relayed(self, position: int, relay: RelayName = "zenoh") -> None:
        """Store the position up to which a relay has handed events over. It never decreases."""
        table, key = tables.relay, _RELAYS[relay]
        with self._database.write(notify=False, upkeep=True) as connection:
            if connection.dialect.name == "postgresql":  # the next relay waits for the row
                connection.exec_driver_sql(f"SELECT {LIMIT_IDLE_TIME}")
            stored_position = connection.execute(select(table.c.position).where(table.c.id == key)).scalar()
            if stored_position is None:
                connection.execute(insert(table).values(id=key, position=position))
            elif stored_position < position:
                connection.execute(update(table).where(table.c.id == key).values(position=position))

    def history(self, position: int, each: int, limit: int) -> list[HistoryRange]:
        """Choose the last ``each`` events up to a position of all environments, also purged ones, newest first.

        If these are more than ``limit``, each environment has fewer; if even one per environment is too many, those
        with the oldest events have none. Environments without an event in the newest LOG_SEARCH_WINDOW positions come
        last and share what is left; purged ones of that age have none.
        """
        table = tables.event
        rank = func.row_number().over(partition_by=table.c.environment_id, order_by=table.c.sequence.desc())
        recent = (
            select(table.c.environment_id, table.c.position, rank.label("rank"))
            .where(table.c.position <= position, table.c.position > position - LOG_SEARCH_WINDOW)
            .subquery()
        )
        chosen = (
            select(recent.c.environment_id, recent.c.position)
            .where(recent.c.rank <= each)
            .order_by(recent.c.rank, recent.c.position.desc())
            .limit(limit)
            .subquery()
        )
        number = func.count().label("number")
        query = select(chosen.c.environment_id, func.min(chosen.c.position).label("first"), number)
        query = query.group_by(chosen.c.environment_id).order_by(func.max(chosen.c.position).desc())
        owner = tables.environment
        with self._database.read() as connection:
            rows = connection.execute(query).all()
            names = connection.execute(select(owner.c.id).order_by(owner.c.updated.desc())).scalars().all()
        ranges = [HistoryRange(row.environment_id, row.first, each) for row in rows]
        left, recent_ids = limit - sum(row.number for row in rows), {row.environment_id for row in rows}
        quiet = [name for name in names if name not in recent_ids][: max(0, left)]
        return ranges + [HistoryRange(name, 0, min(each, left // len(quiet))) for name in quiet]

    def last(self, chosen: HistoryRange, each: int, position: int) -> list[Event]:
        """List an environment's chosen events and later ones up to a position, at most the last ``each``, in order."""
        table = tables.event
        query = (
            select(table)
            .where(
                table.c.environment_id == chosen.environment_id,
                table.c.position >= chosen.first,
                table.c.position <= position,
            )
            .order_by(table.c.sequence.desc())
            .limit(min(each, chosen.most))
        )
        with self._database.read() as connection:
            rows = connection.execute(query).all()
        return [as_event(r) for r in reversed(rows)]

    def last_position(self) -> int:
        """Return the position of the newest event."""
        with self._database.read() as connection:
            return int(connection.execute(select(tables.log.c.position).where(tables.log.c.id == 1)).scalar_one())
