"""Abstract tests of OGC API - Features, Part 1 (Core 1.0) and Part 2 (CRS), by number, on several sites.

Each function is named like its abstract test: ``test_a13`` is abstract test 13 of Part 1, ``test_crs_a4`` is test 4 of
Part 2. Tests of a page of features run for the plain request and with ``bbox``, ``limit`` and ``datetime``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from typing import Any
from urllib.parse import quote

import httpx
import numpy as np
import pyproj
import pytest
import shapely
from shapely.geometry import shape

from tests.api.conftest import Api
from tests.api.ogc_sites import ON_EARTH, Ogc, link

GEOJSON = "application/geo+json"
OPENAPI = "application/vnd.oai.openapi+json;version=3.0"
CRS84 = "http://www.opengis.net/def/crs/OGC/1.3/CRS84"
CONF = "http://www.opengis.net/spec/ogcapi-features"
KINDS = ("plain", "bbox", "limit", "datetime")
TIMES = (
    "2018-02-12T23:20:52Z",
    "2018-02-12T00:00:00Z/2018-03-18T12:31:12Z",
    "../2018-03-18T12:31:12+01:00",
    "2018-02-12T00:00:00Z/..",
    "/2018-03-18T12:31:12Z",
    "2018-02-12T00:00:00Z/",
)


@pytest.fixture(scope="module", params=ON_EARTH)
def ogc(ogc_sites: Api, request: pytest.FixtureRequest) -> Ogc:
    return Ogc(ogc_sites.http, f"{ogc_sites.url}/ogc/{request.param}/")


def extent_of(collection: dict[str, Any]) -> list[float]:
    """Return the extent of a collection, which only one without geometries lacks; the world then."""
    assert ("extent" in collection) == (collection["id"] != "objects-other"), collection
    box: list[float] = collection["extent"]["spatial"]["bbox"][0] if "extent" in collection else [-180, -90, 180, 90]
    return box


def middle_box(collection: dict[str, Any]) -> list[float]:
    """Return a box around the middle third of a collection's extent; the world if nothing has a position."""
    west, south, east, north = extent_of(collection)
    dx, dy = (east - west) / 3, (north - south) / 3
    return [west + dx, south + dy, east - dx, north - dy]


def parameters(kind: str, collection: dict[str, Any]) -> dict[str, Any]:
    box = ",".join(map(repr, middle_box(collection)))
    return {"plain": {}, "bbox": {"bbox": box}, "limit": {"limit": 7}, "datetime": {"datetime": TIMES[1]}}[kind]


def pages(ogc: Ogc, kind: str) -> Iterator[tuple[dict[str, Any], httpx.Response]]:
    """Request one page of each collection."""
    collections = ogc.collections()
    assert collections
    for collection in collections:
        more = parameters(kind, collection)
        yield collection, ogc.get(ogc.items_url(collection), accept=GEOJSON, **more)


def resolve(api: dict[str, Any], parameter: dict[str, Any]) -> dict[str, Any]:
    name = parameter.get("$ref", "").rpartition("/")[2]
    resolved: dict[str, Any] = api["components"]["parameters"][name] if name else parameter
    return resolved


def declared(ogc: Ogc, name: str) -> list[dict[str, Any]]:
    """Return a parameter as the OpenAPI document declares it for the items of each collection."""
    api = ogc.get(link(ogc.landing(), "service-desc", OPENAPI)).json()
    out = []
    for collection in ogc.collections():
        listed = api["paths"][f"/collections/{collection['id']}/items"]["get"]["parameters"]
        out.append(next(p for p in (resolve(api, one) for one in listed) if p["name"] == name))
    assert out
    return out


def check_links(document: dict[str, Any], media_type: str, others: set[str]) -> None:
    """Check the links of a document to itself and to its other representations."""
    for one in document["links"]:
        assert {"href", "rel", "type"} <= set(one), one
        assert one["href"].startswith("http")
    assert [one["type"] for one in document["links"] if one["rel"] == "self"] == [media_type]
    assert {one["type"] for one in document["links"] if one["rel"] == "alternate"} == others


# --- Part 1: landing page, API definition, conformance ---


def test_a1_http(ogc: Ogc) -> None:
    answer = ogc.get(ogc.root)
    assert answer.http_version == "HTTP/1.1"


