"""OGC API: sign-in, addresses, refused parameters, properties, representations, sites without a datum."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pyproj
import pytest
import shapely

from app.convert.recently_used import RecentlyUsed
from app.ogc.extensions import extensions
from app.ogc.property_types import read_types
from app.ogc.tables import VECTOR_LAYERS, TableCache, build_tables, table_key
from tests.api import samples
from tests.api.conftest import ADMIN, Api, problem, running, settings_for
from tests.api.ogc_sites import SHAPES, TURNED_DATUM, create_turned, local_geojson

ITEMS = "/ogc/turned/collections/{}/items"


@pytest.fixture(scope="module")
def turned(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Api]:
    with running(settings_for(tmp_path_factory.mktemp("turned"), token_failures=10_000)) as api:
        create_turned(api, "turned")
        api.post("environments", {"name": "nowhere"})
        api.upload("nowhere", {"network.tmap2.yaml": samples.tmap2()})
        yield api


def basic(password: str, user: str = "any") -> dict[str, str]:
    return {"Authorization": "Basic " + base64.b64encode(f"{user}:{password}".encode()).decode()}


# --- sign-in ---


def test_basic_takes_a_token_as_password_below_ogc_only(turned: Api) -> None:
    anonymous = turned.as_(None)
    for user in ("", "any", "ädmin"):
        anonymous.get("/ogc/turned/", headers=basic(ADMIN, user))
    anonymous.get("environments", 401, headers=basic(ADMIN))  # also right after a success, which is cached
    anonymous.get("/maps/turned/geojson", 401, headers=basic(ADMIN))
    for header in (basic("wrong"), {"Authorization": "Basic !!"}, {"Authorization": "Basic"}, basic("")):
        anonymous.get("/ogc/turned/", 401, headers=header)


def test_missing_token_is_answered_with_a_basic_challenge(turned: Api) -> None:
    anonymous = turned.as_(None)
    for path in ("/ogc/turned/", "/ogc/absent/", "/ogc/turned/collections/nodes/items"):
        answer = anonymous.get(path, 401)
        assert answer.headers["www-authenticate"] == 'Basic realm="Fleet Map Server"'
        problem(answer)
    assert anonymous.get("environments", 401).headers["www-authenticate"].startswith("Bearer")


def test_basic_change_from_another_site_is_refused(turned: Api) -> None:
    anonymous = turned.as_(None)
    other = {**basic(ADMIN), "Origin": "https://evil.example"}
    assert anonymous("POST", "/ogc/turned/", 403, headers=other).json()["detail"].startswith("the request comes from")
    anonymous("POST", "/ogc/turned/", 405, headers=basic(ADMIN))


def test_token_of_other_environments_is_refused(turned: Api) -> None:
    limited = turned.token_for("viewer", environments="street*")
    limited.get("/ogc/turned/", 403)
    turned.token_for("viewer", environments="turned").get(ITEMS.format("nodes"))


# --- addresses and versions ---


def test_links_use_the_public_url(tmp_path: Path) -> None:
    with running(settings_for(tmp_path, public_url="https://maps.example.org/fleet/")) as api:
        api.post("environments", {"name": "farm", "datum": TURNED_DATUM})
        landing = api.get("/ogc/farm/", headers={"X-Forwarded-Host": "evil.example", "Host": "evil.example"}).json()
        assert all(one["href"].startswith("https://maps.example.org/fleet/ogc/farm/") for one in landing["links"])


def test_texts_that_xml_cannot_have_are_refused(turned: Api, fresh: Callable[[], str]) -> None:
    name = fresh()
    for member in ("title", "description"):
        detail = turned.problem("POST", "environments", 422, json={"name": name, member: "Farm\u0001"})["detail"]
        assert f"a {member} must have no control characters" in detail
        turned.problem("PATCH", "environments/turned", 422, json={member: "Farm\u000b"})
    turned.post("environments", {"name": name, "description": "two\n\tlines"})


def test_unusable_host_is_not_linked(turned: Api) -> None:
    landing = turned.get("/ogc/turned/", headers={"Host": 'x"><script>'}).text
    assert "<script" not in landing
    assert turned.url in landing


def test_short_address_is_production_else_latest(turned: Api, fresh: Callable[[], str]) -> None:
    name = fresh()
    api = turned
    api.post("environments", {"name": name, "datum": TURNED_DATUM})
    first = api.upload(name, {"network.tmap2.yaml": samples.tmap2()}).json()["version"]
    api("PUT", f"environments/{name}/channels/production", 200, json={"version": first})
    api.upload(name, {"network.tmap2.yaml": samples.tmap2({"a": (0.0, 0.0), "b": (5.0, 0.0)}, (("a", "b"),))})

    def count(start: str) -> tuple[str, int]:
        answer = api.get(f"/ogc/{name}{start}/collections/nodes/items")
        return answer.headers["fleetmap-version"], answer.json()["numberMatched"]

    assert count("") == count("/versions/production") == count(f"/versions/{first}") == (str(first), 3)
    assert count("/versions/latest") == (str(first + 1), 2)
    problem(api.get(f"/ogc/{name}/versions/99/collections", 404))
    numbered = api.get(f"/ogc/{name}/versions/{first}/collections")
    assert "immutable" in numbered.headers["cache-control"]
    assert "no-cache" in api.get(f"/ogc/{name}/collections").headers["cache-control"]
    repeat = {"If-None-Match": numbered.headers["etag"]}
    api.get(f"/ogc/{name}/versions/{first}/collections", 304, headers=repeat)
    page = f"/ogc/{name}/versions/{first}/collections/nodes/items"
    api.get(page, 304, headers={"If-None-Match": api.get(page).headers["etag"]})
    assert f"/versions/{first}/" in json.dumps(numbered.json()["collections"][0]["links"])


def test_site_without_datum_has_no_collections_and_states_why(turned: Api) -> None:
    body = turned.get("/ogc/nowhere/collections").json()
    assert body["collections"] == []
    assert "upload a datum.yaml" in body["notice"]
    assert "upload a datum.yaml" in turned.get("/ogc/nowhere/collections", params={"f": "html"}).text
    for path in ("collections/nodes", "collections/nodes/items", "collections/nodes/items/gate", "crs/local",
                 "collections/nodes/schema"):  # fmt: skip
        assert "datum" in problem(turned.get(f"/ogc/nowhere/{path}", 404))["detail"]
    assert list(turned.get("/ogc/nowhere/api").json()["paths"]) == ["/", "/conformance", "/api", "/collections"]


def test_only_collections_with_content_exist(turned: Api) -> None:
    ids = [one["id"] for one in turned.get("/ogc/turned/collections").json()["collections"]]
    assert ids == ["grid-map", "nodes", "edges", "objects-points", "objects-lines", "objects-polygons", "zones"]
    wrong = problem(turned.get("/ogc/turned/collections/node/items", 404))["detail"]
    assert "did you mean nodes?" in wrong
    problem(turned.get("/ogc/turned/collections/fence", 404))


# --- grids ---


def test_grid_is_an_outline_with_the_addresses_of_its_content(turned: Api) -> None:
    (feature,) = turned.get(ITEMS.format("grid-map"), params={"level": "ground", "f": "jsonfg"}).json()["features"]
    ring = np.array(feature["place"]["coordinates"][0])
    across, up = 20.0 * np.array([np.cos(0.4), np.sin(0.4)]), 15.0 * np.array([-np.sin(0.4), np.cos(0.4)])
    first = np.array([-1.0, -2.0])  # 40 by 30 cells of 0.5 m, turned by 0.4 around this corner
    assert np.allclose(ring[[0, 9, 18, 27, 36]], [first, first + across, first + across + up, first + up, first])
    properties = feature["properties"]
    assert {k: properties[k] for k in ("kind", "name", "level", "resolution", "width", "height")} == {
        "kind": "grid", "name": "map", "level": "ground", "resolution": 0.5, "width": 40, "height": 30,
    }  # fmt: skip
    assert turned.get(properties["map"].removeprefix(turned.url)).content.startswith(b"\x89PNG")
    redirect = turned.get(properties["geotiff"].removeprefix(turned.url), 307)
    anonymous = httpx.get(redirect.headers["location"])
    assert anonymous.content.startswith(b"II")
    with_password = httpx.get(properties["geotiff"], auth=("any", ADMIN), follow_redirects=True)
    assert with_password.content == anonymous.content, "GDAL repeats the password at the link"
    missing = problem(turned.get("/ogc/turned/collections/nodes/geotiff", 404))
    assert "only collections of grids and images" in missing["detail"]
    assert turned.get(ITEMS.format("grid-map"), params={"level": "attic"}).json()["features"] == []
    schema = turned.get("/ogc/turned/collections/grid-map/schema").json()["properties"]
    assert schema["geometry"]["format"] == "geometry-polygon"
    assert set(schema) == {"id", "geometry", *properties}


def test_grids_of_drafts_are_not_written(turned: Api) -> None:
    at = "/ogc/turned/drafts/mine/collections/grid-map/items"
    assert turned("OPTIONS", f"{at}/map", 204).headers["allow"] == "GET, HEAD, OPTIONS"
    feature = {"type": "Feature", "geometry": None, "properties": {}}
    for method, path in (("POST", at), ("PUT", f"{at}/map"), ("PATCH", f"{at}/map"), ("DELETE", f"{at}/map")):
        refused = turned(method, path, 405, json=None if method == "DELETE" else feature)
        assert "upload a grid" in problem(refused)["detail"]
    assert turned.get("environments/turned/drafts").json() == []


def test_edited_draft_has_no_geotiff(turned: Api) -> None:
    at = "/ogc/turned/drafts/mine/collections"
    assert turned.get(f"{at}/grid-map/geotiff", 307), "nothing is edited: that of the version"
    node = turned.get(f"{at}/nodes/items?limit=1").json()["features"][0]
    turned("PATCH", f"{at}/nodes/items/{node['id']}", 204, json={"properties": {"note": "edited"}})
    (grid,) = turned.get(f"{at}/grid-map/items").json()["features"]
    assert "geotiff" not in grid["properties"]
    assert "before it is committed" in problem(turned.get(f"{at}/grid-map/geotiff", 404))["detail"]
    (draft,) = turned.get("environments/turned/drafts").json()
    turned("DELETE", f"environments/turned/drafts/{draft['id']}", 204)


# --- positions ---


@pytest.mark.parametrize("name", sorted(SHAPES))
def test_turned_site_lies_where_its_heading_says(turned: Api, name: str) -> None:
    """Work the position out by hand: distance and azimuth on the ellipsoid, by PROJ's geodesic."""
    family = {"Point": "points", "LineString": "lines", "Polygon": "polygons"}[
        SHAPES[name]["type"].removeprefix("Multi")
    ]
    feature = turned.get(ITEMS.format(f"objects-{family}") + f"/{name}").json()
    local = np.array(SHAPES[name]["coordinates"]).reshape(-1, 2)
    degrees = np.array(feature["geometry"]["coordinates"]).reshape(-1, 2)
    geod = pyproj.Geod(ellps="WGS84")
    for (x, y), (longitude, latitude) in zip(local, degrees, strict=True):
        azimuth = TURNED_DATUM["heading"] + math.degrees(math.atan2(x, y))
        expected = geod.fwd(TURNED_DATUM["longitude"], TURNED_DATUM["latitude"], azimuth, math.hypot(x, y))
        assert geod.inv(longitude, latitude, expected[0], expected[1])[2] < 1e-3
    fg = turned.get(ITEMS.format(f"objects-{family}") + f"/{name}", params={"f": "jsonfg"})
    assert fg.json()["place"] == SHAPES[name]
    assert fg.json()["geometry"] == feature["geometry"]
    assert fg.headers["content-type"] == "application/vnd.ogc.fg+json"
    assert fg.json()["coordRefSys"] == f"{turned.url}/ogc/turned/crs/local"


