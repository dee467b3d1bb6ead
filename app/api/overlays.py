"""Overlays: robots report obstructions, editors decide; accepted overlays are in force on every channel."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from datetime import UTC, datetime, timedelta
from functools import partial
from typing import Annotated, Any, Literal

import shapely
from fastapi import Path, Query, Request
from pydantic import BaseModel, ConfigDict, Field
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from app.api.http.addresses import request_address
from app.api.http.auth import Editor, Principal, RobotRole, Viewer
from app.api.http.conversions import JobStarted, job_started_response
from app.api.http.dependencies import Services, ServicesDep
from app.api.http.responses import api_router, json_response
from app.api.http.schemas import ApiTime, DryRun, DryRunOut, EnvironmentPath, RequestModel, problem_responses
from app.convert.cache import CachedMap
from app.convert.closures import place_problem
from app.errors import Conflict, Denied, Invalid, NotFound, Problem
from app.fleet import live, overlays
from app.ingest import CommitRequest
from app.ingest.edits import parse_geometry
from app.model.closures import Closures
from app.model.frame import GROUND
from app.store.fleet_values import Overlay
from app.store.values import Version

MAX_POINTS = 1000
"""Maximum number of points of a reported polygon, because an event carries it to every robot."""

DEFAULT_SECONDS = 3600.0
MAX_SECONDS = 2_592_000.0


class EndBody(RequestModel):
    """End of a closure: from now, or a time."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"ttl_seconds": 7200}]})

    ttl_seconds: float | None = Field(
        None,
        ge=1,
        le=MAX_SECONDS,
        description="Duration in seconds from now. A report with neither `ttl_seconds` nor `expires` ends in 3600 s.",
    )
    expires: ApiTime | None = Field(None, description="End, instead of `ttl_seconds`: RFC 3339 time with time zone.")


