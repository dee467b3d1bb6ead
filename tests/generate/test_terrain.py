"""Gradient noise against its definitions, and terrain whose height map, trees, grid and costs agree."""

from __future__ import annotations

import hashlib
import io
import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray
from PIL import Image

from app.cli import run
from app.convert.files import write_layers
from app.errors import CannotGenerate, Invalid
from app.generate import RandomSource, _kernels_noise, _noise
from app.model import solids
from app.model.features import features
from app.model.frame import Datum
from app.model.grid import FREE, OCCUPIED
from app.model.layers import Layers, PartKey
from tests.api.conftest import Api
from tests.generate import site_checks

Array = NDArray[np.float64]
GRID = PartKey("occupancy")
COSTS = PartKey("occupancy", name="costs")
NOISE, GROUND = "c9ffde907188bc8f", "ae1af6858e88e8e6"
SMALL: dict[str, Any] = {"width": 20, "depth": 15, "detail": "65"}


def table(seed: int = 1) -> NDArray[np.uint8]:
    order = np.random.default_rng(seed).permutation(256).astype(np.uint8)
    return np.concatenate([order, order])


def fade(t: float) -> float:
    return 6 * t**5 - 15 * t**4 + 10 * t**3


def unit(k: int) -> tuple[float, float]:
    return math.cos(k * math.pi / 4), math.sin(k * math.pi / 4)


def perlin(p: tuple[float, ...], t: NDArray[np.uint8]) -> float:
    """Perlin noise at one point, from its definition: the corners' ramps, blended."""
    base = [math.floor(v) for v in p]
    rest = [v - b for v, b in zip(p, base, strict=True)]
    total = 0.0
    for corner in np.ndindex(*[2] * len(p)):
        h = 0
        for k, c in enumerate(corner):
            h = int(t[(h + (base[k] & 255) + c) & 511])
        ramp = [r - c for r, c in zip(rest, corner, strict=True)]
        weight = math.prod(fade(r) if c else 1 - fade(r) for r, c in zip(rest, corner, strict=True))
        g = unit(h & 7) if len(p) == 2 else GRADIENTS[h & 15]
        total += weight * sum(a * b for a, b in zip(g, ramp, strict=True))
    return total * (math.sqrt(2) if len(p) == 2 else 1.0)


GRADIENTS = [
    *((u, v, 0.0) for v in (1.0, -1.0) for u in (1.0, -1.0)),
    *((u, 0.0, w) for w in (1.0, -1.0) for u in (1.0, -1.0)),
    *((0.0, v, w) for w in (1.0, -1.0) for v in (1.0, -1.0)),
    *((1.0, 1.0, 0.0), (-1.0, 1.0, 0.0), (0.0, -1.0, 1.0), (0.0, -1.0, -1.0)),
]


def simplex(p: tuple[float, ...], t: NDArray[np.uint8]) -> float:
    """Simplex noise at one point, from its definition: the simplex' corners are found by sorting."""
    n = len(p)
    skew, back = (math.sqrt(n + 1) - 1) / n, (1 - 1 / math.sqrt(n + 1)) / n
    base = [math.floor(v + sum(p) * skew) for v in p]
    origin = [v - (b - sum(base) * back) for v, b in zip(p, base, strict=True)]
    order = sorted(range(n), key=lambda k: -origin[k])
    total = 0.0
    for many in range(n + 1):
        step = [1 if k in order[:many] else 0 for k in range(n)]
        d = [o - s + many * back for o, s in zip(origin, step, strict=True)]
        reach = (0.5 if n == 2 else 0.6) - sum(v * v for v in d)
        if reach <= 0:
            continue
        h = 0
        for k in range(n):
            h = int(t[(h + (base[k] & 255) + step[k]) & 511])
        g = unit(h & 7) if n == 2 else GRADIENTS[h & 15]
        total += reach**4 * sum(a * b for a, b in zip(g, d, strict=True))
    return total * (99.2 if n == 2 else 32.0)


