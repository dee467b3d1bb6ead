"""Server commands: serve, migrate and demo."""

from __future__ import annotations

import atexit
import gc
import inspect
import multiprocessing
import os
import re
import secrets
import signal
import socket
import ssl
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Mapping
from functools import partial
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_origin

import typer

from app.cli import local, options, output, variables
from app.cli.problems import RequestFailed
from app.errors import FleetMapError, Unavailable

if TYPE_CHECKING:
    from app.config import Settings

_ASSIGNED = re.compile(rf"\s*(?:export\s+)?({variables.PREFIX}\w+)\s*=", re.IGNORECASE)

SECRETS_DIR = "FLEETMAP_SECRETS_DIR"
"""Variable with the folder of mounted secrets, in which a file named like a setting (``fleetmap_admin_token``) contains
its value. Not a setting itself, since settings are read from there.
"""

START_SECONDS = 60.0
"""Maximum time that the demo waits until the server is ready."""

WORKER_PORT = 8001
"""Port of a worker's health, beside a server's."""

PANELS: Mapping[str, str] = {
    **dict.fromkeys(("data", "database", "blob", "cache", "memory", "retention"), "Data"),
    **dict.fromkeys(
        ("host", "port", "tls", "admin", "signing", "insecure", "token", "anonymous", "header", "body"),
        "Network and access",
    ),
    "zenoh": "Events over Zenoh",
    "ros2": "Maps as ROS 2 topics",
    **dict.fromkeys(("imagery", "models"), "Satellite pictures and models"),
    "max": "Limits of uploads and maps",
}
"""Help panels by the first word of a setting; the others are in the first panel."""

NOT_FLAGS = frozenset({"admin_token", "blob_secret_key", "zenoh_password"})
"""Settings without an option: secrets in a command line are visible to all users of the machine."""

DEMO_TOKEN = "demo-token"  # noqa: S105  the name of a file
"""File in the data folder, readable by its owner only: keeps the token of ``serve --demo`` the same at every start."""


def serve(*, demo: bool = False, **values: Any) -> None:
    """Start the server.

    It runs in the foreground and stops cleanly on SIGTERM and Ctrl-C.

    Each option can also be set as FLEETMAP_… in the environment or in a file .env, or as a file fleetmap_… in the
    folder FLEETMAP_SECRETS_DIR. Sizes are in bytes or have a unit: 512MiB, 2GB.

    Example: `fleetmap serve --port 8080 --data-dir /srv/fleetmap --max-upload-bytes 2GiB`
    """
    settings = load_settings(values)
    if demo and settings.tls_certificate is not None:
        raise typer.BadParameter("--demo and --tls-certificate cannot be combined: the demo uses plain HTTP")
    _check_certificate(settings)
    if demo:
        settings = with_demo_token(settings)
    listener = listen(settings.host, settings.port)
    if settings.workers == 1:
        from app.pool import preload_in_background

        preload_in_background()
    gc.disable()  # until the application is created: modules loaded until then stay in memory anyway
    from app import main

    try:
        address = local_address(listener, secure=settings.tls_certificate is not None)
        settings = settings.model_copy(update={"port": listener.getsockname()[1]})
        check(settings)
        main.check_bus(settings)
        _compile(settings.data_dir / "native")
        output.print_result(f"Fleet Map Server: {address} · documentation: {address}/docs")
        if demo:
            threading.Thread(target=_bring_demo, args=(address, settings), daemon=True).start()
        else:
            output.print_result(f"open {address}/")
        sys.stdout.flush()
        _run(settings, listener)
    finally:
        gc.enable()
        listener.close()


def _compile(folder: Path) -> None:
    """Compile the native code of derivations into a folder, in the background. Workers only read the folder.

    Uses the folder ``NUMBA_CACHE_DIR`` if set. Until compilation has finished, workers compile the code that they need.
    """
    from app import native

    cache_path = os.environ.setdefault(native.FOLDER, str(folder.resolve()))
    if native.is_filled(Path(cache_path)):
        return
    process = multiprocessing.get_context("spawn").Process(
        target=native.fill_quietly, args=(Path(cache_path),), daemon=True
    )
    process.start()