class OverlayBody(EndBody):
    """Obstruction: a polygon or an edge."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "kind": "blocked",
                    "polygon": {
                        "type": "Polygon",
                        "coordinates": [[[5.6133, 52.4206], [5.6134, 52.4206], [5.6134, 52.4207], [5.6133, 52.4206]]],
                    },
                    "crs": "wgs84",
                    "ttl_seconds": 1800,
                    "detail": "a fallen tree",
                }
            ]
        },
    )

    kind: Literal["blocked"]
    polygon: dict[str, Any] | None = Field(None, description="Blocked area: GeoJSON Polygon or MultiPolygon.")
    edge: str | None = Field(
        None, min_length=1, max_length=512, description="Blocked edge, by id: one direction of a lane."
    )
    crs: Literal["local", "wgs84"] | None = Field(
        None, description="CRS of the polygon. Default: `wgs84` if there is a datum, else `local`."
    )
    level: str | None = Field(
        None, min_length=1, max_length=256, description="Level of the polygon. Default: `ground`."
    )
    state: Literal["pending", "accepted"] = Field(
        "pending", description="`accepted` (editors only): in force at once, on every channel."
    )
    detail: str | None = Field(None, max_length=2000)


class OverlayOut(BaseModel):
    """Reported obstruction and its state."""

    id: str
    environment: str
    kind: Literal["blocked"]
    state: Literal["pending", "accepted", "rejected", "expired", "ended"]
    level: str
    reporter: str
    created: datetime
    expires: datetime
    polygon: dict[str, Any] | None = None
    edge: str | None = None
    crs: Literal["local", "wgs84"] | None = None
    detail: str | None = None
    decided_by: str | None = None
    decided: datetime | None = None
    version: int | None = Field(None, description="Version that made it permanent.")


class DynamicEdgesOut(BaseModel):
    """Request of `nav2_msgs/srv/DynamicEdges`."""

    closed_edges: list[int]
    opened_edges: list[int]


class LaneRequestOut(BaseModel):
    """Message of `rmf_fleet_msgs/msg/LaneRequest`."""

    fleet_name: str
    open_lanes: list[int]
    close_lanes: list[int]


class GraphLanesOut(BaseModel):
    """Message to publish for one navigation graph."""

    graph: str = Field(description="File of the graph, `0.yaml` …")
    message: LaneRequestOut


class LaneRequestsOut(BaseModel):
    """One message per navigation graph."""

    requests: list[GraphLanesOut]


class ZoneSetsOut(BaseModel):
    """Closures as zone sets of VDA 5050 3.0."""

    model_config = ConfigDict(populate_by_name=True)

    zone_sets: list[dict[str, Any]] = Field(alias="zoneSets")
    closed_edges: list[dict[str, Any]] = Field(alias="closedEdges")


OverlayPath = Annotated[str, Path(max_length=100, description="Id of the overlay.")]

router = api_router("overlays", "/environments/{env}/overlays")

Ref = Annotated[
    str | None,
    Query(
        pattern=r"^([a-z][a-z0-9_-]{0,62}|\d{1,18})$",
        description="Version that the planners have loaded: a channel or number. Default: `production` if it exists, "
        "else `latest`.",
    ),
]


@router.get("", responses=problem_responses(list[OverlayOut], 404), summary="List overlays")
def list_overlays(
    env: EnvironmentPath,
    services: ServicesDep,
    _: Viewer,
    state: Annotated[
        Literal["pending", "accepted", "rejected", "expired", "ended"] | None,
        Query(
            description="Only overlays in this state. Default: all of the last 30 days. `accepted` ones are in force."
        ),
    ] = None,
) -> Response:
    """List overlays, oldest first.

    `pending` waits for a decision, `accepted` is in force on every channel, `rejected` was declined, `expired` ended
    without a decision, `ended` is over.
    """
    return json_response([overlay.as_dict() for overlay in services.store.overlays.all(env, state)])


@router.post(
    "",
    status_code=201,
    responses={
        **problem_responses(OverlayOut, 400, 404, 409, 415, ok=201, description="Pending, or in force"),
        200: {"model": OverlayOut, "description": "Already reported; the expiry was updated."},
    },
    summary="Report an obstruction",
)
def report_overlay(env: EnvironmentPath, body: OverlayBody, services: ServicesDep, principal: RobotRole) -> Response:
    """Report that a polygon or an edge is blocked until a given time.

    With `state: "accepted"` (editors only) it is in force at once, on every channel; otherwise an editor decides.
    """
    if (body.polygon is None) == (body.edge is None):
        raise Invalid(
            "invalid obstruction: give either polygon or edge", [Problem("give either polygon or edge", where="body")]
        )
    if body.state == "accepted" and principal.role not in ("editor", "admin"):
        raise Denied("only editors can accept an overlay: report it without state, and an editor decides")
    versions = list(shown_versions(services, env))
    head = versions[0]
    now = datetime.now(UTC)
    crs = None if body.polygon is None else body.crs or ("wgs84" if head.datum else "local")
    level = body.level or GROUND
    edge = None
    if body.edge is not None:
        key, feature = overlays.find_edge(services.store, versions, body.edge)
        level, edge = key.level, feature.id
    reported = Overlay(
        environment=env,
        kind=body.kind,
        level=level,
        polygon=None if body.polygon is None else parse_polygon(body.polygon),
        edge=edge,
        crs=crs,
        detail=body.detail,
        reporter=principal.robot or principal.name,
        created=now,
        expires=_expiry_of(body, now),
        state=body.state,
        decided_by=principal.name if body.state == "accepted" else None,
        decided=now if body.state == "accepted" else None,
    )
    check_place(reported, versions)
    overlay, new = services.store.overlays.add(reported)
    return json_response(overlay.as_dict(), 201 if new else 200)


def _expiry_of(body: EndBody, now: datetime) -> datetime:
    """Compute the end of a report or closure. Raises Invalid."""
    if body.expires is None:
        return now + timedelta(seconds=DEFAULT_SECONDS if body.ttl_seconds is None else body.ttl_seconds)
    problem = ""
    if body.ttl_seconds is not None:
        problem = "expires and ttl_seconds exclude each other: give one"
    elif body.expires.tzinfo is None:
        problem = "expires needs a time zone, for example 2030-01-31T06:00:00Z"
    elif body.expires <= now:
        problem = "expires is in the past: give a later time"
    elif body.expires > now + timedelta(seconds=MAX_SECONDS):
        problem = (
            f"expires is more than {MAX_SECONDS / 86400:g} days ahead: give an earlier time, or block it "
            "permanently with an edit"
        )
    if problem:
        raise Invalid(problem, [Problem(problem, where="body.expires")])
    return body.expires


def check_place(overlay: Overlay, versions: Iterable[Version]) -> None:
    """Raise Invalid if an area cannot be placed in any version that robots may run."""
    if overlay.polygon is None:
        return
    problems = [place_problem(overlay.closure, version) for version in versions]
    if None not in problems:
        problem = f"the polygon cannot become a closure: {problems[0]}"
        raise Invalid(problem, [Problem(str(problems[0]), where="polygon")])


def shown_versions(services: Services, env: str) -> Iterator[Version]:
    """Yield the head, then the versions of channels: robots report from any of them."""
    head = services.store.versions.get(env)
    yield head
    numbers = {channel.version for channel in services.store.channels.all(env)} - {None, head.number}
    for number in sorted((n for n in numbers if n is not None), reverse=True):
        yield services.store.versions.get(env, number)


def parse_polygon(given: Mapping[str, Any]) -> dict[str, Any]:
    """Parse a valid GeoJSON polygon, without foreign members. Raises Invalid."""
    shape = parse_geometry(given)
    if shape.geom_type not in ("Polygon", "MultiPolygon") or shape.is_empty or not shape.is_valid:
        reason = shapely.is_valid_reason(shape)
        problem = f"must be a valid GeoJSON Polygon or MultiPolygon, got {shape.geom_type}: {reason}"
        raise Invalid(f"the polygon {problem}", [Problem(problem, where="body.polygon")])
    if (count := int(shapely.get_num_coordinates(shape))) > MAX_POINTS:
        problem = f"has {count} points; the limit is {MAX_POINTS}: simplify it"
        raise Invalid(f"the polygon {problem}", [Problem(problem, where="body.polygon")])
    clean: dict[str, Any] = json.loads(shapely.to_geojson(shape))
    return clean


@router.post("/{id}/accept", responses=problem_responses(OverlayOut, 404, 409, 422, 503), summary="Accept an overlay")
def accept_overlay(env: EnvironmentPath, id: OverlayPath, services: ServicesDep, principal: Editor) -> Response:
    """Put an overlay in force on every channel until its end: areas become keepout zones, edges are closed.

    No version changes.
    """
    now = datetime.now(UTC)
    overlay = services.store.overlays.get(env, id)
    if overlay.state == "pending" and overlay.expires <= now:
        raise Conflict(f"the overlay {id} has expired: report it again")
    if overlay.state == "pending":
        versions = list(shown_versions(services, env))
        if overlay.edge is not None:
            overlays.find_edge(services.store, versions, overlay.edge)
        check_place(overlay, versions)
    return json_response(services.store.overlays.decide(env, id, "pending", "accepted", principal.name, now).as_dict())


@router.post("/{id}/reject", responses=problem_responses(OverlayOut, 404, 409), summary="Reject an overlay")
def reject_overlay(env: EnvironmentPath, id: OverlayPath, services: ServicesDep, principal: Editor) -> Response:
    """Reject a pending overlay. It stays in the list and has no effect."""
    decided = services.store.overlays.decide(env, id, "pending", "rejected", principal.name, datetime.now(UTC))
    return json_response(decided.as_dict())


@router.patch(
    "/{id}",
    responses=problem_responses(OverlayOut, 400, 404, 409, 415),
    summary="Change the end of an accepted overlay",
)
def change_overlay(
    env: EnvironmentPath, id: OverlayPath, body: EndBody, services: ServicesDep, principal: Editor
) -> Response:
    """Let a closure end earlier or later. Robots get it with its new end: the event is `overlay.accepted` again."""
    if body.ttl_seconds is None and body.expires is None:
        problem = "give ttl_seconds or expires"
        raise Invalid(f"the new end is missing: {problem}", [Problem(problem, where="body")])
    now = datetime.now(UTC)
    moved = services.store.overlays.move_end(env, id, _expiry_of(body, now), principal.name, now)
    return json_response(moved.as_dict())


@router.post("/{id}/end", responses=problem_responses(OverlayOut, 404, 409), summary="End an accepted overlay now")
def end_overlay(env: EnvironmentPath, id: OverlayPath, services: ServicesDep, principal: Editor) -> Response:
    """Open the area or edge again, on every channel at once."""
    return json_response(
        services.store.overlays.decide(env, id, "accepted", "ended", principal.name, datetime.now(UTC)).as_dict()
    )


@router.post(
    "/{id}/keep",
    responses=problem_responses(OverlayOut | DryRunOut, 404, 409, 422, 503),
    summary="Make an accepted overlay permanent",
)
def keep_overlay(
    env: EnvironmentPath,
    id: OverlayPath,
    services: ServicesDep,
    principal: Editor,
    dry_run: Annotated[DryRun, Query()] = False,
) -> Response:
    """Create a version with the obstruction: an area as a keepout zone, an edge with `blocked: true`.

    The overlay stays in force until its end. Promote the version before that, so that robots keep out permanently.
    To commit after a dry run, call it again without `dry_run`, so that the overlay refers to the version.
    """
    overlay = services.store.overlays.get(env, id)
    if overlay.state != "accepted":
        raise Conflict(f"the overlay {id} is {overlay.state}: only accepted overlays can be made permanent")
    obstruction = f"edge {overlay.edge}" if overlay.edge is not None else "a polygon"
    outcome = services.ingest.amend(
        env,
        partial(overlays.permanent_edits, services.store, overlay=overlay),
        CommitRequest(
            principal.name,
            f"{obstruction} is blocked permanently (reported by {overlay.reporter})",
            dry_run=dry_run,
        ),
    )
    if outcome.status == "dry_run":
        return json_response(outcome.body)
    assert outcome.version is not None
    return json_response(services.store.overlays.note_kept(env, id, outcome.version.number).as_dict())


# --- closures in the formats of planners ---


@router.get(
    "/nav2", responses=problem_responses(DynamicEdgesOut, 404, 409, 422), summary="Get closures for Nav2's route server"
)
async def nav2_edges(
    env: EnvironmentPath, request: Request, services: ServicesDep, principal: Viewer, version: Ref = None
) -> Response:
    """Return a request of `nav2_msgs/srv/DynamicEdges`.

    It contains the numbers of closed and reopened edges in the graph of `maps/nav2_route?closures=mark`.
    """
    maps = await _files_with_marks(services, env, version, "nav2_route", request, principal)
    if isinstance(maps, JobStarted):
        return job_started_response(maps.job)
    now, before = (live.closed_edges(files) for files in maps)
    return json_response({"closed_edges": now, "opened_edges": sorted(set(before) - set(now))})


@router.get(
    "/rmf",
    responses=problem_responses(LaneRequestsOut, 404, 409, 422),
    summary="Get closures for Open-RMF fleet adapters",
)
async def rmf_lanes(
    env: EnvironmentPath,
    request: Request,
    services: ServicesDep,
    principal: Viewer,
    version: Ref = None,
    fleet: Annotated[str, Query(max_length=256, description="`fleet_name` of the messages.")] = "",
) -> Response:
    """Return messages of `rmf_fleet_msgs/msg/LaneRequest`, one per graph.

    They have the lanes to close, and the lanes to open again, by their indexes in the graphs of
    `maps/rmf_nav_graph?closures=mark`.
    """
    maps = await _files_with_marks(services, env, version, "rmf_nav_graph", request, principal)
    if isinstance(maps, JobStarted):
        return job_started_response(maps.job)
    now, before = (live.closed_lanes(files) for files in maps)
    messages = [
        {
            "graph": name,
            "message": {
                "fleet_name": fleet,
                "open_lanes": sorted(set(before.get(name, ())) - set(lanes)),
                "close_lanes": lanes,
            },
        }
        for name, lanes in sorted(now.items())
    ]
    return json_response({"requests": messages})


@router.get(
    "/vda5050",
    responses=problem_responses(ZoneSetsOut, 404, 409, 422),
    summary="Get closures for VDA 5050 fleet managers",
)
def vda5050_zones(
    env: EnvironmentPath,
    services: ServicesDep,
    _: Viewer,
    version: Ref = None,
    map_id: Annotated[
        str | None,
        Query(
            alias="mapId",
            min_length=1,
            max_length=256,
            description="Id of the map in the fleet manager. Default: the environment's name.",
        ),
    ] = None,
) -> Response:
    """Return zone sets of VDA 5050 3.0, one per level, with a `BLOCKED` zone for each closed area.

    `closedEdges` has the ids of closed edges, for the fleet manager's own routing. The id of a set changes with its
    content.
    """
    shown = _as_json(services, env, version)
    closures = shown.closures or Closures()
    return json_response(
        {
            "zoneSets": live.zone_sets(shown, closures, map_id or env),
            "closedEdges": [{"edgeId": c.edge, "until": c.expires} for c in closures.items if c.edge is not None],
        }
    )


def _as_json(services: Services, env: str, ref: str | None) -> Version:
    """Load the version that planners run, with the closures in force. Raises NotFound."""
    refs: list[str | int] = ["production", "latest"] if ref is None else [int(ref) if ref.isdigit() else ref]
    for name in refs[:-1]:
        try:
            return services.store.channels.target(env, name, "mark")[0]
        except NotFound:
            continue
    return services.store.channels.target(env, refs[-1], "mark")[0]


async def _files_with_marks(
    services: Services, env: str, ref: str | None, name: str, request: Request, principal: Principal
) -> list[dict[str, bytes]] | JobStarted:
    """Load the files of a map twice, with marks: for the closures in force, and for those that ended."""
    shown = await run_in_threadpool(_as_json, services, env, ref)
    ended = [o for o in await run_in_threadpool(services.store.overlays.all, env) if o.state == "ended"]
    out = []
    for closures in (shown.closures, Closures(tuple(o.closure for o in ended), "mark")):
        plan = partial(services.maps.recipe, live.with_closures(shown, closures), name)
        outcome = await services.jobs.convert(plan, principal, request_address(request))
        if isinstance(outcome, JobStarted):
            return outcome
        out.append(await run_in_threadpool(_files, outcome[1]))
    return out


def _files(cached_map: CachedMap) -> dict[str, bytes]:
    return {file.name: file.read() for file in cached_map.files}
