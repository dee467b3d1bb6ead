"""Overlays: what robots report as blocked for a time, until an editor decides on it. Each step is an event.

An accepted overlay is told of (``overlay.accepted``) when the version that it went into is known, after that version's
own event. Who follows overlays goes by events, not by ``expires``: reported again, the end moves without an event.
"""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from contextlib import suppress
from datetime import datetime, timedelta
from typing import Any, Final

from sqlalchemy import Connection, Row, func, insert, or_, select, update

from app.errors import Conflict, NotFound
from app.event_types import EventType
from app.store import outbox, tables
from app.store.base import Base, environment_row, text, utcnow
from app.store.values import Overlay, OverlayState

MAX_PENDING: Final = 1000
"""So many overlays of an environment may wait for a decision."""

MAX_OF_ONE: Final = 100
"""So many of them may one reporter have: one that goes wild leaves room for the others."""

MAX_LISTED: Final = 10_000
TOLD: Final[Mapping[OverlayState, EventType]] = {"rejected": "overlay.rejected", "ended": "overlay.ended"}
"""What deciding tells. An acceptance is told once its version is known."""

LOST_AFTER: Final = timedelta(seconds=60)
"""An acceptance that has named no version after so long was cut off: it may stand in one all the same."""

AT_ONCE: Final = 100
"""Overlays that are ended in one go."""


