"""Removal of blobs that nothing refers to, and checks of those that are stored."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator
from typing import Final

from sqlalchemy import delete, exists, select, update

from app.backends.blobs import Unreadable
from app.errors import Unavailable
from app.store import blob_rows
from app.store.blob_rows import BATCH
from app.store.blobs import Blobs
from app.store.database import Database
from app.store.tables import blob, is_young, made_map, source

_SINGLE: Final = re.compile(r"[0-9a-f]{2}/(?P<name>[0-9a-f]{64})(\..+)?")
_PACK: Final = re.compile(r"packs/(?P<name>[0-9a-f]{64})")
_SHARED: Final = re.compile(r"made/[0-9a-f]{2}/(?P<name>[0-9a-f]{64})")


class BlobUpkeep:
    """Upkeep of the blobs of one store."""

    def __init__(self, database: Database, blobs: Blobs) -> None:
        self._database, self._blobs = database, blobs

    def keep(self, names: Collection[str]) -> None:
        """Note that versions refer to these blobs, so that ``collect_young`` does not look at them again."""
        listed = sorted(names)
        for start in range(0, len(listed), BATCH):
            some = listed[start : start + BATCH]
            with self._database.write(upkeep=True) as connection:
                young = blob.c.sha256.in_(some), is_young(blob)
                if connection.execute(select(blob.c.sha256).where(*young).limit(1)).first() is not None:
                    connection.execute(update(blob).where(*young).values(kept=True))

    def collect_young(self, referenced: set[str], before: int) -> tuple[int, int]:
        """Remove those that no version is known to refer to, unless ``referenced`` or used since; (count, bytes)."""
        query = select(blob.c.sha256).where(is_young(blob), blob.c.used < before)
        with self._database.read() as connection:
            idle = sorted(set(connection.execute(query).scalars()) - referenced)
            sources: set[str] = set()
            for start in range(0, len(idle), BATCH):
                some = idle[start : start + BATCH]
                named = select(source.c.sha256).where(source.c.sha256.in_(some), source.c.removed.is_(None))
                sources.update(connection.execute(named).scalars())
        self.keep(sources)
        return self._remove([name for name in idle if name not in sources], before, young=True)

    def collect_all(self, referenced: set[str], before: int) -> tuple[int, int]:
        """Remove all that are not referenced and were last used before this second; (count, bytes)."""
        with self._database.read() as connection:
            query = select(blob.c.sha256).where(blob.c.used < before)
            idle = sorted(name for name in connection.execute(query).scalars() if name not in referenced)
        return self._remove(idle, before, young=False)

    def _remove(self, names: list[str], before: int, *, young: bool) -> tuple[int, int]:
        """Remove rows, then the files while the transaction still holds their rows.

        An upload that uses one again waits, then finds it missing and writes it. The base of another blob stays; that
        of removed ones goes with them, chain by chain.
        """
        count = freed = 0
        packs: set[str] = set()
        left = names
        while left:
            removed: set[str] = set()
            for start in range(0, len(left), BATCH):
                for row in self._remove_batch(left[start : start + BATCH], before, young=young):
                    removed.add(row.name)
                    freed += row.size
                    packs |= {row.pack} if row.pack is not None else set()
            count += len(removed)
            left = [name for name in left if name not in removed] if removed else []
        for pack in sorted(packs):
            self._repack(pack)
        return count, freed

    def _remove_batch(self, names: list[str], before: int, *, young: bool) -> list[blob_rows.BlobRow]:
        other = blob.alias()
        needed = exists(select(other.c.sha256).where(other.c.base == blob.c.sha256))
        conditions = [blob.c.sha256.in_(names), blob.c.used < before, ~needed]
        if young:
            conditions.append(is_young(blob))
        with self._database.write(upkeep=True) as connection:
            rows = blob_rows.select_rows(connection, names)
            gone = set(connection.execute(delete(blob).where(*conditions).returning(blob.c.sha256)).scalars())
            removed = [rows[name] for name in sorted(gone) if name in rows]
            self._blobs.files.delete([row.key for row in removed if row.pack is None])
        return removed

    def _repack(self, pack: str) -> None:
        """Write the used blobs of a pack into a new one."""
        with self._database.read() as connection:
            names = list(connection.execute(select(blob.c.sha256).where(blob.c.pack == pack)).scalars())
        if names:
            moved = self._blobs.write_pack(self._blobs.get_many(names))
            with self._database.write(upkeep=True) as connection:
                blob_rows.relocate(connection, moved, pack_was=pack)
        with self._database.write(upkeep=True) as connection:
            if connection.execute(select(blob.c.sha256).where(blob.c.pack == pack).limit(1)).first() is None:
                self._blobs.files.delete([f"packs/{pack}"])

    def remove_strays(self, before: float) -> int:
        """List all files, and remove those without a row: remains of processes that ended between the two."""
        count = 0
        batch: list[str] = []
        for file in self._blobs.files.list():
            if file.modified < before:
                batch.append(file.key)
            if len(batch) == BATCH:
                count += self._remove_unknown(batch)
                batch = []
        return count + self._remove_unknown(batch)

    def _remove_unknown(self, keys: list[str]) -> int:
        single = {key: match["name"] for key in keys if (match := _SINGLE.fullmatch(key))}
        packs = {key: match["name"] for key in keys if (match := _PACK.fullmatch(key))}
        shared = {key: match["name"] for key in keys if (match := _SHARED.fullmatch(key))}
        with self._database.read() as connection:
            rows = blob_rows.select_rows(connection, sorted({*single.values()}))
            query = select(blob.c.pack).where(blob.c.pack.in_(sorted({*packs.values()}))).distinct()
            known_packs = set(connection.execute(query).scalars())
            query = select(made_map.c.object).where(made_map.c.object.in_(sorted({*shared.values()})))
            known_shared = set(connection.execute(query).scalars())
        strays = [key for key, name in single.items() if name not in rows or rows[name].key != key]
        strays += [key for key, name in packs.items() if name not in known_packs]
        strays += [key for key, name in shared.items() if name not in known_shared]
        self._blobs.files.delete(strays)
        return len(strays)

    def verify(self) -> list[str]:
        """Hash everything; returns the names of damaged and lost blobs."""
        return [name for name, _, problem in self.iterate_checks() if problem is not None]

    def iterate_checks(
        self, after: str = "", skip: Callable[[str, Unavailable], None] | None = None
    ) -> Iterator[tuple[str, int, str | None]]:
        """Hash one blob after the other, in order of their names: (name, bytes, ``lost``, ``damaged`` or None).

        skip: called for a file that is temporarily unreadable; without it, that raises Unavailable.
        """
        while True:
            query = select(blob.c.sha256).where(blob.c.sha256 > after).order_by(blob.c.sha256).limit(BATCH)
            with self._database.read() as connection:
                rows = blob_rows.select_rows(connection, list(connection.execute(query).scalars()))
            for name, row in sorted(rows.items()):
                try:
                    problem = self._blobs.check_row(row)
                except Unreadable as error:
                    if skip is None:
                        raise
                    skip(name, error)
                    continue
                yield name, row.size, problem
            if len(rows) < BATCH:
                return
            after = max(rows)
