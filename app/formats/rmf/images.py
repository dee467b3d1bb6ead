"""Floor plan images of Open-RMF buildings and sites: their files in an upload, and their names.

A name is a path below the map's directory; if it points elsewhere, the file with the same base name is used.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import PurePosixPath

from app.formats import Files, ReadContext

_OUTSIDE_UPLOAD = re.compile(r"^[A-Za-z]:|^[/~\\]|^\$|://|\\")


def companion_hook(pattern: re.Pattern[bytes]) -> Callable[[str, bytes, Sequence[str]], Iterable[str]]:
    """Create the hook that finds the images named in a main file; one of the pattern's groups is a name."""

    def companions(main: str, data: bytes, names: Sequence[str]) -> Iterable[str]:
        """Return the images that the main file names."""
        image_names = {
            match[match.lastindex or 0].decode("utf-8", "replace").strip() for match in pattern.finditer(data)
        }
        by_base = _by_base_name(names)
        files = (_find(name, main, by_base) for name in sorted(image_names) if name)
        return [name for name in dict.fromkeys(files) if name]

    return companions


def images(files: Files, main: str, named: Iterable[tuple[str, str]], context: ReadContext) -> dict[str, bytes]:
    """Return the images by their path in the exported map. named: (location, name) from the main file."""
    out: dict[str, bytes] = {}
    by_base = _by_base_name(files)
    for location, reference in named:
        if not reference:
            continue
        path = _find(reference, main, by_base)
        if path is None:
            context.warn(
                f"the image {reference[:200]!r} is not in the upload; the map is read without it", where=location
            )
            continue
        name = _plain(reference)
        if name is None:
            name = _base(reference)
            context.warn(
                f"the image path {reference[:200]!r} points outside the upload; using {path} of the same name",
                where=location,
            )
        out[name] = files[path]
    return out


def find_stored_image(reference: str, resources: Mapping[str, bytes]) -> str | None:
    """Return the name of the stored image for a reference in a map, or None."""
    return next((name for name in (_plain(reference), _base(reference)) if name in resources), None)


def _plain(reference: str) -> str | None:
    """Return a reference as a safe path below the map's directory, or None if it points elsewhere."""
    path = PurePosixPath(reference)
    return None if _OUTSIDE_UPLOAD.search(reference) or ".." in path.parts or not path.name else str(path)


def _base(reference: str) -> str:
    return reference.replace("\\", "/").rpartition("/")[2]


def _by_base_name(names: Iterable[str]) -> dict[str, list[str]]:
    """Group the files by base name."""
    out: dict[str, list[str]] = {}
    for name in sorted(names):
        out.setdefault(_base(name), []).append(name)
    return out


def _find(reference: str, main: str, by_base: Mapping[str, Sequence[str]]) -> str | None:
    """Find the upload's file for a reference: next to the map, else the first with that base name."""
    candidates = by_base.get(_base(reference), ())
    folder = main.rpartition("/")[0]
    beside = [f"{folder}/{name}" if folder else name for name in (_plain(reference), _base(reference)) if name]
    return next((name for name in beside if name in candidates), candidates[0] if candidates else None)
