"""Reports of obstructions, and the decisions of editors. ``test_closures.py`` covers the maps."""

from __future__ import annotations

import json
import math
import time
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest

from app.events.messages import Event
from app.store.values import rfc3339
from tests.api.conftest import Api

SQUARE = {"type": "Polygon", "coordinates": [[[1, 1], [4, 1], [4, 3], [1, 3], [1, 1]]]}


def edge(api: Api, env: str, name: str, version: str = "latest") -> dict[str, Any]:
    features = api.get(f"environments/{env}/versions/{version}/layers/topology?crs=local").json()["features"]
    feature: dict[str, Any] = next(f for f in features if f["id"] == name)
    return feature


def zones(api: Api, env: str) -> list[dict[str, Any]]:
    features: list[dict[str, Any]] = api.get(f"environments/{env}/versions/latest/layers/zones?crs=local").json()[
        "features"
    ]
    return features


def told_of(api: Api, env: str) -> list[dict[str, Any]]:
    """Read the events after those of the farm, like a client."""
    lines = api.get(f"events?environment={env}&since=4&follow=false").text.splitlines()
    events = [json.loads(line[5:]) for line in lines if line.startswith("data:")]
    assert [e["sequence"] for e in events] == list(range(5, 5 + len(events)))
    return events


def until(condition: Any) -> Any:
    deadline = time.monotonic() + 20
    while not (value := condition()):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    return value


def test_accepted_overlay_is_in_force_until_its_end_and_changes_no_version(api: Api, farm: str) -> None:
    url = f"environments/{farm}/overlays"
    robot = api.token_for("robot", robot="mower-7", environments=farm)
    report = {"kind": "blocked", "polygon": SQUARE, "crs": "local", "ttl_seconds": 4, "detail": "a trailer"}
    pending = robot.post(url, report).json()
    assert {k: pending[k] for k in ("state", "reporter", "detail", "polygon", "crs", "level")} == {
        "state": "pending", "reporter": "mower-7", "detail": "a trailer", "polygon": SQUARE, "crs": "local",
        "level": "ground",
    }  # fmt: skip
    assert robot.post(url, report, 200).json()["id"] == pending["id"]
    robot.problem("POST", f"{url}/{pending['id']}/accept", 403)
    robot.problem("POST", f"{url}/{pending['id']}/reject", 403)
    accepted = api.post(f"{url}/{pending['id']}/accept", expect=200).json()
    assert (accepted["state"], accepted["decided_by"]) == ("accepted", "administrator")
    assert "version" not in accepted
    api.problem("POST", f"{url}/{pending['id']}/accept", 409)
    assert [o["id"] for o in api.get(f"{url}?state=accepted").json()] == [pending["id"]]
    until(lambda: api.get(f"{url}?state=ended").json())
    assert zones(api, farm) == []
    assert api.get(f"environments/{farm}").json()["version"] == 3
    assert api.get(f"{url}?state=pending").json() == []
    events = told_of(api, farm)
    assert [(e["type"], e["version"]) for e in events] == [
        ("overlay.created", 3), ("overlay.accepted", 3), ("overlay.ended", 3)
    ]  # fmt: skip
    assert events[0]["overlay"] == pending
    assert "overlays_digest" not in events[0]
    assert (events[0]["author"], events[0]["layers"], events[0]["previous"]) == ("mower-7", [], None)
    assert events[1]["overlay"] == accepted
    assert events[2]["overlay"]["state"] == "ended"
    assert events[1]["overlays_digest"] != events[2]["overlays_digest"]


def test_editor_creates_an_overlay_in_force(api: Api, farm: str) -> None:
    url = f"environments/{farm}/overlays"
    body = {"kind": "blocked", "edge": "gate_barn", "state": "accepted"}
    robot = api.token_for("robot", robot="mower-7")
    assert "only editors" in robot.problem("POST", url, 403, json=body)["detail"]
    overlay = api.token_for("editor").post(url, body).json()
    assert (overlay["state"], overlay["decided_by"]) == ("accepted", overlay["reporter"])
    assert [e["type"] for e in told_of(api, farm)] == ["overlay.accepted"]
    api.post(f"{url}/{overlay['id']}/end", expect=200)
    assert [e["type"] for e in told_of(api, farm)] == ["overlay.accepted", "overlay.ended"]
    api.problem("POST", f"{url}/{overlay['id']}/end", 409)
    robot.problem("POST", f"{url}/{overlay['id']}/end", 403)


