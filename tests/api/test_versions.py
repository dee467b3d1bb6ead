"""Uploads, history, reverts, edits and sources over HTTP."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile

import pytest
from lxml import etree

from tests.api import samples
from tests.api.conftest import Api, problem


def test_upload_creates_a_version(api: Api, bare: str) -> None:
    answer = api.upload(bare, {"network.tmap2.yaml": samples.tmap2()}, message="driven today")
    body = answer.json()
    assert answer.headers["location"] == f"/api/v1/environments/{bare}/versions/1"
    assert answer.headers["etag"] == '"1"'
    assert set(body) == {
        "environment", "version", "root", "parent", "author", "message", "time", "changes", "sources", "warnings",
        "information", "stale", "tags",
    }  # fmt: skip
    assert (body["environment"], body["version"], body["parent"]) == (bare, 1, 0)
    assert (body["author"], body["message"]) == ("administrator", "driven today")
    assert body["time"].endswith("Z")
    changes = body["changes"]["topology"]
    assert (changes["added"], changes["changed"], changes["deleted"]) == (6, 0, 0)
    assert body["information"]["topology"] == "raw"
    assert body["information"]["occupancy"] == "missing"
    digest = hashlib.sha256(samples.tmap2()).hexdigest()
    (source,) = body["sources"]
    assert source == {
        "name": "network.tmap2.yaml", "size": len(samples.tmap2()), "sha256": digest, "format": "tmap2", "used": True,
    }  # fmt: skip
    assert api.get(answer.headers["location"]).json() == body


def test_reupload_of_same_content_returns_head(api: Api, bare: str) -> None:
    api.upload(bare, {"a.tmap2.yaml": samples.tmap2()})
    again = api.upload(bare, {"b.tmap2.yaml": samples.tmap2()}, expect=200)
    assert again.json()["version"] == 1
    assert {s["name"] for s in api.get(f"environments/{bare}/versions/1/sources").json()} >= {"b.tmap2.yaml"}
    assert len(api.get(f"environments/{bare}/versions").json()) == 2


def test_upload_of_several_files_creates_one_version(api: Api, bare: str) -> None:
    files = {
        "config/location/datum.yaml": samples.DATUM,
        "config/topological/network.tmap2.yaml": samples.tmap2(),
        **{f"config/metric/map/{name}": data for name, data in samples.grid().items()},
    }
    body = api.upload(bare, files).json()
    assert body["version"] == 1
    assert {s["name"] for s in body["sources"]} == set(files)
    for name, data in files.items():
        assert api.get(f"environments/{bare}/versions/1/sources/{name}").content == data
    info = body["information"]
    assert (info["location"], info["topology"], info["occupancy"]) == ("raw", "raw", "raw")


def lanes(ids: tuple[str, str]) -> bytes:
    places = [[[-0.5245, 53.2686], [-0.5244, 53.2686]], [[-0.5243, 53.2687], [-0.5242, 53.2688]]]
    rows = [
        {"type": "Feature", "id": i, "geometry": {"type": "LineString", "coordinates": p}, "properties": {}}
        for i, p in zip(ids, places, strict=True)
    ]
    return json.dumps({"type": "FeatureCollection", "features": rows}).encode()


def test_drawing_with_other_ids_creates_no_version(api: Api, bare: str) -> None:
    first = api.upload(bare, {"lanes.geojson": lanes(("a", "b"))}, layer="topology").json()
    again = api.upload(bare, {"lanes.geojson": lanes(("x", "y"))}, layer="topology").json()
    assert again["changes"].get("objects") is None, again["changes"]
    url = f"environments/{bare}/versions/latest/layers"
    objects = {f["id"] for f in api.get(f"{url}/objects").json()["features"]}
    network = api.get(f"{url}/topology").json()["features"]
    assert objects == {"a", "b"}
    assert {f["properties"]["drawn_from"] for f in network} == objects, first["changes"]
    assert len(json.loads(api.get(f"/maps/{bare}/geojson").content)["features"]) == 2


def test_osm_ids_are_never_changed(api: Api, bare: str) -> None:
    """OSM ids are global: other ids are other features, even with equal geometry."""
    api.upload(bare, {"a.osm": samples.OSM})
    other = samples.OSM.replace(b'id="1"', b'id="11"').replace(b'id="2"', b'id="12"').replace(b'id="3"', b'id="13"')
    other = other.replace(b'ref="1"', b'ref="11"').replace(b'ref="2"', b'ref="12"')
    api.upload(bare, {"a.osm": other})
    root = etree.fromstring(api.get(f"/maps/{bare}/osm").content)
    assert {node.get("id") for node in root.iter("node")} == {"11", "12"}
    assert [way.get("id") for way in root.iter("way")] == ["13"]


def test_zip_equals_its_files(api: Api, bare: str) -> None:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name, data in samples.grid().items():
            archive.writestr(f"grids/{name}", data)
    body = api.upload(bare, {"grids.zip": packed.getvalue()}).json()
    assert body["information"]["occupancy"] == "raw"
    assert api.get(f"environments/{bare}/versions/1/sources/grids/map.yaml").content == samples.grid()["map.yaml"]


def test_dry_run_stores_nothing(api: Api, bare: str) -> None:
    body = api.upload(bare, {"n.tmap2.yaml": samples.tmap2()}, expect=200, dry_run="true").json()
    assert body["version"] is None
    assert body["changes"]["topology"]["added"] == 6
    assert len(body["root"]) == 64
    assert api.get(f"environments/{bare}").json()["version"] == 0
    version = api.upload(bare, {"n.tmap2.yaml": samples.tmap2()}).json()
    assert version["root"] == body["root"]


@pytest.mark.parametrize("tag", ['"0"', '"7", "0"', "*"])
def test_if_match_accepts_the_head_only(api: Api, bare: str, tag: str) -> None:
    api.upload(bare, {"n.tmap2.yaml": samples.tmap2()}, headers={"If-Match": tag})


def test_if_match_accepts_a_root(api: Api, bare: str) -> None:
    root = api.get(f"environments/{bare}").json()["root"]
    api.upload(bare, {"n.tmap2.yaml": samples.tmap2()}, headers={"If-Match": f'"{root}"'})
    answer = api.upload(bare, {"datum.yaml": samples.DATUM}, expect=412, headers={"If-Match": f'"{root}"'})
    assert "version 1" in problem(answer)["detail"]


def test_idempotency_key_returns_the_first_response(api: Api, bare: str) -> None:
    headers = {"Idempotency-Key": "k-1"}
    first = api.upload(bare, {"n.tmap2.yaml": samples.tmap2()}, headers=headers, message="m")
    api.upload(bare, {"datum.yaml": samples.DATUM})
    second = api.upload(bare, {"n.tmap2.yaml": samples.tmap2()}, headers=headers, message="m")
    assert second.json() == first.json()
    assert second.headers["location"] == first.headers["location"]
    problem(api.upload(bare, {"n.tmap2.yaml": samples.tmap2()}, expect=409, headers=headers, message="other"))
    assert api.get(f"environments/{bare}").json()["version"] == 2


def test_idempotency_key_covers_unchanged_uploads(api: Api, bare: str) -> None:
    api.upload(bare, {"n.tmap2.yaml": samples.tmap2()})
    headers = {"Idempotency-Key": "k"}
    api.upload(bare, {"n.tmap2.yaml": samples.tmap2()}, expect=200, headers=headers)
    api.post(f"environments/{bare}/versions", {"revert_to": 1}, expect=200, headers={"Idempotency-Key": "r"})
    api.upload(bare, {"n.tmap2.yaml": samples.tmap2({"gate": (0.0, 0.0), "barn": (10.0, 1.0), "field": (9.0, 9.0)})})
    again = api.upload(bare, {"n.tmap2.yaml": samples.tmap2()}, expect=200, headers=headers)
    assert again.json()["version"] == 1
    once_more = {"Idempotency-Key": "r"}
    assert api.post(f"environments/{bare}/versions", {"revert_to": 1}, expect=200, headers=once_more).json() == (
        again.json()
    )
    problem(api.upload(bare, {"datum.yaml": samples.DATUM}, expect=409, headers=headers))
    assert api.get(f"environments/{bare}").json()["version"] == 2


def test_revert_creates_a_version(api: Api, farm: str) -> None:
    body = {"revert_to": 1, "message": "the gate was open"}
    answer = api.post(f"environments/{farm}/versions", body, headers={"If-Match": '"3"', "Idempotency-Key": "r"})
    version = answer.json()
    assert (version["version"], version["parent"], version["message"]) == (4, 3, "the gate was open")
    assert version["root"] == api.get(f"environments/{farm}/versions/1").json()["root"]
    again = api.post(f"environments/{farm}/versions", body, headers={"If-Match": '"3"', "Idempotency-Key": "r"})
    assert again.json() == version
    api.post(f"environments/{farm}/versions", {"revert_to": 4}, expect=200)
    api.problem("POST", f"environments/{farm}/versions", 404, json={"revert_to": 99})
    api.problem("POST", f"environments/{farm}/versions", 412, json=body, headers={"If-Match": '"3"'})
    for bad in ({}, {"revert_to": -1}, {"revert_to": "x"}, {"revert_to": 1, "extra": 2}, []):
        api.problem("POST", f"environments/{farm}/versions", 422, json=bad)


def test_history_is_paginated_newest_first(api: Api, farm: str) -> None:
    first = api.get(f"environments/{farm}/versions?limit=3")
    assert [v["version"] for v in first.json()] == [3, 2, 1]
    second = api.get(first.links["next"]["url"])
    assert [v["version"] for v in second.json()] == [0]
    assert "next" not in second.links
    assert "link" not in api.get(f"environments/{farm}/versions?limit=4").headers
    api.problem("GET", f"environments/{farm}/versions?cursor=x", 422)


def test_versions_are_found_by_number_and_channel(api: Api, farm: str) -> None:
    answer = api.get(f"environments/{farm}/versions/latest")
    assert answer.json()["version"] == 3
    assert answer.headers["fleetmap-root"] == answer.json()["root"]
    assert api.get(f"environments/{farm}/versions/0").json()["parent"] is None
    for missing in ("99", "production", "nosuch"):
        api.problem("GET", f"environments/{farm}/versions/{missing}", 404)
    for bad in ("-1", "1.5", "A", "9" * 30):
        api.problem("GET", f"environments/{farm}/versions/{bad}", 422)


# --- sources ---


def test_sources_are_attachments(api: Api, farm: str) -> None:
    answer = api.get(f"environments/{farm}/versions/2/sources/network.tmap2.yaml")
    assert answer.content == samples.tmap2()
    assert answer.headers["content-type"] == "application/octet-stream"
    assert answer.headers["content-disposition"] == 'attachment; filename="network.tmap2.yaml"'
    assert answer.headers["x-content-type-options"] == "nosniff"
    etag = answer.headers["etag"]
    assert etag == f'"{hashlib.sha256(samples.tmap2()).hexdigest()}"'
    path = f"environments/{farm}/versions/2/sources/network.tmap2.yaml"
    assert api.get(path, 304, headers={"If-None-Match": etag}).content == b""
    part = api.get(path, 206, headers={"Range": "bytes=2-5"})
    assert part.content == samples.tmap2()[2:6]
    assert part.headers["content-range"] == f"bytes 2-5/{len(samples.tmap2())}"
    beyond = api.get(path, 416, headers={"Range": "bytes=999999-"})
    assert beyond.headers["content-range"] == f"bytes */{len(samples.tmap2())}"
    problem(beyond)
    api.problem("GET", f"environments/{farm}/versions/2/sources/other.yaml", 404)


# --- edits ---


def put(item: str, x: float, y: float, **more: object) -> dict[str, object]:
    shape = {"type": "Point", "coordinates": [x, y]}
    feature = {
        "type": "Feature",
        "id": item,
        "geometry": None,
        "place": shape,
        "properties": {"kind": "node", "name": item},
    }
    return {"op": "put", "layer": "topology", "feature": feature, **more}


def test_edges_follow_a_moved_node(api: Api, farm: str) -> None:
    answer = api.post(f"environments/{farm}/edits", {"message": "moved", "changes": [put("barn", 12.0, 1.0)]})
    body = answer.json()
    assert (body["version"], body["message"]) == (4, "moved")
    changes = body["changes"]["topology"]
    assert (changes["added"], changes["changed"], changes["deleted"]) == (0, 4, 0)
    layer = api.get(f"environments/{farm}/versions/4/layers/topology?crs=local").json()
    places = {f["id"]: f["place"]["coordinates"] for f in layer["features"]}
    assert places["barn"] == [12.0, 1.0]
    assert places["gate_barn"][-1] == [12.0, 1.0]
    assert places["barn_field"][0] == [12.0, 1.0]
    before = api.get(f"environments/{farm}/versions/3/layers/topology?crs=local").json()
    assert {f["id"]: f["place"]["coordinates"] for f in before["features"]}["barn"] == [10.0, 0.0]


def test_dangling_edge_is_refused(api: Api, farm: str) -> None:
    answer = api.problem(
        "POST",
        f"environments/{farm}/edits",
        422,
        json={"message": "", "changes": [{"op": "delete", "layer": "topology", "id": "barn"}]},
    )
    assert {e["where"] for e in answer["errors"]} == {"gate_barn", "barn_gate", "barn_field"}
    assert api.get(f"environments/{farm}").json()["version"] == 3
    everything = [
        {"op": "delete", "layer": "topology", "id": i} for i in ("barn", "gate_barn", "barn_gate", "barn_field")
    ]
    body = api.post(f"environments/{farm}/edits", {"changes": everything}).json()
    assert body["changes"]["topology"]["deleted"] == 4


def test_cells_in_a_polygon_are_set(api: Api, farm: str) -> None:
    ring = [[-0.5, -2.0], [0.5, -2.0], [0.5, -1.0], [-0.5, -1.0], [-0.5, -2.0]]
    change = {
        "op": "cells",
        "grid": "map",
        "polygon": {"type": "Polygon", "coordinates": [ring]},
        "crs": "local",
        "value": 100,
    }
    body = api.post(f"environments/{farm}/edits", {"changes": [change]}).json()
    assert body["changes"]["occupancy"]["map"]["blocked"] == 4
    url = f"environments/{farm}/versions/{{}}/layers/occupancy"
    before, after = (api.get(url.format(v), headers={"Accept": "application/json"}).json() for v in (3, 4))
    assert after["counts"]["occupied"] == before["counts"]["occupied"] + 4


@pytest.mark.parametrize(
    "change",
    [
        {"op": "paint"},
        {"op": "put", "layer": "topology"},
        {"op": "put", "layer": "occupancy", "feature": {}},
        {"op": "put", "layer": "topology", "feature": {"type": "Feature", "properties": {"kind": "node"}}},
        {"op": "put", "layer": "topology", "feature": {"type": "Feature", "id": "n", "properties": {}}, "extra": 1},
        {"op": "delete", "layer": "topology", "id": "nobody"},
        {"op": "cells", "grid": "nosuch", "polygon": {"type": "Polygon", "coordinates": []}, "value": 0},
        {"op": "cells", "polygon": {"type": "Point", "coordinates": [0, 0]}, "value": 0},
        {"op": "cells", "polygon": {"type": "Polygon", "coordinates": [[[0, 0], [1, 0], [1, 1]]]}, "value": 101},
        {"op": "put", "layer": "topology", "feature": {"type": "Feature", "id": "n", "geometry": {"type": "Point",
         "coordinates": [999, 0]}, "properties": {"kind": "node"}}},
        {"op": "put", "layer": "topology", "feature": {"type": "Feature", "id": "n", "geometry": {"type": "Point",
         "coordinates": ["x", None]}, "properties": {"kind": "node"}}},
    ],
)  # fmt: skip
def test_invalid_edits_are_refused(api: Api, unchanged_farm: str, change: object) -> None:
    api.problem("POST", f"environments/{unchanged_farm}/edits", 422, json={"changes": [change]})
    assert api.get(f"environments/{unchanged_farm}").json()["version"] == 3


def test_edits_honour_if_match_and_idempotency_key(api: Api, farm: str) -> None:
    body = {"changes": [put("new", 1.0, 1.0)]}
    api.problem("POST", f"environments/{farm}/edits", 412, json=body, headers={"If-Match": '"2"'})
    first = api.post(f"environments/{farm}/edits", body, headers={"If-Match": '"3"', "Idempotency-Key": "e"})
    assert api.post(f"environments/{farm}/edits", body, headers={"If-Match": '"3"', "Idempotency-Key": "e"}).json() == (
        first.json()
    )
    api.problem("POST", f"environments/{farm}/edits", 422, json={"changes": []})


@pytest.mark.parametrize(
    "text",
    [
        '{"changes": [{"op": "put", "layer": "objects", "feature": {"type": "Feature", "id": "a", "geometry": null, '
        '"properties": {"x": NaN}}}]}',
        '{"changes": [',
        "\ud800".encode("utf-8", "surrogatepass"),
        '{"message": "\\ud800", "changes": []}',
        "[" * 5000,
        '{"message": "x", "changes": [{"op": "delete", "layer": "zones", "id": 123456789012345678901234567890}]}',
        '{"message": 1e999, "changes": []}',
    ],
)
def test_invalid_json_returns_400(api: Api, unchanged_farm: str, text: str | bytes) -> None:
    headers = {"Content-Type": "application/json"}
    api.problem("POST", f"environments/{unchanged_farm}/edits", 400, content=text, headers=headers)
