"""Chunks in the database: read in batches, hashed again, kept in a bounded memory; written in one statement."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Iterable, Mapping, Sequence

from sqlalchemy import Connection

from app.errors import Damaged
from app.store.database import Database
from app.store.encode import decompress, digest

BATCH = 500
CACHE_BYTES = 64 * 2**20
BIGGEST_CACHED = 2**20


class Chunks:
    """Reads chunks by hash. Thread-safe. reads: how many came from the database so far."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._lock = threading.Lock()
        self._cache: OrderedDict[bytes, bytes] = OrderedDict()
        self._bytes = 0
        self.reads = 0

    def read_many(self, hashes: Sequence[bytes]) -> dict[bytes, bytes]:
        """Hash -> canonical bytes; Damaged where one is missing or does not match its hash."""
        out: dict[bytes, bytes] = {}
        with self._lock:
            for h in hashes:
                known = self._cache.get(h)
                if known is not None:
                    self._cache.move_to_end(h)
                    out[h] = known
        missing = [h for h in dict.fromkeys(hashes) if h not in out]
        if missing:
            read = self._query(missing)
            out.update(read)
            self._keep(read)
        return out

    def _query(self, hashes: Sequence[bytes]) -> dict[bytes, bytes]:
        out: dict[bytes, bytes] = {}
        with self._database.read() as connection:
            for start in range(0, len(hashes), BATCH):
                some = list(hashes[start : start + BATCH])
                if self._database.sqlite:
                    marks = ",".join("?" * len(some))
                    rows = connection.exec_driver_sql(
                        f"SELECT hash, data FROM chunk WHERE hash IN ({marks})",  # noqa: S608 - only question marks
                        tuple(some),
                    )
                else:
                    rows = connection.exec_driver_sql("SELECT hash, data FROM chunk WHERE hash = ANY(%s)", (some,))
                for name, data in rows.fetchall():
                    raw = decompress(bytes(data))
                    if digest(raw) != bytes(name):
                        raise Damaged(f"the stored chunk {bytes(name).hex()} does not match its hash: restore a backup")
                    out[bytes(name)] = raw
        self.reads += len(out)
        for h in hashes:
            if h not in out:
                raise Damaged(f"the stored chunk {h.hex()} is missing: restore a backup")
        return out

    def _keep(self, read: Mapping[bytes, bytes]) -> None:
        with self._lock:
            for h, raw in read.items():
                if h in self._cache or len(raw) > BIGGEST_CACHED:
                    continue
                self._cache[h] = raw
                self._bytes += len(raw)
            while self._bytes > CACHE_BYTES:
                _, raw = self._cache.popitem(last=False)
                self._bytes -= len(raw)

    def forget(self) -> None:
        """Empty the memory."""
        with self._lock:
            self._cache.clear()
            self._bytes = 0


def insert(connection: Connection, chunks: Mapping[str, bytes], now: float | None = None) -> None:
    """Write chunks (hash in hex -> stored bytes); one that is there counts as used now.

    Sorted by hash, so that two uploads with common chunks wait for each other instead of deadlocking.
    """
    used = int(time.time() if now is None else now)
    rows = [(bytes.fromhex(h), chunks[h], used) for h in sorted(chunks)]
    if not rows:
        return
    mark = "?" if connection.dialect.name == "sqlite" else "%s"
    connection.exec_driver_sql(
        f"INSERT INTO chunk (hash, data, used) VALUES ({mark}, {mark}, {mark}) "  # noqa: S608 - only marks
        "ON CONFLICT (hash) DO UPDATE SET used = excluded.used",
        rows,
    )


def delete(connection: Connection, hashes: Iterable[bytes], before: int) -> int:
    """Remove those of the chunks that were last used before this second; how many."""
    count = 0
    some = sorted(hashes)
    for start in range(0, len(some), BATCH):
        batch = some[start : start + BATCH]
        if connection.dialect.name == "sqlite":
            marks = ",".join("?" * len(batch))
            result = connection.exec_driver_sql(
                f"DELETE FROM chunk WHERE hash IN ({marks}) AND used < ?",  # noqa: S608 - only question marks
                (*batch, before),
            )
        else:
            result = connection.exec_driver_sql("DELETE FROM chunk WHERE hash = ANY(%s) AND used < %s", (batch, before))
        count += result.rowcount
    return count
