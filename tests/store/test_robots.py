"""Robot reports and presence, on both databases."""

from __future__ import annotations

import random
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest

from app.errors import Conflict, NotFound
from app.fleet import channel_convergence, count_robots, is_online, robot_lag
from app.store import robot_counts, robots, silent_robots
from app.store.changes import Replace
from app.store.fleet_values import NO_ROOT, ActiveMap, ChannelMove, ReceivedReport, RobotReport
from app.store.store import Store
from tests.store.conftest import count
from tests.store.samples import DATUM, GRID, grid, save

NOW = datetime(2031, 5, 1, 14, 0, tzinfo=UTC)
A, B = "a" * 64, "b" * 64


def received_report(robot: str, minute: float, root: str = A, state: Any = "active", **more: Any) -> ReceivedReport:
    """Return a report received the given minutes after NOW."""
    version = more.pop("version", 1)
    channel = more.pop("channel", "production")
    environment = more.pop("environment", "farm")
    report = RobotReport(channel, version, root, state, **more)
    return ReceivedReport(environment, robot, report, NOW + timedelta(minutes=minute))


@pytest.fixture
def farm(store: Store) -> Store:
    store.environments.create("farm")
    return store


def test_active_map_follows_robot_reports(farm: Store):
    def active_map() -> ActiveMap | None:
        return farm.robots.all("farm", "r1")[0].active_map

    def report_status(minute: float, root: str, state: Any, holds: tuple[int, str] | None, **more: Any) -> None:
        assert farm.robots.note_reports([received_report("r1", minute, root, state, holds=holds, **more)]) == [None]

    report_status(0, A, "active", None, sequence=3)
    report_status(1, "c" * 64, "failed", (2, B), version=3, sequence=5)
    assert active_map() == ActiveMap(2, B, 5, NOW + timedelta(minutes=1)), "the status active of B was lost"
    report_status(2, "c" * 64, "failed", (2, B), version=3, sequence=5)
    assert active_map() == ActiveMap(2, B, 5, NOW + timedelta(minutes=1))
    assert len(farm.robots.history("farm", "r1")) == 2
    report_status(3, "c" * 64, "failed", (1, A), version=3, sequence=5)
    assert active_map() == ActiveMap(1, A, 5, NOW + timedelta(minutes=3)), "the same failure, and it moved back"
    report_status(4, "c" * 64, "downloading", None, version=3)
    assert active_map() == ActiveMap(1, A, 5, NOW + timedelta(minutes=3)), "not reported"
    report_status(5, "c" * 64, "active", (1, A), version=3)
    assert active_map() == ActiveMap(3, "c" * 64, None, NOW + timedelta(minutes=5)), (
        "active means that it runs the version"
    )
    report_status(6, A, "downloading", (0, NO_ROOT), version=1)
    assert active_map() is None, "its disk is empty"


def test_vouched_robot_stays_vouched(farm: Store):
    def vouched() -> list[bool]:
        return [r.vouched for r in farm.robots.all("farm")]

    open_bus = {"vouched": False}
    reported_at = NOW
    first, second = (
        received_report("r1", 0, A, reported_at=reported_at),
        received_report("r1", 1, B, "ready", reported_at=reported_at),
    )
    farm.robots.note_reports(
        [replace(first, **open_bus), replace(second, **open_bus), replace(received_report("r2", 0), **open_bus)]
    )
    assert vouched() == [False, False]
    farm.robots.note_reports([replace(first, time=NOW + timedelta(minutes=2))])
    assert vouched() == [True, False], "the same report arrived late, over HTTP"
    assert farm.robots.all("farm", "r1")[0].report.state == "ready"
    farm.robots.note_reports([replace(received_report("r1", 3, A, "failed"), **open_bus), received_report("r2", 3)])
    assert vouched() == [True, True]
    farm.robots.forget("farm", "r2")
    farm.robots.note_reports([replace(received_report("r2", 4), **open_bus)])
    assert vouched() == [True, False]


