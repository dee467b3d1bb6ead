"""Wave-function collapse: windows and shares as in the sample, fixed cells kept; grids completed."""

from __future__ import annotations

import hashlib
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from app import generate
from app.cli import run
from app.derive import DerivationNotes
from app.errors import CannotGenerate, Invalid, MissingLayer
from app.generate import RandomSource, _wfc
from app.generate.wave_function_collapse import SAMPLES
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.layers import Layers, PartKey
from tests.api.conftest import Api
from tests.generate import site_checks

NAME = "wave_function_collapse"
GRID = PartKey("occupancy")
DRAW = RandomSource(7, "tests").stream
CELLS = "133544c3d3efcb5f"
COMPLETED = "db80781a61463687"
U8 = NDArray[np.uint8]

SHARE = 0.05
"""How far the share of occupied tiles, and of each pair of neighbours, may be from the sample's on 10 m × 10 m."""


def windows(cells: U8, n: int) -> set[bytes]:
    """All windows of n × n cells."""
    views = np.lib.stride_tricks.sliding_window_view(cells, (n, n)).reshape(-1, n * n)
    return {row.tobytes() for row in np.unique(views, axis=0)}


def collapse(sample: U8, size: int, pattern: int, draw: Any = DRAW, symmetry: Any = "none", **more: Any) -> U8:
    """Generate a square grid from a sample."""
    model = _wfc.learn(sample, tile=1, pattern=pattern, symmetry=symmetry, wrap=more.pop("wrap", False))
    fixed = more.pop("fixed", np.full((size, size), -1))
    return _wfc.render(model, _wfc.collapse_model(model, (size, size), fixed, draw, **more))


def pairs(cells: U8) -> list[float]:
    """Shares of the pairs of neighbours, along x and along y."""
    full = (cells == OCCUPIED).astype(int)
    both = (2 * full[:, :-1] + full[:, 1:], 2 * full[:-1] + full[1:])
    return [float((p == k).mean()) for p in both for k in range(4)]


def board() -> U8:
    return np.asarray((np.indices((4, 4)).sum(axis=0) % 2 * OCCUPIED), np.uint8)


def rooms() -> U8:
    """A room with two doors: without a connectivity rule its results are sometimes in several pieces."""
    out = np.zeros((16, 16), np.uint8)
    out[3:12, 3:12] = OCCUPIED
    out[4:11, 4:11] = FREE
    out[6:8, 3] = out[11, 7:10] = FREE
    return out


def test_board_of_two_colours_has_two_patterns() -> None:
    model = _wfc.learn(board(), tile=1, pattern=2, symmetry="all", wrap=True)
    assert model.patterns.tolist() == [[[0, 1], [1, 0]], [[1, 0], [0, 1]]]
    assert model.weights[0] == model.weights[1]
    assert model.allowed[:, :, 0].tolist() == [[2, 1]] * 4  # the tiles alternate in each direction
    for border in (False, True):
        out = collapse(board(), 10, 2, wrap=True, periodic=border)
        assert windows(out, 2) == windows(board(), 2)


def test_adjacent_tiles_occur_in_sample() -> None:
    sample = SAMPLES["warehouse"].cells(0.05)
    model = _wfc.learn(sample, tile=4, pattern=1, symmetry="none")
    tiles = _wfc.collapse_model(model, (20, 30), np.full((20, 30), -1), DRAW)
    blocks = sample.reshape(25, 4, 25, 4).transpose(0, 2, 1, 3).reshape(25, 25, 16)
    sample_pairs = [
        {(a.tobytes(), b.tobytes()) for a, b in zip(p.reshape(-1, 16), q.reshape(-1, 16), strict=True)}
        for p, q in ((blocks[:, :-1], blocks[:, 1:]), (blocks[:-1], blocks[1:]))
    ]
    tile_grid = model.tiles[tiles].reshape(20, 30, 16)
    for seen, p, q in (
        (sample_pairs[0], tile_grid[:, :-1], tile_grid[:, 1:]),
        (sample_pairs[1], tile_grid[:-1], tile_grid[1:]),
    ):
        assert {(a.tobytes(), b.tobytes()) for a, b in zip(p.reshape(-1, 16), q.reshape(-1, 16), strict=True)} <= seen
    assert len(np.unique(tiles)) > 5


