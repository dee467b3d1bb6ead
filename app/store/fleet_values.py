"""Values of the store about a fleet: channels and rollouts, robots and their reports, overlays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from datetime import datetime
from typing import Any, Final, Literal

from app.event_types import RobotPlace, RobotState
from app.model.closures import NO_CLOSURES, Closure, Closures
from app.store.values import rfc3339

RolloutState = Literal["waiting", "watching", "done", "expired", "failed", "rolled_back", "cancelled"]
OPEN_ROLLOUTS: tuple[RolloutState, ...] = ("waiting", "watching")


@dataclass(frozen=True, slots=True)
class Rollout:
    """A two-stage move: robots fetch the version before the channel moves, and are watched after it.

    Attributes:
        ready: share of the channel's online robots that must have the version before the move (None: at its time only).
        failed: share of robots that must report a failure to move the channel back, or to cancel the move.
        deadline: time at which a waiting move is cancelled.
        window: seconds of watching after the move.
        before: version to move back to.
        state: ``waiting`` until the move, ``watching`` after it, then the outcome.
        said_before: robots that had reported a failure of this version before the present stage began, with the time of
            receipt by the server: later reports are ordered by it, not by the robots' clocks.
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
        """Return all members in the stored form, as JSON."""
        out: dict[str, Any] = {}
        for item in fields(self):
            value = getattr(self, item.name)
            out[item.name] = rfc3339(value) if isinstance(value, datetime) else value
        return out

    def as_dict(self) -> dict[str, Any]:
        """Return the members that clients see, as JSON."""
        return {name: value for name, value in self.as_row().items() if name != "said_before"}

    @classmethod
    def from_row(cls, members: Mapping[str, Any]) -> Rollout:
        """Read the result of ``as_row``; rows of earlier releases have no ``said_before``."""
        values = dict(members)
        for name in ("started", "activate_at", "deadline", "moved"):
            values[name] = None if values[name] is None else datetime.fromisoformat(values[name])
        return cls(**values)


@dataclass(frozen=True, slots=True)
class RolloutStep:
    """The next step of a rollout: move, move back, or end with ``state``; and the reason."""

    do: Literal["move", "move_back", "end"]
    state: RolloutState
    detail: str


@dataclass(frozen=True, slots=True)
class PlannedMove:
    """A channel's next move. activate_at: None if it waits for robots only."""

    version: int
    activate_at: datetime | None
    author: str = ""
    root: str = ""


@dataclass(frozen=True, slots=True)
class Channel:
    """A movable name for a version. version and root are None before its first move.

    sequence: of the event that moved it last (``latest``: of the event that created the head). rollout: the last one.
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
    """A robot's status report.

    reported_at: by the robot's clock. sequence: of the last event that it has processed. holds: version and root that
    it has loaded, ``NO_ROOT`` for none; None if not reported; not part of the history. overlays: digest of the closures
    in the loaded map; None from robots without support for closures. place: not part of the history.
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
    place: RobotPlace | None = None


@dataclass(frozen=True, slots=True)
class ReceivedReport:
    """A report with its robot, and the time of receipt by the server's clock.

    vouched: whether it was authenticated: by a token that may report for the robot, or by a router with users. late:
    whether a mirror has received it and hands it on: it is history if the robot has reported since.
    """

    environment: str
    robot: str
    report: RobotReport
    time: datetime
    vouched: bool = True
    late: bool = False


@dataclass(frozen=True, slots=True)
class ActiveMap:
    """A robot's active map. sequence: of the event that led to it, if reported. since: server's clock.

    overlays: digest of the closures in the map.
    """

    version: int
    root: str
    sequence: int | None
    since: datetime
    overlays: str | None = None

    def shows(self, root: str | None, overlays: str) -> bool:
        """Return whether this is the map with a root and closures, given by their digest."""
        return self.root == root and (self.overlays or NO_CLOSURES.digest) == overlays


@dataclass(frozen=True, slots=True)
class Robot:
    """Current state of a robot in one environment.

    time: of its last report. since: when it first reported the same. on_bus: its liveliness on the bus, as of
        ``presence_at``; None if it never was on the bus.
    vouched: whether any of its reports was authenticated, so that it counts in rollouts.
    place: the last one that it reported, and placed: when the server received it; None if it never did.
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
    place: RobotPlace | None = None
    placed: datetime | None = None


@dataclass(frozen=True, slots=True)
class FailedRobot:
    """Robot that reports a failure of a version. time: of its report. online: whether it is."""

    robot: str
    time: datetime
    online: bool


@dataclass(frozen=True, slots=True)
class OnlineCounts:
    """Numbers of a channel's robots that are online, and of those of them that have or run a version."""

    online: int
    ready: int


@dataclass(frozen=True, slots=True)
class RobotGroup:
    """Robots of a channel with equal reports. held_root, held_overlays: of the active map, None without one."""

    channel: str
    state: RobotState
    root: str
    held_root: str | None
    held_overlays: str | None
    vouched: bool
    number: int

    def shows(self, root: str | None, overlays: str) -> bool:
        """Return whether the active map has a root and closures, given by their digest."""
        return (
            self.held_root is not None
            and self.held_root == root
            and (self.held_overlays or NO_CLOSURES.digest) == overlays
        )


@dataclass(frozen=True, slots=True)
class FleetCounts:
    """Counts of an environment's robots.

    online: number of robots that are online, by channel. last_held: when a robot of the channel last changed its map.
    """

    groups: Sequence[RobotGroup]
    online: Mapping[str, int]
    last_held: Mapping[str, datetime | None]


@dataclass(frozen=True, slots=True)
class ChannelMove:
    """Event that moved a channel to a version."""

    sequence: int
    version: int
    root: str
    time: datetime


NO_ROOT: Final = "0" * 64
"""Root in reports of a robot without a map."""

OverlayState = Literal["pending", "accepted", "rejected", "expired", "ended"]


@dataclass(frozen=True, slots=True)
class Overlay:
    """A temporary obstruction until ``expires``: a GeoJSON polygon in ``crs``, or an edge by its id.

    state: ``pending`` until an editor accepts or rejects it or it expires (``expired``). An accepted overlay is in
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
        """Return the overlay as clients see it, without its empty members."""
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
        """Return the closure for manifests and maps."""
        end = rfc3339(self.expires)
        return Closure(self.id, self.kind, self.level, end, self.edge, self.polygon, self.crs, self.detail)
