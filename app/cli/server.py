"""The server's side of the command line: serve and migrate, and the demo that ``serve --demo`` brings along."""

from __future__ import annotations

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
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_origin

import typer

from app.cli import local, options, output, variables
from app.cli.problems import RequestFailed
from app.errors import FleetMapError, NoRoom, Unavailable

if TYPE_CHECKING:
    from app.config import Settings

_ASSIGNED = re.compile(rf"\s*(?:export\s+)?({variables.PREFIX}\w+)\s*=", re.IGNORECASE)

SECRETS_DIR = "FLEETMAP_SECRETS_DIR"
"""Names the folder where a container mounts secrets: a file named like a setting (``fleetmap_admin_token``) holds its
value. It is no setting itself, since it says where settings are."""

START_SECONDS = 60.0
"""How long the demo waits for the server to be ready."""

PANELS: Mapping[str, str] = {
    **dict.fromkeys(("data", "database", "blob", "cache", "memory"), "Data"),
    **dict.fromkeys(("host", "port", "tls", "admin", "insecure", "token", "header", "body"), "Network and access"),
    "zenoh": "Events over Zenoh",
    "ros2": "Maps as ROS 2 topics",
    **dict.fromkeys(("imagery", "models"), "Satellite pictures and models"),
    "max": "Limits of uploads and maps",
}
"""Panels of the help by the first word of a setting; the others are in the first panel."""

NOT_FLAGS = frozenset({"admin_token", "zenoh_password"})
"""Settings that must not stand in a command line, where every user of the machine can read them."""

DEMO_TOKEN = "demo-token"  # noqa: S105  the name of a file
"""In the data folder, readable for its owner: lets ``serve --demo`` print commands that work at every start."""


def serve(*, demo: bool = False, **values: Any) -> None:
    """Start the server, with a demo if you like.

    It runs in the foreground and stops cleanly on SIGTERM and Ctrl-C.

    Every option is also a setting: FLEETMAP_… in the environment or in a file .env, or a file fleetmap_… in the folder
    that FLEETMAP_SECRETS_DIR names. Sizes are bytes, or have a unit: 512MiB, 2GB.

    Example: `fleetmap serve --port 8080 --data-dir /srv/fleetmap --max-upload-bytes 2GiB`
    """
    settings = load_settings(values)
    if demo and settings.tls_certificate is not None:
        raise typer.BadParameter("the demo is shown over plain HTTP: leave out --demo or --tls-certificate")
    _check_certificate(settings)
    if demo:
        settings = with_demo_token(settings)
    listener = listen(settings.host, settings.port)
    if settings.workers == 1:
        from app.pool import preload_in_background

        preload_in_background()
    gc.disable()  # until the application is made: what is loaded by then stays
    from app import main

    try:
        address = local_address(listener, secure=settings.tls_certificate is not None)
        settings = settings.model_copy(update={"port": listener.getsockname()[1]})
        check(settings)
        main.check_bus(settings)
        _compile(settings.data_dir / "native")
        output.print_result(f"Fleet Map Server: {address} · documentation: {address}/docs")
        sys.stdout.flush()
        if demo:
            token = settings.admin_token.get_secret_value() if settings.admin_token else None
            threading.Thread(target=_bring_demo, args=(address, token), daemon=True).start()
        _run(settings, listener)
    finally:
        gc.enable()
        listener.close()


def _compile(folder: Path) -> None:
    """Have the derivations' native code compiled into a folder, beside the start: workers read it and cannot write.

    Where ``NUMBA_CACHE_DIR`` names a folder, that one is taken. Until it is done, workers compile what they need.
    """
    from app import native

    cache_path = os.environ.setdefault(native.FOLDER, str(folder.resolve()))
    if native.is_filled(Path(cache_path)):
        return
    process = multiprocessing.get_context("spawn").Process(
        target=native.fill_quietly, args=(Path(cache_path),), daemon=True
    )
    process.start()


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

    PostgreSQL needs it before the server of a new release starts. SQLite is migrated at each start anyway.

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
    """Install the demo environment on a running server. A second time changes nothing.

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
        f"{result['environment']}: version {result['version']}{'' if result['created'] else ' was there already'}"
    )
    for line in lines:
        output.print_result(f"  {line}")


def application(settings: Settings) -> Any:
    """The ASGI application, in a server process of its own: it ends with the process that started it."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_stop_with_parent, args=(parent,), daemon=True).start()
    from app.main import create_app

    server_app = create_app(settings)
    gc.freeze()
    gc.unfreeze()  # all of it counts as old now, without a look at any of it
    gc.enable()
    return server_app


def load_settings(values: Mapping[str, Any]) -> Settings:
    """The settings: flags first, then the environment, ``.env``, mounted secrets. BadParameter for unusable ones."""
    local.require_server_python("serve")
    from pydantic import ValidationError

    from app.config import Settings

    given = {name: value for name, value in values.items() if value not in (None, False)}
    folder = os.environ.get(SECRETS_DIR)
    if folder:
        if not Path(folder).is_dir():
            raise typer.BadParameter(f"{SECRETS_DIR}: there is no folder {folder}")
        given["_secrets_dir"] = folder
    _warn_unknown(Settings.model_fields, Path(".env"))
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


