"""Worker processes: results, errors, crashes, timeouts, and their end with the parent."""

from __future__ import annotations

import os
import pickle
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from multiprocessing import forkserver
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app import answers, progress, sandbox
from app.errors import NotFound, Problem, TooLarge, Unavailable
from app.pool import CancelHandle, Cancelled, Pool, WorkerDied
from app.progress import Progress
from app.sandbox import SandboxPolicy
from app.store.changes import KEEP


def work_double(x: int) -> int:
    return 2 * x


def work_refuse() -> None:
    raise NotFound("nothing here", [Problem("gone", "a.yaml", 3)])


def work_bug() -> None:
    {}["missing"]


def work_crash() -> None:
    os.kill(os.getpid(), signal.SIGSEGV)


def work_sleep(seconds: float) -> int:
    time.sleep(seconds)
    return os.getpid()


def work_write(path: str, text: str) -> str:
    Path(path).write_text(text)
    return Path(path).read_text()


def work_call(port: int) -> str:
    with socket.create_connection(("127.0.0.1", port), timeout=60) as s:
        return str(s.getpeername()[1])


def work_execute() -> bytes:
    return subprocess.run(["/bin/true"], check=True, capture_output=True).stdout


def work_eat() -> int:
    return len(bytearray(64 * 2**30))


class _Call:
    """Result that calls a function where it is read."""

    def __init__(self, function: Any, *args: object) -> None:
        self.call = function, args

    def __reduce__(self) -> Any:
        return self.call


def work_call_back(name: str, folder: str) -> _Call:
    """Answer as a worker that a hostile file has taken over."""
    calls = {
        "program": _Call(os.system, f"touch {folder}/made"),
        "builtin": _Call(eval, f"open({folder + '/made'!r}, 'w')"),
        "function of app": _Call(sandbox.landlock_version),
        "class of app": _Call(Pool, 1),
    }
    answers.dumps = lambda value: memoryview(pickle.dumps(value))
    return calls[name]


class PluginError(NotFound):
    """Error of a distribution that the server need not know."""


def work_refuse_as_plugin() -> None:
    raise PluginError("nothing here", [Problem("gone", "a.yaml", 3)])


VALUES = [
    *(None, True, 2**70, 1.5, "é", b"x", [1], (2,), {"a": {3}}, frozenset({4}), bytearray(b"y"), 1j),
    *(datetime(2026, 1, 2, tzinfo=UTC), timedelta(seconds=3), np.float64(0.5), KEEP, Problem("gone", line=3)),
]


def work_values() -> list[object]:
    return VALUES


def work_steps() -> int:
    progress.report(0.0, "reading")
    with progress.within(0.2, 0.6):
        progress.report(0.5, "first")
        progress.report(0.6, "first")  # too soon after the report before
        with progress.within(0.5, 1.0):
            progress.report(0.5, "second")
    progress.report(0.9, "storing")
    return 7


def work_unsendable() -> Any:
    return np.broadcast_to(np.uint8(0), 64 * 2**30)


def work_function() -> Any:
    return [sandbox.landlock_version]


@pytest.fixture
def pool() -> Iterator[Pool]:
    new_pool = Pool(1, memory_bytes=4 * 2**30, seconds=20.0, waiting=1)
    yield new_pool
    new_pool.close()


def test_pool_returns_a_result(pool: Pool) -> None:
    assert pool.run(work_double, 21) == 42


def test_worker_errors_keep_their_class_and_locations(pool: Pool) -> None:
    with pytest.raises(NotFound) as caught:
        pool.run(work_refuse)
    assert caught.value.problems == (Problem("gone", "a.yaml", 3),)


def test_bug_in_a_worker_is_reported_with_its_traceback(pool: Pool) -> None:
    with pytest.raises(RuntimeError, match="KeyError in a worker"):
        pool.run(work_bug)


@pytest.mark.parametrize("name", ["program", "builtin", "function of app", "class of app"])
def test_answer_of_a_worker_calls_nothing(pool: Pool, tmp_path: Path, name: str) -> None:
    with pytest.raises(pickle.UnpicklingError, match="no type of values"):
        pool.run(work_call_back, name, str(tmp_path))
    assert list(tmp_path.iterdir()) == []
    assert pool.run(work_double, 1) == 2


def test_result_that_is_no_value_is_a_bug(pool: Pool) -> None:
    with pytest.raises(RuntimeError, match=r"sending a worker's result failed: .*function, which is no type of values"):
        pool.run(work_function)
    assert pool.run(work_double, 1) == 2


def test_values_return_from_a_worker(pool: Pool) -> None:
    assert pool.run(work_values) == VALUES
    array = pool.run(np.arange, 5)
    assert (array.dtype, array.tolist()) == (np.arange(5).dtype, [0, 1, 2, 3, 4])


