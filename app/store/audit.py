"""Audit log: each change with its token, address and request. A row is written in the transaction of its change."""

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
"""Maximum length of a stored address, in characters."""


@dataclass(slots=True)
class Caller:
    """A request that changes something, with its sender.

    target: the object that it creates, if the path does not name it. recorded: whether its row is committed.
    """

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
"""Request that is being handled; None for work that the server starts itself."""


@dataclass(frozen=True, slots=True)
class AuditEntry:
    """One change, with its token, address and request."""

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
    """Set the object that the current request changes, if the path does not name it."""
    caller = CALLER.get()
    if caller is not None:
        caller.environment = environment or caller.environment
        caller.target = target or caller.target


def skip_audit() -> None:
    """Mark the current request as a repetition of an earlier one: it gets no entry of its own."""
    caller = CALLER.get()
    if caller is not None:
        caller.recorded = True


def record(connection: Connection, now: datetime) -> Caller | None:
    """Write the current request's row in the caller's transaction, unless it exists; returns the request, or None."""
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
    connection.execute(insert(tables.audit), values)
    return caller


class Audit:
    """Read access to the audit log."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def record_change(self) -> None:
        """Record the current request, which grants access and changes nothing that is stored."""
        with self._database.write():
            pass

    @contextmanager
    def changing(self) -> Iterator[None]:
        """Record the current request's change of something outside the database (the server's key)."""
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
        """List the newest changes first. before: only entries with a smaller id."""
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
