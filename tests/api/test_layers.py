"""Canonical content over HTTP, diffs and transformations."""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from pyproj import Proj

from app.api.http.features import geometries_as_geojson
from app.api.layers import crop_grid
from app.errors import NotFound
from app.model.grid import OccupancyGrid
from tests.api import samples
from tests.api.conftest import Api

JSON = {"Accept": "application/json"}
TMERC = Proj(f"+proj=tmerc +lat_0={samples.LATITUDE} +lon_0={samples.LONGITUDE} +k=1 +ellps=WGS84")


def test_list_has_all_parts_of_a_version(api: Api, farm: str) -> None:
    lines = api.get(f"environments/{farm}/versions/3/layers").json()
    by = {(line["layer"], line["name"]): line for line in lines}
    network = by["topology", "network"]
    assert network["count"] == 6
    assert network["level"] == "ground"
    assert network["bounds"]["local"] == [0.0, 0.0, 10.0, 8.0]
    assert network["sources"] == ["network.tmap2.yaml"]
    assert network["information"] == "raw"
    assert by["occupancy", "map"]["count"] == 48
    assert len(api.get(f"environments/{farm}/versions/1/layers").json()) < len(lines)
    assert api.get(f"environments/{farm}/versions/0/layers").json() == []


def test_topology_is_geojson_in_wgs84(api: Api, farm: str) -> None:
    answer = api.get(f"environments/{farm}/versions/3/layers/topology")
    assert answer.headers["content-type"] == "application/geo+json"
    body = answer.json()
    assert body["type"] == "FeatureCollection"
    assert "coordRefSys" not in body
    features = {f["id"]: f for f in body["features"]}
    assert set(features) == {"gate", "barn", "field", "gate_barn", "barn_gate", "barn_field"}
    for name, (x, y) in samples.NODES.items():
        feature = features[name]
        assert feature["properties"]["kind"] == "node"
        lon, lat = feature["geometry"]["coordinates"]
        east, north = TMERC(lon, lat)
        assert math.hypot(east - x, north - y) < 1e-6
    edge = features["barn_field"]
    assert (edge["properties"]["kind"], edge["properties"]["source"], edge["properties"]["target"]) == (
        "edge", "barn", "field",
    )  # fmt: skip
    assert edge["geometry"]["type"] == "LineString"
    assert edge["geometry"]["coordinates"][0] == features["barn"]["geometry"]["coordinates"]


def test_local_coordinates_are_never_geometry(api: Api, farm: str) -> None:
    body = api.get(f"environments/{farm}/versions/3/layers/topology?crs=local").json()
    assert body["coordRefSys"]
    assert body["datum"]["latitude"] == samples.LATITUDE
    for feature in body["features"]:
        assert feature["geometry"] is None
        if feature["properties"]["kind"] == "node":
            assert tuple(feature["place"]["coordinates"]) == samples.NODES[feature["id"]]


def test_layers_without_a_datum_are_local_only(api: Api, bare: str) -> None:
    api.upload(bare, {"n.tmap2.yaml": samples.tmap2()})
    body = api.get(f"environments/{bare}/versions/1/layers/topology").json()
    assert body["coordRefSys"]
    assert body["datum"] is None
    problem = api.problem("GET", f"environments/{bare}/versions/1/layers/topology?crs=wgs84", 422)
    assert "datum" in problem["detail"]


def test_location_has_fence_and_datum(api: Api, farm: str, bare: str) -> None:
    (fence,) = api.get(f"environments/{farm}/versions/1/layers/location").json()["features"]
    assert fence["geometry"]["type"] == "Polygon"
    assert fence["properties"]["datum"] == {
        "latitude": samples.LATITUDE, "longitude": samples.LONGITUDE, "altitude": 0.0, "heading": 0.0,
    }  # fmt: skip
    api("PATCH", f"environments/{bare}", 200, json={"datum": {"latitude": 1.0, "longitude": 2.0}})
    (only,) = api.get(f"environments/{bare}/versions/1/layers/location").json()["features"]
    assert only["geometry"] == {"type": "Point", "coordinates": [2.0, 1.0]}
    assert only["properties"]["datum"]["latitude"] == 1.0


def test_bbox_selects_features(api: Api, farm: str) -> None:
    url = f"environments/{farm}/versions/3/layers/topology"
    near = api.get(url, params={"crs": "local", "bbox": "-1,-1,1,1"}).json()["features"]
    assert {f["id"] for f in near} == {"gate", "gate_barn", "barn_gate"}
    lon, lat = TMERC(0.0, 0.0, inverse=True)
    box = f"{lon - 1e-5},{lat - 1e-5},{lon + 1e-5},{lat + 1e-5}"
    assert {f["id"] for f in api.get(url, params={"bbox": box}).json()["features"]} == {
        "gate",
        "gate_barn",
        "barn_gate",
    }
    assert api.get(url, params={"crs": "local", "bbox": "100,100,101,101"}).json()["features"] == []
    for bad in ("1,2,3", "1,1,0,0", "a,b,c,d", "0,0,1e9,1"):
        api.problem("GET", url, 422, params={"crs": "local", "bbox": bad})
    api.problem("GET", url, 422, params={"bbox": "0,91,0,92"})


