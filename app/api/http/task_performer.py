"""Worker's side of the queue of all servers: carries out tasks, and stores their outcomes for who waits."""

from __future__ import annotations

import dataclasses
import logging
import threading
from collections.abc import Callable, Mapping
from typing import Any

from app.api.http import problems
from app.api.http.outcomes import commit_as_json, error_as_json
from app.api.http.responses import api_path
from app.backends.fence import FenceError
from app.backends.queue import MAX_FAILURES, Task
from app.convert.maps import Maps
from app.convert.recipe import MapOrder
from app.derive import ChainFailure
from app.errors import FleetMapError, NoRoom, Unavailable
from app.ingest import CommitRequest, CommitResult, DerivationRequest, GenerationRequest, Ingest
from app.pool import CancelHandle, Cancelled
from app.progress import Progress
from app.store.audit import CALLER, Caller
from app.store.store import Store
from app.store.values import Version

log = logging.getLogger(__name__)

Done = tuple[Mapping[str, Any], str | None]
"""Outcome of a task for servers, and the address of what was made if only the worker knows it."""


class TaskPerformer:
    """Carries out the tasks of the queue with the services of a worker. Thread-safe."""

    def __init__(self, store: Store, maps: Maps, ingest: Ingest, count: Callable[[str, str], None]) -> None:
        self._store, self._maps, self._ingest, self._count = store, maps, ingest, count
        self._stops: dict[str, CancelHandle] = {}
        self._noted: dict[str, Progress] = {}
        self._lock = threading.Lock()
        self._kinds: Mapping[str, Callable[[Task, CancelHandle], Done]] = {
            "convert": self._convert,
            "derive": self._derive,
            "generate": self._generate,
        }

    def perform(self, task: Task) -> None:
        """Carry out a task and store its outcome; blocks. Raises Unavailable if another attempt may do better."""
        stop = CancelHandle()
        with self._lock:
            self._stops[task.key] = stop
        try:
            if not self._store.jobs.start_task(task.key):
                return  # cancelled, or made for another one with its key
            self._carry_out(task, stop)
        finally:
            with self._lock:
                self._stops.pop(task.key, None)
                self._noted.pop(task.key, None)

    def store_progress(self) -> None:
        """Store how far the running tasks are, if that has changed, and end those whose jobs were all cancelled."""
        with self._lock:
            stops = {key: stop for key, stop in self._stops.items() if self._noted.get(key) != stop.progress}
            self._noted |= {key: stop.progress for key, stop in stops.items()}
        for key, stop in stops.items():
            if stop.progress != Progress() and not self._store.jobs.note_task_progress(key, stop.progress):
                stop()

    def stop(self, task: Task) -> None:
        """End ``perform`` of this task."""
        with self._lock:
            stop = self._stops.get(task.key)
        if stop is not None:
            stop()

    def give_up(self, task: Task) -> None:
        """Fail a task that several workers died of."""
        log.error("worker: several workers died of a task (kind=%s, environment=%s)", task.kind, task.environment)
        lost = Unavailable("several workers died of this work: its input may be too large for them")
        self._fail(task, lost)

    def _carry_out(self, task: Task, stop: CancelHandle) -> None:
        try:
            carry_out = self._kinds.get(task.kind)
            if carry_out is None:
                raise Unavailable(f"the worker does not know {task.kind!r}: update it to the release of the servers")
            outcome, location = carry_out(task, stop)
        except Cancelled:
            self._store.jobs.release_task(task.key)  # unless all were cancelled, this worker stops
        except FenceError:
            raise  # another worker has the task already
        except Unavailable as error:
            # Another worker may have room. A change's client relies on its job: the database may be back soon.
            if task.failures < MAX_FAILURES and (task.kind != "convert" or isinstance(error, NoRoom)):
                raise
            self._fail(task, error)
        except Exception as error:  # noqa: BLE001  the outcome is for who waits
            self._fail(task, error)
        else:
            self._store.jobs.finish_task(task.key, outcome=outcome, location=location)

    def _fail(self, task: Task, error: Exception) -> None:
        if isinstance(error, FleetMapError):
            problem = problems.as_document(error)
        else:
            log.error("worker: internal error in a task: %s", problems.describe(error))
            text = "internal server error; details are in the worker's log"
            problem = problems.document(500, text, title="Internal error")
        self._store.jobs.finish_task(task.key, outcome=error_as_json(error), problem=problem)

    def _convert(self, task: Task, stop: CancelHandle) -> Done:
        order = MapOrder(**task.arguments["order"])
        failures = [ChainFailure(**one) for one in task.arguments["failed"]]
        recipe = self._maps.recipe(
            self._version(task.environment, order),
            order.format,
            order.values,
            derive=order.derive,
            file=order.file,
            listed=order.listed,
        )
        if recipe.key != task.key and failures:
            recipe = recipe.without(failures)
        if recipe.key == task.key or recipe.failed:
            recipe, cached_map = self._maps.get_or_convert(recipe, stop)
            if cached_map.fresh:
                self._count(order.format, "made")
        # Else the closures or the draft have changed meanwhile: who waits makes the map of then.
        return {"failed": [dataclasses.asdict(one) for one in recipe.failed]}, None

    def _version(self, environment: str, order: MapOrder) -> Version:
        if order.closures is None:
            return self._store.versions.get(environment, order.ref)
        return self._store.channels.target(environment, order.ref, order.closures)[0]

    def _derive(self, task: Task, stop: CancelHandle) -> Done:
        request = DerivationRequest(**task.arguments["request"])
        ingest = self._ingest.stopped_by(stop)
        return self._commit(task, lambda commit: ingest.derive(task.environment, request, commit))

    def _generate(self, task: Task, stop: CancelHandle) -> Done:
        request = GenerationRequest(**task.arguments["request"])
        ingest = self._ingest.stopped_by(stop)
        return self._commit(task, lambda commit: ingest.generate(task.environment, request, commit))

    def _commit(self, task: Task, carry_out: Callable[[CommitRequest], CommitResult]) -> Done:
        """Make a change in the name of its caller; a repeated one returns the version of the first."""
        caller = task.arguments["caller"]
        CALLER.set(None if caller is None else Caller(**{**caller, "recorded": False}))
        try:
            result = carry_out(CommitRequest(**task.arguments["commit"]))
        finally:
            CALLER.set(None)
        number = None if result.version is None else result.version.number
        location = None if number is None else api_path("environments", task.environment, "versions", number)
        return commit_as_json(result), location
