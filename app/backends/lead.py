"""Lead: the right to do a task that only one process may do at a time, such as relaying events.

Local: a file lock in the data folder, for all processes of one server. Shared: a lock in PostgreSQL, for all servers on
one database. A shared lead is a lease: its session ends if the server falls silent for LEASE_SECONDS, and another
server gets the lead.

Work of a leader belongs to the term in which it began. A process may lose the lead and win it again without noticing;
another one may have led meanwhile. So work asks its term whether it goes on, and transactions of an earlier term fail.
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
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final

import psycopg
from sqlalchemy import Connection

from app.backends.direct import DirectConnection
from app.backends.fence import LIMIT_IDLE_TIME, FenceError, fenced_by
from app.clock import seconds_since_boot

log = logging.getLogger(__name__)

LEASE_SECONDS: Final = 2.0
"""Silence of a server after which PostgreSQL frees its leads."""

ROUND_SECONDS: Final = 0.25
"""Interval of a server's heartbeats, and of its attempts to get leads that others have."""

POLL_SECONDS: Final = 0.05
"""Interval at which a thread that waits for a lead looks for it."""


class LeadLostError(FenceError):
    """The process no longer has the lead: another one may have it."""


@dataclass(frozen=True, slots=True)
class Term:
    """Time from winning a lead to losing it. number: of the election."""

    lead: Lead
    number: int

    @property
    def goes_on(self) -> bool:
        """Whether this process has had the lead ever since. Never blocks."""
        return self.lead.term == self

    @contextmanager
    def fenced(self) -> Iterator[None]:
        """Let transactions of this context be committed only in this term. They and this raise LeadLostError."""
        if not self.goes_on:
            raise self.lost_error()
        with fenced_by(self):
            yield

    def check(self, connection: Connection) -> None:
        """Check within a transaction, right before its commit, that the term goes on. Raises LeadLostError."""
        if not self.goes_on:
            raise self.lost_error()
        self.lead.check_term(connection, self)

    def lost_error(self) -> LeadLostError:
        """Return the error for work that another leader may have done meanwhile."""
        return LeadLostError(f"another server has taken over ({self.lead.name}): nothing was stored")


class Lead(ABC):
    """Right to do one task. Thread-safe.

    unbroken_since: number of the first term of this process after which no other process has led.
    """

    def __init__(self, name: str) -> None:
        self.name, self.unbroken_since = name, 0

    @property
    @abstractmethod
    def term(self) -> Term | None:
        """Present term; None if this process does not have the lead. Never blocks."""

    @property
    def is_held(self) -> bool:
        """Whether this process has the lead now. Work that takes some time asks its term instead. Never blocks."""
        return self.term is not None

    @abstractmethod
    def try_acquire(self) -> bool:
        """Take part in the election; return whether this process has the lead."""

    def acquire(self, seconds: float) -> Term | None:
        """Wait for the lead, at most so long; return the term, None if another process keeps the lead."""
        deadline = time.monotonic() + seconds
        while not self.try_acquire() or (term := self.term) is None:
            if time.monotonic() > deadline:
                self.release()
                return None
            time.sleep(POLL_SECONDS)
        return term

    @abstractmethod
    def release(self) -> None:
        """Give up the lead, and take part in no election until the next ``try_acquire``."""

    @contextmanager
    def fenced(self) -> Iterator[Term]:
        """Fence this context by the present term. Raises LeadLostError."""
        term = self.term or Term(self, 0)  # none has the number 0
        with term.fenced():
            yield term

    def check_term(self, connection: Connection, term: Term) -> None:  # noqa: B027  most leads need no more
        """Check in the database that a term goes on, and that none begins before the commit. Raises LeadLostError."""


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
        self._elections = 0
        self._mutex = threading.Lock()

    @property
    def term(self) -> Term | None:
        """Time for which this process has the lock."""
        return None if self._handle is None else Term(self, self._elections)

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
                self._elections += 1
                self.unbroken_since = self._elections
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
        self.won: Term | None = None
        self._last = -1  # number of its last term; none yet, and numbers begin with 1

    @property
    def term(self) -> Term | None:
        """Time for which this process has the lock. None as soon as PostgreSQL may have ended its session."""
        won = self.won
        return won if self.is_wanted and self._leads.has_lease else None

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

    def note_election(self, number: int) -> Term:
        """Note that this process has won an election; return the term. Each election has the next number."""
        if number != self._last + 1:
            self.unbroken_since = number
        self._last = number
        return Term(self, number)

    def check_term(self, connection: Connection, term: Term) -> None:
        """Check that no process has won an election since, and keep elections waiting until the commit."""
        query = f"SELECT term, {LIMIT_IDLE_TIME} FROM lead WHERE name = %s FOR SHARE"  # noqa: S608  a constant
        if connection.exec_driver_sql(query, (self.name,)).scalar() != term.number:
            raise term.lost_error()


class SharedLeads(Leads):
    """Leads among all servers on one PostgreSQL, in one session with a thread that keeps it alive.

    Args:
        url: database URL that reaches PostgreSQL itself, not a pooler of transactions.
        data_dir: folder of this server; with the name of the host it names the server to operators.
        clock: seconds; must count the time for which the host is suspended, since PostgreSQL does.
    """

    def __init__(self, url: str, data_dir: Path, clock: Callable[[], float] = seconds_since_boot) -> None:
        self._url, self._data_dir, self._clock = url, data_dir, clock
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
        return self._clock() < self._lease_until

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
        sent = self._clock()
        rows = self._connection.execute("SELECT name, holder FROM lead")
        self._lease_until = sent + LEASE_SECONDS
        self._roles = {name: holder == self._server for name, holder in rows}
        for lead in list(self._leads.values()):
            if lead.is_wanted and lead.won is None:
                lead.won = self._elect(self._connection, lead)
            elif not lead.is_wanted and lead.won is not None:
                lead.won = None
                self._connection.execute("SELECT pg_advisory_unlock(%s)", (lead.key,))

    def _elect(self, connection: DirectConnection, lead: SharedLead) -> Term | None:
        """Try to get a lead; return the new term, None if another process has it."""
        if not connection.execute("SELECT pg_try_advisory_lock(%s)", (lead.key,))[0][0]:
            return None
        query = (
            "INSERT INTO lead (name, term, holder, since) VALUES (%s, 1, %s, now()) ON CONFLICT (name) DO UPDATE "
            "SET term = lead.term + 1, holder = excluded.holder, since = excluded.since RETURNING term"
        )
        number = int(connection.execute(query, (lead.name, self._server))[0][0])
        self._roles[lead.name] = True
        log.info("leads: this server leads (task=%s, term=%d)", lead.name, number)
        return lead.note_election(number)

    def _disconnect(self) -> None:
        self._lease_until = 0.0
        for lead in self._leads.values():
            lead.won = None
        if self._connection is not None:
            with contextlib.suppress(Exception):
                self._connection.close()
            self._connection = None


def open_leads(database_url: str, data_dir: Path) -> Leads:
    """Return the leads of a process: local ones with SQLite, shared ones with PostgreSQL."""
    return LocalLeads(data_dir) if database_url.startswith("sqlite") else SharedLeads(database_url, data_dir)
