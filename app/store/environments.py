"""Environments: create, clone, find, rename, delete, restore, purge."""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from fnmatch import fnmatchcase
from typing import Any, Final

from sqlalchemy import ColumnElement, Connection, Row, Text, cast, delete, func, insert, or_, select, update
from sqlalchemy.exc import IntegrityError

from app.errors import Conflict, Invalid
from app.event_types import EventType
from app.model.frame import Datum, Level
from app.model.templates import NO_TEMPLATES, template_changes
from app.store import outbox, tables
from app.store.area import area_after
from app.store.base import (
    as_environment,
    check_environment_name,
    check_own,
    check_tags,
    checked_prose,
    checked_text,
    environment_row,
    upsert,
)
from app.store.box_index import few_environments, intersects
from app.store.changes import KEEP
from app.store.chunks import Chunks
from app.store.database import Database
from app.store.manifest import read_version
from app.store.prepare import frame_changes, summarise, version_root
from app.store.values import Box, Environment, Version
from app.store.versions import append_version_event, insert_version

PAGE: Final = 500


class Environments:
    """Service for environments."""

    def __init__(self, database: Database, chunks: Chunks) -> None:
        self._database, self._chunks = database, chunks

    def create(
        self,
        name: str,
        *,
        title: str = "",
        description: str = "",
        tags: Sequence[str] = (),
        author: str = "",
        datum: Datum | None = None,
        clone: Version | None = None,
    ) -> Environment:
        """Create an environment with version 0 (empty) and, with a datum or a clone, version 1.

        clone: a version of any environment whose content becomes version 1; a datum given as well replaces the clone's.
        Raises Conflict if the name is taken or not yet purged.
        """
        check_environment_name(name)
        empty = version_root((), None, (Level(),))
        changes = self._initial_changes(datum, clone)
        area = area_after(
            self._chunks.stage(), (), clone.parts if clone else (), None, datum or (clone.datum if clone else None)
        )
        now = self._database.now()
        with self._database.write() as connection:
            sequence = _last_sequence(connection, name) + 1
            values = {
                "id": secrets.token_hex(16),
                "name": name,
                "title": checked_prose(title, "a title"),
                "description": checked_prose(description, "a description"),
                "tags": check_tags(tags),
                "head": 0,
                "root": empty,
                "sequence": sequence,
                "datum": None,
                "area_stale": False,
                "created": now,
                "updated": now,
            }
            _insert_environment(connection, name, values)
            row = environment_row(connection, name)
            start = _empty_version(name, empty, checked_text(author, "an author"), now)
            insert_version(connection, row, start, sequence=sequence, area=KEEP)
            first = None
            if datum is not None or clone is not None:
                first = replace(_first_version(connection, start, datum, clone), changes=changes)
                insert_version(connection, row, first, sequence=sequence + 1, area=area)
            _append_event(connection, row, "environment.created", sequence, name, author, now, previous=None)
            if first is not None:
                append_version_event(connection, row, start, first, sequence + 1)
            return as_environment(environment_row(connection, name))

    def _initial_changes(self, datum: Datum | None, clone: Version | None) -> dict[str, Any]:
        changes: dict[str, Any] = {}
        if clone is not None:
            changes = summarise(self._chunks.stage(), {}, {e.key: e for e in clone.parts})
        place = datum or (clone.datum if clone else None)
        changes |= template_changes(NO_TEMPLATES, clone.templates if clone else NO_TEMPLATES)
        return changes | frame_changes(None, place, (Level(),), clone.levels if clone else (Level(),))

    def get(self, name: str, *, deleted: bool = False) -> Environment:
        """Read an environment. Raises Gone if it is deleted (unless ``deleted``), NotFound if it never existed."""
        with self._database.read() as connection:
            return as_environment(environment_row(connection, name, deleted=deleted))

    def check_own(self, name: str) -> None:
        """Raise Mirrored for an environment that follows another server, where it is changed; NotFound."""
        with self._database.read() as connection:
            check_own(environment_row(connection, name))

    def page(
        self,
        *,
        q: str | None = None,
        bbox: Box | None = None,
        limit: int = 100,
        cursor: str | None = None,
        allowed: str | None = None,
        deleted: bool = False,
    ) -> tuple[list[Environment], str | None]:
        """List a page of environments by name, with the cursor of the next page.

        q: in name, title, description or a tag, case-insensitive. bbox: (west, south, east, north) in degrees that the
        extent must intersect, west > east across the antimeridian. allowed: a name pattern (fnmatch). deleted: list
        those that can be restored or purged instead of the others.
        """
        if limit < 1:
            raise Invalid(f"limit must be at least 1, got {limit}")
        table = tables.environment
        dialect = self._database.engine.dialect.name
        query = select(table).order_by(table.c.name).where(*filters(q=q, bbox=bbox, deleted=deleted, dialect=dialect))
        out: list[Environment] = []
        after = cursor
        with self._database.read() as connection:
            if not deleted:
                query = query.where(*few_environments(connection, q, bbox))
            while len(out) <= limit:
                page = query if after is None else query.where(table.c.name > after)
                rows = connection.execute(page.limit(PAGE if allowed else limit + 1)).all()
                out += [as_environment(r) for r in rows if reaches(allowed, r.name)]
                if len(rows) < (PAGE if allowed else limit + 1):
                    break
                after = rows[-1].name
        return out[:limit], out[limit - 1].name if len(out) > limit else None

    def update(
        self,
        name: str,
        *,
        new_name: str | None = None,
        title: str | None = None,
        description: str | None = None,
        tags: Sequence[str] | None = None,
        author: str = "",
    ) -> Environment:
        """Rename or describe an environment. The history stays.

        A new name produces two events: the end of the old name and the start of the new one.
        """
        now = self._database.now()
        with self._database.write() as connection:
            row = environment_row(connection, name, lock=True)
            values: dict[str, Any] = {"updated": now}
            if title is not None:
                values["title"] = checked_prose(title, "a title")
            if description is not None:
                values["description"] = checked_prose(description, "a description")
            if tags is not None:
                values["tags"] = check_tags(tags)
            table = tables.environment
            connection.execute(update(table).where(table.c.id == row.id).values(values))
            if new_name is not None and new_name != name:
                self._rename(connection, row, check_environment_name(new_name), author, now)
            return as_environment(environment_row(connection, new_name or name))

    def _rename(self, connection: Connection, row: Row[Any], new_name: str, author: str, now: datetime) -> None:
        table = tables.environment
        if connection.execute(select(table.c.id).where(table.c.name == new_name)).first():
            raise Conflict(
                f"the environment {new_name!r} already exists, or is deleted and not yet purged: choose another name"
            )
        ended = row.sequence + 1
        _retire(connection, row.name, ended)
        begun = max(ended, _last_sequence(connection, new_name)) + 1
        try:
            connection.execute(update(table).where(table.c.id == row.id).values(name=new_name, sequence=begun))
        except IntegrityError as error:
            raise Conflict(f"the environment {new_name!r} already exists: choose another name") from error
        head = (row.head, row.root)
        # without the other name: a client may be allowed to see only one of them
        _append_event(connection, row, "environment.deleted", ended, row.name, author, now, "renamed", previous=head)
        _append_event(connection, row, "environment.created", begun, new_name, author, now, "renamed", previous=head)

    def delete(self, name: str, author: str = "") -> Environment:
        """Delete an environment; it can be restored until it is purged, and its name stays taken."""
        return self._mark(name, author, deleted=True)

    def restore(self, name: str, author: str = "") -> Environment:
        """Restore a deleted environment. Raises Conflict if it is not deleted."""
        return self._mark(name, author, deleted=False)

    def _mark(self, name: str, author: str, *, deleted: bool) -> Environment:
        now = self._database.now()
        table = tables.environment
        with self._database.write() as connection:
            row = environment_row(connection, name, lock=True, deleted=not deleted)
            if not deleted and row.deleted is None:
                raise Conflict(f"the environment {name!r} is not deleted")
            sequence = row.sequence + 1
            connection.execute(
                update(table)
                .where(table.c.id == row.id)
                .values(deleted=now if deleted else None, updated=now, sequence=sequence)
            )
            kind: EventType = "environment.deleted" if deleted else "environment.created"
            message = "deleted" if deleted else "restored"
            head = (row.head, row.root)
            _append_event(connection, row, kind, sequence, name, author, now, message, previous=head)
            return as_environment(environment_row(connection, name, deleted=True))

    def purge(self, name: str) -> None:
        """Remove a deleted environment permanently. Raises Conflict if it is not deleted.

        Garbage collection removes its chunks and files; its events stay in the log for 30 days or more, for late
        readers.
        """
        table = tables.environment
        with self._database.write() as connection:
            row = environment_row(connection, name, lock=True, deleted=True)
            if row.deleted is None:
                raise Conflict(f"the environment {name!r} is not deleted: delete it first, then purge it")
            _retire(connection, name, row.sequence)
            connection.execute(delete(table).where(table.c.id == row.id))
            tally = tables.robot_tally
            connection.execute(delete(tally).where(tally.c.environment_id == row.id))
            connection.execute(update(tables.collection).values(purges=tables.collection.c.purges + 1))


