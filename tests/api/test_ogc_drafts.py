"""Part 4 on drafts: features written one by one by GIS programs gather in a draft, and become one version."""

from __future__ import annotations

import json
from typing import Any
from urllib.parse import quote

import pytest

from app.ogc import tables, vector
from tests.api.conftest import Api

Json = dict[str, Any]

CRS84 = "http://www.opengis.net/def/crs/OGC/1.3/CRS84"
EPSG4326 = "http://www.opengis.net/def/crs/EPSG/0/4326"
MERCATOR = "http://www.opengis.net/def/crs/EPSG/0/3857"
UTM = "http://www.opengis.net/def/crs/EPSG/0/32630"
MERGE = {"content-type": "application/merge-patch+json"}
GEOJSON = {"content-type": "application/geo+json"}


class Gis:
    """A GIS program that was given one address."""

    def __init__(self, api: Api, env: str, draft: str = "mine") -> None:
        self.api, self.env = api, env
        self.at = f"/ogc/{env}/drafts/{draft}"
        self.local = {"content-crs": f"<{api.url}{self.at}/crs/local>"}

    def item(self, collection: str, feature: str, *, local: bool = True) -> Json:
        query = f"?crs={self.api.url}{self.at}/crs/local" if local else ""
        return dict(self.api.get(f"{self.at}/collections/{collection}/items/{feature}{query}").json())

    def add(self, collection: str, geometry: Json, expect: int = 201, id: str | None = None, **properties: Any) -> Any:
        body = {"type": "Feature", "geometry": geometry, "properties": properties} | ({} if id is None else {"id": id})
        path = f"{self.at}/collections/{collection}/items"
        return self.api("POST", path, expect, json=body, headers={**GEOJSON, **self.local})

    def patch(self, collection: str, feature: str, expect: int = 204, headers: Any = None, **body: Any) -> Any:
        path = f"{self.at}/collections/{collection}/items/{feature}"
        return self.api("PATCH", path, expect, json=body, headers={**MERGE, **self.local, **(headers or {})})

    def drafts(self) -> list[Json]:
        return list(self.api.get(f"environments/{self.env}/drafts").json())


@pytest.fixture
def gis(api: Api, farm: str) -> Gis:
    return Gis(api, farm)


def test_draft_lists_empty_collections_and_takes_their_first_feature(api: Api, gis: Gis) -> None:
    listed = {one["id"]: one for one in api.get(f"{gis.at}/collections").json()["collections"]}
    assert set(listed) >= {"nodes", "edges", "objects-points", "objects-lines", "objects-polygons", "zones", "fence"}
    assert "zones" not in [one["id"] for one in api.get(f"/ogc/{gis.env}/collections").json()["collections"]]
    assert "extent" not in listed["zones"]
    at = f"{gis.at}/collections/zones"
    page = api.get(f"{at}/items").json()
    assert (page["features"], page["numberMatched"]) == ([], 0)
    for query in ("?f=html", "?bbox=0,0,1,1", "?kind=keepout", "?f=jsonfg", f"?crs={MERCATOR}"):
        api.get(f"{at}/items{query}")
    schema = api.get(f"{at}/schema").json()["properties"]
    assert schema["geometry"]["format"] == "geometry-polygon"
    assert {"kind", "name", "level", "part"} <= set(schema)
    ring = [[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0], [0.0, 0.0]]
    gis.add("zones", {"type": "Polygon", "coordinates": [ring]}, kind="keepout", name="pond")
    (zone,) = api.get(f"{at}/items").json()["features"]
    assert (zone["id"], zone["properties"]["kind"]) == ("pond", "keepout")
    assert api.get(f"{at}").json()["extent"]["spatial"]["bbox"]


def test_items_of_an_empty_collection_are_not_found(api: Api, gis: Gis) -> None:
    at = f"{gis.at}/collections/zones/items/pond"

    def refuse_all() -> None:
        body = {"type": "Feature", "geometry": None, "properties": {}}
        api.get(at, 404)
        for headers in ({}, {"if-match": '"a"'}):
            api("PUT", at, 404, json=body, headers={**GEOJSON, **headers})
            gis.patch("zones", "pond", 404, headers=headers, properties={"a": 1})
            api("DELETE", at, 404, headers=headers)

    refuse_all()
    assert gis.drafts() == []
    ring = [[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0], [0.0, 0.0]]
    gis.add("zones", {"type": "Polygon", "coordinates": [ring]}, kind="keepout", name="pond")
    api("DELETE", at, 204)
    refuse_all()


