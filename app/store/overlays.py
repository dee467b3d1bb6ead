"""Overlays: reported temporary obstructions. Accepted ones are closures, in force on every channel.

Each change of state is an event, written in its transaction. Events that change the closures in force also order the
manifests of channels.
"""

from __future__ import annotations

import json
import secrets
import threading
from collections import OrderedDict
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from datetime import datetime
from typing import Any, Final

from sqlalchemy import Connection, Row, bindparam, func, insert, select, update

from app.errors import Conflict, NotFound
from app.event_types import EventType
from app.model.closures import Closures
from app.store import outbox, tables
from app.store.base import checked_text, environment_row
from app.store.database import Database
from app.store.fleet_values import Overlay, OverlayState
from app.store.values import rfc3339

MAX_PENDING: Final = 1000
"""Maximum number of pending overlays of an environment."""

MAX_PENDING_PER_REPORTER: Final = 100
"""Maximum number of pending overlays from one reporter, so that a faulty one leaves room for the others."""

MAX_IN_FORCE: Final = 1000
"""Maximum number of closures of an environment: every manifest lists them."""

MAX_IN_FORCE_BYTES: Final = 2**21
"""Maximum total size of the closures' areas as JSON, in bytes."""

MAX_LISTED: Final = 10_000
EVENTS: Final[Mapping[OverlayState, EventType]] = {
    "accepted": "overlay.accepted",
    "rejected": "overlay.rejected",
    "ended": "overlay.ended",
}
"""The event of each decision."""

CHANGE_CLOSURES: Final = frozenset({"overlay.accepted", "overlay.ended"})
"""Types of events that change the closures in force."""

MAX_ENDED_PER_CALL: Final = 100
"""Maximum number of overlays that are ended in one call."""

_overlay, _owner = tables.overlay, tables.environment
_DUE: Final = (
    select(_overlay.c.id, _overlay.c.state, _owner.c.name.label("environment"))
    .join(_owner, _owner.c.id == _overlay.c.environment_id)
    .where(_overlay.c.expires <= bindparam("now"), _overlay.c.state.in_(("pending", "accepted")))
    .where(_owner.c.deleted.is_(None))
    .order_by(_overlay.c.expires, _overlay.c.id)
    .limit(MAX_ENDED_PER_CALL)
)


