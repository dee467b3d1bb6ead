"""Open connections of one process: how many there may be, and which of them give way.

A connection is *proven* once one of its requests had a valid token or link. All others are bounded for each address,
and a quarter of the places is not for those of strangers. The oldest one gives way to a new one: a client sends its
token within milliseconds, so that a flood of silent connections displaces only itself.
"""

from __future__ import annotations

import itertools
import logging
import math
import resource
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from app.api.http.auth import client_source, is_loopback

log = logging.getLogger(__name__)

TRUST_SECONDS = 600.0
"""How long an address counts as trusted after a valid token came from it."""

MAX_TRUSTED = 10_000
RESERVED_SHARE = 4
"""One place in so many is not for connections of strangers."""

WARN_SECONDS = 60.0
OTHER_FILES = 512
"""Descriptors for all else: database, cache, workers, the router."""

FILES_PER_CONNECTION = 2
"""Its socket, and the file that it may be streamed."""


@dataclass(frozen=True, slots=True)
class ConnectionLimits:
    """What a client may take up. Times in seconds.

    Attributes:
        total: open connections.
        per_address: open connections of one address that have not been proven; loopback addresses have no such limit.
        head_seconds: time in which a request's head must have come.
        stall_seconds: time after which a client that reads an answer at less than ``pace`` is given up.
        pace: bytes per second.
    """

    total: int = 4096
    per_address: int = 512
    head_seconds: float = 20.0
    stall_seconds: float = 30.0
    pace: int = 1024


class Connection(Protocol):
    """What the registry needs of a connection."""

    @property
    def is_idle(self) -> bool:
        """Whether no request is under way."""

    def close_idle(self) -> None:
        """Close at once."""


class Connections:
    """The open connections of a process. For the thread of its event loop alone."""

    def __init__(self, limits: ConnectionLimits, clock: Callable[[], float] = time.monotonic) -> None:
        self.limits = limits
        self._clock = clock
        # Each in order of age: not proven yet, of strangers and of trusted addresses; proven.
        self._strangers: dict[Connection, str] = {}
        self._expected: dict[Connection, str] = {}
        self._proven: dict[Connection, str] = {}
        self._unproven_of: dict[str, dict[Connection, None]] = {}
        self._trusted: OrderedDict[str, float] = OrderedDict()
        self._warned = -WARN_SECONDS

    def __len__(self) -> int:
        return len(self._strangers) + len(self._expected) + len(self._proven)

    def open(self, connection: Connection, address: str | None) -> bool:
        """Register a new connection; others give way where need be. False: there is no place for it."""
        source = client_source(address)
        connections = self._unproven_of.get(source, {})
        if len(connections) >= self.limits.per_address and not is_loopback(source):
            self._displace(next(iter(connections)))
        trusted = self._trusted.get(source, -math.inf) > self._clock() or is_loopback(source)
        if not trusted and len(self._strangers) >= self.limits.total - self.limits.total // RESERVED_SHARE:
            self._displace(next(iter(self._strangers)))
        if len(self) >= self.limits.total:
            idle = (proven for proven in self._proven if proven.is_idle)
            victim = next(itertools.chain(self._strangers, self._expected, idle), None)
            if victim is None:
                self._warn("refused a connection, for all places are taken by clients with a token")
                return False
            self._displace(victim)
        (self._expected if trusted else self._strangers)[connection] = source
        self._unproven_of.setdefault(source, {})[connection] = None
        return True

    def prove(self, connection: Connection) -> None:
        """A request of it had a valid token: it gives way to no stranger, and its address is trusted for a while."""
        source = self._remove(connection)
        if source is None:
            return  # it has given way meanwhile
        self._proven[connection] = source
        self._trusted[source] = self._clock() + TRUST_SECONDS
        self._trusted.move_to_end(source)
        while len(self._trusted) > MAX_TRUSTED:
            self._trusted.popitem(last=False)

    def close(self, connection: Connection) -> None:
        """A connection has ended."""
        self._remove(connection)

    def _remove(self, connection: Connection) -> str | None:
        """Its address; None for one that is not registered."""
        if connection in self._proven:
            return self._proven.pop(connection)
        source = self._strangers.pop(connection, None)
        if source is None:
            source = self._expected.pop(connection, None)
        if source is not None:
            connections = self._unproven_of[source]
            del connections[connection]
            if not connections:
                del self._unproven_of[source]
        return source

    def _displace(self, connection: Connection) -> None:
        self._remove(connection)
        connection.close_idle()
        self._warn("the oldest connections without a token give way: there are too many")

    def _warn(self, event: str) -> None:
        if self._clock() - self._warned >= WARN_SECONDS:
            self._warned = self._clock()
            limits = self.limits
            log.warning("connections: %s (total=%d, per_address=%d)", event, limits.total, limits.per_address)


def fit_open_files(total: int) -> int:
    """Raise this process' limit of open files for so many connections; how many of them it allows."""
    required_files = total * FILES_PER_CONNECTION + OTHER_FILES
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != resource.RLIM_INFINITY and soft < required_files:
        soft = required_files if hard == resource.RLIM_INFINITY else min(required_files, hard)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    if soft == resource.RLIM_INFINITY or soft >= required_files:
        return total
    fitting = max(soft - OTHER_FILES, soft // 2) // FILES_PER_CONNECTION
    log.warning(
        "connections: the limit of open files (%d) allows %d of %d: raise it (ulimit -Hn, LimitNOFILE) or lower "
        "FLEETMAP_MAX_CONNECTIONS",
        soft,
        fitting,
        total,
    )
    return fitting
