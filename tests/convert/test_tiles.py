"""Tiles against a slow reference: values, joins, overviews, slices of voxels, damage."""

from __future__ import annotations

import io
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from app.convert import pyramid
from app.convert.cache import Cache
from app.convert.placement import place_columns, place_raster
from app.convert.pyramid import TILE, Size, halve_colours
from app.convert.tiles import TileAddress, Tiles
from app.convert.voxel_tiles import Columns, slice_heights
from app.errors import Invalid, MissingDatum, NotFound
from app.model.frame import Datum
from app.model.geodesy import local_frame
from app.model.grid import OccupancyGrid, halve_cells
from app.model.imagery import GeoImage, display_pixels
from app.model.layers import Part, PartKey
from app.model.voxels import VoxelMap, morton
from app.store.store import Store
from app.store.values import PartEntry
from tests.store.conftest import migrated_file
from tests.store.samples import replaces, save

__all__ = ["migrated_file"]

LIMITED = settings(deadline=None, max_examples=15, suppress_health_check=list(HealthCheck))


class Bench:
    """A store with one part at a time, and tiles of it."""

    def __init__(self, folder: Path) -> None:
        self.store = Store(f"sqlite:///{folder / 'db.sqlite'}", folder / "blobs")
        self.store.migrate()
        self.store.environments.create("farm")
        self.cache = Cache(folder / "cache", 2**30)
        self.tiles = Tiles(self.store, self.cache)

    def put(self, layer: Any, part: Part) -> PartEntry:
        key = PartKey(layer, "ground", "map")
        entry = save(self.store, "farm", *replaces({key: part})).part(key)
        assert entry is not None
        return entry

    def level(self, entry: PartEntry, z: int, size: Size) -> np.ndarray[Any, Any]:
        """Join all tiles of a level."""
        rows, columns = size.reduced(size.levels - 1 - z).tiles()
        images = [
            np.concatenate(
                [decode(self.tiles.raster_tile(entry, TileAddress(z, r, c))) for c in range(columns)], axis=1
            )
            for r in range(rows)
        ]
        return np.concatenate(images)


def decode(png: bytes) -> np.ndarray[Any, Any]:
    image = Image.open(io.BytesIO(png))
    assert image.size == (TILE, TILE)
    return np.asarray(image if image.mode == "L" else image.convert("RGBA"))


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    return Bench(tmp_path_factory.mktemp("tiles"))


def reduced_at_once(cells: np.ndarray[Any, Any], k: int) -> np.ndarray[Any, Any]:
    """Reduce cells (row 0 on top) by 2**k at once: the highest known value of each block."""
    side = 2**k
    height, width = math.ceil(cells.shape[0] / side), math.ceil(cells.shape[1] / side)
    known = np.full((height * side, width * side), -1, np.int16)
    known[: cells.shape[0], : cells.shape[1]] = np.where(cells == 255, -1, cells.astype(np.int16))
    highest = known.reshape(height, side, width, side).max(axis=(1, 3))
    return np.where(highest < 0, 255, highest).astype(np.uint8)


@st.composite
def grids(draw: Any) -> OccupancyGrid:
    height, width = draw(st.integers(1, 600)), draw(st.integers(1, 600))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    cells = rng.integers(0, 101, (height, width)).astype(np.uint8)
    cells[rng.random((height, width)) < draw(st.sampled_from([0.0, 0.5, 0.99]))] = 255
    return OccupancyGrid(cells, 0.1)


@LIMITED
@given(grid=grids())
def test_tiles_of_each_level_join_to_the_grid_reduced_at_once(bench: Bench, grid: OccupancyGrid) -> None:
    entry, size = bench.put("occupancy", grid), Size(grid.width, grid.height)
    assert max(size.reduced(size.levels - 1).width, size.reduced(size.levels - 1).height) <= TILE
    for z in range(size.levels):
        expected = reduced_at_once(grid.cells[::-1], size.levels - 1 - z)
        joined = bench.level(entry, z, size)
        assert (joined[: expected.shape[0], : expected.shape[1]] == expected).all()
        joined = joined.copy()
        joined[: expected.shape[0], : expected.shape[1]] = 255
        assert (joined == 255).all()  # padding is unknown


