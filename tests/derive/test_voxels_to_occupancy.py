"""voxels → occupancy: against brute force on small trees, facts of real ones, bands above a level's floor, sizes."""

from __future__ import annotations

import math
import time
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app import derive, formats
from app.convert.files import offline
from app.derive.voxels_to_occupancy import Parameters, voxels_to_occupancy
from app.errors import CannotConvert, MissingLayer
from app.formats import FileGroup, ReadContext, get_format
from app.model.frame import Level
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.layers import Layers, PartKey
from app.model.voxels import HALF, VoxelMap
from tests.api.conftest import Api

REAL = [
    "geb079/geb079.bt",
    "joctomap_ecmrv4/ecmrv4_withfree.ot",
    "legacy_headerless_simple/simple.bt",
    "rotors_power_plant/power_plant.bt",
    "synthetic_color/color.ot",
]


def tree(path: Path) -> VoxelMap:
    layers = formats.read(FileGroup(get_format("octomap"), "map.bt", {"map.bt": path.read_bytes()}), ReadContext())
    (part,) = layers.parts.values()
    assert isinstance(part, VoxelMap)
    return part


FULL = (-1e5, 1e5)


def leaves(*rows: tuple[int, int, float], resolution: float = 0.5) -> VoxelMap:
    """(depth, code, log-odds) each, in any order."""
    order = sorted(rows, key=lambda r: r[1] << 3 * (16 - r[0]))
    depth, code, odds = zip(*order, strict=True)
    return VoxelMap(resolution, np.array(depth, np.uint8), np.array(code, np.uint64), np.array(odds, np.float32))


def project(voxels: VoxelMap, *, elevation: float = 0.0, **more: Any) -> tuple[OccupancyGrid, derive.DerivationNotes]:
    notes = derive.DerivationNotes()
    layers = Layers({PartKey("voxels"): voxels}, levels=(Level("ground", elevation),))
    derived_layers = voxels_to_occupancy(layers, Parameters(**more), notes)
    grid = derived_layers.parts[PartKey("occupancy")]
    assert isinstance(grid, OccupancyGrid)
    assert grid.origin[2] == 0.0
    return grid, notes


def by_hand(voxels: VoxelMap, low: float, high: float) -> dict[tuple[int, int], int]:
    """Column -> value, one smallest voxel after the other."""
    out: dict[tuple[int, int], int] = {}
    spans = [voxels.axis(k) for k in range(3)]
    for row in range(len(voxels)):
        (x0, x1), (y0, y1), (z0, z1) = ((int(a[row]), int(b[row])) for a, b in spans)
        if not any(z * voxels.resolution < high and (z + 1) * voxels.resolution > low for z in range(z0, z1)):
            continue
        for x in range(x0, x1):
            for y in range(y0, y1):
                out[x, y] = OCCUPIED if voxels.occupied[row] else max(out.get((x, y), FREE), FREE)
                if voxels.occupied[row]:
                    out[x, y] = OCCUPIED
    return out


@pytest.mark.parametrize("name", REAL)
def test_real_trees_are_projected_at_full_height(
    shared: Path, facts: ModuleType, facts_json: dict[str, Any], name: str
) -> None:
    path = shared / "data" / "octomap" / name
    expected = facts_json[f"octomap/{name}"]["facts"]["projection_xy_full_height"]
    grid, _ = project(tree(path), band=FULL)
    counts = grid.counts()
    assert (grid.width, grid.height) == (expected["width_cells"], expected["height_cells"])
    assert (counts["occupied"], counts["free"], counts["unknown"]) == (
        expected["occupied"], expected["free"], expected["unknown"],
    )  # fmt: skip
    assert grid.origin[:2] == tuple(expected["origin"])
    theirs = facts.projection(facts.octomap(path.read_bytes()))
    assert np.array_equal(np.where(grid.cells == UNKNOWN, -1, grid.cells.astype(int)), theirs["cells"]), "cell by cell"


codes = st.tuples(st.integers(12, 16), st.integers(0, 2**15), st.sampled_from([-1.0, 2.0]))


@given(st.lists(codes, min_size=1, max_size=12), st.integers(-5, 9), st.integers(1, 12))
def test_bands_of_small_trees_equal_brute_force(rows: list[tuple[int, int, float]], start: int, tall: int) -> None:
    middle = sum(7 << 3 * k for k in range(15))  # the octant 0 of the root is all below the origin: shift to its middle
    leaf_rows: list[tuple[int, int, float]] = []
    taken: list[tuple[int, int]] = []
    for depth, code, odds in rows:
        place = (code << 3 * (16 - depth)) & ((1 << 18) - 1)
        place = (place >> 3 * (16 - depth) << 3 * (16 - depth)) | (middle >> 18 << 18)
        span = (place, place + (1 << 3 * (16 - depth)))
        if all(span[1] <= a or b <= span[0] for a, b in taken):
            taken.append(span)
            leaf_rows.append((depth, place >> 3 * (16 - depth), odds))
    voxels = leaves(*leaf_rows)
    z = voxels.axis(2)[0].min()
    low, high = (z + start) * 0.5, (z + start + tall) * 0.5
    want = by_hand(voxels, low, high)
    if not want:
        with pytest.raises(MissingLayer, match="no voxel is in the band"):
            project(voxels, band=(low, high))
        return
    grid, _ = project(voxels, band=(low, high))
    x0, y0 = (round(v / 0.5) for v in grid.origin[:2])
    cells = {(x + x0, y + y0): int(v) for (y, x), v in np.ndenumerate(grid.cells) if v != UNKNOWN}
    assert cells == want
    assert grid.origin[:2] == (voxels.axis(0)[0].min() * 0.5, voxels.axis(1)[0].min() * 0.5), "whatever the band"


