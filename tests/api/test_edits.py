"""Edits of content that the server returned: unedited content does not change, and no wrong content is stored."""

from __future__ import annotations

import re
from typing import Any

import pytest

from tests.api import samples
from tests.api.conftest import Api

Json = dict[str, Any]

DRAWING = b"""\
<kml xmlns="http://www.opengis.net/kml/2.2"><Document><name>lanes</name>
<Placemark><name>lane</name><LineString><coordinates>-0.5245,53.2686 -0.5244,53.2686 -0.5243,53.2687</coordinates>
</LineString></Placemark>
<Placemark><name>other</name><LineString><coordinates>-0.5242,53.2686 -0.5241,53.2686</coordinates></LineString>
</Placemark></Document></kml>
"""


def features(api: Api, env: str, layer: str, **query: str) -> dict[str, Json]:
    items = api.get(f"environments/{env}/versions/latest/layers/{layer}", params=query).json()["features"]
    return {f["id"]: f for f in items}


def edit(api: Api, env: str, *changes: Json, expect: int = 201) -> Json:
    body: Json = api.post(f"environments/{env}/edits", {"changes": list(changes)}, expect=expect).json()
    return body


def put(layer: str, feature: Json, **more: object) -> Json:
    return {"op": "put", "layer": layer, "feature": feature, **more}


@pytest.mark.parametrize("layer", ["topology", "location"])
@pytest.mark.parametrize("crs", ["local", "wgs84"])
def test_put_of_an_unedited_feature_creates_no_version(api: Api, bare: str, layer: str, crs: str) -> None:
    odd = {"a": (1 / 3, 2 / 3), "b": (10 / 7, -5 / 9)}
    files = {"datum.yaml": samples.DATUM, "n.tmap2.yaml": samples.tmap2(odd, (("a", "b"), ("b", "a")))}
    before = api.upload(bare, files).json()
    shown = features(api, bare, layer, crs=crs)
    assert shown
    body = edit(api, bare, *(put(layer, f, crs=crs) for f in shown.values()), expect=200)
    assert (body["version"], body["root"]) == (1, before["root"])


def test_edited_feature_keeps_its_anchor(api: Api, farm: str) -> None:
    node = features(api, farm, "topology", crs="wgs84")["barn"]
    node["geometry"]["coordinates"][1] += 1e-5
    edit(api, farm, put("topology", node, crs="wgs84"))
    (entry,) = [e for e in api.get(f"environments/{farm}/versions/4/layers").json() if e["layer"] == "topology"]
    assert entry["bounds"]["wgs84"] == pytest.approx([-0.5245, 53.2686, -0.52435, 53.26867], abs=2e-5)
    items = features(api, farm, "topology", crs="local")
    assert items["barn"]["place"]["coordinates"] == pytest.approx([10.0, 1.113], abs=1e-3)
    assert items["gate_barn"]["place"]["coordinates"][-1] == items["barn"]["place"]["coordinates"]


def test_edited_fence_sets_the_datum(api: Api, farm: str) -> None:
    (fence,) = features(api, farm, "location").values()
    fence["properties"]["datum"]["latitude"] += 0.001
    body = edit(api, farm, put("location", fence))
    assert set(body["changes"]) == {"datum"}
    assert "features with local anchor keep their metres" in body["warnings"][0]["problem"]
    assert api.get(f"environments/{farm}").json()["datum"]["latitude"] == pytest.approx(samples.LATITUDE + 0.001)
    (after,) = features(api, farm, "location").values()
    assert after["geometry"] == fence["geometry"]
    fence["properties"]["datum"] = {"latitude": "north", "longitude": 0}
    edit(api, farm, put("location", fence), expect=422)


def test_datum_without_a_fence_is_an_editable_point(api: Api, bare: str) -> None:
    api("PATCH", f"environments/{bare}", 200, json={"datum": {"latitude": 1.0, "longitude": 2.0}})
    (point,) = features(api, bare, "location").values()
    assert (point["id"], point["part"], point["geometry"]["coordinates"]) == ("datum", "site", [2.0, 1.0])
    for layer in ("objects", "topology", "zones"):
        assert features(api, bare, layer) == {}
    assert features(api, bare, "location", bbox="10,10,11,11") == {}
    assert set(features(api, bare, "location", bbox="1,0,3,2")) == {"datum"}
    point["properties"]["datum"]["heading"] = 30.0
    body = edit(api, bare, put("location", point))
    assert set(body["changes"]) == {"datum"}
    assert api.get(f"environments/{bare}").json()["datum"]["heading"] == 30.0
    assert not [e for e in api.get(f"environments/{bare}/versions/latest/layers").json() if e["count"]]


