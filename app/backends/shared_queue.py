"""Queue of all servers on one PostgreSQL database, in the tables of Procrastinate.

Servers add and cancel tasks in plain transactions; ``QueueWorker`` runs Procrastinate's worker. A task's priority there
is its urgency and its tag (see ``app.backends.queue``). Of two tasks with one key, one waits while the other runs, and
then finds the result made.

A worker that dies leaves its tasks marked as running. The others see its heartbeat end and put the tasks back. It may
only have stood still: what it then stores, and the end of its task, count no more.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from typing import Any, Final

import procrastinate
from procrastinate import exceptions, jobs
from procrastinate.connector import Notify
from procrastinate.manager import JobManager
from procrastinate.worker import Worker
from psycopg.conninfo import make_conninfo
from sqlalchemy import Connection, Row, text
from sqlalchemy.engine import make_url
from sqlalchemy.exc import IntegrityError, SQLAlchemyError

from app.backends.fence import LIMIT_IDLE_TIME, FenceError, fenced_by
from app.backends.queue import (
    FAILURES,
    FULL,
    MAX_FAILURES,
    Performer,
    QueueFigures,
    Task,
    Urgency,
    carry_out,
    with_parent,
)
from app.errors import FleetMapError, Unavailable

log = logging.getLogger(__name__)

TASK: Final = "fleetmap"
"""Name of Procrastinate's task that carries out all of ours."""

HEARTBEAT_SECONDS: Final = 2.0
STALLED_SECONDS: Final = 8.0
"""Seconds without a heartbeat after which a worker counts as dead, and its tasks are put back."""

POLL_SECONDS: Final = 1.0
"""Interval at which workers look for tasks and cancellations, should a notification be lost."""

GRACE_SECONDS: Final = 20.0
"""Seconds that a worker has for its running tasks when it stops; then it gives them back."""

MAX_DEATHS: Final = 3
"""Number of workers that may die of a task before it fails. One that stops and gives it back is none of them."""

DEATHS: Final = "worker_deaths"
"""Name among a task's arguments of the number of workers that died of it."""

RETRY_SECONDS: Final = 1.0

_TOP: Final[dict[Urgency, int]] = {"robot": 2_000_000_000, "person": 1_000_000_000}
"""Priority of the tag 0; larger tags have lower priorities."""

_TAGS = text(
    "SELECT count(*) FILTER (WHERE status = 'todo') AS waiting,"
    " :top - max(priority) FILTER (WHERE status = 'todo') AS first,"
    " :top - min(priority) FILTER (WHERE args ->> 'environment' = :environment) AS own"
    " FROM procrastinate_jobs WHERE queue_name = :queue AND status IN ('todo', 'doing')"
)
_RAISE = text(
    "UPDATE procrastinate_jobs SET priority = greatest(priority, :priority),"
    " queue_name = CASE WHEN priority < :priority THEN :queue ELSE queue_name END"
    " WHERE queueing_lock = :key AND status = 'todo' RETURNING id"
)
_DEFER = text(
    "SELECT procrastinate_defer_jobs_v1(ARRAY[ROW(:queue, :name, :priority, :key, :key, CAST(:args AS jsonb), NULL)"
    "::procrastinate_job_to_defer_v1])"
)
_CANCEL = text(
    "SELECT procrastinate_cancel_job_v1(id, true, true) FROM procrastinate_jobs"
    " WHERE lock = :key AND status IN ('todo', 'doing')"
)
_FIGURES = text(
    "SELECT queue_name, status::text AS status, count(*) AS number, extract(epoch FROM now() - min(event.at)) AS oldest"
    " FROM procrastinate_jobs job LEFT JOIN procrastinate_events event"
    " ON event.job_id = job.id AND event.type = 'deferred'"
    " WHERE status IN ('todo', 'doing') GROUP BY queue_name, status"
)
_WORKERS = text(
    "SELECT count(*) FROM procrastinate_workers WHERE last_heartbeat > now() - make_interval(secs => :seconds)"
)
_RUNNING: Final = (
    "SELECT job.id, job.args, job.attempts, job.abort_requested OR EXISTS (SELECT 1 FROM procrastinate_jobs other"
    " WHERE other.queueing_lock = job.queueing_lock AND other.status = 'todo') AS is_needless"
    " FROM procrastinate_jobs job WHERE job.status = 'doing'"
)
"""Running tasks. is_needless: whether a task was cancelled, or another one with its key waits."""

