"""``fleetmap keys``: list, show and rotate the keys that sign manifests."""

from __future__ import annotations

from typing import Annotated

import typer

from app.cli import options, output
from app.cli.client import Client
from app.cli.groups import Commands
from app.cli.problems import RequestFailed
from app.model.names import did_you_mean

commands = Commands("List, show and rotate the keys that sign manifests for robots.")


@commands.command("list")
def list_keys(
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """List the server's public keys, newest first. The newest signs; each is endorsed by the next older one.

    Example: `fleetmap keys list`
    """
    with Client(server, token) as client:
        rows = client.get("/keys")
    if as_json:
        output.show_json(rows)
        return
    output.show_table(
        ("id", "public key (base64)", "created (UTC)", "endorsed by"),
        ((row["id"], row["public_key"], output.minute(row["created"]), row.get("endorsed_by")) for row in rows),
    )


@commands.command("show")
def show(
    key: Annotated[
        str | None, typer.Argument(metavar="ID", help="Id of the key [default: the current signing key].")
    ] = None,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Print one public key, for `fleetmap agent --key`.

    Example: `fleetmap agent --key "$(fleetmap keys show)" …`
    """
    with Client(server, token) as client:
        rows = client.get("/keys")
    row = next((row for row in rows if key in (None, row["id"])), None)
    if row is None:
        near = did_you_mean(key or "", [row["id"] for row in rows])
        raise RequestFailed({"title": "Not found", "detail": f"unknown key {key!r}{near}"}, status=404)
    output.show_json(row) if as_json else output.print_result(row["public_key"])


@commands.command("rotate")
def rotate(
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask for confirmation.")] = False,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Replace the signing key with a new one (as administrator). Robots that trust the old key accept the new one.

    Asks for confirmation unless --yes is set.

    Example: `fleetmap keys rotate --yes`
    """
    if not yes:
        typer.confirm("Replace the signing key? This cannot be undone.", abort=True, err=True)
    with Client(server, token) as client:
        result = client.post("/keys", {})
    if as_json:
        output.show_json(result)
    else:
        output.print_result(f"new signing key {result['id']}: {result['public_key']}")
