"""``fleetmap``: the server, and everything that can be done with one, from a shell.

Exit status: 0 it worked, 1 it did not (the reason stands on standard error), 2 wrong usage.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING, Annotated, Any

import typer

from app import __version__
from app.cli import groups
from app.cli.problems import Refused, problem_of
from app.errors import FleetMapError

if TYPE_CHECKING:
    from typer._click import Context


def main(arguments: Sequence[str] | None = None) -> None:
    """The entry point: run one command and exit with its status."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    sys.exit(run(given))


def run(arguments: Sequence[str]) -> int:
    """Run one command and return its exit status. Errors are printed to standard error, as JSON with ``--json``."""
    try:
        build(needed(arguments))(list(arguments), prog_name="fleetmap", standalone_mode=True)
    except SystemExit as error:
        return error.code if isinstance(error.code, int) else int(error.code is not None)
    except (Refused, FleetMapError, ModuleNotFoundError, OSError) as error:
        problem, hint = problem_of(error)
        if problem is None:
            raise
        from app.cli import output

        output.show_problem(problem, hint=hint, as_json="--json" in arguments)
        return 1
    return 0


def needed(arguments: Sequence[str]) -> str | None:
    """Return the only command that a call needs: the fewer are imported, the sooner it starts. None: all of them."""
    if "_FLEETMAP_COMPLETE" not in os.environ:
        return "" if list(arguments) == ["--version"] else groups.first_command(arguments)
    typed = os.environ.get("COMP_WORDS") or os.environ.get("_TYPER_COMPLETE_ARGS") or ""
    words = [*typed.split(), *[""][: typed.endswith(" ")]]
    only = groups.first_command(words[1:-1])
    return only if only != "serve" or find_spec("pydantic_settings") is not None else None


PANELS: Mapping[str, Sequence[tuple[str, str]]] = {
    "Maps": (
        ("import", "maps:import_maps"),
        ("export", "maps:export_map"),
        ("coverage", "maps:coverage"),
        ("link", "maps:link"),
        ("template", "templates:template"),
    ),
    "Files on this machine (no server needed)": (
        ("convert", "maps:convert"),
        ("check", "maps:check"),
        ("formats", "maps:list_formats"),
    ),
    "Environments and their versions": (
        ("environment", "environments:commands"),
        ("versions", "history:versions"),
        ("diff", "history:diff"),
        ("revert", "history:revert"),
        ("where", "position:locate"),
        ("derive", "history:derive"),
        ("align", "align:align"),
        ("generate", "generate:generate"),
    ),
    "Fleet": (
        ("promote", "history:promote"),
        ("channels", "channels:commands"),
        ("robots", "robots:commands"),
        ("overlays", "overlays:commands"),
        ("events", "events:events"),
        ("agent", "agent:agent"),
        ("agent-level", "agent:agent_level"),
    ),
    "Server": (
        ("serve", "serving:serve"),
        ("demo", "serving:demo"),
        ("token", "tokens:commands"),
        ("keys", "keys:commands"),
        ("jobs", "jobs:commands"),
        ("migrate", "serving:migrate"),
    ),
}
"""Commands in the order of the help: name, and where its function or group is (below ``app.cli``)."""

ALIASES: Mapping[str, str] = {
    "environments": "environment",
    "channel": "channels",
    "robot": "robots",
    "overlay": "overlays",
    "event": "events",
    "tokens": "token",
    "key": "keys",
    "job": "jobs",
    "format": "formats",
    "version": "versions",
}
"""Further names of commands; the help does not list them."""

NEGATIVE_ARGUMENTS = frozenset({"where"})
"""Commands whose argument may start with a minus: a southern latitude is no option."""


class Root(groups.Group):
    """All commands, in the order of the panels."""

    def list_commands(self, ctx: Context) -> list[str]:
        """Return the names as the help lists them."""
        order = [name for commands in PANELS.values() for name, _ in commands]
        return sorted(super().list_commands(ctx), key=lambda name: order.index(ALIASES.get(name, name)))


def build(only: str | None = None) -> typer.Typer:
    """Build the commands.

    Args:
        only: the command that is needed: others are neither imported nor built. All of them for None and for a name
            that is no command's, none for an empty text. Only where it is named does ``serve`` get an option for every
            setting, since these import the server's settings.
    """
    app = groups.Commands(
        "Store versioned maps of every environment, and give each robot the map in its own format.",
        cls=Root,
        no_args_is_help=True,
        add_completion=True,
        pretty_exceptions_enable=False,
        epilog="New here? `fleetmap serve --demo`. A command's options and an example: `fleetmap COMMAND --help`.",
    )

    @app.callback()
    def common(
        version: Annotated[
            bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version.")
        ] = False,
    ) -> None:
        pass

    panels = {name: panel for panel, commands in PANELS.items() for name, _ in commands}
    places = {name: place for commands in PANELS.values() for name, place in commands}
    if only is not None and only in ALIASES:
        places = {only: places[ALIASES[only]]}
    elif only is not None:
        places = {only: places[only]} if only in places else places if only else {}
    for name, place in places.items():
        module, _, member = place.partition(":")
        found = getattr(importlib.import_module(f"app.cli.{module}"), member)
        shown: dict[str, Any] = {"rich_help_panel": panels.get(name), "hidden": name in ALIASES}
        if isinstance(found, typer.Typer):
            app.add_typer(found, name=name, **shown)
            continue
        if name == "serve":
            found = sys.modules["app.cli.serving"].with_flags(found) if only == "serve" else _serve_without_flags
        settings = {"ignore_unknown_options": True} if name in NEGATIVE_ARGUMENTS else None
        app.command(name, context_settings=settings, **shown)(found)
    return app


def _serve_without_flags() -> None:
    """Start the server, with a demo if you like."""


def _show_version(wanted: bool) -> None:
    if wanted:
        sys.stdout.write(f"fleetmap {__version__}\n")
        raise typer.Exit
