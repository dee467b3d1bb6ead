"""Work that may take long: asked for by many, done once, and after a while followed as a job."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

from fastapi import APIRouter
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from app.api import problems
from app.api.access import Principal, Viewer
from app.api.answers import Route, answer, path_of
from app.api.schemas import JobOut, JobPath, told
from app.api.services import Here
from app.convert import Maps, Recipe
from app.convert.cache import Made
from app.errors import Denied, FleetMapError, Unavailable
from app.store import Store
from app.store.values import Job, rfc3339

log = logging.getLogger(__name__)

AT_ONCE = 32
WAITING = 256
BEAT_SECONDS = 5.0
LOST_AFTER = timedelta(seconds=60)
"""A job that nobody has touched for this long belonged to a process that is no more."""


@dataclass(frozen=True, slots=True)
class Started:
    """The map takes longer than an answer may: follow this job."""

    job: Job


@dataclass(slots=True)
class _Running:
    future: asyncio.Future[Made]
    jobs: dict[str, str]  # principal's id -> job id


class Work:
    """Maps being made in this process, by recipe."""

    def __init__(self, store: Store, maps: Maps, seconds: float, count: Callable[[str, str], None]) -> None:
        self._store, self._maps, self._seconds, self._count = store, maps, seconds, count
        self._running: dict[str, _Running] = {}
        self._threads = ThreadPoolExecutor(AT_ONCE, thread_name_prefix="fleetmap-make")
        self._tasks: set[asyncio.Task[None]] = set()

    async def make(self, recipe: Recipe, who: Principal, address: str) -> Made | Started:
        """The map, or after ``seconds`` the job that will end with it. address: where the finished map is had.

        Raises what making raises; Unavailable where too much is being made.
        """
        running = self._running.get(recipe.key)
        if running is None:
            if len(self._running) >= AT_ONCE + WAITING:
                raise Unavailable("too many maps are being made: try again in a few seconds")
            future = asyncio.get_running_loop().run_in_executor(self._threads, self._maps.make, recipe)
            running = self._running[recipe.key] = _Running(future, {})
            future.add_done_callback(lambda done: self._finished(recipe, done))
        done, _ = await asyncio.wait({running.future}, timeout=self._seconds)
        if done:
            return running.future.result()
        known = running.jobs.get(who.id)
        if known is not None:
            return Started(await run_in_threadpool(self._store.job, known))
        return Started(await self._as_job(recipe, running, who, address))

    def beat(self) -> None:
        """Show that the jobs of this process are alive. Blocks."""
        for running in list(self._running.values()):
            for job in list(running.jobs.values()):
                self._touch(job)

    def close(self) -> None:
        """Let threads end; what is being made ends with the pool."""
        self._threads.shutdown(wait=False, cancel_futures=True)

    async def _as_job(self, recipe: Recipe, running: _Running, who: Principal, address: str) -> Job:
        what = f"{recipe.format.name} of {recipe.version.environment}, version {recipe.version.number}"

        def begin() -> Job:
            job = self._store.create_job(who.id, f"making {what}")
            return self._store.update_job(job.id, state="running")

        job = await run_in_threadpool(begin)
        running.jobs[who.id] = job.id

        async def follow() -> None:
            await asyncio.wait({running.future})
            if not running.future.cancelled():
                await run_in_threadpool(self._end, job.id, running.future.exception(), what, address)

        task = asyncio.create_task(follow())
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return job

    def _end(self, job: str, error: BaseException | None, what: str, address: str) -> None:
        try:
            if self._store.job(job).state == "cancelled":
                return
            if error is None:
                detail = f"made {what}"
                self._store.update_job(job, state="done", progress=1.0, detail=detail, result={"location": address})
            else:
                self._store.update_job(job, state="failed", detail=f"could not make {what}", problem=_problem(error))
        except FleetMapError as other:
            log.warning("a job's end could not be noted: %s", other.detail)

    def _touch(self, job: str) -> None:
        try:
            if self._store.job(job).state == "running":
                self._store.update_job(job, state="running")
        except FleetMapError as error:
            log.warning("a job could not be kept alive: %s", error.detail)

    def _finished(self, recipe: Recipe, done: asyncio.Future[Made]) -> None:
        self._running.pop(recipe.key, None)
        if done.cancelled() or done.exception() is not None:
            self._count(recipe.format.name, "failed")
        elif done.result().fresh:  # else another request or process had just made it
            self._count(recipe.format.name, "made")


def _problem(error: BaseException) -> dict[str, Any]:
    if isinstance(error, FleetMapError):
        return problems.as_document(error)
    log.error("internal error in a job: %s", problems.describe(error))
    return problems.document(500, "the server made a mistake; its log says where", title="Internal error")


def as_dict(job: Job) -> dict[str, Any]:
    """The job in the contract's words; one whose process is gone has failed."""
    state, problem, detail = job.state, job.problem, job.detail
    if state in ("queued", "running") and datetime.now(UTC) - job.updated > LOST_AFTER:
        state, detail = "failed", "the server was restarted"
        problem = problems.document(503, "the server was restarted while it worked on this: ask for it again")
    out: dict[str, Any] = {"id": job.id, "state": state, "progress": job.progress, "detail": detail}
    if job.result is not None:
        out["result"] = dict(job.result)
    if problem is not None:
        out["problem"] = dict(problem)
    return {**out, "created": rfc3339(job.created), "updated": rfc3339(job.updated)}


def started(job: Job) -> Response:
    """The answer 202 of a call that became a job."""
    return answer(as_dict(job), 202, {"location": path_of("jobs", job.id), "retry-after": "2"})


router = APIRouter(prefix="/jobs", tags=["jobs"], route_class=Route)


def _mine(here: Here, who: Principal, id: str) -> Job:
    job = here.store.job(id)
    if job.owner != who.id and who.role != "admin":
        raise Denied("this job was started with another token")
    return job


@router.get("/{id}", responses=told(JobOut, 404), summary="How far a job is")
def get_job(id: JobPath, here: Here, who: Viewer) -> Response:
    """A job of the own token; administrators see all. ``result.location`` is where a finished map is had."""
    return answer(as_dict(_mine(here, who, id)))


@router.delete("/{id}", status_code=204, responses=told(None, 404), summary="Cancel or forget a job")
def delete_job(id: JobPath, here: Here, who: Viewer) -> Response:
    """Cancels a job that runs (what is half made is kept for the next one who asks); forgets one that has ended."""
    job = _mine(here, who, id)
    if as_dict(job)["state"] in ("queued", "running"):
        here.store.update_job(id, state="cancelled", detail="cancelled")
    else:
        here.store.delete_job(id)
    return Response(status_code=204)
