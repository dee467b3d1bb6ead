"""Cellular automata: the rule is kept, free space is one piece for a robot too, trees are objects with shapes."""

from __future__ import annotations

import hashlib
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from app.cli import run
from app.errors import CannotGenerate, Invalid
from app.generate import _automata
from app.model.features import features
from app.model.frame import Datum
from app.model.grid import FREE, OCCUPIED
from app.model.layers import Layers, PartKey
from tests.api.conftest import Api
from tests.generate import site_checks

Bool = NDArray[np.bool_]
GRID = PartKey("occupancy")
LIFE = ((3,), (2, 3))
HASHES = {"cave": "1a2fcd83953d20d8", "cluttered_hall": "6ae03efe0e59ab9e", "forest": "0a64c1fd36839249"}
SMALL: dict[str, dict[str, Any]] = {
    "cave": {"width": 15, "depth": 12},
    "cluttered_hall": {"width": 10, "depth": 8},
    "forest": {"width": 30, "depth": 25},
}


def picture(*rows: str) -> Bool:
    return np.array([[c == "#" for c in row] for row in rows])


def by_hand(alive: Bool, born: set[int], stays: set[int], outside: bool) -> Bool:
    """One step, cell by cell."""
    out = np.zeros_like(alive)
    around = np.pad(alive, 1, constant_values=outside)
    for y in range(alive.shape[0]):
        for x in range(alive.shape[1]):
            n = int(around[y : y + 3, x : x + 3].sum()) - int(alive[y, x])
            out[y, x] = n in (stays if alive[y, x] else born)
    return out


def pieces(free: Bool) -> int:
    return int(cv2.connectedComponents(free.astype(np.uint8), connectivity=4)[0]) - 1


def test_conway_glider_moves() -> None:
    glider = picture(".#......", "..#.....", "###.....", "........", "........", "........")
    later = picture("........", "..#.....", "...#....", ".###....", "........", "........")
    assert (_automata.run_automaton(glider, *LIFE, 4, outside=False) == later).all()
    block = picture("....", ".##.", ".##.", "....")
    assert (_automata.run_automaton(block, *LIFE, 1000, outside=False) == block).all()
    assert (_automata.run_automaton(glider, *LIFE, 0, outside=False) == glider).all()


@pytest.mark.parametrize("outside", [False, True])
@pytest.mark.parametrize(("born", "stays"), [("5678", "45678"), ("", "012345678"), ("012345678", ""), ("08", "08")])
def test_rules_give_hand_computed_cells(outside: bool, born: str, stays: str) -> None:
    alive = np.random.default_rng(3).random((23, 31)) < 0.45
    b, s = ({int(c) for c in digits} for digits in (born, stays))
    expected = by_hand(by_hand(alive, b, s, outside), b, s, outside)
    assert (_automata.run_automaton(alive, b, s, 2, outside=outside) == expected).all()


def test_many_rows_are_processed_in_strips(monkeypatch: pytest.MonkeyPatch) -> None:
    alive = np.random.default_rng(4).random((50, 40)) < 0.45
    expected = _automata.run_automaton(alive, *LIFE, 3, outside=True)
    monkeypatch.setattr(_automata, "STRIP", 40 * 7)
    assert (_automata.run_automaton(alive, *LIFE, 3, outside=True) == expected).all()


def test_step_takes_at_most_twice_the_numpy_sums() -> None:
    alive = np.random.default_rng(5).random((2000, 2000)) < 0.5
    padded = np.pad(alive.astype(np.uint8), 1)

    def sums() -> None:
        total = padded[:-2, :-2].copy()
        for y in range(3):
            for x in range(3):
                if (y, x) not in ((0, 0), (1, 1)):
                    total += padded[y : y + 2000, x : x + 2000]
        np.isin(total, (5, 6, 7, 8)) | (alive & (total == 4))

    def ours() -> None:
        _automata.run_automaton(alive, (5, 6, 7, 8), (4, 5, 6, 7, 8), 1, outside=True)

    assert shortest_time(ours) <= 2 * shortest_time(sums) + 0.02


def shortest_time(work: Any) -> float:
    times = []
    for _ in range(3):
        started = time.process_time()
        work()
        times.append(time.process_time() - started)
    return min(times)


