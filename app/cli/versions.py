"""Commands for the history of an environment: versions, diff, promote, revert, derive."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Annotated, Any

import typer

from app.cli import completion, local, options, output
from app.cli.client import Client, quote_path
from app.cli.environments import list_environments
from app.cli.problems import RequestFailed


def versions(
    environment: Annotated[
        str | None,
        typer.Argument(
            help="Name of the environment [default: list all environments].", autocompletion=completion.environments
        ),
    ] = None,
    limit: Annotated[int, typer.Option("--limit", "-n", min=1, help="Maximum number, newest first.")] = 20,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """List the versions of an environment, newest first, with its tags and the channels that point to each.

    A thinned version has no content any more.

    Without a name it lists all environments, as `environment list` does.

    Example: `fleetmap versions farm`
    """
    if environment is None:
        list_environments(limit=limit, server=server, token=token, as_json=as_json)
        return
    with Client(server, token) as client:
        page = {"limit": min(limit, 100)}
        rows = list(client.pages(quote_path("environments", environment, "versions"), page, limit=limit))
        standing = channels_by_version(client, environment)
    if as_json:
        output.show_json(rows)
        return
    output.show_table(
        ("version", "channels, tags", "time (UTC)", "author", "message", "changes"),
        (
            (
                row["version"],
                ", ".join((*standing.get(row["version"], ()), *row.get("tags", ()))),
                output.minute(row.get("time")),
                row.get("author"),
                row.get("message"),
                "thinned" if row.get("thinned") else summary(row.get("changes") or {}),
            )
            for row in rows
        ),
    )


def diff(
    environment: options.Environment,
    old: Annotated[
        str, typer.Argument(metavar="FROM", help="Version number or channel.", autocompletion=completion.versions)
    ],
    new: Annotated[
        str, typer.Argument(metavar="TO", help="Version number or channel.", autocompletion=completion.versions)
    ] = "latest",
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Show the differences of two versions: a summary, then each item (+ added, ~ changed, - deleted).

    Example: `fleetmap diff farm production latest`
    """
    with Client(server, token) as client:
        differences = client.get(quote_path("environments", environment, "diff"), {"from": old, "to": new})
    if as_json:
        output.show_json(differences)
        return
    old, new = str(differences.get("from", old)), str(differences.get("to", new))
    lines = [line for layer, change in (differences.get("layers") or {}).items() for line in _lines(layer, change)]
    if not lines:
        output.print_result(f"versions {old} and {new} have the same content")
        return
    parts = filter(None, (_summary(layer, change) for layer, change in differences["layers"].items()))
    output.print_result(f"versions {old} → {new}: {'; '.join(parts)}")
    for line in lines:
        output.print_result(line)


def _summary(layer: str, change: Mapping[str, Any]) -> str:
    """Summarise a layer's differences: ``topology 2 added, 1 deleted``, ``occupancy map (30 freed)``."""
    if layer in ("datum", "templates"):
        return f"{layer} changed"
    if any(isinstance(change.get(kind), list) for kind in ("added", "changed", "deleted")):
        return f"{layer} {counts({kind: len(change.get(kind) or ()) for kind in ('added', 'changed', 'deleted')})}"
    return f"{layer} {counts(change)}" if any(change.values()) else ""


VersionOption = Annotated[
    str,
    typer.Argument(help="Version number or channel to move the channel to.", autocompletion=completion.versions),
]
ChannelOption = Annotated[
    str, typer.Option("--channel", "-c", help="Channel to move.", autocompletion=completion.channels)
]
At = Annotated[
    str | None,
    typer.Option("--at", metavar="TIME", help="Move at this time (RFC 3339: 2030-01-31T06:00:00Z) [default: now]."),
]
Ready = Annotated[
    float | None,
    typer.Option(
        "--ready",
        metavar="SHARE",
        help="Move when this share of its online robots has fetched the version, such as 0.9.",
    ),
]
Failed = Annotated[
    float | None,
    typer.Option(
        "--failed", metavar="SHARE", help="Cancel or roll back if this share of its robots fails, such as 0.2."
    ),
]
Deadline = Annotated[
    str | None,
    typer.Option(
        "--deadline", metavar="TIME", help="Cancel the move if too few robots are ready by then (requires --ready)."
    ),
]
Window = Annotated[
    float | None,
    typer.Option("--window", metavar="SECONDS", help="Time to watch for failures after the move [default: 600]."),
]


