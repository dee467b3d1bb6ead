"""Vector layers as collections of features: complete, or filtered, paged and simplified for drawing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field
from pydantic.json_schema import SkipJsonSchema

from app.api.http.features import (
    CollectionOut,
    GeometryOut,
    Page,
    Position,
    collection_head,
    digits_of,
    geometries_as_geojson,
    missing_datum_error,
    omittable,
    page_of,
    placed,
)
from app.api.http.responses import json_bytes
from app.errors import Invalid, Problem
from app.model import drawing
from app.model.features import Features
from app.model.frame import GROUND, Anchor
from app.model.geodesy import LocalFrame, local_frame
from app.model.layers import SITE, PartKey
from app.store.content import ContentReader
from app.store.values import Box, Version

MAX_IDS = 1000
"""Maximum number of ids in a request."""

DATUM_ID = "datum"


class FeatureOut(BaseModel):
    """Feature of a layer."""

    type: Literal["Feature"]
    id: str
    geometry: GeometryOut | None = Field(description="In WGS 84; null if the coordinates are local.")
    place: GeometryOut | None = Field(None, description="In local metres; only if the coordinates are local.")
    properties: dict[str, Any]
    level: str
    part: str = Field(description="Name of its part of the layer, for example of the network.")


class LayerFeaturesOut(CollectionOut):
    """Features of a layer."""

    features: list[FeatureOut]
    left_out: int | SkipJsonSchema[None] = omittable(
        "Number of features that are too small or too dense to draw. Only with `zoom`.", "leftOut"
    )


@dataclass(frozen=True, slots=True)
class FeatureQuery:
    """Requested part of a layer. text: substring of id, name or kind, in any case; None or empty: any."""

    box: Box | None = None
    text: str | None = None
    ids: tuple[str, ...] | None = None
    zoom: int | None = None
    limit: int | None = None
    cursor: str | None = None


class _Row(NamedTuple):
    """Feature to return: index of its part, its index there, geometry in the collection's coordinates."""

    part: int
    place: int
    geometry: Any


def parse_ids(text: str | None) -> tuple[str, ...] | None:
    """Parse ids separated by commas; None without the parameter. Raises Invalid for none or too many."""
    if text is None:
        return None
    ids = tuple(dict.fromkeys(item for item in text.split(",") if item))
    if not 0 < len(ids) <= MAX_IDS:
        reason = f"must be 1 to {MAX_IDS} ids, separated by commas"
        raise Invalid(f"ids {reason}; got {len(ids)}", [Problem(reason, where="ids")])
    return ids


def write_layer(
    content: ContentReader, version: Version, keys: Sequence[PartKey], crs: Anchor, query: FeatureQuery, layer: str
) -> tuple[bytes, str | None]:
    """Write the features of some parts of a layer as a collection; returns it with the cursor of the next page."""
    frame = local_frame(version.datum) if version.datum else None
    parts = [(key, content.features(version, key, bbox=query.box, crs=crs, ids=query.ids)) for key in keys]
    if frame is None and any(len(part) and bool((part.local != (crs == "local")).any()) for _, part in parts):
        raise missing_datum_error(version.environment)
    fences = [e for e in version.parts if e.key.layer == "location" and e.count]
    alone = layer == "location" and not fences and (query.box is None or _datum_within(version, query.box, crs))
    alone = alone and _selects_datum(query)
    if query == FeatureQuery(query.box):
        return feature_collection(parts, crs, frame, version, with_datum=alone), None
    rows, left_out = _rows(parts, crs, frame, query)
    if alone and not rows and version.datum is not None:
        page = page_of([Position("location", GROUND, SITE, DATUM_ID)], lambda item: item, query.limit, query.cursor)
        features = [_datum_feature(version.datum.as_dict(), crs)] if page.indices else []
    else:
        page, features = _page(parts, rows, crs, version, query)
    members = page.members | ({} if query.zoom is None else {"leftOut": left_out})
    body = json_bytes({**collection_head(crs, version), "features": features, **members})
    return body, page.members.get("next")


def _rows(
    parts: Sequence[tuple[PartKey, Features]], crs: Anchor, frame: LocalFrame | None, query: FeatureQuery
) -> tuple[list[_Row], int]:
    """List the features that match a query, and count those that are not worth drawing at its zoom."""
    rows: list[_Row] = []
    left_out = 0
    for number, (_, part) in enumerate(parts):
        matching = _matching(part, query.text)
        if not len(matching):
            continue
        part_geometry = part.in_local(frame) if crs == "local" else part.in_wgs84(frame)
        indices, geometry = matching, part_geometry[matching]
        if query.zoom is not None:
            kinds = np.array([str(p.get("kind")) for p in part.properties], object)
            drawn = drawing.for_zoom(kinds[matching], geometry, crs, query.zoom)
            left_out += len(matching) - len(drawn.indices)
            indices, geometry = matching[drawn.indices], drawn.geometry
        rows += [_Row(number, index, shape) for index, shape in zip(indices.tolist(), geometry, strict=True)]
    return rows, left_out


