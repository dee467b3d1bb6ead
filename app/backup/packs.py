"""Packs: immutable files of many objects; and which objects a place has already.

A pack is ``FMPACK01``, the length of its table (4 bytes, big-endian), the table ``[[kind, name, length], …]`` as
MessagePack, then the objects. Its name is the SHA-256 of its bytes as they are stored, encrypted or not. Beside each
pack is an index in the clear: names of its objects, 16 bytes each, made with the place's key, their sizes, 4 bytes
each, and a code over all that needs the key as well. So a server that cannot decrypt its own backups knows what they
contain.
"""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final

import numpy as np
import ormsgpack
from numpy.typing import NDArray

from app.errors import Damaged

MAGIC: Final = b"FMPACK01"
INDEX_MAGIC: Final = b"FMINDX01"
PACK_BYTES: Final = 32 * 2**20
"""Size in bytes of objects at which a pack is written."""

NAME_BYTES: Final = 16
ENTRY_BYTES: Final = NAME_BYTES + 4
CODE_BYTES: Final = 32


class Kind(IntEnum):
    """Kinds of objects: a chunk, the row of a blob, a part of a stored file, a segment of a table's rows."""

    CHUNK = 1
    BLOB = 2
    PART = 3
    SEGMENT = 4


@dataclass(frozen=True, slots=True)
class PackEntry:
    """One object of a pack."""

    kind: Kind
    name: bytes
    data: bytes


@dataclass(frozen=True, slots=True)
class PackReference:
    """A pack of a place. name: SHA-256 (hex) of the stored bytes. size: their number."""

    name: str
    size: int

    @property
    def key(self) -> str:
        """Key of its file."""
        return f"packs/{self.name[:2]}/{self.name}"

    @property
    def index_key(self) -> str:
        """Key of its index."""
        return f"index/{self.name}"


def object_name(key: bytes, kind: Kind, name: bytes) -> bytes:
    """Return the name of an object in indexes."""
    return hashlib.blake2b(name, key=key, digest_size=NAME_BYTES, salt=bytes([kind])).digest()


def part_name(file: str, number: int) -> bytes:
    """Return the name of a part of a stored file."""
    return f"{file}#{number}".encode()


class PackWriter:
    """Collects objects and writes a pack whenever it has enough. write: stores a pack's plain bytes and its entries."""

    def __init__(self, write: Callable[[bytes, bytes], PackReference], key: bytes) -> None:
        self._write, self._key = write, key
        self._table: list[tuple[int, bytes, int]] = []
        self._data: list[bytes] = []
        self._size = 0
        self.packs: list[PackReference] = []

    def add(self, kind: Kind, name: bytes, data: bytes) -> None:
        """Add an object."""
        self._table.append((int(kind), name, len(data)))
        self._data.append(data)
        self._size += len(data) + len(name)
        if self._size >= PACK_BYTES:
            self.flush()

    def flush(self) -> None:
        """Write what is collected."""
        if not self._table:
            return
        table = ormsgpack.packb(self._table)
        names = b"".join(object_name(self._key, Kind(kind), name) for kind, name, _ in self._table)
        sizes = b"".join(min(length, 2**32 - 1).to_bytes(4, "big") for _, _, length in self._table)
        content = b"".join((MAGIC, len(table).to_bytes(4, "big"), table, *self._data))
        self._table, self._data, self._size = [], [], 0
        self.packs.append(self._write(content, names + sizes))


def read_entries(content: bytes) -> Iterator[PackEntry]:
    """Read the objects of a pack's plain bytes. Raises Damaged."""
    try:
        start = 12 + int.from_bytes(content[8:12], "big")
        if content[:8] != MAGIC or start > len(content):
            raise Damaged("a pack of the backup has an unknown form: it may be of a newer release")
        table = ormsgpack.unpackb(content[12:start])
        for kind, name, length in table:
            if start + length > len(content):
                raise Damaged("a pack of the backup is shorter than its table says")
            yield PackEntry(Kind(kind), name, content[start : start + length])
            start += length
    except (ValueError, TypeError) as error:
        raise Damaged(f"the table of a pack of the backup cannot be read ({error})") from error


def index_of(pack: PackReference, entries: bytes, key: bytes) -> bytes:
    """Return the content of a pack's index. entries: the names of its objects, then their sizes."""
    body = INDEX_MAGIC + pack.size.to_bytes(8, "big") + entries
    return body + _code(pack.name, body, key)


def read_index(name: str, content: bytes, key: bytes) -> tuple[int, bytes] | None:
    """Check an index; returns the size of its pack and the entries, None if it is cut off or altered."""
    body, code = content[:-CODE_BYTES], content[-CODE_BYTES:]
    if (
        body[:8] != INDEX_MAGIC
        or (len(body) - 16) % ENTRY_BYTES
        or not hmac.compare_digest(code, _code(name, body, key))
    ):
        return None
    return int.from_bytes(body[8:16], "big"), body[16:]


def _code(name: str, body: bytes, key: bytes) -> bytes:
    return hashlib.blake2b(name.encode() + body, key=key, digest_size=CODE_BYTES).digest()


class ObjectIndex:
    """Which pack of a place has an object, of many objects in little memory (25 bytes each).

    entries: of the index of each pack.

    Two names with equal first halves, which is next to impossible, make one of them unknown: it is written again.
    """

    def __init__(self, packs: Sequence[PackReference], entries: Sequence[bytes]) -> None:
        self.packs = list(packs)
        counts = [len(content) // ENTRY_BYTES for content in entries]
        joined = b"".join(e[: n * NAME_BYTES] for e, n in zip(entries, counts, strict=True))
        both: NDArray[Any] = np.frombuffer(joined, ">u8").reshape(-1, 2)
        joined = b"".join(e[n * NAME_BYTES :] for e, n in zip(entries, counts, strict=True))
        sizes = np.frombuffer(joined, ">u4")
        numbers = np.repeat(np.arange(len(counts), dtype=np.int32), counts)
        order = np.argsort(both[:, 0], kind="stable")
        self._first = both[order, 0].astype(np.uint64)
        self._second = both[order, 1].astype(np.uint64)
        self._pack, self._size = numbers[order], sizes[order].astype(np.int64) + NAME_BYTES
        self._used = np.zeros(len(order), bool)

    def find(self, names: Sequence[bytes]) -> NDArray[np.int32]:
        """Return for each object name the number of its pack, -1 if the place does not have it."""
        if not names or not len(self._first):
            return np.full(len(names), -1, np.int32)
        asked = np.frombuffer(b"".join(names), ">u8").reshape(-1, 2).astype(np.uint64)
        at = np.minimum(np.searchsorted(self._first, asked[:, 0]), len(self._first) - 1)
        present = (self._first[at] == asked[:, 0]) & (self._second[at] == asked[:, 1])
        self._used[at[present]] = True
        return np.where(present, self._pack[at], -1).astype(np.int32)

    def used_shares(self) -> NDArray[np.float64]:
        """Return for each pack the share of its bytes that ``find`` was asked for."""
        count = len(self.packs)
        used = np.bincount(self._pack[self._used], self._size[self._used], count)
        shares: NDArray[np.float64] = used / np.maximum(np.bincount(self._pack, self._size, count), 1)
        return shares
