"""Which of several stored parts of a layer a derivation looks at: one for each level."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

from app.errors import Ambiguous, NotFound
from app.model.layers import PartKey
from app.model.names import did_you_mean

P = TypeVar("P")


def parts_with_name(parts: Mapping[PartKey, P], name: str, label: str) -> dict[PartKey, P]:
    """The parts of this name. what: what errors call one. Raises NotFound with the names that there are."""
    matches = {key: part for key, part in parts.items() if key.name == name}
    if not matches:
        names = sorted({key.name for key in parts})
        listing = ", ".join(names) or "none"
        raise NotFound(f"there is no {label} {name!r}{did_you_mean(name, names)}; there are: {listing}")
    return matches


def select_per_level(parts: Mapping[PartKey, P], usual: str, label: str, option: str) -> dict[PartKey, P]:
    """For each level the part of the usual name, else the only one. Ambiguous says which option names one."""
    out: dict[PartKey, P] = {}
    for level in dict.fromkeys(key.level for key in parts):
        level_parts = {key: part for key, part in parts.items() if key.level == level}
        chosen = {key: part for key, part in level_parts.items() if key.name == usual} or level_parts
        if len(chosen) > 1:
            listing = ", ".join(key.name for key in chosen)
            raise Ambiguous(f"level {level!r} has several {label}s ({listing}): name one with {option}=")
        out.update(chosen)
    return out
