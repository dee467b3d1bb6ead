"""Overlays as edits: a blocked polygon becomes a keepout zone, a blocked edge says so of itself, both until their time.

What is put for an overlay is taken out again when its time is over, each by a version.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import datetime
from typing import Any

import shapely

from app.errors import Invalid, Problem
from app.model.features import Feature
from app.model.layers import PartKey
from app.store import Store
from app.store.values import Overlay, Version, rfc3339

BLOCKED, UNTIL = "blocked", "blocked_until"


def accepting(store: Store, head: Version, overlay: Overlay) -> list[dict[str, Any]]:
    """The edits that put an overlay into a version; none where the edge is blocked for as long already. Raises Invalid
    where its edge is not there.
    """
    if overlay.edge is not None:
        key, edge = edge_of(store, head, overlay.edge)
        if _blocked(edge, overlay.expires):
            return []
        return [_put(key, edge, {**edge.properties, BLOCKED: True, UNTIL: rfc3339(overlay.expires)})]
    about = {"id": overlay.id, "reporter": overlay.reporter}
    properties: dict[str, Any] = {"kind": "keepout", "expires": rfc3339(overlay.expires), "overlay": about}
    if overlay.detail:
        about["detail"] = overlay.detail
    feature = {"type": "Feature", "id": zone_of(overlay), "geometry": overlay.polygon, "properties": properties}
    return [{"op": "put", "layer": "zones", "level": overlay.level, "crs": overlay.crs, "feature": feature}]


def ending(store: Store, head: Version, overlay: Overlay) -> list[dict[str, Any]]:
    """The edits that take it out again; none where somebody has done so, or has blocked the edge for longer."""
    if overlay.edge is not None:
        try:
            key, edge = edge_of(store, head, overlay.edge)
        except Invalid:
            return []
        if edge.properties.get(UNTIL) != rfc3339(overlay.expires):
            return []
        return [_put(key, edge, {k: v for k, v in edge.properties.items() if k not in (BLOCKED, UNTIL)})]
    zone = zone_of(overlay)
    keys = [e.key for e in head.parts if e.key.layer == "zones" and store.has_ids(head, e.key, [zone])]
    return [{"op": "delete", "layer": "zones", "level": k.level, "name": k.name, "id": zone} for k in keys]


def zone_of(overlay: Overlay) -> str:
    """The id of its zone."""
    return f"overlay-{overlay.id}"


def edge_of(store: Store, head: Version, edge: str) -> tuple[PartKey, Feature]:
    """An edge of a version and the network it is in; Invalid where there is none."""
    for entry in head.parts:
        if entry.key.layer == "topology":
            for found in store.get(head, entry.key, [edge]):
                if found.properties.get("kind") == "edge":
                    return entry.key, found
    raise Invalid(
        f"{head.environment} has no edge {edge[:80]!r} in version {head.number}",
        [Problem("no such edge", where="edge")],
    )


def _blocked(edge: Feature, until: datetime) -> bool:
    """Whether an edge is blocked until a time, or later: by an overlay, or by an editor without an end."""
    if edge.properties.get(BLOCKED) is not True:
        return False
    try:
        end = datetime.fromisoformat(edge.properties[UNTIL])
    except (KeyError, TypeError, ValueError):
        return UNTIL not in edge.properties
    return end.tzinfo is not None and end >= until


def _put(key: PartKey, edge: Feature, properties: Mapping[str, Any]) -> dict[str, Any]:
    """The edge with other properties, where it is."""
    shape = None if edge.geometry.is_empty else json.loads(shapely.to_geojson(edge.geometry))
    local = edge.anchor == "local"
    feature = {"type": "Feature", "id": edge.id, "geometry": None if local else shape, "properties": dict(properties)}
    if local:
        feature["place"] = shape
    change = {"op": "put", "layer": "topology", "level": key.level, "name": key.name, "feature": feature}
    return change if local else {**change, "crs": "wgs84"}
