"""Occupancy -> imagery: a floor plan drawn from the map, if there is no photograph or drawing."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from app.derive import DerivationNotes, derives
from app.errors import CannotConvert, MissingDatum
from app.model import raster
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.imagery import GeoImage
from app.model.layers import Layers, Part, PartKey
from app.model.raster import RasterFrame
from app.model.selection import as_planned, grid_label, select_grids
from app.parameters import parameter

NAME = "plan"
MAX_PIXELS = 2**26
GRID_PURPOSE = "obstacles"

PAPER, INK, NOTHING = (246, 246, 242), (44, 46, 52), (205, 205, 205)
"""Red, green, blue of free, occupied and unknown cells; costs are shades between paper and ink."""

COLOURS: Mapping[str, tuple[int, int, int]] = {
    "building": (178, 124, 104),
    "roof": (178, 124, 104),
    "water": (122, 166, 198),
    "vegetation": (116, 152, 96),
    "tree": (82, 124, 68),
    "tree_row": (82, 124, 68),
    "hedge": (82, 124, 68),
    "shelf": (92, 120, 164),
    "furniture": (160, 134, 104),
    "door": (206, 160, 82),
    "wall": (70, 70, 76),
    "barrier": (70, 70, 76),
}
EDGE = (196, 64, 56)


@dataclass(frozen=True, slots=True)
class Parameters:
    """Parameters of occupancy_to_imagery."""

    grid: str | None = parameter(None, "name of the occupancy grid; default: map, else the only one")
    pixel: float | None = parameter(
        None, "size of a pixel; default: the grid's cells, or coarser to keep the image below 2^26 pixels",
        minimum=1e-3, maximum=100.0, unit="m",
    )  # fmt: skip
    draw_objects: bool = parameter(True, "whether buildings, trees, water, shelves … are drawn over the cells")
    draw_network: bool = parameter(False, "whether the network's edges are drawn")


def _try(layers: Layers, parameters: Parameters) -> None:
    for key, grid in select_grids(layers, parameters.grid, GRID_PURPOSE).items():
        _step(grid, parameters.pixel, grid_label(key))


@derives(
    gives="imagery",
    needs={"occupancy"},
    also=frozenset({"objects", "topology"}),
    parameters=Parameters,
    cost=40.0,
    version=2,
    last=True,
    trial=_try,
)
def occupancy_to_imagery(layers: Layers, parameters: Parameters, notes: DerivationNotes) -> Layers:
    """Plan in plain colours, drawn from the grid, with objects and optionally the network over it.

    Pixels [height, width, 4] red, green, blue, alpha, with transparent unknown cells; in the local frame, along the
    grid's axes. A pixel of several cells shows occupied before free. Raises NotFound, MissingLayer or Ambiguous if no
    grid can be selected, CannotConvert if the plan would have too many pixels.
    """
    parts: dict[PartKey, Part] = {}
    for key, stored in select_grids(layers, parameters.grid, GRID_PURPOSE).items():
        grid = as_planned(stored, grid_label(key), notes.warn)
        step = _step(grid, parameters.pixel, grid_label(key))
        cells = _coarser(grid.cells, step)
        size = grid.resolution * step
        if step > 1 and parameters.pixel is None:
            notes.warn(f"pixels are {step} cells wide, {size:g} m; a finer plan would be too large")
        if parameters.pixel is not None and not math.isclose(size, parameters.pixel, rel_tol=1e-6):
            notes.fill("pixel", round(size, 9), "pixels are whole cells of the grid", "pixel")
        pixels = _colour_cells(cells)
        frame = RasterFrame((0.0, 0.0), size, cells.shape[1], cells.shape[0])
        if parameters.draw_objects:
            _draw_objects(pixels, layers, key.level, grid, frame, notes)
        if parameters.draw_network:
            _draw_network(pixels, layers, key.level, grid, frame, notes)
        x, y, yaw = grid.origin
        c, s = math.cos(yaw), math.sin(yaw)
        up = cells.shape[0] * size
        transform = (size * c, size * s, x - s * up, size * s, -size * c, y + c * up)
        parts[PartKey("imagery", key.level, NAME)] = GeoImage(np.ascontiguousarray(pixels[::-1]), transform)
    notes.warn("the image is a plan drawn from the map, not a photograph")
    return Layers(parts, layers.datum, layers.levels)


def _step(grid: OccupancyGrid, pixel: float | None, label: str) -> int:
    """Return the number of cells along the side of a pixel."""
    if pixel is not None:
        step = max(1, round(pixel / grid.resolution))
        if grid.width * grid.height / step**2 > MAX_PIXELS:
            raise CannotConvert(
                f"a plan of {label} with {pixel:g} m per pixel would have more than {MAX_PIXELS} pixels: enlarge it"
            )
        return step
    return max(1, math.ceil(math.sqrt(grid.width * grid.height / MAX_PIXELS)))


def _coarser(cells: NDArray[np.uint8], step: int) -> NDArray[np.uint8]:
    """Return the highest cost in each block of step × step cells; unknown only if all of them are."""
    if step == 1:
        return cells
    height, width = (-(-n // step) for n in cells.shape)
    out = np.full((height, width), UNKNOWN, np.uint8)
    for first in range(step):  # row by row of each block, to avoid a copy of the grid
        rows = cells[first::step] + np.uint8(1)  # unknown becomes 0, costs 1 … 101
        rows = np.pad(rows, ((0, 0), (0, width * step - cells.shape[1]))).reshape(len(rows), width, step).max(axis=2)
        part = out[: len(rows)]
        np.copyto(part, np.maximum(part + np.uint8(1), rows) - np.uint8(1))
    return out


def _colour_cells(cells: NDArray[np.uint8]) -> NDArray[np.uint8]:
    table = np.zeros((256, 4), np.uint8)
    share = np.linspace(0.0, 1.0, OCCUPIED + 1 - FREE)[:, None]
    table[FREE : OCCUPIED + 1, :3] = np.round((1 - share) * np.array(PAPER) + share * np.array(INK))
    table[FREE : OCCUPIED + 1, 3] = 255
    table[OCCUPIED + 1 :, :3] = NOTHING
    return table[cells]


def _draw_objects(
    pixels: NDArray[np.uint8],
    layers: Layers,
    level: str,
    grid: OccupancyGrid,
    frame: RasterFrame,
    notes: DerivationNotes,
) -> None:
    shapes: dict[str, list[Any]] = {}
    for part in layers.vector("objects", level).values():
        kinds = [str(p.get("kind")) for p in part.properties]
        rows = [k for k, kind in enumerate(kinds) if kind in COLOURS]
        if not rows:
            continue
        try:
            geometries = part.select(rows).in_local(layers.frame)
        except MissingDatum:
            notes.drop("objects", len(rows), "they have WGS 84 coordinates and there is no datum; not drawn")
            continue
        for row, geometry in zip(rows, geometries, strict=True):
            width = part.properties[row].get("width")
            if isinstance(width, int | float) and not isinstance(width, bool) and 0 < width < 1000:
                geometry = geometry if geometry.geom_type.endswith("Polygon") else geometry.buffer(width / 2)  # noqa: PLW2901
            shapes.setdefault(kinds[row], []).append(geometry)
    for kind in sorted(shapes, key=list(COLOURS).index):
        _paint(pixels, shapes[kind], COLOURS[kind], grid, frame)


def _draw_network(
    pixels: NDArray[np.uint8],
    layers: Layers,
    level: str,
    grid: OccupancyGrid,
    frame: RasterFrame,
    notes: DerivationNotes,
) -> None:
    for part in layers.vector("topology", level).values():
        edges = part.select_kinds("edge")
        try:
            geometries = edges.in_local(layers.frame)
        except MissingDatum:
            notes.drop("edges", len(edges), "they have WGS 84 coordinates and there is no datum; not drawn")
            continue
        _paint(pixels, list(geometries), EDGE, grid, frame)


def _paint(
    pixels: NDArray[np.uint8], shapes: list[Any], colour: tuple[int, int, int], grid: OccupancyGrid, frame: RasterFrame
) -> None:
    """Draw geometries: polygons filled, lines one pixel wide; points are skipped."""
    x, y, yaw = grid.origin
    c, s = math.cos(yaw), math.sin(yaw)
    turn = np.array([[c, -s], [s, c]])
    inside = shapely.transform(np.array(shapes, object), lambda xy: (xy - [x, y]) @ turn)
    pieces = shapely.get_parts(shapely.get_parts(inside))
    mask = np.zeros(pixels.shape[:2], np.uint8)
    raster.paint(mask, raster.areas(list(pieces[shapely.get_dimensions(pieces) > 0]), frame, touched=False), 1)
    pixels[mask == 1] = (*colour, 255)
