"""Rollouts in two stages: robots fetch a version first; the channel moves if enough are ready, and back if many fail.

Shares refer to the channel's online robots. Robots that reported a failure also count if they are offline now, since
the map may be the cause. Robots without an authenticated report do not count: on an open router anyone can invent them.
Reports from before a stage do not count in it; they are compared with those stored at its begin, so that a clock that
is set back hides no failure.

Each second all open rollouts are looked at: that reads the robots that failed, and has the others counted only if the
answer decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timedelta
from fractions import Fraction
from typing import Protocol

from app.fleet.status import PRESENCE_FRESH, REPORT_FRESH
from app.store.fleet_values import FailedRobot, OnlineCounts, Rollout, RolloutStep
from app.store.values import rfc3339


class ChannelRobots(Protocol):
    """Authenticated robots of a rollout's channel. Times: as of ``RobotCounts.read``."""

    def failed(self, *, on_bus_after: datetime, heard_after: datetime) -> Sequence[FailedRobot]:
        """List those that report a failure of the rollout's version."""

    def online(self, *, on_bus_after: datetime, heard_after: datetime) -> OnlineCounts:
        """Count those that are online, and those of them that have or run its version."""


def next_step(rollout: Rollout, robots: ChannelRobots, now: datetime) -> RolloutStep | None:
    """Return the next step of a rollout, None to wait."""
    times = {"on_bus_after": now - PRESENCE_FRESH, "heard_after": now - REPORT_FRESH}
    begun = rollout.started if rollout.moved is None else rollout.moved
    failed = [r for r in robots.failed(**times) if rollout.said_before.get(r.robot) != rfc3339(r.time)]
    broken, too_many = "", False
    if failed:
        counted = robots.online(**times).online + sum(not r.online for r in failed)
        broken = f"{len(failed)} of {counted} robots failed"
        too_many = rollout.failed is not None and _reaches(len(failed), rollout.failed, counted)
    if rollout.state == "watching":
        if too_many:
            return RolloutStep("move_back", "rolled_back", broken)
        if now >= begun + timedelta(seconds=rollout.window):
            return RolloutStep("end", "done", broken)
        return None
    if too_many:
        return RolloutStep("end", "failed", f"{broken} to fetch it; the channel does not move")
    if rollout.activate_at is None or now >= rollout.activate_at:
        if rollout.ready is None:
            return RolloutStep("move", "waiting", "scheduled time reached")
        counts = robots.online(**times)
        if counts.online and _reaches(counts.ready, rollout.ready, counts.online):
            return RolloutStep("move", "waiting", f"{counts.ready} of {counts.online} robots are ready")
    if rollout.deadline is not None and now >= rollout.deadline:
        counts = robots.online(**times)
        reason = f"only {counts.ready} of {counts.online} robots are ready; the channel does not move"
        return RolloutStep("end", "expired", reason)
    return None


def _reaches(count: int, share: float, total: int) -> bool:
    """Whether ``count`` reaches a share of ``total``, computed with exact decimals: 0.28 of 25 is 7."""
    return count >= Fraction(repr(share)) * total
