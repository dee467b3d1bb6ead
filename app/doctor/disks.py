"""Checks of folders and their disks."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from pathlib import Path

from app.backends.room import DiskRoom, disk_room
from app.doctor.registry import Finding, check, error, human_size, ok, warning
from app.doctor.site import Site

MIN_BYTES = 64 * 2**20
"""Free space in bytes below which the next upload may make the server read-only."""

FEW_BYTES = 2**30
FEW_SHARE = 0.05
"""Free space in bytes, and share of a disk, from which on an operator should act."""

MIN_SHARE = 0.005
"""Share of free inodes below which the next files may fail."""

FREE = "purge deleted environments, lower FLEETMAP_CACHE_BYTES, or enlarge the disk"


def _folders(site: Site) -> dict[str, Path]:
    """Return the existing folders with data, or where they would be created, by setting."""
    settings = site.settings
    folders = {"FLEETMAP_DATA_DIR": settings.data_dir}
    if not (settings.blob_url or "").startswith("s3://"):
        folders["FLEETMAP_BLOB_URL"] = settings.blob_dir
    if site.database_file is not None:
        folders["FLEETMAP_DATABASE_URL"] = site.database_file.parent
    return folders


def _existing(folder: Path) -> Path:
    """Return a folder, or the nearest one above it that exists."""
    path = folder.resolve()
    while not path.exists() and path != path.parent:
        path = path.parent
    return path


def _users(folder: Path) -> tuple[int, int]:
    """Return the numbers of this user and of the owner of a folder."""
    return os.getuid(), folder.stat().st_uid


@check
def folders(site: Site) -> Iterator[Finding]:
    """Look whether the folders exist and can be written by their owner."""
    data = site.settings.data_dir
    user, owner = _users(_existing(data))
    if user == 0 and owner != 0 and data.exists():
        advice = f"run it as the user of the server, whose rights it then examines: sudo -u '#{owner}' fleetmap doctor"
        yield warning(f"this examination runs as root, and the folder belongs to user {owner}", str(data), advice)
    closed = set[Path]()
    for name, folder in _folders(site).items():
        place = f"{folder} ({name})"
        if folder.exists() and not folder.is_dir():
            yield error("is no folder", place, "set another path")
        elif not os.access(_existing(folder), os.R_OK | os.W_OK | os.X_OK):
            closed.add(folder)
            yield _inaccessible(_existing(folder), place)
        elif not folder.exists():
            yield ok("will be created at the first start", place)
        else:
            yield ok("can be written", place)
    for path in _necessary(site):
        if path.parent not in closed and path.exists() and not os.access(path, os.R_OK | os.W_OK):
            yield _inaccessible(path, str(path))


def _necessary(site: Site) -> Iterator[Path]:
    """Return what the server must read and write within its folders, and may have been created by another user."""
    yield site.settings.data_dir / "keys"
    if site.database_file is not None:
        yield from (Path(f"{site.database_file}{end}") for end in ("", "-wal", "-shm"))


def _inaccessible(path: Path, place: str) -> Finding:
    """Say why a file or folder cannot be used, as far as the system says."""
    if os.statvfs(path).f_flag & os.ST_RDONLY:
        advice = "mount it writable; if the system has closed it after an error of the disk, see `dmesg`"
        return error("its file system is read-only", place, advice)
    status, user = path.stat(), os.getuid()
    detail = f"cannot be read and written by this user (mode {stat.S_IMODE(status.st_mode):04o}, owner {status.st_uid})"
    if status.st_uid == user:
        return error(detail, place, f"chmod -R u+rwX {path}")
    advice = f"give it to the user of the server, who runs this: chown -R {user} {path}; or run this as its owner"
    return error(detail, place, advice)


@check
def disk_space(site: Site) -> Iterator[Finding]:
    """Look for free space and inodes."""
    devices: dict[int, None] = {}
    for name, folder in _folders(site).items():
        existing = _existing(folder)
        room = disk_room(existing, site.statvfs)
        if room.device not in devices:
            devices[room.device] = None
            yield _space(room, f"{existing} ({name})")
            if room.inodes:
                yield _inodes(room, f"{existing} ({name})")


def _space(room: DiskRoom, place: str) -> Finding:
    detail = f"{human_size(room.free)} of {human_size(room.size)} are free"
    if room.free < MIN_BYTES:
        return error(f"the disk is full: {detail}", place, FREE)
    if room.free < FEW_BYTES or room.free < FEW_SHARE * room.size:
        return warning(f"the disk is nearly full: {detail}", place, FREE)
    return ok(detail, place)


def _inodes(room: DiskRoom, place: str) -> Finding:
    share = room.free_inodes / room.inodes
    detail = f"{room.free_inodes} of {room.inodes} inodes are free"
    advice = "remove small files of other programs, lower FLEETMAP_CACHE_BYTES, or use a file system with more inodes"
    if share < MIN_SHARE:
        return error(f"the disk can hold no further files: {detail}", place, advice)
    return warning(f"the disk can hold few further files: {detail}", place, advice) if share < FEW_SHARE else ok(detail)


@check
def disk_limits(site: Site) -> Iterator[Finding]:
    """Compare the limits of caches and uploads with the disk."""
    settings, sufficient = site.settings, True
    room = disk_room(_existing(settings.data_dir), site.statvfs)
    caches = {"FLEETMAP_CACHE_BYTES": settings.cache_bytes}
    if (settings.blob_url or "").startswith("s3://"):
        caches["FLEETMAP_BLOB_CACHE_BYTES"] = settings.blob_cache_bytes
    if sum(caches.values()) > room.size:
        sufficient = False
        advice = "lower it below the size of the disk, so that the cache cannot fill it"
        yield warning(f"larger than the disk of {human_size(room.size)}", " + ".join(caches), advice)
    if settings.max_upload_bytes > room.size:
        sufficient = False
        detail = f"an upload may have {human_size(settings.max_upload_bytes)}, the disk has {human_size(room.size)}"
        yield warning(detail, "FLEETMAP_MAX_UPLOAD_BYTES", "lower the limit")
    if sufficient:
        yield ok("caches and uploads fit on the disk")
