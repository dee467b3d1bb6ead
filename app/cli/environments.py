"""``fleetmap environment``: create, list, describe, rename and delete environments."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from app.cli import completion, options, output
from app.cli.client import Client, quote_path
from app.cli.folder import check_name
from app.cli.groups import Commands

commands = Commands("List, create, rename and delete environments.")

Deleted = Annotated[str, typer.Argument(help="Name of a deleted environment.")]
Title = Annotated[str | None, typer.Option("--title", help="Title to display.")]
Description = Annotated[str | None, typer.Option("--description", help="Description to display.")]
Tags = Annotated[list[str] | None, typer.Option("--tag", help="Tag; repeatable.")]
Yes = Annotated[bool, typer.Option("--yes", "-y", help="Do not ask for confirmation.")]


@commands.command("list")
def list_environments(
    query: Annotated[
        str | None,
        typer.Option("--query", "-q", help="Only environments with this text in name, title, description or tags."),
    ] = None,
    deleted: Annotated[
        bool, typer.Option("--deleted", help="Only deleted environments, which can be restored.")
    ] = False,
    limit: Annotated[int, typer.Option("--limit", "-n", min=1, help="Maximum number.")] = 1000,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """List the environments that your token can access, sorted by name.

    Example: `fleetmap environment list --query orchard`
    """
    parameters = {"limit": min(limit, 100), "q": query, "deleted": "true" if deleted else None}
    with Client(server, token) as client:
        rows = list(client.pages("/environments", parameters, limit=limit))
    if as_json:
        output.show_json(rows)
        return
    output.show_table(
        ("environment", "version", "changed (UTC)", "title"),
        ((row["name"], row["version"], output.minute(row.get("updated")), row.get("title")) for row in rows),
    )


@commands.command("show")
def show(
    environment: options.Environment,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Show an environment: datum, bounds, newest version and channels.

    Example: `fleetmap environment show farm`
    """
    with Client(server, token) as client:
        details = client.get(quote_path("environments", environment))
        channels = client.get(quote_path("environments", environment, "channels"), {"robots": "false"})
    if as_json:
        output.show_json(details)
        return
    west_south_east_north = details.get("bounds")
    output.show_members(
        {
            "environment": details["name"],
            "title": details.get("title"),
            "description": details.get("description"),
            "tags": ", ".join(details.get("tags") or ()),
            "newest version": str(details["version"]),
            "channels": ", ".join(f"{c['channel']} → {c['version']}" for c in channels if c["version"] is not None),
            "datum": output.datum(details.get("datum")),
            "bounds (west, south, east, north)": ", ".join(f"{n:.6f}" for n in west_south_east_north or ()),
            "created (UTC)": output.minute(details.get("created")),
            "changed (UTC)": output.minute(details.get("updated")),
            "root hash": details.get("root"),
        }
    )


@commands.command("create")
def create(
    environment: Annotated[str, typer.Argument(help="Name: a-z, 0-9, - and _.", show_default=False)],
    datum: options.DatumText = None,
    title: Title = None,
    description: Description = None,
    tag: Tags = None,
    clone: Annotated[
        str | None,
        typer.Option(
            "--clone",
            metavar="ENVIRONMENT[@VERSION]",
            help="Copy the content of this environment, or of one of its versions or channels.",
            autocompletion=completion.environments,
        ),
    ] = None,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Create an environment (as administrator). `import` and `generate` create missing ones as well.

    Example: `fleetmap environment create farm --datum 53.2686,-0.5245 --title 'North farm'`
    """
    check_name(environment)
    new_datum = options.datum(datum)
    body: dict[str, Any] = {"name": environment, "title": title, "description": description, "tags": tag}
    body["datum"] = new_datum.as_dict() if new_datum else None
    if clone is not None:
        name, _, version = clone.partition("@")
        body["clone"] = {"environment": name, "version": version or "latest"}
    with Client(server, token) as client:
        result = client.post("/environments", body)
    _show_result(result, f"{result['name']}: created, version {result['version']}", as_json=as_json)


@commands.command("rename")
def rename(
    environment: options.Environment,
    name: Annotated[str | None, typer.Argument(help="New name [default: keep the name].")] = None,
    title: Title = None,
    description: Description = None,
    tag: Tags = None,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Change an environment's name, title, description or tags (as administrator).

    Robots and links that use the old name no longer find the environment.

    Example: `fleetmap environment rename farm north-farm --title 'North farm'`
    """
    body = {"name": name, "title": title, "description": description, "tags": tag}
    if all(value is None for value in body.values()):
        raise typer.BadParameter("nothing to change: use a new name, --title, --description or --tag")
    if name is not None:
        check_name(name)
    with Client(server, token) as client:
        changed = client.patch(quote_path("environments", environment), body)
    change = f"renamed to {changed['name']}" if name not in (None, environment) else "changed"
    _show_result(changed, f"{environment}: {change}", as_json=as_json)


@commands.command("datum")
def set_datum(
    environment: options.Environment,
    datum: Annotated[
        str | None,
        typer.Argument(
            metavar="[LAT,LON[,HEADING]]",
            help="Position of the local origin in degrees, and heading clockwise from north [default: show it].",
        ),
    ] = None,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Show or set the datum, the WGS 84 position of the local origin. A new datum creates a version.

    Content in metres keeps its local coordinates; content in degrees keeps its latitude and longitude.

    Example: `fleetmap environment datum farm 53.2686,-0.5245,12.5`
    """
    new_datum = options.datum(datum)
    with Client(server, token) as client:
        place = quote_path("environments", environment)
        result = client.get(place) if new_datum is None else client.patch(place, {"datum": new_datum.as_dict()})
    if as_json:
        output.show_json(result["datum"] if new_datum is None else result)
        return
    version = "" if new_datum is None else f", version {result['version']}"
    output.print_result(f"{environment}: datum {output.datum(result.get('datum'))}{version}")
    output.show_warnings(result.get("warnings") or ())


@commands.command("delete")
def delete(
    environment: options.Environment,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Delete an environment (as administrator). It can be restored until it is purged.

    Example: `fleetmap environment delete farm`
    """
    with Client(server, token) as client:
        client.delete(quote_path("environments", environment))
    if as_json:
        output.show_json({"environment": environment, "deleted": True})
    else:
        output.print_result(f"{environment}: deleted; restore it with `fleetmap environment restore {environment}`")


@commands.command("restore")
def restore(
    environment: Deleted,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Restore a deleted environment with all its versions and channels (as administrator).

    Example: `fleetmap environment restore farm`
    """
    with Client(server, token) as client:
        result = client.post(quote_path("environments", environment, "restore"), {})
    _show_result(result, f"{environment}: restored, version {result['version']}", as_json=as_json)


@commands.command("purge")
def purge(
    environment: Deleted,
    yes: Yes = False,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Remove a deleted environment permanently, with all its versions (as administrator).

    Frees its name for a new environment. Asks for confirmation unless --yes is set.

    Example: `fleetmap environment purge farm --yes`
    """
    if not yes:
        typer.confirm(f"Remove {environment} and all its versions permanently?", abort=True, err=True)
    with Client(server, token) as client:
        client.post(quote_path("environments", environment, "purge"), {})
    if as_json:
        output.show_json({"environment": environment, "purged": True})
    else:
        output.print_result(f"{environment}: removed permanently")


def _show_result(result: Any, line: str, *, as_json: bool) -> None:
    output.show_json(result) if as_json else output.print_result(line)
