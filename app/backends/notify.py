"""Notify: a number that changes with each commit, which caches and streams compare.

Local: eight bytes of a file in the blob folder, mapped into memory by all processes of a server; reading them takes
less than a microsecond, a database query about a hundred, and threads can wait for their change. Shared: a commit also
notifies the other servers through PostgreSQL, and one process of each changes the number there. Notifications may be
lost with a connection, so caches expire after one second anyway, and what waits for commits reads the database now and
then.
"""

from __future__ import annotations

import contextlib
import logging
import mmap
import os
import secrets
import struct
import threading
import time
from pathlib import Path
from typing import Final, Protocol

import psycopg
from sqlalchemy import Connection

from app.backends.direct import DirectConnection
from app.backends.futex import POLL_SECONDS, Futex
from app.backends.lead import Lead

log = logging.getLogger(__name__)

CHANNEL: Final = "fleetmap_commit"
CHECK_SECONDS: Final = 1.0
"""Silence after which the listening connection is checked."""

RETRY_SECONDS: Final = 0.5

NAME = ".generation"
_NUMBER = struct.Struct("<Q")


def new_number() -> int:
    """Return a random number for the commit counter."""
    return secrets.randbits(64)


class CommitCounter:
    """Commit counter, opened on first use; without a folder it counts commits of this process only."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._map: mmap.mmap | None = None
        self._futex: Futex | None = None
        self._number = 0
        self._lock = threading.Lock()

    def __call__(self) -> int:
        """Return the current number."""
        shared = self._map or self._open()
        return self._number if shared is None else int(_NUMBER.unpack_from(shared)[0])

    def change(self, number: int | None = None) -> None:
        """Set another number after a commit. Default: a random one, so that processes need not agree on the next."""
        number = new_number() if number is None else number
        shared = self._map or self._open()
        if shared is None:
            self._number = number
        else:
            _NUMBER.pack_into(shared, 0, number)
        self.wake()

    def wait(self, number: int, seconds: float) -> bool:
        """Wait while the number is ``number``, but no longer than so many seconds; return whether it is another one.

        May return early with False, for example after ``wake`` or ``close``.
        """
        if self() != number:
            return True
        futex = self._futex
        if futex is None:
            time.sleep(min(seconds, POLL_SECONDS))
        else:
            futex.wait(number % 2**32, seconds)
        return self._futex is futex and self() != number

    def wake(self) -> None:
        """End the waits of all threads, since there is something else to do."""
        futex = self._futex
        if futex is not None:
            futex.wake()

    def close(self) -> None:
        """Give up the mapping, which ends with its last reader."""
        with self._lock:
            self.wake()
            self._futex = self._map = None

    def _open(self) -> mmap.mmap | None:
        with self._lock:
            if self._map is None and self._folder.is_dir():
                try:
                    descriptor = os.open(self._folder / NAME, os.O_RDWR | os.O_CREAT, 0o600)
                except OSError:  # read-only disk: no process on this host commits
                    return None
                try:
                    if os.fstat(descriptor).st_size < _NUMBER.size:
                        # not a sparse file: on a full disk, access to its mapping would kill the process
                        os.pwrite(descriptor, bytes(_NUMBER.size), 0)
                    memory = mmap.mmap(descriptor, _NUMBER.size)
                    self._futex = Futex(memory)
                    self._map = memory
                except OSError:
                    return None
                finally:
                    os.close(descriptor)
            return self._map


class Notifier(Protocol):
    """How a commit becomes known to other servers."""

    def announce(self, connection: Connection, number: int) -> None:
        """Announce, within the transaction of a commit, the number that the counter gets afterwards."""


class LocalNotifier:
    """Notifier of a server that has its database for itself: the commit counter suffices."""

    def announce(self, connection: Connection, number: int) -> None:
        """Do nothing."""


class SharedNotifier:
    """Notifier of the servers on one PostgreSQL, which delivers a notification with the commit."""

    def announce(self, connection: Connection, number: int) -> None:
        """Notify all servers."""
        connection.exec_driver_sql("SELECT pg_notify(%s, %s)", (CHANNEL, str(number)))


class Listener:
    """Thread that changes the commit counter when other servers commit, in one process of each server.

    Args:
        url: database URL that reaches PostgreSQL itself, not a pooler of transactions.
        lead: lead among the processes of this server.
    """

    def __init__(self, url: str, counter: CommitCounter, lead: Lead) -> None:
        self._url, self._counter, self._lead = url, counter, lead
        self._connection: DirectConnection | None = None
        self._is_down = False
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="fleetmap-notify", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def close(self) -> None:
        """Stop the thread."""
        self._stopping.set()
        connection = self._connection
        if connection is not None:
            connection.close()
        self._thread.join(5)
        self._lead.release()

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                if self._lead.try_acquire():
                    self._listen()
                else:
                    self._stopping.wait(CHECK_SECONDS)
            except (psycopg.Error, OSError) as error:
                if not self._is_down and not self._stopping.is_set():  # once, not for each attempt
                    reason = (str(error).splitlines() or [type(error).__name__])[0]
                    log.warning("notifications: lost the connection, will retry (reason=%s)", reason)
                self._is_down = True
                self._stopping.wait(RETRY_SECONDS)
            finally:
                self._disconnect()

    def _listen(self) -> None:
        """Change the counter for each commit of another server until the connection fails."""
        self._connection = connection = DirectConnection(self._url, "fleetmap notify")
        connection.execute(f"LISTEN {CHANNEL}")
        self._counter.change()  # commits may have been missed
        if self._is_down:
            log.info("notifications: connected again")
        self._is_down = False
        while not self._stopping.is_set():
            numbers = connection.notifications(CHECK_SECONDS)
            if not numbers:
                connection.execute("SELECT 1")  # fails if the network has gone silent
            elif numbers[-1] != str(self._counter()):  # else a commit of this server
                self._counter.change()

    def _disconnect(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            with contextlib.suppress(Exception):
                connection.close()
