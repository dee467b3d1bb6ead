"""Dry runs: versions that were tried and not committed, readable by id for some minutes.

Their content is stored like that of a version, with a row that garbage collection treats as a root. A commit locks the
row, and what is removed is the row: so a commit finds either all of its content or no dry run.
"""

from __future__ import annotations

import re
import secrets
from collections.abc import Sequence
from datetime import datetime, timedelta
from typing import Any, Final

from sqlalchemy import Connection, Row, delete, select
from sqlalchemy import insert as insert_into

from app.errors import NotFound, Problem
from app.store import tables
from app.store.base import storable_text
from app.store.changes import Prepared
from app.store.database import Database
from app.store.pending import as_version, content_values
from app.store.values import DRY_PREFIX, Pending, Source, Version

LIFETIME: Final = timedelta(minutes=10)

MAX_DRY_RUNS: Final = 20
"""Maximum number of dry runs of an environment: a further one removes the oldest."""

_ID: Final = re.compile(r"[0-9a-f]{32}")


def insert(
    connection: Connection,
    environment: Row[Any],
    prepared: Prepared,
    *,
    author: str,
    message: str,
    sources: Sequence[Source],
    warnings: Sequence[Problem],
    now: datetime,
) -> Version:
    """Write the row of a dry run, and remove the oldest of too many.

    The caller has locked the environment's row and stored the content in this transaction.
    """
    table = tables.dry_run
    new = secrets.token_hex(16)
    connection.execute(
        insert_into(table).values(
            id=new,
            environment_id=environment.id,
            author=author,
            message=message,
            created=now,
            expires=now + LIFETIME,
            sources=[{**source.as_dict(), "name": storable_text(source.name)} for source in sources],
            **content_values(prepared, warnings),
        )
    )
    others = select(table.c.id).where(table.c.environment_id == environment.id, table.c.id != new)
    oldest = others.order_by(table.c.created.desc(), table.c.id).offset(MAX_DRY_RUNS - 1)
    surplus = connection.execute(oldest).scalars().all()
    if surplus:
        connection.execute(delete(table).where(table.c.id.in_(surplus)))
    return read(connection, environment, DRY_PREFIX + new, now)


def read(connection: Connection, environment: Row[Any], ref: str, now: datetime) -> Version:
    """Read a dry run by ``dry:<id>``. Raises NotFound if it is unknown or has expired."""
    row = _row(connection, environment, ref.removeprefix(DRY_PREFIX), now)
    pending = Pending("dry", row.id, row.expires, row.changed)
    sources = [Source(**source) for source in row.sources]
    return as_version(environment, row, pending, author=row.author, message=row.message, sources=sources)


def lock(connection: Connection, environment: Row[Any], id: str, now: datetime) -> None:
    """Keep a dry run until the transaction ends. Raises NotFound if it is unknown or has expired."""
    _row(connection, environment, id, now, lock=True)


def remove_expired(database: Database) -> None:
    """Remove the rows of expired dry runs."""
    table = tables.dry_run
    expired = table.c.expires <= database.now()
    with database.read() as connection:
        first = connection.execute(select(table.c.id).where(expired).limit(1)).one_or_none()
    if first is not None:
        with database.write(notify=False, upkeep=True) as connection:
            connection.execute(delete(table).where(expired))


def _row(connection: Connection, environment: Row[Any], id: str, now: datetime, *, lock: bool = False) -> Row[Any]:
    table = tables.dry_run
    query = select(table).where(table.c.id == id, table.c.environment_id == environment.id)
    row = None
    if _ID.fullmatch(id):
        row = connection.execute(query.with_for_update() if lock else query).one_or_none()
    if row is None or row.expires <= now:
        raise NotFound(f"{environment.name} has no dry run {id[:80]!r}, or the dry run has expired: run it again")
    return row
