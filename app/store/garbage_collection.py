"""Garbage collection: remove what no version, dry run or draft refers to and what was not used in the grace period.

Most runs cost what was written since the last one: they walk the versions since then, mark what these contain as kept,
and look only at what is not kept. Content of versions goes only when an environment is purged or versions are thinned;
the run after that, and one a month, looks at everything, also for files without a row and for events of purged
environments. After thinning that run waits for the grace period, since somebody may still read what was thinned.

It never races an upload. The chunks that a version in progress relies on are part of its base version, which exists
while it is marked (else the commit fails), or were written or used again within the grace period. Rows are removed with
a condition on that time, in the statement that finds them.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Container, Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from types import MappingProxyType
from typing import Final

from sqlalchemy import ColumnElement, Connection, Table, delete, func, literal, select, update

from app.store import chunks, drafts, dry_runs, parts, tables
from app.store.blob_upkeep import BlobUpkeep
from app.store.blobs import Blobs
from app.store.chunks import Chunks
from app.store.database import Database
from app.store.made_maps import MadeMaps
from app.store.manifest import unpack_manifest
from app.store.retention import EnvironmentPlan
from app.store.silent_robots import remove_silent

CONTENT_LEAD: Final = "content"
"""Lead of who removes content, or needs it all to stay: garbage collection and backups exclude each other."""

IDEMPOTENCY_DAYS: Final = 7
EVENT_DAYS: Final = 30
JOB_DAYS: Final = 7
OVERLAY_DAYS: Final = 30
ROBOT_DAYS: Final = 90
"""Days without a report after which a robot is removed."""
COMPLETE_SECONDS: Final = 30 * 24 * 3600
"""Seconds after which a run looks at everything again."""
OVERLAP_SECONDS: Final = 3600
"""Seconds by which a run overlaps the one before: servers' clocks differ, and a commit takes time."""
PAGE: Final = 500


@dataclass(frozen=True, slots=True)
class _References:
    """Chunks and blobs that something refers to."""

    chunks: set[bytes]
    blobs: set[str]

    def __or__(self, other: _References) -> _References:
        return _References(self.chunks | other.chunks, self.blobs | other.blobs)


class _KeptChunks:
    """All chunks but the young ones: a walk goes no further there, since a kept chunk's are kept, too."""

    def __init__(self, young: Collection[bytes]) -> None:
        self._young = young

    def __contains__(self, name: object) -> bool:
        return name not in self._young


