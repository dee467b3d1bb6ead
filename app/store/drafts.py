"""Drafts: named working versions, which edits gather in until they are committed or deleted.

The row holds a version's content like that of a dry run, and is replaced by every edit with compare-and-swap.
"""

from __future__ import annotations

import re
import secrets
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime, timedelta
from typing import Any, Final

from sqlalchemy import Connection, Row, delete, func, select, update
from sqlalchemy import insert as insert_into

from app.errors import Conflict, Invalid, NotFound, Problem, StaleParent
from app.store import chunks, tables
from app.store.audit import set_audit_target
from app.store.base import checked_text, environment_row
from app.store.changes import Prepared
from app.store.database import Database
from app.store.manifest import read_version
from app.store.pending import as_prepared, as_version, content_values
from app.store.values import Draft, Pending, Version, Writer

LIFETIME: Final = timedelta(days=90)
"""Time after its last edit when a draft is removed."""

MAX_DRAFTS: Final = 200
"""Maximum number of drafts of an environment."""

MAX_CHANGES: Final = 100_000
"""Maximum number of features that a draft may add, change and delete: as many as one request of edits."""

MAX_NAME: Final = 100
MAX_WARNINGS: Final = 100

_ID: Final = re.compile(r"[0-9a-f]{16}")


def read(connection: Connection, environment: Row[Any], id: str, now: datetime) -> Version:
    """Read the version that a draft holds. Raises NotFound."""
    row = _row(connection, environment, id, now)
    return as_version(environment, row, _pending(row), author=row.owner, message=row.name)


def remove(connection: Connection, environment: Row[Any], pending: Pending, now: datetime) -> None:
    """Remove a draft that is committed. Raises NotFound, or StaleParent if it was edited since it was read."""
    row = _row(connection, environment, pending.id, now)
    table = tables.draft
    same = (table.c.id == pending.id) & (table.c.revision == pending.revision)
    if not connection.execute(delete(table).where(same)).rowcount:
        raise _edited(row.name)


def remove_expired(database: Database) -> None:
    """Remove the rows of expired drafts; the next garbage collection removes their content."""
    table = tables.draft
    expired = table.c.expires <= database.now()
    with database.read() as connection:
        first = connection.execute(select(table.c.id).where(expired).limit(1)).one_or_none()
    if first is not None:
        with database.write(upkeep=True) as connection:
            connection.execute(delete(table).where(expired))


