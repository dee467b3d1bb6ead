"""Sleep between two syncs until an event arrives or the router reconnects."""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Collection

from app.agent.signed_manifest import MAX_SEQUENCE_AHEAD
from app.agent.state import Mark
from app.agent.status import StatusReporter
from app.events.messages import Event

LATEST = "latest"
CLOSURE_EVENTS = ("overlay.accepted", "overlay.ended")
"""Events that change the closures in force."""

DEBOUNCE_SECONDS = 0.02
"""Debounce time after an event. Doubles with each wake-up without effect, up to 5 seconds: on an open router anyone can
publish events.
"""

MAX_DOUBLINGS = 8

REJOIN_SECONDS = 1.0
"""Maximum random delay of a sync after a reconnect, so that a fleet does not poll all at once."""


class Alarm(threading.Event):
    """Event that wakes the sync loop; set by Zenoh threads."""

    def __init__(self, stopping: threading.Event) -> None:
        super().__init__()
        self._stopping = stopping
        self.rejoined = False
        """Whether the router has reconnected since the last sync."""
        self.idle_wakeups = 0
        """Number of consecutive wake-ups without effect."""

    def sleep(self, seconds: float, status: StatusReporter) -> bool:
        """Sleep until woken, at most ``seconds``; confirm the status when it is due. Return whether it was woken."""
        end = time.monotonic() + seconds
        while True:
            now = time.monotonic()
            until = end if status.confirm_at is None else min(end, status.confirm_at)
            woken = self._wait(max(0.0, until - now))
            if woken or self._stopping.is_set() or time.monotonic() >= end:
                return woken
            status.send()

    def _wait(self, seconds: float) -> bool:
        """Wait until woken, at most ``seconds``, then debounce. Return whether it was woken."""
        woken = self.wait(seconds)
        if woken and not self._stopping.is_set():
            rejoined, self.rejoined = self.rejoined, False
            debounce = DEBOUNCE_SECONDS * 2.0 ** min(MAX_DOUBLINGS, self.idle_wakeups)
            self._stopping.wait(REJOIN_SECONDS * random.random() if rejoined else debounce)  # noqa: S311
        return woken


def is_newer(event: Event, mark: Mark | None) -> bool:
    """Whether an event is newer than the newest accepted manifest, but not absurdly so.

    Args:
        mark: position of that manifest; None before the first one.
    """
    number = event.body.get("edge_sequence")
    if mark is not None and event.sequence == mark.sequence and type(number) is int:  # a mirror's own change
        return 0 < number - mark.edge_sequence <= MAX_SEQUENCE_AHEAD
    return 0 < event.sequence - (-1 if mark is None else mark.sequence) <= MAX_SEQUENCE_AHEAD + 1


def is_relevant(event: Event, channel: str | None, candidates: Collection[str | None]) -> bool:
    """Whether an event may change the robot's map.

    Args:
        channel: followed channel.
        candidates: channels that the agent may follow.
    """
    if event.type == "version.created":
        return channel in (LATEST, None)
    if event.type.startswith("overlay."):
        return event.type in CLOSURE_EVENTS  # closures apply to every channel
    return event.channel in candidates or event.type.startswith("environment.")
