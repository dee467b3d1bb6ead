"""Queue: order, fairness, one at a time for each key, cancelling, fullness; the same on both adapters."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from app.backends.queue import LocalQueue, Queue, Task, Urgency
from app.errors import Unavailable
from app.store.store import Store
from tests.postgres import Cluster

SECONDS = 60.0
WAITING = 30


class Recorder:
    """Performer that holds the tasks named ``hold…`` until they are stopped or let go."""

    def __init__(self) -> None:
        self.begun: list[str] = []
        self.made: list[str] = []
        self.stopped: set[str] = set()
        self.at_once = self.most = 0
        self.let_go = threading.Event()
        self._lock = threading.Lock()

    def perform(self, task: Task) -> None:
        with self._lock:
            self.begun.append(task.key)
            self.at_once += 1
            self.most = max(self.most, self.at_once)
        while task.key.startswith("hold") and not self.let_go.is_set() and task.key not in self.stopped:
            time.sleep(0.01)
        with self._lock:
            self.at_once -= 1
            if task.key not in self.stopped:
                self.made.append(task.key)

    def stop(self, task: Task) -> None:
        self.stopped.add(task.key)


class Case:
    """A queue whose tasks are taken once ``start`` was called."""

    def __init__(
        self, queue: Queue, recorder: Recorder, start: Callable[[], None], stop: Callable[[], None] = lambda: None
    ) -> None:
        self.queue, self.recorder, self.start, self.stop = queue, recorder, start, stop

    def submit(self, key: str, environment: str = "a", urgency: Urgency = "person") -> None:
        self.queue.submit(Task("test", key, environment, urgency, {"value": 1}))


def eventually(condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + SECONDS
    while not condition():
        assert time.monotonic() < deadline, "the condition does not come true"
        time.sleep(0.01)


def _local() -> Iterator[Case]:
    recorder = Recorder()
    queue = LocalQueue(recorder, threads=1, waiting=WAITING)

    def start() -> None:
        recorder.let_go.set()

    # The only thread is busy until the test starts.
    queue.submit(Task("test", "hold-start", "other"))
    eventually(lambda: recorder.begun)
    yield Case(queue, recorder, start)
    recorder.let_go.set()
    queue.close()


def shared_case(request: pytest.FixtureRequest, folder: Path) -> Iterator[Case]:
    """A queue on PostgreSQL. Tasks named ``hold…`` are held until ``recorder.let_go`` is set, which ``start`` does."""
    from app.backends.shared_queue import QueueWorker, SharedQueue

    cluster: Cluster = request.getfixturevalue("postgres_cluster")
    name = cluster.create_database(request.getfixturevalue("migrated_database"))
    store, recorder = Store(cluster.url(name), folder / "blobs"), Recorder()
    queue = SharedQueue(store.transaction, waiting=WAITING)
    stops: list[Callable[[], None]] = []
    ends: list[Callable[[], None]] = []

    def start() -> None:
        recorder.let_go.set()
        loop = asyncio.new_event_loop()
        worker = QueueWorker(cluster.url(name), queue, recorder, lambda task: None, slots=1)
        thread = threading.Thread(target=loop.run_until_complete, args=(worker.run(),))
        thread.start()

        def stop() -> None:
            loop.call_soon_threadsafe(worker.stop)

        def end() -> None:
            stop()
            thread.join(SECONDS)
            loop.close()

        stops.append(stop)
        ends.append(end)

    yield Case(queue, recorder, start, lambda: stops[0]())
    for end in ends:
        end()
    store.close()
    cluster.drop_database(name)


@pytest.fixture(params=["local", "shared"])
def case(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Case]:
    """A queue whose only place is not free, or has no worker, until it is started."""
    yield from _local() if request.param == "local" else shared_case(request, tmp_path)


def made(case: Case) -> list[str]:
    return [key for key in case.recorder.made if key != "hold-start"]


def test_tasks_of_an_environment_are_made_in_order(case: Case) -> None:
    for k in range(5):
        case.submit(f"task-{k}")
    case.start()
    eventually(lambda: len(made(case)) == 5)
    assert made(case) == [f"task-{k}" for k in range(5)]


def test_robots_overtake_people(case: Case) -> None:
    for k in range(3):
        case.submit(f"person-{k}")
    case.submit("robot", "b", "robot")
    case.start()
    eventually(lambda: len(made(case)) == 4)
    assert made(case)[0] == "robot"


def test_twenty_tasks_of_one_environment_do_not_starve_another(case: Case) -> None:
    for k in range(20):
        case.submit(f"many-{k}", "a")
    for k in range(2):
        case.submit(f"few-{k}", "b")
    case.start()
    eventually(lambda: len(made(case)) == 22)
    assert made(case).index("few-0") <= 2
    assert made(case).index("few-1") <= 4


def test_newcomers_do_not_starve_who_waits(case: Case) -> None:
    for k in range(10):
        case.submit(f"many-{k}", "a")
    for k in range(10):
        case.submit(f"new-{k}", f"environment-{k}")  # each the first of its environment
    case.submit("last", "b")
    case.start()
    eventually(lambda: len(made(case)) == 21)
    assert made(case)[0] == "many-0"
    assert made(case)[-9:] == [f"many-{k}" for k in range(1, 10)]


def test_task_that_waits_is_not_added_twice(case: Case) -> None:
    case.submit("same")
    case.submit("same", "b")
    case.submit("after")
    case.start()
    eventually(lambda: "after" in made(case))
    assert made(case) == ["same", "after"]


def test_waiting_task_becomes_urgent_when_a_robot_needs_it(case: Case) -> None:
    case.submit("first")
    case.submit("needed")
    case.submit("needed", urgency="robot")
    case.start()
    eventually(lambda: len(made(case)) == 2)
    assert made(case) == ["needed", "first"]


def test_cancelled_task_is_not_made(case: Case) -> None:
    case.submit("cancelled")
    case.submit("kept")
    case.queue.cancel("cancelled")
    case.start()
    eventually(lambda: "kept" in made(case))
    assert made(case) == ["kept"]


def test_full_queue_refuses_people_and_not_robots(case: Case) -> None:
    for k in range(WAITING):
        case.submit(f"task-{k}")
    with pytest.raises(Unavailable, match="try again"):
        case.submit("one-more")
    case.submit("task-0")  # waits already
    case.submit("robot", urgency="robot")


def test_figures_count_what_waits(case: Case) -> None:
    case.submit("person-1")
    case.submit("person-2")
    case.submit("robot", urgency="robot")
    figures = case.queue.figures()
    assert figures.waiting == {"robot": 1, "person": 2}
    eventually(lambda: case.queue.figures().oldest > 0.05)
    case.start()
    eventually(lambda: len(made(case)) == 3 and case.queue.figures().running == 0)
    figures = case.queue.figures()
    assert (figures.waiting, figures.oldest) == ({"robot": 0, "person": 0}, 0.0)
    assert figures.workers == 1
