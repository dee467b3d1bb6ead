"""Which of several stored parts of a layer a derivation looks at: one for each level."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

from app.errors import Ambiguous, NotFound
from app.model.layers import PartKey
from app.model.names import did_you_mean

P = TypeVar("P")


def named(parts: Mapping[PartKey, P], name: str, what: str) -> dict[PartKey, P]:
    """The parts of this name. what: what errors call one. Raises NotFound with the names that there are."""
    found = {key: part for key, part in parts.items() if key.name == name}
    if not found:
        names = sorted({key.name for key in parts})
        there = ", ".join(names) or "none"
        raise NotFound(f"there is no {what} {name!r}{did_you_mean(name, names)}; there are: {there}")
    return found


def one_each(parts: Mapping[PartKey, P], usual: str, what: str, option: str) -> dict[PartKey, P]:
    """For each level the part of the usual name, else the only one. Ambiguous says which option names one."""
    out: dict[PartKey, P] = {}
    for level in dict.fromkeys(key.level for key in parts):
        here = {key: part for key, part in parts.items() if key.level == level}
        chosen = {key: part for key, part in here.items() if key.name == usual} or here
        if len(chosen) > 1:
            there = ", ".join(key.name for key in chosen)
            raise Ambiguous(f"level {level!r} has several {what}s ({there}): name one with {option}=")
        out.update(chosen)
    return out
