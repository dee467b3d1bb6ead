"""``fleetmap align``: align a stored grid with another map of its environment, or merge grids."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import typer

from app.cli import completion, options, output
from app.cli.client import Client, quote_path
from app.errors import Invalid

Onto = Annotated[
    list[str] | None,
    typer.Argument(
        help="Reference map: objects, voxels, or the name of another grid. Or use --pair. With --merge: the grids, "
        "the oldest first."
    ),
]
OntoLevel = Annotated[
    str | None, typer.Option("--onto-level", help="Level of the reference map [default: level of the grid].")
]
Pair = Annotated[
    list[str] | None,
    typer.Option(
        "--pair",
        metavar="X,Y=X,Y",
        help="Current and correct position of a point, in metres; repeatable. With --merge: GRID:X,Y=X,Y, its position "
        "in the grid and in the first one.",
    ),
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
Least = Annotated[
    float | None,
    typer.Option(
        "--least", min=0, max=1, help="Minimum share of matching cells or points [default: 0.5, with --merge 0.9]."
    ),
]
Merge = Annotated[bool, typer.Option("--merge", help="Merge the named grids into one, in the frame of the first.")]
Name = Annotated[
    str | None, typer.Option("--name", help="Name of the merged grid [default: the first one's, which it replaces].")
]
Seam = Annotated[
    str | None,
    typer.Option("--seam", help="Where grids disagree: evidence of all, or newest [default: evidence]."),
]
Pose = Annotated[
    list[str] | None,
    typer.Option(
        "--pose",
        metavar="GRID=X,Y,DEGREES",
        help="Rough position of a grid's frame in the first one's, for --merge; repeatable.",
    ),
]
Overlap = Annotated[
    float | None,
    typer.Option("--overlap", min=0, max=1, help="Minimum share in common with the others [default: 0.1]."),
]


def align(
    environment: options.Environment,
    onto: Onto = None,
    grid: Annotated[
        str | None,
        typer.Option("--grid", help="Grid to move [default: map].", autocompletion=completion.grids),
    ] = None,
    level: options.Level = "ground",
    onto_level: OntoLevel = None,
    pair: Pair = None,
    option: Option = None,
    merge: Merge = False,
    name: Name = None,
    seam: Seam = None,
    drop: Annotated[bool, typer.Option("--drop", help="Delete the grids that were merged; the result stays.")] = False,
    pose: Pose = None,
    overlap: Overlap = None,
    angle: Annotated[
        float | None,
        typer.Option("--angle", min=0, max=180, help="Maximum rotation, in degrees [default: 180, around --pose 20]."),
    ] = None,
    reach: Reach = None,
    near: Near = None,
    least: Least = None,
    dry_run: options.DryRun = False,
    message: options.Message = "",
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Align an occupancy grid with another map of its environment, or merge grids, as a new version.

    Reports how well the grid fits. Only the origin of the grid changes. To rotate its cells as well, use
    `fleetmap export … occupancy_grid -O normalize=true`.

    With --merge, the grids of several robots become one. Each is placed by the walls that it has in common with the
    others; a grid that fits nowhere, or in several ways, is refused.

    Example: `fleetmap align farm objects --grid map --dry-run`
    `fleetmap align farm --merge robot-1 robot-2 --name site`
    """
    body: dict[str, Any] = {"level": level, "angle": angle, "reach": reach, "near": near}
    body |= {"least": least, "dry_run": dry_run, "message": message}
    if merge:
        if grid is not None or option or onto_level is not None:
            raise typer.BadParameter("--grid, --option and --onto-level cannot be combined with --merge")
        if len(onto or ()) < 2:
            raise typer.BadParameter("--merge requires the names of at least two grids")
        choices = {"name": name, "seam": seam, "overlap": overlap, "drop": drop}
        points, poses = _pairs_by_grid(pair or ()), dict(_pose(text) for text in pose or ())
        given = {word: value for word, value in choices.items() if value is not None}
        body["merge"] = {"grids": onto, "pairs": points, "poses": poses, **given}
    else:
        if name or seam or drop or pose or overlap is not None:
            raise typer.BadParameter("--name, --seam, --drop, --pose and --overlap require --merge")
        body["grid"] = grid or "map"
        body |= _target(onto or [], pair, option, onto_level, level)
    with Client(server, token) as client, output.progress_bar("merging" if merge else "aligning"):
        result = client.post(quote_path("environments", environment, "alignments"), body, repeat=True)
    if as_json:
        output.show_json(result)
    elif merge:
        _show_merge(environment, result)
    else:
        _show(environment, result)


