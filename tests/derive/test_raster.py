"""The rasteriser against shapely and trimesh, cell by cell, and against truths worked out by hand."""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from app.errors import CannotConvert
from app.model import raster, solids
from app.model.raster import RasterFrame, Spans

FRAME = RasterFrame((-1.0, -2.0), 0.25, 20, 24)


def cells(spans: Iterable[Spans], frame: RasterFrame = FRAME, layers: int = 1) -> Any:
    """bool [layers, height, width]."""
    out = np.zeros((layers, frame.height, frame.width), bool)
    for part in spans:
        layer, row, column = raster.expand_spans(part)
        out[layer, row, column] = True
    return out


def boxes(frame: RasterFrame = FRAME) -> Any:
    x, y = np.meshgrid(np.arange(frame.width), np.arange(frame.height))
    low_x, low_y = frame.origin[0] + x * frame.resolution, frame.origin[1] + y * frame.resolution
    return shapely.box(low_x, low_y, low_x + frame.resolution, low_y + frame.resolution)


def shape(**members: Any) -> Any:
    return solids.triangles({"shapes": [members]}, {})


def clipped(triangle: Any, low: float, high: float) -> Any:
    """A triangle between two heights seen from above, computed independently: half planes on a fine polygon."""
    out = [tuple(p) for p in triangle]
    for sign, bound in ((1.0, low - 1e-9), (-1.0, -high - 1e-9)):
        corners = []
        for a, b in zip(out, [*out[1:], *out[:1]], strict=True):
            da, db = sign * a[2] - bound, sign * b[2] - bound
            if da >= 0:
                corners.append(a)
            if (da >= 0) != (db >= 0):
                t = da / (da - db)
                corners.append(tuple(p + (q - p) * t for p, q in zip(a, b, strict=True)))
        out = corners
    return shapely.convex_hull(shapely.MultiPoint([p[:2] for p in out])) if out else shapely.Polygon()


@given(st.integers(0, 2**32 - 1), st.booleans())
@settings(max_examples=30)
def test_surface_paints_touched_cells(seed: int, slice_: bool) -> None:
    random = np.random.default_rng(seed)
    triangles = random.uniform([-2, -3, 0], [5, 5, 2], (4, 3, 3))
    low = float(random.uniform(0, 2))
    high = low if slice_ else float(random.uniform(low, 2.2))
    mask = cells(raster.surfaces(triangles, FRAME, np.array([[low, high]])))[0]
    pieces = [clipped(t, low, high) for t in triangles]
    # a micrometre along the normal moves the cut of a nearly level triangle by more: only grazed cells may differ
    near = np.logical_or.reduce([shapely.distance(boxes(), p) < 1e-3 for p in pieces])
    sure = np.logical_or.reduce([shapely.intersects(shapely.buffer(boxes(), -1e-3), p) for p in pieces])
    assert not (mask & ~near).any()
    assert not (sure & ~mask).any()


def test_surface_slabs_become_layers() -> None:
    random = np.random.default_rng(4)
    triangles = random.uniform([-2, -3, 0], [5, 5, 2], (30, 3, 3))
    heights = np.arange(9) * 0.25
    slabs = np.column_stack([heights[:-1], heights[1:]])
    together = cells(raster.surfaces(triangles, FRAME, slabs), layers=8)
    for k, slab in enumerate(slabs):
        alone = cells(raster.surfaces(triangles, FRAME, slab[None]))[0]
        assert (together[k] == alone).all()


