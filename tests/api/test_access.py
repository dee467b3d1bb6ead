"""Tokens, roles and throttling of failures, without a server."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import pytest

from app.api.http.auth import (
    FRESH_SECONDS,
    WINDOW_SECONDS,
    Authenticator,
    Credentials,
    Principal,
    client_source,
    environment_in_path,
    is_loopback,
    is_open,
)
from app.api.http.problems import Throttled
from app.errors import Denied, Unauthenticated
from app.store.values import Role, Token

NOW = datetime.now(UTC)


class Clock:
    def __init__(self) -> None:
        self.time = 1000.0

    def __call__(self) -> float:
        return self.time


class Book:
    """Tokens of a store, with a count of the lookups."""

    def __init__(self, **tokens: Token) -> None:
        self.tokens, self.lookups = tokens, 0

    def __call__(self, text: str) -> Token | None:
        self.lookups += 1
        return self.tokens.get(text)


def token(role: Role = "viewer", environments: str | None = None, expires: datetime | None = None) -> Token:
    return Token("t1", "somebody", role, environments, None, expires, NOW)


def test_token_is_looked_up_once_per_second() -> None:
    clock, book = Clock(), Book(good=token())
    access = Authenticator(book, failures=3, clock=clock)
    header = b"Bearer good"
    assert access.cached_principal(Credentials(header)) is None
    assert access.authenticate(Credentials(header, client="10.0.0.1")).name == "somebody"
    assert access.cached_principal(Credentials(header)) is not None
    access.authenticate(Credentials(header, client="10.0.0.1"))
    assert book.lookups == 1
    clock.time += FRESH_SECONDS + 0.01
    assert access.cached_principal(Credentials(header)) is None
    book.tokens.clear()
    with pytest.raises(Unauthenticated):
        access.authenticate(Credentials(header, client="10.0.0.1"))


def test_revoked_token_is_refused_at_once() -> None:
    book = Book(good=token())
    access = Authenticator(book, failures=3, clock=Clock())
    access.authenticate(Credentials(b"Bearer good", client=None))
    access.invalidate()
    assert access.cached_principal(Credentials(b"Bearer good")) is None


@pytest.mark.parametrize(
    "header", [None, b"", b"Bearer", b"Bearer ", b"Basic good", b"good", b"Bearer \xff", b"Bearer " + b"x" * 999]
)
def test_unusable_token_raises_unauthenticated_without_lookup(header: bytes | None) -> None:
    book = Book(good=token())
    with pytest.raises(Unauthenticated):
        Authenticator(book, failures=3, clock=Clock()).authenticate(Credentials(header))
    assert book.lookups == 0


def test_scheme_is_case_insensitive() -> None:
    assert Authenticator(Book(good=token()), failures=3).authenticate(Credentials(b"bearer good")).id == "t1"


def test_expired_token_raises_unauthenticated() -> None:
    access = Authenticator(Book(old=token(expires=NOW - timedelta(seconds=1))), failures=3)
    with pytest.raises(Unauthenticated):
        access.authenticate(Credentials(b"Bearer old", client=None))


def test_wrong_tokens_throttle_only_their_source() -> None:
    clock, book = Clock(), Book(good=token())
    access = Authenticator(book, failures=3, clock=clock)
    access.authenticate(Credentials(b"Bearer good", client="10.0.0.1"))
    for _ in range(3):
        with pytest.raises(Unauthenticated):
            access.authenticate(Credentials(b"Bearer wrong", client="10.0.0.1"))
    with pytest.raises(Throttled, match="always accepted"):
        access.authenticate(Credentials(b"Bearer wrong", client="10.0.0.1"))
    with pytest.raises(Throttled):
        access.note_failure("::ffff:10.0.0.1")  # a wrong signature of a link
    with pytest.raises(Unauthenticated):
        access.authenticate(Credentials(None, client="10.0.0.1"))
    book.tokens["other"] = token("robot")
    assert access.authenticate(Credentials(b"Bearer other", client="10.0.0.1")).role == "robot", (
        "robots behind one NAT share its address"
    )
    assert access.authenticate(Credentials(b"Bearer good", client="10.0.0.1")), "a cached token stays valid"
    assert access.authenticate(Credentials(b"Bearer good", client="10.0.0.2"))
    with pytest.raises(Unauthenticated):
        access.authenticate(Credentials(b"Bearer wrong", client="10.0.0.2"))
    clock.time += WINDOW_SECONDS + 1
    with pytest.raises(Unauthenticated):
        access.authenticate(Credentials(b"Bearer wrong", client="10.0.0.1"))


def test_missing_token_counts_as_no_failure() -> None:
    access = Authenticator(Book(good=token()), failures=1, clock=Clock())
    for _ in range(5):
        with pytest.raises(Unauthenticated):
            access.authenticate(Credentials(None, client="10.0.0.1"))
    assert access.authenticate(Credentials(b"Bearer good", client="10.0.0.1"))


def test_client_source_groups_addresses() -> None:
    assert client_source("10.0.0.1") == "10.0.0.1"
    assert client_source("2001:db8::1") == client_source("2001:db8::2") != client_source("2001:db9::1")
    assert client_source("::ffff:10.0.0.1") == "10.0.0.1", "an IPv4 client of a server that listens on ::"
    assert is_loopback(client_source("::1"))
    assert is_loopback(client_source("127.1.2.3"))
    assert not is_loopback(client_source("::"))
    assert client_source(None) == ""
    assert client_source("testclient") == "testclient"


@pytest.mark.parametrize(
    ("role", "may"),
    [
        ("viewer", {"viewer"}),
        ("robot", {"viewer"}),
        ("editor", {"viewer", "editor"}),
        ("admin", {"viewer", "editor", "admin"}),
    ],
)
def test_require_role_follows_role_order(role: Role, may: set[str]) -> None:
    principal = Principal.from_token(token(role))
    for need in ("viewer", "editor", "admin"):
        if need in may:
            principal.require_role(need)  # type: ignore[arg-type]
        else:
            with pytest.raises(Denied):
                principal.require_role(need)  # type: ignore[arg-type]


def test_environment_pattern_limits_access() -> None:
    principal = Principal.from_token(token(environments="farm-*"))
    principal.require_environment("farm-1")
    for other in ("farm", "xfarm-1", "street"):
        with pytest.raises(Denied):
            principal.require_environment(other)
    with pytest.raises(Denied):
        principal.require_all_environments()
    Principal.from_token(token()).require_environment("anything")


@pytest.mark.parametrize(
    ("path", "environment"),
    [
        ("/api/v1/environments", None),
        ("/api/v1/environments/", None),
        ("/api/v1/environments/farm", "farm"),
        ("/api/v1/environments/farm/versions/1/maps/kml", "farm"),
        ("/api/v1/environments/fa\nrm/x", "fa\nrm"),
        ("/maps/farm/kml", "farm"),
        ("/ogc/farm", "farm"),
        ("/ogc/farm/versions/1/", "farm"),
        ("/api/v1/formats", None),
    ],
)
def test_environment_in_path_returns_the_name(path: str, environment: str | None) -> None:
    assert environment_in_path(path) == environment


def test_open_paths_need_no_token() -> None:
    assert all(map(is_open, ("/healthz", "/readyz", "/docs", "/docs/swagger-ui.css", "/openapi.json")))
    assert not any(map(is_open, ("//", "/metrics", "/docsx", "/healthz/", "/api/v1/formats", "/maps/a/b")))
