"""The pace of a backup: full speed on a free machine, rests beside others."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import time

import pytest

from app.backup.pace import MAX_REST, MAX_REST_SECONDS, PIECE_SECONDS, Pace, thread_times

BURN = "import os; os.sched_setaffinity(0, {int(os.environ['CPU'])})\nwhile True: pass"


class Clock:
    """Times of a thread that works in pieces, and gets a processor after a wait."""

    def __init__(self) -> None:
        self.ran = self.waited = self.rested = 0.0

    def __call__(self) -> tuple[float, float]:
        return self.ran, self.waited

    def sleep(self, seconds: float) -> None:
        self.rested += seconds

    def work(self, pace: Pace, seconds: float, wait_per_second: float, piece: float = 0.005) -> float:
        """Work for some seconds; return the share of a processor that the thread had."""
        begin = self.ran + self.waited + self.rested
        for _ in range(round(seconds / piece)):
            self.ran += piece
            self.waited += piece * wait_per_second
            pace.rest()
        return seconds / (self.ran + self.waited + self.rested - begin)


def test_free_machine_gives_full_speed() -> None:
    clock = Clock()
    assert clock.work(Pace(clock, clock.sleep), 10, 0.0) == pytest.approx(1)
    assert clock.rested == 0


@pytest.mark.parametrize(("wait", "share"), [(0.01, 0.83), (0.1, 0.32), (1.0, 1 / 6), (4.0, 1 / 6)])
def test_rests_grow_with_the_waits_up_to_a_sixth_of_a_processor(wait: float, share: float) -> None:
    clock = Clock()
    assert clock.work(Pace(clock, clock.sleep), 10, wait) == pytest.approx(share, abs=0.02)


def test_who_gets_little_anyway_does_not_rest() -> None:
    clock = Clock()
    clock.work(Pace(clock, clock.sleep), 10, MAX_REST + 1)
    assert clock.rested == 0


def test_large_piece_of_work_ends_in_a_short_rest() -> None:
    clock = Clock()
    clock.work(Pace(clock, clock.sleep), 100, 1.0, piece=100)
    assert clock.rested == MAX_REST_SECONDS


def test_system_without_these_times_is_no_problem() -> None:
    rests: list[float] = []
    pace = Pace(lambda: None, rests.append)
    pace.rest()
    assert rests == []


def test_busy_processor_is_noticed() -> None:
    """One other program on this thread's processor: the thread waits, and rests."""
    if thread_times() is None:
        pytest.skip("this system does not count how long a thread waits for a processor")
    former, cpu = os.sched_getaffinity(0), min(os.sched_getaffinity(0))
    rests: list[float] = []
    other = subprocess.Popen([sys.executable, "-c", BURN], env={**os.environ, "CPU": str(cpu)})
    try:
        os.sched_setaffinity(0, {cpu})
        pace, deadline = Pace(sleep=rests.append), time.monotonic() + 60
        while not rests and time.monotonic() < deadline:
            begin = time.thread_time()
            while time.thread_time() - begin < PIECE_SECONDS:
                hashlib.sha256(bytes(2**16)).digest()
            pace.rest()
    finally:
        os.sched_setaffinity(0, former)
        other.kill()
        other.wait()
    assert rests