@pytest.mark.parametrize("scan", [True, False])
@pytest.mark.parametrize("symmetry", ["none", "mirror", "rotate", "all"])
def test_every_window_occurs_in_sample(scan: bool, symmetry: Any) -> None:
    sample = SAMPLES["office"].cells(0.1)
    sample[5:9, 40] = OCCUPIED
    sample_windows = set().union(*(windows(np.ascontiguousarray(one), 3) for one in _wfc.symmetries(sample, symmetry)))
    out = collapse(sample, 60, 3, symmetry=symmetry, scan=scan)
    assert windows(out, 3) <= sample_windows
    wide = collapse(sample, 40, 3, symmetry=symmetry, scan=scan, periodic=True)
    assert windows(np.pad(wide, ((0, 2), (0, 2)), mode="wrap"), 3) <= sample_windows


def test_ten_metre_site_keeps_sample_shares_and_time_limit() -> None:
    sample = SAMPLES["warehouse"].cells(0.05)
    site_checks.make(NAME, width=3, depth=3)  # compiled, or loaded
    expected, sample_windows = pairs(sample), windows(sample, 5)
    for seed in range(2):
        started = time.process_time()
        out = collapse(sample, 200, 5, RandomSource(seed, "tests").stream)
        assert time.process_time() - started < 5.0
        assert abs((out == OCCUPIED).mean() - (sample == OCCUPIED).mean()) <= SHARE
        assert np.abs(np.array(pairs(out)) - expected).max() <= SHARE
        assert windows(out, 5) <= sample_windows


def test_pillars_are_within_walls() -> None:
    layers, _ = site_checks.make(NAME, sample="pillars", width=6, depth=6)
    kinds = {i.split("/")[0] for part in layers.vector("objects").values() for i in part.ids}
    assert kinds == {"pillar", "wall"}


def test_fixed_cells_stay() -> None:
    sample = SAMPLES["pillars"].cells(0.1)
    fixed = np.full((50, 50), -1)
    fixed[10, 10:14] = 1
    fixed[30:40, 30:40] = 0
    out = collapse(sample, 50, 3, fixed=fixed)
    assert (out[10, 10:14] == OCCUPIED).all()
    assert (out[30:40, 30:40] == FREE).all()
    assert windows(out, 3) <= windows(sample, 3)
    fixed[20, 22:25] = 1, 0, 1
    with pytest.raises(CannotGenerate, match=r"contradict the sample at row (18|19|20), column 2[0-4],"):
        collapse(sample, 50, 3, fixed=fixed)


def test_free_space_is_joined_when_requested() -> None:
    def free_pieces(out: U8) -> int:
        return int(cv2.connectedComponents((out == FREE).astype(np.uint8), connectivity=4)[0]) - 1

    counts = []
    for seed in range(3):
        draw = RandomSource(seed, "rooms").stream
        counts.append(free_pieces(collapse(rooms(), 60, 3, draw)))
        joined = collapse(rooms(), 60, 3, draw, joined=True)
        assert free_pieces(joined) == 1
        assert (joined == OCCUPIED).any()
        assert windows(joined, 3) <= windows(rooms(), 3)
    assert max(counts) > 1


def test_contradictory_sample_raises_cannot_generate() -> None:
    collapse(board(), 4, 2)  # compiled, or loaded
    started = time.process_time()
    with pytest.raises(CannotGenerate, match="contradict the sample"):
        collapse(np.array([[0, 100], [100, 100]], np.uint8), 20, 2)
    hard = (np.random.default_rng(2).integers(0, 2, (6, 6)) * OCCUPIED).astype(np.uint8)
    with pytest.raises(CannotGenerate, match="11 contradictions could not be repaired in 4 attempts"):
        collapse(hard, 30, 3, repairs=10, symmetry="all")
    assert time.process_time() - started < 5.0


