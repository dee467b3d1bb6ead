"""Roll-outs in two stages: robots fetch a version first, the channel moves when enough have it, and moves back when too
many fail.

Shares are of the channel's robots that are online. Robots that say that they failed count as well where they are not
online any more: what broke them may have been the map. Robots of which no report came with authority do not count:
anybody can make them up on an open router. What was said before a stage began does not count in it; that is
known from what was stored then, so that a clock that is set back hides no failure.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timedelta
from fractions import Fraction

from app.fleet.status import is_online, is_ready
from app.store.fleet_values import Robot, Rollout, RolloutStep
from app.store.values import rfc3339


def next_step(rollout: Rollout, robots: Sequence[Robot], now: datetime) -> RolloutStep | None:
    """The next step of a roll-out, None for waiting on. robots: of its channel; only those vouched for count."""
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
        return RolloutStep("end", "failed", f"{broken} to fetch it: the channel stays")
    ready = [r for r in robots if is_online(r, now) and is_ready(r, rollout.root)]
    online = sum(is_online(r, now) for r in robots)
    enough = rollout.ready is None or (online > 0 and _reaches(len(ready), rollout.ready, online))
    if enough and (rollout.activate_at is None or now >= rollout.activate_at):
        reason = "its time has come" if rollout.ready is None else f"{len(ready)} of {online} robots are ready"
        return RolloutStep("move", "waiting", reason)
    if rollout.deadline is not None and now >= rollout.deadline:
        return RolloutStep("end", "expired", f"only {len(ready)} of {online} robots are ready: the channel stays")
    return None


def _reaches(count: int, share: float, total: int) -> bool:
    """Whether so many are this share of all, the share being the decimal that was asked for: 0.28 of 25 is 7."""
    return count >= Fraction(repr(share)) * total
