"""Pool of worker processes for parsing and conversion, with limits on memory and time; a crash fails only one job.

Untrusted files are parsed here, never in the server's own process. Workers are forked from a process that has only
imported their modules: a worker that dies or exceeds its time is replaced within milliseconds, and all share that
memory. The server itself is never forked, since it has native threads. Workers end with it.
"""

from __future__ import annotations

import contextlib
import importlib
import logging
import multiprocessing
import os
import queue
import resource
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from multiprocessing import forkserver
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

from app import answers, progress
from app.errors import FleetMapError, TooLarge, Unavailable
from app.heap import release_free_memory
from app.progress import Progress
from app.sandbox import SandboxPolicy, confine

log = logging.getLogger(__name__)

_processes = multiprocessing.get_context("forkserver")

PRELOADED_MODULES = ("app.ingest.prepare", "app.convert.warm")
"""Modules that the server's worker processes import before their first job."""

FORK_SERVER_TRIES, FORK_SERVER_SECONDS = 40, 0.05

IDLE_SECONDS = 1.0
"""Seconds without a job after which a worker returns its free memory to the system."""

CANCEL_POLL_SECONDS = 0.2
"""Seconds between two checks of a queued job for its cancellation."""


def preload_in_background(warm: tuple[str, ...] = PRELOADED_MODULES) -> None:
    """Start the process that workers are forked from, without waiting for its imports."""
    _processes.set_forkserver_preload(list(warm))
    forkserver.ensure_running()


class WorkerDied(FleetMapError):
    """The job ended its process (a crash, or out of memory) or exceeded its time."""


class Cancelled(Unavailable):
    """The job was cancelled because its result is no longer needed."""


@dataclass(frozen=True, slots=True)
class _Worker:
    process: BaseProcess
    pipe: Connection