def test_last_feature_that_leaves_its_collection_is_written(gis: Gis) -> None:
    gis.add("objects-points", point(1, 1), id="oak", kind="tree")
    assert "etag" not in gis.patch("objects-points", "oak", geometry=None).headers
    assert gis.item("objects-other", "oak")["geometry"] is None
    gis.api.get(f"{gis.at}/collections/objects-points/items/oak", 404)


OLD, NEW = "Mozilla/5.0 QGIS/34015/Linux", "Mozilla/5.0 QGIS/34400/Linux"


@pytest.mark.parametrize(
    ("collection", "query", "program", "shown"),
    [
        ("zones", "?limit=10", OLD, True),
        ("zones", "?limit=10", NEW, False),
        ("zones", "?limit=10", "python-httpx/0.28", False),
        ("zones", "?limit=1000", OLD, False),
        ("zones", "?limit=10&bbox=0,0,1,1", OLD, False),
        ("nodes", "?limit=10", OLD, False),
    ],
)
def test_only_old_versions_of_qgis_open_an_empty_collection_by_an_example(
    api: Api, gis: Gis, collection: str, query: str, program: str, *, shown: bool
) -> None:
    page = api.get(f"{gis.at}/collections/{collection}/items{query}", headers={"user-agent": program}).json()
    examples = [one for one in page["features"] if one["id"] == "example"]
    assert len(examples) == shown
    if shown:
        assert page["numberMatched"] == 0
        assert examples[0]["geometry"] == {"type": "Polygon", "coordinates": []}
        assert examples[0]["properties"] == dict.fromkeys(("kind", "name", "level", "part"))


def point(x: float, y: float) -> Json:
    return {"type": "Point", "coordinates": [x, y]}


def line(*points: tuple[float, float]) -> Json:
    return {"type": "LineString", "coordinates": [list(p) for p in points]}


def path(item: Json) -> list[Any]:
    return [pytest.approx(vertex, abs=1e-6) for vertex in item["geometry"]["coordinates"]]


def test_one_address_gathers_edits_that_become_one_version(api: Api, gis: Gis) -> None:
    assert gis.item("nodes", "barn")["geometry"]["coordinates"] == pytest.approx([10, 0]), "of the head"
    assert gis.drafts() == [], "reading makes no draft"
    gis.patch("nodes", "barn", properties={"colour": "red"})
    (draft,) = gis.drafts()
    assert (draft["name"], draft["is_owner"], draft["base"]) == ("mine", True, 3)
    gis.patch("nodes", "barn", geometry=point(12, 0))
    made = gis.add("nodes", point(20, 5), name="shed").headers["location"]
    assert made == f"{api.url}{gis.at}/collections/nodes/items/shed"
    new = gis.add("edges", line((12.2, 0.1), (15, 3), (20, 5))).headers["location"].rpartition("/")[2]
    edge = gis.item("edges", new)
    assert (new, edge["properties"]["source"], edge["properties"]["target"]) == ("barn_shed", "barn", "shed")
    assert path(edge) == [[12, 0], [15, 3], [20, 5]], "onto its nodes"
    assert path(gis.item("edges", "gate_barn")) == [[0, 0], [12, 0]], "edges follow their nodes"
    api("DELETE", f"{gis.at}/collections/edges/items/barn_field", 204)
    assert api.get(f"environments/{gis.env}").json()["version"] == 3
    (draft,) = gis.drafts()
    assert draft["changes"]["topology"] == {"added": 2, "changed": 3, "deleted": 1}
    version = api.post(f"environments/{gis.env}/drafts/{draft['id']}/commit", {"message": "QGIS"}).json()
    assert version["changes"]["topology"] == draft["changes"]["topology"]
    assert gis.drafts() == []
    assert gis.item("nodes", "shed")["geometry"]["coordinates"] == pytest.approx([20, 5])


