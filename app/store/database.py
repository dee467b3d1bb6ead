"""One engine for SQLite and PostgreSQL: pragmas, transactions, and conversion of database errors."""

from __future__ import annotations

import contextlib
import logging
import os
import re
import shutil
import sqlite3
import stat
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any, Protocol

import orjson
from sqlalchemy import Connection, Engine, create_engine, event, exc, func, select
from sqlalchemy.engine import make_url

from app.backends.fence import check_fences
from app.backends.notify import LocalNotifier, Notifier, SharedNotifier, new_number
from app.backends.room import ROOM_BYTES, check_room
from app.errors import DISK_FULL_ERRNOS, DatabaseDamaged, FleetMapError, Invalid, NoRoom, Unavailable
from app.store.base import utcnow

log = logging.getLogger(__name__)

BUSY_MILLISECONDS = 5000
TURN_SECONDS = 30.0
RECHECK_SECONDS = 60.0
"""Seconds between two checks of a database that was found damaged."""

MAX_STANDSTILL_SECONDS = 30
"""Maximum time between two statements of a transaction that writes, after which PostgreSQL ends it.

Others wait for the rows that it has locked, and its server may have stopped. It is enough to compute something.
"""

KEEPALIVE = {"keepalives_idle": 5, "keepalives_interval": 2, "keepalives_count": 3}
"""Seconds, and number of probes: PostgreSQL and this process notice within some 10 s that the network is gone.

Else the rows that an open transaction has changed would stay locked for the two hours of Linux's default.
"""

REPAIR = "stop the server, run `fleetmap verify`, and restore a backup of the database"
_CORRUPT = frozenset({sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB})
_CORRUPT_STATES = frozenset({"XX001", "XX002"})
"""PostgreSQL's SQLSTATE codes data_corrupted and index_corrupted."""

_NO_FILE_STATE = "58P01"
_RELATION_FILE = re.compile(r"\b(?:base|global|pg_tblspc)/")
"""Pattern of damage in PostgreSQL's undefined_file: a missing data file, not a missing library."""

_DISK_FULL_STATE = "53100"


def _from_json(text: str | bytes) -> Any:
    try:
        return orjson.loads(text)
    except orjson.JSONDecodeError as error:
        raise DatabaseDamaged(f"invalid JSON value in the database: {REPAIR}") from error


def engine(url: str, *, readonly: bool) -> Engine:
    """Create a durable engine: SQLite in WAL mode with full syncs, or PostgreSQL by psycopg."""
    try:
        parsed = make_url(url)
    except exc.ArgumentError as error:
        raise Invalid(f"invalid database URL ({error}): use sqlite:///PATH or postgresql+psycopg://…") from error
    options: dict[str, Any] = {
        "json_serializer": lambda value: orjson.dumps(value).decode(),
        "json_deserializer": _from_json,
        "pool_size": 8,
        "max_overflow": 24,
        "pool_timeout": 30,
    }
    if parsed.get_backend_name() == "sqlite":
        if parsed.database and parsed.database != ":memory:" and not readonly:
            Path(parsed.database).parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        sql_engine = create_engine(parsed, **options)
        event.listen(sql_engine, "connect", _sqlite_on_connect(readonly))
        event.listen(sql_engine, "begin", _sqlite_on_begin)
        return sql_engine
    if parsed.get_backend_name() == "postgresql":
        settings = "-c synchronous_commit=on -c jit=off" + (" -c default_transaction_read_only=on" if readonly else "")
        settings += "".join(f" -c tcp_{name}={value}" for name, value in KEEPALIVE.items())
        connect = {"connect_timeout": 5, "application_name": "fleetmap", "options": settings, **KEEPALIVE}
        return create_engine(
            parsed.set(drivername="postgresql+psycopg"), connect_args=connect, pool_pre_ping=True, **options
        )
    raise Invalid(f"unsupported database {parsed.get_backend_name()!r}: use sqlite:///PATH or postgresql+psycopg://…")


def _sqlite_on_connect(readonly: bool) -> Any:
    def connected(connection: sqlite3.Connection, record: object) -> None:
        del record
        # The driver would begin transactions itself, too late for BEGIN IMMEDIATE.
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


def _create_private(path: Path) -> None:
    """Create SQLite's file for its owner, and for the group if the folder is its group's to write to (umask applies).

    The file has secrets of webhooks. SQLite gives its mode to the files beside it, and reports itself what fails here.
    """
    with contextlib.suppress(OSError):
        is_shared = path.parent.stat().st_mode & stat.S_IWGRP
        os.close(os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o660 if is_shared else 0o600))


class _FileGone(DatabaseDamaged):
    """Error for a replaced SQLite file. The original may be restored at any moment."""


