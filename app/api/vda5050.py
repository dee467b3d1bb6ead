"""VDA 5050: instant actions for a version, and a vehicle's state as a robot status."""

from __future__ import annotations

import dataclasses
import secrets
from datetime import datetime
from typing import Annotated, Any

from fastapi import Body, Query, Request
from pydantic import BaseModel, ConfigDict, Field
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from app import formats
from app.api.http.auth import Principal, RobotRole, Viewer
from app.api.http.conversions import JobStarted, job_started_response
from app.api.http.dependencies import Services, ServicesDep
from app.api.http.parameters import parse_version_ref
from app.api.http.responses import api_router, json_response
from app.api.http.schemas import CHANNEL, NAME, EnvironmentPath, VersionPath, problem_responses
from app.api.links import LinkedFile, link_to
from app.api.robots import RobotOut, RobotPath, require_report_permission, store_report
from app.errors import CannotConvert, Invalid, NotFound, Problem
from app.event_types import RobotPlace, RobotState
from app.fleet import vda5050
from app.store.fleet_values import Channel, RobotReport
from app.store.values import Version


class FloorActionsOut(BaseModel):
    """Instant actions of VDA 5050 for one level of a version."""

    model_config = ConfigDict(populate_by_name=True)

    map_id: str = Field(alias="mapId")
    map_version: str = Field(alias="mapVersion")
    level: str | None = Field(description="Level, or null if none was requested.")
    size: int = Field(description="Size of the linked file in bytes.")
    expires: datetime | None = Field(description="Expiry of the link, or null if the link needs a token.")
    download_map: dict[str, Any] = Field(alias="downloadMap")
    enable_map: dict[str, Any] = Field(alias="enableMap")
    delete_map: dict[str, Any] = Field(alias="deleteMap")


class MissingLevelOut(BaseModel):
    """Level without such a map, and the reason."""

    level: str
    detail: str


class ActionsOut(FloorActionsOut):
    """Instant actions of VDA 5050 for one version: those of its first level, and in `maps` of each level."""

    environment: str
    version: int
    root: str
    maps: list[FloorActionsOut]
    missing: list[MissingLevelOut] = Field(description="Levels without such a map, with `level=*`.")


class StateOut(BaseModel):
    """Result of processing a vehicle's state."""

    robots: list[RobotOut]
    ignored: list[dict[str, str]]


MapIdQuery = Annotated[
    str | None,
    Query(
        alias="mapId", min_length=1, max_length=256, description="Id of the map in the fleet manager. Default: `env`."
    ),
]
FormatQuery = Annotated[
    str,
    Query(
        max_length=64,
        description="Format that the vehicles read: any except `lif`, which is for fleet managers.",
        examples=["geojson"],
    ),
]
LevelQuery = Annotated[
    str | None,
    Query(
        min_length=1,
        max_length=256,
        description="Name of a level, or `*` for one map of each level that has one. Default: the default level. Only "
        "for formats with a parameter `level`.",
    ),
]
SignedQuery = Annotated[
    bool, Query(description="Create links that need no token until they expire. `false`: links that need one.")
]
SecondsQuery = Annotated[
    int | None,
    Query(ge=1, description="Lifetime of the links in seconds. Default and maximum: `FLEETMAP_LINK_SECONDS`."),
]

router = api_router("vda5050")

STATE: dict[str, Any] = {
    "timestamp": "2026-05-01T14:03:07Z",
    "serialNumber": "mower-3",
    "maps": [{"mapId": "orchard", "mapVersion": "1", "mapStatus": "ENABLED", "mapDescriptor": None}],
}


