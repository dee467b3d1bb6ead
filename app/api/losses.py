"""What a format loses of a version, drawn: the map is written, read back and compared."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

from fastapi import Query, Request
from pydantic import BaseModel, Field
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from app.api.http.addresses import request_address
from app.api.http.auth import Viewer
from app.api.http.caching import none_match
from app.api.http.conversions import JobStarted, job_started_response
from app.api.http.dependencies import Services, ServicesDep
from app.api.http.feature_changes import FeatureChange, FeatureChangeOut, FeatureState, change_features
from app.api.http.features import (
    GEOJSON,
    CollectionOut,
    Crs,
    PageCursor,
    PageLimit,
    Position,
    collection_head,
    missing_datum_error,
    page_of,
)
from app.api.http.parameters import parse_version_ref, require_format
from app.api.http.responses import api_router, json_bytes, next_page
from app.api.http.schemas import EnvironmentPath, VersionPath, component_schemas, problem_responses
from app.convert.cache import CachedMap
from app.convert.losses import Loss, decode_losses, losses_recipe, states_as_features
from app.convert.recipe import Recipe
from app.errors import Invalid, NotFound, Problem
from app.model.features import Features
from app.model.frame import Anchor
from app.model.geodesy import local_frame
from app.store.values import Version

router = api_router("maps", "/environments/{env}/versions/{v}/losses")


class DroppedOut(BaseModel):
    """Content that a format cannot contain, as its report states it."""

    subject: str = Field(alias="what")
    count: int
    why: str


class LossReportOut(BaseModel):
    """Statement of the map's report."""

    format: str
    read: bool = Field(description="Whether the format can be read. If not, there are no features, only `dropped`.")
    dropped: list[DroppedOut]


class LossesOut(CollectionOut):
    """Features that a format loses, or returns with differences."""

    version: int | str
    features: list[FeatureChangeOut]
    report: LossReportOut


@router.get(
    "",
    response_class=Response,
    responses={
        **problem_responses(None, 404, 409, 422, 503),
        200: {
            "description": "The losses",
            "content": {GEOJSON: {"schema": {"$ref": "#/components/schemas/LossesOut"}}},
        },
        202: {"description": "The comparison takes long: follow the job at `Location`, then repeat the request."},
        304: {"description": "Not modified: the client has this content"},
    },
    summary="Get what a format would lose",
    openapi_extra=component_schemas(LossesOut),
)
async def get_losses(
    env: EnvironmentPath,
    v: VersionPath,
    request: Request,
    services: ServicesDep,
    principal: Viewer,
    format: Annotated[
        str, Query(max_length=64, description="Id of a format; see `GET /api/v1/formats`.", examples=["kml"])
    ],
    level: Annotated[str | None, Query(max_length=256, description="Only features of this level.")] = None,
    crs: Crs = None,
    limit: PageLimit = None,
    cursor: PageCursor = None,
) -> Response:
    """Return the features that a map in a format does not contain, or returns differently.

    The map of the whole site, without closures, is converted and read back as an upload. `change` is `deleted` for
    features that do not come back. It is `changed` for those with other properties (`fields`), another position
    (`geometry`, more than 1 cm) or another level (`level`); `after` is what comes back. Features are matched by id,
    else by name, else by the nodes that an edge joins, else by position: another id alone is no loss. Format-specific
    properties (`properties.<format>`), added ones, and noise below one millionth are not compared.

    Grids, images and voxels are in `report.dropped` only. Pages are as those of layers.
    """
    version = await run_in_threadpool(services.store.versions.get, env, parse_version_ref(v))
    fmt = require_format(format, "format")
    if fmt.write is None:
        raise Invalid(f"{format} cannot be written: choose another format", [Problem("read only", where="format")])
    levels = sorted({entry.key.level for entry in version.parts})
    if level is not None and level not in levels:
        raise NotFound(f"version {version.ref} has no level {level!r}; available: {', '.join(levels) or 'none'}")
    recipe = await run_in_threadpool(services.maps.recipe, version, format)
    wanted = losses_recipe(recipe)
    outcome = await services.jobs.convert(lambda: wanted, principal, request_address(request))
    if isinstance(outcome, JobStarted):
        return job_started_response(outcome.job)
    anchor: Anchor = crs or ("wgs84" if version.datum else "local")
    etag = f'"{wanted.key[:32]}-{version.ref}-{anchor}"'
    if none_match(request.headers.get("if-none-match"), etag):
        return Response(status_code=304, headers={"etag": etag})
    selection = (anchor, level, limit, cursor)
    body, following = await run_in_threadpool(_write, services, recipe, outcome[1], fmt.read is not None, *selection)
    return Response(body, headers={"etag": etag, **next_page(request, following)}, media_type=GEOJSON)


def _write(
    services: Services,
    recipe: Recipe,
    cached: CachedMap,
    is_readable: bool,
    crs: Anchor,
    level: str | None,
    limit: int | None,
    cursor: str | None,
) -> tuple[bytes, str | None]:
    """Write a page of losses; returns it with the cursor of the next one."""
    version = recipe.version
    losses = [one for one in decode_losses(cached.single_file().read()) if level in (None, one.key.level)]
    page = page_of(losses, _position, limit, cursor)
    changes = _load_changes(services, version, [losses[k] for k in page.indices], crs)
    report = services.maps.report(recipe)
    body: dict[str, Any] = {
        **collection_head(crs, version),
        "version": version.ref,
        "features": change_features(changes, crs),
        **page.members,
        "report": {
            "format": recipe.format.name,
            "read": is_readable,
            "dropped": [line.as_dict() for line in report.dropped],
        },
    }
    return json_bytes(body), page.members.get("next")


def _position(loss: Loss) -> Position:
    return Position(loss.key.layer, loss.key.level, loss.key.name, loss.id)


def _load_changes(services: Services, version: Version, losses: Sequence[Loss], crs: Anchor) -> list[FeatureChange]:
    """Load the stored features of losses, and decode what comes back instead."""
    before: dict[Position, FeatureState] = {}
    for key in {one.key for one in losses}:
        ids = [one.id for one in losses if one.key == key]
        part = services.store.content.features(version, key, ids=ids)
        states = _states(part, version, crs)
        before |= {Position(key.layer, key.level, key.name, item): states[k] for k, item in enumerate(part.ids)}
    returned = [one.after for one in losses if one.after is not None]
    after = iter(_states(states_as_features(returned), version, crs))
    return [
        FeatureChange(
            _position(one),
            one.change,
            before[_position(one)],
            None if one.after is None else next(after),
            one.fields,
        )
        for one in losses
    ]


def _states(part: Features, version: Version, crs: Anchor) -> list[FeatureState]:
    """Return features in the coordinates of the response."""
    frame = local_frame(version.datum) if version.datum else None
    if frame is None and bool((part.local != (crs == "local")).any()):
        raise missing_datum_error(version.environment)
    geometry = part.in_local(frame) if crs == "local" else part.in_wgs84(frame)
    return [FeatureState(*state) for state in zip(geometry, part.properties, strict=True)]
