"""One engine for SQLite and PostgreSQL: pragmas, transactions, and database errors as ours."""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import orjson
from sqlalchemy import Connection, Engine, create_engine, event, exc
from sqlalchemy.engine import make_url

from app.errors import Invalid, Unavailable

if TYPE_CHECKING:
    from app.store.audit import Caller

BUSY_MILLISECONDS = 5000
TURN_SECONDS = 30.0


def engine(url: str, *, readonly: bool) -> Engine:
    """An engine that keeps what it acknowledges: SQLite in WAL mode with full syncs, or PostgreSQL by psycopg."""
    try:
        parsed = make_url(url)
    except exc.ArgumentError as error:
        raise Invalid(
            f"the database URL cannot be read: use sqlite:///PATH or postgresql+psycopg://… ({error})"
        ) from error
    options: dict[str, Any] = {
        "json_serializer": lambda value: orjson.dumps(value).decode(),
        "json_deserializer": orjson.loads,
        "pool_size": 8,
        "max_overflow": 24,
        "pool_timeout": 30,
    }
    if parsed.get_backend_name() == "sqlite":
        if parsed.database and parsed.database != ":memory:" and not readonly:
            Path(parsed.database).parent.mkdir(parents=True, exist_ok=True)
        made = create_engine(parsed, **options)
        event.listen(made, "connect", _sqlite_connected(readonly))
        event.listen(made, "begin", _sqlite_begin)
        return made
    if parsed.get_backend_name() == "postgresql":
        settings = "-c synchronous_commit=on -c jit=off" + (" -c default_transaction_read_only=on" if readonly else "")
        connect = {"connect_timeout": 5, "application_name": "fleetmap", "options": settings}
        return create_engine(
            parsed.set(drivername="postgresql+psycopg"), connect_args=connect, pool_pre_ping=True, **options
        )
    raise Invalid(
        f"{parsed.get_backend_name()} is no database that can be used: use sqlite:///… or postgresql+psycopg://…"
    )


def _sqlite_connected(readonly: bool) -> Any:
    def connected(connection: sqlite3.Connection, record: object) -> None:
        del record
        # The driver would begin transactions by itself, too late for BEGIN IMMEDIATE.
        connection.isolation_level = None
        for pragma in (
            f"busy_timeout={BUSY_MILLISECONDS}",
            "journal_mode=WAL",
            "synchronous=FULL",
            "foreign_keys=ON",
            "cache_size=-16000",
            *(["query_only=ON"] if readonly else []),
        ):
            connection.execute(f"PRAGMA {pragma}").close()

    return connected


def _sqlite_begin(connection: Connection) -> None:
    write = connection.get_execution_options().get("write")
    connection.exec_driver_sql("BEGIN IMMEDIATE" if write else "BEGIN")


class Database:
    """Transactions on an engine. Every database error that another try may not have becomes Unavailable.

    written: called after each commit, so that caches in memory can tell. record: adds who makes the change to its
    transaction.
    """

    def __init__(
        self,
        url: str,
        *,
        readonly: bool,
        written: Callable[[], None] = lambda: None,
        record: Callable[[Connection], Caller | None] = lambda _: None,
    ) -> None:
        self.engine = engine(url, readonly=readonly)
        self._written, self._record = written, record
        self.sqlite = self.engine.dialect.name == "sqlite"
        # SQLite lets whoever happens to look at the right moment write: among many, one may never come to it.
        self._turn = threading.Lock()

    @contextmanager
    def read(self) -> Iterator[Connection]:
        """A transaction that only reads."""
        with translated(), self.engine.connect() as connection:
            yield connection

    @contextmanager
    def snapshot(self) -> Iterator[Connection]:
        """A transaction that only reads, all of it from one state."""
        with translated(), self.engine.connect() as connection:
            if not self.sqlite:
                connection.execution_options(isolation_level="REPEATABLE READ")
            yield connection

    @contextmanager
    def write(self, *, tell: bool = True) -> Iterator[Connection]:
        """A transaction that writes: all or nothing, and on disk when it ends. tell: whether caches are to know."""
        with self._in_turn(), translated(), self.engine.connect() as connection:
            connection.execution_options(write=True)
            with connection.begin():
                yield connection
                caller = self._record(connection)
        if caller is not None:
            caller.recorded = True
        if tell:
            self._written()

    @contextmanager
    def _in_turn(self) -> Iterator[None]:
        """One writer of this process after the other, where the database lets only one write."""
        if not self.sqlite:
            yield
            return
        if not self._turn.acquire(timeout=TURN_SECONDS):
            raise Unavailable("too much is being written: try again in a few seconds")
        try:
            yield
        finally:
            self._turn.release()

    def close(self) -> None:
        """Give back all connections."""
        self.engine.dispose()


@contextmanager
def translated() -> Iterator[None]:
    """Database errors -> Unavailable; Invalid for a NUL that somebody asks for, which PostgreSQL has no text with."""
    try:
        yield
    except exc.DataError as error:
        if "NUL" not in _short(error):
            raise
        raise Invalid("a name or text has a NUL character: nothing here has one") from error
    except (exc.OperationalError, exc.InterfaceError, exc.TimeoutError, exc.InternalError) as error:
        raise Unavailable(f"the database does not answer as it should: {_short(error)}. Try again later") from error


def _short(error: exc.SQLAlchemyError) -> str:
    """The driver's first line, without the statement and without what might be a secret in a URL."""
    original = getattr(error, "orig", None)
    return (str(original or error).splitlines() or ["no reason told"])[0][:200]
