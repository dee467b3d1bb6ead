"""What an event can tell of. The store writes these words and robots read them: neither imports the other."""

from __future__ import annotations

from typing import Literal, get_args

EventType = Literal[
    "version.created",
    "channel.planned",
    "channel.cancelled",
    "channel.moved",
    "environment.created",
    "environment.deleted",
    "overlay.created",
    "overlay.accepted",
    "overlay.rejected",
    "overlay.expired",
    "overlay.ended",
]
EVENT_TYPES: tuple[EventType, ...] = get_args(EventType)
