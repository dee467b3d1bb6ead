"""``fleetmap doctor``: look at everything that keeps a server alive, and say what to do."""

from __future__ import annotations

import os
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from app.cli import local, options, output

if TYPE_CHECKING:
    from app.doctor import Result

STYLES = {"ok": "green", "warning": "yellow", "error": "red"}


def doctor(
    only: Annotated[
        list[str] | None, typer.Option("--only", metavar="CHECK", help="Run this check only; repeatable.")
    ] = None,
    database_url: Annotated[
        str | None, typer.Option("--database-url", help="Database [default: FLEETMAP_DATABASE_URL].")
    ] = None,
    data_dir: Annotated[
        Path | None, typer.Option("--data-dir", help="Data folder of the server [default: FLEETMAP_DATA_DIR].")
    ] = None,
    blob_url: Annotated[
        str | None,
        typer.Option("--blob-url", help="Folder or s3:// address of stored files [default: FLEETMAP_BLOB_URL]."),
    ] = None,
    server: options.Server = None,
    as_json: options.Json = False,
) -> None:
    """Look at everything that keeps a server alive, and say what is wrong, where, and what to do.

    Settings, ports, certificates, clock, disks, memory, database, file store, Zenoh router, MQTT broker, webhooks,
    keys, backups and worker processes of this machine, with the settings of the server. With --server (or
    FLEETMAP_SERVER) also the running server. It changes nothing and does not disturb a running server.

    Exit status: 0 if there is no error (there may be warnings), 1 otherwise, 2 for a wrong option.

    Example: `fleetmap doctor --data-dir /srv/fleetmap --server https://maps.example.org`
    """
    local.require_server_python("doctor")
    from app import doctor as examination
    from app.cli import server as server_commands

    for name in only or ():
        options.check_choice("--only", name, sorted(examination.all_checks()))
    values = {"database_url": database_url, "data_dir": data_dir, "blob_url": blob_url}
    try:
        settings = server_commands.load_settings(values, warn=False)
    except typer.BadParameter as failure:
        advice = "correct the settings; nothing else was checked"
        _show(
            [examination.Result("settings", examination.Finding("error", failure.message, "", advice))], as_json=as_json
        )
        raise typer.Exit(1) from failure
    unknown = tuple(server_commands.unknown_settings())
    with (
        closing(examination.Site(settings, unknown, server, dict(os.environ))) as site,
        output.progress_bar("examining"),
    ):
        results = list(examination.examine(site, only or ()))
    _show(results, as_json=as_json)
    if any(result.finding.level == "error" for result in results):
        raise typer.Exit(1)


def _show(results: list[Result], *, as_json: bool) -> None:
    levels = [result.finding.level for result in results]
    counts = {"errors": levels.count("error"), "warnings": levels.count("warning")}
    if as_json:
        checks = [result.as_dict() for result in results]
        output.show_json({"ok": not counts["errors"], **counts, "checks": checks})
        return
    for result in results:
        finding = result.finding
        place = f" ({finding.place})" if finding.place else ""
        output.print_result(f"{finding.level:<8} {result.check}: {finding.detail}{place}", style=STYLES[finding.level])
        if finding.advice:
            output.print_result(f"         → {finding.advice}")
    output.print_result(f"{counts['errors']} errors, {counts['warnings']} warnings, {levels.count('ok')} ok")
