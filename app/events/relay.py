"""Relay of the outbox to Zenoh or an MQTT broker: in order and at least once, whatever fails meanwhile.

One process of all servers relays; if it dies, another takes over. One process of each server is connected and ready to
take over (with Zenoh it also answers queries). The database stores the position after events were accepted, so events
may be published again after a crash; receivers detect repeated events by ``sequence``.

A new leader publishes new events first. Then it publishes the last events of each environment again, oldest first, so
that late joiners find them in order: with Zenoh in the caches of its publishers, with MQTT as retained messages.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Protocol

from app import traces
from app.backends.lead import Leads, Term
from app.events import leader
from app.events.follower import Follower, pages_after
from app.events.leader import POLL_SECONDS, STAND_BY_SECONDS
from app.store.outbox import HistoryRange, RelayName
from app.store.store import Store
from app.store.values import Event

MAX_REPLAYED_EVENTS = 20_000
"""Maximum number of events republished at start for late joiners, the newest of each environment."""

REPLAY_SECONDS = 0.05
"""Duration of republishing after which new events are published."""

NAMES: Mapping[RelayName, str] = {"zenoh": "events", "mqtt": "mqtt"}
"""Names of the leads and of the state files."""


class Outlet(Protocol):
    """Where a relay publishes events.

    history: number of the newest events of each environment that late joiners get. opened: number of sessions so far.
    """

    relay: RelayName
    history: int
    opened: int

    @property
    def title(self) -> str:
        """Where it is connected to, for the log."""

    @property
    def state(self) -> dict[str, str]:
        """``{state: connected | down, detail?}`` for /readyz."""

    @property
    def connected(self) -> bool:
        """Whether events can be published now."""

    def ensure_connected(self) -> bool:
        """Connect again if needed; return whether it is connected."""

    def publish(self, environment: str, body: Mapping[str, Any]) -> None:
        """Publish an event. Raises Unavailable."""

    def flush(self) -> None:
        """Wait until all published events are accepted. Raises Unavailable."""

    def close_publishers(self) -> None:
        """Give up what only the leader needs."""

    def close(self) -> None:
        """Disconnect."""


class Relay(Follower):
    """Thread that publishes the events of the outbox."""

    def __init__(self, store: Store, outlet: Outlet, data_dir: Path, leads: Leads) -> None:
        super().__init__(
            store,
            data_dir,
            NAMES[outlet.relay],
            leads,
            well=f"event relay: connected to {outlet.title}",
            trouble="event relay: down",
        )
        self._outlet = outlet
        self._published_in: Term | None = None
        self._replayed_for = 0
        self._history: deque[HistoryRange] = deque()
        self._chooser = ThreadPoolExecutor(1, thread_name_prefix="fleetmap-history")
        self._choice: Future[list[HistoryRange]] | None = None
        self._checked = 0.0

    def _release(self) -> None:
        self._outlet.close()
        self._chooser.shutdown(wait=False, cancel_futures=True)

    def _is_able(self) -> bool:
        return self._outlet.ensure_connected()

    def _stand_by(self) -> None:
        """Stay connected without publishers, so that late joiners ask only the leader for history."""
        if not self._lead.is_held:
            self._forget()
        state = self._outlet.state
        if state["state"] != "connected":
            self._publish_state(state)
            self._stopping.wait(POLL_SECONDS / 4)
            return
        if time.monotonic() - self._checked > POLL_SECONDS:
            self._position()
            self._checked = time.monotonic()
        self._publish_state({**state, "leader": False})
        self._stopping.wait(STAND_BY_SECONDS)

    def _forget(self) -> None:
        """Give up the publishers and the history: another server publishes, or has published meanwhile."""
        if self._published_in is not None:
            self._published_in, self._replayed_for, self._choice = None, 0, None
            self._history.clear()
            self._outlet.close_publishers()

    def _hand_over(self) -> bool:
        """Publish pending events, and go on with the history."""
        if self._published_in != self._term:
            self._forget()
        self._published_in = self._term
        self._publish_new()
        outlet = self._outlet
        if self._replayed_for != outlet.opened:
            history = self._store.events.history
            self._choice = self._chooser.submit(history, self._position(), outlet.history, MAX_REPLAYED_EVENTS)
            self._choice.add_done_callback(lambda _: self._wake())
            self._replayed_for = outlet.opened
        self._take_choice()
        self._publish_state({**outlet.state, "leader": True})  # only now: without the database nothing is published
        if self._history:
            self._replay()
            return True
        return False

    def _has_more(self) -> bool:
        return self._choice is not None and self._choice.done()

    def _position(self) -> int:
        # A broker keeps only the last event of each environment, so it does not get a log of years at first.
        return self._store.events.relay_position(self._outlet.relay, from_now=self._outlet.relay == "mqtt")

    def _publish_new(self) -> None:
        for page in pages_after(self._store, self._position(), self._stopping.is_set):
            for event in page:
                if not self._outlet.connected or not self._term.goes_on:
                    return
                self._publish(event)
            self._outlet.flush()
            self._store.events.set_relayed(page[-1].position, self._outlet.relay)

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
        started, position = time.monotonic(), self._position()
        while self._history and time.monotonic() - started < REPLAY_SECONDS:
            for event in self._store.events.last(self._history.popleft(), self._outlet.history, position):
                if self._is_ending():
                    return
                self._publish(event)
        self._outlet.flush()

    def _publish(self, event: Event) -> None:
        # After a rename the body keeps the old name; robots subscribe to both until they have synced.
        with traces.span("publish", environment=event.environment, type=event.body["type"], sequence=event.sequence):
            self._outlet.publish(event.environment, event.body)


def relay_state(data_dir: Path, mode: str, relay: RelayName = "zenoh") -> dict[str, Any]:
    """Return the state of a relay for /readyz: ``off``, ``starting``, ``connected`` or ``down`` with the reason."""
    return {"state": "off"} if mode == "off" else leader.read_state(data_dir, NAMES[relay])