def _insert_environment(connection: Connection, name: str, values: dict[str, Any]) -> None:
    table = tables.environment
    taken = connection.execute(select(table.c.deleted).where(table.c.name == name)).one_or_none()
    if taken is not None:
        why = "already exists: choose another name" if taken.deleted is None else "is deleted: restore it, or purge it"
        raise Conflict(f"the environment {name!r} {why}")
    try:
        with connection.begin_nested():
            connection.execute(insert(table).values(values))
    except IntegrityError as error:
        raise Conflict(f"the environment {name!r} already exists: choose another name") from error


def _last_sequence(connection: Connection, name: str) -> int:
    """Return the last sequence published under a name of an earlier environment; 0 for a new name."""
    table = tables.retired
    return int(connection.execute(select(table.c.sequence).where(table.c.name == name)).scalar_one_or_none() or 0)


def _empty_version(environment: str, root: str, author: str, time: datetime) -> Version:
    return Version(
        environment=environment,
        number=0,
        root=root,
        parent=None,
        author=author,
        message="",
        time=time,
        changes={},
        sources=(),
        warnings=(),
        datum=None,
        levels=(Level(),),
        parts=(),
    )


def _first_version(connection: Connection, start: Version, datum: Datum | None, clone: Version | None) -> Version:
    """Return the content of version 1. A clone is read again in this transaction, so that its chunks still exist."""
    base, message = start, "datum set"
    if clone is not None:
        origin = environment_row(connection, clone.environment, lock=True, mirrored=True)
        base = read_version(connection, origin, clone.number)
        message = f"cloned from {clone.environment}, version {clone.number}"
    place = datum or base.datum
    return replace(
        start,
        number=1,
        root=version_root(base.parts, place, base.levels, base.templates),
        parent=0,
        message=message,
        sources=base.sources,
        datum=place,
        levels=base.levels,
        parts=base.parts,
        templates=base.templates,
    )


