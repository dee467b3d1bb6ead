"""``fleetmap keys``: the keys that sign manifests, which robots verify."""

from __future__ import annotations

from typing import Annotated

import typer

from app.cli import options, output
from app.cli.client import Client
from app.cli.groups import Commands
from app.cli.problems import RequestFailed
from app.model.names import did_you_mean

commands = Commands("List, show and rotate the keys that sign what robots fetch.")


@commands.command("list")
def list_keys(
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """List the server's public keys. The first one signs; each is endorsed by the key before it.

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
        str | None, typer.Argument(metavar="ID", help="Id of the key [default: the one that signs].")
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
        raise RequestFailed({"title": "Not found", "detail": f"the server has no key {key!r}{near}"}, status=404)
    output.show_json(row) if as_json else output.print_result(row["public_key"])


@commands.command("rotate")
def rotate(
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask for confirmation.")] = False,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Sign with a new key from now on (as administrator). Robots that trust the old key follow.

    It asks first, unless you give --yes.

    Example: `fleetmap keys rotate --yes`
    """
    if not yes:
        typer.confirm("Sign with a new key from now on? This cannot be undone.", abort=True, err=True)
    with Client(server, token) as client:
        result = client.post("/keys", {})
    if as_json:
        output.show_json(result)
    else:
        output.print_result(f"key {result['id']} signs from now on: {result['public_key']}")
