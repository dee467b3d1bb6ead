"""Webhooks: each event arrives signed, in order and at least once, and nothing but allowed addresses is reached."""

from __future__ import annotations

import ipaddress
import itertools
import socket
from collections.abc import Callable, Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import delete

from app.backends.lead import LocalLeads, SharedLeads
from app.errors import Invalid, NoRoom, Unavailable
from app.events import outgoing
from app.events.outgoing import OutgoingClient, OutgoingRules, RequestError, check_url
from app.events.webhooks import Attempt, Attempts, WebhookSender, next_attempts
from app.store import tables
from app.store.store import Store
from app.store.webhooks import Lag, Webhook
from tests.api.conftest import empty_database
from tests.certificates import Authority
from tests.events.conftest import eventually
from tests.events.receiver import Answer, Receiver, drip, flood
from tests.ports import free_port

CHANNELS = itertools.count()
LOOPBACK = OutgoingRules(networks=(ipaddress.ip_network("127.0.0.0/8"),))


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    (tmp_path / "store.sqlite").write_bytes(empty_database())
    store = Store(f"sqlite:///{tmp_path / 'store.sqlite'}", tmp_path / "blobs")
    yield store
    store.close()


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    receiver = Receiver()
    yield receiver
    receiver.close()
    assert receiver.problems == []


@pytest.fixture
def start(store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., WebhookSender]]:
    """Start a sender, which stands for a server."""
    monkeypatch.setattr("app.events.webhooks.FIRST_RETRY_SECONDS", 0.01)
    monkeypatch.setattr("app.events.follower.POLL_SECONDS", 0.05)
    monkeypatch.setattr("app.events.leader.POLL_SECONDS", 0.05)
    senders: list[WebhookSender] = []

    def start(rules: OutgoingRules = LOOPBACK) -> WebhookSender:
        senders.append(WebhookSender(store, tmp_path, LocalLeads(tmp_path), rules))
        senders[-1].start()
        return senders[-1]

    yield start
    for sender in senders:
        sender.close()


def hook(store: Store, receiver: Receiver, **more: Any) -> Webhook:
    webhook = store.webhooks.create(receiver.url, **more)
    receiver.secret = webhook.secret
    return webhook


def promote(store: Store, environment: str, times: int) -> None:
    """Make an event each time."""
    for _ in range(times):
        store.channels.move(environment, f"channel-{next(CHANNELS)}", 0, author="test")


def test_events_arrive_signed_and_in_order(store: Store, receiver: Receiver, start: Any) -> None:
    store.environments.create("before")
    webhook = hook(store, receiver)
    start()
    for name in ("farm", "street"):
        store.environments.create(name)
    for _ in range(5):
        promote(store, "farm", 1)
        promote(store, "street", 2)
    eventually(lambda: len(receiver.sequences("farm")) == 6 and len(receiver.sequences("street")) == 11)
    assert receiver.sequences("farm") == [1, 2, 3, 4, 5, 6]
    assert receiver.sequences("street") == list(range(1, 12))
    assert receiver.sequences("before") == [], "a webhook gets what happens after it was made"
    logged = store.events.page("farm")
    assert [e for e in receiver.events if e["environment"] == "farm"] == [e.body for e in logged]
    assert len({attempt[0] for attempt in receiver.attempts}) == len(receiver.attempts) == 17
    eventually(lambda: store.webhooks.count_waiting(store.webhooks.get(webhook.id)) == 0)


def test_webhook_gets_only_what_it_asked_for(store: Store, receiver: Receiver, start: Any) -> None:
    hook(store, receiver, environments="farm-*", types=["channel.moved"])
    start()
    for name in ("farm-1", "street"):
        store.environments.create(name)
        promote(store, name, 2)
    eventually(lambda: len(receiver.events) == 2)
    assert [(e["environment"], e["type"]) for e in receiver.events] == [("farm-1", "channel.moved")] * 2


def test_refused_event_delays_only_its_environment(store: Store, receiver: Receiver, start: Any) -> None:
    refuses = True
    receiver.answer = lambda _, event: 422 if refuses and event["environment"] == "farm" else 200
    webhook = hook(store, receiver)
    start()
    store.environments.create("farm")
    store.environments.create("street")
    promote(store, "farm", 60)
    promote(store, "street", 3)
    eventually(lambda: receiver.sequences("street") == [1, 2, 3, 4])
    assert receiver.sequences("farm") == []
    lag = eventually(lambda: store.webhooks.lags(webhook.id))[0]
    assert lag.environment == "farm"
    assert lag.attempts.error == "the receiver answered 422"
    eventually(lambda: store.webhooks.count_waiting(store.webhooks.get(webhook.id)) == 61)
    refuses = False
    eventually(lambda: len(receiver.sequences("farm")) == 61)
    promote(store, "farm", 1)
    eventually(lambda: len(receiver.sequences("farm")) == 62)
    assert receiver.sequences("farm") == list(range(1, 63))
    assert store.webhooks.lags(webhook.id) == []


