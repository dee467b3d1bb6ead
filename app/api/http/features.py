"""Features in responses: GeoJSON in WGS 84, JSON-FG in local metres, in pages of a stable order."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Callable, Sequence
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

import numpy as np
import orjson
import shapely
from fastapi import Query
from numpy.typing import NDArray
from pydantic import BaseModel, Field
from pydantic.json_schema import SkipJsonSchema

from app.api.http.schemas import DatumOut
from app.errors import Invalid, MissingDatum, Problem
from app.model.frame import Anchor
from app.store.values import Version

LOCAL_CRS = "urn:fleetmap:crs:local"
"""Name of the local frame in JSON-FG's ``coordRefSys``; the member ``datum`` gives its origin."""

CONFORMS = ["http://www.opengis.net/spec/json-fg-1/1.0/conf/core"]
GEOJSON = "application/geo+json"

MAX_PAGE = 10_000
"""Maximum number of features per page."""

Crs = Annotated[
    Literal["local", "wgs84"] | None,
    Query(
        description="`wgs84`: longitude, latitude in degrees. `local`: metres. Default: `wgs84` if there is a datum, "
        "else `local`."
    ),
]
PageLimit = Annotated[
    int | None, Query(ge=1, le=MAX_PAGE, description="Maximum number of features per page. Default: all features.")
]
PageCursor = Annotated[
    str | None, Query(max_length=4000, description="Start of the page: `next` of the previous page. Needs `limit`.")
]


def omittable(description: str, alias: str | None = None) -> Any:
    """Declare a member of a response that is omitted, never null; its type is ``X | SkipJsonSchema[None]``."""

    def drop_default(schema: dict[str, Any]) -> None:
        schema.pop("default", None)

    return Field(None, alias=alias, description=description, json_schema_extra=drop_default)


class GeometryOut(BaseModel):
    """Geometry as in GeoJSON, in the coordinates of the collection."""

    type: Literal[
        "Point", "LineString", "Polygon", "MultiPoint", "MultiLineString", "MultiPolygon", "GeometryCollection"
    ]
    coordinates: list[Any] | SkipJsonSchema[None] = omittable("Omitted for a `GeometryCollection`.")
    geometries: list[dict[str, Any]] | SkipJsonSchema[None] = omittable("Only of a `GeometryCollection`.")


class CollectionOut(BaseModel):
    """Members that all collections of features share."""

    type: Literal["FeatureCollection"]
    conforms_to: list[str] | SkipJsonSchema[None] = omittable(
        "JSON-FG, if the coordinates are local. Else omitted.", "conformsTo"
    )
    coord_ref_sys: Literal["urn:fleetmap:crs:local"] | SkipJsonSchema[None] = omittable(
        "If the coordinates are local metres: in `place` of each feature. Else omitted.", "coordRefSys"
    )
    datum: DatumOut | None = Field(
        None, description="Origin of local coordinates; null if there is none. Omitted if the coordinates are WGS 84."
    )
    next: str | SkipJsonSchema[None] = omittable("Cursor of the next page. Omitted on the last page.")
    number_matched: int | SkipJsonSchema[None] = omittable(
        "Number of features on all pages. Only with `limit`.", "numberMatched"
    )
    number_returned: int | SkipJsonSchema[None] = omittable(
        "Number of features on this page. Only with `limit`.", "numberReturned"
    )


class Position(NamedTuple):
    """Position of a feature in the order of a collection: layer, level, name of its part, id."""

    layer: str
    level: str
    part: str
    id: str


T = TypeVar("T")


class Page(NamedTuple):
    """Indices of a page's items, and the members that describe it."""

    indices: Sequence[int]
    members: dict[str, Any]


def page_of(items: Sequence[T], position: Callable[[T], Position], limit: int | None, cursor: str | None) -> Page:
    """Select a page of items, which are in the order of their positions. Raises Invalid for a wrong cursor."""
    if limit is None:
        if cursor is not None:
            problem = Problem("needs limit", where="cursor")
            raise Invalid("cursor needs limit: give the limit of the previous page", [problem])
        return Page(range(len(items)), {})
    start = 0 if cursor is None else _first_after(items, position, _parse_cursor(cursor))
    indices = range(start, min(start + limit, len(items)))
    members: dict[str, Any] = {"numberMatched": len(items), "numberReturned": len(indices)}
    if indices.stop < len(items):
        members = {"next": _cursor(position(items[indices.stop - 1])), **members}
    return Page(indices, members)


def _first_after(items: Sequence[T], position: Callable[[T], Position], last: Position) -> int:
    """Find the first item after a position, by bisection."""
    low, high = 0, len(items)
    while low < high:
        middle = (low + high) // 2
        if position(items[middle]) <= last:
            low = middle + 1
        else:
            high = middle
    return low


def _cursor(position: Position) -> str:
    return base64.urlsafe_b64encode(orjson.dumps(list(position))).rstrip(b"=").decode()


def _parse_cursor(cursor: str) -> Position:
    try:
        data = base64.b64decode(cursor.encode("ascii") + b"=" * (-len(cursor) % 4), b"-_", validate=True)
        members = orjson.loads(data)
    except (ValueError, binascii.Error):
        members = None
    if not (isinstance(members, list) and len(members) == 4 and all(isinstance(text, str) for text in members)):
        problem = Problem("invalid cursor", where="cursor")
        raise Invalid("invalid cursor: take it from next of the previous page", [problem])
    return Position(*members)


def collection_head(crs: Anchor, version: Version) -> dict[str, Any]:
    """Return the first members of a collection: of JSON-FG for local metres."""
    head: dict[str, Any] = {"type": "FeatureCollection"}
    if crs == "local":
        datum = version.datum.as_dict() if version.datum else None
        head |= {"conformsTo": CONFORMS, "coordRefSys": LOCAL_CRS, "datum": datum}
    return head


def placed(shape: Any, crs: Anchor) -> dict[str, Any]:
    """Return the members of a feature's geometry: local metres never are ``geometry``."""
    return {"geometry": None, "place": shape} if crs == "local" else {"geometry": shape}


def digits_of(crs: Anchor) -> int:
    """Return the number of decimals of coordinates: 1e-9 metres or 1e-12 degrees."""
    return 9 if crs == "local" else 12


def geometries_as_geojson(geometry: NDArray[np.object_], digits: int) -> list[orjson.Fragment | None]:
    """Write each geometry as GeoJSON, rounded to ``digits``; None for empty geometries."""
    if not len(geometry):
        return []
    flat = ~shapely.has_z(geometry)
    rounded = np.empty(len(geometry), object)

    def round_(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.round(values, digits) + 0.0

    for mask, include_z in ((flat, False), (~flat, True)):
        if mask.any():
            rounded[mask] = shapely.transform(geometry[mask], round_, include_z=include_z)
    empty = shapely.is_empty(rounded)
    texts = shapely.to_geojson(rounded)
    return [None if none else orjson.Fragment(text) for none, text in zip(empty, texts, strict=True)]


def missing_datum_error(environment: str) -> MissingDatum:
    """Build the error for a conversion between metres and degrees without a datum."""
    return MissingDatum(
        f"{environment} has no datum, so local metres cannot be converted to WGS 84: PATCH it with "
        f'{{"datum": {{…}}}}, upload a datum.yaml, or request the other crs'
    )
