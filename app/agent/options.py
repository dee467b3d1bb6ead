"""Options of the agent: which map of which server, where to keep it, and which commands to run."""

from __future__ import annotations

import re
import socket
from dataclasses import dataclass, field
from pathlib import Path

from app.errors import Invalid
from app.events import messages
from app.events.credentials import ZenohCredentials

POLL_SECONDS = 60.0


@dataclass(frozen=True, slots=True)
class AgentOptions:
    """Options of one agent.

    Attributes:
        channel: None follows ``production`` if it exists, else ``latest``.
        formats, optional: entries such as ``occupancy_grid?level=L2``; optional ones are installed if available.
        before_switch: commands that decide when the robot may switch to a new map.
        on_change: commands that load a map after the switch.
        key: server key to trust at first contact.
        zenoh_login: credentials for the router; the default user of a password is the robot's name.
        ca: certification authority of the server (PEM).
    """

    server: str
    environment: str
    formats: tuple[str, ...]
    into: Path
    channel: str | None = None
    robot: str = ""
    on_change: tuple[str, ...] = ()
    token: str | None = None
    key: str | None = None
    poll_seconds: float = POLL_SECONDS
    zenoh_connect: str | None = None
    zenoh_prefix: str | None = None
    zenoh_config: Path | None = None
    zenoh_login: ZenohCredentials = field(default_factory=ZenohCredentials)
    ca: Path | None = None
    before_switch: tuple[str, ...] = ()
    optional: tuple[str, ...] = ()


def robot_name(text: str | None = None) -> str:
    """Return a valid robot name; default: derived from the host name. Raises Invalid."""
    name = text or re.sub(r"[^A-Za-z0-9_.-]", "-", socket.gethostname()).lstrip("_.-") or "robot"
    if not messages.ROBOT_NAME.fullmatch(name):
        raise Invalid(f"invalid robot name {name[:80]!r}: use letters, digits, dots, - and _")
    return name