def worker(
    host: Annotated[
        str | None, typer.Option("--host", help="Address for /healthz, /readyz and /metrics [default: FLEETMAP_HOST].")
    ] = None,
    port: Annotated[int | None, typer.Option("--port", min=0, max=65535, help="Their port [default: 8001].")] = None,
    conversion_workers: Annotated[
        int | None,
        typer.Option("--conversion-workers", min=1, max=256, help="Number of tasks at once [default: processors]."),
    ] = None,
    data_dir: Annotated[
        Path | None, typer.Option("--data-dir", help="Folder for caches [default: FLEETMAP_DATA_DIR].")
    ] = None,
) -> None:
    """Do the long work of several servers: conversions, derivations and generations.

    Set FLEETMAP_DATABASE_URL and FLEETMAP_BLOB_URL as for the servers. It runs in the foreground. On SIGTERM it
    finishes its tasks, and gives those back that take over 20 seconds more.

    Example: `fleetmap worker --port 8001 --conversion-workers 4`
    """
    local.require_server_python("worker")
    given = {"host": host, "conversion_workers": conversion_workers, "data_dir": data_dir}
    settings = load_settings({**given, "port": WORKER_PORT if port is None else None})
    if port is not None:
        settings = settings.model_copy(update={"port": port})
    settings = settings.model_copy(update={"workers": 1, "zenoh_mode": "off"})
    import uvicorn

    from app import logs
    from app.pool import preload_in_background
    from app.worker import create_worker

    app = create_worker(settings)
    listener = listen(settings.host, settings.port)
    preload_in_background()
    check(settings)
    _compile(settings.data_dir / "native")
    output.print_result(f"Fleet Map Server's worker: {local_address(listener)}/readyz")
    sys.stdout.flush()
    for signal_number in (signal.SIGTERM, signal.SIGINT):  # uvicorn raises it again after its shutdown
        signal.signal(signal_number, lambda *_: None)
    log_config = logs.config(settings.log_level, settings.log_format)
    config = uvicorn.Config(app, lifespan="on", log_config=log_config, access_log=False, server_header=False, ws="none")
    try:
        uvicorn.Server(config).run(sockets=[listener])
    except SystemExit as error:  # it did not start; uvicorn has logged why
        raise typer.Exit(1) from error
    finally:
        listener.close()


def migrate(
    database_url: Annotated[
        str | None, typer.Option("--database-url", help="Database [default: FLEETMAP_DATABASE_URL].")
    ] = None,
    data_dir: Annotated[
        Path | None, typer.Option("--data-dir", help="Data folder of the server [default: FLEETMAP_DATA_DIR].")
    ] = None,
    as_json: options.Json = False,
) -> None:
    """Migrate the database to the schema of this release.

    Required for PostgreSQL before a new release starts. SQLite is migrated at each start.

    Example: `fleetmap migrate --database-url postgresql+psycopg://fleetmap@db/fleetmap`
    """
    local.require_server_python("migrate")
    settings = load_settings({"database_url": database_url, "data_dir": data_dir})
    with output.progress_bar("migrating"), _store(settings) as store:
        store.migrate()
        store.check()
    if as_json:
        output.show_json({"database": _without_password(settings.database), "migrated": True})
    else:
        output.print_result(f"{_without_password(settings.database)}: the schema is current")


def demo(server: options.Server = None, token: options.Token = None, as_json: options.Json = False) -> None:
    """Install the demo environment on a running server, if it is not installed yet.

    Example: `fleetmap demo`
    """
    from app.cli import demo as orchard
    from app.cli.client import Client

    with Client(server, token) as client:
        result = orchard.install(client)
        lines = orchard.curl_lines(client.server, client.token)
    if as_json:
        output.show_json(result)
        return
    output.print_result(
        f"{result['environment']}: version {result['version']}{'' if result['created'] else ' exists already'}"
    )
    for line in lines:
        output.print_result(f"  {line}")


