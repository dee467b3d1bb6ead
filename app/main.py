"""Create the server application from store, worker pools, services and API, and configure uvicorn."""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
import sys
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Any

import uvicorn
from fastapi.exceptions import RequestValidationError
from sqlalchemy.engine import make_url
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException

from app import __version__, derive, housekeeping, logs, ogc, traces
from app import formats as every_format
from app.api import events, health, maps, page, ros2, routers
from app.api.http import openapi, problems
from app.api.http.application import FleetMapApp
from app.api.http.auth import Authenticator
from app.api.http.compression import JsonCompression
from app.api.http.connections import ConnectionLimits, Connections, fit_open_files
from app.api.http.conversions import ConversionJobs
from app.api.http.deltas import Deltas
from app.api.http.dependencies import ApiOptions, Services, Writability
from app.api.http.metrics import Metrics
from app.api.http.middleware import Guard
from app.api.http.protocol import BoundedProtocol, tls_context
from app.api.http.response_cache import ResponseCache
from app.api.http.shared_work import SharedWork
from app.api.http.signed import SignedLinks
from app.api.http.uploads import UploadSpool
from app.backends.blob_s3 import S3Files
from app.backends.blobs import BlobFiles
from app.backends.documents import FileDocument
from app.backends.lead import open_leads
from app.backends.locks import file_lock
from app.backends.notify import Listener
from app.backends.shared_queue import SharedQueue
from app.config import Settings
from app.convert.maps import Maps
from app.convert.preview import Previews
from app.convert.shared_maps import SharedMaps
from app.convert.tiles import Tiles
from app.convert.views import Views
from app.errors import Conflict, DatabaseDamaged, FleetMapError, LostBlobs, Unavailable
from app.events import bus, relay
from app.events.bus import Bus, BusOptions
from app.events.credentials import ZenohCredentials
from app.events.mqtt import MqttBroker, MqttOptions
from app.events.outgoing import OutgoingRules
from app.events.relay import Relay
from app.events.ros2 import Ros2Options, Ros2Publisher
from app.events.ros_names import parse_keys, parse_selectors
from app.events.security import RouterSecurity
from app.events.webhooks import WebhookSender
from app.fleet import ReportQueue as FleetIntake
from app.ingest import Ingest, Provider
from app.links import LinkSecrets
from app.pool import PRELOADED_MODULES, Pool
from app.sandbox import SandboxPolicy
from app.signing import Keys, MountedKeys, SharedKeys, SigningKeys
from app.store.scrub import Scrub
from app.store.store import Store
from app.watch import operation_metrics

log = logging.getLogger(__name__)

CACHE_SHARE = 0.1
"""Share of the cached maps that a scrub hashes: each process also hashes a map at its first use."""


def create_app(settings: Settings) -> FleetMapApp:
    """Create the application. Its lifespan opens the store and starts the workers, and closes both."""
    app = FleetMapApp(
        title="Fleet Map Server",
        version=__version__,
        lifespan=partial(_lifespan, settings),
        openapi_url=None,
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
    )
    app.add_exception_handler(FleetMapError, problems.handle_error)
    app.add_exception_handler(HTTPException, problems.handle_http)
    app.add_exception_handler(RequestValidationError, problems.handle_validation)
    app.add_middleware(Guard)
    app.add_middleware(JsonCompression)  # the last one is the outermost
    maps.add_routes(app)
    openapi.add_pages(app)
    for router in (*routers(), *ogc.routers(), health.root_router, page.root_router):
        app.router.routes.extend(router.routes)  # include_router() would build each route a second time, 10 ms each
    return app


@contextlib.asynccontextmanager
async def _lifespan(settings: Settings, app: FleetMapApp) -> AsyncIterator[None]:
    traces.start(os.environ, __version__)
    services = await run_in_threadpool(open_services, settings)
    app.state.services = services
    app.state.feed = events.EventFeed(services)
    services.fleet.start()
    services.leads.start()
    listener = start_listener(settings, services)
    threading.Thread(target=_prepare, args=(services,), daemon=True).start()
    starting = (start_ros2, start_relay, start_mqtt, start_webhooks)
    publishing = [thread for start in starting if (thread := start(settings, services)) is not None]
    app.response_cache = services.response_cache
    scrub = start_scrub(settings, services)
    try:
        async with housekeeping.running(services):
            yield
    finally:
        app.response_cache = None
        if scrub is not None:
            await run_in_threadpool(scrub.close)
        for one in (*publishing, *([listener] if listener else [])):
            await run_in_threadpool(one.close)
        await run_in_threadpool(close_services, services)
        await run_in_threadpool(traces.stop)


