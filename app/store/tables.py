"""Tables, one model for SQLite and PostgreSQL. Migrations create them; a test compares both.

Geometry is PostGIS' ``geometry`` (GiST index) on PostgreSQL and WKB on SQLite, with four bounding-box columns on both.
"""

from __future__ import annotations

from typing import Any

from sqlalchemy import (
    JSON,
    BigInteger,
    Boolean,
    Column,
    ColumnElement,
    Computed,
    Float,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    SmallInteger,
    String,
    Table,
    Text,
    false,
    literal_column,
    true,
)

from app.store import fleet_tables, mirror_tables, table_base, webhook_tables
from app.store.column_types import Grams, UtcDateTime, WkbGeometry, binary_text
from app.store.table_base import POSTGRESQL, box, environment_key

metadata = table_base.metadata

robot, robot_history = fleet_tables.robot, fleet_tables.robot_history
robot_tally, presence = fleet_tables.robot_tally, fleet_tables.presence
mirror, delegation, edge_change = mirror_tables.mirror, mirror_tables.delegation, mirror_tables.edge_change
webhook, webhook_lag = webhook_tables.webhook, webhook_tables.webhook_lag

SEARCH_STALE = "(search_sequence = sequence AND search_updated = updated) IS NOT TRUE"

environment = Table(
    "environment",
    metadata,
    Column("id", String(32), primary_key=True),
    Column("name", String(63), nullable=False, unique=True),
    Column("title", Text, nullable=False),
    Column("description", Text, nullable=False),
    Column("tags", JSON, nullable=False),
    Column("head", Integer, nullable=False),
    Column("root", String(64), nullable=False),
    Column("sequence", BigInteger, nullable=False),
    Column("closures_sequence", BigInteger, nullable=False, server_default="0"),
    Column("datum", JSON(none_as_null=True), nullable=True),
    Column("indexed", Integer, nullable=False, default=-1),
    Column("created", UtcDateTime, nullable=False),
    Column("updated", UtcDateTime, nullable=False),
    Column("deleted", UtcDateTime, nullable=True),
    *box(),
    Column("extent", WkbGeometry, nullable=True),
    Column("area_stale", Boolean, nullable=False, server_default=true(), index=True),
    Column("index_stale", Boolean, Computed("indexed <> head"), index=True),
    Column("search_version", Integer, nullable=False, server_default="-1"),
    Column("search_sequence", BigInteger, nullable=False, server_default="-1"),
    Column("search_updated", UtcDateTime, nullable=True),
    Column("search_stale", Boolean, Computed(SEARCH_STALE), index=True),
    Column("centre", Text, nullable=True),
    Column("centre_epoch", BigInteger, nullable=True),
    Column("edge_sequence", BigInteger, nullable=False, server_default="0"),
)
"""Environments. head and root: of the newest version. sequence: of the last event. closures_sequence: of the last event
that changed the closures in force. area_stale: whether ``area`` has to be computed from the head before it is read.
indexed, index_stale: not used, as ``place``.

search_version: the version that ``search_item`` shows; negative while there is none. search_sequence, search_updated:
``sequence`` and ``updated`` at that time; every change raises one of them. search_stale: whether ``search_item``
may be behind, as the database computes it.

centre, centre_epoch: URL and epoch of the server that a mirror follows, NULL for an environment of this server.
edge_sequence: number of changes of closures that a mirror made by itself.
"""

Index("ix_environment_extent", environment.c.extent, postgresql_using="gist", info=POSTGRESQL).ddl_if(
    dialect="postgresql"
)
Index("ix_environment_box", environment.c.south, environment.c.north, environment.c.west, environment.c.east)

area = Table(
    "area",
    metadata,
    environment_key(primary_key=True),
    Column("piece", Integer, primary_key=True, autoincrement=False),
    Column("basis", String(8), nullable=False),
    Column("size", Float(53), nullable=False),
    *box(),
    Column("geometry", WkbGeometry, nullable=False),
)
"""Areas of the heads on earth, see ``app.store.area``: for queries by position.

A piece does not cross the antimeridian.
size: square metres of all pieces. Can be rebuilt from the trees at any time.
"""

Index("ix_area_geometry", area.c.geometry, postgresql_using="gist", info=POSTGRESQL).ddl_if(dialect="postgresql")
Index("ix_area_box", area.c.south, area.c.north, area.c.west, area.c.east)

