"""Lead: the right to do a task that only one process may do at a time, such as relaying events.

Local: a file lock in the data folder, for all processes of one server. Shared: a lock in PostgreSQL, for all servers on
one database. A shared lead is a lease: its session ends if the server falls silent for LEASE_SECONDS, and another
server gets the lead. What a leader writes is fenced by its term: a transaction of a former leader fails.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import logging
import socket
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import IO, Final

import psycopg
from sqlalchemy import Connection

from app.backends.direct import DirectConnection
from app.errors import Unavailable

log = logging.getLogger(__name__)

LEASE_SECONDS: Final = 2.0
"""Silence of a server after which PostgreSQL frees its leads."""

ROUND_SECONDS: Final = 0.25
"""Interval of a server's heartbeats, and of its attempts to get leads that others have."""

FENCE_SECONDS: Final = 2.0
"""Maximum time that a transaction of a leader may block its successor, between the check of its term and its commit."""


class LeadLostError(Unavailable):
    """The process no longer has the lead: another one may have it."""


class Lead(ABC):
    """Right to do one task. Thread-safe. term: number of the election that this process won, if there are elections."""

    term: int | None = None

    def __init__(self, name: str) -> None:
        self.name = name

    @property
    @abstractmethod
    def is_held(self) -> bool:
        """Whether this process has the lead. Never blocks."""

    @abstractmethod
    def try_acquire(self) -> bool:
        """Take part in the election; return whether this process has the lead."""

    @abstractmethod
    def release(self) -> None:
        """Give up the lead, and take part in no election until the next ``try_acquire``."""

    @contextmanager
    def fenced(self) -> Iterator[None]:
        """Let transactions of this context be committed only in the present term. They and this raise LeadLostError.

        A process that loses the lead meanwhile and wins it again may not store what it has read before.
        """
        term = self.term
        if not self.is_held:
            raise self._lost_error()
        token = _fence.set((self, term))
        try:
            yield
        finally:
            _fence.reset(token)

    def check_term(self, connection: Connection, term: int | None) -> None:
        """Check within a transaction, right before its commit, that this term goes on. Raises LeadLostError."""
        del connection, term
        if not self.is_held:
            raise self._lost_error()

    def _lost_error(self) -> LeadLostError:
        return LeadLostError(f"another server has taken over ({self.name}): nothing was stored")


_fence: ContextVar[tuple[Lead, int | None] | None] = ContextVar("fence", default=None)


def check_fence(connection: Connection) -> None:
    """Check a transaction of a leader right before its commit; others pass. Raises LeadLostError."""
    fence = _fence.get()
    if fence is not None:
        lead, term = fence
        lead.check_term(connection, term)


class Leads(ABC):
    """Leads of one process."""

    @abstractmethod
    def lead(self, name: str) -> Lead:
        """Return the lead of a task among all servers on the database."""

    @abstractmethod
    def host_lead(self, name: str) -> Lead:
        """Return the lead of a task among the processes of this server."""

    @abstractmethod
    def roles(self) -> dict[str, bool]:
        """Return whether this server has the lead, by task."""

    @abstractmethod
    def start(self) -> None:
        """Start to take part in elections."""

    @abstractmethod
    def close(self) -> None:
        """Give up all leads."""


class LocalLead(Lead):
    """Lead by an exclusive lock on ``NAME.lock`` in the data folder, which ends with the process."""

    def __init__(self, data_dir: Path, name: str) -> None:
        super().__init__(name)
        self._path = data_dir / f"{name}.lock"
        self._handle: IO[str] | None = None
        self._mutex = threading.Lock()

    @property
    def is_held(self) -> bool:
        """Whether this process has the lock."""
        return self._handle is not None

    def try_acquire(self) -> bool:
        """Take the lock if it is free; return whether this process has it. Raises OSError."""
        with self._mutex:
            if self._handle is None:
                handle = self._path.open("a")
                try:
                    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except OSError:
                    handle.close()
                    return False
                self._handle = handle
            return True

    def release(self) -> None:
        """Free the lock."""
        with self._mutex:
            if self._handle is not None:
                self._handle.close()
                self._handle = None


class LocalLeads(Leads):
    """Leads of a server that has its database for itself."""

    def __init__(self, data_dir: Path) -> None:
        self._data_dir = data_dir
        self._leads: dict[str, LocalLead] = {}

    def lead(self, name: str) -> LocalLead:
        """Return the lead of a task."""
        return self._leads.setdefault(name, LocalLead(self._data_dir, name))

    def host_lead(self, name: str) -> LocalLead:
        """Return the same lead: there is no other server."""
        return self.lead(name)

    def roles(self) -> dict[str, bool]:
        """Return that this server leads all its tasks."""
        return dict.fromkeys(self._leads, True)

    def start(self) -> None:
        """Do nothing: an attempt to get a file lock takes no time."""

    def close(self) -> None:
        """Free all locks."""
        for lead in self._leads.values():
            lead.release()