def test_band_is_above_level_floor() -> None:
    """One voxel from 1.0 to 1.5 m above the local origin; a touching face does not count."""
    code = sum(1 << 3 * k + b for b, v in enumerate((HALF, HALF, HALF + 2)) for k in range(16) if v >> k & 1)
    voxels = leaves((16, code, 1.0))
    assert voxels.axis(2)[0].tolist() == [2]
    for elevation, band, expected in (
        (0.0, (1.0, 1.5), True), (0.0, (1.4, 9.0), True), (0.0, (0.0, 1.0), False), (0.0, (1.5, 2.0), False),
        (1.0, (0.0, 0.5), True), (1.0, (1.0, 1.5), False), (3.0, (-2.0, -1.9), True),
    ):  # fmt: skip
        if expected:
            assert project(voxels, elevation=elevation, band=band)[0].counts()["occupied"] == 1
        else:
            with pytest.raises(MissingLayer, match=r"map from 1 to 1\.5 m"):
                project(voxels, elevation=elevation, band=band)
    for band in ((1.0, 1.0), (2.0, 1.0)):
        with pytest.raises(CannotConvert, match="low,high with low < high"):
            project(voxels, band=band)


@pytest.mark.parametrize("size", [0.08, 0.16, 0.24, 0.1, 0.05, 0.04, 0.33, 5.0, 100.0])
def test_resampling_loses_no_obstacle(shared: Path, size: float) -> None:
    voxels = tree(shared / "data/octomap/geb079/geb079.bt")
    fine, _ = project(voxels, band=(0.3, 1.2))
    grid, _ = project(voxels, band=(0.3, 1.2), resolution=size)
    assert grid.resolution == size
    for v in grid.origin[:2]:
        assert abs(v / size - round(v / size)) < 1e-6, "a whole multiple"
    rank = {FREE: 0, UNKNOWN: 1, OCCUPIED: 2}
    dice = np.random.default_rng(3)
    x0, y0 = (round(v / 0.08) for v in fine.origin[:2])
    for row, column in {(int(dice.integers(grid.height)), int(dice.integers(grid.width))) for _ in range(300)}:
        if size >= 0.08:
            spans = []
            for k, first, sides in ((column, grid.origin[0], fine.width), (row, grid.origin[1], fine.height)):
                start = first + k * size
                a, b = math.floor(round(start / 0.08, 6)), math.ceil(round((start + size) / 0.08, 6))
                spans.append((a, b, x0 if sides == fine.width else y0, sides))
            (ax, bx, ox, w), (ay, by, oy, h) = spans
            seen = [
                rank[int(fine.cells[y - oy, x - ox])] if 0 <= x - ox < w and 0 <= y - oy < h else 1
                for x in range(ax, bx)
                for y in range(ay, by)
            ]
            assert rank[int(grid.cells[row, column])] == max(seen)
        else:
            x = math.floor((grid.origin[0] + (column + 0.5) * size) / 0.08) - x0
            y = math.floor((grid.origin[1] + (row + 0.5) * size) / 0.08) - y0
            assert grid.cells[row, column] == fine.cells[min(y, fine.height - 1), min(x, fine.width - 1)]


@pytest.mark.parametrize(
    ("name", "band"),
    [
        ("rotors_power_plant/power_plant.bt", "0.25,2.25"),
        ("geb079/geb079.bt", "0,2"),
        ("joctomap_ecmrv4/ecmrv4_withfree.ot", None),
    ],
)
def test_recorded_floor_is_left_out(shared: Path, name: str, band: str | None) -> None:
    """The heights as seen in the trees: a floor of one layer, one of two with a ceiling at 2.6 m, walls only."""
    grid, notes = project(tree(shared / "data/octomap" / name))
    assert [t.value for t in notes.template] == ([band] if band else [])
    counts = grid.counts()
    assert counts["free"] > counts["occupied"], "the ground is no obstacle"
    same, _ = project(tree(shared / "data/octomap" / name), band=tuple(map(float, band.split(","))) if band else FULL)
    assert np.array_equal(grid.cells, same.cells)


