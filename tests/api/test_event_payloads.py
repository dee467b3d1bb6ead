"""Documented payloads have the same members, of the same types, as those that the server sends."""

from __future__ import annotations

import json
import time
from typing import Any

from app.event_types import EVENT_TYPES, describe
from tests.api.conftest import Api

OF_ALL = frozenset(
    ("sequence", "type", "environment", "version", "root", "previous", "layers", "message", "author", "time")
)


def shape(value: Any) -> Any:
    """Return the members of a JSON value and their types; for a list, the shape of its first item."""
    if isinstance(value, dict):
        return {name: shape(member) for name, member in value.items()}
    if isinstance(value, list):
        return [shape(member) for member in value[:1]]
    return type(value).__name__


def happened(api: Api, env: str) -> dict[str, dict[str, Any]]:
    """Cause one event of each type, and return the events."""
    channel, overlays = f"environments/{env}/channels/production", f"environments/{env}/overlays"
    api("PUT", channel, 200, json={"version": 2})
    api("PUT", channel, 200, json={"version": 3, "rollout": {"ready": 0.9, "failed": 0.2}})
    api("DELETE", f"{channel}/planned")
    report = {"kind": "blocked", "edge": "gate_barn", "detail": "a fallen tree"}
    for step in ("accept", "reject"):
        one = api.post(overlays, report).json()["id"]
        api.post(f"{overlays}/{one}/{step}", expect=200)
        if step == "accept":
            api.post(f"{overlays}/{one}/end", expect=200)
    api.post(overlays, {**report, "ttl_seconds": 1})
    deadline = time.monotonic() + 60
    while not api.get(f"{overlays}?state=expired").json():
        assert time.monotonic() < deadline
        time.sleep(0.1)
    api("DELETE", f"environments/{env}")
    lines = api.get(f"events?environment={env}&since=0&follow=false").text.splitlines()
    events = [json.loads(line[5:]) for line in lines if line.startswith("data:")]
    return {event["type"]: event for event in events}


def test_documented_payloads_match_sent_events(api: Api, farm: str) -> None:
    sent = happened(api, farm)
    assert sorted(sent) == sorted(EVENT_TYPES)
    for kind, event in sent.items():
        assert event.keys() >= OF_ALL
        documented = describe(kind)[1]
        compared = {name: value for name, value in event.items() if name not in OF_ALL or name in documented}
        assert shape(documented) == shape(compared), f"{kind}: the server sends {json.dumps(event)}"
