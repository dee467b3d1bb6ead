"""``fleetmap show``: a picture of an environment."""

from __future__ import annotations

from typing import Annotated, Literal

import typer

from app.cli import options, output
from app.cli.client import Client, quote_path
from app.cli.maps import preferred_channel, store


def show(
    environment: options.Environment,
    to: options.Output = None,
    version: options.MapVersion = None,
    layers: Annotated[
        str | None, typer.Option("--layers", help="Comma-separated layers, such as occupancy,topology [default: all].")
    ] = None,
    level: Annotated[
        str | None, typer.Option("--level", help="Level to draw [default: ground, else the lowest with content].")
    ] = None,
    width: Annotated[int, typer.Option("--width", min=64, max=2048, help="Width of the picture in pixels.")] = 640,
    theme: Annotated[
        Literal["light", "dark"], typer.Option("--theme", help="Dark on light, or light on dark.")
    ] = "light",
    server: options.Server = None,
    token: options.Token = None,
) -> None:
    """Write a picture of an environment as PNG, and print its path.

    It shows the whole site in the local frame, +y up. Default for -o: ENVIRONMENT.png in the working directory.

    Example: `fleetmap show orchard -o orchard.png --theme dark`
    """
    params = {"width": str(width), "theme": theme}
    params |= {k: v for k, v in (("layers", layers), ("level", level)) if v is not None}
    with Client(server, token) as client:
        chosen = version or preferred_channel(client, environment)
        path = quote_path("environments", environment, "versions", chosen, "preview.png")
        with client.download(path, params) as got:
            for name in store(got, to or f"{environment}.png"):
                output.print_result(name)
