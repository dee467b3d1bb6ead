"""Occupancy -> objects: a grid's obstacles as trees or posts, walls and furniture, classified by shape.

A connected piece of occupied cells is

========= =============================================================================================================
a post    if it is round (or, among trees, of any shape and no larger than a trunk), its inside unknown or not: a laser
          scanner sees only the rim, or a part of it
a wall    if it is a straight piece no thicker than ``wall_width``; of other pieces all parts that are no thicker, each
          straight edge of their centreline within ``tolerance`` one wall
furniture if it is a rectangle that is thicker, or the rim of one around ground that was not seen, up to the size that
          the context allows; in offices also what is round and wider than 0.5 m, and a table on four separate legs
obstacle  otherwise, as an outline within ``tolerance``
========= =============================================================================================================

Walls that lie on one line within ``tolerance`` are joined over gaps up to ``wall_gap``, and so are the two faces of a
wall. What is shorter than ``wall_length`` then, or little longer and oblique to the main directions of the walls, is an
obstacle. Pieces around free cells are never solid. Cells count as occupied from the grid's ``occupied_thresh`` on;
unknown cells are no objects.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from app.derive import DerivationNotes, derives
from app.derive._figures import MAX_FIGURES, figures
from app.derive._shapes import Box, Disc, MaskShapes, ShapeLimits
from app.errors import CannotConvert, TooLarge
from app.model.features import features
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.layers import Layers, Part, PartKey
from app.model.selection import as_planned, grid_label, select_grids
from app.parameters import parameter

NAME = "occupancy"
"""Family and part name of these objects."""

CELLS = 2**29
"""Maximum number of cells that are processed."""

LEG = 0.25
"""Maximum size of a table's leg in metres."""

Row = tuple[str, Any, dict[str, Any]]


@dataclass(frozen=True, slots=True)
class Context:
    """Typical sizes in a context, in metres.

    heights of kinds; widest: post; longest: furniture; trunk: largest; round_furniture: diameter from which a disc is
    furniture, not a post; table: shortest and longest side of a table of which only legs are seen.
    """

    post: str
    furniture: str
    heights: Mapping[str, float]
    widest: float
    longest: float
    trunk: float = 0.0
    round_furniture: float = math.inf
    table: tuple[float, float] = (0.0, 0.0)


CONTEXTS: Mapping[str, Context] = {
    "forest": Context("tree", "rock", {"tree": 15.0, "rock": 1.0, "wall": 1.5, "obstacle": 1.5}, 3.0, 3.0, 1.0),
    "orchard": Context("tree", "crate", {"tree": 3.0, "crate": 1.0, "wall": 2.0, "obstacle": 2.0}, 4.0, 3.0, 0.6),
    "office": Context(
        "post",
        "furniture",
        {"post": 2.5, "furniture": 0.8, "wall": 2.5, "obstacle": 2.5},
        1.5,
        4.0,
        round_furniture=0.5,
        table=(0.4, 2.4),
    ),
    "warehouse": Context("post", "rack", {"post": 5.0, "rack": 3.0, "wall": 5.0, "obstacle": 5.0}, 1.5, 20.0),
}


@dataclass(frozen=True, slots=True)
class Parameters:
    """Parameters of occupancy_to_objects."""

    context: Literal["forest", "orchard", "office", "warehouse"] = parameter(
        "office",
        "kind of site; decides whether discs are trees (forest, orchard) or posts, and sizes of objects",
    )
    grid: str | None = parameter(
        None, "name of the grid; default: map, else the only one on a level that is not a filter mask"
    )
    minimum_size: float | None = parameter(
        None,
        "diameter below which a shape is dropped as a speck; default: two cells",
        minimum=0.0,
        maximum=100.0,
        unit="m",
    )
    height: float | None = parameter(
        None, "height of all objects; default: the context's height of each kind", minimum=1e-3, maximum=1e3, unit="m"
    )
    tolerance: float | None = parameter(
        None,
        "maximum distance of straight edges from the cells; default: one and a half cells",
        minimum=0.0,
        maximum=100.0,
        unit="m",
    )
    wall_width: float = parameter(
        0.4, "maximum thickness of a wall; at least three cells", minimum=0.0, maximum=10.0, unit="m"
    )
    wall_length: float = parameter(
        0.5, "minimum length of a wall; shorter pieces are obstacles", minimum=0.0, maximum=100.0, unit="m"
    )
    wall_gap: float = parameter(
        0.25, "maximum gap in a wall that is closed, at least two cells", minimum=0.0, maximum=10.0, unit="m"
    )


