"""Schemas that several resources share: names, parameters, problems, versions.

The schemas of one resource are in its module. A test runs all examples against a server with the demo environment.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated, Any, Literal

from fastapi import Header, Path, Query
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from app.api.http.problems import MEDIA_TYPE
from app.model.frame import MAX_DATUM_LATITUDE

NAME = r"^[a-z0-9][a-z0-9_-]{0,62}$"
CHANNEL = r"^[a-z][a-z0-9_-]{0,62}$"
VERSION = r"^([0-9]{1,18}|[a-z][a-z0-9_-]{0,62})$"
DRY_RUN = r"^dry:[0-9a-f]{32}$"
VERSION_OR_PENDING = r"^([0-9]{1,18}|[a-z][a-z0-9_-]{0,62}|dry:[0-9a-f]{32}|draft:[0-9a-f]{16})$"
MAX_TEXT = 20_000


class RequestModel(BaseModel):
    """Request body: unknown members and numbers that are not finite are refused."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


def _representable(moment: datetime) -> datetime:
    """Check that a time can be converted to UTC: near the years 1 and 9999 it may leave the calendar."""
    try:
        moment.astimezone(UTC)
    except OverflowError:
        raise ValueError("time out of range: give one between the years 2 and 9998") from None
    return moment


ApiTime = Annotated[datetime, AfterValidator(_representable)]


class DatumBody(RequestModel):
    """Origin of the local frame (WGS 84) and heading of its +y axis."""

    latitude: float = Field(ge=-MAX_DATUM_LATITUDE, le=MAX_DATUM_LATITUDE, description="Degrees north.")
    longitude: float = Field(ge=-180, le=180, description="Degrees east.")
    altitude: float = Field(0.0, ge=-12_000, le=100_000, description="Metres above the ellipsoid.")
    heading: float = Field(0.0, ge=-360, le=360, description="Degrees clockwise from true north to the local +y axis.")


class DatumOut(BaseModel):
    """Origin of the local frame (WGS 84) and heading of its +y axis."""

    latitude: float
    longitude: float
    altitude: float
    heading: float


class ProblemItem(BaseModel):
    """Error or warning, with its place."""

    problem: str
    file: str | None = None
    line: int | None = None
    where: str | None = None
    level: Literal["error", "warning"] | None = Field(
        default=None,
        description="Severity of a finding in a served map: `error` if its consumer would refuse it, else `warning`.",
    )


class ProblemOut(BaseModel):
    """Error response (RFC 9457)."""

    type: str
    title: str
    status: int
    detail: str
    errors: list[ProblemItem] | None = None


class SourceOut(BaseModel):
    """Uploaded file. `used`: whether the version uses it. `removed`: when a rule of retention removed it."""

    name: str
    size: int
    sha256: str
    format: str | None
    used: bool
    removed: datetime | None = None


class StaleOut(BaseModel):
    """Derived part whose inputs have changed since."""

    layer: str
    level: str
    name: str
    changed: list[str] = Field(description="Inputs that have changed.")
    method: str | None = Field(description="Derivation that computed it, or null.")
    parameters: dict[str, Any] = Field(description="Parameters that it was computed with.")


class ThinnedOut(BaseModel):
    """When the content of a version was removed, and by which rule."""

    time: datetime
    rule: str


class VersionContentOut(BaseModel):
    """What versions and dry runs have in common."""

    environment: str
    root: str
    author: str
    message: str
    changes: dict[str, Any]
    sources: list[SourceOut]
    warnings: list[ProblemItem]
    information: dict[str, str]
    stale: list[StaleOut] = Field(
        description="Derived parts whose inputs have changed since, with the changed inputs. Maps derive them again."
    )
    tags: list[str] = Field([], description="Names of the version, which keep it from being thinned.")


class VersionOut(VersionContentOut):
    """Immutable version of an environment."""

    version: int
    parent: int | None
    time: datetime
    thinned: ThinnedOut | None = Field(
        None, description="Set if a rule of retention has removed the content: only the history lists such a version."
    )


