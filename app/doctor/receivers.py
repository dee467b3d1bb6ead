"""Checks of those that events are sent to besides Zenoh: the MQTT broker and webhooks."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import timedelta
from urllib.parse import urlsplit

from app.doctor.registry import Finding, check, error, ok, warning
from app.doctor.site import Site
from app.main import mqtt_broker
from app.store.webhooks import Webhook

BRIEF = timedelta(minutes=10)
"""Duration of a failure up to which a receiver may be restarting."""


@check
def mqtt(site: Site) -> Iterator[Finding]:
    """Log in to the MQTT broker as the server does, without publishing anything."""
    broker = mqtt_broker(site.settings)
    if broker is None:
        yield ok("no MQTT broker is set")
        return
    try:
        is_connected, state = broker.ensure_connected(), broker.state
    finally:
        broker.close()
    place = f"{broker.options.host} port {broker.options.port} (FLEETMAP_MQTT_URL)"
    if is_connected:
        yield ok("accepts the server's login", place)
    else:
        advice = "start the broker; check address, user, password and FLEETMAP_MQTT_CA"
        yield error(state["detail"], place, advice)


@check
def webhooks(site: Site) -> Iterator[Finding]:
    """Look which webhooks do not get their events, by the server's last attempts."""
    if not site.has_database:
        yield ok("not checked without a database")
        return
    store = site.store.webhooks
    registered = store.all()
    failing = 0
    for webhook in registered:
        attempts = [webhook.attempts, *(lag.attempts for lag in store.lags(webhook.id))]
        failed = [a for a in attempts if a.since is not None and site.now() - a.since > BRIEF]
        if not failed:
            continue
        failing += 1
        since = min(a.since for a in failed if a.since is not None)
        detail = f"{store.count_waiting(webhook)} events wait since {since:%Y-%m-%d %H:%M} UTC: {failed[0].error}"
        advice = f"repair the receiver, then `fleetmap webhooks test {webhook.id}`; if it is gone for good: "
        yield warning(detail, _place(webhook), f"{advice}`fleetmap webhooks delete {webhook.id}`")
    if not failing:
        yield ok(f"{len(registered)} webhooks, and none fails")


def _place(webhook: Webhook) -> str:
    """Return a webhook's address without its path, which may be a secret."""
    parts = urlsplit(webhook.url)
    return f"webhook {webhook.id}, {parts.scheme}://{parts.netloc.rpartition('@')[2]}"
