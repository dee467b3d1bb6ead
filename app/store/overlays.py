"""Overlays: what robots report as blocked for a time, until an editor decides on it."""

from __future__ import annotations

import secrets
from datetime import datetime
from typing import Any, Final

from sqlalchemy import Connection, Row, func, insert, select, update

from app.errors import Conflict, NotFound
from app.store import tables
from app.store.base import Base, environment_row, text
from app.store.values import Overlay, OverlayState

MAX_PENDING: Final = 1000
"""So many overlays of an environment may wait for a decision."""

MAX_LISTED: Final = 10_000


class Overlays(Base):
    """Pending and decided overlays."""

    def add_overlay(self, wanted: Overlay) -> tuple[Overlay, bool]:
        """Keep a pending overlay: (it, whether it is new). id and state are set here.

        The same reported again by the same reporter while it is pending only moves its end. NotFound for an unknown
        environment, Conflict where too many wait.
        """
        table = tables.overlay
        with self._database.write(tell=False) as connection:
            row = environment_row(connection, wanted.environment, lock=True)
            pending = (table.c.environment_id == row.id, table.c.state == "pending")
            own = select(table).where(*pending, table.c.reporter == wanted.reporter, table.c.expires > wanted.created)
            for known in connection.execute(own):
                same = (known.kind, known.level, known.polygon, known.edge, known.crs)
                if same == (wanted.kind, wanted.level, wanted.polygon, wanted.edge, wanted.crs):
                    values = {"expires": wanted.expires, "detail": wanted.detail}
                    connection.execute(update(table).where(table.c.id == known.id).values(values))
                    return _read(connection, row, known.id), False
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
            return _read(connection, row, new), True

    def overlays(self, environment: str, state: OverlayState | None = None) -> list[Overlay]:
        """An environment's overlays, oldest first; NotFound."""
        table = tables.overlay
        with self._database.read() as connection:
            row = environment_row(connection, environment)
            query = select(table).where(table.c.environment_id == row.id).order_by(table.c.created, table.c.id)
            if state is not None:
                query = query.where(table.c.state == state)
            return [_as_overlay(environment, r) for r in connection.execute(query.limit(MAX_LISTED))]

    def overlay(self, environment: str, id: str) -> Overlay:
        """One overlay; NotFound."""
        with self._database.read() as connection:
            return _read(connection, environment_row(connection, environment), id)

    def decide_overlay(
        self, environment: str, id: str, before: OverlayState, state: OverlayState, author: str, now: datetime
    ) -> Overlay:
        """Change its state; Conflict where it is not (or no longer) in the state ``before``."""
        table = tables.overlay
        with self._database.write(tell=False) as connection:
            row = environment_row(connection, environment, lock=True)
            known = _read(connection, row, id)
            if known.state != before:
                raise Conflict(f"the overlay {id} is {known.state}, not {before}")
            values: dict[str, Any] = {"state": state, "decided_by": text(author, "an author"), "decided": now}
            if state == "pending":
                values |= {"decided_by": None, "decided": None}
            connection.execute(update(table).where(table.c.id == id).values(values))
            return _read(connection, row, id)

    def note_overlay_version(self, environment: str, id: str, version: int) -> Overlay:
        """The version that an accepted overlay went into."""
        table = tables.overlay
        with self._database.write(tell=False) as connection:
            row = environment_row(connection, environment)
            connection.execute(
                update(table).where(table.c.id == id, table.c.environment_id == row.id).values(version=version)
            )
            return _read(connection, row, id)

    def expire_overlays(self, now: datetime) -> list[Overlay]:
        """Pending overlays whose time is over expire. Accepted ones whose time is over: to be taken out by the caller,
        who then ends them with ``decide_overlay``.
        """
        table, owner = tables.overlay, tables.environment
        over = table.c.expires <= now
        with self._database.read() as connection:
            pending = connection.execute(
                select(table.c.id).where(table.c.state == "pending", over).limit(1)
            ).scalar_one_or_none()
            query = (
                select(table, owner.c.name.label("environment"))
                .join(owner, owner.c.id == table.c.environment_id)
                .where(table.c.state == "accepted", over, table.c.version.is_not(None), owner.c.deleted.is_(None))
                .order_by(table.c.expires, table.c.id)
                .limit(100)
            )
            accepted = [_as_overlay(r.environment, r) for r in connection.execute(query)]
        if pending is not None:
            with self._database.write(tell=False) as connection:
                connection.execute(
                    update(table).where(table.c.state == "pending", over).values(state="expired", decided=now)
                )
        return accepted


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
