"""Running conversions: shared by concurrent requests, and continued as jobs if they take long."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from app.api.http import problems
from app.api.http.auth import Principal
from app.api.http.responses import api_path, json_response
from app.convert.cache import CachedMap
from app.convert.maps import Maps
from app.convert.recipe import Recipe
from app.errors import FleetMapError, NoRoom, Unavailable
from app.pool import CancelHandle, Cancelled
from app.store.store import Store
from app.store.values import Job, rfc3339

log = logging.getLogger(__name__)

MAX_CONCURRENT_CONVERSIONS = 32
MAX_QUEUED_CONVERSIONS = 256
HEARTBEAT_SECONDS = 5.0
LOST_AFTER = timedelta(seconds=60)
"""Age of the last heartbeat after which a job counts as lost, because its process has ended."""


@dataclass(frozen=True, slots=True)
class JobStarted:
    """Outcome of a conversion that outlives its request: the job to follow."""

    job: Job


@dataclass(slots=True)
class _RunningConversion:
    """Conversion in progress. waiters: number of waiting requests. jobs: principal id -> job id."""

    future: asyncio.Future[tuple[Recipe, CachedMap]]
    stop: CancelHandle
    waiters: int = 0
    jobs: dict[str, str] = field(default_factory=dict)


class ConversionJobs:
    """Running conversions of this process by recipe, and their jobs."""

    def __init__(self, store: Store, maps: Maps, seconds: float, count: Callable[[str, str], None]) -> None:
        self._store, self._maps, self._seconds, self._count = store, maps, seconds, count
        self._running: dict[str, _RunningConversion] = {}
        self._lock = threading.Lock()
        self._threads = ThreadPoolExecutor(MAX_CONCURRENT_CONVERSIONS, thread_name_prefix="fleetmap-make")
        self._tasks: set[asyncio.Task[None]] = set()

    async def get_or_start(
        self, recipe: Recipe, principal: Principal, address: str
    ) -> tuple[Recipe, CachedMap] | JobStarted:
        """Return the map with the recipe that was used, or, after the time limit, the job that converts it.

        address: URL of the finished map.

        Raises the errors of the conversion; Unavailable if too many conversions are queued.
        """
        with self._lock:  # short critical section: a new waiter prevents cancellation
            running = self._running.get(recipe.key)
            if running is None:
                if len(self._running) >= MAX_CONCURRENT_CONVERSIONS + MAX_QUEUED_CONVERSIONS:
                    raise Unavailable("too many conversions are waiting: try again in a few seconds")
                running = self._start(recipe)
            running.waiters += 1
        try:
            done, _ = await asyncio.wait({running.future}, timeout=self._seconds)
            if done:
                return running.future.result()
            job_id = running.jobs.get(principal.id)
            if job_id is not None:
                return JobStarted(await run_in_threadpool(self._store.jobs.get, job_id))
            try:
                return JobStarted(await self._as_job(recipe, running, principal, address))
            except NoRoom:  # a job cannot be stored: wait for the map
                return await asyncio.shield(running.future)
        finally:
            with self._lock:
                running.waiters -= 1

    async def convert(
        self, plan: Callable[[], Recipe], principal: Principal, address: str
    ) -> tuple[Recipe, CachedMap] | JobStarted:
        """Return a planned map from the cache or a conversion, or the job that converts it for ``address``."""
        recipe = await run_in_threadpool(plan)
        cached_map = await run_in_threadpool(self._maps.get_cached, recipe)
        if cached_map is not None:
            return recipe, cached_map
        return await self.get_or_start(recipe, principal, address)

    def cancel(self, job: str) -> bool:
        """Stop the conversion of a job unless others wait for it. Returns False if it runs in another process."""
        with self._lock:
            for key, running in self._running.items():
                owner = next((principal_id for principal_id, job_id in running.jobs.items() if job_id == job), None)
                if owner is None:
                    continue
                del running.jobs[owner]
                if not running.jobs and not running.waiters:
                    running.stop()
                    del self._running[key]  # later requests start a new conversion
                return True
        return False

    def _start(self, recipe: Recipe) -> _RunningConversion:
        stop = CancelHandle()
        future = asyncio.get_running_loop().run_in_executor(self._threads, self._maps.get_or_convert, recipe, stop)
        running = self._running[recipe.key] = _RunningConversion(future, stop)
        future.add_done_callback(lambda _: self._on_done(recipe, running))
        return running

    def send_heartbeats(self) -> None:
        """Update the heartbeats of this process's jobs, and stop those cancelled by other processes. Blocks."""
        with self._lock:
            jobs = [job for running in self._running.values() for job in running.jobs.values()]
        for job in jobs:
            self._touch(job)

    def close(self) -> None:
        """Release the threads; running conversions end with the pool."""
        self._threads.shutdown(wait=False, cancel_futures=True)

    async def _as_job(self, recipe: Recipe, running: _RunningConversion, principal: Principal, address: str) -> Job:
        label = f"{recipe.format.name} of {recipe.version.environment}, version {recipe.version.number}"

        def begin() -> Job:
            job = self._store.jobs.create(principal.id, f"converting {label}")
            return self._store.jobs.update(job.id, state="running")

        job = await run_in_threadpool(begin)
        running.jobs[principal.id] = job.id

        async def follow() -> None:
            await asyncio.wait({running.future})
            if not running.future.cancelled():
                await run_in_threadpool(self._finish_job, job.id, running.future.exception(), label, address)

        task = asyncio.create_task(follow())
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return job

    def _finish_job(self, job: str, error: BaseException | None, label: str, address: str) -> None:
        try:
            if self._store.jobs.get(job).state == "cancelled":
                return
            if error is None:
                detail = f"converted {label}"
                self._store.jobs.update(job, state="done", progress=1.0, detail=detail, result={"location": address})
            else:
                self._store.jobs.update(
                    job, state="failed", detail=f"could not convert {label}", problem=_problem(error)
                )
        except FleetMapError as other:
            log.warning("conversions: storing the outcome of a job failed: %s", other.detail)

    def _touch(self, job: str) -> None:
        try:
            state = self._store.jobs.get(job).state
            if state == "running":
                self._store.jobs.update(job, state="running")
            elif state == "cancelled":  # by another process of the server
                self.cancel(job)
        except FleetMapError as error:
            log.warning("conversions: updating the heartbeat of a job failed: %s", error.detail)

    def _on_done(self, recipe: Recipe, running: _RunningConversion) -> None:
        with self._lock:
            if self._running.get(recipe.key) is running:
                del self._running[recipe.key]
        done = running.future
        if done.cancelled() or isinstance(done.exception(), Cancelled):
            self._count(recipe.format.name, "cancelled")
        elif done.exception() is not None:
            self._count(recipe.format.name, "failed")
        elif done.result()[1].fresh:  # otherwise another request or process converted it meanwhile
            self._count(recipe.format.name, "made")


def _problem(error: BaseException) -> dict[str, Any]:
    if isinstance(error, FleetMapError):
        return problems.as_document(error)
    log.error("conversions: internal error in a job: %s", problems.describe(error))
    return problems.document(500, "internal server error; details are in the server log", title="Internal error")


def job_as_json(job: Job) -> dict[str, Any]:
    """Convert a job to JSON. A job whose process has ended counts as failed."""
    state, problem, detail = job.state, job.problem, job.detail
    if state in ("queued", "running") and datetime.now(UTC) - job.updated > LOST_AFTER:
        state, detail = "failed", "the server was restarted"
        problem = problems.document(503, "the server restarted during the conversion: repeat the request")
    out: dict[str, Any] = {"id": job.id, "state": state, "progress": job.progress, "detail": detail}
    if job.result is not None:
        out["result"] = dict(job.result)
    if problem is not None:
        out["problem"] = dict(problem)
    return {**out, "created": rfc3339(job.created), "updated": rfc3339(job.updated)}


def job_started_response(job: Job) -> Response:
    """Build the 202 response for a request that became a job."""
    return json_response(job_as_json(job), 202, {"location": api_path("jobs", job.id), "retry-after": "2"})
