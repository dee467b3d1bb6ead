"""``fleetmap webhooks``: list, add, delete and test addresses that get each event."""

from __future__ import annotations

from typing import Annotated

import typer

from app.cli import options, output
from app.cli.client import Client, quote_path
from app.cli.groups import Commands

commands = Commands("List, add, delete and test webhooks, which get each event (as administrator).")

Identifier = Annotated[str, typer.Argument(metavar="ID", help="Id of the webhook, see `fleetmap webhooks list`.")]


@commands.command("list")
def show(server: options.Server = None, token: options.Token = None, as_json: options.Json = False) -> None:
    """List all webhooks: events that wait, why, and when they are tried again.

    Example: `fleetmap webhooks list`
    """
    with Client(server, token) as client:
        rows = client.get("/webhooks")
    if as_json:
        output.show_json(rows)
        return
    members = ("id", "url", "environments", "waiting", "delivered")
    shown = [
        {**row, "environments": row["environments"] or "all", "delivered": output.minute(row["delivered"])}
        for row in rows
    ]
    output.show_table(members, ([row[member] for member in members] for row in shown))
    for row in rows:
        if row["error"]:
            output.print_status(f"{row['id']}: next try {output.minute(row['next_try'])}: {row['error']}")
        for waiting in row["refused"]:
            output.print_status(f"{row['id']}: {waiting['environment']} waits: {waiting['error']}")


@commands.command("add")
def add(
    url: Annotated[str, typer.Argument(help="Address that gets events by POST, such as https://hooks.example.org.")],
    environments: Annotated[
        str | None,
        typer.Option("--environments", "-e", help="Pattern of the environments, such as 'farm-*' [default: all]."),
    ] = None,
    types: Annotated[
        str | None,
        typer.Option("--types", help="Types of events, comma-separated, such as 'channel.moved' [default: all]."),
    ] = None,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Add a webhook. Its secret is shown only once; the receiver needs it to check signatures.

    Example: `fleetmap webhooks add https://hooks.example.org/fleet -e 'farm-*'`
    """
    listed = None if types is None else [kind.strip() for kind in types.split(",")]
    with Client(server, token) as client:
        result = client.post("/webhooks", {"url": url, "environments": environments, "types": listed})
    if as_json:
        output.show_json(result)
        return
    output.print_status(f"webhook {result['id']} for {url}; its secret, shown only once:")
    output.print_result(result["secret"])


@commands.command("delete")
def delete(
    identifier: Identifier,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Delete a webhook; events that wait are not sent any more.

    Example: `fleetmap webhooks delete 3f9a…`
    """
    with Client(server, token) as client:
        client.delete(quote_path("webhooks", identifier))
    if as_json:
        output.show_json({"id": identifier, "deleted": True})
    else:
        output.print_result(f"deleted webhook {identifier}")


@commands.command("test")
def send_test(
    identifier: Identifier,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Send a test message to a webhook now. Exit status 1 if it is not delivered.

    Example: `fleetmap webhooks test 3f9a…`
    """
    with Client(server, token) as client:
        result = client.post(quote_path("webhooks", identifier, "test"), {})
    if as_json:
        output.show_json(result)
    elif result["delivered"]:
        output.print_result(f"delivered: the receiver answered {result['status']} after {result['seconds']} s")
    else:
        output.print_result(f"not delivered: {result['detail']}")
    if not result["delivered"]:
        raise typer.Exit(1)
