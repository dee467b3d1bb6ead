"""Committed derivations: provenance, staleness, and derivation from changed inputs."""

from __future__ import annotations

from typing import Any

import pytest

from tests.api.conftest import Api

LANE = """<kml xmlns="http://www.opengis.net/kml/2.2"><Document><name>lanes</name><Placemark><name>Lane</name>
<LineString><coordinates>0.001,0.001 0.002,0.001 {more}</coordinates></LineString></Placemark></Document></kml>"""
DATUM = {"latitude": 0.0, "longitude": 0.0}


def lanes(more: str = "") -> dict[str, bytes]:
    return {"lanes.kml": LANE.format(more=more).encode()}


@pytest.fixture
def env(api: Api, request: pytest.FixtureRequest) -> str:
    name = f"d-{abs(hash(request.node.name)) % 10**9}"
    api.post("environments", {"name": name, "datum": DATUM})
    api.upload(name, lanes())
    return name


def derive(api: Api, env: str, expect: int | None = 201, **body: Any) -> Any:
    return api.post(f"environments/{env}/derivations", {"method": "objects_to_topology", **body}, expect=expect).json()


def nodes(api: Api, env: str, version: str = "latest") -> int:
    features = api.get(f"environments/{env}/versions/{version}/layers/topology").json()["features"]
    return sum(f["properties"]["kind"] == "node" for f in features)


def test_derivation_creates_a_version_with_provenance(api: Api, env: str) -> None:
    version = derive(api, env, parameters={"join": 0.5}, message="for the tractors")
    assert version["version"] == 3
    assert version["information"]["topology"] == "derived"
    assert version["stale"] == []
    assert version["message"] == "for the tractors"
    assert nodes(api, env) == 2
    report = api.get(f"environments/{env}/versions/3/reports/tmap2").json()
    line = next(line for line in report["layers"] if line["layer"] == "topology")
    assert line["information"] == "derived"
    assert line["sources"] == ["lanes.kml"]
    assert line["steps"][0] == {
        "step": "objects_to_topology",
        "from": ["objects"],
        "to": "topology",
        "parameters": {"join": 0.5, "outlines": False},
    }
    table = {row["format"]: row for row in api.get(f"environments/{env}/versions/3/maps").json()}
    assert table["tmap2"]["state"] == "direct"
    again = derive(api, env, expect=200, parameters={"join": 0.5})
    assert again["version"] == 3, "no new version"


def test_changed_inputs_make_derived_layers_stale(api: Api, env: str) -> None:
    derive(api, env, parameters={"join": 0.5})
    api.upload(env, lanes("0.002,0.002"))
    head = api.get(f"environments/{env}/versions/latest").json()
    assert [(s["layer"], s["changed"]) for s in head["stale"]] == [("topology", ["objects ground/kml"])]
    assert nodes(api, env) == 2, "stored versions do not change"
    assert api.get(f"/maps/{env}/tmap2").content.count(b"- meta:") == 3, "maps are derived from the current inputs"
    report = api.get(f"environments/{env}/versions/latest/reports/tmap2").json()
    line = next(line for line in report["layers"] if line["layer"] == "topology")
    assert line["steps"][0]["parameters"]["join"] == 0.5, "like before"
    old = api.get(f"environments/{env}/versions/3/maps/tmap2").content
    assert old.count(b"- meta:") == 2
    renewed = derive(api, env, parameters={"join": 0.5})
    assert renewed["stale"] == []
    assert nodes(api, env) == 3


