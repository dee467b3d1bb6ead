"""Webhooks: addresses that get events, and how far each one is, also for each environment that must wait."""

from __future__ import annotations

import base64
import binascii
import secrets
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from fnmatch import fnmatchcase
from typing import Any, Final

from sqlalchemy import Connection, Row, delete, func, insert, select, update

from app.errors import Conflict, Invalid, NotFound, Problem
from app.event_types import EVENT_TYPES
from app.model.names import did_you_mean
from app.store import tables
from app.store.audit import set_audit_target
from app.store.base import checked_text, upsert
from app.store.database import Database
from app.store.outbox import as_event, lock_log
from app.store.values import Event

MAX_WEBHOOKS: Final = 32
MAX_COUNTED: Final = 1000
"""Number of events beyond which waiting ones are not counted."""

SECRET_PREFIX: Final = "whsec_"  # noqa: S105  the form of all secrets
SECRET_BYTES: Final = 32
_SECRET_SIZES: Final = range(24, 65)
_MAX_ERROR: Final = 500


@dataclass(frozen=True, slots=True)
class Attempts:
    """Failed attempts since the last success. since: of the first one; next_try: not before; error: the last one."""

    failures: int = 0
    since: datetime | None = None
    next_try: datetime | None = None
    error: str | None = None

    def columns(self) -> dict[str, Any]:
        """Return the values of the columns."""
        error = None if self.error is None else self.error[:_MAX_ERROR]
        return {"failures": self.failures, "failing_since": self.since, "next_try": self.next_try, "error": error}


@dataclass(frozen=True, slots=True)
class Webhook:
    """A webhook.

    environments: name pattern (fnmatch), types: of events; None for all. position: of the log, up to which all events
    were delivered, except those of environments that lag. delivered: time of the last success.
    """

    id: str
    url: str
    secret: str = field(repr=False)
    environments: str | None
    types: tuple[str, ...] | None
    created: datetime
    position: int
    delivered: datetime | None
    attempts: Attempts

    def wants(self, environment: str, kind: str) -> bool:
        """Test if events of an environment and a type are delivered."""
        return (self.environments is None or fnmatchcase(environment, self.environments)) and (
            self.types is None or kind in self.types
        )


@dataclass(frozen=True, slots=True)
class Lag:
    """An environment whose next event the receiver refused. position: of its last delivered event, in the log."""

    environment_id: str
    environment: str
    position: int
    attempts: Attempts


def secret_key(secret: str) -> bytes:
    """Return the key of a secret in the form of Standard Webhooks: ``whsec_`` and base64 of 24 to 64 bytes."""
    try:
        key = base64.b64decode(secret.removeprefix(SECRET_PREFIX), validate=True)
    except (binascii.Error, ValueError):
        key = b""
    if not secret.startswith(SECRET_PREFIX) or len(key) not in _SECRET_SIZES:
        rule = "must be whsec_ and the base64 of 24 to 64 random bytes"
        hint = 'omit it to get one, or use "whsec_$(openssl rand -base64 32)"'
        raise Invalid(f"secret {rule}: {hint}", [Problem(rule, where="secret")])
    return key