def test_active_map_stays_while_robot_fetches(farm: Store):
    reported_at = NOW - timedelta(hours=5)
    assert farm.robots.note_reports(
        [received_report("r1", 0, A, detail="ok\x00", sequence=4, reported_at=reported_at)]
    ) == [None]
    (robot,) = farm.robots.all("farm")
    assert robot.report == RobotReport("production", 1, A, "active", "ok\ufffd", 4, reported_at)
    assert (robot.environment, robot.robot, robot.time, robot.since) == ("farm", "r1", NOW, NOW)
    assert robot.active_map == ActiveMap(1, A, 4, NOW)
    assert (robot.on_bus, robot.presence_at) == (None, None)
    farm.robots.note_reports(
        [received_report("r1", 1, B, "downloading", version=2), received_report("r1", 2, B, "failed", version=2)]
    )
    (robot,) = farm.robots.all("farm", "r1")
    assert (robot.report.state, robot.report.version) == ("failed", 2)
    assert robot.active_map == ActiveMap(1, A, 4, NOW)
    farm.robots.note_reports(
        [received_report("r1", 3, B, version=2, sequence=9), received_report("r1", 4, B, version=2, sequence=9)]
    )
    (robot,) = farm.robots.all("farm", "r1")
    assert robot.active_map == ActiveMap(2, B, 9, NOW + timedelta(minutes=3))
    assert (robot.since, robot.time) == (NOW + timedelta(minutes=3), NOW + timedelta(minutes=4))
    history = farm.robots.history("farm", "r1")
    assert [(t, r.state) for t, r in history] == [
        (NOW + timedelta(minutes=m), state)
        for m, state in ((3, "active"), (2, "failed"), (1, "downloading"), (0, "active"))
    ]
    assert len(farm.robots.history("farm", "r1", limit=2)) == 2


def test_duplicate_report_counts_once(farm: Store):
    first = received_report("r1", 0, B, "downloading", reported_at=NOW)
    second = received_report("r1", 0, B, "ready", reported_at=NOW + timedelta(seconds=1), detail="x")
    farm.robots.note_reports([first, second, replace(first, time=NOW + timedelta(minutes=1)), second])
    assert [r.state for _, r in farm.robots.history("farm", "r1")] == ["ready", "downloading"]
    (robot,) = farm.robots.all("farm")
    assert (robot.report.state, robot.time) == ("ready", NOW)
    farm.robots.note_reports([replace(first, time=NOW + timedelta(minutes=1))])
    (robot,) = farm.robots.all("farm")
    assert (robot.report.state, robot.time) == ("ready", NOW + timedelta(minutes=1))
    farm.robots.note_reports([received_report("r1", 2, B, "downloading", reported_at=NOW + timedelta(seconds=2))])
    assert farm.robots.all("farm")[0].report.state == "downloading"


def test_robots_are_listed_per_environment(farm: Store):
    farm.environments.create("yard")
    errors = farm.robots.note_reports(
        [
            received_report("r2", 0),
            received_report("r1", 0),
            received_report("r1", 0, environment="nowhere"),
            received_report("r1", 1, environment="yard"),
        ]
    )
    assert [type(e) for e in errors] == [type(None), type(None), NotFound, type(None)]
    assert [(r.environment, r.robot) for r in farm.robots.all()] == [("farm", "r1"), ("farm", "r2"), ("yard", "r1")]
    assert [r.environment for r in farm.robots.all(robot="r1")] == ["farm", "yard"]
    farm.environments.delete("yard")
    assert [r.environment for r in farm.robots.all(robot="r1")] == ["farm"]
    with pytest.raises(NotFound):
        farm.robots.all("nowhere")
    farm.environments.purge("yard")
    farm.robots.forget("farm", "r1")
    assert [r.robot for r in farm.robots.all()] == ["r2"]
    assert farm.robots.history("farm", "r1") == []
    with pytest.raises(NotFound, match="r1"):
        farm.robots.forget("farm", "r1")


