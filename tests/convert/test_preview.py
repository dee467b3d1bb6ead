"""Pictures of sites, by facts about their pixels."""

from __future__ import annotations

import io
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from PIL import Image

from app.convert import tiles
from app.convert.cache import Cache
from app.convert.drawing import Canvas, fit_frame
from app.convert.painting import THEMES
from app.convert.preview import (
    ASPECT,
    PreviewRequest,
    Previews,
    parse_layers,
    preview_key,
)
from app.convert.tiles import Tiles
from app.errors import Invalid, NotFound
from app.model.areas import AREA_OPACITY
from app.model.features import features
from app.model.frame import Datum, Level
from app.model.grid import OccupancyGrid
from app.model.imagery import GeoImage
from app.model.layers import Part, PartKey
from app.store.store import Store
from app.store.values import Version
from tests.store.samples import replaces, save

LIGHT, DARK = THEMES["light"], THEMES["dark"]


class Site:
    """Store whose environments are drawn."""

    def __init__(self, folder: Path) -> None:
        self.store = Store(f"sqlite:///{folder / 'db.sqlite'}", folder / "blobs")
        self.store.migrate()
        cache = Cache(folder / "cache", 2**30)
        self.previews = Previews(self.store, Tiles(self.store, cache), cache)
        self.count = 0

    def version(self, parts: dict[PartKey, Part], **frame: Any) -> Version:
        self.count += 1
        self.store.environments.create(f"site-{self.count}")
        return save(self.store, f"site-{self.count}", *replaces(parts), **frame)

    def draw(self, parts: dict[PartKey, Part], frame: Any = None, **wanted: Any) -> np.ndarray[Any, Any]:
        return self.picture(self.version(parts, **(frame or {})), **wanted)

    def picture(self, version: Version, **wanted: Any) -> np.ndarray[Any, Any]:
        png = self.previews.png(version, PreviewRequest(**wanted))
        return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Site:
    return Site(tmp_path_factory.mktemp("previews"))


def near(pixels: np.ndarray[Any, Any], colour: Any, tolerance: int = 12) -> np.ndarray[Any, Any]:
    return np.asarray((np.abs(pixels - np.array(colour)) <= tolerance).all(axis=-1))


def middle(mask: np.ndarray[Any, Any]) -> tuple[float, float]:
    """Return the middle (column, row) of the chosen pixels as shares of the picture."""
    rows, columns = np.nonzero(mask)
    assert len(rows)
    return float(columns.mean() / mask.shape[1]), float(rows.mean() / mask.shape[0])


TOPOLOGY = PartKey("topology", "ground", "network")
OBJECTS = PartKey("objects", "ground", "site")
GRID = PartKey("occupancy", "ground", "map")


def room() -> OccupancyGrid:
    """Return free cells of 10 × 5 m with an obstacle in the *upper left* corner, in unknown surroundings."""
    cells = np.full((200, 200), 255, np.uint8)
    cells[50:100, 50:150] = 0
    cells[90:100, 50:60] = 100
    return OccupancyGrid(cells, 0.1)


def test_a_grid_is_upright_and_its_unknown_surroundings_are_cut_off(site: Site) -> None:
    pixels = site.draw({GRID: room()}, width=400)
    assert pixels.shape == (216, 400, 3)  # 10 × 5 m in 368 pixels, and a margin of 16 on each side
    walls = near(pixels, LIGHT.occupied)
    assert near(pixels, LIGHT.free)[20:196, 60:380].all()
    column, row = middle(walls)
    assert (column, row) == (pytest.approx(0.04 + 0.046, abs=0.01), pytest.approx((16 + 18.4) / 216, abs=0.01))
    assert walls.sum() == pytest.approx(36.8**2, rel=0.06)
    assert near(pixels[:14], LIGHT.background).all()


def test_a_turned_grid_is_drawn_turned(site: Site) -> None:
    cells = np.zeros((10, 100), np.uint8)
    cells[:, 90:] = 100
    pixels = site.draw({GRID: OccupancyGrid(cells, 0.1, (0.0, 0.0, np.pi / 2))}, width=200)
    column, row = middle(near(pixels, LIGHT.occupied))
    assert abs(column - 0.5) < 0.02  # 1 × 10 m standing upright in the middle
    assert row < 0.15  # its end is on top


