"""Maps in and out: import, export, convert, check, formats, coverage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from app.cli import completion, local, options, output, output_files
from app.cli import folder as folders
from app.cli.client import Client, Download, LocalFile, quote_path
from app.cli.companions import with_companions
from app.cli.created import ensure_environment
from app.cli.versions import change_line, channel_rows, dry_run_line
from app.errors import Invalid, NotFound
from app.model.frame import GROUND

if TYPE_CHECKING:
    from app.formats import Format, LayerRequirements


Environment = Annotated[
    str | None,
    typer.Option(
        "--environment",
        "-e",
        help="Name of the environment, created if missing [default: derived from the folder's name].",
        autocompletion=completion.environments,
    ),
]
Mode = Annotated[
    str, typer.Option("--mode", help="replace: a map replaces the parts that it contains; merge: nothing is deleted.")
]


def import_maps(
    paths: Annotated[list[Path], typer.Argument(metavar="PATH...", help="An environment's folder, or map files.")],
    environment: Environment = None,
    format: options.Format = None,
    layer: options.Layer = None,
    level: options.Level = GROUND,
    grid: options.Grid = None,
    mode: Mode = "replace",
    message: options.Message = "",
    datum: options.DatumText = None,
    option: options.Options = None,
    create: options.Create = None,
    dry_run: options.DryRun = False,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Upload a folder or files as a new version of an environment.

    A folder with config/location, config/metric, config/topological or config/world is an environment_template: the
    server infers the purpose of a file from its folder. A missing environment is created, and removed again if the
    upload fails.

    Example: `fleetmap import network.kml --environment farm --layer topology -m 'drawn by hand'`
    """
    new_datum = options.datum(datum)
    extra = options.pairs(option)
    if environment is not None:
        folders.check_name(environment)
    files, suggested, notes = _collect(paths, for_environment=environment is None)
    name = environment or suggested
    if name is None:
        raise typer.BadParameter("missing --environment NAME: it is optional only for a single folder")
    fields = {"level": level, "mode": mode, "message": message or _default_message(paths)} | extra
    fields |= {k: v for k, v in (("format", format), ("layer", layer), ("grid", grid)) if v is not None}
    fields |= {"dry_run": "true"} if dry_run else {}
    with Client(server, token) as client:
        title = paths[0].resolve().name if len(paths) == 1 and paths[0].is_dir() else None
        with ensure_environment(
            client,
            name,
            datum=new_datum,
            title=title if title != name else None,
            create=create if environment else True,
            dry_run=dry_run,
        ) as is_new:
            status, body = client.upload(quote_path("environments", name, "versions"), files, fields)
    if as_json:
        output.show_json(body)
        return
    for note in notes:
        output.print_status(f"skipped: {note}", style="yellow")
    _show_import(name, status, body, dry_run=dry_run, is_new=is_new)


def export_map(
    environment: options.Environment,
    format: options.MapFormat,
    to: options.Output = None,
    version: options.MapVersion = None,
    file: Annotated[str | None, typer.Option("--file", help="Only this file of the map.")] = None,
    option: options.Options = None,
    derive: options.Derive = True,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Also print the map report: derived, filled-in and dropped data.")
    ] = False,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Export the map of an environment in any format, and print the written paths.

    Several files are written to a folder if -o is one (`-o out/`), otherwise as a ZIP. Default for -o: the file name
    from the server, in the working directory.

    Example: `fleetmap export farm occupancy_grid -o maps/ -O resolution=0.1`
    """
    if to == "-" and as_json:
        raise typer.BadParameter("--json and -o - cannot be combined: both write to standard output")
    params: dict[str, str] = options.pairs(option)
    params |= {} if derive else {"derive": "false"}
    with Client(server, token) as client:
        chosen = version or preferred_channel(client, environment)
        base = quote_path("environments", environment, "versions", chosen)
        with client.download(base + quote_path("maps", format, *(file.split("/") if file else ())), params) as got:
            written = store(got, to)
        report = client.get(base + quote_path("reports", format), params) if as_json or verbose else None
    if as_json:
        output.show_json({"files": written, "report": report})
        return
    for name in written:
        output.print_result(name)
    if report is not None:
        show_report(report)


def link(
    environment: options.Environment,
    format: options.MapFormat,
    file: Annotated[str | None, typer.Argument(help="Only this file of the map [default: the complete map].")] = None,
    version: options.MapVersion = None,
    seconds: Annotated[
        int | None, typer.Option("--seconds", min=1, help="Lifetime in seconds [default: the server's maximum, 86400].")
    ] = None,
    option: options.Options = None,
    derive: options.Derive = True,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Create a signed link to a map, which needs no token until it expires.

    The link contains the version number, so it always returns the same bytes. Anyone with the link can read this map.

    Example: `fleetmap link farm tmap2 --seconds 3600`
    """
    parameters: dict[str, str] = options.pairs(option)
    parameters |= {} if derive else {"derive": "false"}
    body: dict[str, Any] = {"format": format, "file": file, "parameters": parameters, "seconds": seconds}
    with Client(server, token) as client:
        chosen = version or preferred_channel(client, environment)
        result = client.post_until_done(quote_path("environments", environment, "versions", chosen, "links"), body)
    if as_json:
        output.show_json(result)
        return
    output.print_status(f"{result['name']} of version {result['version']}, without a token until {result['expires']}:")
    output.print_result(result["url"])


