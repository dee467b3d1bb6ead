"""Channels: which version robots drive on, now and from when."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from typing import Annotated, Any

from fastapi import Path, Query, Request
from pydantic import BaseModel, ConfigDict, Field, field_validator
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from app import fleet
from app.api.http.auth import Editor, Viewer
from app.api.http.caching import none_match
from app.api.http.dependencies import Services, ServicesDep
from app.api.http.responses import api_router, json_bytes, json_response
from app.api.http.schemas import CHANNEL, ApiTime, EnvironmentPath, RequestModel, problem_responses
from app.errors import Invalid, Problem
from app.store.fleet_values import Channel, Robot, Rollout, RolloutState
from app.store.values import LATEST, rfc3339

MAX_CLOCK_SKEW = timedelta(seconds=60)
"""A time that is past by less may lie ahead by the clock of whoever asks: the channel moves at once."""


class RolloutBody(RequestModel):
    """A move in two stages. At least one of ``ready`` and ``failed``."""

    ready: float | None = Field(
        None, gt=0, le=1, description="The channel moves when this share of its online robots has the version."
    )
    failed: float | None = Field(
        None, gt=0, le=1, description="It does not move, or moves back, when this share of its robots reports `failed`."
    )
    deadline: ApiTime | None = Field(None, description="RFC 3339 time with zone: without enough robots it stays then.")
    window: float = Field(600.0, ge=1, le=604_800, description="Seconds for which robots are watched after the move.")


class ChannelBody(RequestModel):
    """Where a channel is to stand, and since when."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"version": 1}, {"version": 1, "rollout": {"ready": 0.9, "failed": 0.2}}]},
    )

    version: int | str = Field(description="Number, channel or `latest`; kept as the number.")
    activate_at: ApiTime | None = Field(
        None, description="RFC 3339 time with zone at which the channel moves; left out: now."
    )
    rollout: RolloutBody | None = Field(None, description="Let robots fetch it first, and watch them afterwards.")

    @field_validator("version", mode="before")
    @classmethod
    def _no_truth(cls, value: Any) -> Any:
        """To JSON ``true`` is no number."""
        if isinstance(value, bool):
            raise ValueError("a version is a number or a channel's name")
        return value


class ChannelRobotsOut(BaseModel):
    """A channel's robots. ``since``: since when all hold its root and closures; null while any does not."""

    total: int
    online: int
    holding: int
    lagging: int
    failed: int
    ready: int = Field(description="Those that have the planned version and count in its roll-out (`vouched`).")
    since: datetime | None


class RolloutOut(BaseModel):
    """The last roll-out of a channel. ``before``: the version that it moves back to; ``detail``: why it stands so."""

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
    """The closures in force."""

    count: int
    digest: str = Field(description="Robots with equal roots and equal digests hold the same map.")
    sequence: int = Field(description="Of the last event that changed them; 0: none did.")


class ChannelOut(BaseModel):
    """A movable name for a version."""

    channel: str
    version: int | None
    root: str | None
    sequence: int
    overlays: OverlaysOut | None = Field(
        None, description="The closures in force, the same on all channels. Left out with `robots=false`."
    )
    author: str
    time: datetime
    planned: dict[str, Any] | None = None
    rollout: RolloutOut | None = None
    robots: ChannelRobotsOut | None = Field(None, description="Left out with `robots=false`.")


ChannelPath = Annotated[str, Path(pattern=CHANNEL, description="A channel's name.", examples=["production"])]

router = api_router("channels", "/environments/{env}/channels")


def as_dict(channel: Channel, robots: Sequence[Robot] | None, now: datetime) -> dict[str, Any]:
    """The channel as clients see it, with how its robots stand. robots: of the environment; None leaves that out."""
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
        out["robots"] = fleet.channel_convergence(robots, channel, now, root).as_dict()
    return out


def _channel_as_json(services: Services, env: str, channel: Channel) -> dict[str, Any]:
    return as_dict(channel, services.store.robots.all(env), datetime.now(UTC))


