"""What people see: places, bars, and nothing that a file could do to their terminal."""

from __future__ import annotations

import io
import os
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from app.cli import output
from app.cli.output_files import to_file
from app.cli.versions import change_line, counts


@pytest.mark.parametrize(
    ("problem", "line"),
    [
        ({"file": "a.yaml", "line": 3, "where": "nodes[0]", "problem": "is bad"}, "a.yaml:3: nodes[0]: is bad"),
        ({"line": 3, "problem": "is bad"}, "line 3: is bad"),
        ({"file": "a.yaml", "problem": "is bad"}, "a.yaml: is bad"),
        ({"problem": "is bad"}, "is bad"),
    ],
)
def test_problem_place_has_compiler_format(problem: dict[str, object], line: str) -> None:
    assert output.problem_place(problem) == line


def test_control_characters_of_files_are_removed(capsys: pytest.CaptureFixture[str]) -> None:
    hostile = "\x1b[2J[red]node[/red]\u202e\r\n"
    output.print_result(hostile)
    output.show_table(["name"], [[hostile]])
    output.show_problem({"detail": hostile, "errors": [{"file": hostile, "problem": hostile}]})
    captured = capsys.readouterr()
    for text in (captured.out, captured.err):
        assert "[red]node[/red]" in text
        assert not {"\x1b", "\u202e", "\r"} & set(text)


def test_many_problems_are_cut_short(capsys: pytest.CaptureFixture[str]) -> None:
    output.show_problem({"detail": "bad", "errors": [{"problem": f"p{k}"} for k in range(70)]}, limit=50)
    stderr = capsys.readouterr().err
    assert "p49" in stderr
    assert "p50" not in stderr
    assert "20 more" in stderr


def test_progress_bar_is_shown_only_on_terminals(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def work() -> str:
        capsys.readouterr()
        with output.progress_bar("uploading", total=10, count_bytes=True) as bar:
            bar.advance(4)
            bar.update(completed=10, description="done")
        return capsys.readouterr().err

    assert work() == ""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setenv("TERM", "xterm")
    assert "uploading" in work() or "done" in work()


def test_size_and_counts_are_formatted() -> None:
    assert [output.size(n) for n in (0, 999, 1500, 2_000_000, 3_000_000_000)] == [
        "0 B",
        "999 B",
        "1.5 kB",
        "2.0 MB",
        "3.0 GB",
    ]
    assert counts({"added": 2, "changed": 0, "document": True}) == "2 added, file header"
    assert counts({"map": {"freed": 3, "bbox": [0, 0, 1, 1]}}) == "map (3 freed)"
    assert counts({"added": 0}) == "unchanged"
    origin, turned = {"latitude": 53.25, "longitude": -0.5}, {"latitude": 53.25, "longitude": -0.5, "heading": 12.5}
    assert change_line("datum", {"from": None, "to": origin}) == "datum: none → 53.25, -0.5"
    assert change_line("datum", {"from": origin, "to": turned}) == "datum: 53.25, -0.5 → 53.25, -0.5, heading 12.5°"


def test_files_with_the_same_warning_share_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    alike = [{"file": f"f{k}.stl", "problem": "no format reads this file"} for k in range(5)]
    output.show_warnings([*alike, {"file": "a.yaml", "line": 3, "problem": "is odd"}])
    assert capsys.readouterr().err.splitlines() == [
        "warning: 5 files: no format reads this file: f0.stl, f1.stl, f2.stl and 2 more",
        "warning: a.yaml:3: is odd",
    ]
    output.show_warnings([{"problem": f"p{k}"} for k in range(30)], limit=20)
    stderr = capsys.readouterr().err
    assert "p19" in stderr
    assert "p20" not in stderr
    assert "10 more warnings" in stderr


def test_table_keeps_names_on_one_line_and_wraps_texts(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    name, reason = "riseholme_general_east_pathway", "upload an OSM file or a drawing with layer=topology " * 3
    row = (name, "1", "2026-05-01 08:30", reason)
    for columns in (12, 30, 60, 79, 80, 81, 160):
        monkeypatch.setenv("COLUMNS", str(columns))
        output.show_table(("environment", "version", "time (UTC)", "reason"), [row])
        stdout = capsys.readouterr().out
        assert max(map(len, stdout.splitlines())) <= columns
        if columns >= 80:
            assert name in stdout
            assert "2026-05-01 08:30" in stdout
        if columns >= 60:
            assert all(word in stdout for word in reason.split() if len(word) <= output.WORD)
        assert sorted("".join(stdout.split())) == sorted(
            "".join(("environment", "version", "time(UTC)", "reason", *row)).replace(" ", "")
        ), "nothing is cut off"


def test_pipe_is_written_to_and_not_replaced(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with ThreadPoolExecutor(1) as thread:
        read = thread.submit(pipe.read_bytes)
        to_file(pipe, io.BytesIO(b"content"))
        assert read.result(60) == b"content"
    assert pipe.is_fifo()
