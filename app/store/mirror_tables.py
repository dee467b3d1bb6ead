"""Tables of a mirror: what it follows, what it may sign, and what its centre does not have yet."""

from __future__ import annotations

from sqlalchemy import JSON, BigInteger, Column, Integer, LargeBinary, String, Table, Text

from app.store.column_types import UtcDateTime
from app.store.table_base import environment_key, metadata

mirror = Table(
    "mirror",
    metadata,
    Column("id", Integer, primary_key=True, autoincrement=False),
    Column("url", Text, nullable=False),
    Column("key", LargeBinary, nullable=False),
    Column("epoch", BigInteger, nullable=False),
    Column("position", BigInteger, nullable=False),
    Column("reported", BigInteger, nullable=False),
    Column("seen", UtcDateTime, nullable=True),
    Column("centre_keys", JSON, nullable=False),
    Column("contact", UtcDateTime, nullable=True),
    Column("problem", Text, nullable=True),
    Column("failures", JSON, nullable=False),
    Column("skipped", JSON(none_as_null=True), nullable=True),
    Column("centre_position", BigInteger, nullable=False, server_default="0"),
    Column("received", BigInteger, nullable=False, server_default="0"),
    Column("sent", BigInteger, nullable=False, server_default="0"),
)
"""One row on a server that mirrors another, its centre. key: the centre's public key that is trusted. position: of the
centre's log, up to which everything is mirrored. reported: newest row of ``robot_history`` that the centre has; seen:
newest time of a robot's status that it has. contact: of the last success. failures: problems by environment. skipped:
number of statuses that the centre refused, and why, by environment. centre_position: the end of its log at the last
contact. received, sent: bytes of bodies.
"""

delegation = Table(
    "delegation",
    metadata,
    environment_key(primary_key=True),
    Column("statement", LargeBinary, nullable=False),
    Column("signed_by", String(16), nullable=False),
    Column("signature", LargeBinary, nullable=False),
    Column("key", LargeBinary, nullable=False),
    Column("expires", UtcDateTime, nullable=False),
)
"""Statements of the centre that this server's key may sign manifests of an environment, until ``expires``."""

edge_change = Table(
    "edge_change",
    metadata,
    Column("id", BigInteger().with_variant(Integer, "sqlite"), primary_key=True),
    environment_key(nullable=False, index=True),
    Column("overlay_id", String(32), nullable=False),
    Column("body", JSON, nullable=False),
)
"""Changes of overlays that a mirror made and its centre does not have yet, in their order."""