def test_wfc_of_same_seed_gives_same_cells() -> None:
    out = collapse(SAMPLES["warehouse"].cells(0.1), 60, 4, RandomSource(7, "hash").stream, joined=True)
    free = collapse(rooms(), 40, 3, RandomSource(7, "hash").stream, scan=False)
    assert hashlib.sha256(out.tobytes() + free.tobytes()).hexdigest()[:16] == CELLS


@pytest.mark.parametrize(
    ("values", "why"),
    [
        ({"width": 0}, "at least 0.5"),
        ({"width": 1e9}, "at most 10000"),
        ({"width": 10_000, "depth": 10_000}, "more than 67108864 cells"),
        ({"width": 400, "depth": 400}, "tiles; the limit is 4194304"),
        ({"sample": "nave"}, "use one of warehouse, office, pillars, or a grid"),
        ({"model": "tiled", "pattern": 3}, "pattern: applies only to model=overlapping"),
        ({"tile": 64, "width": 50, "depth": 50, "border": "open"}, "does not contain"),
        ({"resolution": 0.0333}, "whole millimetres"),
        ({"wrap": True}, "has no walls"),
        ({"free": (1.0, 2.0, 3.0)}, "even number"),
        ({"free": (99.0, 2.0)}, "outside"),
        ({"free": (0.01, 2.0)}, "is on a wall"),
        ({"width": 0.5, "depth": 0.5, "tile": 4}, "has only"),
        ({"pattern": 9}, "at most 8"),
    ],
)
def test_invalid_wfc_parameters_raise_before_work(values: dict[str, Any], why: str) -> None:
    started = time.process_time()
    with pytest.raises((CannotGenerate, Invalid), match=why):
        site_checks.make(NAME, **values)
    assert time.process_time() - started < 3.0


def test_wfc_site_is_consistent(tmp_path: Path) -> None:
    site, notes = site_checks.make(NAME, width=8, depth=6, free=(4.0, 3.0), blocked=(2.0, 2.0))
    site_checks.agrees_with_itself(site, 0.3)
    grid = site.grids()[GRID]
    assert (grid.width, grid.height, grid.resolution, grid.origin) == (160, 120, 0.05, (0.0, 0.0, 0.0))
    assert grid.cells[60, 80] == FREE
    assert grid.cells[40, 40] == OCCUPIED
    rim = np.concatenate([grid.cells[0], grid.cells[-1], grid.cells[:, 0], grid.cells[:, -1]])
    assert (rim == OCCUPIED).all()
    kinds = {p["kind"] for part in site.vector("objects").values() for p in part.properties}
    assert kinds == {"wall", "rack"}
    assert not notes.warnings
    site_checks.serves(site)
    site_checks.sound_sdf(site, tmp_path)
    assert site_checks.digest(site) == site_checks.digest(
        site_checks.make(NAME, width=8, depth=6, free=(4.0, 3.0), blocked=(2.0, 2.0))[0]
    )
    assert site_checks.digest(site) != site_checks.digest(site_checks.make(NAME, seed=8, width=8, depth=6)[0])


@pytest.mark.parametrize("border", ["open", "periodic"])
def test_wfc_supports_other_borders_and_tiles(border: str) -> None:
    site, _ = site_checks.make(NAME, border=border, width=6, depth=6, model="tiled", order="entropy", symmetry="mirror")
    site_checks.agrees_with_itself(site, 0.3)


def test_environment_grid_serves_as_sample_inside_its_fence() -> None:
    first, _ = site_checks.make(NAME, width=6, depth=6)
    plan = {GRID: first.grids()[GRID], **{k: p for k, p in first.parts.items() if k.layer == "location"}}
    site, _ = site_checks.make(NAME, given=Layers(plan, first.datum), sample="map", pattern=3, symmetry="all")
    site_checks.agrees_with_itself(Layers({**plan, **site.parts}, site.datum), 0.3)
    assert site.grids()[GRID].cells.shape == first.grids()[GRID].cells.shape
    with pytest.raises(CannotGenerate, match=r"is the sample's, 0\.05 m"):
        site_checks.make(NAME, given=Layers(plan, first.datum), sample="map", resolution=0.1)


def holed() -> tuple[U8, U8]:
    """A place, and the same with an unknown hole."""
    complete = collapse(SAMPLES["warehouse"].cells(0.05), 120, 4)
    cells = complete.copy()
    cells[40:70, 50:90] = UNKNOWN
    cells[5, 5] = 42
    return complete, cells


