"""The outbox -> Zenoh: in order, at least once, through the loss of router, server or database.

One process of a data folder relays (it holds a file lock); where it dies, another takes over. What was published is
noted in the database after it was handed to a connected session, so what a crash leaves open is published again: robots
know by ``sequence`` what they have.
"""

from __future__ import annotations

import fcntl
import json
import logging
import os
import threading
import time
from pathlib import Path
from typing import IO, Any

from app.errors import FleetMapError, Unavailable
from app.events.bus import HISTORY, Bus
from app.store import Store
from app.store.values import Event

log = logging.getLogger(__name__)

LOOK_SECONDS = 0.004
"""How often the host's generation number is looked at: a read of shared memory."""

POLL_SECONDS = 1.0
"""How often the database is asked all the same (another host may have committed), and the session looked after."""

PAGE = 500
REPLAYED_ENVIRONMENTS = 250
"""At a start the last events of so many environments fill the publishers' caches again."""

STATE_FILE = "events.json"
LOCK_FILE = "events.lock"


class Relay:
    """A thread that publishes what the outbox holds."""

    def __init__(self, store: Store, bus: Bus, data_dir: Path) -> None:
        self._store, self._bus, self._data_dir = store, bus, data_dir
        self._ending = threading.Event()
        self._lock: IO[str] | None = None
        self._told: dict[str, str] = {}
        self._written: dict[str, str] = {}
        self._seen = -1
        self._asked = 0.0
        self._replayed_for = 0
        self._thread = threading.Thread(target=self._run, name="fleetmap-relay", daemon=True)

    def start(self) -> None:
        """Begin; returns at once."""
        self._thread.start()

    def close(self) -> None:
        """Stop, and give the lock back."""
        self._ending.set()
        self._thread.join(10)
        self._bus.close()
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def _run(self) -> None:
        while not self._ending.is_set():
            try:
                if self._lock is None:
                    self._lock = take_lock(self._data_dir / LOCK_FILE)
                    if self._lock is None:
                        self._ending.wait(POLL_SECONDS)
                        continue
                self._round()
            except FleetMapError as error:
                self._note({"state": "down", "detail": error.detail})
                self._ending.wait(POLL_SECONDS)
            except Exception:
                log.exception("the relay of events stumbled")
                self._ending.wait(POLL_SECONDS)

    def _round(self) -> None:
        """Publish what is there, then wait for more."""
        if not self._bus.tend():
            self._note(self._bus.state)
            self._ending.wait(POLL_SECONDS / 4)
            return
        self._note(self._bus.state)
        if self._replayed_for != self._bus.opened:
            self._replay()
            self._replayed_for = self._bus.opened
        generation = self._store.generation()
        self._publish_new()
        self._seen, self._asked = generation, time.monotonic()
        while not self._ending.wait(LOOK_SECONDS):
            if self._store.generation() != self._seen or time.monotonic() - self._asked > POLL_SECONDS:
                return

    def _publish_new(self) -> None:
        position = self._store.relayed()
        while not self._ending.is_set():
            page = self._store.events(None, position, PAGE)
            if not page:
                return
            for event in page:
                if not self._bus.connected:
                    return
                self._publish(event)
                position = event.position
            self._store.set_relayed(position)

    def _replay(self) -> None:
        """A new session's caches are empty: put the last events of each environment again, oldest first."""
        position = self._store.relayed()
        for event in self._store.last_events(position, HISTORY, REPLAYED_ENVIRONMENTS):
            self._publish(event)

    def _publish(self, event: Event) -> None:
        # The body says the name the environment had then; after a rename robots listen to both until they resync.
        self._bus.publish(event.environment, event.body)

    def _note(self, state: dict[str, str]) -> None:
        """Tell the log when it changes, and all workers by a file."""
        if state == self._told and (self._data_dir / STATE_FILE).exists():
            return
        if state["state"] != self._told.get("state"):
            if state["state"] == "connected":
                log.info("events go out over Zenoh at %s", self._bus.options.listen)
            else:
                log.error("NO EVENTS GO OUT: %s", state.get("detail", ""))
        self._told = state
        path = self._data_dir / STATE_FILE
        temporary = path.with_suffix(f".{os.getpid()}")
        temporary.write_text(json.dumps(state))
        temporary.replace(path)


def take_lock(path: Path) -> IO[str] | None:
    """A file that one process of a host holds locked while it is open; None where another one has it."""
    handle = path.open("a")
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        handle.close()
        return None
    return handle


def state_of(data_dir: Path, mode: str) -> dict[str, Any]:
    """What /readyz says of events: ``off``, ``starting``, ``connected`` or ``down`` with the reason."""
    if mode == "off":
        return {"state": "off"}
    try:
        found: dict[str, Any] = json.loads((data_dir / STATE_FILE).read_text())
    except (OSError, ValueError):
        return {"state": "starting"}
    return found


__all__ = ["Relay", "Unavailable", "state_of", "take_lock"]
