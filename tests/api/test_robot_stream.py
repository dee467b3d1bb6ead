"""Changes of robots in streams of events."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Any

import httpx
import pytest

from app.api.robot_feed import RobotFeed, RobotSubscription
from app.store.fleet_values import ReceivedReport, RobotReport
from app.store.robots import Robots
from tests.api import samples
from tests.api.conftest import API, Api

ROOT = "5" * 64


def messages(answer: httpx.Response) -> Iterator[dict[str, str]]:
    fields: dict[str, str] = {}
    for line in answer.iter_lines():
        if not line:
            if "data" in fields:
                yield fields
            fields = {}
        elif not line.startswith(":"):
            name, _, value = line.partition(": ")
            fields[name] = value


def report(api: Api, env: str, robot: str, **more: Any) -> None:
    body = {"environment": env, "channel": "latest", "version": 1, "root": ROOT, "state": "active", **more}
    api("PUT", f"robots/{robot}/status", 200, json=body)


def test_stream_has_changes_of_robots_between_events(api: Api, bare: str) -> None:
    report(api, bare, "mower-1")
    with api.http.stream("GET", f"{API}/events", params={"environment": bare, "robots": "true"}, timeout=30) as answer:
        following = messages(answer)
        report(api, bare, "mower-2", state="downloading", detail="12 of 40 MB")
        message = next(following)
        assert message["event"] == "robot.status"
        assert "id" not in message
        listed = api.get(f"robots?environment={bare}").json()
        assert json.loads(message["data"]) == listed[1], "mower-1 has not changed"
        api.upload(bare, samples.grid())
        kinds: dict[str, list[dict[str, str]]] = {"version.created": [], "robot.status": []}
        while len(kinds["robot.status"]) < 2:  # the head has moved, so both lag
            message = next(following)
            kinds[message["event"]].append(message)
    assert [m["id"] for m in kinds["version.created"]] == ["2"]
    lags = {b["robot"]: b["lag"]["events"] for b in (json.loads(m["data"]) for m in kinds["robot.status"])}
    assert lags == {"mower-1": 1, "mower-2": 1}


def test_a_robot_is_sent_once_a_second_with_its_newest_status(api: Api, bare: str) -> None:
    """The first change is sent at once, later ones together."""
    with api.http.stream("GET", f"{API}/events", params={"environment": bare, "robots": "true"}, timeout=30) as answer:
        following = messages(answer)
        begun = time.monotonic()
        for version in range(1, 31):
            report(api, bare, "mower", version=version)
        versions = [json.loads(next(following)["data"])["version"]]
        while versions[-1] < 30:
            versions.append(json.loads(next(following)["data"])["version"])
        elapsed = time.monotonic() - begun
    assert versions == sorted(set(versions))
    assert len(versions) <= elapsed + 1


def test_a_fleet_arrives_within_a_second(api: Api, bare: str) -> None:
    fleet = [f"mower-{number:03}" for number in range(500)]
    status = RobotReport("latest", 1, ROOT, "active")
    reports = [ReceivedReport(bare, robot, status, datetime.now(UTC)) for robot in fleet]
    with api.http.stream("GET", f"{API}/events", params={"environment": bare, "robots": "true"}, timeout=60) as answer:
        following = messages(answer)
        assert api.app.state.services.store.robots.note_reports(reports) == [None] * len(fleet)
        begun = time.monotonic()
        pending = set(fleet)
        while pending:
            pending.discard(json.loads(next(following)["data"])["robot"])
        print(f"500 robots after {time.monotonic() - begun:.2f} s")
        assert time.monotonic() - begun < 60.0  # 0.4 s on a quiet machine; one a second would take 500 s


def test_streams_of_all_environments_have_the_robots_of_the_token(api: Api, fresh: Any) -> None:
    ours, theirs = fresh(), fresh()
    for name in (ours, theirs):
        api.post("environments", {"name": name})
    viewer = api.token_for("viewer", environments=ours)
    with viewer.http.stream("GET", f"{API}/events", params={"robots": "true"}, timeout=30) as answer:
        following = messages(answer)
        report(api, theirs, "mower")
        report(api, ours, "mower")
        assert json.loads(next(following)["data"])["environment"] == ours
    assert viewer.get(f"events?environment={theirs}&robots=true", expect=None).status_code == 403


def test_streams_of_an_environment_share_reads_and_others_cost_none(
    api: Api, bare: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    reads: list[str | None] = []
    received_since = Robots.received_since

    def counted(self: Robots, environment: str | None, since: Any) -> Any:
        reads.append(environment)
        return received_since(self, environment, since)

    monkeypatch.setattr(Robots, "received_since", counted)
    follow = {"environment": bare}
    with api.http.stream("GET", f"{API}/events", params=follow, timeout=30):
        time.sleep(1)
    assert bare not in reads
    client = api.as_(api.token)
    with (
        client.http.stream("GET", f"{API}/events", params={**follow, "robots": "true"}) as one,
        client.http.stream("GET", f"{API}/events", params={**follow, "robots": "true"}) as other,
    ):
        for following in (messages(one), messages(other)):
            report(api, bare, "mower", version=len(reads) + 1)
            assert next(following)["event"] == "robot.status"
        reads.clear()
        time.sleep(1)
        assert reads.count(bare) <= 6
    feed: RobotFeed = api.app.state.feed.robots
    deadline = time.monotonic() + 30
    while feed._watches[bare].is_running:
        assert time.monotonic() < deadline, "reading goes on without streams"
        time.sleep(0.1)


def test_a_slow_stream_keeps_only_the_newest_status_of_a_robot() -> None:
    class Anyone:
        def can_access(self, environment: str) -> bool:
            return environment == "orchard"

    subscription = RobotSubscription()
    for line in (b"1", b"2"):
        subscription.add({("orchard", "mower"): line, ("secret", "mower"): b"x"})
    assert subscription.take(Anyone()) == b"2"  # type: ignore[arg-type]
    assert subscription.take(Anyone()) == b""  # type: ignore[arg-type]


def test_changes_cannot_be_read_from_the_log(api: Api, bare: str) -> None:
    problem = api.problem("GET", f"events?environment={bare}&follow=false&robots=true", 422)
    assert "robots=true excludes follow=false" in problem["detail"]
    assert api.get("events?environment=nowhere&robots=true", expect=None).status_code == 404
