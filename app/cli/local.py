"""Python version check of commands that run the server's code on this machine (``serve``, ``convert``, …)."""

from __future__ import annotations

import platform
import sys

from app.errors import FleetMapError

SERVER_PYTHON = (3, 11)
"""Minimum Python of the server's code; ``agent`` and commands that call a server run from 3.10 on."""


class NotInstalled(FleetMapError):
    """The command needs code that this installation cannot run."""


def require_server_python(command: str) -> None:
    """Check the interpreter before the server's code is imported. Raises NotInstalled."""
    if sys.version_info < SERVER_PYTHON:
        raise NotInstalled(
            f"fleetmap {command} requires Python 3.11 or newer, this is {platform.python_version()}: "
            "install it with a newer Python, for example "
            'pipx install --python python3.12 "fleet-map-server[server]"'
        )
