"""OGC API in independent clients: GDAL of pyogrio, GDAL's command line tools, QGIS. Counts, positions, attributes."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
import shapely

from tests import qgis
from tests.api.conftest import ADMIN, Api
from tests.api.ogc_sites import ON_EARTH

QGIS = """
url, password, sites = sys.argv[1], sys.argv[2], json.loads(sys.argv[3])
out = {site: {} for site in sites}
for site, name in [(site, name) for site, names in sites.items() for name in names]:
    source = f"url='{url}/ogc/{site}/' typename='{name}' username='any' password='{password}'"
    layer = QgsVectorLayer(source, name, "OAPIF")
    if not layer.isValid():
        out[site][name] = "invalid"
        continue
    features = list(layer.getFeatures())
    index = layer.fields().indexOf("level")
    points = [[vertex.x(), vertex.y()] for f in features for vertex in f.geometry().vertices()]
    levels = sorted({str(f.attributes()[index]) for f in features})
    out[site][name] = {"count": len(features), "crs": layer.crs().authid(), "levels": levels, "points": sorted(points)}
answer(out)
"""


GDAL = """
import json, sys
import pyogrio, shapely
url, utm, wanted = sys.argv[1:]
out = {}
for name in pyogrio.list_layers(url)[:, 0].tolist():
    if name not in wanted.split(","):
        continue
    meta, _, geometry, fields = pyogrio.raw.read(url, layer=name)
    levels = fields[meta["fields"].tolist().index("level")].tolist()
    points, projected = (
        sorted(shapely.get_coordinates([one for one in shapely.from_wkb(wkb) if one is not None]).tolist())
        for wkb in (geometry, pyogrio.raw.read(url, layer=name, CRS=utm)[2])
    )
    out[name] = {"count": len(geometry), "levels": sorted(levels), "points": points, "projected": projected}
print(json.dumps(out))
"""


def require(command: str, works: bool) -> None:
    """Skip a test whose program is missing; fail in CI, which installs it."""
    if not works:
        if os.environ.get("CI"):
            pytest.fail(f"{command} is missing")
        pytest.skip(f"{command} is missing")


@pytest.fixture(scope="module", params=ON_EARTH)
def site(request: pytest.FixtureRequest) -> str:
    return str(request.param)


RASTERS = {"grid": "occupancy", "image": "imagery", "voxels": "voxels"}


def outline(api: Api, url: str, name: str, level: str) -> dict[str, Any]:
    """Return the outline of a grid, image or voxel map by its description in the API of layers, placed by PROJ."""
    shown = api.get(url, params={"name": name, "level": level}, headers={"Accept": "application/json"}).json()
    steps = np.arange(9) / 9 if "voxels" not in url else np.zeros(1)
    zeros, ones = np.zeros_like(steps), np.ones_like(steps)
    u = np.concatenate([steps, ones, 1 - steps, zeros])
    v = np.concatenate([zeros, steps, ones, 1 - steps])
    crs = "local"
    if "voxels" in url:
        x0, y0, _, x1, y1, _ = shown["bounds"]
        x, y = x1 + (x0 - x1) * v, y0 + (y1 - y0) * u  # from the lower right corner, counterclockwise
    elif "imagery" in url:
        a, b, c, d, e, f = shown["transform"]
        column, row, crs = u * shown["width"], v * shown["height"], shown["crs"]
        x, y = a * column + b * row + c, d * column + e * row + f
    else:
        column, row = u * shown["width"] * shown["resolution"], v * shown["height"] * shown["resolution"]
        left, bottom, yaw = shown["origin"]
        x, y = np.cos(yaw) * column - np.sin(yaw) * row + left, np.sin(yaw) * column + np.cos(yaw) * row + bottom
    source = api.get(f"/ogc/{url.split('/')[1]}/crs/local").text if crs == "local" else crs
    degrees = pyproj.Transformer.from_crs(source, "OGC:CRS84", always_xy=True).transform(x, y)
    shape = shapely.geometry.mapping(shapely.Polygon(np.column_stack(degrees)))
    return {"geometry": shape, "properties": {"level": level}, "level": level}


def layer_features(api: Api, site: str, collection: str) -> list[dict[str, Any]]:
    """Return the features of a collection by the API of layers, which shares no code with the OGC API's pages."""
    word, _, place = collection.partition("-")
    if word in RASTERS:
        name, _, level = place.partition("@")
        return [outline(api, f"environments/{site}/versions/latest/layers/{RASTERS[word]}", name, level or "ground")]
    layer = {"nodes": "topology", "edges": "topology", "zones": "zones", "fence": "location"}.get(collection, "objects")
    listed = api.get(f"environments/{site}/versions/latest/layers/{layer}").json()["features"]
    families = {
        "objects-points": ("Point", "MultiPoint"),
        "objects-lines": ("LineString", "MultiLineString"),
        "objects-polygons": ("Polygon", "MultiPolygon"),
    }
    kind = {"nodes": "node", "edges": "edge"}.get(collection)
    out = []
    for feature in listed:
        shape = (feature["geometry"] or {}).get("type")
        if kind is not None:
            fits = feature["properties"]["kind"] == kind
        elif layer == "objects":
            others = [name for family in families.values() for name in family]
            fits = shape in families[collection] if collection in families else shape not in others
        else:
            fits = True
        out += [feature] if fits else []
    return out


