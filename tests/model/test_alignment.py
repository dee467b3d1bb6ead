"""Alignment of maps: known motions are found again."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from app.errors import CannotConvert, Invalid
from app.model import alignment
from app.model.alignment import Fit
from app.model.grid import FREE, OCCUPIED, OccupancyGrid


def hall(resolution: float = 0.05, noise: float = 0.0) -> OccupancyGrid:
    """Return a room of 12 × 8 m with inner walls and pillars, without symmetry."""
    cells = np.full((round(8 / resolution), round(12 / resolution)), FREE, np.uint8)

    def wall(x0: float, y0: float, x1: float, y1: float) -> None:
        a, b, c, d = (round(v / resolution) for v in (y0, y1, x0, x1))
        cells[a : max(b, a + 2), c : max(d, c + 2)] = OCCUPIED

    for box in ((0, 0, 12, 0.1), (0, 7.9, 12, 8), (0, 0, 0.1, 8), (11.9, 0, 12, 8), (4, 0, 4.1, 5), (4, 5, 7, 5.1)):
        wall(*box)
    for x, y in ((8, 2), (9.5, 2), (9.5, 6), (2, 3), (1.5, 6.5)):
        wall(x, y, x + 0.4, y + 0.3)
    if noise:
        chance = np.random.default_rng(3).random(cells.shape)
        cells[(cells == OCCUPIED) & (chance < noise)] = FREE
        cells[chance > 1 - noise / 100] = OCCUPIED
    return OccupancyGrid(cells, resolution, (-3.0, 2.0, 0.0))


def away(fit: Fit, x: float, y: float, yaw: float) -> tuple[float, float]:
    """Return (metres at the hall's middle, degrees) between a fit and a known motion."""
    middle = np.array([[3.0, 6.0]])
    computed, expected = fit.apply_to(middle), Fit(x, y, yaw, 0, 1).apply_to(middle)
    return float(np.linalg.norm(computed - expected)), abs(math.degrees(math.remainder(fit.yaw - yaw, 2 * math.pi)))


@pytest.mark.parametrize(
    ("x", "y", "degrees"), [(0.0, 0.0, 0.0), (1.3, -2.7, 11.3), (-20.0, 4.0, -97.0), (3.0, 3.0, 179.0)]
)
def test_align_grids_finds_known_motion(x: float, y: float, degrees: float) -> None:
    onto = hall()
    # the moved map is a coarser, damaged map of the hall
    out = Fit(x, y, math.radians(degrees), 0.0, 1.0)
    moving = out.move_grid(hall(0.1, noise=0.2))
    fit = alignment.align_grids(moving, onto)[0]
    back = fit.move_grid(moving)
    assert math.dist(back.origin[:2], (-3.0, 2.0)) < 0.1, "within a cell of the coarser map"
    assert abs(math.degrees(back.origin[2])) < 0.2
    assert fit.agreement > 0.9
    assert fit.overlap > 0.97
    assert 0 < fit.residual < 0.1
    assert np.array_equal(back.cells, moving.cells)


def test_align_grids_keeps_to_angle_and_reach() -> None:
    onto = hall()
    moving = Fit(0.5, 0.0, math.radians(90), 0.0, 1.0).move_grid(hall())
    for fit in alignment.align_grids(moving, onto, angle=math.radians(20)):
        assert abs(fit.yaw) <= math.radians(20) + 2e-3
    far = Fit(30.0, 0.0, 0.0, 0.0, 1.0).move_grid(hall())
    assert alignment.align_grids(far, onto)[0].x == pytest.approx(-30, abs=0.05)
    fits: list[Fit] = []
    try:
        fits = alignment.align_grids(far, onto, reach=25.0)
    except CannotConvert as error:
        assert "nowhere" in error.detail
    assert all(f.score < 0.7 for f in fits)


def test_align_grids_prefers_nearest_of_equal_fits() -> None:
    cells = np.zeros((100, 100), np.uint8)
    cells[0:2], cells[-2:], cells[:, 0:2], cells[:, -2:] = (OCCUPIED,) * 4
    square = OccupancyGrid(cells, 0.1)
    moving = Fit(0.3, -0.2, math.radians(3), 0.0, 1.0).move_grid(square)
    fits = alignment.align_grids(moving, square)
    assert abs(math.degrees(fits[0].yaw) + 3) < 0.2
    assert len([f for f in fits if f.score > 0.95]) >= 4, "a square fits four ways"


def test_align_grids_counts_cells_from_the_threshold_on() -> None:
    fixed = hall()
    walls = np.where(fixed.cells == OCCUPIED, 80, fixed.cells).astype(np.uint8)
    moved = OccupancyGrid(walls, fixed.resolution, (fixed.origin[0] + 0.4, fixed.origin[1] - 0.3, 0.0), "scale")
    fit = alignment.align_grids(moved, fixed)[0]
    assert away(fit, -0.4, 0.3, 0.0) == pytest.approx((0.0, 0.0), abs=0.05)


def test_align_grids_rejects_grids_without_outline() -> None:
    nothing = OccupancyGrid(np.zeros((10, 10), np.uint8), 0.1)
    for a, b in ((nothing, hall()), (hall(), nothing)):
        with pytest.raises(CannotConvert, match="0 occupied border cells"):
            alignment.align_grids(a, b)
    solid = OccupancyGrid(np.full((40, 40), OCCUPIED, np.uint8), 0.1)
    assert alignment.align_grids(solid, solid)[0].score > 0.9


POINTS = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 5.0], [3.0, 8.0], [-4.0, 2.0]])


