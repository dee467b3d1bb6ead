"""A site across the antimeridian: features are cut there, boxes have west > east, maps and tiles show both sides."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import Any

import numpy as np
import pyproj
import pytest
import shapely
from PIL import Image

from app.ogc.crs import EPSG
from app.ogc.tables import CACHE
from tests.api.conftest import Api, problem, running, settings_for
from tests.api.ogc_sites import create_turned
from tests.api.samples import EDGES, NODES

DATUM = {"latitude": -16.8, "longitude": 179.99995, "altitude": 0.0, "heading": 0.0}
COLLECTIONS = "/ogc/island/collections"


@pytest.fixture(scope="module")
def island(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Api]:
    with running(settings_for(tmp_path_factory.mktemp("island"))) as api:
        create_turned(api, "island", DATUM)
        yield api


def on_earth(x: float, y: float) -> list[float]:
    """Return the longitude and latitude of local metres, by PROJ alone."""
    frame = pyproj.Proj(proj="tmerc", lat_0=DATUM["latitude"], lon_0=DATUM["longitude"], ellps="WGS84")
    return list(frame(x, y, inverse=True))


def items(api: Api, collection: str, **query: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = api.get(f"{COLLECTIONS}/{collection}/items", params=query).json()["features"]
    return found


def test_features_are_cut(island: Api) -> None:
    edges = {feature["id"]: feature for feature in items(island, "edges")}
    assert len(edges) == len(EDGES)
    for feature in edges.values():
        ends = [on_earth(*NODES[feature["properties"][end]]) for end in ("source", "target")]
        shape = shapely.geometry.shape(feature["geometry"])
        points = shapely.get_coordinates(shape)
        assert points[[0, -1]].tolist() == [pytest.approx(end, abs=1e-11) for end in ends]
        crosses = ends[0][0] * ends[1][0] < 0
        assert shape.geom_type == ("MultiLineString" if crosses else "LineString")
        if crosses:
            assert sorted(points[1:-1, 0].tolist()) == [-180.0, 180.0]
    (grid,) = items(island, "grid-map")
    assert grid["geometry"]["type"] == "MultiPolygon"
    area = sum(abs(pyproj.Geod(ellps="WGS84").geometry_area_perimeter(part)[0]) for part in
               shapely.geometry.shape(grid["geometry"]).geoms)  # fmt: skip
    properties = grid["properties"]
    assert area == pytest.approx(properties["width"] * properties["height"] * properties["resolution"] ** 2, rel=1e-4)


def test_metres_are_not_cut(island: Api) -> None:
    uris = island.get(f"{COLLECTIONS}/edges").json()["crs"]
    utm = next(uri for uri in uris if uri.endswith("32760"))
    for uri in (utm, uris[-1]):
        for feature in items(island, "edges", crs=uri):
            assert feature["geometry"]["type"] == "LineString"
            assert shapely.geometry.shape(feature["geometry"]).length == pytest.approx(10, rel=0.25)


def test_boxes_have_west_beyond_east(island: Api) -> None:
    listed = {one["id"]: one["extent"]["spatial"]["bbox"][0] for one in island.get(COLLECTIONS).json()["collections"]}
    points = [on_earth(*place) for place in NODES.values()]
    west, south, east, north = listed["nodes"]
    assert west == pytest.approx(max(lon for lon, _ in points), abs=1e-9)
    assert east == pytest.approx(max(lon for lon, _ in points if lon < 0), abs=1e-9)
    assert (south, north) == pytest.approx((min(lat for _, lat in points), max(lat for _, lat in points)), abs=1e-9)
    assert all(box[0] > 179.99 for box in (listed["edges"], listed["grid-map"]))
    assert all(-180.0 < box[2] < -179.99 for box in (listed["edges"], listed["grid-map"]))


@pytest.mark.parametrize(
    ("box", "edges"),
    [
        ("179.99,-17,-179.99,-16", 3),
        ("179.9999501,-17,179.9999502,-16", 2),  # between the ends of the edges that cross
        ("-179.99999,-17,-179.99998,-16", 2),
        ("179,-17,180,-16", 2),
        ("-180,-17,-179,-16", 3),
        ("0,-17,100,-16", 0),
        ("-179,-17,179,-16", 0),
        ("-180,-90,180,90", 3),
    ],
)
@pytest.mark.parametrize("cached", [False, True])
def test_boxes_select_what_is_there(island: Api, box: str, edges: int, cached: bool) -> None:
    """By the store's index before there is a table, and by the table."""
    CACHE._entries.clear()
    if cached:
        items(island, "edges")
    assert len(items(island, "edges", bbox=box)) == edges
    assert len(items(island, "grid-map", bbox=box)) == (edges > 0)
    layer = island.get("environments/island/versions/latest/layers/topology", params={"bbox": box, "crs": "wgs84"})
    assert sum(one["properties"]["kind"] == "edge" for one in layer.json()["features"]) == edges


