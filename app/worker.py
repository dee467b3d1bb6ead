"""Worker of several servers: takes conversions, derivations and generations from their queue (``fleetmap worker``)."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
from collections.abc import AsyncIterator
from functools import partial

from prometheus_client import CollectorRegistry, generate_latest
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from app import __version__, main, traces
from app.api.http import problems
from app.api.http.metrics import CONTENT_TYPE, QueueCollector
from app.api.http.responses import json_response
from app.api.http.task_performer import TaskPerformer
from app.backends.shared_queue import QueueWorker, SharedQueue
from app.config import Settings
from app.errors import FleetMapError, Invalid, Unavailable
from app.watch import disk_metrics

log = logging.getLogger(__name__)

PROGRESS_SECONDS = 1.0
"""Interval at which the progress of tasks is stored, if it has changed."""


def check(settings: Settings) -> None:
    """Raise Invalid unless the settings are those of several servers."""
    if not settings.shares_maps:
        raise Invalid(
            "a worker needs the database and the files of its servers: set FLEETMAP_DATABASE_URL to their PostgreSQL "
            "database and FLEETMAP_BLOB_URL to their folder or bucket"
        )


def create_worker(settings: Settings) -> Starlette:
    """Create the application of a worker: it works during its lifespan, and answers about its health."""
    check(settings)
    routes = [Route("/healthz", _healthz), Route("/readyz", _readyz), Route("/metrics", _metrics)]
    return Starlette(routes=routes, lifespan=partial(_lifespan, settings))


@contextlib.asynccontextmanager
async def _lifespan(settings: Settings, app: Starlette) -> AsyncIterator[None]:
    traces.start(os.environ, __version__)
    services = await run_in_threadpool(main.open_services, settings)
    queue = SharedQueue(services.store.transaction, waiting=settings.conversion_queue)

    def count(name: str, result: str) -> None:
        services.metrics.conversions.labels(name, result).inc()

    performer = TaskPerformer(services.store, services.maps, services.ingest, count)
    worker = QueueWorker(
        settings.direct_database, queue, performer, performer.give_up, slots=settings.conversion_workers
    )
    await run_in_threadpool(services.pool.start)
    app.state.services, app.state.worker, app.state.queue = services, worker, queue
    app.state.disks = disk_metrics(settings)
    running = asyncio.create_task(worker.run())
    reporting = asyncio.create_task(_report_progress(performer))
    try:
        yield
    finally:
        reporting.cancel()
        worker.stop()
        await running
        await run_in_threadpool(main.close_services, services)
        await run_in_threadpool(traces.stop)


async def _report_progress(performer: TaskPerformer) -> None:
    """Store the progress of tasks every second."""
    while True:
        await asyncio.sleep(PROGRESS_SECONDS)
        try:
            await run_in_threadpool(performer.store_progress)
        except FleetMapError as error:
            log.warning("worker: storing the progress of tasks failed, will retry: %s", error.detail)
        except Exception as error:  # noqa: BLE001  must survive a temporary loss of the database
            log.warning("worker: storing the progress of tasks failed, will retry: %s", problems.describe(error))


async def _healthz(request: Request) -> Response:
    """Return 200 while the process runs."""
    del request
    return json_response({"status": "ok"})


async def _readyz(request: Request) -> Response:
    """Return 200 while the worker takes tasks and its database responds."""
    try:
        await run_in_threadpool(request.app.state.services.store.check)
        if not request.app.state.worker.is_connected:
            raise Unavailable("the worker has no connection to the queue: it will retry")
    except FleetMapError as error:
        return problems.error_response(error)
    return json_response({"status": "ready"})


async def _metrics(request: Request) -> Response:
    """Return the conversions of this worker, its disks and the state of the queue."""
    registry = CollectorRegistry()
    registry.register(QueueCollector(request.app.state.queue.figures))
    registry.register(request.app.state.disks)
    conversions = generate_latest(request.app.state.services.metrics.registry)
    return Response(conversions + await run_in_threadpool(generate_latest, registry), media_type=CONTENT_TYPE)
