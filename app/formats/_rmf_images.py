"""The floor plan images that buildings and sites of Open-RMF name: which files of an upload they are, and their names.

A name is a path below the map's folder, or leads to another machine: then the file of the same base name is taken.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import PurePosixPath

from app.formats import Files, ReadContext

_ELSEWHERE = re.compile(r"^[A-Za-z]:|^[/~\\]|^\$|://|\\")


def companions_of(pattern: re.Pattern[bytes]) -> Callable[[str, bytes, Sequence[str]], Iterable[str]]:
    """The hook that finds the images which a main file names; one of the pattern's groups is a name."""

    def companions(main: str, data: bytes, names: Sequence[str]) -> Iterable[str]:
        """The images that the main file names."""
        said = {found[found.lastindex or 0].decode("utf-8", "replace").strip() for found in pattern.finditer(data)}
        known = _by_base(names)
        files = (_find(name, main, known) for name in sorted(said) if name)
        return [name for name in dict.fromkeys(files) if name]

    return companions


def images(files: Files, main: str, named: Iterable[tuple[str, str]], context: ReadContext) -> dict[str, bytes]:
    """The images by the path that the served map names them with. named: (place, name) as the main file says it."""
    out: dict[str, bytes] = {}
    known = _by_base(files)
    for where, said in named:
        if not said:
            continue
        found = _find(said, main, known)
        if found is None:
            context.warn(f"the image {said[:200]!r} is not in the upload: the map is read without it", where=where)
            continue
        name = _plain(said)
        if name is None:
            name = _base(said)
            context.warn(f"the image {said[:200]!r} is of another machine: {found} is taken", where=where)
        out[name] = files[found]
    return out


def stored(said: str, resources: Mapping[str, bytes]) -> str | None:
    """The name of the stored image that a map names, or None."""
    return next((name for name in (_plain(said), _base(said)) if name in resources), None)


def _plain(said: str) -> str | None:
    """The name as a safe path below the map's folder, or None where it leads elsewhere."""
    path = PurePosixPath(said)
    return None if _ELSEWHERE.search(said) or ".." in path.parts or not path.name else str(path)


def _base(said: str) -> str:
    return said.replace("\\", "/").rpartition("/")[2]


def _by_base(names: Iterable[str]) -> dict[str, list[str]]:
    """The files by their base names."""
    out: dict[str, list[str]] = {}
    for name in sorted(names):
        out.setdefault(_base(name), []).append(name)
    return out


def _find(said: str, main: str, known: Mapping[str, Sequence[str]]) -> str | None:
    """The file of the upload that a map means: beside it, else the first of that base name."""
    found = known.get(_base(said), ())
    folder = main.rpartition("/")[0]
    beside = [f"{folder}/{name}" if folder else name for name in (_plain(said), _base(said)) if name]
    return next((name for name in beside if name in found), found[0] if found else None)