class CancelHandle:
    """Cancels one job from another thread: kills its process, or prevents its start. progress: as last reported."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process: BaseProcess | None = None
        self._part = (0.0, 1.0)
        self.is_cancelled = False
        self.progress = Progress()

    def __call__(self) -> None:
        """Cancel the job; it raises Cancelled unless it has just finished."""
        with self._lock:
            self.is_cancelled = True
            if self._process is not None:
                _kill(self._process)

    def check(self) -> None:
        """Raise Cancelled if the job was cancelled."""
        if self.is_cancelled:
            raise Cancelled("the conversion was cancelled: request it again")

    @contextlib.contextmanager
    def part(self, start: float, end: float) -> Iterator[None]:
        """Have calls of workers inside be a part of the whole, from one fraction of it to another. Raises Cancelled."""
        self.check()
        outer = self._part
        width = outer[1] - outer[0]
        self._part = (outer[0] + width * start, outer[0] + width * end)
        try:
            yield
        finally:
            self._part = outer

    def note(self, progress: Progress) -> None:
        """Note the progress of the present call. It never decreases, though another way may have to be tried."""
        start, end = self._part
        self.progress = Progress(max(self.progress.fraction, start + (end - start) * progress.fraction), progress.step)

    def attach(self, process: BaseProcess | None) -> None:
        """Set the process that runs the job (None: none any more). Raises Cancelled if the job was cancelled."""
        with self._lock:
            self._process = process
            self.check()


class Pool:
    """Pool of at most ``workers`` concurrent and ``waiting`` queued jobs; rejects further jobs with Unavailable.

    memory_bytes: address space of a worker. seconds: time limit of a job. warm: modules that a worker imports before
    its first job. allowed: permissions of a worker besides computing and reading; None: everything. environment:
    variables that a worker has besides those of this process.
    """

    def __init__(
        self,
        workers: int = 2,
        *,
        memory_bytes: int = 8 * 2**30,
        seconds: float = 300.0,
        waiting: int = 64,
        warm: tuple[str, ...] = (),
        allowed: SandboxPolicy | None = None,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self._environment = dict(environment or {})
        self._memory_bytes, self._seconds, self._warm, self._allowed = memory_bytes, seconds, warm, allowed
        self._slots = threading.BoundedSemaphore(workers + waiting)
        self._idle: queue.LifoQueue[_Worker | None] = queue.LifoQueue()
        self._workers: dict[int, _Worker] = {}
        self._lock = threading.Lock()
        self._closed = False
        for _ in range(workers):
            self._idle.put(None)  # started on first use
        self._count = workers
        if warm:
            _processes.set_forkserver_preload(list(warm))

    @property
    def is_busy(self) -> bool:
        """Whether a further job would have to wait."""
        return self._idle.empty()

    def start(self) -> None:
        """Start all idle workers now, so that the first job does not wait for their imports; blocks until they run.

        A worker that cannot be started is tried again when it is needed.
        """
        idle: list[_Worker | None] = []
        with contextlib.suppress(queue.Empty):
            while len(idle) < self._count:
                idle.append(self._idle.get_nowait())
        for taken in idle:
            worker = taken
            try:
                worker = taken or self._start_worker()
            except FleetMapError as error:
                log.warning("pool: starting a worker failed, will retry (reason=%s)", error.detail)
            finally:
                self._idle.put(worker)

    def run(
        self, function: Callable[..., Any], *args: Any, seconds: float | None = None, stop: CancelHandle | None = None
    ) -> Any:
        """Call a module-level function in a worker and return its result; blocks, so call it from a thread.

        Raises the errors of the function, WorkerDied if the process ended or exceeded its time, Unavailable if too many
        jobs are waiting, Cancelled after ``stop`` was called.
        """
        if not self._slots.acquire(blocking=False):
            raise Unavailable("too many conversions are waiting: try again in a few seconds")
        try:
            worker, healthy = self._turn(stop), False
            try:
                if self._closed:
                    raise Unavailable("the server is stopping")
                if worker is not None and not worker.process.is_alive():  # ended by others, for example for its memory
                    self._stop_worker(worker)
                    worker = None
                worker = worker or self._start_worker()
                if stop is not None:
                    stop.attach(worker.process)
                try:
                    limit, note = self._seconds if seconds is None else seconds, None if stop is None else stop.note
                    ok, value = _call_worker(worker, function, args, limit, note)
                finally:
                    if stop is not None:
                        stop.attach(None)  # raise Cancelled rather than WorkerDied
                healthy = True
            finally:
                healthy = healthy and not self._closed
                if not healthy:
                    self._stop_worker(worker)
                self._idle.put(worker if healthy else None)
        finally:
            self._slots.release()
        if ok:
            return value
        raise value if isinstance(value, FleetMapError) else RuntimeError(value)

    def _turn(self, stop: CancelHandle | None) -> _Worker | None:
        """Wait for a worker; None: the caller must start one."""
        if stop is None:
            return self._idle.get()
        while True:
            stop.check()
            with contextlib.suppress(queue.Empty):
                return self._idle.get(timeout=CANCEL_POLL_SECONDS)

    def close(self) -> None:
        """End all workers.

        Closes only the pipes of idle workers; the thread that uses a busy worker closes its pipe. If another thread
        closed it, its file descriptor could already belong to another file.
        """
        with self._lock:
            self._closed = True
            workers = list(self._workers.values())
        for worker in workers:
            _kill(worker.process)
        for _ in range(self._count):
            with contextlib.suppress(queue.Empty):
                self._stop_worker(self._idle.get_nowait())
                self._idle.put_nowait(None)  # wake threads that wait for a worker
        for worker in workers:
            worker.process.join(5.0)

    def _start_worker(self) -> _Worker:
        try:
            ours, theirs = _processes.Pipe()
        except OSError as error:
            raise Unavailable("the system limit of open files is reached: try again in a few seconds") from error
        arguments = (theirs, {**os.environ, **self._environment}, self._memory_bytes, self._warm, self._allowed)
        process = _processes.Process(target=_work, args=arguments, daemon=True, name="fleetmap-worker")
        try:
            _start(process)
        except (OSError, EOFError) as error:
            ours.close()
            log.warning("pool: cannot start a worker (reason=%s)", error)
            raise Unavailable("the system cannot start another process: try again in a few seconds") from error
        finally:
            theirs.close()
        worker = _Worker(process, ours)
        with self._lock:
            self._workers[id(worker)] = worker
            closed = self._closed
        if closed:  # close() did not see it
            self._stop_worker(worker)
            raise Unavailable("the server is stopping")
        return worker

    def _stop_worker(self, worker: _Worker | None) -> None:
        if worker is None:
            return
        with self._lock:
            self._workers.pop(id(worker), None)
        _kill(worker.process)
        worker.process.join(5.0)
        worker.pipe.close()


def _start(process: BaseProcess) -> None:
    """Start a process. If the fork server has just ended, multiprocessing starts another one once it notices."""
    for left in reversed(range(FORK_SERVER_TRIES)):
        try:
            process.start()
            break
        except (EOFError, ConnectionError):
            if not left:
                raise
            time.sleep(FORK_SERVER_SECONDS)


def _kill(process: BaseProcess) -> None:
    """Kill a worker. It is no child of this process: after it ended, its PID may belong to another process."""
    if process.is_alive():
        process.kill()


def _call_worker(
    worker: _Worker,
    function: Callable[..., Any],
    args: tuple[Any, ...],
    seconds: float,
    note: Callable[[Progress], None] | None,
) -> tuple[bool, Any]:
    """Run the function in a worker. Returns whether it returned, and its result or exception. note: gets progress."""
    end = time.monotonic() + seconds
    try:
        worker.pipe.send((function.__module__, function.__qualname__, args))
        while True:
            if not worker.pipe.poll(max(0.0, end - time.monotonic())):
                raise WorkerDied(f"the time limit of {seconds:g} seconds was exceeded")
            ok, value = answers.loads(worker.pipe.recv_bytes())
            if ok is not None:
                break
            if note is not None:
                note(Progress(*value))
    except (EOFError, OSError) as error:
        worker.process.join(1.0)
        code = worker.process.exitcode
        raise WorkerDied(f"a worker process died (exit code {code}): the input may be damaged or too large") from error
    return ok, value


def _work(
    pipe: Connection,
    environment: dict[str, str],
    memory_bytes: int,
    warm: tuple[str, ...],
    allowed: SandboxPolicy | None,
) -> None:
    """Run jobs in a worker until the parent closes the pipe or dies."""
    os.environ.clear()  # the fork server may have been started with other settings
    os.environ.update(environment)
    if allowed is not None:
        confine(allowed)  # before any thread starts: existing threads would not be confined
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    if memory_bytes:
        resource.setrlimit(resource.RLIMIT_AS, (memory_bytes, memory_bytes))
    threading.Thread(target=_die_with_parent, daemon=True).start()
    for name in warm:
        importlib.import_module(name)

    def send(answer: tuple[bool | None, Any]) -> None:
        pipe.send_bytes(answers.dumps(answer))

    while True:
        try:
            if not pipe.poll(IDLE_SECONDS):
                release_free_memory()
            module, function, args = pipe.recv()
        except (EOFError, OSError):
            return
        try:
            target: Any = importlib.import_module(module)
            for part in function.split("."):
                target = getattr(target, part)
            with progress.sent_to(lambda one: send((None, (one.fraction, one.step)))):
                answer = (True, target(*args))
        except MemoryError:
            answer = (False, _no_memory())
        except FleetMapError as error:
            answer = (False, _as_ours(error))
        except Exception as error:  # noqa: BLE001  a bug: send the parent its traceback, for the log
            trace = "".join(traceback.format_exception(error))
            answer = (False, f"{type(error).__name__} in a worker\n{trace}")
        try:
            send(answer)
        except (OSError, BrokenPipeError):
            return
        except MemoryError:
            answer = (False, None)  # release the result before anything else is allocated
            with contextlib.suppress(OSError):
                send((False, _no_memory()))
        except Exception as error:  # noqa: BLE001  a result that cannot be pickled is a bug, too
            with contextlib.suppress(OSError):
                send((False, f"sending a worker's result failed: {error}"))


def _as_ours(error: FleetMapError) -> FleetMapError:
    """Return an error as one of app: the server does not read classes of plug-ins."""
    if type(error).__module__.startswith("app."):
        return error
    ours: type[FleetMapError] = next(kind for kind in type(error).__mro__ if kind.__module__.startswith("app."))
    return ours(error.detail, error.problems)


def _no_memory() -> TooLarge:
    return TooLarge("processing needs more memory than an upload may use")


def _die_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
    os._exit(1)