def from_environment() -> FleetMapApp:
    """Create the application with settings from the environment, for uvicorn's ``--factory``."""
    return create_app(Settings())


def server_config(settings: Settings, app: Any = "app.main:from_environment", **more: Any) -> uvicorn.Config:
    """Configure uvicorn: fast loop and parser, limited connections, no access log, no version in headers.

    Args:
        app: an application; for several workers a factory that can be pickled, or its import string.
    """
    if settings.workers > 1:
        folder = settings.data_dir / "metrics"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        os.environ["PROMETHEUS_MULTIPROC_DIR"] = str(folder.resolve())
    limits = ConnectionLimits(
        total=fit_open_files(settings.max_connections),
        per_address=settings.max_connections_per_address,
        head_seconds=settings.header_seconds,
        stall_seconds=settings.body_seconds,
        pace=settings.body_pace,
    )
    tls = None
    if settings.tls_certificate is not None and settings.tls_key is not None:
        tls = settings.tls_certificate, settings.tls_key
        tls_context(*tls)  # report unusable files at start
    options: dict[str, Any] = {
        "factory": isinstance(app, str | partial),
        "host": settings.host,
        "port": settings.port,
        "workers": settings.workers,
        "http": partial(BoundedProtocol, Connections(limits), tls),
        "loop": "uvloop" if _has_uvloop() else "auto",
        "ws": "none",
        "lifespan": "on",
        "log_config": logs.config(settings.log_level, settings.log_format),
        "access_log": False,
        "server_header": False,
        "timeout_keep_alive": 30,
        "timeout_graceful_shutdown": 20,
        # Uvicorn's default of 5 s kills workers that start slowly on a busy machine.
        "timeout_worker_healthcheck": 120,
    }
    return uvicorn.Config(app, **{**options, **more})


def _has_uvloop() -> bool:
    try:
        import uvloop  # noqa: F401
    except ImportError:
        return False
    return True


def open_store(settings: Settings, *, readonly: bool = False) -> Store:
    """Open the database and the blob store of the settings."""
    url = settings.blob_url or ""
    files: BlobFiles | None = None
    if url.startswith("s3://"):
        secret = settings.blob_secret_key.get_secret_value() if settings.blob_secret_key else None
        files = S3Files(url, settings.blob_dir, access_key=settings.blob_access_key, secret_key=secret)
    return Store(
        settings.database,
        settings.blob_dir,
        readonly=readonly,
        files=files,
        copies_bytes=settings.blob_cache_bytes,
        max_robots=settings.max_robots,
    )


def create_folders(settings: Settings) -> None:
    """Create the folders of a server. Only its user can read a new data folder; the mode of an existing one stays."""
    settings.data_dir.mkdir(mode=0o700, parents=True, exist_ok=True)
    settings.blob_dir.mkdir(parents=True, exist_ok=True)


def open_services(settings: Settings) -> Services:
    """Open the store and start the workers. Blocks. Raises Unavailable if the schema is not that of this release."""
    create_folders(settings)
    store = open_store(settings)
    pools: list[Pool] = []
    try:
        with startup_lock(settings.data_dir):
            store.initialise()
            try:
                store.check()
            except Unavailable as error:
                hint = (
                    "" if settings.database.startswith("sqlite") else " (run `fleetmap migrate` to update the schema)"
                )
                raise Unavailable(error.detail + hint) from error
            problem = store.write_problem()
            if problem is None:
                store.recover()
            else:
                log.error("%s", problem)
            if not settings.insecure_no_auth:
                _ensure_first_token(store, settings)
            intake = UploadSpool(settings.spool_dir, settings.limits, at_once=settings.max_uploads)
        # One spare worker, started on demand, so that coverage tables do not wait for conversions.
        pool, spare = pools = [_worker_pool(settings, workers) for workers in (settings.conversion_workers, 1)]
        return _services(settings, store, pool, spare, intake)
    except BaseException:
        for opened in pools:
            opened.close()
        store.close()
        raise


def _worker_pool(settings: Settings, workers: int) -> Pool:
    return Pool(
        workers,
        memory_bytes=settings.max_memory_bytes,
        seconds=settings.max_seconds,
        waiting=settings.conversion_queue,
        warm=PRELOADED_MODULES,
        allowed=sandbox_policy(settings),
        environment=_model_variables(settings),
    )