def _target(
    onto: list[str], pair: list[str] | None, option: list[str] | None, onto_level: str | None, level: str
) -> dict[str, Any]:
    """Return the reference map of an alignment as a member of the request."""
    if len(onto) > 1:
        raise typer.BadParameter("give one reference map, or --merge to merge grids")
    if bool(onto) == bool(pair):
        raise typer.BadParameter("missing reference: use objects, voxels, the name of another grid, or --pair")
    if pair:
        if option or onto_level is not None:
            raise typer.BadParameter("--option and --onto-level cannot be combined with --pair")
        return {"pairs": [_pair(text) for text in pair]}
    layer = onto[0] if onto[0] in ("objects", "voxels") else "occupancy"
    if option and layer == "occupancy":
        raise typer.BadParameter("--option requires objects or voxels as reference: grids have no parameters")
    target: dict[str, Any] = {"layer": layer, "level": onto_level or level, "parameters": options.pairs(option)}
    return {"onto": target if layer != "occupancy" else {**target, "name": onto[0]}}


def _show_merge(environment: str, result: Mapping[str, Any]) -> None:
    report, version = result.get("merge") or {}, result.get("version")
    for line in report.get("grids") or ():
        turn = math.degrees(float(line["yaw"]))
        output.print_result(
            f"{environment}: {report['level']}/{line['grid']} turned by {turn:.3f}°, moved by {float(line['x']):.3f}, "
            f"{float(line['y']):.3f} m"
        )
        if line is not report["grids"][0]:
            shares = [f"agreement {float(line['agreement']):.1%}", f"overlap {float(line['overlap']):.1%}"]
            shares += [f"residual {float(line['residual']):.3f} m"] if "residual" in line else []
            output.print_result(f"  {', '.join(shares)}, {float(line['walls']):.1f} m of walls in common")
        for other in line.get("others") or ():
            turn = math.degrees(float(other["yaw"]))
            output.print_result(
                f"  also possible: {turn:.3f}°, {other['x']:.3f}, {other['y']:.3f} m: {other['agreement']:.1%}"
            )
    if "size" in report:
        width, height = report["size"]
        output.print_result(
            f"  {report['level']}/{report['name']}: {width} × {height} cells of {report['resolution']:g} m, "
            f"{report['conflicts']} in conflict, {report['freed']} of them free"
        )
    output.print_result(f"  version {version['version']}" if version else "  nothing is stored")
    output.show_warnings(result.get("warnings") or ())


def _pairs_by_grid(texts: Sequence[str]) -> dict[str, list[list[list[float]]]]:
    """Parse ``GRID:X,Y=X,Y`` texts. Raises Invalid."""
    out: dict[str, list[list[list[float]]]] = {}
    for text in texts:
        name, colon, points = text.rpartition(":")
        if not colon:
            raise Invalid(f"--pair must be GRID:X,Y=X,Y in metres with --merge, got {text[:80]!r}")
        out.setdefault(name, []).append(_pair(points))
    return out


def _pose(text: str) -> tuple[str, list[float]]:
    """Parse ``GRID=X,Y,DEGREES``. Raises Invalid."""
    name, _, numbers = text.rpartition("=")
    try:
        values = [float(n) for n in numbers.split(",")]
    except ValueError:
        values = []
    if not name or len(values) != 3 or not all(math.isfinite(n) for n in values):
        raise Invalid(f"--pose must be GRID=X,Y,DEGREES, got {text[:80]!r}")
    return name, values


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