@pytest.mark.parametrize("count", [2, 3, 5])
def test_align_points_minimises_squares(count: int) -> None:
    truth = Fit(5.0, -1.0, math.radians(33.0), 0, 1)
    fit, bad, scale = alignment.fit_pairs(np.stack([POINTS[:count], truth.apply_to(POINTS[:count])], axis=1))
    assert away(fit, truth.x, truth.y, truth.yaw) == pytest.approx((0, 0), abs=1e-9)
    assert (fit.residual, bad) == (pytest.approx(0, abs=1e-9), [])
    assert scale == pytest.approx(1.0)


def test_align_points_reports_wrong_pairs() -> None:
    truth = Fit(5.0, -1.0, math.radians(-120.0), 0, 1)
    targets = truth.apply_to(POINTS)
    targets[2] += (6.0, -3.0)
    fit, bad, _ = alignment.fit_pairs(np.stack([POINTS, targets], axis=1))
    assert bad == [2]
    assert fit.agreement == 0.8
    assert away(fit, truth.x, truth.y, truth.yaw) == pytest.approx((0, 0), abs=1e-9)
    many = np.random.default_rng(1).uniform(-50, 50, (200, 2))
    moved = truth.apply_to(many) + np.random.default_rng(2).normal(0, 0.05, many.shape)
    moved[::3] = np.random.default_rng(4).uniform(-50, 50, moved[::3].shape)
    fit, bad, _ = alignment.fit_pairs(np.stack([many, moved], axis=1))
    assert set(range(0, 200, 3)) - set(bad) == set() or len(set(range(0, 200, 3)) - set(bad)) <= 1
    assert away(fit, truth.x, truth.y, truth.yaw) < (0.1, 0.2)
    assert fit.residual == pytest.approx(0.07, abs=0.03)
    _, _, scale = alignment.fit_pairs(np.stack([POINTS[:2], 2 * POINTS[:2]], axis=1))
    assert scale == pytest.approx(2.0)


@pytest.mark.parametrize(
    "pairs",
    [
        np.zeros((1, 2, 2)), np.zeros((3, 2, 2)), np.zeros((0, 2, 2)), np.full((3, 2, 2), np.nan),
        np.full((2, 2, 2), 1e9), np.zeros((2, 3)), np.stack([POINTS, 3 * POINTS], axis=1),
    ],
)  # fmt: skip
def test_align_points_rejects_undetermined_pairs(pairs: Any) -> None:
    with pytest.raises(Invalid) as refused:
        alignment.fit_pairs(pairs)
    assert refused.value.problems[0].where == "pairs"
