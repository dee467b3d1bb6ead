"""Chunks in the database: read in batches, hashed again, cached in bounded memory; written in one statement."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping, Sequence

from sqlalchemy import Connection, select

from app.errors import Damaged
from app.store import tables
from app.store.database import Database
from app.store.encode import compress, decompress, digest
from app.store.tree import ChunkStage

BATCH = 500
REPAIR = "run `fleetmap verify --repair`, or restore a backup"
CACHE_BYTES = 64 * 2**20
MAX_CACHED_CHUNK_BYTES = 2**20


class Chunks:
    """Reader of chunks by hash, with a cache. Thread-safe. reads: number of chunks read from the database so far."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._lock = threading.Lock()
        self._cache: OrderedDict[bytes, bytes] = OrderedDict()
        self._bytes = 0
        self.reads = 0

    def read_many(self, hashes: Sequence[bytes]) -> dict[bytes, bytes]:
        """Read chunks: hash -> canonical bytes. Raises Damaged if one is missing or does not match its hash."""
        out: dict[bytes, bytes] = {}
        with self._lock:
            for h in hashes:
                chunk = self._cache.get(h)
                if chunk is not None:
                    self._cache.move_to_end(h)
                    out[h] = chunk
        missing = [h for h in dict.fromkeys(hashes) if h not in out]
        if missing:
            read = self._query(missing)
            out.update(read)
            self._cache_chunks(read)
        return out

    def read(self, sha256: str) -> bytes:
        """Read a chunk's canonical bytes by its hash in hex, hashed again. Raises Damaged if it is lost or damaged."""
        name = bytes.fromhex(sha256)
        return self.read_many([name])[name]

    def stored(self, hashes: Sequence[bytes]) -> list[tuple[bytes, bytes]]:
        """Read chunks as they are stored, in the given order: (hash, compressed bytes). Raises Damaged if one is lost.

        Not hashed again: for another server, which does that.
        """
        rows = dict(self._rows(hashes))
        for name in hashes:
            if name not in rows:
                raise Damaged(f"the stored chunk {name.hex()} is missing: {REPAIR}")
        return [(name, rows[name]) for name in hashes]

    def stage(self) -> ChunkStage:
        """Create a stage for new chunks on top of the stored ones."""
        return ChunkStage(self)

    def heal(self, chunks: Mapping[str, bytes]) -> None:
        """Replace damaged or lost chunks (hash in hex -> canonical bytes). Raises Damaged for a wrong hash."""
        for name, raw in chunks.items():
            if digest(raw).hex() != name:
                raise Damaged(f"the replacement does not match the hash of chunk {name}")
        with self._database.write() as connection:
            insert(connection, {name: compress(raw) for name, raw in chunks.items()}, kept=True)

    def remove_damaged(self, hashes: Iterable[str], before: float) -> set[str]:
        """Remove damaged chunks (hashes in hex) that were last used before this second; returns the removed ones."""
        names = [bytes.fromhex(name) for name in hashes]
        with self._database.write() as connection:
            damaged = [name for name, data in select_rows(connection, names) if problem(name, data) is not None]
            return {name.hex() for name in delete(connection, damaged, int(before))}

    def find_damaged(self, hashes: Sequence[bytes]) -> dict[bytes, str]:
        """Check chunks in the database, bypassing the cache; of the bad ones: hash -> ``lost`` or ``damaged``."""
        out = dict.fromkeys(hashes, "lost")
        for start in range(0, len(hashes), BATCH):
            for name, data in self._rows(hashes[start : start + BATCH]):
                if problem(name, data) is None:
                    out.pop(name, None)
                else:
                    out[name] = "damaged"
        return out

    def iterate_checks(self, after: bytes = b"") -> Iterator[tuple[bytes, int, str | None]]:
        """Hash one stored chunk after the other, in order of their hashes: (hash, bytes, ``damaged`` or None)."""
        table = tables.chunk
        while True:
            query = select(table.c.hash, table.c.data).where(table.c.hash > after).order_by(table.c.hash).limit(BATCH)
            with self._database.read() as connection:
                rows = connection.execute(query).all()
            for row in rows:
                yield bytes(row.hash), len(row.data), problem(bytes(row.hash), bytes(row.data))
            if len(rows) < BATCH:
                return
            after = bytes(rows[-1].hash)

    def _rows(self, hashes: Sequence[bytes]) -> list[tuple[bytes, bytes]]:
        with self._database.read() as connection:
            return list(select_rows(connection, hashes))

    def _query(self, hashes: Sequence[bytes]) -> dict[bytes, bytes]:
        out: dict[bytes, bytes] = {}
        for start in range(0, len(hashes), BATCH):
            for name, data in self._rows(hashes[start : start + BATCH]):
                raw = decompress(data)
                if digest(raw) != name:
                    raise Damaged(f"the stored chunk {name.hex()} does not match its hash: {REPAIR}")
                out[name] = raw
        self.reads += len(out)
        for h in hashes:
            if h not in out:
                raise Damaged(f"the stored chunk {h.hex()} is missing: {REPAIR}")
        return out

    def _cache_chunks(self, read: Mapping[bytes, bytes]) -> None:
        with self._lock:
            for h, raw in read.items():
                if h in self._cache or len(raw) > MAX_CACHED_CHUNK_BYTES:
                    continue
                self._cache[h] = raw
                self._bytes += len(raw)
            while self._bytes > CACHE_BYTES:
                _, raw = self._cache.popitem(last=False)
                self._bytes -= len(raw)

    def forget(self) -> None:
        """Empty the cache."""
        with self._lock:
            self._cache.clear()
            self._bytes = 0