class GarbageCollector:
    """Garbage collector of one store."""

    def __init__(
        self, database: Database, chunks: Chunks, blobs: Blobs, upkeep: BlobUpkeep, made_maps: MadeMaps
    ) -> None:
        self._database, self._chunks, self._blobs, self._upkeep = database, chunks, blobs, upkeep
        self._made_maps = made_maps

    def collect(self, grace: timedelta) -> dict[str, int]:
        """Remove chunks and blobs that no version, dry run or draft refers to, unless written or used within ``grace``.

        Returns ``{chunks, blobs, bytes, temporary}``: numbers of removed objects, bytes of the blobs. Also removes
        expired dry runs and drafts (before all else), old idempotency keys (7 days), finished jobs (7 days), silent
        robots (90 days), settled overlays, events of purged environments, and made maps without use (30 days).

        ``grace`` must be longer than any upload takes. Raises Damaged if a chunk of a version is damaged; nothing is
        removed then. Safe on several servers at once, but in vain.
        """
        started = int(time.time())
        before = int(started - grace.total_seconds()) + (1 if not grace else 0)
        dry_runs.remove_expired(self._database)
        drafts.remove_expired(self._database)
        with self._database.read() as connection:
            state = connection.execute(select(tables.collection)).one()
        is_quiet = state.thinned < before
        is_due = state.purges != state.collected and is_quiet
        complete = is_due or started - state.complete > COMPLETE_SECONDS
        if complete:
            counts = self._collect_all(before)
        else:
            counts = self._collect_young(before, since=state.time - OVERLAP_SECONDS)
        temporary = self._blobs.files.recover()
        self._made_maps.collect()
        self._tidy(complete=complete)
        done = {"time": started, **({"complete": started} if complete else {})}
        done |= {"collected": state.purges} if complete and is_quiet else {}
        with self._database.write(notify=False, upkeep=True) as connection:
            connection.execute(update(tables.collection).values(done))
        return {**counts, "temporary": counts["temporary"] + temporary}

    def look_at_everything(self) -> None:
        """Have the next run look at everything, since content of versions was removed or stored again."""
        with self._database.write(notify=False, upkeep=True) as connection:
            connection.execute(update(tables.collection).values(purges=tables.collection.c.purges + 1))

    def last_run(self) -> datetime | None:
        """Return when the last collection began; None if there was none."""
        with self._database.read() as connection:
            seconds = int(connection.execute(select(tables.collection.c.time)).scalar_one())
        return datetime.fromtimestamp(seconds, UTC) if seconds else None

    def removable_bytes(self, plans: Iterable[EnvironmentPlan] = ()) -> tuple[int, int]:
        """Return the bytes that a complete collection would remove, and those stored in all; changes nothing.

        plans: count what these would remove as removed. Reads the inner nodes of all trees, like such a collection.
        """
        listed = list(plans)
        without = {plan.id: frozenset(plan.thinned) for plan in listed}
        files = {(plan.id, *file) for plan in listed for file in plan.files}
        with self._database.snapshot() as connection:
            roots = [*_roots(connection, [tables.version], without=without), *_roots(connection, _PENDING)]
            sources = _used_sources(connection, without, files) | _pending_sources(connection)
        live = self._walk(roots) | _References(set(), sources)
        chunk, blob = tables.chunk, tables.blob
        removable = total = 0
        with self._database.snapshot() as connection:
            connection.execution_options(stream_results=True)
            for name, size in connection.execute(select(chunk.c.hash, func.length(chunk.c.data))):
                total += size
                removable += 0 if bytes(name) in live.chunks else size
            for name, size in connection.execute(select(blob.c.sha256, func.coalesce(blob.c.stored, blob.c.size))):
                total += size
                removable += 0 if name in live.blobs else size
        return removable, total

    def _collect_all(self, before: int) -> dict[str, int]:
        self._chunks.forget()
        # one snapshot: else content could be missed if it is cloned and its origin purged during the walk
        with self._database.snapshot() as connection:
            kept_roots = _roots(connection, [tables.version])
            present = tables.source.c.removed.is_(None)
            sources = set(connection.execute(select(tables.source.c.sha256).where(present).distinct()).scalars())
            pending_roots, pending_sources = _roots(connection, _PENDING), _pending_sources(connection)
        kept = self._walk(kept_roots) | _References(set(), sources)
        live = kept | self._walk(pending_roots, kept.chunks) | _References(set(), pending_sources)
        removed = self._sweep(live.chunks, before)
        self._keep(kept.chunks)
        self._upkeep.keep(kept.blobs)
        blobs, size = self._upkeep.collect_all(live.blobs, before)
        return {"chunks": removed, "blobs": blobs, "bytes": size, "temporary": self._upkeep.remove_strays(before)}

    def _collect_young(self, before: int, since: int) -> dict[str, int]:
        table, version = tables.chunk, tables.version
        recent = version.c.time >= datetime.fromtimestamp(max(since, 0), UTC)
        with self._database.snapshot() as connection:
            query = select(table.c.hash, table.c.used).where(tables.is_young(table))
            young = {bytes(name): used for name, used in connection.execute(query)}
            kept_roots = _roots(connection, [version], recent)
            pending_roots, pending_sources = _roots(connection, _PENDING), _pending_sources(connection)
        kept = self._walk(kept_roots, _KeptChunks(young))
        self._keep(kept.chunks & young.keys())
        self._upkeep.keep(kept.blobs)
        live = kept | self._walk(pending_roots, _KeptChunks(young)) | _References(set(), pending_sources)
        idle = sorted(name for name, used in young.items() if used < before and name not in live.chunks)
        removed = self._delete(idle, before, young=True)
        blobs, size = self._upkeep.collect_young(live.blobs, before)
        return {"chunks": removed, "blobs": blobs, "bytes": size, "temporary": 0}

    def _walk(self, roots: Iterable[bytes], skipped: Container[bytes] = ()) -> _References:
        """Return every chunk and blob below parts, except below ``skipped`` chunks. Equal parts are walked once."""
        live: set[bytes] = set()
        files: set[str] = set()
        for root in roots:
            if root in skipped:
                continue
            stage = self._chunks.stage()
            names, blobs = parts.all_chunks(stage, root, _Either(live, skipped))
            live |= names
            files |= blobs
        return _References(live, files)

    def _keep(self, names: Collection[bytes]) -> None:
        """Note that versions contain these chunks, so that the next runs do not look at them."""
        table = tables.chunk
        listed = sorted(names)
        for start in range(0, len(listed), PAGE):
            young = table.c.hash.in_(listed[start : start + PAGE]), tables.is_young(table)
            with self._database.read() as connection:
                some = list(connection.execute(select(table.c.hash).where(*young)).scalars())
            if some:
                with self._database.write(upkeep=True) as connection:
                    connection.execute(update(table).where(table.c.hash.in_(some)).values(kept=True))

    def _sweep(self, live: set[bytes], before: int) -> int:
        table = tables.chunk
        count = 0
        last = b""
        while True:
            query = select(table.c.hash, table.c.used).where(table.c.hash > last).order_by(table.c.hash)
            with self._database.read() as connection:
                rows = connection.execute(query.limit(PAGE * 10)).all()
            idle = [bytes(h) for h, used in rows if used < before and bytes(h) not in live]
            count += self._delete(idle, before, young=False)
            if len(rows) < PAGE * 10:
                return count
            last = bytes(rows[-1].hash)

    def _delete(self, names: list[bytes], before: int, *, young: bool) -> int:
        count = 0
        for start in range(0, len(names), PAGE * 10):
            with self._database.write(upkeep=True) as connection:
                count += len(chunks.delete(connection, names[start : start + PAGE * 10], before, young=young))
        return count

    def _tidy(self, *, complete: bool) -> None:
        now = self._database.now()
        events, keys, jobs = tables.event, tables.idempotency, tables.job
        remove_silent(self._database, now - timedelta(days=ROBOT_DAYS))
        with self._database.write(upkeep=True) as connection:
            connection.execute(delete(keys).where(keys.c.time < now - timedelta(days=IDEMPOTENCY_DAYS)))
            decided = tables.overlay.c.state.in_(("rejected", "expired", "ended"))
            old = tables.overlay.c.decided < now - timedelta(days=OVERLAY_DAYS)
            connection.execute(delete(tables.overlay).where(decided, old))
            finished = jobs.c.state.in_(("done", "failed", "cancelled"))
            connection.execute(delete(jobs).where(finished, jobs.c.updated < now - timedelta(days=JOB_DAYS)))
            if complete:  # they are looked for in all old events
                old_events = events.c.time < now - timedelta(days=EVENT_DAYS)
                gone = events.c.environment_id.not_in(select(tables.environment.c.id))
                connection.execute(delete(events).where(old_events, gone))


