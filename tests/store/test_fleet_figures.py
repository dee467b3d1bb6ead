"""Figures for operators, on both databases: robots behind their channel, rollouts, closures, events."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import timedelta
from typing import Any

import pytest

from app.fleet import next_step
from app.store import fleet_figures
from app.store.changes import Replace
from app.store.fleet_figures import OpenRollout, OverlayCounts
from app.store.fleet_values import Overlay, ReceivedReport, RobotReport, Rollout
from app.store.store import Store
from tests.store.conftest import NOW, Clock
from tests.store.samples import GRID, grid, save

MINUTE, HOUR = timedelta(minutes=1), timedelta(hours=1)
SQUARE = {"type": "Polygon", "coordinates": [[[0, 0], [1, 0], [1, 1.5], [0, 0]]]}


class Site:
    """The environment ``site`` with three versions, of which production is the first, at a time that the test sets."""

    def __init__(self, store: Store, clock: Clock) -> None:
        self.store, self.clock = store, clock
        store.environments.create("site")
        self.roots = {k + 1: save(store, "site", Replace(GRID, grid(seed=k))).root for k in range(3)}
        store.channels.move("site", "production", 1, author="ann")

    def report(self, robots: str, version: int, state: Any = "active", channel: str = "production") -> None:
        """Report by robots now; a failure keeps their map."""
        report = RobotReport(channel, version, self.roots[version], state)
        reports = [ReceivedReport("site", robot, report, self.clock.now) for robot in robots]
        assert not any(self.store.robots.note_reports(reports))

    def robots(self) -> dict[str, tuple[int, int, int, int]]:
        """Return (holding, lagging, failed, late) by channel."""
        now = self.clock.now
        counted = self.store.fleet_figures.robots(on_bus_after=now - MINUTE, heard_after=now - 3 * MINUTE)
        return {one.channel: (one.holding, one.lagging, one.failed, one.late) for one in counted}

    def close(self, hours: float, **more: Any) -> None:
        """Report an obstruction, or close a place, for some hours from now."""
        now = self.clock.now
        end = now + hours * HOUR
        values = {"state": "accepted", "decided_by": "ann", "decided": now, **more}
        overlay = Overlay("site", "blocked", "ground", SQUARE, None, "local", None, "ann", now, end, **values)
        self.store.overlays.add(overlay)


@pytest.fixture
def site(store: Store, clock: Clock) -> Iterator[Site]:
    clock.now = NOW
    timed = Store(store.database_url, store.blob_dir, clock=clock)
    yield Site(timed, clock)
    timed.close()


def test_robots_behind_their_channel_are_counted(site: Site, clock: Clock) -> None:
    assert site.robots() == {}
    site.report("abcd", 1)
    site.report("x", 3, channel="latest")
    site.report("y", 3, channel="nowhere")
    assert site.robots() == {"production": (4, 0, 0, 0), "latest": (1, 0, 0, 0)}, "nowhere points to no version"

    clock.now += 14 * MINUTE
    site.store.channels.move("site", "production", 2, author="ann")
    site.report("ab", 2)
    site.report("c", 2, "failed")
    site.report("d", 1)
    assert site.robots()["production"] == (2, 1, 1, 0), "they have had a minute"

    clock.now += 2 * MINUTE
    assert site.robots()["production"] == (2, 1, 1, 2)
    clock.now += 2 * MINUTE
    assert site.robots()["production"] == (2, 1, 1, 0), "offline robots are not late"
    site.report("d", 1)
    assert site.robots()["production"] == (2, 1, 1, 1)


def test_closures_make_robots_lag(site: Site, clock: Clock) -> None:
    site.report("ab", 1)
    clock.now += 20 * MINUTE
    site.close(10)
    site.report("ab", 1)
    assert site.robots() == {"production": (0, 2, 0, 2)}
    site.store.environments.delete("site")
    assert site.robots() == {}


def test_many_late_robots_are_counted_now_and_then(site: Site, clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fleet_figures, "LARGE", 2)
    site.report("abc", 2)
    clock.now += 20 * MINUTE
    site.report("abc", 2)
    assert site.robots() == {"production": (0, 3, 0, 3)}
    clock.now += 20 * MINUTE
    assert site.robots() == {"production": (0, 3, 0, 3)}, "they are offline now, but were counted just now"
    site.store.fleet_figures._counted -= 61
    assert site.robots() == {"production": (0, 3, 0, 0)}


def test_late_robots_are_looked_up_by_an_index(sqlite_store: Store) -> None:
    times = dict.fromkeys(("on_bus_after", "heard_after", "taken_before"), NOW)
    values = {"environment": "e", "channel": "c", **times}
    for group in ((None, None), ("a" * 64, None), (None, "b" * 64), ("a" * 64, "b" * 64)):
        query = fleet_figures._late_query(*group)
        compiled = query.compile(sqlite_store._database.engine)
        bound = {**compiled.params, **values}
        with sqlite_store._database.read() as connection:
            plan = connection.exec_driver_sql(
                f"EXPLAIN QUERY PLAN {compiled}", tuple(str(bound[name]) for name in compiled.positiontup or ())
            ).all()
        lines = [row[3] for row in plan if " robot " in f"{row[3]} "]
        assert any(
            "ix_robot_map (environment_id=? AND channel=? AND held_root=? AND held_overlays=?)" in line
            for line in lines
        ), plan


def test_open_rollouts_show_how_long_they_wait(site: Site, clock: Clock) -> None:
    figures = site.store.fleet_figures
    assert figures.rollouts() == []
    site.report("ab", 1)
    planned = Rollout(0, "", NOW, ready=1.0, failed=0.5, window=600.0)
    site.store.channels.move("site", "production", 2, author="bob", activate_at=NOW + HOUR, rollout=planned)
    assert figures.rollouts() == [OpenRollout("site", "production", "waiting", 0.0)]
    clock.now += 3 * HOUR
    assert figures.rollouts() == [OpenRollout("site", "production", "waiting", 7200.0)]
    site.report("ab", 2, "ready")
    site.store.channels.advance_rollouts(clock.now, next_step)
    clock.now += 11 * MINUTE
    assert figures.rollouts() == [OpenRollout("site", "production", "watching", 60.0)]
    site.store.channels.advance_rollouts(clock.now, next_step)
    assert figures.rollouts() == []


def test_planned_moves_are_overdue_if_nobody_carries_them_out(site: Site, clock: Clock) -> None:
    figures = site.store.fleet_figures
    site.store.channels.move("site", "production", 2, author="bob", activate_at=NOW + HOUR)
    site.store.channels.move("site", "staging", 2, author="bob", activate_at=NOW + 2 * HOUR)
    assert figures.overdue_moves() == 0
    clock.now += 3 * HOUR
    assert figures.overdue_moves() == 7200
    site.store.channels.apply_due_moves(clock.now)
    assert figures.overdue_moves() == 0


def test_lasting_closures_that_end_soon_are_counted(site: Site, clock: Clock) -> None:
    assert site.store.fleet_figures.overlays() == []
    site.close(8)
    site.close(5)
    site.close(100)
    site.close(7.5, state="pending", decided_by=None, decided=None)
    assert site.store.fleet_figures.overlays() == [OverlayCounts("site", 3, 1, 0)]
    clock.now += 4.5 * HOUR
    assert site.store.fleet_figures.overlays() == [OverlayCounts("site", 3, 1, 0)], "five hours are short"
    clock.now += 3 * HOUR
    assert site.store.fleet_figures.overlays() == [OverlayCounts("site", 3, 1, 1)]


def test_unsent_events_are_counted_with_the_age_of_the_oldest(site: Site, clock: Clock) -> None:
    events = site.store.events
    last = events.last_position()
    clock.now += HOUR
    number, oldest = events.unsent(clock.now)
    assert (number, oldest >= 3600) == (last, True)
    events.set_relayed(last)
    assert events.unsent(clock.now) == (0, 0.0)
    site.store.channels.move("site", "production", 3, author="ann")
    clock.now += MINUTE
    assert events.unsent(clock.now) == (1, 60.0)


def test_versions_of_the_database_are_known(store: Store) -> None:
    versions = store.database_versions()
    assert set(versions) == ({"PostgreSQL", "PostGIS", "schema"} if store.is_shared else {"SQLite", "schema"})
    assert all(version[0].isdigit() for version in versions.values()), versions


def test_clock_of_the_database_is_compared(store: Store) -> None:
    offset = store.clock_offset()
    if not store.is_shared:
        assert offset is None
        return
    assert offset is not None
    assert abs(offset) < 60