class Overlays:
    """Pending and decided overlays."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def add(self, overlay: Overlay) -> tuple[Overlay, bool]:
        """Store a pending or accepted overlay: (the stored one, whether it is new). The id is set here.

        The same report again by the same reporter, while it is pending, only moves its end. Raises NotFound for an
        unknown environment, Conflict if too many wait or are in force.
        """
        table = tables.overlay
        accepted = overlay.state == "accepted"
        with self._database.write() as connection:
            row = environment_row(connection, overlay.environment, lock=True, mirrored=True)
            if accepted:
                require_room(connection, row, overlay)
            elif (same := _pending_twin(connection, row, overlay)) is not None:
                values = {"expires": overlay.expires, "detail": overlay.detail}
                connection.execute(update(table).where(table.c.id == same).values(values))
                renewed = _read(connection, row, same)
                if row.centre is not None:
                    created = renewed.reporter, renewed.created
                    _queue_for_centre(connection, row, renewed, "overlay.created", *created)
                return renewed, False
            overlay_id = secrets.token_hex(8)
            insert_overlay(connection, row.id, replace(overlay, id=overlay_id))
            stored = _read(connection, row, overlay_id)
            event: EventType = "overlay.accepted" if accepted else "overlay.created"
            append_overlay_event(connection, row, stored, event, stored.reporter, stored.created)
            return stored, True

    def all(self, environment: str, state: OverlayState | None = None) -> list[Overlay]:
        """List an environment's overlays, oldest first (if there are very many, the newest). Raises NotFound."""
        table = tables.overlay
        newest = (table.c.created.desc(), table.c.id.desc())
        with self._database.read() as connection:
            row = environment_row(connection, environment)
            query = select(table).where(table.c.environment_id == row.id).order_by(*newest)
            if state is not None:
                query = query.where(table.c.state == state)
            rows = connection.execute(query.limit(MAX_LISTED)).all()
        return [as_overlay(environment, r) for r in reversed(rows)]

    def get(self, environment: str, id: str) -> Overlay:
        """Read one overlay. Raises NotFound."""
        with self._database.read() as connection:
            return _read(connection, environment_row(connection, environment), id)

    def closures(self, environment: str) -> Closures:
        """Read the closures in force. Raises NotFound for an unknown environment."""
        with self._database.read() as connection:
            return read_closures(connection, environment_row(connection, environment))

    def decide(
        self,
        environment: str,
        id: str,
        before: OverlayState,
        state: OverlayState,
        author: str,
        now: datetime,
    ) -> Overlay:
        """Change an overlay's state, with its event. Raises Conflict if its state is not ``before``."""
        table = tables.overlay
        with self._database.write() as connection:
            row = environment_row(connection, environment, lock=True, mirrored=True)
            stored = _read(connection, row, id)
            if stored.state != before:
                raise Conflict(f"overlay {id} is {stored.state}: only {before} overlays can be {state}")
            if state == "accepted":
                require_room(connection, row, stored)
            values: dict[str, Any] = {"state": state, "decided_by": checked_text(author, "an author"), "decided": now}
            connection.execute(update(table).where(table.c.id == id).values(values))
            decided = _read(connection, row, id)
            if (event := EVENTS.get(state)) is not None:
                append_overlay_event(connection, row, decided, event, author, now)
            return decided

    def move_end(self, environment: str, id: str, expires: datetime, author: str, now: datetime) -> Overlay:
        """Change the end of an accepted overlay, with an event: robots get it anew. Raises NotFound, Conflict."""
        table = tables.overlay
        with self._database.write() as connection:
            row = environment_row(connection, environment, lock=True, mirrored=True)
            stored = _read(connection, row, id)
            if stored.state != "accepted":
                raise Conflict(f"overlay {id} is {stored.state}: only the end of accepted overlays can be changed")
            if stored.expires == expires:
                return stored
            connection.execute(update(table).where(table.c.id == id).values(expires=expires))
            moved = _read(connection, row, id)
            append_overlay_event(connection, row, moved, "overlay.accepted", author, now)
            return moved

    def end_due(self, now: datetime) -> None:
        """End overlays that are due: pending ones expire, closures are lifted, each with its event."""
        table = tables.overlay
        with self._database.read() as connection:
            due = connection.execute(_DUE, {"now": now}).all()
        for due_row in due:
            with suppress(NotFound), self._database.write(upkeep=True) as connection:
                row = environment_row(connection, due_row.environment, lock=True, mirrored=True)
                stored = _read(connection, row, due_row.id)
                if stored.state != due_row.state or stored.expires > now:
                    continue  # another process was faster, or the expiry was updated
                state: OverlayState = "expired" if stored.state == "pending" else "ended"
                event: EventType = "overlay.expired" if stored.state == "pending" else "overlay.ended"
                connection.execute(update(table).where(table.c.id == due_row.id).values(state=state, decided=now))
                ended = _read(connection, row, due_row.id)
                # a mirror's centre ends it by itself
                append_overlay_event(connection, row, ended, event, stored.decided_by or "", now, to_centre=False)

    def note_kept(self, environment: str, id: str, version: int) -> Overlay:
        """Record the version that made an overlay permanent. It stays in force until its end."""
        table = tables.overlay
        with self._database.write() as connection:
            row = environment_row(connection, environment, lock=True)
            connection.execute(update(table).where(table.c.id == id).values(version=version))
            return _read(connection, row, id)


_closure_cache: OrderedDict[tuple[str, int, int], Closures] = OrderedDict()
_closure_cache_lock = threading.Lock()
MAX_CACHED_CLOSURES: Final = 256


def read_closures(connection: Connection, environment: Row[Any]) -> Closures:
    """Read the closures in force of an environment, in the caller's transaction.

    They are cached by the sequence of the event that last changed them, which is in the environment's row, and in a
    mirror by the number of its own changes.
    """
    key = (str(environment.id), int(environment.closures_sequence), int(environment.edge_sequence))
    with _closure_cache_lock:
        closures = _closure_cache.get(key)
    if closures is None:
        closures = read_closures_anew(connection, environment)
        with _closure_cache_lock:
            _closure_cache[key] = closures
            while len(_closure_cache) > MAX_CACHED_CLOSURES:
                _closure_cache.popitem(last=False)
    return closures


def read_closures_anew(connection: Connection, environment: Row[Any]) -> Closures:
    """Read the closures in force without the cache, in a transaction that changes them."""
    table = tables.overlay
    query = select(table).where(table.c.environment_id == environment.id, table.c.state == "accepted")
    rows = connection.execute(query.order_by(table.c.id))
    return Closures(tuple(as_overlay(environment.name, row).closure for row in rows))


def require_room(connection: Connection, environment: Row[Any], overlay: Overlay) -> None:
    """Raise Conflict if another closure would make manifests too large."""
    table = tables.overlay
    in_force = select(table.c.polygon).where(table.c.environment_id == environment.id, table.c.state == "accepted")
    polygons = [row.polygon for row in connection.execute(in_force)]
    size = sum(len(json.dumps(polygon)) for polygon in [*polygons, overlay.polygon])
    if len(polygons) >= MAX_IN_FORCE or size > MAX_IN_FORCE_BYTES:
        reason = f"{MAX_IN_FORCE} overlays" if len(polygons) >= MAX_IN_FORCE else f"{MAX_IN_FORCE_BYTES} bytes of areas"
        raise Conflict(
            f"{environment.name} has reached the limit of {reason} in force: end or keep some first, or "
            "simplify the polygon"
        )


