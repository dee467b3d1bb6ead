"""OGC API - Tiles and - Maps, WMTS and the QGIS layer definition: abstract tests, places, and independent readers.

Numbers of abstract tests are those of OGC 20-057 (Tiles) and OGC 20-058 (Maps).
"""

from __future__ import annotations

import io
import itertools
import json
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import pytest
from lxml import etree
from PIL import Image

from app.model.frame import Datum
from app.model.geodesy import local_frame
from tests import qgis
from tests.api.conftest import Api, create_farm, running, settings_for
from tests.api.samples import NODES, grid, tmap2

HERE = {"latitude": 53.2686, "longitude": -0.5245, "altitude": 0.0, "heading": 30.0}
FRAME = local_frame(Datum(53.2686, -0.5245, heading=30.0))
NAMES = (f"tiled-{k}" for k in itertools.count())
REL = "http://www.opengis.net/def/rel/ogc/1.0/"
MVT = "application/vnd.mapbox-vector-tile"
CRS84 = "http://www.opengis.net/def/crs/OGC/1.3/CRS84"


def grid_files() -> dict[str, bytes]:
    """Return a grid of 60 x 40 m round the nodes, with one block of walls from (20, 10) to (21, 11) m."""
    cells = np.full((400, 600), 254, np.uint8)
    cells[400 - 210 : 400 - 200, 300:310] = 0
    place = b"image: map.pgm\nresolution: 0.1\norigin: [-10, -10, 0]\n"
    meaning = b"negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    return {"map.yaml": place + meaning, "map.pgm": b"P5\n600 400\n255\n" + cells.tobytes()}


@pytest.fixture(scope="module")
def site(api: Api) -> str:
    return create_site(api)


@pytest.fixture(scope="module")
def open_site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Api, str]]:
    """Server that programs read without a token, and a site on it."""
    with running(settings_for(tmp_path_factory.mktemp("open"), anonymous_networks="127.0.0.1")) as api:
        yield api, create_site(api)


def create_site(api: Api) -> str:
    env = next(NAMES)
    api.post("environments", {"name": env, "title": "Tiled", "datum": HERE})
    api.upload(env, {"network.tmap2.yaml": tmap2()})
    api.upload(env, grid_files())
    return env


def get(api: Api, path: str, expect: int = 200) -> Any:
    return api.get(path, expect).json()


def links(document: Any, rel: str) -> list[dict[str, Any]]:
    return [link for link in document["links"] if link["rel"] == rel]


def tile_of(z: int, x: float, y: float) -> tuple[int, int]:
    """Return row and column of the tile of a Mercator point."""
    edge = 20037508.3427892
    return int((edge - y) / (2 * edge) * 2**z), int((x + edge) / (2 * edge) * 2**z)


def mercator(x: float, y: float) -> tuple[float, float]:
    """Convert local metres to Web Mercator by its formula."""
    ((longitude, latitude),) = FRAME.to_wgs84(np.array([[x, y]]))
    radius = 6378137.0
    return radius * np.radians(longitude), radius * np.log(np.tan(np.pi / 4 + np.radians(latitude) / 2))


def program(name: str, *arguments: str) -> str:
    path = shutil.which(name)
    if path is None:
        pytest.skip(f"{name} is not installed")
    done = subprocess.run([path, *arguments], capture_output=True, text=True, check=True, timeout=300)
    return done.stdout


# --- tile matrix sets ---


def test_tile_matrix_sets(api: Api, site: str) -> None:
    """Each listed set is defined, with levels that halve."""
    listed = get(api, f"/ogc/{site}/tileMatrixSets")
    assert [one["id"] for one in listed["tileMatrixSets"]] == ["WebMercatorQuad", "local"]
    for one in listed["tileMatrixSets"]:
        (own,) = one["links"]
        defined = get(api, own["href"].removeprefix(api.url))
        assert (defined["id"], defined["uri"], defined["crs"]) == (one["id"], one["uri"], one["crs"])
        cells = [matrix["cellSize"] for matrix in defined["tileMatrices"]]
        assert all(a == 2 * b for a, b in itertools.pairwise(cells))
        for z, matrix in enumerate(defined["tileMatrices"]):
            assert (matrix["id"], matrix["matrixWidth"], matrix["tileWidth"]) == (str(z), 2**z, 256)
            assert matrix["scaleDenominator"] == pytest.approx(matrix["cellSize"] / 0.00028)
    quad = get(api, f"/ogc/{site}/tileMatrixSets/WebMercatorQuad")
    assert quad["tileMatrices"][0]["scaleDenominator"] == pytest.approx(559082264.028717, rel=1e-9)
    assert "unknown tile matrix set 'lokal'" in api.problem("GET", f"/ogc/{site}/tileMatrixSets/lokal", 404)["detail"]


