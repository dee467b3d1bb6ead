"""``fleetmap token``: create, list and delete access tokens."""

from __future__ import annotations

from typing import Annotated

import typer

from app.cli import options, output
from app.cli.client import Client, quote_path
from app.cli.groups import Commands

commands = Commands("Create, list and delete access tokens (as administrator).")


ROLES = ("viewer", "robot", "mirror", "editor", "admin")


@commands.command("create")
def create(
    name: Annotated[str, typer.Argument(help="Name of the owner, shown as author in the history.")],
    role: Annotated[
        str,
        typer.Option(
            "--role", "-r", help="viewer, robot, mirror, editor or admin.", autocompletion=lambda: list(ROLES)
        ),
    ] = "viewer",
    environments: Annotated[
        str | None,
        typer.Option(
            "--environments", "-e", help="Pattern of accessible environments, such as 'farm-*' [default: all]."
        ),
    ] = None,
    robot: Annotated[
        str | None,
        typer.Option("--robot", help="Robot that may report its status with this token (role robot) [default: NAME]."),
    ] = None,
    expires: Annotated[
        str | None, typer.Option("--expires", metavar="TIME", help="Time of expiry (RFC 3339) [default: never].")
    ] = None,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Create a token. It is shown only once, since the server stores only its hash.

    Example: `fleetmap token create tractor-7 --role robot --environments 'farm-*'`
    """
    options.check_choice("--role", role, ROLES)
    body = {"name": name, "role": role, "environments": environments, "robot": robot, "expires": expires}
    with Client(server, token) as client:
        result = client.post("/tokens", body)
    if as_json:
        output.show_json(result)
        return
    scope = f"{role}, reports the status of robot {result['robot']}" if result.get("robot") else role
    output.print_status(f"token {result['id']} for {name} ({scope}), shown only once:")
    output.print_result(result["token"])


@commands.command("link")
def link(
    identifier: Annotated[str, typer.Argument(metavar="ID", help="Id of the token, see `fleetmap token list`.")],
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Create a link that signs in one browser with a token, without typing it. It is valid once, for 10 minutes.

    Example: `fleetmap token link 3f9a…`
    """
    with Client(server, token) as client:
        result = client.post(quote_path("tokens", identifier, "sign-in-code"), {})
        result = {**result, "url": f"{client.server}{result['path']}"}
    if as_json:
        output.show_json(result)
        return
    output.print_status(f"valid once, until {result['expires']}:")
    output.print_result(result["url"])


@commands.command("list")
def show(server: options.Server = None, token: options.Token = None, as_json: options.Json = False) -> None:
    """List all tokens, without their secrets.

    Example: `fleetmap token list`
    """
    with Client(server, token) as client:
        rows = list(client.pages("/tokens", {}))
    if as_json:
        output.show_json(rows)
        return
    members = ("id", "name", "role", "environments", "robot", "expires", "last_used", "ended")
    output.show_table(members, ([row.get(member) or "" for member in members] for row in rows))


@commands.command("delete")
def delete(
    identifier: Annotated[str, typer.Argument(metavar="ID", help="Id of the token, see `fleetmap token list`.")],
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Delete a token, which loses its access at once.

    Example: `fleetmap token delete 3f9a…`
    """
    with Client(server, token) as client:
        client.delete(quote_path("tokens", identifier))
    if as_json:
        output.show_json({"id": identifier, "deleted": True})
    else:
        output.print_result(f"deleted token {identifier}")
