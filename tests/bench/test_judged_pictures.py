"""The pictures of what two checkouts derive, and the made-up maps that they show."""

from __future__ import annotations

import numpy as np
import shapely

from app.derive import DerivationNotes
from app.derive.imagery_to_occupancy import Parameters, imagery_to_occupancy
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.imagery import GeoImage
from app.model.layers import MAP, Layers, PartKey
from tests.bench.judged_pictures import AREAS, EDGE, INK, LINE, WIDTH, side_by_side, summary
from tests.bench.made_up_maps import PIXEL, double_line_plan, make_site, scan, visitor_plan


def room() -> OccupancyGrid:
    """Return a room of 8 × 4 m with a block in its middle; beyond its walls nothing is known."""
    cells = np.full((84, 164), UNKNOWN, np.uint8)
    cells[1:83, 1:163] = OCCUPIED
    cells[2:82, 2:162] = FREE
    cells[30:54, 72:92] = OCCUPIED
    return OccupancyGrid(cells, 0.05, (3.0, -2.0, 0.0))


def test_features_are_drawn_at_their_places_and_counted() -> None:
    area = {"rows": [(shapely.box(4.0, -1.0, 5.0, 0.0), {"kind": "door"})]}
    node = {"rows": [(shapely.Point(9.0, 1.0), {"kind": "node"}), (shapely.Point(9.5, 1.0), {"kind": "node"})]}
    layers = Layers({PartKey("occupancy", "ground", MAP): room()})
    picture = np.asarray(side_by_side("room", layers, [("before", area), ("now", node)]))
    panel = (WIDTH - EDGE) // 2 - EDGE
    scale = panel / 8.2

    def pixel(x: float, y: float, column: int) -> tuple[int, ...]:
        across = EDGE + column * (panel + EDGE) + (x - 3.0) * scale
        return tuple(picture[round(2 * LINE + (4.2 - 2.0 - y) * scale), round(across)].tolist())

    assert pixel(4.5, -0.5, 0) == AREAS["door"]
    assert pixel(4.5, -0.5, 1) == (255, 255, 255)
    assert pixel(9.0, 1.0, 1) == INK
    assert pixel(9.0, 1.0, 0) == (255, 255, 255)
    assert [summary(area), summary(node), summary({"fault": "not derived"})] == ["1 door", "2 nodes", "not derived"]


def test_picture_is_shown_beside_what_is_derived_of_it() -> None:
    image = GeoImage(np.full((40, 80, 3), (10, 120, 200), np.uint8), (0.1, 0.0, 0.0, 0.0, -0.1, 4.0))
    layers = Layers({PartKey("imagery", "ground", "plan"): image})
    cells = np.full((40, 80), UNKNOWN, np.uint8)
    cells[:20] = FREE  # the southern half
    picture = np.asarray(side_by_side("plan", layers, [("now", {"cells": cells})]))
    low, high = 2 * LINE + 5, picture.shape[0] - EDGE
    middle = 3 * WIDTH // 4
    assert picture[low, WIDTH // 4].tolist() == [10, 120, 200]
    assert (picture[low, middle].tolist(), picture[high, middle].tolist()) == ([205] * 3, [255] * 3)


def test_scan_sees_no_inside_of_walls() -> None:
    grid = room()
    seen = scan(grid).cells
    assert (seen[34:50, 76:88] == UNKNOWN).all(), "the block's inside"
    assert (seen[4:80, 4:160][grid.cells[4:80, 4:160] == FREE] == FREE).mean() > 0.95
    assert (seen == OCCUPIED).sum() > 300
    assert (seen[~((grid.cells == FREE) | (grid.cells == OCCUPIED))] == FREE).sum() == 0


def test_drawn_plans_show_rooms_that_are_derived() -> None:
    site = make_site("office", levels=1, length=14.0)
    for pixels in (double_line_plan(site), visitor_plan(site)):
        image = GeoImage(pixels, (PIXEL, 0.0, 0.0, 0.0, -PIXEL, len(pixels) * PIXEL))
        layers = Layers({PartKey("imagery", "ground", "plan"): image})
        (grid,) = imagery_to_occupancy(layers, Parameters(), DerivationNotes()).parts.values()
        assert isinstance(grid, OccupancyGrid)
        assert 0.3 < (grid.cells == FREE).mean() < 0.7
        assert (grid.cells[:10] == UNKNOWN).all(), "the ground outside"