def _model_variables(settings: Settings) -> dict[str, str]:
    """Return the environment variables with the model folder for derivations in workers, which have no settings."""
    if settings.models_dir is None:
        return {}
    folder, max_bytes = str(settings.models_dir.resolve()), str(settings.models_max_bytes)
    return {"FLEETMAP_MODELS_DIR": folder, "FLEETMAP_MODELS_MAX_BYTES": max_bytes}


def sandbox_policy(settings: Settings) -> SandboxPolicy:
    """Return the sandbox policy of worker processes: access to the database only."""
    if settings.database.startswith("sqlite"):
        file = make_url(settings.database).database
        # Readers of SQLite's write-ahead log mark in its shared memory what they read. The server's connections keep
        # the file; if it is newer than a worker all the same, SQLite there uses the marks of others.
        return SandboxPolicy(overwrite=(Path(f"{Path(file).resolve()}-shm"),) if file else ())
    return SandboxPolicy(ports=(make_url(settings.database).port or 5432,))


def _services(settings: Settings, store: Store, pool: Pool, spare: Pool, intake: UploadSpool) -> Services:
    def run(function: Callable[..., Any], *args: Any, by: Pool = pool, **more: Any) -> Any:
        fetched: set[str] = set()
        while True:
            try:
                with traces.span(f"worker {function.__name__}"):
                    return by.run(function, *args, **more)
            except DatabaseDamaged as error:  # found by a worker
                store.note_damage(error)
                raise
            except LostBlobs as error:  # a worker has no network: it reads what is on this machine
                if fetched.issuperset(error.names) or not store.blobs.fetch(error.names):
                    raise
                fetched.update(error.names)

    def run_trial(function: Callable[..., Any], *args: Any) -> Any:
        return run(function, *args, by=spare if pool.is_busy else pool)

    metrics = Metrics()
    service = _maps(settings, store, run, run_trial)
    service.cache.on_damage = metrics.cache_damaged.inc
    access = _authenticator(settings, store)

    keys, secrets = signing_keys(settings, store), _link_secrets(settings, store)
    with contextlib.suppress(OSError):  # create now: later the disk may be full
        keys.public()
        secrets.newest()
    leads = open_leads(settings.direct_database, settings.data_dir)

    jobs, work = _conversion_jobs(settings, store, service, pool, metrics)
    writability = Writability(store.check_writable, intake.check)
    metrics.operation = operation_metrics(settings, store, service.cache, writability)
    tiles = Tiles(store, service.cache)
    return Services(
        options=_api_options(settings),
        store=store,
        pool=pool,
        spare=spare,
        ingest=Ingest(store, run, settings.limits, imagery_provider(settings)),
        maps=service,
        access=access,
        jobs=jobs,
        work=work,
        response_cache=ResponseCache(settings.memory_cache_bytes, access, metrics, store.generation),
        intake=intake,
        metrics=metrics,
        keys=keys,
        links=SignedLinks(secrets, access, store.environments.get, int(settings.link_seconds)),
        deltas=Deltas(service.cache),
        tiles=tiles,
        previews=Previews(store, tiles, service.cache),
        views=Views(store, tiles),
        leads=leads,
        fleet=FleetIntake(store, leads.lead(relay.NAMES["zenoh"]), bus_vouches=_bus_vouches(settings)),
        writability=writability,
    )


def _maps(settings: Settings, store: Store, run: Callable[..., Any], run_trial: Callable[..., Any]) -> Maps:
    return Maps(
        store,
        run,
        settings.cache_dir,
        settings.limits,
        cache_bytes=settings.cache_bytes,
        run_trial=run_trial,
        shared=SharedMaps(store.made_maps) if settings.shares_maps else None,
    )


def _conversion_jobs(
    settings: Settings, store: Store, service: Maps, pool: Pool, metrics: Metrics
) -> tuple[ConversionJobs, SharedWork | None]:
    """Create the jobs of this server, and its side of the queue of all servers if there is one."""

    def count(name: str, result: str) -> None:
        metrics.conversions.labels(name, result).inc()

    work = None
    if settings.shares_maps:
        queue = SharedQueue(store.transaction, waiting=settings.conversion_queue)
        work = SharedWork(store, queue, service)
    jobs = ConversionJobs(store, service, settings.job_seconds, count, work=work, is_busy=lambda: pool.is_busy)
    metrics.queue = jobs.figures
    return jobs, work


