"""Plug-ins: the documented example works, and a broken plug-in does not stop the server."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "contributing" / "plug-ins.md"


def example() -> dict[str, str]:
    """Read the files on the page: name -> text."""
    return dict(re.findall(r'```\w+ title="([^"]+)"\n(.*?)```', PAGE.read_text(), re.DOTALL))


def install(folder: Path, project: str, modules: dict[str, str]) -> None:
    """Write the files of an installed distribution to a folder of packages."""
    metadata = tomllib.loads(project)["project"]
    info = folder / f"{metadata['name'].replace('-', '_')}-{metadata['version']}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {metadata['name']}\nVersion: {metadata['version']}\n")
    groups = metadata["entry-points"].items()
    lines = [line for group, entries in groups for line in (f"[{group}]", *(f"{n} = {v}" for n, v in entries.items()))]
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n")
    for name, text in modules.items():
        (folder / name).write_text(text)


def run(packages: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(packages), str(ROOT)])}
    command = [sys.executable, "-c", "from app.cli import main; main()", *arguments]
    return subprocess.run(command, env=environment, cwd=packages, capture_output=True, text=True, check=False)


def test_documented_plug_in_lists_reads_and_writes(tmp_path: Path) -> None:
    files = example()
    install(tmp_path, files.pop("pyproject.toml"), files)
    listed = run(tmp_path, "formats", "--json")
    assert listed.returncode == 0, listed.stderr
    assert "poles" in [fmt["id"] for fmt in json.loads(listed.stdout)]
    assert listed.stderr == ""
    (tmp_path / "site.poles").write_text("# poles\nb 3 4\na 1 2.5\n")
    converted = run(tmp_path, "convert", "site.poles", "--to", "geojson", "-o", "out.geojson")
    assert converted.returncode == 0, converted.stderr
    assert len(json.loads((tmp_path / "out.geojson").read_text())["features"]) == 2
    back = run(tmp_path, "convert", "out.geojson", "--to", "poles", "-o", "back.poles")
    assert back.returncode == 0, back.stderr
    assert (tmp_path / "back.poles").read_text() == "# poles\na 1.000 2.500\nb 3.000 4.000\n"


def test_broken_plug_ins_are_reported_and_skipped(tmp_path: Path) -> None:
    module = example()["fleetmap_poles.py"]
    broken = {
        "absent": module.replace("import numpy", "import no_such_module"),
        "ancient": module.replace("FLEETMAP_INTERFACE = 1", "FLEETMAP_INTERFACE = 0"),
        "silent": module.replace("FLEETMAP_INTERFACE = 1", ""),
        "rival": module.replace('name="poles"', 'name="kml"'),
        "steps": "FLEETMAP_INTERFACE = 1\nraise RuntimeError('no such step')\n",
    }
    for name, text in broken.items():
        group = "derivations" if name == "steps" else "formats"
        entry = f'[project.entry-points."fleetmap.{group}"]\np = "x_{name}"'
        project = f'[project]\nname = "x-{name}"\nversion = "2"\n{entry}'
        install(tmp_path, project, {f"x_{name}.py": text})
    listed = run(tmp_path, "formats", "--json")
    assert listed.returncode == 0, listed.stderr
    formats = {fmt["id"]: fmt["title"] for fmt in json.loads(listed.stdout)}
    assert "poles" not in formats
    assert formats["kml"] == "KML"
    errors = [line for line in listed.stderr.splitlines() if "is not used" in line]
    assert errors == [
        "plug-in p of x-absent 2 is not used: No module named 'no_such_module'",
        "plug-in p of x-ancient 2 is not used: it was written for interface 0; this server has interface 1",
        "plug-in p of x-rival 2 is not used: format kml is already registered",
        "plug-in p of x-silent 2 is not used: it declares no FLEETMAP_INTERFACE; this server has interface 1",
        "plug-in p of x-steps 2 is not used: no such step",
    ]
