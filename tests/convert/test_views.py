"""Pictures of boxes of a CRS: place and transparency by facts about pixels, on a site with a heading."""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from PIL import Image

from app.convert.cache import Cache
from app.convert.painting import THEMES
from app.convert.tiles import Tiles
from app.convert.views import MAX_SIDE, View, ViewContent, Views, view_key
from app.model.features import features
from app.model.frame import Datum
from app.model.geodesy import WGS84, between, local_frame
from app.model.grid import OccupancyGrid
from app.model.imagery import GeoImage
from app.model.layers import Part, PartKey
from app.store.store import Store
from app.store.values import Version
from tests.store.samples import replaces, save

HERE = Datum(53.2686, -0.5245, heading=37.5)
FRAME = local_frame(HERE)
LIGHT = THEMES["light"]
GRID = PartKey("occupancy", "ground", "map")
IMAGE = PartKey("imagery", "ground", "satellite")
NETWORK = PartKey("topology", "ground", "network")
CRSS = ["local", "EPSG:3857", "EPSG:4326", "EPSG:32630"]


class Site:
    """Store whose environments are drawn."""

    def __init__(self, folder: Path) -> None:
        self.store = Store(f"sqlite:///{folder / 'db.sqlite'}", folder / "blobs")
        self.store.migrate()
        self.views = Views(self.store, Tiles(self.store, Cache(folder / "cache", 2**30)))
        self.count = 0

    def version(self, parts: dict[PartKey, Part]) -> Version:
        self.count += 1
        self.store.environments.create(f"site-{self.count}")
        return save(self.store, f"site-{self.count}", *replaces(parts), datum=HERE)

    def draw(self, version: Version, view: View, background: Any = None, types: Any = None) -> Any:
        png = self.views.png(version, ViewContent(version.parts, types), view, background)
        return np.asarray(Image.open(io.BytesIO(png)).convert("RGBA")).astype(int)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Site:
    return Site(tmp_path_factory.mktemp("views"))


def place(crs: str, *points: tuple[float, float]) -> Any:
    """Convert local metres to coordinates of a CRS, x first, independently of the drawing."""
    local = np.array(points, float)
    return local if crs == "local" else between(WGS84, crs, FRAME.to_wgs84(local))


def view_around(crs: str, point: tuple[float, float], metres: float, size: int = 200) -> View:
    """Return a view of some metres around a local point, square on the ground."""
    x, y = place(crs, point)[0].tolist()
    scale = 1.0
    if crs == "EPSG:3857":
        scale = 1 / math.cos(math.radians(HERE.latitude))
    dx = dy = metres / 2 * scale
    if crs == "EPSG:4326":
        dx, dy = dx / (111_320 * math.cos(math.radians(HERE.latitude))), dy / 111_320
    return View(crs, (x - dx, y - dy, x + dx, y + dy), size, size)


def blob(mask: Any) -> tuple[float, float]:
    rows, columns = np.nonzero(mask)
    assert len(rows)
    return float(columns.mean()) + 0.5, mask.shape[0] - float(rows.mean()) - 0.5


def occupied(pixels: Any) -> Any:
    return (np.abs(pixels[..., :3] - np.array(LIGHT.occupied)) <= 40).all(axis=-1) & (pixels[..., 3] > 128)


@pytest.mark.parametrize("crs", CRSS)
@pytest.mark.parametrize("metres", [3.0, 30.0, 60.0])
def test_a_cell_of_a_turned_grid_is_where_it_is_on_earth(site: Site, crs: str, metres: float) -> None:
    cells = np.zeros((800, 600), np.uint8)
    cells[500:510, 400:410] = 100
    grid = OccupancyGrid(cells, 0.05, (400.0, -300.0, 0.4))
    c, s = math.cos(0.4), math.sin(0.4)
    middle = (400 + c * 20.25 - s * 25.25, -300 + s * 20.25 + c * 25.25)
    view = view_around(crs, (middle[0] + metres / 5, middle[1] - metres / 9), metres)
    pixels = site.draw(site.version({GRID: grid}), view)
    expected = view.to_pixels(place(crs, middle))[0]
    assert np.abs(np.array(blob(occupied(pixels))) - expected).max() < 1.0
    assert (pixels[..., 3] > 0).any()


