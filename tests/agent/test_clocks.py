"""Robots with a clock that is wrong by a minute: following, planned moves, expiry."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest

from app.agent.agent import Agent, AgentOptions
from app.signing import Keys
from tests.agent.conftest import Gate, network, whole
from tests.agent.test_attacks import signed
from tests.api.conftest import ADMIN, Api
from tests.events.conftest import eventually

Make = Callable[[float], Agent]


@pytest.fixture
def agent(place: str, gate: Gate, tmp_path: Path) -> Iterator[Make]:
    """An agent in this process, whose clock is so many seconds fast."""
    agents: list[Agent] = []

    def make(fast: float) -> Agent:
        options = AgentOptions(gate.url, place, ("tmap2",), tmp_path / "robot", token=ADMIN, robot="robot")
        one = Agent(options, lambda *_, **__: None, clock=lambda: time.time() + fast)
        one.open()
        agents.append(one)
        return one

    yield make
    for one in agents:
        one.close()


@pytest.mark.parametrize("fast", [-60.0, 60.0])
def test_activation_follows_server_time(
    api: Api, place: str, agent: Make, gate: Gate, tmp_path: Path, fast: float
) -> None:
    channel = f"environments/{place}/channels/production"
    api("PUT", channel, 200, json={"version": 1})
    one = agent(fast)
    assert one.run_once()
    api.upload(place, {"n.tmap2.yaml": network(1)})
    at = datetime.now(timezone.utc) + timedelta(seconds=4)
    api("PUT", channel, 200, json={"version": 2, "activate_at": at.isoformat()})
    assert one.run_once()
    assert gate.statuses[-1]["state"] == "ready"
    assert whole(tmp_path / "robot")["version"] == 1, "not by the robot's clock"
    eventually(lambda: _stands(api, channel) == 2)
    assert datetime.now(timezone.utc) >= at
    assert one.run_once()
    assert whole(tmp_path / "robot")["version"] == 2
    status = api.get(f"robots/robot?environment={place}").json()
    assert status["online"]
    assert status["lag"]["events"] == 0
    robot_time, received = datetime.fromisoformat(status["time"]), datetime.fromisoformat(status["received"])
    assert abs((robot_time - received).total_seconds() - fast) < 30, "the robot's clock shows, and decides nothing"


def _stands(api: Api, channel: str) -> Any:
    listed = api.get(channel.rpartition("/")[0]).json()
    return next(c["version"] for c in listed if c["channel"] == "production")


@pytest.mark.parametrize(("fast", "good"), [(-60.0, True), (50.0, True), (100.0, False)])
def test_expiry_allows_for_a_minute(
    place: str, agent: Make, gate: Gate, api: Api, folder: Path, tmp_path: Path, fast: float, good: bool
) -> None:
    api.get("keys")
    soon = (datetime.now(timezone.utc) + timedelta(seconds=20)).isoformat()
    gate.change = signed(Keys(folder / "keys"), expires=soon)
    assert agent(fast).run_once() is good
    assert (tmp_path / "robot" / "current").exists() is good