def completed(cells: U8, seed: int = 7, **values: Any) -> tuple[U8, DerivationNotes]:
    notes = DerivationNotes()
    given = Layers({GRID: OccupancyGrid(cells, 0.05, properties={"kept": 1})})
    out = generate.run("complete_grid", seed, values, given, notes).grids()[GRID]
    assert out.properties == {"kept": 1}
    return out.cells, notes


@pytest.mark.parametrize("order", ["rows", "entropy"])
def test_unknown_part_is_completed_from_known_part(order: str) -> None:
    complete, cells = holed()
    out, notes = completed(cells, reach=0, confidence=0, order=order, symmetry="none")
    assert (out == cells)[cells != UNKNOWN].all()
    assert set(np.unique(out[cells == UNKNOWN])) <= {FREE, OCCUPIED}
    plain = np.where(out >= 65, OCCUPIED, FREE).astype(np.uint8)
    strange = windows(plain[37:73, 47:93], 3) - windows(complete, 3)
    assert len(strange) <= sum("do not occur" in w.problem for w in notes.warnings) * 40
    near, _ = completed(cells, reach=0.25, confidence=0, order=order)
    filled = (near != UNKNOWN) & (cells == UNKNOWN)
    assert 0 < filled.sum() < (cells == UNKNOWN).sum()
    assert not filled[46:64, 56:84].any(), "cells beyond the reach stay unknown"


def test_completion_is_repeatable() -> None:
    cells = np.full((20, 20), UNKNOWN, np.uint8)
    cells[:8] = board()[0, 0]
    cells[3:5, 4:16] = OCCUPIED
    out, _ = completed(cells, reach=0.3, confidence=0)
    assert hashlib.sha256(out.tobytes()).hexdigest()[:16] == COMPLETED
    assert out.tobytes() == completed(cells, reach=0.3, confidence=0)[0].tobytes()


def test_known_cells_without_pattern_are_skipped(shared: Path) -> None:
    with Image.open(shared / "data" / "occupancy_grid" / "nav2_tb3_sandbox" / "tb3_sandbox.pgm") as picture:
        grey = np.asarray(picture.convert("L"))[::-1]
    cells = np.where(grey < 90, OCCUPIED, np.where(grey > 220, FREE, UNKNOWN)).astype(np.uint8)
    out, notes = completed(cells, reach=0.4, confidence=0)
    assert (out == cells)[cells != UNKNOWN].all()
    assert (out == UNKNOWN).sum() < (cells == UNKNOWN).sum()
    assert all("do not occur in the known part" in w.problem for w in notes.warnings)


@pytest.mark.parametrize(
    ("cells", "values", "why"),
    [
        (np.zeros((9, 9), np.uint8), {}, "has no unknown cell"),
        (np.full((9, 9), UNKNOWN, np.uint8), {}, "no window of 3 × 3 cells is completely known"),
        (np.array([[0, 255], [255, 255]], np.uint8), {"pattern": 2}, "no window of 2 × 2"),
        (np.full((1100, 1100), UNKNOWN, np.uint8), {"reach": 0}, "1210000 cells would be filled in"),
        (np.pad(np.zeros((5, 5), np.uint8), 9, constant_values=UNKNOWN), {"reach": 0.01}, "use a larger reach"),
        (np.zeros((9, 9), np.uint8), {"pattern": 4}, "at most 3"),
    ],
)
def test_invalid_completions_raise(cells: U8, values: dict[str, Any], why: str) -> None:
    with pytest.raises((CannotGenerate, Invalid), match=why):
        completed(cells, **values)


def test_completion_without_grid_raises_missing_layer() -> None:
    with pytest.raises(MissingLayer, match="complete_grid needs occupancy"):
        generate.run("complete_grid", 7, {}, Layers(), DerivationNotes())


