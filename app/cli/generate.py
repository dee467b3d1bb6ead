"""``fleetmap generate``: generate synthetic sites, on a server or as files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from app.cli import completion, local, options, output, output_files
from app.cli.client import Client, quote_path
from app.cli.created import ensure_environment
from app.cli.folder import check_name, environment_name
from app.cli.maps import show_parameters, show_report
from app.cli.versions import show_commit
from app.errors import Invalid, Problem

if TYPE_CHECKING:
    from app.model.frame import Datum


Site = Annotated[
    str | None,
    typer.Argument(
        help="Generator, such as orchard or warehouse [default: list generators].",
        autocompletion=completion.generators,
    ),
]
Seed = Annotated[
    int, typer.Option("--seed", min=0, help="Random seed: the same seed and parameters give the same site.")
]
EnvironmentOption = Annotated[
    str | None,
    typer.Option(
        "--environment",
        "-e",
        help="Environment to store the site in, created if missing [default: SITE-SEED].",
        autocompletion=completion.environments,
    ),
]
Describe = Annotated[
    bool,
    typer.Option("--parameters", help="Only describe the generator and its parameters. Needs no server."),
]
To = Annotated[
    str | None,
    typer.Option(
        "--to",
        help="Write a map in this format instead of storing the site. Needs no server.",
        autocompletion=completion.formats,
    ),
]


def generate(
    site: Site = None,
    seed: Seed = 0,
    environment: EnvironmentOption = None,
    option: Annotated[list[str] | None, options.named_values_option("Parameter of the generator")] = None,
    datum: options.DatumText = None,
    describe: Describe = False,
    to: To = None,
    out: options.Output = None,
    create: options.Create = None,
    message: options.Message = "",
    replace: options.Replace = False,
    dry_run: options.DryRun = False,
    server: options.Server = None,
    token: options.Token = None,
    as_json: options.Json = False,
) -> None:
    """Generate a synthetic site with all its maps: orchards, buildings, streets, caves, … Without a name, list them.

    The list, --parameters and `--to FORMAT -o FILE` need no server. With --to, -O also takes parameters of the format.
    A missing environment is created, and removed again if the generator fails.

    Example: `fleetmap generate orchard --seed 7 -O rows=6 -e orchard-7`
    """
    if site is None:
        _list(as_json=as_json)
        return
    if describe:
        _describe(site, as_json=as_json)
        return
    values = options.pairs(option)
    place = options.datum(datum)
    if to is None:
        if out is not None:
            raise typer.BadParameter("-o requires --to FORMAT, the format of the file")
        name = environment or environment_name(f"{site}-{seed}")
        check_name(name)
        body = {"generator": site, "seed": seed, "parameters": values, "message": message, "replace": replace}
        body["dry_run"] = dry_run
        with (
            Client(server, token) as client,
            ensure_environment(client, name, datum=place, create=create if environment else True, dry_run=dry_run),
        ):
            path = quote_path("environments", name, "generations")
            result = client.post_work(path, body, f"generating {site}")
        show_commit(name, result, as_json=as_json)
        return
    if dry_run:
        raise typer.BadParameter("--dry-run and --to cannot be combined: --to stores nothing on a server")
    if out is None:
        raise typer.BadParameter("--to requires -o: a file, a folder, or - for standard output")
    if environment is not None:
        raise typer.BadParameter(
            "--environment and --to cannot be combined: store the site on a server, or write a file"
        )
    if out == "-" and as_json:
        raise typer.BadParameter("--json and -o - cannot be combined: both write to standard output")
    _write(site, seed, values, place, to, out, as_json=as_json)


def _list(*, as_json: bool) -> None:
    local.require_server_python("generate")
    from app.generate import all_generators

    generators = [one.as_dict() for one in all_generators().values()]
    if as_json:
        output.show_json(generators)
        return
    output.show_table(
        ("generator", "description", "works on", "gives", "parameters"),
        [
            (
                one["id"],
                one["title"],
                _worked_on(one),
                ", ".join(one["gives"]),
                ", ".join(p["name"] for p in one["parameters"]),
            )
            for one in generators
        ],
    )


def _describe(site: str, *, as_json: bool) -> None:
    local.require_server_python("generate")
    from app.generate import get_generator

    details = get_generator(site).as_dict()
    if as_json:
        output.show_json(details)
        return
    output.show_members(
        {
            "generator": f"{details['id']}: {details['title']}",
            "works on": _worked_on(details),
            "gives": ", ".join(details["gives"]),
        }
    )
    show_parameters(details["parameters"], "Parameters")


def _worked_on(details: Mapping[str, Any]) -> str:
    return ", ".join(details["needs"]) or " or ".join(details["changes"]) or "nothing"


def _check_names(site: str, ours: set[str], to: str, values: Mapping[str, str]) -> None:
    """Check the names of options. Raises Invalid with the accepted ones of the generator and the format."""
    from app import derive, formats, parameters

    theirs = {p["name"] for p in parameters.describe(formats.get_format(to).write_options)}
    derived = {name for step in derive.all_derivations() for name in derive.parameter_names(step)}
    for name in values.keys() - ours - theirs - derived:
        of_format = f"; {to} accepts {', '.join(sorted(theirs))}" if theirs else ""
        reason = f"unknown parameter of {site}: use one of {', '.join(sorted(ours))}{of_format}"
        raise Invalid(f"{name}: {reason}", [Problem(reason, where=name)])


def _write(
    site: str, seed: int, values: dict[str, str], datum: Datum | None, to: str, out: str, *, as_json: bool
) -> None:
    local.require_server_python("generate --to")
    from app import formats, generate, parameters
    from app.convert.files import write_layers
    from app.derive import DerivationNotes
    from app.model.layers import Layers
    from app.store.values import Provenance

    generator = generate.get_generator(site)
    formats.get_format(to)
    if generator.editable_layers:
        raise Invalid(
            f"{site} changes the layers {', '.join(sorted(generator.editable_layers))} of an environment: set one with "
            "--environment"
        )
    ours = {p["name"] for p in parameters.describe(generator.parameters)}
    _check_names(site, ours, to, values)
    generator_values = {n: v for n, v in values.items() if n in ours}
    notes = DerivationNotes()
    with output.progress_bar(f"generating {site}"):
        layers = generate.run(site, seed, generator_values, Layers(datum=datum), notes)
        made_up = layers.datum if datum is None else None
        how = generate.step(site, seed, generator_values, {}, made_up, generate.drawn_values(notes))
        came = Provenance("generated", steps=(how,))
        result = write_layers(layers, to, {n: v for n, v in values.items() if n not in ours}, came)
    report = replace(
        result.report,
        warnings=(*notes.warnings, *result.report.warnings),
        dropped=(*notes.dropped, *result.report.dropped),
        template=(*notes.template, *result.report.template),
    ).as_dict()
    as_folder = output_files.wants_folder(out) or (
        len(result.files) > 1 and out != "-" and not out.lower().endswith(".zip")
    )
    names = output_files.bundle(result.files, Path(out), folder=as_folder)
    if as_json:
        output.show_json({"files": names, "report": report})
        return
    for name in names if as_folder else [out] if out != "-" else []:
        output.print_status(f"wrote {Path(out) / name if as_folder else name}")
    show_report(report)