def test_box_covers_exactly_its_cells() -> None:
    box = shape(type="box", size=[1.0, 0.5, 1.0], pose=[0.5, 0.25, 0.5, 0, 0, 0])
    for low, high in ((0.2, 0.2), (0.0, 1.0), (-5.0, 5.0), (0.0, 0.0)):
        mask = cells(raster.surfaces(box, FRAME, np.array([[low, high]])))[0]
        mask |= cells(raster.insides(box, np.zeros(len(box), int), FRAME, np.array([low])))[0]
        rows, columns = np.nonzero(mask)
        assert (rows.min(), rows.max(), columns.min(), columns.max()) == (8, 9, 4, 7)
        assert mask.sum() == 8
    for height in (1.0, -0.1):
        slab = np.array([[height, height]])
        assert not cells(raster.surfaces(box, FRAME, slab)).any(), "the top is where it ends"
        assert not cells(raster.insides(box, np.zeros(len(box), int), FRAME, slab[:, 0])).any()


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_inside_agrees_with_the_distance_to_spheres(seed: int) -> None:
    random = np.random.default_rng(seed)
    at = random.uniform([-1, -2, 0], [4, 4, 1], (5, 3))
    radii = random.uniform(0.1, 1.5, 5)
    parts = [shape(type="sphere", radius=float(r), pose=[*map(float, p)]) for p, r in zip(at, radii, strict=True)]
    parts[0] = parts[0][:, ::-1]  # its inside turned out
    owner = np.repeat(np.arange(5), [len(p) for p in parts])
    height = 0.5 + 1e-4
    mask = cells(raster.insides(np.concatenate(parts), owner, FRAME, np.array([height])))[0]
    x, y = np.meshgrid(np.arange(20) * 0.25 - 0.875, np.arange(24) * 0.25 - 1.875)
    away = np.min(
        [np.hypot(np.hypot(x - p[0], y - p[1]), height - p[2]) - r for p, r in zip(at, radii, strict=True)], axis=0
    )
    assert mask[away < -0.01].all()
    assert not mask[away > 1e-6].any()


def test_open_surface_has_no_inside() -> None:
    box = shape(type="box", size=[2, 2, 2])
    walls = box[np.ptp(box[:, :, 2], axis=1) > 0]
    none = np.zeros(len(box), int)
    at = np.array([0.0])
    assert cells(raster.insides(walls, none[: len(walls)], FRAME, at)).sum() == 64, "a tube is closed at every height"
    gap = walls[1:]
    assert cells(raster.insides(gap, none[: len(gap)], FRAME, at)).sum() in (0, 32), "rows that are open are left"
    both = np.concatenate([gap, shape(type="box", size=[0.5, 0.5, 2], pose=[2, 2, 0])])
    owner = np.append(np.zeros(len(gap), int), np.ones(12, int))
    assert cells(raster.insides(both, owner, FRAME, at))[0, 15:18, 11:14].sum() == 4, "others are judged on their own"


def test_areas_with_holes_agree_with_rasterio() -> None:
    from rasterio.features import rasterize
    from rasterio.transform import Affine

    random = np.random.default_rng(3)
    for _ in range(10):
        outer = shapely.Point(*random.uniform(0, 2, 2)).buffer(float(random.uniform(0.5, 2)), quad_segs=3)
        hole = shapely.affinity.scale(outer, 0.5, 0.4)
        area = shapely.MultiPolygon([shapely.Polygon(outer.exterior, [hole.exterior]), shapely.box(3.1, 3.1, 3.6, 3.7)])
        mask = cells(raster.areas([area], FRAME, touched=False))[0]
        transform = Affine(0.25, 0, -1, 0, -0.25, -2 + 24 * 0.25)
        theirs = rasterize([area], (24, 20), transform=transform)[::-1].astype(bool)
        assert (mask == theirs).all()
        touched = cells(raster.areas([area], FRAME, touched=True))[0]
        assert (touched == shapely.intersects(boxes(), area)).all()


def test_lines_points_and_outside_geometry_are_rasterised() -> None:
    line = shapely.LineString([(-0.9, -1.9), (0.9, -1.9), (0.9, 100)])
    mask = cells(raster.areas([line], FRAME, touched=False))[0]
    assert np.flatnonzero(mask[0]).tolist() == list(range(8))
    assert np.flatnonzero(mask[:, 7]).tolist() == list(range(24))
    assert mask.sum() == 31
    assert cells(raster.areas([shapely.Point(0.1, 0.1)], FRAME, touched=False))[0, 8, 4]
    far = [shapely.Point(50, 50), shapely.box(90, 90, 99, 99), shapely.LineString([(-9, 0), (-8, 0)]), shapely.Point()]
    assert not cells(raster.areas(far, FRAME, touched=True)).any()
    assert cells(raster.areas([shapely.box(-99, -99, 99, 99)], FRAME, touched=True)).all()
    assert not list(raster.areas([], FRAME, touched=True))


