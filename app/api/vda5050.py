"""VDA 5050: a version as instant actions, and a vehicle's state as a robot's status."""

from __future__ import annotations

import secrets
from typing import Annotated, Any

from fastapi import APIRouter, Body, Query, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from app import formats
from app.api.access import Principal, Reporter, Viewer
from app.api.answers import Route, answer, path_of
from app.api.jobs import Started, started
from app.api.manifest import made_for
from app.api.maps import number_of
from app.api.robots import may_report, noted
from app.api.schemas import CHANNEL, NAME, ActionsOut, EnvironmentPath, RobotPath, StateOut, VersionPath, told
from app.api.services import Here, Services
from app.errors import Invalid, NotFound, Problem
from app.fleet import vda5050
from app.store.values import Channel, Report, RobotState

router = APIRouter(tags=["vda5050"], route_class=Route)

STATE: dict[str, Any] = {
    "timestamp": "2026-05-01T14:03:07Z",
    "serialNumber": "mower-3",
    "maps": [{"mapId": "farm", "mapVersion": "1", "mapStatus": "ENABLED", "mapDescriptor": None}],
}


@router.get(
    "/environments/{env}/versions/{v}/vda5050/actions",
    responses={
        **told(ActionsOut, 404, 409),
        202: {"description": "The map takes long: follow the job at `Location`, then ask again."},
    },
    summary="A version as VDA 5050 instant actions",
    openapi_extra={"x-free-query": True},
)
async def get_actions(
    env: EnvironmentPath,
    v: VersionPath,
    request: Request,
    here: Here,
    who: Viewer,
    map_id: Annotated[
        str | None,
        Query(
            alias="mapId", min_length=1, max_length=256, description="What the fleet manager calls it; default: env."
        ),
    ] = None,
    format: Annotated[
        str, Query(max_length=64, description="The format that the vehicles read.", examples=["geojson"])
    ] = "occupancy_grid",
) -> Response:
    """`downloadMap` with the link to one file (a zip where the format has several) and its SHA-256, `enableMap`,
    `deleteMap`: to be sent as `instantActions` by the fleet manager. Further query parameters are the map's.

    `mapVersion` is the version's number, and the link names it, so that its bytes stay the same whatever is promoted
    later. A vehicle needs a token to follow it. Each answer has new action ids.
    """
    values = {k: t for k, t in request.query_params.multi_items() if k not in ("mapId", "format")}
    version = await run_in_threadpool(here.store.version, env, number_of(v))
    if formats.get_format(format).write is None:
        raise Invalid(f"{format} is not served", [Problem("not served", where="format")])
    outcome = await made_for(here, version, format, values, request, who)
    if isinstance(outcome, Started):
        return started(outcome.job)
    file = outcome.whole()
    path = path_of("environments", env, "versions", version.number, "maps", format)
    link = str(request.base_url.replace(path=path).include_query_params(**values))
    name = map_id or env
    unique = secrets.token_hex(8)
    body = {
        "mapId": name,
        "mapVersion": str(version.number),
        "environment": env,
        "version": version.number,
        "root": version.root,
        "size": file.size,
        "downloadMap": vda5050.action(
            "downloadMap", name, version.number, unique, mapDownloadLink=link, mapHash=file.sha256
        ),
        "enableMap": vda5050.action("enableMap", name, version.number, unique),
        "deleteMap": vda5050.action("deleteMap", name, version.number, unique),
    }
    return answer(body, headers={"cache-control": "no-store"})


@router.post(
    "/robots/{robot}/vda5050/state", responses=told(StateOut, 400, 404, 409, 415), summary="A vehicle's VDA 5050 state"
)
def post_state(
    robot: RobotPath,
    message: Annotated[dict[str, Any], Body(openapi_examples={"state": {"value": STATE}})],
    here: Here,
    who: Reporter,
    environment: Annotated[
        str | None, Query(pattern=NAME, description="Whose versions the maps are; default: the `mapId`.")
    ] = None,
    map_id: Annotated[
        str | None, Query(alias="mapId", min_length=1, max_length=256, description="Only of this map.")
    ] = None,
    channel: Annotated[
        str | None,
        Query(
            pattern=CHANNEL, description="Default: as it said last, else `production` if there is one, else `latest`."
        ),
    ] = None,
) -> Response:
    """Its `maps` become the robot's status, `mapVersion` being a version's number: ENABLED is `active`; a version that
    is planned for its channel and DISABLED is `ready`; an action of ours that failed is `failed`. All else in the
    message is the fleet manager's. `ignored`: what is not known here, and why.
    """
    may_report(who, robot)
    out: dict[str, list[dict[str, Any]]] = {"robots": [], "ignored": []}
    found = [maps for maps in vda5050.read_state(message) if map_id in (None, maps.map_id)]
    if environment is not None and len(found) > 1:
        names = ", ".join(maps.map_id for maps in found[:20])
        raise Invalid(f"the state tells of several maps: say which is {environment}'s, mapId being one of {names}")
    for maps in found:
        _take(here, who, robot, maps, environment or maps.map_id, channel, out)
    return answer(out)


def _take(
    here: Services,
    who: Principal,
    robot: str,
    maps: vda5050.Maps,
    env: str,
    channel: str | None,
    out: dict[str, list[dict[str, Any]]],
) -> None:
    try:
        if not who.may_enter(env):
            raise NotFound("your token does not reach it, or it is none of this server's environments")
        known = next(iter(here.store.robots(env, robot)), None)
        channels = {c.name: c for c in here.store.channels(env)}
    except NotFound as error:
        out["ignored"].append({"mapId": maps.map_id, "why": error.detail})
        return
    usual = known.report.channel if known else "production" if "production" in channels else "latest"
    follows = channels.get(channel or usual)
    reports = [report for state, text, detail in _states(maps, follows) for report in _report(
        here, env, maps.map_id, channel or usual, state, text, detail, out)]  # fmt: skip
    # What it drives on is told only where it is news: else every message would be a change there and back.
    if len(reports) > 1 and known is not None and known.held is not None and known.held.root == reports[0].root:
        reports = reports[1:]
    for report in reports:
        told = noted(here, env, robot, report)
    if reports:
        out["robots"].append(told)


def _states(maps: vda5050.Maps, channel: Channel | None) -> list[tuple[RobotState, str, str | None]]:
    """What a vehicle is told to have said: (state, version, detail), what it drives on first."""
    planned = None if channel is None or channel.planned is None else str(channel.planned.version)
    wanted = {planned, None if channel is None or channel.version is None else str(channel.version)} - {None}
    out: list[tuple[RobotState, str, str | None]] = [("active", text, None) for text in maps.enabled]
    failed = [(text, why) for text, why in maps.failed if text in wanted and text not in maps.enabled]
    loaded = [text for text in maps.disabled if text in wanted]
    if failed:
        out.append(("failed", *failed[-1]))
    elif loaded:
        out.append(("ready", planned if planned in loaded else loaded[-1], None))
    elif not out and maps.disabled:
        out.append(("ready", maps.disabled[-1], None))
    return out


def _report(
    here: Services,
    env: str,
    map_id: str,
    channel: str,
    state: RobotState,
    text: str,
    detail: str | None,
    out: dict[str, list[dict[str, Any]]],
) -> list[Report]:
    try:
        if not (text.isascii() and text.isdigit() and len(text) < 10):
            raise NotFound("its mapVersion is no version's number")
        version = here.store.version(env, int(text))
    except NotFound as error:
        out["ignored"].append({"mapId": map_id, "mapVersion": text, "why": error.detail})
        return []
    return [Report(channel, version.number, version.root, state, detail and detail[:2000])]