def test_level_and_name_select_parts(api: Api, farm: str) -> None:
    url = f"environments/{farm}/versions/3/layers/topology"
    assert len(api.get(f"{url}?level=ground&name=network").json()["features"]) == 6
    for query in ("level=attic", "name=other"):
        assert "network" in api.problem("GET", f"{url}?{query}", 404)["detail"]
    assert api.get(f"environments/{farm}/versions/3/layers/zones").json()["features"] == []
    api.problem("GET", f"environments/{farm}/versions/3/layers/weather", 422)
    api.problem("GET", f"{url}?crs=utm", 422)


def test_occupancy_is_png_or_json(api: Api, farm: str) -> None:
    url = f"environments/{farm}/versions/3/layers/occupancy"
    answer = api.get(url)
    assert answer.headers["content-type"] == "image/png"
    pixels = np.asarray(Image.open(io.BytesIO(answer.content)))
    assert pixels.shape == (6, 8)
    assert (pixels[:, 0] == 100).all()
    assert pixels[5, 7] == 255, "row 0 is at the top: the unknown cell is at the lower right"
    assert (pixels[:5, 1:] == 0).all()
    body = api.get(url, headers=JSON).json()
    assert body == {
        "name": "map", "level": "ground", "width": 8, "height": 6, "resolution": 0.5, "origin": [-1.0, -2.0, 0.0],
        "counts": {"occupied": 6, "free": 41, "unknown": 1, "other": 0},
    }  # fmt: skip
    assert api.get(url, headers={"Accept": "text/html, application/json;q=0.9, image/*;q=0.5"}).json() == body
    api.problem("GET", url, 406, headers={"Accept": "text/html"})


def test_bbox_crops_a_grid(api: Api, farm: str) -> None:
    url = f"environments/{farm}/versions/3/layers/occupancy"
    body = api.get(url, headers=JSON, params={"crs": "local", "bbox": "-1,-2,-0.5,0"}).json()
    assert (body["width"], body["height"], body["origin"]) == (1, 4, [-1.0, -2.0, 0.0])
    assert body["counts"]["occupied"] == 4
    lon, lat = TMERC(-0.75, -1.75, inverse=True)
    tiny = api.get(url, headers=JSON, params={"bbox": f"{lon},{lat},{lon},{lat}"}).json()
    assert (tiny["width"], tiny["height"], tiny["counts"]["occupied"]) == (1, 1, 1)
    api.problem("GET", url, 404, params={"crs": "local", "bbox": "100,100,101,101"})


def test_several_grids_need_a_name(api: Api, farm: str, bare: str) -> None:
    api.upload(farm, samples.grid("keepout"))
    url = f"environments/{farm}/versions/latest/layers/occupancy"
    assert api.get(url, headers=JSON).json()["name"] == "map"
    assert api.get(f"{url}?name=keepout", headers=JSON).json()["name"] == "keepout"
    assert "keepout" in api.problem("GET", f"{url}?name=speed", 404)["detail"]
    api.upload(bare, samples.grid("keepout"))
    only = f"environments/{bare}/versions/latest/layers/occupancy"
    assert api.get(only, headers=JSON).json()["name"] == "keepout"
    api.upload(bare, samples.grid("speed"))
    problem = api.problem("GET", only, 409)
    assert {e["where"] for e in problem["errors"]} == {"keepout", "speed"}
    assert "keepout, speed" in problem["detail"]


def test_missing_parts_return_404(api: Api, bare: str) -> None:
    for layer in ("occupancy", "voxels", "imagery"):
        api.problem("GET", f"environments/{bare}/versions/0/layers/{layer}", 404)


def test_repeated_layer_request_returns_304(api: Api, farm: str) -> None:
    for url in (f"environments/{farm}/versions/3/layers/topology", f"environments/{farm}/versions/3/layers/occupancy"):
        etag = api.get(url).headers["etag"]
        assert api.get(url, 304, headers={"If-None-Match": etag}).content == b""
        assert api.get(f"{url}?crs=local").headers["etag"] != etag


