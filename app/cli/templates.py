"""``fleetmap template``: show and set the values that formats need and layers do not contain."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from typing import Annotated, Any

import typer

from app.cli import completion, local, options, output
from app.cli.client import Client, quote_path
from app.cli.versions import change_line


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
        typer.Option("--set", metavar="NAME", help="Template set to use, for the environment or the format."),
    ] = None,
    option: Annotated[
        list[str] | None, options.named_values_option("Value of a template parameter of the format")
    ] = None,
    unset: Annotated[
        bool, typer.Option("--unset", help="Reset to the defaults; with -O NAME only this parameter.")
    ] = False,
    message: options.Message = "",
    dry_run: options.DryRun = False,
    version: options.Version = "latest",
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Show or set template values, which are filled in if a format needs more than the layers contain.

    Each value comes from the environment, from its template set, or from the default of the format. A change creates a
    version, since it changes maps.

    Example: `fleetmap template farm tmap2 -O xy_goal_tolerance=0.4`
    """
    if environment is None:
        _sets(as_json=as_json)
        return
    if option and format is None:
        raise typer.BadParameter("--option requires a format, to which the parameter belongs")
    if unset and chosen is not None:
        raise typer.BadParameter("--unset and --set cannot be combined")
    place = quote_path("environments", environment, "templates", *([format] if format else []))
    with Client(server, token) as client:
        if not (chosen or option or unset):
            details = client.get(place, {"version": version})
            output.show_json(details) if as_json else _show(details)
            return
        stored_template = client.get(place)
        common = {"message": message, "dry_run": dry_run}
        key = {"Idempotency-Key": secrets.token_hex(16)}
        if unset and not option:
            result = client.delete(place, {"message": message, "dry_run": str(dry_run).lower()}, key)
        elif format is None:
            result = client.put(place, {"set": chosen, **common}, key)
        else:
            body = _merged_values(stored_template, chosen, option or [], unset=unset)
            result = client.put(place, {**body, **common}, {**key, "If-Match": f'"{stored_template["version"]}"'})
    if as_json:
        output.show_json(result)
    else:
        _print_commit(environment, result, before=stored_template["version"])


def _merged_values(
    stored_template: Mapping[str, Any], chosen: str | None, texts: list[str], *, unset: bool
) -> dict[str, Any]:
    """Return the new template of a format: the stored one with these options set or removed."""
    values = dict(stored_template.get("values") or {})
    if unset:
        for text in texts:
            values.pop(text.partition("=")[0].strip(), None)
    else:
        values |= options.pairs(texts)
    return {"set": chosen or stored_template.get("set"), "values": values}


def _print_commit(environment: str, result: Mapping[str, Any], *, before: int) -> None:
    changes = result.get("changes") or {}
    if result["version"] is None:
        output.print_result(f"{environment}: {'this would create a version' if changes else 'no changes'}")
    elif result["version"] == before:
        output.print_result(f"{environment}: no changes, still version {before}")
        return  # the listed changes are those of the existing version
    else:
        output.print_result(f"{environment}: version {result['version']}")
    if "templates" in changes:
        output.print_result(f"  {change_line('templates', changes['templates'])}")


def _sets(*, as_json: bool) -> None:
    local.require_server_python("template")
    from app import templates

    template_sets = [one.as_dict(name) for name, one in templates.SETS.items()]
    if as_json:
        output.show_json(template_sets)
        return
    rows = (
        (s["name"], s["title"], "; ".join(f"{f}: {_values(v)}" for f, v in s["formats"].items())) for s in template_sets
    )
    output.show_table(("set", "purpose", "values"), rows)


def _show(details: Mapping[str, Any]) -> None:
    lines = details.get("formats")
    if lines is None:
        shown = [(name, one["value"], one["from"]) for name, one in details["effective"].items()]
        output.show_table(("parameter", "value", "from"), shown, title=_title(details))
        return
    rows = [
        (line["format"], name, one["value"], one["from"])
        for line in lines
        for name, one in line["effective"].items()
        if one["from"] != "default"
    ]
    output.print_result(f"{details['environment']}, version {details['version']}: template set {details['set']}")
    if rows:
        output.show_table(("format", "parameter", "value", "from"), rows)


def _title(details: Mapping[str, Any]) -> str:
    set_note = f", template set {details['set']}" if details.get("set") else ""
    return f"{details['environment']}, version {details['version']}: {details['format']}{set_note}"


def _values(values: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {value}" for name, value in values.items())
