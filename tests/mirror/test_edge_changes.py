"""Closures and robots' statuses are accepted at the edge, also while it is cut off, and reach the centre in order."""

from __future__ import annotations

import base64
import itertools
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
import zenoh
from sqlalchemy import delete, insert, select

from app.errors import Unavailable
from app.events import messages
from app.mirror.follow import FULL_PASS
from app.mirror.process import MAX_PAUSE_SECONDS
from app.store import tables
from tests.api.conftest import Api, create_farm
from tests.events.conftest import Listener, client_config, eventually
from tests.mirror.conftest import Edge, mirror_token

Make = Callable[..., Edge]
_count = itertools.count(1)


@pytest.fixture
def farm(centre: Api) -> str:
    return create_farm(centre, f"yard-{next(_count)}")


def manifest(api: Api, env: str) -> dict[str, Any]:
    body: dict[str, Any] = api.get(f"environments/{env}/versions/latest/manifest?formats=tmap2").json()
    return body


def overlays(api: Api, env: str) -> list[dict[str, Any]]:
    body: list[dict[str, Any]] = api.get(f"environments/{env}/overlays").json()
    return body


def test_closures_of_the_edge_are_in_force_and_reach_the_centre(
    centre: Api, site: Api, farm: str, follower: Make
) -> None:
    edge = follower(farm)
    edge.follow()
    edge.wire.cut = True
    before = manifest(site, farm)
    path = f"environments/{farm}/overlays"
    pending = site.post(path, {"kind": "blocked", "edge": "gate_barn", "detail": "a tree"}).json()["id"]
    site.post(f"{path}/{pending}/accept", expect=200)
    second = site.post(path, {"kind": "blocked", "edge": "barn_field", "state": "accepted"}).json()["id"]
    site.post(f"{path}/{second}/end", expect=200)
    cut_off = manifest(site, farm)
    assert [o["id"] for o in cut_off["overlays"]] == [pending]
    assert (cut_off["sequence"], cut_off["edge_sequence"]) == (before["sequence"], 4)
    assert cut_off["files"] != before["files"], "the closed edge is not in the map"
    with pytest.raises(Unavailable):
        edge.mirror.run_once()
    assert site.get("/readyz").json()["mirror"]["state"] == "cut off"
    assert site.get("/readyz").json()["mirror"]["waiting"] == 4
    ours = overlays(site, farm)
    edge.wire.cut = False
    edge.follow()
    assert overlays(centre, farm) == ours == overlays(site, farm), "with ids, reporters and times of the edge"
    lines = centre.get(f"events?environment={farm}&since={before['sequence']}&follow=false").text.splitlines()
    kinds = [line.removeprefix("event: ") for line in lines if line.startswith("event: ")]
    assert kinds == ["overlay.created", "overlay.accepted", "overlay.accepted", "overlay.ended"]
    theirs, after = manifest(centre, farm), manifest(site, farm)
    assert after["files"] == theirs["files"] == cut_off["files"]
    assert (after["sequence"], after["overlays_digest"]) == (theirs["sequence"], theirs["overlays_digest"])
    assert site.get("/readyz").json()["mirror"]["waiting"] == 0


def test_change_is_applied_once_if_the_answer_is_lost(centre: Api, site: Api, farm: str, follower: Make) -> None:
    edge = follower(farm)
    edge.follow()
    path = f"environments/{farm}/overlays"
    one = site.post(path, {"kind": "blocked", "edge": "gate_barn"}).json()["id"]
    site.post(f"{path}/{one}/accept", expect=200)
    edge.wire.change = lambda path, body: b"<html>" if path.endswith("/reports") else body
    assert "no JSON" in edge.mirror.run_once().failures[farm]
    events = centre.app.state.services.store.events
    sequence = events.last_sequence(farm)
    edge.wire.change = None
    edge.follow()
    assert events.last_sequence(farm) == sequence
    assert overlays(centre, farm) == overlays(site, farm)


