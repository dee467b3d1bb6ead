"""Commands that run the server's code on this machine (``serve``, ``convert``, ``check`` …) need a newer Python."""

from __future__ import annotations

import platform
import sys

from app.errors import FleetMapError

SERVER_PYTHON = (3, 11)
"""Oldest Python of the server's code; ``agent`` and the commands that call a server run from 3.10 on."""


class NotInstalled(FleetMapError):
    """The command needs code that this installation cannot run."""


def require_server_python(command: str) -> None:
    """Check the interpreter before the server's code is imported. Raises NotInstalled."""
    if sys.version_info < SERVER_PYTHON:
        raise NotInstalled(
            f"fleetmap {command} runs the server's code, which needs Python 3.11 or newer, and this is "
            f"{platform.python_version()}: install it with a newer one, for example "
            'pipx install --python python3.12 "fleet-map-server[server]"'
        )