# --- tilesets ---


@pytest.mark.parametrize("kind", ["vector", "map"])
def test_abstract_test_of_tilesets(api: Api, site: str, kind: str) -> None:
    """A.3 to A.5: links to lists of tilesets, lists with links to tilesets, tilesets with a template of tiles."""
    sources = [get(api, f"/ogc/{site}/")]
    collections = get(api, f"/ogc/{site}/collections")["collections"]
    sources += [one for one in collections if kind == "map" or one["id"] in ("nodes", "edges")]
    assert len(sources) == (4 if kind == "map" else 3)
    for source in sources:
        (found,) = links(source, f"{REL}tilesets-{kind}")
        listed = get(api, found["href"].removeprefix(api.url))
        assert len(listed["tilesets"]) == 2
        for item in listed["tilesets"]:
            assert item["dataType"] == kind
            (own,) = links(item, "self")
            tileset = get(api, own["href"].removeprefix(api.url))
            assert {"title", "dataType", "crs", "tileMatrixSetURI", "links", "boundingBox"} <= set(tileset)
            (scheme,) = links(tileset, f"{REL}tiling-scheme")
            assert get(api, scheme["href"].removeprefix(api.url))["uri"] == tileset["tileMatrixSetURI"]
            (template,) = links(tileset, "item")
            assert template["templated"] is True
            limits = tileset["tileMatrixSetLimits"][18]
            href = template["href"].removeprefix(api.url)
            href = href.replace("{tileMatrix}", "18").replace("{tileRow}", str(limits["minTileRow"]))
            answer = api.get(href.replace("{tileCol}", str(limits["minTileCol"])), None)
            assert answer.status_code in (200, 204)
            assert answer.status_code == 204 or answer.headers["content-type"] == template["type"]


def test_conformance_and_api(api: Api, site: str) -> None:
    classes = get(api, f"/ogc/{site}/conformance")["conformsTo"]
    tiles, maps = ("http://www.opengis.net/spec/ogcapi-" + name + "-1/1.0/conf/" for name in ("tiles", "maps"))
    assert {tiles + name for name in ("core", "tileset", "tilesets-list", "mvt", "png")} <= set(classes)
    assert {maps + name for name in ("core", "dataset-map", "collection-map", "crs", "tilesets")} <= set(classes)
    paths = get(api, f"/ogc/{site}/api")["paths"]
    names = {item["get"]["operationId"] for item in paths.values()}
    assert {"dataset.vector.getTile", "dataset.map.getTileSet", "edges.collection.vector.getTile"} <= names
    assert "/collections/grid-map/map" in paths
    assert "/collections/grid-map/tiles" not in paths


# --- vector tiles ---


def read_tile(path: Path, data: bytes, z: int, row: int, column: int) -> dict[str, list[dict[str, Any]]]:
    """Read a tile in Web Mercator with GDAL: features by layer."""
    folder = path / str(z) / str(column)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{row}.mvt").write_bytes(data)
    out: dict[str, list[dict[str, Any]]] = {}
    file = str(folder / f"{row}.mvt")
    for line in program("ogrinfo", "-q", file).splitlines():
        name = line.split(": ", 1)[1].split(" ")[0]
        text = program("ogr2ogr", "-f", "GeoJSON", "-t_srs", "EPSG:3857", "/vsistdout/", file, name)
        out[name] = json.loads(text)["features"]
    return out


def test_gdal_reads_nodes_where_they_are(api: Api, site: str, tmp_path: Path) -> None:
    z = 19
    row, column = tile_of(z, *mercator(5.0, 4.0))
    seen: dict[str, Any] = {}
    edges: set[tuple[str, str]] = set()
    for r, c in itertools.product((row - 1, row, row + 1), (column - 1, column, column + 1)):
        answer = api.get(f"/ogc/{site}/tiles/WebMercatorQuad/{z}/{r}/{c}", None)
        if answer.status_code == 204:
            assert answer.content == b""
            continue
        assert answer.headers["content-type"] == MVT
        layers = read_tile(tmp_path, answer.content, z, r, c)
        seen |= {f["properties"]["id"]: f["geometry"]["coordinates"] for f in layers.get("nodes", [])}
        edges |= {(f["properties"]["source"], f["properties"]["target"]) for f in layers.get("edges", [])}
    unit = 2 * 20037508.3427892 / 2**z / 4096
    assert set(seen) == set(NODES)
    for name, place in NODES.items():
        assert np.abs(np.array(seen[name]).ravel()[:2] - mercator(*place)).max() <= unit
    assert edges == {("gate", "barn"), ("barn", "gate"), ("barn", "field")}


