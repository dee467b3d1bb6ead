"""Environments: create, find, update, rename, delete, restore and purge."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Final, Literal

from fastapi import Query, Request
from pydantic import BaseModel, ConfigDict, Field
from starlette.responses import Response

from app.api.http.auth import Admin, Editor, Principal, Viewer
from app.api.http.dependencies import Services, ServicesDep
from app.api.http.parameters import parse_box, parse_position
from app.api.http.responses import api_path, api_router, json_response, page_response
from app.api.http.schemas import (
    MAX_TEXT,
    NAME,
    Cursor,
    DatumBody,
    DatumOut,
    EnvironmentPath,
    IfMatch,
    Limit,
    RequestModel,
    problem_responses,
)
from app.errors import Conflict, Gone, Invalid, NotFound, Problem
from app.ingest import CommitRequest
from app.ingest.service import check_if_match
from app.model.frame import Datum
from app.store.area import DATUM_METRES, MARGIN_METRES, NEIGHBOURHOOD_METRES
from app.store.audit import set_audit_target
from app.store.values import Environment, Match, rfc3339

CONTAINS: Final = f"""\
`LAT,LON` in degrees: environments that contain this position (which map am I on?).

- An environment with a GNSS fence (polygons of its location layer) matches if the fence covers the position.
- One without a fence matches on mapped floor within {NEIGHBOURHOOD_METRES:.0f} m of its datum: the rectangle around
  a grid's free cells, the convex hull of a network, objects of kind `floor`, and {MARGIN_METRES:.0f} m around them.
- If nothing is mapped there, it matches within {DATUM_METRES:.0f} m of its datum.

A datum at exactly 0, 0 is ignored. Order: fences first, then the smallest area, then the nearest datum. `match` gives
the reason: `by`, `area_m2`, and `distance_m` from the position to the datum."""

RESERVED = frozenset({"robots", "server"})


class CloneBody(RequestModel):
    """Environment whose content the new one starts with."""

    environment: str = Field(examples=["orchard"])
    version: int | str = Field("latest", description="Version: number, channel or `latest`.", examples=["latest"])


class EnvironmentBody(RequestModel):
    """A new environment."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "name": "orchard-2",
                    "title": "Orchard behind the barn",
                    "datum": {"latitude": 53.2686, "longitude": -0.5245},
                    "tags": ["apple"],
                }
            ]
        },
    )

    name: str = Field(pattern=NAME, description="Lower case letters, digits, `_` and `-`; not `robots` or `server`.")
    title: str = Field("", max_length=200)
    description: str = Field("", max_length=MAX_TEXT)
    datum: DatumBody | None = Field(
        None, description="Local origin; creates version 1. Default: none, the environment starts empty."
    )
    tags: list[Annotated[str, Field(min_length=1, max_length=100)]] = Field(default_factory=list, max_length=100)
    clone: CloneBody | None = Field(
        None, description="Start with the content of another environment (creates version 1)."
    )


