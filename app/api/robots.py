"""Robots: who holds what since when, who lags."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Annotated, Any

from fastapi import Header, Path, Query, Request
from pydantic import BaseModel, ConfigDict, Field
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from app import fleet
from app.api.http.auth import Editor, Principal, RobotRole, Viewer
from app.api.http.dependencies import Services, ServicesDep
from app.api.http.responses import api_router, json_response, page_response
from app.api.http.schemas import CHANNEL, NAME, ApiTime, Cursor, Limit, RequestModel, problem_responses
from app.errors import Denied, Invalid, NotFound, Problem
from app.event_types import RobotState
from app.store.audit import set_audit_target
from app.store.fleet_values import ActiveMap, Channel, ChannelMove, ReceivedReport, Robot, RobotReport
from app.store.values import rfc3339


class StatusHoldsBody(RequestModel):
    """A version that a robot has loaded."""

    version: int = Field(ge=0, lt=2**63)
    root: str = Field(pattern=r"^[0-9a-f]{64}$", description="Root hash of the version; 64 zeros: no map is loaded.")


class StatusBody(RequestModel):
    """What a robot says of itself."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {"environment": "orchard", "channel": "latest", "version": 1, "root": "0" * 64, "state": "active"}
            ]
        },
    )

    environment: str = Field(pattern=NAME)
    channel: str = Field(pattern=CHANNEL, description="The channel that it follows.")
    version: int = Field(ge=0, lt=2**63)
    root: str = Field(pattern=r"^[0-9a-f]{64}$", description="Of the version, as the manifest says it.")
    state: RobotState = Field(
        description="`ready`: it has the version and does not drive on it yet; `active`: it does."
    )
    detail: str | None = Field(None, max_length=2000)
    time: ApiTime | None = Field(None, description="RFC 3339 time with zone, by the robot's clock.")
    sequence: int | None = Field(None, ge=0, lt=2**63, description="Of the last event that it has processed.")
    overlays: str | None = Field(
        None, pattern=r"^[0-9a-f]{64}$", description="Digest of the closures in the map that it has loaded."
    )
    holds: StatusHoldsBody | None = Field(
        None, description="The loaded map, if the status is about another version. Default: the last `active` one."
    )


class LagOut(BaseModel):
    """How far a robot is behind its channel: events not acted on, whether its root differs, since when."""

    events: int
    differs: bool
    since: datetime | None


class HoldsOut(BaseModel):
    """What a robot drives on, and since when it said so (the server's clock)."""

    version: int
    root: str
    overlays: str | None = Field(None, description="Digest of the closures in it.")
    since: datetime


class RobotOut(BaseModel):
    """A robot in an environment. ``time``: by its clock, where it told one; ``received`` and ``since`` (when it first
    said the same) by the server's. ``lag`` is null where its channel stands nowhere.
    """

    robot: str
    environment: str
    channel: str
    version: int
    root: str
    state: RobotState
    detail: str | None = None
    sequence: int | None = None
    overlays: str | None = None
    time: datetime
    received: datetime
    since: datetime
    holds: HoldsOut | None
    online: bool
    vouched: bool = Field(
        description="Whether a report came with authority (by a token that may report for it, or over a router with "
        "users). Other robots do not count in roll-outs."
    )
    lag: LagOut | None


class RobotDetailOut(RobotOut):
    """A robot with its past."""

    environments: list[str]
    history: list[dict[str, Any]]


RobotPath = Annotated[
    str,
    Path(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,127}$", description="A robot's name.", examples=["mower-3"]),
]

router = api_router("robots", "/robots")

EnvironmentQuery = Annotated[
    str | None, Query(pattern=NAME, description="Only in this environment; else in all that the token reaches.")
]


@router.get("", responses=problem_responses(list[RobotOut], 404), summary="All robots")
def list_robots(
    request: Request,
    services: ServicesDep,
    principal: Viewer,
    environment: EnvironmentQuery = None,
    channel: Annotated[str | None, Query(pattern=CHANNEL, description="Only on this channel.")] = None,
    limit: Limit = 100,
    cursor: Cursor = None,
) -> Response:
    """What each says of itself, what it drives on, whether it is there, and how far it is behind its channel. By
    environment and name.
    """
    if environment is not None:
        principal.require_environment(environment)
    robots, following = services.store.robots.page(
        environment, channel=channel, limit=limit, cursor=cursor, allowed=principal.environments
    )
    return page_response(request, _robots_as_json(services, robots), following)


@router.get("/{robot}", responses=problem_responses(RobotDetailOut, 404), summary="One robot, with what it said before")
def get_robot(
    robot: RobotPath,
    services: ServicesDep,
    principal: Viewer,
    environment: EnvironmentQuery = None,
    limit: Annotated[int, Query(ge=1, le=200, description="Reports in `history`.")] = 50,
) -> Response:
    """In the environment where it reported last, unless one is named. `history`: newest first, each time that it said
    something new; `environments`: all in which it reported.
    """
    robots = [r for r in services.store.robots.all(None, robot) if principal.can_access(r.environment)]
    if environment is not None:
        principal.require_environment(environment)
    chosen = [r for r in robots if environment is None or r.environment == environment]
    if not chosen:
        scope = "" if environment is None else f" in {environment}"
        raise NotFound(f"no robot {robot[:80]!r} has reported{scope}")
    newest = max(chosen, key=lambda r: r.time)
    history = services.store.robots.history(newest.environment, robot, limit)
    body = _only_robot(services, [newest])
    body["environments"] = [r.environment for r in robots]
    body["history"] = [{**_report(report, time), "received": rfc3339(time)} for time, report in history]
    return json_response(body)


