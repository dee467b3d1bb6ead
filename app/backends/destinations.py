"""Where backups are kept: a folder, an S3 bucket, or a single file; each is a port to files by key."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

from app.backends.archive_file import ArchiveFiles
from app.backends.blob_folder import FolderFiles
from app.backends.blob_s3 import S3Files
from app.backends.blobs import BlobFiles
from app.errors import Invalid, Unavailable, system_reason

ARCHIVE: Final = ".tar"
"""End of the name of a backup in a single file."""

_FOLDERS: Final = re.compile(r"packs|index|snapshots")


def open_destination(place: str, scratch: Path, *, new: bool) -> BlobFiles:
    """Open a place of backups: ``s3://bucket/prefix``, ``FILE.tar`` or a folder.

    Args:
        scratch: folder on this machine for temporary files.
        new: whether a backup is to be written, so that a missing folder is created.

    Raises Invalid if there is no such place, or if it is not empty and has no backups; Unavailable.
    """
    if place.startswith("s3://"):
        if not urlsplit(place).netloc:
            raise Invalid(f"{place}: the bucket is missing: use s3://bucket/prefix")
        return S3Files(place, scratch)
    if "://" in place:
        raise Invalid(f"{place}: unsupported place of backups: use a folder, a file NAME.tar, or s3://bucket/prefix")
    path = Path(place)
    if path.is_file() or (new and place.endswith(ARCHIVE)):
        return ArchiveFiles(path, scratch, new=new)
    if not new and not path.is_dir():
        raise Invalid(f"{place}: no such file or folder")
    try:
        path.mkdir(parents=True, exist_ok=True)
        (path / "tmp").mkdir(exist_ok=True)
    except OSError as error:
        raise Unavailable(f"{place}: the folder cannot be created ({system_reason(error)})") from error
    return FolderFiles(path, _FOLDERS, gentle=True)


def is_foreign(place: str) -> bool:
    """Return whether a place is a folder with other files, in which no backup may begin.

    Empty folders are what a first backup leaves that is killed before it has written anything.
    """
    path = Path(place)
    return path.is_dir() and any(
        child.name != "tmp" and not (child.is_dir() and next(child.iterdir(), None) is None) for child in path.iterdir()
    )


def shown(place: str) -> str:
    """Return a place as it may be shown and stored: without user, password and parameters of a URL."""
    if "://" not in place:
        return str(Path(place).resolve())
    parts = urlsplit(place)
    return f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}"