def insert_overlay(connection: Connection, environment_id: str, overlay: Overlay) -> None:
    """Store a new overlay, under its id. Raises Invalid for a text that cannot be stored."""
    connection.execute(
        insert(tables.overlay).values(
            id=overlay.id,
            environment_id=environment_id,
            kind=overlay.kind,
            state=overlay.state,
            level=overlay.level,
            polygon=overlay.polygon,
            edge=overlay.edge,
            crs=overlay.crs,
            detail=None if overlay.detail is None else checked_text(overlay.detail, "a detail"),
            reporter=checked_text(overlay.reporter, "a reporter"),
            created=overlay.created,
            expires=overlay.expires,
            decided_by=overlay.decided_by,
            decided=overlay.decided,
        )
    )


def _pending_twin(connection: Connection, environment: Row[Any], overlay: Overlay) -> str | None:
    """Return the id of the same reporter's equal pending report, if any. Raises Conflict if too many are pending."""
    table = tables.overlay
    pending = (table.c.environment_id == environment.id, table.c.state == "pending")
    query = select(table).where(*pending, table.c.reporter == overlay.reporter, table.c.expires > overlay.created)
    rows = connection.execute(query).all()
    for row in rows:
        same = (row.kind, row.level, row.polygon, row.edge, row.crs)
        if same == (overlay.kind, overlay.level, overlay.polygon, overlay.edge, overlay.crs):
            return str(row.id)
    if len(rows) >= MAX_PENDING_PER_REPORTER:
        raise Conflict(
            f"{overlay.reporter} has reached the limit of {MAX_PENDING_PER_REPORTER} pending overlays: wait until an "
            "editor accepts or rejects some"
        )
    waiting = select(func.count()).select_from(table).where(*pending)
    if connection.execute(waiting).scalar_one() >= MAX_PENDING:
        raise Conflict(
            f"{environment.name} has reached the limit of {MAX_PENDING} pending overlays: accept or reject some"
        )
    return None


def append_overlay_event(
    connection: Connection,
    environment: Row[Any],
    overlay: Overlay,
    event: EventType,
    author: str,
    now: datetime,
    *,
    to_centre: bool = True,
) -> None:
    """Append the event of a change of state. The caller has locked the environment's row.

    version and root are the head's. to_centre: in a mirror, whether its centre has to be told of the change.
    """
    sequence, edge = environment.sequence + 1, None
    owner = tables.environment
    values: dict[str, Any] = {"sequence": sequence}
    more: dict[str, Any] = {"overlay": overlay.as_dict()}
    if event in CHANGE_CLOSURES:
        values["closures_sequence"] = sequence
        more["overlays_digest"] = read_closures_anew(connection, environment).digest
    if environment.centre is not None:
        sequence, edge = environment.sequence, environment.edge_sequence + 1
        values = {"edge_sequence": edge}
        if to_centre:
            _queue_for_centre(connection, environment, overlay, event, author, now)
    connection.execute(update(owner).where(owner.c.id == environment.id).values(values))
    obstruction = f"edge {overlay.edge}" if overlay.edge is not None else "a polygon"
    outbox.append_event(
        connection,
        environment_id=environment.id,
        environment=environment.name,
        sequence=sequence,
        kind=event,
        version=environment.head,
        root=environment.root,
        previous=None,
        layers=[],
        message=f"{obstruction}, reported as {overlay.kind}" + (f": {overlay.detail}" if overlay.detail else ""),
        author=author,
        time=now,
        edge=edge,
        **more,
    )


def _queue_for_centre(
    connection: Connection, environment: Row[Any], overlay: Overlay, event: EventType, author: str, now: datetime
) -> None:
    change = {"event": event, "overlay": overlay.as_dict(), "author": author, "time": rfc3339(now)}
    queued = {"environment_id": environment.id, "overlay_id": overlay.id, "body": change}
    connection.execute(insert(tables.edge_change).values(queued))


def _read(connection: Connection, environment: Row[Any], id: str) -> Overlay:
    table = tables.overlay
    query = select(table).where(table.c.id == id, table.c.environment_id == environment.id)
    row = connection.execute(query).one_or_none()
    if row is None:
        raise NotFound(f"{environment.name} has no overlay {id[:80]!r}")
    return as_overlay(environment.name, row)


def as_overlay(environment: str, row: Row[Any]) -> Overlay:
    """Convert a row into a value."""
    return Overlay(
        environment=environment,
        kind=row.kind,
        level=row.level,
        polygon=row.polygon,
        edge=row.edge,
        crs=row.crs,
        detail=row.detail,
        reporter=row.reporter,
        created=row.created,
        expires=row.expires,
        id=row.id,
        state=row.state,
        decided_by=row.decided_by,
        decided=row.decided,
        version=row.version,
    )
