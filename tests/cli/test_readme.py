"""The README's shell blocks work as they are pasted: the tour, and the command line after it."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.cli.conftest import TOKEN, ServerProcess
from tests.test_docs import README


def blocks(heading: str) -> list[str]:
    """The shell blocks of one section."""
    section = README.split(f"\n## {heading}\n")[1].split("\n## ")[0]
    return re.findall(r"^```sh\n(.*?)^```", section, re.DOTALL | re.MULTILINE)


def test_the_tour_and_the_command_line_work_as_pasted(tmp_path: Path) -> None:
    for tool in ("bash", "curl"):
        if shutil.which(tool) is None:
            (pytest.fail if os.environ.get("CI") else pytest.skip)(f"{tool} is not installed")
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "demo-token").write_text(TOKEN + "\n")
    process = ServerProcess(environment={"FLEETMAP_ADMIN_TOKEN": TOKEN}, folder=tmp_path)
    try:
        address = process.ready()
        tour, gdal = blocks("A tour of 60 seconds")
        assert "ogrinfo" in gdal
        gdal = gdal if shutil.which("ogrinfo") else ""
        (commands,) = blocks("The command line")
        pasted = "\n".join((tour, gdal, commands))
        assert "127.0.0.1:8000" in pasted
        folder = Path(__file__).parents[2]
        script = f"""
            set -euo pipefail
            curl() {{ command curl --no-progress-meter --fail-with-body "$@"; echo; }}
            fleetmap() {{ PYTHONPATH={folder} {sys.executable} -m app.cli "$@"; }}
            """
        script += pasted.replace("http://127.0.0.1:8000", address)
        told = subprocess.run(
            ["bash", "-c", script], cwd=tmp_path, capture_output=True, text=True, timeout=240, check=False
        )
        assert told.returncode == 0, told.stdout + told.stderr
    finally:
        process.stop()
    answers = [json.loads(line) for line in told.stdout.splitlines() if line.startswith(("{", "["))]
    created, uploaded, maps, report, history, channel = answers
    assert created["version"] == 1, "the tour says that the upload is version 2"
    assert (uploaded["version"], uploaded["warnings"]) == (2, [])
    assert {row["format"]: row["state"] for row in maps}["tmap2"] == "direct"
    assert report["format"] == "tmap2"
    assert [row["version"] for row in history] == [2, 1, 0]
    assert (channel["channel"], channel["version"]) == ("production", 2)
    assert "my-farm: nothing changed, version 2 stays" in told.stdout
    assert "my-farm: version 3 holds what version 1 holds" in told.stdout
    assert "edge_id" in (tmp_path / "network.tmap2.yaml").read_text()
    assert "<Placemark>" in (tmp_path / "my-farm.kml").read_text()
