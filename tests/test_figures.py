"""The tables of docs/security.md have the rows that tests/figures.py measures."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.figures import FAULTS, KINDS, Count, Outcome, table

TEXT = (Path(__file__).resolve().parents[1] / "docs" / "security.md").read_text()


def rows(head: str) -> list[list[str]]:
    """Return the rows of the table whose first header cell is ``head``."""
    lines = TEXT.partition(f"\n| {head} |")[2].partition("\n\n")[0].splitlines()[2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


@pytest.mark.parametrize(("head", "names"), [("kind of input", [*KINDS, "all"]), ("fault", list(FAULTS))])
def test_documented_table_has_the_measured_rows(head: str, names: list[str]) -> None:
    assert [row[0] for row in rows(head)] == names


def test_documented_figures_show_no_failure() -> None:
    measured = [list(map(int, row[1:6])) for row in rows("kind of input")]
    assert all(inputs == refused + warned + silent for inputs, refused, warned, silent, _ in measured)
    assert [failed for *_, failed in measured] == [0] * len(measured)
    assert [list(map(sum, zip(*measured[:-1], strict=True)))] == measured[-1:]
    assert [row[2:4] for row in rows("fault")] == [["0", "0"]] * len(FAULTS)


def test_outcomes_are_counted_by_status_and_warnings() -> None:
    count = Count()
    for status, warnings in ((201, True), (200, False), (422, False), (413, False), (503, False)):
        count.add(status, warnings)
    assert count.row("x")[:6] == ["x", 5, 2, 1, 1, 1]


def test_tables_are_markdown() -> None:
    text = table(["fault", "n"], Outcome(3, 1, 2, [1.0, 3.0, 8.0]).row("kill")[:2])
    assert text == "| fault | n |\n| --- | --- |\n| kill | 3 |"
    assert Outcome(3, 1, 2, [1.0, 3.0, 8.0]).row("kill") == ["kill", 3, 1, 2, "3.00", "8.00"]
