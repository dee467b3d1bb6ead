"""Running conversions: shared by concurrent requests, and continued as jobs if they take long."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import threading
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from typing import Annotated, Any

from fastapi import Header
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from app.api.http import problems
from app.api.http.auth import Principal
from app.api.http.responses import api_path, commit_response, json_response
from app.api.http.shared_work import NoWorkersError, SharedWork
from app.backends.queue import LocalQueue, QueueFigures, Task, Urgency
from app.convert.cache import CachedMap
from app.convert.maps import Maps
from app.convert.recipe import Recipe
from app.errors import FleetMapError, NoRoom, Unavailable
from app.ingest import CommitResult
from app.pool import CancelHandle, Cancelled
from app.progress import Progress
from app.store.store import Store
from app.store.values import Job, rfc3339

log = logging.getLogger(__name__)

MAX_CONCURRENT_CONVERSIONS = 32
MAX_AWAITED_CONVERSIONS = 128
"""Maximum number of concurrent conversions, if workers of all servers make most of them: a thread only waits."""

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
    """Conversion in progress. waiters: number of waiting requests. jobs: principal id -> job id. creating: its locks.

    shared: job that waits for a worker of all servers, if one makes the map. noted: the progress that its jobs show.
    """

    recipe: Recipe
    task: Task
    outcome: Future[tuple[Recipe, CachedMap]]
    future: asyncio.Future[tuple[Recipe, CachedMap]]
    stop: CancelHandle = field(default_factory=CancelHandle)
    waiters: int = 0
    jobs: dict[str, str] = field(default_factory=dict)
    creating: dict[str, asyncio.Lock] = field(default_factory=dict)
    shared: Job | None = None
    noted: Progress = field(default_factory=Progress)


class ConversionJobs:
    """Running conversions of this process by recipe, and their jobs.

    work: the workers of all servers, if there may be some. is_busy: whether this server's own processes are.
    """

    def __init__(
        self,
        store: Store,
        maps: Maps,
        seconds: float,
        count: Callable[[str, str], None],
        *,
        work: SharedWork | None = None,
        is_busy: Callable[[], bool] = lambda: False,
    ) -> None:
        self._store, self._maps, self._seconds, self._count = store, maps, seconds, count
        self._work, self._is_busy = work, is_busy
        self._running: dict[str, _RunningConversion] = {}
        self._begun: dict[str, _RunningConversion] = {}
        self._numbers = itertools.count()
        self._lock = threading.Lock()
        threads = MAX_CONCURRENT_CONVERSIONS if work is None else MAX_AWAITED_CONVERSIONS
        self._queue = LocalQueue(self, threads=threads, waiting=MAX_QUEUED_CONVERSIONS)
        self._tasks: set[asyncio.Task[None]] = set()

    async def get_or_start(
        self, recipe: Recipe, principal: Principal, address: str
    ) -> tuple[Recipe, CachedMap] | JobStarted:
        """Return the map with the recipe that was used, or, after the time limit, the job that converts it.

        address: URL of the finished map.

        Raises the errors of the conversion; Unavailable if too many conversions are queued.
        """
        urgency: Urgency = "robot" if principal.role == "robot" or principal.robot is not None else "person"
        with self._lock:  # short critical section: a new waiter prevents cancellation
            running = self._running.get(recipe.key)
            hurries = running is not None and urgency == "robot" and running.task.urgency == "person"
            if running is None:
                running = self._start(recipe, urgency)
            running.waiters += 1
        try:
            if hurries:
                await run_in_threadpool(self._hurry, running)
            done, _ = await asyncio.wait({running.future}, timeout=self._seconds)
            if done:
                return running.future.result()
            try:
                async with running.creating.setdefault(principal.id, asyncio.Lock()):  # one job for all its requests
                    job_id = running.jobs.get(principal.id)
                    if job_id is not None:
                        return JobStarted(await run_in_threadpool(self._store.jobs.get, job_id))
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

    def cancel(self, job: str) -> None:
        """Stop the conversion of a job unless others wait for it. Another process that runs it notices soon."""
        with self._lock:
            for key, running in self._running.items():
                owner = next((principal_id for principal_id, job_id in running.jobs.items() if job_id == job), None)
                if owner is None:
                    continue
                del running.jobs[owner]
                if not running.jobs and not running.waiters:
                    running.stop()
                    del self._running[key]  # later requests start a new conversion
                break
        if self._work is not None:
            self._work.cancel(job)

    def figures(self) -> QueueFigures:
        """Return the state of the queue of all servers, or of this process."""
        return self._queue.figures() if self._work is None else self._work.figures()

    def perform(self, task: Task) -> None:
        """Convert the map of a task in this thread, or wait until a worker has."""
        running = self._begun.pop(task.key)
        if not running.outcome.set_running_or_notify_cancel():
            return
        try:
            running.outcome.set_result(self._convert(running))
        except BaseException as error:  # noqa: BLE001  for who waits
            running.outcome.set_exception(error)

    def stop(self, task: Task) -> None:
        """Stop the conversion of a task."""
        running = self._begun.get(task.key)
        if running is not None:
            running.stop()

    def _start(self, recipe: Recipe, urgency: Urgency) -> _RunningConversion:
        """Start a conversion. Raises Unavailable if too many wait."""
        key = f"{recipe.key} {next(self._numbers)}"  # a cancelled conversion of it may still be running
        task = Task("convert", key, recipe.version.environment, urgency)
        outcome: Future[tuple[Recipe, CachedMap]] = Future()
        running = self._begun[key] = _RunningConversion(recipe, task, outcome, asyncio.wrap_future(outcome))
        try:
            self._queue.submit(task)
        except Unavailable:
            del self._begun[key]
            raise
        self._running[recipe.key] = running
        running.future.add_done_callback(lambda _: self._on_done(recipe, running))
        return running

    def _hurry(self, running: _RunningConversion) -> None:
        """Make a waiting conversion as urgent as a robot that waits for it."""
        running.task = replace(running.task, urgency="robot")
        with contextlib.suppress(Unavailable):
            if running.shared is not None and self._work is not None:
                self._work.hurry(running.recipe)
            elif running.task.key in self._begun:
                self._queue.submit(running.task)

    def _convert(self, running: _RunningConversion) -> tuple[Recipe, CachedMap]:
        recipe, work = running.recipe, self._work
        while work is not None and self._is_shared(recipe, work):
            job = running.shared = work.submit_conversion(recipe, running.task.urgency, f"converting {_label(recipe)}")
            try:
                finished = work.finish_conversion(job, recipe, running.stop)
                if finished is not None:
                    return finished
                running.shared = None
                break
            except Cancelled:
                if running.stop.is_cancelled:
                    work.abandon(job)
                    raise
                if not running.waiters:
                    raise  # a client of another server cancelled it
            except NoWorkersError:
                running.shared = None
                work.withdraw(job)
        return self._maps.get_or_convert(recipe, running.stop)

    def _is_shared(self, recipe: Recipe, work: SharedWork) -> bool:
        """Decide whether a worker makes a map.

        A map without derivations takes about as long as the queue: a free process of this server makes it. All others
        are worth it even for a robot: the queue makes a map once, however many servers are asked for it.
        """
        if recipe.order is None or recipe.compared is not None or not (recipe.is_derived or self._is_busy()):
            return False
        return self._maps.cache.get_or_fetch(recipe.key) is None and work.has_workers()

    def send_heartbeats(self) -> None:
        """Update the heartbeats of this process's jobs, and stop those cancelled by other processes. Blocks."""
        with self._lock:
            jobs = [job for running in self._running.values() for job in running.jobs.values()]
        for job in jobs:
            self._touch(job)

    def store_progress(self) -> None:
        """Store how far this process's conversions are, if that has changed, and stop cancelled ones. Blocks."""
        with self._lock:
            changed = [
                running
                for running in self._running.values()
                if running.jobs and running.shared is None and running.noted != running.stop.progress
            ]
        for running in changed:
            running.noted, jobs = running.stop.progress, list(running.jobs.values())
            try:
                active = self._store.jobs.note_progress(jobs, running.noted)
                for job in jobs:
                    if job not in active and self._store.jobs.get(job).state == "cancelled":
                        self.cancel(job)  # by another process of the server
            except FleetMapError as error:
                log.warning("conversions: storing the progress of a job failed: %s", error.detail)

    def sweep(self) -> None:
        """Fail jobs of all servers whose task is lost, and delete old ones. For one server of all. Blocks."""
        if self._work is not None:
            self._work.sweep()

    def close(self) -> None:
        """Release the threads; running conversions end with the pool."""
        if self._work is not None:
            self._work.close()
        self._queue.close()
        for running in list(self._begun.values()):
            running.outcome.cancel()

    async def _as_job(self, recipe: Recipe, running: _RunningConversion, principal: Principal, address: str) -> Job:
        label, shared = _label(recipe), running.shared

        def begin() -> Job:
            if shared is not None and self._store.jobs.claim(shared.id, principal.id, address):
                return self._store.jobs.get(shared.id)
            task = None if shared is None else shared.task
            job = self._store.jobs.create(
                principal.id, f"converting {label}", task=task, location=None if task is None else address
            )
            return self._store.jobs.update(job.id, state="running")

        job = await run_in_threadpool(begin)
        running.jobs[principal.id] = job.id

        async def follow() -> None:
            await asyncio.wait({running.future})
            if not running.future.cancelled() and running.shared is None:  # else the worker does
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


