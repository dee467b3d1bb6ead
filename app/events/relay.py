"""Relay of the outbox to Zenoh: in order and at least once, even if router, server or database fail.

One process of all servers relays; if it dies, another takes over. One process of each server has a session with Zenoh,
answers queries and is ready to take over. The database stores the position after events were passed to a connected
session, so events may be published again after a crash; robots detect repeated events by ``sequence``.

A new leader publishes new events first. Then it publishes the last events of each environment again, oldest first, so
that the caches of its publishers have them in order for late joiners.
"""

from __future__ import annotations

import time
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

from app import traces
from app.backends.lead import Leads
from app.events import leader
from app.events.bus import EVENT_CACHE_SIZE, Bus
from app.events.leader import POLL_SECONDS, STAND_BY_SECONDS, LeaderThread
from app.store.outbox import HistoryRange
from app.store.store import Store
from app.store.values import Event

COMMIT_POLL_SECONDS = 0.004
"""Interval between two reads of the commit counter in shared memory."""

PAGE = 500
MAX_REPLAYED_EVENTS = 20_000
"""Maximum number of events republished at start to fill the publishers' caches, the newest of each environment."""

REPLAY_SECONDS = 0.05
"""Duration of republishing after which new events are published."""

NAME = "events"


class Relay(LeaderThread):
    """Thread that publishes the events of the outbox."""

    def __init__(self, store: Store, bus: Bus, data_dir: Path, leads: Leads) -> None:
        super().__init__(
            data_dir,
            NAME,
            leads,
            well=f"event relay: connected to Zenoh at {bus.endpoints}",
            trouble="event relay: down",
        )
        self._store, self._bus = store, bus
        self._replayed_for = 0
        self._history: deque[HistoryRange] = deque()
        self._chooser = ThreadPoolExecutor(1, thread_name_prefix="fleetmap-history")
        self._choice: Future[list[HistoryRange]] | None = None
        self._checked = 0.0

    def _release(self) -> None:
        self._bus.close()
        self._chooser.shutdown(wait=False, cancel_futures=True)

    def _is_able(self) -> bool:
        return self._bus.ensure_connected()

    def _stand_by(self) -> None:
        """Stay connected without publishers, so that late joiners ask only the leader for history."""
        if self._replayed_for and not self._lead.is_held:
            self._replayed_for, self._choice = 0, None
            self._history.clear()
            self._bus.close_publishers()
        state = self._bus.state
        if state["state"] != "connected":
            self._publish_state(state)
            self._stopping.wait(POLL_SECONDS / 4)
            return
        if time.monotonic() - self._checked > POLL_SECONDS:
            self._store.events.relay_position()
            self._checked = time.monotonic()
        self._publish_state({**state, "leader": False})
        self._stopping.wait(STAND_BY_SECONDS)

    def _run_once(self) -> None:
        """Publish pending events, then wait for more, or go on with the history."""
        generation = self._store.generation()
        self._publish_new()
        if self._replayed_for != self._bus.opened:
            position = self._store.events.relay_position()
            history = self._store.events.history
            self._choice = self._chooser.submit(history, position, EVENT_CACHE_SIZE, MAX_REPLAYED_EVENTS)
            self._replayed_for = self._bus.opened
        self._take_choice()
        self._publish_state({**self._bus.state, "leader": True})  # only now: without the database nothing is published
        if self._history:
            self._replay()
            return
        # Also return periodically: a notification may have been lost, and the session must be checked.
        last_read = time.monotonic()
        while self._lead.is_held and not self._stopping.wait(COMMIT_POLL_SECONDS):
            is_chosen = self._choice is not None and self._choice.done()
            if is_chosen or self._store.generation() != generation or time.monotonic() - last_read > POLL_SECONDS:
                return

    def _publish_new(self) -> None:
        position = self._store.events.relay_position()
        while not self._stopping.is_set():
            page = self._store.events.page(None, position, PAGE)
            if not page:
                return
            for event in page:
                if not self._bus.connected or not self._lead.is_held:
                    return
                self._publish(event)
                position = event.position
            with self._lead.fenced():
                self._store.events.set_relayed(position)

    def _take_choice(self) -> None:
        """Begin to republish the history once it is chosen, which may take a second with a long log."""
        if self._choice is None or not self._choice.done():
            return
        choice, self._choice = self._choice, None
        try:
            self._history = deque(choice.result())
        except Exception:
            self._replayed_for = 0
            raise

    def _replay(self) -> None:
        """Publish the last events of some environments again, also those that were new just now."""
        started, position = time.monotonic(), self._store.events.relay_position()
        while self._history and time.monotonic() - started < REPLAY_SECONDS:
            for event in self._store.events.last(self._history.popleft(), EVENT_CACHE_SIZE, position):
                if self._stopping.is_set() or not self._lead.is_held:
                    return
                self._publish(event)

    def _publish(self, event: Event) -> None:
        # After a rename the body keeps the old name; robots subscribe to both until they have synced.
        with traces.span("publish", environment=event.environment, type=event.body["type"], sequence=event.sequence):
            self._bus.publish(event.environment, event.body)


def relay_state(data_dir: Path, mode: str) -> dict[str, Any]:
    """Return the state of the relay for /readyz: ``off``, ``starting``, ``connected`` or ``down`` with the reason."""
    return {"state": "off"} if mode == "off" else leader.read_state(data_dir, NAME)
