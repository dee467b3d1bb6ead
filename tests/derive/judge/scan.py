"""Judge the walls and objects that occupancy_to_objects derives from grids that robots recorded.

Keys of a label file of kind ``scan``, all positions in cells of the picture (x to the right, y down):

    map, sha256     the picture of the grid: dark cells are occupied, 205 is unknown
    resolution      metres per cell
    walls           [[x, y], [x, y]], the straight walls that a person would draw
    rounds          [x, y, radius], round objects: tables, bins, pillars
    tables          [[x, y] × 4], the legs of a table

Coverage: share of the occupied cells that the objects cover, with a margin of one cell. Count and median length of the
walls are compared with the labelled ones. Recall: share of the length of labelled walls within 0.15 m of a derived wall
of the same direction (± 10°), or of such a side of rectangular furniture: a person draws a pallet with four lines, or
as a box. Rounds and tables: share with a round object, or one piece of furniture, in their place.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray
from PIL import Image

from app.derive import DerivationNotes
from app.derive.occupancy_to_objects import Parameters, occupancy_to_objects
from app.model.features import Features
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.layers import MAP, Layers, PartKey
from tests.derive.judge import Case, Figure, Result

COVERAGE, RECALL, FACTOR, PLACES = 0.97, 0.8, 2.0, 0.5
REACH_METRES, TURN_DEGREES = 0.15, 10.0
SCALE = 3

Row = tuple[Any, Any]


def judge(case: Case) -> Result:
    """Derive objects from a labelled grid and compare its walls with those that a person drew."""
    grey, grid = read_grid(case)
    size = grid.resolution
    derived = occupancy_to_objects(Layers({PartKey("occupancy", "ground", MAP): grid}), Parameters(), DerivationNotes())
    (part,) = derived.parts.values()
    assert isinstance(part, Features)
    rows = [(f.geometry, f.properties) for f in part]
    walls = [shape for shape, properties in rows if properties["kind"] == "wall"]
    height = len(grey) * size
    labelled = [_to_metres(line, size, height) for line in case.labels["walls"]]
    figures = [
        Figure("occupied cells covered", _coverage(rows, grid), at_least=COVERAGE),
        Figure("walls", len(walls)),
        Figure("walls / labelled walls", len(walls) / len(labelled), at_least=1 / FACTOR, at_most=FACTOR),
        Figure(
            "median length / labelled",
            float(np.median([w.length for w in walls] or [0.0]) / np.median([w.length for w in labelled])),
            at_least=1 / FACTOR,
            at_most=FACTOR,
        ),
        Figure("recall of labelled walls", _recall(labelled, [*walls, *_sides(rows)]), at_least=RECALL),
        *_places(case, rows, size, height),
    ]
    return Result(figures, _picture(grey, rows, labelled, size))


def read_grid(case: Case) -> tuple[NDArray[np.uint8], OccupancyGrid]:
    """Return the labelled picture, and the grid that it shows."""
    with Image.open(case.file()) as image:
        grey = np.array(image.convert("L"))
    cells = np.full(grey.shape, FREE, np.uint8)
    cells[grey < 100] = OCCUPIED
    cells[grey == 205] = UNKNOWN
    return grey, OccupancyGrid(np.ascontiguousarray(cells[::-1]), float(case.labels["resolution"]), (0.0, 0.0, 0.0))


def _to_metres(line: Any, size: float, height: float) -> Any:
    at = (np.array(line, np.float64) + 0.5) * size
    return shapely.LineString(np.column_stack([at[:, 0], height - at[:, 1]]))


def _outline(shape: Any, properties: Any) -> Any:
    """Return the ground that an object covers; a wall is a centreline whose ends are square."""
    if shape.geom_type == "LineString":
        return shape.buffer(properties["width"] / 2, cap_style="square")
    return shape


def _coverage(rows: list[Row], grid: OccupancyGrid) -> float:
    ground = shapely.union_all([_outline(*row) for row in rows]).buffer(grid.resolution)
    shapely.prepare(ground)
    at = (np.argwhere(grid.cells == OCCUPIED)[:, ::-1] + 0.5) * grid.resolution
    return float(shapely.contains_xy(ground, at[:, 0], at[:, 1]).mean())


def _sides(rows: list[Row]) -> list[Any]:
    """Return the sides of rectangular furniture."""
    out = []
    for shape, properties in rows:
        if properties["kind"] == "furniture" and "radius" not in properties:
            corners = shapely.get_coordinates(shape)
            out += list(shapely.linestrings(np.stack([corners[:-1], corners[1:]], axis=1)))
    return out


def _direction(line: Any) -> float:
    (x0, y0), (x1, y1) = line.coords[0][:2], line.coords[-1][:2]
    return float(np.degrees(np.arctan2(y1 - y0, x1 - x0)) % 180)


def _recall(labelled: list[Any], walls: list[Any]) -> float:
    """Return the share of the labelled length that has a parallel wall nearby."""
    covered = total = 0.0
    turns = np.array([_direction(wall) for wall in walls])
    for line in labelled:
        apart = np.abs((turns - _direction(line) + 90) % 180 - 90)
        near = [wall for wall, turn in zip(walls, apart, strict=True) if turn <= TURN_DEGREES]
        covered += shapely.union_all([wall.buffer(REACH_METRES) for wall in near]).intersection(line).length
        total += line.length
    return covered / total


def _places(case: Case, rows: list[Row], size: float, height: float) -> list[Figure]:
    """Return the shares of round objects and of tables that were recognised."""
    out = []
    if case.labels.get("rounds"):
        right = 0
        for x, y, radius in case.labels["rounds"]:
            spot = shapely.Point((x + 0.5) * size, height - (y + 0.5) * size)
            right += any(
                "radius" in properties
                and spot.distance(shape.centroid) <= radius * size
                and 0.5 <= properties["radius"] / (radius * size) <= 2
                for shape, properties in rows
            )
        out.append(Figure("round objects", right / len(case.labels["rounds"]), at_least=PLACES))
    if case.labels.get("tables"):
        right = 0
        for legs in case.labels["tables"]:
            top = shapely.MultiPoint(_to_metres(legs, size, height).coords).convex_hull
            right += any(
                properties["kind"] == "furniture"
                and shape.intersection(top).area >= 0.6 * top.area
                and top.intersection(shape).area >= 0.6 * shape.area
                for shape, properties in rows
            )
        out.append(Figure("tables", right / len(case.labels["tables"]), at_least=PLACES))
    return out


COLOURS = {"wall": (200, 0, 0), "furniture": (0, 120, 220), "post": (0, 150, 60), "obstacle": (220, 140, 0)}


def _picture(grey: NDArray[np.uint8], rows: list[Row], labelled: list[Any], size: float) -> Image.Image:
    """Draw the objects over the grid, walls with dots at their ends; labelled walls light blue below them."""
    faded = (grey // 3 + 170).astype(np.uint8)
    out = cv2.cvtColor(cv2.resize(faded, None, fx=SCALE, fy=SCALE, interpolation=cv2.INTER_NEAREST), cv2.COLOR_GRAY2RGB)

    def pixels(shape: Any) -> NDArray[np.int32]:
        at = shapely.get_coordinates(shape)
        return np.round(np.column_stack([at[:, 0], len(grey) * size - at[:, 1]]) / size * SCALE).astype(np.int32)

    for line in labelled:
        cv2.polylines(out, [pixels(line)], False, (120, 200, 255), 5)
    for shape, properties in rows:
        colour = COLOURS.get(properties["kind"], (120, 0, 160))
        if shape.geom_type == "LineString":
            cv2.polylines(out, [pixels(shape)], False, colour, 1)
            for x, y in pixels(shape):
                cv2.circle(out, (int(x), int(y)), 2, colour, -1)
        else:
            for ring in shapely.get_rings(shapely.get_parts(shape)):
                cv2.polylines(out, [pixels(ring)], True, colour, 2)
    return Image.fromarray(out)
