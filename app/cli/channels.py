"""``fleetmap channels``: list and show channels, and cancel planned moves."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import typer

from app.cli import completion, options, output
from app.cli.client import Client, quote_path
from app.cli.groups import Commands
from app.cli.problems import RequestFailed
from app.model.names import did_you_mean

commands = Commands(
    "List channels, their versions and robots, and cancel planned moves. To move a channel, use `promote`."
)

Channel = Annotated[str, typer.Argument(help="Name of the channel.", autocompletion=completion.versions)]


@commands.command("list")
def list_channels(
    environment: options.Environment,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """List the channels of an environment, with the number of robots that run their version.

    Example: `fleetmap channels list farm`
    """
    with Client(server, token) as client:
        rows = client.get(quote_path("environments", environment, "channels"))
    if as_json:
        output.show_json(rows)
        return
    output.show_table(
        ("channel", "version", "since (UTC)", "author", "planned", "robots with it", "failed", "closures"),
        (
            (
                row["channel"],
                "-" if row["version"] is None else row["version"],
                output.minute(row.get("time")),
                row.get("author"),
                planned_move_text(row),
                f"{row['robots']['holding']} of {row['robots']['total']}",
                row["robots"]["failed"],
                row["overlays"]["count"],
            )
            for row in rows
        ),
    )


@commands.command("show")
def show(
    environment: options.Environment,
    channel: Channel,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Show one channel: version, plan, rollout and robots.

    Example: `fleetmap channels show farm production`
    """
    with Client(server, token) as client:
        rows = client.get(quote_path("environments", environment, "channels"))
    row = next((row for row in rows if row["channel"] == channel), None)
    if row is None:
        names = [row["channel"] for row in rows]
        detail = f"unknown channel {channel!r}{did_you_mean(channel, names)}: {environment} has {', '.join(names)}"
        raise RequestFailed({"title": "Not found", "detail": detail}, status=404)
    if as_json:
        output.show_json(row)
        return
    robots, rollout = row["robots"], row.get("rollout") or {}
    output.show_members(
        {
            "channel": row["channel"],
            "version": "none" if row["version"] is None else str(row["version"]),
            "since (UTC)": output.minute(row.get("time")),
            "author": row.get("author"),
            "planned": planned_move_text(row),
            "rollout": ", ".join(f"{name} {value}" for name, value in rollout.items() if value is not None),
            "robots": f"{robots['holding']} of {robots['total']} run it, {robots['lagging']} are behind, "
            f"{robots['failed']} failed, {robots['ready']} are ready for the planned move",
            "closures": f"{row['overlays']['count']} in force",
            "root hash": row.get("root"),
        }
    )


@commands.command("cancel")
def cancel(
    environment: options.Environment,
    channel: Channel,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Cancel the planned move of a channel, which stays at its version. Same as `promote --cancel`.

    Example: `fleetmap channels cancel farm production`
    """
    with Client(server, token) as client:
        client.delete(quote_path("environments", environment, "channels", channel, "planned"))
    if as_json:
        output.show_json({"environment": environment, "channel": channel, "planned": None})
    else:
        output.print_result(f"{environment}: cancelled the planned move of {channel}")


def planned_move_text(row: Mapping[str, Any]) -> str:
    """Format the planned move of a channel: ``version 3 at 2026-05-01 08:30``."""
    plan = row.get("planned")
    if not plan:
        return ""
    time = output.minute(plan.get("activate_at"))
    return f"version {plan['version']}{f' at {time}' if time else ''}"