class AuditMark(Protocol):
    """Handle of a request's row in the audit log. recorded: whether the row is committed."""

    recorded: bool


class Database:
    """Transactions on an engine. Database errors that a retry may avoid become Unavailable.

    written: called after each commit with the new number of the commit counter, so that caches in memory notice it.
    record: adds the audit row to a transaction. clock: returns the present as an aware time. file: SQLite's; None on
    PostgreSQL.
    """

    def __init__(
        self,
        url: str,
        *,
        readonly: bool,
        written: Callable[[int], None] = lambda _: None,
        record: Callable[[Connection, datetime], AuditMark | None] = lambda *_: None,
        clock: Callable[[], datetime] = utcnow,
    ) -> None:
        self.engine = engine(url, readonly=readonly)
        self._written, self._record, self.now = written, record, clock
        self.sqlite = self.engine.dialect.name == "sqlite"
        self._notifier: Notifier = LocalNotifier() if self.sqlite else SharedNotifier()
        name = self.engine.url.database if self.sqlite else None
        self.file = Path(name) if name and name != ":memory:" and not name.startswith("file:") else None
        self._inode: int | None = None
        self._damage: tuple[float, str] | None = None
        self._checking = threading.Lock()
        self._gone = ""
        self._is_closed = False
        self.readonly = readonly
        # SQLite does not queue writers: among many, one may never get its turn
        self._turn = threading.Lock()
        if self.file is not None:
            event.listen(self.engine, "do_connect", self._before_connect)
            event.listen(self.engine, "connect", self._after_connect)

    @contextmanager
    def read(self) -> Iterator[Connection]:
        """Begin a transaction that only reads."""
        with self.connection() as connection:
            yield connection

    @contextmanager
    def snapshot(self) -> Iterator[Connection]:
        """Begin a transaction that only reads, from one snapshot."""
        with self.connection() as connection:
            if not self.sqlite:
                connection.execution_options(isolation_level="REPEATABLE READ")
            yield connection

    @contextmanager
    def write(self, *, notify: bool = True, upkeep: bool = False, alone: bool = False) -> Iterator[Connection]:
        """Begin a transaction that writes: all or nothing, durable when it ends.

        Within a fence (``app.backends.fence``) only who still has the right can commit it. notify: whether caches are
        notified, on all servers. upkeep: no change by a user, so that it gets no row in the audit log. alone: nobody
        else uses the database, so that it may stand still for any time.
        """
        with self._write_turn(), self.connection() as connection:
            connection.execution_options(write=True)
            number = new_number()
            with connection.begin():
                if not self.sqlite and not alone:
                    limit = f"{MAX_STANDSTILL_SECONDS}s"
                    connection.execute(select(func.set_config("idle_in_transaction_session_timeout", limit, True)))
                yield connection
                caller = None if upkeep else self._record(connection, self.now())
                if notify:
                    self._notifier.announce(connection, number)
                check_fences(connection)
        if caller is not None:
            caller.recorded = True
        if notify:
            self._written(number)

    @contextmanager
    def connection(self) -> Iterator[Connection]:
        """Convert the errors of a connection: Unavailable, NoRoom, DatabaseDamaged; Invalid for a NUL in a query.

        PostgreSQL cannot store a NUL in a text.
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
        finally:
            if self._is_closed:  # meanwhile: the connection went back to a pool that nobody would empty
                self.engine.pool.dispose()

    def check(self) -> None:
        """Raise DatabaseDamaged while found damage persists; a damaged SQLite file is checked again periodically."""
        self._check_file()
        if self._damage is None:
            return
        since, detail = self._damage
        if time.monotonic() - since > RECHECK_SECONDS and self._checking.acquire(blocking=False):
            try:  # one check at a time; all others report the last result
                problem = self.integrity(1) if self.sqlite else None
                if problem is None:
                    self._damage = None
                    log.warning("database: intact again, no damage found")
                    return
                self._damage = time.monotonic(), detail
            finally:
                self._checking.release()
        raise DatabaseDamaged(detail)

    def check_room(self) -> None:
        """Raise NoRoom or Unavailable unless the folder of SQLite's file can be written."""
        if self.file is None:
            return
        try:
            check_room(self.file.parent)
        except OSError as error:
            kind = NoRoom if error.errno in DISK_FULL_ERRNOS else Unavailable
            raise kind(f"the folder of the database cannot be written: {error.strerror}") from error

    def versions(self) -> dict[str, str]:
        """Return the versions of SQLite, or of PostgreSQL and PostGIS (``missing`` without it)."""
        with self.connection() as connection:
            if self.sqlite:
                return {"SQLite": str(connection.exec_driver_sql("SELECT sqlite_version()").scalar_one())}
            version = str(connection.exec_driver_sql("SHOW server_version").scalar_one()).partition(" ")[0]
            extension = "SELECT extversion FROM pg_extension WHERE extname = 'postgis'"
            postgis = connection.exec_driver_sql(extension).scalar()
        return {"PostgreSQL": version, "PostGIS": str(postgis or "missing")}

    def clock_offset(self) -> float | None:
        """Return by how many seconds the database's clock is ahead of this machine's; None if it is the same clock.

        The error is at most half of the time that the query takes.
        """
        if self.sqlite:
            return None
        with self.connection() as connection:
            sent = time.time()
            remote = float(connection.exec_driver_sql("SELECT extract(epoch FROM clock_timestamp())").scalar_one())
            return remote - (sent + time.time()) / 2

    def tables(self) -> tuple[list[str], int]:
        """Return the names of SQLite's tables, and the bytes of its pages; none on PostgreSQL."""
        if not self.sqlite:
            return [], 0
        with self.connection() as connection:
            names = connection.exec_driver_sql("SELECT name FROM sqlite_master WHERE type = 'table'").scalars()
            sizes = [connection.exec_driver_sql(f"PRAGMA {name}").scalar_one() for name in ("page_count", "page_size")]
            return sorted(["sqlite_master", *names]), sizes[0] * sizes[1]

    def integrity(self, limit: int, *, quick: bool = True, table: str | None = None) -> str | None:
        """Run SQLite's own check of its pages; returns up to ``limit`` problems, None if intact or on PostgreSQL.

        table: check only this one, with its indexes.
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
        """Note damage that another process found. A missing file is checked for each request instead."""
        if not isinstance(error, _FileGone):
            self.note_damage(error.detail)

    def note_damage(self, detail: str) -> None:
        """Note damage: from now on ``check`` fails."""
        first = self._damage is None
        self._damage = time.monotonic(), detail
        if first:  # once, not for each request
            log.critical("database: %s (database=%s)", detail, self.file or self._name)

    def report_damage(self, problem: str) -> None:
        """Note damage that a check of the pages found."""
        self.note_damage(f"the database {self._name} is damaged ({problem[:200]}): {REPAIR}")

    @property
    def _name(self) -> str:
        """Return the database's name for clients: no path, no password."""
        return f"file {self.file.name}" if self.file is not None else str(self.engine.url.database)

    def _check_file(self) -> None:
        """Raise DatabaseDamaged if SQLite's file is not the one that was opened: writes to it would be lost."""
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
        """Keep SQLite from creating its file: if it is missing, or so that every user of the machine can read it."""
        self._check_file()
        if self.file is None or self.file.exists():
            return
        if self.readonly:
            raise _FileGone(f"the database {self._name} is missing: restore a backup")
        _create_private(self.file)

    def _after_connect(self, *_: object) -> None:
        if self._inode is None and self.file is not None:
            self._inode = self.file.stat().st_ino

    def _error(self, error: exc.SQLAlchemyError) -> FleetMapError | None:
        """Convert a database error; None if the error is in the request."""
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
                f"the server has no disk space left for its database ({_short(error)}), and nothing was stored: try "
                "again when its operator has freed space"
            )
        if code == sqlite3.SQLITE_READONLY:
            return Unavailable(
                f"the database {self._name} cannot be written ({_short(error)}), and nothing was stored: its "
                "operator must make the file and its folder writable"
            )
        if code in (sqlite3.SQLITE_IOERR, sqlite3.SQLITE_CANTOPEN):
            return Unavailable(
                f"the database {self._name} cannot be read or written ({_short(error)}): its operator must check the "
                "file, its folder and its disk"
            )
        if isinstance(error, exc.OperationalError | exc.InterfaceError | exc.TimeoutError | exc.InternalError):
            return Unavailable(f"the database is unavailable ({_short(error)}): try again later")
        return None

    def _is_full(self) -> bool:
        try:
            return self.file is not None and shutil.disk_usage(self.file.parent).free < ROOM_BYTES
        except OSError:
            return False

    @contextmanager
    def _write_turn(self) -> Iterator[None]:
        """Queue the writers of this process for a database that allows one writer at a time."""
        if not self.sqlite:
            yield
            return
        if not self._turn.acquire(timeout=TURN_SECONDS):
            raise Unavailable("too many concurrent writes: try again in a few seconds")
        try:
            yield
        finally:
            self._turn.release()

    def close(self) -> None:
        """Close all connections; those that threads still use are closed when they are done with them."""
        self._is_closed = True
        self.engine.pool.dispose()  # not Engine.dispose(), which would begin another pool for such threads


def _short(error: exc.SQLAlchemyError) -> str:
    """Return the first line of the driver's message, without the statement and without URLs (secrets)."""
    original = getattr(error, "orig", None)
    return (str(original or error).splitlines() or ["no reason given"])[0][:200]
