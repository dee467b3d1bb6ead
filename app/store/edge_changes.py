"""Changes of overlays and reports of robots that a mirror received, on their way to its centre, and there.

Each is handed on with its own time and in order. The centre applies a change once: a repetition finds it done. Where
centre and mirror have decided differently, the centre's decision counts.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Any, Final

from sqlalchemy import Connection, Row, delete, func, select, update

from app.errors import Conflict, Invalid
from app.event_types import EventType, RobotPlace
from app.store import tables
from app.store.base import checked_text, environment_row, upsert
from app.store.database import Database
from app.store.fleet_values import Overlay, OverlayState, ReceivedReport, RobotReport
from app.store.mirror_source import overlay_as_json
from app.store.mirror_target import overlay_values
from app.store.overlays import (
    MAX_PENDING,
    append_overlay_event,
    as_overlay,
    insert_overlay,
    read_closures_anew,
    require_room,
)

STATES: Final[Mapping[EventType, OverlayState]] = {
    "overlay.created": "pending",
    "overlay.accepted": "accepted",
    "overlay.rejected": "rejected",
    "overlay.ended": "ended",
}
"""The state after each event that a mirror hands on."""

BEFORE: Final[Mapping[OverlayState, OverlayState]] = {
    "accepted": "pending",
    "rejected": "pending",
    "ended": "accepted",
}


@dataclass(frozen=True, slots=True)
class OverlayChange:
    """A change of an overlay that a mirror made. overlay: after the change. time: of the change."""

    event: EventType
    overlay: Overlay
    author: str
    time: datetime


@dataclass(frozen=True, slots=True)
class QueuedChange:
    """A change that waits for the centre. body: as JSON."""

    id: int
    environment: str
    overlay_id: str
    body: Mapping[str, Any]


class EdgeChanges:
    """Service for both sides."""

    def __init__(self, database: Database) -> None:
        self._database = database

    # --- at the centre ---

    def apply(self, environment: str, change: OverlayChange) -> Mapping[str, Any]:
        """Apply a mirror's change, with its event; returns the overlay's row as JSON. A repetition changes nothing.

        Raises Conflict if the overlay is in another state here, or too many are; NotFound for an unknown environment.
        """
        if change.event not in STATES:
            raise Invalid(f"a mirror cannot hand on {change.event[:80]!r}")
        table, overlay = tables.overlay, change.overlay
        with self._database.write() as connection:
            row = environment_row(connection, environment, lock=True)
            stored = connection.execute(select(table).where(table.c.id == overlay.id)).one_or_none()
            if stored is None:
                _insert(connection, row, replace(overlay, state=STATES[change.event]))
            elif stored.environment_id != row.id:
                raise Conflict(f"the id {overlay.id} is that of an overlay of another environment")
            elif not _update(connection, row, stored, change):
                return overlay_as_json(stored)
            changed = connection.execute(select(table).where(table.c.id == overlay.id)).one()
            value, author = as_overlay(environment, changed), checked_text(change.author, "an author")
            append_overlay_event(connection, row, value, change.event, author, change.time)
            return overlay_as_json(changed)

    def read_overlay(self, environment: str, id: str) -> Mapping[str, Any] | None:
        """Read an overlay's row as JSON, None if there is none."""
        table = tables.overlay
        with self._database.read() as connection:
            row = environment_row(connection, environment)
            query = select(table).where(table.c.id == id, table.c.environment_id == row.id)
            stored = connection.execute(query).one_or_none()
        return None if stored is None else overlay_as_json(stored)

    # --- at the mirror ---

    def waiting(self, limit: int) -> list[QueuedChange]:
        """List the oldest changes of each environment that wait for the centre, by environment."""
        table, owner = tables.edge_change, tables.environment
        rank = func.row_number().over(partition_by=table.c.environment_id, order_by=table.c.id)
        ranked = select(table, rank.label("rank")).subquery()
        query = (
            select(ranked, owner.c.name)
            .join(owner, owner.c.id == ranked.c.environment_id)
            .where(owner.c.deleted.is_(None), ranked.c.rank <= limit)
            .order_by(owner.c.name, ranked.c.id)
        )
        with self._database.read() as connection:
            return [QueuedChange(r.id, r.name, r.overlay_id, r.body) for r in connection.execute(query)]

    def count_waiting(self) -> int:
        """Count the changes that wait for the centre, which takes none of a deleted environment."""
        table, owner = tables.edge_change, tables.environment
        query = select(func.count()).select_from(table).join(owner, owner.c.id == table.c.environment_id)
        with self._database.read() as connection:
            return int(connection.execute(query.where(owner.c.deleted.is_(None))).scalar_one())

    def settle(self, change: QueuedChange, refusal: str | None, overlay: Mapping[str, Any] | None) -> None:
        """Note the centre's answer to a change.

        Args:
            refusal: why it refused the change; None if it has it.
            overlay: the overlay as the centre has it, if it refused; None if it has none.
        """
        table, owner = tables.overlay, tables.environment
        with self._database.write(upkeep=True) as connection:
            connection.execute(delete(tables.edge_change).where(tables.edge_change.c.id == change.id))
            if refusal is None:
                return
            row = environment_row(connection, change.environment, lock=True, mirrored=True)
            digest = read_closures_anew(connection, row).digest
            if overlay is not None:
                upsert(
                    connection, table, {"id": change.overlay_id}, {"environment_id": row.id, **overlay_values(overlay)}
                )
            else:
                why = f"{row.centre}: {refusal}"[:500]
                values = {"state": "rejected", "decided_by": why, "decided": self._database.now()}
                connection.execute(update(table).where(table.c.id == change.overlay_id).values(values))
            if read_closures_anew(connection, row).digest != digest:
                connection.execute(
                    update(owner).where(owner.c.id == row.id).values(edge_sequence=owner.c.edge_sequence + 1)
                )

    def newest_report(self) -> int:
        """Return the number of the newest row of the history of robots' reports, 0 without any."""
        with self._database.read() as connection:
            return int(connection.execute(select(func.max(tables.robot_history.c.id))).scalar() or 0)

    def reports_after(self, id: int, limit: int, *, handed: int, since: datetime) -> list[tuple[int, ReceivedReport]]:
        """List reports of robots in mirrored environments after a row of the history, in order, each with its row.

        handed: up to this row, only those received after ``since``.
        """
        table, owner = tables.robot_history, tables.environment
        query = (
            select(table, owner.c.name.label("environment"), tables.robot.c.vouched)
            .join(owner, owner.c.id == table.c.environment_id)
            .join(
                tables.robot,
                (tables.robot.c.environment_id == table.c.environment_id) & (tables.robot.c.robot == table.c.robot),
            )
            .where(owner.c.centre.is_not(None), owner.c.deleted.is_(None))
            .where(table.c.id > id, (table.c.id > handed) | (table.c.time > since))
            .order_by(table.c.id)
            .limit(limit)
        )
        with self._database.read() as connection:
            return [(r.id, _as_received(r)) for r in connection.execute(query)]

    def current_reports(self, since: datetime | None, limit: int) -> list[ReceivedReport]:
        """List the current reports of robots in mirrored environments received after a time, with place and map."""
        table, owner = tables.robot, tables.environment
        query = (
            select(table, owner.c.name.label("environment"))
            .join(owner, owner.c.id == table.c.environment_id)
            .where(owner.c.centre.is_not(None), owner.c.deleted.is_(None))
            .order_by(table.c.time, owner.c.name, table.c.robot)
        )
        if since is not None:
            query = query.where(table.c.time > since)
        with self._database.read() as connection:
            return [_as_current(r) for r in connection.execute(query.limit(limit))]


