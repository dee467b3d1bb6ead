"""Queue: tasks that take long, in the order of their urgency and fairly between environments.

Local: threads of this process, each of which waits for a process of its pool. Shared: a table in PostgreSQL, from which
the workers of all servers take tasks (``app.backends.shared_queue``).

Order: what a robot waits for comes before what people started. Within each of the two, environments take turns: a task
gets the tag after the last one of its environment, but none before the first that waits, and the smallest tag is next.
So many tasks of one environment delay another one's by one task each, and none waits for ever.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from time import monotonic
from typing import Any, Final, Literal, Protocol

from app import traces
from app.errors import Unavailable

Urgency = Literal["robot", "person"]
"""Who waits for a task."""

FAILURES: Final = "worker_failures"
"""Name among a task's arguments of the number of failures."""

MAX_FAILURES: Final = 3
"""Number of failures that the next worker may do better, such as a full disk; a further one is the task's outcome."""

FULL = "too many conversions are waiting: try again in a few seconds"


@dataclass(frozen=True, slots=True)
class Task:
    """Task, described by values that any server can carry out: names, numbers and hashes, never content.

    kind: what to do. key: hash of its result; of tasks with equal keys one is carried out at a time. arguments: JSON.
    """

    kind: str
    key: str
    environment: str
    urgency: Urgency = "person"
    arguments: Mapping[str, Any] = field(default_factory=dict)

    @property
    def failures(self) -> int:
        """Number of attempts that failed."""
        return int(self.arguments.get(FAILURES, 0))


@dataclass(frozen=True, slots=True)
class QueueFigures:
    """State of a queue. waiting: number of tasks by urgency. oldest: seconds that the longest waiting task has waited.

    workers: number of live workers that take tasks.
    """

    waiting: Mapping[Urgency, int]
    running: int
    oldest: float
    workers: int


class Performer(Protocol):
    """What carries out tasks. Thread-safe."""

    def perform(self, task: Task) -> None:
        """Carry out a task and store its outcome; blocks. A task may come again: after its worker died."""

    def stop(self, task: Task) -> None:
        """Make ``perform`` of this task end soon, or not begin."""


class Queue(Protocol):
    """Queue of tasks. Thread-safe."""

    def submit(self, task: Task) -> None:
        """Add a task, unless one with its key waits; that becomes as urgent as this. Raises Unavailable if full."""

    def cancel(self, key: str) -> None:
        """Stop the task with this key, or remove it if it waits."""

    def figures(self) -> QueueFigures:
        """Return the state of the queue."""


def with_parent(task: Task) -> Task:
    """Return the task with the current span, so that its own is within it wherever it is carried out."""
    span = traces.parent()
    return replace(task, arguments={**task.arguments, "trace": span}) if span else task


def carry_out(performer: Performer, task: Task) -> None:
    """Perform a task in a span of its own."""
    span = str(task.arguments.get("trace", ""))
    with traces.task_span(f"task {task.kind}", span, environment=task.environment, urgency=task.urgency):
        performer.perform(task)


@dataclass(slots=True)
class _Entry:
    task: Task
    urgency: Urgency
    tag: int
    number: int
    since: float


class LocalQueue:
    """Queue of one process: ``threads`` tasks run at once, ``waiting`` of each urgency may wait."""

    def __init__(self, performer: Performer, *, threads: int, waiting: int) -> None:
        self._performer, self._count, self._limit = performer, threads, waiting
        self._threads = ThreadPoolExecutor(threads, thread_name_prefix="fleetmap-make")
        self._lock = threading.Lock()
        self._waiting: dict[str, _Entry] = {}
        self._running: list[_Entry] = []
        self._number = 0

    def submit(self, task: Task) -> None:
        """Add a task, unless one with its key waits; that becomes as urgent as this. Raises Unavailable if full."""
        task = with_parent(task)
        with self._lock:
            present = self._waiting.get(task.key)
            if present is not None and (present.urgency == "robot" or task.urgency == "person"):
                return
            waiting = [entry for entry in self._waiting.values() if entry.urgency == task.urgency]
            if len(waiting) >= self._limit + max(0, self._count - len(self._running)):
                raise Unavailable(FULL)
            tag = _next_tag(task, waiting, [e for e in self._running if e.urgency == task.urgency])
            self._number += 1
            self._waiting[task.key] = _Entry(task, task.urgency, tag, self._number, monotonic())
            if present is None:
                self._threads.submit(self._run_next)

    def cancel(self, key: str) -> None:
        """Stop the task with this key, or remove it if it waits."""
        with self._lock:
            entries = [*self._running, *self._waiting.values()]
            tasks = [entry.task for entry in entries if entry.task.key == key]
        for task in tasks:
            self._performer.stop(task)

    def figures(self) -> QueueFigures:
        """Return the state of the queue."""
        with self._lock:
            entries, running = list(self._waiting.values()), len(self._running)
        people = sum(entry.urgency == "person" for entry in entries)
        oldest = max((monotonic() - entry.since for entry in entries), default=0.0)
        return QueueFigures({"robot": len(entries) - people, "person": people}, running, oldest, self._count)

    def close(self) -> None:
        """Release the threads; running tasks end with their pool."""
        self._threads.shutdown(wait=False, cancel_futures=True)

    def _run_next(self) -> None:
        with self._lock:
            entry = min(self._waiting.values(), key=lambda e: (e.urgency == "person", e.tag, e.number))
            del self._waiting[entry.task.key]
            self._running.append(entry)
        try:
            carry_out(self._performer, entry.task)
        finally:
            with self._lock:
                self._running.remove(entry)


def _next_tag(task: Task, waiting: Iterable[_Entry], running: Iterable[_Entry]) -> int:
    """Return a new task's tag among the entries of its urgency."""
    waiting = list(waiting)
    first = min((entry.tag for entry in waiting), default=0)
    tags = [entry.tag for entry in (*waiting, *running) if entry.task.environment == task.environment]
    return max([first, *(tag + 1 for tag in tags)])
