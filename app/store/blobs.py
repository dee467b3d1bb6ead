"""Content-addressed files: uploads byte for byte, and the files that maps consist of.

A blob is a file of the blob store by its SHA-256, or a part of a pack with other small ones, as its row in the table
``blob`` states. It is kept compressed if that pays; a file that an upload sends again, changed, as the difference from
the one before. Files are durable before any row refers to them. If a blob is used again, its row is updated first, so
that a running garbage collection skips it.

With a store on another machine, contents are read through copies in a folder of this one. Confined workers have no
network: they read these copies, and raise LostBlobs for those that are not there yet (``fetch``).
"""

from __future__ import annotations

import hashlib
import io
import secrets
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from itertools import chain
from pathlib import Path
from typing import BinaryIO, Final

from app.backends.blob_folder import FolderFiles
from app.backends.blobs import BlobFiles, Unreadable, unwritable_error
from app.backends.local_copies import LocalCopies
from app.errors import Damaged, FleetMapError, Invalid, LostBlobs, NotFound, Unavailable, system_reason
from app.store import blob_coding, blob_rows
from app.store.blob_coding import Undecodable
from app.store.blob_rows import BlobRow
from app.store.database import Database

REPAIR: Final = "run `fleetmap verify --repair`, upload the same file again, or restore it from a backup"

PACKED_BELOW: Final = 64 * 2**10
"""Size in bytes below which files of one upload share a pack."""

PACK_BYTES: Final = 64 * 2**20
COPIES_BYTES: Final = 4 * 2**30
MAX_CHAIN: Final = 2**16
"""Number of versions of a file after which one is kept whole. A read decodes at most 16 differences."""

WORTH: Final = 0.7
"""Share of the compressed size that a difference may have, else the file is kept whole."""