def test_history_and_fleet_are_bounded(farm: Store, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(robots, "HISTORY", 5)
    monkeypatch.setattr(farm.robots, "_limit", 2)
    farm.robots.note_reports([received_report("r1", k, version=k) for k in range(12)] + [received_report("r2", 0)])
    assert [r.version for _, r in farm.robots.history("farm", "r1")] == [11, 10, 9, 8, 7]
    assert len(farm.robots.history("farm", "r2")) == 1
    (error,) = farm.robots.note_reports([received_report("r3", 0)])
    assert isinstance(error, Conflict)
    assert farm.robots.note_reports([received_report("r2", 1)]) == [None]
    assert [r.robot for r in farm.robots.all()] == ["r1", "r2"]


def test_concurrent_reports_of_same_robots_are_stored(farm: Store):
    def write(k: int) -> None:
        names = [f"r{n}" for n in range(6)]
        for name in names if k % 2 else reversed(names):
            assert farm.robots.note_reports(
                [received_report(name, k, version=k), received_report("r0", k, version=k)]
            ) == [None, None]

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(write, range(8)))
    assert [r.robot for r in farm.robots.all("farm")] == [f"r{n}" for n in range(6)]


def test_presence_is_stored_and_bounded(farm: Store, monkeypatch: pytest.MonkeyPatch):
    farm.robots.note_reports([received_report("r1", 0), received_report("r2", 0)])
    farm.robots.note_presence({"r1", "r2", "r9"}, set(), NOW)
    later = NOW + timedelta(minutes=9)
    farm.robots.note_presence({"r1"}, {"r2"}, later)
    assert [(r.robot, r.on_bus, r.presence_at) for r in farm.robots.all()] == [
        ("r1", True, later),
        ("r2", False, later),
    ]
    monkeypatch.setattr(robots, "MAX_PRESENT", 3)
    farm.robots.note_reports([received_report("r3", 0)])
    farm.robots.note_presence({"r2", "r3"}, {"r1"}, later)
    assert [(r.robot, r.on_bus) for r in farm.robots.all()] == [("r1", False), ("r2", True), ("r3", None)]


