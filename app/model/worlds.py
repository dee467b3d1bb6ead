"""Selection among several worlds of one upload, which are side by side in one part of objects.

The part's ``document.gazebo.worlds`` lists them by the path of their file without its ending, each with its data
(``sdf``: its element; ``alone``: a single model; ``list``: a generator's list); an object names its own world under
``properties.gazebo.world``. Objects without one belong to each world.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import PurePosixPath
from typing import Any

from app.errors import NotFound
from app.model.features import Features, Properties
from app.model.names import did_you_mean

FAMILY = "gazebo"


def rank(name: str, entry: Mapping[str, Any]) -> tuple[Any, ...]:
    """Sort key: worlds before models and lists; ``gazebo.world`` before others; then the shortest name."""
    base = PurePosixPath(name).name
    alone = "sdf" not in entry or bool(entry.get("alone"))
    return (alone, "list" in entry, not base.startswith("gazebo"), name.count("/"), len(base), name)


def names(part: Features) -> list[str]:
    """List the worlds of a part, the default one first."""
    document = part.document.get(FAMILY)
    worlds = document.get("worlds") if isinstance(document, Mapping) else None
    if not isinstance(worlds, Mapping):
        return []
    used = {object_world(p) for p in part.properties}
    used_worlds = {str(k): w for k, w in worlds.items() if isinstance(w, Mapping) and ("sdf" in w or str(k) in used)}
    return sorted(used_worlds, key=lambda name: rank(name, used_worlds[name]))


def object_world(properties: Properties) -> str | None:
    """Return the world that an object belongs to; None: each."""
    source_properties = properties.get(FAMILY)
    name = source_properties.get("world") if isinstance(source_properties, Mapping) else None
    return None if name is None else str(name)


def select_world(part: Features, world: str | None) -> tuple[Features, list[str]]:
    """Return the objects of one world, by its path or its file's name, default the first; and the other worlds.

    Raises NotFound with the existing ones.
    """
    worlds = names(part)
    if world is not None and worlds:
        matches = [name for name in worlds if world in (name, PurePosixPath(name).name)]
        if not matches:
            raise NotFound(
                f"unknown world {world[:200]!r}{did_you_mean(world, worlds)}; available: {', '.join(worlds)}"
            )
        worlds = [matches[0], *(name for name in worlds if name != matches[0])]
    if len(worlds) < 2:
        return part, []
    others = frozenset(worlds[1:])
    return part.select([k for k, p in enumerate(part.properties) if object_world(p) not in others]), worlds[1:]