def signing_keys(settings: Settings, store: Store) -> SigningKeys:
    """Return the keys of a mounted file, of the database that servers share, or of the data folder."""
    folder = settings.data_dir / "keys"
    if settings.signing_key is not None:
        return MountedKeys(settings.signing_key)
    return SharedKeys(store.document("keys"), folder) if store.is_shared else Keys(folder)


def _link_secrets(settings: Settings, store: Store) -> LinkSecrets:
    file = FileDocument(settings.data_dir / "keys" / "links.json")
    return LinkSecrets(store.document("links"), file) if store.is_shared else LinkSecrets(file)


def _api_options(settings: Settings) -> ApiOptions:
    return ApiOptions(
        limits=settings.limits,
        spool_dir=settings.spool_dir,
        max_json_bytes=settings.max_json_bytes,
        body_seconds=settings.body_seconds,
        body_pace=settings.body_pace,
        data_dir=settings.data_dir,
        zenoh_mode=settings.zenoh_mode,
        zenoh_prefix=settings.zenoh_prefix,
        zenoh_listen=settings.zenoh_listen if settings.zenoh_mode == "router" else "",
        zenoh_advertise=settings.zenoh_advertise,
        ros2=bool(settings.ros2_environments.strip()),
        manifest_seconds=int(settings.manifest_seconds),
        delegation_seconds=int(settings.delegation_seconds),
        public_url=settings.public_url,
        basemap_url=settings.basemap_url,
        basemap_attribution=settings.basemap_attribution.strip(),
        retention=settings.retention,
        mqtt=settings.mqtt_url is not None,
        webhooks=OutgoingRules(settings.webhook_list, settings.webhook_ca),
    )


def _authenticator(settings: Settings, store: Store) -> Authenticator:
    return Authenticator(
        store.tokens.find,
        failures=settings.token_failures,
        find_session=store.sessions.find,
        anonymous=settings.anonymous_list,
        share=store.wrong_tokens.add if store.is_shared else None,
        insecure=settings.insecure_no_auth,
    )


def _bus_vouches(settings: Settings) -> bool:
    """Whether reports from Zenoh count as authenticated, because the router requires users.

    For an external router this is assumed if the server itself has to log in. With ``insecure_no_auth`` all count.
    """
    return settings.insecure_no_auth or settings.zenoh_users is not None or settings.zenoh_user is not None


def imagery_provider(settings: Settings) -> Provider | None:
    """Return the imagery provider; None if none is configured."""
    if settings.imagery_url is None:
        return None
    return Provider(
        url=settings.imagery_url,
        kind=settings.imagery_kind,
        token=settings.imagery_token.get_secret_value() if settings.imagery_token else "",
        attribution=tuple(text.strip() for text in settings.imagery_attribution.split(";") if text.strip()),
        max_bytes=settings.imagery_max_bytes,
        seconds=settings.imagery_seconds,
        tries=settings.imagery_tries,
        max_zoom=settings.imagery_max_zoom,
        tile=settings.imagery_tile_size,
        cache_dir=settings.data_dir / "imagery" if settings.imagery_cache_bytes else None,
        cache_bytes=settings.imagery_cache_bytes,
    )


def start_scrub(settings: Settings, services: Services) -> Scrub | None:
    """Start the background check of stored data; None if it is off."""
    if not settings.scrub_hours:
        return None
    sample = partial(services.maps.cache.sample, CACHE_SHARE)
    rate = settings.scrub_bytes_per_second
    lead = services.leads.lead("scrub")
    scrub = Scrub(services.store, sample, lead, every=settings.scrub_hours * 3600, rate=rate)
    scrub.start()
    return scrub


def start_listener(settings: Settings, services: Services) -> Listener | None:
    """Start to listen for commits of other servers; None if there are none."""
    if not services.store.is_shared:
        return None
    listener = Listener(settings.direct_database, services.store.generation, services.leads.host_lead("notify"))
    listener.start()
    return listener


def start_relay(settings: Settings, services: Services) -> Relay | None:
    """Start the event relay; None if Zenoh is off."""
    if settings.zenoh_mode == "off":
        return None
    if settings.zenoh_users is not None and "tcp/" in settings.zenoh_listen:
        log.warning(
            "Zenoh router: FLEETMAP_ZENOH_USERS is set but the router listens without TLS; passwords and messages are "
            "sent in clear text"
        )
    options = bus_options(settings)
    zenoh_bus = Bus(
        options,
        query_handler=partial(events.answer_zenoh_query, services, options.max_reply_bytes),
        explain=problems.problem_body,
        on_status=services.fleet.enqueue_status,
        on_alive=services.fleet.set_presence,
    )
    thread = Relay(services.store, zenoh_bus, settings.data_dir, services.leads)
    thread.start()
    return thread