_PENDING: Final = (tables.dry_run, tables.draft)


class _Either:
    """What is in one of two containers."""

    def __init__(self, one: Container[bytes], other: Container[bytes]) -> None:
        self._one, self._other = one, other

    def __contains__(self, name: object) -> bool:
        return name in self._one or name in self._other


def _roots(
    connection: Connection,
    of: Iterable[Table],
    *conditions: ColumnElement[bool],
    without: Mapping[str, Collection[int]] = MappingProxyType({}),
) -> list[bytes]:
    """Return the parts of versions, dry runs or drafts, each once; a thinned version has none.

    An expired one counts as long as its row exists: a commit of it may have begun before it expired. without: numbers
    of versions to leave out, by environment.
    """
    hashes: dict[str, None] = {}
    for table in of:
        number = table.c.number if table is tables.version else literal(-1)
        query = select(table.c.environment_id, number, table.c.manifest).where(*conditions)
        if table is tables.version:
            query = query.where(table.c.thinned.is_(None))
        rows = connection.execution_options(stream_results=True).execute(query)
        for some in rows.partitions(PAGE):
            for environment_id, version, manifest in some:
                if version not in without.get(environment_id, ()):
                    hashes.update((entry.hash, None) for entry in unpack_manifest(bytes(manifest))[2])
    return [bytes.fromhex(name) for name in hashes]


def _used_sources(
    connection: Connection, without: Mapping[str, Collection[int]], files: Collection[tuple[str, int, int]]
) -> set[str]:
    """Return the files of versions, except of some versions, and except some (environment, version, position)."""
    table = tables.source
    query = select(table.c.environment_id, table.c.number, table.c.position, table.c.sha256)
    rows = connection.execution_options(stream_results=True).execute(query.where(table.c.removed.is_(None)))
    return {
        r.sha256
        for r in rows
        if r.number not in without.get(r.environment_id, ()) and (r.environment_id, r.number, r.position) not in files
    }


def _pending_sources(connection: Connection) -> set[str]:
    listed = connection.execute(select(tables.dry_run.c.sources)).scalars()
    return {source["sha256"] for sources in listed for source in sources}
