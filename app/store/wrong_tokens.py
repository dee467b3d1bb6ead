"""Counts of wrong tokens by network, which all servers share: a guesser gains nothing by asking another server."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime, timedelta
from typing import Final

from sqlalchemy import case, delete, func
from sqlalchemy.dialects import postgresql

from app.store import tables
from app.store.database import Database

MAX_COUNT: Final = 1_000_000


class WrongTokens:
    """Service for the counts. For PostgreSQL only: with SQLite each process counts for itself."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def add(self, counts: Mapping[str, int], window: timedelta) -> dict[str, tuple[int, datetime]]:
        """Add to the counts of networks; return the sum of all servers, and since when it counts.

        A count begins anew with the first wrong token after ``window``.
        """
        table, now = tables.wrong_token, self._database.now()
        statement = postgresql.insert(table).values(
            [{"source": source, "count": count, "since": now} for source, count in sorted(counts.items())]
        )
        is_over = table.c.since < now - window
        more = func.least(table.c.count + statement.excluded.count, MAX_COUNT)
        upsert = statement.on_conflict_do_update(
            index_elements=["source"],
            set_={
                "count": case((is_over, statement.excluded.count), else_=more),
                "since": case((is_over, now), else_=table.c.since),
            },
        ).returning(table.c.source, table.c.count, table.c.since)
        with self._database.write(notify=False, upkeep=True) as connection:
            return {row.source: (row[1], row.since) for row in connection.execute(upsert)}

    def sweep(self, window: timedelta) -> int:
        """Remove the counts of networks that were silent for ``window``; returns how many."""
        table = tables.wrong_token
        if self._database.sqlite:
            return 0
        with self._database.write(notify=False, upkeep=True) as connection:
            old = table.c.since < self._database.now() - window
            return int(connection.execute(delete(table).where(old)).rowcount)
