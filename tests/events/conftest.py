"""Real Zenoh sessions and routers on loopback."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh
from zenoh import ext

from tests.ports import free_port

if sys.version_info >= (3, 11):  # the server's; the agent's tests run on 3.10, too
    from tests.api.conftest import Api, running, settings_for


def client_config(port: int, **more: Any) -> zenoh.Config:
    config = zenoh.Config()
    values = {
        "mode": "client",
        "connect/endpoints": [f"tcp/127.0.0.1:{port}"],
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
        **more,
    }
    for key, value in values.items():
        config.insert_json5(key, json.dumps(value))
    return config


class Listener:
    """A robot's listener: an advanced subscriber with history and recovery, as `docs/reference/zenoh.md` recommends."""

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self.events: list[dict[str, Any]] = []
        self._news = threading.Condition()
        self.subscriber = ext.declare_advanced_subscriber(
            session,
            key,
            self._take,
            history=ext.HistoryConfig(detect_late_publishers=True),
            recovery=ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
        )

    def _take(self, sample: zenoh.Sample) -> None:
        with self._news:
            self.events.append(json.loads(bytes(sample.payload)))
            self._news.notify_all()

    def sequences(self) -> list[int]:
        """Each sequence once, in the order they first came."""
        return list(dict.fromkeys(e["sequence"] for e in self.events))

    def wait(self, condition: Callable[[Listener], bool], seconds: float = 60.0) -> None:
        with self._news:
            is_met = self._news.wait_for(lambda: condition(self), seconds)
        assert is_met, "received: " + " ".join(str(e["sequence"]) for e in self.events)


def eventually(condition: Callable[[], Any], seconds: float = 60.0) -> Any:
    """Wait until a condition holds and return its value. The longer it takes, the less often it is tried."""
    start = time.monotonic()
    while True:
        value = condition()
        if value:
            return value
        elapsed = time.monotonic() - start
        assert elapsed < seconds, "it did not come about in time"
        time.sleep(min(max(0.02, elapsed / 10), 0.25))


def nothing(*_: Any) -> Any:
    """What nobody asks for."""


def status_payload(n: int, state: str = "active") -> bytes:
    """What a robot says: that it holds version ``n``."""
    body = {"channel": "latest", "version": n, "root": f"{n:064x}", "state": state, "sequence": n}
    return json.dumps(body).encode()


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def api(tmp_path: Path, port: int) -> Iterator[Api]:
    """A server with a router of its own on ``port``."""
    with running(settings_for(tmp_path, zenoh_mode="router", zenoh_listen=f"tcp/127.0.0.1:{port}")) as api:
        eventually(lambda: api.get("/readyz").json()["events"]["state"] == "connected")
        yield api


@pytest.fixture
def session(api: Api, port: int) -> Iterator[zenoh.Session]:
    """A robot's session."""
    new_session = zenoh.open(client_config(port))
    try:
        yield new_session
    finally:
        new_session.close()  # type: ignore[no-untyped-call]
