"""Event types: one dataclass per type. The store writes these events, robots and clients read them.

The docstring of a class describes when the event happens; its fields are the members besides those of all events.
``member`` adds an example for the generated documentation; members without an example are optional.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal, TypeVar

EventType = str
"""Name of an event type, such as ``version.created``."""

RobotState = Literal["downloading", "ready", "active", "failed"]
"""State of the map that a robot reports."""


@dataclass(frozen=True)
class Pose:
    """Position of a robot in metres and radians, in the local frame. level: None if not reported."""

    x: float
    y: float
    yaw: float
    level: str | None = None


@dataclass(frozen=True)
class RobotPlace:
    """Place and route that a robot reports. node: id of its last node. route: ids of nodes and edges, in order."""

    pose: Pose | None = None
    node: str | None = None
    route: tuple[str, ...] | None = None

    def __bool__(self) -> bool:
        return self.pose is not None or self.node is not None or self.route is not None

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON members that are set."""
        out: dict[str, Any] = {}
        if self.pose is not None:
            level = {} if self.pose.level is None else {"level": self.pose.level}
            out["pose"] = {"x": self.pose.x, "y": self.pose.y, "yaw": self.pose.yaw, **level}
        if self.node is not None:
            out["node"] = self.node
        if self.route is not None:
            out["route"] = list(self.route)
        return out

    @classmethod
    def from_dict(cls, members: Mapping[str, Any]) -> RobotPlace:
        """Read the result of ``as_dict``."""
        pose, route = members.get("pose"), members.get("route")
        return cls(None if pose is None else Pose(**pose), members.get("node"), None if route is None else tuple(route))


MAX_POSE_METRES = 1e7
MAX_YAW = 1e3
MAX_ROUTE = 1000
MAX_ROUTE_CHARACTERS = 16_384
"""Limits of a reported place: coordinates, radians, ids in a route, and their characters together."""

T = TypeVar("T")

_registry: dict[str, type[Any]] = {}
_examples: dict[str, Mapping[str, Any]] = {}


def event(name: EventType, **examples: Any) -> Callable[[type[T]], type[T]]:
    """Declare a class as an event type. examples: values of common members that are specific to this type."""

    def declare(cls: type[T]) -> type[T]:
        _registry[name], _examples[name] = dataclass(frozen=True)(cls), examples
        return cls

    return declare


def member(example: Any = None) -> Any:
    """Declare a member of an event, with an example value."""
    return field(default=None, metadata={"example": example})


def check_members(name: EventType, members: Iterable[str]) -> None:
    """Raise ValueError if the event type or one of its members is not declared."""
    if name not in _registry:
        raise ValueError(f"unknown event type {name!r}")
    unknown = sorted(set(members) - {f.name for f in fields(_registry[name])})
    if unknown:
        raise ValueError(f"unknown members of event {name}: {', '.join(unknown)}")


def describe(name: EventType) -> tuple[str, dict[str, Any]]:
    """Return the description of an event type, and examples of its specific members."""
    examples = {f.name: f.metadata["example"] for f in fields(_registry[name])}
    doc = " ".join((_registry[name].__doc__ or "").split())
    return doc, {**_examples[name], **{member: example for member, example in examples.items() if example is not None}}


def _overlay(state: str, **more: str) -> dict[str, str]:
    return {
        "id": "d142d4a55e99ca6e",
        "environment": "my-farm",
        "kind": "blocked",
        "state": state,
        "level": "ground",
        "reporter": "administrator",
        "created": "2026-03-02T09:21:16.792667Z",
        "expires": "2026-03-02T10:21:16.792667Z",
        "edge": "gate_barn",
        "detail": "a fallen tree",
        **more,
    }


_MESSAGE = "edge gate_barn, reported as blocked: a fallen tree"
_TIME = "2026-03-02T09:21:16.821263Z"
_DIGEST = "4f53cda18c2baa0c0354bb5f9a3ecbe5ed12ab4d8e11ba873c2f11161202b945"


@event("environment.created", version=0, previous=None, layers=[], message="")
class EnvironmentCreated:
    """An environment is created, restored or renamed. After a rename, this is the first event under the new name."""


@event("environment.deleted", layers=[], message="deleted")
class EnvironmentDeleted:
    """An environment is deleted or renamed. After a rename, this is the last event under the old name. It ends event
    streams of that name."""


@event("version.created")
class VersionCreated:
    """An upload, an edit, a derivation, a generation, a template change or a revert creates a version."""


@event("channel.planned")
class ChannelPlanned:
    """A later channel move is planned, and robots fetch the version in advance. `rollout` or `activate_at` contains the
    condition of the move."""

    channel: str = member("production")
    rollback: bool = member(False)
    rollout: Mapping[str, Any] | None = member({"ready": 0.9, "failed": 0.2, "deadline": None})
    activate_at: str | None = member()


@event("channel.cancelled", layers=[])
class ChannelCancelled:
    """A planned move ends without moving the channel. `reason` contains the cause: it was cancelled, too many robots
    failed, or too few were ready in time."""

    channel: str = member("production")
    rollback: bool = member(False)
    reason: str = member("the plan was cancelled")


@event("channel.moved")
class ChannelMoved:
    """A channel points to another version, which its robots install. A move to an older version has `rollback: true`;
    an automatic rollback after failures also has a `reason`."""

    channel: str = member("production")
    rollback: bool = member(False)
    reason: str | None = member()
    edge_sequence: int | None = member()


@event("overlay.created", previous=None, layers=[], message=_MESSAGE)
class OverlayCreated:
    """A robot or an editor reports an obstruction. It is pending and not part of any map."""

    overlay: Mapping[str, Any] = member(_overlay("pending"))
    edge_sequence: int | None = member()


@event("overlay.accepted", previous=None, layers=[], message=_MESSAGE)
class OverlayAccepted:
    """An editor accepts an obstruction. It is then a closure in force and part of maps on all channels."""

    overlay: Mapping[str, Any] = member(_overlay("accepted", decided_by="administrator", decided=_TIME))
    edge_sequence: int | None = member()
    overlays_digest: str = member(_DIGEST)


@event("overlay.rejected", previous=None, layers=[], message=_MESSAGE)
class OverlayRejected:
    """An editor rejects an obstruction."""

    overlay: Mapping[str, Any] = member(_overlay("rejected", decided_by="administrator", decided=_TIME))
    edge_sequence: int | None = member()


@event("overlay.expired", previous=None, layers=[], message=_MESSAGE)
class OverlayExpired:
    """An obstruction reaches its expiry without a decision."""

    overlay: Mapping[str, Any] = member(_overlay("expired", decided=_TIME))
    edge_sequence: int | None = member()


@event("overlay.ended", previous=None, layers=[], message=_MESSAGE)
class OverlayEnded:
    """A closure ends at its expiry or by an editor. It is no longer part of maps."""

    overlay: Mapping[str, Any] = member(_overlay("ended", decided_by="administrator", decided=_TIME))
    edge_sequence: int | None = member()
    overlays_digest: str = member(_DIGEST)


EVENT_TYPES: tuple[EventType, ...] = tuple(_registry)
"""Names of all event types."""
