"""The outbox -> Zenoh: in order, at least once, through the loss of router, server or database.

One process of a data folder relays (it holds a file lock); where it dies, another takes over. What was published is
noted in the database after it was handed to a connected session, so what a crash leaves open is published again: robots
know by ``sequence`` what they have.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from app.events import leader
from app.events.bus import EVENT_CACHE_SIZE, Bus
from app.events.leader import POLL_SECONDS, LeaderThread
from app.store.store import Store
from app.store.values import Event

COMMIT_POLL_SECONDS = 0.004
"""How often the host's generation number is looked at: a read of shared memory."""

PAGE = 500
MAX_REPLAYED_EVENTS = 20_000
"""At a start so many events fill the publishers' caches again: where environments are many, the last ones of each."""

NAME = "events"


class Relay(LeaderThread):
    """A thread that publishes what the outbox holds."""

    def __init__(self, store: Store, bus: Bus, data_dir: Path) -> None:
        super().__init__(
            data_dir, NAME, well=f"events go out over Zenoh at {bus.endpoints}", trouble="NO EVENTS GO OUT"
        )
        self._store, self._bus = store, bus
        self._replayed_for = 0

    def _release(self) -> None:
        self._bus.close()

    def _run_once(self) -> None:
        """Publish what is there, then wait for more."""
        if not self._bus.ensure_connected():
            self._publish_state(self._bus.state)
            self._stopping.wait(POLL_SECONDS / 4)
            return
        if self._replayed_for != self._bus.opened:
            self._replay()
            self._replayed_for = self._bus.opened
        generation = self._store.generation()
        self._publish_new()
        self._publish_state(self._bus.state)  # not before: nothing goes out while the database is away
        # The database is asked all the same (another host may have committed), and the session looked after.
        last_read = time.monotonic()
        while not self._stopping.wait(COMMIT_POLL_SECONDS):
            if self._store.generation() != generation or time.monotonic() - last_read > POLL_SECONDS:
                return

    def _publish_new(self) -> None:
        position = self._store.events.relay_position()
        while not self._stopping.is_set():
            page = self._store.events.page(None, position, PAGE)
            if not page:
                return
            for event in page:
                if not self._bus.connected:
                    return
                self._publish(event)
                position = event.position
            self._store.events.set_relayed(position)

    def _replay(self) -> None:
        """A new session's caches are empty: put the last events of each environment again, oldest first."""
        position = self._store.events.relay_position()
        for event in self._store.events.last(position, EVENT_CACHE_SIZE, MAX_REPLAYED_EVENTS):
            if self._stopping.is_set():
                return
            self._publish(event)

    def _publish(self, event: Event) -> None:
        # The body says the name the environment had then; after a rename robots listen to both until they resync.
        self._bus.publish(event.environment, event.body)


def relay_state(data_dir: Path, mode: str) -> dict[str, Any]:
    """What /readyz says of events: ``off``, ``starting``, ``connected`` or ``down`` with the reason."""
    return {"state": "off"} if mode == "off" else leader.read_state(data_dir, NAME)
