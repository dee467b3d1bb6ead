"""Content-addressed files: uploads byte for byte, and the files that maps consist of.

A blob is stored as ``ab/abcdef…`` (its SHA-256), or with other small ones in ``packs/<SHA-256 of the pack>``, as its
row in the table ``blob`` states. Files are written under a temporary name, synced, renamed, and their folder synced,
before any row refers to them. Temporary names are in a folder of each upload below ``tmp``, which its process locks, so
that the next start can recognise the remains of a killed process. If a blob is used again, its row is updated first, so
that a running garbage collection skips it.
"""

from __future__ import annotations

import fcntl
import hashlib
import io
import os
import re
import secrets
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Final

from sqlalchemy import Connection, bindparam, delete, select, update
from sqlalchemy.dialects import postgresql, sqlite

from app.errors import (
    BROKEN_STORAGE_ERRNOS,
    DISK_FULL_ERRNOS,
    Damaged,
    FleetMapError,
    Invalid,
    NoRoom,
    NotFound,
    Unavailable,
    system_reason,
)
from app.store.database import Database, check_room
from app.store.tables import blob

REPAIR: Final = "run `fleetmap verify --repair`, upload the same file again, or restore it from a backup"

PACKED_BELOW: Final = 64 * 2**10
"""Size in bytes below which files of one upload share a pack."""

LOCK: Final = ".lock"
PACK_BYTES: Final = 64 * 2**20
BLOCK: Final = 2**20
BATCH: Final = 500
_NAME = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True, slots=True)
class _BlobRow:
    size: int
    pack: str | None
    start: int