def _append_event(
    connection: Connection,
    row: Row[Any],
    kind: EventType,
    sequence: int,
    name: str,
    author: str,
    time: datetime,
    message: str = "",
    *,
    previous: tuple[int, str] | None,
) -> None:
    outbox.append_event(
        connection,
        environment_id=row.id,
        environment=name,
        sequence=sequence,
        kind=kind,
        version=row.head,
        root=row.root,
        previous=previous,
        layers=(),
        message=message,
        author=checked_text(author, "an author"),
        time=time,
    )


def _retire(connection: Connection, name: str, sequence: int) -> None:
    """Store the last sequence published under a name."""
    upsert(connection, tables.retired, {"name": name}, {"sequence": sequence})


def filters(*, q: str | None, bbox: Box | None, deleted: bool, dialect: str) -> list[ColumnElement[bool]]:
    """Return the conditions on an environment's row that ``Environments.page`` describes."""
    table = tables.environment
    out: list[ColumnElement[bool]] = [table.c.deleted.is_not(None) if deleted else table.c.deleted.is_(None)]
    if q:
        columns = (table.c.name, table.c.title, table.c.description)
        conditions = [func.lower(c).contains(q.lower(), autoescape=True) for c in columns]
        conditions.append(func.lower(cast(table.c.tags, Text)).contains(q.lower(), autoescape=True))
        out.append(or_(*conditions))
    if bbox is not None:
        out.append(intersects(table, table.c.extent, _check_bounds(bbox), dialect))
    return out


def reaches(allowed: str | None, name: str) -> bool:
    """Return whether a name pattern (None: every name) allows an environment."""
    return allowed is None or fnmatchcase(name, allowed)


def _check_bounds(box: Box) -> Box:
    west, south, east, north = box
    if not (-180.0 <= west <= 180.0 and -180.0 <= east <= 180.0 and -90.0 <= south <= north <= 90.0):
        raise Invalid(
            "bbox must be degrees: longitudes within ±180, latitudes within ±90, south not above north; got "
            f"{', '.join(f'{v:g}' for v in box)}"
        )
    return box
