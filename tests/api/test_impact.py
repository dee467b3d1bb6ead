"""Impact of a change over HTTP: edges, nodes, docks, parts and robots."""

from __future__ import annotations

from typing import Any

import pytest

from tests.api.conftest import Api
from tests.api.test_checks import edge, edit, node
from tests.api.test_robots import root_of

Json = dict[str, Any]

NODES = {
    "a": (0, 0), "b": (10, 0), "c": (10, 10), "d": (0, 10), "e": (20, 0), "f": (30, 0), "ChargingPoint1": (40, 0),
}  # fmt: skip
WAYS = [("a", "b"), ("b", "c"), ("c", "d"), ("d", "a"), ("b", "e"), ("e", "f"), ("f", "ChargingPoint1")]


def network(**more: Any) -> list[Json]:
    changes = [node(item, (float(x), float(y))) for item, (x, y) in NODES.items()]
    return changes + [edge(f"{i}_{j}", i, j, **more) for a, b in WAYS for i, j in ((a, b), (b, a))]


def delete(item: str) -> Json:
    return {"op": "delete", "layer": "topology", "id": item}


def box(x0: float, y0: float, x1: float, y1: float) -> Json:
    return {"type": "Polygon", "coordinates": [[[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]]]}


def keepout(item: str, polygon: Json) -> Json:
    feature = {"type": "Feature", "id": item, "place": polygon, "geometry": None, "properties": {"kind": "keepout"}}
    return {"op": "put", "layer": "zones", "feature": feature}


@pytest.fixture
def site(api: Api, bare: str) -> str:
    """Create a network of a square and a way to a charger (version 1), in production."""
    edit(api, bare, network())
    api("PUT", f"environments/{bare}/channels/production", 200, json={"version": 1})
    return bare


def impact(api: Api, env: str, **query: Any) -> Json:
    body: Json = api.get(f"environments/{env}/impact", params=query).json()
    return body


def report(api: Api, env: str, robot: str, **place: Any) -> None:
    body = {"environment": env, "channel": "latest", "version": 1, "root": root_of(api, env, 1), "state": "active"}
    api("PUT", f"robots/{robot}/status", 200, json={**body, **place})


def pose(x: float, y: float, **more: Any) -> Json:
    return {"x": x, "y": y, "yaw": 0.0, **more}


def states(body: Json) -> dict[str, str]:
    return {robot["robot"]: robot["state"] for robot in body["robots"]}


def test_nothing_changed(api: Api, site: str) -> None:
    assert impact(api, site) == {
        "from": 1, "to": 1, "edges": {"deleted": [], "blocked": [], "turned": []},
        "nodes": {"deleted": [], "moved": []}, "docks": [], "parts": [], "robots": [], "truncated": False,
    }  # fmt: skip


def test_deleted_way_cuts_off_the_charger(api: Api, site: str) -> None:
    report(api, site, "there", node="f")
    report(api, site, "going", node="a", route=["a", "a_b", "b", "b_e", "e"])
    report(api, site, "nodes-only", node="a", route=["a", "b", "e"])
    report(api, site, "elsewhere", node="c", route=["c", "c_d", "d"])
    report(api, site, "silent")
    report(api, site, "foreign", node="somewhere-else")
    report(api, site, "near", pose=pose(15.0, 0.4))
    report(api, site, "upstairs", pose=pose(15.0, 0.4, level="L2"))
    edit(api, site, [delete("b_e"), delete("e_b")])
    body = impact(api, site)
    assert (body["from"], body["to"]) == (1, 2)
    assert sorted(body["edges"]["deleted"]) == ["b_e", "e_b"]
    (part,) = body["parts"]
    assert part["nodes"] == 3
    assert sorted(part["sample"]) == ["ChargingPoint1", "e", "f"]
    assert part["why"] == "has no connection"
    (dock,) = body["docks"]
    assert dock == {"id": "ChargingPoint1", "name": "ChargingPoint1", "level": "ground", "why": "has no connection"}
    assert states(body) == {
        "there": "touched", "going": "touched", "nodes-only": "touched", "elsewhere": "clear", "silent": "unknown",
        "foreign": "unknown", "near": "touched", "upstairs": "clear",
    }  # fmt: skip
    robots = {robot["robot"]: robot for robot in body["robots"]}
    assert robots["going"]["edges"] == ["b_e"]
    assert robots["there"]["why"] == ["its node f is cut off"]
    assert robots["elsewhere"]["why"] == []
    assert robots["elsewhere"]["online"] is True
    assert robots["silent"]["time"] is None
    assert robots["near"]["pose"] == {"x": 15.0, "y": 0.4, "yaw": 0.0, "level": None}
    assert impact(api, site, **{"from": 2, "to": 1})["edges"]["deleted"] == []


