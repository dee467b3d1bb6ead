"""``fleetmap align``: align a stored grid with another map of its environment."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any

import typer

from app.cli import completion, options, output
from app.cli.client import Client, quote_path
from app.errors import Invalid

Onto = Annotated[
    str | None,
    typer.Argument(help="Reference map: objects, voxels, or the name of another grid. Or use --pair."),
]
OntoLevel = Annotated[
    str | None, typer.Option("--onto-level", help="Level of the reference map [default: level of the grid].")
]
Pair = Annotated[
    list[str] | None,
    typer.Option("--pair", metavar="X,Y=X,Y", help="Current and correct position of a point, in metres; repeatable."),
]
Option = Annotated[
    list[str] | None, options.named_values_option("Parameter of the slice through objects or voxels (height, …)")
]
Reach = Annotated[float | None, typer.Option("--reach", min=0, help="Maximum shift of the grid's centre, in metres.")]
Near = Annotated[
    float | None,
    typer.Option(
        "--near", help="Maximum distance of matching cells [default: 0.1] or points [default: 0.5], in metres."
    ),
]
Least = Annotated[float, typer.Option("--least", min=0, max=1, help="Minimum share of matching cells or points.")]


def align(
    environment: options.Environment,
    onto: Onto = None,
    grid: Annotated[str, typer.Option("--grid", help="Grid to move.", autocompletion=completion.grids)] = "map",
    level: options.Level = "ground",
    onto_level: OntoLevel = None,
    pair: Pair = None,
    option: Option = None,
    angle: Annotated[float, typer.Option("--angle", min=0, max=180, help="Maximum rotation, in degrees.")] = 180.0,
    reach: Reach = None,
    near: Near = None,
    least: Least = 0.5,
    dry_run: options.DryRun = False,
    message: options.Message = "",
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Align an occupancy grid with another map of its environment, and store it as a new version.

    Reports how well the grid fits. Only the origin of the grid changes. To rotate its cells as well, use
    `fleetmap export … occupancy_grid -O normalize=true`.

    Example: `fleetmap align farm objects --grid map --dry-run`
    """
    body: dict[str, Any] = {"grid": grid, "level": level, "angle": angle, "reach": reach, "near": near}
    body |= {"least": least, "dry_run": dry_run, "message": message}
    if (onto is None) == (not pair):
        raise typer.BadParameter("missing reference: use objects, voxels, the name of another grid, or --pair")
    if pair:
        if option or onto_level is not None:
            raise typer.BadParameter("--option and --onto-level cannot be combined with --pair")
        body["pairs"] = [_pair(text) for text in pair]
    else:
        layer = onto if onto in ("objects", "voxels") else "occupancy"
        if option and layer == "occupancy":
            raise typer.BadParameter("--option requires objects or voxels as reference: grids have no parameters")
        target: dict[str, Any] = {"layer": layer, "level": onto_level or level, "parameters": options.pairs(option)}
        body["onto"] = target if layer != "occupancy" else {**target, "name": onto}
    with Client(server, token) as client, output.progress_bar("aligning"):
        result = client.post(quote_path("environments", environment, "alignments"), body, repeat=True)
    if as_json:
        output.show_json(result)
        return
    _show(environment, result)


def _show(environment: str, result: Mapping[str, Any]) -> None:
    fit, version = result.get("alignment") or {}, result.get("version")
    if fit:
        grid = fit.get("grid") or {}
        turn = math.degrees(float(fit["yaw"]))
        moved = f"turned by {turn:.3f}°, moved by {float(fit['x']):.3f}, {float(fit['y']):.3f} m"
        output.print_result(f"{environment}: {grid.get('level')}/{grid.get('name')} {moved}")
        shares = [f"residual {float(fit['residual']):.3f} m", f"agreement {float(fit['agreement']):.1%}"]
        if fit.get("overlap") is not None:
            shares.append(f"overlap {float(fit['overlap']):.1%}")
        output.print_result(f"  {', '.join(shares)}")
        output.print_result(f"  origin {_place(fit['before'])} → {_place(fit['origin'])}")
        for other in fit.get("others") or ():
            turn = math.degrees(float(other["yaw"]))
            output.print_result(
                f"  also possible: {turn:.3f}°, {other['x']:.3f}, {other['y']:.3f} m: {other['agreement']:.1%}"
            )
    output.print_result(f"  version {version['version']}" if version else "  nothing is stored")
    output.show_warnings(result.get("warnings") or ())


def _place(origin: Any) -> str:
    x, y, yaw = (float(v) for v in origin)
    return f"({x:.3f}, {y:.3f}, {math.degrees(yaw):.3f}°)"


def _pair(text: str) -> list[list[float]]:
    """Parse ``X,Y=X,Y`` as two points. Raises Invalid."""
    try:
        (a, b), (c, d) = ([float(n) for n in point.split(",")] for point in text.split("="))
    except ValueError:
        raise Invalid(f"--pair must be X,Y=X,Y in metres, got {text[:80]!r}") from None
    if not all(math.isfinite(n) for n in (a, b, c, d)):
        raise Invalid(f"--pair must have finite numbers, got {text[:80]!r}")
    return [[a, b], [c, d]]
