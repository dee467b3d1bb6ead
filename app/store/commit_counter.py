"""A number that changes with every committed write, shared by all processes of a host: what caches in memory ask.

Eight bytes of a file in the blob folder, mapped into memory: reading costs less than a microsecond, where any question
to the database costs a hundred. Another host's commits are not seen, so a cache may believe it for a second at most.
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
    """The number, opened when first needed; without a folder it changes in this process alone."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._map: mmap.mmap | None = None
        self._changes = 0
        self._lock = threading.Lock()

    def __call__(self) -> int:
        """The number now."""
        shared = self._map or self._open()
        return self._changes if shared is None else int(_NUMBER.unpack_from(shared)[0])

    def change(self) -> None:
        """Called after a commit: another number, so that no two processes need to agree on the next one."""
        shared = self._map or self._open()
        if shared is None:
            self._changes += 1
        else:
            _NUMBER.pack_into(shared, 0, int.from_bytes(os.urandom(8), "little"))

    def close(self) -> None:
        """Give back the mapping."""
        with self._lock:
            if self._map is not None:
                self._map.close()
                self._map = None

    def _open(self) -> mmap.mmap | None:
        with self._lock:
            if self._map is None and self._folder.is_dir():
                try:
                    descriptor = os.open(self._folder / NAME, os.O_RDWR | os.O_CREAT, 0o600)
                except OSError:  # a disk that is read-only: nobody on this host commits
                    return None
                try:
                    if os.fstat(descriptor).st_size < _NUMBER.size:
                        # Real bytes, not a hole: a disk without room for them would kill whoever touches the mapping.
                        os.pwrite(descriptor, bytes(_NUMBER.size), 0)
                    self._map = mmap.mmap(descriptor, _NUMBER.size)
                except OSError:
                    return None
                finally:
                    os.close(descriptor)
            return self._map
