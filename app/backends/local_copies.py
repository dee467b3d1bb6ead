"""Copies of a remote blob store's contents on this machine: a folder of bounded size, least recently used go first."""

from __future__ import annotations

import contextlib
import hashlib
import os
import secrets
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Final

FRESH_SECONDS: Final = 60.0
"""Minimum seconds between two updates of a copy's time of last use."""
KEPT_SHARE: Final = 0.9
"""Share of the limit that is kept when copies are removed, so that the folder is not listed for each new one."""


class LocalCopies:
    """Contents by SHA-256, in files ``ab/abcdef…`` of a folder. Thread-safe, and safe beside other processes.

    A copy is trusted only by its hash. limit: bytes of all copies; the newest stays, whatever its size.
    """

    def __init__(self, folder: Path, limit: int) -> None:
        self._folder, self._limit = folder, limit
        self._lock = threading.Lock()
        self._size: int | None = None

    @staticmethod
    def key(sha256: str) -> str:
        """Return the name of a copy in the folder: also that of a plain blob in a blob store."""
        return f"{sha256[:2]}/{sha256}"

    def path(self, sha256: str) -> Path:
        """Return where the copy of a content is, if there is one."""
        return self._folder / self.key(sha256)

    def get(self, sha256: str) -> bytes | None:
        """Read a copy; None if there is none. A damaged one is removed."""
        try:
            data = self.path(sha256).read_bytes()
        except OSError:
            return None
        if hashlib.sha256(data).hexdigest() != sha256:
            self.remove(sha256)
            return None
        self._note_use(sha256)
        return data

    def open(self, sha256: str) -> BinaryIO | None:
        """Open a copy, hashed first; None if there is none. A damaged one is removed."""
        with contextlib.ExitStack() as stack:
            try:
                file = stack.enter_context(self.path(sha256).open("rb"))
                name = hashlib.file_digest(file, "sha256").hexdigest()
                file.seek(0)
            except OSError:
                return None
            if name != sha256:
                self.remove(sha256)
                return None
            stack.pop_all()
        self._note_use(sha256)
        return file

    def add(self, sha256: str, chunks: Iterator[bytes]) -> None:
        """Write a copy from verified pieces. Raises OSError if the disk cannot be written; then there is none."""
        path = self.path(sha256)
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f".{sha256[:16]}-{secrets.token_hex(8)}")
        try:
            with temporary.open("wb") as file:
                for chunk in chunks:
                    file.write(chunk)
                size = file.tell()
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)
        with self._lock:
            self._size = (self._total() if self._size is None else self._size) + size
            if self._size > self._limit:
                self._size = self._evict(path)

    def remove(self, sha256: str) -> None:
        """Remove a copy."""
        with contextlib.suppress(OSError):
            self.path(sha256).unlink(missing_ok=True)

    def _note_use(self, sha256: str) -> None:
        path = self.path(sha256)
        with contextlib.suppress(OSError):
            if time.time() - path.stat().st_mtime > FRESH_SECONDS:
                os.utime(path)

    def _entries(self) -> list[tuple[float, int, Path]]:
        out = []
        for path in self._folder.glob("[0-9a-f][0-9a-f]/*"):
            with contextlib.suppress(OSError):
                status = path.stat()
                out.append((status.st_mtime, status.st_size, path))
        return out

    def _total(self) -> int:
        return sum(size for _, size, _ in self._entries())

    def _evict(self, newest: Path) -> int:
        entries = sorted(self._entries())
        total = sum(size for _, size, _ in entries)
        for _, size, path in entries:
            if total <= self._limit * KEPT_SHARE:
                break
            if path == newest:
                continue
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
            total -= size
        return total
