"""Direct connection to PostgreSQL beside the pool, for what belongs to a session: advisory locks and notifications.

Each statement ends within a time limit, whatever becomes of the network; a session that falls silent is ended by
PostgreSQL itself, so that a stopped process or a host without a network holds no lock.
"""

from __future__ import annotations

import contextlib
import os
import socket
import threading
from collections.abc import Sequence
from typing import Any, Final, cast

import psycopg
from sqlalchemy.engine import make_url

STATEMENT_SECONDS: Final = 2.0
"""Maximum duration of a statement: afterwards the connection is cut."""

CONNECT_SECONDS: Final = 2


class DirectConnection:
    """Connection with autocommit. For one thread; only ``close`` may be called from another.

    Args:
        url: database URL as SQLAlchemy has it. A pooler in between must pool sessions, not transactions.
        idle_seconds: silence after which PostgreSQL (14 or newer) ends the session; None: no limit.

    Its methods raise psycopg.Error.
    """

    def __init__(self, url: str, application: str, *, idle_seconds: float | None = None) -> None:
        parsed = make_url(url).set(drivername="postgresql+psycopg")
        options: dict[str, Any] = dict(parsed.get_dialect()().create_connect_args(parsed)[1])
        settings = {
            "statement_timeout": int(STATEMENT_SECONDS * 1000),
            "tcp_keepalives_idle": 2,
            "tcp_keepalives_interval": 1,
            "tcp_keepalives_count": 2,
            "tcp_user_timeout": 3000,
        }
        if idle_seconds is not None:
            settings["idle_session_timeout"] = int(idle_seconds * 1000)
        options["options"] = " ".join(
            [options.get("options", ""), *(f"-c {name}={value}" for name, value in settings.items())]
        ).strip()
        options |= {"connect_timeout": CONNECT_SECONDS, "application_name": application, "keepalives": 1}
        options |= {"keepalives_idle": 2, "keepalives_interval": 1, "keepalives_count": 2, "tcp_user_timeout": 3000}
        self._connection = psycopg.connect(autocommit=True, prepare_threshold=None, **options)
        self._socket = socket.socket(fileno=os.dup(self._connection.fileno()))

    def execute(self, query: str, parameters: Sequence[object] = ()) -> list[tuple[Any, ...]]:
        """Execute a statement and return its rows."""
        limit = threading.Timer(STATEMENT_SECONDS, self._cut)
        limit.daemon = True
        limit.start()
        try:
            cursor = self._connection.execute(cast(Any, query), parameters)
            return cursor.fetchall() if cursor.description is not None else []
        finally:
            limit.cancel()

    def notifications(self, seconds: float) -> list[str]:
        """Wait for a notification, but no longer than ``seconds``; return the payloads of those that have come."""
        return [notice.payload for notice in self._connection.notifies(timeout=seconds, stop_after=1)]

    def close(self) -> None:
        """Close the connection, also one that hangs."""
        self._cut()
        with contextlib.suppress(psycopg.Error):
            self._connection.close()
        self._socket.close()

    def _cut(self) -> None:
        """End the connection's socket: what waits for it fails at once."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
