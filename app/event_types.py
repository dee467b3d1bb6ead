"""What an event can tell of: one dataclass for each type. The store writes these events and robots read them.

Its docstring says when it happens; its fields are the members that it has beside those of all events. ``member`` gives
each an example for the documentation, which is made from here; a member without one is not in every event of the type.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal, TypeVar

EventType = str
"""The name of an event type, such as ``version.created``."""

RobotState = Literal["downloading", "ready", "active", "failed"]
"""State of the map that a robot reports."""

T = TypeVar("T")

_registry: dict[str, type[Any]] = {}
_examples: dict[str, Mapping[str, Any]] = {}


def event(name: EventType, **examples: Any) -> Callable[[type[T]], type[T]]:
    """Declare a class as an event type. examples: of members of all events, where it is special."""

    def declare(cls: type[T]) -> type[T]:
        _registry[name], _examples[name] = dataclass(frozen=True)(cls), examples
        return cls

    return declare


def member(example: Any = None) -> Any:
    """A member of an event, with an example of it."""
    return field(default=None, metadata={"example": example})


def check_members(name: EventType, members: Iterable[str]) -> None:
    """Raise ValueError for an event that is not declared, or has a member that its type does not have."""
    if name not in _registry:
        raise ValueError(f"no event type {name!r}")
    unknown = sorted(set(members) - {f.name for f in fields(_registry[name])})
    if unknown:
        raise ValueError(f"an event {name} has no member {', '.join(unknown)}")


def describe(name: EventType) -> tuple[str, dict[str, Any]]:
    """When an event happens, and an example of its members beside those that all events have in the same way."""
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
    """An environment is created, restored, or renamed: then this is the first event under its new name."""


@event("environment.deleted", layers=[], message="deleted")
class EnvironmentDeleted:
    """An environment is deleted, or renamed: then this is the last event under its old name. A stream of that name ends
    with it."""


@event("version.created")
class VersionCreated:
    """An upload, an edit, a derivation, a generation, a template or a revert makes a version."""


@event("channel.planned")
class ChannelPlanned:
    """A channel is to move later: robots fetch the version in advance. Either `rollout` or `activate_at` says when it
    moves."""

    channel: str = member("production")
    rollback: bool = member(False)
    rollout: Mapping[str, Any] | None = member({"ready": 0.9, "failed": 0.2, "deadline": None})
    activate_at: str | None = member()


@event("channel.cancelled", layers=[])
class ChannelCancelled:
    """A plan ends without a move. `reason` says why: it was cancelled, or its robots failed or were not ready in
    time."""

    channel: str = member("production")
    rollback: bool = member(False)
    reason: str = member("the plan was cancelled")


@event("channel.moved")
class ChannelMoved:
    """A channel points to another version. Robots that follow the channel install it. A move back has `rollback: true`;
    one that the server makes by itself after failures also has a `reason`."""

    channel: str = member("production")
    rollback: bool = member(False)
    reason: str | None = member()


@event("overlay.created", previous=None, layers=[], message=_MESSAGE)
class OverlayCreated:
    """A robot or an editor reports an obstruction. It is pending, and no map shows it."""

    overlay: Mapping[str, Any] = member(_overlay("pending"))


@event("overlay.accepted", previous=None, layers=[], message=_MESSAGE)
class OverlayAccepted:
    """An editor accepts an obstruction. From now on it is a closure that maps show, whatever the channel."""

    overlay: Mapping[str, Any] = member(_overlay("accepted", decided_by="administrator", decided=_TIME))
    overlays_digest: str = member(_DIGEST)


@event("overlay.rejected", previous=None, layers=[], message=_MESSAGE)
class OverlayRejected:
    """An editor rejects an obstruction."""

    overlay: Mapping[str, Any] = member(_overlay("rejected", decided_by="administrator", decided=_TIME))


@event("overlay.expired", previous=None, layers=[], message=_MESSAGE)
class OverlayExpired:
    """Nobody decides on an obstruction before its time is over."""

    overlay: Mapping[str, Any] = member(_overlay("expired", decided=_TIME))


@event("overlay.ended", previous=None, layers=[], message=_MESSAGE)
class OverlayEnded:
    """A closure ends, by its time or by an editor. Maps no longer show it."""

    overlay: Mapping[str, Any] = member(_overlay("ended", decided_by="administrator", decided=_TIME))
    overlays_digest: str = member(_DIGEST)


EVENT_TYPES: tuple[EventType, ...] = tuple(_registry)
"""The names of all event types."""
