"""Which of the stored occupancy grids a derivation looks at."""

from __future__ import annotations

from app.derive.occupancy_to_voxels import MASKS
from app.errors import Ambiguous, MissingLayer, NotFound
from app.model import masks
from app.model.grid import OccupancyGrid
from app.model.layers import MAP, Layers, PartKey


def chosen(layers: Layers, name: str | None, what: str) -> dict[PartKey, OccupancyGrid]:
    """One grid for each level: the named one, else ``map``, else the only one that is no costmap filter mask.

    what: what masks do not tell, for the error. Raises NotFound, MissingLayer where there are masks alone, Ambiguous.
    """
    grids = layers.grids()
    if name is not None:
        found = {k: g for k, g in grids.items() if k.name == name}
        if not found:
            there = ", ".join(sorted({k.name for k in grids})) or "none"
            raise NotFound(f"there is no occupancy grid {name!r}; there are: {there}")
        return found
    out = {}
    maps = {k: g for k, g in grids.items() if k.name not in MASKS and masks.NAME not in g.properties}
    if not maps:
        raise MissingLayer(f"costmap filter masks alone tell no {what}: upload an occupancy grid of what stands there")
    for level in dict.fromkeys(k.level for k in maps):
        here = {k: g for k, g in maps.items() if k.level == level}
        plain = {k: g for k, g in here.items() if k.name == MAP} or here
        if len(plain) > 1:
            there = ", ".join(k.name for k in plain)
            raise Ambiguous(f"level {level!r} has several occupancy grids ({there}): name one with grid=")
        out.update(plain)
    return out


def called(key: PartKey) -> str:
    """What errors call a grid."""
    return f"the occupancy grid {key.name!r} of level {key.level!r}"