def reset(handler: Any, _: Any) -> None:
    handler.connection.close()


@pytest.mark.parametrize(
    ("answer", "error"),
    [
        (lambda _, __: 500, "answered 500"),
        (lambda _, __: 503, "answered 503"),
        (lambda _, __: 429, "answered 429"),
        (lambda _, __: 307, "redirects are not followed"),
        (reset, "disconnected"),
        (drip, "no response within 0.5 seconds"),
    ],
)
def test_failed_delivery_is_repeated(
    store: Store, receiver: Receiver, start: Any, monkeypatch: pytest.MonkeyPatch, answer: Answer, error: str
) -> None:
    monkeypatch.setattr(outgoing, "SECONDS", 0.5)
    webhook = hook(store, receiver)
    other = Receiver()
    receiver.answer, receiver.headers = answer, {"location": other.url}
    start()
    store.environments.create("farm")
    promote(store, "farm", 2)

    def problem() -> str:
        lags = store.webhooks.lags(webhook.id)
        return (lags[0].attempts.error if lags else store.webhooks.get(webhook.id).attempts.error) or ""

    assert error in eventually(problem)
    receiver.answer, receiver.headers = lambda _, __: 200, {}
    receiver.problems.clear()
    eventually(lambda: len(receiver.sequences("farm")) == 3)
    assert receiver.sequences("farm") == [1, 2, 3]
    ids = {key for key, event, _ in receiver.attempts if event["sequence"] == 1}
    assert len(ids) == 1, "an event has the same id in each attempt"
    stored = eventually(lambda: (w := store.webhooks.get(webhook.id)).delivered and w)
    assert (stored.attempts, store.webhooks.lags(webhook.id)) == (Attempts(), [])
    assert other.attempts == []
    other.close()
    receiver.problems.clear()


def test_endless_response_is_cut_off(store: Store, receiver: Receiver, start: Any) -> None:
    """The status acknowledges the event; the body is of no interest."""
    receiver.answer = flood
    webhook = hook(store, receiver)
    start()
    store.environments.create("farm")
    promote(store, "farm", 1)
    eventually(lambda: store.webhooks.get(webhook.id).position == 2)
    eventually(lambda: len(receiver.attempts) == 2)  # each is counted when its response has been cut off
    receiver.problems.clear()


def test_absent_receiver_gets_all_when_it_comes(store: Store, start: Any) -> None:
    port = free_port()
    webhook = store.webhooks.create(f"http://127.0.0.1:{port}/hook")
    start()
    store.environments.create("farm")
    promote(store, "farm", 70)
    attempts = eventually(lambda: (a := store.webhooks.get(webhook.id).attempts).failures >= 2 and a)
    assert "Connection refused" in str(attempts.error)
    receiver = Receiver(port)
    receiver.secret = webhook.secret
    try:
        eventually(lambda: len(receiver.sequences("farm")) == 71)
        assert receiver.sequences("farm") == list(range(1, 72))
    finally:
        receiver.close()


