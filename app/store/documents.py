"""Documents in the database, shared by all servers on it."""

from __future__ import annotations

from collections.abc import Callable, Hashable

from sqlalchemy import insert, select, update
from sqlalchemy.exc import IntegrityError

from app.backends.documents import Change, time_slot
from app.store import tables
from app.store.database import Database


class StoredDocument:
    """Document in a row of the table ``document``. generation: commit counter."""

    def __init__(self, database: Database, generation: Callable[[], int], name: str) -> None:
        self._database, self._generation, self._name = database, generation, name

    def stamp(self) -> Hashable:
        """Return the commit counter and the second: the row is read again after each commit, and once a second."""
        return self._generation(), time_slot()

    def read(self) -> bytes | None:
        """Read the row. Raises Unavailable."""
        table = tables.document
        with self._database.read() as connection:
            content = connection.execute(select(table.c.content).where(table.c.name == self._name)).scalar_one_or_none()
        return None if content is None else bytes(content)

    def update(self, change: Change, *, notify: bool = True) -> bytes:
        """Replace the content in one transaction, with the row locked. Raises Unavailable.

        notify: whether other servers have to read it again.
        """
        if self.read() is None:
            try:
                return self._insert(change(None))
            except IntegrityError:  # another server was first: its content is changed below
                pass
        table = tables.document
        row = table.c.name == self._name
        with self._database.write(notify=notify, upkeep=True) as connection:
            present = connection.execute(select(table.c.content).where(row).with_for_update()).scalar_one()
            content = change(bytes(present))
            connection.execute(update(table).where(row).values(content=content, revision=table.c.revision + 1))
        return content

    def _insert(self, content: bytes) -> bytes:
        with self._database.write(upkeep=True) as connection:
            connection.execute(insert(tables.document).values(name=self._name, content=content, revision=1))
        return content