version = Table(
    "version",
    metadata,
    environment_key(primary_key=True),
    Column("number", Integer, primary_key=True, autoincrement=False),
    Column("root", String(64), nullable=False),
    Column("parent", Integer, nullable=True),
    Column("author", Text, nullable=False),
    Column("message", Text, nullable=False),
    Column("time", UtcDateTime, nullable=False, index=True),
    Column("sequence", BigInteger, nullable=False),
    Column("changes", JSON, nullable=False),
    Column("warnings", JSON, nullable=False),
    Column("manifest", LargeBinary, nullable=False),
    Column("thinned", UtcDateTime, nullable=True),
    Column("thinned_rule", Text, nullable=True),
    Column("linked", UtcDateTime, nullable=True),
)
"""Versions. manifest: datum, levels and parts, as packed by ``manifest.py``. sequence: of the version's event.

thinned, thinned_rule: when a rule of retention removed the content, and which; the manifest is empty then. linked: time
until which a signed link may name the version.
"""

_thinned = version.c.thinned.is_not(None)
Index(
    "ix_version_thinned",
    version.c.environment_id,
    version.c.thinned,
    sqlite_where=_thinned,
    postgresql_where=_thinned,
)

version_tag = Table(
    "version_tag",
    metadata,
    environment_key(primary_key=True),
    Column("name", String(63), primary_key=True),
    Column("number", Integer, nullable=False),
    Column("author", Text, nullable=False),
    Column("time", UtcDateTime, nullable=False),
    Index("ix_version_tag_number", "environment_id", "number"),
)
"""Tags: names of versions, which keep them from being thinned."""

source = Table(
    "source",
    metadata,
    environment_key(primary_key=True),
    Column("number", Integer, primary_key=True, autoincrement=False),
    Column("position", Integer, primary_key=True, autoincrement=False),
    Column("name", Text, nullable=False),
    Column("size", BigInteger, nullable=False),
    Column("sha256", String(64), nullable=False, index=True),
    Column("format", Text, nullable=True),
    Column("used", Boolean, nullable=False),
    Column("removed", UtcDateTime, nullable=True),
)
"""Files of a version, in the order of the upload. removed: when a rule of retention removed the file."""


def _pending_content() -> tuple[Column[Any], ...]:
    return (
        Column("base", Integer, nullable=False),
        Column("root", String(64), nullable=False),
        Column("created", UtcDateTime, nullable=False),
        Column("expires", UtcDateTime, nullable=False, index=True),
        Column("changed", Boolean, nullable=False),
        Column("changes", JSON, nullable=False),
        Column("warnings", JSON, nullable=False),
        Column("manifest", LargeBinary, nullable=False),
    )


dry_run = Table(
    "dry_run",
    metadata,
    Column("id", String(32), primary_key=True),
    environment_key(nullable=False, index=True),
    *_pending_content(),
    Column("author", Text, nullable=False),
    Column("message", Text, nullable=False),
    Column("sources", JSON, nullable=False),
)
"""Versions that were tried and not committed; garbage collection keeps their content as long as the row exists.

base: number of the head that they were made for. sources: as in ``source``. changed: see ``Prepared``.
"""

draft = Table(
    "draft",
    metadata,
    Column("id", String(32), primary_key=True),
    environment_key(nullable=False),
    *_pending_content(),
    Column("name", Text, nullable=False),
    Column("owner", Text, nullable=False),
    Column("owner_id", String(32), nullable=False),
    Column("revision", Integer, nullable=False),
    Column("edited", UtcDateTime, nullable=False),
    Index("ix_draft_owner", "environment_id", "owner_id", "name", unique=True),
)
"""Versions that people work on; garbage collection keeps their content as long as the row exists.

base, changed: as in ``dry_run``. owner, owner_id: name and id of the token, which may have ended. revision: rises with
every edit, so that of two at once only one is stored.
"""

chunk = Table(
    "chunk",
    metadata,
    Column("hash", LargeBinary(32), primary_key=True),
    Column("data", LargeBinary, nullable=False),
    Column("used", BigInteger, nullable=False),
    Column("kept", Boolean, nullable=False, server_default=false()),
)
"""Chunks by the hash of their canonical bytes; data is compressed.

used: time of the last write or repeated write (seconds since 1970): garbage collection skips recent ones, which an
upload in progress may rely on. kept: known to be part of a version.
"""