def problem(name: bytes, data: bytes) -> str | None:
    """Return ``damaged`` if stored bytes do not match the chunk's hash, else None."""
    try:
        return None if digest(decompress(data)) == name else "damaged"
    except Damaged:
        return "damaged"


def insert(
    connection: Connection, chunks: Mapping[str, bytes], now: float | None = None, *, kept: bool = False
) -> None:
    """Write chunks (hash in hex -> stored bytes); an existing one counts as used now. kept: a version refers to them.

    An existing row gets these bytes too, which repairs a damaged one. Chunks are written in the order of their hashes,
    so that two uploads with common chunks wait for each other instead of deadlocking.
    """
    used = int(time.time() if now is None else now)
    rows = [(bytes.fromhex(h), chunks[h], used, kept) for h in sorted(chunks)]
    if not rows:
        return
    mark = "?" if connection.dialect.name == "sqlite" else "%s"
    connection.exec_driver_sql(
        f"INSERT INTO chunk (hash, data, used, kept) VALUES ({mark}, {mark}, {mark}, {mark}) "  # noqa: S608 - only marks
        "ON CONFLICT (hash) DO UPDATE SET used = excluded.used, data = excluded.data, "
        "kept = chunk.kept OR excluded.kept",
        rows,
    )


def select_rows(connection: Connection, hashes: Sequence[bytes]) -> Iterator[tuple[bytes, bytes]]:
    """Read hash and stored bytes of the chunks that exist."""
    columns = "SELECT hash, data FROM chunk WHERE hash"
    for batch in _batches(hashes):
        if connection.dialect.name == "sqlite":
            marks = ",".join("?" * len(batch))
            rows = connection.exec_driver_sql(f"{columns} IN ({marks})", tuple(batch))
        else:
            rows = connection.exec_driver_sql(f"{columns} = ANY(%s)", (batch,))
        yield from ((bytes(name), bytes(data)) for name, data in rows.fetchall())


def delete(connection: Connection, hashes: Iterable[bytes], before: int, *, young: bool = False) -> list[bytes]:
    """Remove the chunks that were last used before this second (young: and are not kept); returns the removed ones."""
    out: list[bytes] = []
    further = " AND kept IS false" if young else ""
    for batch in _batches(sorted(hashes)):
        if connection.dialect.name == "sqlite":
            marks = ",".join("?" * len(batch))
            rows = connection.exec_driver_sql(
                f"DELETE FROM chunk WHERE hash IN ({marks}) AND used < ?{further} RETURNING hash",  # noqa: S608 - only marks
                (*batch, before),
            )
        else:
            rows = connection.exec_driver_sql(
                f"DELETE FROM chunk WHERE hash = ANY(%s) AND used < %s{further} RETURNING hash",  # noqa: S608
                (batch, before),
            )
        out += [bytes(name) for (name,) in rows.fetchall()]
    return out


def _batches(hashes: Sequence[bytes]) -> Iterator[list[bytes]]:
    return (list(hashes[start : start + BATCH]) for start in range(0, len(hashes), BATCH))