def test_vector_tiles_in_the_local_frame(api: Api, site: str) -> None:
    """Level 12 has tiles of 64 m: the content is in the tile whose lower left corner is the datum."""
    data = api.get(f"/ogc/{site}/collections/nodes/tiles/local/12/2047/2048").content
    assert b"nodes" in data
    assert b"edges" not in data
    assert api.get(f"/ogc/{site}/tiles/local/12/0/0", 204).content == b""


def test_tiles_are_immutable_and_revalidated(api: Api, site: str) -> None:
    path = f"/ogc/{site}/versions/2/tiles/local/12/2047/2048"
    answer = api.get(path)
    assert "immutable" in answer.headers["cache-control"]
    assert api.get(path, 304, headers={"If-None-Match": answer.headers["etag"]}).content == b""
    other = api.get(f"/ogc/{site}/versions/2/collections/nodes/tiles/local/12/2047/2048")
    assert other.headers["etag"] != answer.headers["etag"]


@pytest.mark.parametrize(
    ("path", "status", "text"),
    [
        ("tiles/local/21/0/0", 404, "no level 21"),
        ("tiles/local/2/4/0", 404, "rows and columns are 0 to 3"),
        ("tiles/local/-1/0/0", 400, ""),
        ("tiles/local/1/a/0", 400, ""),
        ("tiles/none/1/0/0", 404, "unknown tile matrix set"),
        ("collections/grid-map/tiles/local/1/0/0", 404, "has no vector tiles"),
        ("collections/grid-map/tiles", 404, "has no vector tiles"),
        ("collections/nothing/map/tiles/local/1/0/0", 404, "unknown collection"),
        ("map?bbox=1,2,3", 400, "four numbers"),
        ("map?bbox=1,2,1,3", 400, "minimum below its maximum"),
        ("map?bbox=nan,2,1,3", 400, "four numbers"),
        ("map?bbox=1_0,2,11,3", 400, "four numbers"),
        ("map?bbox=1e300,2,2e300,3", 400, "four numbers"),
        ("map?bbox=0,0,1e-300,1e-300", 400, "too small"),
        ("map?bbox=-1,89,1,90&crs=%5BEPSG:3857%5D", 400, "outside the area"),
        ("map?bbox-crs=%5BEPSG:3857%5D", 400, "no effect without bbox"),
        ("map?crs=%5BEPSG:27700%5D", 400, "unknown crs"),
        ("map?width=2049", 400, ""),
        ("map?width=0", 400, ""),
        ("map?bgcolor=greenish", 400, "unknown bgcolor"),
        ("map?colour=red", 400, ""),
        ("collections/nothing/map", 404, "unknown collection"),
    ],
)
def test_wrong_requests_are_refused(api: Api, site: str, path: str, status: int, text: str) -> None:
    assert text in api.problem("GET", f"/ogc/{site}/{path}", status)["detail"]


# --- maps ---


def picture(answer: Any) -> Any:
    assert answer.headers["content-type"] == "image/png"
    return np.asarray(Image.open(io.BytesIO(answer.content)).convert("RGBA")).astype(int)


def wall(pixels: Any) -> tuple[float, float]:
    """Return the middle (column, row) of the dark pixels."""
    rows, columns = np.nonzero((pixels[..., :3].max(axis=-1) < 110) & (pixels[..., 3] > 128))
    assert len(rows)
    return float(columns.mean()) + 0.5, float(rows.mean()) + 0.5


