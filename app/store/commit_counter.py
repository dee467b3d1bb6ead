"""Commit counter in shared memory: in-memory caches compare it to detect writes by any process on this host.

Eight bytes of a file in the blob folder, mapped into memory: reading it takes less than a microsecond, a database query
about a hundred. Commits of other hosts are not counted, so caches expire after one second.
"""

from __future__ import annotations

import mmap
import os
import struct
import threading
from pathlib import Path

NAME = ".generation"
_NUMBER = struct.Struct("<Q")


class CommitCounter:
    """Commit counter, opened on first use; without a folder it counts commits of this process only."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._map: mmap.mmap | None = None
        self._changes = 0
        self._lock = threading.Lock()

    def __call__(self) -> int:
        """Return the current number."""
        shared = self._map or self._open()
        return self._changes if shared is None else int(_NUMBER.unpack_from(shared)[0])

    def change(self) -> None:
        """Set another number after a commit. It is random, so that processes need not agree on the next one."""
        shared = self._map or self._open()
        if shared is None:
            self._changes += 1
        else:
            _NUMBER.pack_into(shared, 0, int.from_bytes(os.urandom(8), "little"))

    def close(self) -> None:
        """Close the mapping."""
        with self._lock:
            if self._map is not None:
                self._map.close()
                self._map = None

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
                    self._map = mmap.mmap(descriptor, _NUMBER.size)
                except OSError:
                    return None
                finally:
                    os.close(descriptor)
            return self._map
