"""The audit log: who changed what, from where. A row belongs to the transaction of the change that it is about."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import Connection, Row, insert, select

from app.store import tables
from app.store.database import Database

MAX_PATH = 1000
"""Characters of an address that are kept."""


@dataclass(slots=True)
class Caller:
    """A request that changes something, and who sent it. target: what it makes, where the path does not name it.
    recorded: whether its row is committed."""

    token_id: str
    token: str
    role: str
    address: str
    request_id: str
    method: str
    path: str
    environment: str | None
    target: str | None = None
    recorded: bool = False


CALLER: ContextVar[Caller | None] = ContextVar("caller", default=None)
"""Set for the time of a request; work of the server itself has none."""


@dataclass(frozen=True, slots=True)
class AuditEntry:
    """One change: by which token, from which address, by which request."""

    id: int
    time: datetime
    token_id: str
    token: str
    role: str
    address: str
    request_id: str
    method: str
    path: str
    environment: str | None
    target: str | None


def set_audit_target(*, environment: str | None = None, target: str | None = None) -> None:
    """Say what the current request changes, where its path does not."""
    caller = CALLER.get()
    if caller is not None:
        caller.environment = environment or caller.environment
        caller.target = target or caller.target


def skip_audit() -> None:
    """Say that the current request is an earlier one that was sent again: it gets no entry of its own."""
    caller = CALLER.get()
    if caller is not None:
        caller.recorded = True


def record(connection: Connection, now: datetime) -> Caller | None:
    """Write the current request's row into its transaction, unless an earlier one has it; the caller, where it did."""
    caller = CALLER.get()
    if caller is None or caller.recorded:
        return None
    values = {
        "time": now,
        "token_id": caller.token_id,
        "token": caller.token,
        "role": caller.role,
        "address": caller.address,
        "request_id": caller.request_id,
        "method": caller.method,
        "path": caller.path[:MAX_PATH],
        "environment": caller.environment,
        "target": caller.target,
    }
    connection.execute(insert(tables.audit).values(**values))
    return caller


class Audit:
    """Reading the audit log."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def record_change(self) -> None:
        """Record the current request, which gives somebody access and changes nothing that is stored."""
        with self._database.write():
            pass

    @contextmanager
    def changing(self) -> Iterator[None]:
        """Record the current request's change of something that is not in the database (the server's key)."""
        with self._database.write():
            yield

    def page(
        self,
        *,
        environment: str | None = None,
        token_id: str | None = None,
        before: int | None = None,
        limit: int = 100,
    ) -> list[AuditEntry]:
        """The newest changes first. before: only entries with a smaller id."""
        table = tables.audit
        query = select(table).order_by(table.c.id.desc()).limit(limit)
        if environment is not None:
            query = query.where(table.c.environment == environment)
        if token_id is not None:
            query = query.where(table.c.token_id == token_id)
        if before is not None:
            query = query.where(table.c.id < before)
        with self._database.read() as connection:
            return [_as_entry(row) for row in connection.execute(query).all()]


def _as_entry(row: Row[Any]) -> AuditEntry:
    return AuditEntry(
        row.id,
        row.time,
        row.token_id,
        row.token,
        row.role,
        row.address,
        row.request_id,
        row.method,
        row.path,
        row.environment,
        row.target,
    )