class Blobs:
    """Store of bytes by their SHA-256 (hex).

    Thread-safe, and safe beside other processes and servers on the same files and database. folder: on this machine.
    """

    def __init__(
        self,
        database: Database,
        folder: Path,
        *,
        readonly: bool = False,
        files: BlobFiles | None = None,
        copies_bytes: int = COPIES_BYTES,
    ) -> None:
        self._database, self.folder, self._readonly = database, folder, readonly
        self.files: BlobFiles = FolderFiles(folder) if files is None else files
        self._copies = LocalCopies(folder, copies_bytes)

    def prepare(self) -> None:
        """Create the folders."""
        self.files.prepare()

    # --- writing ---

    def put(self, data: bytes | Path) -> str:
        """Store bytes or a file's content durably; returns the SHA-256."""
        return self.put_many([data])[0]

    def put_many(self, files: Sequence[bytes | Path], similar: Sequence[str | None] = ()) -> list[str]:
        """Store several files with one set of fsyncs; returns their SHA-256s in the same order.

        Small ones (below 64 KiB) share a pack. Nothing is written twice; stored content is hashed again, and replaced
        if it is damaged or lost. similar: for each file the SHA-256 of an earlier version of it.

        Raises Unavailable if the blob store cannot be written.
        """
        if self._readonly:
            raise Invalid("this store was opened for reading only")
        try:
            return self._put_many(files, similar)
        except OSError as error:
            raise unwritable_error(error) from error

    def _put_many(self, files: Sequence[bytes | Path], similar: Sequence[str | None]) -> list[str]:
        names: list[str] = []
        small: dict[str, bytes] = {}
        large: dict[str, tuple[bytes | Path, str | None]] = {}
        for k, data in enumerate(files):
            size = len(data) if isinstance(data, bytes) else data.stat().st_size
            if size < PACKED_BELOW and len(files) > 1:
                content = data if isinstance(data, bytes) else data.read_bytes()
                name = hashlib.sha256(content).hexdigest()
                small[name] = content
            else:
                name = _hash(data)
                large[name] = (data, similar[k] if k < len(similar) else None)
            names.append(name)
        stored_rows = self._touch(sorted({*names}))
        lost = {n for n in names if n not in stored_rows or self._problem(stored_rows[n]) is not None}
        if lost:
            with self.files.workspace() as workspace:
                encoded = [self._encode(workspace, n, *large[n]) for n in large if n in lost]
                self.files.write({row.key: content for row, content in encoded})
                rows = [row for row, _ in encoded] + self._write_packs({n: d for n, d in small.items() if n in lost})
            with self._database.write(upkeep=True) as connection:
                blob_rows.insert(connection, [r for r in rows if r.name not in stored_rows])
                # a row whose file was lost: the content is stored again, in another file
                blob_rows.relocate(connection, [r for r in rows if r.name in stored_rows])
        return names

    def _touch(self, names: list[str]) -> dict[str, BlobRow]:
        with self._database.read() as connection:
            if not blob_rows.select_rows(connection, names):
                return {}
        with self._database.write(upkeep=True) as connection:
            return blob_rows.touch(connection, names)

    def _problem(self, row: BlobRow) -> str | None:
        """Return the problem of a stored file (``lost`` or ``damaged``), None if it matches its hash."""
        digest = hashlib.sha256()
        try:
            for piece in self._decoded(row):
                digest.update(piece)
        except FileNotFoundError:
            return "lost"
        except (OSError, Undecodable, Damaged):
            return "damaged"
        return None if digest.hexdigest() == row.name else "damaged"

    def _encode(
        self, workspace: Path, name: str, data: bytes | Path, similar: str | None
    ) -> tuple[BlobRow, bytes | Path]:
        """Choose the smallest form of a file, and write it to the workspace."""
        plain, packed = workspace / name, workspace / f"{name}.zst"
        size, digest = _copy(data, plain)
        if digest != name:
            raise OSError(f"{plain.name} changed while it was stored")
        compressed = blob_coding.compress_file(plain, packed)
        difference = self._difference(plain, name, size, compressed, similar)
        if difference is None and compressed >= size * blob_coding.PAYS:
            packed.unlink()
            return BlobRow(name, size, stored=size), plain
        plain.unlink()
        return difference or (BlobRow(name, size, stored=compressed, coding="zstd"), packed)

    def _difference(
        self, plain: Path, name: str, size: int, compressed: int, similar: str | None
    ) -> tuple[BlobRow, bytes] | None:
        """Make the difference from an earlier version of a file; None if there is none, or if it is not worth it."""
        chosen = None if similar in (None, name) or size > blob_coding.MAX_PATCHED else self._base_for(similar)
        if chosen is None:
            return None
        base, number = chosen
        try:
            coding, patch = blob_coding.make_difference(self.get(base.name), plain.read_bytes())
        except (Damaged, NotFound):
            return None
        if len(patch) > compressed * WORTH or base.name == name:
            return None
        return BlobRow(name, size, stored=len(patch), coding=coding, base=base.name, chain=number), patch

    def _base_for(self, similar: str | None) -> tuple[BlobRow, int] | None:
        """Choose the base for the next version of a file, and the number of that version.

        Version n is kept as the difference from version n without its lowest bit: a read decodes as many differences as
        n has bits set, and the last version is never far from its base.
        """
        if similar is None:
            return None
        with self._database.read() as connection:
            row = blob_rows.select_rows(connection, [similar]).get(similar)
            if row is None or row.pack is not None or row.size > blob_coding.MAX_PATCHED:
                return None
            number = row.chain + 1
            while row.chain != number & (number - 1) and row.base is not None:
                below = blob_rows.select_rows(connection, [row.base]).get(row.base)
                if below is None:
                    return None
                row = below
        return None if number >= MAX_CHAIN else (row, number)

    def _write_packs(self, files: Mapping[str, bytes]) -> list[BlobRow]:
        """Write packs of at most 64 MiB; returns the rows that locate each file in them."""
        rows: list[BlobRow] = []
        group: list[str] = []
        size = 0
        for name in files:
            group.append(name)
            size += len(files[name])
            if size >= PACK_BYTES:
                rows += self.write_pack({n: files[n] for n in group})
                group, size = [], 0
        if group:
            rows += self.write_pack({n: files[n] for n in group})
        return rows

    def write_pack(self, files: Mapping[str, bytes]) -> list[BlobRow]:
        """Write one pack; returns the rows that locate each file in it."""
        # random: packs of equal content in another order are different files, so a row never changes its meaning
        pack = secrets.token_hex(32)
        rows: list[BlobRow] = []
        parts: list[bytes] = []
        start = 0
        for name, data in files.items():
            packed = blob_coding.compress_bytes(data)
            parts.append(data if packed is None else packed)
            coding: blob_coding.Coding | None = None if packed is None else "zstd"
            rows.append(BlobRow(name, len(data), pack, start, len(parts[-1]), coding))
            start += len(parts[-1])
        self.files.write({f"packs/{pack}": b"".join(parts)})
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
            rows = blob_rows.select_rows(connection, names)
        out: dict[str, bytes] = {}
        lost: list[str] = []
        for name in names:
            if name not in rows:
                raise NotFound(f"unknown stored file {name}")
            data = self._read(rows[name])
            if data is None:  # it was moved to another pack between the query and the read
                data = self._read(self._row(name))
            if data is None:
                lost.append(name)
            else:
                out[name] = data
        if lost:
            raise LostBlobs(f"the stored file {lost[0]} is lost: {REPAIR}", names=lost)
        return out

    def _read(self, row: BlobRow) -> bytes | None:
        """Read a content; None if its file does not exist."""
        copy = self._copies.get(row.name) if self.files.remote else None
        if copy is not None:
            return copy
        try:
            data = b"".join(self._checked(row))
        except FileNotFoundError:
            # a worker reads what its server has copied
            return None if self.files.remote or row.key == self._copies.key(row.name) else self._copies.get(row.name)
        if self.files.remote:
            self._add_copy(row, iter([data]))
        return data

    def _checked(self, row: BlobRow) -> Iterator[bytes]:
        """Read a content in pieces, hashed. Raises FileNotFoundError, and Damaged at the end if it does not match."""
        digest = hashlib.sha256()
        try:
            for piece in self._decoded(row):
                digest.update(piece)
                yield piece
        except FileNotFoundError:
            raise
        except OSError as error:
            reason = system_reason(error)
            raise Damaged(f"the stored file {row.name} cannot be read ({reason}): {REPAIR}") from error
        except Undecodable as error:
            raise _mismatch(row.name) from error
        if digest.hexdigest() != row.name:
            raise _mismatch(row.name)

    def _decoded(self, row: BlobRow) -> Iterator[bytes]:
        stored = self.files.stream(row.key, row.start, None if row.pack is None else row.stored)
        first = next(stored, b"")  # a worker finds that the file is not on this machine before it looks for its base
        size = 0
        for piece in blob_coding.decoded(chain((first,), stored), row.coding, self._base(row)):
            size += len(piece)
            if size > row.size:
                raise Undecodable("it is longer than its content")
            yield piece

    def _base(self, row: BlobRow) -> bytes:
        """Read what a blob is the difference from. It is not hashed: the hash of the blob itself shows any damage.

        Raises FileNotFoundError if it is not stored.
        """
        if row.base is None:
            return b""
        copy = self._copies.get(row.base) if self.files.remote else None
        if copy is not None:
            return copy
        try:
            base = self._row(row.base)
        except NotFound as error:
            raise FileNotFoundError(row.base) from error
        return b"".join(self._decoded(base))

    def _add_copy(self, row: BlobRow, pieces: Iterator[bytes]) -> bool:
        """Keep a copy on this machine; False if its disk cannot be written."""
        try:
            self._copies.add(row.name, pieces)
        except FileNotFoundError:
            raise
        except OSError:
            return False
        return True

    def fetch(self, hashes: Sequence[str]) -> bool:
        """Copy contents to this machine for workers, which have no network; False if all were there already.

        Raises Damaged, or NotFound, or Unavailable if that is not possible.
        """
        if not self.files.remote:
            return False
        absent = [name for name in dict.fromkeys(hashes) if self._copies.get(name) is None]
        for name in absent:
            self._fetch(self._row(name))
        return bool(absent)

    def _fetch(self, row: BlobRow) -> None:
        try:
            if not self._add_copy(row, self._checked(row)):
                raise Unavailable("the disk for copies of stored files cannot be written: try again later")
        except FileNotFoundError as error:
            raise LostBlobs(f"the stored file {row.name} is lost: {REPAIR}", names=[row.name]) from error

    def open(self, sha256: str) -> BinaryIO:
        """Open the content as a seekable file, hashed first; for large ones that are read in parts."""
        row = self._row(sha256)
        if row.pack is not None:
            return io.BytesIO(self.get(sha256))
        if self.files.remote:
            opened = self._copies.open(sha256)
            if opened is None:
                self._fetch(row)
                opened = self._copies.open(sha256)
            if opened is None:
                raise Unavailable("the cache for stored files is too small for this one: try again, or enlarge it")
            return opened
        return self._open_decoded(row)

    def _open_decoded(self, row: BlobRow) -> BinaryIO:
        with ExitStack() as stack:
            try:
                if row.coding is None and isinstance(self.files, FolderFiles):
                    plain = stack.enter_context(self.files.open(row.key))
                    if hashlib.file_digest(plain, "sha256").hexdigest() != row.name:
                        raise _mismatch(row.name)
                    file: BinaryIO = plain
                else:
                    with self.files.workspace() as workspace:
                        file = stack.enter_context((workspace / "decoded").open("w+b"))
                        for piece in self._checked(row):
                            file.write(piece)
            except FileNotFoundError as error:
                raise LostBlobs(f"the stored file {row.name} is lost: {REPAIR}", names=[row.name]) from error
            except OSError as error:
                raise Damaged(
                    f"the stored file {row.name} cannot be read ({system_reason(error)}): {REPAIR}"
                ) from error
            file.seek(0)
            stack.pop_all()
        return file

    def rows(self, hashes: Sequence[str]) -> dict[str, BlobRow]:
        """Read where contents are and how they are kept, of those that are stored."""
        with self._database.read() as connection:
            return blob_rows.select_rows(connection, list(hashes))

    def encoded(self, row: BlobRow) -> Iterator[bytes]:
        """Read a content as it is kept, for another server that decodes and checks it."""
        return self.files.stream(row.key, row.start, None if row.pack is None else row.stored)

    def path(self, sha256: str) -> Path | None:
        """Return the file in the folder that contains this, maybe compressed; None if it is in a pack. Not checked."""
        row = self._row(sha256)
        return None if row.pack is not None or self.files.remote else self.folder / row.key

    def has(self, sha256: str) -> bool:
        """Return whether a blob is stored with the right content."""
        with self._database.read() as connection:
            row = blob_rows.select_rows(connection, [sha256]).get(sha256)
        return row is not None and self._problem(row) is None

    def size(self, sha256: str) -> int:
        """Return the size of the content in bytes."""
        return self._row(sha256).size

    def check_row(self, row: BlobRow) -> str | None:
        """Return the problem of a stored file, read from the blob store, None if it is intact or was removed."""
        problem = self._problem(row)
        if problem is None:
            return None
        with self._database.read() as connection:  # it may have been moved to another pack, or removed, meanwhile
            moved = blob_rows.select_rows(connection, [row.name]).get(row.name)
        return None if moved is None else self._problem(moved)

    def _row(self, name: str) -> BlobRow:
        with self._database.read() as connection:
            row = blob_rows.select_rows(connection, [name]).get(name)
        if row is None:
            raise NotFound(f"unknown stored file {name}")
        return row

    def check(self) -> None:
        """Raise Unavailable unless the blob store can be written (a read-only store: read)."""
        self.files.check(readonly=self._readonly)


def _mismatch(name: str) -> FleetMapError:
    return Damaged(f"the stored file {name} does not match its hash: {REPAIR}")


def _hash(data: bytes | Path) -> str:
    if isinstance(data, bytes):
        return hashlib.sha256(data).hexdigest()
    with data.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _copy(data: bytes | Path, target: Path) -> tuple[int, str]:
    digest = hashlib.sha256()
    with target.open("wb") as out:
        for piece in blob_coding.pieces(data):
            out.write(piece)
            digest.update(piece)
        return out.tell(), digest.hexdigest()


__all__ = ["Blobs", "Unreadable"]
