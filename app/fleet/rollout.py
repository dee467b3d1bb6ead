"""Rollouts in two stages: robots fetch a version first; the channel moves if enough are ready, and back if many fail.

Shares refer to the channel's online robots. Robots that reported a failure also count if they are offline now, since
the map may be the cause. Robots without an authenticated report do not count: on an open router anyone can invent them.
Reports from before a stage do not count in it; they are compared with those stored at its begin, so that a clock that
is set back hides no failure.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timedelta
from fractions import Fraction

from app.fleet.status import is_online, is_ready
from app.store.fleet_values import Robot, Rollout, RolloutStep
from app.store.values import rfc3339


def next_step(rollout: Rollout, robots: Sequence[Robot], now: datetime) -> RolloutStep | None:
    """Return the next step of a rollout, None to wait. robots: of its channel; only authenticated ones count."""
    robots = [robot for robot in robots if robot.vouched]
    begun = rollout.started if rollout.moved is None else rollout.moved
    failed = [r for r in robots if r.has_failed_with(rollout.root)]
    names = {r.robot for r in failed if rollout.said_before.get(r.robot) != rfc3339(r.time)}
    counted = len(names | {r.robot for r in robots if is_online(r, now)})
    broken = f"{len(names)} of {counted} robots failed"
    too_many = rollout.failed is not None and bool(names) and _reaches(len(names), rollout.failed, counted)
    if rollout.state == "watching":
        if too_many:
            return RolloutStep("move_back", "rolled_back", broken)
        if now >= begun + timedelta(seconds=rollout.window):
            return RolloutStep("end", "done", broken if names else "")
        return None
    if too_many:
        return RolloutStep("end", "failed", f"{broken} to fetch it; the channel does not move")
    ready = [r for r in robots if is_online(r, now) and is_ready(r, rollout.root)]
    online = sum(is_online(r, now) for r in robots)
    enough = rollout.ready is None or (online > 0 and _reaches(len(ready), rollout.ready, online))
    if enough and (rollout.activate_at is None or now >= rollout.activate_at):
        reason = "scheduled time reached" if rollout.ready is None else f"{len(ready)} of {online} robots are ready"
        return RolloutStep("move", "waiting", reason)
    if rollout.deadline is not None and now >= rollout.deadline:
        return RolloutStep(
            "end", "expired", f"only {len(ready)} of {online} robots are ready; the channel does not move"
        )
    return None


def _reaches(count: int, share: float, total: int) -> bool:
    """Whether ``count`` reaches a share of ``total``, computed with exact decimals: 0.28 of 25 is 7."""
    return count >= Fraction(repr(share)) * total