def is_young(table: Table) -> ColumnElement[bool]:
    """Return the condition of ``_young``, as written there: SQLite does not use its index for ``kept IS 0``."""
    return literal_column(f"{table.name}.kept IS false")  # with a type, SQLite would get "= 1" after it


def _young(table: Table) -> None:
    """Index what no version is known to refer to, by time of use: garbage collection looks at little else."""
    kept = table.c.kept.is_(False)
    Index(f"ix_{table.name}_young", table.c.used, sqlite_where=kept, postgresql_where=kept)


_young(chunk)

blob = Table(
    "blob",
    metadata,
    Column("sha256", String(64), primary_key=True),
    Column("size", BigInteger, nullable=False),
    Column("pack", String(64), nullable=True, index=True),
    Column("start", BigInteger, nullable=False),
    Column("used", BigInteger, nullable=False),
    Column("kept", Boolean, nullable=False, server_default=false()),
    Column("stored", BigInteger, nullable=True),
    Column("coding", String(8), nullable=True),
    Column("base", String(64), nullable=True, index=True),
    Column("chain", Integer, nullable=False, server_default="0"),
)
"""Files by the hash of their content.

pack: the pack file that contains it, from byte ``start`` on; NULL if it is a file of its own. stored: number of bytes
there, NULL if ``size``. coding: how they are kept (``app.store.blob_coding``), NULL: as they are. base: the blob that
they are the difference from. chain: which version of a file it is. used, kept: as of a chunk.
"""

_young(blob)

collection = Table(
    "collection",
    metadata,
    Column("id", Integer, primary_key=True, autoincrement=False),
    Column("purges", BigInteger, nullable=False),
    Column("collected", BigInteger, nullable=False),
    Column("time", BigInteger, nullable=False),
    Column("complete", BigInteger, nullable=False),
    Column("thinned", BigInteger, nullable=False, server_default="0"),
)
"""State of garbage collection: one row. purges: number of removals of content that versions referred to; collected: the
purges whose content is removed. time, complete: of the last run, and of the last one that looked at everything.
thinned: when retention last removed something; what reads it may go on for a while.
"""

made_map = Table(
    "made_map",
    metadata,
    Column("key", String(64), primary_key=True),
    Column("object", String(64), nullable=False, index=True),
    Column("size", BigInteger, nullable=False),
    Column("entry", LargeBinary, nullable=False),
    Column("used", BigInteger, nullable=False, index=True),
)
"""Made maps that servers share, by the key of their recipe. object: the file of the blob store with all their files;
size: its bytes. entry: as in ``map.json`` of the cache, compressed. used: day of the last use (seconds since 1970).
"""

made_file = Table(
    "made_file",
    metadata,
    Column("key", String(64), ForeignKey("made_map.key", ondelete="CASCADE"), primary_key=True),
    Column("position", Integer, primary_key=True, autoincrement=False),
    Column("sha256", String(64), nullable=False, index=True),
    Column("size", BigInteger, nullable=False),
    Column("start", BigInteger, nullable=False),
    Column("stored", BigInteger, nullable=False),
    Column("coding", String(8), nullable=True),
)
"""Files of made maps, as parts of the map's object. coding: as of a blob."""

channel = Table(
    "channel",
    metadata,
    environment_key(primary_key=True),
    Column("name", String(63), primary_key=True),
    Column("version", Integer, nullable=True),
    Column("sequence", BigInteger, nullable=False),
    Column("author", Text, nullable=False),
    Column("time", UtcDateTime, nullable=False),
    Column("planned_version", Integer, nullable=True),
    Column("planned_at", UtcDateTime, nullable=True, index=True),
    Column("planned_author", Text, nullable=True),
    Column("rollout", JSON(none_as_null=True), nullable=True),
    Column("rollout_state", String(16), nullable=True, index=True),
)
"""Channels. planned_at is NULL if the move waits for robots only. rollout: result of ``Rollout.as_row``."""

event = Table(
    "event",
    metadata,
    Column("position", BigInteger, primary_key=True, autoincrement=False),
    Column("environment_id", String(32), nullable=False),
    Column("environment", String(63), nullable=False),
    Column("sequence", BigInteger, nullable=False),
    Column("body", JSON, nullable=False),
    Column("time", UtcDateTime, nullable=False),
    Index("uq_event_sequence", "environment_id", "sequence", unique=True),
)
"""The outbox, which is also the log. Rows outlive their environment, so that its end is published after a purge."""

