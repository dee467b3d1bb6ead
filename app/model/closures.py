"""Closures: overlays in force. Edges and areas that no robot may use for a time, on every channel, in no version."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

ClosureMode = Literal["apply", "mark", "ignore"]
"""How a map shows closures. ``apply``: closed edges are left out of formats that cannot express a blocked edge.
``mark``: closed edges stay and are marked. ``ignore``: the map is the version's, whatever is in force.
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
        """JSON-like, without empty members."""
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
    """The closures in force in an environment, sorted by id, and how a map shows them.

    digest: SHA-256 (hex) of the list: robots with equal roots and equal digests hold the same map.
    """

    items: tuple[Closure, ...] = ()
    mode: ClosureMode = "apply"
    digest: str = ""

    def __post_init__(self) -> None:
        if not self.digest:
            object.__setattr__(self, "digest", closures_digest([closure.as_dict() for closure in self.items]))

    def for_mode(self, mode: ClosureMode) -> Closures | None:
        """The same, shown in another way; None if they are ignored."""
        return None if mode == "ignore" else replace(self, mode=mode)


def closures_digest(closures: list[dict[str, Any]]) -> str:
    """SHA-256 (hex) of closures as they stand in a manifest."""
    data = json.dumps(closures, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return hashlib.sha256(data.encode()).hexdigest()


NO_CLOSURES = Closures()


def zone_id(overlay_id: str) -> str:
    """Return the id of the zone that stands for an overlay's polygon."""
    return f"overlay-{overlay_id}"