def test_methods_are_told_as_programs_ask_for_them(api: Api, gis: Gis) -> None:
    assert "POST" in api("OPTIONS", f"{gis.at}/collections/edges/items", 204).headers["allow"]
    methods = api("OPTIONS", f"{gis.at}/collections/edges/items/unknown_id", 204).headers["allow"]
    assert {"PUT", "PATCH", "DELETE"} <= set(methods.split(", "))
    classes = api.get(f"{gis.at}/conformance").json()["conformsTo"]
    assert any("features-4" in one and one.endswith("/create-replace-delete") for one in classes)
    assert any(one.endswith("ogcapi-features-4/1.0/conf/optimistic-locking-etags") for one in classes)
    assert "additionalProperties" not in api.get(f"{gis.at}/collections/nodes/schema").json(), "a POST adds them"
    described = api.get(f"{gis.at}/api").json()["paths"]
    assert set(described["/collections/edges/items"]) == {"get", "post"}
    assert set(described["/collections/edges/items/{featureId}"]) == {"get", "put", "patch", "delete"}
    for fixed in (f"/ogc/{gis.env}", f"/ogc/{gis.env}/versions/3"):
        assert "POST" not in api("OPTIONS", f"{fixed}/collections/edges/items", 204).headers["allow"]
        assert not any("features-4" in one for one in api.get(f"{fixed}/conformance").json()["conformsTo"])
        for method, rest in (("POST", ""), ("PUT", "/barn"), ("PATCH", "/barn"), ("DELETE", "/barn")):
            refused = api(method, f"{fixed}/collections/nodes/items{rest}", 405, json={})
            assert "drafts/mine" in refused.json()["detail"]
            assert "GET" in refused.headers["allow"]
    assert gis.drafts() == []


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"geometry": line((0, 0), (13, 0))}, "the end of the edge is at no node"),
        ({"geometry": line((0, 0), (10, 8)), "properties": {"target": "gate"}}, "m from its node 'gate'"),
        ({"properties": {"target": "nowhere"}}, "'nowhere' is not a node"),
        ({"geometry": point(0, 0)}, "LineString"),
        ({"geometry": {"type": "LineString", "coordinates": [[0, 0]]}}, "geometry"),
        ({"geometry": None}, "LineString"),
        ({"properties": {"level": "roof"}}, "keeps its level"),
        ({}, "nothing to change"),
        ({"crs": "x", "properties": {}}, "unknown member 'crs'"),
    ],
)
def test_edge_that_would_leave_its_nodes_is_refused(gis: Gis, change: Json, words: str) -> None:
    assert words in gis.patch("edges", "gate_barn", 400, **change).json()["detail"]
    assert gis.drafts() == [], "what is refused leaves no draft"


def test_moved_end_takes_the_node_at_that_place(gis: Gis) -> None:
    gis.patch("edges", "gate_barn", geometry=line((0, 0), (5, 5), (9.9, 8.1)))
    edge = gis.item("edges", "gate_barn")
    assert edge["properties"]["target"] == "field"
    assert path(edge) == [[0, 0], [5, 5], [10, 8]]
    gis.patch("edges", "gate_barn", properties={"target": "barn"})
    assert path(gis.item("edges", "gate_barn")) == [[0, 0], [5, 5], [10, 0]]


def test_edge_away_from_its_nodes_stays_there_unless_it_is_moved(gis: Gis) -> None:
    """Ends of edges of other sources may be metres from their nodes."""
    features = [gis.item("nodes", name, local=False) for name in ("gate", "barn")]
    (west, south), (east, north) = (one["geometry"]["coordinates"] for one in features)
    edge = line((west, south + 2e-5), (east, north + 2e-5))
    properties = {"kind": "edge", "source": "gate", "target": "barn"}
    features.append({"type": "Feature", "id": "far", "geometry": edge, "properties": properties})
    network = json.dumps({"type": "FeatureCollection", "features": features}).encode()
    gis.api.upload(gis.env, {"n.geojson": network}, layer="topology")
    start, end = gis.item("edges", "far")["geometry"]["coordinates"]
    assert start[1] > 2, "more than edges are drawn to their nodes from"
    gis.patch("edges", "far", properties={"colour": "red"})
    assert path(gis.item("edges", "far")) == [start, end], "only properties were changed"
    gis.patch("edges", "far", geometry=line(start, (5, 3), end), properties={"source": None})
    shown = gis.item("edges", "far")
    assert path(shown) == [start, [5, 3], end], "only a bend was added"
    assert (shown["properties"]["source"], shown["properties"]["colour"]) == ("gate", "red")
    body = {"type": "Feature", "geometry": shown["geometry"], "properties": {}}
    at = f"{gis.at}/collections/edges/items/far"
    gis.api("PUT", at, 204, json=body, headers={**GEOJSON, **gis.local})
    assert path(gis.item("edges", "far")) == [start, [5, 3], end]


