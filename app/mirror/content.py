"""Fetch the content of mirrored versions: only what is missing, by hash, checked before it is stored.

Nothing refers to fetched content until its version is applied. So a transfer that ends early leaves what it has, which
the next attempt does not fetch again, and garbage collection removes what no version needs.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import ormsgpack

from app.errors import Damaged, NotFound, Unavailable, Untrusted
from app.mirror.centre import Centre
from app.store import blob_coding
from app.store.blob_coding import Undecodable
from app.store.encode import decompress, digest
from app.store.mirror_source import new_content
from app.store.mirror_target import MirrorPage
from app.store.store import Store

MAX_CHUNK_BYTES: Final = 2**28
MAX_HEAD_BYTES: Final = 2**12
BATCH_BYTES: Final = 4 * 2**20
"""Bytes of chunks or small files that are stored in one transaction."""

BLOBS: Final = 200
"""Number of files in one request."""

CODINGS: Final = frozenset({None, "zstd", "patch", "xor"})


@dataclass(frozen=True, slots=True)
class FetchedContent:
    """Content of a page that is stored now. chunks: those that the version before does not have. blobs: likewise."""

    chunks: tuple[bytes, ...]
    blobs: frozenset[str]


class Fetcher:
    """Fetches the content of pages from a centre."""

    def __init__(self, store: Store, centre: Centre) -> None:
        self._store, self._centre = store, centre

    def fetch(self, page: MirrorPage, after: int, base_parts: Sequence[str]) -> FetchedContent:
        """Fetch what the versions of a page need and this server lacks.

        Args:
            after: newest version that the mirror has.
            base_parts: hashes of its parts.

        Raises Untrusted for bytes that do not match their hash, Unavailable if the answer is cut off.
        """
        present, absent = self._store.mirror_target.absent_chunks(page.prefixes)
        if absent:
            self._fetch_chunks(page, after, present, set(absent))
        roots = {entry.hash for version, _ in page.versions for entry in version.parts}
        try:
            content = new_content(self._store.chunks.stage(), base_parts, roots)
        except Damaged as error:
            raise Unavailable(f"{page.name}: incomplete content from {self._centre.url}: {error.detail}") from error
        uploads = [s.sha256 for version, _ in page.versions for s in version.sources if s.removed is None]
        if page.base is not None:
            uploads += [str(source["sha256"]) for source in page.base["sources"] if "removed" not in source]
        wanted = list(dict.fromkeys([*uploads, *sorted(content.blobs)]))
        stored = self._store.blobs.rows(wanted)
        missing = [name for name in wanted if name not in stored]
        for start in range(0, len(missing), BLOBS):
            self._fetch_blobs(page, after, missing[start : start + BLOBS])
        return FetchedContent(content.chunks, content.blobs)

    def _fetch_chunks(self, page: MirrorPage, after: int, present: Sequence[bytes], absent: set[bytes]) -> None:
        texts = base64.b64encode(b"".join(name[:8] for name in present)).decode()
        body = {"after": after, "last": page.last, "chunks": True, "present": texts}
        batch: dict[str, bytes] = {}
        size = 0
        with self._centre.content(page.name, body) as pieces:
            frames = _Frames(pieces)
            while absent:
                length = int.from_bytes(frames.read(4))
                if length > MAX_CHUNK_BYTES:
                    raise Untrusted(f"{page.name}: {self._centre.url} sent a chunk of {length} bytes")
                stored = frames.read(length)
                name = _checked_name(stored)
                if name[:8] not in absent:
                    raise Untrusted(
                        f"{page.name}: {self._centre.url} sent content that does not match a requested hash"
                    )
                absent.discard(name[:8])
                batch[name.hex()] = stored
                size += length
                if size > BATCH_BYTES:
                    self._store.mirror_target.add_chunks(batch)
                    batch, size = {}, 0
        self._store.mirror_target.add_chunks(batch)

    def _fetch_blobs(self, page: MirrorPage, after: int, names: Sequence[str]) -> None:
        """Fetch files, first as differences from others; those whose base is not here once more as a whole."""
        rest = self._fetch_some(page, after, names, whole=False)
        if rest and self._fetch_some(page, after, rest, whole=True):
            raise Untrusted(f"{page.name}: {self._centre.url} sent files as differences that were requested whole")

    def _fetch_some(self, page: MirrorPage, after: int, names: Sequence[str], *, whole: bool) -> list[str]:
        body = {"after": after, "last": page.last, "blobs": list(names), "whole": whole}
        rest: list[str] = []
        with self._store.blobs.files.workspace() as folder, self._centre.content(page.name, body) as pieces:
            frames = _Frames(pieces)
            files: list[Path] = []
            bases: list[str | None] = []
            for expected in names:
                head_length = int.from_bytes(frames.read(4))
                if head_length > MAX_HEAD_BYTES:
                    raise Untrusted(f"{page.name}: {self._centre.url} sent {head_length} bytes before a file")
                head = ormsgpack.unpackb(frames.read(head_length))
                name, size, coding, base, length = _checked_head(head, expected)
                base_data = b"" if base is None else self._base(base, files, bases)
                if base_data is None:
                    for _ in frames.read_pieces(length):
                        pass
                    rest.append(name)
                    continue
                path = folder / f"{name}.fetched"
                _write(path, frames.read_pieces(length), coding, base_data, name, size)
                files.append(path)
                bases.append(base)
                if sum(file.stat().st_size for file in files) > BATCH_BYTES:
                    self._put(files, bases)
            self._put(files, bases)
        return rest

    def _base(self, name: str, files: list[Path], bases: list[str | None]) -> bytes | None:
        """Read what a file is the difference from, which may be one that was fetched just now; None if it is absent."""
        self._put(files, bases)
        try:
            return self._store.blobs.get(name)
        except (NotFound, Damaged):
            return None

    def _put(self, files: list[Path], bases: list[str | None]) -> None:
        if files:
            self._store.blobs.put_many(files, bases)
            for file in files:
                file.unlink(missing_ok=True)
        files.clear()
        bases.clear()


class _Frames:
    """Reader of exact numbers of bytes from a stream. Raises Unavailable at its early end."""

    def __init__(self, pieces: Iterator[bytes]) -> None:
        self._pieces, self._buffer = pieces, b""

    def read(self, count: int) -> bytes:
        return b"".join(self.read_pieces(count))

    def read_pieces(self, count: int) -> Iterator[bytes]:
        while count:
            if not self._buffer:
                self._buffer = next(self._pieces, b"")
                if not self._buffer:
                    raise Unavailable("the centre's answer ended early: the next attempt goes on from there")
            piece, self._buffer = self._buffer[:count], self._buffer[count:]
            count -= len(piece)
            yield piece


def _checked_name(stored: bytes) -> bytes:
    try:
        return digest(decompress(stored))
    except Damaged as error:
        raise Untrusted(f"the centre sent a damaged chunk: {error.detail}") from error


def _checked_head(head: Any, expected: str) -> tuple[str, int, blob_coding.Coding | None, str | None, int]:
    try:
        name, size, coding, base, length = head
        valid = name == expected and coding in CODINGS and int(size) >= 0 and int(length) >= 0
        valid = valid and (base is None or (isinstance(base, str) and len(base) == 64))
    except (TypeError, ValueError):
        valid = False
    if not valid:
        raise Untrusted(f"the centre sent another file than {expected}")
    return name, int(size), coding, base, int(length)


def _write(
    path: Path, pieces: Iterator[bytes], coding: blob_coding.Coding | None, base: bytes, name: str, size: int
) -> None:
    """Decode a file and check its hash. Raises Untrusted if it does not match."""
    sha256, written = hashlib.sha256(), 0
    try:
        with path.open("wb") as out:
            for piece in blob_coding.decoded(pieces, coding, base):
                written += len(piece)
                if written > size:
                    break
                sha256.update(piece)
                out.write(piece)
    except Undecodable as error:
        raise Untrusted(f"the centre sent a damaged file {name}: {error}") from error
    for _ in pieces:  # what follows the end of the compressed data
        pass
    if written != size or sha256.hexdigest() != name:
        raise Untrusted(f"the centre sent a file that does not match its hash {name}")
