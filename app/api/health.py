"""Alive, ready, and what Prometheus reads."""

from __future__ import annotations

import asyncio

from fastapi import APIRouter, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from app.api.access import Viewer
from app.api.answers import Route, answer
from app.api.metrics import CONTENT_TYPE
from app.api.schemas import told
from app.api.services import Here, Services
from app.errors import Unavailable
from app.events.relay import state_of

READY_SECONDS = 5.0

router = APIRouter(tags=["health"], route_class=Route)


@router.get("/healthz", summary="Alive")
async def healthz() -> Response:
    """Answers as long as the process does, whatever the database and the conversions do."""
    return answer({"status": "ok"})


@router.get("/readyz", responses=told(None, 503), summary="Ready")
async def readyz(request: Request) -> Response:
    """Whether database and file store answer and the schema is this release's.

    It also tells whether events go out over Zenoh; where they do not, maps are served all the same.
    """
    here: Services = request.app.state.services
    try:
        async with asyncio.timeout(READY_SECONDS):
            await run_in_threadpool(here.store.check)
    except TimeoutError:
        raise Unavailable(f"database or file store did not answer within {READY_SECONDS:g} seconds") from None
    events = state_of(here.options.data_dir, here.options.zenoh_mode)
    return answer({"status": "ready", "database": "ok", "blobs": "ok", "events": events})


@router.get(
    "/metrics",
    summary="Prometheus metrics",
    response_class=Response,
    responses={200: {"description": "Prometheus text format", "content": {"text/plain": {}}}},
)
async def metrics(here: Here, who: Viewer) -> Response:
    """Requests, conversions, cache hits, heads. Takes a token for all environments."""
    who.demand_everywhere()
    here.hot.count()
    response = Response(await run_in_threadpool(here.metrics.render, here.store))
    response.headers["content-type"] = CONTENT_TYPE
    return response
