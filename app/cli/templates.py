"""What formats ask for and no layer has: the named sets, and what an environment says of it."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from typing import Annotated, Any

import typer

from app.cli import completion, local, options, output
from app.cli.client import Client, path_of
from app.cli.history import change_line


def template(
    environment: Annotated[
        str | None,
        typer.Argument(
            help="Name of the environment [default: list the template sets].", autocompletion=completion.environments
        ),
    ] = None,
    format: Annotated[
        str | None, typer.Argument(help="Only for this format [default: all].", autocompletion=completion.formats)
    ] = None,
    chosen: Annotated[
        str | None,
        typer.Option("--set", metavar="NAME", help="Use this template set, for the environment or the format."),
    ] = None,
    option: Annotated[list[str] | None, options.named_values("A value for a parameter of the format")] = None,
    unset: Annotated[
        bool, typer.Option("--unset", help="Return to the defaults; with -O NAME only for this parameter.")
    ] = False,
    message: options.Message = "",
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Show what would change; store nothing.")] = False,
    version: options.Version = "latest",
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Show or set the values that are filled in where a format needs more than the layers contain.

    Each value comes from the environment, from its template set, or from the default of the format. A change makes
    a version, since robots get other maps.

    Example: `fleetmap template farm tmap2 -O xy_goal_tolerance=0.4`
    """
    if environment is None:
        _sets(as_json=as_json)
        return
    if option and format is None:
        raise typer.BadParameter("--option needs the format whose parameter it is")
    if unset and chosen is not None:
        raise typer.BadParameter("--unset and --set exclude each other")
    place = path_of("environments", environment, "templates", *([format] if format else []))
    with Client(server, token) as client:
        if not (chosen or option or unset):
            told = client.get(place, {"version": version})
            output.show_json(told) if as_json else _show(told)
            return
        known = client.get(place)
        common = {"message": message, "dry_run": dry_run}
        key = {"Idempotency-Key": secrets.token_hex(16)}
        if unset and not option:
            made = client.delete(place, {"message": message, "dry_run": str(dry_run).lower()}, key)
        elif format is None:
            made = client.put(place, {"set": chosen, **common}, key)
        else:
            body = _said(known, chosen, option or [], unset=unset)
            made = client.put(place, {**body, **common}, {**key, "If-Match": f'"{known["version"]}"'})
    if as_json:
        output.show_json(made)
    else:
        _show_made(environment, made, before=known["version"])


def _said(known: Mapping[str, Any], chosen: str | None, texts: list[str], *, unset: bool) -> dict[str, Any]:
    """What is said of a format from now on: as before, with these options or without them."""
    values = dict(known.get("values") or {})
    if unset:
        for text in texts:
            values.pop(text.partition("=")[0].strip(), None)
    else:
        values |= options.pairs(texts)
    return {"set": chosen or known.get("set"), "values": values}


def _show_made(environment: str, made: Mapping[str, Any], *, before: int) -> None:
    changes = made.get("changes") or {}
    if made["version"] is None:
        output.show(f"{environment}: {'this would make a version' if changes else 'nothing would change'}")
    elif made["version"] == before:
        output.show(f"{environment}: nothing changed, version {before} stays")
        return  # its changes are those that made it
    else:
        output.show(f"{environment}: version {made['version']}")
    if "templates" in changes:
        output.show(f"  {change_line('templates', changes['templates'])}")


def _sets(*, as_json: bool) -> None:
    local.require_server_python("template")
    from app import templates

    known = [one.as_dict(name) for name, one in templates.SETS.items()]
    if as_json:
        output.show_json(known)
        return
    rows = ((s["name"], s["title"], "; ".join(f"{f}: {_values(v)}" for f, v in s["formats"].items())) for s in known)
    output.show_table(("set", "what it is for", "values"), rows)


def _show(told: Mapping[str, Any]) -> None:
    lines = told.get("formats")
    if lines is None:
        shown = [(name, one["value"], one["from"]) for name, one in told["effective"].items()]
        output.show_table(("parameter", "value", "from"), shown, title=_title(told))
        return
    rows = [
        (line["format"], name, one["value"], one["from"])
        for line in lines
        for name, one in line["effective"].items()
        if one["from"] != "default"
    ]
    output.show(f"{told['environment']}, version {told['version']}: the set {told['set']}")
    if rows:
        output.show_table(("format", "parameter", "value", "from"), rows)


def _title(told: Mapping[str, Any]) -> str:
    own = f", the set {told['set']}" if told.get("set") else ""
    return f"{told['environment']}, version {told['version']}: {told['format']}{own}"


def _values(values: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {value}" for name, value in values.items())