class Overlays(Base):
    """Pending and decided overlays."""

    def add_overlay(self, wanted: Overlay) -> tuple[Overlay, bool]:
        """Keep a pending overlay: (it, whether it is new). id and state are set here.

        The same reported again by the same reporter while it is pending only moves its end. NotFound for an unknown
        environment, Conflict where too many wait.
        """
        table = tables.overlay
        with self._database.write() as connection:
            row = environment_row(connection, wanted.environment, lock=True)
            pending = (table.c.environment_id == row.id, table.c.state == "pending")
            own = select(table).where(*pending, table.c.reporter == wanted.reporter, table.c.expires > wanted.created)
            theirs = connection.execute(own).all()
            for known in theirs:
                same = (known.kind, known.level, known.polygon, known.edge, known.crs)
                if same == (wanted.kind, wanted.level, wanted.polygon, wanted.edge, wanted.crs):
                    values = {"expires": wanted.expires, "detail": wanted.detail}
                    connection.execute(update(table).where(table.c.id == known.id).values(values))
                    return _read(connection, row, known.id), False
            if len(theirs) >= MAX_OF_ONE:
                raise Conflict(f"{MAX_OF_ONE} overlays of {wanted.reporter} wait for a decision: no more are taken")
            waiting = select(func.count()).select_from(table).where(*pending)
            if connection.execute(waiting).scalar_one() >= MAX_PENDING:
                raise Conflict(f"{MAX_PENDING} overlays of {wanted.environment} wait: accept or reject some")
            new = secrets.token_hex(8)
            connection.execute(
                insert(table).values(
                    id=new,
                    environment_id=row.id,
                    kind=wanted.kind,
                    state="pending",
                    level=wanted.level,
                    polygon=wanted.polygon,
                    edge=wanted.edge,
                    crs=wanted.crs,
                    detail=None if wanted.detail is None else text(wanted.detail, "a detail"),
                    reporter=text(wanted.reporter, "a reporter"),
                    created=wanted.created,
                    expires=wanted.expires,
                )
            )
            made = _read(connection, row, new)
            _tell(connection, row, made, "overlay.created", made.reporter, made.created)
            return made, True

    def overlays(self, environment: str, state: OverlayState | None = None) -> list[Overlay]:
        """An environment's overlays, oldest first, of very many the newest; NotFound."""
        table = tables.overlay
        newest = (table.c.created.desc(), table.c.id.desc())
        with self._database.read() as connection:
            row = environment_row(connection, environment)
            query = select(table).where(table.c.environment_id == row.id).order_by(*newest)
            if state is not None:
                query = query.where(table.c.state == state)
            rows = connection.execute(query.limit(MAX_LISTED)).all()
        return [_as_overlay(environment, r) for r in reversed(rows)]

    def overlay(self, environment: str, id: str) -> Overlay:
        """One overlay; NotFound."""
        with self._database.read() as connection:
            return _read(connection, environment_row(connection, environment), id)

    def decide_overlay(
        self, environment: str, id: str, before: OverlayState, state: OverlayState, author: str, now: datetime
    ) -> Overlay:
        """Change its state; Conflict where it is not (or no longer) in the state ``before``."""
        table = tables.overlay
        with self._database.write() as connection:
            row = environment_row(connection, environment, lock=True)
            known = _read(connection, row, id)
            if known.state != before:
                raise Conflict(f"the overlay {id} is {known.state}, not {before}")
            values: dict[str, Any] = {"state": state, "decided_by": text(author, "an author"), "decided": now}
            if state == "pending":
                values |= {"decided_by": None, "decided": None}
            connection.execute(update(table).where(table.c.id == id).values(values))
            decided = _read(connection, row, id)
            if (kind := TOLD.get(state)) is not None:
                _tell(connection, row, decided, kind, author, now)
            return decided

    def note_overlay_version(self, environment: str, id: str, version: int) -> Overlay:
        """The version that an accepted overlay went into: now it is told of.

        It counts as accepted whatever was decided meanwhile: it is in the map, and has to be taken out again.
        """
        table = tables.overlay
        with self._database.write() as connection:
            row = environment_row(connection, environment, lock=True)
            before = _read(connection, row, id)
            values: dict[str, Any] = {"version": version}
            if before.state != "ended":
                values["state"] = "accepted"
            connection.execute(update(table).where(table.c.id == id).values(values))
            noted = _read(connection, row, id)
            if before.version is None and noted.state == "accepted":
                _tell(connection, row, noted, "overlay.accepted", noted.decided_by or "", utcnow())
            return noted

    def expire_overlays(self, now: datetime) -> list[Overlay]:
        """Pending overlays whose time is over expire. Accepted ones whose time is over: to be taken out by the caller,
        who then ends them with ``decide_overlay``.
        """
        table, owner = tables.overlay, tables.environment
        joined = select(table, owner.c.name.label("environment")).join(owner, owner.c.id == table.c.environment_id)
        over = joined.where(table.c.expires <= now, owner.c.deleted.is_(None)).order_by(table.c.expires, table.c.id)
        over = over.limit(AT_ONCE)
        with self._database.read() as connection:
            pending = connection.execute(over.where(table.c.state == "pending")).all()
            whole = or_(table.c.version.is_not(None), table.c.decided < now - LOST_AFTER)
            accepted = connection.execute(over.where(table.c.state == "accepted", whole)).all()
        for found in pending:
            with suppress(NotFound), self._database.write() as connection:
                row = environment_row(connection, found.environment, lock=True)
                known = _read(connection, row, found.id)
                if known.state == "pending" and known.expires <= now:  # else somebody was quicker
                    connection.execute(update(table).where(table.c.id == found.id).values(state="expired", decided=now))
                    _tell(connection, row, _read(connection, row, found.id), "overlay.expired", "", now)
        return [_as_overlay(r.environment, r) for r in accepted]


def _tell(
    connection: Connection, environment: Row[Any], overlay: Overlay, kind: EventType, author: str, now: datetime
) -> None:
    """The event of one step. version and root are the head's; the environment's row is locked and as it is stored."""
    sequence = environment.sequence + 1
    owner = tables.environment
    connection.execute(update(owner).where(owner.c.id == environment.id).values(sequence=sequence))
    what = f"edge {overlay.edge}" if overlay.edge is not None else "a polygon"
    outbox.append(
        connection,
        environment_id=environment.id,
        environment=environment.name,
        sequence=sequence,
        kind=kind,
        version=environment.head,
        root=environment.root,
        previous=None,
        layers=[],
        message=f"{what}, reported as {overlay.kind}" + (f": {overlay.detail}" if overlay.detail else ""),
        author=author,
        time=now,
        overlay=overlay.as_dict(),
    )


def _read(connection: Connection, environment: Row[Any], id: str) -> Overlay:
    table = tables.overlay
    query = select(table).where(table.c.id == id, table.c.environment_id == environment.id)
    row = connection.execute(query).one_or_none()
    if row is None:
        raise NotFound(f"{environment.name} has no overlay {id[:80]!r}")
    return _as_overlay(environment.name, row)


def _as_overlay(environment: str, row: Row[Any]) -> Overlay:
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