class Blobs:
    """Store of bytes by their SHA-256 (hex).

    Thread-safe, and safe beside other processes on the same folder and database.
    """

    def __init__(self, database: Database, folder: Path, *, readonly: bool = False) -> None:
        self._database = database
        self.folder = folder
        self._readonly = readonly

    def prepare(self) -> None:
        """Create the folders."""
        for path in (self.folder, self._packs, self._temporary):
            path.mkdir(parents=True, exist_ok=True)

    @property
    def _packs(self) -> Path:
        return self.folder / "packs"

    @property
    def _temporary(self) -> Path:
        return self.folder / "tmp"

    def _path(self, sha256: str) -> Path:
        return self.folder / sha256[:2] / sha256

    @contextmanager
    def _workspace(self) -> Iterator[Path]:
        """Create a folder for temporary names, locked while this process uses it."""
        folder = self._temporary / secrets.token_hex(16)
        with self._workspaces_lock(shared=True):
            folder.mkdir()
            lock = os.open(folder / LOCK, os.O_CREAT | os.O_RDWR, 0o600)
            fcntl.flock(lock, fcntl.LOCK_EX)
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)
            os.close(lock)

    @contextmanager
    def _workspaces_lock(self, *, shared: bool) -> Iterator[None]:
        """Keep the search for abandoned workspaces from removing one that is being created."""
        lock = os.open(self._temporary / LOCK, os.O_CREAT | os.O_RDWR, 0o600)
        try:
            fcntl.flock(lock, fcntl.LOCK_SH if shared else fcntl.LOCK_EX)
            yield
        finally:
            os.close(lock)

    # --- writing ---

    def put(self, data: bytes | Path) -> str:
        """Store bytes or a file's content durably; returns the SHA-256."""
        return self.put_many([data])[0]

    def put_many(self, files: Sequence[bytes | Path]) -> list[str]:
        """Store several files with one set of fsyncs; returns their SHA-256s in the same order.

        Small ones (below 64 KiB) share a pack. Nothing is written twice; stored content is hashed again, and replaced
        if it is damaged or lost. Raises Unavailable if the disk cannot be written.
        """
        if self._readonly:
            raise Invalid("this store was opened for reading only")
        try:
            return self._put_many(files)
        except OSError as error:
            raise _unavailable_error(error) from error

    def _put_many(self, files: Sequence[bytes | Path]) -> list[str]:
        names: list[str] = []
        small: dict[str, bytes] = {}
        large: dict[str, bytes | Path] = {}
        sizes: dict[str, int] = {}
        for data in files:
            size = len(data) if isinstance(data, bytes) else data.stat().st_size
            if size < PACKED_BELOW and len(files) > 1:
                content = data if isinstance(data, bytes) else data.read_bytes()
                name = hashlib.sha256(content).hexdigest()
                small[name] = content
            else:
                name = hashlib.sha256(data).hexdigest() if isinstance(data, bytes) else _hash_file(data)
                large[name] = data
            sizes[name] = size
            names.append(name)
        stored_rows = self._touch(sizes)
        lost = {n for n in sizes if n not in stored_rows or self._problem(n, stored_rows[n]) is not None}
        if lost:
            with self._workspace() as workspace:
                self._write_large(workspace, {n: d for n, d in large.items() if n in lost})
                rows = self._write_packs(workspace, {n: d for n, d in small.items() if n in lost})
            rows += [{"sha256": n, "size": sizes[n], "pack": None, "start": 0} for n in large if n in lost]
            with self._database.write(upkeep=True) as connection:
                _upsert(connection, [r for r in rows if r["sha256"] not in stored_rows])
                # a row whose file was lost: the content is stored again, in another file
                _relocate(
                    connection,
                    [
                        {"name": r["sha256"], "to": r["pack"], "at": r["start"]}
                        for r in rows
                        if r["sha256"] in stored_rows
                    ],
                )
        return names

    def _touch(self, sizes: Mapping[str, int]) -> dict[str, _BlobRow]:
        """Mark existing rows as used now, so that garbage collection skips them."""
        names = sorted(sizes)
        out: dict[str, _BlobRow] = {}
        with self._database.read() as connection:
            if not self._rows(connection, names):
                return out
        with self._database.write(upkeep=True) as connection:
            for start in range(0, len(names), BATCH):
                some = names[start : start + BATCH]
                connection.execute(update(blob).where(blob.c.sha256.in_(some)).values(used=int(time.time())))
                out.update(self._rows(connection, some))
        return out

    def _problem(self, name: str, row: _BlobRow) -> str | None:
        """Return the problem of a stored file (``lost`` or ``damaged``), None if it matches its hash."""
        digest = hashlib.sha256()
        try:
            with (self._path(name) if row.pack is None else self._packs / row.pack).open("rb") as file:
                file.seek(row.start)
                left = row.size
                while left and (block := file.read(min(BLOCK, left))):
                    digest.update(block)
                    left -= len(block)
                complete = not left and (row.pack is not None or not file.read(1))
        except FileNotFoundError:
            return "lost"
        except OSError as error:
            if error.errno not in BROKEN_STORAGE_ERRNOS:
                raise _unreadable_error(error) from error
            return "damaged"
        return None if complete and digest.hexdigest() == name else "damaged"

    def _write_large(self, workspace: Path, files: Mapping[str, bytes | Path]) -> None:
        folders: set[Path] = set()
        for name, data in files.items():
            temporary = workspace / name
            with temporary.open("wb") as out:
                if isinstance(data, bytes):
                    out.write(data)
                else:
                    with data.open("rb") as source:
                        shutil.copyfileobj(source, out, BLOCK)
                out.flush()
                os.fsync(out.fileno())
            if not isinstance(data, bytes) and _hash_file(temporary) != name:
                raise OSError(f"{data.name} changed while it was stored")
        for name in files:
            path = self._path(name)
            if not path.parent.is_dir():
                path.parent.mkdir(exist_ok=True)
                folders.add(self.folder)
            (workspace / name).replace(path)
            folders.add(path.parent)
        for folder in folders:
            _sync_folder(folder)

    def _write_packs(self, workspace: Path, files: Mapping[str, bytes]) -> list[dict[str, object]]:
        """Write packs of at most 64 MiB; returns the rows that locate each file in them."""
        rows: list[dict[str, object]] = []
        group: list[str] = []
        size = 0
        for name in files:
            group.append(name)
            size += len(files[name])
            if size >= PACK_BYTES:
                rows += self._write_pack(workspace, {n: files[n] for n in group})
                group, size = [], 0
        if group:
            rows += self._write_pack(workspace, {n: files[n] for n in group})
        return rows

    def _write_pack(self, workspace: Path, files: Mapping[str, bytes]) -> list[dict[str, object]]:
        content = b"".join(files.values())
        # random suffix: packs of equal content in another order are different files, so a row never changes its meaning
        pack = hashlib.sha256(content + secrets.token_bytes(16)).hexdigest()
        temporary = workspace / pack
        with temporary.open("wb") as out:
            out.write(content)
            out.flush()
            os.fsync(out.fileno())
        temporary.replace(self._packs / pack)
        _sync_folder(self._packs)
        rows: list[dict[str, object]] = []
        start = 0
        for name, data in files.items():
            rows.append({"sha256": name, "size": len(data), "pack": pack, "start": start})
            start += len(data)
        return rows

    # --- reading ---

    def get(self, sha256: str) -> bytes:
        """Read the content, hashed again.

        Raises Damaged if it is lost or does not match, NotFound if it never existed.
        """
        return self.get_many([sha256])[sha256]

    def get_many(self, hashes: Sequence[str]) -> dict[str, bytes]:
        """Read several contents by SHA-256, all hashed again."""
        names = list(dict.fromkeys(hashes))
        with self._database.read() as connection:
            rows = self._rows(connection, names)
        out: dict[str, bytes] = {}
        for name in names:
            if name not in rows:
                raise NotFound(f"unknown stored file {name}")
            data = self._read(name, rows[name])
            if data is None:  # it was moved to another pack between the query and the read
                data = self._read(name, self._row(name))
            if data is None:
                raise Damaged(f"the stored file {name} is lost: {REPAIR}")
            if hashlib.sha256(data).hexdigest() != name:
                raise Damaged(f"the stored file {name} does not match its hash: {REPAIR}")
            out[name] = data
        return out

    def _read(self, name: str, row: _BlobRow) -> bytes | None:
        try:
            if row.pack is None:
                return self._path(name).read_bytes()
            with (self._packs / row.pack).open("rb") as source:
                source.seek(row.start)
                return source.read(row.size)
        except FileNotFoundError:
            return None
        except OSError as error:
            raise _read_error(name, error) from error

    def open(self, sha256: str) -> BinaryIO:
        """Open the content as a seekable file, hashed first; for large ones that are read in parts."""
        row = self._row(sha256)
        if row.pack is not None:
            return io.BytesIO(self.get(sha256))
        with ExitStack() as stack:
            try:
                file = stack.enter_context(self._path(sha256).open("rb"))
                name = hashlib.file_digest(file, "sha256").hexdigest()
                file.seek(0)
            except FileNotFoundError as error:
                raise Damaged(f"the stored file {sha256} is lost: {REPAIR}") from error
            except OSError as error:
                raise _read_error(sha256, error) from error
            if name != sha256:
                raise Damaged(f"the stored file {sha256} does not match its hash: {REPAIR}")
            stack.pop_all()
        return file

    def path(self, sha256: str) -> Path | None:
        """Return the path of the file with exactly this content, None if it is in a pack. Its bytes are not checked."""
        return None if self._row(sha256).pack is not None else self._path(sha256)

    def has(self, sha256: str) -> bool:
        """Return whether a blob is stored with the right content."""
        with self._database.read() as connection:
            row = self._rows(connection, [sha256]).get(sha256)
        return row is not None and self._problem(sha256, row) is None

    def size(self, sha256: str) -> int:
        """Return the size of the content in bytes."""
        return self._row(sha256).size

    def _row(self, name: str) -> _BlobRow:
        with self._database.read() as connection:
            row = self._rows(connection, [name]).get(name)
        if row is None:
            raise NotFound(f"unknown stored file {name}")
        return row

    @staticmethod
    def _rows(connection: Connection, names: Sequence[str]) -> dict[str, _BlobRow]:
        out: dict[str, _BlobRow] = {}
        for start in range(0, len(names), BATCH):
            some = list(names[start : start + BATCH])
            query = select(blob.c.sha256, blob.c.size, blob.c.pack, blob.c.start).where(blob.c.sha256.in_(some))
            out.update((r.sha256, _BlobRow(r.size, r.pack, r.start)) for r in connection.execute(query))
        return out

    # --- upkeep ---

    def check(self) -> None:
        """Raise Unavailable unless the folder can be written (a read-only store: read)."""
        try:
            if self._readonly:
                next(self.folder.iterdir(), None)
                return
            self.prepare()
            with self._workspace() as workspace:
                check_room(workspace)
        except OSError as error:
            raise _unavailable_error(error) from error

    def recover(self, older_than: float) -> int:
        """Remove workspaces of ended processes, and packs without a row that are older (seconds); returns how many."""
        self.prepare()
        limit = time.time() - older_than
        count = 0
        with self._workspaces_lock(shared=False):
            for folder in self._temporary.iterdir():
                count += folder.is_dir() and _remove_workspace(folder)
        with self._database.read() as connection:
            packs = set(connection.execute(select(blob.c.pack).where(blob.c.pack.is_not(None)).distinct()).scalars())
        for path in self._packs.iterdir():
            if path.name not in packs:
                count += _unlink_if_older(path, limit)
        return count

    def collect(self, referenced: set[str], before: int) -> tuple[int, int]:
        """Remove unreferenced blobs that were last used before this second; returns (count, bytes).

        Files are removed while the transaction still holds their rows. An upload that uses one again waits, then finds
        it missing and writes it.
        """
        with self._database.read() as connection:
            query = select(blob.c.sha256, blob.c.size).where(blob.c.used < before)
            idle = {name: size for name, size in connection.execute(query) if name not in referenced}
        names = sorted(idle)
        count = freed = 0
        packs: set[str] = set()
        for start in range(0, len(names), BATCH):
            some = names[start : start + BATCH]
            with self._database.write(upkeep=True) as connection:
                deleted_rows = connection.execute(
                    delete(blob)
                    .where(blob.c.sha256.in_(some), blob.c.used < before)
                    .returning(blob.c.sha256, blob.c.size, blob.c.pack)
                ).all()
                for row in deleted_rows:
                    count += 1
                    freed += row.size
                    if row.pack is None:
                        self._path(row.sha256).unlink(missing_ok=True)
                    else:
                        packs.add(row.pack)
        for pack in sorted(packs):
            self._repack(pack)
        self._remove_strays(before)
        return count, freed

    def _repack(self, pack: str) -> None:
        """Write the used blobs of a pack into a new one."""
        with self._database.read() as connection:
            names = list(connection.execute(select(blob.c.sha256).where(blob.c.pack == pack)).scalars())
        if names:
            with self._workspace() as workspace:
                moved = self._write_pack(workspace, self.get_many(names))
            with self._database.write(upkeep=True) as connection:
                _relocate(
                    connection,
                    [{"name": r["sha256"], "to": r["pack"], "at": r["start"], "pack_was": pack} for r in moved],
                )
        with self._database.write(upkeep=True) as connection:
            if connection.execute(select(blob.c.sha256).where(blob.c.pack == pack).limit(1)).first() is None:
                (self._packs / pack).unlink(missing_ok=True)

    def _remove_strays(self, before: int) -> None:
        """List files without a row, which remain after a crash between the file and its row."""
        for folder in self.folder.iterdir():
            if len(folder.name) != 2 or not folder.is_dir():
                continue
            files = [path for path in folder.iterdir() if _NAME.fullmatch(path.name)]
            with self._database.read() as connection:
                rows = self._rows(connection, [path.name for path in files])
            for path in files:
                if path.name not in rows:
                    _unlink_if_older(path, before)

    def verify(self) -> list[str]:
        """Hash everything; returns the names of damaged and lost blobs."""
        return [name for name, _, problem in self.iterate_checks() if problem is not None]

    def iterate_checks(
        self, after: str = "", skip: Callable[[str, Unavailable], None] | None = None
    ) -> Iterator[tuple[str, int, str | None]]:
        """Hash one file after the other, in order of their names: (name, bytes, ``lost``, ``damaged`` or None).

        skip: called for a file that is temporarily unreadable; without it, that raises Unavailable.
        """
        while True:
            query = select(blob.c.sha256).where(blob.c.sha256 > after).order_by(blob.c.sha256).limit(BATCH)
            with self._database.read() as connection:
                rows = self._rows(connection, list(connection.execute(query).scalars()))
            for name, row in sorted(rows.items()):
                try:
                    problem = self._problem(name, row)
                    if problem is not None:  # it may have been moved to another pack, or removed, since the query
                        with self._database.read() as connection:
                            moved = self._rows(connection, [name]).get(name)
                        problem = None if moved is None else self._problem(name, moved)
                except _Unreadable as error:
                    if skip is None:
                        raise
                    skip(name, error)
                    continue
                yield name, row.size, problem
            if len(rows) < BATCH:
                return
            after = max(rows)


