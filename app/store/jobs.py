"""Jobs: long-running work and its outcome."""

from __future__ import annotations

import secrets
from typing import Any

from sqlalchemy import Row, delete, insert, select, update

from app.errors import NotFound
from app.store import tables
from app.store.base import checked_text, storable_text
from app.store.database import Database
from app.store.values import Job, State


class Jobs:
    """Store of the job queue."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def create(self, owner: str = "", detail: str = "") -> Job:
        """Add a queued job."""
        now = self._database.now()
        new = secrets.token_hex(16)
        with self._database.write() as connection:
            connection.execute(
                insert(tables.job).values(
                    id=new,
                    state="queued",
                    progress=0.0,
                    detail=storable_text(detail),
                    result=None,
                    problem=None,
                    owner=checked_text(owner, "an owner"),
                    created=now,
                    updated=now,
                )
            )
        return self.get(new)

    def update(
        self,
        id: str,
        *,
        state: State | None = None,
        progress: float | None = None,
        detail: str | None = None,
        result: dict[str, Any] | None = None,
        problem: dict[str, Any] | None = None,
    ) -> Job:
        """Update the given fields; a done, failed or cancelled job keeps its state. Raises NotFound."""
        table = tables.job
        given = {
            "state": state,
            "progress": None if progress is None else min(1.0, max(0.0, progress)),
            "detail": None if detail is None else storable_text(detail),
            "result": result,
            "problem": problem,
        }
        values = {name: value for name, value in given.items() if value is not None}
        with self._database.write() as connection:
            row = connection.execute(select(table).where(table.c.id == id).with_for_update()).one_or_none()
            if row is None:
                raise NotFound(f"unknown job {id[:80]!r}")
            if row.state not in ("done", "failed", "cancelled"):
                connection.execute(update(table).where(table.c.id == id).values(updated=self._database.now(), **values))
            return _as_job(connection.execute(select(table).where(table.c.id == id)).one())

    def get(self, id: str) -> Job:
        """Read a job. Raises NotFound."""
        with self._database.read() as connection:
            row = connection.execute(select(tables.job).where(tables.job.c.id == id)).one_or_none()
        if row is None:
            raise NotFound(f"unknown job {id[:80]!r}")
        return _as_job(row)

    def all(self, *, state: State | None = None) -> list[Job]:
        """List jobs, oldest first."""
        table = tables.job
        query = select(table).order_by(table.c.created, table.c.id)
        if state is not None:
            query = query.where(table.c.state == state)
        with self._database.read() as connection:
            return [_as_job(r) for r in connection.execute(query)]

    def delete(self, id: str) -> None:
        """Delete a job. Raises NotFound."""
        with self._database.write() as connection:
            if not connection.execute(delete(tables.job).where(tables.job.c.id == id)).rowcount:
                raise NotFound(f"unknown job {id[:80]!r}")


def _as_job(row: Row[Any]) -> Job:
    return Job(
        row.id,
        row.state,
        row.progress,
        row.detail,
        row.result,
        row.problem,
        row.created,
        row.updated,
        row.owner,
    )