def test_a3_landing_page_responds(ogc: Ogc) -> None:
    assert ogc.get(ogc.root, accept="application/json").headers["content-type"] == "application/json"
    assert "text/html" in ogc.get(ogc.root, accept="text/html,application/xhtml+xml,*/*;q=0.8").headers["content-type"]


def test_a4_landing_page_has_links(ogc: Ogc) -> None:
    landing = ogc.landing()
    assert link(landing, "service-desc", OPENAPI)
    assert ogc.get(link(landing, "service-doc", "text/html"), accept="text/html").text.startswith("<!DOCTYPE html>")
    assert link(landing, "conformance", "application/json")
    assert link(landing, "data", "application/json")
    check_links(landing, "application/json", {"text/html"})


def test_a5_api_definition_responds(ogc: Ogc) -> None:
    answer = ogc.get(link(ogc.landing(), "service-desc", OPENAPI), accept=OPENAPI)
    assert answer.headers["content-type"].replace(" ", "") == OPENAPI


def test_a6_api_definition_is_valid(ogc: Ogc) -> None:
    answer = ogc.get(link(ogc.landing(), "service-desc", OPENAPI), accept=OPENAPI)
    api = answer.json()
    assert re.fullmatch(r"3\.0\.\d", api["openapi"])
    assert [one["url"] + "/" for one in api["servers"]] == [ogc.root]
    for reference in set(re.findall(r'"\$ref":"#/([^"]+)"', answer.text)):
        place = api
        for key in reference.split("/"):
            place = place[key]
    names = [item["get"]["operationId"] for item in api["paths"].values()]
    assert len(names) == len(set(names))
    for path, item in api["paths"].items():
        listed = [resolve(api, one) for one in item["get"]["parameters"]]
        assert set(re.findall(r"\{(\w+)\}", path)) == {p["name"] for p in listed if p["in"] == "path"}
        assert all("schema" in p for p in listed)
        assert item["get"]["responses"]["200"]["description"]
        if "{" not in path:
            small = {"width": 64} if "width" in {p["name"] for p in listed} else {}
            ogc.get(ogc.root.rstrip("/") + path, **small)


def test_a7_a8_conformance(ogc: Ogc) -> None:
    classes = ogc.get(link(ogc.landing(), "conformance")).json()["conformsTo"]
    assert {f"{CONF}-1/1.0/conf/{name}" for name in ("core", "oas30", "html", "geojson")} <= set(classes)
    assert f"{CONF}-2/1.0/conf/crs" in classes
    assert len(classes) == len(set(classes))


# --- Part 1: collections ---


def test_a9_collections_respond(ogc: Ogc) -> None:
    ogc.get(link(ogc.landing(), "data"), accept="application/json")


def test_a10_collections_are_complete(ogc: Ogc) -> None:
    document = ogc.get(link(ogc.landing(), "data"), accept="application/json").json()
    check_links(document, "application/json", {"text/html"})
    assert document["collections"]
    assert document["crs"][0] == CRS84
    for collection in document["collections"]:
        assert {one["type"] for one in collection["links"] if one["rel"] == "items"} == {
            GEOJSON,
            "application/vnd.ogc.fg+json",
            "text/html",
        }
        west, south, east, north = extent_of(collection)
        assert -180 <= west <= east <= 180
        assert -90 <= south <= north <= 90


def test_a11_collection_responds(ogc: Ogc) -> None:
    for collection in ogc.collections():
        ogc.get(link(collection, "self"), accept="application/json")


def test_a12_collection_equals_its_entry(ogc: Ogc) -> None:
    for collection in ogc.collections():
        alone = ogc.get(link(collection, "self")).json()
        for name in ("id", "title", "description", "extent", "itemType", "crs", "storageCrs"):
            assert alone.get(name) == collection.get(name)
        check_links(alone, "application/json", {"text/html"})


# --- Part 1: features ---


@pytest.mark.parametrize("kind", KINDS)
def test_a13_items_respond(ogc: Ogc, kind: str) -> None:
    for _, answer in pages(ogc, kind):
        assert answer.headers["content-type"] == GEOJSON