@router.get(
    "/environments/{env}/versions/{v}/vda5050/actions",
    responses={
        **problem_responses(ActionsOut, 404, 409),
        202: {"description": "The conversion takes long: follow the job at `Location`, then repeat the request."},
    },
    summary="Get VDA 5050 instant actions for a version",
    openapi_extra={"x-free-query": True},
)
async def get_actions(
    env: EnvironmentPath,
    v: VersionPath,
    request: Request,
    services: ServicesDep,
    principal: Viewer,
    map_id: MapIdQuery = None,
    format: FormatQuery = "occupancy_grid",
    level: LevelQuery = None,
    signed: SignedQuery = True,
    seconds: SecondsQuery = None,
) -> Response:
    """Return the actions `downloadMap`, `enableMap` and `deleteMap`, which the fleet manager sends as
    `instantActions`.

    `downloadMap` has the link to one file (a zip of several) and its SHA-256. Further query parameters are those of
    the map.

    VDA 5050 has one `mapId` per level: `mapId` itself for the default level, `<mapId>/<level>` for another one.
    `maps` has the actions of each requested level; the members beside it are those of the first. `mapVersion` is the
    number of the version. The link contains it too, so the bytes never change. Each response has new action ids.
    """
    reserved_names = {"mapId", "format", "level", "signed", "seconds"}
    values = {name: text for name, text in request.query_params.multi_items() if name not in reserved_names}
    version = await run_in_threadpool(services.store.versions.get_committed, env, parse_version_ref(v))
    _check_format(format, by_level=level is not None)
    services.links.check_life(seconds)
    maps: list[dict[str, Any]] = []
    missing: list[dict[str, str]] = []
    site = map_id or env
    for name in _levels(version, level):
        options = values if level is None else {**values, "level": name}
        try:
            outcome = await link_to(
                services, request, principal, version, format, None, options, seconds, signed=signed
            )
        except (NotFound, CannotConvert) as error:
            if level != "*":
                raise
            missing.append({"level": name, "detail": error.detail})
            continue
        if isinstance(outcome, JobStarted):
            return job_started_response(outcome.job)
        floor = map_id if map_id is not None and level != "*" else vda5050.level_map_id(site, _other(version, name))
        maps.append(_actions(version, floor, name if level is not None else None, outcome))
    if not maps:
        raise CannotConvert(
            "this map is not available on any level: " + "; ".join(f"{m['level']}: {m['detail']}" for m in missing[:20])
        )
    body = {"environment": env, "version": version.number, "root": version.root, **maps[0], "maps": maps}
    return json_response(body | {"missing": missing}, headers={"cache-control": "no-store"})


def _check_format(name: str, *, by_level: bool) -> None:
    """Raise Invalid for a format that vehicles cannot read, or that has no parameter ``level`` if one is requested."""
    if name == "lif":
        raise Invalid(
            "lif is a layout for fleet managers, not for vehicles: request occupancy_grid, nav2_route or "
            "another format that the vehicles read, and download lif from .../maps/lif for the fleet manager",
            [Problem("not for vehicles", where="format")],
        )
    fmt = formats.get_format(name)
    if fmt.write is None:
        raise Invalid(
            f"{name} cannot be written: see GET /api/v1/formats for formats with write",
            [Problem("read-only format", where="format")],
        )
    if by_level and not _has_level(fmt):
        others = ", ".join(f.name for f in formats.all_formats().values() if f.write is not None and _has_level(f))
        raise Invalid(
            f"a map in {name} contains all levels: omit level, or use one of {others}",
            [Problem("the format has no levels", where="level")],
        )


def _has_level(fmt: formats.Format) -> bool:
    return any(field.name == "level" for field in dataclasses.fields(fmt.write_options))


def _levels(version: Version, level: str | None) -> list[str]:
    """List the requested levels, the default one first. Raises NotFound if the version lacks the level."""
    default = vda5050.default_level(version)
    names = [default, *(other.name for other in version.levels if other.name != default)]
    if level == "*":
        return names
    if level is not None and level not in names:
        raise NotFound(f"version {version.number} has no level {level[:80]!r}; its levels: {', '.join(names[:50])}")
    return [level or default]


def _other(version: Version, level: str) -> str | None:
    """Return the level's name, or None for the default level."""
    return None if level == vda5050.default_level(version) else level


def _actions(version: Version, map_id: str, level: str | None, link: LinkedFile) -> dict[str, Any]:
    """Build the three actions of one level."""
    unique, number = secrets.token_hex(8), version.number
    return {
        "mapId": map_id,
        "mapVersion": str(number),
        "level": level,
        "size": link.file.size,
        "expires": link.expires,
        "downloadMap": vda5050.action(
            "downloadMap", map_id, number, unique, mapDownloadLink=link.url, mapHash=link.file.sha256
        ),
        "enableMap": vda5050.action("enableMap", map_id, number, unique),
        "deleteMap": vda5050.action("deleteMap", map_id, number, unique),
    }


