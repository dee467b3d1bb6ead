"""How many items of a search have a group of three characters, by PostgreSQL's own statistics.

To read the index for a group that most items have takes longer than to compare what the rarest groups leave.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Final

from sqlalchemy import Connection, text

REFRESH_SECONDS: Final = 60.0

_STATISTICS: Final = text(
    "SELECT most_common_elems::text::text[], most_common_elem_freqs FROM pg_stats"
    " WHERE schemaname = current_schema() AND tablename = 'search_item' AND attname = 'grams'"
)


class GramShares:
    """Shares of the items by group. Thread-safe: two threads may read the same statistics."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._cache: tuple[float, Mapping[str, float]] = (-REFRESH_SECONDS, {})

    def current(self, connection: Connection) -> Mapping[str, float]:
        """Return the shares of the most common groups: none on SQLite, or if PostgreSQL has no statistics yet."""
        now = self._clock()
        if connection.dialect.name == "postgresql" and now - self._cache[0] >= REFRESH_SECONDS:
            row = connection.execute(_STATISTICS).one_or_none()
            shares = dict(zip(row[0], row[1], strict=False)) if row is not None and row[0] else {}  # then their range
            self._cache = now, shares
        return self._cache[1]