class SharedLead(Lead):
    """Lead by an advisory lock in the session of ``SharedLeads``."""

    def __init__(self, leads: SharedLeads, name: str) -> None:
        super().__init__(name)
        self._leads = leads
        self.key = int.from_bytes(hashlib.sha256(f"fleetmap lead {name}".encode()).digest()[:8], "big", signed=True)
        self.is_wanted = False
        self.term = None

    @property
    def is_held(self) -> bool:
        """Whether this process has the lock, and PostgreSQL cannot have ended its session."""
        return self.is_wanted and self.term is not None and self._leads.has_lease

    def try_acquire(self) -> bool:
        """Take part in the election, which is held by the thread of ``SharedLeads``."""
        if not self.is_wanted:
            self.is_wanted = True
            self._leads.wake()
        return self.is_held

    def release(self) -> None:
        """Give up the lead; the thread frees the lock at once."""
        if self.is_wanted:
            self.is_wanted = False
            self._leads.wake()

    def check_term(self, connection: Connection, term: int | None) -> None:
        """Check that no process has won an election since, and keep elections waiting until the commit."""
        super().check_term(connection, term)
        query = (
            "SELECT term, set_config('idle_in_transaction_session_timeout', %s, true) FROM lead WHERE name = %s "
            "FOR SHARE"
        )
        row = connection.exec_driver_sql(query, (str(int(FENCE_SECONDS * 1000)), self.name)).one_or_none()
        if row is None or row.term != term:
            raise self._lost_error()


class SharedLeads(Leads):
    """Leads among all servers on one PostgreSQL, in one session with a thread that keeps it alive.

    Args:
        url: database URL that reaches PostgreSQL itself, not a pooler of transactions.
        data_dir: folder of this server; with the name of the host it names the server to operators.
    """

    def __init__(self, url: str, data_dir: Path) -> None:
        self._url, self._data_dir = url, data_dir
        self._server = f"{socket.gethostname()}:{data_dir.resolve()}"
        self._leads: dict[str, SharedLead] = {}
        self._host_leads: dict[str, LocalLead] = {}
        self._roles: dict[str, bool] = {}
        self._connection: DirectConnection | None = None
        self._lease_until = 0.0
        self._problem = ""
        self._wake, self._stopping = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="fleetmap-lead", daemon=True)

    @property
    def has_lease(self) -> bool:
        """Whether PostgreSQL cannot have ended the session: it heard of this process within LEASE_SECONDS."""
        return time.monotonic() < self._lease_until

    def lead(self, name: str) -> SharedLead:
        """Return the lead of a task."""
        return self._leads.setdefault(name, SharedLead(self, name))

    def host_lead(self, name: str) -> LocalLead:
        """Return the lead of a task among the processes of this data folder."""
        return self._host_leads.setdefault(name, LocalLead(self._data_dir, name))

    def roles(self) -> dict[str, bool]:
        """Return whether a process of this server won the last election, by task."""
        return dict(self._roles)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def wake(self) -> None:
        """Let the thread hold elections now."""
        self._wake.set()

    def close(self) -> None:
        """Stop the thread and end the session, which frees all its locks at once."""
        self._stopping.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(5)
        for lead in self._host_leads.values():
            lead.release()

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                self._hold_elections()
                if self._problem:
                    log.info("leads: connected to the database again")
                self._problem = ""
            except (psycopg.Error, OSError) as error:
                self._disconnect()
                problem = (str(error).splitlines() or [type(error).__name__])[0]
                if not self._problem:  # once, not for each attempt
                    log.warning("leads: lost the connection to the database, will retry (reason=%s)", problem)
                self._problem = problem
            except Exception:  # the thread must outlive a defect: else no server would lead
                log.exception("leads: internal error; it continues")
                self._disconnect()
            self._wake.wait(ROUND_SECONDS)
            self._wake.clear()
        self._disconnect()

    def _hold_elections(self) -> None:
        """Keep the session alive, free leads that are no longer wanted, and try to get those that are."""
        if self._connection is None:
            self._connection = DirectConnection(self._url, "fleetmap lead", idle_seconds=LEASE_SECONDS)
        sent = time.monotonic()
        rows = self._connection.execute("SELECT name, holder FROM lead")
        self._lease_until = sent + LEASE_SECONDS
        self._roles = {name: holder == self._server for name, holder in rows}
        for lead in list(self._leads.values()):
            if lead.is_wanted and lead.term is None:
                lead.term = self._elect(self._connection, lead)
            elif not lead.is_wanted and lead.term is not None:
                lead.term = None
                self._connection.execute("SELECT pg_advisory_unlock(%s)", (lead.key,))

    def _elect(self, connection: DirectConnection, lead: SharedLead) -> int | None:
        """Try to get a lead; return the new term, None if another process has it."""
        if not connection.execute("SELECT pg_try_advisory_lock(%s)", (lead.key,))[0][0]:
            return None
        query = (
            "INSERT INTO lead (name, term, holder, since) VALUES (%s, 1, %s, now()) ON CONFLICT (name) DO UPDATE "
            "SET term = lead.term + 1, holder = excluded.holder, since = excluded.since RETURNING term"
        )
        term = int(connection.execute(query, (lead.name, self._server))[0][0])
        self._roles[lead.name] = True
        log.info("leads: this server leads (task=%s, term=%d)", lead.name, term)
        return term

    def _disconnect(self) -> None:
        self._lease_until = 0.0
        for lead in self._leads.values():
            lead.term = None
        if self._connection is not None:
            with contextlib.suppress(Exception):
                self._connection.close()
            self._connection = None


def open_leads(database_url: str, data_dir: Path) -> Leads:
    """Return the leads of a process: local ones with SQLite, shared ones with PostgreSQL."""
    return LocalLeads(data_dir) if database_url.startswith("sqlite") else SharedLeads(database_url, data_dir)