@router.post(
    "/robots/{robot}/vda5050/state",
    responses=problem_responses(StateOut, 400, 404, 409, 415),
    summary="Report a vehicle's VDA 5050 state",
)
def post_state(
    robot: RobotPath,
    message: Annotated[dict[str, Any], Body(openapi_examples={"state": {"value": STATE}})],
    services: ServicesDep,
    principal: RobotRole,
    environment: Annotated[
        str | None, Query(pattern=NAME, description="Environment of the maps. Default: the part of `mapId` before `/`.")
    ] = None,
    map_id: Annotated[
        str | None, Query(alias="mapId", min_length=1, max_length=256, description="Process only this map.")
    ] = None,
    channel: Annotated[
        str | None,
        Query(
            pattern=CHANNEL,
            description="Channel that the vehicle follows. Default: that of its last report, else `production` if it "
            "exists, else `latest`.",
        ),
    ] = None,
) -> Response:
    """Convert the `maps` of a vehicle's state to the robot's status.

    `mapVersion` is the number of a version. ENABLED becomes `active`; DISABLED becomes `ready` if the version is
    planned for the channel; a failed action of this server becomes `failed`. The robot's place comes from
    `agvPosition` (3.0: `mobileRobotPosition`), `lastNodeId`, `nodeStates` and `edgeStates`, the latter up to 1000 ids.
    The rest of the message is for the fleet manager.

    The levels of a site (`<mapId>/<level>`) count together: the vehicle is `ready` with a version if it has it for
    each level in the message, and `active` with the oldest version that is enabled on any level. `ignored` lists the
    unknown maps, with the reason.
    """
    require_report_permission(principal, robot)
    out: dict[str, list[dict[str, Any]]] = {"robots": [], "ignored": []}
    sites: dict[str, list[vda5050.VehicleMaps]] = {}
    for maps in vda5050.read_state(message):
        if map_id in (None, maps.map_id, vda5050.site_name(maps.map_id)):
            sites.setdefault(vda5050.site_name(maps.map_id), []).append(maps)
    if environment is not None and len(sites) > 1:
        names = ", ".join(list(sites)[:20])
        raise Invalid(f"the state has several maps: set mapId to the one of {environment}, one of {names}")
    vehicle = vda5050.read_vehicle_place(message)
    for site, floors in sites.items():
        place = None if vehicle is None or not _is_in(vehicle, site, len(sites)) else vehicle.place
        _collect_reports(services, principal, robot, floors, environment or site, channel, out, place)
    return json_response(out)


def _collect_reports(
    services: Services,
    principal: Principal,
    robot: str,
    floors: list[vda5050.VehicleMaps],
    env: str,
    channel: str | None,
    out: dict[str, list[dict[str, Any]]],
    place: RobotPlace | None,
) -> None:
    try:
        if not principal.can_access(env):
            raise NotFound("unknown environment, or not accessible with your token")
        stored_robot = next(iter(services.store.robots.all(env, robot)), None)
        channels = {c.name: c for c in services.store.channels.all(env)}
    except NotFound as error:
        out["ignored"] += [{"mapId": floor.map_id, "why": error.detail} for floor in floors]
        return
    maps = vda5050.merge_levels(floors)
    usual = stored_robot.report.channel if stored_robot else "production" if "production" in channels else "latest"
    follows = channels.get(channel or usual)
    reports = []
    for state, text, detail in _states(maps, follows):
        try:
            version = _reported_version(services, env, text)
        except NotFound as error:
            out["ignored"].append({"mapId": maps.map_id, "mapVersion": text, "why": error.detail})
            continue
        short = detail and detail[:2000]
        reports.append(RobotReport(channel or usual, version.number, version.root, state, short, place=place))
    # Report the active version only if it is new: otherwise every message would alternate between two reports.
    if (
        len(reports) > 1
        and stored_robot is not None
        and stored_robot.active_map is not None
        and stored_robot.active_map.root == reports[0].root
    ):
        reports = reports[1:]
    if not reports and place is not None and stored_robot is not None:  # no news of maps: only the place changes
        reports = [dataclasses.replace(stored_robot.report, place=place)]
    for report in reports:
        body = store_report(services, env, robot, report)
    if reports:
        out["robots"].append(body)


def _is_in(vehicle: vda5050.VehiclePlace, site: str, sites: int) -> bool:
    """Return whether a vehicle's place is in a site: that of its position, else the only one."""
    return sites == 1 if vehicle.map_id is None else vda5050.site_name(vehicle.map_id) == site


def _states(maps: vda5050.VehicleMaps, channel: Channel | None) -> list[tuple[RobotState, str, str | None]]:
    """Derive the statuses that a vehicle's maps imply: (state, version, detail), the active version first."""
    planned = None if channel is None or channel.planned is None else str(channel.planned.version)
    targets = {planned, None if channel is None or channel.version is None else str(channel.version)} - {None}
    out: list[tuple[RobotState, str, str | None]] = [("active", text, None) for text in maps.enabled]
    failed = [(text, why) for text, why in maps.failed if text in targets and text not in maps.enabled]
    loaded = [text for text in maps.disabled if text in targets]
    if failed:
        out.append(("failed", *failed[-1]))
    elif loaded:
        out.append(("ready", planned if planned in loaded else loaded[-1], None))
    elif not out and maps.disabled:
        out.append(("ready", maps.disabled[-1], None))
    return out


def _reported_version(services: Services, env: str, text: str) -> Version:
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        raise NotFound("invalid mapVersion: it must be the number of a version")
    return services.store.versions.get(env, int(text))