def _label(recipe: Recipe) -> str:
    return f"{recipe.format.name} of {recipe.version.environment}, version {recipe.version.number}"


def _problem(error: BaseException) -> dict[str, Any]:
    if isinstance(error, FleetMapError):
        return problems.as_document(error)
    log.error("conversions: internal error in a job: %s", problems.describe(error))
    return problems.document(500, "internal server error; details are in the server log", title="Internal error")


def job_as_json(job: Job) -> dict[str, Any]:
    """Convert a job to JSON. A job whose process has ended counts as failed."""
    state, problem, detail = job.state, job.problem, job.detail
    if job.task is None and state in ("queued", "running") and datetime.now(UTC) - job.updated > LOST_AFTER:
        state, detail = "failed", "the server was restarted"
        problem = problems.document(503, "the server restarted during the conversion: repeat the request")
    out: dict[str, Any] = {"id": job.id, "state": state, "progress": job.progress, "detail": detail}
    if job.step and state == "running":
        out["step"] = job.step
    if job.result is not None:
        out["result"] = dict(job.result)
    if problem is not None:
        out["problem"] = dict(problem)
    return {**out, "created": rfc3339(job.created), "updated": rfc3339(job.updated)}


def job_started_response(job: Job) -> Response:
    """Build the 202 response for a request that became a job."""
    return json_response(job_as_json(job), 202, {"location": api_path("jobs", job.id), "retry-after": "2"})


Prefer = Annotated[
    str | None,
    Header(
        max_length=200,
        description="`respond-async` (RFC 7240): return 202 and a job at once if a worker makes the change. Without "
        "workers the response comes when it is made.",
    ),
]

STARTED: dict[int | str, dict[str, Any]] = {
    202: {"description": "A worker makes the change: follow the job at `Location`; its result is the version."}
}


def responds_async(prefer: str | None) -> bool:
    """Return whether a Prefer header asks not to wait."""
    return prefer is not None and "respond-async" in {part.strip().lower() for part in prefer.split(",")}


def work_response(outcome: CommitResult | Job) -> Response:
    """Build the response for a change that a worker made, or for its job."""
    if isinstance(outcome, CommitResult):
        return commit_response(outcome)
    started = job_started_response(outcome)
    started.headers["preference-applied"] = "respond-async"
    return started