def test_low_ceiling_ends_the_band_and_level_moves_it() -> None:
    """A room of 40 × 40 voxels of 0.1 m and of 1.5 m height, with walls, on a floor at 1 m."""

    def code(x: int, y: int, z: int) -> int:
        return sum(
            1 << 3 * k + b for b, v in enumerate((HALF + x, HALF + y, HALF + z)) for k in range(16) if v >> k & 1
        )

    side = range(40)
    walls = {(x, y, z) for z in range(10, 26) for x in side for y in (0, 39)}
    walls |= {(x, y, z) for z in range(10, 26) for y in side for x in (0, 39)}
    plates = {(x, y, z) for x in side for y in side for z in (10, 25)}
    voxels = leaves(*((16, code(*at), 1.0) for at in sorted(walls | plates)), resolution=0.1)
    grid, notes = project(voxels, elevation=1.0)
    assert [t.value for t in notes.template] == ["0.1,1.5"]
    assert grid.counts()["occupied"] == 4 * 39
    _, notes = project(leaves(*((16, code(*at), 1.0) for at in sorted(walls)), resolution=0.1))
    assert not notes.template, "walls alone are no floor"


def test_doubtful_projections_are_warned_of(shared: Path) -> None:
    plate = [(16, sum(1 << 3 * k + b for b, v in enumerate((x, y, 0)) for k in range(16) if v >> k & 1), 1.0)
             for x in range(8) for y in range(8)]  # fmt: skip
    _, notes = project(leaves(*plate))
    assert any("probably by the floor" in w.problem for w in notes.warnings)
    _, notes = project(leaves((16, 5, 1.0)))
    assert any("no free space" in w.problem for w in notes.warnings)
    _, notes = project(tree(shared / "data/octomap/joctomap_ecmrv4/ecmrv4_withfree.ot"))
    assert not notes.warnings


def test_too_large_grids_raise_cannot_convert() -> None:
    wide = leaves((16, 0, 1.0), (16, 8**16 - 1, 1.0))
    with pytest.raises(CannotConvert, match="65536 × 65536"):
        project(wide)
    one = leaves((1, 0, 1.0))
    with pytest.raises(CannotConvert, match="above the maximum of"):
        project(one)
    with pytest.raises(CannotConvert, match="above the maximum of"):
        project(leaves((16, 0, 1.0), (16, 8**7, 1.0)), resolution=0.001)


def test_empty_voxel_maps_raise_missing_layer() -> None:
    none = VoxelMap(0.1, np.empty(0, np.uint8), np.empty(0, np.uint64), np.empty(0, np.float32))
    for layers in (Layers(), Layers({PartKey("voxels"): none})):
        with pytest.raises(MissingLayer, match="the voxel maps are empty"):
            voxels_to_occupancy(layers, Parameters(), derive.DerivationNotes())


def test_large_leaves_cost_no_more_than_small_ones() -> None:
    """Thirty leaves of 4096³ voxels and a million small ones, in CPU seconds."""
    dice = np.random.default_rng(1)
    small = np.unique(dice.integers(0, 8**10, 1_000_000).astype(np.uint64))
    big = np.arange(8, 38, dtype=np.uint64)
    depth = np.concatenate([np.full(len(small), 16, np.uint8), np.full(30, 5, np.uint8)])
    odds = np.concatenate([np.ones(len(small), np.float32), -np.ones(30, np.float32)])
    voxels = VoxelMap(0.05, depth, np.concatenate([small, big]), odds)
    start = time.process_time()
    grid, _ = project(voxels)
    assert time.process_time() - start < 3.0
    counts = grid.counts()
    assert counts["occupied"] > 0
    assert counts["free"] > 2048**2


def test_band_parameter_works_over_http(api: Api, shared: Path) -> None:
    api.post("environments", {"name": "tree"})
    api.upload("tree", {"map.bt": (shared / "data/octomap/geb079/geb079.bt").read_bytes()})
    coverage = {t["format"]: t for t in api.get("environments/tree/versions/1/maps").json()}
    assert coverage["occupancy_grid"]["state"] == "derivable"
    assert [s["step"] for s in coverage["occupancy_grid"]["chain"]] == ["voxels_to_occupancy"]
    pgm = {
        band: api.get(f"/maps/tree/occupancy_grid/map.pgm{band}").content
        for band in ("", "?band=0.3,1.2", "?band=0.3,1.2&resolution=0.16")
    }
    assert len(set(pgm.values())) == 3
    assert pgm[""].startswith(b"P5\n487 187\n")
    report = api.get("environments/tree/versions/1/reports/occupancy_grid?band=0.3,1.2").json()
    (line,) = [one for one in report["layers"] if one["layer"] == "occupancy"]
    assert line["information"] == "derived"
    api.problem("GET", "/maps/tree/occupancy_grid?band=50,60", 422)
    api.problem("GET", "/maps/tree/occupancy_grid?band=high", 422)


def test_point_cloud_gives_grid(shared: Path) -> None:
    data = (shared / "data/pointcloud/pcl_data/room_scan1.pcd").read_bytes()
    converted = offline({"room.pcd": data}, "occupancy_grid", options={"band": "-0.5,0.5"})
    assert set(converted.files) == {"room.yaml", "room.pgm"} or set(converted.files) == {"map.yaml", "map.pgm"}
    assert any("no free space" in w["problem"] for w in converted.report.as_dict()["warnings"])
