"""Select one of several named parts (grids, voxel maps) for formats that contain one."""

from __future__ import annotations

import re
from collections.abc import Sequence

from app.errors import Ambiguous, MissingLayer, NotFound
from app.model.frame import GROUND
from app.model.layers import MAP, Layer, PartKey
from app.model.names import did_you_mean


def file_stem(name: str, default: str = MAP) -> str:
    """Convert a part's name to the stem of its files: no subfolder, not hidden."""
    # A leading "x:" would be a Windows drive, which archives may not contain.
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
    """Select the named part, else the part named ``default``, else the only one.

    On the given level, else on the ground, else on the only one.

    Args:
        noun: word for the part in messages (``grid``).
        option: parameter that names it.
        supply: what to upload.

    Raises MissingLayer, NotFound, or Ambiguous with the names to choose from.
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
            f"there is no {noun} on level {level!r:.80}{near}; levels with {noun}s: {', '.join(level_names)}"
        )
    name = name or (default if default in names else names[0] if len(names) == 1 else None)
    if name is None:
        raise Ambiguous(f"there are several {noun}s ({', '.join(names)}): name one with {option}=…")
    matches = [key for key in matches if key.name == name]
    if not matches:
        raise NotFound(f"unknown {noun} {name!r:.80}{did_you_mean(name, names)}; available: {', '.join(names)}")
    if len(matches) > 1:
        ground = [key for key in matches if key.level == GROUND]
        if not ground:
            levels = ", ".join(key.level for key in matches)
            raise Ambiguous(f"{noun} {name!r} exists on several levels ({levels}): name one with level=…")
        matches = ground
    return matches