def convert(
    paths: Annotated[list[Path], typer.Argument(metavar="IN...", help="Map files, or a folder.", exists=True)],
    to: Annotated[
        str,
        typer.Option(
            "--to", help="Format of the output; `fleetmap formats` lists them.", autocompletion=completion.formats
        ),
    ],
    out: Annotated[str, typer.Option("--output", "-o", help="A file, a folder, or - for standard output.")],
    format: options.Format = None,
    layer: options.Layer = None,
    level: options.Level = GROUND,
    grid: options.Grid = None,
    datum: options.DatumText = None,
    option: options.Options = None,
    derive: options.Derive = True,
    as_json: options.Json = False,
) -> None:
    """Convert map files on this machine, without a server.

    Several files are written to a folder, or as a ZIP if -o ends in .zip. -O sets parameters of the output format, of
    derivations and of the input formats.

    Example: `fleetmap convert network.kml --layer topology --to tmap2 -o network.tmap2.yaml`
    """
    local.require_server_python("convert")
    from app import formats, parameters
    from app.convert.files import offline
    from app.derive import all_derivations, parameter_names
    from app.upload_reader import UploadHints, parse_drawn_layer

    if out == "-" and as_json:
        raise typer.BadParameter("--json and -o - cannot be combined: both write to standard output")
    fmt = formats.get_format(to)
    ours = {p["name"] for p in parameters.describe(fmt.write_options)}
    ours |= {name for step in all_derivations() for name in parameter_names(step)}
    values = options.pairs(option)
    files, _, notes = _collect(paths)
    files = with_companions(files)
    hints = UploadHints(
        format, parse_drawn_layer(layer), level, grid, {k: v for k, v in values.items() if k not in ours}
    )
    format_options = {k: v for k, v in values.items() if k in ours}
    with output.progress_bar(f"converting to {to}"):
        data = {f.name: f.path.read_bytes() for f in files}
        converted = offline(data, to, hints=hints, datum=options.datum(datum), options=format_options, derived=derive)
    as_folder = output_files.wants_folder(out) or (
        len(converted.files) > 1 and out != "-" and not out.lower().endswith(".zip")
    )
    names = output_files.bundle(converted.files, Path(out), folder=as_folder)
    if as_json:
        output.show_json({"files": names, "report": converted.report.as_dict()})
        return
    for note in notes:
        output.print_status(f"skipped: {note}", style="yellow")
    for name in names if as_folder else [out] if out != "-" else []:
        output.print_status(f"wrote {Path(out) / name if as_folder else name}")
    show_report(converted.report.as_dict())