log = Table(
    "log",
    metadata,
    Column("id", Integer, primary_key=True, autoincrement=False),
    Column("position", BigInteger, nullable=False),
)
"""One row: the position of the newest event. Its lock puts the events of all environments in one order."""

relay = Table(
    "relay",
    metadata,
    Column("id", Integer, primary_key=True, autoincrement=False),
    Column("position", BigInteger, nullable=False),
)
"""Positions up to which events were handed over: 1 to Zenoh, 2 to the MQTT broker."""

retired = Table(
    "retired",
    metadata,
    Column("name", String(63), primary_key=True),
    Column("sequence", BigInteger, nullable=False),
)
"""Former names of environments, with the last sequence published under them: a new environment of that name continues
from there, since robots reject a lower sequence.
"""

idempotency = Table(
    "idempotency",
    metadata,
    environment_key(primary_key=True),
    Column("key", String(255), primary_key=True),
    Column("fingerprint", Text, nullable=False),
    Column("version", Integer, nullable=False),
    Column("time", UtcDateTime, nullable=False),
)

token = Table(
    "token",
    metadata,
    Column("id", String(32), primary_key=True),
    Column("hash", String(64), nullable=False, unique=True),
    Column("name", Text, nullable=False),
    Column("role", String(16), nullable=False),
    Column("environments", Text, nullable=True),
    Column("robot", Text, nullable=True),
    Column("expires", UtcDateTime, nullable=True),
    Column("created", UtcDateTime, nullable=False),
    Column("ended", UtcDateTime, nullable=True),
    Column("used", UtcDateTime, nullable=True),
)


def _token() -> Column[str]:
    return Column("token_id", String(32), ForeignKey("token.id", ondelete="CASCADE"), nullable=False, index=True)


session = Table(
    "session",
    metadata,
    Column("hash", String(64), primary_key=True),
    _token(),
    Column("created", UtcDateTime, nullable=False),
    Column("used", UtcDateTime, nullable=False, index=True),
)
"""Sessions of browsers, by the SHA-256 of their secret. used: time of the last use, stored at most once a minute."""

sign_in_code = Table(
    "sign_in_code",
    metadata,
    Column("hash", String(64), primary_key=True),
    _token(),
    Column("expires", UtcDateTime, nullable=False),
)
"""One-time codes that start a session, by their SHA-256."""

job = Table(
    "job",
    metadata,
    Column("id", String(32), primary_key=True),
    Column("state", String(16), nullable=False),
    Column("progress", Float(53), nullable=False),
    Column("detail", Text, nullable=False),
    Column("result", JSON(none_as_null=True), nullable=True),
    Column("problem", JSON(none_as_null=True), nullable=True),
    Column("owner", Text, nullable=False),
    Column("created", UtcDateTime, nullable=False),
    Column("updated", UtcDateTime, nullable=False),
    Column("task", String(64), nullable=True),
    Column("location", Text, nullable=True),
    Column("outcome", JSON(none_as_null=True), nullable=True),
    Column("followed", Boolean, nullable=False, server_default=true()),
    Column("step", Text, nullable=True),
    Index("ix_job_task", "task"),
)
"""Jobs. task: key of the task in the queue of all servers, which sets the state of all jobs that wait for it.

location: address of what the task makes. outcome: of the task, for servers. followed: whether a client was told of it.
step: what a running job does now.
"""


server = Table(
    "server",
    metadata,
    Column("id", Integer, primary_key=True, autoincrement=False),
    Column("epoch", BigInteger, nullable=False),
    Column("min_compatible", String(32), nullable=True),
    Column("presence_checked", UtcDateTime, nullable=True),
)
"""One row. epoch: rises when the database is restored from a backup, so that robots accept lower sequences again.

min_compatible: newest revision of the oldest release that can use this schema. presence_checked: when the robots that
``presence`` has as present were last seen all together.
"""

lead = Table(
    "lead",
    metadata,
    Column("name", String(32), primary_key=True),
    Column("term", BigInteger, nullable=False),
    Column("holder", Text, nullable=False),
    Column("since", UtcDateTime, nullable=False),
)
"""Tasks that one process of all servers does at a time, see ``app.backends.lead``. term: of the last election."""

document = Table(
    "document",
    metadata,
    Column("name", String(32), primary_key=True),
    Column("content", LargeBinary, nullable=False),
    Column("revision", BigInteger, nullable=False),
)
"""Small files of a data folder, on PostgreSQL: keys, secrets of links, state of checks. revision: number of changes."""

