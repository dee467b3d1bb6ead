"""What the store hands out about a fleet: channels and their roll-outs, robots and their reports, overlays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from datetime import datetime
from typing import Any, Final, Literal

from app.event_types import RobotState
from app.model.closures import NO_CLOSURES, Closure, Closures
from app.store.values import rfc3339

RolloutState = Literal["waiting", "watching", "done", "expired", "failed", "rolled_back", "cancelled"]
OPEN_ROLLOUTS: tuple[RolloutState, ...] = ("waiting", "watching")


@dataclass(frozen=True, slots=True)
class Rollout:
    """A move in two stages: robots fetch the version first, and are watched after it.

    ready: the channel moves when this share of its online robots has the version (None: at its time alone). failed: it
    moves back, or does not move at all, when this share says that it failed. deadline: the move is given up then.
    window: seconds of watching. before: the version that it moves back to. state: ``waiting`` until it moves,
    ``watching`` after it, then how it ended. said_before: robots that said already that they failed with this version
    when its present stage began, and when the server received it: this orders later reports, not the robots' clocks.
    """

    version: int
    root: str
    started: datetime
    ready: float | None = None
    failed: float | None = None
    activate_at: datetime | None = None
    deadline: datetime | None = None
    window: float = 600.0
    state: RolloutState = "waiting"
    before: int | None = None
    moved: datetime | None = None
    detail: str = ""
    said_before: Mapping[str, str] = field(default_factory=dict)

    def as_row(self) -> dict[str, Any]:
        """JSON-like, with all members, as it is stored."""
        out: dict[str, Any] = {}
        for item in fields(self):
            value = getattr(self, item.name)
            out[item.name] = rfc3339(value) if isinstance(value, datetime) else value
        return out

    def as_dict(self) -> dict[str, Any]:
        """JSON-like, what clients see of it."""
        return {name: value for name, value in self.as_row().items() if name != "said_before"}

    @classmethod
    def from_row(cls, members: Mapping[str, Any]) -> Rollout:
        """The reverse of ``as_row``; rows of earlier releases have no ``said_before``."""
        values = dict(members)
        for name in ("started", "activate_at", "deadline", "moved"):
            values[name] = None if values[name] is None else datetime.fromisoformat(values[name])
        return cls(**values)


@dataclass(frozen=True, slots=True)
class RolloutStep:
    """What a roll-out does next: move, move back, or end as ``state`` says; and why."""

    do: Literal["move", "move_back", "end"]
    state: RolloutState
    detail: str


@dataclass(frozen=True, slots=True)
class PlannedMove:
    """A channel's next move. activate_at: None where it waits for robots alone."""

    version: int
    activate_at: datetime | None
    author: str = ""
    root: str = ""


@dataclass(frozen=True, slots=True)
class Channel:
    """A movable name for a version. version and root are None where the first move is still planned.

    sequence: of the event that moved it last (``latest``: of the event that made the head). rollout: the last one.
    closures: those in force, and closures_sequence: of the last event that changed them.
    """

    name: str
    version: int | None
    root: str | None
    sequence: int
    planned: PlannedMove | None
    author: str
    time: datetime
    rollout: Rollout | None = None
    closures: Closures = NO_CLOSURES
    closures_sequence: int = 0


@dataclass(frozen=True, slots=True)
class RobotReport:
    """What a robot says of itself. reported_at: when, by its own clock. sequence: of the last event that it has
    processed.

    holds: version and root that it has loaded, ``NO_ROOT`` for none; None where it does not say. It is not part of the
    history. overlays: digest of the closures in the map that it has loaded; None from robots that know of none.
    """

    channel: str
    version: int
    root: str
    state: RobotState
    detail: str | None = None
    sequence: int | None = None
    reported_at: datetime | None = None
    overlays: str | None = None
    holds: tuple[int, str] | None = None


@dataclass(frozen=True, slots=True)
class ReceivedReport:
    """A report, of whom, and when it was received by the server's clock.

    vouched: whether it came with authority: with a token that may report for the robot, or over a router with users.
    """

    environment: str
    robot: str
    report: RobotReport
    time: datetime
    vouched: bool = True


@dataclass(frozen=True, slots=True)
class ActiveMap:
    """What a robot drives on. sequence: of the event that it acted on, where it says so. since: server's clock.
    overlays: digest of the closures in it.
    """

    version: int
    root: str
    sequence: int | None
    since: datetime
    overlays: str | None = None

    def shows(self, root: str | None, overlays: str) -> bool:
        """Whether this is the map of a root and of closures, given by their digest."""
        return self.root == root and (self.overlays or NO_CLOSURES.digest) == overlays


@dataclass(frozen=True, slots=True)
class Robot:
    """A robot in one environment, as it is now.

    time: of its last report. since: when it first said the same. on_bus: its liveliness on the bus, as of
        ``presence_at``;
    None where it never was on the bus. vouched: whether any of its reports came with authority, so that it counts in
    roll-outs.
    """

    robot: str
    environment: str
    report: RobotReport
    time: datetime
    since: datetime
    active_map: ActiveMap | None
    on_bus: bool | None = None
    presence_at: datetime | None = None
    vouched: bool = True

    def has_failed_with(self, root: str) -> bool:
        """Whether it says that it failed with a version."""
        return self.report.state == "failed" and self.report.root == root


@dataclass(frozen=True, slots=True)
class ChannelMove:
    """An event that brought a channel to a version."""

    sequence: int
    version: int
    root: str
    time: datetime


NO_ROOT: Final = "0" * 64
"""Root that a robot without a map reports."""

OverlayState = Literal["pending", "accepted", "rejected", "expired", "ended"]


@dataclass(frozen=True, slots=True)
class Overlay:
    """Something that is blocked until ``expires``: a GeoJSON polygon in ``crs``, or an edge by its id.

    state: ``pending`` until an editor accepts or rejects it or its time is over (``expired``). An accepted one is in
    force on every channel until it has ``ended``. version: the one that made it permanent, or into which a release
    before closures put it.
    """

    environment: str
    kind: str
    level: str
    polygon: Mapping[str, Any] | None
    edge: str | None
    crs: str | None
    detail: str | None
    reporter: str
    created: datetime
    expires: datetime
    id: str = ""
    state: OverlayState = "pending"
    decided_by: str | None = None
    decided: datetime | None = None
    version: int | None = None

    def as_dict(self) -> dict[str, Any]:
        """The overlay as clients see it, without its empty members."""
        out: dict[str, Any] = {"id": self.id, "environment": self.environment, "kind": self.kind}
        out |= {"state": self.state, "level": self.level, "reporter": self.reporter}
        out |= {"created": rfc3339(self.created), "expires": rfc3339(self.expires)}
        more: dict[str, Any] = {
            "polygon": self.polygon,
            "edge": self.edge,
            "crs": self.crs,
            "detail": self.detail,
            "decided_by": self.decided_by,
            "decided": rfc3339(self.decided) if self.decided else None,
            "version": self.version,
        }
        return out | {name: value for name, value in more.items() if value is not None}

    @property
    def closure(self) -> Closure:
        """What it closes while it is in force."""
        end = rfc3339(self.expires)
        return Closure(self.id, self.kind, self.level, end, self.edge, self.polygon, self.crs, self.detail)
