"""Which of the stored occupancy grids a derivation looks at."""

from __future__ import annotations

from app.derive._choice import named, one_each
from app.errors import MissingLayer
from app.model import masks
from app.model.grid import OccupancyGrid
from app.model.layers import MAP, Layers, PartKey


def chosen(layers: Layers, name: str | None, what: str) -> dict[PartKey, OccupancyGrid]:
    """One grid for each level: the named one, else ``map``, else the only one that is no costmap filter mask.

    what: what masks do not tell, for the error. Raises NotFound, MissingLayer where there are masks alone, Ambiguous.
    """
    grids = layers.grids()
    if name is not None:
        return named(grids, name, "occupancy grid")
    maps = {k: g for k, g in grids.items() if k.name not in masks.MASKS and masks.NAME not in g.properties}
    if not maps:
        raise MissingLayer(f"costmap filter masks alone tell no {what}: upload an occupancy grid of what stands there")
    return one_each(maps, MAP, "occupancy grid", "grid")


def called(key: PartKey) -> str:
    """What errors call a grid."""
    return f"the occupancy grid {key.name!r} of level {key.level!r}"
