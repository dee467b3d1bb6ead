"""Zenoh session of the server: event publishers, queryables for maps, subscribers for robot status and liveliness.

Zenoh calls back in its own threads; callbacks only pass queries to a small thread pool and messages to a queue. Events
use an AdvancedPublisher with cache and sporadic heartbeat over DROP: it loses nothing while a router is down for a
short time. Plain publishers would lose these events, and with BLOCK one stopped subscriber would stall all others.
"""

from __future__ import annotations

import contextlib
import json
import logging
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import zenoh
from zenoh import ext

from app.errors import Invalid, Problem, Unavailable
from app.events import messages
from app.events.credentials import describe_connection_failure, first_line
from app.events.router import Router
from app.events.security import RouterSecurity
from app.store.outbox import RelayName

log = logging.getLogger(__name__)

EVENT_CACHE_SIZE = 256
"""Number of events per environment that late joiners and reconnected robots receive."""

PUBLISHERS = 4096
"""Maximum number of environments with a publisher; the least recently used ones are closed."""

HEARTBEAT_SECONDS = 0.3
THREADS = 4
"""Number of threads for queries, and of further threads for conversions, so that queries for cached maps do not wait
for conversions.
"""

MAX_WAITING_QUERIES = 256
"""Maximum number of waiting queries; further ones get an error reply."""

MESSAGE_BYTES = 65 * 2**20
"""Minimum of the embedded router's message size limit; raised if larger replies are allowed."""

RESTART_SECONDS = 8.0
"""Maximum pause before another attempt to start the embedded router."""

CONNECT_SECONDS = 10.0

SESSION_LEASE_MILLISECONDS = 3000
"""Silence after which routers drop the server's session: late joiners wait that long for the cache of a server that has
stopped. Zenoh's default is 10 seconds.
"""

Mode = Literal["router", "client", "off"]


@dataclass(frozen=True, slots=True)
class BusOptions:
    """Options of the Zenoh session and the embedded router.

    Attributes:
        listen, connect: endpoints, comma-separated.
        config: JSON5 file with further Zenoh settings.
    """

    mode: Mode = "router"
    listen: str = "tcp/127.0.0.1:7447"
    connect: str = ""
    prefix: str = messages.PREFIX
    config: Path | None = None
    max_reply_bytes: int = 64 * 2**20
    security: RouterSecurity = field(default_factory=RouterSecurity)


@dataclass(frozen=True, slots=True)
class Reply:
    """Reply to a query."""

    payload: bytes
    encoding: str


DeferredReply = Callable[[], Reply]

QueryHandler = Callable[[str, str, Mapping[str, str]], Reply | DeferredReply]
"""Function (environment, rest of the key, parameters) -> the reply, or a slow function that returns it. Both may raise.
"""

ErrorEncoder = Callable[[Exception], bytes]
"""Function error -> JSON of its problem, as over HTTP."""

OnStatus = Callable[[str, str, bytes], None]
"""Function (environment, robot, payload); must return at once."""

OnLiveliness = Callable[[str, bool], None]
"""Function (robot, whether its session is alive); must return at once."""


def router_configuration(options: BusOptions) -> str:
    """Return the router's configuration: the operator's file with the server's values. Raises FleetMapError."""
    config = _base(options)
    own_rules = bool(json.loads(config.get_json("access_control/enabled")))
    for key, value in options.security.router_values(options.prefix, access=not own_rules).items():
        _set(config, key, value)
    _set(config, "mode", "router")
    _set(config, "listen/endpoints", [part.strip() for part in options.listen.split(",")])
    _set(config, "connect/endpoints", [part.strip() for part in options.connect.split(",") if part.strip()])
    _set(config, "scouting/multicast/enabled", False)
    _set(config, "transport/shared_memory/enabled", False)
    _set(config, "transport/unicast/max_sessions", 10_000)
    if options.config is None:
        # Zenoh's limit is 1 GiB, and the router assembles fragmented messages in memory.
        _set(config, "transport/link/rx/max_message_size", max(MESSAGE_BYTES, options.max_reply_bytes + 2**20))
    # With Zenoh's default of 100, this many idle connections would block new clients for 10 seconds.
    _set(config, "transport/unicast/accept_pending", 1000)
    return str(config)


