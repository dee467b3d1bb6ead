"""Small documents that all processes share, such as keys: a file in the data folder, or a row in PostgreSQL."""

from __future__ import annotations

import os
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Final, Protocol

from app.backends.locks import file_lock
from app.clock import seconds_since_boot

FRESH_SECONDS: Final = 1.0
"""Seconds for which a document is not read again unless a commit is known of."""

Change = Callable[[bytes | None], bytes]
"""Function content, None without one -> new content."""


class Document(Protocol):
    """Small document. Thread-safe."""

    def stamp(self) -> Hashable:
        """Return a value that changes if the content may have changed; never blocks for long."""

    def read(self) -> bytes | None:
        """Return the content, None without one."""

    def update(self, change: Change, *, notify: bool = True) -> bytes:
        """Replace the content by that which ``change`` returns; return it. No other process changes it meanwhile.

        notify: whether other servers have to read it again at once.
        """


class FileDocument:
    """Document in a file that only its owner can read. Processes lock ``lock`` in its folder to change it."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def stamp(self) -> Hashable:
        """Return the time of the last change."""
        try:
            return self.path.stat().st_mtime_ns
        except FileNotFoundError:
            return 0

    def read(self) -> bytes | None:
        """Read the file. Raises OSError."""
        try:
            return self.path.read_bytes()
        except FileNotFoundError:
            return None

    def update(self, change: Change, *, notify: bool = True) -> bytes:
        """Replace the file atomically; there is no other server to notify. Raises OSError."""
        del notify
        self.path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        with file_lock(self.path.parent / "lock"):
            content = change(self.read())
            write_private(self.path, content)
            return content


def write_private(path: Path, data: bytes) -> None:
    """Write a file atomically, readable by its owner only."""
    temporary = path.with_suffix(f".{os.getpid()}")
    descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    with os.fdopen(descriptor, "wb") as handle:
        handle.write(data)
        handle.flush()
        os.fsync(handle.fileno())
    temporary.replace(path)


def time_slot() -> int:
    """Return a number that changes every FRESH_SECONDS."""
    return int(seconds_since_boot() / FRESH_SECONDS)
