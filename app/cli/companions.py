"""Files that belong to maps which the user names: a grid's picture, a building's floor plans, a world's models.

The rules are those of an upload of the folder: only files beside or below a map count, and only those that its format
says it names. It needs the server's code.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from app.cli.client import LocalFile
from app.cli.folder import single, walk

MAX_LISTED = 20_000
"""Maximum number of files below a map's folder that are looked at by name."""


def with_companions(files: Sequence[LocalFile]) -> list[LocalFile]:
    """Add the companions of files that are named by themselves; a name that is taken stays."""
    from app import formats

    out = {file.name: file for file in files}
    for file in files:
        if "/" in file.name or file.path.name != file.name:  # of a folder, which is taken with all its files
            continue
        beside = _Beside(file.path)
        data = beside[file.name]
        known = formats.detect(file.name, data)
        if known is None:
            continue
        names = list(beside)
        if known.sort is not None:
            wanted = known.sort(beside, [file.name]).get(file.name, ())
        else:
            wanted = [*known.companions(file.name, data, names), *known.looks_at(file.name, names)]
        for name in wanted:
            if name in beside:
                out.setdefault(name, single(beside.path(name), name))
    return list(out.values())


class _Beside(Mapping[str, bytes]):
    """The files beside and below a map by name, read when they are needed."""

    def __init__(self, path: Path) -> None:
        folder = path.resolve().parent
        self._paths = {path.name: path}
        for found in walk(folder, MAX_LISTED):
            self._paths.setdefault(found.relative_to(folder).as_posix(), found)
        self._read: dict[str, bytes] = {}

    def path(self, name: str) -> Path:
        """Where a file is."""
        return self._paths[name]

    def __getitem__(self, name: str) -> bytes:
        if name not in self._read:
            self._read[name] = self._paths[name].read_bytes()
        return self._read[name]

    def __contains__(self, name: object) -> bool:
        return name in self._paths

    def __iter__(self) -> Iterator[str]:
        return iter(self._paths)

    def __len__(self) -> int:
        return len(self._paths)
