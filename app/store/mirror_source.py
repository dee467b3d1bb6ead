"""What a centre hands to the servers that mirror its environments: states, events and content, as JSON and hashes.

A page of an environment has the events after a sequence, and the versions, channels and overlays that they led to.
Content is named by hashes, of which the mirror asks for those that it lacks.
"""

from __future__ import annotations

import base64
import threading
from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Final

from sqlalchemy import Connection, Row, select

from app.errors import Mirrored, NotFound
from app.store import parts, tables
from app.store.base import environment_row
from app.store.chunks import Chunks
from app.store.database import Database
from app.store.environments import reaches
from app.store.manifest import read_sources, unpack_manifest
from app.store.tree import ChunkStage
from app.store.values import Source, rfc3339

FORM: Final = 1
"""Number of the form of pages. A mirror refuses one that it does not know."""

SIGNATURE: Final = "fleetmap-mirror-signature"
"""Header of a page: as that of a manifest. Another name, since a page may be compressed on its way."""

MAX_EVENTS: Final = 2000
MAX_VERSIONS: Final = 100
"""Maximum number of events and versions in one page."""

MAX_CACHED: Final = 8
PREFIX_BYTES: Final = 8
"""Bytes of a chunk's hash in a page: enough to ask for it; the mirror checks the whole hash of what it gets."""


@dataclass(frozen=True, slots=True)
class Content:
    """Chunks (hashes) and files (SHA-256 in hex) that some versions have and the ones before do not."""

    chunks: tuple[bytes, ...]
    blobs: frozenset[str]


class MirrorSource:
    """Read access for mirrors."""

    def __init__(self, database: Database, chunks: Chunks) -> None:
        self._database, self._chunks = database, chunks
        self._lock = threading.Lock()
        self._contents: OrderedDict[tuple[str, int, int, str, datetime], Content] = OrderedDict()

    def listing(self, allowed: str | None, since: int = 0) -> dict[str, Any]:
        """List the environments that a name pattern allows, also deleted ones, with the position of the log.

        since: position of the log for which the environments are null, if it is still the present one.
        """
        table = tables.environment
        columns = (table.c.id, table.c.name, table.c.sequence, table.c.updated, table.c.centre)
        with self._database.snapshot() as connection:
            position = connection.execute(select(tables.log.c.position).where(tables.log.c.id == 1)).scalar_one()
            epoch = connection.execute(select(tables.server.c.epoch)).scalar_one_or_none() or 0
            is_new = position != since or not since
            rows = connection.execute(select(*columns).order_by(table.c.name)).all() if is_new else []
        environments = [
            {"id": r.id, "name": r.name, "sequence": r.sequence, "updated": rfc3339(r.updated)}
            for r in rows
            if r.centre is None and reaches(allowed, r.name)
        ]
        return {
            "form": FORM,
            "epoch": epoch,
            "position": position,
            "allowed": allowed,
            "environments": environments if is_new else None,
        }

    def page(self, name: str, after: int, sequence: int, thinned: datetime | None = None) -> dict[str, Any]:
        """Read the next page of an environment, also of a deleted one.

        Args:
            after: number of the newest version that the mirror has, -1 for none.
            sequence: of the newest event that it has, 0 for none.
            thinned: time up to which it has thinned versions, None for none.

        Raises NotFound, or Mirrored if the environment is a mirror itself.
        """
        with self._database.snapshot() as connection:
            row = environment_row(connection, name, deleted=True)
            if row.centre is not None:
                raise Mirrored(f"the environment {name!r} is a mirror itself: follow {row.centre}")
            epoch = connection.execute(select(tables.server.c.epoch)).scalar_one_or_none() or 0
            events = _read_events(connection, row, sequence)
            upto = int(row.sequence) if len(events) <= MAX_EVENTS else int(events[MAX_EVENTS - 1]["sequence"])
            versions = _read_versions(connection, row, after, upto)
            if len(versions) > MAX_VERSIONS:
                versions = versions[:MAX_VERSIONS]
                upto = int(versions[-1]["sequence"])
            if versions and "thinned" in versions[-1]:  # the mirror's newest version must have content
                upto = _next_kept_sequence(connection, row, int(versions[-1]["number"]))
                versions = _read_versions(connection, row, after, upto, limit=None)
                events = _read_events(connection, row, sequence, limit=None)
            last = max([after, *(int(v["number"]) for v in versions)])
            is_last = upto == row.sequence
            overlay_ids = {e["body"]["overlay"]["id"] for e in events if "overlay" in e["body"]}
            out = {
                "form": FORM,
                "epoch": epoch,
                "environment": _environment_as_json(row),
                "base": _read_base(connection, row, after),
                "upto": upto,
                "last": last,
                "complete": is_last,
                "versions": versions,
                "events": [e for e in events if e["sequence"] <= upto],
                "channels": _read_channels(connection, row) if is_last else [],
                "tags": _read_tags(connection, row) if is_last else [],
                "thinned": _read_thinned(connection, row, after, thinned),
                "overlays": _read_overlays(connection, row, overlay_ids) if is_last else [],
            }
        chunks = self.content(name, after, last).chunks
        out["chunks"] = base64.b64encode(b"".join(h[:PREFIX_BYTES] for h in chunks)).decode()
        return out

    def content(self, name: str, after: int, last: int) -> Content:
        """Name the content of the versions after ``after`` up to ``last`` that the one before does not have.

        Raises NotFound if a version does not exist.
        """
        with self._database.snapshot() as connection:
            row = environment_row(connection, name, deleted=True)
            key = (str(row.id), after, last, str(row.root), row.updated)  # thinning changes the latter alone
            with self._lock:
                if (cached := self._contents.get(key)) is not None:
                    return cached
            table = tables.version
            query = select(table.c.number, table.c.manifest, table.c.thinned).where(
                table.c.environment_id == row.id, table.c.number >= after, table.c.number <= last
            )
            rows = connection.execute(query).all()
            manifests = {r.number: bytes(r.manifest) for r in rows if r.thinned is None}
            sources = read_sources(connection, row.id, sorted(manifests))
        if last > after and last not in manifests:
            raise NotFound(f"{name} has no version {last}")
        roots = {number: [entry.hash for entry in unpack_manifest(data)[2]] for number, data in manifests.items()}
        new = {root for number, listed in roots.items() if number > after for root in listed}
        content = new_content(self._chunks.stage(), roots.get(after, ()), new)
        uploads = {source.sha256 for listed in sources.values() for source in listed if source.removed is None}
        content = Content(content.chunks, content.blobs | uploads)
        with self._lock:
            self._contents[key] = content
            while len(self._contents) > MAX_CACHED:
                self._contents.popitem(last=False)
        return content