def test_latitude_comes_first_in_epsg_4326(turned: Api) -> None:
    uri = "http://www.opengis.net/def/crs/EPSG/0/4326"
    plain = turned.get(ITEMS.format("nodes") + "/barn").json()["geometry"]["coordinates"]
    swapped = turned.get(ITEMS.format("nodes") + "/barn", params={"crs": uri}).json()["geometry"]["coordinates"]
    assert swapped[:2] == [plain[1], plain[0]]
    x, y = plain[:2]
    box = f"{y - 1e-7},{x - 1e-7},{y + 1e-7},{x + 1e-7}"
    found = turned.get(ITEMS.format("nodes"), params={"bbox": box, "bbox-crs": uri}).json()
    assert [f["id"] for f in found["features"]] == ["barn"]


def test_local_frame_is_defined_in_wkt_and_projjson(turned: Api) -> None:
    wkt = turned.get("/ogc/turned/crs/local")
    assert wkt.headers["content-type"] == "text/plain; charset=utf-8"
    assert wkt.text.startswith("DERIVEDPROJCRS[")
    projjson = turned.get("/ogc/turned/crs/local", headers={"accept": "application/json"})
    assert pyproj.CRS.from_json(projjson.text) == pyproj.CRS.from_wkt(wkt.text)
    transformer = pyproj.Transformer.from_crs(wkt.text, "OGC:CRS84", always_xy=True)
    longitude, latitude = transformer.transform(10.0, 8.0)
    place = turned.get(ITEMS.format("nodes") + "/field").json()["geometry"]["coordinates"]
    assert pyproj.Geod(ellps="WGS84").inv(longitude, latitude, place[0], place[1])[2] < 1e-6