def promote(
    environment: options.Environment,
    version: VersionOption = "latest",
    channel: ChannelOption = "production",
    at: At = None,
    ready: Ready = None,
    failed: Failed = None,
    deadline: Deadline = None,
    window: Window = None,
    cancel: Annotated[bool, typer.Option("--cancel", help="Cancel the planned move of the channel.")] = False,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Move a channel to a version, which its robots then fetch. An older version is a rollback.

    With --ready or --failed the move is a rollout in two stages: robots fetch the version first, then the channel moves
    and failures are watched.

    Example: `fleetmap promote farm 12 --ready 0.9 --failed 0.2`
    """
    stages = {"ready": ready, "failed": failed, "deadline": deadline, "window": window}
    rollout = {name: value for name, value in stages.items() if value is not None}
    with Client(server, token) as client:
        path = quote_path("environments", environment, "channels", channel)
        if cancel:
            if at is not None or rollout:
                raise typer.BadParameter(
                    "--cancel cannot be combined with --at, --ready, --failed, --deadline or --window"
                )
            client.delete(f"{path}/planned")
            channels = client.get(quote_path("environments", environment, "channels"), {"robots": "false"})
            moved: Any = next((c for c in channels if c["channel"] == channel), {"channel": channel, "version": None})
        else:
            number = resolve(client, environment, version)
            moved = client.put(path, {"version": number, "activate_at": at, "rollout": rollout or None})
    if as_json:
        output.show_json(moved)
    elif cancel:
        output.print_result(f"{environment}: cancelled the planned move of {channel}")
    elif moved["planned"] is None:
        watched = (moved["rollout"] or {}).get("state") == "watching"
        more = ", and is rolled back if too many robots fail" if watched else ""
        output.print_result(f"{environment}: {channel} points to version {number}{more}")
    else:
        when = [f"{ready:.4g} of its online robots have fetched it"] if ready is not None else []
        when += [f"it is {at}"] if at else []
        output.print_result(f"{environment}: {channel} will point to version {number} when {' and '.join(when)}")


def revert(
    environment: options.Environment,
    version: Annotated[
        str,
        typer.Argument(
            help="Version number or channel with the content to return to.", autocompletion=completion.versions
        ),
    ],
    message: options.Message = "",
    dry_run: options.DryRun = False,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Create a new version with the content of an old one. Nothing is deleted.

    Example: `fleetmap revert farm 11 -m 'the survey was wrong'`
    """
    with Client(server, token) as client:
        number = resolve(client, environment, version)
        body = {"revert_to": number, "message": message or f"revert to version {number}", "dry_run": dry_run}
        result = client.post(quote_path("environments", environment, "versions"), body, repeat=True)
    if dry_run or as_json:
        show_commit(environment, result, as_json=as_json)
    else:
        output.print_result(f"{environment}: version {result['version']} has the content of version {number}")


def resolve(client: Client, environment: str, version: str) -> int:
    """Return the version number of a number or channel. Raises RequestFailed for an unknown channel."""
    if version.isascii() and version.isdigit():
        return int(version)
    number: int = client.get(quote_path("environments", environment, "versions", version))["version"]
    return number


def channels_by_version(client: Client, environment: str) -> dict[int, list[str]]:
    """Return version -> channels that point to it."""
    channels: dict[int, list[str]] = {}
    for row in channel_rows(client, environment):
        channels.setdefault(row["version"], []).append(str(row["channel"]))
    return channels


def channel_rows(client: Client, environment: str) -> list[dict[str, Any]]:
    """Get all channels of an environment."""
    rows: list[dict[str, Any]] = client.get(quote_path("environments", environment, "channels"))
    return rows


def summary(changes: Mapping[str, Any]) -> str:
    """Summarise the changes of a version in one line."""
    return "; ".join(change_line(subject, change) for subject, change in changes.items())


def change_line(subject: str, change: Any) -> str:
    """Format a change: ``topology: 2 added``, ``datum: none → 53.25, -0.5``."""
    if subject == "datum" and isinstance(change, Mapping):
        return f"datum: {output.datum(change.get('from'))} → {output.datum(change.get('to'))}"
    if subject == "templates" and isinstance(change, Mapping):
        return f"templates: {', '.join(_template_changes(change))}"
    if subject == "renewed" and isinstance(change, list):
        parts = ", ".join(f"{part['layer']} {part['level']}/{part['name']}" for part in change)
        return f"derived again with the same content: {parts}"
    return f"{subject}: {counts(change)}"


def counts(change: Any) -> str:
    """Format the counts of a change: ``2 added, 1 deleted``, without bounds and zeros.

    ``file header`` stands for the collection document, the data of a file besides its items.
    """
    if not isinstance(change, Mapping):
        return str(change)
    parts = []
    for name, value in change.items():
        if isinstance(value, Mapping):
            parts.append(f"{name} ({counts(value)})")
        elif isinstance(value, float):
            parts.append(f"{name} {value:.7g}")
        elif value and not isinstance(value, list):
            flag = "file header" if name == "document" else name
            parts.append(flag if value is True else f"{value} {name}")
    return ", ".join(parts) or "unchanged"


def _lines(layer: str, change: Mapping[str, Any]) -> list[str]:
    """Return the differences of a layer, one per line: features by id, grids by name with cell counts."""
    if layer == "datum":
        return [f"~ {change_line(layer, change)}"]
    if layer == "templates":
        return [f"~ templates {line}" for line in _template_changes(change)]
    if not any(isinstance(change.get(kind), list) for kind in ("added", "changed", "deleted")):
        return [f"~ {layer} {name}: {counts(grid)}" for name, grid in change.items() if grid]
    lines = [f"+ {layer} {item}" for item in change.get("added", [])]
    for item in change.get("changed", []):
        fields = ", ".join(item.get("fields") or ())
        lines.append(f"~ {layer} {item['id']}{f': {fields}' if fields else ''}")
    return lines + [f"- {layer} {item}" for item in change.get("deleted", [])]


def _template_changes(change: Mapping[str, Any]) -> list[str]:
    """Return the differing template values as ``tmap2 action: none → NavigateToPose``."""
    out = []
    for name, format_changes in change.items():
        if name == "set":
            out.append(f"set: {format_changes.get('from')} → {format_changes.get('to')}")
            continue
        for parameter, values in format_changes.items():
            old, new = ("none" if values.get(end) is None else values[end] for end in ("from", "to"))
            out.append(f"{name} {parameter}: {old} → {new}")
    return out


def _derivations(server: str | None, token: str | None) -> list[dict[str, Any]]:
    """List the derivations of the server; without one, or if it is unreachable, those of this installation."""
    named = server or os.environ.get("FLEETMAP_SERVER")
    why = "no server set"
    if named:
        try:
            with Client(server, token) as client:
                rows: list[dict[str, Any]] = client.get("/derivations")
                return rows
        except RequestFailed as refused:
            if refused.status is not None:
                raise
            why = str(refused)
    local.require_server_python("derive")
    from app.catalogue import describe_derivations

    output.print_status(
        f"{why}: listing local derivations; a server with an imagery provider also has location_to_imagery"
    )
    return describe_derivations()


def derive(
    environment: Annotated[
        str | None,
        typer.Argument(
            help="Name of the environment [default: list derivations].", autocompletion=completion.environments
        ),
    ] = None,
    method: Annotated[
        str | None,
        typer.Argument(help="Derivation, such as occupancy_to_topology.", autocompletion=completion.derivations),
    ] = None,
    option: Annotated[list[str] | None, options.named_values_option("Parameter of the derivation")] = None,
    message: options.Message = "",
    replace: options.Replace = False,
    dry_run: options.DryRun = False,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Derive a layer from other layers and store it as a version. Without arguments, list the derivations.

    The list comes from the server set by --server or FLEETMAP_SERVER, otherwise from this installation.

    Example: `fleetmap derive farm occupancy_to_topology -O robot_radius=0.3`
    """
    if environment is None:
        derivations = _derivations(server, token)
        if as_json:
            output.show_json(derivations)
            return
        output.show_table(
            ("derivation", "description", "from", "to", "parameters"),
            [
                (d["id"], d["title"], ", ".join(d["needs"]), d["gives"], ", ".join(p["name"] for p in d["parameters"]))
                for d in derivations
            ],
        )
        return
    if method is None:
        raise typer.BadParameter("missing derivation: list them with `fleetmap derive`")
    body = {"method": method, "parameters": options.pairs(option), "message": message, "replace": replace}
    body["dry_run"] = dry_run
    with Client(server, token) as client:
        path = quote_path("environments", environment, "derivations")
        result = client.post_work(path, body, f"deriving by {method}")
    show_commit(environment, result, as_json=as_json)


def dry_run_line(environment: str, body: Mapping[str, Any]) -> str:
    """Summarise a dry run: whether it would create a version."""
    return f"{environment}: this would {'create a version' if body.get('changes') else 'change nothing'}"


def show_commit(environment: str, result: Mapping[str, Any], *, as_json: bool) -> None:
    """Print the version of a derivation or a generator, which may be unchanged; or what a dry run would change."""
    if as_json:
        output.show_json(result)
        return
    if result["version"] is None:
        output.print_result(dry_run_line(environment, result))
        for subject, change in result["changes"].items():
            output.print_result(f"  {change_line(subject, change)}")
    else:
        output.print_result(
            f"{environment}: version {result['version']}: {summary(result.get('changes') or {}) or 'no changes'}"
        )
    output.show_warnings(result.get("warnings") or ())