class Drafts:
    """Service for the drafts of environments."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def create(self, environment: str, owner: Writer, name: str | None = None) -> Draft:
        """Create a draft with the content of the head. name: by default ``draft 1``, ``draft 2`` …

        Raises Conflict if the owner has a draft of this name, or the environment has too many; Invalid.
        """
        if name is not None:
            _check_name(name)
        now = self._database.now()
        table = tables.draft
        new = secrets.token_hex(8)
        with self._database.write() as connection:
            row = environment_row(connection, environment, lock=True)
            taken = connection.execute(select(table).where(table.c.environment_id == row.id)).all()
            if len(taken) >= MAX_DRAFTS:
                raise Conflict(f"{environment} has {MAX_DRAFTS} drafts already: commit or delete some")
            names = {other.name for other in taken if other.owner_id == owner.id}
            if name in names:
                raise Conflict(
                    f"you have a draft {name!r} of {environment} already: edit that one, or use another name"
                )
            head = read_version(connection, row, row.head)
            pending = Pending("draft", new, now + LIFETIME, changed=False, revision=1)
            content = as_prepared(_on_head(head, pending))
            connection.execute(
                insert_into(table).values(
                    id=new,
                    environment_id=row.id,
                    created=now,
                    edited=now,
                    expires=pending.expires,
                    name=name
                    or next(one for one in map("draft {}".format, range(1, MAX_DRAFTS + 2)) if one not in names),
                    owner=owner.name,
                    owner_id=owner.id,
                    revision=pending.revision,
                    **content_values(content, ()),
                )
            )
            set_audit_target(target=f"draft {new}")
            return _as_draft(row, _row(connection, row, new, now))

    def all(self, environment: str) -> list[Draft]:
        """List the drafts of an environment, last edited first."""
        table = tables.draft
        with self._database.read() as connection:
            row = environment_row(connection, environment)
            query = select(table).where(table.c.environment_id == row.id, table.c.expires > self._database.now())
            rows = connection.execute(query.order_by(table.c.edited.desc(), table.c.id)).all()
        return [_as_draft(row, one) for one in rows]

    def get(self, environment: str, id: str) -> Draft:
        """Read a draft. Raises NotFound."""
        with self._database.read() as connection:
            row = environment_row(connection, environment)
            return _as_draft(row, _row(connection, row, id, self._database.now()))

    def find(self, environment: str, owner: Writer, name: str) -> Draft | None:
        """Find somebody's own draft by its name, or return None."""
        owned = (draft for draft in self.all(environment) if draft.owner_id == owner.id and draft.name == name)
        return next(owned, None)

    def store(
        self, environment: str, pending: Pending, prepared: Prepared, warnings: Sequence[Problem] = (), *, rebased: bool
    ) -> Draft:
        """Replace the content of a draft, in one transaction.

        prepared: a change of the draft's base. rebased: of a newer head, which must still be the head. Raises
        StaleParent if the draft was edited since ``pending`` was read, or the head has moved; Invalid if the draft
        becomes too large; NotFound.
        """
        _check_size(prepared)
        now = self._database.now()
        table = tables.draft
        with self._database.write() as connection:
            row = environment_row(connection, environment, lock=True)
            if rebased and row.head != prepared.base:
                raise StaleParent(f"the head of {environment} moved to version {row.head} meanwhile: rebase again")
            before = _row(connection, row, pending.id, now)
            chunks.insert(connection, prepared.chunks)
            stored_warnings = [Problem(**warning) for warning in before.warnings]
            joined = list(dict.fromkeys((*stored_warnings, *warnings)))[:MAX_WARNINGS]
            values = {"revision": pending.revision + 1, "edited": now, "expires": now + LIFETIME}
            same = (table.c.id == pending.id) & (table.c.revision == pending.revision)
            replaced = update(table).where(same).values(**values, **content_values(prepared, joined))
            if not connection.execute(replaced).rowcount:
                raise _edited(before.name)
            return _as_draft(row, _row(connection, row, pending.id, now))

    def delete(self, environment: str, id: str) -> None:
        """Delete a draft. Raises NotFound."""
        with self._database.write() as connection:
            row = environment_row(connection, environment)
            _row(connection, row, id, self._database.now())
            connection.execute(delete(tables.draft).where(tables.draft.c.id == id))

    def remove_expired(self) -> None:
        """Remove drafts that nobody edited for a long time."""
        remove_expired(self._database)


def _row(connection: Connection, environment: Row[Any], id: str, now: datetime) -> Row[Any]:
    table = tables.draft
    row = None
    if _ID.fullmatch(id):
        query = select(table).where(table.c.id == id, table.c.environment_id == environment.id)
        row = connection.execute(query).one_or_none()
    if row is None or row.expires <= now:
        count = connection.execute(select(func.count()).where(table.c.environment_id == environment.id)).scalar_one()
        raise NotFound(
            f"{environment.name} has no draft {id[:80]!r}: it may have been committed or deleted; it has {count} "
            "drafts, which GET …/drafts lists"
        )
    return row


def _pending(row: Row[Any]) -> Pending:
    return Pending("draft", row.id, row.expires, row.changed, row.revision)


def _as_draft(environment: Row[Any], row: Row[Any]) -> Draft:
    return Draft(
        id=row.id,
        environment=environment.name,
        name=row.name,
        owner=row.owner,
        owner_id=row.owner_id,
        base=row.base,
        head=environment.head,
        revision=row.revision,
        created=row.created,
        changed=row.edited,
        expires=row.expires,
        changes=row.changes,
    )


def _on_head(head: Version, pending: Pending) -> Version:
    """Return the head as the content of a draft that nobody has edited yet."""
    return replace(head, parent=head.number, changes={}, pending=pending)


def _check_name(name: str) -> None:
    checked_text(name, "a draft's name", MAX_NAME)
    if not name.strip() or not name.isprintable():
        raise Invalid("a draft's name must have a printable character, and no control characters")


def _check_size(prepared: Prepared) -> None:
    counts = [value for layer in prepared.changes.values() if isinstance(layer, dict) for value in layer.values()]
    changed = sum(count for count in counts if isinstance(count, int) and not isinstance(count, bool))
    if changed > MAX_CHANGES:
        raise Invalid(f"the draft would change {changed} features, the maximum is {MAX_CHANGES}: commit it first")


def _edited(name: str) -> StaleParent:
    return StaleParent(f"the draft {name!r} was edited meanwhile: read it again, and repeat the change")
