"""Whether a disk has room."""

from __future__ import annotations

import os
import secrets
from pathlib import Path
from typing import Final

ROOM_BYTES: Final = 2**20
"""Free space in bytes below which a folder is not writable, and an I/O error of SQLite means a full disk."""


def check_room(folder: Path) -> None:
    """Raise OSError unless a file of 1 MiB can be written to a folder."""
    probe = folder / f".room-{secrets.token_hex(8)}"
    try:
        with probe.open("wb") as file:
            os.posix_fallocate(file.fileno(), 0, ROOM_BYTES)
    finally:
        probe.unlink(missing_ok=True)