def new_content(draft: ChunkStage, before: Iterable[str], after: Iterable[str]) -> Content:
    """Name the content of some parts that others do not have. before, after: hashes of parts.

    Reads inner nodes only. Raises Damaged if one is missing.
    """
    present: set[bytes] = set()
    for root in sorted(set(before)):
        present |= parts.all_chunks(draft, bytes.fromhex(root), present)[0]
    out: set[bytes] = set()
    blobs: set[str] = set()
    for root in sorted(set(after) - set(before)):
        names, files = parts.all_chunks(draft, bytes.fromhex(root), present | out)
        out |= names - present
        blobs |= files
    return Content(tuple(sorted(out)), frozenset(blobs))


def _environment_as_json(row: Row[Any]) -> dict[str, Any]:
    return {
        "id": row.id,
        "name": row.name,
        "title": row.title,
        "description": row.description,
        "tags": list(row.tags),
        "head": row.head,
        "root": row.root,
        "sequence": row.sequence,
        "closures_sequence": row.closures_sequence,
        "created": rfc3339(row.created),
        "updated": rfc3339(row.updated),
        "deleted": None if row.deleted is None else rfc3339(row.deleted),
    }


def _read_base(connection: Connection, environment: Row[Any], number: int) -> dict[str, Any] | None:
    """Read what tells whether the mirror's newest version is of the same history; None if there is none."""
    table = tables.version
    query = select(table.c.root, table.c.sequence, table.c.time).where(
        table.c.environment_id == environment.id, table.c.number == number
    )
    row = connection.execute(query).one_or_none()
    if row is None:
        return None
    sources = read_sources(connection, environment.id, [number])[number]
    listed = [_source_as_json(source) for source in sources]
    return {"root": row.root, "sequence": row.sequence, "time": rfc3339(row.time), "sources": listed}


def _source_as_json(source: Source) -> dict[str, Any]:
    return source.as_dict()


