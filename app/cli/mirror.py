"""``fleetmap mirror``: let this server follow another one."""

from __future__ import annotations

import os
import sys
import threading
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from app.cli import local, options, output
from app.cli.signals import call_at_stop
from app.errors import Invalid, NotFound

if TYPE_CHECKING:
    from app.config import Settings
    from app.store.store import Store


def mirror(
    url: Annotated[
        str | None, typer.Argument(metavar="[URL]", help="Address of the centre.", show_default=False)
    ] = None,
    token_file: Annotated[
        Path | None,
        typer.Option("--token-file", help="File with a token of the centre, role mirror [default: FLEETMAP_TOKEN]."),
    ] = None,
    environments: Annotated[
        list[str] | None,
        typer.Option(
            "--environment", "-e", metavar="NAME", help="Mirror only this one, a name or pattern; repeatable."
        ),
    ] = None,
    key: Annotated[
        str | None,
        typer.Option("--key", help="Id or public key of the centre [default: trust the key of the first contact]."),
    ] = None,
    status: Annotated[bool, typer.Option("--status", help="Print the state of the mirror, and end.")] = False,
    once: Annotated[bool, typer.Option("--once", help="Bring everything up to date once, and end.")] = False,
    release: Annotated[
        str | None,
        typer.Option("--release", metavar="NAME", help="Make a mirrored environment one of this server, and end."),
    ] = None,
    data_dir: Annotated[
        Path | None, typer.Option("--data-dir", help="Data folder of this server [default: FLEETMAP_DATA_DIR].")
    ] = None,
    database_url: Annotated[
        str | None, typer.Option("--database-url", help="Database of this server [default: FLEETMAP_DATABASE_URL].")
    ] = None,
    blob_url: Annotated[
        str | None,
        typer.Option("--blob-url", help="Its folder or s3:// address of files [default: FLEETMAP_BLOB_URL]."),
    ] = None,
    as_json: options.Json = False,
) -> None:
    """Let this server follow another one, its centre, and serve robots while it is cut off.

    Runs in the foreground beside `fleetmap serve`, with the same settings. Mirrored environments are changed at the
    centre; closures and statuses of robots are also accepted here, and handed on. It may be stopped at any time.

    Example: `fleetmap mirror https://maps.example.org --token-file /run/secrets/centre -e 'farm-*'`
    """
    local.require_server_python("mirror")
    from app.cli.server import load_settings

    settings = load_settings({"data_dir": data_dir, "database_url": database_url, "blob_url": blob_url})
    if sum((bool(url), status, release is not None)) != 1:
        raise typer.BadParameter("give the URL of the centre, or --status, or --release NAME")
    if status:
        _show_status(settings, as_json=as_json)
    elif release is not None:
        _release(settings, release, as_json=as_json)
    else:
        _follow(settings, str(url), _read_token(token_file), environments or [], key, once=once)


def _read_token(file: Path | None) -> str:
    if file is None:
        token = os.environ.get("FLEETMAP_TOKEN", "")
    else:
        try:
            token = file.read_text().strip()
        except (OSError, UnicodeDecodeError) as error:
            raise Invalid(f"--token-file {file}: could not read it: {error}") from error
    if not token:
        raise Invalid(
            "no token of the centre: create one there with `fleetmap token create NAME --role mirror`, and give it "
            "with --token-file or FLEETMAP_TOKEN"
        )
    return token


def _open(settings: Settings) -> Store:
    from app.main import create_folders, open_store, startup_lock

    create_folders(settings)
    store = open_store(settings)
    with startup_lock(settings.data_dir):
        store.initialise()
    store.check()
    return store


def _follow(settings: Settings, url: str, token: str, environments: list[str], key: str | None, *, once: bool) -> None:
    import logging.config

    import httpx

    from app import logs
    from app.agent.signatures import check_key
    from app.backends.lead import open_leads
    from app.events.credentials import server_ssl_context
    from app.main import signing_keys
    from app.mirror import process
    from app.mirror.centre import TIMEOUT, Centre
    from app.mirror.follow import Mirror

    address = url if "://" in url else f"http://{url}"
    ca = os.environ.get("FLEETMAP_CA")
    given = None if key is None else check_key(key)
    with (
        closing(_open(settings)) as store,
        closing(open_leads(settings.direct_database, settings.data_dir)) as leads,
        closing(httpx.Client(timeout=TIMEOUT, verify=server_ssl_context(address, Path(ca) if ca else None))) as client,
    ):
        state = store.mirrors.state()
        pinned = None if state is None or given is not None else state.key
        centre = Centre(address, token, key=pinned, given=given, client=client)
        mirror = Mirror(store, signing_keys(settings, store), centre, environments)
        if once:
            _end_once(mirror.run_once().failures)
            return
        logging.config.dictConfig(logs.config(settings.log_level, settings.log_format))
        stop = threading.Event()
        call_at_stop(stop.set)
        leads.start()
        output.print_result(f"following {centre.url}")
        sys.stdout.flush()
        process.run(store, centre, mirror, leads.lead(process.LEAD), stop)


def _end_once(failures: Any) -> None:
    for name, problem in sorted((failures or {}).items()):
        output.print_status(f"{name}: {problem}", style="yellow")
    if failures:
        raise typer.Exit(1)


def _show_status(settings: Settings, *, as_json: bool) -> None:
    with closing(_open(settings)) as store:
        described = store.mirrors.describe()
    if described is None:
        raise NotFound("this server mirrors no other: start `fleetmap mirror URL`")
    if as_json:
        output.show_json(described)
        return
    output.print_result(f"{described['centre']}: {described['state']}, last contact {described['contact'] or 'never'}")
    if described["problem"]:
        output.print_result(f"problem: {described['problem']}")
    output.print_result(f"changes that wait for the centre: {described['waiting']}")
    rows = [
        (one["name"], one.get("version", ""), one.get("serves_until") or "", one["problem"] or "")
        for one in described["environments"]
    ]
    output.show_table(("environment", "version", "serves until", "problem"), rows)


def _release(settings: Settings, name: str, *, as_json: bool) -> None:
    with closing(_open(settings)) as store:
        if not store.mirror_target.release(name):
            raise NotFound(f"{name[:80]!r} is no mirrored environment of this server")
    if as_json:
        output.show_json({"environment": name, "released": True})
    else:
        output.print_result(f"{name}: changed on this server from now on")