def test_end_is_given_as_a_time_or_as_seconds(api: Api, farm: str) -> None:
    url = f"environments/{farm}/overlays"
    soon = datetime.now(UTC) + timedelta(hours=2)
    overlay = api.post(url, {"kind": "blocked", "edge": "gate_barn", "expires": rfc3339(soon)}).json()
    assert overlay["expires"] == rfc3339(soon)
    for expires, more, text in (
        (rfc3339(datetime.now(UTC) - timedelta(seconds=1)), {}, "in the past"),
        (rfc3339(soon + timedelta(days=400)), {}, "days ahead"),
        (soon.replace(tzinfo=None).isoformat(), {}, "time zone"),
        (rfc3339(soon), {"ttl_seconds": 5}, "exclude each other"),
    ):
        body = {"kind": "blocked", "edge": "gate_barn", "expires": expires, **more}
        assert text in api.problem("POST", url, 422, json=body)["detail"]


def test_editor_changes_the_end_of_a_closure(api: Api, farm: str) -> None:
    url = f"environments/{farm}/overlays"
    report = api.post(url, {"kind": "blocked", "edge": "gate_barn"}).json()
    address = f"{url}/{report['id']}"
    assert "is pending" in api.problem("PATCH", address, 409, json={"ttl_seconds": 60})["detail"]
    accepted = api.post(f"{address}/accept", expect=200).json()
    later = rfc3339(datetime.now(UTC) + timedelta(hours=5))
    moved = api("PATCH", address, 200, json={"expires": later}).json()
    assert moved == {**accepted, "expires": later}
    assert api("PATCH", address, 200, json={"expires": later}).json() == moved
    events = told_of(api, farm)
    assert [e["type"] for e in events] == ["overlay.created", "overlay.accepted", "overlay.accepted"]
    assert events[2]["overlay"] == moved
    assert events[1]["overlays_digest"] != events[2]["overlays_digest"], "robots get the new end"
    assert "give ttl_seconds or expires" in api.problem("PATCH", address, 422, json={})["detail"]
    api.problem("PATCH", address, 422, json={"ttl_seconds": 5, "expires": later})
    api.problem("PATCH", address, 422, json={"state": "ended"})
    api.token_for("robot", robot="mower-7").problem("PATCH", address, 403, json={"ttl_seconds": 60})
    api("PATCH", address, 200, json={"ttl_seconds": 1})
    until(lambda: api.get(f"{url}?state=ended").json())
    assert "is ended" in api.problem("PATCH", address, 409, json={"ttl_seconds": 60})["detail"]


def test_edge_that_only_a_channel_has_can_be_closed(api: Api, farm: str) -> None:
    """The robot runs production, and the head has another network."""
    url = f"environments/{farm}/overlays"
    api.http.put(f"/api/v1/environments/{farm}/channels/production", json={"version": 3}).raise_for_status()
    deletion = {"op": "delete", "layer": "topology", "id": "gate_barn"}
    api.post(f"environments/{farm}/edits", {"changes": [deletion]})
    overlay = api.post(url, {"kind": "blocked", "edge": "gate_barn"}).json()
    api.http.put(f"/api/v1/environments/{farm}/channels/production", json={"version": 4}).raise_for_status()
    problem = api.problem("POST", f"{url}/{overlay['id']}/accept", 422)
    assert "unknown edge 'gate_barn' in version 4" in problem["detail"]
    api.http.put(f"/api/v1/environments/{farm}/channels/production", json={"version": 3}).raise_for_status()
    api.post(f"{url}/{overlay['id']}/accept", expect=200)
    assert "gate_barn" not in api.get(f"/maps/{farm}/tmap2").text
    problem = api.problem("POST", f"{url}/{overlay['id']}/keep", 422)
    assert "version 4" in problem["detail"]


def test_piece_of_a_bent_edge_closes_the_edge(api: Api, farm: str) -> None:
    """The robot reports the edge by the id in its map, in which a bent edge is split into straight edges."""
    url = f"environments/{farm}/overlays"
    line = edge(api, farm, "gate_barn")
    (x, y, *_), (x2, y2, *_) = line["place"]["coordinates"]
    line["place"]["coordinates"] = [[x, y], [(x + x2) / 2, y + 3], [x2, y2]]
    feature = {word: line[word] for word in ("type", "id", "geometry", "place", "properties")}
    put = {"op": "put", "layer": "topology", "feature": feature}
    api.post(f"environments/{farm}/edits", {"changes": [put]})
    assert "gate_barn~2" in api.get(f"/maps/{farm}/tmap2").text
    overlay = api.post(url, {"kind": "blocked", "edge": "gate_barn~2", "state": "accepted"}).json()
    assert overlay["edge"] == "gate_barn"
    assert "gate_barn" not in api.get(f"/maps/{farm}/tmap2").text
    api.post(f"{url}/{overlay['id']}/end", expect=200)
    for name in ("gate_barn~3", "barn_gate~1", "gate~1"):
        problem = api.problem("POST", url, 422, json={"kind": "blocked", "edge": name})
        assert f"unknown edge '{name}'" in problem["detail"]