def test_bbox_crops_a_rotated_grid() -> None:
    cells = np.arange(16, dtype=np.uint8).reshape(4, 4)
    turned = OccupancyGrid(cells, 1.0, (0.0, 0.0, math.pi / 2))
    # Turned by a quarter: cell (row r, column c) covers x in [-r-1, -r], y in [c, c+1].
    part = crop_grid(turned, (-1.9, 2.1, -1.1, 2.9))
    assert part.cells.tolist() == [[6]]
    assert part.origin == pytest.approx((-1.0, 2.0, math.pi / 2))
    with pytest.raises(NotFound):
        crop_grid(turned, (1.0, 1.0, 2.0, 2.0))


OCTOMAP = Path(__file__).resolve().parents[1] / "samples" / "octomap"
BYTES = {"Accept": "application/octet-stream"}


def test_voxels_are_json_or_octomap(api: Api, bare: str) -> None:
    shed = (OCTOMAP / "shed.bt").read_bytes()
    api.upload(bare, {"shed.bt": shed})
    url = f"environments/{bare}/versions/latest/layers/voxels"
    body = api.get(url).json()
    assert body.pop("leaves") == {"occupied": 908, "free": 1042}
    assert body == {
        "name": "shed",
        "level": "ground",
        "resolution": 0.25,
        "depth": 16,
        "counts": {"occupied": 908, "free": 2260},
        "bounds": [-2.5, -2.0, 0.0, 3.0, 2.0, 2.25],
    }
    answer = api.get(url, headers=BYTES)
    assert answer.headers["content-type"] == "application/octet-stream"
    assert answer.content == shed
    assert api.get(f"environments/{bare}/versions/latest/maps/octomap").content == shed
    cut = api.get(f"{url}?bbox=-2.5,-2,-2.25,2&crs=local").json()
    assert cut["bounds"] == [-2.5, -2.0, 0.0, -2.25, 2.0, 2.25]
    assert cut["counts"] == {"occupied": 16 * 9, "free": 0}
    part = api.get(f"{url}?bbox=-2.5,-2,-2.25,2&crs=local", headers=BYTES).content
    assert part != shed
    api.upload(bare, {"cut.bt": part})
    assert {**api.get(f"{url}?name=cut").json(), "name": "shed"} == cut
    api.problem("GET", f"{url}?name=cut&bbox=5,5,6,6", 404)
    api.problem("GET", f"{url}?name=cut&bbox=5,5,6,6", 404, headers=BYTES)
    api.problem("GET", url, 409)
    api.problem("GET", f"{url}?name=cut", 406, headers={"Accept": "image/png"})


def test_voxels_are_written_as_bt_from_any_upload(api: Api, bare: str) -> None:
    shelf = (OCTOMAP / "shelf.ot").read_bytes()
    api.upload(bare, {"map.ot": shelf})
    latest = f"environments/{bare}/versions/latest"
    assert api.get(f"{latest}/layers/voxels", headers=BYTES).content.startswith(b"# Octomap OcTree binary file")
    response = api.get(f"{latest}/maps/octomap")
    assert response.content == shelf
    assert 'filename="map.ot"' in response.headers["content-disposition"]
    assert api.get(f"{latest}/maps/octomap/map.ot").content == shelf
    binary = api.get(f"{latest}/maps/octomap/map.bt")
    assert binary.content == api.get(f"{latest}/layers/voxels", headers=BYTES).content
    report = api.get(f"{latest}/reports/octomap?kind=bt").json()
    assert [d["what"] for d in report["dropped"]] == ["log-odds", "colours"]
    api.problem("GET", f"{latest}/maps/octomap?depth=17", 422)
    api.problem("GET", f"{latest}/maps/octomap?bbox=0,0,0,1,1", 422)
    api.problem("GET", f"{latest}/maps/octomap/lab.bt", 404)


def test_empty_octree_survives_a_round_trip(api: Api, bare: str) -> None:
    head = (OCTOMAP / "shelf.ot").read_bytes().partition(b"size ")[0].replace(b"ColorOcTree", b"OcTree")
    empty = head + b"size 0\nres 0.1\ndata\n"
    answer = api.upload(bare, {"map.ot": empty}).json()
    assert any("no voxels" in w["problem"] for w in answer["warnings"])
    latest = f"environments/{bare}/versions/latest"
    assert api.get(f"{latest}/maps/octomap").content == empty
    body = api.get(f"{latest}/layers/voxels").json()
    assert (body["counts"], body["bounds"]) == ({"occupied": 0, "free": 0}, None)
    assert b"size 0" in api.get(f"{latest}/layers/voxels", headers=BYTES).content


def test_coordinates_are_rounded() -> None:
    import orjson
    import shapely

    shapes = np.array([shapely.Point(1 / 3, -1e-15), shapely.Point(1, 2, 3), shapely.GeometryCollection()], object)
    flat, deep, none = orjson.loads(orjson.dumps(geometries_as_geojson(shapes, 9)))
    assert flat["coordinates"] == [0.333333333, 0.0]
    assert deep["coordinates"] == [1.0, 2.0, 3.0]
    assert none is None