def test_decision_of_the_centre_counts(centre: Api, site: Api, farm: str, follower: Make) -> None:
    edge = follower(farm)
    path = f"environments/{farm}/overlays"
    one = centre.post(path, {"kind": "blocked", "edge": "gate_barn"}).json()["id"]
    edge.follow()
    centre.post(f"{path}/{one}/reject", expect=200)
    site.post(f"{path}/{one}/accept", expect=200)
    closed = manifest(site, farm)
    edge.follow()
    assert overlays(site, farm) == overlays(centre, farm)
    assert overlays(site, farm)[0]["state"] == "rejected"
    after = manifest(site, farm)
    assert after["files"] != closed["files"]
    position = (after["sequence"], after["edge_sequence"])
    assert position > (closed["sequence"], closed["edge_sequence"]), "robots take the map without the closure"


def status(env: str, version: int, state: str, **more: Any) -> dict[str, Any]:
    return {"environment": env, "channel": "latest", "version": version, "root": "a" * 64, "state": state, **more}


def test_statuses_reach_the_centre_in_order(centre: Api, site: Api, farm: str, follower: Make) -> None:
    edge = follower(farm)
    edge.follow()
    edge.wire.cut = True
    for version, state in ((1, "downloading"), (1, "ready"), (1, "active"), (2, "failed")):
        more = {"pose": {"x": 1.0, "y": 2.0, "yaw": 0.5}} if state == "failed" else {}
        site("PUT", "robots/mower-1/status", 200, json=status(farm, version, state, **more))
    here = site.get(f"robots/mower-1?environment={farm}").json()
    edge.wire.cut = False
    edge.follow()
    there = centre.get(f"robots/mower-1?environment={farm}").json()
    assert [(line["state"], line["received"]) for line in there["history"]] == [
        (line["state"], line["received"]) for line in here["history"]
    ]
    for member in ("state", "version", "received", "holds"):
        assert there[member] == here[member], member
    assert there["place"]["pose"] == here["place"]["pose"]
    edge.follow()
    again = centre.get(f"robots/mower-1?environment={farm}").json()
    assert len(again["history"]) == 4, "nothing is stored twice"


def test_statuses_that_the_centre_refuses_are_reported(centre: Api, site: Api, farm: str, follower: Make) -> None:
    edge = follower(farm)
    edge.follow()
    rights = edge.centre._headers
    edge.centre._headers = {"authorization": f"Bearer {mirror_token(centre, 'another-*')}"}
    for version in (1, 2):
        site("PUT", "robots/mower-9/status", 200, json=status(farm, version, "active"))
    edge.mirror.run_once()
    assert site.get("/readyz").json()["mirror"]["skipped"] == 2
    assert farm not in site.get("/readyz").text, "anybody may read it"
    text = site.get("/metrics").text
    assert f'fleetmap_mirror_skipped_statuses{{environment="{farm}"}} 2.0' in text
    listed = site.app.state.services.store.mirrors.describe()["environments"]
    assert "statuses are skipped" in next(one["problem"] for one in listed if one["name"] == farm)
    edge.centre._headers = rights
    site("PUT", "robots/mower-9/status", 200, json=status(farm, 3, "active"))
    edge.follow()
    assert "skipped" not in site.get("/readyz").json()["mirror"]
    there = centre.get(f"robots/mower-9?environment={farm}").json()
    assert [line["version"] for line in there["history"]] == [3], "the others are lost to the centre"
    values = dict(line.rsplit(" ", 1) for line in site.get("/metrics").text.splitlines() if "fleetmap_mirror" in line)
    assert float(values["fleetmap_mirror_events_behind"]) == 0
    assert 0 <= float(values["fleetmap_mirror_contact_age_seconds"]) < 3600
    assert float(values['fleetmap_mirror_bytes_total{direction="received"}']) >= edge.centre.received > 0
    assert float(values['fleetmap_mirror_bytes_total{direction="sent"}']) >= edge.centre.sent > 0
    assert float(values["fleetmap_mirror_permission_seconds"]) > 3600


def test_late_status_is_history(centre: Api, site: Api, farm: str, follower: Make) -> None:
    edge = follower(farm)
    edge.follow()
    site("PUT", "robots/mower-2/status", 200, json=status(farm, 1, "active"))
    centre("PUT", "robots/mower-2/status", 200, json=status(farm, 3, "active"))
    edge.follow()
    there = centre.get(f"robots/mower-2?environment={farm}").json()
    assert there["version"] == 3
    assert sorted(line["version"] for line in there["history"]) == [1, 3]