@derives(gives="objects", needs={"occupancy"}, parameters=Parameters, cost=60.0, version=6)
def occupancy_to_objects(layers: Layers, parameters: Parameters, notes: DerivationNotes) -> Layers:
    """Objects from a grid: posts or trees, walls and furniture by shape, with heights of a context.

    In local metres with ``pose`` and ``shapes`` (cylinders, boxes); irregular outlines have only a ``height``. Walls
    are their centrelines with a ``width``. Raises CannotConvert if nothing or everything is occupied, NotFound or
    Ambiguous if no grid can be selected.
    """
    parts: dict[PartKey, Part] = {}
    used: set[str] = set()
    for key, grid in select_grids(layers, parameters.grid, "obstacles").items():
        rows = _objects(
            as_planned(grid, grid_label(key), notes.warn),
            parameters,
            layers.elevation(key.level),
            notes,
            grid_label(key),
        )
        used.update(row[2]["kind"] for row in rows)
        parts[PartKey("objects", key.level, NAME)] = features(rows, "local")
    for kind in sorted(used):
        if parameters.height is None:
            value = CONTEXTS[parameters.context].heights[kind]
            notes.fill(
                f"height of {kind}",
                value,
                f"a grid has no heights; typical of the context {parameters.context}",
                "context",
            )
    if parameters.height is not None:
        notes.fill("height", parameters.height, "a grid has no heights", "height")
    notes.warn(f"kinds of objects were guessed from their shapes in the context {parameters.context}; review them")
    return Layers(parts, layers.datum, layers.levels)


def _objects(grid: OccupancyGrid, parameters: Parameters, floor: float, notes: DerivationNotes, name: str) -> list[Row]:
    context = CONTEXTS[parameters.context]
    cell = grid.resolution
    mask = _occupied_mask(grid, name)
    sizes = ShapeLimits(
        speck=2.0 if parameters.minimum_size is None else parameters.minimum_size / cell,
        disc=context.widest / cell,
        box=context.longest / cell,
        wall=max(parameters.wall_width / cell, 3.0) + 1e-6,
        small=context.trunk / cell,
        tolerance=1.5 if parameters.tolerance is None else parameters.tolerance / cell,
        length=parameters.wall_length / cell,
        gap=max(parameters.wall_gap / cell, 2.0),
        leg=LEG / cell,
        table=(context.table[0] / cell, context.table[1] / cell),
    )
    limit = sizes.speck * cell
    try:
        shapes = figures(mask, grid.cells == FREE, sizes)
    except CannotConvert as error:
        raise CannotConvert(f"{name}: {error.detail}") from error
    notes.drop("specks", shapes.specks, f"{name}: less than minimum_size={limit:g} m across")
    count = len(shapes.discs) + len(shapes.boxes) + len(shapes.walls) + len(shapes.areas)
    if not count:
        raise CannotConvert(
            f"{name} has only {shapes.specks} specks less than {limit:g} m across: set a smaller minimum_size"
        )
    if count > MAX_FIGURES:
        raise CannotConvert(
            f"{name} would be {count} objects; the limit is {MAX_FIGURES}: set minimum_size above {limit:g} m"
        )
    return _rows(shapes, grid, context, parameters.height, floor)


