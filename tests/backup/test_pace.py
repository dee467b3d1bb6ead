"""The pace of a backup: full speed on a free machine, rests beside others."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from app.backup import pace
from app.backup.pace import MAX_REST, MAX_REST_SECONDS, Pace, Times, current_times


class Machine:
    """Times of a machine with two processors, of which others use a share.

    wait, server: seconds that the thread waits, and that a database server works for it, per second of its work.
    """

    def __init__(self, others: float, wait: float = 0.0, server: float = 0.0) -> None:
        self.others, self.wait, self.server = others, wait, server
        self.elapsed = self.worked = self.rested = 0.0

    def __call__(self) -> Times:
        served = self.server * self.worked
        machine = self.worked + served + 2 * self.others * self.elapsed
        return Times(self.elapsed, self.worked, self.worked, machine, served)

    def sleep(self, seconds: float) -> None:
        self.rested += seconds
        self.elapsed += seconds

    def work(self, seconds: float, piece: float = 0.005) -> float:
        """Work for some seconds; return the share of a processor that the thread had."""
        paced = Pace(self, self.sleep, processors=2)
        for _ in range(round(seconds / piece)):
            self.worked += piece
            self.elapsed += piece * (1 + self.wait + self.server)
            paced.rest()
        return seconds / self.elapsed


def test_free_machine_gives_full_speed() -> None:
    assert Machine(0.0).work(20) == pytest.approx(1)


@pytest.mark.parametrize(("others", "share"), [(0.01, 0.74), (0.1, 1 / 4.6), (0.25, 1 / 10), (1.0, 1 / 10)])
def test_rests_grow_with_the_use_by_others(others: float, share: float) -> None:
    assert Machine(others).work(60) == pytest.approx(share, abs=0.02)


@pytest.mark.parametrize(("others", "share"), [(0.0, 1 / 2), (0.5, 1 / 20)])
def test_work_of_a_database_server_counts_as_own(others: float, share: float) -> None:
    assert Machine(others, server=1.0).work(20) == pytest.approx(share, abs=0.02)


@pytest.mark.parametrize("others", [0.0, 0.5])
def test_waits_count_as_rests(others: float) -> None:
    machine = Machine(others, wait=MAX_REST + 1)
    machine.work(20)
    assert machine.rested == 0


def test_large_piece_of_work_ends_in_a_short_rest() -> None:
    machine = Machine(0.5)
    machine.work(100, piece=100)
    assert machine.rested == MAX_REST_SECONDS


def test_system_without_these_times_is_no_problem(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pace, "PROC_STAT", tmp_path / "stat")
    rests: list[float] = []
    Pace(sleep=rests.append).rest()
    assert (current_times(), rests) == (None, [])


def test_times_are_those_of_the_machine() -> None:
    before = current_times()
    if before is None:
        pytest.skip("this system does not show how busy it is")
    while time.thread_time() - before.thread < 0.3:
        pass
    after = current_times()
    assert after is not None
    assert after.thread - before.thread >= 0.3
    assert after.machine - before.machine > 0.2