_STALLED = text(
    _RUNNING + " AND NOT EXISTS (SELECT 1 FROM procrastinate_workers worker"  # noqa: S608  constants
    " WHERE worker.id = job.worker_id AND worker.last_heartbeat > now() - make_interval(secs => :seconds))"
    " FOR UPDATE OF job SKIP LOCKED"
)
_OF_ATTEMPT = text(_RUNNING + " AND job.id = :id AND job.attempts = :attempts FOR UPDATE OF job")
_CHECK = text(
    f"SELECT {LIMIT_IDLE_TIME} FROM procrastinate_jobs"  # noqa: S608  constants
    " WHERE id = :id AND attempts = :attempts AND status = 'doing' FOR SHARE"
)
_COUNT = text(
    "UPDATE procrastinate_jobs SET args = jsonb_set(args, ARRAY['arguments', CAST(:what AS text)],"
    " to_jsonb(coalesce((args #>> ARRAY['arguments', CAST(:what AS text)])::int, 0) + 1)) WHERE id = :id"
)
"""Counts among a task's arguments, where workers of other releases do not mind it."""

_RETRY = text("SELECT procrastinate_retry_job_v2(:id, now() + make_interval(secs => :seconds), NULL, NULL, NULL)")
_REMOVE = text("SELECT procrastinate_finish_job_v1(:id, 'failed', true)")
_SWEEP = text("DELETE FROM procrastinate_jobs WHERE NOT (status IN ('todo', 'doing'))")

Transaction = Callable[[], AbstractContextManager[Connection]]


class TaskLostError(FenceError):
    """The worker no longer has the task: it was taken for dead, and another one may have it."""


@dataclass(frozen=True, slots=True)
class Attempt:
    """A worker's right to a task, until it ends it or is taken for dead. id: of the task. number: of earlier ones."""

    id: int
    number: int

    def check(self, connection: Connection) -> None:
        """Check within a transaction that the worker has the task still, and until the commit. Raises TaskLostError."""
        if connection.execute(_CHECK, {"id": self.id, "attempts": self.number}).first() is None:
            raise TaskLostError("another worker has taken over the task: nothing was stored")


