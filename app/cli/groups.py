"""Command groups: help in panels, ``--json`` before or after a command, and proposals for mistyped names."""

from __future__ import annotations

import inspect
import os
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import typer
from typer.core import TyperCommand, TyperGroup, TyperOption

from app.model.names import did_you_mean, nearest

if TYPE_CHECKING:
    from typer._click import Context, HelpFormatter

MAX_WIDTH = 120
"""Maximum width of help in columns."""

PIPED_WIDTH = 100
"""Width of help in columns if the output is not a terminal."""

JSON = "fleetmap.json"
"""Key in a context's ``meta``: whether ``--json`` precedes the command."""

LIST = "list"
"""Default command of a ``ListGroup``."""


class Command(TyperCommand):
    """Command with help in panels and a proposal for an unknown option."""

    def parse_args(self, ctx: Context, args: list[str]) -> list[str]:
        """Parse the arguments."""
        with _naming_options(self, ctx):
            return super().parse_args(ctx, args)
        raise AssertionError("unreachable")

    def format_help(self, ctx: Context, formatter: HelpFormatter) -> None:  # noqa: ARG002  the base class's
        """Print the help, as wide as the terminal."""
        show_help(self, ctx)


class Group(TyperGroup):
    """Command group that accepts ``--json`` before a command as well, with a proposal for an unknown command."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        self.suggest_commands = False  # replaces Typer's own suggestions
        self.params.append(
            TyperOption(
                param_decls=["--json"],
                is_flag=True,
                default=False,
                required=False,
                expose_value=False,
                callback=_note_json,
                help="Print machine-readable JSON; also after the command.",
            )
        )

    def resolve_command(self, ctx: Context, args: list[str]) -> tuple[str | None, Any, list[str]]:
        """Find the command of the first argument and pass ``--json`` on to it."""
        if not ctx.resilient_parsing and not args[0].startswith("-") and args[0] not in self.commands:
            ctx.fail(f"unknown command {args[0]}{did_you_mean(args[0], self.commands)}")
        name, command, rest = super().resolve_command(ctx, args)
        return name, command, ["--json", *rest] if ctx.meta.pop(JSON, False) else rest

    def parse_args(self, ctx: Context, args: list[str]) -> list[str]:
        """Parse the arguments."""
        with _naming_options(self, ctx):
            return super().parse_args(ctx, args)
        raise AssertionError("unreachable")

    def format_help(self, ctx: Context, formatter: HelpFormatter) -> None:  # noqa: ARG002  the base class's
        """Print the help, as wide as the terminal."""
        show_help(self, ctx)


class ListGroup(Group):
    """Command group with the default command ``list``: ``channels farm`` is ``channels list farm``."""

    def parse_args(self, ctx: Context, args: list[str]) -> list[str]:
        """Insert ``list`` before arguments that start with neither a command nor a misspelled one."""
        if not ctx.resilient_parsing:
            first = next((argument for argument in args if argument != "--json"), "-")
            named = first == "--help" or (not first.startswith("-") and nearest(first, self.commands) is not None)
            args = args if named else [LIST, *args]
        return super().parse_args(ctx, args)


class Commands(typer.Typer):
    """Typer application with the command and group classes of this module."""

    def __init__(self, help: str, *, cls: type[Group] = ListGroup, **attributes: Any) -> None:
        super().__init__(cls=cls, help=help, rich_markup_mode=None, **attributes)

    def command(self, name: str | None = None, **attributes: Any) -> Callable[[Any], Any]:
        """Register a function as a command."""
        return super().command(name, **{"cls": Command, **attributes})


@contextmanager
def _naming_options(command: Command | Group, ctx: Context) -> Iterator[None]:
    """Report unknown options in the style of all other errors."""
    try:
        yield
    except Exception as error:  # the class is Typer's or click's, depending on the release
        if type(error).__name__ != "NoSuchOption":
            raise
        option = getattr(error, "option_name", "")
        names = [name for parameter in command.get_params(ctx) for name in parameter.opts if name.startswith("--")]
        ctx.fail(f"unknown option {option}{did_you_mean(option, names)}")


def show_help(command: Command | Group, ctx: Context) -> None:
    """Print the help of a command in panels, coloured, as wide as the terminal up to MAX_WIDTH."""
    from typer import rich_utils

    texts: list[Any] = [command, *command.get_params(ctx)]
    texts += [*command.commands.values()] if isinstance(command, Group) else []
    for text in texts:
        if getattr(text, "help", None):
            text.help = _markup(text.help)
    rich_utils.MAX_WIDTH = _width()
    rich_utils.FORCE_TERMINAL = None  # rich chooses colours and respects FORCE_COLOR and NO_COLOR
    rich_utils.rich_format_help(obj=command, ctx=ctx, markup_mode="rich")


def _width() -> int:
    piped = not sys.stdout.isatty() and not os.environ.get("COLUMNS")
    return PIPED_WIDTH if piped else min(MAX_WIDTH, shutil.get_terminal_size().columns)


def _markup(text: str) -> str:
    """Turn a help text into rich's markup: its paragraphs unwrapped, brackets literal, code between `…` coloured."""
    from rich.markup import escape

    paragraphs = inspect.cleandoc(text).split("\n\n")
    lines = [p if p.startswith("Example") else " ".join(p.split()) for p in paragraphs]
    parts = escape("\n\n".join(lines)).split("`")
    return "".join(f"[cyan]`{part}`[/]" if number % 2 else part for number, part in enumerate(parts))


def _note_json(ctx: Context, parameter: Any, value: bool) -> bool:  # noqa: ARG001  Typer's signature
    if value:
        ctx.meta[JSON] = True
    return value


def first_command(arguments: Sequence[str]) -> str | None:
    """Return the first argument that is not an option: the command, since no option before it takes a value."""
    return next((argument for argument in arguments if not argument.startswith("-")), None)
