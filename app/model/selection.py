"""Selection among several stored parts of a layer: one for each level."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from app.errors import Ambiguous, MissingLayer, NotFound
from app.model import masks
from app.model.grid import OccupancyGrid, unknown_grey, unknown_grey_as_unknown
from app.model.layers import MAP, Layers, PartKey
from app.model.names import did_you_mean

P = TypeVar("P")


def parts_with_name(parts: Mapping[PartKey, P], name: str, label: str) -> dict[PartKey, P]:
    """Return the parts of this name. label: their kind in errors. Raises NotFound with the existing names."""
    matches = {key: part for key, part in parts.items() if key.name == name}
    if not matches:
        names = sorted({key.name for key in parts})
        listing = ", ".join(names) or "none"
        raise NotFound(f"unknown {label} {name!r:.80}{did_you_mean(name, names)}; available: {listing}")
    return matches


def select_per_level(parts: Mapping[PartKey, P], usual: str, label: str, option: str) -> dict[PartKey, P]:
    """Return for each level the part of the default name, else the only one.

    Raises Ambiguous with the option to use.
    """
    out: dict[PartKey, P] = {}
    for level in dict.fromkeys(key.level for key in parts):
        level_parts = {key: part for key, part in parts.items() if key.level == level}
        chosen = {key: part for key, part in level_parts.items() if key.name == usual} or level_parts
        if len(chosen) > 1:
            listing = ", ".join(key.name for key in chosen)
            raise Ambiguous(f"level {level!r} has several {label}s ({listing}): name one with {option}=…")
        out.update(chosen)
    return out


def select_grids(layers: Layers, name: str | None, label: str) -> dict[PartKey, OccupancyGrid]:
    """Return one grid per level: the named one, else ``map``, else the only one that is no costmap filter mask.

    label: kind of information that masks lack, for the error. Raises NotFound, MissingLayer if there are only masks,
    Ambiguous.
    """
    grids = layers.grids()
    if name is not None:
        return parts_with_name(grids, name, "occupancy grid")
    maps = {k: g for k, g in grids.items() if k.name not in masks.MASKS and masks.NAME not in g.properties}
    if not maps:
        raise MissingLayer(f"costmap filter masks contain no {label}: upload an occupancy grid of the obstacles")
    return select_per_level(maps, MAP, "occupancy grid", "grid")


def as_planned(grid: OccupancyGrid, name: str, warn: Callable[[str], None]) -> OccupancyGrid:
    """Set free cells with the grey of unknown ones to unknown, and warn of them."""
    grey = unknown_grey(grid)
    if grey is not None:
        warn(grey_warning(grid, grey, name, "they count as unknown"))
    return unknown_grey_as_unknown(grid)


def grey_warning(grid: OccupancyGrid, grey: NDArray[np.bool_], name: str, effect: str) -> str:
    """Return the warning about free cells with the grey of unknown ones. effect: the consequence."""
    return (
        f"{name} has {int(np.count_nonzero(grey))} cells of the grey 205 (map_saver's unknown), which are free by its "
        f"free_thresh of {grid.free_thresh:g}: {effect}; set free_thresh to 0.196 if such cells mean unknown"
    )


def grid_label(key: PartKey) -> str:
    """Return a grid's name in errors."""
    return f"the occupancy grid {key.name!r} of level {key.level!r}"