def _occupied_mask(grid: OccupancyGrid, name: str) -> NDArray[np.uint8]:
    """Return 1 for occupied cells. Raises CannotConvert if there are none, or if all known cells are occupied."""
    if grid.cells.size > CELLS:
        raise TooLarge(f"{name} has {grid.cells.size} cells, the maximum for deriving objects is {CELLS}")
    meaning = np.zeros(256, np.uint8)
    meaning[: OCCUPIED + 1] = np.arange(OCCUPIED + 1) / 100 >= grid.occupied_thresh
    meaning[FREE], meaning[OCCUPIED], meaning[UNKNOWN] = 0, 1, 0
    mask = np.asarray(meaning[grid.cells])
    if not mask.any():
        counts = grid.counts()
        summary = ", ".join(f"{counts[n]} {n}" for n in ("free", "unknown", "other") if counts[n])
        raise CannotConvert(
            f"{name} has no occupied cell ({summary}), so it shows no objects: upload a grid with obstacles"
        )
    if mask.all():
        raise CannotConvert(
            f"{name} is completely occupied, so it shows no separate objects: upload a grid with free space"
        )
    return mask


def _rows(shapes: MaskShapes, grid: OccupancyGrid, context: Context, height: float | None, floor: float) -> list[Row]:
    """Convert shapes to posts, walls, furniture and obstacles, each numbered from 1, in the local frame."""
    cell = grid.resolution
    x, y, yaw = grid.origin
    c, s = math.cos(yaw), math.sin(yaw)

    def placed(at: NDArray[np.float64]) -> NDArray[np.float64]:
        u, v = at[:, 0] * cell, at[:, 1] * cell
        return np.asarray(np.round(np.stack([x + c * u - s * v, y + s * u + c * v], axis=1), 9) + 0.0, np.float64)

    def high(kind: str) -> float:
        return context.heights[kind] if height is None else height

    def body(kind: str, figure: Disc | Box, size: list[float], solid: dict[str, Any]) -> dict[str, Any]:
        (px, py), h = placed(np.array([[figure.x, figure.y]]))[0].tolist(), high(kind)
        turned = figure.yaw + yaw if isinstance(figure, Box) else 0.0
        pose = [px, py, floor, 0.0, 0.0, round(math.remainder(turned, math.tau), 9) + 0.0]
        solid = {**solid, "pose": [0.0, 0.0, h / 2, 0.0, 0.0, 0.0]}
        return {"kind": kind, "pose": pose, "size": [*size, h], "height": h, "shapes": [solid]}

    rows: list[Row] = []
    numbers = dict.fromkeys((context.post, context.furniture), 0)
    for disc in shapes.discs:
        radius = round(disc.radius * cell, 6)
        kind = context.furniture if 2 * radius >= context.round_furniture else context.post
        numbers[kind] += 1
        k = numbers[kind]
        turn = np.arange(24) * (math.tau / 24)
        ring = np.stack([disc.x + disc.radius * np.cos(turn), disc.y + disc.radius * np.sin(turn)], axis=1)
        properties = body(kind, disc, [2 * radius] * 2, {"type": "cylinder", "radius": radius, "length": high(kind)})
        rows.append((f"{kind}/{k}", shapely.Polygon(placed(ring)), {**properties, "radius": radius}))
    for kind, boxes in (("wall", shapes.walls), (context.furniture, shapes.boxes)):
        for k, box in enumerate(boxes, numbers.get(kind, 0) + 1):
            size = [round(box.length * cell, 6), round(box.width * cell, 6)]
            properties = body(kind, box, size, {"type": "box", "size": [*size, high(kind)]})
            along, across = _axes(box)
            middle = np.array([box.x, box.y])
            if kind == "wall":
                half = along * max(box.length - box.width, 0.1 * box.length) / 2  # its ends are square, as RMF's are
                geometry: Any = shapely.LineString(placed(np.array([middle - half, middle + half])))
                properties["width"] = size[1]
            else:
                a, b = along * box.length / 2, across * box.width / 2
                corners = np.array([middle - a - b, middle + a - b, middle + a + b, middle - a + b])
                geometry = shapely.Polygon(placed(corners))
            rows.append((f"{kind}/{k}", geometry, properties))
    for k, area in enumerate(shapes.areas, 1):
        outline = shapely.make_valid(shapely.transform(area, placed))
        rows.append((f"obstacle/{k}", outline, {"kind": "obstacle", "height": high("obstacle")}))
    return rows


def _axes(box: Box) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    c, s = math.cos(box.yaw), math.sin(box.yaw)
    return np.array([c, s]), np.array([-s, c])