def check(
    paths: Annotated[list[Path], typer.Argument(metavar="PATH...", help="Map files, or a folder.", exists=True)],
    format: options.Format = None,
    as_json: options.Json = False,
) -> None:
    """Check whether robots and tools would accept these map files.

    Applies the rules of each format's own loaders (Nav2's map_server, its route server, …). Uploads and changes
    nothing. The exit status is 1 if a map would be rejected.

    Example: `fleetmap check map.yaml map.pgm`
    """
    local.require_server_python("check")
    from app import formats, upload_reader
    from app.limits import Limits

    collected, _, notes = _collect(paths)
    collected = with_companions(collected)
    files = upload_reader.unpack({f.name: f.path.read_bytes() for f in collected}, Limits())
    groups, rest = formats.group({name: data for name, data in files.items() if data}, format)
    results: list[dict[str, Any]] = []
    for group in groups:
        findings = [p.as_dict() for p in formats.check(group.format, group.files)]
        level = findings[0]["level"] if findings else "fine" if group.format.check else "unchecked"
        results.append({"format": group.format.name, "file": group.main, "result": level, "findings": findings})
    if not results:
        raise Invalid("no file has a recognised map format: set it with --format")
    if as_json:
        output.show_json({"maps": results, "unknown": rest})
    else:
        for note in notes:
            output.print_status(f"skipped: {note}", style="yellow")
        for line in results:
            _show_check(line)
        for name in rest:
            output.print_status(f"not checked: {name}: no format can read this file")
    if any(line["result"] == "error" for line in results):
        raise typer.Exit(1)


def list_formats(
    format: Annotated[
        str | None,
        typer.Argument(
            metavar="[FORMAT]",
            help="Show the files, layers and parameters of this format [default: list all formats].",
            autocompletion=completion.formats,
        ),
    ] = None,
    as_json: options.Json = False,
) -> None:
    """List all formats, or describe one with its parameters. Needs no server.

    Example: `fleetmap formats occupancy_grid`
    """
    local.require_server_python("formats")
    from app import catalogue, formats

    if format is not None:
        fmt = formats.get_format(format)
        described = catalogue.describe_format(fmt)
        output.show_json(described) if as_json else _show_format(fmt, described)
        return
    descriptions = catalogue.describe_formats()
    if as_json:
        output.show_json(descriptions)
        return
    rows = [
        (
            f["id"],
            f["title"],
            "yes" if f["read"] else "-",
            ", ".join(f["files"]) if f["write"] else "-",
            ", ".join(layer for layer, how in f["information"].items() if how == "raw"),
            ", ".join(p["name"] for p in f["options"] if p["for"] == "write") or "-",
        )
        for f in descriptions
    ]
    output.show_table(("format", "description", "read", "served as", "layers", "options"), rows)


def _show_format(fmt: Format, described: Mapping[str, Any]) -> None:
    """Print a format: files, layers that it keeps and drops, requirements of a map, and parameters."""
    carried_layers = [layer for layer in described["information"] if layer in fmt.layers]
    dropped = [layer for layer in described["information"] if layer not in fmt.layers]
    dropped += ["blocked edges"] if "topology" in fmt.layers and not fmt.traits.marks_blocked else []
    derived = [layer for layer, how in described["information"].items() if how == "derived"]
    output.show_members(
        {
            "format": f"{fmt.name}: {fmt.title}",
            "uploads": "yes, detected from the content" if fmt.read else "not read",
            "maps": ", ".join(fmt.files) if fmt.write else "not written",
            "media types": ", ".join(dict.fromkeys(fmt.files.values())) if fmt.write else "",
            "requires": _requirements_text(fmt.needs) if fmt.write else "",
            "keeps": ", ".join(carried_layers),
            "derived from it": ", ".join(derived) if fmt.read else "",
            "drops": ", ".join(dropped) if fmt.write else "",
        }
    )
    for use, title in (("write", "Parameters of a map"), ("read", "Parameters of an upload")):
        show_parameters([p for p in described["options"] if p["for"] == use], title)


def _requirements_text(needs: LayerRequirements) -> str:
    """Format the requirements of a map: ``objects, or occupancy; and a datum``."""
    layers = ", or ".join(" with ".join(sorted(layers)) for layers in needs.one_of)
    datum = "a datum" if needs.datum else "a datum, if any content is in metres" if needs.anchor == "wgs84" else ""
    return "; and ".join(filter(None, (layers, datum)))


