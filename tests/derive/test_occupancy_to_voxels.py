"""occupancy → voxels: against brute force, there and back on real maps, turned and shifted grids, sizes."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app import derive, formats
from app.convert.files import offline
from app.derive import occupancy_to_voxels as module
from app.derive.occupancy_to_voxels import Parameters, occupancy_to_voxels
from app.derive.voxels_to_occupancy import Parameters as Back
from app.derive.voxels_to_occupancy import voxels_to_occupancy
from app.errors import CannotConvert, MissingLayer
from app.formats import FileGroup, ReadContext, get_format
from app.model.frame import Level
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.layers import Layers, PartKey
from app.model.voxels import VoxelMap, expand_leaves, prune

MAP = PartKey("occupancy")


def extrude(grid: OccupancyGrid, *, elevation: float = 0.0, **more: Any) -> VoxelMap:
    layers = Layers({MAP: grid}, levels=(Level("ground", elevation),))
    voxels = occupancy_to_voxels(layers, Parameters(**more), derive.DerivationNotes()).parts[PartKey("voxels")]
    assert isinstance(voxels, VoxelMap)
    return voxels


def voxels_of(voxels: VoxelMap) -> dict[tuple[int, int, int], bool]:
    """Every smallest voxel, and whether it is occupied."""
    code, rows = expand_leaves(voxels, np.ones(len(voxels), bool))
    small = VoxelMap(voxels.resolution, np.full(len(code), 16, np.uint8), code, voxels.log_odds[rows])
    places = zip(*(small.axis(k)[0].tolist() for k in range(3)), strict=True)
    return dict(zip(places, small.occupied.tolist(), strict=True))


def grid_of(rows: list[list[int]], **more: Any) -> OccupancyGrid:
    return OccupancyGrid(np.array(rows, np.uint8), **{"resolution": 0.5, **more})


cells = st.lists(st.lists(st.sampled_from([FREE, OCCUPIED, UNKNOWN]), min_size=9, max_size=9), min_size=1, max_size=9)


@given(cells, st.integers(-9, 9), st.integers(-9, 9), st.integers(-3, 3), st.integers(1, 11), st.booleans())
def test_columns_equal_brute_force(rows: list[list[int]], x: int, y: int, floor: int, tall: int, free: bool) -> None:
    grid = grid_of(rows, origin=(x * 0.5, y * 0.5, 0.0))
    want = {
        (x + i, y + j, floor + k): value == OCCUPIED
        for j, row in enumerate(rows)
        for i, value in enumerate(row)
        if value == OCCUPIED or (value == FREE and free)
        for k in range(tall)
    }
    if not want:
        with pytest.raises(MissingLayer, match="occupied or free cells"):
            extrude(grid, height=tall * 0.5, free=free)
        return
    voxels = extrude(grid, elevation=floor * 0.5, height=tall * 0.5, free=free)
    assert voxels_of(voxels) == want
    assert len(prune(voxels)) == len(voxels), "no leaf can be merged any further"


@pytest.mark.parametrize("size", [0.5, 0.25, 0.1, 1.0, 1.3])
@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (0.2, -0.3, 0.0), (1.0, 2.0, 0.4), (-3.0, 0.1, -2.0)])
def test_rotated_cells_occupy_all_touched_voxels(origin: tuple[float, float, float], size: float) -> None:
    dice = np.random.default_rng(4)
    rows = dice.choice([FREE, FREE, OCCUPIED, UNKNOWN], (7, 8)).tolist()
    grid = grid_of(rows, origin=origin)
    voxels = voxels_of(extrude(grid, resolution=size, height=size))
    c, s = math.cos(origin[2]), math.sin(origin[2])
    for j, i in np.argwhere(grid.cells == OCCUPIED).tolist():
        for a in np.linspace(0.01, 0.99, 25):
            for b in (0.01, 0.5, 0.99):
                for u, v in ((a, b), (b, a)):
                    p, q = (i + u) * 0.5, (j + v) * 0.5
                    place = (origin[0] + p * c - q * s) / size, (origin[1] + p * s + q * c) / size
                    near = (
                        [math.floor(place[0] + d) for d in (-0.25, 0, 0.25)],
                        [math.floor(place[1] + d) for d in (-0.25, 0, 0.25)],
                    )
                    assert any(voxels.get((m, n, 0)) for m in near[0] for n in near[1]), "within a quarter of a voxel"
    for (m, n, _), occupied in voxels.items():
        x, y = (m + 0.5) * size - origin[0], (n + 0.5) * size - origin[1]
        i, j = math.floor((x * c + y * s) / 0.5), math.floor((y * c - x * s) / 0.5)
        inside = 0 <= i < 8 and 0 <= j < 7
        if not occupied:
            assert inside
            assert rows[j][i] == FREE


def test_large_cells_are_sampled_at_their_border_only() -> None:
    """Their inside is found from the voxels' centres; one cell of 250 × 250 voxels took a minute before."""
    points = np.array(module._border(501))
    assert len({tuple(point) for point in points.tolist()}) == len(points) == 4 * 500
    assert (np.minimum(points, 1 - points).min(axis=1) < 1e-5).all()
    voxels = extrude(grid_of([[OCCUPIED]], resolution=5.0), resolution=0.02, height=0.02)
    assert voxels.voxel_counts() == {"occupied": 250 * 250, "free": 0}