def test_one_way_and_reversed_edges_are_turned(api: Api, site: str) -> None:
    report(api, site, "on-it", node="a", route=["a_b"])
    edit(api, site, [delete("b_a")])
    body = impact(api, site)
    assert body["edges"] == {"deleted": ["b_a"], "blocked": [], "turned": ["a_b"]}
    assert body["parts"] == [], "the square can still be driven around"
    assert states(body) == {"on-it": "touched"}
    edit(api, site, [delete("e_b")])
    body = impact(api, site, **{"from": 2})
    assert body["edges"]["turned"] == ["b_e"]
    assert [part["why"] for part in body["parts"]] == ["cannot be left"]
    assert body["docks"][0]["why"] == "cannot be left"
    edit(api, site, [edge("c_d", "d", "c")])
    assert "c_d" in impact(api, site, **{"from": 3})["edges"]["turned"]


def test_new_keepout_blocks(api: Api, site: str) -> None:
    report(api, site, "inside", pose=pose(15.0, 1.5))
    report(api, site, "beside", pose=pose(15.0, 5.0))
    edit(api, site, [keepout("works", box(14.0, -2.0, 16.0, 2.0))])
    body = impact(api, site)
    blocked = body["edges"]["blocked"]
    assert {item["id"] for item in blocked} == {"b_e", "e_b"}
    assert {(item["zone"], item["grid"], item["level"]) for item in blocked} == {("works", None, "ground")}
    assert 14.0 <= blocked[0]["where"][0] <= 16.0
    assert body["parts"][0]["nodes"] == 3
    assert states(body) == {"inside": "touched", "beside": "clear"}
    edit(api, site, [keepout("works", box(14.0, -2.0, 16.0, 3.0))])
    assert impact(api, site, **{"from": 2})["edges"]["blocked"] == [], "they were blocked before"


def test_blocked_mark_and_moved_nodes(api: Api, site: str) -> None:
    edit(api, site, [edge("a_b", "a", "b", blocked=True), node("c", (10.0, 13.0))])
    body = impact(api, site)
    (blocked,) = body["edges"]["blocked"]
    assert blocked == {"id": "a_b", "level": "ground", "where": [5.0, 0.0], "grid": None, "zone": None}
    assert body["nodes"]["moved"] == [{"id": "c", "level": "ground", "distance": 3.0}]
    assert body["edges"]["turned"] == []
    edit(api, site, [keepout("yard", box(20.5, 3.0, 40.0, 9.0))])
    edit(api, site, [node("f", (30.0, 5.0))])
    moved = impact(api, site, **{"from": 3})["edges"]["blocked"]
    assert {item["id"] for item in moved} == {"e_f", "f_e", "f_ChargingPoint1", "ChargingPoint1_f"}
    assert {item["zone"] for item in moved} == {"yard"}


def test_newly_occupied_cells_block(api: Api, farm: str) -> None:
    polygon = box(1.0, -1.0, 2.0, 1.0)
    report(api, farm, "in-it", pose=pose(1.5, 0.0))
    cells = {"op": "cells", "crs": "local", "polygon": polygon}
    api.post(f"environments/{farm}/edits", {"changes": [{**cells, "value": 0}]}, None)
    base = api.get(f"environments/{farm}").json()["version"]
    edit(api, farm, [{**cells, "value": 100}])
    body = impact(api, farm, **{"from": base})
    assert {item["grid"] for item in body["edges"]["blocked"]} == {"map"}
    assert states(body) == {"in-it": "touched"}
    assert "newly occupied" in body["robots"][0]["why"][0]
    again = impact(api, farm, **{"from": "latest"})
    assert again["edges"]["blocked"] == []
    assert states(again) == {"in-it": "clear"}


def test_docks_by_the_words_of_formats(api: Api, bare: str) -> None:
    docks = {
        "rmf": {"nav_graph": {"parameters": {"is_charger": True}}},
        "building": {"openrmf": {"parameters": {"is_parking_spot": [4, True]}}},
        "no": {"nav_graph": {"parameters": {"is_charger": False, "dock_name": ""}}},
        "lif": {"lif": {"item": {"vehicleTypeNodeProperties": [{"actions": [{"actionType": "pick"}]}]}}},
        "Docking": {},
        "DockYard": {},
        "Paddock": {},
    }
    edit(api, bare, [node(item, (5.0 * k, 0.0), **more) for k, (item, more) in enumerate(docks.items())])
    edit(api, bare, [delete(item) for item in docks])
    assert {dock["id"] for dock in impact(api, bare, **{"from": 1})["docks"]} == {
        "rmf",
        "building",
        "lif",
        "Docking",
        "DockYard",
    }


def test_versions_and_parameters(api: Api, site: str) -> None:
    edit(api, site, [delete("a_b")])
    assert impact(api, site)["from"] == 1, "production"
    assert impact(api, site, **{"from": "latest", "to": "production"})["to"] == 1
    api.problem("GET", f"environments/{site}/impact?to=9", 404)
    api.problem("GET", f"environments/{site}/impact?since=1", 422)
    api.problem("GET", f"environments/{site}/impact?to=-1", 422)


def test_robots_of_other_environments_are_not_listed(api: Api, site: str, farm: str) -> None:
    report(api, farm, "stranger", node="gate")
    assert impact(api, site)["robots"] == []
