"""A thread that one process of a data folder has, of all that could: the others wait for its end."""

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
"""How often the others look whether they are needed, and how long a pause is after something went wrong."""


class LeaderThread(ABC):
    """It does rounds while it holds the lock ``NAME.lock``, and says in ``NAME.json`` how it stands, for all processes.

    well, trouble: what the log says when it is connected, and when it is down.
    """

    def __init__(self, data_dir: Path, name: str, *, well: str, trouble: str) -> None:
        self._data_dir, self._name, self._healthy_state, self._problem = data_dir, name, well, trouble
        self._lock: IO[str] | None = None
        self._logged_state: dict[str, Any] = {}
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"fleetmap-{name}", daemon=True)

    def start(self) -> None:
        """Begin; returns at once. What a process said that was killed no longer holds from here on."""
        with contextlib.suppress(OSError):  # the thread tries again, and tells
            self._try_lock()
        self._thread.start()

    def close(self) -> None:
        """Stop, take back what is out, and give the lock to the next one."""
        self._stopping.set()
        self._thread.join(15)
        self._release()
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    @abstractmethod
    def _run_once(self) -> None:
        """Do what there is to do, then wait for more. FleetMapError: it is down for now."""

    @abstractmethod
    def _release(self) -> None:
        """Take back what is out."""

    def _on_unexpected_error(self) -> None:
        """After an error of our own: its log entry, and what else helps."""
        log.exception("%s stumbled", self._thread.name)

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
            except Exception:  # noqa: BLE001  logged by _stumbled
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
        """Tell the log when it changes, and all processes by a file."""
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
        except OSError as error:  # a full disk stops no event
            log.warning("%s cannot be written: %s", path.name, error.strerror)


def read_state(data_dir: Path, name: str) -> dict[str, Any]:
    """What /readyz says: ``starting``, ``connected``, or ``down`` with the reason."""
    try:
        state: dict[str, Any] = json.loads(_state_file(data_dir, name).read_text())
    except (OSError, ValueError):
        return {"state": "starting"}
    return state


def _state_file(data_dir: Path, name: str) -> Path:
    return data_dir / f"{name}.json"