def test_silent_robots_are_removed(farm: Store, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(silent_robots, "PAGE", 2)
    old, now = datetime.now(UTC) - timedelta(days=91), datetime.now(UTC)
    names = ("old", "older", "oldest")
    for version, state in enumerate(("failed", "active")):
        reports = [ReceivedReport("farm", r, RobotReport("latest", version, A, state), old) for r in names]
        farm.robots.note_reports(reports)
    farm.robots.note_reports([ReceivedReport("farm", "new", RobotReport("latest", 0, A, "active"), now)])
    farm.robots.note_presence({"new", "old"}, set(), old)
    farm.robots.note_presence({"new"}, set(), now)
    farm.garbage.collect(timedelta(hours=6))
    assert [r.robot for r in farm.robots.all()] == ["new"]
    assert farm.robots.present_robots() == {"new"}
    assert [len(farm.robots.history("farm", name)) for name in (*names, "new")] == [0, 0, 0, 1]


def test_channel_moves_are_listed_oldest_first(farm: Store):
    first = save(farm, "farm", Replace(GRID, grid()))
    second = save(farm, "farm", Replace(GRID, grid(seed=1)))
    farm.channels.move("farm", "production", 2, author="ann")
    farm.channels.move("farm", "staging", 1, author="ann")
    farm.channels.move("farm", "production", 1, author="ann")
    farm.channels.move("farm", "production", 2, author="ann", activate_at=NOW)
    assert [(m.sequence, m.version, m.root) for m in farm.channels.moves("farm", "latest")] == [
        (2, 1, first.root), (3, 2, second.root),
    ]  # fmt: skip
    assert [(m.sequence, m.version) for m in farm.channels.moves("farm", "production")] == [(4, 2), (6, 1)]
    assert farm.channels.moves("farm", "none") == []


def test_convergence_requires_reports_of_root(farm: Store):
    old, new = (save(farm, "farm", Replace(GRID, grid(seed=k))).root for k in range(2))
    channel = farm.channels.move("farm", "production", 2, author="ann")
    base = channel.time

    def report_status(robot: str, seconds: float, root: str, state: Any = "active", **more: Any) -> None:
        report = RobotReport(more.pop("channel", "production"), 0, root, state, **more)
        farm.robots.note_reports([ReceivedReport("farm", robot, report, base + timedelta(seconds=seconds))])

    def convergence(seconds: float = 60) -> Any:
        counts = count_robots(farm.robot_counts, "farm", base + timedelta(seconds=seconds))
        return channel_convergence(counts, channel)

    assert convergence().as_dict() == {
        "total": 0, "online": 0, "holding": 0, "lagging": 0, "failed": 0, "ready": 0, "since": None,
    }  # fmt: skip
    report_status("a", -100, new)
    report_status("b", 3, old, sequence=1)
    report_status("c", 4, new, "failed")
    report_status("d", 4, old, channel="staging")
    now = convergence()
    assert (now.total, now.online, now.holding, now.lagging, now.failed, now.since) == (3, 3, 1, 1, 1, None)
    assert convergence(1000).online == 0
    report_status("b", 5, new)
    report_status("b", 9, new)
    report_status("c", 7, new)
    now = convergence()
    assert (now.total, now.holding, now.lagging, now.failed) == (3, 3, 0, 0)
    assert now.since == base + timedelta(seconds=7)
    farm.robots.forget("farm", "b")
    farm.robots.forget("farm", "c")
    assert convergence().since == base, "before the move no robot ran the root"
    # the next version is fetched while the robot runs the present one
    planned = farm.channels.move("farm", "production", 1, author="ann", activate_at=base + timedelta(hours=1))
    assert planned.planned is not None
    assert planned.planned.root == old
    report_status("a", 20, old, "ready")
    ready = channel_convergence(count_robots(farm.robot_counts, "farm", base), planned, old)
    assert (ready.holding, ready.ready) == (1, 1)
    report = RobotReport("production", 1, old, "ready")
    farm.robots.note_reports([ReceivedReport("farm", "unvouched", report, base + timedelta(seconds=21), vouched=False)])
    ready = channel_convergence(count_robots(farm.robot_counts, "farm", base), planned, old)
    assert (ready.total, ready.ready) == (2, 1), "it is listed, and does not count in the rollout"


def test_counts_equal_a_count_of_the_robots(farm: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robot_counts, "MAX_ROWS", 10)
    farm.environments.create("yard")
    dice = random.Random(4)
    present: set[str] = set()
    for step in range(120):
        robot, minute = f"r{dice.randrange(12)}", step / 20
        more = {"channel": dice.choice(["production", "staging"]), "environment": dice.choice(["farm", "yard"])}
        state = dice.choice(["active", "ready", "failed", "downloading"])
        report = received_report(robot, minute, dice.choice([A, B]), state, **more)
        farm.robots.note_reports([replace(report, vouched=dice.random() < 0.7)])
        if step % 10 == 0:
            present ^= {robot}
            now = NOW + timedelta(minutes=minute)
            farm.robots.note_presence(present & {robot}, {robot} - present, now)
        if step in (50, 90):
            farm.robot_counts.join()
        if step == 70:
            farm.robots.forget("farm", farm.robots.all("farm")[0].robot)
    assert count(farm, "robot_tally") < 80, "rows were joined"
    for environment in ("farm", "yard"):
        now = NOW + timedelta(minutes=8)
        counts = count_robots(farm.robot_counts, environment, now)
        listed = farm.robots.all(environment)
        expected = Counter(
            (r.report.channel, r.report.state, r.report.root, r.active_map and r.active_map.root, r.vouched)
            for r in listed
        )
        groups: Counter[Any] = Counter()
        for g in counts.groups:
            groups[g.channel, g.state, g.root, g.held_root, g.vouched] += g.number
        assert groups == expected
        assert counts.online == Counter(r.report.channel for r in listed if is_online(r, now))
        for channel, last in counts.last_held.items():
            held = [r.active_map.since for r in listed if r.report.channel == channel and r.active_map]
            assert last == max(held, default=None)


def test_counts_end_with_the_environment(farm: Store) -> None:
    farm.robots.note_reports([received_report("r", 0)])
    farm.environments.delete("farm")
    farm.environments.purge("farm")
    assert count(farm, "robot_tally") == 0


def test_lag_counts_unapplied_events(sqlite_store: Store):
    farm = sqlite_store
    farm.environments.create("farm", datum=DATUM)
    channel = next(c for c in farm.channels.all("farm"))
    moves = [ChannelMove(n, n, str(n) * 64, NOW + timedelta(minutes=n)) for n in (2, 5, 7)]
    channel = replace(channel, root=moves[-1].root)

    def lag(*reports: ReceivedReport) -> Any:
        farm.robots.note_reports(list(reports))
        (robot,) = farm.robots.all("farm", reports[0].robot)
        lag = robot_lag(robot, channel, moves)
        return lag.events, lag.differs, lag.since and (lag.since - NOW) / timedelta(minutes=1)

    assert lag(received_report("in-step", 0, moves[2].root)) == (0, False, None)
    assert lag(received_report("applied", 0, moves[1].root, sequence=5)) == (1, True, 7)
    assert lag(received_report("behind", 0, moves[0].root)) == (2, True, 5)
    assert lag(received_report("foreign", 0, A)) == (3, True, 2)
    assert lag(received_report("empty", 0, moves[2].root, "downloading")) == (3, True, 2)
    assert lag(received_report("ahead", 4, A, sequence=9)) == (0, True, 4)


@pytest.mark.parametrize(
    ("report", "present", "seen", "online"),
    [
        (-1, None, None, True), (-4, None, None, False),
        (-4, True, -0.5, True), (-4, True, -2, False), (-1, True, -2, True),
        (-1, False, -0.5, False), (-1, False, -2, True), (-1, False, -1, False),
    ],
)  # fmt: skip
def test_robot_is_online_by_presence_or_recent_report(
    sqlite_store: Store, report: float, present: bool | None, seen: float | None, online: bool
):
    sqlite_store.environments.create("farm")
    sqlite_store.robots.note_reports([received_report("r", report)])
    if seen is not None:
        at = NOW + timedelta(minutes=seen)
        sqlite_store.robots.note_presence({"r"} if present else set(), set() if present else {"r"}, at)
    (robot,) = sqlite_store.robots.all()
    assert is_online(robot, NOW) is online
    counts = count_robots(sqlite_store.robot_counts, "farm", NOW)
    assert counts.online == ({"production": 1} if online else {})


def test_repeated_report_is_stored_once_a_minute(farm: Store):
    """Unless it says more: a failure, a place, or that a robot without the bus is online."""

    def stored_time(minutes: float, **more: Any) -> datetime:
        report = replace(received_report("r", 0).report, **more)
        farm.robots.note_reports([ReceivedReport("farm", "r", report, NOW + timedelta(minutes=minutes))])
        return farm.robots.all(robot="r")[0].time

    assert stored_time(0) == NOW
    assert stored_time(0.5) == NOW
    assert stored_time(1) == NOW + timedelta(minutes=1)
    farm.robots.note_presence(set(), {"r"}, NOW + timedelta(minutes=1.1))
    assert stored_time(1.2) == NOW + timedelta(minutes=1.2), "it is online without the bus"
    assert stored_time(1.3) == NOW + timedelta(minutes=1.2)
    for minutes in (1.4, 1.5):
        assert stored_time(minutes, state="failed") == NOW + timedelta(minutes=minutes)


def test_presence_is_renewed_for_all_robots_at_once(farm: Store):
    farm.robots.note_reports([received_report("r1", -10), received_report("r2", -10)])
    farm.robots.note_presence({"r1"}, {"r2"}, NOW)
    later = NOW + timedelta(minutes=5)
    farm.robots.renew_presence(later)
    assert [(r.on_bus, r.presence_at) for r in farm.robots.all()] == [(True, later), (False, NOW)]
    assert [is_online(r, later) for r in farm.robots.all()] == [True, False]