def start_ros2(settings: Settings, services: Services) -> Ros2Publisher | None:
    """Start the ROS 2 publisher; None if no environment is selected or Zenoh is off."""
    chosen = parse_selectors(settings.ros2_environments)
    if not chosen or settings.zenoh_mode == "off":
        return None
    publishing = Ros2Publisher(
        Ros2Options(chosen, parse_keys(settings.ros2_keys), settings.ros2_domain_id),
        bus_options(settings),
        settings.data_dir,
        services.leads,
        generation=services.store.generation,
        look=partial(ros2.channel_versions, services, chosen, settings.ros2_channel),
        fetch=partial(ros2.topic_content, services, settings.ros2_derive),
    )
    publishing.start()
    return publishing


def mqtt_broker(settings: Settings) -> MqttBroker | None:
    """Return the connection to the MQTT broker of the settings, not connected yet; None if there is none."""
    if settings.mqtt_url is None:
        return None
    url, password_file = settings.mqtt_url.get_secret_value(), settings.mqtt_password_file
    return MqttBroker(MqttOptions.from_url(url, settings.zenoh_prefix, password_file, settings.mqtt_ca))


def start_mqtt(settings: Settings, services: Services) -> Relay | None:
    """Start the relay of events to an MQTT broker; None if there is none."""
    broker = mqtt_broker(settings)
    if broker is None:
        return None
    thread = Relay(services.store, broker, settings.data_dir, services.leads)
    thread.start()
    return thread


def start_webhooks(_: Settings, services: Services) -> WebhookSender:
    """Start the thread that sends events to webhooks."""
    thread = WebhookSender(services.store, services.options.data_dir, services.leads, services.options.webhooks)
    thread.start()
    return thread


def check_bus(settings: Settings) -> None:
    """Check the Zenoh settings, including their files and users. Raises FleetMapError."""
    if settings.zenoh_mode != "off":
        bus.check(bus_options(settings))


def bus_options(settings: Settings) -> BusOptions:
    """Return the options of the Zenoh session and router."""
    return BusOptions(
        mode=settings.zenoh_mode,
        listen=settings.zenoh_listen,
        connect=settings.zenoh_connect,
        prefix=settings.zenoh_prefix,
        config=settings.zenoh_config,
        max_reply_bytes=settings.zenoh_max_reply_bytes,
        security=RouterSecurity(
            ZenohCredentials(
                settings.zenoh_ca,
                settings.zenoh_certificate,
                settings.zenoh_key,
                settings.zenoh_user,
                settings.zenoh_password.get_secret_value() if settings.zenoh_password else None,
            ),
            settings.zenoh_mtls,
            settings.zenoh_users,
            settings.data_dir,
        ),
    )


def close_services(services: Services) -> None:
    """Stop the workers, remove the spool and close the store. Blocks."""
    services.fleet.close()
    services.leads.close()
    services.pool.close()
    services.spare.close()
    services.jobs.close()
    services.intake.close()
    services.store.close()


def _prepare(services: Services) -> None:
    """Import formats and derivations and start the workers in the background, so that no request waits for that."""
    try:
        every_format.all_formats()
        derive.all_derivations()
        services.pool.start()
    finally:
        services.prepared.set()


def startup_lock(data_dir: Path) -> AbstractContextManager[None]:
    """Lock a data folder for the start of one process at a time, so that migration and recovery run once."""
    return file_lock(data_dir / "start.lock")


def _ensure_first_token(store: Store, settings: Settings) -> None:
    """Create an administrator's token if there is none."""
    if settings.admin_token is not None:
        text = settings.admin_token.get_secret_value()
        if len(text) < 22:
            log.warning("tokens: FLEETMAP_ADMIN_TOKEN is short and can be guessed; use 32 random characters")
        if store.tokens.find(text) is None:
            with contextlib.suppress(Conflict):  # another server has created it at the same time
                store.tokens.create("administrator", "admin", token=text)
    elif (token := store.tokens.create_administrator()) is not None:
        print(f"administrator's token, shown only once: {token}", file=sys.stdout, flush=True)
