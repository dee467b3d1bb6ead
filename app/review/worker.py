"""Checks and impact of stored versions, in a worker process: reads the store, writes nothing."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from app.event_types import RobotPlace
from app.ingest.edits import edit_changes
from app.model.features import Features, concatenate
from app.model.frame import Datum
from app.model.layers import Layer, Layers, Part, PartKey
from app.review.impact import Blocked, Comparison, CutOff
from app.review.rules import check_layers
from app.review.touched import RobotImpact, RobotTouch
from app.store.changes import Changes, Delete, Drop, Put, Replace
from app.store.in_worker import open_store
from app.store.store import Store
from app.store.values import Version

CHECKED_LAYERS: frozenset[Layer] = frozenset({"location", "objects", "topology", "occupancy", "zones"})
MAX_LISTED = 10_000
"""Maximum number of items in each list of an impact."""

COMPARED_LAYERS: frozenset[Layer] = frozenset({"objects", "topology", "occupancy", "zones"})


def check_version(
    database_url: str,
    blob_dir: str,
    version: Version,
    level: str | None,
    edits: Sequence[Mapping[str, Any]] = (),
) -> dict[str, Any]:
    """Check a version, with edits applied that are not stored. Raises Invalid for invalid edits.

    Returns ``{items, truncated}`` as JSON.
    """
    store = open_store(database_url, blob_dir)
    changes = edit_changes(store, version, edits)[0] if edits else Changes()
    layers = apply_changes(_load(store, version, CHECKED_LAYERS, level), changes)
    result = check_layers(layers, level)
    return {"items": result.as_dicts(), "truncated": result.truncated}


@dataclass(frozen=True, slots=True)
class ImpactResult:
    """Impact of a change as JSON (without robots), and of each robot in the order of their places."""

    members: dict[str, Any]
    robots: tuple[RobotImpact, ...]


def compare_versions(
    database_url: str, blob_dir: str, old: Version, new: Version, places: Sequence[RobotPlace | None]
) -> ImpactResult:
    """Compare two versions, and judge robots by their last places."""
    store = open_store(database_url, blob_dir)
    c = Comparison(*(_load(store, version, COMPARED_LAYERS, None) for version in (old, new)))
    touch = RobotTouch(c)
    lists: dict[str, list[Any]] = {
        "deleted": [item for _, item in c.deleted_edges],
        "blocked": [_as_dict(blocked) for blocked in c.blocked],
        "turned": [item for _, item in c.turned],
    }
    nodes: dict[str, list[Any]] = {
        "deleted": [item for _, item in c.deleted_nodes],
        "moved": [asdict(moved) for moved in c.moved],
    }
    members = {
        "edges": {name: items[:MAX_LISTED] for name, items in lists.items()},
        "nodes": {name: items[:MAX_LISTED] for name, items in nodes.items()},
        "docks": [asdict(dock) for dock in c.docks[:MAX_LISTED]],
        "parts": [_as_dict(part) for part in c.parts[:MAX_LISTED]],
        "truncated": any(len(items) > MAX_LISTED for items in (*lists.values(), *nodes.values(), c.docks, c.parts)),
    }
    return ImpactResult(members, tuple(touch.judge(place) for place in places))


def _as_dict(item: Blocked | CutOff) -> dict[str, Any]:
    """Return the JSON members, with the position as ``where``."""
    members = asdict(item)
    return {"where" if name == "position" else name: value for name, value in members.items()}


def _load(store: Store, version: Version, chosen: Collection[Layer], level: str | None) -> Layers:
    """Load the chosen layers; grids, zones and objects only of one level if it is given."""
    everywhere = ("topology", "location", "objects")  # networks, fences and lifts of other levels belong to it
    keys = [
        entry.key
        for entry in version.parts
        if entry.key.layer in chosen and (level in (None, entry.key.level) or entry.key.layer in everywhere)
    ]
    return store.content.load(version, keys)


def apply_changes(layers: Layers, changes: Changes) -> Layers:
    """Apply the operations of a change set to loaded layers; those on parts that are not loaded have no effect."""
    parts: dict[PartKey, Part] = dict(layers.parts)
    for operation in changes.operations:
        key = operation.key
        if isinstance(operation, Replace):
            parts[key] = operation.part
        elif isinstance(operation, Drop):
            parts.pop(key, None)
        elif isinstance(operation, Delete):
            parts[key] = _without(parts.get(key), operation.ids)
        elif isinstance(operation, Put):
            put = operation.features
            parts[key] = concatenate([_without(parts.get(key), put.ids), put])
    levels = changes.levels if isinstance(changes.levels, tuple) else layers.levels
    datum = changes.datum if isinstance(changes.datum, Datum) else layers.datum
    return replace(layers, parts=parts, datum=datum, levels=levels)


def _without(part: Part | None, ids: Collection[str]) -> Features:
    if not isinstance(part, Features):
        return Features((), np.empty(0, object), (), np.empty(0, bool))
    gone = set(ids)
    return part.select([k for k, item in enumerate(part.ids) if item not in gone])
