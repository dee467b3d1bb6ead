"""Rests of a backup while other programs want the processors.

A low priority is not enough: a server's thread that wakes up waits for the end of the backup's time slice (some
milliseconds since Linux 6.6), dozens of times in one commit, and caches are shared. The kernel counts how long a
thread was ready and had no processor: that is the sign that others want it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

SCHEDSTAT: Final = Path("/proc/thread-self/schedstat")
"""Times in nanoseconds: on a processor, and ready without one (Linux, Documentation/scheduler/sched-stats.rst)."""

PIECE_SECONDS: Final = 0.02
"""Work on a processor between two rests."""

REST_PER_WAIT: Final = 20.0
"""Rest per second without a processor: an accidental wait of a millisecond costs little."""

MAX_REST: Final = 5.0
"""Maximum rest per second of work, waits included: a backup beside others gets a sixth of a processor, or more."""

MAX_REST_SECONDS: Final = 1.0
"""Maximum duration of one rest, also after a large piece of work."""


def thread_times() -> tuple[float, float] | None:
    """Return for how many seconds this thread ran, and was ready without a processor; None if the system hides it."""
    try:
        ran, waited, _ = map(int, SCHEDSTAT.read_bytes().split())
    except (OSError, ValueError):
        return None
    return ran / 1e9, waited / 1e9


class Pace:
    """Pace of one thread's work. Call ``rest`` after each piece of work, in that thread and outside of transactions."""

    def __init__(
        self,
        times: Callable[[], tuple[float, float] | None] = thread_times,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._times, self._sleep = times, sleep
        self._before = times()

    def rest(self) -> None:
        """Sleep if others wanted the processors since the last rest."""
        now = self._times()
        if now is None or self._before is None:
            return
        ran, waited = now[0] - self._before[0], now[1] - self._before[1]
        if ran < PIECE_SECONDS:
            return
        rest = min(REST_PER_WAIT * waited, MAX_REST * ran - waited, MAX_REST_SECONDS)
        if rest > 0:
            self._sleep(rest)
        self._before = now
