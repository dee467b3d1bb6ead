"""Robots: status, active map and lag."""

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
from app.event_types import (
    MAX_POSE_METRES,
    MAX_ROUTE,
    MAX_ROUTE_CHARACTERS,
    MAX_YAW,
    RobotPlace,
    RobotState,
)
from app.events import messages
from app.store.audit import set_audit_target
from app.store.fleet_values import ActiveMap, Channel, ChannelMove, ReceivedReport, Robot, RobotReport
from app.store.values import rfc3339


class StatusHoldsBody(RequestModel):
    """Version that a robot has loaded."""

    version: int = Field(ge=0, lt=2**63)
    root: str = Field(pattern=r"^[0-9a-f]{64}$", description="Root hash of the version; 64 zeros: no map is loaded.")


class PoseBody(RequestModel):
    """Position of a robot in the environment's local frame."""

    x: float = Field(ge=-MAX_POSE_METRES, le=MAX_POSE_METRES, description="Metres.")
    y: float = Field(ge=-MAX_POSE_METRES, le=MAX_POSE_METRES, description="Metres.")
    yaw: float = Field(ge=-MAX_YAW, le=MAX_YAW, description="Radians, counter-clockwise from the local x axis.")
    level: str | None = Field(None, min_length=1, max_length=256, description="Level. Default: not reported.")


FeatureId = Annotated[str, Field(min_length=1, max_length=512)]


class StatusBody(RequestModel):
    """Status of a robot."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {"environment": "orchard", "channel": "latest", "version": 1, "root": "0" * 64, "state": "active"}
            ]
        },
    )

    environment: str = Field(pattern=NAME)
    channel: str = Field(pattern=CHANNEL, description="Channel that the robot follows.")
    version: int = Field(ge=0, lt=2**63)
    root: str = Field(pattern=r"^[0-9a-f]{64}$", description="Root hash of the version, from the manifest.")
    state: RobotState = Field(
        description="`ready`: the robot has the version but does not run it yet; `active`: it runs it."
    )
    detail: str | None = Field(None, max_length=2000)
    time: ApiTime | None = Field(None, description="RFC 3339 time with time zone, from the robot's clock.")
    sequence: int | None = Field(
        None, ge=0, lt=2**63, description="Sequence of the last event that the robot has processed."
    )
    overlays: str | None = Field(
        None, pattern=r"^[0-9a-f]{64}$", description="Digest of the closures in the loaded map."
    )
    holds: StatusHoldsBody | None = Field(
        None, description="The loaded map, if the status is about another version. Default: the last `active` one."
    )
    pose: PoseBody | None = Field(None, description="Where the robot is.")
    node: FeatureId | None = Field(None, description="Id of the node at which the robot is, or which it passed last.")
    route: list[FeatureId] | None = Field(
        None,
        max_length=MAX_ROUTE,
        description="Ids of the nodes and edges that the robot drives next, in order; together at most "
        f"{MAX_ROUTE_CHARACTERS} characters. `[]`: it has no route.",
    )

    def place(self) -> RobotPlace | None:
        """Return the reported place; None if there is none. Raises Invalid for a route that is too long."""
        members = {name: value for name, value in self.model_dump().items() if name in ("pose", "node", "route")}
        place, problems = messages.read_place(members)
        if problems:
            located = [Problem(p.problem, where=f"body.{p.where}") for p in problems]
            raise Invalid("; ".join(f"{p.where} {p.problem}" for p in located), located)
        return place or None


class LagOut(BaseModel):
    """Lag of a robot behind its channel: number of events not applied, whether its root differs, and since when."""

    events: int
    differs: bool
    since: datetime | None


class HoldsOut(BaseModel):
    """Active map of a robot. `since`: when it first reported it, by the server's clock."""

    version: int
    root: str
    overlays: str | None = Field(None, description="Digest of the closures in the active map.")
    since: datetime


class PoseOut(BaseModel):
    """Position of a robot in the environment's local frame, in metres and radians. `level`: null if not reported."""

    x: float
    y: float
    yaw: float
    level: str | None


class PlaceOut(BaseModel):
    """Last place that a robot reported. Members are null if that report did not have them."""

    pose: PoseOut | None
    node: str | None = Field(description="Id of the node at which the robot is, or which it passed last.")
    route: list[str] | None = Field(description="Ids of the nodes and edges that the robot drives next, in order.")
    time: datetime = Field(description="Time of receipt, by the server's clock.")


