"""Location -> occupancy: a blank grid of the fence, to draw on or to drive by GNSS alone."""

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
    """A blank occupancy grid: free inside the fence, unknown outside; it knows of no obstacle.

    The ground around objects of unknown extent is unknown. The origin is a whole multiple of the resolution, yaw 0.
    Raises MissingLayer where there is a datum but no fence, or objects have solids that cannot be read; CannotConvert
    where the grid would be too large.
    """
    reading_notes = DerivationNotes()
    obstacles = sites(layers, reading_notes)
    unreadable = [reason for site in obstacles.values() for reason in site.unreadable]
    if unreadable:
        raise unreadable_error(unreadable, "a blank grid would call ground free that is not known")
    parts: dict[PartKey, Part] = {}
    for level, fence in fences(layers, notes.warn).items():
        frame = grid_frame(shapely.bounds(fence).tolist(), parameters.resolution, notes)
        cells = empty_cells(frame, fence, [])
        if level in obstacles:
            obstacles[level].draw_unknown(cells, frame)
        parts[PartKey("occupancy", level, MAP)] = OccupancyGrid(cells, frame.resolution, (*frame.origin, 0.0))
    if not parts:
        raise MissingLayer("a blank grid needs a fence: upload a datum.yaml with gnss_fence, or a drawing as location")
    notes.warnings += reading_notes.warnings
    notes.warn("the grid is blank: it is free wherever the fence allows, and knows of no obstacle")
    return Layers(parts, layers.datum, layers.levels)
