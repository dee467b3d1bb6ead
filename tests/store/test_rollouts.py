"""Two-stage rollouts, on both databases."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from sqlalchemy import event, text

from app.errors import Conflict
from app.fleet import next_step
from app.store import rollout_robots
from app.store.changes import Replace
from app.store.fleet_values import Channel, FailedRobot, OnlineCounts, ReceivedReport, RobotReport, Rollout
from app.store.store import Store
from app.store.values import rfc3339
from tests.store.samples import GRID, grid, save


class Fleet:
    """Robots of the channel production, which points to version 1 and is to move to version 2; the clock stands."""

    def __init__(self, store: Store) -> None:
        self.store = store
        store.environments.create("farm")
        self.roots = {k + 1: save(store, "farm", Replace(GRID, grid(seed=k))).root for k in range(3)}
        store.channels.move("farm", "production", 1, author="ann")
        self.start = datetime.now(UTC)

    def at(self, seconds: float) -> datetime:
        return self.start + timedelta(seconds=seconds)

    def report(self, robots: str, version: int, state: Any, seconds: float = 1, *, vouched: bool = True) -> None:
        report = RobotReport("production", version, self.roots[version], state)
        assert not any(
            self.store.robots.note_reports(
                [ReceivedReport("farm", r, report, self.at(seconds), vouched) for r in robots]
            )
        )

    def roll(self, version: int = 2, activate_at: datetime | None = None, **more: Any) -> Channel:
        rollout = Rollout(0, "", self.start, **more)
        return self.store.channels.move(
            "farm", "production", version, author="bob", activate_at=activate_at, rollout=rollout
        )

    def tick(self, seconds: float) -> tuple[int | None, str]:
        """Advance the rollout; returns (version, state of the rollout)."""
        self.store.channels.apply_due_moves(self.at(seconds))
        self.store.channels.advance_rollouts(self.at(seconds), next_step)
        now = self.channel()
        return now.version, now.rollout.state if now.rollout else ""

    def channel(self) -> Channel:
        return next(c for c in self.store.channels.all("farm") if c.name == "production")

    def events(self) -> list[dict[str, Any]]:
        return [dict(e.body) for e in self.store.events.page("farm", since=5)]


@pytest.fixture
def fleet(store: Store, monkeypatch: pytest.MonkeyPatch) -> Fleet:
    fleet = Fleet(store)
    monkeypatch.setattr(store._database, "now", lambda: fleet.start)
    return fleet


def test_unvouched_robots_neither_move_nor_stop_rollout(fleet: Fleet):
    fleet.report("ab", 1, "active")
    fleet.report("wxyz", 1, "active", vouched=False)
    fleet.roll(ready=1, failed=0.4)
    fleet.report("wxyz", 2, "ready", 2, vouched=False)
    assert fleet.tick(3) == (1, "waiting")
    fleet.report("wxy", 2, "failed", 4, vouched=False)
    fleet.report("a", 2, "ready", 4)
    assert fleet.tick(5) == (1, "waiting"), "one of two is ready, and none of the two failed"
    fleet.report("b", 2, "ready", 6, vouched=False)
    assert fleet.tick(7) == (2, "watching"), "b has sent a vouched report before"
    fleet.report("wxyz", 2, "failed", 8, vouched=False)
    assert fleet.tick(9) == (2, "watching")
    fleet.report("w", 2, "failed", 10)
    assert fleet.tick(11) == (2, "watching"), "w counts from now on, and is one of three"
    fleet.report("x", 2, "failed", 12)
    assert fleet.tick(13) == (1, "rolled_back")


def test_rollout_moves_when_enough_robots_are_ready(fleet: Fleet):
    fleet.report("abcd", 1, "active")
    planned = fleet.roll(ready=0.75)
    assert planned.planned is not None
    assert (planned.version, planned.planned.version, planned.planned.activate_at) == (1, 2, None)
    assert planned.planned.root == fleet.roots[2]
    (event,) = fleet.events()
    assert (event["type"], event["version"]) == ("channel.planned", 2)
    assert event["rollout"] == {"ready": 0.75, "failed": None, "deadline": None}
    assert "activate_at" not in event
    fleet.report("ab", 2, "ready", 2)
    fleet.report("c", 2, "downloading", 2)
    assert fleet.tick(3) == (1, "waiting")
    fleet.report("c", 2, "ready", 4)
    assert fleet.tick(5) == (2, "done")
    event = fleet.events()[-1]
    assert (event["type"], event["version"], event["previous"]["version"]) == ("channel.moved", 2, 1)
    assert (event["rollback"], event["reason"], event["author"]) == (False, "3 of 4 robots are ready", "bob")
    count = len(fleet.events())
    assert fleet.tick(6) == (2, "done")
    assert len(fleet.events()) == count
    assert fleet.channel().planned is None


@dataclass(frozen=True)
class Census:
    """Robots of a channel, all online."""

    count: int
    ready_count: int
    failed_count: int
    time: datetime

    def failed(self, **_: datetime) -> list[FailedRobot]:
        return [FailedRobot(f"r{k}", self.time, online=True) for k in range(self.failed_count)]

    def online(self, **_: datetime) -> OnlineCounts:
        return OnlineCounts(self.count, self.ready_count)


@pytest.mark.parametrize(("count", "share", "enough"), [(25, 0.28, 7), (25, 0.56, 14), (1, 1.0, 1), (3, 0.001, 1)])
def test_rollout_moves_at_exact_ready_share(count: int, share: float, enough: int):
    """In binary, 0.28 of 25 is slightly more than 7."""
    now = datetime.now(UTC)

    def step(state: Any, those: int) -> Any:
        rollout = Rollout(2, "b", now, ready=share, failed=share, state=state, moved=now, before=1)
        ready, failed = (those, 0) if state == "waiting" else (0, those)
        return next_step(rollout, Census(count, ready, failed, now), now)

    for stage, then in (("waiting", "move"), ("watching", "move_back")):
        assert step(stage, enough).do == then
        assert step(stage, enough - 1) is None


@pytest.mark.parametrize("shift", [-60, 60])
def test_changed_robot_clock_hides_no_failure(fleet: Fleet, shift: float):
    fleet.report("abc", 1, "active")
    fleet.report("a", 2, "failed")  # an earlier attempt: it does not count
    fleet.roll(failed=0.5, window=600.0)
    assert fleet.tick(1) == (2, "watching")
    fleet.report("b", 2, "failed", 2 + shift)
    assert fleet.tick(3 + shift) == (2, "watching")
    fleet.report("c", 2, "failed", 4 + shift)
    assert fleet.tick(5 + shift) == (1, "rolled_back")
    ended = fleet.channel().rollout
    assert ended is not None
    assert ended.detail == "2 of 3 robots failed"
    assert "said_before" not in ended.as_dict()


def test_rollout_does_not_wait_for_offline_robots(fleet: Fleet):
    fleet.report("abcd", 1, "active", -1000)
    fleet.report("a", 1, "active")
    fleet.roll(ready=1.0)
    assert fleet.tick(2) == (1, "waiting")
    fleet.report("a", 2, "ready", 3)
    assert fleet.tick(4) == (2, "done")


def test_rollout_without_robots_does_not_move(fleet: Fleet):
    fleet.roll(ready=0.1, deadline=fleet.at(100))
    assert fleet.tick(99) == (1, "waiting")
    assert fleet.tick(100) == (1, "expired")
    now = fleet.channel()
    assert now.planned is None
    assert now.rollout is not None
    assert now.rollout.detail == "only 0 of 0 robots are ready; the channel does not move"
    assert fleet.tick(101) == (1, "expired")
    assert [e["type"] for e in fleet.events()] == ["channel.planned", "channel.cancelled"]


def test_rollout_waits_for_its_time(fleet: Fleet):
    fleet.report("a", 2, "ready")
    fleet.roll(ready=1.0, activate_at=fleet.at(60))
    assert fleet.events()[0]["activate_at"]
    assert fleet.tick(59) == (1, "waiting")
    assert fleet.tick(60) == (2, "done")
    fleet.report("a", 2, "active", 61)
    fleet.roll(3, ready=1.0, activate_at=fleet.at(70))
    assert fleet.tick(71) == (2, "waiting"), "due, but its robots are not ready"
    fleet.report("a", 3, "ready", 80)
    assert fleet.tick(81) == (3, "done")


def test_rollout_moves_back_when_too_many_robots_fail(fleet: Fleet):
    fleet.report("abcde", 1, "active")
    fleet.roll(ready=0.6, failed=0.4, window=100.0)
    fleet.report("abc", 2, "ready", 2)
    fleet.report("d", 2, "failed", 2)
    assert fleet.tick(3) == (2, "watching")
    fleet.report("ab", 2, "active", 4)
    assert fleet.tick(5) == (2, "watching"), "failures before the move do not count after it"
    fleet.report("c", 2, "failed", 6)
    assert fleet.tick(7) == (2, "watching")
    fleet.report("d", 2, "failed", 8)
    assert fleet.tick(9) == (1, "rolled_back")
    moved, back = (e for e in fleet.events() if e["type"] == "channel.moved")
    assert back["sequence"] == moved["sequence"] + 1
    assert (back["version"], back["root"], back["rollback"]) == (1, fleet.roots[1], True)
    assert (back["previous"]["version"], back["reason"]) == (2, "2 of 5 robots failed")
    assert fleet.channel().sequence == back["sequence"]
    assert fleet.tick(10) == (1, "rolled_back")


def test_move_back_to_newer_version_is_rollback(fleet: Fleet):
    fleet.store.channels.move("farm", "production", 3, author="ann")
    fleet.roll(2, failed=0.5)
    assert fleet.tick(0) == (2, "watching"), "without a ready share it moves at once"
    fleet.report("a", 2, "failed", 10)
    assert fleet.tick(11) == (3, "rolled_back")
    assert fleet.events()[-1]["rollback"] is True


def test_failed_robots_count_when_offline(fleet: Fleet):
    fleet.report("abc", 1, "active")
    fleet.roll(failed=0.5, window=10_000.0)
    fleet.report("ab", 2, "failed", 2)
    assert fleet.tick(1000) == (1, "rolled_back")


def test_rollout_ends_after_window(fleet: Fleet):
    fleet.report("abc", 1, "active")
    fleet.roll(failed=0.5, window=60.0)
    assert fleet.tick(59) == (2, "watching")
    assert fleet.tick(61) == (2, "done")
    fleet.report("abc", 2, "failed", 62)
    assert fleet.tick(63) == (2, "done")


def test_rollout_is_cancelled_when_robots_fail_to_fetch(fleet: Fleet):
    fleet.report("abc", 1, "active")
    fleet.roll(ready=0.3, failed=0.5)
    fleet.report("ab", 2, "failed", 2)
    assert fleet.tick(3) == (1, "failed")
    assert fleet.channel().planned is None
    planned, dropped = fleet.events()
    assert (planned["type"], dropped["type"]) == ("channel.planned", "channel.cancelled")
    assert (dropped["version"], dropped["previous"]["version"], dropped["author"]) == (2, 1, "bob")
    assert "2 of 3 robots failed to fetch it" in dropped["reason"]


def test_another_move_ends_rollout(fleet: Fleet):
    fleet.report("a", 1, "active")
    fleet.roll(failed=0.1)
    fleet.store.channels.move("farm", "production", 3, author="ann")
    fleet.report("a", 2, "failed", 2)
    assert fleet.tick(3) == (3, "")
    fleet.roll(ready=1.0)
    fleet.store.channels.cancel_planned("farm", "production", "ann")
    fleet.report("a", 2, "ready", 4)
    assert fleet.tick(5) == (3, "cancelled")
    fleet.roll(ready=1.0)
    fleet.store.channels.move("farm", "production", 1, author="ann", activate_at=fleet.at(10))
    assert fleet.tick(9) == (3, "")
    assert fleet.tick(10) == (1, "")


def test_planned_move_does_not_end_the_watch(fleet: Fleet):
    fleet.report("a", 1, "active")
    moved = fleet.roll(failed=0.1, window=60.0)
    with pytest.raises(Conflict, match=re.escape(f"version 2 is watched for failures until {rfc3339(fleet.at(60))}")):
        fleet.store.channels.move("farm", "production", 3, author="ann", activate_at=fleet.at(900))
    assert fleet.channel() == moved
    fleet.report("a", 2, "failed", 2)
    assert fleet.tick(3) == (1, "rolled_back")
    fleet.store.channels.move("farm", "production", 3, author="ann", activate_at=fleet.at(900))
    assert fleet.channel().planned is not None


def test_another_rollout_ends_the_watch(fleet: Fleet):
    fleet.report("a", 1, "active")
    fleet.roll(failed=0.1, window=60.0)
    fleet.roll(3, ready=1.0)
    fleet.report("a", 2, "failed", 2)
    assert fleet.tick(3) == (2, "waiting")


def test_first_move_has_no_version_to_move_back_to(fleet: Fleet):
    rollout = Rollout(0, "", fleet.start, failed=0.1)
    moved = fleet.store.channels.move("farm", "staging", 2, author="ann", rollout=rollout)
    assert moved.rollout is not None
    assert (moved.version, moved.rollout.state) == (2, "done")
    same = fleet.store.channels.move("farm", "staging", 2, author="ann", rollout=rollout)
    assert same.sequence == moved.sequence


def test_rollout_decision_is_repeated_in_transaction(fleet: Fleet):
    fleet.report("a", 2, "ready")
    fleet.roll(ready=1.0)
    calls = []

    def changes_its_mind(*about: Any) -> Any:
        calls.append(about)
        return next_step(*about) if len(calls) == 1 else None

    assert fleet.store.channels.advance_rollouts(fleet.at(2), changes_its_mind) == []
    assert len(calls) == 2
    assert fleet.channel().version == 1


def test_open_rollout_of_large_channel_reads_few_rows_each_second(fleet: Fleet, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(rollout_robots, "LARGE", 3)
    fleet.report("abcde", 1, "active")
    fleet.report("a", 2, "failed", 2)
    fleet.roll(ready=1.0, failed=0.9)
    with fleet.store.transaction() as connection:
        engine = connection.engine
    rows = []

    def count(*about: Any) -> None:
        rows.append(about[2])

    event.listen(engine, "after_cursor_execute", count)
    try:
        for seconds in range(3, 10):
            fleet.tick(seconds)
    finally:
        event.remove(engine, "after_cursor_execute", count)
    counted = [statement for statement in rows if "AS ready" in statement]
    assert len(counted) == 1, "the other robots are counted at most every few seconds"
    assert not [statement for statement in rows if "robot_history" in statement or "robot.detail" in statement]
    fleet.report("bcde", 2, "ready", 11)
    assert fleet.tick(12) == (1, "waiting")


def test_failed_robots_are_read_from_their_index(fleet: Fleet):
    query = rollout_robots._failed_query().compile(compile_kwargs={"literal_binds": False})
    values = {name: "2030-01-01T00:00:00+00:00" if name.endswith("_after") else "" for name in query.params}
    is_sqlite = fleet.store.database_url.startswith("sqlite")
    with fleet.store.transaction() as connection:
        if not is_sqlite:
            connection.exec_driver_sql("SET LOCAL enable_seqscan = off")  # else it reads a small table as a whole
        plan = connection.execute(text(f"EXPLAIN {'QUERY PLAN' if is_sqlite else ''} {query}"), values).all()
    assert "ix_robot_failed" in str(plan), plan
