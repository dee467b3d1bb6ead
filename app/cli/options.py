"""Shared options of commands, and parsing of their values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import typer

from app.cli import completion
from app.errors import Invalid
from app.model.frame import Datum
from app.model.names import did_you_mean

CONNECTION = "Server and output"
"""Panel of the help with the options that most commands share."""


def named_values_option(help: str) -> Any:
    """Declare the option -O NAME=VALUE, parsed by ``pairs``."""
    return typer.Option("--option", "-O", metavar="NAME=VALUE", help=f"{help}; repeatable.")


Options = Annotated[list[str] | None, named_values_option("Parameter of the format, see `fleetmap formats FORMAT`")]
Server = Annotated[
    str | None,
    typer.Option(
        "--server",
        "-s",
        envvar="FLEETMAP_SERVER",
        metavar="URL",
        help="Address of the server [default: http://127.0.0.1:8000].",
        rich_help_panel=CONNECTION,
    ),
]
Token = Annotated[
    str | None,
    typer.Option(
        "--token",
        "-t",
        envvar="FLEETMAP_TOKEN",
        metavar="TEXT",
        help="Access token.",
        rich_help_panel=CONNECTION,
    ),
]
Json = Annotated[
    bool, typer.Option("--json", help="Print machine-readable JSON instead of text.", rich_help_panel=CONNECTION)
]
Environment = Annotated[
    str, typer.Argument(help="Name of the environment.", autocompletion=completion.environments, show_default=False)
]
MapFormat = Annotated[
    str,
    typer.Argument(help="Format of the map, see `fleetmap formats`.", autocompletion=completion.formats),
]
Version = Annotated[
    str,
    typer.Option("--version", "-V", help="Version number, channel, or latest.", autocompletion=completion.versions),
]
MapVersion = Annotated[
    str | None,
    typer.Option(
        "--version",
        "-V",
        help="Version number or channel [default: production if it exists, else latest].",
        autocompletion=completion.versions,
    ),
]
Derive = Annotated[bool, typer.Option("--derive/--no-derive", help="Derive missing layers that the map needs.")]
Message = Annotated[
    str, typer.Option("--message", "-m", help="Reason for the change, shown in the history.", show_default=False)
]
Replace = Annotated[bool, typer.Option("--replace", help="Also replace uploaded or edited content.")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Show what would change; store nothing.")]
Format = Annotated[
    str | None,
    typer.Option(
        "--format",
        "-f",
        help="Format of the files [default: detected from their content].",
        autocompletion=completion.formats,
    ),
]
Layer = Annotated[
    str | None,
    typer.Option(
        "--layer",
        help="Meaning of the lines and polygons in a drawing: objects, topology, location or zones.",
        autocompletion=completion.drawn_layers,
    ),
]
Level = Annotated[str, typer.Option("--level", help="Level of the map.", autocompletion=completion.levels)]
Grid = Annotated[
    str | None,
    typer.Option("--grid", help="Name of the occupancy grid: map, keepout, speed, …", autocompletion=completion.grids),
]
DatumText = Annotated[
    str | None,
    typer.Option(
        "--datum",
        metavar="LAT,LON[,HEADING]",
        help="Position of the local origin in degrees; heading clockwise from north.",
    ),
]
Output = Annotated[str | None, typer.Option("--output", "-o", help="File, folder, or - for standard output.")]
Create = Annotated[
    bool | None,
    typer.Option(
        "--create/--no-create",
        help="Create a missing environment, or fail "
        "[default: create, unless the name looks like a misspelling of an existing one].",
        show_default=False,
    ),
]


def check_choice(option: str, value: str | None, choices: Sequence[str]) -> None:
    """Check that a value is one of the choices or None. Raises BadParameter with the most similar one."""
    if value is not None and value not in choices:
        raise typer.BadParameter(f"{option} must be one of {', '.join(choices)}{did_you_mean(value, choices)}")


def pairs(texts: list[str] | None) -> dict[str, str]:
    """Parse ``name=value`` texts. Raises Invalid for other texts and duplicate names."""
    out: dict[str, str] = {}
    for text in texts or ():
        name, equals, value = text.partition("=")
        if not equals or not name.strip():
            raise Invalid(f"--option must be NAME=VALUE, got {text[:80]!r}")
        if name.strip() in out:
            raise Invalid(f"duplicate --option {name.strip()}")
        out[name.strip()] = value
    return out


def datum(text: str | None) -> Datum | None:
    """Parse ``LAT,LON`` or ``LAT,LON,HEADING`` in degrees. Raises Invalid."""
    if text is None:
        return None
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (2, 3):
        raise Invalid(f"--datum must be LAT,LON or LAT,LON,HEADING in degrees, got {text[:80]!r}")
    return Datum(numbers[0], numbers[1], heading=numbers[2] if len(numbers) == 3 else 0.0)