def session_configuration(options: BusOptions) -> str:
    """Return the configuration of the server's session, a client of its own or another router. Raises FleetMapError."""
    config = _base(options)
    endpoints = options.connect if options.mode == "client" else client_endpoint(options.listen)
    _set(config, "mode", "client")
    _set(config, "connect/endpoints", [part.strip() for part in endpoints.split(",") if part.strip()])
    _set(config, "connect/timeout_ms", int(CONNECT_SECONDS * 1000))
    _set(config, "connect/exit_on_failure", True)
    _set(config, "transport/link/tx/lease", SESSION_LEASE_MILLISECONDS)
    _set(config, "connect/retry", {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2})
    _set(config, "listen/endpoints", [])
    _set(config, "scouting/multicast/enabled", False)
    _set(config, "transport/shared_memory/enabled", False)
    with contextlib.suppress(zenoh.ZError):
        _set(config, "access_control/enabled", False)  # only the router needs it
        _set(config, "transport/auth/usrpwd/dictionary_file", None)
    security = options.security
    for key, value in (security.login.values() if options.mode == "client" else security.session_values()).items():
        _set(config, key, value)
    return str(config)


def connection_error(options: BusOptions, error: Exception) -> str:
    """Describe why the server's session could not connect."""
    endpoints = options.connect if options.mode == "client" else client_endpoint(options.listen)
    return describe_connection_failure(endpoints, error, options.security.login, names=options.mode == "client")


def check(options: BusOptions) -> None:
    """Check the options before the start. Raises FleetMapError."""
    if options.mode == "router":
        router_configuration(options)
    if options.mode != "off":
        session_configuration(options)


def probe_router(options: BusOptions, seconds: float) -> str | None:
    """Connect to the router as the server does, and disconnect; return the router's version if it states it.

    Raises Unavailable without a connection, Invalid for unusable settings.
    """
    config = zenoh.Config.from_json5(session_configuration(options))
    _set(config, "connect/timeout_ms", int(seconds * 1000))
    try:
        session = zenoh.open(config)
    except Exception as error:
        raise Unavailable(connection_error(options, error)) from error
    try:
        for reply in session.get("@/*/router", timeout=seconds):
            if reply.ok is not None:
                described = json.loads(bytes(reply.ok.payload))
                return str(described.get("version", "")).partition("-")[0].lstrip("v") or None
        return None
    finally:
        _close(session)


def client_endpoint(listen: str) -> str:
    """Return the endpoint for clients on this machine, from the listen endpoints."""
    first = listen.split(",", maxsplit=1)[0].strip()
    return first.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:")


def _base(options: BusOptions) -> zenoh.Config:
    if options.config is None:
        return zenoh.Config()
    try:
        return zenoh.Config.from_file(str(options.config))
    except Exception as error:
        raise Unavailable(f"FLEETMAP_ZENOH_CONFIG: could not read {options.config}: {error}") from error


def _set(config: zenoh.Config, key: str, value: Any) -> None:
    config.insert_json5(key, json.dumps(value))