class SharedQueue:
    """Queue of all servers. transaction: begins one in their database. waiting: how many tasks of each urgency may."""

    def __init__(self, transaction: Transaction, *, waiting: int) -> None:
        self._transaction, self._limit = transaction, waiting

    def submit(self, task: Task) -> None:
        """Add a task, unless one with its key waits; that becomes as urgent as this. Raises Unavailable if full."""
        try:
            self._submit(task)
        except IntegrityError:  # another server was first: its task may be less urgent
            with contextlib.suppress(IntegrityError):
                self._submit(task)

    def _submit(self, task: Task) -> None:
        top = _TOP[task.urgency]
        with self._transaction() as connection:
            values = {"top": top, "environment": task.environment, "queue": task.urgency}
            row = connection.execute(_TAGS, values).one()
            tag = max(row.first or 0, 0 if row.own is None else row.own + 1)
            values = {"queue": task.urgency, "priority": top - tag, "key": task.key}
            if connection.execute(_RAISE, values).first() is not None:
                return
            if row.waiting >= self._limit:
                raise Unavailable(FULL)
            connection.execute(_DEFER, {**values, "name": TASK, "args": json.dumps(_as_arguments(with_parent(task)))})

    def cancel(self, key: str) -> None:
        """Stop the task with this key, or remove it if it waits."""
        with self._transaction() as connection:
            connection.execute(_CANCEL, {"key": key})

    def figures(self) -> QueueFigures:
        """Return the state of the queue."""
        with self._transaction() as connection:
            rows = connection.execute(_FIGURES).all()
            workers = connection.execute(_WORKERS, {"seconds": STALLED_SECONDS}).scalar_one()
        waiting: dict[Urgency, int] = {"robot": 0, "person": 0}
        waiting |= {row.queue_name: row.number for row in rows if row.status == "todo"}
        running = sum(row.number for row in rows if row.status == "doing")
        oldest = max((float(row.oldest or 0) for row in rows if row.status == "todo"), default=0.0)
        return QueueFigures(waiting, running, oldest, workers)

    def finish(self, attempt: Attempt) -> bool:
        """Remove a task. Returns False, and does nothing, if the worker no longer has it."""
        with self._transaction() as connection:
            row = _row_of(connection, attempt)
            if row is not None:
                connection.execute(_REMOVE, {"id": row.id})
            return row is not None

    def give_back(self, attempt: Attempt, seconds: float, *, failed: bool = False) -> bool:
        """Let a task wait again, for some seconds at least. Returns False if the worker no longer has it.

        failed: whether that counts as one of the task's failures.
        """
        with self._transaction() as connection:
            row = _row_of(connection, attempt)
            if row is not None:
                if failed:
                    connection.execute(_COUNT, {"id": row.id, "what": FAILURES})
                connection.execute(_REMOVE if row.is_needless else _RETRY, {"id": row.id, "seconds": seconds})
            return row is not None

    def put_back_stalled(self) -> list[Task]:
        """Put back the tasks of dead workers. Returns those that too many workers died of, which are removed."""
        given_up = []
        with self._transaction() as connection:
            for row in connection.execute(_STALLED, {"seconds": STALLED_SECONDS}).all():
                task = _as_task(row.args)
                if row.is_needless:
                    connection.execute(_REMOVE, {"id": row.id})
                elif int(task.arguments.get(DEATHS, 0)) + 1 >= MAX_DEATHS:
                    connection.execute(_REMOVE, {"id": row.id})
                    given_up.append(task)
                else:
                    log.warning("queue: a worker died, its task is put back (key=%s)", task.key[:16])
                    connection.execute(_COUNT, {"id": row.id, "what": DEATHS})
                    connection.execute(_RETRY, {"id": row.id, "seconds": 0})
            connection.execute(_SWEEP)
        return given_up


def _row_of(connection: Connection, attempt: Attempt) -> Row[Any] | None:
    """Lock the row of an attempt and return it; None if the worker no longer has the task."""
    return connection.execute(_OF_ATTEMPT, {"id": attempt.id, "attempts": attempt.number}).one_or_none()


def _as_arguments(task: Task) -> dict[str, Any]:
    return {
        "kind": task.kind,
        "key": task.key,
        "environment": task.environment,
        "urgency": task.urgency,
        "arguments": dict(task.arguments),
    }


def _as_task(arguments: dict[str, Any]) -> Task:
    return Task(**arguments)


class _GiveBack(procrastinate.BaseRetryStrategy):
    """Gives a task back that a stopping worker did not finish, or whose outcome could not be stored.

    failed: ids of tasks whose attempt failed, for who ends it.
    """

    def __init__(self, failed: set[int]) -> None:
        self._failed = failed

    def get_retry_decision(self, *, exception: BaseException, job: jobs.Job) -> procrastinate.RetryDecision | None:
        """Decide whether and when the task is tried again."""
        if isinstance(exception, asyncio.CancelledError | exceptions.JobAborted):
            return procrastinate.RetryDecision(retry_in={"seconds": 0})
        if isinstance(exception, FleetMapError) and _as_task(job.task_kwargs).failures < MAX_FAILURES:
            assert job.id is not None
            self._failed.add(job.id)
            return procrastinate.RetryDecision(retry_in={"seconds": 2})
        return None


