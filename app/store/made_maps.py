"""Made maps that servers share: an entry by the key of its recipe, and one file of the blob store with all its files.

A map is made once for all servers. What is lost or damaged here is made again, so its bytes are checked by the reader,
and a failure of the blob store never fails a request.
"""

from __future__ import annotations

import hashlib
import logging
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, cast

from sqlalchemy import delete, insert, select, update
from sqlalchemy.exc import IntegrityError

from app.backends.blobs import BlobFiles
from app.errors import Unavailable
from app.store.blob_coding import Coding, Undecodable, compress_bytes, decoded
from app.store.database import Database
from app.store.encode import compress, decompress
from app.store.tables import made_file, made_map

log = logging.getLogger(__name__)

MAX_BYTES: Final = 2**30
"""Maximum size in bytes of a map that is shared; a larger one is made by each server."""
DAY: Final = 86_400
IDLE_DAYS: Final = 30
"""Days without use after which a made map is removed; it is made again when requested."""
BATCH: Final = 200


@dataclass(frozen=True, slots=True)
class MadeMap:
    """A made map. entry: its description, for the cache. contents: of its files, in the order of the entry."""

    entry: bytes
    contents: list[bytes]


class MadeMaps:
    """Made maps of all servers on one database and blob store. Thread-safe."""

    def __init__(self, database: Database, files: BlobFiles) -> None:
        self._database, self._files = database, files
        self._problem: str | None = None

    def publish(self, key: str, entry: bytes, contents: Sequence[bytes | Path]) -> None:
        """Share a map with the other servers, if that is possible now."""
        try:
            self._publish(key, entry, contents)
        except (Unavailable, OSError) as error:
            self._note_problem(str(error))
        else:
            self._note_problem(None)

    def _publish(self, key: str, entry: bytes, contents: Sequence[bytes | Path]) -> None:
        size = sum(len(data) if isinstance(data, bytes) else data.stat().st_size for data in contents)
        if size > MAX_BYTES:
            return
        digest, rows, start = hashlib.sha256(), list[dict[str, Any]](), 0
        with self._files.workspace() as workspace:
            path = workspace / "made"
            with path.open("wb") as out:
                for k, content in enumerate(contents):
                    data = content if isinstance(content, bytes) else content.read_bytes()
                    packed = compress_bytes(data)
                    stored = data if packed is None else packed
                    place = {"start": start, "stored": len(stored), "coding": None if packed is None else "zstd"}
                    sha256 = hashlib.sha256(data).hexdigest()
                    rows.append({"key": key, "position": k, "sha256": sha256, "size": len(data), **place})
                    out.write(stored)
                    digest.update(stored)
                    start += len(stored)
            name = digest.hexdigest()
            self._files.write({_object_key(name): path})
        self._insert(key, name, start, entry, rows)

    def _insert(self, key: str, name: str, size: int, entry: bytes, rows: list[dict[str, Any]]) -> None:
        values = {"key": key, "object": name, "size": size, "entry": compress(entry), "used": int(time.time())}
        try:
            with self._database.write(notify=False, upkeep=True) as connection:
                connection.execute(delete(made_map).where(made_map.c.key == key))
                connection.execute(insert(made_map).values(values))
                if rows:
                    connection.execute(insert(made_file), rows)
        except IntegrityError:  # another server shared the same map at this moment
            return

    def load(self, key: str) -> MadeMap | None:
        """Get a map that a server has made; None if there is none, or if its bytes cannot be had now."""
        try:
            with self._database.read() as connection:
                row = connection.execute(select(made_map).where(made_map.c.key == key)).one_or_none()
                query = select(made_file).where(made_file.c.key == key).order_by(made_file.c.position)
                rows = connection.execute(query).all() if row is not None else []
            if row is None:
                return None
            stored = b"".join(self._files.stream(_object_key(row.object)))
            contents = [self._content(r, stored[r.start : r.start + r.stored]) for r in rows]
        except (FileNotFoundError, Undecodable):
            self.forget(key)
            return None
        except (Unavailable, OSError) as error:
            self._note_problem(str(error))
            return None
        self._note_use(key, row.used)
        return MadeMap(decompress(bytes(row.entry)), contents)

    @staticmethod
    def _content(row: Any, stored: bytes) -> bytes:
        """Decode a file. Raises Undecodable if it does not match its hash."""
        data = b"".join(decoded([stored], cast("Coding | None", row.coding)))
        if hashlib.sha256(data).hexdigest() != row.sha256:
            raise Undecodable(f"the file of a made map does not match its hash {row.sha256}")
        return data

    def find(self, sha256: str, max_bytes: int) -> bytes | None:
        """Return a file of any made map by its hash; None if there is none of at most ``max_bytes``."""
        query = select(made_file, made_map.c.object).join(made_map, made_map.c.key == made_file.c.key)
        try:
            with self._database.read() as connection:
                row = connection.execute(query.where(made_file.c.sha256 == sha256).limit(1)).one_or_none()
            if row is None or row.size > max_bytes:
                return None
            stored = b"".join(self._files.stream(_object_key(row.object), row.start, row.stored))
            return self._content(row, stored)
        except (FileNotFoundError, Undecodable):
            self.forget(row.key if row is not None else "")
        except (Unavailable, OSError) as error:
            self._note_problem(str(error))
        return None

    def forget(self, key: str) -> None:
        """Remove a map whose bytes are lost or damaged, so that it is made again."""
        log.warning("made maps: a shared map was lost or damaged, it will be converted again (key=%s)", key[:16])
        with self._database.write(notify=False, upkeep=True) as connection:
            connection.execute(delete(made_map).where(made_map.c.key == key))

    def iterate_checks(self) -> Iterator[tuple[str, int, str | None]]:
        """Hash one file after the other, in order of their names: (name, bytes, ``lost``, ``damaged`` or None)."""
        after = ""
        while True:
            query = select(made_map.c.object, made_map.c.size).distinct().where(made_map.c.object > after)
            with self._database.read() as connection:
                rows = connection.execute(query.order_by(made_map.c.object).limit(BATCH)).all()
            for row in rows:
                yield row.object, row.size, self._problem_of(row.object)
            if len(rows) < BATCH:
                return
            after = rows[-1].object

    def _problem_of(self, name: str) -> str | None:
        digest = hashlib.sha256()
        try:
            for block in self._files.stream(_object_key(name)):
                digest.update(block)
        except FileNotFoundError:
            return "lost"
        except OSError:  # a broken disk
            return "damaged"
        return None if digest.hexdigest() == name else "damaged"

    def drop(self, name: str) -> None:
        """Remove a file and its maps; they are made again when requested."""
        with self._database.write(notify=False, upkeep=True) as connection:
            connection.execute(delete(made_map).where(made_map.c.object == name))
            self._files.delete([_object_key(name)])

    def collect(self, days: float = IDLE_DAYS) -> int:
        """Remove maps that no server has used for so many days; returns how many."""
        before, count = int(time.time() - days * DAY), 0
        while True:
            with self._database.write(notify=False, upkeep=True) as connection:
                query = select(made_map.c.key).where(made_map.c.used < before).limit(BATCH)
                keys = list(connection.execute(query).scalars())
                gone = delete(made_map).where(made_map.c.key.in_(keys), made_map.c.used < before)
                objects = set(connection.execute(gone.returning(made_map.c.object)).scalars())
                query = select(made_map.c.object).where(made_map.c.object.in_(objects))
                objects -= set(connection.execute(query).scalars())
                self._files.delete([_object_key(name) for name in sorted(objects)])
            count += len(keys)
            if len(keys) < BATCH:
                return count

    def _note_use(self, key: str, used: int) -> None:
        now = int(time.time())
        if now - used > DAY:
            with self._database.write(notify=False, upkeep=True) as connection:
                connection.execute(update(made_map).where(made_map.c.key == key).values(used=now))

    def _note_problem(self, reason: str | None) -> None:
        """Log once that maps cannot be shared, and once that they can again."""
        if (reason is None) != (self._problem is None):
            if reason is None:
                log.warning("made maps: sharing with other servers works again")
            else:
                log.error("made maps: sharing with other servers failed, each makes its own (reason=%s)", reason)
        self._problem = reason


def _object_key(name: str) -> str:
    return f"made/{name[:2]}/{name}"
