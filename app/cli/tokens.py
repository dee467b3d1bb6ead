"""Access tokens: create, list, delete."""

from __future__ import annotations

from typing import Annotated

import typer

from app.cli import options, output
from app.cli.client import Client, path_of
from app.cli.groups import Commands

commands = Commands("Create, list and delete access tokens (as administrator).")


@commands.command("create")
def create(
    name: Annotated[str, typer.Argument(help="Whose it is, for the list.")],
    role: Annotated[str, typer.Option("--role", "-r", help="viewer, robot, editor or admin.")] = "viewer",
    environments: Annotated[
        str | None, typer.Option("--environments", "-e", help="Only environments of this name pattern: 'farm-*'.")
    ] = None,
    robot: Annotated[
        str | None,
        typer.Option("--robot", help="The robot whose status it may set (role robot) [default: the token's name]."),
    ] = None,
    expires: Annotated[str | None, typer.Option("--expires", metavar="TIME", help="Until when (RFC 3339).")] = None,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Make a token. It is shown this once: the server keeps only its hash."""
    body = {"name": name, "role": role, "environments": environments, "robot": robot, "expires": expires}
    with Client(server, token) as client:
        made = client.post("/tokens", body)
    if as_json:
        output.show_json(made)
        return
    scope = f"{role}, sets the status of the robot {made['robot']}" if made.get("robot") else role
    output.say(f"token {made['id']} for {name} ({scope}), shown only this once:")
    output.show(made["token"])


@commands.command("list")
def show(server: options.Server = None, token: options.Token = None, as_json: options.Json = False) -> None:
    """All tokens, without their texts."""
    with Client(server, token) as client:
        rows = list(client.pages("/tokens", {}))
    if as_json:
        output.show_json(rows)
        return
    members = ("id", "name", "role", "environments", "robot", "expires")
    output.show_table(members, ([row.get(member) or "" for member in members] for row in rows))


@commands.command("delete")
def delete(
    identifier: Annotated[str, typer.Argument(metavar="ID", help="As `fleetmap token list` shows it.")],
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Make a token useless from now on."""
    with Client(server, token) as client:
        client.delete(path_of("tokens", identifier))
    if as_json:
        output.show_json({"id": identifier, "deleted": True})
    else:
        output.show(f"token {identifier} is deleted")
