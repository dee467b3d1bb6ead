"""What robots report as blocked, and what editors make of it."""

from __future__ import annotations

import json
import math
import time
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest

from app.api.overlays import end_overlays
from app.errors import Unavailable
from app.events.messages import Event
from app.fleet import overlays
from tests.api.conftest import Api

SQUARE = {"type": "Polygon", "coordinates": [[[1, 1], [4, 1], [4, 3], [1, 3], [1, 1]]]}


def edge(api: Api, env: str, name: str, version: str = "latest") -> dict[str, Any]:
    features = api.get(f"environments/{env}/versions/{version}/layers/topology?crs=local").json()["features"]
    found: dict[str, Any] = next(f for f in features if f["id"] == name)
    return found


def zones(api: Api, env: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = api.get(f"environments/{env}/versions/latest/layers/zones?crs=local").json()[
        "features"
    ]
    return found


def told_of(api: Api, env: str) -> list[dict[str, Any]]:
    """The events after the farm's own, as a client reads them."""
    lines = api.get(f"events?environment={env}&since=4&follow=false").text.splitlines()
    events = [json.loads(line[5:]) for line in lines if line.startswith("data:")]
    assert [e["sequence"] for e in events] == list(range(5, 5 + len(events)))
    return events


def until(condition: Any) -> Any:
    deadline = time.monotonic() + 20
    while not (found := condition()):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    return found


def test_a_blocked_polygon_becomes_a_keepout_and_goes_again(api: Api, farm: str) -> None:
    url = f"environments/{farm}/overlays"
    robot = api.token_for("robot", robot="mower-7", environments=farm)
    said = {"kind": "blocked", "polygon": SQUARE, "crs": "local", "ttl_seconds": 4, "detail": "a trailer"}
    told = robot.post(url, said).json()
    assert {k: told[k] for k in ("state", "reporter", "detail", "polygon", "crs", "level")} == {
        "state": "pending", "reporter": "mower-7", "detail": "a trailer", "polygon": SQUARE, "crs": "local",
        "level": "ground",
    }  # fmt: skip
    assert robot.post(url, said, 200).json()["id"] == told["id"]
    assert api.get(f"environments/{farm}").json()["version"] == 3, "no map changes by a report"
    robot.problem("POST", f"{url}/{told['id']}/accept", 403)
    robot.problem("POST", f"{url}/{told['id']}/reject", 403)
    accepted = api.post(f"{url}/{told['id']}/accept", expect=200).json()
    assert (accepted["state"], accepted["version"], accepted["decided_by"]) == ("accepted", 4, "administrator")
    (zone,) = zones(api, farm)
    assert zone["properties"] == {
        "kind": "keepout", "expires": accepted["expires"],
        "overlay": {"id": told["id"], "reporter": "mower-7", "detail": "a trailer"},
    }  # fmt: skip
    assert "reported by mower-7" in api.get(f"environments/{farm}/versions/4").json()["message"]
    mask = api.get(f"environments/{farm}/versions/4/maps/occupancy_grid/keepout.pgm").content
    assert mask.startswith(b"P5")
    api.problem("POST", f"{url}/{told['id']}/accept", 409)
    until(lambda: api.get(f"{url}?state=ended").json())
    assert zones(api, farm) == []
    assert api.get(f"environments/{farm}").json()["version"] == 5
    assert api.get(f"{url}?state=pending").json() == []
    events = told_of(api, farm)
    assert [(e["type"], e["version"]) for e in events] == [
        ("overlay.created", 3), ("version.created", 4), ("overlay.accepted", 4), ("version.created", 5),
        ("overlay.ended", 5),
    ]  # fmt: skip
    assert events[0]["overlay"] == told
    assert (events[0]["author"], events[0]["layers"], events[0]["previous"]) == ("mower-7", [], None)
    assert events[2]["overlay"] == accepted
    assert events[2]["root"] == events[1]["root"] == api.get(f"environments/{farm}/versions/4").json()["root"]
    assert events[4]["overlay"]["state"] == "ended"


def test_a_blocked_edge(api: Api, farm: str) -> None:
    url = f"environments/{farm}/overlays"
    before = edge(api, farm, "gate_barn")
    told = api.post(url, {"kind": "blocked", "edge": "gate_barn", "ttl_seconds": 3}).json()
    accepted = api.post(f"{url}/{told['id']}/accept", expect=200).json()
    now = edge(api, farm, "gate_barn")
    assert now["properties"] == {**before["properties"], "blocked": True, "blocked_until": accepted["expires"]}
    assert now["place"] == before["place"]
    until(lambda: api.get(f"{url}?state=ended").json())
    assert edge(api, farm, "gate_barn") == before
    roots = [api.get(f"environments/{farm}/versions/{v}").json()["root"] for v in (3, 5)]
    assert roots[0] == roots[1], "nothing of it stays"


@pytest.mark.parametrize("first", [2, 3600])
def test_an_edge_that_two_report_is_blocked_until_the_later_end(api: Api, farm: str, first: int) -> None:
    url = f"environments/{farm}/overlays"
    before = edge(api, farm, "gate_barn")
    said = {}
    for seconds in (first, 3602 - first):
        robot = api.token_for("robot", robot=f"for-{seconds}")
        said[seconds] = robot.post(url, {"kind": "blocked", "edge": "gate_barn", "ttl_seconds": seconds}).json()
        api.post(f"{url}/{said[seconds]['id']}/accept", expect=200)
    until(lambda: [o["id"] for o in api.get(f"{url}?state=ended").json()] == [said[2]["id"]])
    assert edge(api, farm, "gate_barn")["properties"]["blocked_until"] == said[3600]["expires"]
    end_overlays(api.app.state.services, datetime.now(UTC) + timedelta(hours=2))
    assert edge(api, farm, "gate_barn") == before


def test_what_an_editor_blocked_stays_blocked(api: Api, farm: str) -> None:
    """An overlay's end does not free an edge that is blocked without an end."""
    url = f"environments/{farm}/overlays"
    feature = edge(api, farm, "gate_barn")
    feature["properties"]["blocked"] = True
    feature["properties"].pop("level", None)
    put = {"op": "put", "layer": "topology", "level": "ground", "feature": feature}
    api.post(f"environments/{farm}/edits", {"changes": [put]})
    told = api.post(url, {"kind": "blocked", "edge": "gate_barn", "ttl_seconds": 1}).json()
    assert api.post(f"{url}/{told['id']}/accept", expect=200).json()["version"] == 4
    until(lambda: api.get(f"{url}?state=ended").json())
    assert edge(api, farm, "gate_barn")["properties"]["blocked"] is True
    assert api.get(f"environments/{farm}").json()["version"] == 4


def test_what_others_write_meanwhile_is_not_put_back(api: Api, farm: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between an acceptance's look at the edge and its version an editor changes the same edge."""
    url = f"environments/{farm}/overlays"
    told = api.post(url, {"kind": "blocked", "edge": "gate_barn"}).json()
    feature = edge(api, farm, "gate_barn")
    feature["properties"] |= {"surface": "gravel"}
    feature["properties"].pop("level", None)
    put = {"op": "put", "layer": "topology", "level": "ground", "feature": feature}
    look, meanwhile = overlays.edge_of, iter([put])

    def slow(*args: Any) -> Any:
        found = look(*args)
        for change in meanwhile:
            api.as_(api.token).post(f"environments/{farm}/edits", {"changes": [change]})
        return found

    monkeypatch.setattr(overlays, "edge_of", slow)
    assert api.post(f"{url}/{told['id']}/accept", expect=200).json()["version"] == 5
    now = edge(api, farm, "gate_barn")["properties"]
    assert (now["surface"], now["blocked"]) == ("gravel", True)


def test_a_polygon_is_kept_without_what_came_along(api: Api, farm: str, bare: str) -> None:
    url = f"environments/{farm}/overlays"
    said = {"kind": "blocked", "crs": "local", "polygon": {**SQUARE, "properties": {"x": "y" * 5000}, "crs": {}}}
    assert api.post(url, said).json()["polygon"] == SQUARE
    assert api.post(url, {**said, "polygon": SQUARE}, 200).json()["polygon"] == SQUARE
    round_ = [[math.cos(k / 500 * math.pi), math.sin(k / 500 * math.pi)] for k in range(1000)]
    told = api.problem("POST", url, 422, json={**said, "polygon": {"type": "Polygon", "coordinates": [round_]}})
    assert "1001 points" in told["detail"]
    told = api.problem("POST", url, 422, json={**said, "level": "attic"})
    assert "it has ground" in told["detail"]
    assert (
        "no datum" in api.problem("POST", f"environments/{bare}/overlays", 422, json={**said, "crs": "wgs84"})["detail"]
    )


def test_one_that_goes_wild_leaves_room(api: Api, farm: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.store.overlays.MAX_OF_ONE", 3)
    url = f"environments/{farm}/overlays"
    wild, calm = (api.token_for("robot", robot=name) for name in ("wild", "calm"))
    squares = [{"type": "Polygon", "coordinates": [[[k, 0], [k + 1, 0], [k, 1], [k, 0]]]} for k in range(4)]
    bodies = [{"kind": "blocked", "polygon": square, "crs": "local"} for square in squares]
    for body in bodies[:3]:
        wild.post(url, body)
    assert "wild" in wild.problem("POST", url, 409, json=bodies[3])["detail"]
    wild.post(url, bodies[0], 200)
    calm.post(url, bodies[3])


def test_undecided_overlays_expire(api: Api, farm: str) -> None:
    url = f"environments/{farm}/overlays"
    told = api.post(url, {"kind": "blocked", "edge": "gate_barn", "ttl_seconds": 1}).json()
    until(lambda: api.get(f"{url}?state=expired").json())
    api.problem("POST", f"{url}/{told['id']}/accept", 409)
    assert api.get(f"environments/{farm}").json()["version"] == 3
    other = api.post(url, {"kind": "blocked", "edge": "gate_barn"}).json()
    assert api.post(f"{url}/{other['id']}/reject", expect=200).json()["state"] == "rejected"
    api.problem("POST", f"{url}/{other['id']}/accept", 409)
    assert [o["state"] for o in api.get(url).json()] == ["expired", "rejected"]
    kinds = [(e["type"], e["overlay"]["id"]) for e in told_of(api, farm)]
    assert kinds == [
        ("overlay.created", told["id"]), ("overlay.expired", told["id"]),
        ("overlay.created", other["id"]), ("overlay.rejected", other["id"]),
    ]  # fmt: skip
    assert Event.from_json(json.dumps(told_of(api, farm)[1])).type == "overlay.expired"


def test_an_acceptance_that_was_cut_off_ends_as_well(api: Api, farm: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """kill -9 after the version and before it was noted: the edge does not stay blocked."""
    url = f"environments/{farm}/overlays"
    before = edge(api, farm, "gate_barn")
    told = api.post(url, {"kind": "blocked", "edge": "gate_barn", "ttl_seconds": 2}).json()
    store = api.app.state.services.store

    def cut_off(*_: Any) -> Any:
        raise Unavailable("gone")

    with monkeypatch.context() as patch:
        patch.setattr(type(store), "note_overlay_version", cut_off)
        api.problem("POST", f"{url}/{told['id']}/accept", 503)
    assert edge(api, farm, "gate_barn")["properties"]["blocked"] is True
    later = datetime.now(UTC) + timedelta(seconds=50)
    assert told["id"] not in {o.id for o in store.expire_overlays(later)}, "somebody may be at it"
    end_overlays(api.app.state.services, datetime.now(UTC) + timedelta(seconds=70))
    assert edge(api, farm, "gate_barn") == before
    assert [o["state"] for o in api.get(url).json()] == ["ended"]


def test_a_zone_that_an_editor_removed_is_not_missed(api: Api, farm: str) -> None:
    url = f"environments/{farm}/overlays"
    said = {"kind": "blocked", "polygon": SQUARE, "crs": "local", "ttl_seconds": 2}
    told = api.post(url, said).json()
    api.post(f"{url}/{told['id']}/accept", expect=200)
    gone = {"op": "delete", "layer": "zones", "id": f"overlay-{told['id']}"}
    api.post(f"environments/{farm}/edits", {"changes": [gone]})
    until(lambda: api.get(f"{url}?state=ended").json())
    assert api.get(f"environments/{farm}").json()["version"] == 5


def test_refusals(api: Api, farm: str, bare: str) -> None:
    url = f"environments/{farm}/overlays"
    line = {"type": "LineString", "coordinates": [[0, 0], [1, 1]]}
    for bad in (
        {}, {"kind": "blocked"}, {"kind": "open", "edge": "gate_barn"}, {"kind": "blocked", "edge": "no_such"},
        {"kind": "blocked", "edge": "gate"}, {"kind": "blocked", "edge": "gate_barn", "polygon": SQUARE},
        {"kind": "blocked", "polygon": line}, {"kind": "blocked", "polygon": {"type": "Polygon"}},
        {"kind": "blocked", "edge": "gate_barn", "ttl_seconds": 0}, {"kind": "blocked", "edge": "gate_barn", "x": 1},
    ):  # fmt: skip
        api.problem("POST", url, 422, json=bad)
    good = {"kind": "blocked", "edge": "gate_barn"}
    api.token_for("viewer").problem("POST", url, 403, json=good)
    api.token_for("robot", robot="r", environments=bare).problem("POST", url, 403, json=good)
    api.problem("POST", f"{url}/none/accept", 404)
    api.problem("GET", f"{url}?state=odd", 422)
    api.problem("GET", "environments/nowhere/overlays", 404)
    assert api.get(url).json() == []


def test_what_cannot_be_accepted_waits_on(api: Api, farm: str, monkeypatch: pytest.MonkeyPatch) -> None:
    url = f"environments/{farm}/overlays"
    told = api.post(url, {"kind": "blocked", "edge": "gate_barn"}).json()
    here = api.app.state.services

    def busy(*_: Any, **__: Any) -> Any:
        raise Unavailable("busy")

    with monkeypatch.context() as patch:
        patch.setattr(type(here.ingest), "amend", busy)
        api.problem("POST", f"{url}/{told['id']}/accept", 503)
    (now,) = api.get(url).json()
    assert now["state"] == "pending"
    assert "decided" not in now
    assert api.post(f"{url}/{told['id']}/accept", expect=200).json()["version"] == 4
