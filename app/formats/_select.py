"""Which of several named parts a map is made of, where a format holds one: grids, voxel maps."""

from __future__ import annotations

import re
from collections.abc import Sequence

from app.errors import Ambiguous, MissingLayer, NotFound
from app.model.frame import GROUND
from app.model.layers import MAP, Layer, PartKey
from app.model.names import did_you_mean


def file_stem(name: str, default: str = MAP) -> str:
    """Turn a part's name into that of its files, without the ending: one folder deep, and not hidden."""
    # A second character ":" would make a Windows drive of it, which no archive may hold.
    return re.sub(r"[/\\\x00-\x1f]|(?<=^.):", "_", name.lstrip(".")).lstrip(".") or default


def select_part(
    keys: Sequence[PartKey],
    layer: Layer,
    name: str | None,
    level: str | None,
    *,
    noun: str,
    option: str,
    supply: str,
    default: str = MAP,
) -> list[PartKey]:
    """The named part; else the one with the usual name, else the only one; on its level, else on the ground, else on
    the only one.

    noun: the part as users call it (``grid``). option: the parameter that names it. supply: what to upload. Raises
    MissingLayer, NotFound, or Ambiguous with the names to choose from.
    """
    every = [key for key in keys if key.layer == layer]
    if not every:
        raise MissingLayer(f"there is no {noun}: {supply}")
    matches = [key for key in every if level in (None, key.level)]
    names = sorted({key.name for key in matches})
    if not matches:
        level_names = sorted({key.level for key in every})
        near = did_you_mean(level or "", level_names)
        raise NotFound(
            f"there is no {noun} on the level {level!r}{near}; there are {noun}s on: {', '.join(level_names)}"
        )
    name = name or (default if default in names else names[0] if len(names) == 1 else None)
    if name is None:
        raise Ambiguous(f"there are several {noun}s, name one with {option}=…: {', '.join(names)}")
    matches = [key for key in matches if key.name == name]
    if not matches:
        raise NotFound(f"there is no {noun} {name!r}{did_you_mean(name, names)}; there are: {', '.join(names)}")
    if len(matches) > 1:
        ground = [key for key in matches if key.level == GROUND]
        if not ground:
            levels = ", ".join(key.level for key in matches)
            raise Ambiguous(f"the {noun} {name!r} is there on several levels, name one with level=…: {levels}")
        matches = ground
    return matches