class Bus:
    """Zenoh session of the server, and the embedded router. Reconnects after failures. Thread-safe."""

    relay: RelayName = "zenoh"
    history = EVENT_CACHE_SIZE

    def __init__(
        self,
        options: BusOptions,
        *,
        query_handler: QueryHandler,
        explain: ErrorEncoder,
        on_status: OnStatus,
        on_alive: OnLiveliness,
    ) -> None:
        self.options = options
        self._query_handler, self._explain, self._on_status, self._on_alive = (
            query_handler,
            explain,
            on_status,
            on_alive,
        )
        self._session: zenoh.Session | None = None
        self._router: Router | None = None
        self._declared: list[Any] = []
        self._publishers: OrderedDict[str, ext.AdvancedPublisher] = OrderedDict()
        self._threads = ThreadPoolExecutor(THREADS, thread_name_prefix="fleetmap-zenoh")
        self._workers = ThreadPoolExecutor(THREADS, thread_name_prefix="fleetmap-zenoh-make")
        self._waiting = threading.Semaphore(MAX_WAITING_QUERIES)
        self._lock = threading.RLock()
        self._problem = "not connected yet"
        self._restart, self._pause = 0.0, 0.0
        self.opened = 0

    @property
    def state(self) -> dict[str, str]:
        """``{state: connected | down, detail?}`` for /readyz."""
        if self.connected:
            return {"state": "connected"}
        return {"state": "down", "detail": self._problem}

    @property
    def connected(self) -> bool:
        """Whether the session is connected to a router."""
        session = self._session
        try:
            return session is not None and bool(session.info.routers_zid())
        except zenoh.ZError:
            return False

    def open(self) -> bool:
        """Start the embedded router if needed, connect and declare everything. Return False if it fails."""
        with self._lock:
            if self.options.mode == "router" and (self._router is None or not self._router.alive):
                if self._router is not None:
                    self._router.close()
                    self._router = None
                if time.monotonic() < self._restart:
                    return False
                router = Router(router_configuration(self.options))
                if router.problem is not None:
                    self._problem = f"router cannot listen on {self.options.listen}: {first_line(router.problem)}"
                    self._pause = min(RESTART_SECONDS, 2 * self._pause or 0.5)
                    self._restart = time.monotonic() + self._pause
                    return False
                self._router, self._pause = router, 0.0
                self._problem = f"connecting to the new router at {self.endpoints}"
            if self._session is not None:
                return self.connected
            try:
                self._session = zenoh.open(zenoh.Config.from_json5(session_configuration(self.options)))
                self._declare(self._session)
            except Exception as error:  # noqa: BLE001  zenoh raises one class for everything
                self._problem = connection_error(self.options, error)
                self._close_session()
                return False
            self.opened += 1
            return True

    def ensure_connected(self) -> bool:
        """Restart the embedded router if it has stopped; the session reconnects by itself. Return whether connected."""
        router = self._router
        is_missing = self.options.mode == "router" and (router is None or not router.alive)
        if self._session is None or is_missing:
            return self.open() and self.connected
        if self.connected:
            return True
        self._problem = f"lost the connection to the router at {self.endpoints}: reconnecting"
        return False

    def publish(self, environment: str, body: Mapping[str, Any]) -> None:
        """Publish an event and cache it for late joiners. Raises Unavailable without a session."""
        with self._lock:
            if self._session is None:
                raise Unavailable(self._problem)
            publisher = self._publishers.get(environment)
            if publisher is None:
                publisher = self._declare_publisher(self._session, environment)
                self._publishers[environment] = publisher
                while len(self._publishers) > PUBLISHERS:
                    _, old = self._publishers.popitem(last=False)
                    _undeclare(old)
            self._publishers.move_to_end(environment)
            publisher.put(messages.dumps(body), encoding=messages.JSON)

    def flush(self) -> None:
        """Do nothing: an event that was put is in the cache of its publisher."""

    def close_publishers(self) -> None:
        """Undeclare the publishers of events, with their caches."""
        with self._lock:
            while self._publishers:
                _, publisher = self._publishers.popitem()
                with contextlib.suppress(Exception):
                    _undeclare(publisher)

    def close(self) -> None:
        """Undeclare everything, close the session and stop the router."""
        for threads in (self._threads, self._workers):
            threads.shutdown(wait=False, cancel_futures=True)
        with self._lock:
            self._close_session()
            if self._router is not None:
                self._router.close()
                self._router = None

    @property
    def title(self) -> str:
        """Where it is connected to, for the log."""
        return f"Zenoh at {self.endpoints}"

    @property
    def endpoints(self) -> str:
        """Endpoints of the router, comma-separated."""
        return self.options.connect if self.options.mode == "client" else self.options.listen

    def _declare_publisher(self, session: zenoh.Session, environment: str) -> ext.AdvancedPublisher:
        return ext.declare_advanced_publisher(
            session,
            messages.events_key(self.options.prefix, environment),
            cache=ext.CacheConfig(EVENT_CACHE_SIZE),
            publisher_detection=True,
            sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT_SECONDS),
            reliability=zenoh.Reliability.RELIABLE,
            congestion_control=zenoh.CongestionControl.DROP,
            express=True,
        )

    def _declare(self, session: zenoh.Session) -> None:
        prefix = self.options.prefix
        self._declared = [
            session.liveliness().declare_token(messages.server_key(prefix)),
            session.declare_subscriber(f"{prefix}/*/robots/*/status", self._status),
            session.liveliness().declare_subscriber(f"{prefix}/robots/*", self._alive, history=True),
            session.declare_queryable(f"{prefix}/*/*/maps/**", self._query, complete=True),
            session.declare_queryable(f"{prefix}/*/*/version", self._query, complete=True),
            session.declare_queryable(messages.position_key(prefix), self._query, complete=True),
        ]

    def _close_session(self) -> None:
        self.close_publishers()
        for declaration in self._declared:
            with contextlib.suppress(Exception):
                _undeclare(declaration)
        self._declared = []
        if self._session is not None:
            with contextlib.suppress(Exception):
                _close(self._session)
            self._session = None

    # --- callbacks in Zenoh threads: only pass on ---

    def _status(self, sample: zenoh.Sample) -> None:
        pieces = str(sample.key_expr).removeprefix(self.options.prefix + "/").split("/")
        if sample.kind != zenoh.SampleKind.PUT or len(pieces) != 4:  # a key with ``**`` matches as well
            return
        environment, _, robot, _ = pieces
        payload = bytes(sample.payload) if len(sample.payload) <= messages.MAX_STATUS_BYTES else b""
        self._hand_over(self._on_status, environment, robot, payload)

    def _alive(self, sample: zenoh.Sample) -> None:
        robot = str(sample.key_expr).rpartition("/")[2]
        self._hand_over(self._on_alive, robot, sample.kind == zenoh.SampleKind.PUT)

    def _query(self, query: zenoh.Query) -> None:
        if not self._waiting.acquire(blocking=False):
            self._reply_error(query, Unavailable("too many waiting queries: try again in a few seconds"))
            return
        self._submit(self._threads, query, self._handle_query)

    def _submit(self, threads: ThreadPoolExecutor, query: zenoh.Query, find: Callable[[zenoh.Query], Any]) -> None:
        try:
            threads.submit(self._answer, query, find)
        except RuntimeError:  # closing
            self._waiting.release()
            _drop(query)

    @staticmethod
    def _hand_over(function: Callable[..., None], *arguments: Any) -> None:
        """Call a function that only queues, in this thread, so that a robot's messages stay in order."""
        try:
            function(*arguments)
        except Exception:
            log.exception("Zenoh: handling a message failed")

    def _handle_query(self, query: zenoh.Query) -> Reply | DeferredReply:
        key = str(query.key_expr)
        if "*" in key:
            raise Invalid("wildcards are unsupported: query a single key")
        environment, _, rest = key.removeprefix(self.options.prefix + "/").partition("/")
        return self._query_handler(environment, rest, _parameters(query))

    def _answer(self, query: zenoh.Query, find: Callable[[zenoh.Query], Reply | DeferredReply]) -> None:
        """Reply with the result of ``find``; a deferred reply is passed to the worker threads. Runs in the pool."""
        try:
            reply = find(query)
            if not isinstance(reply, Reply):
                make = reply
                self._submit(self._workers, query, lambda _: make())
                return
            with contextlib.suppress(zenoh.ZError):  # the client has disconnected
                query.reply(query.key_expr, reply.payload, encoding=reply.encoding)
        except Exception as error:  # noqa: BLE001  reported to the client, and logged if internal
            self._reply_error(query, error)
        self._waiting.release()
        with contextlib.suppress(Exception):
            _drop(query)

    def _reply_error(self, query: zenoh.Query, error: Exception) -> None:
        with contextlib.suppress(zenoh.ZError):
            query.reply_err(self._explain(error), encoding="application/problem+json")


def _undeclare(declaration: Any) -> None:
    declaration.undeclare()


def _close(session: Any) -> None:
    session.close()


def _drop(query: Any) -> None:
    query.drop()


def _parameters(query: zenoh.Query) -> dict[str, str]:
    """Parse the parameters of a selector, ``grid=keepout;derive=false``. Raises Invalid for duplicates."""
    out: dict[str, str] = {}
    for pair in str(query.parameters).split(";"):
        name, _, value = pair.partition("=")
        if not name or name.startswith("_"):  # those with an underscore are Zenoh's own
            continue
        if name in out:
            raise Invalid(f"duplicate parameter {name[:80]!r}: give it once", [Problem("duplicate", where=name[:80])])
        out[name] = value
    return out
