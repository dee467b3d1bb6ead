"""Shapes of the responses, for the OpenAPI document of the server."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field
from pydantic.json_schema import SkipJsonSchema

from app.api.http.features import GeometryOut, omittable
from app.api.http.schemas import DatumOut


class OgcLinkOut(BaseModel):
    """Link with an absolute URL."""

    href: str
    rel: str = Field(description="Relation: `self`, `alternate`, `next`, `items`, `data` …")
    type: str = Field(description="Media type of the target.")
    title: str


class OgcSpatialExtentOut(BaseModel):
    """Boxes of a collection."""

    bbox: list[tuple[float, float, float, float]] = Field(
        description="West, south, east, north in degrees; west > east crosses the antimeridian."
    )
    crs: Literal["http://www.opengis.net/def/crs/OGC/1.3/CRS84"]


class OgcExtentOut(BaseModel):
    """Extent of a collection."""

    spatial: OgcSpatialExtentOut


class OgcLandingOut(BaseModel):
    """Landing page."""

    title: str
    description: str
    attribution: str | SkipJsonSchema[None] = omittable("Credits of the sources; omitted if there are none.")
    crs: list[str] | SkipJsonSchema[None] = omittable("CRSs of maps; omitted without a datum.")
    extent: OgcExtentOut | SkipJsonSchema[None] = omittable("Omitted if nothing has a position.")
    links: list[OgcLinkOut]


class OgcConformanceOut(BaseModel):
    """Conformance classes."""

    model_config = ConfigDict(populate_by_name=True)

    conforms_to: list[str] = Field(alias="conformsTo")


class OgcCollectionOut(BaseModel):
    """Collection; modules add members."""

    model_config = ConfigDict(extra="allow", populate_by_name=True)

    id: str
    title: str
    description: str
    extent: OgcExtentOut | SkipJsonSchema[None] = omittable("Omitted if nothing has a position.")
    item_type: Literal["feature"] = Field(alias="itemType")
    crs: list[str] | SkipJsonSchema[None] = omittable("Supported values of `crs`, the default first.")
    storage_crs: str | SkipJsonSchema[None] = omittable("CRS without conversion.", "storageCrs")
    links: list[OgcLinkOut]


class OgcCollectionsOut(BaseModel):
    """Collections with content."""

    crs: list[str] = Field(description="CRSs that all collections with items support.")
    collections: list[OgcCollectionOut]
    links: list[OgcLinkOut]
    notice: str | SkipJsonSchema[None] = omittable("Why there is no collection, and what to do.")


class OgcFeatureOut(BaseModel):
    """Feature."""

    model_config = ConfigDict(extra="allow")

    type: Literal["Feature"]
    id: str
    geometry: GeometryOut | None
    properties: dict[str, Any]
    links: list[OgcLinkOut] | SkipJsonSchema[None] = omittable("Only of a single feature.")
    datum: DatumOut | SkipJsonSchema[None] = omittable("Only of a single feature as JSON-FG in local metres.")


class OgcFeaturesOut(BaseModel):
    """Page of features."""

    model_config = ConfigDict(extra="allow", populate_by_name=True)

    type: Literal["FeatureCollection"]
    features: list[OgcFeatureOut]
    datum: DatumOut | SkipJsonSchema[None] = omittable("Origin of the local frame, of JSON-FG in local metres only.")
    links: list[OgcLinkOut]
    time_stamp: str = Field(alias="timeStamp", description="Time of the response, RFC 3339 in UTC.")
    number_matched: int = Field(alias="numberMatched", description="Number of features on all pages.")
    number_returned: int = Field(alias="numberReturned", description="Number of features on this page.")
