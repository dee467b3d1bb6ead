"""``fleetmap overlays``: list, report and decide on temporary obstructions."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from app.cli import completion, options, output
from app.cli.client import Client, quote_path
from app.cli.groups import Commands
from app.errors import Invalid
from app.model.names import did_you_mean

commands = Commands("List, report and decide on temporary obstructions (overlays, closures).")

STATES = ("pending", "accepted", "rejected", "expired", "ended")

Overlay = Annotated[str, typer.Argument(metavar="ID", help="Id of the overlay, see `fleetmap overlays list`.")]


@commands.command("list")
def list_overlays(
    environment: options.Environment,
    state: Annotated[
        str | None,
        typer.Option(
            "--state",
            help="Only in this state: pending, accepted (in force), rejected, expired or ended [default: all].",
            autocompletion=lambda: list(STATES),
        ),
    ] = None,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """List reported obstructions, oldest first.

    Example: `fleetmap overlays list farm --state pending`
    """
    options.check_choice("--state", state, STATES)
    with Client(server, token) as client:
        rows = client.get(quote_path("environments", environment, "overlays"), {"state": state})
    if as_json:
        output.show_json(rows)
        return
    output.show_table(
        ("id", "state", "what", "level", "until (UTC)", "reporter", "detail"),
        (
            (
                row["id"],
                row["state"],
                describe_obstruction(row),
                row["level"],
                output.minute(row["expires"]),
                row["reporter"],
                row.get("detail"),
            )
            for row in rows
        ),
    )


@commands.command("show")
def show(
    environment: options.Environment,
    overlay: Overlay,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Show one overlay.

    Example: `fleetmap overlays show farm 4f1c…`
    """
    with Client(server, token) as client:
        rows = client.get(quote_path("environments", environment, "overlays"))
    row = next((row for row in rows if row["id"] == overlay), None)
    if row is None:
        near = did_you_mean(overlay, [row["id"] for row in rows])
        raise Invalid(f"no overlay {overlay[:80]!r} in {environment} during the last 30 days{near}")
    if as_json:
        output.show_json(row)
        return
    polygon = row.get("polygon")
    output.show_members(
        {
            "overlay": row["id"],
            "state": row["state"],
            "what": describe_obstruction(row),
            "polygon": f"{json.dumps(polygon)} ({row['crs']})" if polygon else None,
            "level": row["level"],
            "detail": row.get("detail"),
            "reporter": row["reporter"],
            "reported (UTC)": output.minute(row["created"]),
            "until (UTC)": output.minute(row["expires"]),
            "decided by": row.get("decided_by"),
            "decided (UTC)": output.minute(row.get("decided")),
            "kept in version": row.get("version"),
        }
    )


@commands.command("create")
def create(
    environment: options.Environment,
    edge: Annotated[
        str | None, typer.Option("--edge", help="Id of the blocked edge (one direction of a lane).")
    ] = None,
    polygon: Annotated[
        Path | None, typer.Option("--polygon", metavar="FILE", help="GeoJSON file with the blocked polygon.")
    ] = None,
    crs: Annotated[
        str | None,
        typer.Option(
            "--crs", help="Coordinates of the polygon: wgs84 or local [default: wgs84 if the environment has a datum]."
        ),
    ] = None,
    level: Annotated[
        str | None,
        typer.Option("--level", help="Level of the polygon [default: ground].", autocompletion=completion.levels),
    ] = None,
    seconds: Annotated[
        float | None, typer.Option("--seconds", min=1, help="Duration in seconds [default: 3600].")
    ] = None,
    until: Annotated[
        str | None, typer.Option("--until", metavar="TIME", help="End (RFC 3339), instead of --seconds.")
    ] = None,
    detail: Annotated[str | None, typer.Option("--detail", "-m", help="Description of the obstruction.")] = None,
    accept: Annotated[
        bool, typer.Option("--accept", help="Accept it at once (as editor), without a separate decision.")
    ] = False,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Report a temporarily blocked edge or area.

    Example: `fleetmap overlays create farm --edge A_B --seconds 1800 --detail 'fallen tree' --accept`
    """
    if (edge is None) == (polygon is None):
        raise typer.BadParameter("use either --edge or --polygon")
    if edge is not None and (crs is not None or level is not None):
        raise typer.BadParameter("--crs and --level require --polygon")
    body = {"kind": "blocked", "edge": edge, "crs": crs, "level": level, "ttl_seconds": seconds, "expires": until}
    body |= {"detail": detail, "polygon": _polygon(polygon) if polygon else None}
    body["state"] = "accepted" if accept else None
    with Client(server, token) as client:
        result = client.post(quote_path("environments", environment, "overlays"), body)
    _print_decision(environment, result, as_json=as_json)


def _decision(name: str, help: str) -> Callable[..., None]:
    """Create the command ``name``, which posts to the sub-path ``name`` of an overlay."""

    def decide(
        environment: options.Environment,
        overlay: Overlay,
        server: options.Server = None,
        token: options.Token = None,
        as_json: options.Json = False,
    ) -> None:
        with Client(server, token) as client:
            result = client.post(quote_path("environments", environment, "overlays", overlay, name), {})
        _print_decision(environment, result, as_json=as_json)

    commands.command(name, help=f"{help}\n\nExample: `fleetmap overlays {name} farm 4f1c…`")(decide)
    return decide


accept = _decision("accept", "Accept a pending overlay: it is in force on every channel until its end (as editor).")
reject = _decision("reject", "Reject a pending overlay (as editor).")
end = _decision("end", "End an accepted overlay now: robots may use the edge or area again (as editor).")
keep = _decision(
    "keep", "Make an accepted overlay permanent in a new version (as editor). Promote that version afterwards."
)


def describe_obstruction(row: Mapping[str, Any]) -> str:
    """Format the blocked item of an overlay: ``edge A_B`` or ``area``."""
    return f"edge {row['edge']}" if row.get("edge") else "area"


def _print_decision(environment: str, overlay: Mapping[str, Any], *, as_json: bool) -> None:
    if as_json:
        output.show_json(overlay)
        return
    permanence = f"; permanently blocked in version {overlay['version']}" if overlay.get("version") is not None else ""
    until = f" until {output.minute(overlay['expires'])} UTC" if overlay["state"] in ("pending", "accepted") else ""
    state = {"pending": "waits for a decision", "accepted": "is in force", "ended": "has ended"}
    became = state.get(overlay["state"], f"is {overlay['state']}")
    output.print_result(
        f"{environment}: overlay {overlay['id']} ({describe_obstruction(overlay)}) {became}{until}{permanence}"
    )


def _polygon(path: Path) -> Any:
    """Read a GeoJSON file with one polygon: a geometry, a feature, or a collection of one. Raises Invalid."""
    try:
        geometry = json.loads(path.read_bytes())
    except ValueError as error:
        raise Invalid(f"{path} is not JSON: {error}") from error
    features = geometry.get("features") if isinstance(geometry, dict) else None
    if isinstance(features, list):
        if len(features) != 1:
            raise Invalid(f"{path} has {len(features)} features: use a file with one polygon")
        geometry = features[0]
    if isinstance(geometry, dict) and geometry.get("type") == "Feature":
        geometry = geometry.get("geometry")
    if not isinstance(geometry, dict) or geometry.get("type") not in ("Polygon", "MultiPolygon"):
        raise Invalid(f"{path} has no polygon: use a GeoJSON Polygon or MultiPolygon")
    return geometry
