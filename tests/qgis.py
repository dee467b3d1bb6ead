"""QGIS without a screen: scripts of tests run by a Python that has its modules.

``QGIS_PYTHON`` names that Python (``.ci/qgis`` makes one); without it, it is the system's. Writing needs QGIS 3.34.
"""

from __future__ import annotations

import functools
import json
import os
import subprocess
from pathlib import Path
from typing import Any

import pytest

PYTHON = os.environ.get("QGIS_PYTHON", "/usr/bin/python3")
START = """
import json, os, sys
from qgis.core import *
application = QgsApplication([], True)
application.initQgis()
def answer(result):
    print("RESULT" + json.dumps(result), flush=True)
    os._exit(0)  # QGIS crashes when it is torn down after its layers
"""


def run(script: str, *arguments: str | Path, folder: Path) -> Any:
    """Run a script that ends in ``answer(result)`` and return the result; ``folder`` is QGIS' home."""
    if version() < (3, 34):
        message = f"QGIS 3.34 is missing in {PYTHON}: set QGIS_PYTHON to the program that .ci/qgis makes"
        (pytest.fail if os.environ.get("CI") else pytest.skip)(message)
    folder.chmod(0o700)
    command = [PYTHON, "-c", START + script, *map(str, arguments)]
    environment = _environment() | {"HOME": str(folder), "XDG_RUNTIME_DIR": str(folder)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=300)
    lines = [line for line in done.stdout.splitlines() if line.startswith("RESULT")]
    assert len(lines) == 1, done.stdout[-2000:] + done.stderr[-2000:]
    return json.loads(lines[0].removeprefix("RESULT"))


@functools.cache
def version() -> tuple[int, int]:
    """Return the version of QGIS; (0, 0) if there is none."""
    if not Path(PYTHON).exists():
        return 0, 0
    command = [PYTHON, "-c", "from qgis.core import Qgis; print(Qgis.versionInt())"]
    done = subprocess.run(command, env=_environment(), capture_output=True, text=True, check=False, timeout=300)
    number = int(done.stdout) if done.returncode == 0 else 0
    return number // 10000, number // 100 % 100


def _environment() -> dict[str, str]:
    return {"QT_QPA_PLATFORM": "offscreen", "PATH": os.environ["PATH"], "LANG": "C.UTF-8"}
