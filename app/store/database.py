"""One engine for SQLite and PostgreSQL: pragmas, transactions, and database errors as ours."""

from __future__ import annotations

import logging
import os
import re
import secrets
import shutil
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any, Protocol

import orjson
from sqlalchemy import Connection, Engine, create_engine, event, exc
from sqlalchemy.engine import make_url

from app.errors import DISK_FULL_ERRNOS, DatabaseDamaged, FleetMapError, Invalid, NoRoom, Unavailable
from app.store.base import utcnow

log = logging.getLogger(__name__)

BUSY_MILLISECONDS = 5000
TURN_SECONDS = 30.0
RECHECK_SECONDS = 60.0
"""How often a database that was found damaged is checked again."""

ROOM_BYTES = 2**20
"""Free space below which a folder is not writable, and an I/O error of SQLite means a full disk."""

REPAIR = "stop the server, run `fleetmap verify`, and restore a backup of the database"
_CORRUPT = frozenset({sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB})
_CORRUPT_STATES = frozenset({"XX001", "XX002"})
"""PostgreSQL: data_corrupted, index_corrupted."""

_NO_FILE_STATE = "58P01"
_RELATION_FILE = re.compile(r"\b(?:base|global|pg_tblspc)/")
"""PostgreSQL's undefined_file means damage only for a file of its data, not for a missing library."""

_DISK_FULL_STATE = "53100"


def _from_json(text: str | bytes) -> Any:
    try:
        return orjson.loads(text)
    except orjson.JSONDecodeError as error:
        raise DatabaseDamaged(f"a value in the database is not JSON any more: {REPAIR}") from error


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
        "json_deserializer": _from_json,
        "pool_size": 8,
        "max_overflow": 24,
        "pool_timeout": 30,
    }
    if parsed.get_backend_name() == "sqlite":
        if parsed.database and parsed.database != ":memory:" and not readonly:
            Path(parsed.database).parent.mkdir(parents=True, exist_ok=True)
        sql_engine = create_engine(parsed, **options)
        event.listen(sql_engine, "connect", _sqlite_on_connect(readonly))
        event.listen(sql_engine, "begin", _sqlite_on_begin)
        return sql_engine
    if parsed.get_backend_name() == "postgresql":
        settings = "-c synchronous_commit=on -c jit=off" + (" -c default_transaction_read_only=on" if readonly else "")
        connect = {"connect_timeout": 5, "application_name": "fleetmap", "options": settings}
        return create_engine(
            parsed.set(drivername="postgresql+psycopg"), connect_args=connect, pool_pre_ping=True, **options
        )
    raise Invalid(
        f"{parsed.get_backend_name()} is no database that can be used: use sqlite:///… or postgresql+psycopg://…"
    )


def _sqlite_on_connect(readonly: bool) -> Any:
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


def _sqlite_on_begin(connection: Connection) -> None:
    write = connection.get_execution_options().get("write")
    connection.exec_driver_sql("BEGIN IMMEDIATE" if write else "BEGIN")


class _FileGone(DatabaseDamaged):
    """SQLite's file is not the one that was opened. It may come back at any moment."""


class AuditMark(Protocol):
    """Whether a request's row in the audit log is committed."""

    recorded: bool