def show_parameters(described: Sequence[Mapping[str, Any]], title: str) -> None:
    """Show described parameters as a table, if there are any."""
    if described:
        output.print_result("")
        columns = ("parameter", "value", "unit", "default", "meaning")
        output.show_table(columns, map(_parameter_row, described), title=f"{title} (-O NAME=VALUE)")


def _parameter_row(parameter: Mapping[str, Any]) -> tuple[str, str, str, str, str]:
    """Format a described parameter as a row: name, accepted values, unit, default, meaning."""
    schema, default = parameter["schema"], parameter["default"]
    low, high = schema.get("minimum"), schema.get("maximum")
    kind = {"boolean": "true or false", "integer": "whole number", "number": "number", "string": "text"}[schema["type"]]
    kind = schema.get("description") or kind
    if schema.get("enum"):
        value = ", ".join(schema["enum"])
    elif low is not None and high is not None:
        value = f"{kind}, {low:g} to {high:g}"
    elif low is not None or high is not None:
        value = f"{kind}, at least {low:g}" if low is not None else f"{kind}, at most {high:g}"
    else:
        value = kind
    text = ",".join(map(str, default)) if isinstance(default, tuple) else "" if default is None else str(default)
    meaning, _, unit = parameter["description"].removesuffix("]").partition(" [")
    return parameter["name"], value, unit, text.lower() if isinstance(default, bool) else text, meaning


