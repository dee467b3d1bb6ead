"""Clock for what holds only for a while, and must not hold any longer because the host was suspended meanwhile.

``time.monotonic`` stands still while a laptop or virtual machine is suspended. So what others may have changed since,
such as a lead or a cached response, would count as fresh when the host wakes up. Pauses between attempts, limits of
requests and the like are measured with ``time.monotonic``; what users set as a time, such as the end of a closure, is
compared with the time of day.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Final

seconds_since_boot: Final[Callable[[], float]] = (
    partial(time.clock_gettime, time.CLOCK_BOOTTIME) if hasattr(time, "CLOCK_BOOTTIME") else time.monotonic
)
"""Seconds since the host was started, with those for which it was suspended (Linux; elsewhere as ``time.monotonic``).

No clock of a virtual machine counts the time for which its host has paused it, or until a snapshot is restored.
"""
