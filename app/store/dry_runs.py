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

from app.errors import Invalid, NotFound, Problem
from app.store import tables
from app.store.base import clean_problem, storable_text
from app.store.changes import Prepared
from app.store.database import Database
from app.store.manifest import pack_manifest, unpack_manifest, warnings_from_row
from app.store.values import DRY_NUMBER, DRY_PREFIX, DryRun, Source, Version

LIFETIME: Final = timedelta(minutes=10)

MAX_DRY_RUNS: Final = 20
"""Maximum number of dry runs of an environment: a further one removes the oldest."""

_ID: Final = re.compile(r"[0-9a-f]{32}")


def check_committed(ref: str | int) -> None:
    """Raise Invalid if a name of a version is that of a dry run."""
    if isinstance(ref, str) and ref.startswith(DRY_PREFIX):
        reason = "a dry run is not a version that robots can get: commit it first, and use the number of the version"
        raise Invalid(reason, [Problem(reason, where="version")])


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
            base=prepared.base,
            root=prepared.root,
            author=author,
            message=message,
            created=now,
            expires=now + LIFETIME,
            changed=prepared.changed,
            changes=dict(prepared.changes),
            warnings=[clean_problem(warning).as_dict() for warning in warnings],
            sources=[{**source.as_dict(), "name": storable_text(source.name)} for source in sources],
            manifest=pack_manifest(prepared.datum, prepared.levels, prepared.parts, prepared.templates),
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
    return _as_version(environment, _row(connection, environment, ref.removeprefix(DRY_PREFIX), now))


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


def as_prepared(version: Version) -> Prepared:
    """Return the change of a dry run, to be committed. Its chunks and blobs are stored."""
    assert version.dry_run is not None
    assert version.parent is not None
    return Prepared(
        version.parent,
        version.root,
        {},
        version.parts,
        version.datum,
        version.levels,
        version.templates,
        dict(version.changes),
        changed=version.dry_run.changed,
        dry_run=version.dry_run.id,
    )


def _row(connection: Connection, environment: Row[Any], id: str, now: datetime, *, lock: bool = False) -> Row[Any]:
    table = tables.dry_run
    query = select(table).where(table.c.id == id, table.c.environment_id == environment.id)
    row = None
    if _ID.fullmatch(id):
        row = connection.execute(query.with_for_update() if lock else query).one_or_none()
    if row is None or row.expires <= now:
        raise NotFound(f"{environment.name} has no dry run {id[:80]!r}, or the dry run has expired: run it again")
    return row


def _as_version(environment: Row[Any], row: Row[Any]) -> Version:
    datum, levels, parts, templates = unpack_manifest(bytes(row.manifest))
    return Version(
        environment=environment.name,
        number=DRY_NUMBER,
        root=row.root,
        parent=row.base,
        author=row.author,
        message=row.message,
        time=row.created,
        changes=row.changes,
        sources=tuple(Source(**source) for source in row.sources),
        warnings=warnings_from_row(row.warnings),
        datum=datum,
        levels=levels,
        parts=parts,
        templates=templates,
        dry_run=DryRun(row.id, row.expires, row.changed),
    )
