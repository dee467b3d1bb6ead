"""Retention: thin versions by a rule, and remove uploaded files. What somebody uses stays, whatever the rule.

A thinned version keeps its entry in the history; its content and its files go with the garbage collection that follows,
unless something else contains them. Each transaction locks its environment and the reports of robots, and reads again
what must stay: a version that is promoted, tagged or reported at the same moment is either kept, or it was thinned
before, and the promotion fails.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, Final

from sqlalchemy import ColumnElement, Connection, Row, select, update

from app.store import tables
from app.store.database import Database
from app.store.protection import Protection, lock_reports, read_protection
from app.store.retention_rule import Rule

BATCH: Final = 20
"""Versions of one transaction: reports of robots wait for it."""

SOURCE_BATCH: Final = 200


@dataclass(frozen=True, slots=True)
class EnvironmentPlan:
    """What a rule does in one environment.

    kept: number of versions that stay, by reason. thinned: numbers of versions, newest first. files: (version,
    position) of files of kept versions that go. sequence: of the environment's last event when it was planned.
    """

    id: str
    environment: str
    kept: dict[str, int]
    thinned: tuple[int, ...]
    files: tuple[tuple[int, int], ...]
    sequence: int

    def as_dict(self) -> dict[str, Any]:
        """Return the plan as JSON."""
        return {
            "environment": self.environment,
            "kept": self.kept,
            "thinned": list(self.thinned),
            "files": len(self.files),
        }


@dataclass(frozen=True, slots=True)
class Removed:
    """What was removed: numbers of versions, and files of kept versions."""

    versions: tuple[int, ...] = ()
    files: int = 0


class Retention:
    """Service that removes old versions and files by a rule."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def plan(self, rule: Rule, writable: Collection[str] = ()) -> Iterator[EnvironmentPlan]:
        """Plan a rule for each environment that is neither deleted nor a mirror; changes nothing.

        writable: formats that the server writes. Raises Invalid as ``Rule.check``.
        """
        rule.check()
        table = tables.environment
        is_own = (table.c.deleted.is_(None), table.c.centre.is_(None))
        with self._database.read() as connection:
            names = list(connection.execute(select(table.c.id).where(*is_own).order_by(table.c.name)).scalars())
        for environment_id in names:
            with self._database.snapshot() as connection:
                row = connection.execute(select(table).where(table.c.id == environment_id, *is_own)).one_or_none()
                plan = None if row is None else self._plan(connection, row, rule, writable)
            if plan is not None:
                yield plan

    def apply(self, plan: EnvironmentPlan, rule: Rule) -> Iterator[Removed]:
        """Carry out a plan in small transactions; yields what each has removed.

        What has come into use since the plan stays.
        """
        rule.check()
        for start in range(0, len(plan.thinned), BATCH):
            numbers = plan.thinned[start : start + BATCH]
            with self._database.write(upkeep=True) as connection:
                row = _lock_environment(connection, plan.id)
                if row is None:
                    return
                removed = thin(connection, row, numbers, rule.text, self._database.now(), plan.sequence)
            yield Removed(removed)
        for start in range(0, len(plan.files), SOURCE_BATCH):
            with self._database.write(upkeep=True) as connection:
                row = _lock_environment(connection, plan.id)
                if row is None:
                    return
                some = plan.files[start : start + SOURCE_BATCH]
                count = self._remove_files(connection, row, some, plan.sequence)
            yield Removed(files=count)

    def note_link(self, environment: str, number: int, expires: datetime) -> None:
        """Note that a signed link names a version until then, so that it stays. At most one write an hour a version.

        Does nothing if the environment or the version is gone: the link leads nowhere.
        """
        table, owner = tables.version, tables.environment
        environment_id = select(owner.c.id).where(owner.c.name == environment).scalar_subquery()
        row = (table.c.environment_id == environment_id, table.c.number == number)
        with self._database.read() as connection:
            noted = connection.execute(select(table.c.linked).where(*row)).scalar_one_or_none()
        if noted is not None and noted >= expires:
            return
        with self._database.write(notify=False, upkeep=True) as connection:
            until = expires + timedelta(hours=1)
            connection.execute(update(table).where(*row, table.c.thinned.is_(None)).values(linked=until))

    def _plan(self, connection: Connection, row: Row[Any], rule: Rule, writable: Collection[str]) -> EnvironmentPlan:
        table, now = tables.version, self._database.now()
        query = select(table.c.number, table.c.time, table.c.root).where(
            table.c.environment_id == row.id, table.c.thinned.is_(None)
        )
        versions = connection.execute(query.order_by(table.c.number.desc())).all()
        protection = read_protection(connection, row, now)
        by_age = rule.reasons([(v.number, v.time) for v in versions], now)
        kept: dict[str, int] = {}
        thinned: list[int] = []
        for version in versions:
            reason = protection.reason(version.number, version.root) or by_age.get(version.number)
            if reason is None:
                thinned.append(version.number)
            else:
                kept[reason] = kept.get(reason, 0) + 1
        files = _removable_files(connection, row, rule, writable, protection, now)
        left = {number for number, _ in files} - set(thinned)
        files = [one for one in files if one[0] in left]
        return EnvironmentPlan(row.id, row.name, kept, tuple(thinned), tuple(files), int(row.sequence))

    def _remove_files(self, connection: Connection, row: Row[Any], files: Sequence[tuple[int, int]], since: int) -> int:
        table, now = tables.source, self._database.now()
        protection = read_protection(connection, row, now, since)
        count = 0
        for number, position in files:
            if number not in protection.reasons:
                this = (table.c.environment_id == row.id, table.c.number == number, table.c.position == position)
                removed = update(table).where(*this, table.c.removed.is_(None)).values(removed=now)
                count += connection.execute(removed).rowcount
        if count:
            _note_removal(connection, row, now)
        return count