@pytest.mark.parametrize("what", [{"edge": "gate_barn"}, {"polygon": SQUARE, "crs": "local"}])
def test_kept_overlay_creates_a_version_and_stays_in_force(api: Api, farm: str, what: dict[str, Any]) -> None:
    url = f"environments/{farm}/overlays"
    api.http.put(f"/api/v1/environments/{farm}/channels/production", json={"version": 3}).raise_for_status()
    overlay = api.post(url, {"kind": "blocked", "detail": "a wall", **what}).json()
    api.problem("POST", f"{url}/{overlay['id']}/keep", 409)
    api.post(f"{url}/{overlay['id']}/accept", expect=200)
    result = api.post(f"{url}/{overlay['id']}/keep", expect=200).json()
    assert (result["state"], result["version"]) == ("accepted", 4)
    assert api.post(f"{url}/{overlay['id']}/keep", expect=200).json() == result
    assert [o["id"] for o in api.get(f"{url}?state=accepted").json()] == [overlay["id"]], (
        "production does not exist yet"
    )
    if "edge" in what:
        assert edge(api, farm, "gate_barn")["properties"]["blocked"] is True
        assert "gate_barn" not in api.get(f"environments/{farm}/versions/4/maps/tmap2").text
        assert "gate_barn" not in api.get(f"/maps/{farm}/tmap2").text
    else:
        (zone,) = zones(api, farm)
        assert zone["properties"] == {
            "kind": "keepout", "overlay": {"id": overlay["id"], "reporter": "administrator", "detail": "a wall"},
        }  # fmt: skip
        # It is closed now, and a permanent keepout.
        assert f"overlay-{overlay['id']}" in api.get(f"environments/{farm}/versions/4/maps/geojson").text
    api.post(f"{url}/{overlay['id']}/end", expect=200)
    assert "gate_barn" in api.get(f"/maps/{farm}/tmap2").text, "production did not move"
    api.http.put(f"/api/v1/environments/{farm}/channels/production", json={"version": 4}).raise_for_status()
    if "edge" in what:
        assert "gate_barn" not in api.get(f"/maps/{farm}/tmap2").text
    else:
        assert f"overlay-{overlay['id']}" in api.get(f"/maps/{farm}/geojson").text


@pytest.mark.parametrize("what", [{"edge": "gate_barn"}, {"polygon": SQUARE, "crs": "local"}])
def test_overlay_of_an_earlier_release_becomes_a_closure(api: Api, farm: str, what: dict[str, Any]) -> None:
    """The overlay is in version 4, which is promoted: it ends there as well."""
    url = f"environments/{farm}/overlays"
    end = rfc3339(datetime.now(UTC) + timedelta(hours=1))
    overlay = api.post(url, {"kind": "blocked", "expires": end, "state": "accepted", **what}).json()
    if "edge" in what:
        layer, feature = "topology", edge(api, farm, "gate_barn")
        feature["properties"] |= {"blocked": True, "blocked_until": end}
        feature["properties"].pop("level", None)
    else:
        layer, properties = "zones", {"kind": "keepout", "expires": end, "overlay": {"id": overlay["id"]}}
        feature = {"type": "Feature", "id": f"overlay-{overlay['id']}", "properties": properties, "geometry": SQUARE}
    put = {"op": "put", "layer": layer, "level": "ground", "crs": "local", "feature": feature}
    api.post(f"environments/{farm}/edits", {"changes": [put]})
    api.http.put(f"/api/v1/environments/{farm}/channels/production", json={"version": 4}).raise_for_status()

    def blocked() -> bool:
        if "edge" in what:
            return "gate_barn" not in api.get(f"/maps/{farm}/tmap2").text
        return f"overlay-{overlay['id']}" in api.get(f"/maps/{farm}/geojson").text

    assert blocked()
    assert api.get(f"/maps/{farm}/geojson").text.count(f'"overlay-{overlay["id"]}"') <= 1
    api.app.state.services.store.overlays.end_due(datetime.now(UTC) + timedelta(hours=2))
    assert api.get(f"{url}?state=ended").json()[0]["id"] == overlay["id"]
    assert not blocked(), "production still points to version 4"
    assert "blocked_until" not in api.get(f"/maps/{farm}/geojson").text