@pytest.mark.parametrize("crs", ["OGC/1.3/CRS84", "EPSG/0/4326", "EPSG/0/3857"])
def test_pieces_that_are_sent_back_become_one(island: Api, crs: str) -> None:
    uri = f"http://www.opengis.net/def/crs/{crs}"
    island.post("environments/island/drafts", {"name": crs.replace("/", "-")})
    draft = island.get("environments/island/drafts").json()[-1]["id"]
    base = f"/ogc/island/drafts/{draft}/collections"
    for collection, kind in (("edges", "LineString"), ("objects-lines", "LineString")):
        for feature in island.get(f"{base}/{collection}/items", params={"crs": uri}).json()["features"]:
            address = f"{base}/{collection}/items/{feature['id']}"
            island("PUT", address, 204, json=feature, headers={"content-crs": f"<{uri}>"})
            local = island.get(f"/ogc/island/collections/{collection}").json()["crs"][-1]
            local = local.replace("/ogc/island/", f"/ogc/island/drafts/{draft}/")
            shown = island.get(address, params={"crs": local}).json()["geometry"]
            before = island.get(f"/ogc/island/collections/{collection}/items/{feature['id']}",
                                params={"crs": local.replace(f"/drafts/{draft}", "")}).json()["geometry"]  # fmt: skip
            assert shown["type"] == kind
            assert (
                shapely.hausdorff_distance(*map(shapely.geometry.shape, (shown, before))) < 1e-5
            )  # a line straight in degrees


@pytest.mark.parametrize("address", ["/ogc/island/map", f"{COLLECTIONS}/edges/map", f"{COLLECTIONS}/grid-map/map"])
@pytest.mark.parametrize("crs", ["OGC/1.3/CRS84", "EPSG/0/4326", "EPSG/0/3857", "EPSG/0/32760"])
def test_maps_show_both_sides(island: Api, address: str, crs: str) -> None:
    answer = island.get(address, params={"crs": f"http://www.opengis.net/def/crs/{crs}", "width": "400"})
    alpha = np.asarray(Image.open(io.BytesIO(answer.content)).convert("RGBA"))[..., 3]
    assert (alpha[:, :200] > 0).any()
    assert (alpha[:, 200:] > 0).any()
    corners = [float(value) for value in answer.headers["content-bbox"].split(",")]
    if crs == "OGC/1.3/CRS84":
        assert corners[0] > 179.99
        assert corners[2] < -179.99
        again = island.get(address, params={"bbox": answer.headers["content-bbox"], "width": "400"})
        assert again.content == answer.content


def test_a_box_without_area_is_refused(island: Api) -> None:
    refused = problem(island.get("/ogc/island/map", 400, params={"bbox": "1,-16,2,-17"}))
    assert refused["errors"][0]["where"] == "bbox"
    query = {"bbox": "2,1,1,2", "bbox-crs": f"{EPSG}3857"}
    assert problem(island.get("/ogc/island/map", 400, params=query))["errors"][0]["where"] == "bbox"


@pytest.mark.parametrize("kind", ["tiles", "map/tiles"])
def test_tiles_are_on_both_sides_and_not_between(island: Api, kind: str) -> None:
    side, row = 2**18, 143484
    shown = []
    for column in (0, side // 2, side - 1):
        answer = island.get(f"/ogc/island/{kind}/WebMercatorQuad/18/{row}/{column}", None)
        picture = answer.headers.get("content-type") == "image/png"
        some = (
            bool(np.asarray(Image.open(io.BytesIO(answer.content)).convert("RGBA"))[..., 3].any()) if picture else False
        )
        shown.append(some or (not picture and answer.status_code == 200))
    assert shown == [True, False, True]


def test_pages_show_a_map(island: Api) -> None:
    for address in ("/ogc/island/", f"{COLLECTIONS}/edges", f"{COLLECTIONS}/edges/items"):
        text = island.get(address, headers={"accept": "text/html"}).text
        assert "<img" in text or "<svg" in text
    box = text.partition('viewBox="')[2].partition('"')[0].split()
    assert float(box[3]) > 100.0  # not a strip around the globe
