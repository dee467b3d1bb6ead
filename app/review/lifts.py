"""Lifts: which nodes are stops of one lift, and so connected without an edge."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from app.errors import FleetMapError
from app.model.features import Properties
from app.model.layers import Layers
from app.model.obstacles import object_ground

LIFT_WORDS = ("lift", "lift_cabin")
GRAPH_WORDS = ("graph_idx", "graph")


def lift_stops(
    layers: Layers, levels: Sequence[str], properties: Sequence[Properties], xy: NDArray[np.float64]
) -> dict[str, list[int]]:
    """Return the nodes at each lift, by its name: those that state it, and those inside its cabin, on any level.

    levels, properties, xy: of all nodes. Open-RMF's buildings tell a lift's stops by the cabin only.
    """
    out: dict[str, list[int]] = defaultdict(list)
    for k, members in enumerate(properties):
        name = _format_member(members, LIFT_WORDS)
        if isinstance(name, str) and name:
            out[name].append(k)
    stated = {k for members in out.values() for k in members}
    for name, cabin in _cabins(layers):
        inside = np.flatnonzero(shapely.contains_xy(cabin, xy)).tolist()
        out[name] += [k for k in inside if k not in stated]
    return {name: sorted(set(stops)) for name, stops in out.items() if len({levels[k] for k in stops}) > 1}


def _cabins(layers: Layers) -> list[tuple[str, Any]]:
    out: list[tuple[str, Any]] = []
    for part in layers.vector("objects").values():
        lifts = part.select_kinds("lift")
        try:
            for item, p, geometry in zip(lifts.ids, lifts.properties, lifts.in_local(layers.frame), strict=True):
                cabin = object_ground(p, geometry)
                if cabin is not None:
                    out.append((str(p.get("name") or item), cabin))
        except FleetMapError:  # no datum, or an invalid pose
            continue
    return out


def graph_index(properties: Properties) -> int | None:
    """Return the number of Open-RMF's navigation graph that an edge belongs to: each fleet has its own."""
    value = _format_member(properties, GRAPH_WORDS)
    return int(value) if isinstance(value, (int, float)) and math.isfinite(value) else None


def _format_member(properties: Properties, words: Sequence[str]) -> Any:
    """Return the first of these members in the data of formats, or in their parameters, typed or not."""
    for value in properties.values():
        if not isinstance(value, Mapping):
            continue
        inner = value.get("parameters")
        for members in (value, inner) if isinstance(inner, Mapping) else (value,):
            for word in words:
                member = members.get(word)
                member = member[1] if isinstance(member, list) and len(member) == 2 else member
                if member is not None:
                    return member
    return None
