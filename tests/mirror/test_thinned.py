"""A mirror takes over that versions were thinned, but never of what a robot there holds."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from datetime import UTC, datetime, timedelta

import pytest
from sqlalchemy import text

from app.errors import Mirrored, Thinned
from app.mirror.follow import FULL_PASS
from app.store.fleet_values import ReceivedReport, RobotReport
from app.store.retention_rule import Rule
from app.store.store import Store
from tests.api import samples
from tests.api.conftest import Api, create_farm
from tests.mirror.conftest import Edge
from tests.mirror.test_mirror import rows

Make = Callable[..., Edge]
RULE = Rule(all_days=1, daily_days=0, last=1)
_count = itertools.count(1)


@pytest.fixture
def farm(centre: Api) -> str:
    """Environment with seven versions."""
    name = create_farm(centre, f"thin-{next(_count)}")
    while centre.get(f"environments/{name}/versions").json()[0]["version"] < 7:
        k = next(_count)
        centre.upload(name, {"n.tmap2.yaml": samples.tmap2({n: (x + k, y) for n, (x, y) in samples.NODES.items()})})
    return name


def store_of(centre: Api) -> Store:
    store: Store = centre.app.state.services.store
    return store


def thin(store: Store, name: str) -> list[int]:
    """Thin an environment, as if all of its versions were old."""
    with store._database.write() as connection:
        mine = "environment_id = (SELECT id FROM environment WHERE name = :name)"
        connection.execute(text(f"UPDATE version SET time = '2020-01-01 00:00:00.000000' WHERE {mine}"), {"name": name})
        connection.execute(text(f"DELETE FROM idempotency WHERE {mine}"), {"name": name})
    plan = next(p for p in store.retention.plan(RULE) if p.environment == name)
    return sorted(n for one in store.retention.apply(plan, RULE) for n in one.versions)


def later(edge: Edge) -> None:
    """Follow after the interval at which environments without events are compared."""
    edge.now = lambda: datetime.now(UTC) + FULL_PASS
    edge.follow()


def test_new_mirror_takes_over_thinned_history(centre: Api, farm: str, alone: Make, monkeypatch: pytest.MonkeyPatch):
    """In pages of two versions, so that some would end with a thinned one."""
    monkeypatch.setattr("app.store.mirror_source.MAX_VERSIONS", 2)
    centre("PUT", f"environments/{farm}/versions/4/tags/season", 200)
    assert thin(store_of(centre), farm) == [1, 2, 3, 5, 6]
    store_of(centre).garbage.collect(timedelta(0))
    edge = alone(farm)
    edge.follow()
    assert rows(edge.store, farm) == rows(store_of(centre), farm)
    assert [v.tags for v in edge.store.versions.page(farm) if v.tags] == [("season",)]
    assert edge.store.verifier().run().findings == []
    with pytest.raises(Thinned, match="version 5 of"):
        edge.store.versions.get(farm, 5)
    assert [p.environment for p in edge.store.retention.plan(RULE)] == [], "the centre decides"
    with pytest.raises(Mirrored):
        edge.store.tags.add(farm, 4, "mine", author="ann")


def test_new_mirror_after_thinning_gets_what_is_left(centre: Api, farm: str, alone: Make):
    """Though the centre has named the content of the same versions before, to another mirror."""
    alone(farm, folder="first").follow()
    assert thin(store_of(centre), farm) == [1, 2, 3, 4, 5, 6]
    store_of(centre).garbage.collect(timedelta(0))
    second = alone(farm, folder="second")
    second.follow()
    assert rows(second.store, farm) == rows(store_of(centre), farm)
    assert second.store.verifier().run().findings == []


def test_mirror_thins_what_its_centre_has_thinned_since(centre: Api, farm: str, alone: Make):
    edge = alone(farm)
    edge.follow()
    held = edge.store.versions.get(farm, 3)
    robot = RobotReport("latest", 3, held.root, "active")
    assert thin(store_of(centre), farm) == [1, 2, 3, 4, 5, 6]
    edge.wire.paths.clear()
    assert edge.store.robots.note_reports([ReceivedReport(farm, "r1", robot, datetime.now(UTC))]) == [None]
    later(edge)
    gone = [v.number for v in edge.store.versions.page(farm) if v.thinned is not None]
    assert gone == [6, 5, 4, 2, 1], "its robot holds version 3, which the centre did not know"
    assert not any(path.endswith("/content") for path in edge.wire.paths)
    edge.store.garbage.collect(timedelta(0))
    assert edge.store.content.load(edge.store.versions.get(farm, 3)).parts
    assert edge.store.verifier().run().findings == []
    kept = thin(store_of(centre), farm)
    assert kept == [], "nothing is left to thin"
    centre.upload(farm, {"n.tmap2.yaml": samples.tmap2()})
    edge.follow()
    assert edge.store.versions.get(farm).number == 8
    mine, theirs = rows(edge.store, farm), rows(store_of(centre), farm)
    assert mine["environment"] == theirs["environment"]
