"""The package as it is copied into a workspace."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
import yaml

from app.agent import ros
from app.errors import Conflict

TOP = Path(__file__).parents[3]


def fleetmap(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "app.cli", *arguments], cwd=TOP, capture_output=True, text=True, timeout=60, check=False
    )


def test_ros_package_is_copied_and_replaced(tmp_path: Path) -> None:
    ended = fleetmap("agent", "--ros-package", str(tmp_path / "src"))
    assert ended.returncode == 0, ended.stderr
    target = tmp_path / "src" / "fleetmap_ros"
    assert "colcon build" in ended.stderr
    for name in ("package.xml", "setup.py", "setup.cfg", "resource/fleetmap_ros", "launch/fleetmap_agent.launch.py"):
        assert (target / name).is_file(), name
    assert {p.name for p in (target / "fleetmap_ros").iterdir()} == {
        "__init__.py", "control.py", "grids.py", "hook.py", "loading.py", "node.py",
    }  # fmt: skip
    (target / "fleetmap_ros" / "old.py").touch()
    ros.copy_package(tmp_path / "src")
    assert not (target / "fleetmap_ros" / "old.py").exists()


def test_foreign_folder_is_not_replaced_by_ros_package(tmp_path: Path) -> None:
    (tmp_path / "fleetmap_ros").mkdir()
    (tmp_path / "fleetmap_ros" / "mine").touch()
    with pytest.raises(Conflict, match="is not a copy of fleetmap_ros"):
        ros.copy_package(tmp_path)
    assert (tmp_path / "fleetmap_ros" / "mine").exists()


def test_ros_package_imports_nothing_of_this_distribution(tmp_path: Path) -> None:
    package = ros.copy_package(tmp_path) / "fleetmap_ros"
    declared = {e.text for e in ET.parse(package.parent / "package.xml").getroot().iter("exec_depend")}
    for path in (*package.glob("*.py"), *(package.parent / "launch").glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) and not node.level else []
            for name in (n.partition(".")[0] for n in names):
                assert name in sys.stdlib_module_names or name in declared | {"yaml"}, f"{path.name} imports {name}"
    script = "from fleetmap_ros import control, grids, hook, loading; print(control.Settings())"
    ended = subprocess.run(
        [sys.executable, "-I", "-c", f"import sys; sys.path.insert(0, {str(package.parent)!r}); {script}"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr


def test_files_agree_on_names_and_version() -> None:
    setup, launch = (
        (ros.FOLDER / "setup.py").read_text(),
        (ros.FOLDER / "launch" / "fleetmap_agent.launch.py").read_text(),
    )
    root = ET.parse(ros.FOLDER / "package.xml").getroot()
    assert root.findtext("name") == "fleetmap_ros"
    assert f'version="{root.findtext("version")}"' in setup
    assert 'package="fleetmap_ros"' in launch
    assert 'executable="fleetmap_agent"' in launch
    assert "fleetmap_agent = fleetmap_ros.node:main" in setup
    for name in re.findall(r'\["((?:launch|config)/[^"]+|package\.xml)"\]', setup):
        assert (ros.FOLDER / name).is_file()


def test_sample_parameters_are_valid() -> None:
    from app.agent.ros.fleetmap_ros.control import Settings

    body = yaml.safe_load((ros.FOLDER / "config" / "fleetmap_agent.yaml").read_text())
    settings = Settings.from_parameters(body["fleetmap_agent"]["ros__parameters"])
    assert settings.formats == ("occupancy_grid", "nav2_route")
    page = (TOP / "docs" / "how-to" / "nav2.md").read_text()
    for name in Settings.__dataclass_fields__:
        assert f"`{name}`" in page, f"docs/how-to/nav2.md does not name the parameter {name}"
