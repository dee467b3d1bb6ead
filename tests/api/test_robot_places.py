"""Places of robots: pose, node and route in reports over HTTP, VDA 5050 and Zenoh."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from tests.api.conftest import API, Api
from tests.api.test_robots import root_of, status

POSE = {"x": 1.5, "y": -2.25, "yaw": 3.0}


def report(api: Api, env: str, robot: str = "mower", expect: int | None = 200, **more: Any) -> Any:
    body = status(env, root_of(api, env, 2), **more)
    return api("PUT", f"robots/{robot}/status", expect, json=body).json()


def test_reported_place_is_shown_and_kept(api: Api, farm: str) -> None:
    assert report(api, farm)["place"] is None
    first = report(api, farm, pose=POSE, node="WayPoint1", route=["a", "b"])
    assert first["place"] == {
        "pose": {**POSE, "level": None}, "node": "WayPoint1", "route": ["a", "b"], "time": first["received"],
    }  # fmt: skip
    later = report(api, farm)
    assert later["received"] >= first["received"], "a repeated report is stored once a minute"
    assert later["place"] == first["place"], "a report without a place keeps the last one, with its time"
    moved = report(api, farm, pose={**POSE, "level": "L2"})
    assert moved["place"]["pose"] == {**POSE, "level": "L2"}
    assert moved["place"]["route"] is None
    assert moved["since"] == first["since"]
    (listed,) = api.get(f"robots?environment={farm}").json()
    detail = api.get(f"robots/mower?environment={farm}").json()
    assert listed["place"] == detail["place"] == moved["place"]
    assert len(detail["history"]) == 1, "motion is not part of the history"


def test_motion_creates_no_event(api: Api, farm: str) -> None:
    def events() -> str:
        return api.get(f"/{API.strip('/')}/events?environment={farm}&since=0&follow=false").text

    report(api, farm, pose=POSE)
    before = events()
    assert before.count("data:") >= 3
    for k in range(5):
        report(api, farm, pose={**POSE, "x": float(k)})
    assert events() == before


def test_delayed_report_does_not_move_a_robot_back(api: Api, farm: str) -> None:
    report(api, farm, pose=POSE, time="2030-01-01T00:00:10Z")
    late = report(api, farm, pose={**POSE, "x": 9.0}, time="2030-01-01T00:00:05Z")
    assert late["place"]["pose"]["x"] == POSE["x"]
    now = report(api, farm, pose={**POSE, "x": 7.0}, time="2030-01-01T00:00:15Z")
    assert now["place"]["pose"]["x"] == 7.0


@pytest.mark.parametrize(
    "place",
    [
        {"pose": {"x": 1e9, "y": 0, "yaw": 0}},
        {"pose": {"x": 0, "y": 0}},
        {"pose": {"x": 0, "y": 0, "yaw": 1e6}},
        {"pose": {"x": 0, "y": 0, "yaw": 0, "z": 1}},
        {"node": ""},
        {"node": "a\x00b"},
        {"route": ["x"] * 1001},
        {"route": ["x" * 500] * 40},
        {"route": [1]},
    ],
)
def test_absurd_place_is_refused(api: Api, farm: str, place: dict[str, Any]) -> None:
    assert report(api, farm, "absurd", expect=422, **place)["status"] == 422
    api.problem("GET", f"robots/absurd?environment={farm}", 404)


def test_numbers_must_be_finite(api: Api, farm: str) -> None:
    for number in ("NaN", "Infinity", "1e999"):
        body = json.dumps(status(farm, "a" * 64, pose=POSE)).replace("1.5", number)
        answer = api("PUT", "robots/x/status", None, content=body, headers={"content-type": "application/json"})
        assert answer.status_code in (400, 422), number


def test_place_over_zenoh(api: Api, farm: str) -> None:
    fleet = api.app.state.services.fleet
    assert fleet._lead.try_acquire(), "as the relay does, which stores what comes over Zenoh"
    members = {k: v for k, v in status(farm, root_of(api, farm, 2), pose=POSE, route=[]).items() if k != "environment"}
    fleet.enqueue_status(farm, "bus", json.dumps(members).encode())
    fleet.enqueue_status(farm, "bus", json.dumps({**members, "pose": {"x": "1"}}).encode())  # dropped with a warning
    report(api, farm, "bus")  # a robot's reports are stored in order: those before it are stored, too
    robot = api.get(f"robots/bus?environment={farm}").json()
    assert robot["place"]["pose"] == {**POSE, "level": None}
    assert robot["place"]["route"] == []
    assert datetime.fromisoformat(robot["place"]["time"]) <= datetime.now(UTC)


def state(env: str, **more: Any) -> dict[str, Any]:
    return {"maps": [{"mapId": env, "mapVersion": "2", "mapStatus": "ENABLED"}], **more}


def test_place_of_a_vda5050_state(api: Api, farm: str) -> None:
    order = {
        "nodeStates": [{"nodeId": "n2", "sequenceId": 4}, {"nodeId": "n1", "sequenceId": 2}],
        "edgeStates": [{"edgeId": "e1", "sequenceId": 3}],
    }
    position = {"x": 1.5, "y": -2.25, "theta": 3.0, "mapId": f"{farm}/L2", "positionInitialized": True}
    body = state(farm, agvPosition=position, lastNodeId="n0", **order)
    (robot,) = api.post("robots/agv/vda5050/state", body, 200).json()["robots"]
    expected = {"pose": {**POSE, "level": "L2"}, "node": "n0", "route": ["n1", "e1", "n2"]}
    assert {k: robot["place"][k] for k in expected} == expected
    lost = {**position, "mapId": farm, "positionInitialized": False}
    (robot,) = api.post("robots/agv/vda5050/state", state(farm, agvPosition=lost, lastNodeId="n3"), 200).json()[
        "robots"
    ]
    assert robot["place"]["pose"] is None
    assert robot["place"]["node"] == "n3"
    elsewhere = {**position, "mapId": "another-site"}
    (robot,) = api.post("robots/agv/vda5050/state", state(farm, agvPosition=elsewhere), 200).json()["robots"]
    assert robot["place"]["node"] == "n3", "a position on another site's map is not this site's"
    bad = {**position, "mapId": farm, "x": "far"}
    api.problem("POST", "robots/agv/vda5050/state", 422, json=state(farm, agvPosition=bad))


def test_long_vda5050_order_is_cut(api: Api, farm: str) -> None:
    nodes = [{"nodeId": f"{k:036d}", "sequenceId": k} for k in range(3000)]
    (robot,) = api.post("robots/long/vda5050/state", state(farm, nodeStates=nodes), 200).json()["robots"]
    assert len(robot["place"]["route"]) == 16_384 // 36
    assert robot["place"]["route"][0] == "0" * 36


def test_real_vda5050_state(api: Api, farm: str, shared: Path) -> None:
    text = (shared / "data/vda5050/opentcs_v2_0/StateTest.jsonSampleFull.approved.txt").read_text()
    message = json.loads(text)
    message["agvPosition"]["mapId"] = farm
    (robot,) = api.post("robots/tcs/vda5050/state", {**message, **state(farm)}, 200).json()["robots"]
    assert robot["place"]["pose"]["x"] == message["agvPosition"]["x"]
    assert robot["place"]["node"] == message["lastNodeId"]
    assert len(robot["place"]["route"]) == len(message["nodeStates"]) + len(message["edgeStates"]) > 0
