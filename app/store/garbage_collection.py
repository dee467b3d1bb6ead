"""Garbage collection: mark what versions, dry runs and drafts refer to, sweep what was not used in the grace period.

It never races an upload. The chunks that a version in progress relies on are part of its base version, which exists
while it is marked (else the commit fails), or were written or used again within the grace period. Rows are removed with
a condition on that time, in the statement that finds them.
"""

from __future__ import annotations

import time
from datetime import timedelta
from typing import Final

from sqlalchemy import delete, select

from app.store import chunks, drafts, dry_runs, parts, tables
from app.store.blobs import Blobs
from app.store.chunks import Chunks
from app.store.database import Database
from app.store.manifest import unpack_manifest
from app.store.robots import presence_seen

IDEMPOTENCY_DAYS: Final = 7
EVENT_DAYS: Final = 30
JOB_DAYS: Final = 7
OVERLAY_DAYS: Final = 30
ROBOT_DAYS: Final = 90
"""Days without a report after which a robot is removed."""
PAGE: Final = 500


class GarbageCollector:
    """Garbage collector of one store."""

    def __init__(self, database: Database, chunks: Chunks, blobs: Blobs) -> None:
        self._database, self._chunks, self._blobs = database, chunks, blobs

    def collect(self, grace: timedelta) -> dict[str, int]:
        """Remove chunks and blobs that no version, dry run or draft refers to, unless written or used within ``grace``.

        Returns ``{chunks, blobs, bytes, temporary}``: numbers of removed objects, bytes of the blobs. Also removes
        expired dry runs and drafts (before all else), old idempotency keys (7 days), finished jobs (7 days), silent
        robots (90 days), settled overlays and events of purged environments (30 days).

        ``grace`` must be longer than any upload takes. Raises Damaged if a chunk of a version is damaged; nothing is
        removed then. Run it in one process at a time.
        """
        self._chunks.forget()
        before = int(time.time() - grace.total_seconds()) + (1 if not grace else 0)
        dry_runs.remove_expired(self._database)
        drafts.remove_expired(self._database)
        live_chunks, live_blobs = self._live()
        removed = self._sweep(live_chunks, before)
        blobs, size = self._blobs.collect(live_blobs, before)
        temporary = self._blobs.recover(max(grace.total_seconds(), 0.0))
        self._tidy()
        return {"chunks": removed, "blobs": blobs, "bytes": size, "temporary": temporary}

    def _live(self) -> tuple[set[bytes], set[str]]:
        """Return every chunk and blob that a version, dry run or draft refers to. Equal parts are walked once.

        An expired one counts as long as its row exists: a commit of it may have begun before it expired.
        """
        hashes: dict[str, None] = {}
        # one snapshot: else content could be missed if it is cloned and its origin purged during the walk
        with self._database.snapshot() as connection:
            for table in (tables.version, tables.dry_run, tables.draft):
                rows = connection.execution_options(stream_results=True).execute(select(table.c.manifest))
                for some in rows.partitions(PAGE):
                    for (manifest,) in some:
                        hashes.update((entry.hash, None) for entry in unpack_manifest(bytes(manifest))[2])
            blobs = set(connection.execute(select(tables.source.c.sha256).distinct()).scalars())
            for sources in connection.execute(select(tables.dry_run.c.sources)).scalars():
                blobs.update(source["sha256"] for source in sources)
        live: set[bytes] = set()
        for name in hashes:
            chunks_of, files = parts.all_chunks(self._chunks.stage(), bytes.fromhex(name), live)
            live |= chunks_of
            blobs |= files
        return live, blobs

    def _sweep(self, live: set[bytes], before: int) -> int:
        table = tables.chunk
        count = 0
        last = b""
        while True:
            query = select(table.c.hash, table.c.used).where(table.c.hash > last).order_by(table.c.hash)
            with self._database.read() as connection:
                rows = connection.execute(query.limit(PAGE * 10)).all()
            idle = [bytes(h) for h, used in rows if used < before and bytes(h) not in live]
            if idle:
                with self._database.write(upkeep=True) as connection:
                    count += len(chunks.delete(connection, idle, before))
            if len(rows) < PAGE * 10:
                return count
            last = bytes(rows[-1].hash)

    def _tidy(self) -> None:
        now = self._database.now()
        events, keys, jobs = tables.event, tables.idempotency, tables.job
        with self._database.write(upkeep=True) as connection:
            connection.execute(delete(keys).where(keys.c.time < now - timedelta(days=IDEMPOTENCY_DAYS)))
            silent = now - timedelta(days=ROBOT_DAYS)
            for table in (tables.robot, tables.robot_history):
                connection.execute(delete(table).where(table.c.time < silent))
            connection.execute(delete(tables.presence).where(presence_seen() < silent))
            decided = tables.overlay.c.state.in_(("rejected", "expired", "ended"))
            old = tables.overlay.c.decided < now - timedelta(days=OVERLAY_DAYS)
            connection.execute(delete(tables.overlay).where(decided, old))
            finished = jobs.c.state.in_(("done", "failed", "cancelled"))
            connection.execute(delete(jobs).where(finished, jobs.c.updated < now - timedelta(days=JOB_DAYS)))
            connection.execute(
                delete(events).where(
                    events.c.time < now - timedelta(days=EVENT_DAYS),
                    events.c.environment_id.not_in(select(tables.environment.c.id)),
                )
            )
