"""Robots on the bus: their statuses and their liveliness reach GET /robots."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
import zenoh

from app.backends.lead import LocalLead
from app.errors import Unavailable
from app.events.messages import RobotStatus
from app.fleet import ReportQueue
from app.fleet.report_queue import report_from_status
from app.store.fleet_values import ReceivedReport
from app.store.store import Store
from tests.api import samples
from tests.api.conftest import Api
from tests.events.conftest import client_config, eventually, status_payload
from tests.events.test_relay import router_of


def robot_of(api: Api, name: str) -> Any:
    answer = api.get(f"robots/{name}", expect=None)
    return answer.json() if answer.status_code == 200 else None


def test_statuses_come_in_order(api: Api, session: zenoh.Session) -> None:
    api.post("environments", {"name": "farm"})
    for n in range(150):
        session.put("fleetmap/farm/robots/r1/status", status_payload(n, "downloading" if n % 2 else "active"))
    session.put("fleetmap/farm/robots/r1/status", b"{}")
    session.put("fleetmap/nowhere/robots/r1/status", status_payload(1))
    session.put("fleetmap/farm/robots/r2/status", status_payload(7))
    eventually(lambda: robot_of(api, "r2"))
    robot = eventually(lambda: (r := robot_of(api, "r1")) and r["version"] == 149 and r)
    assert robot["holds"]["version"] == 148
    history = api.get("robots/r1?limit=200").json()["history"]
    assert [h["sequence"] for h in history] == list(range(149, -1, -1))
    assert [r["robot"] for r in api.get("robots?environment=farm").json()] == ["r1", "r2"]


def test_forged_robots_on_open_router_do_not_count_in_rollout(api: Api, session: zenoh.Session) -> None:
    api.post("environments", {"name": "farm"})
    for k in range(2):
        api.upload("farm", {"n.tmap2.yaml": samples.tmap2({"gate": (float(k), 0.0), "barn": (10.0, 0.0)})})
    roots = [api.get(f"environments/farm/versions/{v}").json()["root"] for v in range(3)]
    url = "environments/farm/channels/production"
    api("PUT", url, 200, json={"version": 1})

    def status(version: int, state: str) -> dict[str, Any]:
        return {"channel": "production", "version": version, "root": roots[version], "state": state}

    def on_bus(robot: str, version: int, state: str) -> None:
        session.put(f"fleetmap/farm/robots/{robot}/status", json.dumps(status(version, state)).encode())
        eventually(lambda: (r := robot_of(api, robot)) and (r["version"], r["state"]) == (version, state))

    mower = api.token_for("robot", name="mower")
    mower("PUT", "robots/mower/status", 200, json={"environment": "farm", **status(1, "active")})
    for k in range(4):
        on_bus(f"ghost-{k}", 1, "active")
    api("PUT", url, 200, json={"version": 2, "rollout": {"ready": 1, "failed": 0.5}})
    for k in range(4):
        on_bus(f"ghost-{k}", 2, "failed" if k else "ready")
    assert {r["robot"]: r["vouched"] for r in api.get("robots?environment=farm").json()} == {
        "mower": True, **{f"ghost-{k}": False for k in range(4)},
    }  # fmt: skip
    time.sleep(2.5)  # the roll-out is looked at each second
    channel = api.get("environments/farm/channels").json()[-1]
    assert (channel["version"], channel["rollout"]["state"]) == (1, "waiting")
    assert (channel["robots"]["total"], channel["robots"]["ready"]) == (5, 0)
    on_bus("mower", 2, "ready")  # it counts for good, also with what it says on the bus
    eventually(lambda: api.get("environments/farm/channels").json()[-1]["version"] == 2)


def test_liveliness_sets_presence(api: Api, port: int) -> None:
    api.post("environments", {"name": "farm"})
    robot = zenoh.open(client_config(port))
    try:
        token = robot.liveliness().declare_token("fleetmap/robots/r1")
        robot.put("fleetmap/farm/robots/r1/status", status_payload(1))
        assert eventually(lambda: (r := robot_of(api, "r1")) and r["online"])
        token.undeclare()  # type: ignore[no-untyped-call]
        assert eventually(lambda: not robot_of(api, "r1")["online"])
        token = robot.liveliness().declare_token("fleetmap/robots/r1")
        assert eventually(lambda: robot_of(api, "r1")["online"])
    finally:
        robot.close()  # type: ignore[no-untyped-call]
    assert eventually(lambda: not robot_of(api, "r1")["online"])


def test_robot_lost_with_router_is_offline(api: Api, port: int) -> None:
    api.post("environments", {"name": "farm"})
    tokens = []
    stays, leaves = zenoh.open(client_config(port)), zenoh.open(client_config(port))
    try:
        for name, session in (("stays", stays), ("leaves", leaves)):
            tokens.append(session.liveliness().declare_token(f"fleetmap/robots/{name}"))
            session.put(f"fleetmap/farm/robots/{name}/status", status_payload(1))
            assert eventually(lambda name=name: (r := robot_of(api, name)) and r["online"])
        os.kill(router_of(api), signal.SIGKILL)
        leaves.close()  # type: ignore[no-untyped-call]
        assert eventually(lambda: not robot_of(api, "leaves")["online"])
        assert eventually(lambda: robot_of(api, "stays")["online"])
    finally:
        stays.close()  # type: ignore[no-untyped-call]


@pytest.fixture
def lead(tmp_path: Path) -> Iterator[LocalLead]:
    """The lead of the process that stores reports from Zenoh."""
    new_lead = LocalLead(tmp_path, "reports")
    assert new_lead.try_acquire()
    yield new_lead
    new_lead.release()


def test_reports_wait_while_database_is_unavailable(api: Api, lead: LocalLead, monkeypatch: pytest.MonkeyPatch) -> None:
    store: Store = api.app.state.services.store
    store.environments.create("farm")
    note, calls = store.robots.note_reports, []

    def away(batch: Any) -> Any:
        calls.append(len(batch))
        if len(calls) < 3:
            raise Unavailable("away")
        return note(batch)

    monkeypatch.setattr(store.robots, "note_reports", away)
    intake = ReportQueue(store, lead)
    intake.start()
    intake.enqueue_status("farm", "r1", status_payload(1))
    intake.enqueue_status("farm", "r1", status_payload(2))
    eventually(lambda: len(store.robots.history("farm", "r1")) == 2)
    assert len(calls) >= 3
    intake.enqueue_status("farm", "r1", status_payload(3))
    intake.close()
    assert [r.version for _, r in store.robots.history("farm", "r1")] == [3, 2, 1], "what waits is written at the end"


def test_dropped_reports_are_logged(
    api: Api, lead: LocalLead, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("app.fleet.report_queue.QUEUE_SIZE", 2)
    store: Store = api.app.state.services.store
    store.environments.create("farm")
    intake = ReportQueue(store, lead)
    for n in range(5):
        intake.enqueue_status("farm", "r1", status_payload(n))
    intake.start()
    intake.close()
    assert [r.version for _, r in store.robots.history("farm", "r1")] == [1, 0]
    assert "robot reports: dropped 3," in caplog.text


def test_flooding_robot_displaces_no_other(
    api: Api, lead: LocalLead, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("app.fleet.report_queue.MAX_QUEUED_PER_ROBOT", 3)
    monkeypatch.setattr("app.fleet.report_queue.QUEUE_SIZE", 20)
    store: Store = api.app.state.services.store
    store.environments.create("farm")
    intake = ReportQueue(store, lead)
    for n in range(100):
        intake.enqueue_status("farm", "loud", status_payload(n))
        intake.enqueue_status("nowhere", "lost", status_payload(n))
    for n in range(3):
        intake.enqueue_status("farm", "calm", status_payload(n))
    intake.start()
    eventually(lambda: len(store.robots.history("farm", "calm")) == 3)
    assert [r.version for _, r in store.robots.history("farm", "loud")] == [2, 1, 0]
    assert "robot reports: dropped 194," in caplog.text
    eventually(lambda: "dropped one of lost" in caplog.text)  # after the others are stored
    assert caplog.text.count("dropped one of lost") == 1, "one line for all three"
    assert "(and 2 others)" in caplog.text
    intake.enqueue_status("farm", "loud", status_payload(7))
    intake.close()
    assert [r.version for _, r in store.robots.history("farm", "loud")] == [7, 2, 1, 0], (
        "quiet again: its report is stored"
    )


def test_invalid_reports_do_not_delay_presence_refresh(
    api: Api, lead: LocalLead, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Who was there stays there while somebody else never stops."""
    monkeypatch.setattr("app.fleet.report_queue.PRESENCE_REFRESH_SECONDS", 0.2)
    store: Store = api.app.state.services.store
    intake, renewed, stop = ReportQueue(store, lead), [], threading.Event()
    monkeypatch.setattr("app.fleet.report_queue.SETTLE_SECONDS", 0.0)
    monkeypatch.setattr(store.robots, "renew_presence", renewed.append)
    intake.set_presence("calm", on_bus=True)

    def shout() -> None:
        while not stop.is_set():
            intake.enqueue_status("farm", "loud", b"nonsense")

    loud = threading.Thread(target=shout)
    loud.start()
    intake.start()
    try:
        eventually(lambda: len(renewed) > 3)
    finally:
        stop.set()
        loud.join()
        intake.close()
    assert store.robots.present_robots() == {"calm"}
    lines = [r for r in caplog.records if "must be a JSON object" in r.getMessage()]
    assert "others)" in caplog.text
    assert lines


