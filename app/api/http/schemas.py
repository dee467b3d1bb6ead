"""The edge's shapes that several nouns share: names, parameters, problems, versions.

The shapes of one noun stand in its module. The examples fit each other: a test runs every one of them against a server
that holds the demo.
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
MAX_TEXT = 20_000


class RequestModel(BaseModel):
    """A request body: unknown members and numbers that are not finite are refused."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


def _representable(moment: datetime) -> datetime:
    """Times near the years 1 and 9999 leave the calendar in another zone, UTC for instance."""
    try:
        moment.astimezone(UTC)
    except OverflowError:
        raise ValueError("this time is outside the calendar: give one between the years 2 and 9998") from None
    return moment


ApiTime = Annotated[datetime, AfterValidator(_representable)]


class DatumBody(RequestModel):
    """Where the local frame's origin is (WGS 84), and where its +y axis points."""

    latitude: float = Field(ge=-MAX_DATUM_LATITUDE, le=MAX_DATUM_LATITUDE, description="Degrees north.")
    longitude: float = Field(ge=-180, le=180, description="Degrees east.")
    altitude: float = Field(0.0, ge=-12_000, le=100_000, description="Metres above the ellipsoid.")
    heading: float = Field(0.0, ge=-360, le=360, description="Degrees clockwise from true north to the local +y axis.")


class DatumOut(BaseModel):
    """The local origin."""

    latitude: float
    longitude: float
    altitude: float
    heading: float


class ProblemItem(BaseModel):
    """One thing that is wrong or doubtful, and where."""

    problem: str
    file: str | None = None
    line: int | None = None
    where: str | None = None
    level: Literal["error", "warning"] | None = Field(
        default=None,
        description="Of a finding about a served map: error where its consumer would refuse it, else warning.",
    )


class ProblemOut(BaseModel):
    """RFC 9457."""

    type: str
    title: str
    status: int
    detail: str
    errors: list[ProblemItem] | None = None


class SourceOut(BaseModel):
    """An uploaded file. ``used``: whether the version was made from it."""

    name: str
    size: int
    sha256: str
    format: str | None
    used: bool


class VersionOut(BaseModel):
    """An immutable state. A dry run has ``version: null``."""

    environment: str
    version: int | None
    root: str
    parent: int | None
    author: str
    message: str
    time: datetime | None
    changes: dict[str, Any]
    sources: list[SourceOut]
    warnings: list[ProblemItem]
    information: dict[str, str]
    stale: list[dict[str, Any]] = Field(
        description="Derived parts whose inputs have changed since, with what has: maps are made from them anew."
    )


EnvironmentPath = Annotated[
    str, Path(pattern=NAME, description="An environment's name.", examples=["orchard"], max_length=63)
]
VersionPath = Annotated[
    str,
    Path(
        pattern=VERSION,
        description="Number, channel, or `latest`.",
        examples=["latest"],
    ),
]
Limit = Annotated[int, Query(ge=1, le=1000, description="Items on a page.")]
Cursor = Annotated[
    str | None, Query(max_length=500, description="Where the page starts: taken from the last page's `Link` header.")
]
IfMatch = Annotated[
    str | None,
    Header(
        alias="If-Match",
        max_length=2000,
        description='The version that the change builds on, as `"3"`, `"<root>"` or `*`; 412 where the head has moved.',
    ),
]
IdempotencyKey = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        max_length=255,
        description="A text of your choice; the same request sent again with it gets the same answer, and never makes "
        "a second version.",
    ),
]


def problem_responses(
    model: Any, *statuses: int, ok: int = 200, description: str = "OK"
) -> dict[int | str, dict[str, Any]]:
    """OpenAPI's responses: the good one by its shape, and which problems this call can meet besides the usual ones."""
    reasons = {
        400: "The body is malformed.",
        404: "There is no such thing.",
        406: "None of the accepted media types can be served.",
        409: "It does not fit the present state, or several things fit and none was named.",
        412: "The head has moved.",
        413: "Larger than the server takes.",
        415: "A media type or content coding that is not taken.",
        416: "The range lies outside of the file.",
        422: "The request, a file, or what is stored does not allow it; `errors` says where.",
        503: "Too busy, or a part of the server does not answer: try again after `Retry-After` seconds.",
    }
    out: dict[int | str, dict[str, Any]] = {}
    if model is not None:
        out[ok] = {"model": model, "description": description}
    problem = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
    for status in statuses:
        out[status] = {"description": reasons[status], "content": problem}
    return out
