"""Vector layers in pages, filtered by text and ids, and simplified for drawing."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest
import shapely
from shapely.geometry import shape

from tests.api import samples
from tests.api.conftest import Api

NETWORK = ["barn", "barn_field", "barn_gate", "field", "gate", "gate_barn"]
PIXEL = 156543.034


def topology(env: str) -> str:
    return f"environments/{env}/versions/3/layers/topology"


def ids(body: dict[str, Any]) -> list[str]:
    return [feature["id"] for feature in body["features"]]


@pytest.fixture
def crowd(api: Api, bare: str) -> str:
    """Create an environment whose network has a row of 100 nodes, 1 m apart, and whose objects have known sizes."""
    put = [node(f"n{k:03}", float(k), 0.0) for k in range(100)]
    put.append(edge("short", "n000", "n001", [[0, 0], [0.4, 0.01], [1, 0]]))
    put.append(edge("long", "n000", "n099", [[0, 0], [50, 0.001], [99, 0]]))
    circle = shapely.Point(0, 0).buffer(100, quad_segs=64)
    put += [thing("circle", circle), thing("hut", shapely.box(0, 0, 3, 2)), thing("post", shapely.Point(5, 5))]
    put.append(thing("post2", shapely.Point(5, 5.001)))
    changes = [{"op": "put", "layer": layer, "feature": feature} for layer, feature in put]
    api.post(f"environments/{bare}/edits", {"changes": changes})
    return bare


def node(item: str, x: float, y: float) -> tuple[str, dict[str, Any]]:
    place = {"type": "Point", "coordinates": [x, y]}
    return "topology", feature(item, place, kind="node", name=f"Node {item[1:]}")


def edge(item: str, source: str, target: str, line: list[list[float]]) -> tuple[str, dict[str, Any]]:
    place = {"type": "LineString", "coordinates": line}
    return "topology", feature(item, place, kind="edge", source=source, target=target)


def thing(item: str, geometry: Any) -> tuple[str, dict[str, Any]]:
    return "objects", feature(item, json.loads(shapely.to_geojson(geometry)), kind="Thing")


def feature(item: str, place: dict[str, Any], **properties: str) -> dict[str, Any]:
    return {"type": "Feature", "id": item, "geometry": None, "place": place, "properties": properties,
            "coordRefSys": "urn:fleetmap:crs:local"}  # fmt: skip


def test_pages_are_the_whole_layer(api: Api, farm: str) -> None:
    whole = api.get(topology(farm)).json()
    assert not whole.keys() & {"next", "numberMatched", "numberReturned", "leftOut"}
    seen, cursor, links = [], "", []
    while True:
        answer = api.get(f"{topology(farm)}?limit=4{cursor}")
        body = answer.json()
        assert body["numberMatched"] == 6
        assert body["numberReturned"] == len(body["features"])
        seen += body["features"]
        if "next" not in body:
            assert "link" not in answer.headers
            break
        links.append(answer.headers["link"])
        cursor = f"&cursor={body['next']}"
    assert seen == whole["features"]
    assert len(links) == 1
    path = links[0].partition(">")[0].removeprefix("<")
    assert ids(api.get(path).json()) == NETWORK[4:]


def test_filters_select_by_text_ids_and_box_together(api: Api, farm: str) -> None:
    assert ids(api.get(f"{topology(farm)}?q=BARN").json()) == ["barn", "barn_field", "barn_gate", "gate_barn"]
    assert ids(api.get(f"{topology(farm)}?q=node").json()) == ["barn", "field", "gate"]
    assert ids(api.get(f"{topology(farm)}?ids=gate,nosuch,barn,gate").json()) == ["barn", "gate"]
    x, y = samples.NODES["barn"]
    box = f"crs=local&bbox={x - 1},{y - 1},{x + 1},{y + 1}"
    assert ids(api.get(f"{topology(farm)}?q=node&{box}").json()) == ["barn"]
    body = api.get(f"{topology(farm)}?q=node&ids=gate,barn_gate&limit=10").json()
    assert (ids(body), body["numberMatched"], body.get("next")) == (["gate"], 1, None)
    assert api.get(f"{topology(farm)}?q=nosuch&limit=10").json()["numberMatched"] == 0


def test_name_is_searched(api: Api, crowd: str) -> None:
    path = f"environments/{crowd}/versions/1/layers/topology"
    assert ids(api.get(f"{path}?q=node%20007&crs=local").json()) == ["n007"]


def test_datum_without_fence_is_one_feature_that_filters_select(api: Api, bare: str) -> None:
    api("PATCH", f"environments/{bare}", 200, json={"datum": {"latitude": 53.2, "longitude": -0.5}})
    path = f"environments/{bare}/versions/1/layers/location"
    assert ids(api.get(path).json()) == ["datum"]
    for query, expected in (("limit=5", ["datum"]), ("q=Dat", ["datum"]), ("q=x", []), ("ids=datum", ["datum"])):
        assert ids(api.get(f"{path}?{query}").json()) == expected
    assert api.get(f"{path}?limit=5").json()["numberMatched"] == 1
    assert ids(api.get(f"{path}?ids=other&limit=5").json()) == []


@pytest.mark.parametrize("zoom", [12, 14, 16, 24])
def test_nodes_are_thinned_to_one_per_pixel(api: Api, crowd: str, zoom: int) -> None:
    body = api.get(f"environments/{crowd}/versions/1/layers/topology?crs=local&zoom={zoom}").json()
    pixel = PIXEL / 2**zoom
    columns = {math.floor(k / pixel): f"n{k:03}" for k in reversed(range(100))}
    edges = (["long"] if pixel <= 99 else []) + (["short"] if pixel <= 1 else [])
    assert ids(body) == sorted([*edges, *columns.values()])
    assert body["leftOut"] == 102 - len(body["features"])
    for item in body["features"]:
        if item["id"] == "long":
            assert item["place"]["coordinates"] == [[0, 0], [50, 0.001], [99, 0]], "edges are as stored"


def test_shapes_are_simplified_to_a_pixel_and_small_ones_left_out(api: Api, crowd: str) -> None:
    path = f"environments/{crowd}/versions/1/layers/objects?crs=local"
    stored = {f["id"]: shape(f["place"]) for f in api.get(path).json()["features"]}
    previous = shapely.get_num_coordinates(stored["circle"])
    for zoom in (18, 15, 13):
        body = api.get(f"{path}&zoom={zoom}").json()
        pixel = PIXEL / 2**zoom
        expected = ["circle", *(["hut"] if pixel <= 3 else []), "post", "post2"]
        assert ids(body) == expected
        assert body["leftOut"] == 4 - len(expected)
        circle = shape(body["features"][0]["place"])
        assert shapely.get_num_coordinates(circle) < previous
        assert stored["circle"].boundary.hausdorff_distance(circle.boundary) <= pixel
        previous = shapely.get_num_coordinates(circle)


def test_zoom_is_paged_after_thinning(api: Api, crowd: str) -> None:
    path = f"environments/{crowd}/versions/1/layers/topology?crs=local&zoom=14"
    complete = api.get(path).json()
    body = api.get(f"{path}&limit=3").json()
    assert body["numberMatched"] == len(complete["features"])
    assert body["leftOut"] == complete["leftOut"]
    rest = api.get(f"{path}&limit=1000&cursor={body['next']}").json()
    assert body["features"] + rest["features"] == complete["features"]


def test_zoom_in_degrees_has_pixels_of_the_same_size(api: Api, farm: str) -> None:
    # gate, barn and field are some metres apart: in one pixel of 156 m, and in pixels of their own at 0.6 m
    low, high = (api.get(f"{topology(farm)}?crs=wgs84&zoom={zoom}").json() for zoom in (10, 18))
    assert len(low["features"]) + low["leftOut"] == 6
    assert [f["properties"]["kind"] for f in low["features"]] == ["node"] * len(low["features"])
    assert len(low["features"]) <= 3
    assert ids(high) == NETWORK
    assert high["leftOut"] == 0


@pytest.mark.parametrize(
    ("query", "text"),
    [
        ("limit=0", "limit"),
        ("limit=10001", "limit"),
        ("zoom=25", "zoom"),
        ("zoom=-1", "zoom"),
        ("cursor=WyJhIl0", "cursor needs limit"),
        ("cursor=WyJhIl0&limit=2", "invalid cursor"),
        ("cursor=%ff&limit=2", "cursor"),
        ("ids=,", "ids must be 1 to 1000"),
        ("ids=" + ",".join(f"i{k}" for k in range(1001)), "ids must be 1 to 1000"),
        ("q=" + "x" * 201, "q"),
    ],
)
def test_wrong_parameters_are_refused(api: Api, farm: str, query: str, text: str) -> None:
    problem = api.problem("GET", f"{topology(farm)}?{query}", 422)
    assert text in json.dumps(problem)


def test_parameters_of_features_are_refused_for_grids(api: Api, farm: str) -> None:
    for query in ("limit=5", "q=x", "zoom=3", "ids=a"):
        problem = api.problem("GET", f"environments/{farm}/versions/3/layers/occupancy?{query}", 422)
        assert "not supported for occupancy" in problem["detail"]


def test_each_page_has_its_own_etag(api: Api, farm: str) -> None:
    tags = {api.get(f"{topology(farm)}?{query}").headers["etag"] for query in ("", "limit=2", "limit=3", "q=barn")}
    assert len(tags) == 4
    etag = api.get(f"{topology(farm)}?limit=2").headers["etag"]
    api.get(f"{topology(farm)}?limit=2", 304, headers={"If-None-Match": etag})