@pytest.mark.parametrize(
    ("ring", "crs", "text"),
    [
        ([[0, 91], [1, 91], [1, 95], [0, 91]], "wgs84", "latitude"),
        ([[179, 0], [-179, 0], [-179, 1], [179, 0]], "wgs84", "datum"),
        ([[2, 53], [2.01, 53], [2, 53.01], [2, 53]], "wgs84", "100 km from the datum"),
        ([[0, 0], [2e4, 0], [2e4, 1], [0, 0]], "local", "wider than 10 km"),
        ([[0, 0], [1e9, 0], [1e9, 1], [0, 0]], "local", "1e7"),
        ([[0, 0], [1, 1], [1, 0], [0, 1], [0, 0]], "local", "valid"),
    ],
)
def test_area_that_cannot_be_placed_is_refused(api: Api, unchanged_farm: str, ring: Any, crs: str, text: str) -> None:
    body = {"kind": "blocked", "crs": crs, "polygon": {"type": "Polygon", "coordinates": [ring]}}
    problem = api.problem("POST", f"environments/{unchanged_farm}/overlays", 422, json=body)
    assert text in problem["detail"]
    api.get(f"/maps/{unchanged_farm}/tmap2")


def test_wrong_json_types_are_named_in_terms_of_json(api: Api, farm: str) -> None:
    url = f"environments/{farm}/overlays"
    points = {"kind": "blocked", "crs": "local", "polygon": [[0, 0], [2, 0], [2, 2]]}
    for body, where in ((points, "body.polygon"), ([points], "body")):
        detail = api.problem("POST", url, 422, json=body)["detail"]
        assert detail == f"{where}: must be a JSON object"


def test_polygon_is_stored_without_foreign_members(api: Api, farm: str, bare: str) -> None:
    url = f"environments/{farm}/overlays"
    report = {"kind": "blocked", "crs": "local", "polygon": {**SQUARE, "properties": {"x": "y" * 5000}, "crs": {}}}
    assert api.post(url, report).json()["polygon"] == SQUARE
    assert api.post(url, {**report, "polygon": SQUARE}, 200).json()["polygon"] == SQUARE
    round_ = [[math.cos(k / 500 * math.pi), math.sin(k / 500 * math.pi)] for k in range(1000)]
    problem = api.problem("POST", url, 422, json={**report, "polygon": {"type": "Polygon", "coordinates": [round_]}})
    assert "1001 points" in problem["detail"]
    problem = api.problem("POST", url, 422, json={**report, "level": "attic"})
    assert "its levels: ground" in problem["detail"]
    assert (
        "no datum"
        in api.problem("POST", f"environments/{bare}/overlays", 422, json={**report, "crs": "wgs84"})["detail"]
    )


def test_overlay_limit_applies_per_reporter(api: Api, farm: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.store.overlays.MAX_PENDING_PER_REPORTER", 3)
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
    overlay = api.post(url, {"kind": "blocked", "edge": "gate_barn", "ttl_seconds": 1}).json()
    until(lambda: api.get(f"{url}?state=expired").json())
    api.problem("POST", f"{url}/{overlay['id']}/accept", 409)
    assert api.get(f"environments/{farm}").json()["version"] == 3
    other = api.post(url, {"kind": "blocked", "edge": "gate_barn"}).json()
    assert api.post(f"{url}/{other['id']}/reject", expect=200).json()["state"] == "rejected"
    api.problem("POST", f"{url}/{other['id']}/accept", 409)
    assert [o["state"] for o in api.get(url).json()] == ["expired", "rejected"]
    kinds = [(e["type"], e["overlay"]["id"]) for e in told_of(api, farm)]
    assert kinds == [
        ("overlay.created", overlay["id"]), ("overlay.expired", overlay["id"]),
        ("overlay.created", other["id"]), ("overlay.rejected", other["id"]),
    ]  # fmt: skip
    assert Event.from_json(json.dumps(told_of(api, farm)[1])).type == "overlay.expired"


def test_invalid_reports_are_refused(api: Api, farm: str, bare: str) -> None:
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
