"""Port to the blob store: immutable files by key, in a folder or in an S3 bucket.

The store keeps three kinds of keys: ``ab/<SHA-256>…`` for one content, ``packs/<name>`` for many small ones, and
``made/ab/<SHA-256>`` for made maps. What a key contains never changes, so that it may be written again at any time:
this replaces lost and damaged bytes, and makes a file young for the garbage collection.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

from app.errors import DISK_FULL_ERRNOS, NoRoom, Unavailable, system_reason

BLOCK: Final = 2**20
"""Size in bytes of the pieces that files are read and written in."""


@dataclass(frozen=True, slots=True)
class StoredFile:
    """One file of a listing. modified: seconds since 1970."""

    key: str
    size: int
    modified: float


class Unreadable(Unavailable):
    """Temporarily unreadable blob store, as opposed to an unavailable database."""


class BlobFiles(Protocol):
    """Immutable files by key. Thread-safe, and safe beside other processes and servers on the same store.

    remote: whether the bytes are on another machine, so that copies on this one are worth their space.

    Errors: Unavailable (NoRoom: it is full) if the store cannot be written; when reading, FileNotFoundError if there is
    no such file, another OSError if its storage is broken, Unreadable if the store does not answer.
    """

    remote: bool

    def prepare(self) -> None:
        """Create the folders."""

    def workspace(self) -> AbstractContextManager[Path]:
        """Create a folder on this machine for temporary files, which ``write`` may take away."""

    def write(self, files: Mapping[str, bytes | Path]) -> None:
        """Store files durably, each complete or not at all; an existing one is replaced. Paths: in a workspace."""

    def stream(self, key: str, start: int = 0, size: int | None = None) -> Iterator[bytes]:
        """Read a file, or ``size`` bytes of it from byte ``start`` on, in pieces; beyond its end there are none."""

    def delete(self, keys: Iterable[str]) -> None:
        """Remove files; one that does not exist is skipped."""

    def list(self, prefix: str = "") -> Iterator[StoredFile]:
        """List the files whose key begins with a folder (``packs/``), or all of them."""

    def check(self, *, readonly: bool = False) -> None:
        """Raise Unavailable unless files can be written (``readonly``: read)."""

    def recover(self) -> int:
        """Remove the workspaces of ended processes; returns how many."""


def sync(path: Path) -> None:
    """Flush a file, or the names in a folder, to the disk. Raises OSError."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def unwritable_error(error: OSError) -> Unavailable:
    """Convert the error of a folder that cannot be written."""
    if error.errno in DISK_FULL_ERRNOS:
        return NoRoom(
            f"the server has no disk space left for files ({system_reason(error)}), and nothing was stored: try again "
            "when its operator has freed space"
        )
    return Unavailable(f"the blob folder cannot be written ({system_reason(error)}): try again later")


def unreadable_error(error: OSError) -> Unreadable:
    """Convert the error of a folder that cannot be read at the moment."""
    return Unreadable(f"the blob folder cannot be read ({system_reason(error)}): try again later")
