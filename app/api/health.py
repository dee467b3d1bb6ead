"""Liveness, readiness and metrics."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Mapping
from typing import Any, Literal

from fastapi import APIRouter, Query, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from app.api.http.auth import ServerViewer
from app.api.http.dependencies import Services, ServicesDep
from app.api.http.metrics import CONTENT_TYPE
from app.api.http.responses import StrictRoute, json_response
from app.api.http.schemas import problem_responses
from app.errors import Unavailable
from app.events import ros2
from app.events.relay import relay_state

READY_SECONDS = 5.0

root_router = APIRouter(tags=["health"], route_class=StrictRoute)


_ENDPOINT = re.compile(r"([a-z]+)/(.+):(\d+)(.*)")
_HOST = re.compile(r"[A-Za-z0-9._-]+|[0-9A-Fa-f:.]+")
_ANY = ("0.0.0.0", "[::]", "*")  # noqa: S104  nothing is bound here
_LOOPBACK = ("127.0.0.1", "[::1]", "localhost")


def advertised_router(advertised: str, listen: str, host: str) -> str:
    """Return the router's endpoints, comma-separated, as reachable by a client of ``host``; may be empty.

    host: host name with which the client reached this server. A router on a loopback address is announced only to
    clients on loopback, unless the operator advertises it.
    """
    host = host if _HOST.fullmatch(host) else ""
    host = f"[{host}]" if ":" in host else host
    out = []
    for part in (advertised or listen).split(","):
        match = _ENDPOINT.fullmatch(part.strip())
        if match is None:
            continue
        address = match[2]
        if address in _ANY:
            if not host:
                continue
            address = host
        elif address in _LOOPBACK and not advertised and host not in _LOOPBACK:
            continue
        out.append(f"{match[1]}/{address}:{match[3]}{match[4]}")
    return ",".join(out)


@root_router.get("/healthz", summary="Check liveness")
async def healthz() -> Response:
    """Return 200 while the process runs, whatever the state of the database and of conversions."""
    return json_response({"status": "ok"})


@root_router.get("/readyz", responses=problem_responses(None, 422, 503), summary="Check readiness")
async def readyz(
    request: Request,
    for_: Literal["reads", "writes"] = Query(
        "reads", alias="for", description="What to check: `writes` also requires free disk space."
    ),
) -> Response:
    """Check that the database responds, is not known to be damaged, and has a schema that this release can use.

    - `status`: `ready`, or `read-only` if maps are served but nothing can be stored. `writes` then gives the reason,
      and `?for=writes` returns 503.
    - `cache`: why maps are currently not cached on disk, or `ok`.
    - `events`: whether this server is connected to Zenoh, whether it is the one that publishes events (`leader`), and
      where robots find the router (`connect`, `prefix`). Maps are served even if events are not published.
    - `mqtt`: the same for the MQTT broker, if there is one.
    - `mirror`: on a server that mirrors another one: `connected`, `starting` or `cut off`, the time of the last
      contact, how many changes wait for the centre, until when robots accept its manifests without contact, and how
      many statuses of robots the centre refused (`skipped`), if it did.
    - `ros2`: number of published topics, if the ROS 2 publisher is enabled; `standby`: another server publishes them.
    """
    services: Services = request.app.state.services
    try:
        async with asyncio.timeout(READY_SECONDS):
            await run_in_threadpool(services.store.check)
            refusal = await run_in_threadpool(services.writability.refusal)
    except TimeoutError:
        raise Unavailable(f"database or file store did not respond within {READY_SECONDS:g} seconds") from None
    if refusal is not None and for_ == "writes":
        raise Unavailable(f"nothing can be stored: {refusal}")
    if not services.prepared.is_set():
        raise Unavailable("the server is starting: ready in a few seconds")
    events = relay_state(services.options.data_dir, services.options.zenoh_mode)
    if services.options.zenoh_mode != "off":
        options = services.options
        endpoint = advertised_router(options.zenoh_advertise, options.zenoh_listen, request.url.hostname or "")
        events = {**events, "prefix": options.zenoh_prefix, **({"connect": endpoint} if endpoint else {})}
    topics = {"ros2": ros2.ros2_state(services.options.data_dir)} if services.options.ros2 else {}
    broker = {"mqtt": relay_state(services.options.data_dir, "on", "mqtt")} if services.options.mqtt else {}
    state = {
        "status": "ready" if refusal is None else "read-only",
        "database": "ok",
        "blobs": "ok" if refusal is None else "read-only",
        "reads": "ok",
        "writes": refusal or "ok",
        "cache": services.maps.cache.problem or "ok",
    }
    mirror = await run_in_threadpool(services.store.mirrors.describe)
    mirrored = {} if mirror is None else {"mirror": _mirror_state(mirror)}
    return json_response({**state, "events": events, **broker, **topics, **mirrored})


def _mirror_state(mirror: Mapping[str, Any]) -> dict[str, Any]:
    """Return what everybody may know of a mirror: no names of environments."""
    shown = {name: mirror[name] for name in ("state", "contact", "waiting", "serves_until") if name in mirror}
    return {**shown, **({"skipped": sum(mirror["skipped"].values())} if "skipped" in mirror else {})}


@root_router.get(
    "/metrics",
    summary="Get Prometheus metrics",
    response_class=Response,
    responses={200: {"description": "Prometheus text format", "content": {"text/plain": {}}}},
)
async def metrics(services: ServicesDep, _: ServerViewer) -> Response:
    """Return counters of requests, conversions and cache hits, and the head of each environment.

    Requires a token for all environments.
    """
    services.response_cache.flush_counters()
    response = Response(await run_in_threadpool(services.metrics.render, services.store, services.leads))
    response.headers["content-type"] = CONTENT_TYPE
    return response
