"""Location -> occupancy: a grid of the fence without obstacles, to draw on or to drive by GNSS alone."""

from __future__ import annotations

from dataclasses import dataclass

import shapely

from app.derive import DerivationNotes, derives
from app.derive._obstacles import sites, unreadable_error
from app.derive.objects_to_occupancy import cell_size, empty_cells, grid_frame
from app.errors import MissingLayer
from app.model.fences import fences
from app.model.grid import OccupancyGrid
from app.model.layers import MAP, Layers, Part, PartKey


@dataclass(frozen=True, slots=True)
class Parameters:
    """How fine."""

    resolution: float | None = cell_size()


@derives(
    gives="occupancy",
    needs={"location"},
    also=frozenset({"objects", "resources"}),
    parameters=Parameters,
    cost=50.0,
    version=3,
    last=True,
)
def location_to_occupancy(layers: Layers, parameters: Parameters, notes: DerivationNotes) -> Layers:
    """Empty occupancy grid of the fence: free inside, unknown outside, without obstacles.

    The ground around objects of unknown extent is unknown. The origin is a multiple of the resolution, yaw 0. Raises
    MissingLayer if there is a datum but no fence, or if objects have unreadable solids; CannotConvert if the grid would
    be too large.
    """
    reading_notes = DerivationNotes()
    obstacles = sites(layers, reading_notes)
    unreadable = [reason for site in obstacles.values() for reason in site.unreadable]
    if unreadable:
        raise unreadable_error(unreadable, "an empty grid would mark unknown ground as free")
    parts: dict[PartKey, Part] = {}
    for level, fence in fences(layers, notes.warn).items():
        frame = grid_frame(shapely.bounds(fence).tolist(), parameters.resolution, notes)
        cells = empty_cells(frame, fence, [])
        if level in obstacles:
            obstacles[level].draw_unknown(cells, frame)
        parts[PartKey("occupancy", level, MAP)] = OccupancyGrid(cells, frame.resolution, (*frame.origin, 0.0))
    if not parts:
        raise MissingLayer("an empty grid needs a fence: upload a datum.yaml with gnss_fence, or a drawing as location")
    notes.warnings += reading_notes.warnings
    notes.warn("the grid is empty: everything inside the fence is free, and obstacles are missing")
    return Layers(parts, layers.datum, layers.levels)
