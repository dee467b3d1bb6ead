"""Compute fleet status from stored reports: online, lag, channel convergence.

All times are by the server's clock; robots' clocks are ignored.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

from app.store.fleet_values import Channel, ChannelMove, FleetCounts, Robot, RobotGroup
from app.store.robot_counts import RobotCounts
from app.store.values import rfc3339

REPORT_FRESH = timedelta(seconds=180)
"""Time after a report for which a robot without Zenoh counts as online."""

PRESENCE_FRESH = timedelta(seconds=60)
"""Maximum age of a stored presence; the server renews it every 15 seconds."""


def is_online(robot: Robot, now: datetime) -> bool:
    """Whether a robot is online: by its Zenoh liveliness if that is newer than its last report, else by that report."""
    if robot.presence_at is not None:
        if robot.on_bus and now - robot.presence_at < PRESENCE_FRESH:
            return True
        if not robot.on_bus and robot.presence_at >= robot.time:
            return False
    return now - robot.time < REPORT_FRESH


@dataclass(frozen=True, slots=True)
class Lag:
    """Lag of a robot behind its channel.

    Attributes:
        events: number of channel moves that the robot has not applied.
        differs: whether its root or the closures in its map differ from the channel's.
        since: time of the first of these events; None if it does not lag.
    """

    events: int
    differs: bool
    since: datetime | None

    def as_dict(self) -> dict[str, Any]:
        """Return the members for JSON."""
        return {
            "events": self.events,
            "differs": self.differs,
            "since": None if self.since is None else rfc3339(self.since),
        }


def robot_lag(robot: Robot, channel: Channel, moves: Sequence[ChannelMove]) -> Lag:
    """Compute the lag of a robot behind its channel.

    Args:
        moves: moves of this channel, oldest first.

    A robot that reports no sequence counts as having applied the newest move to the root that it runs.
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
    """Number of a channel's robots by status; each robot is one of holding, failed and lagging.

    Attributes:
        holding: robots that run the channel's root with the closures in force.
        failed: robots that do not and reported a failure.
        ready: robots with the planned version that count in its rollout (authenticated).
        since: time since which all robots run the root; None if any does not.
    """

    total: int
    online: int
    holding: int
    lagging: int
    failed: int
    ready: int
    since: datetime | None

    def as_dict(self) -> dict[str, Any]:
        """Return the members for JSON."""
        return {
            "total": self.total,
            "online": self.online,
            "holding": self.holding,
            "lagging": self.lagging,
            "failed": self.failed,
            "ready": self.ready,
            "since": None if self.since is None else rfc3339(self.since),
        }


def count_robots(counts: RobotCounts, environment: str, now: datetime) -> FleetCounts:
    """Count an environment's robots, those online by the rule of ``is_online``. Raises NotFound."""
    return counts.read(environment, on_bus_after=now - PRESENCE_FRESH, heard_after=now - REPORT_FRESH)


def channel_convergence(counts: FleetCounts, channel: Channel, planned: str | None = None) -> ChannelConvergence:
    """Compute the convergence of a channel. counts: of its environment; planned: root of the planned version."""
    groups = [group for group in counts.groups if group.channel == channel.name]
    overlays = channel.closures.digest
    total = sum(group.number for group in groups)
    behind = [group for group in groups if not group.shows(channel.root, overlays)]
    lagging = sum(group.number for group in behind)
    failed = sum(group.number for group in behind if group.state == "failed")
    changed = counts.last_held.get(channel.name)
    return ChannelConvergence(
        total=total,
        online=min(total, counts.online.get(channel.name, 0)),
        holding=total - lagging,
        lagging=lagging - failed,
        failed=failed,
        ready=0 if planned is None else sum(g.number for g in groups if g.vouched and _has_fetched(g, planned)),
        since=max(changed or channel.time, channel.time) if total and not behind else None,
    )


def _has_fetched(group: RobotGroup, root: str) -> bool:
    return (group.state in ("ready", "active") and group.root == root) or group.held_root == root