@pytest.mark.parametrize("kind", KINDS)
def test_a2_items_are_in_crs84(ogc: Ogc, kind: str) -> None:
    for collection, answer in pages(ogc, kind):
        box = shapely.box(*extent_of(collection)).buffer(1e-9)
        shapes = [shape(f["geometry"]) for f in answer.json()["features"] if f["geometry"]]
        assert all(box.covers(one.envelope) for one in shapes)


@pytest.mark.parametrize("kind", KINDS)
def test_a22_items_are_a_feature_collection(ogc: Ogc, kind: str) -> None:
    for _, answer in pages(ogc, kind):
        page = answer.json()
        assert page["type"] == "FeatureCollection"
        for feature in page["features"]:
            assert feature["type"] == "Feature"
            assert set(feature) == {"type", "id", "geometry", "properties"}


@pytest.mark.parametrize("kind", KINDS)
def test_a22_a23_items_have_links(ogc: Ogc, kind: str) -> None:
    for _, answer in pages(ogc, kind):
        page = answer.json()
        check_links(page, GEOJSON, {"text/html", "application/vnd.ogc.fg+json"})
        itself = ogc.get(link(page, "self")).json()
        assert itself["features"] == page["features"]
        following = any(one["rel"] == "next" for one in page["links"])
        assert following == (page["numberReturned"] < page["numberMatched"])


@pytest.mark.parametrize("kind", KINDS)
def test_a22_a24_items_have_a_time_stamp(ogc: Ogc, kind: str) -> None:
    for _, answer in pages(ogc, kind):
        age = datetime.now(UTC) - datetime.fromisoformat(answer.json()["timeStamp"])
        assert timedelta(seconds=-2) < age < timedelta(minutes=5)


