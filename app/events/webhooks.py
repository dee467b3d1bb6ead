"""Delivery of events to webhooks: signed, in order for each environment, again and again until acknowledged.

One process of all servers sends. Each webhook has a thread while there is something to send, so a slow receiver delays
no other. A receiver that is not reached waits as a whole; one that refuses an event delays only that environment.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import logging
import random
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final, Literal

from app.backends.lead import LeadLostError, Leads, Term
from app.errors import FleetMapError, NotFound
from app.events import messages
from app.events.follower import Follower, pages_after
from app.events.outgoing import OutgoingClient, OutgoingRules, RequestError
from app.store.store import Store
from app.store.values import Event, rfc3339
from app.store.webhooks import MAX_WEBHOOKS, Attempts, Lag, Webhook, secret_key

log = logging.getLogger(__name__)

NAME = "webhooks"

PAGE = 50
"""Events that are delivered between two writes of the position. After a kill, at most so many are delivered again."""

STORE_EVENTS = 10_000
"""Number of skipped events after which the position is stored although none was delivered."""

FIRST_RETRY_SECONDS = 1.0
MAX_RETRY_SECONDS = 600.0
"""Wait after the first failed attempt, which doubles with each further one, and its maximum."""

PAUSE_SECONDS = 2.0
"""Pause after the database failed, so that nothing is sent in a loop whose progress cannot be stored."""

_OVERLOADED: Final = (429, 502, 503, 504)
"""Statuses about the receiver as a whole, not about one event."""

Outcome = Literal["delivered", "refused", "unreachable"]


@dataclass(frozen=True, slots=True)
class Attempt:
    """Result of one attempt. status: of the response, None without one. detail: why it failed."""

    outcome: Outcome
    status: int | None = None
    detail: str | None = None
    retry_after: float | None = None


def message_id(body: bytes) -> str:
    """Return the id of a message: the same in each attempt, from each server."""
    return f"msg_{hashlib.sha256(body).hexdigest()[:32]}"


def signed_headers(secret: str, id: str, timestamp: int, body: bytes) -> dict[str, str]:
    """Return the headers of Standard Webhooks: id, time, and the HMAC-SHA-256 over both and the body."""
    signed = b".".join((id.encode(), str(timestamp).encode(), body))
    signature = base64.b64encode(hmac.digest(secret_key(secret), signed, "sha256")).decode()
    return {"webhook-id": id, "webhook-timestamp": str(timestamp), "webhook-signature": f"v1,{signature}"}


def send(client: OutgoingClient, webhook: Webhook, message: Mapping[str, Any]) -> Attempt:
    """Send a message once."""
    body = messages.dumps(message)
    headers = signed_headers(webhook.secret, message_id(body), int(time.time()), body)
    headers |= {"content-type": messages.JSON, "user-agent": "fleet-map-server"}
    try:
        response = client.post(webhook.url, headers, body)
    except RequestError as error:
        return Attempt("unreachable", detail=str(error))
    status = response.status
    if 200 <= status < 300:
        return Attempt("delivered", status)
    detail = f"the receiver answered {status}"
    if 300 <= status < 400:
        detail += ": redirects are not followed, give the address that it leads to"
    outcome: Outcome = "unreachable" if status in _OVERLOADED or 300 <= status < 400 else "refused"
    return Attempt(outcome, status, detail, response.retry_after)


def send_test(webhook: Webhook, rules: OutgoingRules) -> tuple[Attempt, float]:
    """Send a test message at once; return the attempt and its duration in seconds."""
    client, started = _client(webhook, rules), time.monotonic()
    try:
        attempt = send(client, webhook, {"type": "webhook.test", "webhook": webhook.id, "time": rfc3339(_now())})
    finally:
        client.close()
    return attempt, time.monotonic() - started


def _client(webhook: Webhook, rules: OutgoingRules) -> OutgoingClient:
    return OutgoingClient(rules, webhook.url.split(":", maxsplit=1)[0])


def _now() -> datetime:
    return datetime.now(UTC)


def next_attempts(before: Attempts, attempt: Attempt) -> Attempts:
    """Return the state after another failed attempt, with the time of the next one."""
    seconds = min(MAX_RETRY_SECONDS, FIRST_RETRY_SECONDS * 2 ** min(before.failures, 30))
    seconds *= random.uniform(0.8, 1.0)  # noqa: S311  so that receivers of many servers are not asked at once
    if attempt.retry_after is not None:
        seconds = max(seconds, min(attempt.retry_after, MAX_RETRY_SECONDS))
    now = _now()
    return Attempts(before.failures + 1, before.since or now, now + timedelta(seconds=seconds), attempt.detail)


class WebhookSender(Follower):
    """Thread that finds webhooks with something to send, and lets a courier send it."""

    interval_seconds = 0.05

    def __init__(self, store: Store, data_dir: Path, leads: Leads, rules: OutgoingRules) -> None:
        super().__init__(store, data_dir, NAME, leads, well="webhooks: this server sends", trouble="webhooks: down")
        self._rules = rules
        self._couriers: dict[str, Courier] = {}
        self._working: dict[str, Future[None]] = {}
        self._threads = ThreadPoolExecutor(MAX_WEBHOOKS, thread_name_prefix="fleetmap-webhook")

    def _hand_over(self) -> bool:
        self._working = {key: future for key, future in self._working.items() if not future.done()}
        webhooks = {webhook.id: webhook for webhook in self._store.webhooks.all()}
        last = self._store.events.last_position() if webhooks else 0
        for key in self._couriers.keys() - webhooks.keys() - self._working.keys():
            self._couriers.pop(key).close()
        for key, webhook in webhooks.items():
            if key in self._working:
                continue
            if key not in self._couriers:
                self._couriers[key] = Courier(self._store, self._rules, webhook)
            if self._couriers[key].is_due(webhook, last):
                self._working[key] = self._threads.submit(self._couriers[key].run, self._term, self._stopping.is_set)
                self._working[key].add_done_callback(lambda _: self._wake())
        self._publish_state({"state": "connected", "leader": True})
        return False

    def _has_more(self) -> bool:
        return any(future.done() for future in self._working.values())

    def _stand_by(self) -> None:
        """Forget positions, since another server sends from now on."""
        if not self._working:
            self._release_couriers()
        self._working = {key: future for key, future in self._working.items() if not future.done()}
        super()._stand_by()

    def _release_couriers(self) -> None:
        while self._couriers:
            self._couriers.popitem()[1].close()

    def _release(self) -> None:
        self._threads.shutdown(wait=True, cancel_futures=True)
        self._release_couriers()


class Courier:
    """Delivery to one webhook. Its position in memory may be ahead of the stored one, which it never falls behind.

    So neither a filter that skips all events nor a full disk makes it write or send again and again.
    """

    def __init__(self, store: Store, rules: OutgoingRules, webhook: Webhook) -> None:
        self._store, self._webhook = store, webhook
        self._client = _client(webhook, rules)
        self._position = self._stored = webhook.position
        self._delivered: datetime | None = None
        self._attempts = webhook.attempts
        self._lags: dict[str, Lag] = {}
        self._pause_until = 0.0
        self._is_ending: Callable[[], bool] = lambda: False

    def close(self) -> None:
        """Close the connection."""
        self._client.close()

    def is_due(self, webhook: Webhook, last: int) -> bool:
        """Test if there is something to send now, as of the newest position of the log. Takes over the stored state."""
        self._webhook = webhook
        self._position = max(self._position, webhook.position)
        if time.monotonic() < self._pause_until:
            return False
        self._attempts = webhook.attempts
        if not _is_time(self._attempts):
            return False
        self._lags = {lag.environment_id: lag for lag in self._store.webhooks.lags(webhook.id)}
        is_stored = self._delivered is None
        return not is_stored or last > self._position or any(_is_time(lag.attempts) for lag in self._lags.values())

    def run(self, term: Term, is_stopping: Callable[[], bool]) -> None:
        """Send what there is, until ``is_stopping()`` or the end of the term. Logs errors: the next call continues."""
        self._is_ending = lambda: is_stopping() or not term.goes_on
        try:
            with term.fenced():
                if self._delivered is not None:  # the last attempt to store it failed
                    self._store_position()
                for lag in [lag for lag in self._lags.values() if _is_time(lag.attempts)]:
                    if self._is_ending() or not self._catch_up(lag):
                        return
                self._follow()
        except (LeadLostError, NotFound):  # another server sends, or the webhook was deleted
            pass
        except FleetMapError as error:
            self._pause_until = time.monotonic() + PAUSE_SECONDS
            log.warning("webhooks: progress could not be stored, will retry (webhook=%s): %s", self._id, error.detail)
        except Exception:
            self._pause_until = time.monotonic() + PAUSE_SECONDS
            log.exception("webhooks: internal error, will retry (webhook=%s)", self._id)

    @property
    def _id(self) -> str:
        return self._webhook.id

    def _follow(self) -> None:
        """Deliver the events after the position, except those of environments that lag."""
        last = self._store.events.last_position()
        for page in pages_after(self._store, self._position, self._is_ending, PAGE):
            for event in page:
                if self._is_ending() or not self._deliver(event):
                    self._store_position()
                    return
            self._store_position()
        if not self._is_ending() and last > self._position and self._send_resync(None, self._position + 1, last):
            self._position = last
            self._store_position()

    def _deliver(self, event: Event) -> bool:
        """Deliver an event, or skip it; return whether to go on."""
        if event.position > self._position + 1 and not self._send_resync(None, self._position + 1, event.position - 1):
            return False
        if event.environment_id not in self._lags and self._wants(event):
            attempt = send(self._client, self._webhook, event.body)
            if attempt.outcome == "unreachable":
                self._position = event.position - 1
                self._fail(attempt)
                return False
            if attempt.outcome == "refused":
                lag = Lag(event.environment_id, event.environment, event.position - 1, Attempts())
                self._put_lag(lag, attempt, event.position)
            else:
                self._delivered = _now()
        self._position = event.position
        return True

    def _catch_up(self, lag: Lag) -> bool:
        """Deliver the events of an environment that waits; return False to stop, since the receiver is not reached."""
        start = lag.position
        while events := self._store.webhooks.lagging_events(lag, self._position, PAGE):
            if lag.position != start:  # else, or if these were the last, the next process would find none to deliver
                self._store.webhooks.put_lag(self._id, self._position, lag)
            for event in events:
                if self._is_ending():
                    self._store.webhooks.put_lag(self._id, self._position, lag)
                    return False
                if self._wants(event):
                    attempt = send(self._client, self._webhook, event.body)
                    if attempt.outcome != "delivered":
                        return self._stop_catching_up(lag, attempt)
                    self._delivered = _now()
                lag = Lag(lag.environment_id, lag.environment, event.position, Attempts())
        # It waits for at least one event: if there is none any more, it was removed with its environment.
        if lag.position == start and not self._send_resync(lag.environment, lag.position + 1, self._position):
            return False
        self._store.webhooks.end_lag(self._id, self._position, lag)
        del self._lags[lag.environment_id]
        self._store_position()
        return True

    def _stop_catching_up(self, lag: Lag, attempt: Attempt) -> bool:
        """Store how far an environment is; return False if the receiver is not reached."""
        if attempt.outcome == "refused":
            self._put_lag(lag, attempt, self._position)
            return True
        self._store.webhooks.put_lag(self._id, self._position, lag)
        self._fail(attempt)
        return False

    def _wants(self, event: Event) -> bool:
        return self._webhook.wants(event.environment, str(event.body["type"]))

    def _send_resync(self, environment: str | None, first: int, last: int) -> bool:
        """Tell that events were removed before they could be delivered; return whether the receiver knows."""
        body = {"type": "resync", "environment": environment, "positions": [first, last], "webhook": self._id}
        attempt = send(self._client, self._webhook, body)
        if attempt.outcome != "delivered":
            self._fail(attempt)
            return False
        self._delivered = _now()
        return True

    def _put_lag(self, lag: Lag, attempt: Attempt, position: int) -> None:
        """Store that an environment has to wait. position: up to which the others' events were delivered."""
        attempts = next_attempts(lag.attempts, attempt)
        waiting = Lag(lag.environment_id, lag.environment, lag.position, attempts)
        self._store.webhooks.put_lag(self._id, position, waiting)
        self._lags[lag.environment_id] = waiting
        if attempts.failures == 1:
            log.warning("webhooks: refused (webhook=%s, environment=%s): %s", self._id, lag.environment, attempt.detail)

    def _fail(self, attempt: Attempt) -> None:
        """Store that the receiver as a whole has to wait, and what was delivered before."""
        self._store_position()
        self._attempts = next_attempts(self._attempts, attempt)
        if self._attempts.failures == 1:
            log.warning("webhooks: not delivered, will retry (webhook=%s): %s", self._id, attempt.detail)
        self._store.webhooks.note_failure(self._id, self._position, self._attempts)
        self._stored = self._position

    def _store_position(self) -> None:
        """Store the position if an event was delivered, or many were skipped."""
        if self._delivered is None and self._position - self._stored < STORE_EVENTS:
            return
        self._store.webhooks.note_delivered(self._id, self._position, self._delivered)
        if self._delivered is not None and self._attempts.failures:
            log.info("webhooks: delivered again (webhook=%s, failures=%d)", self._id, self._attempts.failures)
            self._attempts = Attempts()
        self._stored, self._delivered = self._position, None


def _is_time(attempts: Attempts) -> bool:
    return attempts.next_try is None or attempts.next_try <= _now()