@pytest.mark.parametrize("crs", CRSS)
def test_a_node_is_where_it_is_on_earth(site: Site, crs: str) -> None:
    nodes = [(name, shapely.Point(x, 75), {"kind": "node"}) for name, x in (("a", 120), ("b", 190))]
    edge = ("e", shapely.LineString([(120, 75), (190, 75)]), {"kind": "edge"})
    part = features([*nodes, edge], "local")
    version = site.version({NETWORK: part})
    view = view_around(crs, (125.0, 70.0), 40.0)
    pixels = site.draw(version, view, types=frozenset({0}))
    expected = view.to_pixels(place(crs, (120.0, 75.0)))[0]
    assert np.abs(np.array(blob(pixels[..., 3] > 200)) - expected).max() < 1.0
    lines = site.draw(version, view, types=frozenset({1}))
    assert (lines[..., 3] > 200).sum() > (pixels[..., 3] > 200).sum()


def test_background_and_transparency(site: Site) -> None:
    cells = np.full((100, 100), 255, np.uint8)
    cells[:50] = 0
    version = site.version({GRID: OccupancyGrid(cells, 0.1)})
    view = View("local", (-5.0, -5.0, 15.0, 15.0), 100, 100)
    clear = site.draw(version, view)
    assert (clear[10:20, 10:20, 3] == 0).all()
    assert (clear[30:45, 30:70, 3] == 0).all(), "unknown cells are transparent"
    assert (clear[55:70, 30:70] == [*LIGHT.free, 255]).all()
    blue = site.draw(version, view, (0, 0, 255))
    assert (blue[10:20, 10:20] == [0, 0, 255, 255]).all()
    assert (blue[55:70, 30:70] == [*LIGHT.free, 255]).all()


def test_an_image_in_utm_is_placed_in_the_local_frame(site: Site) -> None:
    (x, y) = place("EPSG:32630", (50.0, 50.0))[0]
    pixels = np.zeros((40, 40, 3), np.uint8)
    pixels[18:22, 18:22] = (255, 0, 0)
    version = site.version({IMAGE: GeoImage(pixels, (0.5, 0.0, x - 10, 0.0, -0.5, y + 10), "EPSG:32630")})
    view = View("local", (30.0, 30.0, 70.0, 70.0), 160, 160)
    shown = site.draw(version, view)
    assert np.abs(np.array(blob(shown[..., 0] > 200)) - (80.0, 80.0)).max() < 1.0


def test_neighbouring_tiles_join(site: Site) -> None:
    """Two halves drawn alone are the whole picture: width of lines and cells do not depend on the box."""
    cells = (np.random.default_rng(3).random((400, 400)) < 0.1).astype(np.uint8) * 100
    edges = [(str(k), shapely.LineString([(k, 0), (k + 9, 40)]), {"kind": "edge"}) for k in range(0, 30, 3)]
    part = features(edges, "local")
    version = site.version({GRID: OccupancyGrid(cells, 0.1, (0, 0, 0.3)), NETWORK: part})
    whole = site.draw(version, View("local", (0, 0, 40, 40), 512, 512))
    left = site.draw(version, View("local", (0, 0, 20, 40), 256, 512))
    right = site.draw(version, View("local", (20, 0, 40, 40), 256, 512))
    off = np.abs(np.concatenate([left, right], axis=1) - whole)
    assert (off.max(axis=-1) > 40).mean() < 0.002


def test_a_huge_grid_is_read_in_pieces(site: Site) -> None:
    cells = np.zeros((9000, 9000), np.uint8)
    cells[4500, :] = 100
    version = site.version({GRID: OccupancyGrid(cells, 0.05, (0, 0, 0.0))})
    for metres in (1.0, 450.0, 4000.0):
        view = View("local", (225 - metres / 2, 225.025 - metres / 2, 225 + metres / 2, 225.025 + metres / 2), 256, 256)
        pixels = site.draw(version, view)
        assert pixels[..., :3].min() < 180, "a wall one cell wide stays visible"
        assert (pixels[..., 3] > 0).any()
    far = site.draw(version, View("EPSG:3857", (-2e7, -2e7, 2e7, 2e7), MAX_SIDE, 16))
    assert far.shape == (16, MAX_SIDE, 4)


def test_the_key_depends_on_what_is_shown(site: Site) -> None:
    version = site.version({GRID: OccupancyGrid(np.zeros((5, 5), np.uint8), 0.1)})
    content, view = ViewContent(version.parts), View("local", (0, 0, 1, 1), 10, 10)
    keys = {
        view_key(version, content, view, None),
        view_key(version, content, view, (1, 2, 3)),
        view_key(version, ViewContent(version.parts, frozenset({0})), view, None),
        view_key(version, content, View("EPSG:3857", view.box, 10, 10), None),
        view_key(version, ViewContent([]), view, None),
    }
    assert len(keys) == 5
