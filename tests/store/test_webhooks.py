"""Webhooks in the store, on both databases: what they keep, and what is refused."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest

from app.errors import Conflict, Invalid, NotFound
from app.store.store import Store
from app.store.webhooks import MAX_WEBHOOKS, Attempts, Lag

URL = "https://hooks.example.org/fleet"


def test_progress_is_kept_and_never_decreases(store: Store) -> None:
    store.environments.create("farm")
    webhook = store.webhooks.create(URL, environments="farm*", types=["channel.moved", "channel.moved"])
    assert (webhook.position, webhook.types, webhook.environments) == (1, ("channel.moved",), "farm*")
    for k in range(4):
        store.channels.move("farm", f"channel-{k}", 0, author="test")
    store.environments.create("street")
    now = datetime.now(UTC)
    assert store.webhooks.count_waiting(webhook) == 4
    failed = Attempts(2, now, now, "x" * 1000)
    store.webhooks.note_failure(webhook.id, 2, failed)
    stored = store.webhooks.get(webhook.id)
    assert (stored.position, stored.attempts.failures, len(str(stored.attempts.error))) == (2, 2, 500)
    store.webhooks.note_delivered(webhook.id, 4, now)
    store.webhooks.note_delivered(webhook.id, 3, None)
    stored = store.webhooks.get(webhook.id)
    assert (stored.position, stored.attempts, stored.delivered) == (4, Attempts(), now)
    farm = store.environments.get("farm")
    lag = Lag(farm.id, "farm", 2, Attempts(1, now, now, "no"))
    store.webhooks.put_lag(webhook.id, 6, lag)
    assert [e.position for e in store.webhooks.lagging_events(lag, 4, 10)] == [3, 4]
    assert store.webhooks.count_waiting(store.webhooks.get(webhook.id)) == 3
    store.webhooks.retry_now(webhook.id)
    assert store.webhooks.lags(webhook.id) == [Lag(farm.id, "farm", 2, Attempts(1, now, None, "no"))]
    store.webhooks.end_lag(webhook.id, 6, lag)
    assert store.webhooks.lags(webhook.id) == []
    store.webhooks.put_lag(webhook.id, 6, lag)
    store.webhooks.delete(webhook.id)
    assert (store.webhooks.all(), store.webhooks.lags(webhook.id)) == ([], [])
    for change in (
        lambda: store.webhooks.delete(webhook.id),
        lambda: store.webhooks.get(webhook.id),
        lambda: store.webhooks.retry_now(webhook.id),
        lambda: store.webhooks.put_lag(webhook.id, 7, lag),
        lambda: store.webhooks.note_delivered(webhook.id, 7, None),
    ):
        with pytest.raises(NotFound, match="unknown webhook"):
            change()


def test_each_relay_has_a_position_of_its_own(store: Store) -> None:
    store.environments.create("farm")
    assert store.events.relay_position("zenoh") == 0
    assert store.events.relay_position("mqtt", from_now=True) == 1
    store.environments.create("street")
    store.events.set_relayed(2, "zenoh")
    store.events.set_relayed(1, "zenoh")
    assert (store.events.relay_position(), store.events.relay_position("mqtt", from_now=True)) == (2, 1)


@pytest.mark.parametrize(
    "secret", ["", "secret", "whsec_", "whsec_c2hvcnQ=", "whsec_" + "A" * 120, "whsec_!" + "A" * 43]
)
def test_weak_secrets_are_refused(sqlite_store: Store, secret: str) -> None:
    with pytest.raises(Invalid, match="secret must be whsec_"):
        sqlite_store.webhooks.create(URL, secret)


def test_unknown_types_and_too_many_webhooks_are_refused(sqlite_store: Store) -> None:
    with pytest.raises(Invalid, match=r"unknown event type 'channel\.move' \(did you mean channel\.moved\?\)"):
        sqlite_store.webhooks.create(URL, types=["channel.move"])
    secrets = {sqlite_store.webhooks.create(URL).secret for _ in range(MAX_WEBHOOKS)}
    assert len(secrets) == MAX_WEBHOOKS
    assert not any(secret in repr(sqlite_store.webhooks.all()) for secret in secrets)
    with pytest.raises(Conflict, match="32 webhooks, the maximum"):
        sqlite_store.webhooks.create(URL)
