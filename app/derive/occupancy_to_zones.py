"""Occupancy -> zones: the rooms, corridors, doors, aisles and rows of a grid, with names.

Rooms and corridors are ground that walls enclose, divided at doors and at other necks (``_rooms``). A door is a gap
in a wall. Aisles and rows are long strips between parallel lines of obstacles (``_strips``): rows out of doors between
thin lines, as of plants; aisles elsewhere. Open ground has no rooms.

The part ``areas`` has one polygon each, with ``kind``, ``name``, ``area`` (m²), ``width`` (m; of a room, the diameter
of the largest free circle) and ``confidence``: the share of a room's outline that is wall or door, of an aisle's
shorter line that it faces, of a door's width that walls continue. Areas are numbered by kind: rooms, corridors and
doors as people read, rows and aisles group by group, in order across their direction (``_reading_order``).

Names last: an area that overlaps one of the same kind in the stored part keeps its id, name and further properties,
also if these were edited; a new one gets the next number.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from numpy.typing import NDArray

from app.derive import DerivationNotes, derives
from app.derive._areas import AREAS, Area, keep_names
from app.errors import CannotConvert
from app.model.features import features
from app.model.grid import FREE, OCCUPIED, OccupancyGrid
from app.model.layers import Layers, Part, PartKey
from app.model.selection import as_planned, grid_label, select_grids
from app.parameters import parameter

if TYPE_CHECKING:
    from app.derive._rooms import Rooms

RESOLUTION = 0.05
"""Smallest cell in metres in which areas are sought; finer grids are reduced."""

MAX_CELLS = 2**22
"""Number of cells above which a grid is reduced."""

MAX_CELL = 0.25
"""Largest cell in metres in which a door can be seen."""

THIN_FLANK = 1.0
"""Maximum width in metres of the lines beside a row, as of plants or posts."""

HOLE = 2.0
"""Area in square metres below which holes of areas are closed: furniture and posts."""


@dataclass(frozen=True, slots=True)
class Parameters:
    """Parameters of occupancy_to_zones."""

    grid: str | None = parameter(
        None, "name of the grid; default: map, else the only one on a level that is not a filter mask"
    )


@derives(
    gives="zones",
    needs={"occupancy"},
    parameters=Parameters,
    cost=5.0,
    version=3,
    also=frozenset({"zones"}),
    makes=frozenset({AREAS}),
)
def occupancy_to_zones(layers: Layers, parameters: Parameters, notes: DerivationNotes) -> Layers:
    """Rooms, corridors, doors, aisles and rows of a grid, with names: zones of the part areas.

    Raises CannotConvert if there is none, NotFound or Ambiguous if no grid can be selected.
    """
    parts: dict[PartKey, Part] = {}
    for key, grid in select_grids(layers, parameters.grid, "areas").items():
        unnamed = areas(as_planned(grid, grid_label(key), notes.warn), notes, grid_label(key))
        if unnamed:
            stored = layers.vector("zones", key.level).get(PartKey("zones", key.level, AREAS))
            rows = keep_names(unnamed, stored, layers.frame)
            parts[PartKey("zones", key.level, AREAS)] = features(rows, "local")
    if not parts:
        raise CannotConvert(
            "the grid shows no rooms, doors, aisles or rows: walls enclose nothing, and no lines of obstacles are "
            "parallel; draw zones with layer=zones instead"
        )
    notes.warn("areas were guessed from the shapes of free ground; review them, and rename them as people call them")
    return Layers(parts, layers.datum, layers.levels)


def areas(grid: OccupancyGrid, notes: DerivationNotes, called: str) -> list[Area]:
    """Return the areas of a grid, in metres of the local frame. called: name of the grid for messages."""
    from app.derive import _rooms, _strips

    seen = grid.cells <= OCCUPIED
    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    if not len(rows) or not (grid.cells == FREE).any():
        return []
    cells = grid.cells[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    factor = _factor(cells.size, grid.resolution)
    cell = grid.resolution * factor
    if cell > MAX_CELL:
        notes.warn(f"cells of {cell:g} m are too coarse for rooms and doors: areas need {MAX_CELL:g} m", where=called)
        return []
    margin = math.ceil(_rooms.POCKET / cell) + 2
    free, occupied = _reduced(cells, factor, grid.occupied_thresh, margin)
    corner = np.array([columns[0] - margin * factor, rows[0] - margin * factor]) * grid.resolution
    place = _Place(grid.origin, corner, cell)
    aisles = _strips.strips(occupied, free, cell)
    flanks = _strips.flank_cells(aisles, occupied)
    out = [*_room_areas(_rooms.rooms(free | flanks, occupied & ~flanks, cell), place)]
    halls = shapely.union_all([shape for _, shape, _ in out])
    for strip in aisles:
        shape = shapely.Polygon(place.metres(strip.corners + 0.5))
        thin = max(line.width for line in strip.flanks) * cell <= THIN_FLANK
        kind = "row" if thin and not halls.contains(shapely.centroid(shape)) else "aisle"
        width = 2 * shape.area / (shape.length - 2 * shape.area / _length(shape))
        words = {"width": round(float(width), 2), "confidence": round(strip.facing, 2)}
        out.append((kind, shape, words))
    return [(kind, shape, {**words, "area": round(float(shape.area), 2)}) for kind, shape, words in out]


def _length(shape: Any) -> float:
    corners = shapely.get_coordinates(shapely.minimum_rotated_rectangle(shape))
    return float(max(np.hypot(*(corners[1] - corners[0])), np.hypot(*(corners[2] - corners[1]))))


@dataclass(frozen=True, slots=True)
class _Place:
    """Where a reduced grid lies: the origin of the stored one, the corner in its metres, and the cell's size."""

    origin: tuple[float, float, float]
    corner: NDArray[np.float64]
    cell: float

    def metres(self, at: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return positions x, y in cells (0, 0 is the lower left corner) in metres of the local frame."""
        x, y, yaw = self.origin
        c, s = math.cos(yaw), math.sin(yaw)
        u, v = (self.corner + np.asarray(at) * self.cell).T
        return np.asarray(np.round(np.stack([x + c * u - s * v, y + s * u + c * v], axis=1), 6) + 0.0)


def _factor(count: int, resolution: float) -> int:
    """Return by how much cells are reduced."""
    return max(1, math.floor(RESOLUTION / resolution + 1e-6), math.ceil(math.sqrt(count / MAX_CELLS)))


def _reduced(
    cells: NDArray[np.uint8], factor: int, occupied_thresh: float, margin: int
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the free and the occupied cells of a coarser grid with a margin of unknown ones."""
    free = cells == FREE
    occupied = (cells >= occupied_thresh * 100) & (cells <= OCCUPIED) & ~free
    if factor > 1:
        height, width = (-(-n // factor) * factor for n in cells.shape)
        grown = [np.pad(m, ((0, height - cells.shape[0]), (0, width - cells.shape[1]))) for m in (free, occupied)]
        blocks = [m.reshape(height // factor, factor, width // factor, factor).any(axis=(1, 3)) for m in grown]
        free, occupied = blocks[0] & ~blocks[1], blocks[1]
    return np.pad(free, margin), np.pad(occupied, margin)


def _room_areas(rooms: Rooms, place: _Place) -> Iterable[Area]:
    """Yield the rooms and corridors, and the doors between them, in metres."""
    from rasterio.features import shapes

    outlines: dict[int, list[Any]] = {}
    for geometry, label in shapes(rooms.labels, mask=rooms.labels > 0, connectivity=4):
        outlines.setdefault(int(label), []).append(shapely.geometry.shape(geometry))
    for label, kind in rooms.kinds.items():
        shape = shapely.simplify(max(outlines[label], key=lambda s: s.area), 1.5)
        if isinstance(shape, shapely.Polygon):
            limit = HOLE / place.cell**2
            shape = shapely.Polygon(shape.exterior, [h for h in shape.interiors if shapely.Polygon(h).area >= limit])
        metres = shapely.make_valid(shapely.transform(shape, place.metres))
        width, confidence = rooms.widths[label] * place.cell, rooms.enclosed[label]
        yield kind, metres, {"width": round(width, 2), "confidence": round(confidence, 2)}
    for door in rooms.doors:
        a, b = place.metres(door.ends + 0.5)
        along = (b - a) / np.hypot(*(b - a))
        aside = np.array([-along[1], along[0]]) * 0.2
        shape = shapely.Polygon([a - aside, b - aside, b + aside, a + aside])
        width = max(place.cell, (door.width - 1.0) * place.cell)
        yield "door", shape, {"width": round(width, 2), "confidence": round(door.confidence, 2)}