def test_stored_overviews_equal_direct_ones(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    cells = rng.choice(np.array([0, 50, 100, 255], np.uint8), (2500, 4311), p=[0.1, 0.001, 0.001, 0.898])
    grid = OccupancyGrid(cells, 0.05)
    entry, size = bench.put("occupancy", grid), Size(4311, 2500)
    assert size.levels == 6
    assert not bench.tiles.is_ready(entry, 0)
    assert bench.tiles.is_ready(entry, size.levels - 1)
    bench.tiles.prepare(entry)
    assert bench.tiles.is_ready(entry, 0)
    for z in range(size.levels):
        expected = cells[::-1]
        for _ in range(size.levels - 1 - z):
            expected = halve_cells(expected)
        assert (bench.tiles.reduced(entry, size.levels - 1 - z) == expected).all()
    with monkeypatch.context() as patch:  # no further work on the whole raster
        patch.setattr(pyramid.GridSource, "read", None)
        fresh = Tiles(bench.store, bench.cache)
        assert decode(fresh.raster_tile(entry, TileAddress(0, 0, 0)))[:79, :135].tolist() == (
            bench.tiles.reduced(entry, 5).tolist()
        )


def test_a_damaged_pyramid_is_built_again(bench: Bench) -> None:
    cells = np.zeros((2100, 2100), np.uint8)
    cells[7, 3] = 100
    entry = bench.put("occupancy", OccupancyGrid(cells, 0.05))
    before = bench.tiles.raster_tile(entry, TileAddress(0, 0, 0))
    assert (decode(before) == 100).sum() == 1
    (path,) = [p for p in bench.cache._folder.rglob("0") if before in p.read_bytes()]
    path.write_bytes(path.read_bytes()[:-20] + b"\0" * 20)
    damaged = bench.cache.damaged
    assert Tiles(bench.store, bench.cache).raster_tile(entry, TileAddress(0, 0, 0)) == before
    assert bench.cache.damaged == damaged + 1


@LIMITED
@given(seed=st.integers(0, 2**32), height=st.integers(1, 9), width=st.integers(1, 9), share=st.floats(0, 1))
def test_halved_cells_lose_no_obstacle(seed: int, height: int, width: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    cells = rng.integers(0, 101, (height, width)).astype(np.uint8)
    cells[rng.random(cells.shape) < share] = 255
    assert (halve_cells(cells) == reduced_at_once(cells, 1)).all()


@LIMITED
@given(seed=st.integers(0, 2**32), height=st.integers(1, 9), width=st.integers(1, 9), opaque=st.booleans())
def test_halved_colours_are_the_mean_weighted_by_opacity(seed: int, height: int, width: int, opaque: bool) -> None:
    rng = np.random.default_rng(seed)
    pixels = rng.integers(0, 256, (height, width, 4)).astype(np.uint8)
    pixels[..., 3] = 255 if opaque else rng.choice([0, 0, 255, 100], (height, width))
    out = halve_colours(pixels)
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            block = pixels[2 * row : 2 * row + 2, 2 * column : 2 * column + 2].reshape(-1, 4).astype(float)
            alpha = block[:, 3].mean()
            assert abs(out[row, column, 3] - alpha) <= 0.51
            if alpha:
                colour = (block[:, :3] * block[:, 3:]).sum(axis=0) / block[:, 3].sum()
                assert (np.abs(out[row, column, :3] - colour) <= 0.51).all()


def test_image_tiles_join_to_the_displayed_image(bench: Bench) -> None:
    rng = np.random.default_rng(5)
    pixels = rng.integers(0, 256, (300, 270, 3)).astype(np.uint8)
    entry = bench.put("imagery", GeoImage(pixels, (0.1, 0.0, -5.0, 0.0, -0.1, 20.0)))
    whole = bench.level(entry, 1, Size(270, 300))
    assert (whole[:300, :270, :3] == pixels).all()
    assert (whole[:300, :270, 3] == 255).all()
    assert not whole[300:].any()
    assert not whole[:, 270:].any()
    assert Image.open(io.BytesIO(bench.tiles.raster_tile(entry, TileAddress(1, 0, 0)))).mode == "RGB"
    assert Image.open(io.BytesIO(bench.tiles.raster_tile(entry, TileAddress(1, 0, 1)))).mode == "RGBA"
    top = decode(bench.tiles.raster_tile(entry, TileAddress(0, 0, 0)))
    assert np.abs(top[0, 0, :3] - pixels[:2, :2].reshape(4, 3).mean(axis=0)).max() <= 0.51


@pytest.mark.parametrize("dtype", [np.float32, np.uint16, np.int16])
def test_other_values_are_stretched_by_the_range_of_the_whole_image(bench: Bench, dtype: Any) -> None:
    heights = (np.arange(600)[:, None] + np.arange(700)[None, :]).astype(dtype)
    image = GeoImage(heights[..., None].copy(), (0.1, 0.0, 0.0, 0.0, -0.1, 0.0), properties={"nodata": 0})
    entry = bench.put("imagery", image)
    shown = display_pixels(image)
    whole = bench.level(entry, 2, Size(700, 600))[:600, :700]
    assert (whole[..., 0] == shown[..., 0]).all()
    assert (whole[..., 3] == shown[..., 1]).all()


def test_tiles_outside_are_not_found(bench: Bench) -> None:
    entry = bench.put("occupancy", OccupancyGrid(np.zeros((300, 300), np.uint8), 0.1))
    for address in (TileAddress(2, 0, 0), TileAddress(1, 2, 0), TileAddress(1, 0, 2), TileAddress(0, 1, 0)):
        with pytest.raises(NotFound):
            bench.tiles.raster_tile(entry, address)


# --- voxels ---


def voxels_of(cells: dict[tuple[int, int, int], bool], resolution: float = 0.1) -> VoxelMap:
    x, y, z = (np.array([place[k] for place in cells], np.int64) for k in range(3))
    code = morton(x, y, z)
    order = np.argsort(code)
    odds = np.array([1.0 if occupied else -1.0 for occupied in cells.values()], np.float32)
    return VoxelMap(resolution, np.full(len(code), 16, np.uint8), code[order], odds[order])


PLACE = st.tuples(st.integers(-40, 700), st.integers(-300, 300), st.integers(-3, 3))


@LIMITED
@given(
    cells=st.dictionaries(PLACE, st.booleans(), min_size=1, max_size=60),
    low=st.integers(-5, 4),
    thick=st.integers(1, 5),
    data=st.data(),
)
def test_voxel_tiles_equal_a_loop_over_voxels(
    cells: dict[tuple[int, int, int], bool], low: int, thick: int, data: Any
) -> None:
    columns = Columns(voxels_of(cells))
    size = Size(columns.width, columns.height)
    heights = slice_heights(columns, low * 0.1, (low + thick) * 0.1)
    k = data.draw(st.integers(0, size.levels - 1))
    left, top = min(x for x, _, _ in cells), max(y for _, y, _ in cells)
    expected: dict[tuple[int, int], int] = {}
    for (x, y, z), occupied in cells.items():
        if low <= z < low + thick:
            place = (top - y) >> k, (x - left) >> k
            expected[place] = max(expected.get(place, 0), 100 if occupied else 0)
    rows, sides = size.reduced(k).tiles()
    for row in range(rows):
        for column in range(sides):
            tile = columns.tile(k, row * TILE, column * TILE, TILE, heights)
            here = {
                (r - row * TILE, c - column * TILE): value
                for (r, c), value in expected.items()
                if r // TILE == row and c // TILE == column
            }
            assert {(int(r), int(c)): int(tile[r, c]) for r, c in np.argwhere(tile != 255)} == here


def test_large_leaves_cover_all_their_voxels() -> None:
    """A leaf of 32³ voxels beside one of 1, in tiles that cut it."""
    big = VoxelMap(
        0.1,
        np.array([11, 16], np.uint8),
        np.array([0, int(morton(np.array([0]), np.array([0]), np.array([0]))[0])], np.uint64),
        np.array([-1.0, 1.0], np.float32),
    )
    columns = Columns(big)
    assert (columns.width, columns.height) == (32769, 32769)
    tile = columns.tile(0, 32769 - 256, 0, 256, columns.heights)  # the lower left corner
    assert (tile[-32:, :32] == 0).all()
    assert (tile == 0).sum() == 32 * 32
    top = columns.tile(8, 0, 0, 256, columns.heights)
    assert top[0, 128] == 100
    assert top[127, 0] == top[128, 0] == 0  # the leaf's rows 32737 to 32768 touch two cells of 256
    assert (top != 255).sum() == 3


def test_slices() -> None:
    columns = Columns(voxels_of({(0, 0, 0): True, (0, 0, 9): True}))
    assert slice_heights(columns, None, None) == (0, 10)
    assert slice_heights(columns, 0.3, 0.3) == (3, 4)
    assert slice_heights(columns, 0.1, 0.3) == (1, 3)  # 0.3 / 0.1 is not 3 in binary
    assert slice_heights(columns, -1e6, 1e6) == (0, 10)
    with pytest.raises(Invalid, match="above z_max"):
        slice_heights(columns, 1.0, 0.5)
    assert (columns.tile(0, 0, 0, 4, (1, 9)) == 255).all()


def test_an_empty_voxel_map_has_no_tiles(bench: Bench) -> None:
    empty = VoxelMap(0.1, np.empty(0, np.uint8), np.empty(0, np.uint64), np.empty(0, np.float32))
    key = PartKey("voxels", "ground", "map")
    version = save(bench.store, "farm", *replaces({key: empty}))
    with pytest.raises(NotFound, match="empty"):
        bench.tiles.columns(version, key)


# --- position ---


def test_a_turned_grid_has_its_corners(bench: Bench) -> None:
    grid = OccupancyGrid(np.zeros((30, 50), np.uint8), 0.2, (3.0, -4.0, 0.7))
    entry = bench.put("occupancy", grid)
    placement = place_raster(bench.tiles.header(entry), None)
    a, b, c, d, e, f = placement.transform
    corners = [(a * u + b * v + c, d * u + e * v + f) for u, v in ((0, 30), (50, 30), (50, 0), (0, 0))]
    assert np.allclose(corners, grid.corners(), atol=1e-12)
    low, high = grid.corners().min(axis=0), grid.corners().max(axis=0)
    assert np.allclose(placement.bounds(50, 30), [*low, *high], atol=1e-12)
    assert (placement.resolution, placement.origin) == (0.2, (3.0, -4.0, 0.7))


def test_local_images(bench: Bench) -> None:
    turned = GeoImage(np.zeros((10, 20, 3), np.uint8), (0.3, 0.4, 5.0, 0.4, -0.3, 6.0))
    placement = place_raster(bench.tiles.header(bench.put("imagery", turned)), None)
    assert placement.resolution == pytest.approx(0.5)
    assert placement.origin == pytest.approx((9.0, 3.0, math.atan2(0.4, 0.3)))
    for transform in ((0.3, 0.0, 5.0, 0.0, 0.3, 6.0), (0.3, 0.0, 5.0, 0.0, -0.4, 6.0)):  # mirrored, not square
        odd = place_raster(bench.tiles.header(bench.put("imagery", replace(turned, transform=transform))), None)
        assert (odd.resolution, odd.origin, odd.transform) == (None, None, transform)


def test_an_image_on_earth_is_fitted_to_the_local_frame(bench: Bench) -> None:
    image = GeoImage(np.zeros((400, 300, 3), np.uint8), (1e-6, 0.0, -0.5, 0.0, -1e-6, 53.2), "EPSG:4326")
    entry = bench.put("imagery", image)
    reader = bench.tiles.header(entry)
    with pytest.raises(MissingDatum):
        place_raster(reader, None)
    datum = Datum(53.2, -0.5, heading=30.0)
    placement = place_raster(reader, datum)
    a, b, c, d, e, f = placement.transform
    exact = local_frame(datum).to_local(np.array([[-0.5 + 200e-6, 53.2 - 100e-6]]))[0]
    assert math.hypot(a * 200 + b * 100 + c - exact[0], d * 200 + e * 100 + f - exact[1]) <= placement.deviation
    assert 0.0 < placement.deviation < 1e-3


def test_voxels_are_placed_by_their_lowest_voxel() -> None:
    placement = place_columns(Columns(voxels_of({(-3, 2, 0): True, (4, 8, 1): False})))
    assert placement.origin == (-0.3, 0.2, 0.0)
    assert placement.transform == (0.1, 0.0, -0.3, 0.0, -0.1, 0.9)
    assert placement.bounds(8, 7) == pytest.approx((-0.3, 0.2, 0.5, 0.9))
