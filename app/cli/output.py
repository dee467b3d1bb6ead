"""What the command line prints: tables and progress for people, JSON for programs, problems for both.

Results go to standard output, everything else (progress, warnings, errors) to standard error, so that output can be
piped. Texts of files and servers are never read as markup, and their control characters never reach the terminal.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, Progress, SpinnerColumn, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

PIPED_WIDTH = 160
"""Columns where the output is no terminal that could tell its own width."""


def _console(*, stderr: bool) -> Console:
    stream = sys.stderr if stderr else sys.stdout
    width = None if stream.isatty() or os.environ.get("COLUMNS") else PIPED_WIDTH
    return Console(stderr=stderr, highlight=False, markup=False, emoji=False, width=width)


def plain(value: Any) -> str:
    """A value as one line of text without control characters."""
    text = "" if value is None else str(value)
    return "".join(c if c.isprintable() else " " for c in text)


def say(text: str, *, style: str | None = None) -> None:
    """A line for people, on standard error."""
    _console(stderr=True).print(Text(plain(text), style=style or ""), soft_wrap=True)


def show(text: str) -> None:
    """A line of the result, on standard output."""
    _console(stderr=False).print(Text(plain(text)), soft_wrap=True)


def show_json(value: Any) -> None:
    """A result as JSON on standard output."""
    sys.stdout.write(json.dumps(value, ensure_ascii=False, indent=2) + "\n")


def show_table(columns: Sequence[str], rows: Iterable[Sequence[Any]], *, title: str | None = None) -> None:
    """A table on standard output."""
    table = Table(title=Text(plain(title)) if title else None, box=None, pad_edge=False, title_justify="left")
    for column in columns:
        table.add_column(column, style="bold" if column == columns[0] else None, overflow="fold")
    for row in rows:
        table.add_row(*(Text(plain(cell)) for cell in row))
    _console(stderr=False).print(table)


def place(problem: Mapping[str, Any]) -> str:
    """One problem as compilers print it: ``file:line: where: what``."""
    head = str(problem.get("file") or "")
    if problem.get("line") is not None:
        head = f"{head}:{problem['line']}" if head else f"line {problem['line']}"
    parts = [head, str(problem.get("where") or ""), str(problem.get("problem") or "")]
    return ": ".join(part for part in parts if part)


def show_warnings(warnings: Sequence[Mapping[str, Any]], *, limit: int = 20) -> None:
    """Warnings on standard error, the first of many."""
    for warning in warnings[:limit]:
        say(f"warning: {place(warning)}", style="yellow")
    if len(warnings) > limit:
        say(f"… and {len(warnings) - limit} more warnings (--json shows all)", style="yellow")


def show_problem(problem: Mapping[str, Any], *, hint: str = "", as_json: bool = False, limit: int = 50) -> None:
    """An RFC 9457 problem on standard error: what went wrong, then each place as ``file:line: reason``."""
    if as_json:
        sys.stderr.write(json.dumps(problem, ensure_ascii=False, indent=2) + "\n")
        return
    detail = str(problem.get("detail") or problem.get("title") or "it failed")
    say(f"error: {detail}", style="bold red")
    errors = [e for e in problem.get("errors") or () if isinstance(e, Mapping)]
    for error in errors[:limit]:
        line = place(error)
        if line != detail:
            say(f"  {line}")
    if len(errors) > limit:
        say(f"  … and {len(errors) - limit} more")
    if hint:
        say(hint)


def size(count: int) -> str:
    """Bytes for people."""
    value = float(count)
    for unit in ("B", "kB", "MB"):
        if value < 1000:
            return f"{value:.0f} {unit}" if unit == "B" else f"{value:.1f} {unit}"
        value /= 1000
    return f"{value:.1f} GB"


class Bar:
    """One line of progress; it moves forward only where standard error is a terminal."""

    def __init__(self, progress: Progress | None, task: TaskID | None) -> None:
        self._progress, self._task = progress, task

    def advance(self, amount: float) -> None:
        """This much more is done."""
        if self._progress is not None and self._task is not None:
            self._progress.advance(self._task, amount)

    def update(
        self, *, completed: float | None = None, total: float | None = None, description: str | None = None
    ) -> None:
        """Set what is done, how much there is, or what is being done."""
        if self._progress is not None and self._task is not None:
            text = None if description is None else plain(description)
            self._progress.update(self._task, completed=completed, total=total, description=text)


@contextmanager
def progress_bar(description: str, *, total: float | None = None, count_bytes: bool = False) -> Iterator[Bar]:
    """A progress bar on standard error while the block runs; ``total=None`` shows that work goes on."""
    if not sys.stderr.isatty():
        yield Bar(None, None)
        return
    columns = [SpinnerColumn(), TextColumn("{task.description}", markup=False), BarColumn()]
    columns += [DownloadColumn()] if count_bytes else []
    with Progress(*columns, TimeElapsedColumn(), console=_console(stderr=True), transient=True) as progress:
        yield Bar(progress, progress.add_task(plain(description), total=total))
