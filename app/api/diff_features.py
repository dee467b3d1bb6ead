"""Differences between two versions as features, each with both states."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from fastapi import Request
from pydantic import Field
from starlette.responses import Response

from app.api.http.caching import none_match
from app.api.http.dependencies import Services
from app.api.http.feature_changes import Change, FeatureChange, FeatureChangeOut, FeatureState, change_features
from app.api.http.features import GEOJSON, CollectionOut, Position, collection_head, missing_datum_error, page_of
from app.api.http.responses import json_bytes, next_page
from app.model.frame import Anchor, Datum
from app.model.geodesy import local_frame
from app.model.layers import VECTOR_LAYERS, PartKey
from app.store.diff import FeatureChanges, fields
from app.store.parts.features import Item, features_from_items
from app.store.values import Version


class DiffFeaturesOut(CollectionOut):
    """Changed features between two versions."""

    from_: int | str = Field(alias="from", description="Number of the older version, or `dry:…`.")
    to: int | str = Field(description="Number of the newer version, or `dry:…`.")
    features: list[FeatureChangeOut]


@dataclass(frozen=True, slots=True)
class FeatureSelection:
    """Requested part of the changed features. None: the default."""

    crs: Anchor | None = None
    layer: str | None = None
    limit: int | None = None
    cursor: str | None = None


def changed_features(
    request: Request, services: Services, old: Version, new: Version, selection: FeatureSelection
) -> Response:
    """Return the features that differ between two versions, in pages."""
    crs, layer, limit, cursor = selection.crs, selection.layer, selection.limit, selection.cursor
    anchor: Anchor = crs or ("wgs84" if new.datum else "local")
    datums = [version.datum.as_dict() if version.datum else None for version in (old, new)]
    seed = json_bytes(["diff", old.root, new.root, old.ref, new.ref, datums, anchor, layer, limit, cursor])
    headers = {"etag": f'"{hashlib.sha256(seed).hexdigest()[:32]}"'}
    if none_match(request.headers.get("if-none-match"), headers["etag"]):
        return Response(status_code=304, headers=headers)
    layers = VECTOR_LAYERS if layer is None else {layer}
    parts = dict(services.store.content.feature_changes(old, new, layers))
    rows = [
        _Row(Position(key.layer, key.level, key.name, item), key, change)
        for key, changes in parts.items()
        for item, change in sorted(_changes_by_id(changes).items())
    ]
    page = page_of(rows, lambda row: row.position, limit, cursor)
    changes = _load_states([rows[k] for k in page.indices], parts, old, new, anchor)
    body = {
        **collection_head(anchor, new),
        "from": old.ref,
        "to": new.ref,
        "features": change_features(changes, anchor),
        **page.members,
    }
    headers |= next_page(request, page.members.get("next"))
    return Response(json_bytes(body), headers=headers, media_type=GEOJSON)


class _Row(NamedTuple):
    position: Position
    key: PartKey
    change: Change


def _changes_by_id(changes: FeatureChanges) -> dict[str, Change]:
    groups: tuple[tuple[Change, list[str]], ...] = (
        ("added", changes.added), ("changed", changes.changed), ("deleted", changes.deleted),
    )  # fmt: skip
    return {item: change for change, items in groups for item in items}


def _load_states(
    rows: Sequence[_Row], parts: Mapping[PartKey, FeatureChanges], old: Version, new: Version, crs: Anchor
) -> list[FeatureChange]:
    """Load both states of changed features, each where it was at its time if both versions have a datum."""
    items = [(parts[row.key].before.get(row.position.id), parts[row.key].after.get(row.position.id)) for row in rows]
    before = _states([item for item, _ in items], old.datum or new.datum, crs, old.environment)
    after = _states([item for _, item in items], new.datum or old.datum, crs, new.environment)
    return [
        FeatureChange(
            row.position,
            row.change,
            was if row.change != "added" else None,
            now if row.change != "deleted" else None,
            fields(first, second) if row.change == "changed" and first is not None and second is not None else (),
        )
        for row, (first, second), was, now in zip(rows, items, before, after, strict=True)
    ]


def _states(
    items: Sequence[Item | None], datum: Datum | None, crs: Anchor, environment: str
) -> list[FeatureState | None]:
    """Convert stored items to the coordinates of a response; None stays None."""
    present = {str(k): item for k, item in enumerate(items) if item is not None}
    part = features_from_items(present, {})
    frame = local_frame(datum) if datum else None
    if frame is None and bool((part.local != (crs == "local")).any()):
        raise missing_datum_error(environment)
    geometry = part.in_local(frame) if crs == "local" else part.in_wgs84(frame)
    states = dict(zip(part.ids, map(FeatureState, geometry, part.properties), strict=True))
    return [states.get(str(k)) for k in range(len(items))]