def coordinates(features: list[dict[str, Any]]) -> Any:
    shapes = [shapely.geometry.shape(f["geometry"]) for f in features if f["geometry"]]
    return np.array(sorted(map(tuple, shapely.get_coordinates(shapes).tolist())))


def metres_apart(first: Any, second: Any) -> float:
    """Return the maximum distance of two sorted lists of positions in degrees."""
    assert first.shape == second.shape
    if not len(first):
        return 0.0
    return float(np.max(pyproj.Geod(ellps="WGS84").inv(first[:, 0], first[:, 1], second[:, 0], second[:, 1])[2]))


def names_of(api: Api, site: str) -> list[str]:
    listed = api.get(f"/ogc/{site}/collections").json()["collections"]
    names = [one["id"] for one in listed]
    assert {"nodes", "edges"} <= set(names)
    return names


def test_gdal_opens_every_collection(ogc_sites: Api, site: str) -> None:
    """Read by GDAL in a process of its own, since it would block the server's threads."""
    names = names_of(ogc_sites, site)
    crs = ogc_sites.get(f"/ogc/{site}/collections/nodes").json()["crs"]
    utm = next(uri for uri in crs if "/EPSG/0/32" in uri)
    command = [sys.executable, "-W", "ignore", "-c", GDAL, f"OAPIF:{ogc_sites.url}/ogc/{site}", utm, ",".join(names)]
    env = {**os.environ, "GDAL_HTTP_USERPWD": f"any:{ADMIN}"}
    result = subprocess.run(command, env=env, capture_output=True, text=True, check=False, timeout=240)
    assert result.returncode == 0, result.stderr[-2000:]
    opened = json.loads(result.stdout.splitlines()[-1])
    assert list(opened) == names
    transformer = pyproj.Transformer.from_crs("OGC:CRS84", f"EPSG:{utm.rpartition('/')[2]}", always_xy=True)
    for name in names:
        expected = layer_features(ogc_sites, site, name)
        assert opened[name]["count"] == len(expected) > 0, name
        assert opened[name]["levels"] == sorted(f["level"] for f in expected)
        points = coordinates(expected)
        assert metres_apart(np.array(opened[name]["points"]), points) < 1e-3, name
        if not len(points):
            continue
        projected = np.array(opened[name]["projected"])
        again = np.column_stack(transformer.transform(points[:, 0], points[:, 1]))
        order = [np.lexsort(np.round(one, 3).T) for one in (projected, again)]
        assert np.abs(projected[order[0]] - again[order[1]]).max() < 2e-3, name


def test_gdalinfo_opens_every_geotiff(ogc_sites: Api, site: str) -> None:
    require("gdalinfo", shutil.which("gdalinfo") is not None)
    env = {**os.environ, "GDAL_HTTP_USERPWD": f"any:{ADMIN}", "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR"}
    for name in names_of(ogc_sites, site):
        if not name.startswith(("grid-", "image-")):
            continue
        (outline,) = ogc_sites.get(f"/ogc/{site}/collections/{name}/items").json()["features"]
        command = ["gdalinfo", "-json", f"/vsicurl/{outline['properties']['geotiff']}"]
        done = subprocess.run(command, env=env, capture_output=True, text=True, check=False, timeout=240)
        assert done.returncode == 0, done.stderr[-2000:]
        seen = json.loads(done.stdout)
        assert seen["size"] == [outline["properties"]["width"], outline["properties"]["height"]]
        corner = np.array([seen["wgs84Extent"]["coordinates"][0][0][:2]])
        ring = np.array(outline["geometry"]["coordinates"][0])
        assert min(metres_apart(np.array([point[:2]]), corner) for point in ring) < 0.01, name


def test_ogrinfo_counts_every_collection(ogc_sites: Api, site: str) -> None:
    require("ogrinfo", shutil.which("ogrinfo") is not None)
    env = {**os.environ, "GDAL_HTTP_USERPWD": f"any:{ADMIN}"}
    command = ["ogrinfo", "-so", "-al", f"OAPIF:{ogc_sites.url}/ogc/{site}/"]
    text = subprocess.run(command, env=env, capture_output=True, text=True, check=True, timeout=120).stdout
    counts: dict[str, int] = {}
    name = ""
    for line in text.splitlines():
        key, _, value = line.partition(": ")
        if key == "Layer name":
            name = value
        elif key == "Feature Count":
            counts[name] = int(value)
    names = names_of(ogc_sites, site)
    assert counts == {name: len(layer_features(ogc_sites, site, name)) for name in names}


def test_qgis_opens_every_collection(ogc_sites: Api, tmp_path: Path) -> None:
    """All sites in one process: it starts for more than a second."""
    sites = {site: [name for name in names_of(ogc_sites, site) if name != "objects-other"] for site in ON_EARTH}
    opened = qgis.run(QGIS, ogc_sites.url, ADMIN, json.dumps(sites), folder=tmp_path)
    for where in [(site, name) for site, names in sites.items() for name in names]:
        expected, seen = layer_features(ogc_sites, *where), opened[where[0]][where[1]]
        assert seen != "invalid", where
        assert seen["count"] == len(expected), where
        assert seen["crs"] in ("EPSG:4326", "OGC:CRS84"), where
        assert seen["levels"] == sorted({f["level"] for f in expected}), where
        assert metres_apart(np.array(seen["points"]), coordinates(expected)) < 1e-3, where