# --- diff ---


def test_diff_lists_changed_features(api: Api, farm: str) -> None:
    nodes = {"gate": (0.0, 0.0), "barn": (10.0, 1.0), "new": (3.0, 3.0)}
    api.upload(farm, {"network.tmap2.yaml": samples.tmap2(nodes, (("gate", "barn"), ("barn", "new")))})
    body = api.get(f"environments/{farm}/diff?from=3&to=4").json()
    assert (body["from"], body["to"]) == (3, 4)
    topology = body["layers"]["topology"]
    assert set(topology["added"]) >= {"new"}
    assert "barn" in {c["id"] for c in topology["changed"]}
    assert {"barn_gate"} <= set(topology["deleted"])
    assert api.get(f"environments/{farm}/diff").json() == body, "by default: the changes of the head"
    same = api.get(f"environments/{farm}/diff?from=4&to=latest").json()
    assert same["layers"] == {}
    api.problem("GET", f"environments/{farm}/diff?from=99", 404)
    api.problem("GET", f"environments/{farm}/diff?from=x*", 422)
    api.problem("GET", f"environments/{farm}/diff?to=0", 422)


def colours(png: bytes, *wanted: tuple[int, int, int]) -> bool:
    """Test if a picture has all of some colours, to a few steps."""
    pixels = np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).reshape(-1, 3).astype(int)
    return all((np.abs(pixels - one).max(axis=1) <= 4).any() for one in wanted)


def test_diff_counts_cells_and_draws_an_image(api: Api, farm: str) -> None:
    ring = [[0.0, -2.0], [1.0, -2.0], [1.0, -1.0], [0.0, -1.0], [0.0, -2.0]]
    change = {"op": "cells", "polygon": {"type": "Polygon", "coordinates": [ring]}, "crs": "local", "value": 100}
    node = {"type": "Feature", "id": "new", "geometry": None, "place": {"type": "Point", "coordinates": [2.0, 0.0]}}
    put = {"op": "put", "layer": "topology", "feature": {**node, "properties": {"kind": "node"}}}
    api.post(f"environments/{farm}/edits", {"changes": [change, put]})
    body = api.get(f"environments/{farm}/diff?from=3&to=4").json()
    assert body["layers"]["occupancy"]["map"]["blocked"] == 4
    assert body["layers"]["topology"]["added"] == ["new"]
    answer = api.get(f"environments/{farm}/diff?from=3&to=4&render=png")
    assert answer.headers["content-type"] == "image/png"
    assert colours(answer.content, blocked := (203, 36, 49), (0, 140, 60)), "blocked cells, and the added node"
    back = api.get(f"environments/{farm}/diff?from=4&to=3&render=png").content
    assert colours(back, freed := (22, 112, 214), (200, 30, 30)), "freed cells, and the deleted node"
    assert not colours(answer.content, freed)
    assert not colours(back, blocked)
    for query in ("from=3&to=3", "from=0&to=1", "from=1&to=2", "from=2&to=3"):
        assert api.get(f"environments/{farm}/diff?{query}&render=png").content.startswith(b"\x89PNG")
    api.problem("GET", f"environments/{farm}/diff?render=gif", 422)


# --- transform ---


def test_transform_converts_both_ways(api: Api, farm: str, bare: str, fresh: Callable[[], str]) -> None:
    url = f"environments/{farm}/transform"
    body = api.get(url, params={"xy": "100.5,-20.25"}).json()
    lat, lon = body["latlon"]
    east, north = TMERC(lon, lat)
    assert math.hypot(east - 100.5, north + 20.25) < 1e-6
    assert body["xy"] == [100.5, -20.25]
    back = api.get(url, params={"latlon": f"{lat!r},{lon!r}"}).json()
    assert back["xy"] == pytest.approx([100.5, -20.25], abs=1e-6)
    assert api.get(url, params={"latlon": f"{samples.LATITUDE},{samples.LONGITUDE}"}).json()["xy"] == [0.0, 0.0]
    for bad in ({}, {"xy": "1"}, {"xy": "1,2", "latlon": "1,2"}, {"latlon": "91,0"}, {"xy": "1e9,0"}, {"xy": "nan,0"},
                {"xy": "1_0,2"}):  # fmt: skip
        api.problem("GET", url, 422, params=bad)
    assert "datum" in api.problem("GET", f"environments/{bare}/transform?xy=1,2", 422)["detail"]
    turned = fresh()
    api.post("environments", {"name": turned, "datum": {"latitude": 53.0, "longitude": -1.0, "heading": 90.0}})
    lat, lon = api.get(f"environments/{turned}/transform?xy=0,100").json()["latlon"]
    assert lon > -1.0 + 0.001, "heading 90: the local y axis points east"
    assert lat == pytest.approx(53.0, abs=1e-5)