def _warn_unknown(settings: Iterable[str], file: Path) -> None:
    """Warn of FLEETMAP_ variables, in the environment or a .env file, that nothing reads."""
    names = dict.fromkeys(name.upper() for name in os.environ if name.upper().startswith(variables.PREFIX))
    if file.is_file():
        lines = file.read_text(errors="replace").splitlines()
        names |= dict.fromkeys(match[1].upper() for line in lines if (match := _ASSIGNED.match(line)))
    setting_names = {f"{variables.PREFIX}{name.upper()}" for name in settings} | {SECRETS_DIR}
    for warning in variables.unknown(names, setting_names):
        output.print_status(f"warning: {warning}", style="yellow")


def with_flags(function: Callable[..., None]) -> Callable[..., None]:
    """``serve`` with an option for every setting, as ``app.config.Settings`` declares them."""
    local.require_server_python("serve")
    from app.config import Settings, format_size

    def command(**values: Any) -> None:
        function(**values)

    demo = Annotated[bool, typer.Option("--demo", help="Install a small demo environment, and print commands to try.")]
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
    """Return the word for a setting's value in the help: its choices, or its kind."""
    if get_origin(annotation) is Literal:
        return "|".join(get_args(annotation))
    kinds = {int: "NUMBER", float: "NUMBER", Path: "PATH"}
    return next((kinds[kind] for kind in (annotation, *get_args(annotation)) if kind in kinds), "TEXT")


def listen(host: str, port: int) -> socket.socket:
    """A listening socket; Unavailable where the address is taken or not this machine's."""
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
        detail = f"cannot listen on {host} port {port}: {error.strerror or error}; choose another with --port or --host"
        raise Unavailable(detail) from error
    return listener


def local_address(listener: socket.socket, *, secure: bool = False) -> str:
    """Where a client on this machine reaches it."""
    scheme = "https" if secure else "http"
    host, port = listener.getsockname()[:2]
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)  # noqa: S104  compared, not bound
    return f"{scheme}://[{host}]:{port}" if ":" in host else f"{scheme}://{host}:{port}"


def _check_certificate(settings: Settings) -> None:
    """BadParameter where HTTPS could not be served with what was given."""
    if settings.tls_certificate is None or settings.tls_key is None:
        return
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(settings.tls_certificate, settings.tls_key)
    except (OSError, ssl.SSLError) as error:
        raise typer.BadParameter(f"--tls-certificate and --tls-key cannot be used: {error}") from error


def check(settings: Settings) -> None:
    """Whether the server could start, told before it does; Unavailable with what to do about it."""
    with _store(settings) as store:
        if settings.database.startswith("sqlite"):
            from app.main import startup_lock

            with startup_lock(settings.data_dir):
                store.migrate()
        store.check()
        try:
            store.check_writable()
        except NoRoom as error:  # maps are served all the same
            output.print_status(error.detail, style="yellow")


def with_demo_token(settings: Settings) -> Settings:
    """The settings with an administrator's token that stays the same at every start of the demo.

    It is kept in the data folder, readable for its owner alone. One that the operator has set is left as it is.
    """
    from pydantic import SecretStr

    if settings.admin_token is not None or settings.insecure_no_auth:
        return settings
    settings.data_dir.mkdir(parents=True, exist_ok=True)
    token_file = settings.data_dir / DEMO_TOKEN
    if not token_file.is_file() or not token_file.read_text().strip():
        with open(os.open(token_file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w") as stream:  # noqa: PTH123  its mode
            stream.write(secrets.token_urlsafe(32) + "\n")
    return settings.model_copy(update={"admin_token": SecretStr(token_file.read_text().strip())})


def _store(settings: Settings) -> Any:
    from contextlib import closing

    from app.store.store import Store

    try:
        settings.data_dir.mkdir(parents=True, exist_ok=True)
        settings.blob_dir.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise Unavailable(f"{error.filename}: {error.strerror}; choose a folder with --data-dir") from error
    return closing(Store(settings.database, settings.blob_dir))


def _without_password(url: str) -> str:
    from sqlalchemy import make_url

    return make_url(url).render_as_string(hide_password=True)


def _run(settings: Settings, listener: socket.socket) -> None:
    import uvicorn
    from uvicorn.supervisors import Multiprocess

    from app.main import server_config

    config = server_config(settings, partial(application, settings))
    # Uvicorn raises the signal again once it has shut down; after a clean stop the exit status shall be 0.
    for signal_number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(signal_number, lambda *_: None)
    if settings.workers > 1:
        supervisor = Multiprocess(config, sockets=[listener])
        supervisor.run()
        clean = (None, 0, -signal.SIGTERM, -signal.SIGINT)  # uvicorn's workers end by the signal that stopped them
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


def _bring_demo(address: str, token: str | None) -> None:
    """Once the server answers: install the demo and print what to try."""
    from app.cli import demo as orchard
    from app.cli.client import Client

    try:
        wait_ready(address)
        with Client(address, token) as client:
            result = orchard.install(client)
    except (FleetMapError, RequestFailed, OSError) as error:
        output.print_status(f"the demo could not be installed: {error}", style="yellow")
        return
    output.print_result(f"demo environment: {result['environment']}, version {result['version']}")
    if token:
        output.print_result(f"administrator's token: {token}")
    output.print_result("try:")
    for line in orchard.curl_lines(address, token):
        output.print_result(f"  {line}")
    sys.stdout.flush()


def wait_ready(address: str, *, seconds: float = START_SECONDS) -> None:
    """Until the server says that it is ready; Unavailable where it does not in time."""
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
