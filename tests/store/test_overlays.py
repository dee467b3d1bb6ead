"""Overlays and closures, on both databases."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest

from app.errors import Conflict, NotFound
from app.model.closures import NO_CLOSURES
from app.store import overlays
from app.store.fleet_values import Overlay
from app.store.store import Store
from app.store.values import Position

NOW = datetime.now(UTC).replace(microsecond=0)
SQUARE = {"type": "Polygon", "coordinates": [[[0, 0], [1, 0], [1, 1.5], [0, 0]]]}


def blocked(**more: Any) -> Overlay:
    end = NOW + timedelta(seconds=60)
    return replace(Overlay("farm", "blocked", "ground", SQUARE, None, "local", "a tree", "r1", NOW, end), **more)


@pytest.fixture
def farm(store: Store) -> Store:
    store.environments.create("farm")
    return store


def test_pending_overlay_expires(farm: Store):
    first, new = farm.overlays.add(blocked())
    assert new
    assert first == blocked(id=first.id)
    later = NOW + timedelta(seconds=90)
    again, new = farm.overlays.add(blocked(expires=later, detail="still"))
    assert not new
    assert again == replace(first, expires=later, detail="still")
    edge, new = farm.overlays.add(blocked(polygon=None, crs=None, edge="a_b", created=NOW + timedelta(seconds=1)))
    assert new
    assert (edge.polygon, edge.edge) == (None, "a_b")
    other, new = farm.overlays.add(blocked(reporter="r2", created=NOW + timedelta(seconds=2)))
    assert new
    assert farm.overlays.all("farm") == [again, edge, other]
    farm.overlays.end_due(NOW + timedelta(seconds=59))
    assert len(farm.overlays.all("farm", "pending")) == 3
    farm.overlays.end_due(NOW + timedelta(seconds=60))
    assert [o.state for o in farm.overlays.all("farm")] == ["pending", "expired", "expired"]
    assert farm.overlays.all("farm", "expired")[0].decided == NOW + timedelta(seconds=60)
    with pytest.raises(NotFound):
        farm.overlays.get("farm", "none")
    farm.environments.create("yard")
    with pytest.raises(NotFound):
        farm.overlays.get("yard", first.id)


def test_accepted_overlay_is_in_force_until_end_with_events(farm: Store):
    one, _ = farm.overlays.add(blocked())
    assert farm.overlays.closures("farm").items == ()
    before = farm.events.last_sequence("farm")
    accepted = farm.overlays.decide("farm", one.id, "pending", "accepted", "ann", NOW)
    assert (accepted.state, accepted.decided_by, accepted.decided) == ("accepted", "ann", NOW)
    with pytest.raises(Conflict, match="is accepted"):
        farm.overlays.decide("farm", one.id, "pending", "rejected", "bob", NOW)
    in_force = farm.overlays.closures("farm")
    assert [c.id for c in in_force.items] == [one.id]
    assert farm.channels.target("farm", "latest") == (
        replace(farm.versions.get("farm"), closures=in_force),
        Position(before + 1),
    )
    assert farm.channels.target("farm", 0) == (farm.versions.get("farm", 0), Position(1)), (
        "a version's number is history"
    )
    assert farm.channels.target("farm", 0, "apply")[0].closures == in_force
    end = NOW + timedelta(seconds=60)
    farm.overlays.end_due(NOW)
    assert farm.overlays.get("farm", one.id).state == "accepted"
    farm.overlays.end_due(end)
    assert (farm.overlays.get("farm", one.id).state, farm.overlays.closures("farm").items) == ("ended", ())
    assert farm.channels.target("farm", "latest")[1] == Position(before + 2)
    events = [(e.body["type"], e.body.get("overlays_digest")) for e in farm.events.page("farm", before)]
    assert events == [("overlay.accepted", in_force.digest), ("overlay.ended", NO_CLOSURES.digest)]
    again, new = farm.overlays.add(blocked())
    assert new
    assert again.id != one.id


def test_editor_creates_accepted_overlay_with_one_event(farm: Store, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(overlays, "MAX_IN_FORCE", 1)
    one, _ = farm.overlays.add(blocked(state="accepted", decided_by="ann", decided=NOW))
    assert [e.body["type"] for e in farm.events.page("farm", 1)] == ["overlay.accepted"]
    assert [c.id for c in farm.overlays.closures("farm").items] == [one.id]
    with pytest.raises(Conflict, match="farm has reached the limit of 1 overlays in force"):
        farm.overlays.add(blocked(state="accepted"))
    waits, _ = farm.overlays.add(blocked(reporter="r9"))
    with pytest.raises(Conflict, match="in force"):
        farm.overlays.decide("farm", waits.id, "pending", "accepted", "ann", NOW)


def test_kept_overlay_names_its_version_and_stays_in_force(farm: Store):
    one, _ = farm.overlays.add(blocked(state="accepted"))
    assert farm.overlays.note_kept("farm", one.id, 7) == replace(one, version=7)
    assert [c.id for c in farm.overlays.closures("farm").items] == [one.id]
    farm.overlays.end_due(NOW + timedelta(seconds=60))
    assert farm.overlays.get("farm", one.id).state == "ended"


def test_closures_in_force_are_bounded_in_bytes(farm: Store, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(overlays, "MAX_IN_FORCE_BYTES", 100)
    farm.overlays.add(blocked(state="accepted"))
    with pytest.raises(Conflict, match="simplify the polygon"):
        farm.overlays.add(blocked(state="accepted"))


def test_overlays_are_bounded_and_tidied(farm: Store, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(overlays, "MAX_PENDING", 2)
    one, _ = farm.overlays.add(blocked(edge="1"))
    two, _ = farm.overlays.add(blocked(edge="2"))
    with pytest.raises(Conflict, match="2 pending"):
        farm.overlays.add(blocked(edge="3"))
    assert farm.overlays.add(blocked(edge="2"))[0].id == two.id
    farm.overlays.decide("farm", one.id, "pending", "rejected", "ann", NOW - timedelta(days=31))
    farm.overlays.decide("farm", two.id, "pending", "rejected", "ann", NOW - timedelta(days=29))
    farm.garbage.collect(timedelta(hours=6))
    assert [o.id for o in farm.overlays.all("farm")] == [two.id]
    farm.environments.delete("farm")
    farm.environments.purge("farm")
    farm.environments.create("farm")
    assert farm.overlays.all("farm") == []


def test_overlay_list_is_limited_to_newest(farm: Store, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(overlays, "MAX_LISTED", 2)
    overlay_list = [farm.overlays.add(blocked(edge=f"e{k}", created=NOW + timedelta(seconds=k)))[0] for k in range(3)]
    assert [o.edge for o in farm.overlays.all("farm")] == ["e1", "e2"]
    assert overlay_list[0].edge == "e0"
