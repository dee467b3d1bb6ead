"""Queue of several servers: what only a queue in a database can suffer, such as workers that stand still."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from sqlalchemy import text

from app.backends import shared_queue
from app.backends.fence import fenced_by
from app.backends.queue import MAX_FAILURES, Task
from app.backends.shared_queue import Attempt, SharedQueue, TaskLostError
from app.errors import NoRoom, Unavailable
from tests.backends.test_queue import Case, eventually, made, shared_case

pytestmark = pytest.mark.postgres


@pytest.fixture
def case(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Case]:
    """A queue without a worker, until it is started."""
    yield from shared_case(request, tmp_path)


@pytest.fixture
def queue(case: Case) -> SharedQueue:
    """The queue itself."""
    assert isinstance(case.queue, SharedQueue)
    return case.queue


def take(queue: SharedQueue) -> Attempt:
    """Take the next task, as a new worker does that stands still from then on."""
    with queue._transaction() as connection:
        worker = connection.execute(text("SELECT procrastinate_register_worker_v1()")).scalar_one()
        row = connection.execute(text(f"SELECT * FROM procrastinate_fetch_job_v2(NULL, {worker})")).one()
        connection.execute(text("UPDATE procrastinate_workers SET last_heartbeat = now() - interval '1 minute'"))
    return Attempt(row.id, row.attempts)


def rows(queue: SharedQueue) -> list[tuple[str, int]]:
    """Status and number of earlier attempts of each task."""
    with queue._transaction() as connection:
        query = text("SELECT status::text, attempts FROM procrastinate_jobs ORDER BY id")
        return [(row.status, row.attempts) for row in connection.execute(query)]


@pytest.mark.parametrize(
    "end", [SharedQueue.finish, lambda queue, attempt: queue.give_back(attempt, 0)], ids=["finish", "give_back"]
)
def test_worker_taken_for_dead_does_not_end_the_attempt_of_another(
    case: Case, queue: SharedQueue, end: Callable[[SharedQueue, Attempt], bool]
) -> None:
    case.submit("task")
    first = take(queue)
    assert queue.put_back_stalled() == []
    assert not end(queue, first)
    assert rows(queue) == [("todo", 1)]
    second = take(queue)
    assert not end(queue, first)
    assert rows(queue) == [("doing", 1)]
    assert end(queue, second)
    assert not end(queue, second)


def test_worker_taken_for_dead_stores_nothing(case: Case, queue: SharedQueue) -> None:
    case.submit("task")
    first = take(queue)

    def store(attempt: Attempt) -> None:
        with fenced_by(attempt), queue._transaction() as connection:
            connection.execute(text("UPDATE procrastinate_jobs SET priority = priority + 1"))

    store(first)
    queue.put_back_stalled()
    with pytest.raises(TaskLostError):
        store(first)
    second = take(queue)
    with pytest.raises(TaskLostError):
        store(first)
    store(second)
    queue.finish(second)
    with pytest.raises(TaskLostError):
        store(second)


def test_task_is_not_put_back_while_its_worker_commits(case: Case, queue: SharedQueue) -> None:
    """So either its outcome is stored in this attempt, or the task is carried out again: never both."""
    case.submit("task")
    attempt = take(queue)
    with queue._transaction() as connection:
        attempt.check(connection)
        assert queue.put_back_stalled() == []
        assert rows(queue) == [("doing", 0)]
    queue.put_back_stalled()
    assert rows(queue) == [("todo", 1)]


def test_task_fails_of_dead_workers_only(case: Case, queue: SharedQueue) -> None:
    """Upgrades that stop a worker in the middle of a long task are no reason to give it up, however many."""
    case.submit("task")
    for _ in range(2 * shared_queue.MAX_DEATHS):
        assert queue.give_back(take(queue), 0)
    for _ in range(shared_queue.MAX_DEATHS - 1):
        take(queue)
        assert queue.put_back_stalled() == []
    assert queue.give_back(take(queue), 0)
    take(queue)
    assert [task.key for task in queue.put_back_stalled()] == ["task"]
    assert rows(queue) == []


def test_failures_of_a_task_count_by_themselves(case: Case, queue: SharedQueue) -> None:
    perform = case.recorder.perform
    seen: list[int] = []

    def fail(task: Task) -> None:
        perform(task)
        seen.append(task.failures)
        if task.failures < MAX_FAILURES:
            raise NoRoom("the disk is full")

    case.recorder.perform = fail  # type: ignore[method-assign]
    case.submit("task")
    for _ in range(2):
        take(queue)
        assert queue.put_back_stalled() == []
        assert queue.give_back(take(queue), 0)
    case.start()
    eventually(lambda: rows(queue) == [])
    assert seen == list(range(MAX_FAILURES + 1))


def test_workers_have_time_for_a_heartbeat_when_the_database_is_back(
    case: Case, queue: SharedQueue, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shared_queue, "HEARTBEAT_SECONDS", 0.1)
    monkeypatch.setattr(shared_queue, "STALLED_SECONDS", 2.0)
    put_back = SharedQueue.put_back_stalled
    calls: list[float] = []

    def away_at_first(queue: SharedQueue) -> list[Task]:
        calls.append(time.monotonic())
        if len(calls) < 3:
            raise Unavailable("the database is away")
        return put_back(queue)

    monkeypatch.setattr(SharedQueue, "put_back_stalled", away_at_first)
    case.submit("task")
    take(queue)
    case.start()
    eventually(lambda: made(case) == ["task"])
    assert calls[1] - calls[0] >= 2.0
    assert calls[2] - calls[1] >= 2.0


def test_end_of_a_task_is_stored_once_the_database_can_be_had(
    case: Case, queue: SharedQueue, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(shared_queue, "RETRY_SECONDS", 0.1)
    finish, calls = SharedQueue.finish, []

    def away(queue: SharedQueue, attempt: Attempt) -> bool:
        calls.append(attempt)
        if len(calls) < 4:
            raise Unavailable("the database is away")
        return finish(queue, attempt)

    monkeypatch.setattr(SharedQueue, "finish", away)
    case.submit("task")
    case.start()
    eventually(lambda: len(calls) == 4)
    eventually(lambda: rows(queue) == [])
    assert made(case) == ["task"], "once"
    assert caplog.text.count("could not be ended") == 1


def test_task_is_not_given_back_while_another_with_its_key_waits(case: Case, queue: SharedQueue) -> None:
    """Two cannot wait at once: else it would stay at its worker for ever, and the other one behind it."""
    perform = case.recorder.perform

    def fail_first(task: Task) -> None:
        perform(task)
        if len(case.recorder.begun) == 1:
            case.submit("task")
            raise NoRoom("the disk is full")

    case.recorder.perform = fail_first  # type: ignore[method-assign]
    case.submit("task")
    case.start()
    eventually(lambda: len(made(case)) == 2)
    eventually(lambda: rows(queue) == [])


def test_stopping_worker_keeps_its_task_until_it_has_ended_it(
    case: Case, queue: SharedQueue, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It has more time to stop than until others take it for dead."""
    monkeypatch.setattr(shared_queue, "HEARTBEAT_SECONDS", 0.2)
    monkeypatch.setattr(shared_queue, "STALLED_SECONDS", 2.0)
    perform, may_end = case.recorder.perform, threading.Event()
    case.recorder.perform = lambda task: (perform(task), may_end.wait(60))  # type: ignore[method-assign,assignment]
    case.submit("task")
    case.start()
    eventually(lambda: case.recorder.begun)
    case.stop()
    end = time.monotonic() + 3 * shared_queue.STALLED_SECONDS
    while time.monotonic() < end:
        queue.put_back_stalled()
        assert rows(queue) == [("doing", 0)]
        time.sleep(0.1)
    may_end.set()
    eventually(lambda: rows(queue) == [])
    assert case.recorder.begun == ["task"]


def test_task_becomes_urgent_although_another_server_adds_it_at_the_same_time(
    case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    case.submit("first")
    add, raise_urgency = shared_queue.SharedQueue._submit, shared_queue._RAISE

    def add_late(queue: shared_queue.SharedQueue, task: Task) -> None:
        """Look for the task before the other server has added it."""
        monkeypatch.setattr(shared_queue.SharedQueue, "_submit", add)
        case.submit("same")
        with monkeypatch.context() as before:
            before.setattr(shared_queue, "_RAISE", text(raise_urgency.text.replace("'todo'", "'failed'")))
            add(queue, task)

    monkeypatch.setattr(shared_queue.SharedQueue, "_submit", add_late)
    case.submit("same", urgency="robot")
    case.start()
    eventually(lambda: len(made(case)) == 2)
    assert made(case) == ["same", "first"]
