"""Impact of a change: what it blocks, turns and cuts off, and which robots it touches."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated, Any, Literal

from fastapi import Query
from pydantic import BaseModel, ConfigDict, Field
from starlette.responses import Response

from app import fleet
from app.api.checks import run_review
from app.api.http.auth import Viewer
from app.api.http.dependencies import Services, ServicesDep
from app.api.http.parameters import parse_version_ref
from app.api.http.responses import api_router, json_response
from app.api.http.schemas import VERSION_OR_PENDING, EnvironmentPath, problem_responses
from app.api.robots import PoseOut, place_as_json
from app.review.touched import RobotImpact
from app.review.worker import MAX_LISTED, compare_versions
from app.store.fleet_values import Robot
from app.store.values import Version

DEFAULT_CHANNEL = "production"


class BlockedOut(BaseModel):
    """Edge that was open and is blocked now. `grid` and `zone` are null if it is marked as blocked itself."""

    id: str
    level: str
    where: list[float] | None = Field(
        description="The first blocked point [x, y], metres of the local frame; null if it cannot be converted to them."
    )
    grid: str | None = Field(description="Grid or keepout mask with the cells.")
    zone: str | None = Field(description="Keepout zone.")


class ImpactEdgesOut(BaseModel):
    """Edges that robots can no longer use as before."""

    deleted: list[str]
    blocked: list[BlockedOut]
    turned: list[str] = Field(
        description="Edges with another direction or other ends, and those that became or were one-way."
    )


class MovedOut(BaseModel):
    """Node at another position."""

    id: str
    level: str
    distance: float = Field(description="Metres from its former position.")


class ImpactNodesOut(BaseModel):
    """Nodes that are deleted or at another position."""

    deleted: list[str]
    moved: list[MovedOut]


class LostDockOut(BaseModel):
    """Dock, charger, parking or pick-up place that is gone or cut off."""

    id: str
    name: str
    level: str
    why: str


class CutOffOut(BaseModel):
    """Part of the network that robots could reach and leave, and no longer can."""

    nodes: int = Field(description="Number of nodes.")
    sample: list[str] = Field(description="Ids of at most 20 of them.")
    level: str
    where: list[float] | None = Field(
        description="Position [x, y] of its first node, metres of the local frame; null if it cannot be converted."
    )
    why: Literal["cannot be reached", "cannot be left", "has no connection"]


class RobotImpactOut(BaseModel):
    """Whether the change touches a robot, by the last place that it reported.

    `unknown`: it has reported no place, or none in this network.
    """

    robot: str
    state: Literal["touched", "clear", "unknown"]
    why: list[str] = Field(description="Reasons, at most 10; empty if it is clear.")
    channel: str
    online: bool
    node: str | None
    pose: PoseOut | None
    edges: list[str] = Field(description="Edges of its route that are deleted, blocked or turned.")
    time: datetime | None = Field(description="When its place was received; null if it never reported one.")


class ImpactOut(BaseModel):
    """What a change means for the environment's robots."""

    model_config = ConfigDict(populate_by_name=True)

    from_: int | str = Field(alias="from")
    to: int | str
    edges: ImpactEdgesOut
    nodes: ImpactNodesOut
    docks: list[LostDockOut]
    parts: list[CutOffOut]
    robots: list[RobotImpactOut] = Field(description="All robots of the environment, of every channel.")
    truncated: bool = Field(description=f"A list of edges, nodes, docks or parts has more than {MAX_LISTED} items.")


router = api_router("versions", "/environments/{env}")


@router.get("/impact", responses=problem_responses(ImpactOut, 404, 503), summary="Get the impact of a change")
def get_impact(
    env: EnvironmentPath,
    services: ServicesDep,
    _: Viewer,
    from_: Annotated[
        str | None,
        Query(
            alias="from",
            pattern=VERSION_OR_PENDING,
            description="What robots drive on now: number, channel, or `latest`. Default: `production` if it has a "
            "version, else `latest`.",
        ),
    ] = None,
    to: Annotated[
        str, Query(pattern=VERSION_OR_PENDING, description="What they would drive on: number, channel, or `latest`.")
    ] = "latest",
) -> Response:
    """Return what robots lose if `to` replaces `from`, on all levels.

    An edge is blocked if it crosses cells that became occupied, or a keepout zone or mask that is new; also if it was
    moved into one. A part is cut off if it was connected both ways to the largest part of its network, in which robots
    can go from each node to each other, and no longer is. Closures in force do not count.

    A robot is touched if its node or an item of its route is deleted, blocked, turned, cut off or moved by 0.5 m, or if
    its pose is in newly occupied cells or a new keepout, or within 0.5 m of something deleted or blocked.
    """
    old = resolve_version(services, env, from_ or _default_from(services, env))
    new = resolve_version(services, env, to)
    robots = services.store.robots.all(env)
    result = run_review(services, compare_versions, old, new, [robot.place for robot in robots])
    now = datetime.now(UTC)
    listed = [_robot(robot, impact, now) for robot, impact in zip(robots, result.robots, strict=True)]
    return json_response({"from": old.ref, "to": new.ref, **result.members, "robots": listed})


def resolve_version(services: Services, env: str, ref: str) -> Version:
    """Return the version that a reference names: a number, a channel, or ``latest``. Raises NotFound."""
    return services.store.versions.get(env, parse_version_ref(ref))


def _default_from(services: Services, env: str) -> str:
    moved = any(c.name == DEFAULT_CHANNEL and c.version is not None for c in services.store.channels.all(env))
    return DEFAULT_CHANNEL if moved else "latest"


def _robot(robot: Robot, impact: RobotImpact, now: datetime) -> dict[str, Any]:
    place = place_as_json(robot) or {"node": None, "pose": None, "time": None}
    return {
        "robot": robot.robot,
        "state": impact.state,
        "why": list(impact.why),
        "channel": robot.report.channel,
        "online": fleet.is_online(robot, now),
        "node": place["node"],
        "pose": place["pose"],
        "edges": list(impact.edges),
        "time": place["time"],
    }