VersionName = Annotated[
    int | str, Field(description="Number of the version, `dry:…` of a dry run, or `draft:…`.", examples=[3])
]


class DiffOut(BaseModel):
    """Differences between two versions."""

    model_config = ConfigDict(populate_by_name=True)

    from_: VersionName = Field(alias="from")
    to: VersionName
    layers: dict[str, Any]


class DryRunOut(VersionContentOut):
    """Version that a change or draft would create. A dry run can be read by its `id` for ten minutes, and committed."""

    id: str = Field(
        description="Name by which it can be read like a version of its environment: `dry:…` or `draft:…`.",
        examples=["dry:0123456789abcdef0123456789abcdef"],
    )
    expires: datetime = Field(description="Time from which it returns 404.")
    revision: int | None = Field(description="Of a draft: rises with every edit. Null for a dry run.")
    version: None
    parent: int = Field(description="Number of the head that it was made for.")
    time: None
    diff: DiffOut = Field(description="Differences from `parent`, as `GET …/diff` returns them.")


EnvironmentPath = Annotated[
    str, Path(pattern=NAME, description="Name of the environment.", examples=["orchard"], max_length=63)
]
VersionPath = Annotated[
    str,
    Path(
        pattern=VERSION_OR_PENDING,
        description="Version: number, channel, or `latest`. To read: also a dry run, `dry:…`, or a draft, `draft:…`.",
        examples=["latest"],
    ),
]
Limit = Annotated[int, Query(ge=1, le=1000, description="Maximum number of items per page.")]
Cursor = Annotated[
    str | None, Query(max_length=500, description="Start of the page, from the `Link` header of the previous page.")
]
IfMatch = Annotated[
    str | None,
    Header(
        alias="If-Match",
        max_length=2000,
        description='Version on which the change is based, as `"3"`, `"<root>"` or `*`. Returns 412 if the head has '
        "moved.",
    ),
]
DryRun = Annotated[
    bool,
    Field(
        description="Return the version that would be created, and store it only as a dry run: see `DryRunOut`. "
        "`If-Match` is checked, an `Idempotency-Key` is not used up."
    ),
]
IdempotencyKey = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        max_length=255,
        description="Any text. A repeated request with the same key returns the same response and creates no second "
        "version.",
    ),
]


UNCHANGED_OR_DRY_RUN: dict[int | str, dict[str, Any]] = {
    200: {"model": VersionOut | DryRunOut, "description": "Nothing changed: the head. Or the dry run."}
}


def component_schemas(*models: type[BaseModel]) -> dict[str, Any]:
    """Build ``openapi_extra`` that defines the models of responses whose media type is not ``application/json``."""
    schemas: dict[str, Any] = {}
    for model in models:
        schema = model.model_json_schema(ref_template="#/components/schemas/{model}", mode="serialization")
        schemas |= {**schema.pop("$defs", {}), model.__name__: schema}
    return {"x-schemas": schemas}


def problem_responses(
    model: Any, *statuses: int, ok: int = 200, description: str = "OK"
) -> dict[int | str, dict[str, Any]]:
    """Build the OpenAPI responses: success with its schema, and the problems besides those of every call."""
    reasons = {
        400: "The body is malformed.",
        401: "The token or code is wrong, used or expired.",
        403: "The request comes from a page of another site.",
        404: "Not found.",
        406: "None of the accepted media types is available.",
        409: "Conflict with the present state, or several items match and none is named.",
        410: "A rule of retention has removed the content of the version.",
        412: "The head has moved since the version on which the change is based.",
        413: "Too large.",
        415: "Unsupported media type or content coding.",
        416: "The range is outside the file.",
        422: "The request, a file or stored data is not suitable; `errors` has the details.",
        429: "Too many wrong tokens or codes from this address.",
        503: "Overloaded, or a part of the server does not respond: try again after `Retry-After` seconds.",
    }
    out: dict[int | str, dict[str, Any]] = {}
    if model is not None:
        out[ok] = {"model": model, "description": description}
    problem = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
    for status in statuses:
        out[status] = {"description": reasons[status], "content": problem}
    return out
