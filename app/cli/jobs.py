"""``fleetmap jobs``: list, show and cancel long-running conversions and uploads."""

from __future__ import annotations

from typing import Annotated

import typer

from app.cli import options, output
from app.cli.client import Client, quote_path
from app.cli.groups import Commands

commands = Commands("List, show and cancel jobs, the server's long-running work.")

STATES = ("queued", "running", "done", "failed", "cancelled")

Job = Annotated[str, typer.Argument(metavar="ID", help="Id of the job, as `fleetmap jobs list` shows it.")]


@commands.command("list")
def list_jobs(
    state: Annotated[
        str | None,
        typer.Option(
            "--state",
            help="Only jobs in this state: queued, running, done, failed or cancelled.",
            autocompletion=lambda: list(STATES),
        ),
    ] = None,
    limit: Annotated[int, typer.Option("--limit", "-n", min=1, max=1000, help="Maximum number.")] = 100,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """List the jobs of your token, newest first. An administrator sees all jobs.

    Example: `fleetmap jobs list`
    """
    options.check_choice("--state", state, STATES)
    with Client(server, token) as client:
        rows = client.get("/jobs", {"state": state, "limit": limit})
    if as_json:
        output.show_json(rows)
        return
    output.show_table(
        ("id", "state", "progress", "started (UTC)", "detail"),
        (
            (row["id"], row["state"], f"{row['progress']:.0%}", output.minute(row["created"]), row["detail"])
            for row in rows
        ),
    )


@commands.command("show")
def show(
    job: Job,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Show one job: state, progress, and the location of its result or its problem.

    Example: `fleetmap jobs show 7f3a…`
    """
    with Client(server, token) as client:
        details = client.get(quote_path("jobs", job))
    if as_json:
        output.show_json(details)
        return
    output.show_members(
        {
            "job": details["id"],
            "state": details["state"],
            "progress": f"{details['progress']:.0%}",
            "detail": details["detail"],
            "step": details.get("step"),
            "problem": (details.get("problem") or {}).get("detail"),
            "result": (details.get("result") or {}).get("location"),
            "started (UTC)": output.minute(details["created"]),
            "changed (UTC)": output.minute(details["updated"]),
        }
    )


@commands.command("cancel")
def cancel(
    job: Job,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Cancel a running job, or remove a finished one from the list.

    Example: `fleetmap jobs cancel 7f3a…`
    """
    with Client(server, token) as client:
        running = client.get(quote_path("jobs", job))["state"] in ("queued", "running")
        client.delete(quote_path("jobs", job))
    if as_json:
        output.show_json({"id": job, "cancelled": running, "removed": not running})
    else:
        output.print_result(f"job {job}: {'cancelled' if running else 'removed, it was already finished'}")