class Webhooks:
    """Service for webhooks."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def create(
        self, url: str, secret: str | None = None, environments: str | None = None, types: Sequence[str] | None = None
    ) -> Webhook:
        """Create a webhook that gets the events from now on. secret: by default a random one."""
        if secret is None:
            secret = SECRET_PREFIX + base64.b64encode(secrets.token_bytes(SECRET_BYTES)).decode()
        secret_key(secret)
        for k, kind in enumerate(types or ()):
            if kind not in EVENT_TYPES:
                problem = f"unknown event type {kind!r:.80}{did_you_mean(kind, EVENT_TYPES)}"
                raise Invalid(problem, [Problem(problem, where=f"types[{k}]")])
        key, table = secrets.token_hex(8), tables.webhook
        set_audit_target(target=f"webhook {key}")
        with self._database.write() as connection:
            # The log's row is locked: an event that is committed later is delivered, one before is not.
            position = lock_log(connection)
            if connection.execute(select(func.count()).select_from(table)).scalar_one() >= MAX_WEBHOOKS:
                raise Conflict(f"there are {MAX_WEBHOOKS} webhooks, the maximum: delete one first")
            values = {
                "id": key,
                "url": checked_text(url, "a webhook's url", 2000),
                "secret": secret,
                "environments": None if environments is None else checked_text(environments, "a name pattern", 256),
                "types": None if types is None else sorted(set(types)),
                "created": self._database.now(),
                "position": position,
            }
            connection.execute(insert(table).values(values))
        return self.get(key)

    def all(self) -> list[Webhook]:
        """List all webhooks, oldest first."""
        table = tables.webhook
        with self._database.read() as connection:
            rows = connection.execute(select(table).order_by(table.c.created, table.c.id)).all()
        return [_as_webhook(row) for row in rows]

    def get(self, id: str) -> Webhook:
        """Return a webhook. Raises NotFound."""
        with self._database.read() as connection:
            row = connection.execute(select(tables.webhook).where(tables.webhook.c.id == id)).one_or_none()
        if row is None:
            raise NotFound(f"unknown webhook {id[:80]!r}")
        return _as_webhook(row)

    def delete(self, id: str) -> None:
        """Delete a webhook; its waiting events are not delivered any more. Raises NotFound."""
        with self._database.write() as connection:
            if not connection.execute(delete(tables.webhook).where(tables.webhook.c.id == id)).rowcount:
                raise NotFound(f"unknown webhook {id[:80]!r}")

    def lags(self, id: str) -> list[Lag]:
        """List the environments that wait because the receiver refused their next event."""
        table = tables.webhook_lag
        query = select(table).where(table.c.webhook_id == id).order_by(table.c.environment, table.c.environment_id)
        with self._database.read() as connection:
            rows = connection.execute(query).all()
        return [Lag(r.environment_id, r.environment, r.position, _attempts(r)) for r in rows]

    def lagging_events(self, lag: Lag, upto: int, limit: int) -> list[Event]:
        """List the next events of an environment that waits, up to a position of the log."""
        table = tables.event
        query = (
            select(table)
            .where(
                table.c.environment_id == lag.environment_id,
                table.c.position > lag.position,
                table.c.position <= upto,
            )
            .order_by(table.c.sequence)
            .limit(limit)
        )
        with self._database.read() as connection:
            return [as_event(row) for row in connection.execute(query)]

    def count_waiting(self, webhook: Webhook) -> int:
        """Count the events that a webhook has still to get, at most MAX_COUNTED."""
        table = tables.event
        columns = (table.c.environment, table.c.body["type"].as_string().label("kind"))
        behind = select(*columns).where(table.c.position > webhook.position).order_by(table.c.position)
        count = 0
        with self._database.read() as connection:
            rows = connection.execute(behind.limit(MAX_COUNTED)).all()
            count += sum(webhook.wants(row.environment, row.kind) for row in rows)
            for lag in connection.execute(select(tables.webhook_lag).filter_by(webhook_id=webhook.id)).all():
                of_lag = (table.c.environment_id == lag.environment_id) & (table.c.position > lag.position)
                query = select(*columns).where(of_lag, table.c.position <= webhook.position)
                rows = connection.execute(query.limit(MAX_COUNTED)).all()
                count += sum(webhook.wants(row.environment, row.kind) for row in rows)
                if count >= MAX_COUNTED:
                    return MAX_COUNTED
        return count

    def note_delivered(self, id: str, position: int, delivered: datetime | None) -> None:
        """Store the position up to which events were delivered. It never decreases. Raises NotFound.

        delivered: time of a success, which ends a failure; None if events were only skipped.
        """
        table = tables.webhook
        values: dict[str, Any] = {} if delivered is None else {"delivered": delivered, **Attempts().columns()}
        with self._writing(id) as (connection, stored):
            values["position"] = max(position, stored.position)
            connection.execute(update(table).where(table.c.id == id).values(values))

    def note_failure(self, id: str, position: int, attempts: Attempts) -> None:
        """Store that a receiver was not reached. Raises NotFound."""
        table = tables.webhook
        with self._writing(id) as (connection, stored):
            values = {"position": max(position, stored.position), **attempts.columns()}
            connection.execute(update(table).where(table.c.id == id).values(values))

    def put_lag(self, id: str, position: int, lag: Lag) -> None:
        """Store that an environment has to wait, or how far it is. Raises NotFound."""
        with self._writing(id) as (connection, stored):
            self._set_position(connection, id, max(position, stored.position))
            keys = {"webhook_id": id, "environment_id": lag.environment_id}
            values = {"environment": lag.environment, "position": lag.position, **lag.attempts.columns()}
            upsert(connection, tables.webhook_lag, keys, values)

    def end_lag(self, id: str, position: int, lag: Lag) -> None:
        """Store that an environment waits no more: its events were delivered up to ``position``. Raises NotFound."""
        table = tables.webhook_lag
        with self._writing(id) as (connection, stored):
            self._set_position(connection, id, max(position, stored.position))
            is_lag = (table.c.webhook_id == id) & (table.c.environment_id == lag.environment_id)
            connection.execute(delete(table).where(is_lag))

    def retry_now(self, id: str) -> None:
        """Let all that waits for its next try be tried at once. Raises NotFound."""
        webhooks, lags = tables.webhook, tables.webhook_lag
        with self._database.write() as connection:
            if not connection.execute(update(webhooks).where(webhooks.c.id == id).values(next_try=None)).rowcount:
                raise NotFound(f"unknown webhook {id[:80]!r}")
            connection.execute(update(lags).where(lags.c.webhook_id == id).values(next_try=None))

    @contextmanager
    def _writing(self, id: str) -> Iterator[tuple[Connection, Row[Any]]]:
        """Begin a transaction that changes a webhook's progress, with its row locked. Raises NotFound."""
        table = tables.webhook
        with self._database.write(notify=False, upkeep=True) as connection:
            row = connection.execute(select(table).where(table.c.id == id).with_for_update()).one_or_none()
            if row is None:
                raise NotFound(f"unknown webhook {id[:80]!r}")
            yield connection, row

    def _set_position(self, connection: Connection, id: str, position: int) -> None:
        table = tables.webhook
        connection.execute(update(table).where(table.c.id == id).values(position=position))


def _attempts(row: Row[Any]) -> Attempts:
    return Attempts(row.failures, row.failing_since, row.next_try, row.error)


def _as_webhook(row: Row[Any]) -> Webhook:
    return Webhook(
        id=row.id,
        url=row.url,
        secret=row.secret,
        environments=row.environments,
        types=None if row.types is None else tuple(row.types),
        created=row.created,
        position=row.position,
        delivered=row.delivered,
        attempts=_attempts(row),
    )