class RobotOut(BaseModel):
    """Status of a robot in an environment.

    `time` is from the robot's clock if it sent one. `received` and `since` (first report of the same status) are from
    the server's clock. `lag` is null if the channel has no version.
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
        description="Whether a report was authenticated (by a token that may report for the robot, or by a router "
        "with users). Other robots do not count in rollouts."
    )
    lag: LagOut | None
    place: PlaceOut | None = Field(description="The last place that the robot reported; null if it never did.")


class RobotDetailOut(RobotOut):
    """Status of a robot, with its history."""

    environments: list[str]
    history: list[dict[str, Any]]


RobotPath = Annotated[
    str,
    Path(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,127}$", description="Name of the robot.", examples=["mower-3"]),
]

router = api_router("robots", "/robots")

EnvironmentQuery = Annotated[
    str | None,
    Query(pattern=NAME, description="Only in this environment. Default: all environments that the token can access."),
]


@router.get("", responses=problem_responses(list[RobotOut], 404), summary="List robots")
def list_robots(
    request: Request,
    services: ServicesDep,
    principal: Viewer,
    environment: EnvironmentQuery = None,
    channel: Annotated[str | None, Query(pattern=CHANNEL, description="Only robots of this channel.")] = None,
    limit: Limit = 100,
    cursor: Cursor = None,
) -> Response:
    """List the status, active map, presence and lag of robots, by environment and name."""
    if environment is not None:
        principal.require_environment(environment)
    robots, following = services.store.robots.page(
        environment, channel=channel, limit=limit, cursor=cursor, allowed=principal.environments
    )
    return page_response(request, robots_as_json(services, robots), following)


@router.get("/{robot}", responses=problem_responses(RobotDetailOut, 404), summary="Get a robot with its history")
def get_robot(
    robot: RobotPath,
    services: ServicesDep,
    principal: Viewer,
    environment: EnvironmentQuery = None,
    limit: Annotated[int, Query(ge=1, le=200, description="Number of reports in `history`.")] = 50,
) -> Response:
    """Return a robot's status in `environment`, by default in the one of its latest report.

    `history` has the reports with a new status, newest first; `environments` lists all environments in which the
    robot reported.
    """
    robots = [r for r in services.store.robots.all(None, robot) if principal.can_access(r.environment)]
    if environment is not None:
        principal.require_environment(environment)
    chosen = [r for r in robots if environment is None or r.environment == environment]
    if not chosen:
        scope = "" if environment is None else f" in {environment}"
        raise NotFound(f"unknown robot {robot[:80]!r}: it has not reported{scope}")
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
        204: {"description": "Stored (`Prefer: return=minimal`)"},
    },
    summary="Report a robot's status",
)
async def put_status(
    robot: RobotPath,
    body: StatusBody,
    services: ServicesDep,
    principal: RobotRole,
    prefer: Annotated[str | None, Header(description="`return=minimal` (RFC 7240): return 204 without a body.")] = None,
) -> Response:
    """Store a status, as if it were published over Zenoh.

    A token with the role `robot` may report only for its robot; editors may report for any.
    """
    require_report_permission(principal, robot)
    principal.require_environment(body.environment)
    if body.time is not None and body.time.tzinfo is None:
        raise Invalid(
            "time needs a time zone, for example 2030-01-31T06:00:00Z",
            [Problem("missing time zone", where="body.time")],
        )
    holds = None if body.holds is None else (body.holds.version, body.holds.root)
    more = (body.detail, body.sequence, body.time, body.overlays, holds, body.place())
    report = RobotReport(body.channel, body.version, body.root, body.state, *more)
    # Wait without a thread: a whole fleet reports at once, and threads are needed for maps.
    noting = services.fleet.submit_report(ReceivedReport(body.environment, robot, report, datetime.now(UTC)))
    await asyncio.wait({asyncio.wrap_future(noting)}, timeout=fleet.WARN_SECONDS)
    fleet.wait_until_stored(noting)
    if prefer is not None and prefer.strip().lower() == "return=minimal":
        return Response(status_code=204, headers={"preference-applied": "return=minimal"})
    return json_response(
        await run_in_threadpool(lambda: _only_robot(services, services.store.robots.all(body.environment, robot)))
    )


@router.delete("/{robot}", status_code=204, responses=problem_responses(None, 404), summary="Delete a robot")
def forget_robot(
    robot: RobotPath,
    services: ServicesDep,
    principal: Editor,
    environment: Annotated[
        str, Query(pattern=NAME, description="Environment from which to delete the robot.", examples=["orchard"])
    ],
) -> Response:
    """Delete a robot's status, so that it no longer counts in its channel. Its next report adds it again."""
    principal.require_environment(environment)
    set_audit_target(environment=environment)
    services.store.robots.forget(environment, robot)
    return Response(status_code=204)


def require_report_permission(principal: Principal, robot: str) -> None:
    """Raise Denied for a robot's token that names another robot, or none."""
    if principal.role != "robot" or principal.robot == robot:
        return
    names = "names no robot" if principal.robot is None else f"names the robot {principal.robot}"
    raise Denied(f"your token {names}: it cannot report the status of {robot[:128]}")


def store_report(services: Services, environment: str, robot: str, report: RobotReport) -> dict[str, Any]:
    """Store a report and return the robot's status."""
    services.fleet.store_report(ReceivedReport(environment, robot, report, datetime.now(UTC)))
    return _only_robot(services, services.store.robots.all(environment, robot))


def _only_robot(services: Services, robots: Sequence[Robot]) -> dict[str, Any]:
    """Convert the only robot to JSON. Raises NotFound if the robot or its environment was deleted meanwhile."""
    for body in robots_as_json(services, robots):
        return body
    raise NotFound("the robot or its environment was deleted meanwhile")


def robots_as_json(services: Services, robots: Sequence[Robot]) -> list[dict[str, Any]]:
    """Convert robots to JSON, skipping those whose environment was deleted meanwhile."""
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
            continue  # its environment was deleted meanwhile
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
            "place": place_as_json(robot),
        }
        out.append(body)
    return out


def place_as_json(robot: Robot) -> dict[str, Any] | None:
    """Return the members of a robot's last place, with the time of its receipt."""
    if robot.place is None or robot.placed is None:
        return None
    members = {"pose": None, "node": None, "route": None, **robot.place.as_dict()}
    if members["pose"] is not None:
        members["pose"] = {"level": None, **members["pose"]}
    return {**members, "time": rfc3339(robot.placed)}


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
