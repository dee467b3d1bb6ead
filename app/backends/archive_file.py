"""A backup in a single file: files by key as members of a tar archive, written once and read by key."""

from __future__ import annotations

import contextlib
import io
import tarfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Final

from app.backends.blobs import BLOCK, StoredFile, sync, unreadable_error, unwritable_error
from app.backends.workspaces import Workspaces
from app.errors import Conflict, Damaged

PART: Final = ".part"
"""End of the name of an archive that is being written: it gets its own name when it is complete."""


class ArchiveFiles:
    """Files by key in one tar archive. For one thread.

    Args:
        folder: for workspaces on this machine.
        new: whether it is to be written; ``finish`` completes it.
    """

    remote = False

    def __init__(self, path: Path, folder: Path, *, new: bool = False) -> None:
        self._path, self._new = path, new
        self._workspaces = Workspaces(folder / "tmp")
        self._archive: tarfile.TarFile | None = None
        self._members: dict[str, tarfile.TarInfo] = {}

    def prepare(self) -> None:
        """Begin a new archive. Raises Conflict if the file exists, Unavailable if it cannot be written."""
        if not self._new or self._archive is not None:
            return
        if self._path.exists():
            raise Conflict(f"{self._path} exists: a backup in a single file is written once; use another name")
        try:
            self._archive = tarfile.open(self._path.with_name(self._path.name + PART), "w")  # noqa: SIM115  until finish
        except OSError as error:
            raise unwritable_error(error) from error

    def finish(self) -> None:
        """Complete the archive: from now on it has its name. Raises Unavailable."""
        if self._archive is None or not self._new:
            return
        part = self._path.with_name(self._path.name + PART)
        try:
            self._archive.close()
            sync(part)
            part.replace(self._path)
            sync(part.parent)
        except OSError as error:
            raise unwritable_error(error) from error
        self._archive, self._new = None, False

    def close(self) -> None:
        """Close an archive that was read."""
        if self._archive is not None and not self._new:
            self._archive.close()
            self._archive = None

    def discard(self) -> None:
        """Remove an archive that is not complete."""
        if self._archive is not None and self._new:
            with contextlib.suppress(OSError):  # the disk may be full
                self._archive.close()
            self._path.with_name(self._path.name + PART).unlink(missing_ok=True)
            self._archive = None

    def workspace(self) -> AbstractContextManager[Path]:
        """Create a folder for temporary files."""
        return self._workspaces.create()

    def write(self, files: Mapping[str, bytes | Path]) -> None:
        """Append files."""
        self.prepare()
        if self._archive is None:
            raise Conflict(f"{self._path} is complete: a backup in a single file is written once; use another name")
        try:
            for key, content in files.items():
                data = content if isinstance(content, bytes) else content.read_bytes()
                member = tarfile.TarInfo(key)
                member.size, member.mode = len(data), 0o600
                self._archive.addfile(member, io.BytesIO(data))
                self._members[key] = member
        except OSError as error:
            raise unwritable_error(error) from error

    def stream(self, key: str, start: int = 0, size: int | None = None) -> Iterator[bytes]:
        """Read a file in pieces."""
        opened = self._open()
        if key not in self._members:
            raise FileNotFoundError(key)
        file = opened.extractfile(self._members[key])
        if file is None:
            raise FileNotFoundError(key)
        try:
            file.seek(start)
            left = size
            while left != 0 and (block := file.read(BLOCK if left is None else min(BLOCK, left))):
                left = None if left is None else left - len(block)
                yield block
        except tarfile.ReadError:
            return  # cut off: the hash of what was read does not match
        except OSError as error:
            raise unreadable_error(error) from error

    def _open(self) -> tarfile.TarFile:
        """Open the archive and list its members. A cut off one has those before the cut."""
        if self._archive is None:
            try:
                self._archive = tarfile.open(self._path, "r:")  # noqa: SIM115  as long as the object lives
                for member in self._archive:
                    self._members[member.name] = member
            except tarfile.ReadError as error:
                if self._archive is None:
                    raise Damaged(f"{self._path} is no backup: it is no tar archive, or it is cut off") from error
            except OSError as error:
                raise unreadable_error(error) from error
        return self._archive

    def delete(self, keys: Iterable[str]) -> None:
        """Raise Conflict: nothing is removed from an archive."""
        names = list(keys)
        if names:
            raise Conflict(f"{self._path} is a backup in a single file, from which nothing is removed")

    def list(self, prefix: str = "") -> Iterator[StoredFile]:
        """List files."""
        if not self._new:
            self._open()
        for key, member in list(self._members.items()):
            if key.startswith(prefix):
                yield StoredFile(key, member.size, float(member.mtime))

    def check(self, *, readonly: bool = False) -> None:
        """Raise Unavailable or Conflict unless the archive can be written (``readonly``: read)."""
        if readonly:
            self._open()
        else:
            self.prepare()

    def recover(self) -> int:
        """Return 0: there are no remains but the file that is being written."""
        return 0