def test_deleted_node_with_edges_is_refused(api: Api, gis: Gis) -> None:
    refused = api("DELETE", f"{gis.at}/collections/nodes/items/barn", 400).json()
    assert "delete the edge" in refused["detail"]
    gis.patch("nodes", "barn", 400, headers={"content-crs": "<urn:x>"}, properties={"a": 1})
    gis.patch("nodes", "nowhere", 404, properties={"a": 1})
    assert gis.drafts() == []


def test_coordinates_in_other_systems(api: Api, gis: Gis) -> None:
    """A node is where it was after a round trip in each system."""
    at = f"{gis.at}/collections/nodes/items/field"
    for crs in api.get(f"{gis.at}/collections/nodes").json()["crs"]:
        shown = api.get(f"{at}?crs={crs}").json()["geometry"]
        far = {
            **shown,
            "coordinates": [v + (1e-4 if abs(v) < 180 and "local" not in crs else 5) for v in shown["coordinates"]],
        }
        headers = {**MERGE, "content-crs": f"<{crs}>"}
        api("PATCH", at, 204, json={"geometry": far}, headers=headers)
        api("PATCH", at, 204, json={"geometry": shown}, headers=headers)
        assert gis.item("nodes", "field")["geometry"]["coordinates"] == pytest.approx([10, 8], abs=1e-6), crs
    refused = api("PATCH", at, 400, json={"geometry": point(0, 0)}, headers={**MERGE, "content-crs": "<urn:x>"})
    assert "Content-Crs" in refused.json()["detail"]


def test_put_replaces_and_patch_merges(gis: Gis) -> None:
    at = f"{gis.at}/collections/nodes/items/barn"
    gis.patch("nodes", "barn", properties={"colour": "red", "doors": 2})
    gis.patch("nodes", "barn", properties={"colour": None, "doors": 2.0})
    properties = gis.item("nodes", "barn")["properties"]
    assert properties["doors"] == 2
    assert "colour" not in properties
    body = {"type": "Feature", "geometry": point(10, 1), "properties": {"name": "old barn", "note": None}}
    gis.api("PUT", at, 204, json=body, headers={**GEOJSON, **gis.local})
    item = gis.item("nodes", "barn")
    assert item["properties"]["name"] == "old barn"
    assert {"doors", "note"} & set(item["properties"]) == set()
    assert item["geometry"]["coordinates"] == pytest.approx([10, 1])
    gis.api("PUT", f"{at}x", 404, json=body, headers={**GEOJSON, **gis.local})


@pytest.mark.parametrize("is_listed_before", [False, True])
def test_what_was_read_can_be_put_back(gis: Gis, *, is_listed_before: bool) -> None:
    """A feature has properties of its own called level and part, which are shown as stored_level and stored_part."""
    properties = {"kind": "tree", "level": 2, "part": "north", "colour": "green"}
    tree = {"type": "Feature", "id": "oak", "properties": properties, "geometry": point(-0.5245, 53.2686)}
    data = json.dumps({"type": "FeatureCollection", "features": [tree]}).encode()
    gis.api.upload(gis.env, {"o.geojson": data}, layer="objects")
    at = f"{gis.at}/collections/objects-points/items/oak"
    if is_listed_before:  # types are then those of the cached table
        gis.api.get(f"{gis.at}/collections/objects-points/items")
    shown = gis.item("objects-points", "oak")
    assert (shown["properties"]["stored_level"], shown["properties"]["stored_part"]) == (2, "north")
    body = {name: shown[name] for name in ("type", "id", "geometry", "properties")}
    gis.api("PUT", at, 204, json=body, headers={**GEOJSON, **gis.local})
    assert gis.item("objects-points", "oak")["properties"] == shown["properties"]
    gis.patch("objects-points", "oak", properties={"stored_level": 3.0, "stored_part": None})
    after = gis.item("objects-points", "oak")["properties"]
    assert repr(after["stored_level"]) == "3"
    assert "stored_part" not in after
    gis.patch("nodes", "barn", properties={"stored_level": 7})
    assert gis.item("nodes", "barn")["properties"]["stored_level"] == 7


def test_types_are_those_of_the_schema(gis: Gis) -> None:
    wrong = gis.patch("nodes", "barn", 400, properties={"name": 5}).json()
    assert "must be string, as the schema of nodes says" in wrong["detail"]


