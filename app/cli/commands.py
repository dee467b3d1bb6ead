"""Commands of ``fleetmap``: their modules and help panels. Imports only the modules of the requested command."""

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

if TYPE_CHECKING:
    from typer._click import Context


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
        ("versions", "versions:versions"),
        ("show", "show:show"),
        ("diff", "versions:diff"),
        ("revert", "versions:revert"),
        ("tag", "tags:tag"),
        ("draft", "drafts:commands"),
        ("where", "position:locate"),
        ("derive", "versions:derive"),
        ("align", "align:align"),
        ("generate", "generate:generate"),
    ),
    "Fleet": (
        ("promote", "versions:promote"),
        ("channels", "channels:commands"),
        ("robots", "robots:commands"),
        ("overlays", "overlays:commands"),
        ("events", "events:events"),
        ("agent", "agent:agent"),
        ("agent-level", "agent:agent_level"),
    ),
    "Server": (
        ("serve", "server:serve"),
        ("worker", "server:worker"),
        ("mirror", "mirror:mirror"),
        ("demo", "server:demo"),
        ("token", "tokens:commands"),
        ("webhooks", "webhooks:commands"),
        ("keys", "keys:commands"),
        ("jobs", "jobs:commands"),
        ("migrate", "server:migrate"),
        ("verify", "verify:verify"),
        ("doctor", "doctor:doctor"),
        ("backup", "backup:backup"),
        ("restore", "backup:restore"),
        ("retention", "retention:retention"),
    ),
}
"""Commands in the order of the help: name, and path of its function or group below ``app.cli``."""

ALIASES: Mapping[str, str] = {
    "environments": "environment",
    "drafts": "draft",
    "channel": "channels",
    "robot": "robots",
    "overlay": "overlays",
    "event": "events",
    "tokens": "token",
    "webhook": "webhooks",
    "key": "keys",
    "job": "jobs",
    "format": "formats",
    "version": "versions",
}
"""Aliases of commands, hidden in the help."""

NEGATIVE_ARGUMENTS = frozenset({"where"})
"""Commands whose argument may start with a minus sign, such as a southern latitude."""


def needed_command(arguments: Sequence[str]) -> str | None:
    """Return the requested command, so that only its module is imported; None for all."""
    if "_FLEETMAP_COMPLETE" not in os.environ:
        return groups.first_command(arguments)
    typed = os.environ.get("COMP_WORDS") or os.environ.get("_TYPER_COMPLETE_ARGS") or ""
    words = [*typed.split(), *[""][: typed.endswith(" ")]]
    only = groups.first_command(words[1:-1])
    return only if only != "serve" or find_spec("pydantic_settings") is not None else None


class Root(groups.Group):
    """Command group that lists its commands in the order of the panels."""

    def list_commands(self, ctx: Context) -> list[str]:
        """Return the command names in the order of the help."""
        order = [name for commands in PANELS.values() for name, _ in commands]
        return sorted(super().list_commands(ctx), key=lambda name: order.index(ALIASES.get(name, name)))


def build(only: str | None = None) -> typer.Typer:
    """Build the commands.

    Args:
        only: the requested command; no other is imported or built. None or an unknown name: all commands. ``serve``
            gets an option for every setting only if it is requested, since these import the server's settings.
    """
    app = groups.Commands(
        "Store versioned maps of environments and serve each robot the map format that it needs.",
        cls=Root,
        no_args_is_help=True,
        add_completion=True,
        pretty_exceptions_enable=False,
        epilog="Try it: `fleetmap serve --demo`. Options and an example of a command: `fleetmap COMMAND --help`.",
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
    elif only is not None and only in places:
        places = {only: places[only]}
    for name, place in places.items():
        module, _, member = place.partition(":")
        command = getattr(importlib.import_module(f"app.cli.{module}"), member)
        shown: dict[str, Any] = {"rich_help_panel": panels.get(name), "hidden": name in ALIASES}
        if isinstance(command, typer.Typer):
            app.add_typer(command, name=name, **shown)
            continue
        if name == "serve":
            command = sys.modules["app.cli.server"].with_flags(command) if only == "serve" else _serve_without_flags
        settings = {"ignore_unknown_options": True} if name in NEGATIVE_ARGUMENTS else None
        app.command(name, context_settings=settings, **shown)(command)
    return app


def _serve_without_flags() -> None:
    """Start the server; with --demo also create a demo environment."""


def _show_version(flag: bool) -> None:
    if flag:
        sys.stdout.write(f"fleetmap {__version__}\n")
        raise typer.Exit
