"""Jobs: long-running work and its outcome."""

from __future__ import annotations

import secrets
from collections.abc import Collection, Iterator, Mapping
from datetime import timedelta
from typing import Any, Final

from sqlalchemy import Row, bindparam, delete, insert, select, text, tuple_, update

from app.errors import NotFound
from app.progress import Progress
from app.store import tables
from app.store.base import checked_text, storable_text
from app.store.column_types import UtcDateTime
from app.store.database import Database
from app.store.values import Job, State

ACTIVE = ("queued", "running")

KEPT = timedelta(days=7)
"""How long a finished job of a task is kept for its client; one that no client was told of: FORGOTTEN."""

FORGOTTEN = timedelta(minutes=1)

PAGE: Final = 200
"""Number of jobs that a list reads at a time."""

_LOST = text(
    "SELECT task FROM job WHERE task IS NOT NULL AND state IN ('queued', 'running') AND updated < :before"
    " AND NOT EXISTS (SELECT 1 FROM procrastinate_jobs entry WHERE entry.lock = job.task"
    " AND entry.status IN ('todo', 'doing'))"
).bindparams(bindparam("before", type_=UtcDateTime))
"""Tasks of jobs that wait for one that is not in the queue."""


class Jobs:
    """Store of jobs."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def create(
        self,
        owner: str = "",
        detail: str = "",
        *,
        task: str | None = None,
        location: str | None = None,
        followed: bool = True,
    ) -> Job:
        """Add a queued job.

        task: that it waits for. location: address of what that makes. followed: whether a client is told of the job.
        """
        now = self._database.now()
        new = secrets.token_hex(16)
        with self._database.write(upkeep=task is not None) as connection:
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
                    task=task,
                    location=location,
                    followed=followed,
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

    def note_progress(self, ids: Collection[str], progress: Progress) -> set[str]:
        """Store how far running jobs are; returns those that still run."""
        table = tables.job
        active = table.c.id.in_(ids), table.c.state.in_(ACTIVE)
        values = {"progress": progress.fraction, "step": storable_text(progress.step), "updated": self._database.now()}
        with self._database.write(notify=False, upkeep=True) as connection:
            connection.execute(update(table).where(*active).values(values))
            return set(connection.execute(select(table.c.id).where(*active)).scalars())

    def note_task_progress(self, task: str, progress: Progress) -> bool:
        """Store how far a task is for the jobs that wait for it. Returns False if none does."""
        values = {"progress": progress.fraction, "step": storable_text(progress.step)}
        return bool(self._update_task(task, values, notify=False))

    def claim(self, id: str, owner: str, location: str) -> bool:
        """Give a task's job that has no owner to a client. Returns False if another one has it."""
        table = tables.job
        values = {"owner": checked_text(owner, "an owner"), "location": location, "followed": True}
        with self._database.write(upkeep=True) as connection:
            change = update(table).where(table.c.id == id, table.c.owner == "").values(**values)
            return bool(connection.execute(change).rowcount)

    def detach(self, id: str) -> None:
        """Let a job no longer wait for its task; delete it if no client was told of it."""
        table = tables.job
        with self._database.write(upkeep=True) as connection:
            connection.execute(delete(table).where(table.c.id == id, table.c.owner == ""))
            connection.execute(update(table).where(table.c.id == id).values(task=None))

    def start_task(self, task: str) -> bool:
        """Mark the jobs that wait for a task as running. Returns False if none does: all were cancelled."""
        return bool(self._update_task(task, {"state": "running"}))

    def release_task(self, task: str) -> None:
        """Mark the jobs that wait for a task as queued again: its worker stops."""
        self._update_task(task, {"state": "queued", "progress": 0.0, "step": None})

    def finish_task(
        self,
        task: str,
        *,
        outcome: Mapping[str, Any] | None = None,
        location: str | None = None,
        problem: Mapping[str, Any] | None = None,
    ) -> None:
        """Finish all jobs that wait for a task. outcome: for the servers. location: address of what was made."""
        values: dict[str, Any] = {"state": "done", "progress": 1.0} if problem is None else {"state": "failed"}
        values |= {"outcome": outcome, "problem": problem}
        self._update_task(task, values if location is None else {**values, "location": location})

    def _update_task(self, task: str, values: Mapping[str, Any], *, notify: bool = True) -> int:
        table = tables.job
        change = update(table).where(table.c.task == task, table.c.state.in_(ACTIVE))
        with self._database.write(notify=notify, upkeep=True) as connection:
            return connection.execute(change.values(updated=self._database.now(), **values)).rowcount

    def is_awaited(self, task: str) -> bool:
        """Return whether a job waits for a task."""
        table = tables.job
        query = select(table.c.id).where(table.c.task == task, table.c.state.in_(ACTIVE)).limit(1)
        with self._database.read() as connection:
            return connection.execute(query).first() is not None

    def lost_tasks(self, age: timedelta) -> list[str]:
        """List the tasks that jobs wait for and that are not in the queue (PostgreSQL)."""
        with self._database.read() as connection:
            return list(connection.execute(_LOST, {"before": self._database.now() - age}).scalars())

    def sweep(self) -> int:
        """Delete finished jobs of tasks, some time after their end; returns how many."""
        table, now = tables.job, self._database.now()
        done = table.c.task.is_not(None) & table.c.state.not_in(ACTIVE)
        old = (table.c.updated < now - KEPT) | (~table.c.followed & (table.c.updated < now - FORGOTTEN))
        with self._database.write(notify=False, upkeep=True) as connection:
            return connection.execute(delete(table).where(done, old)).rowcount

    def get(self, id: str) -> Job:
        """Read a job. Raises NotFound."""
        with self._database.read() as connection:
            row = connection.execute(select(tables.job).where(tables.job.c.id == id)).one_or_none()
        if row is None:
            raise NotFound(f"unknown job {id[:80]!r}")
        return _as_job(row)

    def newest(self, owner: str | None = None) -> Iterator[Job]:
        """Read the jobs of an owner (None: of all), newest first, some at a time."""
        table = tables.job
        query = select(table).order_by(table.c.created.desc(), table.c.id.desc()).limit(PAGE)
        query = query if owner is None else query.where(table.c.owner == owner)
        page = query
        while True:
            with self._database.read() as connection:
                rows = connection.execute(page).all()
            yield from map(_as_job, rows)
            if len(rows) < PAGE:
                return
            last = rows[-1]
            page = query.where(tuple_(table.c.created, table.c.id) < (last.created, last.id))

    def delete(self, id: str) -> None:
        """Delete a job. Raises NotFound."""
        with self._database.write() as connection:
            if not connection.execute(delete(tables.job).where(tables.job.c.id == id)).rowcount:
                raise NotFound(f"unknown job {id[:80]!r}")


def _as_job(row: Row[Any]) -> Job:
    result = {"location": row.location} if row.state == "done" and row.location is not None else None
    return Job(
        row.id,
        row.state,
        row.progress,
        row.detail,
        row.result or result,
        row.problem,
        row.created,
        row.updated,
        row.owner,
        row.task,
        row.outcome,
        row.step if row.state == "running" else None,
    )