# --- properties ---


def test_level_and_part_are_properties(turned: Api) -> None:
    properties = turned.get(ITEMS.format("objects-points") + "/well").json()["properties"]
    assert (properties["level"], properties["stored_level"]) == ("ground", "odd")
    assert properties["part"]


@pytest.mark.parametrize(
    ("collection", "query", "ids"),
    [
        ("nodes", {"name": "barn"}, ["barn"]),
        ("nodes", {"kind": "node", "name": "gate"}, ["gate"]),
        ("nodes", {"name": "absent"}, []),
        ("edges", {"source": "gate", "target": "barn"}, None),
        ("objects-points", {"rank": "1"}, ["trees"]),
        ("objects-points", {"rank": "1.0"}, ["trees"]),
        ("objects-points", {"level": "ground", "kind": "thing"}, ["trees", "well"]),
    ],
)
def test_properties_filter_by_equality(
    turned: Api, collection: str, query: dict[str, str], ids: list[str] | None
) -> None:
    page = turned.get(ITEMS.format(collection), params=query).json()
    assert page["numberMatched"] == len(page["features"])
    for feature in page["features"]:
        assert all(str(feature["properties"][name]) == str(json.loads(value) if name == "rank" else value)
                   or float(value) == feature["properties"][name] for name, value in query.items())  # fmt: skip
    if ids is None:
        assert page["numberMatched"] == 1
    else:
        assert [f["id"] for f in page["features"]] == ids