def _read_error(sha256: str, error: OSError) -> FleetMapError:
    """Convert an OS error: Damaged for broken storage, Unavailable for temporary errors such as too many open files."""
    if error.errno in BROKEN_STORAGE_ERRNOS:
        return Damaged(f"the stored file {sha256} cannot be read ({system_reason(error)}): {REPAIR}")
    return _unreadable_error(error)


class _Unreadable(Unavailable):
    """Temporarily unreadable file, as opposed to an unavailable database."""


def _unreadable_error(error: OSError) -> _Unreadable:
    return _Unreadable(f"the blob folder cannot be read ({system_reason(error)}): try again later")


def _unavailable_error(error: OSError) -> Unavailable:
    if error.errno in DISK_FULL_ERRNOS:
        return NoRoom(
            f"the server has no disk space left for files ({system_reason(error)}), and nothing was stored: try again "
            "when its operator has freed space"
        )
    return Unavailable(f"the blob folder cannot be written ({system_reason(error)}): try again later")


def _upsert(connection: Connection, rows: Sequence[Mapping[str, object]]) -> None:
    """Insert rows for new blobs; a row that another upload inserted first stays and counts as used now."""
    if not rows:
        return
    now = int(time.time())
    values = [{**row, "used": now} for row in sorted(rows, key=lambda r: str(r["sha256"]))]
    make = sqlite.insert if connection.dialect.name == "sqlite" else postgresql.insert
    statement = make(blob)
    connection.execute(
        statement.on_conflict_do_update(index_elements=["sha256"], set_={"used": statement.excluded.used}), values
    )


def _relocate(connection: Connection, rows: Iterable[Mapping[str, object]]) -> None:
    listed = list(rows)
    if not listed:
        return
    statement = update(blob).where(blob.c.sha256 == bindparam("name"))
    if "pack_was" in listed[0]:
        statement = statement.where(blob.c.pack == bindparam("pack_was"))
    connection.execute(statement.values(pack=bindparam("to"), start=bindparam("at")), listed)


def _hash_file(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _remove_workspace(folder: Path) -> bool:
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


def _unlink_if_older(path: Path, limit: float) -> int:
    try:
        if path.stat().st_mtime < limit:
            path.unlink()
            return 1
    except FileNotFoundError:
        pass
    return 0