POINT: Json = {"type": "Point", "coordinates": [0.0, 0.0]}
RING: Json = {"type": "Polygon", "coordinates": [[[0, 0], [1, 0], [1, 1], [0, 0]]]}


@pytest.mark.parametrize(
    ("layer", "geometry", "properties", "message"),
    [
        ("topology", None, {"kind": "node"}, "Point"),
        ("topology", RING, {"kind": "node"}, "Point"),
        ("topology", POINT, {"kind": "edge", "source": "gate", "target": "barn"}, "LineString"),
        ("zones", POINT, {"kind": "keepout"}, "Polygon"),
        ("zones", None, {"kind": "keepout"}, "Polygon"),
        ("location", POINT, {"kind": "fence"}, "Polygon"),
    ],
)
def test_features_need_the_geometry_of_their_kind(
    api: Api, unchanged_farm: str, layer: str, geometry: Json | None, properties: Json, message: str
) -> None:
    feature = {"type": "Feature", "id": "new", "geometry": geometry, "properties": properties}
    change = put(layer, feature, crs="local")
    problem = api.problem("POST", f"environments/{unchanged_farm}/edits", 422, json={"changes": [change]})
    assert message in problem["detail"]
    assert problem["errors"][0]["where"] == "changes[0]"


def placemarks(api: Api, env: str) -> list[str]:
    text = api.get(f"/maps/{env}/kml").text
    return re.findall(r"<Placemark[^>]*>\s*<name>([^<]*)</name>", text)


def test_drawing_formats_show_edited_networks(api: Api, bare: str) -> None:
    """A drawing format omits features made from a line that it writes, but only while the line still implies them."""
    api.upload(bare, {"lanes.kml": DRAWING}, layer="topology")
    assert set(placemarks(api, bare)) == {"lane", "other"}
    network = features(api, bare, "topology")
    node = next(f for i, f in network.items() if f["geometry"]["coordinates"] == [-0.5244, 53.2686])
    assert node["properties"]["drawn_from"] == "lane"
    node["geometry"]["coordinates"][1] += 1e-4
    edit(api, bare, put("topology", node))
    marks = placemarks(api, bare)
    assert node["id"] in marks
    assert {"lane", "other"} <= set(marks)
    of_other = [i for i, f in network.items() if f["properties"]["drawn_from"] == "other"]
    assert of_other
    assert not set(of_other) & set(marks)
    after = features(api, bare, "topology")
    assert {i for i, f in after.items() if "drawn_from" in f["properties"]} == set(of_other)


def test_moved_line_does_not_move_the_network(api: Api, bare: str) -> None:
    api.upload(bare, {"lanes.kml": DRAWING}, layer="topology")
    before = features(api, bare, "topology")
    line = features(api, bare, "objects")["other"]
    line["geometry"]["coordinates"][0][1] += 1e-4
    edit(api, bare, put("objects", line))
    after = features(api, bare, "topology")
    assert {i: f["geometry"] for i, f in after.items()} == {i: f["geometry"] for i, f in before.items()}
    assert {"other/0", "other/1"} <= set(before) & set(placemarks(api, bare))


def test_edit_applies_to_the_level_of_the_feature(api: Api, farm: str) -> None:
    """Same names on two levels: a feature is put back on the level that it was read from."""
    body = api.upload(farm, {"n.tmap2.yaml": samples.tmap2()}, level="upstairs").json()
    assert {"name": "upstairs", "elevation": 0.0} in body["changes"]["levels"]["to"]
    shown = api.get(f"environments/{farm}/versions/4/layers/topology?crs=local").json()["features"]
    (barn,) = [f for f in shown if f["id"] == "barn" and f["level"] == "upstairs"]
    barn["place"]["coordinates"] = [11.0, 0.0]
    edit(api, farm, put("topology", barn))
    after = api.get(f"environments/{farm}/versions/5/layers/topology?crs=local").json()["features"]
    places = {f["level"]: f["place"]["coordinates"] for f in after if f["id"] == "barn"}
    assert places == {"ground": [10.0, 0.0], "upstairs": [11.0, 0.0]}
    without = {k: v for k, v in barn.items() if k not in ("level", "part")}
    edit(api, farm, put("topology", without), expect=422)
    body = edit(api, farm, put("topology", {**without, "id": "attic"}, level="attic"))
    assert "attic" in {level["name"] for level in body["changes"]["levels"]["to"]}
    edit(api, farm, put("topology", {**without, "id": "odd", "level": 5, "part": None}))