def _insert(connection: Connection, row: Row[Any], overlay: Overlay) -> None:
    table = tables.overlay
    if overlay.state == "accepted":
        require_room(connection, row, overlay)
    waiting = (
        select(func.count()).select_from(table).where(table.c.environment_id == row.id, table.c.state == "pending")
    )
    if overlay.state == "pending" and connection.execute(waiting).scalar_one() >= MAX_PENDING:
        raise Conflict(f"{row.name} has {MAX_PENDING} pending overlays: accept or reject some")
    insert_overlay(connection, row.id, overlay)


def _update(connection: Connection, row: Row[Any], stored: Row[Any], change: OverlayChange) -> bool:
    """Change a stored overlay as the mirror did; False if it is so already. Raises Conflict."""
    table, state, overlay = tables.overlay, STATES[change.event], change.overlay
    if stored.state == state:
        if stored.expires == overlay.expires or state not in ("pending", "accepted"):
            return False
        connection.execute(update(table).where(table.c.id == overlay.id).values(expires=overlay.expires))
        return state == "accepted"  # as a report that is repeated here: without an event
    if state == "pending":
        return False  # a repetition: it was decided since
    if stored.state != BEFORE[state]:
        raise Conflict(f"overlay {overlay.id} is {stored.state}: only {BEFORE[state]} overlays can be {state}")
    if state == "accepted":
        require_room(connection, row, overlay)
    values: dict[str, Any] = {
        "state": state,
        "decided_by": checked_text(change.author, "an author"),
        "decided": change.time,
    }
    connection.execute(update(table).where(table.c.id == overlay.id).values(values))
    return True


def _as_received(row: Row[Any]) -> ReceivedReport:
    more = (row.detail, row.sequence, row.said, row.overlays)
    report = RobotReport(row.channel, row.version, row.root, row.state, *more)
    return ReceivedReport(row.environment, row.robot, report, row.time, row.vouched, late=True)


def _as_current(row: Row[Any]) -> ReceivedReport:
    received = _as_received(row)
    holds = None if row.held_root is None else (row.held_version, row.held_root)
    place = None if row.place is None else RobotPlace.from_dict(row.place)
    return replace(received, report=replace(received.report, holds=holds, place=place))