@pytest.mark.parametrize(("kernel", "reference"), [("perlin", perlin), ("simplex", simplex)])
def test_noise_matches_its_definition(kernel: str, reference: Any) -> None:
    t = table()
    x, y, z = (np.random.default_rng(k).random(9) * 40 - 20 for k in range(3))
    flat, deep = np.zeros((9, 9)), np.full((9, 9, 9), 0.25)
    getattr(_kernels_noise, f"{kernel}2")(x, y, t, 1.0, flat)
    getattr(_kernels_noise, f"{kernel}3")(x, y, z, t, 0.5, deep)
    for r, k in np.ndindex(9, 9):
        assert flat[r, k] == pytest.approx(reference((x[k], y[r]), t), abs=1e-9)
        for s in range(9):
            assert deep[s, r, k] == pytest.approx(0.25 + 0.5 * reference((x[k], y[r], z[s]), t), abs=1e-9)


@pytest.mark.parametrize("kind", ["perlin", "simplex"])
def test_octaves_stay_in_range_and_are_smooth(kind: Any) -> None:
    draw = RandomSource(7, "noise").stream
    x = np.arange(0.0, 60.0, 0.05)
    plain = _noise.noise2(x, x[:200], _noise.Fractal(kind, 4.0, 1), draw("a"))
    assert 0.6 < np.abs(plain).max() <= 1.0
    assert abs(plain.mean()) < 0.15
    assert np.abs(np.diff(plain, axis=1)).max() < 0.1, "no steps"
    rough = _noise.noise2(x, x[:200], _noise.Fractal(kind, 4.0, 6, 0.7), draw("a"))
    assert np.abs(rough).max() <= 1.0
    assert np.abs(np.diff(rough, axis=1)).mean() > 2 * np.abs(np.diff(plain, axis=1)).mean()
    deep = _noise.noise3(x[:100], x[:100], np.array([0.0, 0.001, 30.0]), _noise.Fractal(kind, 4.0, 3), draw("b"))
    assert np.abs(deep[0] - deep[1]).max() < 0.01
    assert np.abs(deep[0] - deep[2]).max() > 0.1


def test_noise_of_same_seed_is_equal() -> None:
    out = hashlib.sha256()
    x = np.linspace(-9.0, 11.0, 64)
    for kind in ("perlin", "simplex"):
        fractal = _noise.Fractal(kind, 3.0, 5)  # type: ignore[arg-type]
        out.update(_noise.noise2(x, x, fractal, RandomSource(7, "n").stream("a")).tobytes())
        out.update(_noise.noise3(x, x[:5], x[:3], fractal, RandomSource(7, "n").stream("b")).tobytes())
    assert out.hexdigest()[:16] == NOISE


def numpys(x: Array, y: Array, t: NDArray[np.uint8]) -> Array:
    """Perlin noise as NumPy passes over the array."""
    i, j = np.floor(x).astype(int), np.floor(y).astype(int)
    u, v = (x - i)[None], (y - j)[:, None]
    gx, gy = np.array([unit(k) for k in range(8)]).T

    def ramp(a: int, b: int) -> Array:
        h = t[t[(i + a) & 255][None] + ((j + b) & 255)[:, None]] & 7
        return np.asarray(gx[h] * (u - a) + gy[h] * (v - b))

    s, w = (6 * q**5 - 15 * q**4 + 10 * q**3 for q in (u, v))
    low, high = (ramp(0, b) + s * (ramp(1, b) - ramp(0, b)) for b in (0, 1))
    return np.asarray(math.sqrt(2) * (low + w * (high - low)))


def test_noise_is_no_slower_than_numpy_passes() -> None:
    x, y, t = np.linspace(0, 37.3, 1000), np.linspace(0, 31.1, 1000), table()
    out = np.zeros((1000, 1000))
    _kernels_noise.perlin2(x, y, t, 1.0, out)
    assert np.abs(out - numpys(x, y, t)).max() < 1e-9

    def shortest_time(work: Any) -> float:
        times = []
        for _ in range(3):
            started = time.process_time()
            work()
            times.append(time.process_time() - started)
        return min(times)

    slow = shortest_time(lambda: numpys(x, y, t))
    for kernel in (_kernels_noise.perlin2, _kernels_noise.simplex2):
        assert shortest_time(lambda: kernel(x, y, t, 1.0, out)) <= 2 * slow  # noqa: B023


