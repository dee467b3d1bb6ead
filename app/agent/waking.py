"""Sleep between two syncs, until an event comes or the router is back."""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Collection

from app.agent.status import StatusReporter
from app.events.messages import Event

LATEST = "latest"
CLOSURE_EVENTS = ("overlay.accepted", "overlay.ended")
"""Events that change the closures in force."""

DEBOUNCE_SECONDS = 0.02
"""Events that come together are one look at the server. Doubled for each look that brought nothing, up to 5 seconds: on
an open router anybody can put events.
"""

MAX_DOUBLINGS = 8

REJOIN_SECONDS = 1.0
"""A fleet that finds its router again does not ask in the same moment: up to so long."""


class Alarm(threading.Event):
    """Set by threads of Zenoh's when there is something to sync; the sync loop sleeps on it."""

    def __init__(self, stopping: threading.Event) -> None:
        super().__init__()
        self._stopping = stopping
        self.rejoined = False
        """Whether the router has come back since the last sync."""
        self.idle_wakeups = 0
        """Wake-ups in a row that brought nothing."""

    def sleep(self, seconds: float, status: StatusReporter) -> bool:
        """Sleep until something happens, at most so long: whether it did. The status is confirmed meanwhile."""
        end = time.monotonic() + seconds
        while True:
            now = time.monotonic()
            until = end if status.confirm_at is None else min(end, status.confirm_at)
            woken = self._wait(max(0.0, until - now))
            if woken or self._stopping.is_set() or time.monotonic() >= end:
                return woken
            status.send()

    def _wait(self, seconds: float) -> bool:
        """Wait until something happens, at most so long: whether an event or the router was it."""
        woken = self.wait(seconds)
        if woken and not self._stopping.is_set():
            rejoined, self.rejoined = self.rejoined, False
            debounce = DEBOUNCE_SECONDS * 2.0 ** min(MAX_DOUBLINGS, self.idle_wakeups)
            self._stopping.wait(REJOIN_SECONDS * random.random() if rejoined else debounce)  # noqa: S311
        return woken


def is_relevant(event: Event, channel: str | None, candidates: Collection[str | None]) -> bool:
    """Whether an event may change the robot's map. channel: that it follows; candidates: those that it may follow."""
    if event.type == "version.created":
        return channel in (LATEST, None)
    if event.type.startswith("overlay."):
        return event.type in CLOSURE_EVENTS  # in force on every channel at once
    return event.channel in candidates or event.type.startswith("environment.")
