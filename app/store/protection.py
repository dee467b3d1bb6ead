"""What keeps a version from being thinned, whatever the rule: channels, robots, tags, drafts and the like."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Final

from sqlalchemy import Connection, Row, Select, select

from app.store import tables

CHANNEL_EVENTS: Final = ("channel.planned", "channel.cancelled", "channel.moved")
MAX_EVENTS: Final = 1000
"""Maximum number of an environment's newest channel events that are read."""


@dataclass(slots=True)
class Protection:
    """Versions that must stay: by number, with the reason, and by root, since a robot may report another number."""

    reasons: dict[int, str] = field(default_factory=dict)
    held_roots: set[str] = field(default_factory=set)

    def add(self, reason: str, numbers: Iterable[int | None]) -> None:
        """Note versions; the first reason counts."""
        for number in numbers:
            if number is not None:
                self.reasons.setdefault(int(number), reason)

    def reason(self, number: int, root: str) -> str | None:
        """Return why a version must stay, or None."""
        return self.reasons.get(number) or ("robot" if root in self.held_roots else None)


def lock_reports(connection: Connection) -> None:
    """Wait for reports of robots that are being stored, and let none be stored until the transaction ends.

    Call it first in a transaction that then reads which versions robots hold: a report locks its environment only if
    the robot is new. SQLite has one writer at a time.
    """
    if connection.dialect.name == "postgresql":
        connection.exec_driver_sql("LOCK TABLE robot IN SHARE MODE")


def read_protection(connection: Connection, environment: Row[Any], now: datetime, since: int = 0) -> Protection:
    """Read which versions of an environment must stay.

    since: sequence from which on events of channels are read; all others are known to the caller.
    """
    out = Protection()
    out.add("head", (environment.head,))
    out.add("first", (0,))
    _add_channels(connection, environment, out)
    _add_robots(connection, environment, out)
    tag, link = tables.version_tag, tables.version
    out.add("tag", _numbers(connection, environment, select(tag.c.number), tag))
    out.add("link", _numbers(connection, environment, select(link.c.number).where(link.c.linked > now), link))
    out.add("draft", _numbers(connection, environment, select(tables.draft.c.base), tables.draft))
    out.add("dry run", _numbers(connection, environment, select(tables.dry_run.c.base), tables.dry_run))
    repeated = tables.idempotency
    out.add("repeated request", _numbers(connection, environment, select(repeated.c.version), repeated))
    _add_channel_events(connection, environment, since, out)
    return out


def _numbers(connection: Connection, environment: Row[Any], query: Select[Any], table: Any) -> list[int]:
    return list(connection.execute(query.where(table.c.environment_id == environment.id).distinct()).scalars())


def _add_channels(connection: Connection, environment: Row[Any], out: Protection) -> None:
    """Add the channels' versions, planned moves, and the target and origin of each one's last rollout."""
    table = tables.channel
    for row in connection.execute(select(table).where(table.c.environment_id == environment.id)):
        out.add("channel", (row.version,))
        out.add("planned move", (row.planned_version,))
        rollout = row.rollout or {}
        out.add("rollout", (rollout.get("version"), rollout.get("before")))


def _add_robots(connection: Connection, environment: Row[Any], out: Protection) -> None:
    table = tables.robot
    columns = (table.c.version, table.c.held_version, table.c.root, table.c.held_root)
    query = select(*columns).where(table.c.environment_id == environment.id).distinct()
    for version, held_version, root, held_root in connection.execute(query):
        out.add("robot", (version, held_version))
        out.held_roots.update(r for r in (root, held_root) if r is not None)


def _add_channel_events(connection: Connection, environment: Row[Any], since: int, out: Protection) -> None:
    """Add what each channel was moved from last, to be moved back, and its last plan, also a cancelled one."""
    table = tables.event
    query = (
        select(table.c.body)
        .where(table.c.environment_id == environment.id, table.c.sequence > since)
        .where(table.c.body["type"].as_string().in_(CHANNEL_EVENTS))
        .order_by(table.c.sequence.desc())
        .limit(MAX_EVENTS)
    )
    seen: set[tuple[str, str]] = set()
    for body in connection.execute(query).scalars():
        kind = (str(body.get("channel")), str(body["type"]))
        if kind in seen and not since:
            continue
        seen.add(kind)
        previous = body.get("previous") or {}
        out.add("rollback" if kind[1] == "channel.moved" else "planned move", (body["version"],))
        out.add("rollback", (previous.get("version"),))