def without_costs(site: Layers) -> Layers:
    return Layers({k: p for k, p in site.parts.items() if k.name not in ("costs", "speed")}, site.datum, site.levels)


def test_terrain_site_is_consistent(tmp_path: Path) -> None:
    site, notes = site_checks.make("terrain", **SMALL)
    site_checks.agrees_with_itself(without_costs(site), 0.3)
    site_checks.serves(site)
    site_checks.sound_sdf(site, tmp_path)
    assert not notes.warnings
    assert site_checks.digest(site) == site_checks.digest(site_checks.make("terrain", **SMALL)[0])
    assert site_checks.digest(site) != site_checks.digest(site_checks.make("terrain", seed=8, **SMALL)[0])
    assert site_checks.digest(site)[:16] == GROUND
    world = write_layers(site, "gazebo", {}, site_checks.CAME).files
    assert b"ground_plane" not in world["world.sdf"], "nothing is above the hills"
    assert b"walls_" not in world["world.sdf"], "costs are no walls"
    assert any(name.endswith("heightmaps/terrain.png") for name in world)


def test_height_map_is_below_floor_with_trees_on_it() -> None:
    site, _ = site_checks.make("terrain", relief=2.0, **SMALL)
    (objects,) = site.vector("objects").values()
    files = site.resources()
    with Image.open(io.BytesIO(files["heightmaps/terrain.png"])) as picture:
        grey = np.asarray(picture)
        assert picture.mode == "L"
    assert grey.shape == (65, 65)
    assert (grey.min(), grey.max()) == (0, 255)
    ground = next(p for p in objects.properties if p["kind"] == "terrain")
    low_x, low_y, low, high_x, high_y, high = solids.bounds(ground, files) or (0.0,) * 6
    assert (low_x, low_y, high_x, high_y) == pytest.approx((0, 0, 20, 15))
    assert (low, high) == pytest.approx((-2.0, 0.0), abs=0.01)
    trees = objects.select_kinds("tree")
    assert len(trees) > 3
    for properties in trees.properties:
        x, y, z, *_ = properties["pose"]
        ground_height = grey[::-1][round(y / 15 * 64), round(x / 20 * 64)] / 255 * 2.0 - 2.0
        assert z == pytest.approx(ground_height, abs=0.25)
        trunk = properties["shapes"][0]
        assert z + trunk["length"] > 2.9, "it is met above the floor"


def test_slopes_cost_and_steep_ground_is_blocked() -> None:
    site, _ = site_checks.make("terrain", relief=3.0, climb=20, **SMALL)
    grid, costs = site.grids()[GRID], site.grids()[COSTS]
    assert costs.mode == "raw"
    assert len(np.unique(costs.cells)) > 50
    assert (costs.cells[grid.cells == OCCUPIED] == OCCUPIED).all()
    steep = (costs.cells == OCCUPIED) & (grid.cells == FREE)
    assert 0 < steep.sum() < grid.cells.size
    (network,) = site.vector("topology").values()
    lines = [g for g, p in zip(network.geometry, network.properties, strict=True) if p["kind"] == "edge"]
    at = shapely.get_coordinates(shapely.line_interpolate_point(np.array(lines, object), 0.5, normalized=True))
    column, row = ((at - grid.origin[:2]) / grid.resolution).astype(int).T
    assert not steep[row, column].any()
    # By hand: the slope of the map that Gazebo gets, between its own heights.
    with Image.open(io.BytesIO(site.resources()["heightmaps/terrain.png"])) as picture:
        height = np.asarray(picture, float)[::-1] / 255 * 3.0
    up_y, up_x = np.gradient(height, 15 / 64, 20 / 64)
    share = np.hypot(up_x, up_y) / math.tan(math.radians(20))
    r, c = np.meshgrid(np.arange(5, 60, 5), np.arange(5, 60, 5), indexing="ij")
    cell = (r * 15 / 64 / 0.05).astype(int), (c * 20 / 64 / 0.05).astype(int)
    free = grid.cells[cell] == FREE
    assert np.abs(costs.cells[cell] - np.minimum(share[r, c], 1.0) * 99)[free].max() < 12


