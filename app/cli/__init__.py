"""``fleetmap``: the server, and everything that can be done with one, from a shell.

Exit status: 0 it worked, 1 it did not (the reason stands on standard error), 2 wrong usage.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from typing import Annotated, Any

import typer

from app import __version__
from app.cli import agent, align, generate, history, maps, output, position, serving, templates, tokens, verify
from app.cli.client import Refused
from app.errors import FleetMapError


def main(arguments: Sequence[str] | None = None) -> None:
    """The entry point: run one command and exit with its status."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    sys.exit(run(given))


HINTS: Mapping[str, str] = {
    "MissingDatum": "On the command line: --datum LAT,LON, or a datum.yaml among the files.",
    "missing-datum": "On the command line: `fleetmap import PATH --environment NAME --datum LAT,LON`.",
    "Ambiguous": "On the command line: --option grid=NAME.",
    "ambiguous": "On the command line: --option grid=NAME.",
}
"""What to do here, by our own errors' class or the last word of a server's problem type."""


def run(arguments: Sequence[str]) -> int:
    """One command: its exit status. Errors are printed to standard error, as JSON with ``--json``."""
    as_json = "--json" in arguments
    completing = "_FLEETMAP_COMPLETE" in os.environ and find_spec("pydantic_settings") is not None
    try:
        command = build(all_flags=completing or list(arguments[:1]) == ["serve"])
        command(list(arguments), prog_name="fleetmap", standalone_mode=True)
    except SystemExit as error:
        return error.code if isinstance(error.code, int) else int(error.code is not None)
    except Refused as refused:
        kind = str(refused.problem.get("type", "")).rpartition(":")[2]
        output.show_problem(refused.problem, hint=refused.hint or HINTS.get(kind, ""), as_json=as_json)
        return 1
    except FleetMapError as error:
        output.show_problem(as_problem(error), hint=HINTS.get(type(error).__name__, ""), as_json=as_json)
        return 1
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] == "app":
            raise
        detail = f"this command needs the server's packages ({error.name} is not installed)"
        hint = 'pip install "fleet-map-server[server]"'
        output.show_problem({"title": "Not installed", "detail": detail}, hint=hint, as_json=as_json)
        return 1
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        output.show_problem(
            {"title": "Input or output failed", "detail": f"{where}{error.strerror or error}"}, as_json=as_json
        )
        return 1
    return 0


def build(*, all_flags: bool = True) -> typer.Typer:
    """All commands. ``all_flags``: whether ``serve`` needs an option for every setting, which costs imports."""
    app = typer.Typer(
        no_args_is_help=True,
        add_completion=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        help="Versioned maps of every environment, for every robot in its own format.",
    )

    @app.callback()
    def common(
        version: Annotated[
            bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version.")
        ] = False,
    ) -> None:
        """Versioned maps of every environment, for every robot in its own format."""

    app.command("serve")(serving.with_flags(serving.serve) if all_flags else _serve_without_flags)
    for name, function in (
        ("import", maps.import_maps),
        ("export", maps.export_map),
        ("link", maps.link),
        ("convert", maps.convert),
        ("check", maps.check),
        ("formats", maps.list_formats),
        ("coverage", maps.coverage),
        ("versions", history.versions),
        ("diff", history.diff),
        ("promote", history.promote),
        ("revert", history.revert),
        ("derive", history.derive),
        ("align", align.align),
        ("generate", generate.generate),
        ("template", templates.template),
        ("agent", agent.agent),
        ("agent-level", agent.agent_level),
        ("migrate", serving.migrate),
        ("verify", verify.verify),
        ("demo", serving.demo),
    ):
        app.command(name)(function)
    # A southern latitude starts with a minus, and is no option.
    app.command("where", context_settings={"ignore_unknown_options": True})(position.locate)
    app.add_typer(tokens.commands, name="token")
    return app


def as_problem(error: FleetMapError) -> dict[str, Any]:
    """An error of our own as the server would tell it."""
    problem: dict[str, Any] = {"title": type(error).__name__, "detail": error.detail}
    if error.problems:
        problem["errors"] = [p.as_dict() for p in error.problems]
    return problem


def _serve_without_flags() -> None:
    """Start the server."""


def _show_version(wanted: bool) -> None:
    if wanted:
        output.show(f"fleetmap {__version__}")
        raise typer.Exit