def test_schema_and_queryables_describe_the_features(turned: Api) -> None:
    for collection in ("nodes", "objects-points", "objects-polygons", "zones"):
        base = f"/ogc/turned/collections/{collection}"
        schema = turned.get(f"{base}/schema")
        assert schema.headers["content-type"] == "application/schema+json"
        listed = schema.json()["properties"]
        roles = {one["x-ogc-role"]: name for name, one in listed.items() if "x-ogc-role" in one}
        assert roles == {"id": "id", "primary-geometry": "geometry"}
        for feature in turned.get(f"{base}/items").json()["features"]:
            assert set(feature["properties"]) <= set(listed)
        queryables = turned.get(f"{base}/queryables").json()
        assert queryables["$id"] == f"{turned.url}{base}/queryables"
        for name in queryables["properties"].keys() - {"geometry"}:
            assert listed[name]["type"] in ("string", "number", "integer", "boolean")
    points = turned.get("/ogc/turned/collections/objects-points/schema").json()["properties"]
    assert points["geometry"]["format"] == "geometry-point-or-multipoint"
    assert points["rank"]["type"] == "integer"


# --- refused parameters ---

REFUSED = [
    ("bbox", "1,2,3"), ("bbox", "1,2,3,4,5"), ("bbox", "a,b,c,d"), ("bbox", "nan,0,1,1"), ("bbox", "0,0,inf,1"),
    ("bbox", "0,2,1,1"), ("bbox", "0,-91,1,1"), ("bbox", "0,0,181,1"), ("bbox", "0,0,5,1,1,1"), ("bbox", ""),
    ("bbox", "1_0,0,11,1"), ("bbox", "٣,0,4,1"), ("bbox", "0x1,0,2,1"), ("bbox", "0,0,1,1,"),
    ("bbox", "1" * 2000), ("bbox-crs", "EPSG:4326"), ("bbox-crs", "http://www.opengis.net/def/crs/OGC/1.3/CRS84"),
    ("crs", "EPSG:3857"), ("crs", ""), ("limit", "0"), ("limit", "-1"), ("limit", "1.5"), ("limit", "x"),
    ("limit", ""), ("limit", "٣"), ("datetime", "yesterday"), ("datetime", "2018-02-30T00:00:00Z"), ("datetime", ".."),
    ("datetime", "../.."), ("datetime", "2019-01-01T00:00:00Z/2018-01-01T00:00:00Z"), ("datetime", "2018-01-01/a/b"),
    ("cursor", "!"), ("cursor", "WzFd"), ("filter", "name='x'"), ("filter-lang", "cql2-text"), ("nam", "x"),
    ("f", "xml"), ("rank", "many"), ("rank", "1_0"), ("rank", "nan"), ("orientation", "1"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "value"), REFUSED)
