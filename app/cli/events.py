"""``fleetmap events``: list and follow the event log of the server."""

from __future__ import annotations

import json
import sys
import time
from collections import deque
from collections.abc import Mapping
from typing import Annotated, Any

import typer

from app.cli import completion, options, output
from app.cli.client import RETRY_SECONDS, Client
from app.cli.problems import RequestFailed

MAX_PAUSE_SECONDS = 30.0
"""Maximum pause before an interrupted stream is reopened."""


def events(
    environment: Annotated[
        str | None,
        typer.Option(
            "--environment",
            "-e",
            help="Only events of this environment [default: all that your token can access].",
            autocompletion=completion.environments,
        ),
    ] = None,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Wait for further events, until Ctrl-C.")] = False,
    since: Annotated[
        int | None,
        typer.Option(
            "--since",
            min=0,
            metavar="ID",
            help="Only events after this id (first column) [default: the newest events].",
        ),
    ] = None,
    limit: Annotated[
        int, typer.Option("--limit", "-n", min=0, help="Number of newest events to list, without --since.")
    ] = 10,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """List the newest events, or follow them: versions, channel moves, overlays, robot status.

    With --json each event is one line of JSON with `id` and `type`. An interrupted stream is resumed after its last
    event.

    Example: `fleetmap events --follow --environment farm`
    """
    with Client(server, token) as client:
        last = since or 0
        query = {"environment": environment, "follow": "false", "since": last}
        past: deque[dict[str, Any]] = deque(maxlen=None if since is not None else limit)
        for event in client.stream("/events", query):
            past.append(event)
            last = event["id"]
        for event in past:
            _show(event, as_json=as_json)
        if follow:
            _follow(client, environment, last, as_json=as_json)


def _follow(client: Client, environment: str | None, last: int, *, as_json: bool) -> None:
    """Print events until the process is interrupted; resume an interrupted stream after its last event."""
    pause = RETRY_SECONDS
    while True:
        try:
            for event in client.stream("/events", {"environment": environment, "since": last}):
                _show(event, as_json=as_json)
                last, pause = event["id"], RETRY_SECONDS
        except RequestFailed as refused:
            if refused.status is not None and refused.status < 500:
                raise
            output.print_status(f"{refused}; trying again in {pause:g} s", style="yellow")
        time.sleep(pause)
        pause = min(MAX_PAUSE_SECONDS, pause * 2)


def _show(event: Mapping[str, Any], *, as_json: bool) -> None:
    if as_json:
        sys.stdout.write(json.dumps(event, ensure_ascii=False) + "\n")
        sys.stdout.flush()
        return
    data = event["data"]
    standard_names = ("environment", "type", "time", "sequence", "epoch", "root")
    rest = [f"{name} {value}" for name, value in data.items() if name not in standard_names and _is_short(value)]
    moment = str(data.get("time") or "")[:19].replace("T", " ")
    output.print_result(
        f"{event['id']}  {moment}  {data.get('environment', '')}  {event['type']}  {', '.join(rest)}".rstrip()
    )


def _is_short(value: Any) -> bool:
    return value not in (None, "") and not isinstance(value, (dict, list))
