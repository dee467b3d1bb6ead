"""Rests of a backup while other programs use the processors.

A low priority is not enough: where two processors are threads of one core, as in most virtual machines, a backup on one
of them slows a server on the other by half, although neither waits. So the backup leaves time between its pieces of
work, as much as others use the machine.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

PROC_STAT: Final = Path("/proc/stat")
"""Times of all processors since the start of the system (Linux, proc(5))."""

PIECE_SECONDS: Final = 0.02
"""Work on a processor between two rests."""

LOOK_SECONDS: Final = 0.5
"""Interval in which it is looked how busy the machine is: the times have steps of 10 ms."""

BUSY_SHARE: Final = 0.25
"""Share of the processors that others use from which on the rests are longest."""

MAX_REST: Final = 9.0
"""Longest rest per second of work, waits for disks and processors included: a tenth of a processor is left."""

MAX_REST_SECONDS: Final = 3.0
"""Maximum duration of one rest, also after a large piece of work."""


@dataclass(frozen=True, slots=True)
class Times:
    """Times in seconds: elapsed, of this thread and of this process on processors, and of all processors at work.

    server: that a database server worked for this thread.
    """

    elapsed: float
    thread: float
    process: float
    machine: float
    server: float = 0.0

    @property
    def work(self) -> float:
        """Time of work for this thread."""
        return self.thread + self.server


def current_times(server: float = 0.0) -> Times | None:
    """Read the times; None if the system does not show how busy it is."""
    try:
        user, nice, system, _, _, irq, softirq = map(int, PROC_STAT.read_text().split(maxsplit=8)[1:8])
    except (OSError, ValueError):
        return None
    machine = (user + nice + system + irq + softirq) / os.sysconf("SC_CLK_TCK")
    return Times(time.monotonic(), time.thread_time(), time.process_time(), machine, server)


class Pace:
    """Pace of one thread's work. Call ``rest`` after each piece of work, in that thread and outside of transactions."""

    def __init__(
        self,
        times: Callable[[], Times | None] = current_times,
        sleep: Callable[[float], None] = time.sleep,
        processors: int | None = None,
    ) -> None:
        self._times, self._sleep = times, sleep
        self._processors = processors or os.cpu_count() or 1
        self._piece = self._look = times()
        self._share = 0.0

    def rest(self) -> None:
        """Sleep in proportion to the work since the last rest, and to how busy others keep the machine."""
        now = self._times()
        if now is None or self._piece is None or now.work - self._piece.work < PIECE_SECONDS:
            return
        self._note_others(now)
        worked = now.work - self._piece.work
        idle = now.elapsed - self._piece.elapsed - worked
        rest = MAX_REST * min(1.0, self._share / BUSY_SHARE) * worked - idle
        if rest > 0:
            self._sleep(min(rest, MAX_REST_SECONDS))
            now = self._times()
        self._piece = now

    def _note_others(self, now: Times) -> None:
        """Update the share of the machine's processors that other programs use."""
        before = self._look
        if before is not None and now.elapsed - before.elapsed >= LOOK_SECONDS:
            backup = now.process - before.process + now.server - before.server
            others = now.machine - before.machine - backup
            self._share = max(0.0, others / (now.elapsed - before.elapsed) / self._processors)
            self._look = now
