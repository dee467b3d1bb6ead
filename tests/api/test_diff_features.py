"""Changed features between two versions, with both states, to draw them."""

from __future__ import annotations

from typing import Any

import pytest

from tests.api import samples
from tests.api.conftest import Api


@pytest.fixture
def edited(api: Api, farm: str) -> str:
    """Add version 4: a node moved, one added, an edge deleted, one with another property."""
    moved = local("field", {"type": "Point", "coordinates": [10.0, 9.0]}, kind="node")
    added = local("shed", {"type": "Point", "coordinates": [4.0, 4.0]}, kind="node", name="Shed")
    network = api.get(f"environments/{farm}/versions/3/layers/topology?crs=local").json()["features"]
    slower = next(item for item in network if item["id"] == "gate_barn")
    slower["properties"]["speed_limit"] = 0.5
    slower["coordRefSys"] = "urn:fleetmap:crs:local"
    changes = [{"op": "put", "layer": "topology", "feature": item} for item in (moved, added, slower)]
    changes.append({"op": "delete", "layer": "topology", "id": "barn_gate"})
    api.post(f"environments/{farm}/edits", {"changes": changes})
    return farm


def local(item: str, place: dict[str, Any], **properties: str) -> dict[str, Any]:
    return {"type": "Feature", "id": item, "geometry": None, "place": place, "properties": properties,
            "coordRefSys": "urn:fleetmap:crs:local"}  # fmt: skip


def by_id(body: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {item["id"]: item for item in body["features"]}


def test_each_change_has_both_states(api: Api, edited: str) -> None:
    answer = api.get(f"environments/{edited}/diff?from=3&to=4&format=geojson&crs=local")
    assert answer.headers["content-type"] == "application/geo+json"
    body = answer.json()
    assert (body["type"], body["from"], body["to"]) == ("FeatureCollection", 3, 4)
    assert body["coordRefSys"] == "urn:fleetmap:crs:local"
    features = by_id(body)
    listed = api.get(f"environments/{edited}/diff?from=3&to=4").json()["layers"]["topology"]
    assert {name: item["properties"]["change"] for name, item in features.items()} == {
        **dict.fromkeys(listed["added"], "added"),
        **dict.fromkeys(listed["deleted"], "deleted"),
        **{line["id"]: "changed" for line in listed["changed"]},
    }
    for line in listed["changed"]:
        assert features[line["id"]]["properties"]["fields"] == line["fields"]
    before = {
        f["id"]: f for f in api.get(f"environments/{edited}/versions/3/layers/topology?crs=local").json()["features"]
    }
    after = {
        f["id"]: f for f in api.get(f"environments/{edited}/versions/4/layers/topology?crs=local").json()["features"]
    }
    for name, item in features.items():
        properties = item["properties"]
        assert properties["before"] == (before[name]["properties"] if name in before else None)
        assert properties["after"] == (after[name]["properties"] if name in after else None)
        assert item["geometry"] is None
        assert item["place"] == (after.get(name) or before[name])["place"]
        assert (properties["layer"], item["level"], item["part"]) == ("topology", "ground", "network")
    assert features["barn_gate"]["properties"]["change"] == "deleted"
    assert features["barn_gate"]["properties"]["kind"] == "edge"
    assert features["shed"]["properties"]["before_geometry"] is None
    moved = features["field"]["properties"]
    assert moved["before_geometry"]["coordinates"][:2] == list(samples.NODES["field"])
    assert "geometry" in moved["fields"]
    slower = features["gate_barn"]["properties"]
    assert slower["fields"] == ["speed_limit"]
    assert slower["before_geometry"] is None
    assert (slower["before"].get("speed_limit"), slower["after"]["speed_limit"]) == (None, 0.5)


def test_wgs84_is_the_default_with_a_datum(api: Api, edited: str) -> None:
    body = api.get(f"environments/{edited}/diff?from=3&to=4&format=geojson").json()
    assert "coordRefSys" not in body
    shed = by_id(body)["shed"]
    layer = api.get(f"environments/{edited}/versions/4/layers/topology?ids=shed").json()["features"][0]
    assert shed["geometry"] == layer["geometry"]
    assert "place" not in shed


def test_reverse_swaps_added_and_deleted(api: Api, edited: str) -> None:
    forth, back = (by_id(api.get(f"environments/{edited}/diff?{query}&format=geojson").json())
                   for query in ("from=3&to=4", "from=4&to=3"))  # fmt: skip
    swapped = {"added": "deleted", "deleted": "added", "changed": "changed"}
    assert forth.keys() == back.keys()
    for name, item in forth.items():
        first, second = item["properties"], back[name]["properties"]
        assert second["change"] == swapped[first["change"]]
        assert (second["before"], second["after"]) == (first["after"], first["before"])


def test_pages_and_layer(api: Api, edited: str) -> None:
    path = f"environments/{edited}/diff?from=1&to=4&format=geojson"
    whole = api.get(path).json()["features"]
    seen, cursor = [], ""
    while True:
        body = api.get(f"{path}&limit=2{cursor}").json()
        assert body["numberMatched"] == len(whole)
        seen += body["features"]
        if "next" not in body:
            break
        cursor = f"&cursor={body['next']}"
    assert seen == whole
    assert len(whole) > 4
    assert api.get(f"{path}&layer=topology").json()["features"] == whole
    assert api.get(f"{path}&layer=objects").json()["features"] == []


def test_default_is_the_parent(api: Api, edited: str) -> None:
    expected = api.get(f"environments/{edited}/diff?from=3&to=4&format=geojson").json()
    assert api.get(f"environments/{edited}/diff?format=geojson").json() == expected


def test_datum_is_that_of_each_version(api: Api, edited: str) -> None:
    api("PATCH", f"environments/{edited}", 200, json={"datum": {"latitude": 10.0, "longitude": 20.0}})
    body = by_id(api.get(f"environments/{edited}/diff?from=3&to=5&format=geojson&crs=wgs84").json())
    moved = body["field"]
    assert moved["geometry"]["coordinates"][0] == pytest.approx(20.0, abs=0.01)
    assert moved["properties"]["before_geometry"]["coordinates"][0] == pytest.approx(samples.LONGITUDE, abs=0.01)
    assert "barn" not in body, "nobody edited it"


def test_condition_and_problems(api: Api, edited: str, bare: str) -> None:
    path = f"environments/{edited}/diff?from=3&to=4&format=geojson"
    api.get(path, 304, headers={"If-None-Match": api.get(path).headers["etag"]})
    for query in ("limit=2", "layer=topology", "crs=local", "cursor=x"):
        assert "format=geojson" in api.problem("GET", f"environments/{edited}/diff?from=3&to=4&{query}", 422)["detail"]
    assert "omit one" in api.problem("GET", f"{path}&render=png", 422)["detail"]
    assert "needs limit" in api.problem("GET", f"{path}&cursor=x", 422)["detail"]
    api.upload(bare, {"n.tmap2.yaml": samples.tmap2()})
    assert "datum" in api.problem("GET", f"environments/{bare}/diff?format=geojson&crs=wgs84", 422)["detail"]
    assert len(api.get(f"environments/{bare}/diff?format=geojson").json()["features"]) == 6