class _JobManager(JobManager):
    """Ends the attempt of a task that the worker made. Procrastinate would end a later one of another worker, too.

    It would also leave a task that it could not end running for ever, since its worker is alive: here it tries again.
    """

    def __init__(
        self, connector: procrastinate.BaseConnector, queue: SharedQueue, is_stopping: Callable[[], bool]
    ) -> None:
        super().__init__(connector)
        self._queue, self._is_stopping = queue, is_stopping
        self.failed: set[int] = set()

    async def finish_job(self, job: jobs.Job, status: jobs.Status, delete_job: bool) -> None:
        """Remove a task, whatever its status: its outcome is stored already."""
        del status, delete_job
        await self._end(job, self._queue.finish)

    async def retry_job(
        self,
        job: jobs.Job,
        retry_at: datetime | None = None,
        priority: int | None = None,
        queue: str | None = None,
        lock: str | None = None,
    ) -> None:
        """Give a task back."""
        del priority, queue, lock
        seconds = 0.0 if retry_at is None else max(0.0, (retry_at - datetime.now(UTC)).total_seconds())
        failed = job.id in self.failed
        self.failed -= {job.id}
        await self._end(job, partial(self._queue.give_back, seconds=seconds, failed=failed))

    async def _end(self, job: jobs.Job, end: Callable[[Attempt], bool]) -> None:
        """End an attempt, as soon as the database can be had. A worker that stops leaves that to the others."""
        key, is_logged = (job.lock or "")[:16], False
        while True:
            try:
                is_ended = await asyncio.to_thread(end, _attempt(job))
            except (FleetMapError, SQLAlchemyError) as error:
                if not is_logged:  # once for each task
                    reason = error.detail if isinstance(error, FleetMapError) else type(error).__name__
                    log.warning("queue: a task could not be ended, will retry (key=%s, reason=%s)", key, reason)
                is_logged = True
                if self._is_stopping():
                    return
                await asyncio.sleep(RETRY_SECONDS)
            else:
                if not is_ended:
                    text = "queue: this worker was taken for dead, what it made too late is thrown away (key=%s)"
                    log.warning(text, key)
                return


def _attempt(job: jobs.Job) -> Attempt:
    assert job.id is not None
    return Attempt(job.id, job.attempts)


class _Connector(procrastinate.PsycopgConnector):
    """Connections of a worker. Procrastinate listens for new tasks on one, and would never again once it is lost."""

    async def listen_notify(self, on_notification: Notify, channels: Iterable[str]) -> None:
        """Listen until cancelled, also after the connection was lost."""
        names, outage = list(channels), False
        while True:
            start = time.monotonic()
            try:
                await super().listen_notify(on_notification, names)
            except exceptions.ConnectorException as error:
                outage = outage and time.monotonic() - start < STALLED_SECONDS
                if not outage:  # once for each
                    reason = (str(error.__cause__ or error).splitlines() or [type(error).__name__])[0]
                    log.warning("worker: not notified of new tasks, polls meanwhile and will retry (reason=%s)", reason)
                outage = True
                await asyncio.sleep(RETRY_SECONDS)


async def _beat(manager: JobManager, worker: Worker) -> None:
    """Send heartbeats as long as a worker has tasks. Procrastinate ends its own when it begins to stop."""
    while True:
        await asyncio.sleep(HEARTBEAT_SECONDS)
        if worker.worker_id is not None:
            with contextlib.suppress(exceptions.ConnectorException):  # the next one may arrive
                await manager.update_heartbeat(worker.worker_id)


