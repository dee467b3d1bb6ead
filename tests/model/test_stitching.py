"""Merging of grids: known positions are found again, and what cannot be decided is refused."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from app.errors import Invalid
from app.model import stitching
from app.model.alignment import Fit
from app.model.grid import FREE, OCCUPIED, UNKNOWN, UNKNOWN_GREY, OccupancyGrid, pack_cells
from tests.model.test_alignment import hall

STAY = Fit(0.0, 0.0, 0.0, 0.0, 1.0)


def piece(
    whole: OccupancyGrid, left: float, right: float, degrees: float, resolution: float | None = None
) -> OccupancyGrid:
    """Return what a robot saw between two x, in its own frame: turned, with its origin at the middle of its view."""
    size = resolution or whole.resolution
    half = math.ceil(7.5 / size)
    v, u = np.mgrid[-half:half, -half:half] + 0.5
    yaw = math.radians(degrees)
    x = u * size * math.cos(yaw) - v * size * math.sin(yaw) + (left + right) / 2
    y = u * size * math.sin(yaw) + v * size * math.cos(yaw) + 6.0
    column = np.floor((x - whole.origin[0]) / whole.resolution).astype(int)
    row = np.floor((y - whole.origin[1]) / whole.resolution).astype(int)
    inside = (x >= left) & (x < right) & (row >= 0) & (row < whole.height) & (column >= 0) & (column < whole.width)
    cells = np.full(inside.shape, UNKNOWN, np.uint8)
    cells[inside] = whole.cells[row[inside], column[inside]]
    return OccupancyGrid(cells, size, (-half * size, -half * size, 0.0))


def truth(left: float, right: float, degrees: float) -> Fit:
    return Fit((left + right) / 2, 6.0, math.radians(degrees), 0.0, 1.0)


def errors(place: stitching.Placement, first: Fit, own: Fit) -> tuple[float, float]:
    """Return (metres at the middle of the grid, degrees) between a placement and the true position."""
    placed = first.apply_to(place.fit.apply_to(np.zeros((1, 2))))
    turn = math.remainder(place.fit.yaw + first.yaw - own.yaw, 2 * math.pi)
    return float(np.linalg.norm(placed - own.apply_to(np.zeros((1, 2))))), abs(math.degrees(turn))


@pytest.mark.parametrize(("degrees", "resolution"), [(0.0, 0.1), (73.0, 0.1), (-160.0, 0.2)])
def test_pieces_are_placed_by_what_they_share(degrees: float, resolution: float) -> None:
    whole = hall(0.1, noise=0.1)
    views = [(-3.0, 3.5, 10.0), (0.5, 9.0, degrees)]
    grids = [piece(whole, *views[0]), piece(whole, *views[1], resolution)]
    first, second = stitching.place_grids(grids, stitching.Bounds())
    assert first.fit.as_dict()["x"] == 0.0
    assert second.problem == ""
    metres, turned = errors(second, truth(*views[0]), truth(*views[1]))
    assert metres <= resolution
    assert turned <= 0.5
    assert second.fit.agreement > 0.9
    assert 0.2 < second.fit.overlap < 0.6
    assert second.walls > 3.0


def test_third_piece_may_share_with_the_second_only() -> None:
    whole = hall(0.1)
    views = [(-3.0, 1.9, 0.0), (2.0, 9.0, 120.0), (-1.0, 7.0, -40.0)]
    grids = [piece(whole, *view) for view in views]
    places = stitching.place_grids(grids, stitching.Bounds())
    assert [place.problem for place in places] == ["", "", ""]
    for place, view in zip(places[1:], views[1:], strict=True):
        metres, turned = errors(place, truth(*views[0]), truth(*view))
        assert metres <= 0.1
        assert turned <= 0.5
    mosaic = stitching.merge_cells(grids, [place.fit for place in places], "evidence")
    assert mosaic.freed == 0
    # 12 x 8 m of the hall, and nothing that nobody saw
    seen = int((mosaic.grid.cells != UNKNOWN).sum()) * mosaic.grid.resolution**2
    assert seen == pytest.approx(96.0, rel=0.03)


def corridor(length: float) -> OccupancyGrid:
    cells = np.full((30, round(length / 0.1)), FREE, np.uint8)
    cells[:2], cells[-2:] = OCCUPIED, OCCUPIED
    return OccupancyGrid(cells, 0.1)


def test_corridor_that_slides_is_ambiguous_until_it_has_a_pose() -> None:
    grids = [corridor(12.0), corridor(8.0)]
    _, place = stitching.place_grids(grids, stitching.Bounds())
    assert "positions fit nearly as well" in place.problem
    assert "give pairs, a pose" in place.problem
    assert place.rivals
    starts = {1: stitching.Start(Fit(3.0, 0.05, math.radians(2), 0.0, 0.0))}
    _, place = stitching.place_grids(grids, stitching.Bounds(), starts)
    assert place.problem == ""
    assert abs(math.degrees(place.fit.yaw)) < 0.5
    assert abs(place.fit.y) < 0.05
    assert abs(place.fit.x - 3.0) < 1.0


def test_pieces_without_a_common_area_are_refused_unless_pairs_place_them() -> None:
    whole = hall(0.1)
    views = [(-3.0, 1.5, 0.0), (4.0, 9.0, 30.0)]
    grids = [piece(whole, *view) for view in views]
    _, place = stitching.place_grids(grids, stitching.Bounds())
    assert "give pairs" in place.problem
    first, own = (truth(*view) for view in views)
    yaw, (x, y) = own.yaw - first.yaw, np.array([own.x - first.x, own.y - first.y])
    starts = {1: stitching.Start(Fit(float(x), float(y), yaw, 0.0, 0.0), is_exact=True)}
    _, place = stitching.place_grids(grids, stitching.Bounds(), starts)
    assert place.problem == ""
    assert "do not confirm" in place.warning
    assert errors(place, first, own) == pytest.approx((0.0, 0.0), abs=1e-6)


@pytest.mark.parametrize("value", [UNKNOWN, FREE])
def test_grid_without_walls_is_refused(value: int) -> None:
    empty = OccupancyGrid(np.full((50, 50), value, np.uint8), 0.1)
    for grids, role in (([hall(0.1), empty], "the grid has"), ([empty, hall(0.1)], "the first grid has")):
        _, place = stitching.place_grids(grids, stitching.Bounds())
        assert role in place.problem
        assert "give pairs of points" in place.problem


def test_same_grid_twice_lies_on_itself() -> None:
    whole = hall(0.1)
    _, place = stitching.place_grids([whole, whole], stitching.Bounds())
    assert place.problem == ""
    assert (place.fit.x, place.fit.y, place.fit.yaw) == pytest.approx((0, 0, 0), abs=1e-3)
    mosaic = stitching.merge_cells([whole, whole], [STAY, place.fit], "evidence")
    assert mosaic.conflicts == 0
    assert np.array_equal(stitching.merge_cells([whole, whole], [STAY, STAY], "newest").grid.cells, whole.cells)


def test_placing_is_reproducible() -> None:
    whole = hall(0.1, noise=0.1)
    grids = [piece(whole, -3.0, 3.5, 10.0), piece(whole, 0.5, 9.0, 73.0)]
    twice = [stitching.place_grids(grids, stitching.Bounds())[1].fit.as_dict() for _ in range(2)]
    assert twice[0] == twice[1]


def block(*rows: str) -> OccupancyGrid:
    codes = {"#": OCCUPIED, ".": FREE, "?": UNKNOWN, "5": 50}
    cells = np.array([[codes[c] for c in row] for row in rows[::-1]], np.uint8)
    return OccupancyGrid(cells, 1.0)


def text(cells: NDArray[np.uint8]) -> list[str]:
    names = {OCCUPIED: "#", FREE: ".", UNKNOWN: "?", 50: "5"}
    return ["".join(names[int(c)] for c in row) for row in cells[::-1]]


def test_seams_decide_conflicts() -> None:
    wall, clear = block("??????#.", "........"), block("........", "...5...?")
    two = [wall, clear]
    evidence = stitching.merge_cells(two, [STAY] * 2, "evidence")
    assert text(evidence.grid.cells) == ["......#.", "...5...."], "in doubt occupied, and a cost is never lowered"
    assert (evidence.conflicts, evidence.freed) == (1, 0)
    newest = stitching.merge_cells(two, [STAY] * 2, "newest")
    assert text(newest.grid.cells) == ["........", "...5...."]
    assert (newest.conflicts, newest.freed) == (1, 1)
    outvoted = stitching.merge_cells([wall, clear, clear, clear], [STAY] * 4, "evidence")
    assert text(outvoted.grid.cells)[0] == "........"
    assert (outvoted.conflicts, outvoted.freed) == (1, 1)
    # one cell apart is the same wall, seen from two places: no conflict, and no robot's wall is lost
    beside = stitching.merge_cells([block("??#."), block("...#")], [STAY] * 2, "evidence")
    assert text(beside.grid.cells) == ["..##"]
    assert beside.conflicts == 0


def test_merged_grid_grows_keeps_walls_and_leaves_the_rest_unknown() -> None:
    first, second = block("..", ".#"), block("?????", "?#.??", "?????")
    mosaic = stitching.merge_cells([first, second], [STAY, Fit(2.0, -3.0, 0.0, 0.0, 1.0)], "evidence")
    assert text(mosaic.grid.cells) == ["..???", ".#???", "?????", "???#."]
    assert mosaic.grid.origin == (0.0, -2.0, 0.0)
    line = OccupancyGrid(np.full((1, 40), OCCUPIED, np.uint8), 0.1)
    for degrees in (17.0, 45.0, 90.0):
        fit = Fit(0.0, 0.0, math.radians(degrees), 0.0, 1.0)
        turned = stitching.merge_cells([block("."), line], [STAY, fit], "evidence").grid
        solid = turned.cells == OCCUPIED
        x, y, _ = turned.origin
        middles = fit.apply_to(np.column_stack([np.arange(40) * 0.1 + 0.05, np.full(40, 0.05)]))
        column, row = np.floor((middles - [x, y]) / 0.1 + 1e-6).astype(int).T
        assert solid[row, column].all(), "each cell of the wall is there after a rotation"
        assert solid.sum() <= 80
    assert turned.resolution == 0.1, "of the finest grid"


def test_grey_of_unknown_cells_counts_as_unknown() -> None:
    grid = block("..#.")
    mask = np.array([[True, False, False, False]])
    grey = replace(grid, properties={UNKNOWN_GREY: pack_cells(mask)})
    merged = stitching.merge_cells([grey, block("????")], [STAY] * 2, "evidence").grid
    assert text(merged.cells) == ["?.#."]
    assert UNKNOWN_GREY not in merged.properties


def test_merged_grid_has_a_limit() -> None:
    far = Fit(1e6, 0.0, 0.0, 0.0, 1.0)
    with pytest.raises(Invalid, match="the limit is"):
        stitching.merge_cells([hall(0.1), hall(0.1)], [STAY, far], "evidence")
    fine = replace(hall(0.1), resolution=1e-4)
    with pytest.raises(Invalid, match="leave out the finest"):
        stitching.merge_cells([hall(0.1), fine], [STAY, STAY], "evidence")


def test_merged_grid_is_no_slice_of_the_objects() -> None:
    first = OccupancyGrid(np.zeros((3, 3), np.uint8), 0.1, properties={"slice": {"of": "objects"}, "kept": 1})
    second = OccupancyGrid(np.full((3, 3), 100, np.uint8), 0.1)
    assert stitching.merge_cells([first, second], [STAY, STAY], "newest").grid.properties == {"kept": 1}
