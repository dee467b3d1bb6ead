"""Channels: the version that robots run, current and planned."""

from __future__ import annotations

import hashlib
from datetime import UTC, datetime, timedelta
from typing import Annotated, Any

from fastapi import Path, Query, Request
from pydantic import BaseModel, ConfigDict, Field, field_validator
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from app import fleet
from app.api.http.auth import Editor, Viewer
from app.api.http.caching import none_match
from app.api.http.compression import UNCOMPRESSED
from app.api.http.dependencies import Services, ServicesDep
from app.api.http.responses import api_router, json_bytes, json_response
from app.api.http.schemas import CHANNEL, ApiTime, EnvironmentPath, RequestModel, problem_responses
from app.errors import Invalid, Problem
from app.store.fleet_values import Channel, FleetCounts, Rollout, RolloutState
from app.store.values import LATEST, rfc3339

MAX_CLOCK_SKEW = timedelta(seconds=60)
"""Tolerance for ``activate_at`` in the past: the client's clock may be behind. The channel then moves at once."""


class RolloutBody(RequestModel):
    """Two-stage move. Requires `ready`, `failed`, or both."""

    ready: float | None = Field(
        None,
        gt=0,
        le=1,
        description="Share of the channel's online robots that must have the version before the channel moves.",
    )
    failed: float | None = Field(
        None,
        gt=0,
        le=1,
        description="Share of the channel's robots that report `failed` at which the move is cancelled or reverted.",
    )
    deadline: ApiTime | None = Field(
        None, description="RFC 3339 time with time zone: if too few robots are ready by then, the move is cancelled."
    )
    window: float = Field(
        600.0, ge=1, le=604_800, description="Seconds after the move during which failures revert it."
    )


