"""A robot can be told "aisle-2": words of areas reach the search, networks and every format with names."""

from __future__ import annotations

import io
import json
from typing import Any

import numpy as np
import pytest
import yaml
from PIL import Image

from app.derive import _kernels_rooms, _kernels_skeleton, _kernels_space
from tests.api.conftest import Api

HALL = "image: map.png\nresolution: 0.1\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"


def hall(*, board: bool = False) -> dict[str, bytes]:
    """Return a grid of a hall of 16 × 12 m with three racks; optionally with a board in the north."""
    grey = np.full((120, 160), 254, np.uint8)
    grey[:2], grey[-2:], grey[:, :2], grey[:, -2:] = 0, 0, 0, 0
    for row in (30, 60, 90):
        grey[row : row + 12, 30:130] = 0
    if board:
        grey[110:114, 60:64] = 0
    out = io.BytesIO()
    Image.fromarray(grey[::-1]).save(out, "PNG")
    return {"map.yaml": HALL.encode(), "map.png": out.getvalue()}


def areas(api: Api, env: str) -> dict[str, dict[str, Any]]:
    body = api.get(f"environments/{env}/versions/latest/layers/zones", params={"name": "areas"}).json()
    return {f["id"]: f for f in body["features"]}


@pytest.fixture(scope="module")
def site(api: Api) -> str:
    for kernels in (_kernels_rooms, _kernels_space, _kernels_skeleton):
        kernels.compile_all()
    api.post("environments", {"name": "hall-of-words"})
    api.upload("hall-of-words", hall())
    made = api.post("environments/hall-of-words/derivations", {"method": "occupancy_to_zones"}).json()
    assert made["stale"] == []
    return "hall-of-words"


def test_words_reach_every_format_with_names(api: Api, site: str) -> None:
    words = {"aisle-2", "aisle-2/in", "aisle-2/out", "room-1"}
    tmap = yaml.safe_load(api.get(f"/maps/{site}/tmap2").content)
    assert words <= {entry["node"]["name"] for entry in tmap["nodes"]}
    node = next(e["node"] for e in tmap["nodes"] if e["node"]["name"] == "aisle-2/in")
    assert node["properties"]["area"] == "aisle-2"
    graph = yaml.safe_load(api.get(f"/maps/{site}/rmf_nav_graph").content)
    (level,) = graph["levels"].values()
    assert words <= {vertex[2]["name"] for vertex in level["vertices"]}
    route = json.loads(api.get(f"/maps/{site}/nav2_route").content)
    metadata = [f["properties"].get("metadata", {}) for f in route["features"]]
    assert words <= {m.get("name") for m in metadata}
    assert "aisle-2" in {m.get("area") for m in metadata}
    lif = json.loads(api.get(f"/maps/{site}/lif").content)
    assert words <= {n["nodeId"] for layout in lif["layouts"] for n in layout["nodes"]}
    assert b"name: aisle-2/in" in api.get(f"/maps/{site}/navgraph").content
    drawing = json.loads(api.get(f"/maps/{site}/geojson").content)
    assert "aisle-2" in {f["properties"].get("name") for f in drawing["features"]}


def test_renamed_area_keeps_its_word_when_derived_again(api: Api, site: str) -> None:
    for item in api.get("search", params={"q": "aisle-2"}).json()["items"]:
        assert (item["environment"], item["kind"], item["name"]) == (site, "zone", "aisle-2")
    feature = areas(api, site)["aisle-2"]
    renamed = {**feature["properties"], "name": "strawberry lane"}
    change = {"op": "put", "layer": "zones", "name": "areas", "feature": {**feature, "properties": renamed}}
    api.post(f"environments/{site}/edits", {"changes": [change]})
    api.upload(site, hall(board=True))
    again: dict[str, Any] = {"method": "occupancy_to_zones"}
    assert "replace=true" in api.problem("POST", f"environments/{site}/derivations", 409, json=again)["detail"]
    body = api.post(f"environments/{site}/derivations", {**again, "replace": True}).json()
    assert body["stale"] == []
    assert areas(api, site)["aisle-2"]["properties"]["name"] == "strawberry lane"
    api.post(f"environments/{site}/derivations", {"method": "occupancy_to_topology"})
    items = api.get("search", params={"q": "strawberry lane"}).json()["items"]
    found = {(item["kind"], item["name"]) for item in items}
    assert found >= {("zone", "strawberry lane"), ("node", "strawberry lane"), ("node", "strawberry lane/in")}


def test_words_stay_while_the_grid_changes(api: Api, site: str) -> None:
    """Areas that are stale still name nodes and stand in drawings: only deriving them again replaces them."""
    api.post("environments", {"name": "changing-hall"})
    api.upload("changing-hall", hall())
    api.post("environments/changing-hall/derivations", {"method": "occupancy_to_zones"})
    head = api.upload("changing-hall", hall(board=True)).json()
    assert [(s["layer"], s["changed"]) for s in head["stale"]] == [("zones", ["occupancy ground/map"])]
    tmap = yaml.safe_load(api.get("/maps/changing-hall/tmap2").content)
    assert "aisle-2/in" in {entry["node"]["name"] for entry in tmap["nodes"]}
    drawing = json.loads(api.get("/maps/changing-hall/geojson").content)
    assert "aisle-2" in {f["properties"].get("name") for f in drawing["features"]}
    body = api.post("environments/changing-hall/derivations", {"method": "occupancy_to_zones"}).json()
    assert body["stale"] == []