def _read_events(
    connection: Connection, environment: Row[Any], sequence: int, limit: int | None = MAX_EVENTS + 1
) -> list[dict[str, Any]]:
    table = tables.event
    query = (
        select(table)
        .where(table.c.environment_id == environment.id, table.c.sequence > sequence)
        .order_by(table.c.sequence)
        .limit(limit)
    )
    return [
        {"sequence": r.sequence, "environment": r.environment, "time": rfc3339(r.time), "body": r.body}
        for r in connection.execute(query)
    ]


def _read_versions(
    connection: Connection, environment: Row[Any], after: int, upto: int, limit: int | None = MAX_VERSIONS + 1
) -> list[dict[str, Any]]:
    table = tables.version
    query = (
        select(table)
        .where(table.c.environment_id == environment.id, table.c.number > after, table.c.sequence <= upto)
        .order_by(table.c.number)
        .limit(limit)
    )
    rows = connection.execute(query).all()
    sources = read_sources(connection, environment.id, [r.number for r in rows])
    return [
        {
            "number": r.number,
            "root": r.root,
            "parent": r.parent,
            "author": r.author,
            "message": r.message,
            "time": rfc3339(r.time),
            "sequence": r.sequence,
            "changes": r.changes,
            "warnings": r.warnings,
            "manifest": base64.b64encode(bytes(r.manifest)).decode(),
            "sources": [_source_as_json(source) for source in sources[r.number]],
            **({} if r.thinned is None else {"thinned": {"time": rfc3339(r.thinned), "rule": r.thinned_rule or ""}}),
        }
        for r in rows
    ]


def _next_kept_sequence(connection: Connection, environment: Row[Any], number: int) -> int:
    """Return the sequence of the next version with content after a thinned one: the head has content."""
    table = tables.version
    kept = (table.c.environment_id == environment.id, table.c.number > number, table.c.thinned.is_(None))
    query = select(table.c.sequence).where(*kept).order_by(table.c.number).limit(1)
    return int(connection.execute(query).scalar_one())


def _read_thinned(
    connection: Connection, environment: Row[Any], after: int, since: datetime | None
) -> list[dict[str, Any]]:
    """List the versions up to ``after`` that were thinned since, as ranges of numbers with equal time."""
    table = tables.version
    query = select(table.c.number, table.c.thinned, table.c.thinned_rule).where(
        table.c.environment_id == environment.id, table.c.thinned.is_not(None), table.c.number <= after
    )
    if since is not None:
        query = query.where(table.c.thinned > since)
    out: list[dict[str, Any]] = []
    for r in connection.execute(query.order_by(table.c.number)):
        about = {"time": rfc3339(r.thinned), "rule": r.thinned_rule or ""}
        if out and out[-1]["last"] == r.number - 1 and about.items() <= out[-1].items():
            out[-1]["last"] = r.number
        else:
            out.append({"first": r.number, "last": r.number, **about})
    return out


def _read_tags(connection: Connection, environment: Row[Any]) -> list[dict[str, Any]]:
    table = tables.version_tag
    rows = connection.execute(select(table).where(table.c.environment_id == environment.id).order_by(table.c.name))
    return [{"name": r.name, "number": r.number, "author": r.author, "time": rfc3339(r.time)} for r in rows]


def _read_channels(connection: Connection, environment: Row[Any]) -> list[dict[str, Any]]:
    table = tables.channel
    rows = connection.execute(select(table).where(table.c.environment_id == environment.id).order_by(table.c.name))
    return [
        {
            "name": r.name,
            "version": r.version,
            "sequence": r.sequence,
            "author": r.author,
            "time": rfc3339(r.time),
            "planned_version": r.planned_version,
            "planned_at": None if r.planned_at is None else rfc3339(r.planned_at),
            "planned_author": r.planned_author,
            "rollout": r.rollout,
            "rollout_state": r.rollout_state,
        }
        for r in rows
    ]


def _read_overlays(connection: Connection, environment: Row[Any], changed: set[str]) -> list[dict[str, Any]]:
    """Read the overlays that wait or are in force, and those that the page's events changed."""
    table = tables.overlay
    query = select(table).where(table.c.environment_id == environment.id).order_by(table.c.created, table.c.id)
    rows = connection.execute(query)
    return [overlay_as_json(r) for r in rows if r.state in ("pending", "accepted") or r.id in changed]


def overlay_as_json(row: Row[Any]) -> dict[str, Any]:
    """Return an overlay's row with its times as texts."""
    members = {c.name: getattr(row, c.name) for c in tables.overlay.c if c.name != "environment_id"}
    for name in ("created", "expires", "decided"):
        members[name] = None if members[name] is None else rfc3339(members[name])
    return members
