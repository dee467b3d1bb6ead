"""Blob store in a folder: of one server, or one that several servers mount.

A file is written in a workspace, synced, renamed, and its folder synced. (obstore's local store does not sync, so that
a power cut could leave an empty file behind a committed version.)
"""

from __future__ import annotations

import os
import re
import secrets
from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager
from io import BufferedReader
from pathlib import Path
from typing import Final

from app.backends.blobs import BLOCK, StoredFile, sync, unreadable_error, unwritable_error
from app.backends.room import check_room
from app.backends.workspaces import Workspaces
from app.errors import BROKEN_STORAGE_ERRNOS

FOLDER: Final = re.compile(r"[0-9a-f]{2}|packs|made")


class FolderFiles:
    """Files below a folder.

    Args:
        tops: pattern of the names of its folders; others belong to other uses.
        gentle: whether bytes are synced piece by piece, so that the commits of a database on the same disk wait less.
    """

    remote = False

    def __init__(self, folder: Path, tops: re.Pattern[str] = FOLDER, *, gentle: bool = False) -> None:
        self._folder, self._tops, self._gentle = folder, tops, gentle
        self._workspaces = Workspaces(folder / "tmp")

    def prepare(self) -> None:
        """Create the folders."""
        for path in (self._folder, self._folder / "packs", self._workspaces.folder):
            path.mkdir(parents=True, exist_ok=True)

    def path(self, key: str) -> Path:
        """Return where a file is."""
        return self._folder / key

    def workspace(self) -> AbstractContextManager[Path]:
        """Create a folder for temporary files."""
        return self._workspaces.create()

    def write(self, files: Mapping[str, bytes | Path]) -> None:
        """Store files with one sync of each folder."""
        try:
            self._write(files)
        except OSError as error:
            raise unwritable_error(error) from error

    def _write(self, files: Mapping[str, bytes | Path]) -> None:
        folders: set[Path] = set()
        with self._workspaces.create() as workspace:
            ready = {key: _synced(data, workspace, gentle=self._gentle) for key, data in files.items()}
            for key, temporary in ready.items():
                path = self._folder / key
                for parent in (path.parent.parent, path.parent):
                    if not parent.is_dir():
                        parent.mkdir(exist_ok=True)
                        folders.add(parent.parent)
                temporary.replace(path)
                folders.add(path.parent)
        for folder in folders:
            sync(folder)

    def open(self, key: str) -> BufferedReader:
        """Open a file. Raises FileNotFoundError, another OSError if its storage is broken, Unreadable."""
        try:
            return (self._folder / key).open("rb")
        except OSError as error:
            raise _converted(error) from error

    def stream(self, key: str, start: int = 0, size: int | None = None) -> Iterator[bytes]:
        """Read a file in pieces."""
        try:
            with (self._folder / key).open("rb") as file:
                file.seek(start)
                left = size
                while left != 0 and (block := file.read(BLOCK if left is None else min(BLOCK, left))):
                    left = None if left is None else left - len(block)
                    yield block
        except OSError as error:
            raise _converted(error) from error

    def delete(self, keys: Iterable[str]) -> None:
        """Remove files."""
        try:
            for key in keys:
                (self._folder / key).unlink(missing_ok=True)
        except OSError as error:
            raise unwritable_error(error) from error

    def list(self, prefix: str = "") -> Iterator[StoredFile]:
        """List files. Those of other uses of the folder are left out."""
        try:
            yield from self._list(prefix)
        except OSError as error:
            raise unreadable_error(error) from error

    def _list(self, prefix: str) -> Iterator[StoredFile]:
        tops = sorted(path.name for path in self._folder.iterdir())
        for top in tops:
            if not self._tops.fullmatch(top) or (prefix and top != prefix.split("/", maxsplit=1)[0]):
                continue
            for path in (self._folder / top).rglob("*"):
                key = path.relative_to(self._folder).as_posix()
                try:
                    status = path.stat()
                except FileNotFoundError:
                    continue
                if key.startswith(prefix) and path.is_file():
                    yield StoredFile(key, status.st_size, status.st_mtime)

    def check(self, *, readonly: bool = False) -> None:
        """Raise Unavailable unless the folder can be written (``readonly``: read)."""
        try:
            if readonly:
                next(self._folder.iterdir(), None)
                return
            self.prepare()
            with self._workspaces.create() as workspace:
                check_room(workspace)
        except OSError as error:
            raise unwritable_error(error) from error

    def recover(self) -> int:
        """Remove the workspaces of ended processes."""
        self.prepare()
        return self._workspaces.recover()


def _converted(error: OSError) -> Exception:
    if isinstance(error, FileNotFoundError) or error.errno in BROKEN_STORAGE_ERRNOS:
        return error
    return unreadable_error(error)


def _synced(data: bytes | Path, workspace: Path, *, gentle: bool) -> Path:
    """Write bytes to a temporary file, or take one over, and flush it to the disk.

    gentle: each BLOCK by itself. The sync of another file waits for what the file system has begun to write of this
    one: with 32 MB at once, syncs of SQLite's log took a third longer, and up to 130 ms; with pieces as long as ever.
    """
    path = data if isinstance(data, Path) else workspace / secrets.token_hex(16)
    if isinstance(data, Path):
        sync(path)
        return path
    with path.open("wb") as out:
        for start in range(0, len(data), BLOCK) if gentle else ():
            out.write(data[start : start + BLOCK])
            out.flush()
            os.fdatasync(out.fileno())
        if not gentle:
            out.write(data)
        out.flush()
        os.fsync(out.fileno())
    return path