def test_statuses_that_are_stored_late_reach_the_centre(
    centre: Api, site: Api, farm: str, follower: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of two processes that store reports at once, the first one to read its clock and its row may commit last."""
    edge, database = follower(farm), site.app.state.services.store._database
    edge.follow()
    for robot, version in (("mower-3", 1), ("mower-4", 1), ("mower-3", 2)):
        site("PUT", f"robots/{robot}/status", 200, json=status(farm, version, "active"))
    history, present = tables.robot_history, tables.robot
    with database.write() as connection:  # as if mower-4's report was not committed yet
        rows = {}
        for table in (history, present):
            rows[table] = connection.execute(select(table).where(table.c.robot == "mower-4")).one()._asdict()
            connection.execute(delete(table).where(table.c.robot == "mower-4"))
    edge.follow()
    centre("GET", f"robots/mower-4?environment={farm}", 404)
    with database.write() as connection:
        for table, values in rows.items():
            connection.execute(insert(table).values(values))
    later = database.now() + timedelta(seconds=MAX_PAUSE_SECONDS)
    monkeypatch.setattr(database, "now", lambda: later)
    edge.follow()
    there = centre.get(f"robots/mower-4?environment={farm}").json()
    assert (there["version"], len(there["history"])) == (1, 1)
    assert len(centre.get(f"robots/mower-3?environment={farm}").json()["history"]) == 2
    edge.wire.paths.clear()
    edge.follow()
    assert not any(path.endswith("/reports") for path in edge.wire.paths), "what was handed on is not sent again"


def test_pass_ends_while_robots_report(
    centre: Api, site: Api, farm: str, follower: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.mirror.statuses.PASS_SECONDS", 0.0)
    edge, arrivals = follower(farm), itertools.count()
    edge.follow()

    def report(path: str, body: bytes) -> bytes:
        if path.endswith("/reports") and (number := next(arrivals)) < 20:
            site("PUT", "robots/mower-5/status", 200, json=status(farm, number % 2 + 1, "active"))
        return body

    site("PUT", "robots/mower-5/status", 200, json=status(farm, 3, "active"))
    edge.wire.change = report
    edge.follow()
    assert next(arrivals) < 20, "the rest waits for the next pass"
    edge.wire.change = None
    edge.follow()
    there, here = (api.get(f"robots/mower-5?environment={farm}").json() for api in (centre, site))
    assert there["version"] == here["version"]


def test_change_that_the_centre_cannot_take_holds_up_no_environment(
    centre: Api, site: Api, farm: str, follower: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    edge = follower(farm)
    edge.follow()
    site.post(f"environments/{farm}/overlays", {"kind": "blocked", "edge": "gate_barn", "state": "accepted"})
    title = {"title": "Renamed"}
    centre("PATCH", f"environments/{farm}", 200, json=title)
    edge.now = lambda: datetime.now(UTC) + FULL_PASS
    send = edge.centre.report
    damaged = Unavailable("a version is damaged")

    def fail(environment: str, **more: Any) -> Any:
        if more.get("changes"):
            raise damaged
        return send(environment, **more)

    monkeypatch.setattr(edge.centre, "report", fail)
    assert edge.mirror.run_once().failures == {farm: damaged.detail}
    assert site.get(f"environments/{farm}").json()["title"] == "Renamed", "what the centre has arrives all the same"
    monkeypatch.undo()
    edge.follow()
    assert [one["state"] for one in overlays(centre, farm)] == ["accepted"]


def test_planned_move_happens_at_a_mirror_that_is_cut_off(centre: Api, site: Api, farm: str, follower: Make) -> None:
    channel = f"environments/{farm}/channels/production"
    centre("PUT", channel, 200, json={"version": 2})
    edge = follower(farm)
    at = datetime.now(UTC) + timedelta(days=1)
    centre("PUT", channel, 200, json={"version": 3, "activate_at": at.isoformat()})
    edge.follow()
    store = site.app.state.services.store
    store.channels.apply_due_moves(at + timedelta(seconds=1))
    moved = next(c for c in store.channels.all(farm) if c.name == "production")
    assert (moved.version, moved.planned) == (3, None)
    theirs = centre.app.state.services.store
    theirs.channels.apply_due_moves(at + timedelta(seconds=1))
    edge.follow()
    assert [c for c in store.channels.all(farm) if c.name == "production"] == [
        c for c in theirs.channels.all(farm) if c.name == "production"
    ]


def test_closure_ends_at_its_time_while_cut_off(centre: Api, site: Api, farm: str, follower: Make) -> None:
    edge = follower(farm)
    centre.post(f"environments/{farm}/overlays", {"kind": "blocked", "edge": "gate_barn", "state": "accepted"})
    edge.follow()
    store = site.app.state.services.store
    store.overlays.end_due(datetime.now(UTC) + timedelta(days=400))
    assert overlays(site, farm)[0]["state"] == "ended"
    assert manifest(site, farm)["edge_sequence"] == 1
    assert store.edge_changes.count_waiting() == 0, "the centre ends it by itself"


def test_edge_publishes_events_of_both(centre: Api, site: Api, port: int, farm: str, follower: Make) -> None:
    eventually(lambda: site.get("/readyz").json()["events"]["state"] == "connected")
    with zenoh.open(client_config(port)) as session:
        listener = Listener(session, messages.events_key("fleetmap", farm))
        edge = follower(farm)
        edge.follow()
        centre("PUT", f"environments/{farm}/channels/production", 200, json={"version": 2})
        edge.follow()
        listener.wait(lambda one: len(one.events) >= 5)
        site.post(f"environments/{farm}/overlays", {"kind": "blocked", "edge": "gate_barn", "state": "accepted"})
        listener.wait(lambda one: len(one.events) >= 6)
        edge.follow()
        listener.wait(lambda one: one.events[-1]["sequence"] == 6)
        shown = [(event["sequence"], event.get("edge_sequence")) for event in listener.events]
        assert list(dict.fromkeys(shown)) == [(1, None), (2, None), (3, None), (4, None), (5, None), (5, 1), (6, None)]


def test_invalid_report_of_an_edge_is_refused(centre: Api, farm: str) -> None:
    edge = centre.as_(mirror_token(centre))
    now = datetime.now(UTC).isoformat()
    overlay = {"id": "ab", "kind": "blocked", "level": "ground", "reporter": "r", "created": now, "expires": now}
    shapes: list[dict[str, Any]] = [
        {},
        {"edge": "gate_barn", "polygon": {"type": "Polygon", "coordinates": []}},
        {"polygon": {"type": "Point", "coordinates": [0, 0]}, "crs": "local"},
        {"polygon": {"type": "Polygon", "coordinates": [[[0, 0], [1, 1], [1, 0], [0, 1], [0, 0]]]}, "crs": "local"},
    ]
    changes = [
        {"event": "overlay.accepted", "overlay": {**overlay, **shape}, "author": "r", "time": now} for shape in shapes
    ]
    changes.append({**changes[0], "event": "overlay.expired", "overlay": {**overlay, "edge": "gate_barn"}})
    statuses = [{"robot": "r1", "status": {"state": "flying"}, "received": now, "vouched": True}]
    path = f"environments/{farm}/mirror/reports"
    outcome = edge.post(path, {"statuses": statuses, "changes": changes}, 200).json()
    assert "state must be" in outcome["statuses"][0]
    assert [result["overlay"] for result in outcome["changes"]] == [None] * 5
    assert all(result["problem"] for result in outcome["changes"])
    assert overlays(centre, farm) == []
    audit = centre.get(f"audit?environment={farm}").json()
    assert not any("mirror/reports" in entry["path"] for entry in audit)
    key = base64.b64encode(bytes(32)).decode()
    edge.post("mirror/delegations", {"public_key": key, "environments": [farm]}, 200)
    assert centre.get("audit").json()[0]["path"].endswith("/mirror/delegations"), "a permission to sign is recorded"