class Database:
    """Transactions on an engine. Every database error that another try may not have becomes Unavailable.

    written: called after each commit, so that caches in memory can tell. record: adds who makes the change to its
    transaction. clock: the present as an aware time, for what is stored. file: SQLite's; None on PostgreSQL.
    """

    def __init__(
        self,
        url: str,
        *,
        readonly: bool,
        written: Callable[[], None] = lambda: None,
        record: Callable[[Connection, datetime], AuditMark | None] = lambda *_: None,
        clock: Callable[[], datetime] = utcnow,
    ) -> None:
        self.engine = engine(url, readonly=readonly)
        self._written, self._record, self.now = written, record, clock
        self.sqlite = self.engine.dialect.name == "sqlite"
        name = self.engine.url.database if self.sqlite else None
        self.file = Path(name) if name and name != ":memory:" and not name.startswith("file:") else None
        self._inode: int | None = None
        self._damage: tuple[float, str] | None = None
        self._checking = threading.Lock()
        self._gone = ""
        self.readonly = readonly
        # SQLite lets whoever happens to look at the right moment write: among many, one may never come to it.
        self._turn = threading.Lock()
        if self.file is not None:
            event.listen(self.engine, "do_connect", self._before_connect)
            event.listen(self.engine, "connect", self._after_connect)

    @contextmanager
    def read(self) -> Iterator[Connection]:
        """A transaction that only reads."""
        with self.connection() as connection:
            yield connection

    @contextmanager
    def snapshot(self) -> Iterator[Connection]:
        """A transaction that only reads, all of it from one state."""
        with self.connection() as connection:
            if not self.sqlite:
                connection.execution_options(isolation_level="REPEATABLE READ")
            yield connection

    @contextmanager
    def write(self, *, notify: bool = True, upkeep: bool = False) -> Iterator[Connection]:
        """A transaction that writes: all or nothing, and on disk when it ends. notify: whether caches are to know.
        upkeep: it is no change that anybody asked for, so that the audit log has nothing of it.
        """
        with self._write_turn(), self.connection() as connection:
            connection.execution_options(write=True)
            with connection.begin():
                yield connection
                caller = None if upkeep else self._record(connection, self.now())
        if caller is not None:
            caller.recorded = True
        if notify:
            self._written()

    @contextmanager
    def connection(self) -> Iterator[Connection]:
        """A connection whose errors are ours: Unavailable, NoRoom, DatabaseDamaged; Invalid for a NUL that somebody
        requests, which PostgreSQL has no text with.
        """
        try:
            self._check_file()
            with self.engine.connect() as connection:
                yield connection
        except exc.DataError as error:
            if "NUL" not in _short(error):
                raise
            raise Invalid("a name or text has a NUL character: remove it") from error
        except (exc.DBAPIError, exc.TimeoutError) as error:
            ours = self._error(error)
            if ours is None:
                raise
            raise ours from error
        except _FileGone:
            raise
        except DatabaseDamaged as error:
            self.note_damage(error.detail)
            raise

    def check(self) -> None:
        """DatabaseDamaged where damage was found and is still there; a damaged SQLite file is checked now and then."""
        self._check_file()
        if self._damage is None:
            return
        since, detail = self._damage
        if time.monotonic() - since > RECHECK_SECONDS and self._checking.acquire(blocking=False):
            try:  # one check at a time; all others report what is known
                problem = self.integrity(1) if self.sqlite else None
                if problem is None:
                    self._damage = None
                    log.warning("database: no damage is found any more")
                    return
                self._damage = time.monotonic(), detail
            finally:
                self._checking.release()
        raise DatabaseDamaged(detail)

    def check_room(self) -> None:
        """NoRoom or Unavailable unless the folder of SQLite's file can be written."""
        if self.file is None:
            return
        try:
            check_room(self.file.parent)
        except OSError as error:
            kind = NoRoom if error.errno in DISK_FULL_ERRNOS else Unavailable
            raise kind(f"the folder of the database cannot be written: {error.strerror}") from error

    def tables(self) -> tuple[list[str], int]:
        """SQLite's tables by name, and the bytes of its pages; none on PostgreSQL."""
        if not self.sqlite:
            return [], 0
        with self.connection() as connection:
            names = connection.exec_driver_sql("SELECT name FROM sqlite_master WHERE type = 'table'").scalars()
            sizes = [connection.exec_driver_sql(f"PRAGMA {name}").scalar_one() for name in ("page_count", "page_size")]
            return sorted(["sqlite_master", *names]), sizes[0] * sizes[1]

    def integrity(self, limit: int, *, quick: bool = True, table: str | None = None) -> str | None:
        """What SQLite's own check of its pages finds wrong, up to ``limit`` lines; None for nothing, or PostgreSQL.

        table: the only one to check, with its indexes.
        """
        if not self.sqlite:
            return None
        try:
            with self.connection() as connection:
                check = "quick_check" if quick else "integrity_check"
                of = limit if table is None else f'"{table}"'
                lines = list(connection.exec_driver_sql(f"PRAGMA {check}({of})").scalars())[:limit]
        except DatabaseDamaged as error:
            return error.detail
        return None if lines == ["ok"] else "; ".join(map(str, lines))

    def note_damage_from(self, error: DatabaseDamaged) -> None:
        """Report damage that another process met. A file that is missing is checked anew for each request."""
        if not isinstance(error, _FileGone):
            self.note_damage(error.detail)

    def note_damage(self, detail: str) -> None:
        """Report damage that was found: from now on ``check`` fails."""
        first = self._damage is None
        self._damage = time.monotonic(), detail
        if first:  # once, not for each request
            log.critical("database: %s (database=%s)", detail, self.file or self._name)

    def report_damage(self, problem: str) -> None:
        """The same, of what a check of the pages found."""
        self.note_damage(f"the database {self._name} is damaged ({problem[:200]}): {REPAIR}")

    @property
    def _name(self) -> str:
        """What clients may read: no path, no password."""
        return f"file {self.file.name}" if self.file is not None else str(self.engine.url.database)

    def _check_file(self) -> None:
        """DatabaseDamaged where SQLite's file is no longer the one that was opened: writes to it would be lost."""
        if self.file is None or self._inode is None:
            return
        try:
            inode = self.file.stat().st_ino
        except OSError as error:
            fault = "is missing" if isinstance(error, FileNotFoundError) else f"cannot be read ({error.strerror})"
            problem = f"the database {self._name} {fault}: stop the server, put the file back or restore a backup"
        else:
            problem = f"the database {self._name} was replaced while the server runs: restart the server"
            problem = "" if inode == self._inode else problem
        if problem and problem != self._gone:  # once, not for each request
            log.critical("database: %s (database=%s)", problem, self.file)
        self._gone = problem
        if problem:
            raise _FileGone(problem)

    def _before_connect(self, *_: object) -> None:
        """SQLite would make an empty file where there is none any more."""
        self._check_file()
        if self.readonly and self.file is not None and not self.file.exists():
            raise _FileGone(f"the database {self._name} is missing: restore a backup")

    def _after_connect(self, *_: object) -> None:
        if self._inode is None and self.file is not None:
            self._inode = self.file.stat().st_ino

    def _error(self, error: exc.SQLAlchemyError) -> FleetMapError | None:
        """A database error as ours; None where it is none of the database's making."""
        original = getattr(error, "orig", None)
        code = getattr(original, "sqlite_errorcode", 0) & 0xFF
        state = getattr(original, "sqlstate", None)
        lost = state == _NO_FILE_STATE and _RELATION_FILE.search(str(original)) is not None
        if code in _CORRUPT or state in _CORRUPT_STATES or lost or "Could not decode to UTF-8" in str(original):
            self.report_damage(_short(error))
            return DatabaseDamaged(self._damage[1] if self._damage else "")
        full = code == sqlite3.SQLITE_FULL or state == _DISK_FULL_STATE
        if full or (code in (sqlite3.SQLITE_IOERR, sqlite3.SQLITE_CANTOPEN) and self._is_full()):
            return NoRoom(
                f"the server has no room left for its database ({_short(error)}); nothing was stored. Try again after "
                "its operator has freed space"
            )
        if code == sqlite3.SQLITE_READONLY:
            return Unavailable(
                f"the database {self._name} cannot be written ({_short(error)}); nothing was stored. Its operator has "
                "to make the file and its folder writable"
            )
        if code in (sqlite3.SQLITE_IOERR, sqlite3.SQLITE_CANTOPEN):
            return Unavailable(
                f"the database {self._name} cannot be read or written ({_short(error)}): its operator has to check the "
                "file, its folder and its disk"
            )
        if isinstance(error, exc.OperationalError | exc.InterfaceError | exc.TimeoutError | exc.InternalError):
            return Unavailable(f"the database does not answer as it should: {_short(error)}. Try again later")
        return None

    def _is_full(self) -> bool:
        try:
            return self.file is not None and shutil.disk_usage(self.file.parent).free < ROOM_BYTES
        except OSError:
            return False

    @contextmanager
    def _write_turn(self) -> Iterator[None]:
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


def _short(error: exc.SQLAlchemyError) -> str:
    """The driver's first line, without the statement and without what might be a secret in a URL."""
    original = getattr(error, "orig", None)
    return (str(original or error).splitlines() or ["no reason told"])[0][:200]


def check_room(folder: Path) -> None:
    """OSError unless a file of 1 MiB can be written to a folder."""
    probe = folder / f".room-{secrets.token_hex(8)}"
    try:
        with probe.open("wb") as file:
            os.posix_fallocate(file.fileno(), 0, ROOM_BYTES)
    finally:
        probe.unlink(missing_ok=True)
