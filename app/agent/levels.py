"""Levels of the installed map: read and store the robot's level, and load another one."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from app.agent import hooks
from app.agent.map_directory import MapDirectory
from app.agent.signed_manifest import Manifest
from app.agent.state import write_durably
from app.errors import Conflict, Invalid, NotFound, Unavailable

MAX_LEVEL_BYTES = 4096


def level_names(manifest: Manifest) -> list[str]:
    """Return the level names of a map, lowest first."""
    return [level.name for level in manifest.levels]


def level_files(manifest: Manifest, level: str) -> list[str]:
    """Return the paths of the files that belong to one level."""
    return sorted(file.path for file in manifest.files if file.level == level)


def read_level(folder: MapDirectory, manifest: Manifest) -> str | None:
    """Return the robot's level by the name that it has in this map; None if it was never set."""
    names = _level_file_names(folder)
    return next((name for name in names if name in level_names(manifest)), names[0] if names else None)


def _level_file_names(folder: MapDirectory) -> list[str]:
    """Read the names of the robot's level: in the present map, and perhaps in the next one."""
    try:
        content = (folder.path / "level").read_bytes()[:MAX_LEVEL_BYTES]
    except FileNotFoundError:
        return []
    return [name for name in content.decode(errors="replace").split("\n") if name]


def level_problem(manifest: Manifest, level: str | None) -> str | None:
    """Return the problem of a robot on this level with a map, None if it can load the map."""
    if level is None or level in level_names(manifest):
        return None
    names = ", ".join(level_names(manifest)) or "none"
    return (
        f"version {manifest.version} has no level {level!r}, which the robot is on (levels: {names}): "
        "choose another with fleetmap agent-level, or give the name that it has in this map, with --next"
    )


def level_variables(manifest: Manifest, level: str | None) -> dict[str, str]:
    """Return the hook variables of a level.

    ``FLEETMAP_LEVEL_FOLDER`` is the folder of its files below ``<format>/``, empty for the default level.
    """
    folders = {
        file.name.partition("/")[0] if "/" in file.name else ""
        for file in manifest.files
        if level is not None and file.level == level
    }
    return {
        "FLEETMAP_LEVEL": level or "",
        "FLEETMAP_LEVEL_FOLDER": folders.pop() if len(folders) == 1 else "",
    }


def write_hooks(folder: MapDirectory, on_change: Sequence[str], robot: str) -> None:
    """Store the agent's hooks for ``agent-level``."""
    body = {"on_change": list(on_change), "robot": robot}
    data = json.dumps(body, indent=1).encode() + b"\n"
    path = folder.path / "hooks.json"
    if not path.exists() or path.read_bytes() != data:
        write_durably(path, data)


def load_level(
    directory: Path,
    level: str,
    variables: Callable[[MapDirectory, Manifest, Sequence[str], Sequence[str], str | None, str], Mapping[str, str]],
    log: Callable[..., None],
    *,
    for_next_map: bool = False,
) -> None:
    """Run the agent's hooks for one level of the current map, and store the level.

    The agent may be running: a lock keeps its hooks and these apart.

    Args:
        variables: builds the hook variables from directory, manifest, changed files and layers, level and robot.
        for_next_map: only store that the robot's level has this name in the next map.

    Raises:
        NotFound: no map is installed, or it has no such level.
        Conflict: no agent has run in the directory, or it belongs to another user; the current map has a level of
            that name, or the robot is on the default level.
        Unavailable: a hook failed; the level stays as it was, and its hooks were run again.
    """
    folder = MapDirectory(directory)
    commands, robot = _read_hooks(folder.path / "hooks.json")
    with folder.hooks_lock():
        manifest = folder.manifest(folder.current_version)
        if manifest is None:
            raise NotFound(f"no map in {directory} yet: wait for the agent's first sync")
        names, before = level_names(manifest), read_level(folder, manifest)
        if for_next_map:
            if before is None:
                raise Conflict(
                    "the robot is on the default level, which each map has: it needs no name for the next map"
                )
            if level in names:
                raise Conflict(f"the current map has a level {level}: load it without --next")
            write_durably(folder.path / "level", f"{before}\n{level}\n".encode())
            log("level", level=before, next=level, version=manifest.version)
            return
        if level not in names:
            choice = f"choose one of {', '.join(names)}" if names else "the map has no levels"
            raise NotFound(f"unknown level {level[:80]!r}: {choice}, or add --next if that is its name in the next map")

        def run(of: str | None) -> str | None:
            """Run the hooks for a level; None: the default one. Return the problem of the first that fails."""
            folder.hook_status.unlink(missing_ok=True)
            files = sorted(manifest.content) if of is None else level_files(manifest, of)
            values = variables(folder, manifest, files, sorted(manifest.layers), of, robot)
            for command in commands:
                if (problem := hooks.run(command, values)) is not None:
                    return problem
                log("hook", command=command, version=manifest.version, level=of)
            return None

        if (problem := run(level)) is not None:
            again = run(before)
            outcome = "is loaded again" if again is None else f"could not be loaded again either ({again})"
            name = "the default level" if before is None else f"level {before}"
            raise Unavailable(f"could not load level {level}: {problem}; {name} {outcome}")
        write_durably(folder.path / "level", f"{level}\n".encode())
        log("level", level=level, version=manifest.version)


def _read_hooks(path: Path) -> tuple[list[str], str]:
    try:
        with path.open("rb") as stream:
            owner = os.fstat(stream.fileno()).st_uid
            body: Any = json.loads(stream.read())
        commands, robot = body["on_change"], body["robot"]
        if not isinstance(robot, str) or not all(isinstance(command, str) for command in commands):
            raise TypeError("a command is not a string")
    except FileNotFoundError:
        raise Conflict(f"no agent has run in {path.parent}: start fleetmap agent --into {path.parent} first") from None
    except (ValueError, KeyError, TypeError) as error:
        raise Invalid(f"could not read {path} ({error}): restart the agent, which writes it again") from None
    if owner not in (0, os.geteuid()):
        raise Conflict(f"{path} belongs to user id {owner}: run this command as that user")
    return commands, robot
