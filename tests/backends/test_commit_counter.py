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
    assert counter.wait(before, 250)
    assert process.wait(60) == 0
    assert counter.wait(before, 250), "it has changed already"
    counter.close()


def test_waiting_sleeps_once_and_ends_in_time(tmp_path: Path) -> None:
    counter = CommitCounter(tmp_path)
    before, slept, start = counter(), sleeps(), time.monotonic()
    assert not counter.wait(before, 0.5)
    assert time.monotonic() - start >= 0.5
    assert sleeps() - slept < 25, "a look every 4 ms sleeps 125 times"
    counter.close()


def test_all_waiting_threads_are_woken(tmp_path: Path) -> None:
    counter = CommitCounter(tmp_path)
    waiting = [threading.Thread(target=counter.wait, args=(counter(), 250.0)) for _ in range(3)]
    for thread in waiting:
        thread.start()
    while any(thread.is_alive() for thread in waiting):  # again, as a thread may not have begun to wait
        counter.wake()
        time.sleep(0.01)
    counter.close()


def test_counter_may_be_closed_while_a_thread_waits(tmp_path: Path) -> None:
    counter = CommitCounter(tmp_path)
    waiting = threading.Thread(target=counter.wait, args=(counter(), 0.5))
    waiting.start()
    counter.close()
    waiting.join(60)
    assert not waiting.is_alive()


def refuse(*_: object) -> int:
    """A kernel that does not allow to wait."""
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
    while not counter.wait(before, 250):
        pass
    timer.join()
    assert counter() != before
    counter.close()
