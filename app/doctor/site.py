"""The installation that is examined: its settings, and ways to look at the machine that tests can replace."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path

import httpx

from app.backends.s3_faults import Fault, check_endpoint
from app.config import Settings
from app.errors import FleetMapError, Unavailable
from app.events.credentials import server_ssl_context
from app.main import open_store
from app.store.store import Store

REQUEST_SECONDS = 10.0
CGROUP_LIMIT = Path("/sys/fs/cgroup/memory.max")
CLOCK_ERROR = 5
"""State of the kernel's clock (``adjtimex``) without synchronisation."""


def machine_memory() -> int:
    """Return the memory in bytes that this machine or container has."""
    total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    try:
        limit = CGROUP_LIMIT.read_text().strip()
    except OSError:
        return total
    return min(total, int(limit)) if limit.isdigit() else total


def is_clock_synchronised() -> bool | None:
    """Return whether the kernel's clock is kept right by a time service; None if the system does not say."""
    state = ctypes.create_string_buffer(256)  # struct timex, with mode 0: it is only read
    try:
        result = ctypes.CDLL(None).adjtimex(state)
    except (AttributeError, OSError):
        return None
    return None if result < 0 else bool(result != CLOCK_ERROR)


@dataclass(frozen=True)
class Site:
    """An installation.

    unknown: warnings about variables that no setting has. server: address of the running server, if it was given.
    environment: variables. statvfs, now, memory, clock_state: of the machine.
    """

    settings: Settings
    unknown: tuple[str, ...] = ()
    server: str | None = None
    environment: Mapping[str, str] = field(default_factory=dict)
    statvfs: Callable[[Path], os.statvfs_result] = os.statvfs
    now: Callable[[], datetime] = lambda: datetime.now(UTC)
    memory: Callable[[], int] = machine_memory
    clock_state: Callable[[], bool | None] = is_clock_synchronised

    @property
    def database_file(self) -> Path | None:
        """File of the SQLite database; None with PostgreSQL."""
        url = self.settings.database
        return Path(url.removeprefix("sqlite:///")) if url.startswith("sqlite:///") else None

    @property
    def has_database(self) -> bool:
        """Whether there can be a database: a server creates SQLite's file at its first start."""
        return self.database_file is None or self.database_file.exists()

    @cached_property
    def store(self) -> Store:
        """Store of the settings, opened only for reading, once; without its files, if their address is unusable."""
        settings = self.settings
        if self.endpoint_fault is not None:
            settings = settings.model_copy(update={"blob_url": None, "blob_access_key": None})
        return open_store(settings, readonly=True)

    @property
    def endpoint_fault(self) -> Fault | None:
        """What is wrong with the address of the S3 server."""
        return check_endpoint() if (self.settings.blob_url or "").startswith("s3://") else None

    @cached_property
    def is_database_usable(self) -> bool:
        """Whether the database answers, is one, and has a schema for this release."""
        try:
            self.store.database_versions()
            self.store.check()
        except FleetMapError:
            return False
        return True

    def close(self) -> None:
        """Close the store, if a check has opened it."""
        if "store" in self.__dict__:
            self.store.close()

    def fetch(self, path: str, address: str | None = None) -> httpx.Response:
        """Get an answer of the running server. Raises Unavailable without one, Invalid for an unusable FLEETMAP_CA."""
        base = (address or self.server or "").rstrip("/")
        ca = self.environment.get("FLEETMAP_CA")
        verify = server_ssl_context(base, Path(ca) if ca else None)
        try:
            return httpx.get(base + path, timeout=REQUEST_SECONDS, verify=verify, trust_env=False)
        except (httpx.HTTPError, httpx.InvalidURL) as error:
            raise Unavailable(f"{base} does not answer: {error or type(error).__name__}") from error
