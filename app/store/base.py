"""Shared helpers of the store's services: rows as values, names, texts that both databases accept."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any, Final

from sqlalchemy import Connection, Row, Table, bindparam, select
from sqlalchemy.dialects import postgresql, sqlite

from app.errors import Gone, Invalid, Mirrored, NotFound, Problem
from app.model.frame import Datum
from app.model.names import did_you_mean
from app.store import tables
from app.store.values import LATEST, Environment

ENVIRONMENT_NAME: Final = re.compile(r"[a-z0-9][a-z0-9_-]{0,62}")
RESERVED: Final = frozenset({"robots", "server"})
CHANNEL_NAME: Final = re.compile(r"[a-z][a-z0-9_-]{0,62}")

MAX_TEXT: Final = 64 * 2**10

_ENVIRONMENT: Final = select(tables.environment).where(tables.environment.c.name == bindparam("environment"))
"""Built once, like other statements of most requests: to build one takes as long as to execute it."""

_LOCKED_ENVIRONMENT: Final = _ENVIRONMENT.with_for_update()


_NOT_IN_XML: Final = re.compile("[\\x00-\\x08\\x0b\\x0c\\x0e-\\x1f\\ufffe\\uffff]")


def utcnow() -> datetime:
    """Return the current time, in UTC."""
    return datetime.now(UTC)


def checked_text(value: str, label: str, longest: int = MAX_TEXT) -> str:
    """Check a text that both databases can store: no NUL, no lone surrogate, not too long. Raises Invalid."""
    if len(value) > longest or "\x00" in value or any("\ud800" <= c <= "\udfff" for c in value):
        raise Invalid(f"{label} must have at most {longest} characters, none of them NUL or half of a surrogate pair")
    return value


def checked_prose(value: str, label: str) -> str:
    """Check a text that XML documents have, too: no control characters but tabs and line ends. Raises Invalid."""
    if _NOT_IN_XML.search(value):
        raise Invalid(f"{label} must have no control characters")
    return checked_text(value, label)


def storable_text(value: str) -> str:
    """Replace characters in a file's text that databases reject by U+FFFD."""
    return value.replace("\x00", "\ufffd").encode("utf-8", "replace").decode()


def clean_problem(problem: Problem) -> Problem:
    """Return a problem with texts that databases can store."""
    return Problem(
        storable_text(problem.problem),
        None if problem.file is None else storable_text(problem.file),
        problem.line,
        None if problem.where is None else storable_text(problem.where),
    )


def hash_secret(secret: str) -> str:
    """Return what is stored of a token or a session's secret."""
    return hashlib.sha256(secret.encode("utf-8", "surrogatepass")).hexdigest()


def check_environment_name(name: str) -> str:
    """Raise Invalid if a name is not allowed for an environment."""
    if not ENVIRONMENT_NAME.fullmatch(name) or name in RESERVED:
        raise Invalid(
            f"invalid environment name {name[:80]!r}: use 1 to 63 of a-z, 0-9, _ and -, starting with a "
            "letter or digit; 'robots' and 'server' are taken"
        )
    return name


def upsert(connection: Connection, table: Table, keys: Mapping[str, Any], values: Mapping[str, Any]) -> None:
    """Insert a row, or update the row with these keys."""
    make = sqlite.insert if connection.dialect.name == "sqlite" else postgresql.insert
    statement = make(table).values(**keys, **values)
    connection.execute(statement.on_conflict_do_update(index_elements=list(keys), set_=dict(values)))


def environment_row(
    connection: Connection, name: str, *, lock: bool = False, deleted: bool = False, mirrored: bool = False
) -> Row[Any]:
    """Read an environment's row, with ``lock`` locked until the transaction ends.

    mirrored: for a change that is also allowed in an environment that follows another server.

    Raises Gone if it is deleted, NotFound if it is unknown, Mirrored for any other change of a mirrored environment.
    """
    row = connection.execute(_LOCKED_ENVIRONMENT if lock else _ENVIRONMENT, {"environment": name}).one_or_none()
    if row is None:
        raise NotFound(f"unknown environment {name[:80]!r}")
    if row.deleted is not None and not deleted:
        raise Gone(f"the environment {name!r} is deleted: restore it with POST /api/v1/environments/{name}/restore")
    if lock and not mirrored:
        check_own(row)
    return row


def check_own(environment: Row[Any]) -> None:
    """Raise Mirrored for an environment that follows another server."""
    if environment.centre is not None:
        raise Mirrored(
            f"the environment {environment.name!r} is a mirror of the one at {environment.centre}: make the change "
            "there"
        )


def nearest_channel(connection: Connection, environment: Row[Any], name: str) -> str:
    """Return ` (did you mean NAME?)` for an unknown channel, or an empty text if no other name is similar."""
    table = tables.channel
    names = connection.execute(select(table.c.name).where(table.c.environment_id == environment.id)).scalars()
    return did_you_mean(name, [LATEST, *names])


def datum_from_row(members: dict[str, float] | None) -> Datum | None:
    """Convert a stored datum."""
    return None if members is None else Datum(**members)


def as_environment(row: Row[Any]) -> Environment:
    """Convert a row into a value."""
    return Environment(
        id=row.id,
        name=row.name,
        title=row.title,
        description=row.description,
        tags=tuple(row.tags),
        head=row.head,
        root=row.root,
        datum=datum_from_row(row.datum),
        bounds=None if row.west is None else (row.west, row.south, row.east, row.north),
        created=row.created,
        updated=row.updated,
        deleted=row.deleted,
        sequence=row.sequence,
    )


def check_tags(tags: Sequence[str]) -> list[str]:
    """Return tags in the form in which they are stored: without duplicates, in the given order."""
    return [checked_text(tag, "a tag", 256) for tag in dict.fromkeys(tags)]
