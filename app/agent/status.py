"""The robot's status: sent over Zenoh at once, confirmed over HTTP, once for each change."""

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
"""Maximum time until a status sent over Zenoh is confirmed over HTTP: the bus acknowledges nothing. A fleet that
changes at once spreads its confirmations over this time.
"""

FIRST_CONFIRM_SECONDS = 2.0
"""The same for the first status after the start: a robot counts in roll-outs once it has reported with its token."""

NO_ROOT = "0" * 64

Subject = Manifest | tuple[int, str]
"""A map that a status is about: its manifest, or version and root if there is no manifest yet."""

REPEAT_SECONDS = 30.0
"""Interval after which a robot without Zenoh repeats its status with the next sync."""


class Bus(Protocol):
    """The robot's Zenoh session, as far as a status needs it."""

    @property
    def connected(self) -> bool:
        """Whether a router is connected."""

    def put_status(self, status: RobotStatus) -> bool:
        """Publish a status; whether a router took it."""


class StatusReporter:
    """The newest status of the robot and where it was sent."""

    def __init__(
        self, environment: str, robot: str, web: ServerClient, stopping: threading.Event, refused: Callable[[str], None]
    ) -> None:
        """Create a reporter. refused: called with the reason when the server does not accept a status."""
        self._environment, self._robot, self._web = environment, robot, web
        self._stopping, self._refused = stopping, refused
        self.bus: Bus | None = None
        self.status: RobotStatus | None = None
        self.confirm_at: float | None = None
        """Monotonic time at which ``send`` has to be called again, if any."""
        self._sent_http: RobotStatus | None = None
        self._sent_http_at = 0.0
        self._is_confirmed = False
        self._sent_zenoh: RobotStatus | None = None

    def set(self, status: RobotStatus) -> bool:
        """Note a status and send it; False if nothing but its time is new."""
        if _is_same_status(status, self.status):
            return False
        self.status = status
        return True

    def forget_sent(self) -> None:
        """Send the status again: a restarted router or server may have missed it."""
        self._sent_http = self._sent_zenoh = None

    def send(self) -> None:
        """Send the status if it is new: over Zenoh at once and over HTTP later, or over HTTP at once without a router.

        A robot that is not on the bus repeats its status now and then: only so does the server see it online.
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
            self._refused(f"the server does not take the robot's status: {error.detail}")
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
    # That of a version fetched by its number is of no move of the channel: the server goes by the root then.
    sequence = current.sequence if current and current.channel is not None else None
    overlays = current.overlays_digest if current else None
    return RobotStatus(channel, version, root, state, detail, time, sequence, overlays, holds)


def loaded_version(current: Manifest | None, *, is_loaded: bool, has_closures: bool) -> tuple[int, str] | None:
    """Return version and root of the current map if the hooks have loaded it; None while they have not.

    A server that applies no closures does not have this member either.
    """
    if current is None:
        return (0, NO_ROOT) if has_closures else None
    if current.overlays_digest is None:
        return None
    return (current.version, current.root) if is_loaded else None


def _version(subject: Subject | None) -> tuple[int, str]:
    """Return the version and root of a map, those of none if there is none."""
    if isinstance(subject, Manifest):
        return subject.version, subject.root
    return subject or (0, NO_ROOT)
