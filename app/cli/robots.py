"""``fleetmap robots``: list, show and forget robots."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import typer

from app.cli import completion, options, output
from app.cli.client import Client, quote_path
from app.cli.groups import Commands

commands = Commands("List robots with their version, state and lag behind their channel.")

InEnvironment = Annotated[
    str | None,
    typer.Option(
        "--environment", "-e", help="Only in this environment [default: all].", autocompletion=completion.environments
    ),
]
Robot = Annotated[str, typer.Argument(help="Name of the robot.")]


@commands.command("list")
def list_robots(
    environment: InEnvironment = None,
    channel: Annotated[
        str | None,
        typer.Option("--channel", "-c", help="Only on this channel.", autocompletion=completion.versions),
    ] = None,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """List robots by environment and name.

    Example: `fleetmap robots list --environment farm --channel production`
    """
    with Client(server, token) as client:
        rows = list(client.pages("/robots", {"environment": environment, "channel": channel}))
    if as_json:
        output.show_json(rows)
        return
    output.show_table(
        ("robot", "environment", "channel", "runs version", "state", "online", "behind", "last report (UTC)"),
        (
            (
                row["robot"],
                row["environment"],
                row["channel"],
                runs(row),
                row["state"],
                "yes" if row["online"] else "no",
                behind(row),
                output.minute(row["received"]),
            )
            for row in rows
        ),
    )


@commands.command("show")
def show(
    robot: Robot,
    environment: InEnvironment = None,
    limit: Annotated[int, typer.Option("--limit", "-n", min=1, max=200, help="Number of previous reports.")] = 10,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Show one robot with its previous reports, newest first.

    Example: `fleetmap robots show mower-3`
    """
    with Client(server, token) as client:
        details = client.get(quote_path("robots", robot), {"environment": environment, "limit": limit})
    if as_json:
        output.show_json(details)
        return
    output.show_members(
        {
            "robot": details["robot"],
            "environment": details["environment"],
            "channel": details["channel"],
            "runs version": runs(details),
            "state": details["state"],
            "detail": details.get("detail"),
            "online": "yes" if details["online"] else "no",
            "behind": behind(details),
            "last report (UTC)": output.minute(details["received"]),
            "also in": ", ".join(name for name in details["environments"] if name != details["environment"]),
        }
    )
    output.show_table(
        ("received (UTC)", "channel", "version", "state", "detail"),
        (
            (output.minute(one["received"]), one["channel"], one["version"], one["state"], one.get("detail"))
            for one in details["history"]
        ),
    )


@commands.command("forget")
def forget(
    robot: Robot,
    environment: Annotated[
        str,
        typer.Option("--environment", "-e", help="Environment of the robot.", autocompletion=completion.environments),
    ],
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Forget a robot that is out of service, so that it no longer counts for its channel.

    Its next report adds it again.

    Example: `fleetmap robots forget mower-3 --environment farm`
    """
    with Client(server, token) as client:
        client.delete(quote_path("robots", robot), {"environment": environment})
    if as_json:
        output.show_json({"robot": robot, "environment": environment, "forgotten": True})
    else:
        output.print_result(f"{robot}: forgotten in {environment}")


def runs(row: Mapping[str, Any]) -> str:
    """Return the version that a robot runs."""
    active_map = row.get("holds")
    return str(active_map["version"]) if active_map else "none"


def behind(row: Mapping[str, Any]) -> str:
    """Format the lag of a robot behind its channel; empty if there is none."""
    lag = row.get("lag")
    if not lag or not (lag["differs"] or lag["events"]):
        return ""
    since = f" since {output.minute(lag['since'])}" if lag.get("since") else ""
    return f"{lag['events']} event{'' if lag['events'] == 1 else 's'}{since}"
