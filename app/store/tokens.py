"""Access tokens: stored as SHA-256, compared in constant time."""

from __future__ import annotations

import hmac
import logging
import secrets
from collections.abc import Callable
from datetime import datetime, timedelta
from typing import Any, Final, get_args

from sqlalchemy import Row, bindparam, delete, insert, select, update
from sqlalchemy.exc import IntegrityError

from app.errors import Conflict, Invalid, NotFound, Unavailable
from app.store import tables
from app.store.audit import set_audit_target
from app.store.base import checked_text, hash_secret
from app.store.database import Database
from app.store.uses import Uses
from app.store.values import Role, Token, rfc3339

log = logging.getLogger(__name__)

SECRET_BYTES: Final = 32

USE_INTERVAL: Final = timedelta(hours=1)
"""Minimum time between two stored uses of a token."""

_EXPIRED: Final = tables.token.c.ended.is_(None) & (tables.token.c.expires <= bindparam("now"))
_ANY_EXPIRED: Final = select(tables.token.c.id).where(_EXPIRED).limit(1)


class Tokens:
    """Service for access tokens."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._uses = Uses(database, tables.token.c.id, tables.token.c.used, USE_INTERVAL)

    def create(
        self,
        name: str,
        role: Role,
        environments: str | None = None,
        robot: str | None = None,
        expires: datetime | None = None,
        token: str | None = None,
    ) -> tuple[Token, str]:
        """Create a token; returns it with its secret, which is not stored.

        environments: a name pattern (fnmatch). robot: name of the robot whose status the token may report; required for
        the role robot. token: a secret chosen by the operator. Raises Conflict if it exists already.
        """
        if role not in get_args(Role):
            raise Invalid(f"role must be one of {', '.join(get_args(Role))}, got {role!r:.80}")
        if role == "robot" and robot is None:
            raise Invalid("a token with the role robot must name its robot")
        if expires is not None and expires.tzinfo is None:
            raise Invalid("expires needs a time zone, for example 2027-01-01T00:00:00Z")
        if token is not None and not token:
            raise Invalid("a chosen token must not be empty")
        secret = token or secrets.token_urlsafe(SECRET_BYTES)
        values: dict[str, Any] = {
            "id": secrets.token_hex(8),
            "name": checked_text(name, "a token's name", 256),
            "role": role,
            "environments": None if environments is None else checked_text(environments, "a name pattern", 256),
            "robot": None if robot is None else checked_text(robot, "a robot's name", 256),
            "expires": expires,
            "created": self._database.now(),
        }
        set_audit_target(target=f"token {values['id']}")
        try:
            with self._database.write() as connection:
                connection.execute(insert(tables.token).values(hash=hash_secret(secret), **values))
        except IntegrityError as error:
            raise Conflict("this token exists already") from error
        return Token(**values), secret

    def create_administrator(self) -> str | None:
        """Create a first administrator's token; returns its secret, None if there is an administrator already.

        Of several servers that start together on one database only one creates it.
        """
        with self._database.write() as connection:
            if not self._database.sqlite:
                connection.exec_driver_sql("LOCK TABLE token IN SHARE ROW EXCLUSIVE MODE")
            table = tables.token
            if connection.execute(select(table.c.id).where(table.c.role == "admin").limit(1)).first() is not None:
                return None
            secret = secrets.token_urlsafe(SECRET_BYTES)
            created = self._database.now()
            values = {"id": secrets.token_hex(8), "name": "administrator", "role": "admin", "created": created}
            connection.execute(insert(table).values(hash=hash_secret(secret), **values))
        return secret

    def all(self) -> list[Token]:
        """List all tokens, oldest first."""
        table = tables.token
        with self._database.read() as connection:
            rows = connection.execute(select(table).order_by(table.c.created, table.c.id)).all()
        return [_as_token(r) for r in rows]

    def delete(self, id: str, *, is_needed: Callable[[Token], bool] = lambda _: False) -> None:
        """Revoke a token. Raises NotFound, or Conflict for the last of those that are needed.

        is_needed: tells of an administrator's token whether one like it must remain.
        """
        table = tables.token
        admins = select(table).where(table.c.role == "admin").order_by(table.c.id).with_for_update()
        with self._database.write() as connection:
            needed = [token.id for row in connection.execute(admins) if is_needed(token := _as_token(row))]
            if needed == [id]:
                raise Conflict("this is the last administrator's token: create another one first")
            if not connection.execute(delete(table).where(table.c.id == id)).rowcount:
                raise NotFound(f"unknown token {id[:80]!r}")

    def find(self, text: str) -> Token | None:
        """Find the token with this secret, and note its use; None if it is unknown or expired."""
        if len(text) > 4096:
            return None
        digest = hash_secret(text)
        with self._database.read() as connection:
            row = connection.execute(select(tables.token).where(tables.token.c.hash == digest)).one_or_none()
        if row is None or not hmac.compare_digest(row.hash, digest):
            return None
        token = self.check_row(row)
        if token is not None:
            self.note_use(token)
        return token

    def note_use(self, token: Token) -> None:
        """Note that a token is used, to be stored by `store_uses`."""
        self._uses.note(token.id, token.used)

    def store_uses(self) -> int:
        """Store the noted uses of tokens, in one transaction; returns how many. Without any it writes nothing."""
        return self._uses.store()

    def check_row(self, row: Row[Any], *, store_end: bool = True) -> Token | None:
        """Convert a token's row; None if the token has ended. store_end: store that it was found expired."""
        token = _as_token(row)
        if token.ended is None and token.expires is not None and token.expires <= self._database.now():
            if store_end:
                self._store_end()
            return None
        return None if token.ended is not None else token

    def _store_end(self) -> None:
        try:
            self.end_expired()
        except Unavailable as error:  # rejected anyway, and stored the next time
            log.warning("tokens: storing the end of an expired token failed (reason=%s)", error.detail)

    def end_expired(self) -> int:
        """Mark expired tokens as ended, and return how many: they stay so, even if the clock is set back."""
        now = self._database.now()
        with self._database.read() as connection:
            if connection.execute(_ANY_EXPIRED, {"now": now}).first() is None:
                return 0
        with self._database.write(upkeep=True) as connection:
            ending = update(tables.token).where(_EXPIRED).values(ended=now)
            count = int(connection.execute(ending, {"now": now}).rowcount)
        log.info("tokens: expired (count=%d, time=%s)", count, rfc3339(now))
        return count


def _as_token(row: Row[Any]) -> Token:
    return Token(row.id, row.name, row.role, row.environments, row.robot, row.expires, row.created, row.ended, row.used)
