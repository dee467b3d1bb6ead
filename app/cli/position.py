"""``fleetmap where``: find the environments at a position."""

from __future__ import annotations

from typing import Annotated

import typer

from app.cli import options, output
from app.cli.client import Client

REASONS = {"fence": "GNSS fence", "floor": "mapped floor", "datum": "near the datum"}


def locate(
    position: Annotated[str, typer.Argument(metavar="LAT,LON", help="Position in degrees, latitude first.")],
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """List the environments that contain a position, best match first.

    GNSS fences come first, then the smallest area. The exit status is 1 if there is no such environment.

    Example: `fleetmap where 53.2690,-0.5238`
    """
    with Client(server, token) as client:
        rows = list(client.pages("/environments", {"contains": position}))
    if as_json:
        output.show_json(rows)
    elif rows:
        output.show_table(
            ("environment", "version", "match", "area (m²)", "to datum (m)", "title"),
            (
                (
                    row["name"],
                    row["version"],
                    REASONS.get(row["match"]["by"], row["match"]["by"]),
                    f"{row['match']['area_m2']:.0f}",
                    "" if row["match"]["distance_m"] is None else f"{row['match']['distance_m']:.0f}",
                    row.get("title"),
                )
                for row in rows
            ),
        )
    else:
        output.print_status(f"no environment contains {position}")
    if not rows:
        raise typer.Exit(1)
