"""Report the robot's status: over Zenoh at once, confirmed over HTTP, once for each change."""

from __future__ import annotations

import dataclasses
import random
import threading
import time
from collections.abc import Callable
from typing import Any, Protocol

from app.agent.http_client import ServerClient
from app.agent.signed_manifest import Manifest
from app.errors import FleetMapError, Unavailable
from app.event_types import RobotState
from app.events.messages import RobotStatus

CONFIRM_SECONDS = 60.0
"""Maximum time until a status sent over Zenoh is confirmed over HTTP, since Zenoh acknowledges nothing. A random delay
spreads the confirmations of a fleet over this time.
"""

FIRST_CONFIRM_SECONDS = 2.0
"""Maximum delay of the first confirmation: a robot counts in roll-outs only after it has reported with its token."""

NO_ROOT = "0" * 64

Subject = Manifest | tuple[int, str]
"""Map that a status is about: its manifest, or version and root if there is no manifest yet."""

REPEAT_SECONDS = 30.0
"""Interval after which a robot without Zenoh repeats its status with the next sync."""


class Bus(Protocol):
    """Zenoh session as far as the reporter needs it."""

    @property
    def connected(self) -> bool:
        """Whether a router is connected."""

    def put_status(self, status: RobotStatus) -> bool:
        """Publish a status. Return whether it was handed to a router."""


class StatusReporter:
    """Newest status of the robot, and what was sent of it over Zenoh and HTTP."""

    def __init__(
        self, environment: str, robot: str, web: ServerClient, stopping: threading.Event, refused: Callable[[str], None]
    ) -> None:
        """Create a reporter. refused: called with the reason when the server does not accept a status."""
        self._environment, self._robot, self._web = environment, robot, web
        self._stopping, self._refused = stopping, refused
        self.bus: Bus | None = None
        self.status: RobotStatus | None = None
        self.confirm_at: float | None = None
        """Monotonic time at which ``send`` must be called again, if any."""
        self._sent_http: RobotStatus | None = None
        self._sent_http_at = 0.0
        self._is_confirmed = False
        self._sent_zenoh: RobotStatus | None = None

    def set(self, status: RobotStatus) -> bool:
        """Set the status. Return False if only its time differs."""
        if _is_same_status(status, self.status):
            return False
        self.status = status
        return True

    def forget_sent(self) -> None:
        """Make the next ``send`` repeat the status, which a restarted router or server may have missed."""
        self._sent_http = self._sent_zenoh = None

    def send(self) -> None:
        """Send the status if it is new: over Zenoh at once and over HTTP later, or over HTTP at once without a router.

        Without a router the status is repeated every REPEAT_SECONDS, so that the server sees the robot online.
        """
        status, now = self.status, time.monotonic()
        if status is None or self._stopping.is_set():
            return
        on_bus = self.bus is not None and self.bus.connected
        stale = not on_bus and now - self._sent_http_at > REPEAT_SECONDS
        if _is_same_status(status, self._sent_http) and not stale:
            self.confirm_at = None
            return
        if on_bus and self.bus is not None:
            if not _is_same_status(status, self._sent_zenoh) and self.bus.put_status(status):
                self._sent_zenoh = status
            if _is_same_status(status, self._sent_zenoh):
                if self.confirm_at is None:
                    longest = CONFIRM_SECONDS if self._is_confirmed else FIRST_CONFIRM_SECONDS
                    self.confirm_at = now + longest * random.uniform(0.25, 1.0)  # noqa: S311
                if now < self.confirm_at:
                    return
        self.confirm_at = now + CONFIRM_SECONDS  # if this attempt fails
        body: dict[str, Any] = {"environment": self._environment, **status.as_dict()}
        try:
            self._web.put_status(self._robot, body)
        except Unavailable:
            return
        except FleetMapError as error:
            self._refused(f"the server rejects the robot's status: {error.detail}")
            return
        self._sent_http, self._sent_http_at, self.confirm_at = status, now, None
        self._is_confirmed = True


def _is_same_status(one: RobotStatus, other: RobotStatus | None) -> bool:
    return other is not None and dataclasses.replace(one, time=None) == dataclasses.replace(other, time=None)


def describe_status(
    state: RobotState,
    detail: str | None,
    about: Subject | None,
    current: Manifest | None,
    *,
    channel: str,
    time: str,
    holds: tuple[int, str] | None,
) -> RobotStatus:
    """Return the status of a robot. about: the map that it is about; default: the current one."""
    version, root = _version(about or current)
    # A version fetched by number has no position in the channel: the server compares roots instead.
    sequence = current.sequence if current and current.channel is not None else None
    overlays = current.overlays_digest if current else None
    return RobotStatus(channel, version, root, state, detail, time, sequence, overlays, holds)


def loaded_version(current: Manifest | None, *, is_loaded: bool, has_closures: bool) -> tuple[int, str] | None:
    """Return version and root of the current map if the hooks have loaded it, else None.

    Also None if the server applies no closures: such servers do not know this member.
    """
    if current is None:
        return (0, NO_ROOT) if has_closures else None
    if current.overlays_digest is None:
        return None
    return (current.version, current.root) if is_loaded else None


def _version(subject: Subject | None) -> tuple[int, str]:
    """Return version and root of a map; 0 and NO_ROOT if there is none."""
    if isinstance(subject, Manifest):
        return subject.version, subject.root
    return subject or (0, NO_ROOT)