def test_terrain_speed_mask_replaces_costs() -> None:
    site, _ = site_checks.make("terrain", rough="speed", **SMALL)
    mask = site.grids()[PartKey("occupancy", name="speed")]
    assert mask.cells.min() >= 10
    assert mask.cells.max() <= 100
    files = write_layers(site, "occupancy_grid", {"grid": "speed"}, site_checks.CAME).files
    assert any(name.endswith("_filter_info.yaml") for name in files)
    plain, _ = site_checks.make("terrain", rough="none", **SMALL)
    assert set(plain.grids()) == {GRID}


def test_time_changes_terrain_slightly() -> None:
    def ground(epoch: float) -> Array:
        site, _ = site_checks.make("terrain", epoch=epoch, vegetation=0, **SMALL)
        with Image.open(io.BytesIO(site.resources()["heightmaps/terrain.png"])) as picture:
            return np.asarray(picture, float)

    now, soon, later = ground(0.0), ground(0.2), ground(300.0)
    assert 0 < np.abs(now - soon).mean() < 0.25 * np.abs(now - later).mean()

    def woods(epoch: float) -> set[tuple[float, float]]:
        site, _ = site_checks.make("terrain", epoch=epoch, **SMALL)
        (objects,) = site.vector("objects").values()
        return {tuple(p["pose"][:2]) for p in objects.properties if p["kind"] == "tree"}

    assert len(woods(0.0) & woods(0.2)) > len(woods(0.0) & woods(300.0))


def test_bare_ground_has_posts_at_its_corners() -> None:
    site, notes = site_checks.make("terrain", vegetation=0, **SMALL)
    site_checks.agrees_with_itself(without_costs(site), 0.3)
    (objects,) = site.vector("objects").values()
    assert [p["kind"] for p in objects.properties].count("post") == 4
    assert any(t.subject == "posts" for t in notes.template)


def test_terrain_stays_inside_fence() -> None:
    fence = shapely.Polygon([(-7, -3), (9, -5), (12, 8), (-2, 11)])
    given = Layers(
        {PartKey("location", name="site"): features([("fence", fence, {"kind": "fence"})], "local")}, Datum(52.0, 5.0)
    )
    site, _ = site_checks.make("terrain", given=given, vegetation=0.6, detail="65")
    site_checks.agrees_with_itself(without_costs(Layers({**given.parts, **site.parts}, given.datum)), 0.3)


@pytest.mark.parametrize(
    ("values", "why"),
    [
        ({"width": 0}, "at least 2"),
        ({"width": 1e9}, "at most 5000"),
        ({"width": 5000, "depth": 5000, "resolution": 0.05}, "coarser"),
        ({"octaves": 0}, "at least 1"),
        ({"octaves": 10**9}, "at most 16"),
        ({"detail": "100"}, "one of 65, 129"),
        ({"noise": "white"}, "one of simplex, perlin"),
        ({"spacing": 0.5, "width": 5000, "depth": 5000}, "the limit is .*: use a larger spacing"),
        ({"feature": 10_000, "octaves": 1, "persistence": 0, "width": 2, "depth": 2, "relief": -1}, "at least 0.01"),
    ],
)
def test_invalid_terrain_parameters_raise(values: dict[str, Any], why: str) -> None:
    started = time.process_time()
    with pytest.raises((CannotGenerate, Invalid), match=why):
        site_checks.make("terrain", **values)
    assert time.process_time() - started < 5.0


def test_terrain_is_generated_over_http(api: Api) -> None:
    site_checks.make("terrain", **SMALL)  # so that native code is there, which takes a minute on a busy machine
    version = site_checks.over_http(api, "terrain", ("occupancy_grid", "gazebo", "tmap2"), **SMALL)
    assert version["information"]["occupancy"] == "generated"
    env = "environments/made-terrain/generations"
    problem = api.problem("POST", env, 422, json={"generator": "terrain", "seed": 1, "parameters": {"octaves": 99}})
    assert "octaves" in problem["detail"]


def test_terrain_is_generated_on_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "world.zip"
    options = [word for key, value in SMALL.items() for word in ("-O", f"{key}={value}")]
    status = run(["generate", "terrain", "--seed", "7", "--to", "gazebo", "-o", str(out), *options])
    assert status == 0, capsys.readouterr().err
    assert out.stat().st_size > 1000
