"""Following the outbox: what Zenoh, MQTT and webhooks share. Each reads the events of a position on, in order."""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Callable, Iterator
from pathlib import Path

from app.backends.lead import Leads
from app.events.leader import POLL_SECONDS, WAIT_SECONDS, LeaderThread
from app.store.store import Store
from app.store.values import Event

PAGE = 500


def pages_after(
    store: Store, position: int, is_stopping: Callable[[], bool], size: int = PAGE
) -> Iterator[list[Event]]:
    """Yield the events of the log after a position, in pages, until there are no more for now."""
    while not is_stopping():
        page = store.events.page(None, position, size)
        if not page:
            return
        yield page
        position = page[-1].position


class Follower(LeaderThread):
    """Leader thread that hands events over as they are committed.

    Args:
        well: log line when the state becomes ``connected``.
        trouble: start of the log line when the state becomes ``down``.
    """

    interval_seconds = 0.004
    """Shortest time between two looks at the log, so that a burst of commits costs one."""

    def __init__(self, store: Store, data_dir: Path, name: str, leads: Leads, *, well: str, trouble: str) -> None:
        super().__init__(data_dir, name, leads, well=well, trouble=trouble)
        self._store = store

    def _run_once(self) -> None:
        """Hand over what there is, then wait for a commit."""
        generation = self._store.generation()
        if self._hand_over():
            return
        # Also return periodically: a notification may have been lost, and the connection must be checked.
        last_read = time.monotonic()
        while not self._is_ending():
            age = time.monotonic() - last_read
            if self._store.generation() != generation or age > POLL_SECONDS or self._has_more():
                self._stopping.wait(self.interval_seconds - age)
                return
            self._store.generation.wait(generation, min(WAIT_SECONDS, POLL_SECONDS))

    def _stop(self) -> None:
        super()._stop()
        self._wake()

    def _wake(self) -> None:
        """Have the thread look for something to do besides new events."""
        self._store.generation.wake()

    @abstractmethod
    def _hand_over(self) -> bool:
        """Hand pending events over; return whether to go on without waiting. Raises FleetMapError while it is down."""

    def _has_more(self) -> bool:
        """Whether there is something to do besides new events."""
        return False
