"""Occupancy -> objects: parallel rows of plants, posts or shelves in a grid, with their headlands."""

from __future__ import annotations

from dataclasses import dataclass

from app.derive import DerivationNotes, derives
from app.derive._row_features import ROWS, fields_of, row_items
from app.model.features import features
from app.model.grid import is_occupied
from app.model.layers import Layers, Part, PartKey
from app.model.selection import grid_label, select_grids
from app.parameters import parameter


@dataclass(frozen=True, slots=True)
class Parameters:
    """Parameters of occupancy_to_rows."""

    grid: str | None = parameter(
        None, "name of the grid; default: map, else the only one on a level that is not a filter mask"
    )
    headland_depth: float = parameter(
        4.5, "depth of the headlands at the ends of rows", minimum=0.5, maximum=50.0, unit="m"
    )


@derives(gives="objects", needs={"occupancy"}, parameters=Parameters, cost=60.0, version=4)
def occupancy_to_rows(layers: Layers, parameters: Parameters, notes: DerivationNotes) -> Layers:
    """Rows in a grid: lines of kind ``row`` with their distance and direction, and headlands.

    Rows may be lines, or posts and trunks at distances up to 4 m; at least three of 5 m stand side by side at regular
    distances. ``rows_to_topology`` makes a network of the aisles. A row's ``confidence`` is 0 to 1. Raises
    CannotConvert if there are none.
    """
    parts: dict[PartKey, Part] = {}
    for key, grid in select_grids(layers, parameters.grid, "rows").items():
        label = grid_label(key)
        fields = fields_of([is_occupied(grid, grid.cells)], grid.resolution, grid.origin, notes, label)
        parts[PartKey("objects", key.level, ROWS)] = features(row_items(fields, parameters.headland_depth), "local")
    return Layers(parts, layers.datum, layers.levels)