def test_edge_follows_both_nodes_moved_in_one_edit(api: Api, farm: str) -> None:
    shown = features(api, farm, "topology", crs="local")
    edge = next(f for f in shown.values() if f["properties"]["kind"] == "edge")
    ends = [shown[edge["properties"][end]] for end in ("source", "target")]
    for node in ends:
        node["place"]["coordinates"] = [v + 3.0 for v in node["place"]["coordinates"]]
        node.pop("geometry", None)
    edit(api, farm, *(put("topology", node, crs="local") for node in ends))
    moved = features(api, farm, "topology", crs="local")[edge["id"]]
    assert moved["place"]["coordinates"] == [node["place"]["coordinates"] for node in ends]


def node(name: str, x: float, y: float, level: str = "ground") -> Json:
    place = {"type": "Point", "coordinates": [x, y]}
    properties = {"kind": "node", "name": name}
    return put("topology", {"type": "Feature", "id": name, "place": place, "properties": properties}, level=level)


def edge(name: str, source: str, target: str, level: str | None = "ground", **properties: str) -> Json:
    place = {"type": "LineString", "coordinates": [[0, 0], [1, 1]]}
    properties = {"kind": "edge", "source": source, "target": target, **properties}
    change = put("topology", {"type": "Feature", "id": name, "place": place, "properties": properties})
    return change if level is None else {**change, "level": level}


def delete(item: str) -> Json:
    return {"op": "delete", "layer": "topology", "id": item}


@pytest.fixture
def storeys(api: Api, bare: str) -> str:
    """Create an environment with networks on two levels. A lift leads from one to the other; both have a `door`."""
    nodes = (node("hall", 0, 0), node("door", 5, 0), node("loft", 1, 1, "upper"), node("door", 5, 5, "upper"))
    edit(api, bare, *nodes, edge("walk", "hall", "door"), edge("way", "loft", "door", "upper"))
    edit(api, bare, edge("lift", "hall", "loft", None))
    return bare


def test_edge_to_another_level_is_edited_on_its_level(api: Api, storeys: str) -> None:
    edit(api, storeys, edge("lift", "hall", "loft", action="lift"))
    assert features(api, storeys, "topology")["lift"]["properties"]["action"] == "lift"


def test_edge_of_another_level_follows_its_node(api: Api, storeys: str) -> None:
    edit(api, storeys, node("loft", 3, 4, "upper"))
    places = {i: f["place"]["coordinates"] for i, f in features(api, storeys, "topology", crs="local").items()}
    assert places["lift"] == [[0, 0], [3, 4]]
    edit(api, storeys, node("door", 7, 7, "upper"))
    places = {i: f["place"]["coordinates"] for i, f in features(api, storeys, "topology", crs="local").items()}
    assert places["walk"] == [[0, 0], [1, 1]], "it ends at the door of its own level"
    assert places["way"] == [[3, 4], [7, 7]]


@pytest.mark.parametrize(
    ("change", "cut"),
    [
        (delete("loft"), {"lift", "way"}),
        (delete("hall"), {"lift", "walk"}),
        (edge("loft", "hall", "hall", "upper"), {"lift", "way"}),
        (edge("hall", "door", "door"), {"lift", "walk"}),
        (edge("loft", "door", "door"), {"lift"}),
    ],
)
def test_edges_of_all_levels_keep_their_nodes(api: Api, storeys: str, change: Json, cut: set[str]) -> None:
    """A node is neither deleted nor becomes an edge while an edge of any level ends there."""
    answer = api.problem("POST", f"environments/{storeys}/edits", 422, json={"changes": [change]})
    assert {problem["where"] for problem in answer["errors"]} == cut
    with_edges = [change, *(delete(item) for item in cut)]
    edit(api, storeys, *with_edges)


def test_edge_that_dangled_before_hinders_no_edit(api: Api, bare: str) -> None:
    """An upload may leave an edge without a node; edits of its other end, and of other nodes, are not about it."""
    api.upload(bare, {"n.tmap2.yaml": samples.tmap2(edges=(("gate", "barn"), ("barn", "moon")))})
    edit(api, bare, node("barn", 11, 1), delete("field"))
    answer = api.problem("POST", f"environments/{bare}/edits", 422, json={"changes": [delete("barn")]})
    assert {problem["where"] for problem in answer["errors"]} == {"gate_barn"}
