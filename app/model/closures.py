"""Closures: overlays in force. No robot may use these edges and areas until they expire; they are in no version."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

ClosureMode = Literal["apply", "mark", "ignore"]
"""Display of closures in a map.

``apply``: closed edges are omitted, or marked in formats that can block an edge. ``mark``: they stay, with a mark.
``ignore``: the map shows the version without closures.
"""
CLOSURE_MODES: tuple[ClosureMode, ...] = get_args(ClosureMode)


@dataclass(frozen=True, slots=True)
class Closure:
    """One overlay in force: an edge by its id, or a GeoJSON polygon in ``crs``. expires: RFC 3339."""

    id: str
    kind: str
    level: str
    expires: str
    edge: str | None = None
    polygon: Mapping[str, Any] | None = None
    crs: str | None = None
    detail: str | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON members, without empty ones."""
        members = {
            "id": self.id,
            "kind": self.kind,
            "level": self.level,
            "expires": self.expires,
            "edge": self.edge,
            "polygon": self.polygon,
            "crs": self.crs,
            "detail": self.detail,
        }
        return {name: value for name, value in members.items() if value is not None}


@dataclass(frozen=True, slots=True)
class Closures:
    """The closures in force in an environment, sorted by id, with their display mode.

    digest: SHA-256 (hex) of the list: robots with equal roots and equal digests have the same map.
    """

    items: tuple[Closure, ...] = ()
    mode: ClosureMode = "apply"
    digest: str = ""

    def __post_init__(self) -> None:
        if not self.digest:
            object.__setattr__(self, "digest", closures_digest([closure.as_dict() for closure in self.items]))

    def for_mode(self, mode: ClosureMode) -> Closures | None:
        """Return the same closures with another mode; None if they are ignored."""
        return None if mode == "ignore" else replace(self, mode=mode)


def closures_digest(closures: list[dict[str, Any]]) -> str:
    """Return the SHA-256 (hex) of closures as they are listed in a manifest."""
    data = json.dumps(closures, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return hashlib.sha256(data.encode()).hexdigest()


NO_CLOSURES = Closures()


def zone_id(overlay_id: str) -> str:
    """Return the id of the zone for an overlay's polygon."""
    return f"overlay-{overlay_id}"
