"""Which files of a folder make an environment, and what it is called.

An environment_template folder, as it is found in the wild, is a ROS package with ``config/location``,
``config/metric``, ``config/topological`` and ``config/world``; the user gives the package, or its ``config``. Any
other folder is taken as it is. Names keep their folders, since the server decides by them what a file is meant for.
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from app.cli.client import LocalFile
from app.errors import Invalid

CONFIG = "config"
PARTS = ("location", "metric", "topological", "world")
"""The folders of an environment_template's config; the same as ``app.upload_reader.TEMPLATE_FOLDERS``, without its
imports."""

SCRIPTS = ("environment.sh", "properties.sh")
"""Read as literal assignments by the server; never run."""

SKIPPED = frozenset({".git", ".svn", ".hg", "__pycache__", "node_modules", ".DS_Store"})


NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,62}")
RESERVED = frozenset({"robots", "server"})
"""What an environment may be called; the same as in ``app.store.base``, without its imports."""


@dataclass(frozen=True, slots=True)
class UploadFolder:
    """Files to upload. root: what the names are relative to. notes: what was left out, and why."""

    root: Path
    files: tuple[LocalFile, ...]
    is_template: bool
    notes: tuple[str, ...]


def collect(folder: Path) -> UploadFolder:
    """All files of a folder that belong to its environment, sorted by name.

    Of an environment_template only ``config`` and the scripts beside it are taken: the rest of the package is no map.
    Invalid where there is nothing to upload.
    """
    folder = folder.resolve()
    root, template_paths = _template(folder)
    notes: list[str] = []
    files = [_local(path, root) for path in _walk(template_paths or root, root, notes)]
    if template_paths is not None:
        files += [_local(root / name, root) for name in SCRIPTS if (root / name).is_file()]
    if not files:
        raise Invalid(f"{folder} has no files to upload")
    return UploadFolder(root, tuple(sorted(files, key=lambda f: f.name)), template_paths is not None, tuple(notes))


def environment_name(text: str) -> str:
    """A valid environment name made from a folder's: ``Farm North (2)`` becomes ``farm-north-2``.

    Invalid where nothing is left or the name is reserved.
    """
    name = re.sub(r"[^a-z0-9_-]+", "-", text.lower()).strip("-_")[:63].rstrip("-_")
    if not NAME.fullmatch(name) or name in RESERVED:
        raise Invalid(f"{text!r} makes no name for an environment: give one with --environment")
    return name


def check_name(name: str) -> None:
    """Invalid where a name that the user gave cannot be an environment's, with one that could."""
    if NAME.fullmatch(name) and name not in RESERVED:
        return
    try:
        proposal = f"; try {environment_name(name)}"
    except Invalid:
        proposal = ""
    raise Invalid(
        f"{name!r} cannot be an environment's name: 1 to 63 of a-z, 0-9, - and _, starting with a letter or digit, "
        f"and not robots or server{proposal}"
    )


def single(path: Path, name: str | None = None) -> LocalFile:
    """One file by its own name."""
    return LocalFile(name or path.name, path, path.stat().st_size)


def _template(folder: Path) -> tuple[Path, Path | None]:
    """What names are relative to, and the config folder; None where this is no environment_template."""
    if _is_config(folder / CONFIG):
        return folder, folder / CONFIG
    if folder.name == CONFIG and _is_config(folder):
        return folder.parent, folder
    return folder, None


def walk(folder: Path, limit: int) -> Iterator[Path]:
    """Regular files beside each other and below, the nearest first, at most ``limit``. Links that lead out and folders
    that cannot be listed are passed over."""
    waiting, count = [folder], 0
    while waiting and count < limit:
        directory = waiting.pop(0)
        try:
            entries = sorted(entry for entry in directory.iterdir() if entry.name not in SKIPPED)
        except OSError:
            continue
        for entry in entries:
            linked = entry.is_symlink()
            if linked and not entry.resolve().is_relative_to(folder):
                continue
            if entry.is_file() and count < limit:
                count += 1
                yield entry
            elif entry.is_dir() and not linked and not entry.name.startswith(".") and len(waiting) < limit:
                waiting.append(entry)


def _is_config(folder: Path) -> bool:
    return folder.is_dir() and any((folder / part).is_dir() for part in PARTS)


def _walk(folder: Path, root: Path, notes: list[str]) -> Iterator[Path]:
    """Regular files below a folder. Links are followed only while they stay inside ``root``."""
    for entry in sorted(folder.iterdir()):
        if entry.name in SKIPPED:
            continue
        name = entry.relative_to(root).as_posix()
        if entry.is_symlink():
            target = entry.resolve()
            if not target.is_relative_to(root) or target.is_dir():
                notes.append(f"{name}: a link out of the folder or to a folder is not followed")
                continue
        try:
            mode = os.stat(entry).st_mode  # noqa: PTH116  one call tells what it is
        except OSError as error:
            notes.append(f"{name}: {error.strerror or error}")
            continue
        if stat.S_ISDIR(mode):
            yield from _walk(entry, root, notes)
        elif stat.S_ISREG(mode):
            yield entry
        else:
            notes.append(f"{name}: neither a file nor a folder")


def _local(path: Path, root: Path) -> LocalFile:
    return single(path, path.relative_to(root).as_posix())