class QueueWorker:
    """Takes tasks from the queue, ``slots`` at once.

    url: database URL that reaches PostgreSQL itself, not a pooler of transactions. give_up: called for a task that too
    many workers died of.
    """

    def __init__(
        self, url: str, queue: SharedQueue, performer: Performer, give_up: Callable[[Task], None], *, slots: int
    ) -> None:
        self._url, self._queue, self._performer, self._give_up, self._slots = url, queue, performer, give_up, slots
        self._threads = ThreadPoolExecutor(slots, thread_name_prefix="fleetmap-task")
        self._stopping = asyncio.Event()
        self._worker: Worker | None = None

    async def run(self) -> None:
        """Take tasks until ``stop``; lost connections are made again."""
        watch = asyncio.create_task(self._watch())
        try:
            while not self._stopping.is_set():
                try:
                    await self._run_connected()
                except Exception as error:  # noqa: BLE001  must survive a temporary loss of the database
                    reason = (str(error).splitlines() or [type(error).__name__])[0]
                    log.warning("worker: lost the queue, will retry (reason=%s)", reason)
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(self._stopping.wait(), RETRY_SECONDS)
        finally:
            watch.cancel()
            self._threads.shutdown(wait=False)

    def stop(self) -> None:
        """Stop: take no more tasks, finish the running ones or give them back."""
        self._stopping.set()
        if self._worker is not None:
            self._worker.stop()  # type: ignore[no-untyped-call]

    @property
    def is_connected(self) -> bool:
        """Whether it takes tasks."""
        return self._worker is not None and self._worker.worker_id is not None

    async def _run_connected(self) -> None:
        parsed = make_url(self._url).set(drivername="postgresql+psycopg")
        options: dict[str, Any] = dict(parsed.get_dialect()().create_connect_args(parsed)[1])
        options |= {"application_name": "fleetmap worker", "connect_timeout": 5, "keepalives_idle": 2}
        connector = _Connector(conninfo=make_conninfo(**options), min_size=1, max_size=self._slots + 4, timeout=10.0)
        queue_app = procrastinate.App(connector=connector)
        queue_app.job_manager = manager = _JobManager(connector, self._queue, self._stopping.is_set)
        queue_app.task(name=TASK, retry=_GiveBack(manager.failed), pass_context=True)(self._perform)
        async with queue_app.open_async():
            self._worker = Worker(
                queue_app,
                name=TASK,
                concurrency=self._slots,
                fetch_job_polling_interval=POLL_SECONDS,
                abort_job_polling_interval=POLL_SECONDS,
                shutdown_graceful_timeout=GRACE_SECONDS,
                delete_jobs="always",
                install_signal_handlers=False,
                update_heartbeat_interval=HEARTBEAT_SECONDS,
                stalled_worker_timeout=STALLED_SECONDS,
            )
            if self._stopping.is_set():
                return
            beating = asyncio.create_task(_beat(manager, self._worker))
            try:
                await self._worker.run()  # type: ignore[no-untyped-call]
            finally:
                beating.cancel()
                self._worker = None

    async def _perform(self, context: procrastinate.JobContext, /, **arguments: Any) -> None:
        """Carry out a task in a thread; if cancelled, end it and wait for that."""
        task, attempt = _as_task(arguments), _attempt(context.job)
        work = asyncio.get_running_loop().run_in_executor(self._threads, self._carry_out, task, attempt)
        try:
            await asyncio.shield(work)
        except asyncio.CancelledError:
            self._performer.stop(task)
            await asyncio.wait({work})
            raise

    def _carry_out(self, task: Task, attempt: Attempt) -> None:
        """Carry out a task; nothing of it is stored once the worker was taken for dead."""
        with fenced_by(attempt), contextlib.suppress(TaskLostError):  # what ends the task logs it
            carry_out(self._performer, task)

    async def _watch(self) -> None:
        """Put back the tasks of dead workers, every few seconds.

        While the database is away no worker's heartbeat reaches it. So each has time to send one before it is missed.
        """
        since = time.monotonic() - STALLED_SECONDS
        while True:
            await asyncio.sleep(HEARTBEAT_SECONDS)
            try:
                if time.monotonic() - since < STALLED_SECONDS:
                    await asyncio.to_thread(self._queue.figures)
                    continue
                for task in await asyncio.to_thread(self._queue.put_back_stalled):
                    await asyncio.to_thread(self._give_up, task)
            except FleetMapError as error:
                since = time.monotonic()
                log.warning("worker: looking for dead workers failed, will retry: %s", error.detail)
            except Exception as error:  # noqa: BLE001  must survive a temporary loss of the database
                since = time.monotonic()
                log.warning("worker: looking for dead workers failed, will retry: %s", type(error).__name__)