wrong_token = Table(
    "wrong_token",
    metadata,
    Column("source", String(64), primary_key=True),
    Column("count", Integer, nullable=False),
    Column("since", UtcDateTime, nullable=False),
)
"""Wrong tokens that all servers counted, by network. since: begin of the period that the count is of."""

overlay = Table(
    "overlay",
    metadata,
    Column("id", String(32), primary_key=True),
    environment_key(nullable=False),
    Column("kind", String(16), nullable=False),
    Column("state", String(16), nullable=False),
    Column("level", String(256), nullable=False),
    Column("polygon", JSON(none_as_null=True), nullable=True),
    Column("edge", String(512), nullable=True),
    Column("crs", String(8), nullable=True),
    Column("detail", Text, nullable=True),
    Column("reporter", Text, nullable=False),
    Column("created", UtcDateTime, nullable=False),
    Column("expires", UtcDateTime, nullable=False),
    Column("decided_by", Text, nullable=True),
    Column("decided", UtcDateTime, nullable=True),
    Column("version", Integer, nullable=True),
    Index("ix_overlay_environment", "environment_id", "state"),
    Index("ix_overlay_expires", "state", "expires"),
)
"""Overlays. expires: end of the obstruction. version: the one that made it permanent; in rows of releases before
closures, the version that it was put into.
"""

place = Table(
    "place",
    metadata,
    Column("id", BigInteger().with_variant(Integer, "sqlite"), primary_key=True),
    environment_key(nullable=False),
    Column("layer", String(16), nullable=False),
    Column("level", String(256), nullable=False),
    Column("name", String(256), nullable=False),
    Column("feature", String(512), nullable=False),
    *box(),
    Column("geometry", WkbGeometry, nullable=False),
    Index("ix_place_feature", "environment_id", "feature"),
)
"""Not used: an index that no query read. Servers of the release before may still write it."""

Index("ix_place_geometry", place.c.geometry, postgresql_using="gist", info=POSTGRESQL).ddl_if(dialect="postgresql")
Index("ix_place_box", place.c.south, place.c.north, place.c.west, place.c.east)

search_item = Table(
    "search_item",
    metadata,
    Column("id", BigInteger().with_variant(Integer, "sqlite"), primary_key=True),
    environment_key(nullable=False),
    Column("environment", binary_text(63), nullable=False),
    Column("kind", SmallInteger, nullable=False),
    Column("level", String(256), nullable=False),
    Column("part", String(256), nullable=False),
    Column("feature", String(512), nullable=False),
    Column("name", Text, nullable=False),
    Column("folded", binary_text(), nullable=False),
    Column("folded_id", binary_text(), nullable=True),
    Column("x", Float(53), nullable=True),
    Column("y", Float(53), nullable=True),
    Column("grams", Grams, nullable=True),
    Index("ix_search_item_feature", "environment_id", "feature"),
    Index("ix_search_item_folded", "kind", "folded", "environment"),
    Index("ix_search_item_folded_id", "kind", "folded_id", "environment"),
)
"""What a search by name finds: environments, and items of their searched versions. Can be rebuilt from the trees.

kind: see ``app.store.search_index``. name: of the item, else its id. folded: the name in lower case; folded_id: the id,
of an environment the title, if it differs. x, y: metres in the local frame. grams: of both texts, on PostgreSQL; on
SQLite the virtual tables ``search_node`` and so on have them.
"""

Index(
    "ix_search_item_grams",
    search_item.c.grams,
    postgresql_using="gin",
    postgresql_with={"gin_pending_list_limit": 128},  # kB, all of which a search reads
    info=POSTGRESQL,
).ddl_if(dialect="postgresql")

audit = Table(
    "audit",
    metadata,
    Column("id", BigInteger().with_variant(Integer, "sqlite"), primary_key=True),
    Column("time", UtcDateTime, nullable=False),
    Column("token_id", String(32), nullable=False),
    Column("token", Text, nullable=False),
    Column("role", String(16), nullable=False),
    Column("address", Text, nullable=False),
    Column("request_id", String(64), nullable=False),
    Column("method", String(16), nullable=False),
    Column("path", Text, nullable=False),
    Column("environment", String(63), nullable=True),
    Column("target", Text, nullable=True),
    Index("ix_audit_environment", "environment", "id"),
)
"""Audit log. Rows outlive tokens and environments, so they contain their names."""
