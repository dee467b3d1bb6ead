"""Limits on the open connections of one process, and the choice of connections to close.

A connection is *proven* once one of its requests had a valid token or link. Unproven connections are limited per
address, and those from untrusted addresses cannot use a quarter of the total. If a limit is reached, the oldest
unproven connection is closed: clients send their token within milliseconds, so a flood of silent connections
displaces only itself.
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
"""Seconds for which an address is trusted after a valid token from it."""

MAX_TRUSTED = 10_000
RESERVED_SHARE = 4
"""Reserved share of connections, as 1/N of the total, that untrusted addresses cannot use."""

WARN_SECONDS = 60.0
OTHER_FILES = 512
"""File descriptors for everything else: database, cache, workers, router."""

FILES_PER_CONNECTION = 2
"""File descriptors per connection: its socket, and a file that is streamed."""


@dataclass(frozen=True, slots=True)
class ConnectionLimits:
    """Limits for clients. Times in seconds.

    Attributes:
        total: maximum number of open connections.
        per_address: maximum number of unproven connections of one address; loopback addresses are not limited.
        head_seconds: maximum time to receive the head of a request.
        stall_seconds: time after which a client that reads slower than ``pace`` is disconnected.
        pace: minimum reading speed in bytes per second.
    """

    total: int = 4096
    per_address: int = 512
    head_seconds: float = 20.0
    stall_seconds: float = 30.0
    pace: int = 1024


class Connection(Protocol):
    """Interface of a connection for the registry."""

    @property
    def is_idle(self) -> bool:
        """Whether no request is in progress."""

    def close_idle(self) -> None:
        """Close immediately."""


class Connections:
    """Registry of a process's open connections. Not thread-safe: use it in the event loop's thread only."""

    def __init__(self, limits: ConnectionLimits, clock: Callable[[], float] = time.monotonic) -> None:
        self.limits = limits
        self._clock = clock
        # Each ordered by age: unproven of untrusted addresses, unproven of trusted addresses, proven.
        self._strangers: dict[Connection, str] = {}
        self._expected: dict[Connection, str] = {}
        self._proven: dict[Connection, str] = {}
        self._unproven_of: dict[str, dict[Connection, None]] = {}
        self._trusted: OrderedDict[str, float] = OrderedDict()
        self._warned = -WARN_SECONDS

    def __len__(self) -> int:
        return len(self._strangers) + len(self._expected) + len(self._proven)

    def open(self, connection: Connection, address: str | None) -> bool:
        """Register a new connection, closing others if necessary. Returns False if there is no room."""
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
                self._warn("connection refused: all connections are in use by clients with a token")
                return False
            self._displace(victim)
        (self._expected if trusted else self._strangers)[connection] = source
        self._unproven_of.setdefault(source, {})[connection] = None
        return True

    def prove(self, connection: Connection) -> None:
        """Mark a connection as proven: it is not closed for unproven ones, and its address is trusted for a while."""
        source = self._remove(connection)
        if source is None:
            return  # closed meanwhile
        self._proven[connection] = source
        self._trusted[source] = self._clock() + TRUST_SECONDS
        self._trusted.move_to_end(source)
        while len(self._trusted) > MAX_TRUSTED:
            self._trusted.popitem(last=False)

    def close(self, connection: Connection) -> None:
        """Unregister a closed connection."""
        self._remove(connection)

    def _remove(self, connection: Connection) -> str | None:
        """Unregister a connection and return its address; None if it is not registered."""
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
        self._warn("limit reached, closing the oldest connections without a token")

    def _warn(self, event: str) -> None:
        if self._clock() - self._warned >= WARN_SECONDS:
            self._warned = self._clock()
            limits = self.limits
            log.warning("connections: %s (total=%d, per_address=%d)", event, limits.total, limits.per_address)


def fit_open_files(total: int) -> int:
    """Raise the process's limit of open files for ``total`` connections; return how many connections it allows."""
    required_files = total * FILES_PER_CONNECTION + OTHER_FILES
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != resource.RLIM_INFINITY and soft < required_files:
        soft = required_files if hard == resource.RLIM_INFINITY else min(required_files, hard)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    if soft == resource.RLIM_INFINITY or soft >= required_files:
        return total
    fitting = max(soft - OTHER_FILES, soft // 2) // FILES_PER_CONNECTION
    log.warning(
        "connections: limit of open files (%d) allows %d of %d connections: raise it (ulimit -Hn, "
        "LimitNOFILE) or lower FLEETMAP_MAX_CONNECTIONS",
        soft,
        fitting,
        total,
    )
    return fitting
