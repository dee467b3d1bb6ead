"""Run a background thread in one process of each server, of which one at a time leads among all servers."""

from __future__ import annotations

import contextlib
import json
import logging
import threading
import time
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

from app.backends.documents import write_private
from app.backends.lead import LeadLostError, Leads, Term
from app.backends.notify import CommitCounter
from app.errors import FleetMapError

log = logging.getLogger(__name__)

POLL_SECONDS = 1.0
"""Interval between attempts of a server's other processes to get its lock, and pause after an error."""

WAIT_SECONDS = 0.2
"""Longest wait for a commit until a thread checks that it still leads, and for a call that should have woken it."""

STAND_BY_SECONDS = 0.05
"""Interval at which the process that takes part for its server checks whether it leads."""


class LeaderThread(ABC):
    """Thread that works after commits while its process leads.

    It writes its state to ``NAME.json`` for all processes of the server.

    Args:
        generation: counter of the commits.
        well: log line when the state becomes ``connected``.
        trouble: start of the log line when the state becomes ``down``.
    """

    interval_seconds = 0.004
    """Shortest time between two looks at the database, so that a burst of commits costs one."""

    _term: Term
    """Term in which the present ``_run_once`` began: it stores nothing in a later one."""

    def __init__(
        self, generation: CommitCounter, data_dir: Path, name: str, leads: Leads, *, well: str, trouble: str
    ) -> None:
        self._generation = generation
        self._data_dir, self._name, self._healthy_state, self._problem = data_dir, name, well, trouble
        self._host_lead, self._lead = leads.host_lead(name), leads.lead(name)
        self._is_new = True
        self._logged_state: dict[str, Any] = {}
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"fleetmap-{name}", daemon=True)

    def start(self) -> None:
        """Start the thread and return at once. Replaces the state of a killed process if the lock is free."""
        with contextlib.suppress(OSError):  # the thread tries again and reports the error
            self._try_represent()
        self._thread.start()

    def close(self) -> None:
        """Stop the thread, release its resources and then the lead."""
        self._stopping.set()
        self._wake()
        self._thread.join(15)
        self._release()
        self._lead.release()
        self._host_lead.release()

    @abstractmethod
    def _run_once(self) -> None:
        """Do pending work, then wait for more. Raises FleetMapError while it is down."""

    @abstractmethod
    def _release(self) -> None:
        """Release resources."""

    def _is_able(self) -> bool:
        """Whether this process could work now. One that cannot leaves the lead to others."""
        return True

    def _stand_by(self) -> None:
        """Wait while another server leads, or this process is not able to. Raises FleetMapError while it is down."""
        self._publish_state({"state": "standby"})
        self._stopping.wait(STAND_BY_SECONDS)

    def _on_unexpected_error(self) -> None:
        """Log an internal error. Subclasses may also clean up."""
        log.exception("%s: unexpected error; retrying", self._thread.name)

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                if not self._try_represent():
                    self._stopping.wait(POLL_SECONDS)
                elif not self._is_able():
                    if self._lead is not self._host_lead:
                        self._lead.release()
                    self._stand_by()
                elif self._lead.try_acquire():
                    with self._lead.fenced() as self._term:
                        self._run_once()
                else:
                    self._stand_by()
            except LeadLostError as error:
                log.info("%s: %s", self._thread.name, error.detail)
            except FleetMapError as error:
                self._publish_state({"state": "down", "detail": error.detail})
                self._stopping.wait(POLL_SECONDS)
            except Exception:  # noqa: BLE001  logged by _on_unexpected_error
                self._on_unexpected_error()
                self._stopping.wait(POLL_SECONDS)

    def _wait_for_commit(self, generation: int, seconds: float) -> None:
        """Wait until the counter is no longer at ``generation``, or there is more to do; at most ``seconds``."""
        start = time.monotonic()
        while not self._is_ending():
            age = time.monotonic() - start
            if self._generation() != generation or age > seconds or self._has_more():
                self._stopping.wait(self.interval_seconds - age)
                return
            self._generation.wait(generation, min(WAIT_SECONDS, seconds))

    def _has_more(self) -> bool:
        """Whether there is something to do besides what was committed."""
        return False

    def _wake(self) -> None:
        """Have the thread look for something to do besides what was committed."""
        self._generation.wake()

    def _is_ending(self) -> bool:
        """Whether to end ``_run_once``: the process stops, or another server may lead or have led meanwhile."""
        return self._stopping.is_set() or not self._term.goes_on

    def _try_represent(self) -> bool:
        """Become the one process of this server that takes part; return whether it is this one."""
        if not self._host_lead.try_acquire():
            return False
        if self._is_new:
            self._is_new = False
            self._publish_state({"state": "starting"})
        return True

    def _publish_state(self, state: dict[str, Any]) -> None:
        """Write the state to its file, and log changes."""
        path = _state_file(self._data_dir, self._name)
        if state == self._logged_state and path.exists():
            return
        if state["state"] != self._logged_state.get("state"):
            if state["state"] == "down":
                log.error("%s: %s", self._problem, state.get("detail", ""))
            elif state["state"] == "connected":
                log.info("%s", self._healthy_state)
        self._logged_state = state
        try:
            write_private(path, json.dumps(state).encode())
        except OSError as error:  # keep running on a full disk
            log.warning("%s: could not write %s: %s", self._thread.name, path.name, error.strerror)


def read_state(data_dir: Path, name: str) -> dict[str, Any]:
    """Read the state of a leader thread for /readyz.

    It is ``starting``, ``connected``, ``standby``, or ``down`` with the reason.
    """
    try:
        state: dict[str, Any] = json.loads(_state_file(data_dir, name).read_text())
    except (OSError, ValueError):
        return {"state": "starting"}
    return state


def _state_file(data_dir: Path, name: str) -> Path:
    return data_dir / f"{name}.json"
