"""Options that several commands share, and how their texts are read."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from app.errors import Invalid
from app.model.frame import Datum


def named_values(help: str) -> Any:
    """The option -O NAME=VALUE, which ``pairs`` reads."""
    return typer.Option("--option", "-O", metavar="NAME=VALUE", help=f"{help}; repeatable.")


Options = Annotated[list[str] | None, named_values("A parameter of the format")]
Server = Annotated[
    str | None,
    typer.Option(
        "--server", "-s", envvar="FLEETMAP_SERVER", help="Address of the server [default: http://127.0.0.1:8000]."
    ),
]
Token = Annotated[
    str | None, typer.Option("--token", "-t", envvar="FLEETMAP_TOKEN", help="Access token.", show_envvar=True)
]
Json = Annotated[bool, typer.Option("--json", help="Print machine-readable JSON.")]
Version = Annotated[str, typer.Option("--version", "-V", help="Version number, channel, or latest.")]
Message = Annotated[str, typer.Option("--message", "-m", help="Why, for the history.")]
Replace = Annotated[bool, typer.Option("--replace", help="Also in place of what a source has told.")]
Format = Annotated[
    str | None, typer.Option("--format", "-f", help="Format of the files [default: found out from the content].")
]
Layer = Annotated[
    str | None,
    typer.Option("--layer", help="What the lines and polygons of a drawing are: objects, topology, location or zones."),
]
Level = Annotated[str, typer.Option("--level", help="The storey that the map belongs to.")]
Grid = Annotated[str | None, typer.Option("--grid", help="Name of the occupancy grid: map, keepout, speed …")]
DatumText = Annotated[
    str | None,
    typer.Option(
        "--datum", metavar="LAT,LON[,HEADING]", help="Where the local origin is: degrees; heading clockwise from north."
    ),
]
Output = Annotated[str | None, typer.Option("--output", "-o", help="A file, a folder, or - for standard output.")]


def pairs(texts: list[str] | None) -> dict[str, str]:
    """``name=value`` texts as a dictionary; Invalid for anything else or a name given twice."""
    out: dict[str, str] = {}
    for text in texts or ():
        name, equals, value = text.partition("=")
        if not equals or not name.strip():
            raise Invalid(f"--option needs NAME=VALUE, got {text!r}")
        if name.strip() in out:
            raise Invalid(f"--option {name.strip()} is given twice")
        out[name.strip()] = value
    return out


def datum(text: str | None) -> Datum | None:
    """``LAT,LON`` or ``LAT,LON,HEADING`` in degrees; Invalid where it is not, or out of range."""
    if text is None:
        return None
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (2, 3):
        raise Invalid(f"--datum needs LAT,LON or LAT,LON,HEADING in degrees, got {text!r}")
    return Datum(numbers[0], numbers[1], heading=numbers[2] if len(numbers) == 3 else 0.0)