def test_wfc_site_is_generated_over_http(api: Api) -> None:
    version = site_checks.over_http(api, NAME, ("occupancy_grid", "tmap2", "gazebo"), width=6, depth=6)
    assert version["information"] | {"occupancy": "generated", "topology": "generated"} == version["information"]
    env = f"environments/made-{NAME}/generations"
    problem = api.problem("POST", env, 422, json={"generator": NAME, "seed": 1, "parameters": {"width": 0}})
    assert "width" in problem["detail"]
    problem = api.problem("POST", env, 422, json={"generator": "complete_grid", "seed": 1, "parameters": {}})
    assert "no unknown cell" in problem["detail"]


def test_wfc_site_is_generated_on_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "map.zip"
    status = run(
        ["generate", NAME, "--seed", "7", "--to", "occupancy_grid", "-o", str(out), "-O", "width=4", "-O", "depth=4"]
    )
    assert status == 0, capsys.readouterr().err
    assert out.stat().st_size > 100


def hall() -> NDArray[np.uint8]:
    """A closed hall of 14 m × 10 m in cells of 0.1 m: racks with aisles of 1.4 m between them, a gangway around."""
    cells = np.full((100, 140), FREE, np.uint8)
    cells[[0, 1, -2, -1]] = OCCUPIED
    cells[:, [0, 1, -2, -1]] = OCCUPIED
    for k in range(4):
        cells[18 + 20 * k : 24 + 20 * k, 20:120] = OCCUPIED
    return cells


def test_patches_of_a_grid_keep_racks_and_aisles() -> None:
    given = Layers({PartKey("occupancy", "ground", "map"): OccupancyGrid(hall(), 0.1)})
    for seed in (1, 2):
        notes = DerivationNotes()
        layers = generate.run(NAME, seed, {"sample": "map", "width": 16, "depth": 12}, given, notes)
        (grid,) = (g for k, g in layers.grids().items() if k.name == "map")
        full = (grid.cells == OCCUPIED).astype(np.uint8)
        assert full[0].all(), "walls, as the sample has them"
        assert full[:, -1].all()
        assert cv2.connectedComponents((grid.cells == FREE).astype(np.uint8), connectivity=4)[0] == 2
        _, _, stats, _ = cv2.connectedComponentsWithStats(full[5:-5, 5:-5], connectivity=8)
        racks = stats[1:][stats[1:, cv2.CC_STAT_WIDTH] * grid.resolution >= 3.0]
        assert len(racks) >= 3
        assert (racks[:, cv2.CC_STAT_HEIGHT] * grid.resolution <= 1.0).all(), "which do not grow together"
        assert [line.option for line in notes.template if line.subject == "tile"] == ["tile"]
        again = generate.run(NAME, seed, {"sample": "map", "width": 16, "depth": 12}, given, DerivationNotes())
        assert (next(g for k, g in again.grids().items() if k.name == "map").cells == grid.cells).all()


def test_patches_keep_fixed_places_and_refuse_what_does_not_fit() -> None:
    given = Layers({PartKey("occupancy", "ground", "map"): OccupancyGrid(hall(), 0.1)})
    values = {"sample": "map", "width": 16, "depth": 12}
    layers = generate.run(NAME, 1, {**values, "blocked": "8,6", "free": "4,3"}, given, DerivationNotes())
    (grid,) = (g for k, g in layers.grids().items() if k.name == "map")
    assert grid.cells[round(6 / grid.resolution), round(8 / grid.resolution)] == OCCUPIED
    assert grid.cells[round(3 / grid.resolution), round(4 / grid.resolution)] == FREE
    for wrong, why in (
        ({"free": "0.1,0.1"}, "free: .* is on a wall, or no patch of the sample fits"),
        ({"blocked": "99,1"}, "blocked: .* is outside the site"),
        ({"width": 1.5}, "width: each side must be at least"),
        ({"wrap": True}, "wrap: a sample that continues"),
    ):
        with pytest.raises(CannotGenerate, match=why):
            generate.run(NAME, 1, {**values, **wrong}, given, DerivationNotes())
    unknown = Layers({PartKey("occupancy", "ground", "map"): OccupancyGrid(np.full((40, 40), UNKNOWN, np.uint8), 0.1)})
    with pytest.raises(CannotGenerate, match="sample: has no known cell"):
        generate.run(NAME, 1, values, unknown, DerivationNotes())
