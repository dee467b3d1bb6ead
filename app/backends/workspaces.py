"""Folders for temporary files, each locked by its process, so that the next start recognises those of killed ones."""

from __future__ import annotations

import fcntl
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from app.backends.locks import file_lock

LOCK: Final = ".lock"


class Workspaces:
    """Temporary folders below ``folder``. Safe beside other processes."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @contextmanager
    def create(self) -> Iterator[Path]:
        """Create a temporary folder, locked until the block ends; then it is removed."""
        folder = self.folder / secrets.token_hex(16)
        self.folder.mkdir(parents=True, exist_ok=True)
        with file_lock(self.folder / LOCK, shared=True):
            folder.mkdir()
            lock = os.open(folder / LOCK, os.O_CREAT | os.O_RDWR, 0o600)
            fcntl.flock(lock, fcntl.LOCK_EX)
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)
            os.close(lock)

    def recover(self) -> int:
        """Remove the folders of ended processes, none that is being created; returns how many."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with file_lock(self.folder / LOCK):
            return sum(folder.is_dir() and _remove(folder) for folder in list(self.folder.iterdir()))


def _remove(folder: Path) -> bool:
    """Remove a workspace unless a running process has locked it."""
    try:
        lock = os.open(folder / LOCK, os.O_RDWR)
    except FileNotFoundError:
        shutil.rmtree(folder, ignore_errors=True)
        return True
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    else:
        shutil.rmtree(folder, ignore_errors=True)
        return True
    finally:
        os.close(lock)
