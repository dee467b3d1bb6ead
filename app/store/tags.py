"""Tags: names that people give to versions, which keep them from being thinned. A tag never moves."""

from __future__ import annotations

import re
from typing import Final

from sqlalchemy import delete, func, insert, select, update

from app.errors import Conflict, Invalid, NotFound
from app.store import tables
from app.store.base import checked_text, environment_row
from app.store.database import Database
from app.store.manifest import read_version
from app.store.values import Version
from app.store.versions import resolve

TAG_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,62}")
MAX_TAGS: Final = 1000
"""Maximum number of tags of an environment."""


class Tags:
    """Service for the tags of versions."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def add(self, environment: str, ref: str | int, name: str, *, author: str) -> Version:
        """Tag a version, by number or channel; returns it. Repeating it changes nothing.

        Raises Conflict if another version has the tag or there are too many, Thinned if the content is gone, Invalid
        for the name, NotFound.
        """
        if not TAG_NAME.fullmatch(name):
            raise Invalid(
                f"invalid tag {name[:80]!r}: use at most 63 of A-Z, a-z, 0-9, _, . and -, starting with a letter or "
                "digit"
            )
        table = tables.version_tag
        with self._database.write() as connection:
            row = environment_row(connection, environment, lock=True)
            version = read_version(connection, row, resolve(connection, row, ref))
            in_environment = table.c.environment_id == row.id
            present = connection.execute(
                select(table.c.number).where(in_environment, table.c.name == name)
            ).scalar_one_or_none()
            if present == version.number:
                return version
            if present is not None:
                raise Conflict(f"version {present} of {environment} has the tag {name!r}: remove it there first")
            count = connection.execute(select(func.count()).select_from(table).where(in_environment)).scalar_one()
            if count >= MAX_TAGS:
                raise Conflict(f"{environment} has {MAX_TAGS} tags: remove one that is no longer needed")
            now = self._database.now()
            values = {"number": version.number, "author": checked_text(author, "an author"), "time": now}
            connection.execute(insert(table).values(environment_id=row.id, name=name, **values))
            owner = tables.environment
            connection.execute(update(owner).where(owner.c.id == row.id).values(updated=now))
            return read_version(connection, row, version.number)

    def remove(self, environment: str, ref: str | int, name: str) -> None:
        """Remove a tag from a version. Raises NotFound if the version does not have it."""
        table = tables.version_tag
        with self._database.write() as connection:
            row = environment_row(connection, environment, lock=True)
            number = resolve(connection, row, ref)
            this = (table.c.environment_id == row.id, table.c.name == name, table.c.number == number)
            if not connection.execute(delete(table).where(*this)).rowcount:
                raise NotFound(f"version {number} of {environment} has no tag {name[:80]!r}")
            owner = tables.environment
            connection.execute(update(owner).where(owner.c.id == row.id).values(updated=self._database.now()))