@pytest.mark.parametrize(
    ("crs", "body", "words"),
    [
        (CRS84, {"type": "Feature", "geometry": point(365, 53.2686)}, "longitude first"),
        (CRS84, {"type": "Feature", "geometry": point(-0.5245, 95)}, "±90°"),
        (EPSG4326, {"type": "Feature", "geometry": point(-120.5, 53.2686)}, "latitude first"),
        (CRS84, {"type": "Feature", "geometry": {"type": "Point", "coordinates": ["-0.5", "53.2"]}}, "numbers"),
        (CRS84, {"type": "Feature", "geometry": {"type": "Point", "coordinates": [True, 53.2]}}, "numbers"),
        (CRS84, {"type": "FeatureCollection", "features": []}, "one GeoJSON Feature"),
        (CRS84, {"geometry": point(-0.5245, 53.2686)}, "one GeoJSON Feature"),
    ],
)
def test_what_no_upload_may_have_is_refused(gis: Gis, crs: str, body: Json, words: str) -> None:
    at = f"{gis.at}/collections/nodes/items"
    headers = {**GEOJSON, "content-crs": f"<{crs}>"}
    for method, path in (("POST", at), ("PUT", f"{at}/barn")):
        assert words in gis.api(method, path, 400, json=body, headers=headers).json()["detail"]
    assert gis.drafts() == [], "what is refused leaves no draft"


def test_fractions_are_numbers_where_all_were_whole(gis: Gis) -> None:
    ring = [[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0], [0.0, 0.0]]
    zone = {"type": "Polygon", "coordinates": [ring]}
    gis.add("zones", zone, id="slow", kind="speed", value=1, rank=1)
    listed = gis.api.get(f"{gis.at}/collections/zones/schema").json()["properties"]
    assert (listed["value"]["type"], listed["rank"]["type"]) == ("number", "integer")
    (draft,) = gis.drafts()
    gis.api.post(f"environments/{gis.env}/drafts/{draft['id']}/commit", {"message": "a speed zone"})
    gis.patch("zones", "slow", properties={"value": 0.5, "rank": 2.0})
    properties = gis.item("zones", "slow")["properties"]
    assert (properties["value"], repr(properties["rank"])) == (0.5, "2")
    gis.patch("zones", "slow", 400, properties={"value": "0.5"})


def test_if_match_names_the_feature(gis: Gis) -> None:
    at = f"{gis.at}/collections/nodes/items/barn"
    tag = gis.api.get(at).headers["etag"]
    changed = gis.patch("nodes", "barn", headers={"if-match": tag, "accept": "text/html"}, properties={"a": 1})
    refused = gis.patch("nodes", "barn", 412, headers={"if-match": tag}, properties={"a": 2})
    assert "read it again" in refused.json()["detail"]
    assert gis.item("nodes", "barn")["properties"]["a"] == 1
    plain = {"accept-encoding": "identity"}  # compression makes tags weak
    assert changed.headers["etag"] == gis.api.get(at, headers=plain).headers["etag"]
    body = {"type": "Feature", "geometry": point(10, 1), "properties": {}}
    headers = {**GEOJSON, **gis.local, "if-match": changed.headers["etag"]}
    replaced = gis.api("PUT", at, 204, json=body, headers=headers)
    assert replaced.headers["etag"] == gis.api.get(at, headers=plain).headers["etag"] != changed.headers["etag"]


@pytest.mark.parametrize(("collection", "item"), [("nodes", "barn"), ("edges", "barn_field")])
def test_feature_is_the_same_read_alone_or_from_the_table(gis: Gis, collection: str, item: str) -> None:
    gis.patch(collection, item, properties={"colour": "red"})
    at = f"{gis.at}/collections/{collection}/items"
    queries = ("", "?f=jsonfg", f"?crs={gis.api.url}{gis.at}/crs/local", "?f=html")
    alone = [gis.api.get(f"{at}/{item}{query}") for query in queries]
    assert gis.api.get(f"{at}/none-such", 404).json()["detail"].startswith(f"{collection} has no feature")
    assert len(gis.api.get(at).json()["features"]) > 1, "now the table is cached"
    for before, query in zip(alone, queries, strict=True):
        now = gis.api.get(f"{at}/{item}{query}")
        assert (now.headers["etag"], now.content) == (before.headers["etag"], before.content), query