class ChannelBody(RequestModel):
    """Version for a channel, and when to move."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"version": 1}, {"version": 1, "rollout": {"ready": 0.9, "failed": 0.2}}]},
    )

    version: int | str = Field(description="Version: number, channel or `latest`; stored as the number.")
    activate_at: ApiTime | None = Field(
        None, description="RFC 3339 time with time zone at which the channel moves. Default: now."
    )
    rollout: RolloutBody | None = Field(
        None, description="Let robots prefetch the version before the move, and watch for failures after it."
    )

    @field_validator("version", mode="before")
    @classmethod
    def _no_truth(cls, value: Any) -> Any:
        """Reject JSON ``true``, which Python would take for 1."""
        if isinstance(value, bool):
            raise ValueError("version must be a number or a channel's name")
        return value


class ChannelRobotsOut(BaseModel):
    """Robots of a channel. `since`: time from which all of them run its root and closures, or null."""

    total: int
    online: int = Field(description="With more than 1000 robots in the environment up to 5 seconds old.")
    holding: int
    lagging: int
    failed: int
    ready: int = Field(description="Robots that have the planned version and count in its rollout (`vouched`).")
    since: datetime | None


class RolloutOut(BaseModel):
    """Last rollout of a channel. `before` is the version to which it moves back; `detail` explains the state."""

    version: int
    root: str
    started: datetime
    ready: float | None
    failed: float | None
    activate_at: datetime | None
    deadline: datetime | None
    window: float
    state: RolloutState
    before: int | None
    moved: datetime | None
    detail: str


class OverlaysOut(BaseModel):
    """Closures in force."""

    count: int
    digest: str = Field(description="Robots with equal roots and equal digests run the same map.")
    sequence: int = Field(description="Sequence of the last event that changed the closures, or 0.")


class ChannelOut(BaseModel):
    """Movable name for a version."""

    channel: str
    version: int | None
    root: str | None
    sequence: int
    overlays: OverlaysOut | None = Field(
        None, description="Closures in force, the same on all channels. Omitted with `robots=false`."
    )
    author: str
    time: datetime
    planned: dict[str, Any] | None = None
    rollout: RolloutOut | None = None
    robots: ChannelRobotsOut | None = Field(None, description="Omitted with `robots=false`.")


ChannelPath = Annotated[str, Path(pattern=CHANNEL, description="Name of the channel.", examples=["production"])]

router = api_router("channels", "/environments/{env}/channels")


def as_dict(channel: Channel, robots: FleetCounts | None) -> dict[str, Any]:
    """Convert a channel to JSON, with the status of its robots.

    robots: counts of the environment's robots; None omits their status and the closures.
    """
    planned = None
    if channel.planned is not None:
        planned = {
            "version": channel.planned.version,
            "root": channel.planned.root,
            "activate_at": rfc3339(channel.planned.activate_at) if channel.planned.activate_at else None,
            "author": channel.planned.author,
        }
    out = {
        "channel": channel.name,
        "version": channel.version,
        "root": channel.root,
        "sequence": channel.sequence,
        "author": channel.author,
        "time": rfc3339(channel.time),
        "planned": planned,
        "rollout": channel.rollout.as_dict() if channel.rollout else None,
    }
    if robots is not None:
        closures = channel.closures
        out["overlays"] = {
            "count": len(closures.items),
            "digest": closures.digest,
            "sequence": channel.closures_sequence,
        }
        root = channel.planned.root if channel.planned else None
        out["robots"] = fleet.channel_convergence(robots, channel, root).as_dict()
    return out


def _channel_as_json(services: Services, env: str, channel: Channel) -> dict[str, Any]:
    return as_dict(channel, fleet.count_robots(services.store.robot_counts, env, datetime.now(UTC)))


@router.get("", responses=problem_responses(list[ChannelOut], 404), summary="List channels")
async def list_channels(
    env: EnvironmentPath,
    request: Request,
    services: ServicesDep,
    _: Viewer,
    robots: Annotated[bool, Query(description="Include the status of robots. `false` is faster.")] = True,
) -> Response:
    """List channels, `latest` first, then by name, with planned moves and the status of their robots.

    `robots.since` is the time from which all robots of a channel run its root, or null. `holding`, `lagging`
    and `failed` add up to `total`; `ready` counts the robots that have the planned version.
    """
    if robots:  # not shared: a shared result is valid until the next commit, and robot reports are not commits
        headers, data = await run_in_threadpool(_list_response, services, env, request, robots)
    else:
        request.scope["state"][UNCOMPRESSED] = True  # as its repetition from memory
        headers, data = await services.response_cache.run_shared(
            request, _list_response, services, env, request, robots
        )
    if none_match(request.headers.get("if-none-match"), headers["etag"]):
        return Response(status_code=304, headers=headers)
    return Response(data, 200, headers, "application/json")


def _list_response(services: Services, env: str, request: Request, robots: bool) -> tuple[dict[str, str], bytes]:
    generation, now = services.response_cache.generation(), datetime.now(UTC)
    counts = fleet.count_robots(services.store.robot_counts, env, now) if robots else None
    data = json_bytes([as_dict(channel, counts) for channel in services.store.channels.all(env)])
    headers = {"etag": f'"{hashlib.sha256(data).hexdigest()[:40]}"', "cache-control": "no-cache"}
    if not robots:  # the request that all robots of a fleet send at once
        services.response_cache.store_response(request, env, headers, data, generation)
    return headers, data


@router.put(
    "/{channel}",
    responses=problem_responses(ChannelOut, 400, 404, 409, 415),
    summary="Promote, roll back, or plan a move",
)
def move_channel(
    env: EnvironmentPath, channel: ChannelPath, body: ChannelBody, services: ServicesDep, principal: Editor
) -> Response:
    """Move a channel to a newer or an older version, now or at a given time.

    `latest` cannot be moved: it follows the head.

    With `rollout`, the channel moves in two stages. Robots learn of the planned version (`channel.planned`), fetch it
    and report `ready`. The channel moves when the share `ready` of its online robots has the version, but not before
    `activate_at`. If the share `failed` reports `failed` before the move, the move is cancelled. If it does within
    `window` seconds after the move, the channel moves back, with a higher sequence and `rollback: true`. The move is
    also cancelled at `deadline`. While robots are watched after the move, no move can be planned without a rollout
    (409); a move at once and another rollout end the watch.
    """
    if channel == LATEST:
        raise Invalid(
            "latest cannot be moved, it follows the head: choose another channel",
            [Problem("cannot be moved", where="channel")],
        )
    if body.activate_at is not None:
        if body.activate_at.tzinfo is None:
            raise _invalid_body_error("activate_at needs a time zone, for example 2030-01-31T06:00:00Z")
        if body.activate_at <= datetime.now(UTC) - MAX_CLOCK_SKEW:
            raise _invalid_body_error("activate_at is in the past: omit it to move now")
    rollout = _rollout(body) if body.rollout is not None else None
    version = services.store.versions.get_committed(env, body.version).number
    moved = services.store.channels.move(
        env, channel, version, author=principal.name, activate_at=body.activate_at, rollout=rollout
    )
    return json_response(_channel_as_json(services, env, moved))


def _rollout(body: ChannelBody) -> Rollout:
    request, now = body.rollout, datetime.now(UTC)
    assert request is not None
    if request.ready is None and request.failed is None:
        raise _invalid_body_error("rollout is incomplete: give ready, failed, or both", "body.rollout")
    if request.deadline is not None:
        location = "body.rollout.deadline"
        if request.ready is None:
            raise _invalid_body_error("deadline requires ready: it limits the wait for ready robots", location)
        if request.deadline.tzinfo is None:
            raise _invalid_body_error("deadline needs a time zone, for example 2030-01-31T06:00:00Z", location)
        if request.deadline <= (body.activate_at or now):
            raise _invalid_body_error("deadline must be in the future and after activate_at", location)
    return Rollout(
        version=0,
        root="",
        started=now,
        ready=request.ready,
        failed=request.failed,
        deadline=request.deadline,
        window=request.window,
    )


def _invalid_body_error(detail: str, location: str = "body.activate_at") -> Invalid:
    return Invalid(detail, [Problem(detail, where=location)])


@router.delete(
    "/{channel}/planned", status_code=204, responses=problem_responses(None, 404), summary="Cancel a planned move"
)
def cancel_planned(env: EnvironmentPath, channel: ChannelPath, services: ServicesDep, principal: Editor) -> Response:
    """Cancel the planned move or rollout. The channel keeps its version."""
    services.store.channels.cancel_planned(env, channel, principal.name)
    return Response(status_code=204)
