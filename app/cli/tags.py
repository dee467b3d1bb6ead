"""``fleetmap tag``: name a version, so that it stays."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from app.cli import completion, options, output
from app.cli.client import Client, quote_path


def tag(
    environment: options.Environment,
    version: Annotated[str, typer.Argument(help="Version number or channel.", autocompletion=completion.versions)],
    name: Annotated[str, typer.Argument(help="Name of the tag, such as season-2026.")],
    remove: Annotated[bool, typer.Option("--remove", help="Remove the tag from the version.")] = False,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Tag a version, so that retention keeps it. A tag never moves.

    Example: `fleetmap tag farm production season-2026`
    """
    path = quote_path("environments", environment, "versions", version, "tags", name)
    with Client(server, token) as client:
        result: Any
        if remove:
            client.delete(path)
            result = {"environment": environment, "tag": name, "removed": True}
        else:
            result = client.put(path, {})
    if as_json:
        output.show_json(result)
    elif remove:
        output.print_result(f"{environment}: the tag {name} is removed")
    else:
        output.print_result(f"{environment}: version {result['version']} has the tags {', '.join(result['tags'])}")