def test_map_shows_the_wall_where_it_is(api: Api, site: str) -> None:
    """Maps core: PNG, Content-Bbox and Content-Crs; the place follows from them, in every CRS and size."""
    (uri,) = [one for one in get(api, f"/ogc/{site}/")["crs"] if one.endswith("/crs/local")]
    ((longitude, latitude),) = FRAME.to_wgs84(np.array([[20.5, 10.5]]))
    places = {
        None: (longitude, latitude),
        "[EPSG:4326]": (latitude, longitude),
        "[EPSG:3857]": mercator(20.5, 10.5),
        "https://www.opengis.net/def/crs/EPSG/0/3857": mercator(20.5, 10.5),
        uri: (20.5, 10.5),
    }
    for crs, place in places.items():
        for size in ({}, {"width": 700}, {"width": 900, "height": 300}):
            parameters = {**size, **({} if crs is None else {"crs": crs})}
            answer = api.get(f"/ogc/{site}/collections/grid-map/map", params=parameters)
            box = [float(word) for word in answer.headers["content-bbox"].split(",")]
            u, v = ((place[k] - box[k]) / (box[k + 2] - box[k]) for k in (0, 1))
            if crs == "[EPSG:4326]":
                u, v = v, u
            pixels = picture(answer)
            for name, value in size.items():
                assert pixels.shape[("height", "width").index(name)] == value
            assert wall(pixels) == pytest.approx((u * pixels.shape[1], (1 - v) * pixels.shape[0]), abs=1.5)
            assert answer.headers["content-crs"].startswith("<http")


def test_map_of_a_box_with_a_background(api: Api, site: str) -> None:
    (uri,) = [one for one in get(api, f"/ogc/{site}/")["crs"] if one.endswith("/crs/local")]
    query = {"bbox": "19,9,22,12", "bbox-crs": uri, "crs": uri, "width": "300", "height": "300"}
    answer = api.get(f"/ogc/{site}/collections/grid-map/map", params=query)
    assert answer.headers["content-bbox"] == "19.0,9.0,22.0,12.0"
    assert wall(picture(answer)) == pytest.approx((150, 150), abs=1.0)
    empty = {**query, "bbox": "-90,-90,-80,-80"}
    assert (picture(api.get(f"/ogc/{site}/map", params=empty))[..., 3] == 0).all()
    red = picture(api.get(f"/ogc/{site}/map", params={**empty, "bgcolor": "0xFF0010"}))
    assert (red == [255, 0, 16, 255]).all()
    white = picture(api.get(f"/ogc/{site}/map", params={**empty, "bgcolor": "red", "transparent": "true"}))
    assert (white[..., 3] == 0).all()
    assert (picture(api.get(f"/ogc/{site}/map", params={**empty, "transparent": "false"})) == 255).all()
    assert api.get(f"/ogc/{site}/map", 304, params=query, headers={"If-None-Match": etag(api, site, query)})


def etag(api: Api, site: str, query: dict[str, str]) -> str:
    return str(api.get(f"/ogc/{site}/map", params=query).headers["etag"])


def test_site_without_a_datum_has_none(api: Api) -> None:
    env = next(NAMES)
    api.post("environments", {"name": env})
    api.upload(env, grid_files())
    for path in ("map", "tiles", "map/tiles/local/0/0/0", "tiles/WebMercatorQuad/0/0/0", "collections/grid-map/map",
                 "wmts/1.0.0/WMTSCapabilities.xml", "layers.qlr", "tileMatrixSets/local"):  # fmt: skip
        assert "datum" in api.problem("GET", f"/ogc/{env}/{path}", 404)["detail"]
    assert not [link for link in get(api, f"/ogc/{env}/")["links"] if "tile" in link["href"].rpartition("/")[2]][1:]


def test_a_feature_far_away_does_not_hide_the_others_in_the_local_frame(api: Api, farm: str) -> None:
    places = {"tree": (-0.52449, 53.26859), "far": (-170.0, -50.0), "pole": (0.0, 90.0)}
    trees = [
        {"type": "Feature", "id": name, "properties": {"kind": "tree"},
         "geometry": {"type": "Point", "coordinates": list(at)}}
        for name, at in places.items()
    ]  # fmt: skip
    api.upload(farm, {"o.geojson": json.dumps({"type": "FeatureCollection", "features": trees}).encode()})
    base = f"/ogc/{farm}/collections/objects-points"
    local = f"{api.url}/ogc/{farm}/crs/local"
    shown = {one["id"]: one for one in api.get(f"{base}/items?f=jsonfg").json()["features"]}
    assert shown["tree"]["place"]["coordinates"] == pytest.approx([0.67, -1.11], abs=0.01)
    assert shown["far"]["place"] is None
    assert shown["far"]["geometry"]["coordinates"] == [-170, -50]
    rows = api.get(f"{base}/items?crs={local}").json()["features"]
    assert {one["id"] for one in rows if one["geometry"] is None} >= {"far"}
    near = api.get(f"{base}/items?bbox=-5,-5,5,5&bbox-crs={local}").json()["features"]
    assert [one["id"] for one in near] == ["tree"]
    assert b"tree" in api.get(f"{base}/tiles/local/9/256/256").content
    api.get(f"{base}/map/tiles/local/9/256/256")


# --- programs ---