def test_collections_are_rasterised_completely() -> None:
    several = shapely.MultiPolygon([shapely.box(0, 0, 0.25, 0.25), shapely.box(1, 1, 1.25, 1.25)])
    mixed = shapely.GeometryCollection([several, shapely.LineString([(2, 2.1), (2.4, 2.1)])])
    assert cells(raster.areas([mixed], FRAME, touched=True)).sum() == 4
    assert len(solids.extrude(mixed, 0.0, 1.0)) == 2 * 12


def test_frames_are_aligned_to_cells() -> None:
    frame = RasterFrame.from_box((0.3, -0.31, 0.9, 0.6), 0.1)
    assert (frame.origin, frame.width, frame.height) == ((0.3, -0.4), 6, 10)
    assert RasterFrame.from_box((1.0, 1.0, 1.0, 1.0), 0.5).cells == 1
    assert raster.check_frame(frame, 60, 10) is frame
    for maximum, longest in ((59, 100), (1000, 9)):
        with pytest.raises(CannotConvert, match="resolution of at least"):
            raster.check_frame(frame, maximum, longest)


def test_paint_and_grow() -> None:
    grid = np.zeros((24, 20), np.uint8)
    raster.paint(grid, [np.array([[0, 5, 3, 4], [7, 5, 3, 6], [0, 23, 19, 20]])], 100)
    assert np.argwhere(grid).tolist() == [[5, 3], [5, 4], [5, 5], [23, 19]]
    raster.grow(grid, 100, 2.0)
    away = np.hypot(*np.meshgrid(np.arange(20) - 19, np.arange(24) - 23))
    y, x = np.mgrid[:24, :20]
    near = np.min([np.hypot(x - c, y - 5) for c in (3, 4, 5)], axis=0)
    assert ((grid == 100) == ((near <= 2) | (away <= 2))).all()
    raster.grow(grid, 50, 3.0)
    assert set(np.unique(grid)) == {0, 100}, "nothing has that value"


def test_growing_in_strips_is_growing(monkeypatch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(0)
    wide = np.where(random.random((900, 20_000)) < 1e-5, 100, 0).astype(np.uint8)
    narrow = wide.copy()
    raster.grow(wide, 100, 30.0)  # 2^24 cells are less than its rows
    raster.grow(narrow[:, :9000], 100, 30.0)
    assert (wide[:, :8960] == narrow[:, :8960]).all()
    assert wide.any()


def test_many_triangles_are_quick() -> None:
    random = np.random.default_rng(2)
    middle = random.uniform([0, 0, 0], [100, 100, 2], (300_000, 1, 3))
    triangles = middle + random.normal(0, 0.1, (300_000, 3, 3))
    frame = RasterFrame((0.0, 0.0), 0.05, 2000, 2000)
    grid = np.zeros((2000, 2000), np.uint8)
    start = time.process_time()
    raster.paint(grid, raster.surfaces(triangles, frame, np.array([[0.2, 1.0]])), 100)
    assert grid.any()
    assert time.process_time() - start < 20


@pytest.mark.parametrize("noise", [1e-16, 1e-15, -1e-15, 4e-15])
def test_level_line_on_a_boundary_touches_whole_rows_in_spite_of_rounding(noise: float) -> None:
    frame = RasterFrame((0.0, 0.0), 1.0, 20, 10)
    edge = np.array([[[1.5, 5.0 - noise], [18.5, 5.0 + noise]]])
    rows, columns = np.nonzero(cells(raster.lines(edge, frame), frame)[0])
    for row in set(rows.tolist()):
        assert columns[rows == row].tolist() == list(range(1, 19))
    assert 5 in rows or 4 in rows
