"""Checks of ports, the running server and the Zenoh router."""

from __future__ import annotations

import errno
import importlib.metadata
import socket
import ssl
from collections.abc import Iterator
from http import HTTPStatus

from app import __version__
from app.doctor.registry import Finding, check, error, ok, warning
from app.doctor.site import Site
from app.errors import FleetMapError, Unavailable
from app.events.bus import client_endpoint, probe_router
from app.events.security import PASSWORD_FILE, read_users
from app.main import bus_options

PROBE_SECONDS = 3.0
TAKEN_ERRNOS = (errno.EADDRINUSE, errno.EACCES)
"""Errors of a port that another process may have: below 1024 the privilege is missed first."""

ANY_ADDRESS = {"0.0.0.0": "127.0.0.1", "::": "::1"}  # noqa: S104  nothing is bound here


@check
def http_port(site: Site) -> Iterator[Finding]:
    """Look whether the port of HTTP is free, or has this server."""
    settings = site.settings
    host, port = settings.host.strip("[]"), settings.port
    place = f"{settings.host} port {port}"
    problem = None if port == 0 else _bind_problem(host, port)
    if problem is None:
        yield ok("the system chooses a free port" if port == 0 else "free; no server runs on it", place)
    elif problem.errno not in TAKEN_ERRNOS or not _listens(ANY_ADDRESS.get(host, host), port):
        advice = "set FLEETMAP_HOST to an address of this machine; ports below 1024 need a privilege"
        yield error(f"cannot listen: {problem.strerror or problem}", place, advice)
    else:
        scheme = "https" if settings.tls_certificate is not None else "http"
        shown = ANY_ADDRESS.get(host, host)
        address = f"{scheme}://[{shown}]:{port}" if ":" in shown else f"{scheme}://{shown}:{port}"
        try:
            answer = site.fetch("/healthz", address)
            is_server = answer.status_code == HTTPStatus.OK and answer.json() == {"status": "ok"}
        except ValueError:
            is_server = False
        except FleetMapError as failure:  # its certificate, which another check examines, may not name this address
            is_server = _has_untrusted_certificate(failure)
        if is_server:
            yield ok("a server answers", place)
        else:
            yield error("another program uses the port", place, "stop it (`ss -ltnp`), or set another FLEETMAP_PORT")


def _has_untrusted_certificate(failure: BaseException | None) -> bool:
    """Return whether there was an answer over TLS, with a certificate that is not trusted here."""
    while failure is not None and not isinstance(failure, ssl.SSLCertVerificationError):
        failure = failure.__cause__ or failure.__context__
    return failure is not None


def _bind_problem(host: str, port: int) -> OSError | None:
    """Bind a port, and free it at once; return why that fails."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as listener:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as the server does, after a stop
            listener.bind(address)
    except OSError as failure:
        return failure
    return None


def _listens(host: str, port: int) -> bool:
    try:
        with socket.create_connection((host, port), PROBE_SECONDS):
            return True
    except OSError:
        return False


@check
def server(site: Site) -> Iterator[Finding]:
    """Look at the state and the version of the running server, if its address is given."""
    if site.server is None:
        yield ok("not asked: set --server to look at a running one")
        return
    try:
        ready = site.fetch("/readyz")
    except Unavailable as failure:
        yield error(
            failure.detail, site.server, "start it and read its log; check the address, the proxy and FLEETMAP_CA"
        )
        return
    state = ready.json() if ready.headers.get("content-type", "").endswith("json") else {}
    if ready.status_code != HTTPStatus.OK:
        detail = str(state.get("detail") or f"/readyz returns {ready.status_code}")
        yield error(f"not ready: {detail}", site.server, "repair the reason; the server goes on by itself")
        return
    if state.get("status") == "read-only":
        yield error(f"read-only: {state.get('writes')}", site.server, "free space, or repair the file store")
    if state.get("cache", "ok") != "ok":
        yield warning(f"cannot write its cache: {state['cache']}", site.server, "free space, or repair its folder")
    events = state.get("events", {})
    if events.get("state") == "down":
        yield warning(f"publishes no events: {events.get('detail')}", site.server, "see the check zenoh-router")
    if state.get("mirror", {}).get("state") == "cut off":
        yield warning("the mirror is cut off", site.server, "repair its connection to the server that it follows")
    version = site.fetch("/openapi.json").json().get("info", {}).get("version")
    if version != __version__:
        advice = "finish the upgrade: install the same release everywhere"
        yield warning(f"the server is version {version}, this program {__version__}", site.server, advice)
    yield ok(f"version {version} answers, {state.get('status', 'ready')}", site.server)


@check
def zenoh_router(site: Site) -> Iterator[Finding]:
    """Connect to the Zenoh router with the server's user and certificate."""
    settings = site.settings
    if settings.zenoh_mode == "off":
        yield ok("Zenoh is off: robots poll")
        return
    place = settings.zenoh_connect if settings.zenoh_mode == "client" else settings.zenoh_listen
    if settings.zenoh_users is not None:
        yield ok(f"{len(read_users(settings.zenoh_users))} users", str(settings.zenoh_users))
        if "tcp/" in settings.zenoh_listen:
            advice = "use tls/ endpoints with FLEETMAP_ZENOH_CERTIFICATE"
            yield warning("passwords are sent in clear text", settings.zenoh_listen, advice)
    if settings.zenoh_mode == "router":
        host, _, port = client_endpoint(settings.zenoh_listen).partition("/")[2].partition("#")[0].rpartition(":")
        if not port.isdigit() or not _listens(host.strip("[]"), int(port)):
            yield ok("not running: it starts with the server", place)
            return
        if settings.zenoh_users is not None and not (settings.data_dir / PASSWORD_FILE).exists():
            advice = "stop the program that has the port, or set the server's data folder with --data-dir"
            yield error("a router runs that this data folder's server has not started", place, advice)
            return
    try:
        version = probe_router(bus_options(settings), PROBE_SECONDS)
    except FleetMapError as failure:
        advice = f"{_router_advice(site)} the certificates (check certificate-zenoh)"
        yield error(failure.detail, place, advice)
        return
    yield _compare(version, place)


def _router_advice(site: Site) -> str:
    """Say what to do about a router that cannot be reached, up to its certificates."""
    if site.settings.zenoh_mode == "router":
        return "a program has the port (`ss -ltnp`): stop it or set FLEETMAP_ZENOH_LISTEN; if it is the server, check"
    return "start the router; check address, user and password, and"


def _compare(router: str | None, place: str) -> Finding:
    """Compare the router's version with that of the client: only releases with the same minor version are tried."""
    client = importlib.metadata.version("eclipse-zenoh")
    if router is None:
        return ok(f"connected; the router does not state its version, the client has {client}", place)
    if router.split(".")[:2] != client.split(".")[:2]:
        advice = f"run a router of version {client}"
        return warning(f"the router is version {router}, the client {client}", place, advice)
    return ok(f"connected to version {router}, the client has {client}", place)