@router.get("", responses=problem_responses(list[ChannelOut], 404), summary="All channels")
async def list_channels(
    env: EnvironmentPath,
    request: Request,
    services: ServicesDep,
    _: Viewer,
    robots: Annotated[
        bool, Query(description="`false`: without how their robots stand, which costs a look at all.")
    ] = True,
) -> Response:
    """`latest` first, then the others by name, with what is planned for them, and how their robots stand.

    `robots.since` is told where all robots of a channel hold its root: from then on they have. `holding`, `lagging` and
    `failed` make up the `total`; `ready` have what is planned.
    """
    if robots:  # a look of one's own: what robots say is no commit that others' looks would be too old for
        headers, data = await run_in_threadpool(_list_response, services, env, request, robots)
    else:
        headers, data = await services.response_cache.run_shared(
            request, _list_response, services, env, request, robots
        )
    if none_match(request.headers.get("if-none-match"), headers["etag"]):
        return Response(status_code=304, headers=headers)
    return Response(data, 200, headers, "application/json")


def _list_response(services: Services, env: str, request: Request, robots: bool) -> tuple[dict[str, str], bytes]:
    generation, now = services.response_cache.generation(), datetime.now(UTC)
    fleet_of = services.store.robots.all(env) if robots else None
    data = json_bytes([as_dict(channel, fleet_of, now) for channel in services.store.channels.all(env)])
    headers = {"etag": f'"{hashlib.sha256(data).hexdigest()[:40]}"', "cache-control": "no-cache"}
    if not robots:  # this is what robots ask for, all of them at once
        services.response_cache.store_response(request, env, headers, data, generation)
    return headers, data


@router.put(
    "/{channel}", responses=problem_responses(ChannelOut, 400, 404, 415), summary="Promote, roll back, or plan it"
)
def move_channel(
    env: EnvironmentPath, channel: ChannelPath, body: ChannelBody, services: ServicesDep, principal: Editor
) -> Response:
    """To a newer version or back to an older one, now or at a time to come. `latest` moves by itself.

    With `rollout` in two stages: robots are told (`channel.planned`), fetch the version and report `ready`; the channel
    moves when the share `ready` of its online robots has it, and not before `activate_at`. When the share `failed`
    reports `failed` before that, it does not move; within `window` seconds after it, it moves back, with a higher
    sequence and `rollback: true`. By `deadline` the move is given up.
    """
    if channel == LATEST:
        raise Invalid("latest moves by itself: choose another channel", [Problem("not to be moved", where="channel")])
    if body.activate_at is not None:
        if body.activate_at.tzinfo is None:
            raise _invalid_body_error("activate_at needs a zone, like 2030-01-31T06:00:00Z")
        if body.activate_at <= datetime.now(UTC) - MAX_CLOCK_SKEW:
            raise _invalid_body_error("activate_at is in the past: leave it out to move now")
    rollout = _rollout(body) if body.rollout is not None else None
    version = services.store.versions.get(env, body.version).number
    moved = services.store.channels.move(
        env, channel, version, author=principal.name, activate_at=body.activate_at, rollout=rollout
    )
    return json_response(_channel_as_json(services, env, moved))


def _rollout(body: ChannelBody) -> Rollout:
    request, now = body.rollout, datetime.now(UTC)
    assert request is not None
    if request.ready is None and request.failed is None:
        raise _invalid_body_error("a rollout takes ready, failed, or both", "body.rollout")
    if request.deadline is not None:
        location = "body.rollout.deadline"
        if request.ready is None:
            raise _invalid_body_error("deadline limits the waiting for robots: it needs ready", location)
        if request.deadline.tzinfo is None:
            raise _invalid_body_error("deadline needs a zone, like 2030-01-31T06:00:00Z", location)
        if request.deadline <= (body.activate_at or now):
            raise _invalid_body_error("deadline must lie in the future, and after activate_at", location)
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
    "/{channel}/planned", status_code=204, responses=problem_responses(None, 404), summary="Cancel what is planned"
)
def cancel_planned(env: EnvironmentPath, channel: ChannelPath, services: ServicesDep, principal: Editor) -> Response:
    """The channel stays where it is."""
    services.store.channels.cancel_planned(env, channel, principal.name)
    return Response(status_code=204)
