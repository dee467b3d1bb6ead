"""Relay of the outbox to Zenoh: in order and at least once, even if router, server or database fail.

One process per data folder relays, elected by a file lock; if it dies, another takes over. The database stores the
position after events were passed to a connected session, so events may be published again after a crash; robots detect
repeated events by ``sequence``.
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
"""Interval between two reads of the commit counter in shared memory."""

PAGE = 500
MAX_REPLAYED_EVENTS = 20_000
"""Maximum number of events republished at start to fill the publishers' caches, the newest of each environment."""

NAME = "events"


class Relay(LeaderThread):
    """Thread that publishes the events of the outbox."""

    def __init__(self, store: Store, bus: Bus, data_dir: Path) -> None:
        super().__init__(
            data_dir, NAME, well=f"event relay: connected to Zenoh at {bus.endpoints}", trouble="event relay: down"
        )
        self._store, self._bus = store, bus
        self._replayed_for = 0

    def _release(self) -> None:
        self._bus.close()

    def _run_once(self) -> None:
        """Publish pending events, then wait for more."""
        if not self._bus.ensure_connected():
            self._publish_state(self._bus.state)
            self._stopping.wait(POLL_SECONDS / 4)
            return
        if self._replayed_for != self._bus.opened:
            self._replay()
            self._replayed_for = self._bus.opened
        generation = self._store.generation()
        self._publish_new()
        self._publish_state(self._bus.state)  # only now: without the database nothing is published
        # Also return periodically: another host may have committed, and the session must be checked.
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
        """Fill the empty caches of a new session: publish the last events of each environment again, oldest first."""
        position = self._store.events.relay_position()
        for event in self._store.events.last(position, EVENT_CACHE_SIZE, MAX_REPLAYED_EVENTS):
            if self._stopping.is_set():
                return
            self._publish(event)

    def _publish(self, event: Event) -> None:
        # After a rename the body keeps the old name; robots subscribe to both until they have synced.
        self._bus.publish(event.environment, event.body)


def relay_state(data_dir: Path, mode: str) -> dict[str, Any]:
    """Return the state of the relay for /readyz: ``off``, ``starting``, ``connected`` or ``down`` with the reason."""
    return {"state": "off"} if mode == "off" else leader.read_state(data_dir, NAME)
