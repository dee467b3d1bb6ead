"""Output of the command line: tables, progress, JSON and problems.

Results go to standard output, everything else (progress, warnings, errors) to standard error, so that output can be
piped. Texts of files and servers are never interpreted as markup, and their control characters are removed.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from rich.cells import cell_len
from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, Progress, SpinnerColumn, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

PIPED_WIDTH = 160
"""Width in columns if the output is not a terminal."""

WORD = 13
"""Maximum number of characters of words that tables do not break."""

GAP = 2
"""Number of spaces between the columns of a table."""

MAX_FILES_NAMED = 3
"""Maximum number of files listed in one line of a shared warning."""


def _console(*, stderr: bool) -> Console:
    stream = sys.stderr if stderr else sys.stdout
    width = None if stream.isatty() or os.environ.get("COLUMNS") else PIPED_WIDTH
    return Console(stderr=stderr, highlight=False, markup=False, emoji=False, width=width)


def single_line(value: Any) -> str:
    """Format a value as one line of text without control characters."""
    text = "" if value is None else str(value)
    return "".join(c if c.isprintable() else " " for c in text)


def print_status(text: str, *, style: str | None = None) -> None:
    """Print a line of status to standard error."""
    _console(stderr=True).print(Text(single_line(text), style=style or ""), soft_wrap=True)


def print_result(text: str, *, style: str | None = None) -> None:
    """Print a line of the result to standard output."""
    _console(stderr=False).print(Text(single_line(text), style=style or ""), soft_wrap=True)


def show_json(value: Any) -> None:
    """Print a result as JSON to standard output."""
    sys.stdout.write(json.dumps(value, ensure_ascii=False, indent=2) + "\n")


def show_table(columns: Sequence[str], rows: Iterable[Sequence[Any]], *, title: str | None = None) -> None:
    """Print a table to standard output. The first column stays on one line if possible; long texts wrap."""
    console = _console(stderr=False)
    cells = [[single_line(cell) for cell in row] for row in rows]
    table = Table(title=Text(single_line(title)) if title else None, box=None, pad_edge=False, title_justify="left")
    texts = [list(column) for column in zip(columns, *cells, strict=True)]
    for number, width in enumerate(_widths(texts, console.width)):
        style = "bold" if number == 0 else None
        table.add_column(columns[number], style=style, overflow="fold", width=width)
    for row in cells:
        table.add_row(*(Text(cell) for cell in row))
    console.print(table)


def show_members(members: Mapping[str, Any]) -> None:
    """Print one object: a line for each member with a value."""
    width = max((len(name) for name in members), default=0)
    for name, value in members.items():
        if value not in (None, "", [], {}):
            print_result(f"{name.ljust(width)}  {value}")


def minute(time: Any) -> str:
    """Shorten an RFC 3339 time of the API (UTC) to the minute: ``2026-05-01 08:30``."""
    return str(time or "")[:16].replace("T", " ")


def datum(datum: Any) -> str:
    """Format a datum: ``53.25, -0.5, heading 12.5°``."""
    if not isinstance(datum, Mapping):
        return "none"
    heading = datum.get("heading")
    return f"{datum.get('latitude')}, {datum.get('longitude')}{f', heading {heading:g}°' if heading else ''}"


def _widths(columns: Sequence[Sequence[str]], room: int) -> list[int]:
    """Return the width of each column of a table, in characters; ``room`` is the width of the terminal.

    Each column gets the width of a word. Then the first column, then the narrowest ones, get their full width as long
    as half of the remaining room is left for the others, which share it.
    """
    full = [max(map(cell_len, texts)) for texts in columns]
    words = [max((cell_len(word) for text in texts for word in text.split()), default=1) for texts in columns]
    widths = [max(1, min(WORD, word)) for word in words]
    left = room - GAP * (len(columns) - 1) - sum(widths)
    while left < 0 and max(widths) > 1:  # narrow terminal: words are broken
        widths[widths.index(max(widths))] -= 1
        left += 1
    for number in sorted(range(len(columns)), key=lambda n: (n > 0, full[n])):
        more = max(0, full[number] - widths[number])
        if more <= (left if number == 0 else left // 2):
            widths[number] += more
            left -= more
    wanting = [n for n in range(len(columns)) if widths[n] < full[n]]
    while left > 0 and wanting:
        for number in wanting[:left]:
            widths[number] += 1
            left -= 1
        wanting = [n for n in wanting if widths[n] < full[n]]
    return widths


def problem_place(problem: Mapping[str, Any]) -> str:
    """Format a problem like a compiler: ``file:line: where: what``."""
    head = str(problem.get("file") or "")
    if problem.get("line") is not None:
        head = f"{head}:{problem['line']}" if head else f"line {problem['line']}"
    parts = [head, str(problem.get("where") or ""), str(problem.get("problem") or "")]
    return ": ".join(part for part in parts if part)


def show_warnings(warnings: Sequence[Mapping[str, Any]], *, limit: int = 20) -> None:
    """Print warnings to standard error, at most ``limit`` lines. Files with the same warning share a line."""
    lines: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for number, warning in enumerate(warnings):
        whole_file = warning.get("file") and warning.get("line") is None and not warning.get("where")
        lines.setdefault((warning.get("problem"),) if whole_file else (number,), []).append(warning)
    groups = list(lines.values())
    for alike in groups[:limit]:
        names = ", ".join(str(w["file"]) for w in alike[:MAX_FILES_NAMED]) if len(alike) > 1 else ""
        more = f" and {len(alike) - MAX_FILES_NAMED} more" if len(alike) > MAX_FILES_NAMED else ""
        line = f"{len(alike)} files: {alike[0].get('problem')}: {names}{more}" if names else problem_place(alike[0])
        severe = alike[0].get("level") == "error"
        print_status(f"{'would be rejected' if severe else 'warning'}: {line}", style="red" if severe else "yellow")
    if len(groups) > limit:
        print_status(f"… and {sum(map(len, groups[limit:]))} more warnings (--json shows all)", style="yellow")


def show_problem(problem: Mapping[str, Any], *, hint: str = "", as_json: bool = False, limit: int = 50) -> None:
    """Print an RFC 9457 problem to standard error: the detail, then each error as ``file:line: reason``."""
    if as_json:
        sys.stderr.write(json.dumps(problem, ensure_ascii=False, indent=2) + "\n")
        return
    detail = str(problem.get("detail") or problem.get("title") or "failed")
    print_status(f"error: {detail}", style="bold red")
    errors = [e for e in problem.get("errors") or () if isinstance(e, Mapping)]
    for error in errors[:limit]:
        line = problem_place(error)
        if line != detail:
            print_status(f"  {line}")
    if len(errors) > limit:
        print_status(f"  … and {len(errors) - limit} more")
    if hint:
        print_status(hint)


def size(count: int) -> str:
    """Format a number of bytes with its unit."""
    value = float(count)
    for unit in ("B", "kB", "MB"):
        if value < 1000:
            return f"{value:.0f} {unit}" if unit == "B" else f"{value:.1f} {unit}"
        value /= 1000
    return f"{value:.1f} GB"


class ProgressBar:
    """Progress in one line; shown only if standard error is a terminal."""

    def __init__(self, progress: Progress | None, task: TaskID | None) -> None:
        self._progress, self._task = progress, task

    def advance(self, amount: float) -> None:
        """Add an amount of completed work."""
        if self._progress is not None and self._task is not None:
            self._progress.advance(self._task, amount)

    def update(
        self, *, completed: float | None = None, total: float | None = None, description: str | None = None
    ) -> None:
        """Set the completed or total amount, or the description."""
        if self._progress is not None and self._task is not None:
            text = None if description is None else single_line(description)
            self._progress.update(self._task, completed=completed, total=total, description=text)


@contextmanager
def progress_bar(description: str, *, total: float | None = None, count_bytes: bool = False) -> Iterator[ProgressBar]:
    """Show a progress bar on standard error during the ``with`` block; without ``total`` it shows activity only."""
    if not sys.stderr.isatty():
        yield ProgressBar(None, None)
        return
    columns = [SpinnerColumn(), TextColumn("{task.description}", markup=False), BarColumn()]
    columns += [DownloadColumn()] if count_bytes else []
    with Progress(*columns, TimeElapsedColumn(), console=_console(stderr=True), transient=True) as progress:
        yield ProgressBar(progress, progress.add_task(single_line(description), total=total))
