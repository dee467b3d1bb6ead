"""What follows from what robots said: who is online, who lags, whether all of a channel hold its root.

All times are the server's clock, so that robots' clocks count for nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

from app.store.fleet_values import Channel, ChannelMove, Robot
from app.store.values import rfc3339

REPORT_FRESH = timedelta(seconds=180)
"""A robot that is not on the bus is online for so long after a report."""

PRESENCE_FRESH = timedelta(seconds=60)
"""A presence is renewed every 15 seconds; where nobody renews it, it counts for no longer than this."""


def is_online(robot: Robot, now: datetime) -> bool:
    """By its liveliness on the bus where that is newer than its last report, else by a recent report."""
    if robot.presence_at is not None:
        if robot.on_bus and now - robot.presence_at < PRESENCE_FRESH:
            return True
        if not robot.on_bus and robot.presence_at >= robot.time:
            return False
    return now - robot.time < REPORT_FRESH


@dataclass(frozen=True, slots=True)
class Lag:
    """How far a robot is behind its channel.

    events: of its channel that it has not acted on. differs: whether its root, or the closures in its map, are not the
    channel's. since: when the
    first of these events was; None where it does not lag.
    """

    events: int
    differs: bool
    since: datetime | None

    def as_dict(self) -> dict[str, Any]:
        """JSON-like."""
        return {
            "events": self.events,
            "differs": self.differs,
            "since": None if self.since is None else rfc3339(self.since),
        }


def robot_lag(robot: Robot, channel: Channel, moves: Sequence[ChannelMove]) -> Lag:
    """A robot's lag. moves: of the channel, oldest first.

    A robot that says no sequence has acted on the newest move that led to the root which it holds.
    """
    active_map = robot.active_map
    if active_map is not None and active_map.shows(channel.root, channel.closures.digest):
        return Lag(0, False, None)
    acted = 0
    if active_map is not None:
        acted = active_map.sequence or next((m.sequence for m in reversed(moves) if m.root == active_map.root), 0)
    missed = [move for move in moves if move.sequence > acted]
    since = missed[0].time if missed else robot.since
    return Lag(len(missed), True, since)


@dataclass(frozen=True, slots=True)
class ChannelConvergence:
    """How a channel's robots stand: each is one of holding, failed and lagging.

    holding: drive on the channel's root with the closures in force. failed: do not, and say that they failed. ready:
    have the version that is planned, and count in its roll-out (vouched for). since: from when on all of them hold the
    root; None while any does not.
    """

    total: int
    online: int
    holding: int
    lagging: int
    failed: int
    ready: int
    since: datetime | None

    def as_dict(self) -> dict[str, Any]:
        """JSON-like."""
        return {
            "total": self.total,
            "online": self.online,
            "holding": self.holding,
            "lagging": self.lagging,
            "failed": self.failed,
            "ready": self.ready,
            "since": None if self.since is None else rfc3339(self.since),
        }


def is_ready(robot: Robot, root: str) -> bool:
    """Whether a robot has a root, so that it could drive on it at once."""
    loaded = robot.report.state in ("ready", "active") and robot.report.root == root
    return loaded or (robot.active_map is not None and robot.active_map.root == root)


def channel_convergence(
    robots: Iterable[Robot], channel: Channel, now: datetime, planned: str | None = None
) -> ChannelConvergence:
    """The proof of convergence of one channel. robots: of its environment; planned: root of what comes next."""
    channel_robots = [robot for robot in robots if robot.report.channel == channel.name]
    overlays = channel.closures.digest
    hold, behind = [], []
    for robot in channel_robots:
        if robot.active_map is not None and robot.active_map.shows(channel.root, overlays):
            hold.append(robot.active_map.since)
        else:
            behind.append(robot)
    failed = sum(robot.report.state == "failed" for robot in behind)
    return ChannelConvergence(
        total=len(channel_robots),
        online=sum(is_online(robot, now) for robot in channel_robots),
        holding=len(hold),
        lagging=len(behind) - failed,
        failed=failed,
        ready=0 if planned is None else sum(robot.vouched and is_ready(robot, planned) for robot in channel_robots),
        since=max([*hold, channel.time]) if channel_robots and not behind else None,
    )
