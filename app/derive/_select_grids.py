"""Which of the stored occupancy grids a derivation looks at."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from app.derive import DerivationNotes
from app.derive._select import parts_with_name, select_per_level
from app.errors import MissingLayer
from app.model import masks
from app.model.grid import OccupancyGrid, unknown_grey, unknown_grey_as_unknown
from app.model.layers import MAP, Layers, PartKey


def select_grids(layers: Layers, name: str | None, label: str) -> dict[PartKey, OccupancyGrid]:
    """One grid for each level: the named one, else ``map``, else the only one that is no costmap filter mask.

    label: what masks do not tell, for the error. Raises NotFound, MissingLayer where there are masks alone, Ambiguous.
    """
    grids = layers.grids()
    if name is not None:
        return parts_with_name(grids, name, "occupancy grid")
    maps = {k: g for k, g in grids.items() if k.name not in masks.MASKS and masks.NAME not in g.properties}
    if not maps:
        raise MissingLayer(f"costmap filter masks alone tell no {label}: upload an occupancy grid of what stands there")
    return select_per_level(maps, MAP, "occupancy grid", "grid")


def as_planned(grid: OccupancyGrid, name: str, notes: DerivationNotes) -> OccupancyGrid:
    """The grid with free cells of unknown's grey as unknown, and a warning where there are such cells."""
    grey = unknown_grey(grid)
    if grey is not None:
        notes.warn(grey_warning(grid, grey, name, "they are taken as unknown"))
    return unknown_grey_as_unknown(grid)


def grey_warning(grid: OccupancyGrid, grey: NDArray[np.bool_], name: str, effect: str) -> str:
    """The warning of free cells of unknown's grey. effect: what happens to them."""
    return (
        f"{name} has {int(np.count_nonzero(grey))} cells of the grey 205, map_saver's unknown, which its "
        f"free_thresh of {grid.free_thresh:g} calls free: {effect}; write "
        "free_thresh: 0.196 where such cells mean unknown"
    )


def grid_label(key: PartKey) -> str:
    """What errors call a grid."""
    return f"the occupancy grid {key.name!r} of level {key.level!r}"