def thin(
    connection: Connection,
    environment: Row[Any],
    numbers: Sequence[int],
    rule: str,
    now: datetime,
    since: int = 0,
    recorded: datetime | None = None,
) -> tuple[int, ...]:
    """Remove the content of versions, except of those in use; returns the numbers of the removed ones.

    The caller has locked the reports of robots, then the environment's row. since: as of ``read_protection``. recorded:
    time for the history, by default ``now``.
    """
    table, source = tables.version, tables.source
    protection = read_protection(connection, environment, now, since)
    with_content = (table.c.environment_id == environment.id, table.c.number.in_(numbers), table.c.thinned.is_(None))
    rows = connection.execute(select(table.c.number, table.c.root).where(*with_content).with_for_update()).all()
    gone = [row.number for row in rows if protection.reason(row.number, row.root) is None]
    # a link may have been made since ``protection`` was read: the row is locked only now
    unlinked = table.c.linked.is_(None) | (table.c.linked <= now)
    chosen = (table.c.environment_id == environment.id, table.c.number.in_(gone), unlinked)
    changed = update(table).where(*chosen).values(thinned=recorded or now, thinned_rule=rule, manifest=b"")
    out = tuple(sorted(connection.execute(changed.returning(table.c.number)).scalars(), reverse=True))
    files = (source.c.environment_id == environment.id, source.c.number.in_(out), source.c.removed.is_(None))
    connection.execute(update(source).where(*files).values(removed=recorded or now))
    if out:
        _note_removal(connection, environment, now)
    return out


def _lock_environment(connection: Connection, environment_id: str) -> Row[Any] | None:
    """Lock reports, then an environment's row; None if it is deleted or follows another server by now."""
    table = tables.environment
    lock_reports(connection)
    is_own = (table.c.deleted.is_(None), table.c.centre.is_(None))
    return connection.execute(
        select(table).where(table.c.id == environment_id, *is_own).with_for_update()
    ).one_or_none()


def _note_removal(connection: Connection, environment: Row[Any], now: datetime) -> None:
    """Have mirrors notice it, and the next garbage collection look at everything."""
    table, collection = tables.environment, tables.collection
    if environment.centre is None:  # a mirror compares the time with its centre's
        connection.execute(update(table).where(table.c.id == environment.id).values(updated=now))
    values = {"purges": collection.c.purges + 1, "thinned": int(time.time())}  # the clock of garbage collection
    connection.execute(update(collection).values(values))


def _removable_files(
    connection: Connection,
    row: Row[Any],
    rule: Rule,
    writable: Collection[str],
    protection: Protection,
    now: datetime,
) -> list[tuple[int, int]]:
    """List files of old versions (version, position) whose format the server writes from the version's layers.

    A file that was not used, or whose format is unknown, is in no layer: it stays.
    """
    if rule.source_days is None or not writable:
        return []
    source, version = tables.source, tables.version
    same = (version.c.environment_id == source.c.environment_id) & (version.c.number == source.c.number)
    conditions: tuple[ColumnElement[bool], ...] = (
        source.c.environment_id == row.id,
        source.c.removed.is_(None),
        source.c.used,
        source.c.format.in_(sorted(writable)),
        version.c.time < now - timedelta(days=rule.source_days),
    )
    query = select(source.c.number, source.c.position).join(version, same).where(*conditions)
    listed = connection.execute(query.order_by(source.c.number.desc(), source.c.position))
    return [(r.number, r.position) for r in listed if r.number not in protection.reasons]
