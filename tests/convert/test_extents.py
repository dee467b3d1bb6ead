"""Bounding boxes of parts in both frames, against PROJ by hand."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from pyproj import Proj

from app.convert.cache import Cache
from app.convert.extents import bounds_in_both_frames
from app.convert.tiles import Tiles
from app.model.features import features
from app.model.frame import Datum
from app.model.grid import OccupancyGrid
from app.model.imagery import GeoImage
from app.model.layers import Layer, Part, PartKey
from app.store.store import Store
from app.store.values import Bounds
from tests.store.samples import replaces, save


class Extents:
    def __init__(self, folder: Path) -> None:
        self.store = Store(f"sqlite:///{folder / 'db.sqlite'}", folder / "blobs")
        self.store.migrate()
        self.tiles = Tiles(self.store, Cache(folder / "cache", 2**30))
        self.count = 0

    def __call__(self, layer: Layer, part: Part, datum: Datum | None) -> Bounds:
        self.count += 1
        self.store.environments.create(f"site-{self.count}")
        key = PartKey(layer, "ground", "map")
        entry = save(self.store, f"site-{self.count}", *replaces({key: part}), datum=datum).part(key)
        assert entry is not None
        return bounds_in_both_frames(entry, datum, self.tiles.header)


@pytest.fixture(scope="module")
def extents(tmp_path_factory: pytest.TempPathFactory) -> Extents:
    return Extents(tmp_path_factory.mktemp("extents"))


def on_earth(points: Any, datum: Datum) -> np.ndarray[Any, Any]:
    """Convert local metres to degrees, independently."""
    h = math.radians(datum.heading)
    x, y = np.asarray(points, float).T
    east, north = x * math.cos(h) + y * math.sin(h), y * math.cos(h) - x * math.sin(h)
    proj = Proj(f"+proj=tmerc +lat_0={datum.latitude} +lon_0={datum.longitude} +k=1 +ellps=WGS84")
    return np.column_stack(proj(east, north, inverse=True))


@pytest.mark.parametrize("heading", [0.0, 30.0, 200.0])
def test_a_turned_grid_has_the_box_of_its_corners(extents: Extents, heading: float) -> None:
    datum = Datum(53.2, -0.5, heading=heading)
    grid = OccupancyGrid(np.zeros((300, 500), np.uint8), 0.2, (10.0, -20.0, 0.7))
    bounds = extents("occupancy", grid, datum)
    corners = on_earth(grid.corners(), datum)
    west, south, east, north = bounds["wgs84"] or (0, 0, 0, 0)
    assert (west, south) == pytest.approx(tuple(corners.min(axis=0)), abs=1e-9)
    assert (east, north) == pytest.approx(tuple(corners.max(axis=0)), abs=1e-9)
    assert bounds["local"] == pytest.approx((*grid.corners().min(axis=0), *grid.corners().max(axis=0)))


@pytest.mark.parametrize("heading", [0.0, 30.0])
def test_features_are_inside_their_box(extents: Extents, heading: float) -> None:
    datum = Datum(53.2, -0.5, heading=heading)
    points = np.random.default_rng(1).uniform(-300, 300, (200, 2))
    part = features([(str(k), shapely.Point(p), {"kind": "node"}) for k, p in enumerate(points)], "local")
    west, south, east, north = extents("topology", part, datum)["wgs84"] or (0, 0, 0, 0)
    lonlat = on_earth(points, datum)
    assert (lonlat >= (west, south)).all()
    assert (lonlat <= (east, north)).all()
    if not heading:
        assert (west, south) == pytest.approx(tuple(lonlat.min(axis=0)), abs=1e-6)  # meridians converge


def test_degrees_become_metres(extents: Extents) -> None:
    datum = Datum(53.2, -0.5)
    part = features([("f", shapely.box(-0.501, 53.199, -0.499, 53.201), {})], "wgs84")
    bounds = extents("location", part, datum)
    assert bounds["wgs84"] == (-0.501, 53.199, -0.499, 53.201)
    x0, y0, x1, y1 = bounds["local"] or (0, 0, 0, 0)
    assert (x1 - x0, y1 - y0) == pytest.approx((133.6, 222.6), abs=0.2)
    assert extents("location", part, None) == {"local": None, "wgs84": (-0.501, 53.199, -0.499, 53.201)}


def test_boxes_cross_the_antimeridian(extents: Extents) -> None:
    datum = Datum(-16.8, 179.9999)
    grid = OccupancyGrid(np.zeros((100, 1000), np.uint8), 0.1)
    part = features([("n", shapely.LineString([(-50, 0), (50, 0)]), {})], "local")
    image = GeoImage(np.zeros((10, 10, 3), np.uint8), (1e-5, 0.0, 179.99995, 0.0, -1e-5, -16.8), "EPSG:4326")
    for layer, value in (("occupancy", grid), ("objects", part), ("imagery", image)):
        west, _, east, _ = extents(layer, value, datum)["wgs84"] or (0, 0, 0, 0)  # type: ignore[arg-type]
        assert 179.99 < west <= 180.0, layer
        assert -180.0 <= east < -179.99, layer


def test_an_image_in_another_crs(extents: Extents) -> None:
    datum = Datum(53.2, -0.5, heading=45.0)
    image = GeoImage(np.zeros((100, 100, 3), np.uint8), (1.0, 0.0, 666_000.0, 0.0, -1.0, 5_897_000.0), "EPSG:32630")
    bounds = extents("imagery", image, datum)
    west, south, east, north = bounds["wgs84"] or (0, 0, 0, 0)
    corners = [(666_000.0 + a, 5_897_000.0 - b) for a in (0, 100) for b in (0, 100)]
    lonlat = np.array([Proj("EPSG:32630")(*corner, inverse=True) for corner in corners])
    assert (west, south, east, north) == pytest.approx((*lonlat.min(axis=0), *lonlat.max(axis=0)), abs=1e-9)
    x0, y0, x1, y1 = bounds["local"] or (0, 0, 0, 0)
    assert x1 - x0 == pytest.approx(141.4, abs=3.0)  # a square turned by 45°
    assert y1 - y0 == pytest.approx(141.4, abs=3.0)
