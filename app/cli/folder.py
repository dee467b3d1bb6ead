"""Collect the files of a folder to upload, and derive an environment name from the folder's name.

An environment_template folder is a ROS package with ``config/location``, ``config/metric``, ``config/topological`` and
``config/world``; the user selects the package or its ``config``. Any other folder is uploaded completely. File names
keep their folders, from which the server infers the purpose of a file.
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
"""Folders of an environment_template's config; copy of ``app.upload_reader.TEMPLATE_FOLDERS``, to avoid its
imports."""

SCRIPTS = ("environment.sh", "properties.sh")
"""Scripts beside ``config``. The server parses their literal assignments and never runs them."""

SKIPPED = frozenset({".git", ".svn", ".hg", "__pycache__", "node_modules", ".DS_Store"})


NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,62}")
RESERVED = frozenset({"robots", "server"})
"""Reserved environment names; copy of ``app.store.base``, to avoid its imports."""


@dataclass(frozen=True, slots=True)
class UploadFolder:
    """Files to upload.

    Attributes:
        root: folder that file names are relative to.
        is_template: whether the folder is an environment_template.
        notes: skipped files, with the reason.
    """

    root: Path
    files: tuple[LocalFile, ...]
    is_template: bool
    notes: tuple[str, ...]


def collect(folder: Path) -> UploadFolder:
    """Collect the files of a folder that belong to its environment, sorted by name.

    From an environment_template only ``config`` and the scripts beside it. Raises Invalid if there are no files.
    """
    folder = folder.resolve()
    root, template_paths = _template(folder)
    notes: list[str] = []
    files = [_local(path, root) for path in _walk(template_paths or root, root, notes)]
    if template_paths is not None:
        files += [_local(root / name, root) for name in SCRIPTS if (root / name).is_file()]
    if not files:
        raise Invalid(f"no files to upload in {folder}")
    return UploadFolder(root, tuple(sorted(files, key=lambda f: f.name)), template_paths is not None, tuple(notes))


def environment_name(text: str) -> str:
    """Derive a valid environment name from a folder name: ``farm-north-2`` from ``Farm North (2)``.

    Raises Invalid if no valid characters are left or the name is reserved.
    """
    name = re.sub(r"[^a-z0-9_-]+", "-", text.lower()).strip("-_")[:63].rstrip("-_")
    if not NAME.fullmatch(name) or name in RESERVED:
        raise Invalid(f"no environment name can be derived from {text[:80]!r}: set one with --environment")
    return name


def check_name(name: str) -> None:
    """Raise Invalid, with a proposal, if this is not a valid environment name."""
    if NAME.fullmatch(name) and name not in RESERVED:
        return
    try:
        proposal = f"; try {environment_name(name)}"
    except Invalid:
        proposal = ""
    raise Invalid(
        f"invalid environment name {name[:80]!r}: use 1 to 63 characters of a-z, 0-9, - and _, starting with a letter "
        f"or digit, and not robots or server{proposal}"
    )


def single(path: Path, name: str | None = None) -> LocalFile:
    """Return one file to upload; name: default its own."""
    return LocalFile(name or path.name, path, path.stat().st_size)


def _template(folder: Path) -> tuple[Path, Path | None]:
    """Return the folder that file names are relative to, and the config folder (None: not an environment_template)."""
    if _is_config(folder / CONFIG):
        return folder, folder / CONFIG
    if folder.name == CONFIG and _is_config(folder):
        return folder.parent, folder
    return folder, None


def walk(folder: Path, limit: int) -> Iterator[Path]:
    """Yield regular files in and below a folder, breadth first, at most ``limit``.

    Skips links that lead outside the folder, and folders that cannot be listed.
    """
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
    """Yield regular files below a folder. Links to files inside ``root`` are followed."""
    for entry in sorted(folder.iterdir()):
        if entry.name in SKIPPED:
            continue
        name = entry.relative_to(root).as_posix()
        if entry.is_symlink():
            target = entry.resolve()
            if not target.is_relative_to(root) or target.is_dir():
                notes.append(f"{name}: links to folders or to files outside the folder are not followed")
                continue
        try:
            mode = os.stat(entry).st_mode  # noqa: PTH116  one call for the type
        except OSError as error:
            notes.append(f"{name}: {error.strerror or error}")
            continue
        if stat.S_ISDIR(mode):
            yield from _walk(entry, root, notes)
        elif stat.S_ISREG(mode):
            yield entry
        else:
            notes.append(f"{name}: not a regular file")


def _local(path: Path, root: Path) -> LocalFile:
    return single(path, path.relative_to(root).as_posix())
