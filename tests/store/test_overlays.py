"""Overlays, kept on both databases."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest

from app.errors import Conflict, NotFound
from app.store import Store, overlays
from app.store.values import Overlay

NOW = datetime.now(UTC).replace(microsecond=0)
SQUARE = {"type": "Polygon", "coordinates": [[[0, 0], [1, 0], [1, 1.5], [0, 0]]]}


def blocked(**more: Any) -> Overlay:
    end = NOW + timedelta(seconds=60)
    return replace(Overlay("farm", "blocked", "ground", SQUARE, None, "local", "a tree", "r1", NOW, end), **more)


@pytest.fixture
def farm(store: Store) -> Store:
    store.create_environment("farm")
    return store


def test_an_overlay_waits_and_expires(farm: Store):
    first, new = farm.add_overlay(blocked())
    assert new
    assert first == blocked(id=first.id)
    later = NOW + timedelta(seconds=90)
    again, new = farm.add_overlay(blocked(expires=later, detail="still"))
    assert not new
    assert again == replace(first, expires=later, detail="still")
    edge, new = farm.add_overlay(blocked(polygon=None, crs=None, edge="a_b", created=NOW + timedelta(seconds=1)))
    assert new
    assert (edge.polygon, edge.edge) == (None, "a_b")
    other, new = farm.add_overlay(blocked(reporter="r2", created=NOW + timedelta(seconds=2)))
    assert new
    assert farm.overlays("farm") == [again, edge, other]
    assert farm.expire_overlays(NOW + timedelta(seconds=59)) == []
    assert len(farm.overlays("farm", "pending")) == 3
    assert farm.expire_overlays(NOW + timedelta(seconds=60)) == []
    assert [o.state for o in farm.overlays("farm")] == ["pending", "expired", "expired"]
    assert farm.overlays("farm", "expired")[0].decided == NOW + timedelta(seconds=60)
    with pytest.raises(NotFound):
        farm.overlay("farm", "none")
    farm.create_environment("yard")
    with pytest.raises(NotFound):
        farm.overlay("yard", first.id)


def test_decisions_are_taken_once(farm: Store):
    one, _ = farm.add_overlay(blocked())
    accepted = farm.decide_overlay("farm", one.id, "pending", "accepted", "ann", NOW)
    assert (accepted.state, accepted.decided_by, accepted.decided) == ("accepted", "ann", NOW)
    with pytest.raises(Conflict, match="is accepted"):
        farm.decide_overlay("farm", one.id, "pending", "rejected", "bob", NOW)
    end = NOW + timedelta(seconds=60)
    assert farm.expire_overlays(end) == [], "it is not in a version yet"
    noted = farm.note_overlay_version("farm", one.id, 7)
    assert noted == replace(accepted, version=7)
    assert farm.expire_overlays(NOW) == []
    assert farm.expire_overlays(end) == [noted]
    assert farm.decide_overlay("farm", one.id, "accepted", "ended", "ann", end).state == "ended"
    assert farm.expire_overlays(end) == []
    again, new = farm.add_overlay(blocked())
    assert new
    assert again.id != one.id


def test_overlays_are_bounded_and_tidied(farm: Store, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(overlays, "MAX_PENDING", 2)
    one, _ = farm.add_overlay(blocked(edge="1"))
    two, _ = farm.add_overlay(blocked(edge="2"))
    with pytest.raises(Conflict, match="2 overlays"):
        farm.add_overlay(blocked(edge="3"))
    assert farm.add_overlay(blocked(edge="2"))[0].id == two.id
    farm.decide_overlay("farm", one.id, "pending", "rejected", "ann", NOW - timedelta(days=31))
    farm.decide_overlay("farm", two.id, "pending", "rejected", "ann", NOW - timedelta(days=29))
    farm.collect(timedelta(hours=6))
    assert [o.id for o in farm.overlays("farm")] == [two.id]
    farm.delete_environment("farm")
    farm.purge_environment("farm")
    farm.create_environment("farm")
    assert farm.overlays("farm") == []


def test_what_went_into_a_version_is_accepted(farm: Store):
    """Two editors accept at once; the one who failed takes his decision back before the other's version is noted."""
    one, _ = farm.add_overlay(blocked())
    farm.decide_overlay("farm", one.id, "pending", "accepted", "ann", NOW)
    farm.decide_overlay("farm", one.id, "accepted", "pending", "bob", NOW)
    noted = farm.note_overlay_version("farm", one.id, 0)
    assert (noted.state, noted.version) == ("accepted", 0)
    assert [e.body["type"] for e in farm.events("farm")][-1] == "overlay.accepted"
    assert [o.id for o in farm.expire_overlays(NOW + timedelta(seconds=61))] == [one.id], "it is taken out again"


def test_of_very_many_the_newest_are_listed(farm: Store, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(overlays, "MAX_LISTED", 2)
    made = [farm.add_overlay(blocked(edge=f"e{k}", created=NOW + timedelta(seconds=k)))[0] for k in range(3)]
    assert [o.edge for o in farm.overlays("farm")] == ["e1", "e2"]
    assert made[0].edge == "e0"
