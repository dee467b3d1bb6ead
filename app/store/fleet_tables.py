"""Tables of the fleet: what robots report, their presence on the bus, and counts of them."""

from __future__ import annotations

from typing import Any

from sqlalchemy import JSON, BigInteger, Boolean, Column, Index, Integer, String, Table, Text, literal_column, true

from app.store.column_types import UtcDateTime
from app.store.table_base import environment_key, metadata


def _report() -> list[Column[Any]]:
    """Columns of a robot's report. said: time by the robot's clock; time: of receipt, by the server's clock."""
    return [
        Column("channel", String(63), nullable=False),
        Column("version", BigInteger, nullable=False),
        Column("root", String(64), nullable=False),
        Column("state", String(16), nullable=False),
        Column("detail", Text, nullable=True),
        Column("sequence", BigInteger, nullable=True),
        Column("overlays", String(64), nullable=True),
        Column("said", UtcDateTime, nullable=True),
        Column("time", UtcDateTime, nullable=False),
    ]


robot = Table(
    "robot",
    metadata,
    environment_key(primary_key=True),
    Column("robot", String(128), primary_key=True, index=True),
    *_report(),
    Column("since", UtcDateTime, nullable=False),
    Column("held_version", BigInteger, nullable=True),
    Column("held_root", String(64), nullable=True),
    Column("held_sequence", BigInteger, nullable=True),
    Column("held_overlays", String(64), nullable=True),
    Column("held_since", UtcDateTime, nullable=True),
    Column("vouched", Boolean, nullable=False, server_default=true()),
    Column("place", JSON(none_as_null=True), nullable=True),
    Column("placed", UtcDateTime, nullable=True),
)
"""Current state of robots, for each environment. since: when they first reported it.

held: the active map, which a report
of a map that is still being fetched does not change. vouched: whether any report was authenticated. place: result of
``RobotPlace.as_dict``, from the report at ``placed``.
"""

robot_history = Table(
    "robot_history",
    metadata,
    Column("id", BigInteger().with_variant(Integer, "sqlite"), primary_key=True),
    environment_key(nullable=False),
    Column("robot", String(128), nullable=False),
    *_report(),
    Index("ix_robot_history_robot", "environment_id", "robot", "id"),
)
"""Changed reports of robots; the newest of each robot are retained."""

presence = Table(
    "presence",
    metadata,
    Column("robot", String(128), primary_key=True),
    Column("there", Boolean, nullable=False),
    Column("time", UtcDateTime, nullable=False),
)
"""Robots' liveliness on the bus. time: of the last change; see also ``server.presence_checked``."""

robot_tally = Table(
    "robot_tally",
    metadata,
    Column("id", BigInteger().with_variant(Integer, "sqlite"), primary_key=True),
    Column("environment_id", String(32), nullable=False),
    Column("channel", String(63), nullable=False),
    Column("state", String(16), nullable=False),
    Column("root", String(64), nullable=False),
    Column("held_root", String(64), nullable=True),
    Column("held_overlays", String(64), nullable=True),
    Column("vouched", Boolean, nullable=False),
    Column("number", Integer, nullable=False),
    Index("ix_robot_tally_environment", "environment_id", "id"),
)
"""Numbers of robots whose rows in ``robot`` have these values: the sum over rows with equal values.

Triggers add a row for each robot that comes, changes or goes, so that no writer has to wait for another or can forget
it; ``app.store.robot_counts`` joins the rows.
"""

Index("ix_robot_held", robot.c.environment_id, robot.c.channel, robot.c.held_since)
Index("ix_robot_map", robot.c.environment_id, robot.c.channel, robot.c.held_root, robot.c.held_overlays)

Index(
    "ix_robot_failed",
    robot.c.environment_id,
    robot.c.channel,
    robot.c.root,
    sqlite_where=robot.c.state == literal_column("'failed'"),
    postgresql_where=robot.c.state == literal_column("'failed'"),
)
"""Robots that report a failure, which open rollouts look for each second."""
