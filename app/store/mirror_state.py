"""State of a mirror: whom it follows, up to where, and the statements by which the centre delegates to its key."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, Final

from sqlalchemy import Row, func, select, update

from app.store import tables
from app.store.base import upsert
from app.store.database import Database
from app.store.values import rfc3339

CUT_OFF_AFTER: Final = timedelta(seconds=60)
"""Time without contact after which a mirror counts as cut off: four times the interval of its passes."""


@dataclass(frozen=True, slots=True)
class MirrorState:
    """The row of a mirror.

    key: raw public key of the centre. epoch, position: of the centre, up to which all is mirrored. reported, seen: the
    newest report of a robot that the centre has: its row, and its time. centre_keys: public keys of the centre as JSON.
    contact: of the last success. problem: why the last attempt failed. failures: reasons by environment. skipped: by
    environment ``{"statuses": number, "problem": why}``, of statuses that the centre refused. centre_position: the end
    of its log at the last contact. received, sent: bytes of bodies.
    """

    url: str
    key: bytes
    epoch: int = 0
    position: int = 0
    reported: int = 0
    seen: datetime | None = None
    centre_keys: Sequence[Mapping[str, Any]] = ()
    contact: datetime | None = None
    problem: str | None = None
    failures: Mapping[str, str] | None = None
    skipped: Mapping[str, Mapping[str, Any]] | None = None
    centre_position: int = 0
    received: int = 0
    sent: int = 0


@dataclass(frozen=True, slots=True)
class StoredDelegation:
    """A statement of the centre that ``key`` may sign an environment's manifests. signed_by: id of the centre's key."""

    environment_id: str
    statement: bytes
    signed_by: str
    signature: bytes
    key: bytes
    expires: datetime


class Mirrors:
    """Service for the state of this server as a mirror."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def state(self) -> MirrorState | None:
        """Read the state; None if this server mirrors no other."""
        with self._database.read() as connection:
            row = connection.execute(select(tables.mirror)).one_or_none()
        if row is None:
            return None
        members = {name: getattr(row, name) for name in MirrorState.__slots__}
        return MirrorState(**{**members, "key": bytes(row.key)})

    def start(self, url: str, key: bytes) -> None:
        """Store whom this server follows, at the first contact."""
        values = {name: getattr(MirrorState(url, key), name) for name in MirrorState.__slots__}
        values |= {"centre_keys": [], "failures": {}}
        with self._database.write(notify=False, upkeep=True) as connection:
            upsert(connection, tables.mirror, {"id": 1}, values)

    def save(self, *, received: int = 0, sent: int = 0, **values: Any) -> None:
        """Store members of the state. received, sent: bytes since the last call."""
        table = tables.mirror
        traffic = {"received": table.c.received + received, "sent": table.c.sent + sent}
        with self._database.write(notify=False, upkeep=True) as connection:
            connection.execute(update(table).where(table.c.id == 1).values({**values, **traffic}))

    def figures(self) -> dict[str, Any] | None:
        """Return what metrics show; None if this server mirrors no other. Times in seconds."""
        state, now = self.state(), self._database.now()
        if state is None:
            return None
        table, owner, queue = tables.delegation, tables.environment, tables.edge_change
        ends = (
            select(func.min(table.c.expires))
            .join(owner, owner.c.id == table.c.environment_id)
            .where(owner.c.centre.is_not(None), owner.c.deleted.is_(None))
        )
        with self._database.read() as connection:
            waiting = connection.execute(select(func.count()).select_from(queue)).scalar_one()
            until = connection.execute(ends).scalar()
        return {
            "contact_age": math.inf if state.contact is None else max(0.0, (now - state.contact).total_seconds()),
            "behind": max(0, state.centre_position - state.position),
            "waiting": waiting,
            "permission": None if until is None else max(0.0, (until - now).total_seconds()),
            "received": state.received,
            "sent": state.sent,
            "skipped": {name: one["statuses"] for name, one in (state.skipped or {}).items()},
        }

    def delegations(self) -> list[StoredDelegation]:
        """List all statements."""
        with self._database.read() as connection:
            rows = connection.execute(select(tables.delegation)).all()
        return [_as_delegation(r) for r in rows]

    def delegation(self, environment: str) -> StoredDelegation | None:
        """Read the statement about an environment, by its name."""
        table, owner = tables.delegation, tables.environment
        query = select(table).join(owner, owner.c.id == table.c.environment_id).where(owner.c.name == environment)
        with self._database.read() as connection:
            r = connection.execute(query).one_or_none()
        return None if r is None else _as_delegation(r)

    def store_delegations(self, delegations: Sequence[StoredDelegation]) -> None:
        """Replace the statements about some environments; those that were purged meanwhile are skipped."""
        table, owner = tables.delegation, tables.environment
        with self._database.write(upkeep=True) as connection:
            for one in delegations:
                if connection.execute(select(owner.c.id).where(owner.c.id == one.environment_id)).first() is None:
                    continue
                values = {name: getattr(one, name) for name in StoredDelegation.__slots__ if name != "environment_id"}
                upsert(connection, table, {"environment_id": one.environment_id}, values)

    def describe(self) -> dict[str, Any] | None:
        """Describe the mirror for operators, as JSON; None if this server mirrors no other.

        ``state``: ``connected``, ``cut off``, or ``starting`` before the first complete pass. ``waiting``: number of
        changes that the centre does not have yet. ``serves_until``: the first end of a permission to sign manifests.
        ``skipped``: numbers of statuses that the centre refused, by environment, if it refuses any.
        """
        state, now = self.state(), self._database.now()
        if state is None:
            return None
        owner, table, queue = tables.environment, tables.delegation, tables.edge_change
        query = (
            select(owner, table.c.expires)
            .outerjoin(table, table.c.environment_id == owner.c.id)
            .where(owner.c.centre.is_not(None), owner.c.deleted.is_(None))
            .order_by(owner.c.name)
        )
        with self._database.read() as connection:
            rows = connection.execute(query).all()
            waiting = connection.execute(select(func.count()).select_from(queue)).scalar_one()
        skipped = {name: one["statuses"] for name, one in (state.skipped or {}).items()}
        failures = {name: f"statuses are skipped: {one['problem']}" for name, one in (state.skipped or {}).items()}
        failures |= dict(state.failures or {})
        environments = [
            {
                "name": r.name,
                "version": r.head,
                "sequence": r.sequence,
                "serves_until": None if r.expires is None else rfc3339(r.expires),
                "problem": failures.pop(r.name, None),
            }
            for r in rows
        ]
        environments += [{"name": name, "problem": problem} for name, problem in sorted(failures.items())]
        is_recent = state.contact is not None and now - state.contact < CUT_OFF_AFTER and state.problem is None
        ends = [r.expires for r in rows if r.expires is not None]
        return {
            "state": "connected" if is_recent else "starting" if state.contact is None else "cut off",
            "centre": state.url,
            "key": hashlib.sha256(state.key).hexdigest()[:16],
            "epoch": state.epoch,
            "position": state.position,
            "contact": None if state.contact is None else rfc3339(state.contact),
            "problem": state.problem,
            "waiting": waiting,
            "serves_until": rfc3339(min(ends)) if ends and len(ends) == len(rows) else None,
            "environments": environments,
            **({"skipped": skipped} if skipped else {}),
        }


def _as_delegation(row: Row[Any]) -> StoredDelegation:
    return StoredDelegation(
        row.environment_id, bytes(row.statement), row.signed_by, bytes(row.signature), bytes(row.key), row.expires
    )