def _matching(part: Features, text: str | None) -> NDArray[np.intp]:
    """Return the indices of features whose id, name or kind contains a text, in any case."""
    if not text:
        return np.arange(len(part))
    wanted = text.casefold()
    columns = zip(part.ids, part.properties, strict=True)
    hits = [
        k
        for k, (item, p) in enumerate(columns)
        if any(wanted in word.casefold() for word in (item, p.get("name"), p.get("kind")) if isinstance(word, str))
    ]
    return np.array(hits, np.intp)


def _page(
    parts: Sequence[tuple[PartKey, Features]], rows: list[_Row], crs: Anchor, version: Version, query: FeatureQuery
) -> tuple[Page, list[dict[str, Any]]]:
    def position(row: _Row) -> Position:
        key, part = parts[row.part]
        return Position(key.layer, key.level, key.name, part.ids[row.place])

    page = page_of(rows, position, query.limit, query.cursor)
    chosen = [rows[k] for k in page.indices]
    geometry = np.empty(len(chosen), object)
    geometry[:] = [row.geometry for row in chosen]
    shapes = geometries_as_geojson(geometry, digits_of(crs))
    datum = version.datum.as_dict() if version.datum else None
    features = []
    for row, shape in zip(chosen, shapes, strict=True):
        key, part = parts[row.part]
        features.append(_feature(key, part.ids[row.place], part.properties[row.place], shape, crs, datum))
    return page, features


def feature_collection(
    parts: Sequence[tuple[PartKey, Features]],
    crs: Anchor,
    frame: LocalFrame | None,
    version: Version,
    *,
    with_datum: bool,
) -> bytes:
    """Write parts as GeoJSON (wgs84) or JSON-FG (local); each feature has its level and the name of its part.

    Coordinates are rounded to 1e-12 degrees and 1e-9 metres. with_datum: add the datum as a point, for environments
    that have a datum but no fence.
    """
    features: list[dict[str, Any]] = []
    datum = version.datum.as_dict() if version.datum else None
    for key, part in parts:
        geometry = part.in_local(frame) if crs == "local" else part.in_wgs84(frame)
        shapes = geometries_as_geojson(geometry, digits_of(crs))
        columns = zip(part.ids, part.properties, shapes, strict=True)
        features += [_feature(key, item, p, shape, crs, datum) for item, p, shape in columns]
    if with_datum and datum is not None:
        features.append(_datum_feature(datum, crs))
    return json_bytes({**collection_head(crs, version), "features": features})


def _feature(
    key: PartKey, item: str, properties: Any, shape: Any, crs: Anchor, datum: dict[str, float] | None
) -> dict[str, Any]:
    if key.layer == "location" and datum is not None:
        properties = {**properties, "datum": datum}
    feature = {"type": "Feature", "id": item, **placed(shape, crs), "properties": properties}
    return {**feature, "level": key.level, "part": key.name}


def _datum_feature(datum: dict[str, float], crs: Anchor) -> dict[str, Any]:
    """Write the datum as a point."""
    place = [0.0, 0.0] if crs == "local" else [datum["longitude"], datum["latitude"]]
    shape = {"type": "Point", "coordinates": place}
    properties = {"kind": "datum", "datum": datum}
    return {"type": "Feature", "id": DATUM_ID, **placed(shape, crs), "properties": properties,
            "level": GROUND, "part": SITE}  # fmt: skip


def _selects_datum(query: FeatureQuery) -> bool:
    """Test if a query's text and ids select the datum, whose id and kind are ``datum``."""
    return (query.text or "").casefold() in DATUM_ID and (query.ids is None or DATUM_ID in query.ids)


def _datum_within(version: Version, box: Box, crs: Anchor) -> bool:
    """Test if the local origin is in a box."""
    if version.datum is None:
        return False
    x, y = (0.0, 0.0) if crs == "local" else (version.datum.longitude, version.datum.latitude)
    across = box[0] <= x <= box[2] if box[0] <= box[2] else x >= box[0] or x <= box[2]
    return across and box[1] <= y <= box[3]
