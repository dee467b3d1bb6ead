"""Images over HTTP: read and written in confined workers, returned as PNG, placed by options."""

from __future__ import annotations

import io
from collections.abc import Callable

import numpy as np
from PIL import Image

from app.formats import FileGroup, ReadContext, WriteContext, get_format, read, write
from app.formats.satellite import WriteOptions
from app.model.imagery import GeoImage
from app.model.layers import Layers, PartKey
from tests.api.conftest import Api

DATUM = {"latitude": 53.2686, "longitude": -0.5245}


def geotiff(pixels: np.ndarray, crs: str = "EPSG:32630", **properties: object) -> bytes:
    picture = GeoImage(pixels, (0.5, 0.0, 665000.0, 0.0, -0.5, 5905000.0), crs, properties)
    context = WriteContext(options=WriteOptions())
    return write(get_format("satellite"), Layers({PartKey("imagery"): picture}), context)["satellite.tif"]


def picture_of(data: bytes) -> GeoImage:
    (part,) = read(FileGroup(get_format("satellite"), "a.tif", {"a.tif": data}), ReadContext()).parts.values()
    assert isinstance(part, GeoImage)
    return part


def environment(api: Api, name: str, **more: object) -> str:
    api.post("environments", {"name": name, **more})
    return name


def test_large_image_survives_a_round_trip(api: Api, fresh: Callable[[], str]) -> None:
    env = environment(api, fresh(), datum=DATUM)
    rows, columns = np.mgrid[0:2500, 0:3000]
    pixels = np.stack([rows % 251, columns % 241, (rows + columns) % 255], axis=-1).astype(np.uint8)
    data = geotiff(pixels, attribution=["© Survey"], satellite={"tags": {"TIFFTAG_COPYRIGHT": "© Survey"}})
    version = api.upload(env, {"field.tif": data}).json()
    assert version["information"]["imagery"] == "raw"
    assert version["warnings"] == []
    about = api.get(f"environments/{env}/versions/latest/layers/imagery", headers={"Accept": "application/json"}).json()
    assert (about["width"], about["height"], about["bands"], about["type"]) == (3000, 2500, 3, "uint8")
    assert about["crs"] == "EPSG:32630"
    assert about["attribution"] == ["© Survey"]
    shown = Image.open(io.BytesIO(api.get(f"environments/{env}/versions/latest/layers/imagery").content))
    assert np.array_equal(np.asarray(shown), pixels)
    answer = api.get(f"/maps/{env}/satellite")
    assert answer.headers["content-type"] == "image/tiff"
    assert 'filename="satellite.tif"' in answer.headers["content-disposition"]
    assert answer.content == api.get(f"/maps/{env}/satellite/satellite.tif").content == data
    report = api.get(f"environments/{env}/versions/latest/reports/satellite").json()
    assert report["attribution"] == ["© Survey"]
    local = picture_of(api.get(f"/maps/{env}/satellite?crs=local").content)
    assert local.transform[1] == local.transform[3] == 0.0


def test_file_name_selects_png(api: Api, fresh: Callable[[], str]) -> None:
    env = environment(api, fresh())
    api.upload(env, {"plan.tif": geotiff(np.full((4, 5, 3), 9, np.uint8))})
    png = api.get(f"/maps/{env}/satellite/satellite.png")
    assert png.headers["content-type"] == "image/png"
    assert Image.open(io.BytesIO(png.content)).size == (5, 4)
    world = api.get(f"/maps/{env}/satellite/satellite.pgw").text.split()
    assert world == ["0.5", "0.0", "0.0", "-0.5", "665000.25", "5904999.75"]
    assert api.get(f"/maps/{env}/satellite/plan.png").content == png.content
    assert b"<SRS>" in api.get(f"/maps/{env}/satellite/satellite.png.aux.xml").content
    api.problem("GET", f"/maps/{env}/satellite/other.tif", 404)


def test_float_terrain_is_shown_in_grey(api: Api, fresh: Callable[[], str]) -> None:
    env = environment(api, fresh())
    heights = np.array([[[10.0], [20.0]], [[-9999.0], [15.0]]], np.float32)
    api.upload(env, {"dtm.tif": geotiff(heights, nodata=-9999)})
    shown = Image.open(io.BytesIO(api.get(f"environments/{env}/versions/latest/layers/imagery").content))
    assert np.asarray(shown).tolist() == [[[0, 255], [255, 255]], [[0, 0], [128, 255]]]
    assert np.array_equal(picture_of(api.get(f"/maps/{env}/satellite").content).pixels, heights)


def test_floor_plan_is_placed_by_options(api: Api, fresh: Callable[[], str]) -> None:
    env = environment(api, fresh())
    out = io.BytesIO()
    Image.new("RGB", (40, 30), (1, 2, 3)).save(out, "PNG")
    refused = api.upload(env, {"plan.png": out.getvalue()}, expect=422).json()
    assert "metres_per_pixel" in refused["errors"][0]["problem"]
    api.upload(env, {"plan.png": out.getvalue()}, metres_per_pixel="0.1", origin="1,2", yaw="0")
    about = api.get(f"environments/{env}/versions/latest/layers/imagery", headers={"Accept": "application/json"}).json()
    assert about["crs"] == "local"
    assert about["transform"] == [0.1, 0.0, 1.0, 0.0, -0.1, 5.0]
    api.problem("GET", f"/maps/{env}/satellite?crs=wgs84", 422)


def test_damaged_tiles_return_422_with_the_reason(api: Api, fresh: Callable[[], str]) -> None:
    env = environment(api, fresh())
    data = geotiff(np.random.default_rng(0).integers(0, 255, (600, 600, 3), dtype=np.uint8))
    refused = api.upload(env, {"a.tif": data[: len(data) * 2 // 3]}, expect=422).json()
    assert refused["errors"][0]["file"] == "a.tif"
    assert "vsimem" not in str(refused)
    assert api.get(f"environments/{env}").json()["version"] == 0


def test_grid_is_served_as_an_image(api: Api) -> None:
    map_yaml = (
        b"image: map.pgm\nresolution: 0.1\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    cells = bytes(254 if k % 7 else 0 for k in range(200))
    api.post("environments", {"name": "drawn-plan"})
    api.upload("drawn-plan", {"map.yaml": map_yaml, "map.pgm": b"P5\n20 10\n255\n" + cells})
    rows = {row["format"]: row for row in api.get("environments/drawn-plan/versions/latest/maps").json()}
    assert [step["step"] for step in rows["satellite"]["chain"]] == ["occupancy_to_imagery"]
    assert api.get("/maps/drawn-plan/satellite/satellite.png").content[:4] == b"\x89PNG"
    report = api.get("environments/drawn-plan/versions/latest/reports/satellite?pixel=0.2").json()
    assert report["layers"][0]["information"] == "derived"
    assert report["layers"][0]["steps"][0]["parameters"]["pixel"] == 0.2
    assert any("not a photograph" in w["problem"] for w in report["warnings"])