def test_gdal_opens_the_wmts_document(open_site: tuple[Api, str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GDAL_ENABLE_WMS_CACHE", "NO")
    api, site = open_site
    url = f"{api.url}/ogc/{site}/wmts/1.0.0/WMTSCapabilities.xml"
    root = etree.fromstring(api.get(url.removeprefix(api.url)).content)
    names = {"w": "http://www.opengis.net/wmts/1.0", "o": "http://www.opengis.net/ows/1.1"}
    layers = root.xpath("w:Contents/w:Layer/o:Identifier/text()", namespaces=names)
    assert layers == ["site", "grid-map", "nodes", "edges"]
    info = json.loads(program("gdalinfo", "-json", f"WMTS:{url},layer=grid-map"))
    extent = np.array(info["wgs84Extent"]["coordinates"][0])
    corners = FRAME.to_wgs84(np.array([[-10.0, -10.0], [50.0, -10.0], [50.0, 30.0], [-10.0, 30.0]]))
    assert np.abs(extent.min(axis=0) - corners.min(axis=0)).max() < 1e-6
    assert np.abs(extent.max(axis=0) - corners.max(axis=0)).max() < 1e-6
    x, y = mercator(20.5, 10.5)
    values = program("gdallocationinfo", "-xml", "-geoloc", f"WMTS:{url},layer=grid-map", f"{x:.3f}", f"{y:.3f}")
    shades = [int(value.text) for value in etree.fromstring(values).iter("Value")]
    assert len(shades) == 4
    assert max(shades[:3]) < 110, "the wall is dark where geodesy says"


OPEN = """
project = QgsProject.instance()
done, problem = QgsLayerDefinition.loadLayerDefinition(sys.argv[1], project, project.layerTreeRoot())
rows = []
for layer in project.layerTreeRoot().layerOrder():
    to = QgsCoordinateTransform(layer.crs(), QgsCoordinateReferenceSystem("EPSG:4326"), project)
    box = to.transformBoundingBox(layer.extent())
    rows.append({"name": layer.name(), "valid": layer.isValid(), "crs": layer.crs().isValid(),
                 "renderer": type(layer.renderer()).__name__,
                 "box": [box.xMinimum(), box.yMinimum(), box.xMaximum(), box.yMaximum()]})
answer({"done": done, "problem": problem, "rows": rows})
"""


def test_qgis_opens_the_layer_definition(open_site: tuple[Api, str], tmp_path: Path) -> None:
    api, site = open_site
    answer = api.get(f"/ogc/{site}/versions/3/layers.qlr")
    assert answer.headers["content-type"] == "application/x-qgis-layer-definition"
    assert answer.content.count(f"/ogc/{site}/versions/3/".encode()) >= 3
    assert api.token is not None
    assert api.token.encode() not in answer.content
    (tmp_path / "site.qlr").write_bytes(answer.content)
    result = qgis.run(OPEN, tmp_path / "site.qlr", folder=tmp_path)
    assert (result["done"], result["problem"]) == (True, "")
    assert [row["name"] for row in result["rows"]] == ["Nodes", "Edges", "Grid map"]
    assert [row["renderer"] for row in result["rows"]][:2] == ["QgsSingleSymbolRenderer", "QgsRuleBasedRenderer"]
    places = FRAME.to_wgs84(np.array(list(NODES.values())))
    for row in result["rows"]:
        assert row["valid"]
        assert row["crs"]
        west, south, east, north = row["box"]
        if row["name"] == "Nodes":
            found = np.array([[west, south], [east, north]])
            assert np.abs(found - [places.min(axis=0), places.max(axis=0)]).max() < 1e-8


def test_qgis_opens_grids_of_levels_with_a_space(open_site: tuple[Api, str], tmp_path: Path) -> None:
    api, _ = open_site
    env = create_farm(api, "floors")
    api.upload(env, grid(), level="first floor & é")
    definition = api.get(f"/ogc/{env}/layers.qlr").content
    sources = [text for text in etree.fromstring(definition).xpath("//datasource/text()") if "tileMatrixSet" in text]
    layers = [unquote(dict(pair.split("=", 1) for pair in source.split("&"))["layers"]) for source in sources]
    assert "grid-map@first floor & é" in layers, "unquoted as Qt does, to which + is no space"
    (tmp_path / "site.qlr").write_bytes(definition)
    result = qgis.run(OPEN, tmp_path / "site.qlr", folder=tmp_path)
    assert all(row["valid"] for row in result["rows"])
    assert any("first floor" in row["name"] for row in result["rows"])
