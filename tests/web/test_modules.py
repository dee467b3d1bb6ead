"""Modules of the page without a browser: each `*.check.ts` is a program for Node, which fails with what is wrong."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

WEB = Path(__file__).resolve().parents[2] / "app" / "web"
CHECKS = sorted(path.relative_to(WEB).as_posix() for path in (WEB / "src").rglob("*.check.ts"))


def test_checks_are_found() -> None:
    assert CHECKS


@pytest.mark.parametrize("check", CHECKS)
def test_module_does_what_its_check_says(check: str, tmp_path: Path) -> None:
    bundler, program = WEB / "node_modules" / ".bin" / "rolldown", tmp_path / "check.mjs"
    arguments = [str(bundler), check, "--file", str(program), "--platform", "node", "--no-codeSplitting"]
    subprocess.run(arguments, cwd=WEB, check=True, capture_output=True, timeout=120)
    done = subprocess.run(["node", str(program)], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
