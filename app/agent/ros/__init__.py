"""Copy the ROS 2 package ``fleetmap_ros`` into a workspace.

This folder is the complete package (``package.xml``, ``setup.py`` …). It imports nothing of this distribution and
starts ``fleetmap agent`` as a process, so that the agent may be installed apart from rclpy (for example with pipx).
"""

from __future__ import annotations

import shutil
from pathlib import Path

from app.errors import Conflict

FOLDER = Path(__file__).resolve().parent
FILES = ("package.xml", "setup.py", "setup.cfg", "resource", "launch", "config", "fleetmap_ros")


def copy_package(workspace: Path) -> Path:
    """Copy the package to ``workspace/fleetmap_ros``, replacing an older copy; return that folder.

    Raises Conflict if the folder is not a copy of the package.
    """
    target = workspace / "fleetmap_ros"
    if target.exists():
        if (
            not (target / "package.xml").is_file()
            or "<name>fleetmap_ros</name>" not in (target / "package.xml").read_text()
        ):
            raise Conflict(f"{target} exists and is not a copy of fleetmap_ros: choose another folder")
        shutil.rmtree(target)
    target.mkdir(parents=True)
    ignored = shutil.ignore_patterns("__pycache__", "*.pyc")
    for name in FILES:
        source = FOLDER / name
        if source.is_dir():
            shutil.copytree(source, target / name, ignore=ignored)
        else:
            shutil.copyfile(source, target / name)
    return target