def test_qualified_ids_are_those_of_their_part_whatever_its_name(gis: Gis) -> None:
    tree = {"type": "Feature", "id": "n1", "properties": {"kind": "tree"}, "geometry": point(-0.5245, 53.2686)}
    data = json.dumps({"type": "FeatureCollection", "features": [tree]}).encode()
    for level in ("A", "B", "Floor #2", "c@d"):
        gis.api.upload(gis.env, {"o.geojson": data}, layer="objects", level=level)
    at = f"{gis.at}/collections/objects-points/items"
    shown = gis.api.get(at).json()["features"]
    assert [one["properties"]["level"] for one in shown] == ["A", "B", "Floor #2", "c@d"]
    for one in shown:
        item = quote(one["id"], safe="")
        gis.patch("objects-points", item, properties={"note": one["properties"]["level"]})
        assert gis.item("objects-points", item)["properties"]["note"] == one["properties"]["level"]
    qualified = quote(f"n1@B/{shown[1]['properties']['part']}", safe="")
    gis.api("DELETE", f"{at}/n1", 204)
    assert gis.item("objects-points", qualified)["properties"]["level"] == "B", "also if no other has its id"
    gis.api("DELETE", f"{at}/{qualified}", 204)
    gis.api("DELETE", f"{at}/{qualified}", 404)
    gis.api.get(f"{at}/{qualified}", 404)
    assert [one["properties"]["level"] for one in gis.api.get(at).json()["features"]] == ["Floor #2", "c@d"]


def test_qualified_id_is_written_and_read_without_the_table(gis: Gis, monkeypatch: pytest.MonkeyPatch) -> None:
    tree = {"type": "Feature", "id": "n1", "properties": {"kind": "tree"}, "geometry": point(-0.5245, 53.2686)}
    shelf = {**tree, "id": "n2", "geometry": line((-0.5245, 53.2686), (-0.5246, 53.2686))}
    literal = {**tree, "id": "n1@B/literal"}
    for level, features in {"A": [tree, shelf], "B": [tree, {**tree, "id": "n2"}], "C": [tree, literal]}.items():
        data = json.dumps({"type": "FeatureCollection", "features": features}).encode()
        gis.api.upload(gis.env, {"o.geojson": data}, layer="objects", level=level)
    at = f"{gis.at}/collections/objects-points/items"
    part = gis.api.get(at).json()["features"][0]["properties"]["part"]
    built: list[str] = []

    def record(content: Any, version: Any, layer: Any) -> Any:
        built.append(layer)
        return tables.build_tables(content, version, layer)

    monkeypatch.setattr(vector, "build_tables", record)
    monkeypatch.setattr(vector, "CACHE", tables.TableCache())
    shown = {f"n1@A/{part}": "n1", f"n1@B/{part}": None, f"n2@B/{part}": "n2", f"n1@C/{part}": None}
    shown["n1@B/literal"] = None
    items = {feature: f"{at}/{quote(feature, safe='')}" for feature in shown}
    for k, feature in enumerate(items):
        gis.patch("objects-points", quote(feature, safe=""), properties={"rank": k})
    alone = {feature: gis.api.get(url) for feature, url in items.items()}
    assert built == []
    gis.api.get(at)
    assert built == ["objects"], "now the table is cached"
    for feature, url in items.items():
        now = gis.api.get(url)
        assert now.json()["id"] == (shown[feature] or feature)
        assert (alone[feature].headers["etag"], alone[feature].content) == (now.headers["etag"], now.content)


def test_drafts_of_others_are_read_and_not_written(api: Api, farm: str) -> None:
    ann, bob, viewer = api.token_for("editor"), api.token_for("editor"), api.token_for("viewer")
    Gis(ann, farm).patch("nodes", "barn", properties={"colour": "red"})
    (draft,) = Gis(ann, farm).drafts()
    theirs = Gis(bob, farm, draft["id"])
    assert theirs.item("nodes", "barn")["properties"]["colour"] == "red"
    assert "belongs to" in theirs.patch("nodes", "barn", 403, properties={"colour": "blue"}).json()["detail"]
    assert "colour" not in Gis(bob, farm).item("nodes", "barn")["properties"], "each has an own one"
    viewer.get(f"/ogc/{farm}/drafts/mine/collections", 403)
    api.get(f"/ogc/{farm}/drafts/{'0' * 16}/", 404)