class EnvironmentPatch(RequestModel):
    """Members to change; the others keep their value."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"title": "The farm by the river", "tags": ["wheat"]}]},
    )

    name: str | None = Field(None, pattern=NAME, description="New name; the old one is available at once.")
    title: str | None = Field(None, max_length=200)
    description: str | None = Field(None, max_length=MAX_TEXT)
    tags: list[Annotated[str, Field(min_length=1, max_length=100)]] | None = Field(None, max_length=100)
    datum: DatumBody | None = Field(
        None,
        description="New local origin; creates a version. Local items keep their metres, wgs84 items their geographic "
        "position; the response contains warnings.",
    )


class MatchOut(BaseModel):
    """Reason for which an environment matches a position."""

    by: Literal["fence", "floor", "datum"] = Field(
        description="`fence`: inside the GNSS fence; `floor`: on mapped floor; `datum`: within 200 m of the datum."
    )
    area_m2: float = Field(description="Area of the fence, floor or neighbourhood in square metres.")
    distance_m: float | None = Field(description="Metres from the position to the datum, or null if there is none.")


class EnvironmentOut(BaseModel):
    """Environment with the state of its head. `bounds`: west, south, east, north in degrees."""

    name: str
    title: str
    description: str
    tags: list[str]
    version: int
    root: str
    datum: DatumOut | None
    bounds: list[float] | None
    created: datetime
    updated: datetime
    deleted: datetime | None = None
    match: MatchOut | None = Field(default=None, description="Only with `contains`.")


router = api_router("environments", "/environments")


def as_dict(environment: Environment, match: Match | None = None) -> dict[str, Any]:
    """Convert an environment to JSON. match: why it matches a position."""
    members = {
        "name": environment.name,
        "title": environment.title,
        "description": environment.description,
        "tags": list(environment.tags),
        "version": environment.head,
        "root": environment.root,
        "datum": environment.datum.as_dict() if environment.datum else None,
        "bounds": list(environment.bounds) if environment.bounds else None,
        "created": rfc3339(environment.created),
        "updated": rfc3339(environment.updated),
        "deleted": rfc3339(environment.deleted) if environment.deleted else None,
    }
    return members if match is None else {**members, "match": match.as_dict()}


def parse_datum(body: DatumBody) -> Datum:
    """Convert the datum of a request."""
    return Datum(body.latitude, body.longitude, body.altitude, body.heading)


def _headers(environment: Environment) -> dict[str, str]:
    return {"etag": f'"{environment.head}"'}


@router.get("", responses=problem_responses(list[EnvironmentOut]), summary="List environments")
def list_environments(
    request: Request,
    services: ServicesDep,
    principal: Viewer,
    q: Annotated[
        str | None,
        Query(
            max_length=200,
            pattern=r"^[^\x00]*$",
            description="Text to find in name, title, description or tags.",
            examples=["orchard"],
        ),
    ] = None,
    contains: Annotated[
        str | None,
        Query(
            description=CONTAINS,
            examples=["52.4206,5.6134"],
        ),
    ] = None,
    bbox: Annotated[
        str | None,
        Query(description="`W,S,E,N` in degrees: environments that intersect this box.", examples=["-1,53,0,54"]),
    ] = None,
    deleted: Annotated[
        bool, Query(description="List deleted environments instead, which can be restored or purged.")
    ] = False,
    limit: Limit = 100,
    cursor: Cursor = None,
) -> Response:
    """List the environments that the token can access, by name, or the best match first with `contains`."""
    position = None if contains is None else parse_position(contains)
    box = parse_box(bbox) if bbox is not None else None
    if position is not None:
        hits, following = services.store.areas.locate(
            *position,
            q=q or None,
            bbox=box,
            limit=limit,
            cursor=cursor,
            allowed=principal.environments,
            deleted=deleted,
        )
        return page_response(request, [as_dict(e, match) for e, match in hits], following)
    items, following = services.store.environments.page(
        q=q or None, bbox=box, limit=limit, cursor=cursor, allowed=principal.environments, deleted=deleted
    )
    return page_response(request, [as_dict(e) for e in items], following)


@router.post(
    "",
    status_code=201,
    responses=problem_responses(EnvironmentOut, 400, 404, 409, 410, 415, ok=201, description="The environment"),
    summary="Create an environment",
)
def create_environment(body: EnvironmentBody, services: ServicesDep, principal: Admin) -> Response:
    """Create an environment: empty (version 0), with a datum, or with the content of another one (version 1)."""
    principal.require_environment(body.name)
    _check_name(body.name)
    clone = None
    if body.clone is not None:
        if body.datum is not None:
            raise Invalid("datum and clone exclude each other: give one, and PATCH the datum of a clone later")
        principal.require_environment(body.clone.environment)
        clone = services.store.versions.get_committed(body.clone.environment, body.clone.version)
    set_audit_target(environment=body.name, target=f"environment {body.name}")
    environment = services.store.environments.create(
        body.name,
        title=body.title,
        description=body.description,
        tags=tuple(body.tags),
        author=principal.name,
        datum=parse_datum(body.datum) if body.datum else None,
        clone=clone,
    )
    return json_response(
        as_dict(environment), 201, {"location": api_path("environments", environment.name), **_headers(environment)}
    )


@router.get("/{env}", responses=problem_responses(EnvironmentOut, 404), summary="Get an environment")
def get_environment(env: EnvironmentPath, services: ServicesDep, _: Viewer) -> Response:
    """Return an environment. Its `ETag` is the number of the head, for `If-Match`."""
    environment = services.store.environments.get(env)
    return json_response(as_dict(environment), headers=_headers(environment))


@router.patch(
    "/{env}",
    responses=problem_responses(EnvironmentOut, 400, 404, 409, 412, 415),
    summary="Update, rename, or set the datum",
)
def update_environment(
    env: EnvironmentPath, body: EnvironmentPatch, services: ServicesDep, principal: Editor, if_match: IfMatch = None
) -> Response:
    """Change the given members.

    A new datum creates a version and requires an editor; all else requires an administrator.
    """
    given = body.model_dump(exclude_none=True)
    if not given:
        raise Invalid("no changes in the request: give at least one of name, title, description, tags, datum")
    if set(given) != {"datum"}:
        principal.require_role("admin")
    if if_match is not None:
        check_if_match(if_match, services.store.versions.get(env))
    if body.name is not None and body.name != env:
        _check_free(services, body.name, principal)
    warnings: list[Any] = []
    if body.datum is not None:
        outcome = services.ingest.set_datum(
            env, parse_datum(body.datum), CommitRequest(principal.name, if_match=if_match)
        )
        warnings = outcome.body.get("warnings", []) if outcome.status == "created" else []
    if set(given) != {"datum"}:
        environment = services.store.environments.update(
            env,
            new_name=body.name if body.name != env else None,
            title=body.title,
            description=body.description,
            tags=tuple(body.tags) if body.tags is not None else None,
            author=principal.name,
        )
    else:
        environment = services.store.environments.get(env)
    headers = {**_headers(environment), "content-location": api_path("environments", environment.name)}
    return json_response({**as_dict(environment), **({"warnings": warnings} if warnings else {})}, headers=headers)


@router.delete("/{env}", status_code=204, responses=problem_responses(None, 404), summary="Delete an environment")
def delete_environment(env: EnvironmentPath, services: ServicesDep, principal: Admin) -> Response:
    """Delete an environment. It can be restored until it is purged; its name stays in use until then."""
    services.store.environments.delete(env, principal.name)
    return Response(status_code=204)


@router.post(
    "/{env}/restore", responses=problem_responses(EnvironmentOut, 404, 409), summary="Restore a deleted environment"
)
def restore_environment(env: EnvironmentPath, services: ServicesDep, principal: Admin) -> Response:
    """Restore a deleted environment with all its versions and channels."""
    environment = services.store.environments.restore(env, principal.name)
    return json_response(as_dict(environment), headers=_headers(environment))


@router.post(
    "/{env}/purge", status_code=204, responses=problem_responses(None, 404, 409), summary="Purge a deleted environment"
)
def purge_environment(env: EnvironmentPath, services: ServicesDep, _: Admin) -> Response:
    """Remove a deleted environment and all its versions permanently. Its name becomes available."""
    services.store.environments.purge(env)
    return Response(status_code=204)


def _check_name(name: str) -> None:
    if name in RESERVED:
        raise Invalid(f"the name {name!r} is reserved: choose another", [Problem("reserved", where="body.name")])


def _check_free(services: Services, name: str, principal: Principal) -> None:
    """Check that a new name is available, before any part of a PATCH is applied."""
    principal.require_environment(name)
    _check_name(name)
    try:
        services.store.environments.get(name, deleted=True)
    except Gone:
        pass
    except NotFound:
        return
    raise Conflict(f"the environment {name!r} already exists, or is deleted and not yet purged: choose another name")