def test_wrong_parameter_is_refused_by_name(turned: Api, name: str, value: str) -> None:
    collection = "objects-points" if name == "rank" else "nodes"
    answer = turned.get(ITEMS.format(collection), 400, params={name: value})
    assert [item["where"] for item in problem(answer)["errors"]] == [name]
    html = turned.get(ITEMS.format(collection), 400, params={name: value}, headers={"accept": "text/html"})
    assert html.headers["content-type"].startswith("application/problem" if name == "f" else "text/html")


def test_repeated_parameter_is_refused(turned: Api) -> None:
    problem(turned.get(ITEMS.format("nodes") + "?limit=1&limit=2", 400))


@pytest.mark.parametrize(
    "path",
    ["/", "/conformance", "/api", "/api.html", "/collections", "/collections/nodes", "/collections/nodes/schema",
     "/collections/nodes/queryables", "/collections/nodes/items/gate", "/crs/local"],
)  # fmt: skip
def test_unknown_parameter_is_refused_everywhere(turned: Api, path: str) -> None:
    assert problem(turned.get(f"/ogc/turned{path}?bogus=1", 400))["errors"][0]["where"] == "bogus"


def test_projected_box_must_be_in_order_and_on_earth(turned: Api) -> None:
    local = f"{turned.url}/ogc/turned/crs/local"
    for box, crs in (("5,0,1,1", local), ("0,0,1e300,1", local), ("0,5,1,1", local)):
        answer = turned.get(ITEMS.format("nodes"), 400, params={"bbox": box, "bbox-crs": crs})
        assert problem(answer)["errors"][0]["where"] == "bbox"


def test_box_across_the_antimeridian_is_accepted(turned: Api) -> None:
    assert turned.get(ITEMS.format("nodes"), params={"bbox": "170,-60,-170,60"}).json()["numberMatched"] == 0
    assert turned.get(ITEMS.format("nodes"), params={"bbox": "-1,50,-170,60"}).json()["numberMatched"] == 3


def test_heights_of_a_box_select(turned: Api) -> None:
    around = "-1,53,{},0,54,{}"
    everything = turned.get(ITEMS.format("objects-points"), params={"bbox": around.format(5, 9)}).json()
    assert everything["numberMatched"] == 2  # they have no heights
    nodes = {
        low: turned.get(ITEMS.format("nodes"), params={"bbox": around.format(low, low + 1)}).json() for low in (-0.5, 5)
    }
    has_heights = any(len(f["geometry"]["coordinates"]) == 3 for f in nodes[-0.5]["features"])
    assert nodes[-0.5]["numberMatched"] == 3
    assert nodes[5]["numberMatched"] == (0 if has_heights else 3)


# --- pages ---


def test_pages_escape_what_they_show_and_run_nothing(turned: Api) -> None:
    mark = "<script>alert(1)</script>"
    turned.post("environments", {"name": "marked", "title": mark, "description": mark, "datum": TURNED_DATUM})
    shapes = {mark: SHAPES["well"], "a/b?c#d%20é": SHAPES["trees"]}
    turned.upload("marked", {"t.geojson": local_geojson(shapes, mark)}, layer="objects", format="geojson")
    base = "/ogc/marked"
    items = f"{base}/collections/objects-points/items"
    listed = turned.get(items).json()["features"]
    assert {f["id"] for f in listed} == set(shapes)
    for path in (f"{base}/", f"{base}/collections", items, f"{base}/collections/objects-points/schema",
                 f"{base}/api.html", f"{base}/crs/local", f"{base}/conformance"):  # fmt: skip
        page = turned.get(path, headers={"accept": "text/html"} if path.endswith("html") else {}, **(
            {} if path.endswith("html") else {"params": {"f": "html"}}))  # fmt: skip
        assert "<script" not in page.text
        assert page.headers["content-security-policy"].startswith("default-src 'none'; style-src 'sha256-")
        assert "style=" not in page.text
    for path in (f"{base}/", f"{base}/collections/objects-points"):
        page = turned.get(path, params={"f": "html"})
        picture = page.text.partition('<img src="')[2].partition('"')[0].replace("&amp;", "&")
        assert "img-src 'self'" in page.headers["content-security-policy"]
        assert turned.http.get(picture).headers["content-type"] == "image/png"
    links = [part.partition('"')[0] for part in turned.get(items, params={"f": "html"}).text.split('href="')[1:]]
    targets = [one.replace("&amp;", "&") for one in links if "/items/" in one]
    assert len(targets) == 2
    for target in targets:
        assert "<svg" in turned.get(target.removeprefix(turned.url)).text
    for name in shapes:
        assert turned.http.get(next(t for t in targets if t)).status_code == 200, name


