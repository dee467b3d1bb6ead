"""Places that robots must reach: docks, chargers, parking and pick-up places, by the words of the formats."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from app.model.features import Properties
from app.model.layers import Layers, PartKey

FLAGS = frozenset({"is_charger", "is_parking_spot", "is_holding_point", "is_cleaning_zone"})
NAMES = frozenset({"dock_name", "undock_name", "pickup_dispenser", "dropoff_ingestor"})
"""Parameters of Open-RMF's vertices: set, or with a name."""

TAGS = frozenset({"Charger", "ParkingSpot", "HoldingPoint"})
"""Tags of locations in Open-RMF's sites."""

ACTIONS = frozenset({"startCharging", "pick", "drop", "dock", "park"})
"""Action types of nodes in LIF."""

KINDS = frozenset(
    {"station", "charger", "charging_station", "dock", "docking_station", "parking", "parking_spot", "workstation"}
)
"""Kinds of objects; LIF's stations name their nodes."""

MAX_DEPTH = 6
"""Depth of nested properties in which formats have such words."""

_WORD = re.compile(
    r"(?<![a-z])(dock(ing)?|charg(er|ing|e)|parking|pick_?up|drop_?off|station|workstation)(?![a-z])", re.IGNORECASE
)
_CAMEL = re.compile(r"(?<=[a-z0-9])(?=[A-Z])")


@dataclass(frozen=True, slots=True)
class Dock:
    """A place that robots must reach. nodes: ids of its nodes; for a node, itself."""

    id: str
    name: str
    key: PartKey
    nodes: tuple[str, ...]


def find_docks(layers: Layers) -> dict[tuple[PartKey, str], Dock]:
    """Return the docks among nodes and objects, by part and id."""
    out: dict[tuple[PartKey, str], Dock] = {}
    for layer in ("topology", "objects"):
        for key, part in layers.vector("topology" if layer == "topology" else "objects").items():
            for item, p in zip(part.ids, part.properties, strict=True):
                if p.get("kind") == "node" and key.layer == "topology":
                    if is_dock(p, item):
                        out[key, item] = Dock(item, str(p.get("name") or item), key, (item,))
                elif key.layer == "objects" and str(p.get("kind")) in KINDS:
                    out[key, item] = Dock(item, str(p.get("name") or item), key, tuple(_interaction_nodes(p)))
    return out


def is_dock(properties: Properties, node_id: str) -> bool:
    """Return whether a node is a dock, by the data of its format, else by its name."""
    if any(_marks(name, value) for name, value in _members(properties)):
        return True
    texts = {str(properties.get("name") or ""), node_id}
    return any(_WORD.search(_CAMEL.sub("_", text[:200])) is not None for text in texts)


def _marks(name: str, value: Any) -> bool:
    value = value[1] if isinstance(value, list) and len(value) == 2 else value  # a typed parameter
    if name in FLAGS:
        return value is True
    if name in NAMES:
        return isinstance(value, str) and bool(value)
    if name == "actionType":
        return isinstance(value, str) and value in ACTIONS
    return name == "tags" and isinstance(value, list) and not TAGS.isdisjoint(str(tag) for tag in value)


def _members(value: Any, depth: int = MAX_DEPTH) -> Iterator[tuple[str, Any]]:
    """Iterate over all members of nested mappings and lists."""
    if isinstance(value, Mapping):
        for name, inner in value.items():
            yield str(name), inner
            if depth:
                yield from _members(inner, depth - 1)
    elif isinstance(value, list) and depth:
        for inner in value[:100]:
            yield from _members(inner, depth - 1)


def _interaction_nodes(properties: Properties) -> Iterator[str]:
    for name, value in _members(properties):
        if name == "interactionNodeIds" and isinstance(value, list):
            yield from (node for node in value if isinstance(node, str))
