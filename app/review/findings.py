"""Findings of a check, and the content that rules read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from app.model.layers import Layer, Layers
from app.review.levels import LevelNetwork
from app.review.network import Floats, Network, build_network

Severity = Literal["error", "warning", "info"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "info")

MAX_IDS = 50
"""Maximum number of ids in one finding; its detail has the count."""


@dataclass(frozen=True, slots=True)
class Fix:
    """Edits that make a finding vanish, as ``POST /edits`` takes them."""

    title: str
    changes: tuple[Mapping[str, Any], ...]

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON members."""
        return {"title": self.title, "changes": list(self.changes)}


@dataclass(frozen=True, slots=True)
class Finding:
    """One mistake. position: local metres; None if the environment has no datum to convert the position."""

    layer: Layer
    level: str
    ids: tuple[str, ...]
    detail: str
    position: tuple[float, float] | None
    fix: Fix | None = None


@dataclass
class Site:
    """Content of a version that is checked, with its network. truncated: a rule stopped at its limits."""

    layers: Layers
    levels: Sequence[str]
    network: Network = field(init=False)
    truncated: bool = False
    _levels: dict[str, LevelNetwork] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.network = build_network(self.layers)

    def level(self, name: str) -> LevelNetwork:
        """Return the network of a level."""
        if name not in self._levels:
            self._levels[name] = LevelNetwork(self.network, name)
        return self._levels[name]


def point(xy: Floats) -> tuple[float, float] | None:
    """Return a position for JSON, rounded to 0.1 mm; None if it is unknown."""
    x, y = float(xy[0]), float(xy[1])
    return (round(x, 4) + 0.0, round(y, 4) + 0.0) if x == x and y == y else None  # noqa: PLR0124  NaN


def name_list(ids: Sequence[str]) -> str:
    """Format the first few ids for a text."""
    return ", ".join(i[:80] for i in ids[:5]) + (" …" if len(ids) > 5 else "")
