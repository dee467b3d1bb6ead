"""Sessions and sign-in codes on both databases."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa
from alembic import command

from app.errors import Conflict, NotFound
from app.store.database import Database
from app.store.schema import config
from app.store.sessions import CODE_LIFE, IDLE, MAX_SESSIONS, USE_INTERVAL
from app.store.store import Store


class Clock:
    def __init__(self) -> None:
        self.time = datetime(2026, 5, 1, tzinfo=UTC)

    def __call__(self) -> datetime:
        return self.time


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def timed(database_url: str, tmp_path: Path, clock: Clock) -> Iterator[Store]:
    """A store whose clock the test sets."""
    store = Store(database_url, tmp_path / "blobs", clock=clock)
    store.migrate()
    yield store
    store.close()


def rows(store: Store, table: str) -> list[Any]:
    with store._database.read() as connection:
        return list(connection.execute(sa.text(f"SELECT * FROM {table}")).all())


def test_session_has_rights_of_its_token_and_is_stored_hashed(timed: Store, clock: Clock) -> None:
    token, _ = timed.tokens.create("alice", "editor", "farm-*")
    session, secret = timed.sessions.create(token)
    assert session.token == token
    assert session.ends == clock.time + IDLE
    assert timed.sessions.find(secret) == session
    assert timed.sessions.find(secret + "x") is None
    assert timed.sessions.find("x" * 5000) is None
    (row,) = rows(timed, "session")
    assert secret not in str(row)


def test_session_ends_after_twelve_hours_without_use(timed: Store, clock: Clock) -> None:
    token, _ = timed.tokens.create("alice", "viewer")
    _, secret = timed.sessions.create(token)
    _, unused = timed.sessions.create(token)
    clock.time += timedelta(hours=11)
    used = timed.sessions.find(secret)
    assert used is not None
    assert used.ends == clock.time + IDLE
    assert timed.sessions.store_uses() == 1
    clock.time += timedelta(hours=1, seconds=1)
    assert timed.sessions.find(secret) is not None
    assert timed.sessions.find(unused) is None
    assert timed.sessions.sweep() == 1
    assert len(rows(timed, "session")) == 1


def test_uses_are_written_at_most_once_a_minute(timed: Store, clock: Clock) -> None:
    token, _ = timed.tokens.create("alice", "viewer")
    _, secret = timed.sessions.create(token)
    generation = timed.generation()
    written = 0
    for _ in range(120):
        clock.time += timedelta(seconds=2)
        assert timed.sessions.find(secret) is not None
        written += timed.sessions.store_uses()
    assert 3 <= written <= 240 / USE_INTERVAL.total_seconds()
    assert timed.generation() == generation, "cached responses stay valid"


def test_last_use_of_a_token_is_stored_at_most_once_an_hour(timed: Store, clock: Clock) -> None:
    token, secret = timed.tokens.create("mower", "viewer")
    unused, _ = timed.tokens.create("spare", "viewer")
    generation = timed.generation()

    def last_used() -> dict[str, datetime | None]:
        return {one.id: one.used for one in timed.tokens.all()}

    start = clock.time
    assert timed.tokens.find(secret) is not None
    assert last_used() == {token.id: None, unused.id: None}, "no read costs a write"
    assert timed.tokens.store_uses() == 1
    for minutes, stored in ((30, 0), (59, 0), (60, 1)):
        clock.time = start + timedelta(minutes=minutes)
        assert timed.tokens.find(secret) is not None
        assert timed.tokens.store_uses() == stored
    assert last_used() == {token.id: clock.time, unused.id: None}
    _, session = timed.sessions.create(unused)
    assert timed.sessions.find(session) is not None
    assert timed.tokens.store_uses() == 1
    assert last_used()[unused.id] == clock.time, "a use of a session is one of its token"
    assert timed.generation() == generation, "cached responses stay valid"


@pytest.mark.parametrize("end", ["expiry", "revocation"])
def test_session_ends_with_its_token(timed: Store, clock: Clock, end: str) -> None:
    token, _ = timed.tokens.create("alice", "viewer", expires=clock.time + timedelta(hours=1))
    _, secret = timed.sessions.create(token)
    code, _ = timed.sessions.make_sign_in_code(token.id)
    if end == "revocation":
        timed.tokens.delete(token.id)
    else:
        clock.time += timedelta(hours=1)
    assert timed.sessions.find(secret) is None
    assert timed.sessions.redeem(code) is None
    with pytest.raises(NotFound):
        timed.sessions.create(token)
    if end == "expiry":
        with pytest.raises(Conflict, match="expired"):
            timed.sessions.make_sign_in_code(token.id)
        clock.time -= timedelta(hours=1)
        assert timed.sessions.find(secret) is None, "an ended token stays so if the clock is set back"
        assert timed.sessions.sweep() == 1
    assert rows(timed, "session") == []


def test_least_used_session_ends_if_a_token_has_too_many(timed: Store, clock: Clock) -> None:
    token, _ = timed.tokens.create("alice", "viewer")
    other, _ = timed.tokens.create("bob", "viewer")
    _, apart = timed.sessions.create(other)
    secrets = []
    for _ in range(MAX_SESSIONS):
        clock.time += timedelta(seconds=1)
        secrets.append(timed.sessions.create(token)[1])
    clock.time += USE_INTERVAL
    assert timed.sessions.find(secrets[0]) is not None
    timed.sessions.store_uses()
    _, last = timed.sessions.create(token)
    assert timed.sessions.find(secrets[1]) is None
    assert all(timed.sessions.find(secret) for secret in (secrets[0], *secrets[2:], last, apart))


def test_ended_session_is_unknown(timed: Store) -> None:
    token, _ = timed.tokens.create("alice", "viewer")
    _, secret = timed.sessions.create(token)
    assert timed.sessions.end(secret)
    assert not timed.sessions.end(secret)
    assert timed.sessions.find(secret) is None


def test_code_is_valid_once_for_ten_minutes(timed: Store, clock: Clock) -> None:
    token, _ = timed.tokens.create("alice", "editor")
    code, expires = timed.sessions.make_sign_in_code(token.id)
    late, _ = timed.sessions.make_sign_in_code(token.id)
    assert expires == clock.time + CODE_LIFE
    assert not any(text in str(rows(timed, "sign_in_code")) for text in (code, late))
    assert timed.sessions.redeem("x" * 22) is None
    started = timed.sessions.redeem(code)
    assert started is not None
    assert started[0].token == token
    assert timed.sessions.find(started[1]) is not None
    assert timed.sessions.redeem(code) is None
    clock.time += CODE_LIFE
    assert timed.sessions.redeem(late) is None
    with pytest.raises(NotFound):
        timed.sessions.make_sign_in_code("nosuch")


def test_concurrent_sign_ins_with_one_code_start_one_session(timed: Store) -> None:
    token, _ = timed.tokens.create("alice", "viewer")
    code, _ = timed.sessions.make_sign_in_code(token.id)
    barrier = threading.Barrier(6)

    def redeem(_: int) -> bool:
        barrier.wait(20)
        return timed.sessions.redeem(code) is not None

    with ThreadPoolExecutor(6) as threads:
        assert sum(threads.map(redeem, range(6))) == 1
    assert len(rows(timed, "session")) == 1


def test_processes_share_sessions_and_codes(timed: Store, database_url: str, tmp_path: Path, clock: Clock) -> None:
    """A store that is opened later sees the sessions, as another process or a restarted server does."""
    token, _ = timed.tokens.create("alice", "viewer")
    _, secret = timed.sessions.create(token)
    code, _ = timed.sessions.make_sign_in_code(token.id)
    other = Store(database_url, tmp_path / "blobs", clock=clock)
    try:
        assert other.sessions.find(secret) is not None
        assert other.sessions.redeem(code) is not None
        assert timed.sessions.redeem(code) is None
        assert other.sessions.end(secret)
        assert timed.sessions.find(secret) is None
    finally:
        other.close()


def test_migration_down_and_up_keeps_tokens(timed: Store, database_url: str) -> None:
    token, secret = timed.tokens.create("alice", "viewer")
    timed.sessions.create(token)
    settings = config()
    database = Database(database_url, readonly=False)
    with database.engine.connect() as connection:
        connection.execution_options(write=True)
        with connection.begin():
            settings.attributes["connection"] = connection
            command.downgrade(settings, "0010")
        assert not {"session", "sign_in_code"} & set(sa.inspect(connection).get_table_names())
    database.close()
    timed.migrate()
    assert timed.tokens.find(secret) == token
    assert rows(timed, "session") == []
    assert timed.sessions.create(token)
