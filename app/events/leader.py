"""Run a background thread in exactly one process per data folder, elected by a file lock."""

from __future__ import annotations

import contextlib
import fcntl
import json
import logging
import os
import threading
from abc import ABC, abstractmethod
from pathlib import Path
from typing import IO, Any

from app.errors import FleetMapError

log = logging.getLogger(__name__)

POLL_SECONDS = 1.0
"""Interval between attempts of the other processes to get the lock, and pause after an error."""


class LeaderThread(ABC):
    """Thread that works while it holds the lock ``NAME.lock``. Writes its state to ``NAME.json`` for all processes.

    Args:
        well: log line when the state becomes ``connected``.
        trouble: start of the log line when the state becomes ``down``.
    """

    def __init__(self, data_dir: Path, name: str, *, well: str, trouble: str) -> None:
        self._data_dir, self._name, self._healthy_state, self._problem = data_dir, name, well, trouble
        self._lock: IO[str] | None = None
        self._logged_state: dict[str, Any] = {}
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"fleetmap-{name}", daemon=True)

    def start(self) -> None:
        """Start the thread and return at once. Replaces the state of a killed process if the lock is free."""
        with contextlib.suppress(OSError):  # the thread tries again and reports the error
            self._try_lock()
        self._thread.start()

    def close(self) -> None:
        """Stop the thread, release its resources and then the lock."""
        self._stopping.set()
        self._thread.join(15)
        self._release()
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    @abstractmethod
    def _run_once(self) -> None:
        """Do pending work, then wait for more. Raises FleetMapError while it is down."""

    @abstractmethod
    def _release(self) -> None:
        """Release resources."""

    def _on_unexpected_error(self) -> None:
        """Log an internal error. Subclasses may also clean up."""
        log.exception("%s: unexpected error; retrying", self._thread.name)

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                if self._try_lock():
                    self._run_once()
                else:
                    self._stopping.wait(POLL_SECONDS)
            except FleetMapError as error:
                self._publish_state({"state": "down", "detail": error.detail})
                self._stopping.wait(POLL_SECONDS)
            except Exception:  # noqa: BLE001  logged by _on_unexpected_error
                self._on_unexpected_error()
                self._stopping.wait(POLL_SECONDS)

    def _try_lock(self) -> bool:
        if self._lock is None:
            handle = (self._data_dir / f"{self._name}.lock").open("a")
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                handle.close()
                return False
            self._lock = handle
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
        temporary = path.with_suffix(f".{os.getpid()}")
        try:
            temporary.write_text(json.dumps(state))
            temporary.replace(path)
        except OSError as error:  # keep running on a full disk
            log.warning("%s: could not write %s: %s", self._thread.name, path.name, error.strerror)


def read_state(data_dir: Path, name: str) -> dict[str, Any]:
    """Read the state of a leader thread for /readyz: ``starting``, ``connected``, or ``down`` with the reason."""
    try:
        state: dict[str, Any] = json.loads(_state_file(data_dir, name).read_text())
    except (OSError, ValueError):
        return {"state": "starting"}
    return state


def _state_file(data_dir: Path, name: str) -> Path:
    return data_dir / f"{name}.json"