def test_derivation_with_equal_result_clears_stale(api: Api, env: str) -> None:
    derive(api, env, parameters={"join": 0.5})
    named = {"lanes.kml": lanes()["lanes.kml"].replace(b"<name>lanes", b"<name>ways")}
    api.upload(env, named)
    stale = api.get(f"environments/{env}/versions/latest").json()
    assert [s["changed"] for s in stale["stale"]] == [["objects ground/kml"]]
    assert [s["method"] for s in stale["stale"]] == ["objects_to_topology"]
    assert set(stale["stale"][0]["parameters"]) == {
        p["name"] for d in api.get("derivations").json() if d["id"] == "objects_to_topology" for p in d["parameters"]
    }
    version = derive(api, env, parameters={"join": 0.5})
    assert (version["version"], version["root"], version["stale"]) == (5, stale["root"], [])
    assert version["changes"] == {"renewed": [{"layer": "topology", "level": "ground", "name": "network"}]}
    report = api.get(f"environments/{env}/versions/latest/reports/tmap2").json()
    assert not any("Derive it again" in w["problem"] for w in report["warnings"])
    assert api.get(f"environments/{env}/diff?from=4&to=5").json()["layers"] == {}
    assert derive(api, env, expect=200, parameters={"join": 0.5})["version"] == 5, "now nothing changes"
    assert api.get(f"environments/{env}/versions/4").json()["stale"] == stale["stale"], "old versions do not change"


def test_derivation_keeps_edited_layers(api: Api, env: str) -> None:
    derive(api, env)
    point = {"type": "Point", "coordinates": [0.003, 0.003]}
    dock = {"type": "Feature", "id": "dock", "geometry": point, "properties": {"kind": "node", "name": "dock"}}
    change = {"op": "put", "layer": "topology", "feature": dock}
    api.post(f"environments/{env}/edits", {"message": "a dock", "changes": [change]})
    api.upload(env, lanes("0.002,0.002"))
    assert b"node: dock" in api.get(f"/maps/{env}/tmap2").content
    report = api.get(f"environments/{env}/versions/latest/reports/tmap2").json()
    assert any("Derive it again" in w["problem"] for w in report["warnings"])
    refused = derive(api, env, expect=409)
    assert "replace=true" in refused["detail"]
    assert b"node: dock" not in api.get(f"/maps/{env}/tmap2").content or derive(api, env, replace=True)
    assert nodes(api, env) == 3


def test_derivation_keeps_uploaded_layers(api: Api, env: str) -> None:
    api.upload(env, lanes("0.002,0.002"), layer="topology")
    refused = derive(api, env, expect=409)
    assert "is raw" in refused["detail"]
    assert derive(api, env, expect=200, replace=True)["version"] == 3, "the same network creates no version"
    api.upload(env, {"b.kml": lanes("0.003,0.002")["lanes.kml"]}, layer="objects")
    assert derive(api, env, replace=True)["information"]["topology"] == "derived"


@pytest.mark.parametrize(
    ("body", "word"),
    [
        ({"method": "alchemy"}, "objects_to_topology"),
        ({"parameters": {"join": -1}}, "at least 0"),
        ({"parameters": {"colour": "red"}}, "accepted: join, outlines"),
        ({"sideways": True}, "sideways"),
    ],
)
def test_bad_derivation_requests_list_accepted_values(api: Api, env: str, body: dict[str, Any], word: str) -> None:
    assert word in str(derive(api, env, expect=422, **body))
    assert api.get(f"environments/{env}").json()["version"] == 2


def test_derivation_without_inputs_returns_422(api: Api) -> None:
    api.post("environments", {"name": "nothing-there"})
    refused = api.post("environments/nothing-there/derivations", {"method": "objects_to_topology"}, expect=None)
    assert refused.status_code == 422
    assert "needs objects" in refused.json()["detail"]


def test_derivation_honours_if_match_and_idempotency_key(api: Api, env: str) -> None:
    body = {"method": "objects_to_topology"}
    address = f"environments/{env}/derivations"
    assert api.post(address, body, expect=None, headers={"if-match": '"1"'}).status_code == 412
    first = api.post(address, body, headers={"idempotency-key": "k"}).json()
    assert api.post(address, body, headers={"idempotency-key": "k"}).json() == first
    other = {**body, "parameters": {"join": 3}}
    assert api.post(address, other, expect=None, headers={"idempotency-key": "k"}).status_code == 409


def test_list_of_derivations_has_parameters(api: Api) -> None:
    derivations = {d["id"]: d for d in api.get("derivations").json()}
    assert derivations["objects_to_topology"]["gives"] == "topology"
    assert [p["name"] for p in derivations["objects_to_topology"]["parameters"]] == ["join", "outlines"]
