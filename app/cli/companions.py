"""Find companion files of maps on the command line: a grid's image, a building's floor plans, a world's models.

The rules are those for uploading the folder: only files beside or below a map that its format refers to. Requires the
server's code.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from app.cli.client import LocalFile
from app.cli.folder import single, walk

MAX_LISTED = 20_000
"""Maximum number of files to list below the folder of a map."""


def with_companions(files: Sequence[LocalFile]) -> list[LocalFile]:
    """Add the companions of single files. Files that are already in the list take precedence."""
    out = {file.name: file for file in files}
    for file in files:
        if "/" in file.name or file.path.name != file.name:  # part of a folder, which is complete
            continue
        beside = _FilesBeside(file.path)
        # An image does not refer to other files: a file of the same name (world file, YAML) refers to it.
        same = [n for n in beside if "/" not in n and n != file.name and _stem(n) == _stem(file.name)]
        speaking = [n for n in same if file.name in _companions(n, beside)]
        for name in [*_companions(file.name, beside), *speaking]:
            out.setdefault(name, single(beside.path(name), name))
    return list(out.values())


def _stem(name: str) -> str:
    return name.rpartition(".")[0].lower()


def _companions(main: str, beside: _FilesBeside) -> list[str]:
    """Return the companion files of a map beside and below it; empty if the file is not a map."""
    from app import formats

    fmt = formats.detect(main, beside[main])
    if fmt is None:
        return []
    if fmt.claims.sort is not None:
        companion_names = fmt.claims.sort(beside, [main]).get(main, ())
    else:
        names = list(beside)
        companion_names = [*fmt.claims.companions(main, beside[main], names), *fmt.claims.related_files(main, names)]
    return [name for name in companion_names if name in beside and name != main]


class _FilesBeside(Mapping[str, bytes]):
    """Files beside and below a map by name; read lazily."""

    def __init__(self, path: Path) -> None:
        folder = path.resolve().parent
        self._paths = {path.name: path}
        for file in walk(folder, MAX_LISTED):
            self._paths.setdefault(file.relative_to(folder).as_posix(), file)
        self._read: dict[str, bytes] = {}

    def path(self, name: str) -> Path:
        """Return the path of a file."""
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
