"""Tables of webhooks: where events are sent, and how far each one is."""

from __future__ import annotations

from typing import Any

from sqlalchemy import JSON, BigInteger, Column, ForeignKey, Integer, String, Table, Text

from app.store.column_types import UtcDateTime
from app.store.table_base import metadata


def _failing() -> list[Column[Any]]:
    """Columns of failed attempts since the last success."""
    return [
        Column("failures", Integer, nullable=False, server_default="0"),
        Column("failing_since", UtcDateTime, nullable=True),
        Column("next_try", UtcDateTime, nullable=True),
        Column("error", Text, nullable=True),
    ]


webhook = Table(
    "webhook",
    metadata,
    Column("id", String(32), primary_key=True),
    Column("url", Text, nullable=False),
    Column("secret", Text, nullable=False),
    Column("environments", String(256), nullable=True),
    Column("types", JSON(none_as_null=True), nullable=True),
    Column("created", UtcDateTime, nullable=False),
    Column("position", BigInteger, nullable=False),
    Column("delivered", UtcDateTime, nullable=True),
    *_failing(),
)
"""Webhooks. environments: name pattern, types: of events; null: all. position: of the log, up to which all events were
delivered, except those of environments in ``webhook_lag``. delivered: time of the last success.
"""

webhook_lag = Table(
    "webhook_lag",
    metadata,
    Column("webhook_id", String(32), ForeignKey("webhook.id", ondelete="CASCADE"), primary_key=True),
    Column("environment_id", String(32), primary_key=True),
    Column("environment", String(63), nullable=False),
    Column("position", BigInteger, nullable=False),
    *_failing(),
)
"""Environments whose next event the receiver refused, so that only they wait. position: of the log, up to which the
environment's events were delivered. The environment itself may be purged meanwhile.
"""