def test_given_ids_are_kept_once(gis: Gis) -> None:
    location = gis.add("nodes", point(1, 1), id="a/b c").headers["location"]
    assert location.endswith("/items/a%2Fb%20c")
    assert gis.api.get(location.removeprefix(gis.api.url)).json()["id"] == "a/b c"
    assert "already" in gis.add("nodes", point(2, 2), 409, id="a/b c").json()["detail"]
    made = {gis.add("nodes", point(k, 3), name="barn").headers["location"] for k in range(2)}
    assert len(made) == 2, "a name that is taken is no id"


@pytest.mark.parametrize("in_degrees", [False, True])
def test_feature_far_from_the_datum_can_be_moved_back(gis: Gis, *, in_degrees: bool) -> None:
    tree = {"type": "Feature", "id": "oak", "properties": {"kind": "tree"}, "geometry": point(-170.0, -50.0)}
    data = json.dumps({"type": "FeatureCollection", "features": [tree]}).encode()
    gis.api.upload(gis.env, {"o.geojson": data}, layer="objects")
    headers = {"content-crs": f"<{CRS84}>"} if in_degrees else {}
    near = (-0.5245, 53.2686) if in_degrees else (3.0, 4.0)
    gis.patch("objects-points", "oak", headers=headers, geometry=point(*near))
    shown = gis.item("objects-points", "oak", local=not in_degrees)["geometry"]["coordinates"]
    assert shown == pytest.approx(near, abs=1e-6)


def test_edge_far_from_the_datum_can_be_moved_back(gis: Gis) -> None:
    features = [gis.item("nodes", name, local=False) for name in ("gate", "barn")]
    edge = {"type": "Feature", "id": "far", "properties": {"kind": "edge", "source": "gate", "target": "barn"}}
    features.append({**edge, "geometry": line((-170.0, -50.0), (-170.1, -50.0))})
    network = json.dumps({"type": "FeatureCollection", "features": features}).encode()
    gis.api.upload(gis.env, {"n.geojson": network}, layer="topology")
    gis.patch("edges", "far", geometry=line((0, 0), (5, 3), (10, 0)))
    assert path(gis.item("edges", "far")) == [[0, 0], [5, 3], [10, 0]]


CRATE = b"""<?xml version="1.0"?><sdf version="1.7"><world name="w"><model name="crate"><static>true</static>
<pose>2 3 0.5 0 0 0</pose><link name="l"><collision name="c"><geometry><box><size>1 1 1</size></box></geometry>
</collision></link></model></world></sdf>"""


@pytest.mark.parametrize("in_degrees", [False, True])
def test_object_that_is_moved_by_its_outline_is_moved_in_every_format(gis: Gis, *, in_degrees: bool) -> None:
    gis.api.upload(gis.env, {"w.sdf": CRATE})
    shown = gis.item("objects-polygons", "crate", local=not in_degrees)["geometry"]
    step = 1e-4 if in_degrees else 6.0
    ring = [[x + step, y] for x, y, *_ in reversed(shown["coordinates"][0])]
    headers = {"content-crs": f"<{CRS84}>"} if in_degrees else {}
    gis.patch("objects-polygons", "crate", headers=headers, geometry={"type": "Polygon", "coordinates": [ring]})
    after = gis.item("objects-polygons", "crate")
    west, east = (pick(x for x, *_ in after["geometry"]["coordinates"][0]) for pick in (min, max))
    assert west > 5, "the outline was moved"
    (draft,) = gis.drafts()
    gis.api.post(f"environments/{gis.env}/drafts/{draft['id']}/commit", {"message": "moved"})
    pose = gis.api.get(f"/maps/{gis.env}/gazebo").text.split("<pose>")[1].split("<")[0]
    assert [float(word) for word in pose.split()] == pytest.approx([(west + east) / 2, 3, 0.5, 0, 0, 0], abs=1e-3)


def test_solids_are_not_left_behind_by_another_outline(gis: Gis) -> None:
    gis.api.upload(gis.env, {"w.sdf": CRATE})
    shown = gis.item("objects-polygons", "crate")
    ring = [[x * 2, y] for x, y, *_ in shown["geometry"]["coordinates"][0]]
    wider = {"type": "Polygon", "coordinates": [ring]}
    assert "change its 'pose'" in gis.patch("objects-polygons", "crate", 400, geometry=wider).json()["detail"]
    gis.patch("objects-polygons", "crate", geometry=wider, properties={"pose": [3, 3, 0.5, 0, 0, 0]})
    assert gis.item("objects-polygons", "crate")["properties"]["pose"][0] == 3
