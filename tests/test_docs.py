"""What is not documented fails here: each setting, format and command stands in the README."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.main import get_command

from app.cli.commands import build
from app.config import Settings
from app.formats import all_formats

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text()


@pytest.mark.parametrize("name", sorted(Settings.model_fields))
def test_every_setting_stands_in_the_readme_with_its_meaning(name: str) -> None:
    line = next((row for row in README.splitlines() if row.startswith(f"| `FLEETMAP_{name.upper()}` |")), "")
    assert line, f"FLEETMAP_{name.upper()} is not in the README's table of settings"
    assert str(Settings.model_fields[name].description) in line


@pytest.mark.parametrize("name", sorted(all_formats()))
def test_every_format_stands_in_the_readme(name: str) -> None:
    assert f"`{name}`" in README


def test_every_command_stands_in_the_readme() -> None:
    names = sorted(get_command(build()).commands)  # type: ignore[attr-defined]
    assert names
    for name in names:
        assert f"fleetmap {name}" in README, f"the README does not mention `fleetmap {name}`"


def test_no_word_of_a_machine_or_a_workplace_stands_in_the_project() -> None:
    for path in ROOT.rglob("*"):
        relative = path.relative_to(ROOT)
        if path.suffix not in (".py", ".md", ".toml", ".yaml") or relative.parts[0].startswith((".", "data")):
            continue
        text = path.read_text(errors="replace")
        for word in ("/" + "work/", "/" + "root/"):
            assert word not in text, f"{relative} names a path of a machine"