def test_accept_selects_the_representation(turned: Api) -> None:
    for accept, media in (
        ("application/geo+json, application/json", "application/geo+json"),
        ("application/json", "application/geo+json"),
        ("text/html,application/xhtml+xml,application/xml;q=0.9,*/*;q=0.8", "text/html; charset=utf-8"),
        ("application/vnd.ogc.fg+json", "application/vnd.ogc.fg+json"),
        ("*/*", "application/geo+json"),
        ("text/html;q=0.1, application/geo+json;q=0.2", "application/geo+json"),
    ):
        assert turned.get(ITEMS.format("nodes"), headers={"accept": accept}).headers["content-type"] == media, accept
    problem(turned.get(ITEMS.format("nodes"), 406, headers={"accept": "image/png"}))
    forced = turned.get(ITEMS.format("nodes"), params={"f": "json"}, headers={"accept": "text/html"})
    assert forced.headers["content-type"] == "application/geo+json"


# --- below HTTP ---


def test_modules_extend_the_service() -> None:
    classes = [uri for one in extensions() for uri in one.conformance]
    assert len(classes) == len(set(classes)) > 10


def test_equal_ids_of_two_parts_are_distinct(turned: Api) -> None:
    name = "storeys"
    turned.post("environments", {"name": name, "datum": TURNED_DATUM})
    for level in ("L1", "L2"):
        data = {"t.geojson": local_geojson({"door": SHAPES["well"]}, "door")}
        turned.upload(name, data, layer="objects", format="geojson", level=level)
    items = turned.get(f"/ogc/{name}/collections/objects-points/items").json()["features"]
    assert [f["properties"]["level"] for f in items] == ["L1", "L2"]
    assert len({f["id"] for f in items}) == 2
    for feature in items:
        found = turned.get(f"/ogc/{name}/collections/objects-points/items/{feature['id']}").json()
        assert found["properties"] == feature["properties"]


def test_types_of_properties_need_no_tables(turned: Api) -> None:
    store = turned.app.state.services.store
    version = store.versions.get("turned")
    layers = [layer for layer in VECTOR_LAYERS if table_key(version, layer) is not None]
    assert {"topology", "objects"} <= set(layers)
    for layer in layers:
        tables = build_tables(store.content, version, layer)
        shown = {
            name: {key: types for key, types in table.types.items() if key not in ("level", "part")}
            for name, table in tables.items()
        }
        assert read_types(store.content, version, layer) == shown


def test_table_cache_drops_the_least_recently_used(turned: Api) -> None:
    store = turned.app.state.services.store
    version = store.versions.get("turned")
    tables = build_tables(store.content, version, "topology")
    assert tables["nodes"].size > 0
    cache = TableCache(max_bytes=2 * sum(t.size for t in tables.values()))
    keys: list[Any] = [(version.datum, ((), str(number))) for number in range(3)]
    cache.put(keys[0], tables)
    cache.put(keys[1], tables)
    assert cache.get(keys[0]) is tables
    cache.put(keys[2], tables)
    assert [cache.get(key) is tables for key in keys] == [True, False, True]


# --- JSON-FG read back ---


def _stored(api: Api, env: str) -> dict[str, Any]:
    """Return the objects' geometries of a site in local metres, by id."""
    document = api.get(f"environments/{env}/versions/latest/layers/objects", params={"crs": "local"})
    return {one["id"]: one["place"] for one in document.json()["features"]}