def test_reports_are_stored_by_the_leader_only_and_by_its_successor(api: Api, lead: LocalLead, tmp_path: Path) -> None:
    store: Store = api.app.state.services.store
    store.environments.create("farm")
    successor = LocalLead(tmp_path, "reports")
    intakes = [ReportQueue(store, one) for one in (lead, successor)]
    for intake in intakes:
        intake.start()

    def publish(number: int) -> None:
        for intake in intakes:
            intake.enqueue_status("farm", "r1", status_payload(number))

    try:
        publish(1)
        eventually(lambda: len(store.robots.history("farm", "r1")) == 1)
        lead.release()
        publish(2)
        threading.Event().wait(0.3)
        assert len(store.robots.history("farm", "r1")) == 1, "nobody leads"
        assert successor.try_acquire()
        eventually(lambda: len(store.robots.history("farm", "r1")) == 2)
        publish(3)
        eventually(lambda: len(store.robots.history("farm", "r1")) == 3)
        assert [r.version for _, r in store.robots.history("farm", "r1")] == [3, 2, 1]
    finally:
        for intake in intakes:
            intake.close()
        successor.release()


def test_successor_stores_what_waits_in_short_transactions(
    api: Api, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.fleet.report_queue.BATCH", 4)
    store: Store = api.app.state.services.store
    store.environments.create("farm")
    leader, successor = (LocalLead(tmp_path, "successor") for _ in range(2))
    assert leader.try_acquire()
    note, stored = store.robots.note_reports, []

    def sometimes_away(batch: list[Any]) -> Any:
        stored.append([received.report.version for received in batch])
        if len(stored) == 2:
            raise Unavailable("the database is away")
        return note(batch)

    monkeypatch.setattr(store.robots, "note_reports", sometimes_away)
    intake = ReportQueue(store, successor)
    intake.start()
    try:
        for number in range(10):
            intake.enqueue_status("farm", "r1", status_payload(number))
        eventually(lambda: len(intake._standby) == 10)
        leader.release()
        assert successor.try_acquire()
        intake.enqueue_status("farm", "r1", status_payload(10))
        eventually(lambda: len(store.robots.history("farm", "r1")) == 11)
    finally:
        intake.close()
        successor.release()
    assert stored[0] == [0, 1, 2, 3]
    assert all(len(batch) <= 4 and not set(batch) & set(stored[0]) for batch in stored[1:]), "none is stored twice"
    assert [report.version for _, report in store.robots.history("farm", "r1")] == list(range(10, -1, -1))


def test_reports_of_a_robot_over_zenoh_and_http_are_stored_in_order(
    api: Api, lead: LocalLead, monkeypatch: pytest.MonkeyPatch
) -> None:
    store: Store = api.app.state.services.store
    store.environments.create("farm")
    note, tried = store.robots.note_reports, threading.Event()

    def away_at_first(batch: list[Any]) -> Any:
        if not tried.is_set():
            tried.set()
            raise Unavailable("the database is away")
        return note(batch)

    monkeypatch.setattr(store.robots, "note_reports", away_at_first)
    intake = ReportQueue(store, lead)
    intake.start()
    try:
        intake.enqueue_status("farm", "r1", status_payload(1))
        assert tried.wait(60)  # it waits to be stored while the next one comes
        newer = report_from_status(RobotStatus.from_json(status_payload(2)))
        intake.submit_report(ReceivedReport("farm", "r1", newer, datetime.now(UTC), False)).result(60)
    finally:
        intake.close()
    assert [report.version for _, report in store.robots.history("farm", "r1")] == [2, 1]


def test_presence_is_written_when_it_changes_and_by_the_leader(
    api: Api, lead: LocalLead, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The server that takes over stores what changed while no server led."""
    monkeypatch.setattr("app.fleet.report_queue.SETTLE_SECONDS", 0.2)
    monkeypatch.setattr("app.fleet.report_queue.PRESENCE_REFRESH_SECONDS", 0.3)
    store: Store = api.app.state.services.store
    written: list[int] = []
    note = store.robots.note_presence
    monkeypatch.setattr(
        store.robots,
        "note_presence",
        lambda came, left, now: (written.append(len(came) + len(left)), note(came, left, now)),
    )
    successor = LocalLead(tmp_path, "reports")
    intakes = [ReportQueue(store, one) for one in (lead, successor)]
    for intake in intakes:
        intake.start()

    def appear(*robots: str, on_bus: bool = True) -> None:
        for robot in robots:
            for intake in intakes:
                intake.set_presence(robot, on_bus)

    try:
        appear("a", "b", "c")
        eventually(lambda: store.robots.present_robots() == {"a", "b", "c"})
        checks = [store.robots.present_robots() and threading.Event().wait(0.5) for _ in range(4)]
        assert len(checks) == 4
        assert sum(written) == 3, "the others are renewed by one time"
        lead.release()
        appear("a", on_bus=False)
        appear("d")
        threading.Event().wait(0.5)
        assert store.robots.present_robots() == {"a", "b", "c"}
        assert successor.try_acquire()
        eventually(lambda: store.robots.present_robots() == {"b", "c", "d"})
        assert sum(written) == 5
    finally:
        for intake in intakes:
            intake.close()
        successor.release()


def test_presence_is_settled_again_although_the_lead_was_lost_for_a_moment_only(
    api: Api, lead: LocalLead, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Meanwhile another server has stored what it saw itself."""
    monkeypatch.setattr("app.fleet.report_queue.SETTLE_SECONDS", 0.2)
    monkeypatch.setattr("app.fleet.report_queue.PRESENCE_REFRESH_SECONDS", 0.3)
    store: Store = api.app.state.services.store
    intake, renew, lost = ReportQueue(store, lead), store.robots.renew_presence, []

    def lose_the_lead(now: datetime) -> None:
        if not lost:
            lead.release()
            other = threading.Thread(target=store.robots.note_presence, args=({"b"}, {"a"}, now))
            other.start()
            other.join()
            assert lead.try_acquire()
            lost.append(store.robots.present_robots() == {"b"})
        renew(now)

    intake.start()
    try:
        intake.set_presence("a", on_bus=True)
        eventually(lambda: store.robots.present_robots() == {"a"})
        eventually(lambda: intake._is_settled)
        monkeypatch.setattr(store.robots, "renew_presence", lose_the_lead)  # which the thread itself calls
        eventually(lambda: lost)
        eventually(lambda: store.robots.present_robots() == {"a"})
        assert lost == [True]
    finally:
        intake.close()