def application(settings: Settings) -> Any:
    """Create the ASGI application of a server process, which stops with its parent process."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_stop_with_parent, args=(parent,), daemon=True).start()
    from app.main import create_app

    server_app = create_app(settings)
    gc.freeze()
    gc.unfreeze()  # moves all objects to the oldest generation without scanning them
    gc.enable()
    atexit.register(gc.freeze)  # of a child process, as in app.cli.main
    return server_app


def load_settings(values: Mapping[str, Any], *, warn: bool = True) -> Settings:
    """Load the settings from options, the environment, ``.env`` and mounted secrets, in this order of precedence.

    warn: whether to print warnings about unused variables. Raises BadParameter for invalid settings.
    """
    local.require_server_python("serve")
    from pydantic import ValidationError

    from app.config import Settings

    given = {name: value for name, value in values.items() if value not in (None, False)}
    folder = os.environ.get(SECRETS_DIR)
    if folder:
        if not Path(folder).is_dir():
            raise typer.BadParameter(f"{SECRETS_DIR}: folder {folder} not found")
        given["_secrets_dir"] = folder
    for warning in unknown_settings() if warn else ():
        output.print_status(f"warning: {warning}", style="yellow")
    try:
        return Settings(**given)
    except ValidationError as error:
        reasons = []
        for item in error.errors():
            name = ".".join(str(part) for part in item["loc"])
            reason = str(item["msg"]).removeprefix("Value error, ")
            flag = f"--{name.replace('_', '-')} (FLEETMAP_{name.upper()}): " if name else ""
            reasons.append(flag + reason)
        raise typer.BadParameter("; ".join(reasons)) from error


def unknown_settings(file: Path = Path(".env")) -> list[str]:
    """Return warnings about unused FLEETMAP_ variables in the environment or in a .env file."""
    from app.config import Settings

    names = dict.fromkeys(name.upper() for name in os.environ if name.upper().startswith(variables.PREFIX))
    if file.is_file():
        lines = file.read_text(errors="replace").splitlines()
        names |= dict.fromkeys(match[1].upper() for line in lines if (match := _ASSIGNED.match(line)))
    setting_names = {f"{variables.PREFIX}{name.upper()}" for name in Settings.model_fields} | {SECRETS_DIR}
    return variables.unknown(names, setting_names)


def with_flags(function: Callable[..., None]) -> Callable[..., None]:
    """Return ``serve`` with an option for each setting of ``app.config.Settings``."""
    local.require_server_python("serve")
    from app.config import Settings
    from app.setting_values import format_size

    def command(**values: Any) -> None:
        function(**values)

    demo = Annotated[bool, typer.Option("--demo", help="Install a small demo environment and print example commands.")]
    parameters: dict[str, tuple[Any, bool | None]] = {"demo": (demo, False)}
    for name, field in Settings.model_fields.items():
        if name in NOT_FLAGS:
            continue
        flag = f"--{name.replace('_', '-')}"
        default = None if field.default_factory or field.default in ("", False) else field.default
        sized = name.endswith("_bytes")
        note = "" if default is None else f" [default: {format_size(default) if sized else default}]"
        text = f"{field.description or ''}{note}"
        panel = PANELS.get(name.partition("_")[0])
        if field.annotation is bool:
            parameters[name] = (Annotated[bool, typer.Option(flag, help=text, rich_help_panel=panel)], False)
            continue
        shown = "SIZE" if sized else "SECONDS" if name.endswith("_seconds") else _metavar(field.annotation)
        option = typer.Option(flag, help=text, show_default=False, metavar=shown, rich_help_panel=panel)
        parameters[name] = (Annotated[str | None, option], None)
    keyword = inspect.Parameter.KEYWORD_ONLY
    command.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [inspect.Parameter(n, keyword, default=d, annotation=a) for n, (a, d) in parameters.items()]
    )
    command.__annotations__ = {name: annotation for name, (annotation, _) in parameters.items()}
    command.__doc__ = function.__doc__
    return command


def _metavar(annotation: Any) -> str:
    """Return the placeholder for a setting's value in the help: its choices, or its type."""
    if get_origin(annotation) is Literal:
        return "|".join(get_args(annotation))
    kinds = {int: "NUMBER", float: "NUMBER", Path: "PATH"}
    return next((kinds[kind] for kind in (annotation, *get_args(annotation)) if kind in kinds), "TEXT")


def listen(host: str, port: int) -> socket.socket:
    """Open a listening socket. Raises Unavailable if the address is in use or does not belong to this machine."""
    listener: socket.socket | None = None
    try:
        family, kind, protocol, _, place = socket.getaddrinfo(
            host.strip("[]"), port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        listener = socket.socket(family, kind, protocol)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(place)
        listener.set_inheritable(True)
    except OSError as error:
        if listener is not None:
            listener.close()
        detail = f"cannot listen on {host} port {port} ({error.strerror or error}): use another --port or --host"
        raise Unavailable(detail) from error
    return listener


def local_address(listener: socket.socket, *, secure: bool = False) -> str:
    """Return the URL of the server for clients on this machine."""
    scheme = "https" if secure else "http"
    host, port = listener.getsockname()[:2]
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)  # noqa: S104  compared, not bound
    return f"{scheme}://[{host}]:{port}" if ":" in host else f"{scheme}://{host}:{port}"


def _check_certificate(settings: Settings) -> None:
    """Raise BadParameter if certificate and key cannot be loaded."""
    if settings.tls_certificate is None or settings.tls_key is None:
        return
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(settings.tls_certificate, settings.tls_key)
    except (OSError, ssl.SSLError) as error:
        raise typer.BadParameter(f"invalid --tls-certificate or --tls-key: {error}") from error


