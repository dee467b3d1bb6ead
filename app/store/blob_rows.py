"""Rows of blobs: where the bytes of each are, and when it was last used."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, cast

from sqlalchemy import Connection, bindparam, select, update
from sqlalchemy.dialects import postgresql, sqlite

from app.errors import Unavailable
from app.store.blob_coding import Coding
from app.store.tables import blob

BATCH: Final = 500


@dataclass(frozen=True, slots=True)
class BlobRow:
    """Where a blob's bytes are. stored: number of bytes there. base: the blob that they are the difference from.

    chain: number of versions of a file up to this one; it chooses the base of the next.
    """

    name: str
    size: int
    pack: str | None = None
    start: int = 0
    stored: int = 0
    coding: Coding | None = None
    base: str | None = None
    chain: int = 0

    @property
    def key(self) -> str:
        """Key of the file that contains it."""
        if self.pack is not None:
            return f"packs/{self.pack}"
        single = f"{self.name[:2]}/{self.name}"
        if self.base is not None:
            return f"{single}.{self.base[:16]}.{self.coding}"
        return single if self.coding is None else f"{single}.zst"


_COLUMNS: Final = (
    blob.c.sha256,
    blob.c.size,
    blob.c.pack,
    blob.c.start,
    blob.c.stored,
    blob.c.coding,
    blob.c.base,
    blob.c.chain,
)


_SELECTED: Final = blob.c.sha256.in_(bindparam("names", expanding=True))
_ROWS: Final = select(*_COLUMNS).where(_SELECTED)
_LOCKED: Final = select(blob.c.sha256).where(_SELECTED).order_by(blob.c.sha256).with_for_update()


def select_rows(connection: Connection, names: Sequence[str]) -> dict[str, BlobRow]:
    """Read the rows that exist."""
    out: dict[str, BlobRow] = {}
    for start in range(0, len(names), BATCH):
        for r in connection.execute(_ROWS, {"names": list(names[start : start + BATCH])}):
            stored = r.size if r.stored is None else r.stored
            coding = cast("Coding | None", r.coding)
            out[r.sha256] = BlobRow(r.sha256, r.size, r.pack, r.start, stored, coding, r.base, r.chain)
    return out


def touch(connection: Connection, names: Sequence[str]) -> dict[str, BlobRow]:
    """Mark rows as used now, so that garbage collection skips them; returns those that exist."""
    out: dict[str, BlobRow] = {}
    for start in range(0, len(names), BATCH):
        some = list(names[start : start + BATCH])
        connection.execute(update(blob).where(blob.c.sha256.in_(some)).values(used=int(time.time())))
        out.update(select_rows(connection, some))
    return out


def lock(connection: Connection, hashes: Collection[str], *, kept: bool) -> None:
    """Mark blobs of this transaction as used, so that garbage collection skips them. kept: a version refers to them.

    Raises Unavailable if one is missing.
    """
    values: dict[str, object] = {"used": int(time.time()), **({"kept": True} if kept else {})}
    names = sorted(hashes)
    for start in range(0, len(names), BATCH):
        some = names[start : start + BATCH]
        stored_names = set(connection.execute(_LOCKED, {"names": some}).scalars())
        missing = [n for n in some if n not in stored_names]
        if missing:
            raise Unavailable(f"uploaded file {missing[0]} is no longer stored: send it again")
        connection.execute(update(blob).where(blob.c.sha256.in_(some)).values(values))


def insert(connection: Connection, rows: Iterable[BlobRow]) -> None:
    """Insert rows for new blobs; a row that another upload inserted first stays and counts as used now.

    Raises Unavailable if the base of one was removed meanwhile.
    """
    listed = sorted(rows, key=lambda row: row.name)
    if not listed:
        return
    now = int(time.time())
    bases = sorted({row.base for row in listed if row.base is not None})
    if len(touch(connection, bases)) < len(bases):
        raise Unavailable("a stored file was removed during the upload: send it again")
    make = sqlite.insert if connection.dialect.name == "sqlite" else postgresql.insert
    statement = make(blob)
    values = [{"sha256": row.name, "used": now, "size": row.size, **_place(row)} for row in listed]
    again = {"used": statement.excluded.used}
    connection.execute(statement.on_conflict_do_update(index_elements=["sha256"], set_=again), values)


def relocate(connection: Connection, rows: Iterable[BlobRow], *, pack_was: str | None = None) -> None:
    """Change where blobs are. pack_was: only if they are still in that pack."""
    listed = list(rows)
    if not listed:
        return
    statement = update(blob).where(blob.c.sha256 == bindparam("name"))
    if pack_was is not None:
        statement = statement.where(blob.c.pack == pack_was)
    values: dict[str, object] = {name: bindparam(f"to_{name}") for name in _place(listed[0])}
    parameters = [{"name": row.name, **{f"to_{n}": v for n, v in _place(row).items()}} for row in listed]
    connection.execute(statement.values(values), parameters)


def _place(row: BlobRow) -> Mapping[str, object]:
    return {
        "pack": row.pack,
        "start": row.start,
        "stored": row.stored,
        "coding": row.coding,
        "base": row.base,
        "chain": row.chain,
    }