@pytest.mark.parametrize("name", ["occupancy_grid/nav2_tb3_sandbox", "occupancy_grid/nav2_map_circular"])
def test_real_maps_survive_round_trip(shared: Path, name: str) -> None:
    files = {p.name: p.read_bytes() for p in (shared / "data" / name).iterdir()}
    main = next(n for n in sorted(files) if n.endswith(".yaml"))
    layers = formats.read(FileGroup(get_format("occupancy_grid"), main, files), ReadContext(grid="map"))
    grid = layers.parts[MAP]
    assert isinstance(grid, OccupancyGrid)
    voxels = extrude(grid, height=1.0)
    counts = grid.counts()
    tall = round(1.0 / grid.resolution)
    assert voxels.voxel_counts() == {"occupied": counts["occupied"] * tall, "free": counts["free"] * tall}
    assert len(voxels) < (counts["occupied"] + counts["free"]) * tall / 3, "large leaves where all is free"
    back = voxels_to_occupancy(Layers({PartKey("voxels"): voxels}), Back(), derive.DerivationNotes()).parts[MAP]
    assert isinstance(back, OccupancyGrid)
    rows, columns = np.nonzero(grid.cells != UNKNOWN)
    crop = grid.cells[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    assert np.array_equal(back.cells, crop)
    bt = offline(files, "octomap", options={"height": "1"})
    assert bt.files["map.bt"].startswith(b"# Octomap OcTree binary file")
    assert any(t["what"] == "height" for t in offline(files, "octomap").report.as_dict()["template"])


def test_grey_cells_follow_the_thresholds() -> None:
    grid = grid_of([[0, 10, 25, 26, 64, 65, 100, 255]], mode="scale", occupied_thresh=0.65, free_thresh=0.25)
    voxels = voxels_of(extrude(grid, height=0.5))
    assert {k[0]: v for k, v in voxels.items()} == {0: False, 1: False, 2: False, 5: True, 6: True}


def test_map_grid_is_extruded_before_others() -> None:
    wall = grid_of([[OCCUPIED]])
    named = {PartKey("occupancy", level, name): wall for level, name in (
        ("ground", "map"), ("ground", "other"), ("ground", "keepout"), ("L2", "lab"), ("L2", "speed"),
    )}  # fmt: skip
    levels = (Level(), Level("L2", 4.0))
    derived_layers = occupancy_to_voxels(Layers(named, levels=levels), Parameters(height=0.5), derive.DerivationNotes())
    assert {(k.level, k.name) for k in derived_layers.parts} == {("ground", "map"), ("L2", "lab")}
    part = derived_layers.parts[PartKey("voxels", "L2", "lab")]
    assert isinstance(part, VoxelMap)
    assert part.bounds() == (0.0, 0.0, 4.0, 0.5, 0.5, 4.5)


def test_empty_grids_raise_missing_layer() -> None:
    for layers in (Layers(), Layers({MAP: grid_of([[UNKNOWN, UNKNOWN]])}), Layers({PartKey("occupancy", name="keepout"): grid_of([[OCCUPIED]])})):  # fmt: skip  # noqa: E501
        with pytest.raises(MissingLayer, match="upload"):
            occupancy_to_voxels(layers, Parameters(), derive.DerivationNotes())
    notes = derive.DerivationNotes()
    occupancy_to_voxels(Layers({MAP: grid_of([[FREE]])}), Parameters(), notes)
    assert any("no occupied cell" in w.problem for w in notes.warnings)
    extrude(grid_of([[OCCUPIED]]))


def test_too_large_octrees_raise_cannot_convert(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(CannotConvert, match="extends beyond"):
        extrude(grid_of([[OCCUPIED]], origin=(20000.0, 0.0, 0.0)))
    with pytest.raises(CannotConvert, match="extends beyond"):
        extrude(grid_of([[OCCUPIED]]), elevation=16383.9)
    with pytest.raises(CannotConvert, match="columns"):
        extrude(grid_of([[FREE] * 100] * 100), resolution=0.001)
    monkeypatch.setattr(module, "MAX_LEAVES", 100)
    dice = np.random.default_rng(0)
    with pytest.raises(CannotConvert, match="more than 100 voxels"):
        extrude(grid_of(dice.choice([FREE, OCCUPIED], (20, 20)).tolist()))


def test_large_free_grid_has_few_leaves() -> None:
    """4096 × 4096 cells, 2 m high: five thousand leaves and not 670 million voxels."""
    big = np.zeros((4096, 4096), np.uint8)
    start = time.process_time()
    voxels = extrude(OccupancyGrid(big, 0.05), height=2.0)
    assert time.process_time() - start < 8.0
    assert voxels.voxel_counts() == {"occupied": 0, "free": 4096 * 4096 * 40}
    assert len(voxels) == 128 * 128 + 512 * 512
