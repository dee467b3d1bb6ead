"""Changed features in responses: each with both states, drawn where it is now, or where it was if it was deleted."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import orjson
from pydantic import BaseModel, Field

from app.api.http.features import GeometryOut, Position, digits_of, geometries_as_geojson, placed
from app.model.features import NO_GEOMETRY, Properties
from app.model.frame import Anchor

Change = Literal["added", "changed", "deleted"]


class ChangeProperties(BaseModel):
    """A change of a feature."""

    layer: Literal["location", "objects", "topology", "zones"]
    kind: str | None = Field(description="`kind` of the feature: `node`, `edge`, `building` …")
    change: Change
    before: dict[str, Any] | None = Field(description="Properties before the change; null if it was added.")
    after: dict[str, Any] | None = Field(description="Properties after the change; null if it was deleted.")
    before_geometry: GeometryOut | None = Field(
        description="Geometry before the change, in the coordinates of the collection; null if it is the same."
    )
    fields: list[str] = Field(
        description="Names of the properties that differ, with `geometry`, and `anchor` if the feature was fixed to "
        "the local frame and is now fixed to the earth, or the reverse. Empty unless it was changed."
    )


class FeatureChangeOut(BaseModel):
    """Changed feature, with the geometry after the change, or before it if the feature was deleted."""

    type: Literal["Feature"]
    id: str = Field(description="Id of the feature, unique in its part of a layer.")
    geometry: GeometryOut | None = Field(description="In WGS 84; null if the coordinates are local.")
    place: GeometryOut | None = Field(None, description="In local metres; only if the coordinates are local.")
    properties: ChangeProperties
    level: str
    part: str = Field(description="Name of its part of the layer, for example of the network.")


class FeatureState(NamedTuple):
    """State of a feature: geometry in the coordinates of the collection, and properties."""

    geometry: Any
    properties: Properties


class FeatureChange(NamedTuple):
    """A change with both states, at least one of which exists. fields: names of what differs."""

    position: Position
    change: Change
    before: FeatureState | None
    after: FeatureState | None
    fields: Sequence[str]


def change_features(changes: Sequence[FeatureChange], crs: Anchor) -> list[dict[str, Any]]:
    """Write changes as features."""
    before = _shapes([change.before for change in changes], crs)
    after = _shapes([change.after for change in changes], crs)
    return [_feature(*row, crs) for row in zip(changes, before, after, strict=True)]


def _shapes(states: Sequence[FeatureState | None], crs: Anchor) -> list[orjson.Fragment | None]:
    geometry = np.empty(len(states), object)
    geometry[:] = [NO_GEOMETRY if state is None else state.geometry for state in states]
    return geometries_as_geojson(geometry, digits_of(crs))


def _feature(
    change: FeatureChange, before: orjson.Fragment | None, after: orjson.Fragment | None, crs: Anchor
) -> dict[str, Any]:
    deleted = change.after is None
    state = change.after or change.before
    kind = state.properties.get("kind") if state is not None else None
    moved = change.change == "changed" and _text(before) != _text(after)
    return {
        "type": "Feature",
        "id": change.position.id,
        **placed(before if deleted else after, crs),
        "properties": {
            "layer": change.position.layer,
            "kind": kind if isinstance(kind, str) else None,
            "change": change.change,
            "before": None if change.before is None else change.before.properties,
            "after": None if change.after is None else change.after.properties,
            "before_geometry": before if moved else None,
            "fields": list(change.fields),
        },
        "level": change.position.level,
        "part": change.position.part,
    }


def _text(shape: orjson.Fragment | None) -> bytes:
    return orjson.dumps(shape)
