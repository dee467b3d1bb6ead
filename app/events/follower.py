"""Following the outbox: what Zenoh, MQTT and webhooks share. Each reads the events of a position on, in order."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator
from pathlib import Path

from app.backends.lead import Leads
from app.events.leader import POLL_SECONDS, LeaderThread
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

    def __init__(self, store: Store, data_dir: Path, name: str, leads: Leads, *, well: str, trouble: str) -> None:
        super().__init__(store.generation, data_dir, name, leads, well=well, trouble=trouble)
        self._store = store

    def _run_once(self) -> None:
        """Hand over what there is, then wait for a commit."""
        generation = self._generation()
        if not self._hand_over():
            # Not forever: a notification may have been lost, and the connection must be checked.
            self._wait_for_commit(generation, POLL_SECONDS)

    @abstractmethod
    def _hand_over(self) -> bool:
        """Hand pending events over; return whether to go on without waiting. Raises FleetMapError while it is down."""