def check(settings: Settings) -> None:
    """Check database and data folder before the start. Raises Unavailable, with a solution."""
    with _store(settings) as store:
        from app.main import startup_lock

        with startup_lock(settings.data_dir):
            store.initialise()
        store.check()
        problem = store.write_problem()
        if problem is not None:
            output.print_status(problem, style="yellow")


def with_demo_token(settings: Settings) -> Settings:
    """Return the settings with an administrator's token that is the same at every start of the demo.

    It is stored in the data folder, readable by its owner only. A token set by the operator is kept.
    """
    from pydantic import SecretStr

    if settings.admin_token is not None or settings.insecure_no_auth:
        return settings
    settings.data_dir.mkdir(mode=0o700, parents=True, exist_ok=True)
    token_file = settings.data_dir / DEMO_TOKEN
    if not token_file.is_file() or not token_file.read_text().strip():
        with open(os.open(token_file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w") as stream:  # noqa: PTH123  its mode
            stream.write(secrets.token_urlsafe(32) + "\n")
    return settings.model_copy(update={"admin_token": SecretStr(token_file.read_text().strip())})


def _store(settings: Settings) -> Any:
    from contextlib import closing

    from app.main import create_folders, open_store

    try:
        create_folders(settings)
    except OSError as error:
        raise Unavailable(f"{error.filename}: {error.strerror}: use another folder with --data-dir") from error
    return closing(open_store(settings))


def _without_password(url: str) -> str:
    from sqlalchemy import make_url

    return make_url(url).render_as_string(hide_password=True)


def _run(settings: Settings, listener: socket.socket) -> None:
    import uvicorn
    from uvicorn.supervisors import Multiprocess

    from app.main import server_config

    config = server_config(settings, partial(application, settings))
    # Uvicorn raises the signal again after its shutdown; the exit status of a clean stop must be 0.
    for signal_number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(signal_number, lambda *_: None)
    if settings.workers > 1:
        supervisor = Multiprocess(config, sockets=[listener])
        supervisor.run()
        clean = (None, 0, -signal.SIGTERM, -signal.SIGINT)  # uvicorn's workers exit by the signal that stopped them
        if any(process.exitcode not in clean for process in supervisor.processes):
            raise typer.Exit(1)
        return
    server = uvicorn.Server(config)
    try:
        server.run(sockets=[listener])
    except SystemExit as error:  # the application did not start; uvicorn has logged why
        raise typer.Exit(1) from error


def _stop_with_parent(parent: Any) -> None:
    parent.join()
    os.kill(os.getpid(), signal.SIGTERM)


def _bring_demo(address: str, settings: Settings) -> None:
    """Wait until the server is ready, install the demo, print example commands and a link that signs in."""
    from app.cli import demo as orchard
    from app.cli.client import Client

    token = settings.admin_token.get_secret_value() if settings.admin_token else None
    try:
        wait_ready(address)
        with Client(address, token) as client:
            result = orchard.install(client)
        path = "/" if token is None or settings.insecure_no_auth else _sign_in_path(settings, token)
    except (FleetMapError, RequestFailed, OSError) as error:
        output.print_status(f"could not install the demo: {error}", style="yellow")
        return
    output.print_result(f"demo environment: {result['environment']}, version {result['version']}")
    if token:
        output.print_result(f"administrator's token: {token}")
    output.print_result("try:")
    for line in orchard.curl_lines(address, token):
        output.print_result(f"  {line}")
    output.print_result(f"open {address}{path}")
    sys.stdout.flush()


def _sign_in_path(settings: Settings, token: str) -> str:
    """Create a one-time code for a token; return the path of the page with it."""
    from app.api.session import sign_in_path

    with _store(settings) as store:
        found_token = store.tokens.find(token)
        return "/" if found_token is None else sign_in_path(store.sessions.make_sign_in_code(found_token.id)[0])


def wait_ready(address: str, *, seconds: float = START_SECONDS) -> None:
    """Wait until the server is ready. Raises Unavailable after ``seconds``."""
    deadline = time.monotonic() + seconds
    while True:
        try:
            with urllib.request.urlopen(f"{address}/readyz", timeout=5) as answer:  # noqa: S310  our own address
                if answer.status == HTTPStatus.OK:
                    return
        except (OSError, urllib.error.URLError):
            pass
        if time.monotonic() > deadline:
            raise Unavailable(f"{address} was not ready within {seconds:g} seconds")
        time.sleep(0.1)