def _largest_distance(a: dict[str, Any], b: dict[str, Any]) -> float:
    shapes = [[shapely.from_geojson(json.dumps(one)) for one in (left[name] for name in SHAPES)] for left in (a, b)]
    return max(float(shapely.hausdorff_distance(p, q)) for p, q in zip(*shapes, strict=True))


@pytest.mark.parametrize("crs", [None, "http://www.opengis.net/def/crs/EPSG/0/3857"])
@pytest.mark.parametrize("heading", [30.0, 0.0])
def test_json_fg_is_read_back_to_a_millimetre(turned: Api, crs: str | None, heading: float) -> None:
    original = _stored(turned, "turned")
    name = f"back-{int(heading)}-{'epsg' if crs else 'frame'}"
    turned.post("environments", {"name": name, "datum": {**TURNED_DATUM, "heading": heading}})
    features: list[Any] = []
    for collection in ("objects-points", "objects-lines", "objects-polygons"):
        params = {"f": "jsonfg", **({} if crs is None else {"crs": crs})}
        document = turned.get(ITEMS.format(collection), params=params).json()
        features += document["features"]
        assert ("datum" in document) == (crs is None)
    body = json.dumps({**document, "features": features}).encode()
    turned.upload(name, {"back.geojson": body}, format="geojson", layer="objects")
    back = turned.get(f"environments/{name}/versions/latest/layers/objects").json()["features"]
    assert {one["id"] for one in back} == set(SHAPES)
    if heading == TURNED_DATUM["heading"]:
        assert _largest_distance(original, _stored(turned, name)) < 1e-3
    else:  # metres of another frame are not metres here: positions on earth are the same
        assert _largest_distance(original, _stored(turned, name)) > 1.0
        earth = {one["id"]: one["geometry"] for one in features}
        assert _largest_distance(earth, {one["id"]: one["geometry"] for one in back}) < 1e-8


def test_json_fg_of_another_frame_needs_a_geometry(turned: Api) -> None:
    document = turned.get(ITEMS.format("objects-points"), params={"f": "jsonfg"}).json()
    turned.post("environments", {"name": "elsewhere", "datum": {"latitude": 10.0, "longitude": 20.0}})
    for feature in document["features"]:
        feature["geometry"] = None
    body = json.dumps(document).encode()
    answer = turned.upload("elsewhere", {"back.geojson": body}, None, format="geojson", layer="objects")
    assert answer.status_code in (400, 422)
    assert "CRS84" in answer.text
    turned.post("environments", {"name": "unplaced"})
    turned.upload("unplaced", {"back.geojson": body}, format="geojson", layer="objects")
    assert turned.get("environments/unplaced").json()["datum"] == document["datum"]


# --- boxes of content that was committed just now ---


def test_a_box_right_after_a_commit_does_not_build_the_table_of_all(
    turned: Api, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a box shows is the same, whether it is read from the store or from the table of all."""
    turned.post("environments", {"name": "fresh", "datum": TURNED_DATUM})
    turned.upload("fresh", {"network.tmap2.yaml": samples.tmap2()})
    at = "/ogc/fresh/collections/{}/items"
    x, y = turned.get(at.format("nodes") + "/gate").json()["geometry"]["coordinates"][:2]
    far = {"meadow": (40.0, 30.0), **samples.NODES}
    turned.upload("fresh", {"network.tmap2.yaml": samples.tmap2(far)})
    box = f"{x - 1e-6},{y - 1e-6},{x + 1e-6},{y + 1e-6}"
    swapped = f"{y - 1e-6},{x - 1e-6},{y + 1e-6},{x + 1e-6}"
    epsg = "http://www.opengis.net/def/crs/EPSG/0/4326"
    queries = [f"?bbox={box}", f"?limit=1&bbox={box}", f"?bbox={swapped}&bbox-crs={epsg}"]

    def answers(name: str) -> list[Any]:
        documents = [turned.get(at.format(name) + query).json() for query in queries]
        return [[one["features"], one["numberMatched"]] for one in documents]

    def refuse(*_: Any) -> None:
        pytest.fail("the table of all is built")

    with monkeypatch.context() as patched:
        patched.setattr("app.ogc.vector.build_tables", refuse)
        patched.setattr("app.ogc.vector._READ", RecentlyUsed(10, lambda _: 0))
        read = answers("nodes")
    turned.get(at.format("nodes"))
    assert answers("nodes") == read
    assert [number for _, number in read] == [1, 1, 1]