def coverage(
    environment: options.Environment,
    version: options.Version = "latest",
    picture: Annotated[
        str | None, typer.Option("--picture", help="Write an SVG diagram of sources, layers and formats to this path.")
    ] = None,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """List for each format whether an environment can be exported, by which derivations, or what is missing.

    Example: `fleetmap coverage farm`
    """
    if picture is not None:
        with Client(server, token) as client:
            address = quote_path("environments", environment, "versions", version, "provenance")
            with client.download(address, {}) as got:
                written = store(got, picture)
        output.print_status(f"wrote {', '.join(written)}")
        return
    with Client(server, token) as client:
        rows = client.get(quote_path("environments", environment, "versions", version, "maps"))
    if as_json:
        output.show_json(rows)
        return
    lines = []
    for row in rows:
        steps = [_step(step) for step in row.get("chain") or ()]
        how = ", then ".join(steps) or "; ".join(row.get("missing") or ()) or "-"
        how += f"; {row['choose']}" if row.get("choose") else ""
        lines.append((row["format"], row["state"], how.removeprefix("-; ")))
    output.show_table(("format", "state", "derivations, or what to supply"), lines)


def show_report(report: Mapping[str, Any]) -> None:
    """Print a map report as text."""
    for line in report.get("layers") or ():
        steps = ", ".join(_step(step) for step in line.get("steps") or ())
        name = "/".join(str(line[k]) for k in ("layer", "level", "name") if line.get(k))
        output.print_status(f"{name}: {line['information']}{f' ({steps})' if steps else ''}")
    for line in report.get("template") or ():
        source = f" ({line['from']})" if line.get("from", "default") != "default" else ""
        value = "(empty)" if line["value"] == "" else line["value"]
        output.print_status(f"filled in: {line['what']} = {value}{source}: {line['why']}")
    for line in report.get("dropped") or ():
        output.print_status(f"dropped: {line['count']} × {line['what']}: {line['why']}", style="yellow")
    output.show_warnings(report.get("warnings") or ())


def _collect(
    paths: Sequence[Path], *, for_environment: bool = False
) -> tuple[list[LocalFile], str | None, tuple[str, ...]]:
    """Collect the files to upload. Also return an environment name if it is a single folder, and skipped files.

    Args:
        for_environment: propose --environment for a missing path that may be the name of an environment.
    """
    for path in paths:
        if not path.exists():
            is_name = for_environment and len(paths) > 1 and folders.NAME.fullmatch(str(path)) is not None
            hint = f": set an environment with --environment {path}" if is_name else ""
            raise NotFound(f"no file or folder {str(path)!r}{hint}")
    if len(paths) == 1 and paths[0].is_dir():
        upload_folder = folders.collect(paths[0])
        inner = upload_folder.root if upload_folder.is_template else paths[0].resolve()
        try:
            name = folders.environment_name(inner.name)
        except Invalid:
            name = None
        return list(upload_folder.files), name, upload_folder.notes
    files: list[LocalFile] = []
    notes: list[str] = []
    for path in paths:
        if path.is_dir():
            upload_folder = folders.collect(path)
            notes += upload_folder.notes
            prefix = "" if upload_folder.is_template else f"{path.resolve().name}/"
            files += [LocalFile(prefix + f.name, f.path, f.size) for f in upload_folder.files]
        else:
            files.append(folders.single(path))
    names = [f.name for f in files]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise Invalid(f"duplicate file name {twice[0]}: import their folder, or import them one by one")
    return files, None, tuple(notes)


def _default_message(paths: Sequence[Path]) -> str:
    names = [path.resolve().name for path in paths]
    return f"import {', '.join(names[:3])}{' …' if len(names) > 3 else ''}"


def _show_import(name: str, status: int, body: Mapping[str, Any], *, dry_run: bool, is_new: bool) -> None:
    if dry_run:
        output.print_result(dry_run_line(name, body))
    elif status == 201:
        output.print_result(f"{name}: version {body['version']}{' of the new environment' if is_new else ''}")
    else:
        output.print_result(f"{name}: no changes, still version {body['version']}")
    if dry_run or status == 201:  # otherwise these are the changes of the existing version
        for subject, change in (body.get("changes") or {}).items():
            output.print_result(f"  {change_line(subject, change)}")
    kinds = [f"{layer} {kind}" for layer, kind in (body.get("information") or {}).items() if kind != "missing"]
    if kinds:
        output.print_result(f"  layers: {', '.join(kinds)}")
    sources = body.get("sources") or []
    used = [s for s in sources if s.get("used")]
    idle = [s for s in sources if not s.get("used")]
    empty = sum(not s["size"] for s in idle)
    note = f" ({empty} of them empty)" if empty else ""
    output.print_result(f"  files: {len(used)} used, {len(idle)} stored as sources only{note}")
    for source in used:
        output.print_result(
            f"    {source['name']} ({source.get('format') or 'part of a map'}, {output.size(source['size'])})"
        )
    names = [s["name"] for s in idle if s["size"]]
    if names:
        output.print_result(
            f"  not used: {', '.join(names[:20])}{f' and {len(names) - 20} more' if len(names) > 20 else ''}"
        )
    output.show_warnings(body.get("warnings") or ())


def preferred_channel(client: Client, environment: str) -> str:
    """Return ``production`` if the channel exists, else ``latest``, like the short map address for robots."""
    names = {row["channel"] for row in channel_rows(client, environment)}
    return "production" if "production" in names else "latest"


def store(got: Download, to: str | None) -> list[str]:
    """Write a download to a file, a folder or standard output. Return the written paths."""
    if to is not None and output_files.wants_folder(to):
        if got.is_zip:
            return [str(Path(to) / name) for name in output_files.unpack(got.path, Path(to))]
        target = output_files.inside(Path(to), got.name)
    else:
        target = Path(to or got.name)
    with got.path.open("rb") as stream:
        if to == "-":
            output_files.to_stdout(stream)
            return []
        output_files.to_file(target, stream)
    return [str(target)]


_RESULTS: Mapping[str, str] = {
    "fine": "no problems",
    "warning": "loads with warnings",
    "error": "would be rejected",
    "unchecked": "not checked, this format has no rules",
}


def _show_check(line: Mapping[str, Any]) -> None:
    output.print_result(f"{line['file']} ({line['format']}): {_RESULTS[line['result']]}")
    for finding in line["findings"]:
        output.print_result(f"  {finding['level']}: {output.problem_place(finding)}")


def _step(step: Any) -> str:
    if not isinstance(step, Mapping):
        return str(step)
    name = str(step.get("step") or step.get("method") or step.get("name") or "?")
    if "from" not in step or "to" not in step:
        return name
    start = step["from"] if isinstance(step["from"], str) else " and ".join(step["from"])
    return f"{start} to {step['to']} ({name})"
