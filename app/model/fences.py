"""Fences of a site: the polygons of the location layer, by level."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import shapely

from app.errors import Invalid, MissingDatum
from app.model.layers import Layers


def fences(layers: Layers, warn: Callable[..., None]) -> dict[str, Any]:
    """Return the polygons of the location layer by level, joined, in metres (shapely)."""
    out: dict[str, Any] = {}
    for key, part in layers.vector("location").items():
        flat = np.isin(shapely.get_type_id(part.geometry), (3, 6)) & ~shapely.is_empty(part.geometry)
        chosen = part.select(flat)
        if not len(chosen):
            continue
        try:
            metres = chosen.in_local(layers.frame)
        except (MissingDatum, Invalid) as error:
            warn(f"the fence is ignored: {error.detail}", where=key.name)
            continue
        joined = shapely.union_all(shapely.make_valid(shapely.force_2d(metres)))
        if not joined.is_empty and joined.area > 0:
            out[key.level] = joined if key.level not in out else shapely.union(out[key.level], joined)
    return out


def level_fence(fences: Mapping[str, Any], level: str, ground: str) -> Any:
    """Return a level's fence, else that of the ground level, else None."""
    return fences.get(level, fences.get(ground))
