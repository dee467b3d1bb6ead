"""The judge of derived maps: what it refuses, what it prints, and that every label file of ours can be used."""

from __future__ import annotations

import hashlib
import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from PIL import Image

from tests.derive import judge
from tests.derive.judge import BadLabels, Case, Figure, Result, cases, kinds
from tests.derive.judge.__main__ import OWN, main


def label(folder: Path, name: str = "yard", **labels: Any) -> Path:
    path = folder / f"{name}{judge.SUFFIX}"
    path.write_text(yaml.safe_dump({"kind": sorted(kinds())[0], "labelled": "by eye", **labels}))
    return path


def test_figure_is_kept_within_its_bounds_only() -> None:
    assert [Figure("share", v, at_least=0.9, at_most=1.1).is_kept for v in (0.8, 0.9, 1.1, 1.2, math.nan)] == [
        *(False, True, True, False, False)
    ]
    assert Figure("count", 7.0).is_kept
    assert Figure("ratio", 1.0, at_least=0.5, at_most=2.0).bound == "≥ 0.5 and ≤ 2"


def test_maps_are_those_that_were_labelled(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "map.png").write_bytes(b"a map")
    right = hashlib.sha256(b"a map").hexdigest()
    label(tmp_path, map="map.png", sha256=right, plan="plan.png")
    (case,) = cases(tmp_path, tmp_path / "data")
    assert case.name == "yard"
    assert case.file() == tmp_path / "data" / "map.png"
    with pytest.raises(BadLabels, match=r"yard\.labels\.yaml: plan plan\.png is in none of"):
        case.file("plan")
    label(tmp_path, map="map.png", sha256="0" * 64)
    (case,) = cases(tmp_path, tmp_path / "data")
    with pytest.raises(BadLabels, match="is not the file that was labelled"):
        case.file()


def test_labels_of_unknown_kind_are_named(tmp_path: Path) -> None:
    path = label(tmp_path, kind="anything")
    with pytest.raises(BadLabels, match=f"{path.name}: kind is 'anything'; known: "):
        list(cases(tmp_path))


def test_judge_prints_figures_and_writes_pictures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    kind = sorted(kinds())[0]
    for name in ("good", "poor"):
        label(tmp_path, name)

    def judged(case: Case) -> Result:
        figures = [Figure("coverage", np.float64(0.95 if case.name == "good" else math.nan), at_least=0.9)]
        return Result(figures, Image.new("RGB", (4, 3)), 1.5, 20.0, case)

    monkeypatch.setattr("tests.derive.judge.__main__.judged", judged)
    for more, status, count in ((["--only", "good"], 0, 1), ([], 1, 2), (["--only", "none"], 2, 0)):
        arguments = ["judge", str(tmp_path), "--json", "--pictures", str(tmp_path / "out"), *more]
        monkeypatch.setattr(sys, "argv", arguments)
        assert main() == status
        printed = capsys.readouterr()
        rows = json.loads(printed.out) if printed.out else []
        assert len(rows) == count
        assert all(
            (row["kept"], row["value"]) == ((True, 0.95) if row["case"] == "good" else (False, None)) for row in rows
        )
    assert "no file *.labels.yaml" in printed.err
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [f"{kind}-good.png", f"{kind}-poor.png"]
    monkeypatch.setattr(sys, "argv", ["judge", str(tmp_path), "--only", "poor"])
    assert main() == 1
    assert "missed" in capsys.readouterr().out


def test_every_label_file_of_ours_names_its_map_and_how_it_was_labelled(shared: Path) -> None:
    chosen = list(cases(OWN, shared / "data"))
    assert {case.kind for case in chosen} == set(kinds())
    for case in chosen:
        assert len(str(case.labels["labelled"])) > 10, case.path
        if "map" in case.labels and "source" not in case.labels:  # maps of a source are fetched by whoever judges them
            assert case.file().is_file()


def test_command_line_says_what_it_does() -> None:
    command = [sys.executable, "-m", "tests.derive.judge", "--help"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    assert "--pictures" in ended.stdout
