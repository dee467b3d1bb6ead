"""Periodic tasks of a server: some in each process, others in one process of all servers."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import AsyncIterator, Iterator
from datetime import UTC, datetime, timedelta

from starlette.concurrency import run_in_threadpool

from app.api.http import problems
from app.api.http.auth import WINDOW_SECONDS
from app.api.http.conversions import HEARTBEAT_SECONDS
from app.api.http.dependencies import Services
from app.backends.lead import LeadLostError
from app.errors import DatabaseDamaged, FleetMapError, NoRoom, Unavailable
from app.fleet import next_step
from app.formats import writable_formats
from app.heap import OldGarbage, release_free_memory
from app.store.garbage_collection import CONTENT_LEAD

log = logging.getLogger(__name__)

NAME = "housekeeping"
TICK_SECONDS = 1.0
"""Interval of housekeeping, and so the maximum delay of a planned channel move."""

GARBAGE_SECONDS = 300.0
"""Interval of looks whether Python has collected the garbage among old objects."""

RELEASE_SECONDS = 30.0
"""Interval in which free memory is returned to the system."""

CLOCK_TOLERANCE = timedelta(seconds=60)
"""Maximum backward step of the clock that is not logged."""

SEARCH_BATCH = 100
"""Maximum number of environments whose names are brought up to date in one run."""

COLLECT_EVERY = timedelta(hours=24)
COLLECT_PAUSE = timedelta(hours=1)
"""Time before the first daily run of a process, so that restarts every day leave one, and after a failure."""

MAX_PAUSE = timedelta(days=3)
"""Maximum time between two daily runs; if it was longer, the clock may be wrong, and retention waits for the next."""

THIN_SECONDS = 0.5
"""Maximum time of a run that is spent on thinning versions."""

COLLECT_GRACE = timedelta(hours=6)
"""Minimum age of unreferenced data that the daily garbage collection removes; uploads may still use younger data."""


@contextlib.asynccontextmanager
async def running(services: Services) -> AsyncIterator[None]:
    """Run the periodic tasks of this process."""
    ticker = asyncio.create_task(_Housekeeping(services).run())
    try:
        yield
    finally:
        ticker.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await ticker


class _Housekeeping:
    """Periodic tasks of one process."""

    def __init__(self, services: Services) -> None:
        self._services = services
        self._lead = services.leads.lead(NAME)
        self._content = services.leads.lead(CONTENT_LEAD)
        self._newest = datetime.now(UTC)
        self._collect_at = self._newest + COLLECT_PAUSE
        self._thinning: Iterator[None] = iter(())
        self._release_at = time.monotonic() + RELEASE_SECONDS
        self._collect_garbage_at = time.monotonic() + GARBAGE_SECONDS
        self._garbage = OldGarbage()

    async def run(self) -> None:
        """Run the tasks every TICK_SECONDS, until cancelled."""
        beat = 0.0
        while True:
            await asyncio.sleep(TICK_SECONDS)
            beat += TICK_SECONDS
            is_beat = beat >= HEARTBEAT_SECONDS
            beat = 0.0 if is_beat else beat
            try:
                self._services.response_cache.flush_counters()
                await run_in_threadpool(self._run_in_each_process, is_beat)
                if await run_in_threadpool(self._lead.try_acquire):
                    await run_in_threadpool(self._run_as_leader, is_beat)
                else:
                    self._content.release()
            except LeadLostError as error:
                log.info("housekeeping: %s", error.detail)
            except FleetMapError as error:
                log.warning("housekeeping: skipped, will retry: %s", error.detail)
            except Exception as error:  # noqa: BLE001  must survive a temporary loss of the database
                log.error("housekeeping: failed, will retry: %s", problems.describe(error))  # noqa: TRY400  a trace shows paths

    def _run_in_each_process(self, is_beat: bool) -> None:
        services, store = self._services, self._services.store
        self._newest = _note_time(self._newest)
        store.tokens.store_uses()
        store.sessions.store_uses()
        services.access.share_failures()
        services.jobs.store_progress()
        if is_beat:
            services.maps.cache.leave_room()
            services.jobs.send_heartbeats()
        if time.monotonic() >= self._collect_garbage_at:
            self._collect_garbage_at = time.monotonic() + GARBAGE_SECONDS
            self._garbage.collect()
        if time.monotonic() >= self._release_at:
            self._release_at = time.monotonic() + RELEASE_SECONDS
            release_free_memory()

    def _run_as_leader(self, is_beat: bool) -> None:
        """Run the tasks of which one process of all servers is enough. Another leader's transactions fail."""
        store = self._services.store
        with self._lead.fenced():
            store.tokens.end_expired()
            store.channels.apply_due_moves(datetime.now(UTC))
            store.channels.advance_rollouts(datetime.now(UTC), next_step)
            store.overlays.end_due(datetime.now(UTC))
            store.search_index.refresh(SEARCH_BATCH)
            store.robot_counts.join()
            if is_beat:
                store.versions.remove_expired_dry_runs()
                store.drafts.remove_expired()
                store.sessions.sweep()
                self._services.jobs.sweep()
            if datetime.now(UTC) >= self._collect_at:
                self._collect_daily()
            self._continue_thinning()

    def _collect_daily(self) -> None:
        """Collect garbage, while no backup runs, unless a process has done so within a day."""
        store, last = self._services.store, self._services.store.garbage.last_run()
        if last is not None and timedelta(0) <= store.now() - last < COLLECT_EVERY:
            self._collect_at = last + COLLECT_EVERY
            return
        if not self._content.try_acquire():
            return
        self._collect_at = datetime.now(UTC) + COLLECT_PAUSE
        try:
            store.wrong_tokens.sweep(timedelta(seconds=WINDOW_SECONDS))
            with self._content.fenced():
                store.garbage.collect(COLLECT_GRACE)
                self._thinning = self._thin(last)
                store.search_index.merge()
        finally:
            self._content.release()

    def _thin(self, last: datetime | None) -> Iterator[None]:
        """Apply the rule of retention, in small steps; the content goes with the next collection.

        last: time of the collection before. After a long pause, or a leap of the clock, versions stay for another day:
        so a clock that is wrong for hours thins nothing.
        """
        rule, store = self._services.options.retention, self._services.store
        if rule is None:
            return
        if last is None or not timedelta(0) <= store.now() - last <= MAX_PAUSE:
            log.warning("retention: no daily run within %d days before: versions stay for now", MAX_PAUSE.days)
            return
        for plan in store.retention.plan(rule, writable_formats()):
            versions = files = 0
            try:
                for removed in store.retention.apply(plan, rule):
                    versions += len(removed.versions)
                    files += removed.files
                    yield
            except (LeadLostError, NoRoom, DatabaseDamaged):
                raise
            except Unavailable as error:
                log.warning(
                    "retention: interrupted until tomorrow (environment=%s): %s", plan.environment, error.detail
                )
                yield
            if versions or files:
                log.info("retention: environment=%s versions=%d files=%d", plan.environment, versions, files)

    def _continue_thinning(self) -> None:
        """Thin for a short time, so that planned moves of channels are not late."""
        end = time.monotonic() + THIN_SECONDS
        for _ in self._thinning:
            if time.monotonic() > end:
                break


def _note_time(newest: datetime) -> datetime:
    """Return the current time; log a warning if the clock was set back."""
    now = datetime.now(UTC)
    if newest - now > CLOCK_TOLERANCE:
        log.warning(
            "clock: set back by %d s; expired tokens and links stay expired, replace those that expired too early",
            (newest - now).total_seconds(),
        )
    return now