def test_rooms_are_joined_and_holes_are_filled() -> None:
    rock = np.ones((40, 60), bool)
    for y, x, h, w in ((3, 3, 12, 12), (20, 4, 14, 10), (5, 40, 10, 15), (25, 40, 9, 9)):
        rock[y : y + h, x : x + w] = False
    rock[36:38, 24:26] = False  # no robot fits in
    rim = np.zeros_like(rock)
    rim[[0, -1]] = rim[:, [0, -1]] = True
    out, filled, passages = _automata.join_free_space(rock, rim, 1.2, 4, 4)
    assert passages == 3
    assert filled == 4
    assert pieces(~out) == 1
    assert out[rim].all()
    away = cv2.distanceTransform((~out).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    fits = away - 0.5 > 1.2
    assert pieces(fits) == 1
    assert fits[8, 8]
    assert fits[29, 44]
    none, filled_count, _ = _automata.join_free_space(np.ones((9, 9), bool), np.zeros((9, 9), bool), 1.0, 3, 1)
    assert none.all()
    assert filled_count == 0


@pytest.mark.parametrize("name", list(SMALL))
def test_automaton_site_is_consistent(name: str, tmp_path: Path) -> None:
    site, _ = site_checks.make(name, **SMALL[name])
    site_checks.agrees_with_itself(site, 0.3)
    site_checks.serves(site)
    site_checks.sound_sdf(site, tmp_path)
    assert "topology" in site.layers
    assert site_checks.digest(site) == site_checks.digest(site_checks.make(name, **SMALL[name])[0])
    assert site_checks.digest(site) != site_checks.digest(site_checks.make(name, seed=8, **SMALL[name])[0])
    assert hashlib.sha256(site.grids()[GRID].cells.tobytes()).hexdigest()[:16] == HASHES[name]


def test_forest_trees_have_solid_trunks_and_visual_crowns() -> None:
    site, _ = site_checks.make("forest", **SMALL["forest"])
    (trees,) = site.vector("objects").values()
    assert len(trees) > 20
    for properties in trees.properties:
        trunk, crown = properties["shapes"]
        assert trunk["type"] == "cylinder"
        assert 0.1 <= trunk["radius"] <= 0.25
        assert crown["visual"] is True
        assert 6.0 <= properties["height"] <= 14.0
        assert crown["pose"][2] + crown["radii"][2] == pytest.approx(properties["height"], abs=0.002)
    at = shapely.get_coordinates(trees.geometry)
    apart = np.sqrt(((at[:, None] - at[None]) ** 2).sum(axis=2)) + 1e9 * np.eye(len(at))
    assert apart.min() >= 2.5 * 0.4 - 0.01
    dense, _ = site_checks.make("forest", density=1.0, **SMALL["forest"])
    assert len(next(iter(dense.vector("objects").values()))) == 12 * 10


def test_automaton_site_stays_inside_fence() -> None:
    fence = shapely.Polygon([(-7, -3), (9, -5), (12, 8), (-2, 11)])
    given = Layers(
        {PartKey("location", name="site"): features([("fence", fence, {"kind": "fence"})], "local")}, Datum(52.0, 5.0)
    )
    for name in SMALL:
        site, _ = site_checks.make(name, given=given)
        site_checks.agrees_with_itself(Layers({**given.parts, **site.parts}, given.datum), 0.3)
        grid = site.grids()[GRID]
        row, column = np.nonzero(grid.cells == FREE)
        x, y = (column + 0.5) * grid.resolution + grid.origin[0], (row + 0.5) * grid.resolution + grid.origin[1]
        assert shapely.contains_xy(fence, x, y).all()
        assert (grid.cells == OCCUPIED).any()


@pytest.mark.parametrize(
    ("name", "values", "why"),
    [
        ("cave", {"width": 0}, "at least 1"),
        ("cave", {"width": 1e9}, "at most 5000"),
        ("cave", {"width": 5000, "depth": 5000, "resolution": 0.05}, "more than 67108864 cells"),
        ("cave", {"width": 1000, "depth": 1000, "iterations": 1000}, "use fewer"),
        ("cave", {"rule": "B9/S1"}, "neighbours from 0 to 8"),
        ("cave", {"rule": "nonsense"}, "neighbours from 0 to 8"),
        ("cave", {"rule": "B012345678/S012345678"}, "no free space is left"),
        ("cave", {"density": 1.5}, "at most 1"),
        ("cave", {"iterations": 10**9}, "at most 1000"),
        ("cave", {"cell": 0.07, "resolution": 0.05}, "whole number of cells"),
        ("cave", {"cell": 10}, "at least 5 × 5"),
        ("cluttered_hall", {"density": 1.0, "rule": "B/S012345678"}, "no free space is left"),
        ("forest", {"spacing": 0.5, "trunk": (0.1, 1)}, "would touch"),
        ("forest", {"spacing": 0.5, "jitter": 0, "trunk": (0.1, 0.2), "width": 5000, "depth": 5000}, "larger spacing"),
        ("forest", {"trunk": (0.3, 0.2)}, "smaller value must come first"),
        ("forest", {"density": 0.0}, "no tree is left"),
    ],
)
def test_invalid_automaton_parameters_raise(name: str, values: dict[str, Any], why: str) -> None:
    started = time.process_time()
    with pytest.raises((CannotGenerate, Invalid), match=why):
        site_checks.make(name, **values)
    assert time.process_time() - started < 3.0


def test_automaton_site_is_generated_over_http(api: Api) -> None:
    for name, values in SMALL.items():
        site_checks.make(name, **values)  # so that native code is there, which takes a minute on a busy machine
        version = site_checks.over_http(api, name, ("occupancy_grid", "tmap2", "gazebo"), **values)
        assert version["information"]["objects"] == "generated"
    env = "environments/made-cave/generations"
    problem = api.problem("POST", env, 422, json={"generator": "cave", "seed": 1, "parameters": {"rule": "x"}})
    assert "B5678/S45678" in problem["detail"]


def test_automaton_site_is_generated_on_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, values in SMALL.items():
        out = tmp_path / f"{name}.zip"
        options = [word for key, value in values.items() for word in ("-O", f"{key}={value}")]
        status = run(["generate", name, "--seed", "7", "--to", "occupancy_grid", "-o", str(out), *options])
        assert status == 0, capsys.readouterr().err
        assert out.stat().st_size > 100
