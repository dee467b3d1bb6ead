"""The robot's install and the agent's tests on Python 3.10: ROS 2 Humble's."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.agent.conftest import ROOT, Robot, Start, find_python310, network, whole
from tests.api.conftest import Api
from tests.events.conftest import eventually

SERVER = re.compile(
    r"^(from|import) (tests\.(api\.conftest|cli|bench|certificates)|app\.(api|store|events\.(bus|router)))",
    re.MULTILINE,
)
"""Imports of a test module that needs the server's packages."""


@pytest.fixture(scope="module")
def python310(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The interpreter of an environment with the robot's install, from the lock file; its bytecode goes with it."""
    python = find_python310()
    assert python is not None  # else this file is not collected
    uv = shutil.which("uv") or str(Path(sys.executable).with_name("uv"))
    place = tmp_path_factory.mktemp("python310") / "venv"
    command = [uv, "sync", "--frozen", "--no-editable", "--no-default-groups", "--group", "robot", "--quiet"]
    ended = subprocess.run(
        [*command, "--no-python-downloads", "--python", python],
        cwd=ROOT,
        env={**os.environ, "UV_PROJECT_ENVIRONMENT": str(place), "UV_SYSTEM_CERTS": "true"},
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPYCACHEPREFIX", str(place.with_name("bytecode")))
        yield place / "bin" / "python"


def fleetmap(python: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """The installed command, away from the checkout."""
    command = [python.with_name("fleetmap"), *arguments]
    return subprocess.run(command, cwd=python.parent, capture_output=True, text=True, timeout=60, check=False)


def test_agent_install_on_python_3_10_is_complete(python310: Path, tmp_path: Path) -> None:
    assert fleetmap(python310, "--version").stdout.startswith("fleetmap ")
    assert "--on-change" in fleetmap(python310, "agent", "--help").stdout
    ended = fleetmap(python310, "agent", "--ros-package", str(tmp_path))
    assert ended.returncode == 0, ended.stderr
    assert (tmp_path / "fleetmap_ros" / "resource" / "fleetmap_ros").is_file(), "it is part of the wheel"
    script = (
        "from app.agent import hooks; print(*hooks.bundled_hooks()); import app.agent.agent, sys; print(*sys.modules)"
    )
    listed = subprocess.run([python310, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=True)
    ready, loaded = listed.stdout.splitlines()
    assert ready.split() == ["nav2", "topological"]
    assert not {"pydantic", "numpy", "fastapi", "sqlalchemy"} & {m.partition(".")[0] for m in loaded.split()}


@pytest.mark.parametrize(
    "arguments",
    [
        ["serve"], ["serve", "--help"], ["migrate"], ["formats"], ["generate"], ["template"], ["derive"],
        ["check", "."], ["convert", ".", "--to", "kml", "-o", "-"], ["generate", "cave", "--to", "kml", "-o", "-"],
    ],
)  # fmt: skip
def test_server_commands_name_required_python(python310: Path, arguments: list[str]) -> None:
    ended = fleetmap(python310, *arguments)
    assert ended.returncode == 1
    assert f"fleetmap {arguments[0]}" in ended.stderr
    assert "requires Python 3.11 or newer, this is 3.10." in ended.stderr
    assert "Traceback" not in ended.stderr


def test_agent_on_python_3_10_follows_server(
    python310: Path, api: Api, place: str, robot: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Events over Zenoh, a delta, the signature, the status: a real agent process of the installed packages."""
    monkeypatch.setenv("FLEETMAP_TEST_PYTHON", str(python310))
    one: Robot = robot(name="humble")
    one.wait("active", seconds=60, version=1)
    one.wait("connected", seconds=60)
    api.upload(place, {"n.tmap2.yaml": network(1.0)})
    one.wait("active", seconds=60, version=2)
    assert whole(one.into)["version"] == 2
    eventually(lambda: [r for r in api.get("robots").json() if r["robot"] == "humble" and r["version"] == 2])
    assert one.stop() == 0


REPETITIONS = (
    "test_kill_at_random_moments_of_hooks_ends_consistently",
    "(test_agent_recovers_from_disk_error_at_each_step and killed)",
    "test_hook_printing_a_gigabyte_is_rolled_back",
    "test_hook_variables_of_many_changed_files_are_truncated",
    "test_topological_hook_checks_published_map",
)
"""Tests that repeat what a shorter test beside them does, many times or with much data: on one Python."""

PARTS = 2

OWN = sorted(p for p in Path(__file__).parent.rglob("test_*.py") if not SERVER.search(p.read_text()))


def test_agent_tests_are_found() -> None:
    assert {"test_hooks.py", "test_bad_server.py", "test_grids.py", "test_node.py"} <= {p.name for p in OWN}
    text = "".join(path.read_text() for path in OWN)
    for name in re.findall(r"test_\w+", " ".join(REPETITIONS)):
        assert text.count(f"def {name}(") == 1, name


@pytest.mark.parametrize("part", range(PARTS))
def test_agent_tests_pass_on_python_3_10(python310: Path, part: int, tmp_path: Path) -> None:
    """Tests of this folder that need no server: each process imports for seconds, so it takes several files."""
    clean = {k: v for k, v in os.environ.items() if not k.startswith(("PYTEST_", "FLEETMAP_"))}
    ended = subprocess.run(
        [python310, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-c", ROOT / "pyproject.toml", "--rootdir", ROOT,
         "--confcutdir", ROOT / "tests" / "agent", "--basetemp", tmp_path / "tests",
         "-k", f"not ({' or '.join(REPETITIONS)})", *OWN[part::PARTS]],
        cwd=ROOT, env=clean, capture_output=True, text=True, timeout=280, check=False,
    )  # fmt: skip
    assert ended.returncode == 0, ended.stdout[-8000:] + ended.stderr[-2000:]
    assert re.search(r"\d+ passed", ended.stdout), ended.stdout[-500:]
