"""Work that a server leaves to the workers of all servers, and waits for."""

from __future__ import annotations

import dataclasses
import secrets
import time
from datetime import timedelta
from typing import Any, Literal

from app.api.http import problems
from app.api.http.outcomes import LOST, commit_from_json, error_from_json
from app.backends.queue import QueueFigures, Task, Urgency
from app.backends.shared_queue import SharedQueue
from app.convert.cache import CachedMap
from app.convert.maps import Maps
from app.convert.recipe import Recipe
from app.derive import ChainFailure
from app.errors import CannotConvert, FleetMapError, Invalid, NotFound, Unavailable
from app.ingest import CommitRequest, CommitResult
from app.pool import CancelHandle, Cancelled
from app.store.audit import CALLER
from app.store.jobs import ACTIVE
from app.store.store import Store
from app.store.values import Job

WAIT_SECONDS = 0.05
"""Interval at which a waiting thread looks whether any server has committed: a number in memory."""

LOOK_SECONDS = 1.0
"""Interval at which it looks at its job in any case."""


LOST_AFTER = timedelta(seconds=30)
"""Age of a job whose task is not in the queue, after which it counts as lost."""


class NoWorkersError(FleetMapError):
    """No worker is alive: the server does the work itself."""


class SharedWork:
    """Server's side of the queue of all servers. Thread-safe."""

    def __init__(self, store: Store, queue: SharedQueue, maps: Maps) -> None:
        self._store, self._queue, self._maps = store, queue, maps
        self._workers = (0.0, 0)
        self._is_closed = False

    def close(self) -> None:
        """End all waiting; the workers go on."""
        self._is_closed = True

    def sweep(self) -> None:
        """Fail the jobs whose task is no longer in the queue, and delete old ones. For one server of all."""
        for task in self._store.jobs.lost_tasks(LOST_AFTER):
            self._store.jobs.finish_task(task, problem=problems.as_document(Unavailable(LOST)))
        self._store.jobs.sweep()

    def has_workers(self) -> bool:
        """Return whether any worker is alive; asks the database once a second."""
        until, count = self._workers
        if time.monotonic() > until:
            count = self._queue.figures().workers
            self._workers = time.monotonic() + LOOK_SECONDS, count
        return count > 0

    def figures(self) -> QueueFigures:
        """Return the state of the queue."""
        return self._queue.figures()

    def submit_conversion(self, recipe: Recipe, urgency: Urgency, detail: str) -> Job:
        """Submit a conversion; the job has no owner yet. Raises Unavailable if the queue is full."""
        return self._submit(_conversion(recipe, urgency), "", detail)

    def hurry(self, recipe: Recipe) -> None:
        """Make a conversion that waits as urgent as a robot that waits for it."""
        self._queue.submit(_conversion(recipe, "robot"))

    def finish_conversion(self, job: Job, recipe: Recipe, stop: CancelHandle) -> tuple[Recipe, CachedMap] | None:
        """Wait for a conversion and return its map; None if no worker could plan this recipe.

        Raises the errors of the conversion, NoWorkersError, and Cancelled after ``stop`` or if others cancelled it.
        """
        started = time.monotonic()
        job = self._wait(job.id, stop)
        if job.state == "failed":
            error = error_from_json(job.outcome)
            if isinstance(error, CannotConvert | NotFound | Invalid):
                self._maps.note_failure(recipe, error, time.monotonic() - started)
            raise error
        if job.state == "cancelled":
            raise Cancelled("the conversion was cancelled: request it again")
        failed = [ChainFailure(**one) for one in (job.outcome or {}).get("failed", ())]
        return self._maps.get_made(recipe, failed)

    def commit(
        self,
        kind: Literal["derive", "generate"],
        environment: str,
        request: Any,
        commit: CommitRequest,
        owner: str,
        *,
        wait: bool,
    ) -> CommitResult | Job:
        """Have a worker make a change, and return its result, or without ``wait`` its job. Raises its errors.

        request: a dataclass of JSON values. A worker that takes over from a dead one makes no second version.
        """
        key = secrets.token_hex(16)
        request_commit = (
            commit if commit.idempotency_key is not None else dataclasses.replace(commit, idempotency_key=key)
        )
        caller = CALLER.get()
        arguments = {
            "request": dataclasses.asdict(request),
            "commit": dataclasses.asdict(request_commit),
            "caller": None if caller is None else dataclasses.asdict(caller),
        }
        task = Task(kind, key, environment, "person", arguments)
        job = self._submit(task, owner, f"{kind}: {environment}", followed=not wait)
        if caller is not None:
            caller.recorded = True  # the worker records the change
        if not wait:
            return job
        job = self._wait(job.id, CancelHandle(), alone=True)
        if job.state == "cancelled":
            raise Cancelled("the work was cancelled: request it again")
        if job.state == "failed" or job.outcome is None:
            raise error_from_json(job.outcome)
        return commit_from_json(self._store, environment, job.outcome)

    def cancel(self, id: str) -> None:
        """Stop the task of a cancelled job unless another job waits for it."""
        try:
            task = self._store.jobs.get(id).task
        except NotFound:
            return
        if task is not None and not self._store.jobs.is_awaited(task):
            self._queue.cancel(task)

    def withdraw(self, job: Job) -> None:
        """Give a job's task up, since this server does the work itself."""
        self._store.jobs.detach(job.id)
        if job.task is not None and not self._store.jobs.is_awaited(job.task):
            self._queue.cancel(job.task)

    def abandon(self, job: Job) -> None:
        """Cancel a job that this server no longer waits for."""
        self._store.jobs.update(job.id, state="cancelled", detail="cancelled")
        self.cancel(job.id)

    def _submit(self, task: Task, owner: str, detail: str, *, followed: bool = False) -> Job:
        job = self._store.jobs.create(owner, detail, task=task.key, followed=followed)
        try:
            self._queue.submit(task)
        except FleetMapError:
            self._store.jobs.delete(job.id)
            raise
        return job

    def _wait(self, id: str, stop: CancelHandle, *, alone: bool = False) -> Job:
        """Wait until a job has ended. alone: this server cannot do the work itself, so wait for a worker."""
        seen, looked = None, 0.0
        while True:
            number = self._store.generation()
            if number != seen or time.monotonic() - looked > LOOK_SECONDS:
                seen, looked = number, time.monotonic()
                job = self._store.jobs.get(id)
                if job.state not in ACTIVE:
                    return job
                if not alone and not self.has_workers():
                    raise NoWorkersError("no worker is alive")
            stop.check()
            if self._is_closed:
                raise Unavailable("the server is stopping")
            time.sleep(WAIT_SECONDS)


def _conversion(recipe: Recipe, urgency: Urgency) -> Task:
    assert recipe.order is not None
    arguments = {"order": recipe.order.as_dict(), "failed": [dataclasses.asdict(one) for one in recipe.failed]}
    return Task("convert", recipe.key, recipe.version.environment, urgency, arguments)