@router.put(
    "/{robot}/status",
    responses={
        **problem_responses(RobotOut, 400, 404, 409, 415, 503),
        204: {"description": "Taken (`Prefer: return=minimal`)"},
    },
    summary="A robot says what it holds",
)
async def put_status(
    robot: RobotPath,
    body: StatusBody,
    services: ServicesDep,
    principal: RobotRole,
    prefer: Annotated[str | None, Header(description="`return=minimal` (RFC 7240): 204 instead of the robot.")] = None,
) -> Response:
    """The same as over Zenoh. A robot's token may tell of the robot that it names; editors may tell of any."""
    require_report_permission(principal, robot)
    principal.require_environment(body.environment)
    if body.time is not None and body.time.tzinfo is None:
        raise Invalid("time needs a zone, like 2030-01-31T06:00:00Z", [Problem("no zone", where="body.time")])
    holds = None if body.holds is None else (body.holds.version, body.holds.root)
    more = (body.detail, body.sequence, body.time, body.overlays, holds)
    report = RobotReport(body.channel, body.version, body.root, body.state, *more)
    # No thread waits for the store: a whole fleet reports at once, and others want maps meanwhile.
    noting = services.fleet.submit_report(ReceivedReport(body.environment, robot, report, datetime.now(UTC)))
    await asyncio.wait({asyncio.wrap_future(noting)}, timeout=fleet.WARN_SECONDS)
    fleet.wait_until_stored(noting)
    if prefer is not None and prefer.strip().lower() == "return=minimal":
        return Response(status_code=204, headers={"preference-applied": "return=minimal"})
    return json_response(
        await run_in_threadpool(lambda: _only_robot(services, services.store.robots.all(body.environment, robot)))
    )


@router.delete(
    "/{robot}", status_code=204, responses=problem_responses(None, 404), summary="Forget a robot that is gone for good"
)
def forget_robot(
    robot: RobotPath,
    services: ServicesDep,
    principal: Editor,
    environment: Annotated[str, Query(pattern=NAME, description="Where it is to be forgotten.", examples=["orchard"])],
) -> Response:
    """It no longer counts among its channel's robots. It comes back with its next report."""
    principal.require_environment(environment)
    set_audit_target(environment=environment)
    services.store.robots.forget(environment, robot)
    return Response(status_code=204)


def require_report_permission(principal: Principal, robot: str) -> None:
    """Denied for a robot's token that names another robot, or none."""
    if principal.role != "robot" or principal.robot == robot:
        return
    names = "names no robot" if principal.robot is None else f"names the robot {principal.robot}"
    raise Denied(f"your token {names}: it cannot tell the status of {robot[:128]}")


def store_report(services: Services, environment: str, robot: str, report: RobotReport) -> dict[str, Any]:
    """Store a report; the robot as it is now."""
    services.fleet.store_report(ReceivedReport(environment, robot, report, datetime.now(UTC)))
    return _only_robot(services, services.store.robots.all(environment, robot))


def _only_robot(services: Services, robots: Sequence[Robot]) -> dict[str, Any]:
    """The only one of them; NotFound where it, or its environment, went meanwhile."""
    for body in _robots_as_json(services, robots):
        return body
    raise NotFound("the robot, or its environment, is no longer there")


def _robots_as_json(services: Services, robots: Sequence[Robot]) -> list[dict[str, Any]]:
    """As clients see them; without those whose environment is deleted meanwhile."""
    now = datetime.now(UTC)
    channels: dict[str, dict[str, Channel]] = {}
    moves: dict[tuple[str, str], list[ChannelMove]] = {}
    out = []
    for robot in robots:
        name = robot.report.channel
        try:
            if robot.environment not in channels:
                channels[robot.environment] = {c.name: c for c in services.store.channels.all(robot.environment)}
            channel = channels[robot.environment].get(name)
            behind = channel is not None and (
                robot.active_map is None or not robot.active_map.shows(channel.root, channel.closures.digest)
            )
            if behind and (robot.environment, name) not in moves:
                moves[robot.environment, name] = services.store.channels.moves(robot.environment, name)
        except NotFound:
            continue  # its environment went since
        lag = None
        if channel is not None and channel.root is not None:
            lag = fleet.robot_lag(robot, channel, moves.get((robot.environment, name), [])).as_dict()
        active_map = robot.active_map
        body = {"robot": robot.robot, "environment": robot.environment, **_report(robot.report, robot.time)}
        body |= {
            "received": rfc3339(robot.time),
            "since": rfc3339(robot.since),
            "holds": active_map and _active_map_as_json(active_map),
            "online": fleet.is_online(robot, now),
            "vouched": robot.vouched,
            "lag": lag,
        }
        out.append(body)
    return out


def _active_map_as_json(active_map: ActiveMap) -> dict[str, Any]:
    overlays = {} if active_map.overlays is None else {"overlays": active_map.overlays}
    return {"version": active_map.version, "root": active_map.root, **overlays, "since": rfc3339(active_map.since)}


def _report(report: RobotReport, received: datetime) -> dict[str, Any]:
    body: dict[str, Any] = {
        "channel": report.channel,
        "version": report.version,
        "root": report.root,
        "state": report.state,
    }
    if report.detail is not None:
        body["detail"] = report.detail
    if report.sequence is not None:
        body["sequence"] = report.sequence
    if report.overlays is not None:
        body["overlays"] = report.overlays
    return body | {"time": rfc3339(report.reported_at or received)}
