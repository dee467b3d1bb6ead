"""Commit counter: changes seen in this process and in another one."""

from __future__ import annotations

import ctypes
import errno
import resource
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from app.backends import futex
from app.backends.notify import CommitCounter
from app.store.store import Store


def test_commit_counter_changes_with_writes_only(tmp_path: Path) -> None:
    store = Store(f"sqlite:///{tmp_path}/a.sqlite", tmp_path / "blobs")
    store.migrate()
    before = store.generation()
    assert store.environments.page() == ([], None)
    assert store.generation() == before
    store.environments.create("farm")
    after = store.generation()
    assert after != before
    store.tokens.create("somebody", "viewer")
    assert store.generation() != after
    store.close()


def test_commit_counter_is_shared_between_processes(tmp_path: Path) -> None:
    counter = CommitCounter(tmp_path)
    before = counter()
    code = "from pathlib import Path; from app.backends.notify import CommitCounter; "
    code += f"CommitCounter(Path({str(tmp_path)!r})).change()"
    subprocess.run([sys.executable, "-c", code], check=True)
    assert counter() != before
    counter.close()


def test_commit_counter_without_folder_counts_in_process(tmp_path: Path) -> None:
    counter = CommitCounter(tmp_path / "absent")
    before = counter()
    counter.change()
    assert counter() != before


ENDLESS = 1000.0
"""Seconds: a wait that is not ended exceeds the time limit of its test."""

CHANGE = """
import time
from pathlib import Path
from app.backends.notify import CommitCounter
counter = CommitCounter(Path({folder!r}))
time.sleep(0.3)
counter.change()
"""


def sleeps() -> int:
    """Count how often this thread has given up the processor to wait."""
    return resource.getrusage(resource.RUSAGE_THREAD).ru_nvcsw


def test_waiting_ends_with_a_change_of_another_process(tmp_path: Path) -> None:
    counter = CommitCounter(tmp_path)
    before = counter()
    process = subprocess.Popen([sys.executable, "-c", CHANGE.format(folder=str(tmp_path))])
    assert counter.wait(before, ENDLESS)
    assert process.wait(60) == 0
    assert counter.wait(before, ENDLESS), "it has changed already"
    counter.close()


def test_waiting_sleeps_once_and_ends_in_time(tmp_path: Path) -> None:
    counter = CommitCounter(tmp_path)
    before, slept, start = counter(), sleeps(), time.monotonic()
    assert not counter.wait(before, 0.5)
    assert time.monotonic() - start >= 0.5
    assert sleeps() - slept < 25, "a look every 4 ms sleeps 125 times"
    counter.close()


def start_waiting(counter: CommitCounter) -> threading.Thread:
    thread = threading.Thread(target=counter.wait, args=(counter(), ENDLESS), daemon=True)
    thread.start()
    return thread


def test_a_change_wakes_all_threads(tmp_path: Path) -> None:
    counter = CommitCounter(tmp_path)
    waiting = [start_waiting(counter) for _ in range(3)]
    time.sleep(0.5)  # one that has not begun to wait until now sees the change
    counter.change()
    for thread in waiting:
        thread.join()
    counter.close()


def test_waiting_ends_without_a_change_when_woken(tmp_path: Path) -> None:
    counter = CommitCounter(tmp_path)
    before, thread = counter(), start_waiting(counter)
    while thread.is_alive():  # again, as it may not have begun to wait
        counter.wake()
        time.sleep(0.01)
    assert counter() == before
    counter.close()


def test_closing_ends_the_wait_of_a_thread(tmp_path: Path) -> None:
    counter = CommitCounter(tmp_path)
    thread = start_waiting(counter)
    while thread.is_alive():  # again, as it may not have begun to wait
        counter.close()
        time.sleep(0.01)


def refuse(*_: object) -> int:
    """A kernel that does not allow waiting."""
    ctypes.set_errno(errno.EPERM)
    return -1


@pytest.mark.parametrize("system_call", [None, refuse])
@pytest.mark.parametrize("folder", ["", "absent"])
def test_waiting_without_the_kernel_looks_now_and_then(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: str, system_call: object
) -> None:
    monkeypatch.setattr(futex, "_system_call", system_call)
    counter = CommitCounter(tmp_path / folder)
    before, start = counter(), time.monotonic()
    assert not counter.wait(before, 0.004)
    assert time.monotonic() - start >= 0.004
    timer = threading.Timer(0.1, counter.change)
    timer.start()
    while not counter.wait(before, ENDLESS):
        pass
    timer.join()
    assert counter() != before
    counter.close()