@pytest.mark.parametrize("kind", KINDS)
def test_a22_a25_number_matched_is_that_of_all_pages(ogc: Ogc, kind: str) -> None:
    for collection, answer in pages(ogc, kind):
        page = answer.json()
        few = kind == "limit" and page["numberMatched"] > 500
        rest = {} if not few else {"limit": page["numberMatched"] // 5}
        items = ogc.all_items(ogc.items_url(collection), **{**parameters(kind, collection), **rest})
        ids = [item["id"] for item in items]
        assert len(ids) == len(set(ids)) == page["numberMatched"]


@pytest.mark.parametrize("kind", KINDS)
def test_a22_a26_number_returned_is_that_of_the_page(ogc: Ogc, kind: str) -> None:
    for _, answer in pages(ogc, kind):
        assert answer.json()["numberReturned"] == len(answer.json()["features"])


def test_a14_bbox_is_declared(ogc: Ogc) -> None:
    for bbox in declared(ogc, "bbox"):
        assert (bbox["in"], bbox["required"], bbox["style"], bbox["explode"]) == ("query", False, "form", False)
        schema = bbox["schema"]
        assert (schema["type"], schema["minItems"], schema["maxItems"]) == ("array", 4, 6)
        assert schema["items"]["type"] == "number"


def test_a15_bbox_selects_what_intersects(ogc: Ogc) -> None:
    for collection in ogc.collections():
        url = ogc.items_url(collection)
        everything = {item["id"]: item for item in ogc.all_items(url, limit=10_000)}
        box = middle_box(collection)
        selected = {item["id"] for item in ogc.all_items(url, bbox=",".join(map(repr, box)), limit=10_000)}
        expected = {
            name
            for name, item in everything.items()
            if item["geometry"] and shape(item["geometry"]).intersects(shapely.box(*box))
        }
        assert selected == expected
        whole = extent_of(collection)
        around = ogc.all_items(url, bbox=",".join(map(repr, whole)), limit=10_000)
        assert {item["id"] for item in around} == {name for name, item in everything.items() if item["geometry"]}
        elsewhere = ogc.get(url, bbox="-179,-60,-178,-59").json()
        assert (elsewhere["features"], elsewhere["numberMatched"]) == ([], 0)


def test_a16_limit_is_declared(ogc: Ogc) -> None:
    for limit in declared(ogc, "limit"):
        assert (limit["in"], limit["required"], limit["style"], limit["explode"]) == ("query", False, "form", False)
        assert limit["schema"] == {"type": "integer", "minimum": 1, "maximum": 10_000, "default": 1000}


def test_a17_limit_bounds_the_page(ogc: Ogc) -> None:
    for collection in ogc.collections():
        url = ogc.items_url(collection)
        total = ogc.get(url).json()["numberMatched"]
        for limit, maximum in ((1, 1), (3, 3), (10_000, 10_000), (10_001, 10_000), (10**30, 10_000)):
            assert len(ogc.get(url, limit=limit).json()["features"]) == min(total, maximum)
        assert len(ogc.get(url).json()["features"]) == min(total, 1000)


def test_a18_datetime_is_declared(ogc: Ogc) -> None:
    for parameter in declared(ogc, "datetime"):
        assert (parameter["in"], parameter["required"], parameter["style"]) == ("query", False, "form")
        assert parameter["explode"] is False
        assert parameter["schema"]["type"] == "string"


@pytest.mark.parametrize("time", TIMES)
def test_a19_datetime_matches_features_without_times(ogc: Ogc, time: str) -> None:
    for collection in ogc.collections():
        url = ogc.items_url(collection)
        assert ogc.get(url, datetime=time).json()["numberMatched"] == ogc.get(url).json()["numberMatched"]


def test_a20_invalid_parameter_is_refused(ogc: Ogc) -> None:
    for collection in ogc.collections():
        ogc.get(ogc.items_url(collection), 400, limit="unlimited")


def test_a21_unknown_parameter_is_refused(ogc: Ogc) -> None:
    for collection in ogc.collections():
        ogc.get(ogc.items_url(collection), 400, unknownQueryParameter12345=1)


def feature_url(ogc: Ogc, collection: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    item = ogc.get(ogc.items_url(collection), limit=1).json()["features"][0]
    base = ogc.items_url(collection).partition("?")[0]
    return f"{base}/{quote(item['id'], safe='')}", item


def test_a27_a28_feature_responds(ogc: Ogc) -> None:
    for collection in ogc.collections():
        url, item = feature_url(ogc, collection)
        feature = ogc.get(url, accept=GEOJSON).json()
        assert {name: feature[name] for name in item} == item


def test_a29_feature_has_links(ogc: Ogc) -> None:
    for collection in ogc.collections():
        url, _ = feature_url(ogc, collection)
        feature = ogc.get(url, accept=GEOJSON).json()
        check_links(feature, GEOJSON, {"text/html", "application/vnd.ogc.fg+json"})
        assert ogc.get(link(feature, "collection")).json()["id"] == collection["id"]
        assert ogc.get(link(feature, "self")).json()["id"] == feature["id"]


# --- Part 2: coordinate reference systems ---

URI = re.compile(r"http://www\.opengis\.net/def/crs/[A-Z]+/[0-9.]+/[A-Za-z0-9]+|https?://[^/\s]+/ogc/[^\s]+/crs/local")


def crs_of(ogc: Ogc, uri: str) -> pyproj.CRS:
    """Return a CRS by its URI; the site's own is read from there."""
    if uri.startswith("http://www.opengis.net"):
        return pyproj.CRS.from_user_input(uri)
    return pyproj.CRS.from_wkt(ogc.get(uri).text)


def converter(ogc: Ogc, uri: str) -> pyproj.Transformer:
    """Return the conversion from CRS84, with the axes of the CRS in their own order."""
    return pyproj.Transformer.from_crs(pyproj.CRS.from_user_input("OGC:CRS84"), crs_of(ogc, uri))


def test_crs_a1_identifiers_are_uris(ogc: Ogc) -> None:
    document = ogc.get(link(ogc.landing(), "data")).json()
    uris = [*document["crs"]]
    for collection in document["collections"]:
        uris += [*collection["crs"], collection["storageCrs"], *ogc.get(link(collection, "self")).json()["crs"]]
    assert all(URI.fullmatch(uri) for uri in uris)
    assert all(crs_of(ogc, uri) for uri in set(uris))


def test_crs_a2_default_is_listed_first_and_the_local_frame_last(ogc: Ogc) -> None:
    for collection in ogc.collections():
        assert collection["crs"][0] == CRS84
        assert collection["crs"][-1].startswith(ogc.root)
        assert len(collection["crs"]) == 5


def test_crs_a3_storage_crs_is_listed(ogc: Ogc) -> None:
    for collection in ogc.collections():
        assert collection["storageCrs"] == CRS84
        assert collection["storageCrs"] in collection["crs"]


def test_crs_a4_header_states_the_requested_crs(ogc: Ogc) -> None:
    for collection in ogc.collections():
        for uri in collection["crs"]:
            for url in (ogc.items_url(collection), feature_url(ogc, collection)[0]):
                assert ogc.get(url, crs=uri).headers["content-crs"] == f"<{uri}>"


def test_crs_a5_unknown_crs_is_refused(ogc: Ogc) -> None:
    for collection in ogc.collections():
        for url in (ogc.items_url(collection), feature_url(ogc, collection)[0]):
            problem = ogc.get(url, 400, crs="http://www.opengis.net/def/crs/0/unsupported").json()
            assert problem["errors"][0]["where"] == "crs"


def test_crs_a6_default_crs_is_stated(ogc: Ogc) -> None:
    for collection in ogc.collections():
        for url in (ogc.items_url(collection), feature_url(ogc, collection)[0]):
            assert ogc.get(url).headers["content-crs"] == f"<{CRS84}>"


def test_crs_a7_geometries_are_converted(ogc: Ogc) -> None:
    """Compare with PROJ's own conversion, to a tenth of a millimetre."""
    for collection in ogc.collections():
        url = ogc.items_url(collection)
        degrees = [shape(f["geometry"]) for f in ogc.get(url, limit=50).json()["features"] if f["geometry"]]
        for uri in collection["crs"]:
            features = ogc.get(url, limit=50, crs=uri).json()["features"]
            converted = [shape(f["geometry"]) for f in features if f["geometry"]]
            points = shapely.get_coordinates(degrees)
            if not len(points):
                assert collection["id"] == "objects-other"
                continue
            expected = np.column_stack(converter(ogc, uri).transform(points[:, 0], points[:, 1]))
            tolerance = 1e-9 if uri.endswith(("4326", "CRS84")) else 1e-4
            assert np.abs(shapely.get_coordinates(converted) - expected).max() < tolerance, uri
            one, _ = feature_url(ogc, collection)
            assert ogc.get(one, crs=uri).json()["geometry"] == features[0]["geometry"]


def test_crs_a8_bbox_is_read_in_its_crs(ogc: Ogc) -> None:
    for collection in ogc.collections():
        url = ogc.items_url(collection)
        items = {f["id"]: f for f in ogc.all_items(url, limit=10_000) if f["geometry"]}
        if not items:
            continue
        shapes = shapely.force_2d([shape(f["geometry"]) for f in items.values()])
        x, y = (middle_box(collection)[k::2] for k in (0, 1))
        for uri in collection["crs"]:
            transformer = converter(ogc, uri)
            corners = np.column_stack(transformer.transform([x[0], x[1], x[0], x[1]], [y[0], y[1], y[1], y[0]]))
            box = [*corners.min(axis=0).tolist(), *corners.max(axis=0).tolist()]
            page = ogc.get(url, bbox=",".join(map(repr, box)), bbox_crs=uri, limit=10_000).json()
            area = shapely.box(*box)
            there = shapely.transform(shapes, lambda xy, t=transformer: np.column_stack(t.transform(*xy.T)))
            expected = {name for name, meets in zip(items, shapely.intersects(there, area), strict=True) if meets}
            assert {f["id"] for f in page["features"]} == expected, uri


def test_crs_a9_unknown_bbox_crs_is_refused(ogc: Ogc) -> None:
    for collection in ogc.collections():
        url, uri = ogc.items_url(collection), "http://www.opengis.net/def/crs/0/unsupported"
        problem = ogc.get(url, 400, bbox="1,1,2,2", bbox_crs=uri).json()
        assert problem["errors"][0]["where"] == "bbox-crs"


def test_crs_a10_bbox_crs_is_crs84_by_default(ogc: Ogc) -> None:
    for collection in ogc.collections():
        url, box = ogc.items_url(collection), ",".join(map(repr, middle_box(collection)))
        assert ogc.get(url, bbox=box).json()["features"] == ogc.get(url, bbox=box, bbox_crs=CRS84).json()["features"]
