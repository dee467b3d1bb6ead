"""Overlays as edits of a version: making a closure permanent."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any

import shapely

from app.errors import Invalid, Problem
from app.model import bends
from app.model.closures import zone_id
from app.model.features import Feature
from app.model.layers import PartKey
from app.store.fleet_values import Overlay
from app.store.store import Store
from app.store.values import Version

BLOCKED, UNTIL = "blocked", "blocked_until"


def permanent_edits(store: Store, head: Version, overlay: Overlay) -> list[dict[str, Any]]:
    """Return edits that make a closure permanent; none if the edge is blocked already.

    Raises Invalid for an unknown edge.
    """
    if overlay.edge is not None:
        key, edge = find_edge(store, [head], overlay.edge)
        if edge.properties.get(BLOCKED) is True and UNTIL not in edge.properties:
            return []
        remaining = {name: value for name, value in edge.properties.items() if name != UNTIL}
        return [_put_edge(key, edge, {**remaining, BLOCKED: True})]
    about = {"id": overlay.id, "reporter": overlay.reporter}
    if overlay.detail:
        about["detail"] = overlay.detail
    properties = {"kind": "keepout", "overlay": about}
    feature = {"type": "Feature", "id": zone_id(overlay.id), "geometry": overlay.polygon, "properties": properties}
    return [{"op": "put", "layer": "zones", "level": overlay.level, "crs": overlay.crs, "feature": feature}]


def find_edge(store: Store, versions: Iterable[Version], edge: str) -> tuple[PartKey, Feature]:
    """Find an edge and its network in the first of these versions that has it. Raises Invalid if none has.

    A piece of a bent edge, which formats with straight edges split, resolves to that edge unless an edge has this id.
    """
    numbers = []
    environment = ""
    piece = bends.NAMED.match(edge)
    names = [(edge, 0)] if piece is None else [(edge, 0), (piece[1], int(piece[2]))]
    for version in versions:
        environment = version.environment
        numbers.append(str(version.number))
        for name, number in names:
            for entry in version.parts:
                if entry.key.layer == "topology":
                    for feature in store.content.features(version, entry.key, ids=[name]):
                        pieces = shapely.get_num_coordinates(feature.geometry) - 1
                        if feature.properties.get("kind") == "edge" and (not number or number <= pieces > 1):
                            return entry.key, feature
    raise Invalid(
        f"unknown edge {edge[:80]!r} in version {' or '.join(numbers)} of {environment}: use an edge id of "
        "GET …/layers/topology",
        [Problem("unknown edge", where="edge")],
    )


def _put_edge(key: PartKey, edge: Feature, properties: Mapping[str, Any]) -> dict[str, Any]:
    """Return an edit that replaces the properties of an edge."""
    shape = None if edge.geometry.is_empty else json.loads(shapely.to_geojson(edge.geometry))
    local = edge.anchor == "local"
    feature = {"type": "Feature", "id": edge.id, "geometry": None if local else shape, "properties": dict(properties)}
    if local:
        feature["place"] = shape
    change = {"op": "put", "layer": "topology", "level": key.level, "name": key.name, "feature": feature}
    return change if local else {**change, "crs": "wgs84"}
