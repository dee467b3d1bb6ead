"""Whether a disk has room, and how much."""

from __future__ import annotations

import os
import secrets
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

ROOM_BYTES: Final = 2**20
"""Free space in bytes below which a folder is not writable, and an I/O error of SQLite means a full disk."""

RESERVE_BYTES: Final = 512 * 2**20
RESERVE_SHARE: Final = 0.05
"""Free space that caches leave to what cannot be made again: these bytes, or this share of a smaller disk."""


def check_room(folder: Path) -> None:
    """Raise OSError unless a file of 1 MiB can be written to a folder."""
    probe = folder / f".room-{secrets.token_hex(8)}"
    try:
        with probe.open("wb") as file:
            os.posix_fallocate(file.fileno(), 0, ROOM_BYTES)
    finally:
        probe.unlink(missing_ok=True)


@dataclass(frozen=True, slots=True)
class DiskRoom:
    """Free space of a folder's file system, for its ordinary users: bytes and inodes.

    device: number of the file system. inodes: 0 on a file system without a fixed number of them.
    """

    device: int
    size: int
    free: int
    inodes: int
    free_inodes: int


def disk_room(folder: Path, statvfs: Callable[[Path], os.statvfs_result] = os.statvfs) -> DiskRoom:
    """Return the free space of a folder. Raises OSError."""
    status = statvfs(folder)
    return DiskRoom(
        device=folder.stat().st_dev,
        size=status.f_blocks * status.f_frsize,
        free=status.f_bavail * status.f_frsize,
        inodes=status.f_files,
        free_inodes=status.f_favail,
    )


def lacking_bytes(folder: Path) -> int:
    """Return by how many bytes the free space is below the reserve; 0 if it suffices or cannot be read."""
    try:
        room = disk_room(folder)
    except OSError:
        return 0
    return max(0, int(min(RESERVE_BYTES, RESERVE_SHARE * room.size)) - room.free)
