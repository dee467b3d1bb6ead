"""Times of last use of tokens and sessions: noted in memory, stored now and then, so that no read costs a write."""

from __future__ import annotations

import threading
from datetime import datetime, timedelta
from typing import Any, Final

from sqlalchemy import Column, update

from app.store.database import Database


class Uses:
    """Noted uses of the rows of a table. Thread-safe.

    Args:
        key: column that names a row.
        used: column of the last use.
        interval: minimum time between two stored uses of a row.
    """

    def __init__(self, database: Database, key: Column[Any], used: Column[Any], interval: timedelta) -> None:
        self._database, self._key, self._used, self._interval = database, key, used, interval
        self._noted: Final[dict[str, datetime]] = {}
        self._lock = threading.Lock()

    def note(self, name: str, stored: datetime | None) -> datetime:
        """Note a use, if the last one is long ago; returns the last use that is stored or will be."""
        now = self._database.now()
        with self._lock:
            times = [time for time in (stored, self._noted.get(name)) if time is not None]
            if times and now - max(times) < self._interval:
                return max(times)
            self._noted[name] = now
        return now

    def store(self) -> int:
        """Store the noted uses, in one transaction; returns how many. Without any it writes nothing."""
        with self._lock:
            noted = dict(self._noted)
            self._noted.clear()
        if not noted:
            return 0
        try:
            with self._database.write(notify=False, upkeep=True) as connection:
                for name, time in sorted(noted.items()):
                    newer = (self._key == name) & (self._used.is_(None) | (self._used < time))
                    connection.execute(update(self._key.table).where(newer).values({self._used: time}))
        except BaseException:
            with self._lock:
                for name, time in noted.items():
                    self._noted.setdefault(name, time)
            raise
        return len(noted)