def test_slow_receiver_delays_no_other(
    store: Store, receiver: Receiver, start: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(outgoing, "SECONDS", 2.0)
    slow = Receiver()
    slow.answer = drip
    store.webhooks.create(slow.url)
    hook(store, receiver)
    start()
    store.environments.create("farm")
    eventually(lambda: receiver.sequences("farm") == [1])
    assert slow.events == []
    slow.close()


def test_another_server_takes_over(store: Store, receiver: Receiver, start: Any) -> None:
    hook(store, receiver)
    first, second = start(), start()
    store.environments.create("farm")
    promote(store, "farm", 5)
    eventually(lambda: len(receiver.sequences("farm")) == 6)
    first.close()
    promote(store, "farm", 5)
    eventually(lambda: len(receiver.sequences("farm")) == 11)
    assert receiver.sequences("farm") == list(range(1, 12)), "one server sends at a time"
    assert second is not first


@pytest.mark.postgres
def test_server_of_another_machine_takes_over(
    postgres_url: str, tmp_path: Path, receiver: Receiver, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its lead is lost, as when its machine has no network: it sends no more, and what it stores is refused."""
    monkeypatch.setattr("app.events.webhooks.FIRST_RETRY_SECONDS", 0.01)
    store = Store(postgres_url, tmp_path / "blobs")
    store.migrate()
    hook(store, receiver)
    folders = [tmp_path / name for name in ("a", "b")]
    leads, senders = [], []
    for folder in folders:
        folder.mkdir()
        leads.append(SharedLeads(postgres_url, folder))
        leads[-1].start()
        senders.append(WebhookSender(store, folder, leads[-1], LOOPBACK))
        senders[-1].start()
        eventually(lambda: any(lead.lead("webhooks").is_held for lead in leads))
    try:
        store.environments.create("farm")
        promote(store, "farm", 30)
        eventually(lambda: len(receiver.sequences("farm")) >= 5)
        leader = next(lead for lead in leads if lead.lead("webhooks").is_held)
        leader.close()
        promote(store, "farm", 10)
        eventually(lambda: set(receiver.sequences("farm")) == set(range(1, 42)))
        assert list(dict.fromkeys(receiver.sequences("farm"))) == list(range(1, 42))
    finally:
        for one in (*senders, *leads):
            one.close()
        store.close()


def test_full_disk_does_not_repeat_deliveries(
    store: Store, receiver: Receiver, start: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("app.events.webhooks.PAUSE_SECONDS", 0.01)
    note, failures = store.webhooks.note_delivered, []

    def full(*args: Any) -> None:
        if len(failures) < 5:
            failures.append(1)
            raise NoRoom("the disk is full")
        note(*args)

    monkeypatch.setattr(store.webhooks, "note_delivered", full)
    webhook = hook(store, receiver)
    start()
    store.environments.create("farm")
    promote(store, "farm", 3)
    eventually(lambda: store.webhooks.get(webhook.id).position == 4)
    assert receiver.sequences("farm") == [1, 2, 3, 4], "each once"
    assert "progress could not be stored" in caplog.text


def test_interrupted_end_of_a_wait_tells_of_no_removed_events(
    store: Store, receiver: Receiver, start: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The server ends right after it has delivered all, of which there were two full pages."""
    monkeypatch.setattr("app.events.webhooks.PAUSE_SECONDS", 0.01)
    monkeypatch.setattr("app.events.webhooks.PAGE", 2)
    end, ended = store.webhooks.end_lag, []

    def interrupted(*args: Any) -> None:
        ended.append(1)
        if len(ended) == 1:
            raise Unavailable("the database is away")
        end(*args)

    monkeypatch.setattr(store.webhooks, "end_lag", interrupted)
    webhook = hook(store, receiver)
    store.environments.create("farm")
    promote(store, "farm", 3)
    lag = Lag(store.environments.get("farm").id, "farm", 0, Attempts())
    store.webhooks.put_lag(webhook.id, 4, lag)
    start()
    eventually(lambda: len(ended) > 1)
    assert set(receiver.sequences("farm")) == {1, 2, 3, 4}
    assert [e["type"] for e in receiver.events if e["type"] == "resync"] == []


def test_server_that_takes_over_a_wait_tells_of_no_removed_events(
    store: Store, receiver: Receiver, start: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.events.webhooks.FIRST_RETRY_SECONDS", 3600.0)
    receiver.answer = lambda _, __: 422
    webhook = hook(store, receiver)
    first = start()
    store.environments.create("farm")
    eventually(lambda: store.webhooks.lags(webhook.id))
    first.close()
    receiver.answer = lambda _, __: 204
    store.webhooks.retry_now(webhook.id)
    start()
    eventually(lambda: not store.webhooks.lags(webhook.id))
    assert receiver.sequences("farm") == [1]
    assert [e["type"] for e in receiver.events if e["type"] == "resync"] == []


def test_removed_events_are_told(store: Store, receiver: Receiver, start: Any) -> None:
    hook(store, receiver)
    for name in ("farm", "street"):
        store.environments.create(name)
    promote(store, "farm", 3)
    with store._database.write() as connection:
        connection.execute(delete(tables.event).where(tables.event.c.environment == "farm"))
    promote(store, "street", 1)
    start()
    eventually(lambda: receiver.sequences("street") == [1, 2])
    hints = [e for e in receiver.events if e["type"] == "resync"]
    assert [hint["positions"] for hint in hints] == [[1, 1], [3, 5]]


def test_waits_grow_and_obey_the_receiver() -> None:
    attempts, waits = Attempts(), []
    for _ in range(40):
        attempts = next_attempts(attempts, Attempt("unreachable", detail="no"))
        assert attempts.next_try is not None
        assert attempts.since is not None
        waits.append((attempts.next_try - attempts.since).total_seconds())
    assert 0.8 <= waits[0] <= 1.0
    assert all(480 <= wait <= 601 for wait in waits[12:])
    asked = next_attempts(Attempts(), Attempt("unreachable", detail="no", retry_after=30))
    assert asked.next_try is not None
    assert asked.since is not None
    assert asked.next_try - asked.since == timedelta(seconds=30)


@pytest.mark.parametrize(
    ("address", "scheme", "word"),
    [
        ("1.1.1.1", "https", None), ("2606:4700::1111", "https", None), ("1.1.1.1", "http", "plain http"),
        ("10.7.0.20", "http", None), ("::ffff:10.7.0.20", "https", None),
        ("127.0.0.1", "https", "public"), ("::1", "https", "public"), ("::ffff:127.0.0.1", "https", "public"),
        ("0.0.0.0", "https", "public"), ("10.8.0.1", "https", "public"), ("192.168.1.1", "https", "public"),
        ("169.254.169.254", "https", "public"), ("fe80::1", "https", "public"), ("fd00:ec2::254", "https", "public"),
        ("100.100.100.200", "https", "public"), ("168.63.129.16", "https", "public"), ("224.0.0.1", "https", "public"),
        ("fec0::1", "https", "public"), ("4000::1", "https", "public"), ("64:ff9b:1::7f00:1", "https", "public"),
        ("::7f00:1", "https", "public"), ("::ffff:0:7f00:1", "https", "public"), ("5f00::1", "https", "public"),
        ("64:ff9b::7f00:1", "https", "public"), ("64:ff9b::a9fe:a9fe", "https", "public"),
        ("2002:7f00:1::", "https", "public"), ("255.255.255.255", "https", "public"), ("::", "https", "public"),
    ],
)  # fmt: skip
def test_only_allowed_addresses_are_reached(address: str, scheme: str, word: str | None) -> None:
    rules = OutgoingRules(networks=(ipaddress.ip_network("10.7.0.0/16"),))
    refusal = rules.refusal(ipaddress.ip_address(address), scheme)
    assert refusal is None if word is None else word in str(refusal)


@pytest.mark.parametrize(
    "url",
    [
        "ftp://example.org/", "https://", "https:///path", "https://user:password@example.org/", "https://example.org/#x",
        "https://example.org:0/", "https://example.org:99999/", "https://exa mple.org/", "https://example.org/\r\nx: y",
        "http://example.org/", "https://127.0.0.1/", "https://[::1]/", "https://169.254.169.254/latest", "x" * 3000,
        "https://[fe80::1%25eth0]/", "https://exämple.org/",
    ],
)  # fmt: skip
def test_bad_addresses_are_refused(url: str) -> None:
    with pytest.raises(Invalid, match="url"):
        check_url(url, OutgoingRules())


def resolve_to(monkeypatch: pytest.MonkeyPatch, *addresses: str) -> list[str]:
    """Let every name have these addresses; return the list of names that are looked up."""
    names: list[str] = []
    literal = socket.getaddrinfo

    def lookup(host: str, port: int, *more: Any, **named: Any) -> list[Any]:
        if not host[-1].isalpha():
            return literal(host, port, *more, **named)
        names.append(host)
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (address, port)) for address in addresses]

    monkeypatch.setattr("app.events.outgoing.socket.getaddrinfo", lookup)
    return names


def post(rules: OutgoingRules, url: str) -> int:
    """Send a request of no meaning; return the status of the response."""
    client = OutgoingClient(rules, url.split(":", maxsplit=1)[0])
    try:
        return client.post(url, {"webhook-id": "1"}, b"{}").status
    finally:
        client.close()


def test_name_of_internal_address_is_refused(receiver: Receiver, monkeypatch: pytest.MonkeyPatch) -> None:
    resolve_to(monkeypatch, "127.0.0.1")
    with pytest.raises(RequestError, match=r"127\.0\.0\.1 is not a public address"):
        post(OutgoingRules(), f"https://hooks.example.org:{receiver.port}/")
    assert receiver.attempts == []


def test_checked_address_is_the_one_that_is_reached(receiver: Receiver, monkeypatch: pytest.MonkeyPatch) -> None:
    """A name is looked up once, and its forbidden addresses are skipped."""
    names = resolve_to(monkeypatch, "10.0.0.1", "127.0.0.1")
    assert post(LOOPBACK, f"http://hooks.example.org:{receiver.port}/") == 204
    assert names == ["hooks.example.org"]


def test_proxies_of_the_environment_are_not_used(receiver: Receiver, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy"):
        monkeypatch.setenv(name, "http://127.0.0.1:1")
    assert post(LOOPBACK, receiver.url) == 204


def test_certificates_are_checked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    authority = Authority(tmp_path)
    receiver = Receiver(certificate=authority.sign("receiver"))
    trusting = OutgoingRules(LOOPBACK.networks, authority.pem)
    try:
        resolve_to(monkeypatch, "127.0.0.1")
        assert post(trusting, receiver.url) == 204
        for rules, url in ((LOOPBACK, receiver.url), (trusting, f"https://hooks.example.org:{receiver.port}/")):
            with pytest.raises(RequestError, match="certificate verify failed"):
                post(rules, url)
        assert len(receiver.attempts) == 1
    finally:
        receiver.close()
