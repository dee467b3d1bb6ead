"""VDA 5050: instant actions for a version, and state messages as robot status."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from app.errors import Invalid
from app.fleet.vda5050 import VehicleMaps, merge_levels, read_state
from tests.api import samples
from tests.api.conftest import Api, running, settings_for

REAL = sorted(Path(__file__).parents[2].parent.glob("shared/data/vda5050/*/*tate*"))


def parameters(action: dict[str, Any]) -> dict[str, str]:
    return {p["key"]: p["value"] for p in action["actionParameters"]}


def maps(env: str, *versions: tuple[Any, str], **more: Any) -> dict[str, Any]:
    listed = [{"mapId": env, "mapVersion": v, "mapStatus": s, "mapDescriptor": None} for v, s in versions]
    return {"headerId": 1, "maps": listed, "actionStates": None, **more}


def test_actions_contain_link_and_hash_of_the_file(api: Api, farm: str) -> None:
    body = api.get(f"environments/{farm}/versions/latest/vda5050/actions?mapId=hall&grid=map&file_type=png").json()
    assert (body["mapId"], body["mapVersion"], body["version"]) == ("hall", "3", 3)
    actions = [body[k] for k in ("downloadMap", "enableMap", "deleteMap")]
    assert [a["actionType"] for a in actions] == ["downloadMap", "enableMap", "deleteMap"]
    assert [a["blockingType"] for a in actions] == ["NONE"] * 3, "3.0 allows no other for instant actions"
    assert all(parameters(a)["mapId"] == "hall" and parameters(a)["mapVersion"] == "3" for a in actions)
    assert set(actions[0]) == {"actionType", "actionId", "blockingType", "actionParameters"}
    given = parameters(actions[0])
    link = urlsplit(given["mapDownloadLink"])
    assert f"{link.scheme}://{link.netloc}" == api.url
    bundle = api.as_(None).get(f"{link.path}?{link.query}").content
    assert (hashlib.sha256(bundle).hexdigest(), len(bundle)) == (given["mapHash"], body["size"])
    assert sorted(zipfile.ZipFile(io.BytesIO(bundle)).namelist()) == ["map.png", "map.yaml"]
    again = api.get(f"environments/{farm}/versions/3/vda5050/actions?format=geojson").json()
    assert again["mapId"] == farm
    assert again["downloadMap"]["actionId"] != body["downloadMap"]["actionId"]
    url = f"environments/{farm}/versions/3/vda5050/actions"
    api.problem("GET", f"{url}?format=nothing", 404)
    api.problem("GET", f"{url}?nonsense=1", 422)
    api.problem("GET", f"{url}?format=occupancy_grid&grid=other", 404)
    api.problem("GET", f"environments/{farm}/versions/77/vda5050/actions", 404)


def test_links_have_the_public_address(tmp_path: Path) -> None:
    with running(settings_for(tmp_path, public_url="https://maps.example.org/fleet")) as api:
        api.post("environments", {"name": "farm"})
        api.upload("farm", samples.grid())
        body = api.get("environments/farm/versions/latest/vda5050/actions").json()
        link = parameters(body["downloadMap"])["mapDownloadLink"]
        assert link.startswith("https://maps.example.org/fleet/api/v1/environments/farm/")
        path = link.removeprefix("https://maps.example.org/fleet")
        assert hashlib.sha256(api.as_(None).get(path).content).hexdigest() == parameters(body["downloadMap"])["mapHash"]


@pytest.fixture
def tower(api: Api, farm: str) -> str:
    """Extend the farm with a grid on the level L2 (version 4) and another level without one (version 5)."""
    api.upload(farm, samples.grid(), level="L2")
    api.upload(farm, {"n.tmap2.yaml": samples.tmap2()}, level="roof")
    return farm


def test_actions_cover_each_level(api: Api, tower: str) -> None:
    url = f"environments/{tower}/versions/latest/vda5050/actions"
    anonymous = api.as_(None)
    every = api.get(f"{url}?level=*&grid=map&derive=false").json()
    assert [(m["mapId"], m["level"], m["mapVersion"]) for m in every["maps"]] == [
        (tower, "ground", "5"), (f"{tower}/L2", "L2", "5"),
    ]  # fmt: skip
    assert [m["level"] for m in every["missing"]] == ["roof"]
    assert {k: every[k] for k in every["maps"][0]} == every["maps"][0]
    links = [parameters(m["downloadMap"]) for m in every["maps"]]
    for one, name in zip(links, ("ground", "L2"), strict=True):
        assert f"level={name}" in one["mapDownloadLink"]
        assert (
            hashlib.sha256(anonymous.get(one["mapDownloadLink"].removeprefix(api.url)).content).hexdigest()
            == one["mapHash"]
        )
    upstairs = api.get(f"{url}?level=L2&grid=map").json()
    assert (upstairs["mapId"], upstairs["level"], len(upstairs["maps"])) == (f"{tower}/L2", "L2", 1)
    assert parameters(upstairs["enableMap"]) == {"mapId": f"{tower}/L2", "mapVersion": "5"}
    assert api.get(f"{url}?level=ground").json()["mapId"] == tower
    assert api.get(f"{url}?level=L2&mapId=upper").json()["mapId"] == "upper"
    named = api.get(f"{url}?level=*&mapId=hall&grid=map").json()
    assert [m["mapId"] for m in named["maps"]][:2] == ["hall", "hall/L2"]
    assert "ground, L2, roof" in api.problem("GET", f"{url}?level=L9", 404)["detail"]
    assert (
        "this map is not available on any level"
        in api.problem("GET", f"{url}?level=*&grid=other&derive=false", 422)["detail"]
    )
    problem = api.problem("GET", f"{url}?level=*&format=nav2_route", 422)
    assert "contains all levels" in problem["detail"]
    assert "occupancy_grid" in problem["detail"]


def test_lif_is_not_offered_to_vehicles(api: Api, farm: str) -> None:
    problem = api.problem("GET", f"environments/{farm}/versions/3/vda5050/actions?format=lif", 422)
    assert "for fleet managers, not for vehicles" in problem["detail"]
    api.get(f"environments/{farm}/versions/3/maps/lif")


def test_action_links_are_signed_by_default(api: Api, farm: str) -> None:
    url = f"environments/{farm}/versions/3/vda5050/actions?format=geojson"
    body = api.get(f"{url}&seconds=60").json()
    left = datetime.fromisoformat(body["expires"]) - datetime.now(UTC)
    assert timedelta(seconds=30) < left <= timedelta(seconds=60)
    plain = api.get(f"{url}&signed=false&derive=false").json()
    link = parameters(plain["downloadMap"])["mapDownloadLink"]
    assert link == f"{api.url}/api/v1/environments/{farm}/versions/3/maps/geojson?derive=false"
    assert plain["expires"] is None
    path = link.removeprefix(api.url)
    api.as_(None).problem("GET", path, 401)
    assert hashlib.sha256(api.get(path).content).hexdigest() == parameters(plain["downloadMap"])["mapHash"]
    api.problem("GET", f"{url}&seconds=86401", 422)


def test_levels_of_a_site_count_together(api: Api, tower: str) -> None:
    api("PUT", f"environments/{tower}/channels/production", 200, json={"version": 4})
    vehicle = api.token_for("robot", robot="agv-9")

    def floors(ground: list[tuple[str, str]], upper: list[tuple[str, str]]) -> tuple[str, int, int | None]:
        body = maps(tower, *ground)
        body["maps"] += maps(f"{tower}/L2", *upper)["maps"]
        (robot,) = vehicle.post("robots/agv-9/vda5050/state", body, 200).json()["robots"]
        assert robot["environment"] == tower
        return robot["state"], robot["version"], robot["holds"] and robot["holds"]["version"]

    on, off = "ENABLED", "DISABLED"
    assert floors([("4", on)], [("4", on)]) == ("active", 4, 4)
    api("PUT", f"environments/{tower}/channels/production", 200, json={"version": 5, "rollout": {"ready": 1}})
    assert floors([("4", on), ("5", off)], [("4", on)]) == ("active", 4, 4), "the upper level does not have it yet"
    assert floors([("4", on), ("5", off)], [("4", on), ("5", off)]) == ("ready", 5, 4)
    assert floors([("5", on)], [("4", on), ("5", off)])[2] == 4, "one level still runs the old version"
    assert floors([("5", on)], [("5", on)]) == ("active", 5, 5)
    body = maps(f"{tower}/L2", ("5", on))
    body["maps"] += maps("other/L2", ("5", on))["maps"]
    vehicle.problem("POST", f"robots/agv-9/vda5050/state?environment={tower}", 422, json=body)
    result = vehicle.post("robots/agv-9/vda5050/state", body, 200).json()
    assert [i["mapId"] for i in result["ignored"]] == ["other/L2"]


def test_merge_levels_combines_a_site() -> None:
    floors = (VehicleMaps("a", ("9",), ("10",), ()), VehicleMaps("a/L2", ("10",), ("9", "x"), (("11", "no room"),)))
    assert merge_levels(floors) == VehicleMaps("a", ("9",), ("10",), (("11", "no room"),))
    assert merge_levels(floors[1:]) == floors[1]
    assert merge_levels((VehicleMaps("a", ("x",), (), ()), VehicleMaps("a/b", ("2",), (), ()))).enabled == ("2",)


def test_vehicle_state_becomes_a_status(api: Api, farm: str) -> None:
    api("PUT", f"environments/{farm}/channels/production", 200, json={"version": 2})
    vehicle = api.token_for("robot", robot="agv-1")
    url = "robots/agv-1/vda5050/state"

    def say(body: dict[str, Any], query: str = "") -> Any:
        return vehicle.post(url + query, body, 200).json()

    (robot,) = say(maps(farm, ("2", "ENABLED"), ("1", "DISABLED")))["robots"]
    assert (robot["channel"], robot["version"], robot["state"]) == ("production", 2, "active")
    assert robot["lag"]["differs"] is False
    plan = {"version": 3, "rollout": {"ready": 1}}
    planned = api("PUT", f"environments/{farm}/channels/production", 200, json=plan).json()
    assert planned["robots"]["ready"] == 0
    failing = [{"actionId": f"downloadMap:{farm}:3:ab", "actionStatus": "FAILED", "resultDescription": "disk full"}]
    (robot,) = say(maps(farm, ("2", "ENABLED"), actionStates=failing))["robots"]
    assert (robot["state"], robot["version"], robot["detail"]) == ("failed", 3, "disk full")
    both = maps(farm, ("3", "DISABLED"), ("2", "ENABLED"))
    for _ in range(3):
        (robot,) = say(both)["robots"]
        assert (robot["state"], robot["version"], robot["holds"]["version"]) == ("ready", 3, 2)
    states = [(h["state"], h["version"]) for h in api.get("robots/agv-1").json()["history"]]
    assert states == [("ready", 3), ("failed", 3), ("active", 2)]
    other = maps("hall", ("2", "ENABLED"))
    assert say(other, f"?environment={farm}&channel=latest")["robots"][0]["channel"] == "latest"


def test_unknown_maps_are_listed_as_ignored(api: Api, farm: str, bare: str) -> None:
    editor = api.token_for("editor", environments=farm)
    body = maps(farm, ("99", "ENABLED"))
    body["maps"] += maps("nowhere", ("1", "ENABLED"))["maps"] + maps(bare, ("0", "ENABLED"))["maps"]
    result = editor.post("robots/agv-2/vda5050/state", body, 200).json()
    assert result["robots"] == []
    assert [i["mapId"] for i in result["ignored"]] == sorted([farm, "nowhere", bare])
    result = editor.post("robots/agv-2/vda5050/state", maps(farm, ("a-b", "ENABLED")), 200).json()
    assert "must be the number of a version" in result["ignored"][0]["why"]
    editor.problem("POST", f"robots/agv-2/vda5050/state?environment={farm}", 422, json=body)
    api.token_for("robot", robot="agv-1").problem("POST", "robots/agv-2/vda5050/state", 403, json=body)
    api.token_for("viewer").problem("POST", "robots/agv-2/vda5050/state", 403, json=body)
    api.problem("POST", "robots/agv-2/vda5050/state", 422, json={"maps": 1})
    assert api.post("robots/agv-2/vda5050/state", {"maps": None}, 200).json() == {"robots": [], "ignored": []}


@pytest.mark.parametrize(
    "bad",
    [
        [], {"maps": {}}, {"maps": [1]}, {"maps": [{}]}, {"maps": [{"mapId": "a", "mapVersion": 1}]},
        {"maps": [{"mapId": "a", "mapVersion": "1", "mapStatus": None}]}, maps("a", ("1", "ENABLED"), ("2", "ENABLED")),
        {"maps": [None] * 1001}, {"actionStates": "x"},
        {"actionStates": [{"actionId": "enableMap:a:1:x", "actionStatus": "FAILED", "resultDescription": 3}]},
        {"instantActionStates": [{"actionId": "enableMap:a:1:x", "actionStatus": "FAILED", "actionResult": []}]},
        {"errors": {}}, {"errors": [{"errorReferences": [1]}]}, {"instantActionStates": 1},
    ],
)  # fmt: skip
def test_bad_states_are_refused(bad: Any) -> None:
    with pytest.raises(Invalid):
        read_state(bad)


def test_state_with_nulls_is_read() -> None:
    states = [
        {"actionId": "a", "actionStatus": "FAILED"},
        {"actionId": None, "actionStatus": None},
        {"actionId": "enableMap:x:y:7:1", "actionStatus": "FAILED", "resultDescription": None},
        {"actionId": "downloadMap:a:1:9", "actionStatus": "FAILED", "resultDescription": "a first try"},
    ]
    assert read_state({**maps("a", ("1", "DISABLED")), "actionStates": states}) == (
        VehicleMaps("a", (), ("1",), ()),
        VehicleMaps("x:y", (), (), (("7", "the vehicle reports no reason"),)),
    )


def test_state_of_version_3_0_is_read() -> None:
    """Version 3.0 lists instant actions separately, retains them, and may retry them; reasons are in errors."""
    states = [
        {"actionId": "downloadMap:a:3:1", "actionType": "downloadMap", "actionStatus": "FAILED"},
        {"actionId": "downloadMap:a:4:1", "actionStatus": "FAILED", "actionResult": "no room"},
        {"actionId": "downloadMap:a:5:1", "actionStatus": "FAILED"},
        {"actionId": "downloadMap:a:5:2", "actionStatus": "RUNNING"},
        {"actionId": "downloadMap:b:6:1", "actionStatus": "RETRIABLE"},
        {"actionId": "enableMap:b:7:1", "actionStatus": "FAILED"},
    ]
    reference = [{"referenceKey": "actionId", "referenceValue": "downloadMap:a:3:1"}]
    other = [{"referenceKey": "actionId", "referenceValue": "enableMap:b:7:1"}, {"referenceKey": "mapId"}]
    errors = [
        {"errorType": "DOWNLOAD", "errorLevel": "WARNING", "errorReferences": reference, "errorDescription": "404"},
        {"errorType": "UNKNOWN_MAP_ID", "errorLevel": "WARNING", "errorReferences": other},
        {"errorType": "other", "errorLevel": "WARNING"},
    ]
    message = maps("a", ("1", "ENABLED"), instantActionStates=states, errors=errors, zoneActionStates=None)
    assert read_state(message) == (
        VehicleMaps("a", ("1",), (), (("3", "404"), ("4", "no room"))),
        VehicleMaps("b", (), (), (("6", "the vehicle reports no reason"), ("7", "UNKNOWN_MAP_ID"))),
    )


@pytest.mark.skipif(not REAL, reason="the real samples are not here")
@pytest.mark.parametrize("path", REAL, ids=lambda p: p.name)
def test_real_states_are_read(path: Path) -> None:
    message = json.loads(path.read_text())
    assert read_state(message) == ()
    message["maps"] = maps("a", ("1", "ENABLED"))["maps"]
    assert read_state(message) == (VehicleMaps("a", ("1",), (), ()),)