def test_thin_walls_remain_visible_in_a_large_grid(site: Site) -> None:
    cells = np.zeros((3000, 3000), np.uint8)
    cells[:, 1500] = 100
    pixels = site.draw({GRID: OccupancyGrid(cells, 0.05)}, width=100)
    dark = pixels[10:-10, 10:-10].sum(axis=2).min(axis=1)
    assert (dark < 600).all()  # white is 762: the wall of one cell in 30 per pixel is seen in every row


def test_themes_and_levels_of_drawing(site: Site) -> None:
    nodes = [("a", shapely.Point(0, 0), {"kind": "node"}), ("b", shapely.Point(10, 4), {"kind": "node"})]
    edge = ("ab", shapely.LineString([(0, 0), (10, 4)]), {"kind": "edge", "source": "a", "target": "b"})
    areas = [("z", shapely.box(0, 0, 2, 4), {"kind": "keepout"}), ("r", shapely.box(8, 0, 10, 4), {"kind": "room"})]
    zone = features(areas, "local")
    parts: dict[PartKey, Part] = {
        TOPOLOGY: features([*nodes, edge], "local"),
        PartKey("zones", "ground", "zones"): zone,
        PartKey("location", "ground", "site"): features(
            [("f", shapely.box(-1, -1, 11, 5), {"kind": "fence"})], "local"
        ),
    }
    version = site.version(parts)
    for name, theme in THEMES.items():
        pixels = site.picture(version, theme=name, width=800)
        assert near(pixels[:10], theme.background).all()
        edge_mask, node_mask = near(pixels, theme.edge), near(pixels, theme.node)
        assert edge_mask.sum() > 600
        assert node_mask.sum() > 20
        columns = np.nonzero(edge_mask)[1]
        assert columns.min() / 800 == pytest.approx(0.04 + 0.92 / 12, abs=0.02)  # from (0, 0)
        tint = np.array(theme.background) * 0.8 + np.array(theme.keepout) * 0.2
        assert near(pixels, tint, 4).sum() > 0.05 * pixels[..., 0].size  # 2 × 4 of 12 × 6 m
        tint = np.array(theme.background) * (1 - AREA_OPACITY) + np.array(theme.area) * AREA_OPACITY
        assert near(pixels, tint, 4).sum() > 0.05 * pixels[..., 0].size
        fence = near(pixels, theme.fence, 30)
        row = int(np.argmax(fence.sum(axis=1)))
        assert 0.3 < fence[row, 60:740].mean() < 0.8  # dashed


def test_equal_content_gives_equal_bytes_and_another_key_for_each_parameter(site: Site) -> None:
    first, second = site.version({GRID: room()}), site.version({GRID: room()})
    wanted = PreviewRequest(width=300)
    assert preview_key(first, wanted) == preview_key(second, wanted)
    fresh = Previews(site.store, site.previews._tiles, Cache(site.previews._cache._folder / "other", 2**30))
    assert fresh.png(first, wanted) == site.previews.png(second, wanted)
    others = [
        PreviewRequest(width=301),
        PreviewRequest(width=300, theme="dark"),
        PreviewRequest(("occupancy",), width=300),
    ]
    assert len({preview_key(first, other) for other in (wanted, *others)}) == 4


def test_layers_and_levels_select_what_is_drawn(site: Site) -> None:
    upstairs = features([("n", shapely.Point(3, 3), {"kind": "node"})], "local")
    version = site.version(
        {GRID: room(), PartKey("topology", "L2", "network"): upstairs}, levels=(Level("ground"), Level("L2", 3.0))
    )
    assert not near(site.picture(version), LIGHT.node).any()
    assert near(site.picture(version, level="L2"), LIGHT.node).any()
    with pytest.raises(NotFound, match="did you mean"):
        site.picture(version, level="L22")
    with pytest.raises(NotFound, match="has no imagery"):
        site.picture(version, layers=("imagery",))
    assert parse_layers(" topology,occupancy") == ("occupancy", "topology")
    with pytest.raises(Invalid, match=r"unknown layer 'occupncy' \(did you mean occupancy\?\)"):
        parse_layers("occupncy")


def test_objects_far_beyond_the_site_are_cut_off(site: Site) -> None:
    plane = features([("plane", shapely.box(-500, -500, 500, 500), {"kind": "model"})], "local")
    pixels = site.draw({GRID: room(), OBJECTS: plane}, width=400)
    assert near(pixels, LIGHT.occupied, 25).sum() > 500  # as large as without the plane, not a dot
    box = features(
        [("p", shapely.box(-500, -500, 500, 500), {}), ("b", shapely.box(0, 0, 4, 3), {})], "local"
    )  # the same without a grid
    alone = site.draw({OBJECTS: box}, width=400)
    assert near(alone, LIGHT.objects, 45).sum() > 500