def test_errors_of_plugins_return_as_errors_of_app(pool: Pool) -> None:
    with pytest.raises(NotFound, match="nothing here") as caught:
        pool.run(work_refuse_as_plugin)
    assert (type(caught.value), caught.value.problems) == (NotFound, (Problem("gone", "a.yaml", 3),))


def test_crash_fails_one_job_and_worker_is_replaced(pool: Pool) -> None:
    with pytest.raises(WorkerDied, match="may be damaged or too large"):
        pool.run(work_crash)
    assert pool.run(work_double, 1) == 2


def test_ended_worker_is_not_killed(pool: Pool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its PID may belong to another process by then."""
    pool.run(work_double, 1)
    killed: list[int | None] = []
    (worker,) = pool._workers.values()
    monkeypatch.setattr(type(worker.process), "kill", lambda process: killed.append(process.pid))
    stop = CancelHandle()
    stop.attach(worker.process)
    assert worker.process.pid is not None
    os.kill(worker.process.pid, signal.SIGKILL)
    worker.process.join(60)
    stop()
    assert pool.run(work_double, 1) == 2, "the next job gets a new worker"
    assert killed == []


def test_start_does_not_wait_for_busy_workers() -> None:
    """Nor does it keep the others from jobs meanwhile."""
    pool = Pool(2, seconds=60.0)
    try:
        with ThreadPoolExecutor(1) as thread:
            stop = CancelHandle()
            job = thread.submit(pool.run, work_sleep, 60.0, stop=stop)
            while not pool._workers:
                time.sleep(0.01)
            pool.start()
            assert not job.done()
            assert pool.run(work_double, 1) == 2
            stop()
            assert isinstance(job.exception(60), Cancelled)
    finally:
        pool.close()


def test_timeout_kills_the_job_and_worker_is_replaced(pool: Pool) -> None:
    pool.run(work_double, 1)
    start = time.monotonic()
    with pytest.raises(WorkerDied, match=r"time limit of 0\.3 seconds"):
        pool.run(work_sleep, 60.0, seconds=0.3)
    assert time.monotonic() - start < 60
    assert pool.run(work_double, 1) == 2


def test_progress_of_a_worker_reaches_who_waits(pool: Pool, monkeypatch: pytest.MonkeyPatch) -> None:
    notes: list[Progress] = []
    note = CancelHandle.note
    monkeypatch.setattr(CancelHandle, "note", lambda self, one: (note(self, one), notes.append(self.progress))[0])
    handle = CancelHandle()
    assert pool.run(work_steps, stop=handle) == 7
    assert [(round(one.fraction, 9), one.step) for one in notes] == [
        (0.0, "reading"), (0.4, "first"), (0.5, "second"), (0.9, "storing"),
    ]  # fmt: skip
    notes.clear()
    assert pool.run(work_steps, stop=handle) == 7
    assert {one.fraction for one in notes} == {0.9}, "it does not go back when another way is tried"
    other = CancelHandle()
    with other.part(0.5, 1.0):
        pool.run(work_steps, stop=other)
    assert other.progress == Progress(0.95, "storing")
    assert pool.run(work_steps) == 7, "without a handle nobody is told"


def test_cancel_stops_running_and_waiting_jobs(pool: Pool) -> None:
    pool.run(work_double, 1)
    stops = CancelHandle(), CancelHandle()
    errors: list[BaseException] = []

    def run(stop: CancelHandle) -> None:
        try:
            pool.run(work_sleep, 60.0, stop=stop)
        except Cancelled as error:
            errors.append(error)

    threads = [threading.Thread(target=run, args=(stop,)) for stop in stops]
    for thread in threads:
        thread.start()
        time.sleep(0.3)  # one runs, the other waits
    for stop, thread in reversed(list(zip(stops, threads, strict=True))):
        stop()
        thread.join(60)
        assert not thread.is_alive()
    assert len(errors) == 2
    with pytest.raises(Cancelled):
        pool.run(work_double, 1, stop=stops[0])
    late = CancelHandle()
    assert pool.run(work_double, 21, stop=late) == 42
    late()  # its worker runs other jobs by now
    assert pool.run(work_double, 1) == 2


def test_memory_limit_fails_the_job_and_worker_survives(pool: Pool) -> None:
    with pytest.raises(TooLarge):
        pool.run(work_eat)
    assert pool.run(work_double, 1) == 2


def test_result_too_large_to_send_raises_too_large(pool: Pool) -> None:
    with pytest.raises(TooLarge):
        pool.run(work_unsendable)
    assert pool.run(work_double, 1) == 2


def test_failed_process_start_raises_unavailable(pool: Pool, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise BlockingIOError(11, "Resource temporarily unavailable")

    with monkeypatch.context() as patch:
        patch.setattr("multiprocessing.context.ForkServerProcess._Popen", refuse)
        with pytest.raises(Unavailable, match="try again"):
            pool.run(work_double, 1)
    assert pool.run(work_double, 1) == 2


def test_worker_starts_when_the_fork_server_dies_meanwhile(pool: Pool) -> None:
    forkserver.ensure_running()
    before = forkserver._forkserver._forkserver_pid  # type: ignore[attr-defined]
    os.kill(before, signal.SIGSTOP)
    with ThreadPoolExecutor(1) as thread:
        result = thread.submit(pool.run, work_double, 4)
        time.sleep(0.2)  # it waits for the fork server
        os.kill(before, signal.SIGKILL)
        assert result.result(60) == 8


def test_waiting_job_raises_unavailable_when_pool_closes(pool: Pool) -> None:
    pool.run(work_double, 1)
    errors: list[type[BaseException]] = []

    def run(*job: object) -> None:
        try:
            pool.run(*job)  # type: ignore[arg-type]
        except (Unavailable, WorkerDied) as error:
            errors.append(type(error))

    threads = [threading.Thread(target=run, args=job) for job in ((work_sleep, 30.0), (work_double, 1))]
    for thread in threads:
        thread.start()
        time.sleep(0.3)
    pool.close()
    for thread in threads:
        thread.join(60)
        assert not thread.is_alive()
    assert errors == [WorkerDied, Unavailable]


def test_full_pool_raises_unavailable(pool: Pool) -> None:
    pool.run(work_double, 1)
    threads = [threading.Thread(target=pool.run, args=(work_sleep, 1.0)) for _ in range(2)]
    for t in threads:
        t.start()
    time.sleep(0.3)
    with pytest.raises(Unavailable, match="try again"):
        pool.run(work_double, 1)
    for t in threads:
        t.join()
    assert pool.run(work_double, 1) == 2


def test_worker_ends_with_a_killed_parent(tmp_path: Path) -> None:
    script = tmp_path / "parent.py"
    script.write_text(
        "import os, signal, sys\n"
        "from app.pool import Pool\n"
        "from tests.test_pool import work_sleep\n"
        "if __name__ == '__main__':\n"
        "    pool = Pool(1)\n"
        "    print(pool.run(work_sleep, 0.0), flush=True)\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    root = Path(__file__).resolve().parents[1]
    done = subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(root)}
    )
    worker = int(done.stdout)
    for _ in range(100):
        try:
            os.kill(worker, 0)
        except ProcessLookupError:
            return
        if Path(f"/proc/{worker}/stat").read_text().rpartition(")")[2].split()[0] == "Z":
            return  # ended; its new parent has not reaped it yet
        time.sleep(0.1)
    pytest.fail("the worker outlived its parent")


@pytest.fixture
def confined(tmp_path: Path) -> Iterator[Pool]:
    (tmp_path / "scratch").mkdir()
    (tmp_path / "database").mkdir()
    (tmp_path / "database" / "a-shm").write_text("old")
    (tmp_path / "database" / "key").write_text("private")
    new_pool = Pool(1, allowed=SandboxPolicy((tmp_path / "scratch",), (tmp_path / "database" / "a-shm",), ()))
    yield new_pool
    new_pool.close()


needs_landlock = pytest.mark.skipif(
    sandbox.landlock_version() < 4, reason="the kernel has no Landlock with network rules"
)


@needs_landlock
def test_confined_worker_writes_only_to_allowed_places(confined: Pool, tmp_path: Path) -> None:
    assert confined.run(work_write, str(tmp_path / "scratch" / "a"), "x") == "x"
    assert confined.run(work_write, str(tmp_path / "database" / "a-shm"), "new") == "new"
    for forbidden in ("database/other", "elsewhere"):
        with pytest.raises(RuntimeError, match="PermissionError"):
            confined.run(work_write, str(tmp_path / forbidden), "x")
        assert not (tmp_path / forbidden).exists()
    with pytest.raises(RuntimeError, match="PermissionError"):
        confined.run(work_write, str(tmp_path / "database" / "key"), "x")
    assert (tmp_path / "database" / "key").read_text() == "private"


@needs_landlock
def test_confined_worker_has_no_network_and_starts_no_program(confined: Pool) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        with pytest.raises(RuntimeError, match="PermissionError"):
            confined.run(work_call, port)
        free = Pool(1, allowed=SandboxPolicy(ports=(port,)))
        assert free.run(work_call, port) == str(port)
        free.close()
    with pytest.raises(RuntimeError, match="PermissionError"):
        confined.run(work_execute)


def test_fork_server_starts_in_background() -> None:
    """Its modules are imported before the first worker starts."""
    script = (
        "import sys\n"
        "from app import pool\n"
        "pool.preload_in_background(('app.sandbox', 'app.links'))\n"
        "one = pool.Pool(1, warm=())\n"
        "try:\n"
        "    print(one.run(eval, \"'app.links' in __import__('sys').modules\"))\n"
        "finally:\n"
        "    one.close()\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120, check=False)
    assert done.stdout.strip() == "True", done.stderr
