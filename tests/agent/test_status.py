"""When the reporter sends a status, and when it counts as sent."""

from __future__ import annotations

import threading
from typing import Any

import pytest

from app.agent import status as status_module
from app.agent.status import StatusReporter
from app.errors import Denied, FleetMapError, Unavailable
from app.events.messages import RobotStatus

STATUS = RobotStatus("production", 1, "0" * 64, "active", None, "2026-01-01T00:00:00Z", 1, None, None)


class Server:
    """Stands for the client of the server: answers with the errors in turn, then accepts."""

    def __init__(self, *errors: FleetMapError) -> None:
        self.errors = list(errors)
        self.sent: list[dict[str, Any]] = []

    def put_status(self, robot: str, body: dict[str, Any]) -> None:
        if self.errors:
            raise self.errors.pop(0)
        self.sent.append(body)


class Router:
    """Stands for a router that is connected."""

    connected = True

    def put_status(self, status: RobotStatus) -> bool:
        return True


@pytest.mark.parametrize("error", [Denied("no access to farm yet"), Unavailable("no connection")])
def test_status_that_the_server_did_not_take_is_confirmed_later(
    error: FleetMapError, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So a robot counts in roll-outs as soon as its token is given access."""
    now = [1000.0]
    monkeypatch.setattr(status_module.time, "monotonic", lambda: now[0])
    server, refused = Server(error), list[str]()
    client: Any = server
    reporter = StatusReporter("farm", "r1", client, threading.Event(), refused.append)
    reporter.bus = Router()
    reporter.set(STATUS)
    reporter.send()
    assert reporter.confirm_at is not None
    now[0] = reporter.confirm_at
    reporter.send()
    assert (server.sent, len(refused)) == ([], int(isinstance(error, Denied)))
    assert reporter.confirm_at == now[0] + status_module.CONFIRM_SECONDS
    now[0] = reporter.confirm_at
    reporter.send()
    assert len(server.sent) == 1
    assert reporter.confirm_at is None
    now[0] += 1000.0
    reporter.send()
    assert len(server.sent) == 1, "confirmed once"