def test_an_image_is_below_and_dimmed_in_the_dark(site: Site) -> None:
    image = GeoImage(np.full((50, 100, 3), 200, np.uint8), (0.1, 0.0, 0.0, 0.0, -0.1, 5.0))
    parts: dict[PartKey, Part] = {PartKey("imagery", "ground", "photo"): image, GRID: room()}
    version = site.version(parts)
    light, dark = site.picture(version), site.picture(version, theme="dark")
    assert near(light, (200, 200, 200), 1).mean() > 0.2
    assert near(dark, (140, 140, 140), 1).mean() > 0.2


def test_a_picture_may_share_a_lock_file_with_what_it_is_made_from(site: Site) -> None:
    """The range of the image's values is in the same cache; it waited for the picture, and the picture for it."""
    heights = (np.arange(50)[:, None] + np.arange(60)[None, :]).astype(np.float32)
    photo = PartKey("imagery", "ground", "photo")
    version = site.version({photo: GeoImage(heights[:, :, None], (0.1, 0.0, 0.0, 0.0, -0.1, 5.0))})
    entry = version.part(photo)
    assert entry is not None
    shared = tiles._key(entry, "range")[:2]
    width = next(w for w in range(100, 100_000) if preview_key(version, PreviewRequest(width=w)).startswith(shared))
    drawing = threading.Thread(target=site.picture, args=[version], kwargs={"width": width}, daemon=True)
    drawing.start()
    drawing.join(120)
    assert not drawing.is_alive()


def test_degrees_without_a_datum_are_drawn_north_up_and_to_scale(site: Site) -> None:
    """A square of 100 m at 60° north is twice as wide as high in degrees."""
    side = 100 / 111_412  # degrees of latitude
    square = shapely.box(10.0, 60.0, 10.0 + 2 * side, 60.0 + side)
    pixels = site.draw({OBJECTS: features([("s", square, {})], "wgs84")}, width=300)
    rows, columns = np.nonzero(~near(pixels, LIGHT.background, 3))
    assert np.ptp(columns) / np.ptp(rows) == pytest.approx(1.0, abs=0.03)
    turned = site.draw(
        {OBJECTS: features([("s", square, {})], "wgs84")}, {"datum": Datum(60.0, 10.0, heading=45.0)}, width=300
    )
    assert near(turned[140:160, 140:160], pixels[150, 150], 2).all()
    assert near(turned[20, 20], LIGHT.background, 3)  # a square on its corner


def test_an_empty_version_says_so(site: Site) -> None:
    site.store.environments.create("nothing")
    pixels = site.picture(site.store.versions.get("nothing"), width=320)
    assert pixels.shape == (160, 320, 3)
    assert near(pixels, LIGHT.text, 40).any()


@pytest.mark.parametrize("box", [(0.0, 0.0, 1000.0, 1.0), (0.0, 0.0, 1.0, 1000.0), (5.0, 5.0, 5.0, 5.0)])
def test_extreme_boxes_fit_into_the_limits(box: tuple[float, float, float, float]) -> None:
    frame = fit_frame(box, 64, 3, ASPECT)
    assert ASPECT[0] * 64 <= frame.height <= ASPECT[1] * 64
    canvas = Canvas(frame, (0, 0, 0))
    canvas.lines(np.array([shapely.box(*box).exterior]), (255, 255, 255), 1.0)
    canvas.dashes(np.array([shapely.box(*box)]), (255, 255, 255), 1.0, 3.0, 2.0)
    assert canvas.finish().shape == (frame.height, 64, 3)


def test_collections_and_empty_geometries_are_drawn_or_skipped() -> None:
    canvas = Canvas(fit_frame((0, 0, 10, 10), 100, 0, ASPECT), (0, 0, 0))
    inner = shapely.GeometryCollection([shapely.MultiPoint([(2, 2), (8, 8)]), shapely.box(4, 4, 6, 6)])
    shapes = np.array([shapely.GeometryCollection([inner]), shapely.Polygon(), shapely.Point()])
    canvas.areas(shapes, (255, 0, 0), 1.0)
    canvas.dots(shapes, (0, 255, 0), 3.0)
    pixels = canvas.finish()
    assert pixels[50, 50].tolist() == [255, 0, 0]
    assert pixels[80, 20].tolist() == [0, 255, 0]
    assert pixels[20, 80].tolist() == [0, 255, 0]
