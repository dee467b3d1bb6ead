"""Sessions of browsers, and one-time codes to start them: stored as SHA-256, each bound to a token."""

from __future__ import annotations

import secrets
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, Final

from sqlalchemy import Connection, Row, delete, insert, select

from app.errors import Conflict, NotFound
from app.store import tables
from app.store.base import hash_secret
from app.store.database import Database
from app.store.tokens import Tokens
from app.store.uses import Uses
from app.store.values import Token

SECRET_BYTES: Final = 32
CODE_BYTES: Final = 16

IDLE: Final = timedelta(hours=12)
"""Time without use after which a session ends."""

CODE_LIFE: Final = timedelta(minutes=10)

USE_INTERVAL: Final = timedelta(minutes=1)
"""Minimum time between two stored uses of a session."""

MAX_SESSIONS: Final = 32
"""Maximum number of sessions of one token; the one that was unused longest ends."""

MAX_SECRET: Final = 128


@dataclass(frozen=True, slots=True)
class Session:
    """Session of a browser. ends: time at which it ends unless it is used before."""

    token: Token
    ends: datetime


class Sessions:
    """Service for sessions and sign-in codes. Thread-safe; all processes on the database share them."""

    def __init__(self, database: Database, tokens: Tokens) -> None:
        self._database, self._tokens = database, tokens
        self._uses = Uses(database, tables.session.c.hash, tables.session.c.used, USE_INTERVAL)

    def create(self, token: Token) -> tuple[Session, str]:
        """Start a session of a token; returns it with its secret, which is not stored. Raises NotFound if revoked."""
        with self._database.write(notify=False, upkeep=True) as connection:
            return self._insert(connection, token.id)

    def make_sign_in_code(self, token_id: str) -> tuple[str, datetime]:
        """Create a code that starts one session of a token; returns it with its expiry. Raises NotFound, Conflict."""
        code = secrets.token_urlsafe(CODE_BYTES)
        expires = self._database.now() + CODE_LIFE
        with self._database.write(notify=False) as connection:
            if self._tokens.check_row(self._lock_token(connection, token_id), store_end=False) is None:
                raise Conflict(f"token {token_id[:80]!r} has expired: create another one")
            values = {"hash": hash_secret(code), "token_id": token_id, "expires": expires}
            connection.execute(insert(tables.sign_in_code).values(values))
        return code, expires

    def redeem(self, code: str) -> tuple[Session, str] | None:
        """Start a session with a sign-in code, which is then used up; None if it is unknown, used or expired."""
        if len(code) > MAX_SECRET:
            return None
        table = tables.sign_in_code
        condition = table.c.hash == hash_secret(code)
        with self._database.read() as connection:  # a wrong code does not wait for writers
            if connection.execute(select(table.c.hash).where(condition)).first() is None:
                return None
        with self._database.write(notify=False, upkeep=True) as connection:
            removal = delete(table).where(condition).returning(table.c.token_id, table.c.expires)
            row = connection.execute(removal).one_or_none()
            if row is None or row.expires <= self._database.now():
                return None
            try:
                return self._insert(connection, row.token_id)
            except NotFound:
                return None

    def find(self, secret: str) -> Session | None:
        """Find a session by its secret, and note its use; None if it or its token has ended."""
        if len(secret) > MAX_SECRET:
            return None
        table, owner, digest = tables.session, tables.token, hash_secret(secret)
        query = (
            select(owner, table.c.used.label("session_used"))
            .join(table, table.c.token_id == owner.c.id)
            .where(table.c.hash == digest)
        )
        with self._database.read() as connection:
            row = connection.execute(query).one_or_none()
        now = self._database.now()
        token = None if row is None else self._tokens.check_row(row)
        if row is None or token is None or row.session_used + IDLE <= now:
            return None
        self._tokens.note_use(token)
        return Session(token, self._uses.note(digest, row.session_used) + IDLE)

    def end(self, secret: str) -> bool:
        """End a session; returns whether there was one."""
        if len(secret) > MAX_SECRET:
            return False
        table = tables.session
        condition = table.c.hash == hash_secret(secret)
        with self._database.read() as connection:
            if connection.execute(select(table.c.hash).where(condition)).first() is None:
                return False
        with self._database.write(upkeep=True) as connection:
            return bool(connection.execute(delete(table).where(condition)).rowcount)

    def store_uses(self) -> int:
        """Store the noted uses of sessions, in one transaction; returns how many. Without any it writes nothing."""
        return self._uses.store()

    def sweep(self) -> int:
        """Delete ended sessions and expired codes; returns how many."""
        table, code, owner, now = tables.session, tables.sign_in_code, tables.token, self._database.now()
        ended = select(owner.c.id).where(owner.c.ended.is_not(None))
        conditions: list[tuple[Any, Any]] = [
            (table, (table.c.used <= now - IDLE) | table.c.token_id.in_(ended)),
            (code, code.c.expires <= now),
        ]
        with self._database.read() as connection:
            due = [(t, c) for t, c in conditions if connection.execute(select(t.c.hash).where(c).limit(1)).first()]
        if not due:
            return 0
        with self._database.write(notify=False, upkeep=True) as connection:
            return sum(int(connection.execute(delete(t).where(c)).rowcount) for t, c in due)

    def _insert(self, connection: Connection, token_id: str) -> tuple[Session, str]:
        table, now = tables.session, self._database.now()
        token = self._tokens.check_row(self._lock_token(connection, token_id), store_end=False)
        if token is None:
            raise NotFound(f"token {token_id[:80]!r} has expired: ask an administrator for a new one")
        secret = secrets.token_urlsafe(SECRET_BYTES)
        newest = select(table.c.hash).where(table.c.token_id == token_id).order_by(table.c.used.desc(), table.c.hash)
        kept = connection.execute(newest.limit(MAX_SESSIONS - 1)).scalars().all()
        connection.execute(delete(table).where(table.c.token_id == token_id, table.c.hash.not_in(kept)))
        values = {"hash": hash_secret(secret), "token_id": token_id, "created": now, "used": now}
        connection.execute(insert(table).values(values))
        return Session(token, now + IDLE), secret

    def _lock_token(self, connection: Connection, token_id: str) -> Row[Any]:
        """Read a token's row, locked until the transaction ends. Raises NotFound."""
        owner = tables.token
        row = connection.execute(select(owner).where(owner.c.id == token_id).with_for_update()).one_or_none()
        if row is None:
            raise NotFound(f"unknown token {token_id[:80]!r}")
        return row
